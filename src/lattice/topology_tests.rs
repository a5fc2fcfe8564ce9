//! Shapes whose topology is known: thin shells, bodies that touch, cavities.

use glam::DVec3;

use crate::context::RunContext;
use crate::error::FindingCode;
use crate::image::contact_removal::remove_contacts;
use crate::image::euler_numbers::euler_numbers;
use crate::image::label_image::LabelImage;
use crate::index::Label;
use crate::lattice::face_adjacency::neighbors_of;
use crate::lattice::interface_topology::InterfaceTopology;
use crate::lattice::options::{Options, PARAMETERS};
use crate::lattice::test_images::{segment_distance, voxel_image as image};
use crate::mesh::mixed_mesh::MixedMesh;
use crate::mesh::validation::check_mixed_mesh;
use crate::parameters::ParameterSet;

fn mesh(image: &LabelImage, options: &[(&str, &str)]) -> MixedMesh {
    let mut set = ParameterSet::new(PARAMETERS);
    options.iter().for_each(|(name, value)| set.set_text(name, value).unwrap());
    let options = Options::from_parameters(&set).unwrap();
    let context = RunContext::with_threads(1).unwrap();
    let mesh = super::run(image, &options, &context).unwrap().0.mesh;
    check_mixed_mesh(&mesh).unwrap();
    mesh
}

/// The tets of a mesh and their neighbours.
fn adjacency(mesh: &MixedMesh) -> (Vec<[u32; 4]>, Vec<[u32; 4]>) {
    let tets: Vec<[u32; 4]> = mesh.tets().unwrap().iter().map(|t| t.map(|v| v.index() as u32)).collect();
    let neighbors = neighbors_of(&tets, mesh.points.len(), &RunContext::with_threads(1).unwrap()).unwrap();
    (tets, neighbors)
}

/// Vertices at which the surface of a label pinches.
fn pinched(mesh: &MixedMesh) -> usize {
    let (tets, neighbors) = adjacency(mesh);
    let labels: Vec<Label> = mesh.labels.iter().map(|l| Label(*l as u16)).collect();
    let context = RunContext::with_threads(1).unwrap();
    let topology = InterfaceTopology::new(&tets, &neighbors, mesh.points.len(), &context).unwrap();
    topology.pinched(&labels, &context).unwrap().len()
}

/// Pieces of a label that hang together through faces.
fn pieces(mesh: &MixedMesh, label: i32) -> usize {
    let (tets, neighbors) = adjacency(mesh);
    let mut seen = vec![false; tets.len()];
    let mut count = 0;
    for start in 0..tets.len() {
        if seen[start] || mesh.labels[start] != label {
            continue;
        }
        count += 1;
        let mut stack = vec![start];
        seen[start] = true;
        while let Some(e) = stack.pop() {
            for near in neighbors[e].into_iter().filter(|n| *n != u32::MAX).map(|n| n as usize) {
                if !seen[near] && mesh.labels[near] == label {
                    seen[near] = true;
                    stack.push(near);
                }
            }
        }
    }
    count
}

/// Faces between two labels, 0 for what is outside of the mesh.
fn faces_between(mesh: &MixedMesh, one: i32, other: i32) -> usize {
    let (_, neighbors) = adjacency(mesh);
    let label = |e: u32| if e == u32::MAX { 0 } else { mesh.labels[e as usize] };
    let of_label = (0..neighbors.len()).filter(|e| mesh.labels[*e] == one);
    of_label.flat_map(|e| neighbors[e]).filter(|near| label(*near) == other).count()
}

fn volume_of(mesh: &MixedMesh, label: i32) -> f64 {
    let tets = mesh.tets().unwrap();
    let of_label = (0..tets.len()).filter(|t| mesh.labels[*t] == label);
    of_label.map(|t| crate::geometry::tetrahedron::volume(tets[t].map(|v| mesh.points[v.index()]))).sum()
}

const BOTH_CHECKS: [(&str, &str); 2] = [("check-image-topology", "1"), ("check-mesh-topology", "1")];

