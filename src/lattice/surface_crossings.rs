//! Counts where the surface of the mesh runs through itself: the last look at what the scaffold promises.
//!
//! # Method
//! 1. The mesh and its scaffold together: where all tets are positive and the outermost faces that could move cross none,
//!    a point is in one tet at most, so that nothing can cross. Faces among vertices that never moved are those of the
//!    lattice. This settles almost every mesh; most of what could move there lies in the border of the image.
//! 2. Otherwise, positive tets that share their inner faces can overlap only where the outside of the mesh crosses itself.
//!    The crossing pairs of outer faces are found through a tree of boxes and the exact triangle test.
//!
//! Faces in one border plane are not tested against one another: their tets lie all on the same side, so that the faces are
//! oriented alike, and two can overlap only where an edge at which faces of that plane end runs across another. The next face at
//! that edge meets it there, and is tested; it is in no other border plane, as no vertex lies outside of these.
//!
//! # Source
//! The crossing test is that of `geometry::intersection`; [Jiang2017] for the scaffold.
//!
//! # Cost
//! One pass over the tets; one tree of the outer faces where step 1 leaves it open.

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::aabb_tree::AabbTree;
use crate::geometry::bounding_box::BoundingBox;
use crate::geometry::intersection::{Meeting, triangle_pair};
use crate::geometry::predicates::orient3d;
use crate::index::Label;
use crate::lattice::element_score::Part;
use crate::lattice::improvement_mesh::ImprovementMesh;
use crate::mesh::numbering::TET_FACES;

/// Pairs of outer faces that meet beyond what they share.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn count_crossings(mesh: &ImprovementMesh, context: &RunContext) -> Result<usize> {
    if is_kept_apart(mesh, context)? {
        return Ok(0);
    }
    let faces = outer_faces(mesh, context);
    crossings_with(mesh, &faces, (0..faces.len()).into_par_iter().map(|at| (faces[at], at + 1)), context)
}

/// Whether mesh and scaffold together show that nothing overlaps.
fn is_kept_apart(mesh: &ImprovementMesh, context: &RunContext) -> Result<bool> {
    let is_positive = |t: u32| {
        let [a, b, c, d] = mesh.corners(t);
        orient3d(a, b, c, d) > 0.0
    };
    let all = || (0..mesh.tets.len() as u32).into_par_iter().with_min_len(4096);
    let tets = || context.until_cancelled(all()).filter(|t| mesh.is_live(*t));
    let are_positive = tets().all(is_positive);
    context.check()?;
    if !are_positive {
        return Ok(false);
    }
    let faces_of = |t: u32| TET_FACES.map(|face| face.map(|v| mesh.tets[t as usize][v]));
    // Inside of a label there are neighbours on all sides.
    let may_be_open = |face: &[u32; 3]| {
        face.iter().any(|v| !mesh.is_still(*v)) && face.iter().all(|v| mesh.is_at_outside(*v) || mesh.is_still(*v))
    };
    let moving = |t: u32| {
        let faces = faces_of(t).into_iter().enumerate();
        let open = faces.filter(move |(at, face)| may_be_open(face) && mesh.label_behind(t, *at).is_none());
        open.map(move |(at, face)| (face, is_in_border(mesh, face, mesh.tets[t as usize][at])))
    };
    // Most tets have no such face: three of the vertices would be there.
    let may_have_one = |t: &u32| {
        let is_there = |v: &&u32| mesh.is_at_outside(**v) || mesh.is_still(**v);
        mesh.tets[*t as usize].iter().filter(is_there).count() >= 3
    };
    let open: Vec<([u32; 3], bool)> = tets().filter(may_have_one).flat_map_iter(moving).collect();
    context.check()?;
    if open.is_empty() {
        return Ok(true);
    }
    let of_kind = |in_border: bool| open.iter().filter(move |(_, is_in)| *is_in == in_border).map(|(face, _)| *face);
    let (flat, mut others): (Vec<[u32; 3]>, Vec<[u32; 3]>) = (of_kind(true).collect(), of_kind(false).collect());
    let count = others.len();
    let is_scaffold = |t: &u32| mesh.part(*t) == Part::Scaffold;
    let still = |t: u32| faces_of(t).into_iter().filter(|face| face.iter().all(|v| mesh.is_still(*v)));
    others.par_extend(tets().filter(is_scaffold).flat_map_iter(still));
    context.check()?;
    let asked = (0..count).into_par_iter().map(|at| (others[at], at + 1));
    Ok(crossings_with(mesh, &others, asked.chain(flat.par_iter().map(|face| (*face, 0))), context)? == 0)
}

