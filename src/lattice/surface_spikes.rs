//! Surface vertices that stand off their surface are merged into a neighbour where that brings the surface nearer.
//!
//! # Method
//! A vertex stays off its surface where a flat tet stands in its way, of the mesh or of the scaffold: a dent or a spike in a surface
//! that is smooth around it. The vertices between two labels that are off by more than a tolerance are gone through, the farthest
//! first. Each is merged into the neighbour on its surface after which the faces cut off least, where that is less than the vertex and
//! its faces do, when the changed tets score as high as the wanted score or as the tets before, whichever is less, and the surface
//! allows it ([`contraction_is_good`]).
//! ```text
//!        v                                v off the surface, a b c on it
//!      / | \                              three triangles that bend become one that does not
//!     a--b--c     ->     a-----c
//!                         \ b /
//! ```
//!
//! # Source
//! [KobbeltCampagnaSeidel1998]: edges of a surface are contracted to one of their ends, the one that keeps the surface nearest.
//!
//! # Differences
//! Only vertices that are off go; the distance is that to the image's surface.
//!
//! # Invariants
//! The mesh conforms; no score falls below the wanted one that was not below before. No face that takes the place of others is farther
//! off its surface than the farthest of these, with the vertex that went.
//!
//! # Cost
//! One distance per surface vertex, in parallel; some tens per vertex that is off, one after another: these are few.

use crate::context::RunContext;
use crate::error::Result;
use crate::lattice::element_score::Threshold;
use crate::lattice::improvement_mesh::{ImprovementMesh, SurfaceFace, neighbors_in, numbers_where};
use crate::lattice::local_transformations::{contraction_is_good, may_contract, merge_into};
use crate::lattice::surface_cuts::{distance_off, labels_around, worst_cut};

/// Vertices between two looks at whether the run is cancelled.
const SPIKES_PER_CHECK: usize = 256;

/// Merges surface vertices that are off their surface by more than `tolerance`, mm, into neighbours; returns how many.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn merge_spikes(mesh: &mut ImprovementMesh, tolerance: f64, wanted: f64, context: &RunContext) -> Result<usize> {
    let is_far = |v: u32| distance_off(mesh, v).is_some_and(|off| off > tolerance);
    let far = numbers_where(mesh.points.len(), &is_far, context)?;
    let mut spikes: Vec<(f64, u32)> = far.into_iter().filter_map(|v| Some((distance_off(mesh, v)?, v))).collect();
    spikes.sort_unstable_by(|l, r| r.0.total_cmp(&l.0).then(l.1.cmp(&r.1)));
    let mut merged = 0;
    for (at, (off, v)) in spikes.into_iter().enumerate() {
        context.check_every(SPIKES_PER_CHECK, at)?;
        if let Some(to) = nearest_merge(mesh, v, off, wanted) {
            merge_into(mesh, v, to);
            merged += 1;
        }
    }
    Ok(merged)
}

/// The neighbour that a vertex `off` its surface is to be merged into: of those that bring the surface nearer and leave good tets, the
/// nearest.
fn nearest_merge(mesh: &ImprovementMesh, v: u32, off: f64, wanted: f64) -> Option<u32> {
    let labels = labels_around(mesh, v)?;
    let faces = mesh.surface_faces(v);
    let at = |corner: u32| move |face: &SurfaceFace| ([corner, face.others[0], face.others[1]], labels);
    let before = worst_cut(mesh, faces.iter().map(at(v))).max(off);
    let after = |to: u32| worst_cut(mesh, faces.iter().filter(|face| !face.others.contains(&to)).map(at(to)));
    let neighbors = neighbors_in(&faces).into_iter().filter(|to| may_contract(mesh, v, *to));
    let mut nearer: Vec<(f64, u32)> = neighbors.map(|to| (after(to), to)).filter(|(cut, _)| *cut < before).collect();
    nearer.sort_unstable_by(|l, r| l.0.total_cmp(&r.0).then(l.1.cmp(&r.1)));
    let needed = Threshold::of(mesh.lowest(mesh.ball(v)).min(wanted));
    nearer.into_iter().map(|(_, to)| to).find(|to| contraction_is_good(mesh, v, *to, &needed))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::test_meshes::with_vertex_on_ball;

    #[test]
    fn a_vertex_off_its_surface_goes_unless_a_tet_pays_for_it() {
        let left = |[off, depth]: [f64; 2], wanted: f64| {
            with_vertex_on_ball([off, depth], |mut mesh| {
                // The others lie on the outside of the mesh, which is no surface of the image.
                mesh.fixed[1..].fill(true);
                let context = RunContext::with_threads(1).unwrap();
                let merged = merge_spikes(&mut mesh, 0.1, wanted, &context).unwrap();
                let live: Vec<u32> = (0..mesh.tets.len() as u32).filter(|t| mesh.is_live(*t)).collect();
                assert!(live.iter().all(|t| (mesh.tets[*t as usize].contains(&0)) == (merged == 0)));
                (merged, live.len())
            })
        };
        assert_eq!(left([0.6, 2.0], 10.0), (1, 2));
        assert_eq!(left([-0.6, 2.0], 10.0), (1, 2));
        assert_eq!(left([0.0, 2.0], 10.0), (0, 6));
        // The tet that would be left inside is flatter than those that are there.
        assert_eq!(left([0.6, 0.4], 30.0), (0, 6));
        assert_eq!(left([0.6, 0.4], 5.0), (1, 2));
        let cancelled = with_vertex_on_ball([0.6, 2.0], |mut mesh| {
            let context = RunContext::with_threads(1).unwrap();
            context.cancel_token().cancel();
            merge_spikes(&mut mesh, 0.1, 10.0, &context)
        });
        assert!(matches!(cancelled, Err(crate::Error::Cancelled)));
    }
}
