//! Meshes of a few tets for tests.

use glam::DVec3;

use crate::context::RunContext;
use crate::geometry::tetrahedron::volume6;
use crate::image::label_image::LabelImage;
use crate::index::{Label, VertexId};
use crate::lattice::boundary_targets::SourcePoints;
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::face_adjacency::neighbors_of;
use crate::lattice::improvement_mesh::ImprovementMesh;
use crate::lattice::subvoxel_surface::SubvoxelSurface;
use crate::lattice::test_images::voxel_image;

/// Works on some tets, turned so that their volume is positive, each with a label, beside the surfaces of an image.
pub fn with_tets<T>(
    points: Vec<DVec3>,
    labelled: &[([u32; 4], Label)],
    image: &LabelImage,
    work: impl FnOnce(ImprovementMesh) -> T,
) -> T {
    let positive = |mut tet: [u32; 4]| {
        if volume6(tet.map(|v| points[v as usize])) < 0.0 {
            tet.swap(2, 3);
        }
        tet
    };
    let rows: Vec<[u32; 4]> = labelled.iter().map(|(tet, _)| positive(*tet)).collect();
    let tets: Vec<[VertexId; 4]> = rows.iter().map(|tet| tet.map(VertexId)).collect();
    let tet_labels: Vec<Label> = labelled.iter().map(|(_, label)| *label).collect();
    let context = RunContext::with_threads(1).unwrap();
    let surface = SubvoxelSurface::new(image, &context).unwrap();
    let neighbors = neighbors_of(&rows, points.len(), &context).unwrap();
    let sources = SourcePoints::new(&points, &tets, &tet_labels, &neighbors, &surface, &[], &context).unwrap();
    let mut mesh = CandidateMesh { points, tets, tet_labels, ..CandidateMesh::default() };
    work(ImprovementMesh::new(&mut mesh, &sources, surface))
}

/// Points and tets of a helix of tets, each beside the next, of two labels by turns.
pub fn helix(count: u32) -> (Vec<DVec3>, Vec<([u32; 4], Label)>) {
    let at = |i: f64| DVec3::new(0.5 * (2.3 * i).cos(), 0.5 * (2.3 * i).sin(), 0.3 * i);
    let tet = |i: u32| ([i, i + 1, i + 2, i + 3], Label(1 + (i % 2) as u16));
    ((0..count + 3).map(|i| at(f64::from(i))).collect(), (0..count).map(tet).collect())
}

/// Cubes along an edge of a block.
const CUBES: u32 = 9;

/// A block of cubes of six tets each, whose inner vertices were shaken by up to `far` along each axis; the label by the position of the
/// cube along x.
pub fn shaken_block(far: f64, label: impl Fn(u32) -> u16) -> (Vec<DVec3>, Vec<([u32; 4], Label)>) {
    let along = CUBES + 1;
    let places = (0..along.pow(3)).map(|v| [v % along, v / along % along, v / along.pow(2)]);
    let shake = |at: [u32; 3]| {
        let turn = f64::from(at[0] + along * (at[1] + along * at[2]));
        let is_inside = at.iter().all(|i| (1..CUBES).contains(i));
        f64::from(u8::from(is_inside)) * far * DVec3::new(turn.sin(), (1.7 * turn).sin(), (2.9 * turn).cos())
    };
    let points = places.clone().map(|at| DVec3::from(at.map(f64::from)) + 1.0 + shake(at)).collect();
    let steps = [1, along, along * along];
    let orders = [[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]];
    let of_cube = |[i, j, k]: [u32; 3]| {
        let first = i + along * (j + along * k);
        let label = Label(label(i));
        orders.map(|[a, b, c]| {
            let [second, third] = [first + steps[a], first + steps[a] + steps[b]];
            ([first, second, third, third + steps[c]], label)
        })
    };
    let cubes = places.filter(|at| at.iter().all(|i| *i < CUBES));
    (points, cubes.flat_map(of_cube).collect())
}

/// Works on four tets around the edge 0 1 between points of a ball of 5 mm, two outside of it (label 2), two inside (label 1), in
/// the given order of these; 0 and 1 are `half` rad from its top, the vertices 2 and 3 across 0.35 rad.
pub fn with_edge_on_ball<T>(half: f64, order: [usize; 4], work: impl FnOnce(ImprovementMesh) -> T) -> T {
    let (center, radius) = (DVec3::new(8.2, 7.9, 8.1), 5.0);
    let on_ball = |x: f64, z: f64| {
        let angle = x.hypot(z);
        center + radius * DVec3::new(x / angle * angle.sin(), angle.cos(), z / angle * angle.sin())
    };
    let mut points = vec![on_ball(0.0, half), on_ball(0.0, -half), on_ball(0.35, 0.0), on_ball(-0.35, 0.0)];
    points.extend([4.0, -4.0].map(|up| center + DVec3::new(0.0, radius + up, 0.0)));
    let tets = [([0, 1, 2, 4], 2), ([0, 1, 3, 4], 2), ([0, 1, 2, 5], 1), ([0, 1, 3, 5], 1)];
    let labelled = order.map(|n| (tets[n].0, Label(tets[n].1)));
    let image = voxel_image(17, |p| if p.distance(center) < radius { 1 } else { 2 });
    with_tets(points, &labelled, &image, work)
}

