//! Inserts a point into a polyhedron that grows around a bad tet as long as that helps.
//!
//! # Method
//! ```text
//!      +-------+          1. The polyhedron is the tet alone; the point is moved to where its worst new tet is best.
//!     / \  .  / \         2. The worst of the border faces that may be crossed lets the tet beyond it in; the point is
//!    /   \ . /   \           moved again from where it was.
//!   +-----.*.-----+       3. The best polyhedron on the way is taken, if it is better than the worst tet it replaces.
//! ```
//! # Source
//! [KlingnerShewchuk2007] section 3.3: a cavity grown from the bad tet, its star smoothed before it is accepted.
//!
//! # Differences
//! There, the largest set of tets in the star's view is found first and cut by a graph search. Here one tet joins at a
//! time and the point follows, because close to a surface most of the border may not be crossed.
//!
//! # Invariants
//! Constrained faces bound the polyhedron; a tet whose vertex, constrained face or constrained edge would come to lie
//! inside stays out.
//!
//! # Cost
//! A search for a place with each tet that joins: a tenth to half a millisecond a tet. For the few worst tets.

use glam::DVec3;

use super::{InsertionLimits, SliverScratch, collect_border};
use crate::conforming::flip_criteria::{TetMeasure, strict};
use crate::conforming::flips::{FlipScratch, Outcome};
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::tet_store::TetStore;

/// Most tets of a grown polyhedron.
const MAX_GROWN: usize = 28;
/// Tets that join without a better star before growth stops: a star that sees over an edge needs all tets around it.
const PATIENCE: usize = 12;

/// Steps of the search with each tet that joins; the place follows from tet to tet.
const FIRST_STEPS: usize = 3;
/// A star within this factor of what is asked for is searched to the end.
const PROMISING: f64 = 0.5;

/// The best star on the way.
struct Best {
    count: usize,
    grade: f64,
    old_grade: f64,
    place: DVec3,
}

/// Plans the insertion of `vertex` (a spare one without tets) into a polyhedron grown around `tet`. The plan is in
/// `flips`; the second value is the place of the vertex, to be set before the commit. Every new tet is better than
/// the floor and than the worst tet that goes, by the factor `gain`.
pub fn plan_grown_insertion<S: TetStore + ?Sized, M: TetMeasure>(
    store: &mut S,
    (tet, vertex): (TetId, VertexId),
    (limits, gain): (InsertionLimits<'_>, f64),
    measure: &M,
    scratch: &mut SliverScratch,
    flips: &mut FlipScratch,
) -> (Outcome, DVec3) {
    if let Some(refusal) = super::claim_start(store, tet, vertex) {
        return (refusal, DVec3::ZERO);
    }
    scratch.cavity.clear();
    scratch.refused.clear();
    scratch.cavity.push(tet);
    let mut place = store.points_of(tet).iter().sum::<DVec3>() / 4.0;
    let mut best: Option<Best> = None;
    let mut old_grade = f64::INFINITY;
    let mut waited = 0;
    loop {
        let newest = scratch.cavity[scratch.cavity.len() - 1];
        let grade = measure.grade(store.points_of(newest));
        old_grade = old_grade.min(if measure.is_strict(&store.vertices(newest)) { strict(grade) } else { grade });
        collect_border(store, scratch);
        scratch.fill_star(store, measure);
        let (moved, mut grade) = scratch.star.search_steps(measure, place, FIRST_STEPS);
        place = moved;
        let bound = best.as_ref().map_or(limits.floor, |b| b.grade).max(gain * old_grade);
        if grade > PROMISING * bound {
            (place, grade) = scratch.star.search(measure, place);
        }
        if grade > bound && scratch.keeps_distance(store, place, &limits) && scratch.star.is_visible_from(place) {
            best = Some(Best { count: scratch.cavity.len(), grade, old_grade, place });
            waited = 0;
        } else {
            waited += 1;
        }
        if waited > PATIENCE || scratch.cavity.len() == MAX_GROWN {
            break;
        }
        match let_next_in(store, measure, place, scratch) {
            Outcome::Accepted => {}
            Outcome::ClaimLost => return (Outcome::ClaimLost, DVec3::ZERO),
            _ => break,
        }
    }
    let Some(Best { count, grade, old_grade, place }) = best else { return (Outcome::WorsensQuality, DVec3::ZERO) };
    scratch.cavity.truncate(count);
    collect_border(store, scratch);
    scratch.write_plan(store, tet, vertex, (old_grade, grade), flips);
    (Outcome::Accepted, place)
}

/// Adds the tet beyond the worst face of the star at `place` that may be crossed.
fn let_next_in<S: TetStore + ?Sized, M: TetMeasure>(
    store: &mut S,
    measure: &M,
    place: DVec3,
    scratch: &mut SliverScratch,
) -> Outcome {
    scratch.order.clear();
    for at in 0..scratch.border.len() {
        let side = scratch.border[at];
        let other = store.neighbor(side);
        if other == TetFace::NONE || store.is_face_constrained(side) || scratch.refused.contains(&other.tet()) {
            continue;
        }
        let [a, b, c] = scratch.star.faces[at];
        scratch.order.push((measure.grade([a, b, c, place]), side));
    }
    scratch.order.sort_unstable_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
    let label = store.label(scratch.cavity[0]);
    for at in 0..scratch.order.len() {
        let other = store.neighbor(scratch.order[at].1);
        let apex = store.apex(other);
        if apex.is_ghost() || store.label(other.tet()) != label {
            continue;
        }
        if !store.try_claim(apex) {
            return Outcome::ClaimLost;
        }
        scratch.cavity.push(other.tet());
        collect_border(store, scratch);
        if scratch.keeps_all(store) {
            return Outcome::Accepted;
        }
        scratch.cavity.pop();
        scratch.refused.push(other.tet());
    }
    Outcome::Constrained
}
