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
//! One distance per surface vertex, in parallel; some tens per vertex that is off.

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::index::Label;
use crate::lattice::element_score::Threshold;
use crate::lattice::improvement_mesh::{ImprovementMesh, SurfaceFace, neighbors_in};
use crate::lattice::local_transformations::{contraction_is_good, may_contract, merge_into};
use crate::lattice::planned_batches::{PlannedChange, Touched, change_in_order};
use crate::lattice::subvoxel_surface::Side;
use crate::lattice::surface_cuts::worst_cut;

/// Merges surface vertices that are off their surface by more than `tolerance`, mm, into neighbours; returns how many.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn merge_spikes(mesh: &mut ImprovementMesh, tolerance: f64, wanted: f64, context: &RunContext) -> Result<usize> {
    context.check()?;
    let far = |v: u32| distance_off(mesh, v).filter(|off| *off > tolerance).map(|off| (off, v));
    let vertices = (0..mesh.points.len() as u32).into_par_iter().with_min_len(1024);
    let mut off: Vec<(f64, u32)> = context.until_cancelled(vertices).filter_map(far).collect();
    context.check()?;
    off.sort_unstable_by(|l, r| r.0.total_cmp(&l.0).then(l.1.cmp(&r.1)));
    let spikes: Vec<u32> = off.into_iter().map(|(_, v)| v).collect();
    let mut merging = Merging { wanted, merged: 0 };
    change_in_order(mesh, &spikes, &mut merging, context)?;
    Ok(merging.merged)
}

/// The labels that a vertex of the mesh lies between, where there are two and no border.
fn labels_around(mesh: &ImprovementMesh, v: u32) -> Option<[Label; 2]> {
    match *mesh.sides(v) {
        [Side::Label(a), Side::Label(b)] if !mesh.ball(v).is_empty() => Some([a, b]),
        _ => None,
    }
}

/// How far off its surface a vertex between two labels is, mm.
fn distance_off(mesh: &ImprovementMesh, v: u32) -> Option<f64> {
    let [a, b] = labels_around(mesh, v)?;
    mesh.surface.depth(mesh.points[v as usize], a, b).map(f64::abs)
}

/// The contractions of one sweep.
struct Merging {
    wanted: f64,
    merged: usize,
}

impl PlannedChange for Merging {
    type Item = u32;
    type Plan = Option<u32>;

    fn vertices_of(&self, mesh: &ImprovementMesh, v: &u32) -> impl Iterator<Item = u32> {
        std::iter::once(*v).chain(neighbors_in(&mesh.surface_faces(*v)))
    }

    fn plan(&self, mesh: &ImprovementMesh, v: &u32) -> Option<u32> {
        nearest_merge(mesh, *v, self.wanted)
    }

    fn change(&mut self, mesh: &mut ImprovementMesh, v: &u32, plan: Option<Option<u32>>, touched: &mut Touched) {
        if let Some(to) = plan.unwrap_or_else(|| nearest_merge(mesh, *v, self.wanted)) {
            touched.mark(mesh, *v);
            merge_into(mesh, *v, to);
            self.merged += 1;
        }
    }
}

/// The neighbour that a vertex is to be merged into: of those that bring the surface nearer and leave good tets, the nearest.
fn nearest_merge(mesh: &ImprovementMesh, v: u32, wanted: f64) -> Option<u32> {
    let labels = labels_around(mesh, v)?;
    let faces = mesh.surface_faces(v);
    let at = |corner: u32| move |face: &SurfaceFace| ([corner, face.others[0], face.others[1]], labels);
    let before = worst_cut(mesh, faces.iter().map(at(v))).max(distance_off(mesh, v)?);
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
    fn a_vertex_off_its_surface_goes_and_one_on_it_stays() {
        let left = |off: f64, wanted: f64, threads: usize| {
            with_vertex_on_ball([off, 2.0], |mut mesh| {
                let context = RunContext::with_threads(threads).unwrap();
                let merged = merge_spikes(&mut mesh, 0.1, wanted, &context).unwrap();
                let live: Vec<u32> = (0..mesh.tets.len() as u32).filter(|t| mesh.is_live(*t)).collect();
                assert!(live.iter().all(|t| (mesh.tets[*t as usize].contains(&0)) == (merged == 0)));
                (merged, live.len())
            })
        };
        for threads in [1, 3] {
            assert_eq!(left(0.6, 10.0, threads), (1, 2));
            assert_eq!(left(-0.6, 10.0, threads), (1, 2));
            assert_eq!(left(0.0, 10.0, threads), (0, 6));
        }
        let cancelled = with_vertex_on_ball([0.6, 2.0], |mut mesh| {
            let context = RunContext::with_threads(1).unwrap();
            context.cancel_token().cancel();
            merge_spikes(&mut mesh, 0.1, 10.0, &context)
        });
        assert!(matches!(cancelled, Err(crate::Error::Cancelled)));
    }
}
