//! Whether an operation leaves edges as long as the sizes of their ends ask for.
//!
//! # Method
//! 1. An edge is in range when its length over the average size of its ends lies between two bounds. With the default factor
//!    of the sizes (`cdf`) the longest is twice the length of the boundary's edges.
//! 2. An operation keeps the lengths when the edges out of range grow by no more than a tenth of the number by which all edges
//!    grow: so operations that take vertices away, and good edges with them, have to take bad ones as well.
//! 3. An operation betters the lengths when it makes more edges than it takes, and no more out of range.
//!
//! # Source
//! [Drakopoulos2017] 4.7.1 (distribution function).
//!
//! # Invariants
//! Edges of the boundary count nowhere: no operation changes them.
//!
//! # Cost
//! A sort of some ten to hundred edges for a plan that would be carried out.

use super::flips::Plan;
use super::spacing::Spacing;
use crate::index::VertexId;
use crate::mesh::numbering::TET_EDGES;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;

/// The share of new edges that may be out of range: that of the whole mesh where sizes are kept.
const TOLERATED: f64 = 0.1;

/// Less than one edge: what takes away a single good edge, as a flip 3-2 does, keeps the lengths.
const SLACK: f64 = 0.5;

/// Buffers of one thread.
#[derive(Debug, Clone, Default)]
pub struct LengthScratch {
    before: Vec<[VertexId; 2]>,
    after: Vec<[VertexId; 2]>,
}

fn collect_edges(rows: impl Iterator<Item = [VertexId; 4]>, edges: &mut Vec<[VertexId; 2]>) {
    edges.clear();
    edges.extend(rows.flat_map(|row| TET_EDGES.map(|[i, j]| [row[i].min(row[j]), row[i].max(row[j])])));
    edges.sort_unstable();
    edges.dedup();
}

/// Whether a plan keeps the lengths. The points of its vertices are set; a new one has `size`.
pub fn keeps_lengths<S: TetStore + ?Sized>(
    store: &S,
    spacing: Spacing<'_>,
    fresh: Option<(VertexId, f64)>,
    plan: &Plan,
    scratch: &mut LengthScratch,
) -> bool {
    let ([gone, made], [bad_gone, bad_made]) = count_edges(store, spacing, fresh, plan, scratch);
    bad_made - bad_gone <= TOLERATED * (made - gone) + SLACK
}

/// Whether a plan makes more edges and no more of them out of range. As [`keeps_lengths`].
pub fn betters_lengths<S: TetStore + ?Sized>(
    store: &S,
    spacing: Spacing<'_>,
    fresh: Option<(VertexId, f64)>,
    plan: &Plan,
    scratch: &mut LengthScratch,
) -> bool {
    let ([gone, made], [bad_gone, bad_made]) = count_edges(store, spacing, fresh, plan, scratch);
    made > gone && bad_made <= bad_gone
}

/// The share of the edges of a mesh that are out of range, each counted with every tet around it; edges of the boundary and
/// those without sizes are left out.
pub fn share_out_of_range(complex: &TetComplex, spacing: Spacing<'_>) -> f64 {
    let mut counts = [0usize; 2];
    for tet in complex.finite_tets() {
        let row = complex.vertices(tet);
        for [i, j] in TET_EDGES {
            let size = 0.5 * (spacing.size_of(row[i]) + spacing.size_of(row[j]));
            if size > 0.0 && !complex.is_edge_constrained(tet, i, j) {
                let length = complex.point(row[i]).distance(complex.point(row[j]));
                let is_in_range = (spacing.factor * size..=spacing.longest * size).contains(&length);
                counts[usize::from(is_in_range)] += 1;
            }
        }
    }
    counts[0] as f64 / (counts[0] + counts[1]).max(1) as f64
}

