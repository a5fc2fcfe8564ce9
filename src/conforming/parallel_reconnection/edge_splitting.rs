//! Splits edges that are far too long for the sizes of their ends.
//!
//! # Method
//! The edge of a tet that is longest against its sizes gets a point in the polyhedron of the tets around it, if more edges
//! are in range then ([`betters_lengths`]) and no tet is worse than the worst there was, or is a good one.
//!
//! # Source
//! [Drakopoulos2017] 4.7.1 (distribution function); the polyhedron: 4.9.3.
//!
//! # Invariants
//! No operation lowers the worst tet of what it touches, unless it stays above [`FLOOR`].

use super::super::edge_lengths::betters_lengths;
use super::super::flip_criteria::{BiasedSine, Relief, StrictInside};
use super::super::flips::Outcome;
use super::super::sliver_removal::{InsertionLimits, Polyhedra, plan_edge_split};
use super::super::spacing::Spacing;
use super::tet_treatment::{FLOOR, LONGEST, SPACING};
use super::{Job, Kit};
use crate::error::Result;
use crate::index::{TetId, VertexId};
use crate::mesh::numbering::TET_EDGES;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;
use crate::parallel::speculative::Attempt;

pub(super) struct SplitJob<'a> {
    spacing: Spacing<'a>,
    measure: StrictInside<'a, BiasedSine>,
}

impl<'a> SplitJob<'a> {
    pub fn new(sizes: &'a [f64], on_boundary: &'a [bool]) -> Self {
        let spacing = Spacing { sizes, factor: SPACING, longest: LONGEST };
        Self { spacing, measure: StrictInside { angles: BiasedSine, on_boundary, relief: Relief::Nothing } }
    }
}

/// The local edge of a tet that is longest against the sizes of its ends, where it is too long, and the average of these.
pub(super) fn longest_edge<S: TetStore + ?Sized>(store: &S, spacing: Spacing<'_>, tet: TetId) -> Option<(usize, f64)> {
    let row = store.vertices(tet);
    let corners = store.corners(row);
    let mut found = None;
    let mut most = spacing.longest;
    for (edge, [i, j]) in TET_EDGES.into_iter().enumerate() {
        // Points inserted by the same pass have no size yet.
        let ends = [i, j].map(|end| spacing.size_of(row[end]));
        let size = 0.5 * (ends[0] + ends[1]);
        let ratio = corners[i].distance(corners[j]) / size;
        if ends[0].min(ends[1]) > 0.0 && ratio > most && !store.is_edge_constrained(tet, i, j) {
            most = ratio;
            found = Some((edge, size));
        }
    }
    found
}

/// How many times longer than the sizes of its ends allow the longest edge of a tet is, where it is too long.
pub fn longest_excess(complex: &TetComplex, sizes: &[f64], tet: TetId) -> Option<f64> {
    let spacing = Spacing { sizes, factor: SPACING, longest: LONGEST };
    let (edge, size) = longest_edge(complex, spacing, tet)?;
    let (corners, [i, j]) = (complex.points_of(tet), TET_EDGES[edge]);
    Some(corners[i].distance(corners[j]) / size)
}

impl Job for SplitJob<'_> {
    type Item = TetId;

    fn attempt<S: TetStore>(&self, store: &mut S, kit: &mut Kit, tet: TetId) -> Result<Attempt> {
        if !store.try_claim_tet(tet) {
            let gone = !store.is_live(tet);
            store.release_claims();
            return Ok(if gone { Attempt::Done } else { Attempt::ClaimLost });
        }
        let is_usable = store.is_live(tet) && !store.vertices(tet).contains(&VertexId::GHOST);
        let Some((edge, size)) = is_usable.then(|| longest_edge(store, self.spacing, tet)).flatten() else {
            store.release_claims();
            return Ok(Attempt::Done);
        };
        let Some(vertex) = kit.spare.pop() else {
            store.release_claims();
            return Ok(Attempt::Done);
        };
        let limits = InsertionLimits {
            floor: FLOOR.to_radians().sin(),
            spacing: self.spacing,
            size,
            polyhedra: Polyhedra::OfLargestAngle,
        };
        let Kit { slivers, reconnector, lengths, .. } = &mut *kit;
        let plan = &mut reconnector.scratch;
        let (outcome, place) = plan_edge_split(store, (tet, edge), vertex, limits, &self.measure, slivers, plan);
        let mut done = false;
        if outcome == Outcome::Accepted {
            store.set_point(vertex, place);
            let fresh = Some((vertex, size));
            done = betters_lengths(store, self.spacing, fresh, &reconnector.scratch.plan, lengths)
                && reconnector.commit(store)?;
        }
        store.release_claims();
        if done {
            kit.touched.made.extend(kit.reconnector.scratch.plan.new.iter().flatten());
            kit.new_sizes.push((vertex, size));
            kit.tally.inserted += 1;
            kit.tally.done += 1;
        } else {
            kit.spare.push(vertex);
        }
        Ok(if outcome == Outcome::ClaimLost { Attempt::ClaimLost } else { Attempt::Done })
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::conforming::delaunay_kernel::{DelaunayOptions, tetrahedralize};
    use crate::conforming::options::Options;
    use crate::conforming::parallel_reconnection::Driver;
    use crate::context::RunContext;
    use crate::index::Label;
    use crate::mesh::topology::find_edge;

    #[test]
    fn an_edge_twice_as_long_as_its_sizes_gets_a_point_in_its_middle() {
        // Six tets around the edge 0 1.
        let mut points = vec![1.8 * DVec3::Z, -1.8 * DVec3::Z];
        points.extend((0..6).map(|i| {
            let turn = std::f64::consts::FRAC_PI_3 * f64::from(i);
            1.95 * DVec3::new(turn.cos(), turn.sin(), 0.0)
        }));
        let (options, context) = (Options::default(), RunContext::with_threads(1).unwrap());
        // An edge may be two long, or four.
        for (size, expected) in [(1.2, 1), (2.4, 0)] {
            let mut complex = tetrahedralize(&points, &DelaunayOptions::default(), &context).unwrap().complex;
            let tets: Vec<TetId> = complex.finite_tets().collect();
            tets.iter().for_each(|&tet| complex.set_label(tet, Label(1)));
            let mut sizes = vec![size; 8];
            assert_eq!(longest_excess(&complex, &sizes, tets[0]).is_some(), expected == 1);
            let mut driver = Driver::for_quality(&options, &context);
            assert_eq!(driver.split_long_edges(&mut complex, &mut sizes, &[true; 8], tets).unwrap(), expected);
            assert_eq!(complex.finite_tets().count(), if expected == 1 { 12 } else { 6 });
            let axis = find_edge(&complex, VertexId(0), VertexId(1), &mut Vec::new());
            assert_eq!(axis.is_none(), expected == 1);
            assert_eq!(sizes.iter().filter(|s| **s == size).count(), 8 + expected);
            complex.check_invariants().unwrap();
            complex.check_orientation().unwrap();
        }
    }
}
