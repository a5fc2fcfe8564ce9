//! Keeps the mesh from running through itself where the gap between two parts of its surface is thin.
//!
//! # Method
//! 1. Positive tets that share their inner faces can overlap only where the outside of the mesh crosses itself: two
//!    sheets moved through a background gap that is thinner than the smoothing. The crossing pairs of outer faces are
//!    found through a tree of boxes and the exact triangle test.
//! 2. Each vertex of a crossing face goes back into the mesh, against the normal of its outer faces, by a part of a
//!    voxel, as far as the tets around it stay well shaped; rounds follow until nothing crosses.
//!
//! # Invariants
//! Fixed vertices stay; no tet becomes flat or inverted. What still crosses is counted, for a finding.
//!
//! # Source
//! Ours; the crossing test is that of `geometry::intersection`.
//!
//! # Cost
//! One pass over the tets and one tree of the outer faces; rounds only where something crosses.

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::aabb_tree::AabbTree;
use crate::geometry::bounding_box::BoundingBox;
use crate::geometry::intersection::{Meeting, triangle_pair};
use crate::geometry::triangle::scaled_normal;
use crate::lattice::element_score::Part;
use crate::lattice::improvement_mesh::ImprovementMesh;
use crate::mesh::numbering::TET_FACES;

/// Rounds of moving back: with `STEP` enough for sheets that overlap by a voxel and a half.
const ROUNDS: usize = 16;

/// Way of one round, in smallest voxel spacings.
const STEP: f64 = 0.1;

/// Parts of the way that are tried, largest first.
const PARTS: [f64; 3] = [1.0, 0.5, 0.25];

/// Score that tets keep, in the first half of the rounds.
const KEPT_SCORE: f64 = 12.0;

/// Moves crossing sheets apart and returns how many pairs of outer faces still cross. In the second half of the rounds
/// tets may fall to `lowest`: while passes follow that raise them again this may be little.
///
/// # Errors
/// [`crate::Error::Cancelled`].
pub fn remove_overlaps(mesh: &mut ImprovementMesh, spacing: f64, lowest: f64, context: &RunContext) -> Result<usize> {
    let faces = outer_faces(mesh);
    let boxes = boxes_of(mesh, &faces, 0.0);
    let all: Vec<u32> = (0..faces.len() as u32).collect();
    let mut crossing = crossing_pairs(mesh, &faces, &all, &AabbTree::new(boxes));
    if crossing.is_empty() {
        return Ok(0);
    }
    // Wide enough for all rounds, so that one tree serves them; only faces of moved vertices are asked again.
    let tree = AabbTree::new(boxes_of(mesh, &faces, ROUNDS as f64 * STEP * spacing));
    let mut moved = FxHashSet::default();
    for round in 0..ROUNDS {
        context.check()?;
        let kept = if 2 * round < ROUNDS { KEPT_SCORE } else { lowest };
        for (vertex, normal) in outward_normals(&faces, &crossing, mesh) {
            move_back(mesh, vertex, -normal * (STEP * spacing), kept);
            moved.insert(vertex);
        }
        let has_moved = |f: &u32| faces[*f as usize].iter().any(|v| moved.contains(v));
        let asked: Vec<u32> = all.iter().copied().filter(has_moved).collect();
        crossing = crossing_pairs(mesh, &faces, &asked, &tree);
        if crossing.is_empty() {
            break;
        }
    }
    Ok(crossing.len())
}