/// Whether a face lies in a border plane of the image, within the others, and its tet's fourth vertex on the inner side. Exactly: what is
/// bound to a plane is put there.
fn is_in_border(mesh: &ImprovementMesh, face: [u32; 3], apex: u32) -> bool {
    let at = |v: u32| mesh.points[v as usize];
    let is_in = |plane: u8| {
        let (axis, border) = mesh.surface.border(plane);
        let inwards = if plane.is_multiple_of(2) { 1.0 } else { -1.0 };
        face.iter().all(|v| at(*v)[axis] == border) && (at(apex)[axis] - border) * inwards > 0.0
    };
    (0..6).any(is_in) && face.iter().all(|v| mesh.surface.within_borders(at(*v)) == at(*v))
}

/// Pairs of faces that meet beyond what they share: each one asked for, and one of `faces` from a number on.
fn crossings_with(
    mesh: &ImprovementMesh,
    faces: &[[u32; 3]],
    asked: impl IndexedParallelIterator<Item = ([u32; 3], usize)>,
    context: &RunContext,
) -> Result<usize> {
    let at = |v: u32| mesh.points[v as usize];
    let box_of = |f: &[u32; 3]| BoundingBox::of_points(f.map(at));
    let tree = AabbTree::new(faces.par_iter().map(box_of).collect(), context)?;
    let of_face = |(face, from): ([u32; 3], usize)| {
        let mut count = 0;
        tree.overlapping(box_of(&face), |other| {
            count += usize::from(other >= from && triangle_pair(face, faces[other], at) != Meeting::Proper);
        });
        count
    };
    let count = context.until_cancelled(asked.with_min_len(256)).map(of_face).sum();
    context.check()?;
    Ok(count)
}

/// Faces of one tet only, seen from outside counter-clockwise; some of them once the run is cancelled.
fn outer_faces(mesh: &ImprovementMesh, context: &RunContext) -> Vec<[u32; 3]> {
    let of_tet = |t: u32| {
        let tet = mesh.tets[t as usize];
        (0..4).filter_map(move |face| {
            let corners = TET_FACES[face].map(|v| tet[v]);
            let may_be =
                mesh.is_live(t) && mesh.part(t) == Part::Mesh && corners.iter().all(|v| mesh.is_on_surface(*v));
            let is_outside = |face: usize| mesh.label_behind(t, face).is_none_or(Label::is_background);
            (may_be && is_outside(face)).then_some(corners)
        })
    };
    context.until_cancelled(0..mesh.tets.len() as u32).flat_map_iter(of_tet).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use crate::image::label_image::LabelImage;
    use crate::index::VertexId;
    use crate::lattice::boundary_targets::SourcePoints;
    use crate::lattice::candidate_mesh::CandidateMesh;
    use crate::lattice::subvoxel_surface::SubvoxelSurface;
    use glam::{DMat3, DVec3};

    /// Crossings of two tets whose tips point at each other along x and overlap by `overlap`; their other faces lie at `bases`.
    fn crossings_of_tips(overlap: f64, bases: [f64; 2]) -> usize {
        let grid = Grid::new([2; 3], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let image = LabelImage::new(grid, vec![Label(1); 8], vec![0, 1]).unwrap();
        let tet = |x: f64, tip: f64| {
            [DVec3::new(tip, 0.1, 0.2), DVec3::new(x, -0.4, -0.4), DVec3::new(x, 1.4, -0.4), DVec3::new(x, 0.2, 1.4)]
        };
        let middle = bases[0].midpoint(bases[1]);
        let mut mesh = CandidateMesh {
            points: [tet(bases[0], middle + overlap / 2.0), tet(bases[1], middle - overlap / 2.0)].concat(),
            tets: vec![[0, 2, 1, 3].map(VertexId), [4, 5, 6, 7].map(VertexId)],
            tet_labels: vec![Label(1); 2],
            ..CandidateMesh::default()
        };
        let context = RunContext::with_threads(1).unwrap();
        let surface = SubvoxelSurface::new(&image, &context).unwrap();
        let alone = [[u32::MAX; 4]; 2];
        let sources =
            SourcePoints::new(&mesh.points, &mesh.tets, &mesh.tet_labels, &alone, &surface, &[], &context).unwrap();
        let mesh = ImprovementMesh::new(&mut mesh, &sources, surface);
        let count = count_crossings(&mesh, &context).unwrap();
        let in_border = |t: u32| {
            let tet = mesh.tets[t as usize];
            (0..4).filter(|at| is_in_border(&mesh, TET_FACES[*at].map(|v| tet[v]), tet[*at])).count()
        };
        assert_eq!([in_border(0), in_border(1)], [usize::from(bases[0] == -0.5); 2]);
        context.cancel_token().cancel();
        assert!(matches!(count_crossings(&mesh, &context), Err(crate::Error::Cancelled)));
        count
    }

    #[test]
    fn tips_that_overlap_cross_and_others_do_not() {
        // The image reaches from -0.5 to 1.5: in the second case the faces across from the tips lie in its border planes.
        for bases in [[-4.0, 4.0], [-0.5, 1.5]] {
            assert_eq!(crossings_of_tips(-0.5, bases), 0);
            assert!(crossings_of_tips(0.6, bases) > 0);
        }
    }
}