#[test]
fn a_shell_of_one_and_a_half_voxels_stays_in_one_piece_with_its_volume() {
    let center = DVec3::new(9.3, 9.1, 9.6);
    let shell = image(20, |p| match p.distance(center) {
        d if d < 5.5 => 1,
        d if d < 7.0 => 2,
        _ => 0,
    });
    let result = mesh(&shell, &[]);
    assert_eq!((pieces(&result, 1), pieces(&result, 2)), (1, 1));
    assert_eq!(pinched(&result), 0);
    for label in 1..3u16 {
        let voxels = shell.voxels().iter().filter(|l| l.0 == label).count() as f64;
        let error = (volume_of(&result, i32::from(label)) / voxels - 1.0).abs();
        assert!(error < 0.02, "label {label}: {error}");
    }
}

#[test]
fn a_wall_around_winding_vessels_has_no_holes() {
    // The wall pinches where no single label mends a whole chain of vertices; 37 faces of the vessels lay open there.
    let waves = |p: DVec3| {
        let [x, y, z] = (p * DVec3::new(0.55, 0.44, 0.38) + DVec3::new(4.3, 4.9, 3.3)).to_array();
        x.sin() + y.sin() + z.sin()
    };
    let is_vessel = |p: DVec3| p.min_element() > 2.5 && p.max_element() < 16.5 && waves(p) < -0.5;
    let near =
        |p: DVec3| (0..27).map(move |n| p + DVec3::new((n % 3) as f64, (n / 3 % 3) as f64, (n / 9) as f64) - 1.0);
    // Voxels within 1.5 of the vessel, which the corners of a cube of 27 are not.
    let is_wall = |p: DVec3| near(p).any(|q| q.distance(p) < 1.5 && is_vessel(q));
    let image = image(20, |p| if is_vessel(p) { 1 } else { 2 * u16::from(is_wall(p)) });
    let result = mesh(&image, &[]);
    assert_eq!(faces_between(&result, 1, 0), 0);
    assert!(faces_between(&result, 1, 2) > 500 && faces_between(&result, 2, 0) > 500);
}

#[test]
fn vessels_that_cross_a_voxel_apart_are_not_joined() {
    // In elements of a voxel and more they are one.
    let rods =
        [([[13.03, 5.05, 9.632], [14.97, 22.95, 9.632]], 3.001), ([[21.05, 8.41, 14.05], [6.95, 19.59, 17.74]], 2.242)];
    let vessels = image(28, |p| u16::from(rods.iter().any(|(ends, radius)| segment_distance(p, *ends) < *radius)));
    assert_eq!(pieces(&mesh(&vessels, &[]), 1), 2);
    // Elements may be kept larger than that: then the bridge is cut at the end, or told where elements stay as they are.
    for (transformations, count, told) in
        [("on", 2, vec![]), ("off", 1, vec![(FindingCode::DisconnectedMesh, [1, -1])])]
    {
        let mut set = ParameterSet::new(PARAMETERS);
        set.set_text("min-element-size", "1").unwrap();
        set.set_text("local-transformations", transformations).unwrap();
        let context = RunContext::with_threads(1).unwrap();
        let (output, _) = super::run(&vessels, &Options::from_parameters(&set).unwrap(), &context).unwrap();
        assert_eq!(pieces(&output.mesh, 1), count);
        assert_eq!(context.take_findings().iter().map(|f| (f.code, f.ids)).collect::<Vec<_>>(), told);
    }
}

#[test]
fn a_vessel_in_a_thin_wall_keeps_volumes_and_topology_with_both_checks() {
    // A wall of 1.4 voxels touches itself and lets the vessel touch the background at edges and corners of voxels all along.
    let vessel = image(30, |p| match segment_distance(p, [[6.2, 7.1, 5.4], [17.3, 14.9, 24.2]]) {
        d if d < 2.1 => 1,
        d if d < 3.5 => 2,
        _ => 0,
    });
    let result = mesh(&vessel, &BOTH_CHECKS);
    assert_eq!((pieces(&result, 1), pieces(&result, 2), pinched(&result)), (1, 1, 0));
    for label in 1..3u16 {
        let voxels = vessel.voxels().iter().filter(|l| l.0 == label).count() as f64;
        let error = (volume_of(&result, i32::from(label)) / voxels - 1.0).abs();
        // Without the volume from before the removal of contacts 0.05 and more.
        assert!(error < 0.01, "label {label}: {error}");
    }
}

