//! Counts where the surface of the mesh runs through itself: the last look at what the scaffold promises.
//!
//! # Method
//! Positive tets that share their inner faces can overlap only where the outside of the mesh crosses itself. The crossing
//! pairs of outer faces are found through a tree of boxes and the exact triangle test.
//!
//! # Source
//! The crossing test is that of `geometry::intersection`.
//!
//! # Cost
//! One pass over the tets and one tree of the outer faces.

use rayon::prelude::*;

use crate::geometry::aabb_tree::AabbTree;
use crate::geometry::bounding_box::BoundingBox;
use crate::geometry::intersection::{Meeting, triangle_pair};
use crate::lattice::element_score::Part;
use crate::lattice::improvement_mesh::ImprovementMesh;
use crate::mesh::numbering::TET_FACES;

/// Pairs of outer faces that meet beyond what they share.
pub fn count_crossings(mesh: &ImprovementMesh) -> usize {
    let faces = outer_faces(mesh);
    let at = |v: u32| mesh.points[v as usize];
    let box_of = |f: &[u32; 3]| BoundingBox::of_points(f.map(at));
    let tree = AabbTree::new(faces.par_iter().map(box_of).collect());
    let of_face = |first: usize| {
        let mut count = 0;
        tree.overlapping(box_of(&faces[first]), |second| {
            count += usize::from(second > first && triangle_pair(faces[first], faces[second], at) != Meeting::Proper);
        });
        count
    };
    (0..faces.len()).into_par_iter().with_min_len(256).map(of_face).sum()
}

/// Faces of one tet only, seen from outside counter-clockwise.
fn outer_faces(mesh: &ImprovementMesh) -> Vec<[u32; 3]> {
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
    (0..mesh.tets.len() as u32).into_par_iter().flat_map_iter(of_tet).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;
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
        let surface = SubvoxelSurface::new(&image, &RunContext::with_threads(1).unwrap()).unwrap();
        let alone = [[u32::MAX; 4]; 2];
        let sources = SourcePoints::new(&mesh.points, &mesh.tets, &mesh.tet_labels, &alone, &surface, &[]);
        count_crossings(&ImprovementMesh::new(&mut mesh, &sources, surface))
    }

    #[test]
    fn tips_that_overlap_cross_and_others_do_not() {
        assert_eq!(crossings_of_tips(-0.5), 0);
        assert!(crossings_of_tips(0.6) > 0);
    }
}
