//! Counts where the surface of the mesh runs through itself: the last look at what the scaffold promises.
//!
//! # Method
//! 1. The mesh and its scaffold together: where all tets are positive and the outermost faces that could move cross none,
//!    a point is in one tet at most, so that nothing can cross. Faces among vertices that never moved are those of the
//!    lattice. This settles almost every mesh; what could move there lies on the image border.
//! 2. Otherwise, positive tets that share their inner faces can overlap only where the outside of the mesh crosses itself.
//!    The crossing pairs of outer faces are found through a tree of boxes and the exact triangle test.
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
    crossings_among(mesh, &outer_faces(mesh, context), context, |_| true)
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
        faces.filter(move |(at, face)| may_be_open(face) && mesh.neighbor(t, *at).is_none()).map(|(_, face)| face)
    };
    // Most tets have no such face: three of the vertices would be there.
    let may_have_one = |t: &u32| {
        let is_there = |v: &&u32| mesh.is_at_outside(**v) || mesh.is_still(**v);
        mesh.tets[*t as usize].iter().filter(is_there).count() >= 3
    };
    let mut faces: Vec<[u32; 3]> = tets().filter(may_have_one).flat_map_iter(moving).collect();
    let count = faces.len();
    if count > 0 {
        let is_scaffold = |t: &u32| mesh.part(*t) == Part::Scaffold;
        let still = |t: u32| faces_of(t).into_iter().filter(|face| face.iter().all(|v| mesh.is_still(*v)));
        faces.par_extend(tets().filter(is_scaffold).flat_map_iter(still));
    }
    context.check()?;
    Ok(crossings_among(mesh, &faces, context, |face| face < count)? == 0)
}

/// Pairs of faces that meet beyond what they share, the first of which is asked for.
fn crossings_among(
    mesh: &ImprovementMesh,
    faces: &[[u32; 3]],
    context: &RunContext,
    is_asked: impl Fn(usize) -> bool + Sync,
) -> Result<usize> {
    let at = |v: u32| mesh.points[v as usize];
    let box_of = |f: &[u32; 3]| BoundingBox::of_points(f.map(at));
    let tree = AabbTree::new(faces.par_iter().map(box_of).collect(), context)?;
    let of_face = |first: usize| {
        let mut count = 0;
        tree.overlapping(box_of(&faces[first]), |second| {
            count += usize::from(second > first && triangle_pair(faces[first], faces[second], at) != Meeting::Proper);
        });
        count
    };
    let asked = (0..faces.len()).into_par_iter().with_min_len(256).filter(|face| is_asked(*face));
    let count = context.until_cancelled(asked).map(of_face).sum();
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
            let is_outside = |n: Option<u32>| n.is_none_or(|n| mesh.part(n) == Part::Scaffold);
            (may_be && is_outside(mesh.neighbor(t, face))).then_some(corners)
        })
    };
    context.until_cancelled(0..mesh.tets.len() as u32).flat_map_iter(of_tet).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use crate::image::label_image::LabelImage;
    use crate::index::{Label, VertexId};
    use crate::lattice::boundary_targets::SourcePoints;
    use crate::lattice::candidate_mesh::CandidateMesh;
    use crate::lattice::subvoxel_surface::SubvoxelSurface;
    use glam::{DMat3, DVec3};

    /// Crossings of two tets whose tips point at each other along x and overlap by `overlap`.
    fn crossings_of_tips(overlap: f64) -> usize {
        let grid = Grid::new([2; 3], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let image = LabelImage::new(grid, vec![Label(1); 8], vec![0, 1]).unwrap();
        let tet = |x: f64, tip: f64| {
            [DVec3::new(tip, 0.1, 0.2), DVec3::new(x, -2.0, -2.0), DVec3::new(x, 2.5, -2.0), DVec3::new(x, 0.0, 2.5)]
        };
        let mut mesh = CandidateMesh {
            points: [tet(-4.0, overlap / 2.0), tet(4.0, -overlap / 2.0)].concat(),
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
        context.cancel_token().cancel();
        assert!(matches!(count_crossings(&mesh, &context), Err(crate::Error::Cancelled)));
        count
    }

    #[test]
    fn tips_that_overlap_cross_and_others_do_not() {
        assert_eq!(crossings_of_tips(-0.5), 0);
        assert!(crossings_of_tips(0.6) > 0);
    }
}