#[test]
fn a_hollow_shell_neither_pinches_nor_has_holes() {
    // Background on both sides of a wall of one element: the outside of the lattice has two parts at a vertex.
    let shell = image(28, |p| u16::from((10.5..12.0).contains(&p.distance(DVec3::new(13.3, 13.1, 13.6)))));
    let result = mesh(&shell, &[("fidelity", "0.9")]);
    assert_eq!((pieces(&result, 1), pinched(&result)), (1, 0));
    // Two closed spheres: V - E + F = 4, and 2 E = 3 F.
    let mut vertices: Vec<_> = result.boundary.triangles.as_flattened().to_vec();
    vertices.sort_unstable();
    vertices.dedup();
    assert_eq!(2 * vertices.len(), result.boundary.triangles.len() + 8);
}

#[test]
fn cubes_that_touch_at_a_corner_or_an_edge_do_not_pinch_with_both_checks() {
    let inside = |p: DVec3, low: DVec3| p.cmpge(low).all() && p.cmplt(low + 5.0).all();
    for second in [DVec3::splat(9.0), DVec3::new(9.0, 9.0, 4.0)] {
        let cubes = image(18, |p| u16::from(inside(p, DVec3::splat(4.0)) || inside(p, second)));
        let result = mesh(&cubes, &BOTH_CHECKS);
        assert_eq!(pinched(&result), 0);
        assert!(pieces(&result, 1) <= 2);
    }
}

#[test]
fn checkered_labels_do_not_pinch_with_both_checks() {
    // Blocks of two labels meet like a checkerboard: many contacts at edges and corners.
    let block = |p: DVec3| (p / 4.0).floor().as_ivec3().element_sum() & 1;
    let ball = |p: DVec3| p.distance(DVec3::splat(7.6)) < 6.4;
    let checkered = image(16, |p| if ball(p) { 1 + block(p) as u16 } else { 0 });
    for smoothing in ["0", "5"] {
        let options = [BOTH_CHECKS[0], BOTH_CHECKS[1], ("smoothing-iterations", smoothing)];
        assert_eq!(pinched(&mesh(&checkered, &options)), 0, "{smoothing}");
    }
}

#[test]
fn a_sponge_keeps_all_its_tunnels_with_both_checks() {
    // Two labels wound into each other, with walls and struts of two voxels. Without a look at Euler numbers label 2 lost two
    // tunnels of 31.
    let wave = |p: DVec3| {
        let [x, y, z] = (p * (std::f64::consts::TAU / 6.5)).to_array();
        x.sin() * y.cos() + y.sin() * z.cos() + z.sin() * x.cos()
    };
    let sponge = image(22, |p| match wave(p) {
        _ if p.distance(DVec3::new(10.6, 10.3, 10.9)) >= 8.5 => 0,
        w if w > 0.5 => 1,
        w if w < -0.6 => 2,
        _ => 0,
    });
    let mut clean = sponge.clone();
    let context = RunContext::with_threads(1).unwrap();
    remove_contacts(&mut clean, 1, &context).unwrap();
    let wanted = euler_numbers(&clean, &context).unwrap();
    assert!(wanted[1][0] < -15 && wanted[2][0] < -20 && wanted[1..].iter().all(|[l, r]| l == r), "{wanted:?}");
    for smoothing in ["0", "5"] {
        let result = mesh(&sponge, &[BOTH_CHECKS[0], BOTH_CHECKS[1], ("smoothing-iterations", smoothing)]);
        let tets: Vec<[u32; 4]> = result.tets().unwrap().iter().map(|t| t.map(|v| v.index() as u32)).collect();
        let labels: Vec<Label> = result.labels.iter().map(|l| Label(*l as u16)).collect();
        let neighbors = neighbors_of(&tets, result.points.len(), &context).unwrap();
        let topology = InterfaceTopology::new(&tets, &neighbors, result.points.len(), &context).unwrap();
        let differing = topology.euler_ranges(&labels, &wanted, &context).unwrap().differing();
        assert!(differing.is_empty(), "{smoothing}: {differing:?}");
    }
}