/// How many edges a plan takes away and makes, and how many of these are out of range.
fn count_edges<S: TetStore + ?Sized>(
    store: &S,
    spacing: Spacing<'_>,
    fresh: Option<(VertexId, f64)>,
    plan: &Plan,
    scratch: &mut LengthScratch,
) -> ([f64; 2], [f64; 2]) {
    let LengthScratch { before, after } = scratch;
    collect_edges(plan.old.iter().map(|&tet| store.vertices(tet)), before);
    collect_edges(plan.new.iter().copied(), after);
    let size_of = |v: VertexId| match fresh {
        Some((fresh, size)) if v == fresh => size,
        _ => spacing.size_of(v),
    };
    let is_in_range = |[a, b]: [VertexId; 2]| {
        let size = 0.5 * (size_of(a) + size_of(b));
        let length = store.point(a).distance(store.point(b));
        size == 0.0 || (spacing.factor * size..=spacing.longest * size).contains(&length)
    };
    // Those of one list that the other has not: how many, and how many of them are out of range.
    let count = |edges: &[[VertexId; 2]], others: &[[VertexId; 2]]| {
        let alone = edges.iter().filter(|edge| others.binary_search(edge).is_err());
        alone.fold((0.0_f64, 0.0_f64), |(all, bad), &edge| (all + 1.0, bad + f64::from(u8::from(!is_in_range(edge)))))
    };
    let ((gone, bad_gone), (made, bad_made)) = (count(before, after), count(after, before));
    ([gone, made], [bad_gone, bad_made])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::flip_criteria::AnyPositive;
    use crate::conforming::flips::{Accept, FlipScratch, Outcome, plan_edge_removal};
    use crate::conforming::test_meshes::random_mesh;
    use crate::mesh::topology::find_edge;

    #[test]
    fn what_makes_long_edges_does_not_keep_the_lengths() {
        let mut mesh = random_mesh(5, 200);
        let (mut flips, mut scratch, mut ball) = (FlipScratch::default(), LengthScratch::default(), Vec::new());
        let rows: Vec<_> = mesh.finite_tets().map(|tet| mesh.vertices(tet)).collect();
        let mut edges = Vec::new();
        collect_edges(rows.into_iter(), &mut edges);
        let mut found = [0, 0];
        for [a, b] in edges {
            let Some(shell) = find_edge(&mesh, a, b, &mut ball) else { continue };
            if plan_edge_removal(&mut mesh, shell, 10, &AnyPositive, Accept::Valid, &mut flips) != Outcome::Accepted {
                continue;
            }
            if flips.plan.new.iter().flatten().any(|v| v.is_ghost()) {
                continue;
            }
            let (mut before, mut after) = (Vec::new(), Vec::new());
            collect_edges(flips.plan.old.iter().map(|&tet| mesh.vertices(tet)), &mut before);
            collect_edges(flips.plan.new.iter().copied(), &mut after);
            let length = |edge: &[VertexId; 2]| mesh.point(edge[0]).distance(mesh.point(edge[1]));
            let made = after.iter().filter(|edge| !before.contains(edge)).map(length).fold(0.0, f64::max);
            // All edges are long enough; those up to `longest` are short enough.
            let mut keeps = |longest| {
                let spacing = Spacing { sizes: &[1.0; 200], factor: 1e-9, longest };
                keeps_lengths(&mesh, spacing, None, &flips.plan, &mut scratch)
            };
            assert!(keeps(2.0), "the mesh has no longer edge");
            let gone = length(&[a, b]);
            if gone < made {
                found[0] += 1;
                assert!(!keeps(0.5 * (gone + made)));
            } else if made > 0.0 {
                found[1] += 1;
                assert!(keeps(0.5 * (gone + made)));
            }
        }
        assert!(found[0] > 9 && found[1] > 9, "{found:?}");
    }

    #[test]
    fn a_new_vertex_has_the_size_it_is_given_and_unknown_ones_ask_for_nothing() {
        let mut mesh = random_mesh(5, 20);
        let tet = mesh.finite_tets().next().unwrap();
        let center = mesh.points_of(tet).iter().sum::<glam::DVec3>() / 4.0;
        let fresh = mesh.push_point(center).unwrap();
        let mut plan = Plan::default();
        plan.old.push(tet);
        plan.new.extend((0..4).map(|local| {
            let mut row = mesh.vertices(tet);
            row[local] = fresh;
            row
        }));
        let keeps = |sizes: &[f64], size| {
            let spacing = Spacing { sizes, factor: 0.5, longest: 1e9 };
            keeps_lengths(&mesh, spacing, Some((fresh, size)), &plan, &mut LengthScratch::default())
        };
        assert!(keeps(&[], 0.0) && keeps(&[1e-9; 20], 1e-9) && !keeps(&[1e-9; 20], 100.0));
    }
}