/// The box of each face, wider by `margin` on all sides.
fn boxes_of(mesh: &ImprovementMesh, faces: &[[u32; 3]], margin: f64) -> Vec<BoundingBox> {
    let wide = |p: DVec3| [p - margin, p + margin];
    let of_face = |f: &[u32; 3]| BoundingBox::of_points(f.iter().flat_map(|v| wide(mesh.points[*v as usize])));
    faces.par_iter().map(of_face).collect()
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

/// Pairs of an asked face and any face that meet beyond what they share; the smaller number first, in order.
fn crossing_pairs(mesh: &ImprovementMesh, faces: &[[u32; 3]], asked: &[u32], tree: &AabbTree) -> Vec<[u32; 2]> {
    let at = |v: u32| mesh.points[v as usize];
    let of_face = |first: &u32| {
        let corners = faces[*first as usize];
        let mut found = Vec::new();
        tree.overlapping(BoundingBox::of_points(corners.map(at)), |second| {
            if second != *first as usize && triangle_pair(corners, faces[second], at) != Meeting::Proper {
                let other = second as u32;
                found.push([other.min(*first), other.max(*first)]);
            }
        });
        found
    };
    let mut pairs: Vec<[u32; 2]> = asked.par_iter().flat_map_iter(of_face).collect();
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

/// The vertices of crossing faces with the unit normal of all their outer faces, in order.
fn outward_normals(faces: &[[u32; 3]], crossing: &[[u32; 2]], mesh: &ImprovementMesh) -> Vec<(u32, DVec3)> {
    let mut vertices: Vec<u32> = crossing.iter().flatten().flat_map(|f| faces[*f as usize]).collect();
    vertices.sort_unstable();
    vertices.dedup();
    let mut normals = vec![DVec3::ZERO; vertices.len()];
    for face in faces {
        for vertex in face {
            if let Ok(at) = vertices.binary_search(vertex) {
                let [a, b, c] = face.map(|v| mesh.points[v as usize]);
                normals[at] += scaled_normal(a, b, c);
            }
        }
    }
    vertices.into_iter().zip(normals.into_iter().map(DVec3::normalize_or_zero)).collect()
}

/// Moves a vertex by the largest part of the way that keeps its tets.
fn move_back(mesh: &mut ImprovementMesh, vertex: u32, way: DVec3, kept: f64) {
    if mesh.fixed[vertex as usize] {
        return;
    }
    let ball = mesh.ball(vertex).to_vec();
    let before = mesh.points[vertex as usize];
    let bound = mesh.lowest(&ball).min(kept);
    for part in PARTS {
        mesh.points[vertex as usize] = before + part * way;
        if mesh.lowest(&ball) >= bound {
            return;
        }
    }
    mesh.points[vertex as usize] = before;
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
    use glam::DMat3;

    /// Two wedges of tets whose tips point at each other along x and overlap by `overlap`.
    fn tips(overlap: f64) -> CandidateMesh {
        let tet = |x: f64, tip: f64| {
            [DVec3::new(tip, 0.1, 0.2), DVec3::new(x, -2.0, -2.0), DVec3::new(x, 2.5, -2.0), DVec3::new(x, 0.0, 2.5)]
        };
        let (left, right) = (tet(-4.0, overlap / 2.0), tet(4.0, -overlap / 2.0));
        CandidateMesh {
            points: [left, [right[0], right[2], right[1], right[3]]].concat(),
            tets: vec![[0, 2, 1, 3].map(VertexId), [4, 6, 5, 7].map(VertexId)],
            tet_labels: vec![Label(1); 2],
            ..CandidateMesh::default()
        }
    }

    fn crossings_after(overlap: f64) -> (usize, usize) {
        let grid = Grid::new([2; 3], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let image = LabelImage::new(grid, vec![Label(1); 8], vec![0, 1]).unwrap();
        let mut mesh = tips(overlap);
        let surface = SubvoxelSurface::new(&image);
        let alone = [[u32::MAX; 4]; 2];
        let sources = SourcePoints::new(&mesh.points, &mesh.tets, &mesh.tet_labels, &alone, &surface);
        let mut work = ImprovementMesh::new(&mut mesh, &sources, surface);
        assert!((0..2).all(|t| work.score(t) > 0.0), "the test's own tets are positive");
        let faces = outer_faces(&work);
        let tree = AabbTree::new(boxes_of(&work, &faces, 0.0));
        let before = crossing_pairs(&work, &faces, &[0, 1, 2, 3, 4, 5, 6, 7], &tree).len();
        let left = remove_overlaps(&mut work, 1.0, 4.0, &RunContext::with_threads(1).unwrap()).unwrap();
        assert!((0..2).all(|t| work.score(t) > 0.0));
        (before, left)
    }

    #[test]
    fn tips_that_cross_are_moved_apart_and_others_stay() {
        assert_eq!(crossings_after(-0.5), (0, 0));
        let (before, left) = crossings_after(0.6);
        assert!(before > 0);
        assert_eq!(left, 0);
    }
}