#[test]
fn a_few_specks_of_a_voxel_do_not_refine_the_whole_lattice() {
    // The two halves of a ball, each with voxels of the other's label.
    let specks: Vec<DVec3> =
        (0..40).map(|n| DVec3::from_array([7, 11, 13].map(|step| 16.0 + f64::from(step * n % 32)))).collect();
    let halves = image(64, |p| {
        let half = 1 + u16::from(p.x > 31.9);
        let label = if specks.contains(&p) { 3 - half } else { half };
        if p.distance(DVec3::splat(31.6)) < 27.0 { label } else { 0 }
    });
    let result = mesh(&halves, &[("smoothing-iterations", "0")]);
    // Measured 128 thousand; 989 thousand where closure carries the refinement of a few leaves through the ball.
    let count = result.tets().unwrap().len();
    assert!(count < 250_000, "{count}");
}

#[test]
fn two_labels_of_eight_voxels_do_not_make_a_lattice_finer_than_the_voxels() {
    let is_at = |p: DVec3, low: [f64; 3]| {
        (p - DVec3::from(low)).cmpge(DVec3::ZERO).all() && (p - DVec3::from(low)).cmple(DVec3::ONE).all()
    };
    let image = image(28, |p| {
        let in_block = p.min_element() >= 4.0 && p.max_element() < 24.0;
        let label = if is_at(p, [9.0, 9.0, 9.0]) {
            2
        } else if is_at(p, [17.0, 16.0, 15.0]) {
            3
        } else {
            1
        };
        if in_block { label } else { 0 }
    });
    let mesh = mesh(&image, &[]);
    // 18 148 where refinement is local at the end, 109 754 where it spreads.
    assert!(mesh.labels.len() < 40_000, "{}", mesh.labels.len());
    assert!([2, 3].iter().all(|label| mesh.labels.contains(label)));
}

#[test]
fn a_closed_cavity_of_eight_voxels_is_kept() {
    let body = image(24, |p| {
        let cavity = p.cmpge(DVec3::splat(11.0)).all() && p.cmplt(DVec3::splat(13.0)).all();
        u16::from(p.distance(DVec3::splat(11.4)) < 9.5 && !cavity)
    });
    for smoothing in ["0", "5"] {
        let result = mesh(&body, &[("surface-tolerance", "100"), ("smoothing-iterations", smoothing)]);
        let near = |p: DVec3| p.distance(DVec3::splat(11.5)) < 3.0;
        let walls = result.boundary.triangles.iter().filter(|t| t.iter().all(|v| near(result.points[v.index()])));
        assert!(walls.count() >= 4, "{smoothing}");
    }
}

#[test]
fn crowded_labels_in_crooked_sheets_do_not_pinch() {
    // Where a sum of plane waves is positive, labels by the nearest of 24 places.
    let middle = DVec3::splat(17.5);
    for k in [0, 5] {
        let wave = |p: DVec3, i: usize| {
            let t = (7 * k + 3 * i + 1) as f64;
            let way = DVec3::new((2.3 * t).sin(), (3.7 * t + 1.0).cos(), (1.9 * t + 2.0).sin()).normalize();
            (way.dot(p) * std::f64::consts::TAU / (13.5 + 4.5 * (5.1 * t).sin()) + 2.7 * t).sin()
        };
        let place = |i: usize| {
            let t = (i + 31 * k) as f64;
            middle + 16.0 * DVec3::new((2.3 * t).sin(), (3.7 * t + 1.0).cos(), (1.9 * t + 2.0).sin())
        };
        let nearest =
            |p: DVec3| (0..24).min_by(|l, r| place(*l).distance(p).total_cmp(&place(*r).distance(p))).unwrap();
        let is_tissue = |p: DVec3| p.distance(middle) < 16.0 && (0..5).map(|i| wave(p, i)).sum::<f64>() > 0.0;
        let crowded = image(36, |p| if is_tissue(p) { 1 + nearest(p) as u16 } else { 0 });
        // Measured with triangles turned over also where a third label is at the edges: one edge with 0, two with 5.
        assert_eq!(pinched(&mesh(&crowded, &[])), 0, "{k}");
    }
}
