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
//! Constrained faces bound the polyhedron, and so may constrained edges on them; a tet whose vertex, constrained face or
//! constrained edge would come to lie inside stays out.
//!
//! # Cost
//! A search for a place with each tet that joins: a tenth to half a millisecond a tet. For the few worst tets.

use glam::DVec3;

use super::{InsertionLimits, Polyhedra, SliverScratch, collect_border};
use crate::conforming::flip_criteria::TetMeasure;
use crate::conforming::flips::{FlipScratch, Outcome, grade_of};
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::tet_store::TetStore;
use crate::mesh::topology::ShellTet;

/// Most tets that a polyhedron grows to from one.
const MAX_GROWN: usize = 28;
/// Most tets around the edge that a polyhedron begins with.
const MAX_FAN: usize = 24;
/// Tets that join without a better star before growth stops: a star that sees over an edge needs all tets around it.
const PATIENCE: usize = 12;

/// Tets, and the share of what is asked for that the best of so many stars must have reached: of the polyhedra that find a
/// place in the end (900 on two surfaces) 98 of 100 have. Fans need more tets before they see anything.
const PROMISES: [(usize, f64); 2] = [(8, 0.1), (12, 0.4)];

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

/// Plans the insertion of `vertex` (a spare one without tets) into a polyhedron grown around `tet`, or around all tets at
/// the edge between two local vertices of it, from a point beside that edge. The plan is in `flips`; the second value is the
/// place of the vertex, to be set before the commit. Every new tet is better than the floor and than the worst tet that
/// goes, by the factor `gain`.
pub fn plan_grown_insertion<S: TetStore + ?Sized, M: TetMeasure>(
    store: &mut S,
    (tet, vertex): (TetId, VertexId),
    edge: Option<[usize; 2]>,
    (limits, gain): (InsertionLimits<'_>, f64),
    measure: &M,
    scratch: &mut SliverScratch,
    flips: &mut FlipScratch,
) -> (Outcome, DVec3) {
    if let Some(refusal) = super::claim_start(store, tet, vertex) {
        return (refusal, DVec3::ZERO);
    }
    scratch.cavity.clear();
    scratch.cavity.push(tet);
    let place = match edge {
        None => store.points_of(tet).iter().sum::<DVec3>() / 4.0,
        Some(ends) => match begin_with_fan(store, (tet, ends), scratch) {
            Ok(place) => place,
            Err(refusal) => return (refusal, DVec3::ZERO),
        },
    };
    grow_from(store, (vertex, place), (limits, gain), measure, scratch, flips)
}

/// Adds the tets around an edge of the tet in the scratch; returns a place beside the edge.
fn begin_with_fan<S: TetStore + ?Sized>(
    store: &mut S,
    (tet, [a, b]): (TetId, [usize; 2]),
    scratch: &mut SliverScratch,
) -> Result<DVec3, Outcome> {
    let outcome = collect_fan(store, ShellTet::new(tet, a, b), &mut scratch.cavity);
    if outcome != Outcome::Accepted {
        return Err(outcome);
    }
    collect_border(store, scratch);
    if !scratch.keeps_all(store) {
        return Err(Outcome::Constrained);
    }
    let row = store.vertices(tet);
    let (p, q) = (store.point(row[a]), store.point(row[b]));
    let middle = 0.5 * (p + q);
    let (mut towards, mut nearest) = (DVec3::ZERO, f64::INFINITY);
    for &around in &scratch.cavity {
        let corners = store.points_of(around);
        towards += (corners.iter().sum::<DVec3>() / 4.0 - middle).normalize_or_zero();
        let others = corners.into_iter().filter(|c| *c != p && *c != q);
        nearest = others.map(|c| c.distance(middle)).fold(nearest, f64::min);
    }
    // Between the lengths of the edge and of the tets: the next point may halve what is left in the same way.
    Ok(middle + (p.distance(q) * nearest).sqrt() * towards.normalize_or_zero())
}

/// Claims the other tets around an edge, as far as constrained faces and the hull let pass, and adds them to `fan`, which
/// holds the first.
fn collect_fan<S: TetStore + ?Sized>(store: &mut S, start: ShellTet, fan: &mut Vec<TetId>) -> Outcome {
    let label = store.label(start.tet);
    for forward in [true, false] {
        let mut current = start;
        loop {
            let side = TetFace::new(current.tet, if forward { current.c } else { current.d });
            let next = if forward { current.next(store) } else { current.previous(store) };
            let Some(next) = next.filter(|_| !store.is_face_constrained(side)) else { break };
            if next.tet == start.tet {
                return Outcome::Accepted; // all round
            }
            let row = store.vertices(next.tet);
            if row.contains(&VertexId::GHOST) {
                break;
            }
            if fan.len() == MAX_FAN || store.label(next.tet) != label {
                return Outcome::NotApplicable;
            }
            if !store.try_claim_all(&row) {
                return Outcome::ClaimLost;
            }
            fan.push(next.tet);
            current = next;
        }
    }
    Outcome::Accepted
}

/// Grows the polyhedron in the scratch, whose tets are claimed, and the place of the point with it.
fn grow_from<S: TetStore + ?Sized, M: TetMeasure>(
    store: &mut S,
    (vertex, mut place): (VertexId, DVec3),
    (limits, gain): (InsertionLimits<'_>, f64),
    measure: &M,
    scratch: &mut SliverScratch,
    flips: &mut FlipScratch,
) -> (Outcome, DVec3) {
    scratch.refused.clear();
    let tet = scratch.cavity[0];
    let most = MAX_GROWN + scratch.cavity.len() - 1;
    let graded = |store: &S, tet: TetId| grade_of(store, measure, store.vertices(tet));
    let mut best: Option<Best> = None;
    let mut old_grade = scratch.cavity.iter().map(|&tet| graded(store, tet)).fold(f64::INFINITY, f64::min);
    let mut waited = 0;
    let (begins_alone, mut nearest) = (scratch.cavity.len() == 1, 0.0_f64);
    loop {
        old_grade = old_grade.min(graded(store, scratch.cavity[scratch.cavity.len() - 1]));
        collect_border(store, scratch);
        scratch.fill_star(store, measure);
        let (moved, mut grade) = scratch.star.search_steps(measure, place, FIRST_STEPS);
        place = moved;
        if grade <= 0.0
            && limits.polyhedra == Polyhedra::OfEverySet
            && let Some(deepest) = scratch.kernel.deepest_point(&scratch.star.faces)
        {
            (place, grade) = scratch.star.search_steps(measure, deepest, FIRST_STEPS);
        }
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
        nearest = nearest.max(grade / bound);
        let is_behind = |&(tets, share): &(usize, f64)| scratch.cavity.len() >= tets && nearest < share;
        let is_vain = begins_alone && best.is_none() && PROMISES.iter().any(is_behind);
        if is_vain || waited > PATIENCE || scratch.cavity.len() == most {
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
        scratch.order.push((scratch.star.weights[at].of(measure.grade([a, b, c, place])), side));
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::delaunay_kernel::{DelaunayOptions, tetrahedralize};
    use crate::conforming::flip_criteria::BiasedSine;
    use crate::conforming::flips::commit;
    use crate::conforming::spacing::Spacing;
    use crate::context::RunContext;
    use crate::index::Label;
    use crate::mesh::tet_complex::TetComplex;

    #[test]
    fn a_point_close_to_a_short_edge_makes_its_tets_better() {
        // A short edge on one side of a box, whose other edges are fifty times as long.
        let mut points = vec![DVec3::new(0.0, 0.0, -0.01), DVec3::new(0.0, 0.0, 0.01)];
        points.extend([[-1.0, -0.9], [-0.9, 1.1], [1.0, -1.1], [0.9, 1.0]].map(|[x, z]| DVec3::new(x, 0.0, z)));
        points.extend([[-1.0, -1.0], [-1.1, 1.0], [1.1, -0.9], [1.0, 1.0]].map(|[x, z]| DVec3::new(x, 1.5, z)));
        points.extend([[0.1, 0.8, 0.5], [-0.2, 0.9, -0.4]].map(DVec3::from));
        let options = DelaunayOptions::default();
        let context = RunContext::with_threads(1).unwrap();
        let mut complex = tetrahedralize(&points, &options, &context).unwrap().complex;
        let tets: Vec<TetId> = complex.finite_tets().collect();
        tets.into_iter().for_each(|tet| complex.set_label(tet, Label(1)));
        let worst = |complex: &TetComplex| {
            let has_edge = |row: [VertexId; 4]| [0, 1].iter().all(|&v| row.contains(&VertexId(v)));
            let tets: Vec<_> = complex.finite_tets().filter(|&t| has_edge(complex.vertices(t))).collect();
            let grade = |&t: &TetId| BiasedSine.grade(complex.points_of(t));
            let worst = tets.iter().copied().min_by(|t, u| grade(t).total_cmp(&grade(u)));
            worst.map(|tet| (tet, grade(&tet)))
        };
        let (tet, before) = worst(&complex).unwrap();
        assert!(before < 0.05);
        let spare = complex.push_point(DVec3::ZERO).unwrap();
        let limits =
            InsertionLimits { floor: 0.0, spacing: Spacing::FREE, size: 1.0, polyhedra: Polyhedra::OfEveryPair };
        let (mut scratch, mut flips) = (SliverScratch::default(), FlipScratch::default());
        let ends = [0, 1].map(|v| complex.local_vertex(tet, VertexId(v)).unwrap());
        let (outcome, place) = plan_grown_insertion(
            &mut complex,
            (tet, spare),
            Some(ends),
            (limits, 2.0),
            &BiasedSine,
            &mut scratch,
            &mut flips,
        );
        assert_eq!(outcome, Outcome::Accepted);
        complex.set_point(spare, place);
        commit(&mut complex, &mut flips).unwrap();
        complex.check_invariants().unwrap();
        complex.check_orientation().unwrap();
        // On the end of the mesh, the edge stays.
        assert!(worst(&complex).unwrap().1 > 2.0 * before);
    }
}
