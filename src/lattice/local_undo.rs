//! Smoothing is taken back, in part or wholly, around tets that nothing could make good enough.
//!
//! # Method
//! The lattice has dihedral angles of 30 to 120 degrees, so around a bad tet a good mesh is known: the one before smoothing.
//! 1. The vertices of the bad tets, and rings of neighbours around them, go back along the way they came: the innermost by
//!    the largest part, the outermost by the least. Replacements of tets that touch them are taken back first, with those
//!    that built on them.
//! 2. While tets are bad, the next step goes back farther and over more rings.
//! 3. After each step what went back is made better by the means of the improvement, which often needs no more steps. Where
//!    the last step leaves bad tets, the best state that was met is taken.
//!
//! # Source
//! [Drakopoulos2017] 2.3.5 takes the whole mesh back; here it is the place that is bad.
//!
//! # Invariants
//! A vertex on the image border stays in its plane, and a fixed vertex where it is.
//!
//! # Cost
//! One pass over all tets; the rest by the number of bad tets.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;

use crate::error::Result;
use crate::lattice::improvement_mesh::ImprovementMesh;
use crate::lattice::subvoxel_surface::Side;

/// Rings around bad tets, and the part of its way that a vertex of a bad tet keeps, step by step.
const STEPS: [(usize, f64); 10] =
    [(0, 0.5), (1, 0.5), (1, 0.25), (2, 0.25), (1, 0.0), (2, 0.0), (3, 0.0), (4, 0.0), (3, 0.0), (4, 0.0)];

/// Takes smoothing back around the tets `low`; `lattice` holds where the first vertices stood before it. After each step `mend`
/// makes the mesh better at some vertices and returns the tets that are low still. Returns how many vertices went back.
///
/// # Errors
/// Those of `mend`.
pub fn undo_around_low_tets(
    mesh: &mut ImprovementMesh,
    lattice: &[DVec3],
    mut low: Vec<u32>,
    mut mend: impl FnMut(&mut ImprovementMesh, &BTreeSet<u32>) -> Result<Vec<u32>>,
) -> Result<usize> {
    let mut returned: BTreeSet<u32> = BTreeSet::new();
    if low.is_empty() {
        return Ok(0);
    }
    let lowest = |mesh: &ImprovementMesh, low: &[u32]| (mesh.lowest(low), std::cmp::Reverse(low.len()));
    let mut best = (lowest(mesh, &low), mesh.snapshot());
    for (rings, kept) in STEPS {
        if low.is_empty() {
            break;
        }
        for (v, ring) in rings_around(mesh, &low, rings) {
            let part = kept + (1.0 - kept) * ring as f64 / (rings + 1) as f64;
            go_back(mesh, lattice, v, part, &mut returned);
        }
        low = mend(mesh, &returned)?;
        let reached = lowest(mesh, &low);
        if !low.is_empty() && reached > best.0 {
            best = (reached, mesh.snapshot());
        }
    }
    if !low.is_empty() {
        mesh.restore(best.1);
    }
    Ok(returned.len())
}

/// The vertices within so many rings of the vertices of tets, with their ring, in order.
fn rings_around(mesh: &ImprovementMesh, tets: &[u32], rings: usize) -> BTreeMap<u32, usize> {
    let mut found: BTreeMap<u32, usize> = BTreeMap::new();
    let mut front: Vec<u32> = tets.iter().flat_map(|t| mesh.tets[*t as usize]).collect();
    for ring in 0..=rings {
        front.sort_unstable();
        front.dedup();
        front.retain(|v| !found.contains_key(v));
        found.extend(front.iter().map(|v| (*v, ring)));
        front = front.iter().flat_map(|v| mesh.ball(*v)).flat_map(|t| mesh.tets[*t as usize]).collect();
    }
    found
}

/// A vertex goes back by the rest of its way; all its tets become those of the lattice.
fn go_back(mesh: &mut ImprovementMesh, lattice: &[DVec3], v: u32, kept: f64, returned: &mut BTreeSet<u32>) {
    let mut work = vec![v];
    while let Some(v) = work.pop() {
        while let Some(change) = mesh.ball(v).iter().find_map(|t| mesh.change_of(*t)) {
            // A vertex that had been merged into another one is back, at the place of that time.
            work.extend(mesh.undo(change));
        }
        // Vertices that splits added are gone with their tets.
        if (v as usize) < lattice.len() && !mesh.fixed[v as usize] {
            returned.insert(v);
            set_place(mesh, v, lattice[v as usize].lerp(mesh.points[v as usize], kept));
        }
    }
}

fn set_place(mesh: &mut ImprovementMesh, v: u32, mut place: DVec3) {
    for side in mesh.sides(v) {
        if let Side::Border(plane) = side {
            let (axis, at) = mesh.surface.border(*plane);
            place[axis] = at;
        }
    }
    mesh.points[v as usize] = place;
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
    use glam::DMat3;

    #[test]
    fn replacements_and_moves_around_a_bad_tet_are_taken_back() {
        let grid = Grid::new([2; 3], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let image = LabelImage::new(grid, vec![Label(1); 8], vec![0, 1]).unwrap();
        let lattice = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z, DVec3::splat(1.0)];
        let tets = vec![[0, 1, 2, 3].map(VertexId), [1, 2, 3, 4].map(VertexId)];
        let mut mesh = CandidateMesh {
            points: lattice.clone(),
            tets: tets.clone(),
            tet_labels: vec![Label(1); 2],
            ..CandidateMesh::default()
        };
        let surface = SubvoxelSurface::new(&image, &RunContext::with_threads(1).unwrap()).unwrap();
        let mut work = ImprovementMesh::new(&mut mesh, &SourcePoints::default(), surface);
        // Two tets become three around the line 0 4, two of which then change once more.
        let rows = [[1, 2, 0, 4], [2, 3, 0, 4], [3, 1, 0, 4]].map(|tet| (tet, Label(1)));
        let slots = work.replace(&[0, 1], &rows);
        work.replace(&slots[..2], &[([3, 2, 0, 4], Label(1))]);
        work.points[4] = DVec3::splat(-3.0);
        let back = undo_around_low_tets(&mut work, &lattice, vec![slots[2]], |_, _| Ok(Vec::new())).unwrap();
        assert_eq!(back, 4);
        // The first step goes back half of the way.
        assert_eq!(work.points[4], DVec3::splat(-1.0));
        let mut found: Vec<[u32; 4]> = work.tets.iter().copied().filter(|t| t[0] != u32::MAX).collect();
        found.sort_unstable();
        assert_eq!(found, tets.iter().map(|t| t.map(|v| v.0)).collect::<Vec<_>>());
        assert!((0..work.tets.len() as u32).all(|t| !work.is_live(t) || work.change_of(t).is_none()));
    }
}