/// Works on the six tets of the vertex 0, `off` mm above the top of a ball of 5 mm: three to the vertex 1, `depth` mm below the top
/// (label 1), three to the vertex 2, 2 mm above it (label 2); the vertices 3 to 5 lie on the ball.
pub fn with_vertex_on_ball<T>([off, depth]: [f64; 2], work: impl FnOnce(ImprovementMesh) -> T) -> T {
    let (center, radius) = (DVec3::new(8.2, 7.9, 8.1), 5.0);
    let on_ball = |turn: f64| {
        let (side, up) = 0.3f64.sin_cos();
        center + radius * DVec3::new(side * turn.cos(), up, side * turn.sin())
    };
    let mut points: Vec<DVec3> = [off, -depth, 2.0].map(|up| center + DVec3::new(0.0, radius + up, 0.0)).to_vec();
    points.extend([0.0, 2.1, 4.2].map(on_ball));
    let tets = |apex: u32, label: u16| [[3, 4], [4, 5], [5, 3]].map(|[p, q]| ([0, p, q, apex], Label(label)));
    let image = voxel_image(17, |p| if p.distance(center) < radius { 1 } else { 2 });
    with_tets(points, &[tets(1, 1), tets(2, 2)].concat(), &image, work)
}

/// Works on two tets with a face each in the border plane x = -0.5, on both sides of an edge between the first two of some vertices; 4 is
/// inside of the image. The surface of their label is at z = 4.5, its corners in the plane between 0.5 above and 3.5 below.
pub fn with_faces_in_border<T>([a, b, c, d]: [u32; 4], work: impl FnOnce(ImprovementMesh) -> T) -> T {
    let at = |x: f64, y: f64, z: f64| DVec3::new(x, y, z);
    let mut points = vec![at(1.5, 4.0, 3.0); 5];
    let in_plane = [(a, at(-0.5, 3.0, 3.0)), (b, at(-0.5, 5.0, 3.0)), (c, at(-0.5, 4.0, 5.0)), (d, at(-0.5, 4.0, 1.0))];
    in_plane.into_iter().for_each(|(v, point)| points[v as usize] = point);
    let tets = [[a, b, c, 4], [a, b, d, 4]].map(|tet| (tet, Label(1)));
    with_tets(points, &tets, &voxel_image(9, |p| u16::from(p.z < 4.5)), work)
}

/// Works on the tets around the edge 0 1 of a flat surface between label 1 below and label 2: the triangle to the vertex 2 lies
/// upside down over that to the vertex 3, with a flat tet of label 2, the slot [`FOLDED`], between them. At the vertex 3 a tet of the
/// label `beside` begins, one of the label `above` has the edge 2 3 across from the flat one.
pub fn with_fold<T>([beside, above]: [Label; 2], work: impl FnOnce(ImprovementMesh) -> T) -> T {
    let at = |x: f64, y: f64, z: f64| DVec3::new(4.0 + x, 4.0 + y, 4.5 + z);
    let edge = [at(0.0, -1.0, 0.0), at(0.0, 1.0, 0.0)];
    let ring = [at(0.5, 0.0, 0.15), at(2.0, 0.0, 0.0), at(0.6, 0.0, -1.6), at(-1.5, 0.0, -0.6), at(-0.4, 0.0, 1.0)];
    let points = edge.into_iter().chain(ring).chain([at(1.4, -0.4, 1.6)]);
    let points = points.chain([at(3.0, -0.5, 0.7), at(3.0, 0.5, 0.7), at(3.0, 0.0, 1.4), at(1.4, 0.4, 1.6)]).collect();
    let below = [[0, 1, 3, 4], [0, 1, 4, 5], [0, 1, 5, 6], [0, 1, 6, 2]].map(|tet| (tet, Label(1)));
    let over = [[0, 1, 2, 3], [0, 2, 3, 7], [1, 2, 3, 11]].map(|tet| (tet, Label(2)));
    let others = [([2, 3, 7, 11], above), ([3, 8, 9, 10], beside)];
    let image = voxel_image(9, |p| if p.z < 4.5 { 1 } else { 2 });
    with_tets(points, &[below.as_slice(), &over, &others].concat(), &image, work)
}

/// The flat tet of [`with_fold`].
pub const FOLDED: u32 = 4;
