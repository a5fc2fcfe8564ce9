//! What one bad tet gets: edge removal, multi-face removal, better places of its vertices, vertex removal, insertion.
//!
//! # Method
//! The operations are tried in this order until one improves the worst tet of what it replaces. A point is inserted
//! only where the result is worth it ([`insertion_limits`]): the better the tet, the more is asked of the new ones.
//!
//! # Source
//! [KlingnerShewchuk2007] section 3; [Drakopoulos2017] 4.9.3.
//!
//! # Differences
//! Without these limits, tets whose bad angles the surface forces draw point after point, each making the worst tet a
//! little better, until thin places are full of small tets off the boundary that nothing forces to be bad. All operations keep
//! the lengths that the size field asks for ([`keeps_lengths`]) unless a tet is nearly flat ([`Crowding`]); polyhedra grow only
//! for points that need not, since hardly any other found a place (52 of 51 000 attempts on one surface).
//!
//! # Invariants
//! No operation lowers the worst tet of what it touches; tets off the boundary are graded strictly
//! ([`super::super::flip_criteria::strict`]).

use glam::DVec3;

use super::super::edge_lengths::keeps_lengths;
use super::super::failed_attempts::{ball_fingerprint, salt_of};
use super::super::flip_criteria::{BiasedSine, Relief, STRICT_ANGLE, StrictInside, TetMeasure, UnskewedSine, strict};
use super::super::flips::{Accept, Outcome, plan_edge_removal, plan_face_removal, plan_vertex_removal};
use super::super::needle_faces::NeedleFaces;
use super::super::sliver_removal::{InsertionLimits, Polyhedra, plan_grown_insertion, plan_sliver_insertion};
use super::super::small_polyhedron::plan_polyhedron_reconnection;
use super::super::spacing::Spacing;
use super::{Job, Kit};
use crate::error::Result;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::TET_EDGES;
use crate::mesh::quality::SLIVER_DEGREES;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;
use crate::mesh::topology::ShellTet;
use crate::parallel::speculative::Attempt;

/// A tet with a smaller angle, degrees, is nearly flat: a point is inserted wherever it helps enough. Half a degree
/// more than a sliver has.
pub const FLAT_BELOW: f64 = 2.5;
/// The same where points may crowd, degrees.
const POOR_BELOW: f64 = 4.0;
/// A tet with a smaller angle, degrees, gets a point where every new tet reaches that angle; or one in a polyhedron grown
/// around it, where that helps by the factor of [`GAIN`].
const BAD_BELOW: f64 = 10.0;
/// Factor by which a point must better the worst tet that goes where it need not reach an angle: a tet of 4 degrees is at
/// 10 after at most four of them, so that thin places do not fill with points for the sake of little.
const GAIN: f64 = 1.3;
/// The same for the few lowest tets of a mesh, which get step after step.
const SMALL_GAIN: f64 = 1.05;
/// Share of its longest edge below which an edge of a bad tet is short: opposite to it angles are small.
const SHORT_EDGE: f64 = 0.25;
/// The angle that every new tet of all other insertions reaches, degrees.
pub(super) const FLOOR: f64 = 18.0;
/// Distance that vertices keep from their neighbours where they may not crowd, in shares of their average size: with edges
/// below half the size of the boundary the mesh would no longer follow the size field.
pub const SPACING: f64 = 0.5;
/// The same for the longest: with the default factor of the sizes (`cdf`, 1.2) twice the length of the boundary's edges.
pub const LONGEST: f64 = 2.0 / 1.2;

/// Whether edges may become shorter or longer than the sizes want, for the sake of bad tets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Crowding {
    /// For every bad tet.
    Allowed,
    /// Only for tets that are nearly flat.
    Refused,
}

/// Whether operations may make edges shorter or longer than the sizes ask for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lengths {
    /// Only in the place of others.
    Kept,
    /// At tets that may not stay.
    Free,
}

/// How many of `bad` (worst first) are so bad that points may crowd around them.
pub fn count_of_bad(complex: &TetComplex, bad: &[TetId]) -> usize {
    let limit = BAD_BELOW.to_radians().sin();
    bad.partition_point(|&tet| BiasedSine.grade(complex.points_of(tet)) < limit)
}

/// Which operations bad tets get.
#[derive(Debug, Clone, Copy)]
pub struct Treatment<'a> {
    /// Most tets around an edge that is removed.
    pub edge_limit: usize,
    /// Whether vertices are removed and inserted.
    pub changes_vertices: bool,
    /// Whether, before that, small polyhedra are reconnected: costly.
    pub reconnects_polyhedra: bool,
    /// Whether inserted points may be close to others.
    pub crowding: Crowding,
    /// Tets of this grade or better are left alone.
    pub goal: f64,
    /// Whether skew faces make a tet bad.
    pub shuns_skew_faces: bool,
    /// Tets at the boundary that count as better than they are.
    pub relief: Relief<'a>,
    /// Whether a point is worth it however little it helps, and the lengths that operations keep then.
    pub small_steps: Option<Lengths>,
}

impl<'a> Treatment<'a> {
    /// Edge and face removal and moves of vertices.
    pub fn topological(goal: f64) -> Self {
        let crowding = Crowding::Refused;
        Self {
            edge_limit: 8,
            changes_vertices: false,
            reconnects_polyhedra: false,
            crowding,
            goal,
            shuns_skew_faces: false,
            relief: Relief::Nothing,
            small_steps: None,
        }
    }

    /// All operations.
    pub fn everything(goal: f64, crowding: Crowding) -> Self {
        Self { edge_limit: 10, changes_vertices: true, crowding, ..Self::topological(goal) }
    }

    /// All operations, and the reconnection of small polyhedra, for the sake of what no needle of the boundary forces.
    pub fn last_resort(goal: f64, needles: &'a NeedleFaces) -> Self {
        Self {
            reconnects_polyhedra: true,
            relief: Relief::Needles(needles),
            ..Self::everything(goal, Crowding::Allowed)
        }
    }

    /// All operations, for the sake of tets off the boundary whatever becomes of those at it.
    pub fn off_boundary(goal: f64) -> Self {
        Self { reconnects_polyhedra: true, relief: Relief::Boundary, ..Self::everything(goal, Crowding::Allowed) }
    }

    /// All operations with lengths as given, step by step: for the few lowest tets of a mesh.
    pub fn of_lowest(goal: f64, lengths: Lengths) -> Self {
        Self { small_steps: Some(lengths), ..Self::everything(goal, Crowding::Allowed) }
    }

    /// All operations, for the sake of skew faces.
    pub fn of_skew_faces() -> Self {
        Self { shuns_skew_faces: true, ..Self::everything(UnskewedSine::GRADE, Crowding::Allowed) }
    }
}

/// The grade below which a tet is bad: off the boundary nothing forces it to be.
fn bad_grade(is_off_boundary: bool) -> f64 {
    (if is_off_boundary { STRICT_ANGLE } else { BAD_BELOW }).to_radians().sin()
}

/// What a point of size `size` inserted for a tet of `grade` must keep to.
fn insertion_limits(
    grade: f64,
    is_off_boundary: bool,
    (size, spacing): (f64, Spacing<'_>),
    crowding: Crowding,
) -> InsertionLimits<'_> {
    let grade_at = |degrees: f64| degrees.to_radians().sin();
    let flat = if crowding == Crowding::Allowed { POOR_BELOW } else { FLAT_BELOW };
    let (floor, every_edge) = if grade < grade_at(flat) {
        (GAIN * grade, true)
    } else if grade < bad_grade(is_off_boundary) {
        (grade_at(BAD_BELOW), true)
    } else {
        (grade_at(FLOOR), is_off_boundary)
    };
    let polyhedra = if every_edge { Polyhedra::OfEveryPair } else { Polyhedra::OfLargestAngle };
    InsertionLimits { floor, spacing, size, polyhedra }
}

pub(super) struct TreatJob<'a, G> {
    pub sizes: &'a [f64],
    pub measure: StrictInside<'a, G>,
    pub treatment: &'a Treatment<'a>,
}

impl<G: TetMeasure> TreatJob<'_, G> {
    fn is_fixed(&self, vertex: VertexId) -> bool {
        self.measure.on_boundary.get(vertex.index()).copied().unwrap_or(false)
    }

    /// Commits the plan in the kit, with its new vertex of a size, if it keeps the lengths: what became of it. Plans larger than
    /// the room that every attempt has are left alone: another attempt would have no more.
    fn commit<S: TetStore>(
        &self,
        store: &mut S,
        kit: &mut Kit,
        (outcome, lengths): (Outcome, Lengths),
        fresh: Option<(VertexId, f64)>,
    ) -> Result<Outcome> {
        if outcome != Outcome::Accepted {
            store.release_claims();
            return Ok(outcome);
        }
        let Kit { reconnector, lengths: scratch, .. } = &mut *kit;
        let spacing = self.spacing(lengths);
        let keeps = spacing.is_free() || keeps_lengths(store, spacing, fresh, &reconnector.scratch.plan, scratch);
        let result = match keeps {
            true if reconnector.commit(store)? => Outcome::Accepted,
            true => Outcome::NotApplicable,
            false => Outcome::WorsensQuality,
        };
        store.release_claims();
        if result == Outcome::Accepted {
            let Kit { reconnector, touched, .. } = kit;
            touched.made.extend(reconnector.scratch.plan.new.iter().flatten());
        }
        Ok(result)
    }

    /// Whether operations at a tet keep the lengths of edges: not where it may not stay. Slivers that the boundary forces are
    /// among these, since they bound what becomes of the tets beside them: with the lengths kept at them, six times as many
    /// slivers stayed on one part, for one edge in sixty more in range.
    fn lengths_at(&self, row: &[VertexId; 4], corners: [DVec3; 4]) -> Lengths {
        let grade = BiasedSine.grade(corners);
        let is_flat = grade < FLAT_BELOW.to_radians().sin();
        let is_bad = grade < bad_grade(self.measure.is_strict(row));
        let is_unbearable = is_flat || is_bad && self.treatment.crowding == Crowding::Allowed;
        let asked = if self.treatment.shuns_skew_faces { Some(Lengths::Free) } else { self.treatment.small_steps };
        asked.unwrap_or(if is_unbearable { Lengths::Free } else { Lengths::Kept })
    }

    fn spacing(&self, lengths: Lengths) -> Spacing<'_> {
        match lengths {
            Lengths::Free => Spacing::FREE,
            Lengths::Kept => Spacing { sizes: self.sizes, factor: SPACING, longest: LONGEST },
        }
    }

    /// Tells attempts apart: all of the treatment that what is tried after the moves depends on.
    fn salt(&self, lengths: Lengths) -> u64 {
        let Treatment { reconnects_polyhedra, small_steps, crowding, goal, .. } = *self.treatment;
        let relief = match self.treatment.relief {
            Relief::Nothing => 0,
            Relief::Needles(_) => 1,
            Relief::Boundary => 2,
        };
        let is_free = lengths == Lengths::Free;
        let flags = [small_steps.is_some(), reconnects_polyhedra, crowding == Crowding::Allowed, is_free];
        salt_of(&[G::KIND, goal.to_bits(), relief, flags.into_iter().fold(0, |word, flag| 2 * word + u64::from(flag))])
    }

    /// Edge and face removal.
    fn reconnect<S: TetStore>(
        &self,
        store: &mut S,
        kit: &mut Kit,
        (tet, lengths): (TetId, Lengths),
    ) -> Result<Outcome> {
        let mut lost = false;
        for option in 0..10 {
            let scratch = &mut kit.reconnector.scratch;
            let outcome = if option < 6 {
                let [a, b] = TET_EDGES[option];
                let start = ShellTet::new(tet, a, b);
                plan_edge_removal(store, start, self.treatment.edge_limit, &self.measure, Accept::Better, scratch)
            } else {
                let side = TetFace::new(tet, option - 6);
                plan_face_removal(store, side, &self.measure, Accept::Better, scratch)
            };
            match self.commit(store, kit, (outcome, lengths), None)? {
                Outcome::Accepted => return Ok(Outcome::Accepted),
                result => lost |= result == Outcome::ClaimLost,
            }
        }
        Ok(if lost { Outcome::ClaimLost } else { Outcome::WorsensQuality })
    }

    /// The best reconnection of a polyhedron around the tet.
    fn reconnect_polyhedron<S: TetStore>(
        &self,
        store: &mut S,
        kit: &mut Kit,
        (tet, row): (TetId, [VertexId; 4]),
        lengths: Lengths,
    ) -> Result<Outcome> {
        let Some(spare) = kit.spare.pop() else { return Ok(Outcome::NotApplicable) };
        let Kit { polyhedra, reconnector, .. } = kit;
        let scratch = &mut reconnector.scratch;
        let (outcome, place) =
            plan_polyhedron_reconnection(store, (tet, spare), self.treatment.goal, &self.measure, polyhedra, scratch);
        if let Some(place) = place {
            store.set_point(spare, place);
        }
        kit.tally.polyhedra[0] += 1;
        let result = self.commit(store, kit, (outcome, lengths), Some((spare, self.size_at(row))))?;
        let done = result == Outcome::Accepted;
        if done {
            kit.tally.polyhedra[1] += 1;
            let removed = &kit.reconnector.scratch.plan.removed_vertices;
            kit.tally.removed += removed.len() as u64;
            kit.removed.extend_from_slice(removed);
        }
        if done && place.is_some() {
            kit.new_sizes.push((spare, self.size_at(row)));
            kit.tally.inserted += 1;
        } else {
            kit.spare.push(spare);
        }
        Ok(result)
    }

    /// The average size of a tet's vertices.
    fn size_at(&self, row: [VertexId; 4]) -> f64 {
        let known = row.iter().filter_map(|v| self.sizes.get(v.index()).copied());
        known.clone().sum::<f64>() / known.count().max(1) as f64
    }

    /// Moves each vertex to its best place; whether any moved.
    fn move_vertices<S: TetStore>(
        &self,
        store: &mut S,
        kit: &mut Kit,
        (row, lengths): ([VertexId; 4], Lengths),
    ) -> bool {
        let spacing = self.spacing(lengths);
        let mut moved = false;
        kit.smoother.seeks_kernel = matches!(self.treatment.relief, Relief::Boundary);
        for vertex in row.into_iter().filter(|v| !self.is_fixed(*v)) {
            if kit.smoother.optimize(store, vertex, &self.measure, spacing) == Outcome::Accepted {
                kit.touched.moved.push(vertex);
                moved = true;
            }
            store.release_claims();
        }
        moved
    }

    /// Removes one of the vertices.
    fn remove_vertex<S: TetStore>(
        &self,
        store: &mut S,
        kit: &mut Kit,
        (row, lengths): ([VertexId; 4], Lengths),
    ) -> Result<Outcome> {
        let mut lost = false;
        for vertex in row.into_iter().filter(|v| !self.is_fixed(*v)) {
            // No vertex has moved: where the search is known to fail, nothing has changed since.
            let fingerprint = kit.smoother.failed.last_at(vertex);
            if fingerprint.is_some_and(|print| kit.failed_removals.has(vertex, print)) {
                continue;
            }
            let scratch = &mut kit.reconnector.scratch;
            let outcome = plan_vertex_removal(store, vertex, &self.measure, Accept::Better, scratch);
            match self.commit(store, kit, (outcome, lengths), None)? {
                Outcome::Accepted => {
                    kit.tally.removed += 1;
                    kit.removed.push(vertex);
                    return Ok(Outcome::Accepted);
                }
                Outcome::ClaimLost => lost = true,
                _ => {
                    if let Some(print) = fingerprint {
                        kit.failed_removals.add(vertex, print);
                    }
                }
            }
        }
        Ok(if lost { Outcome::ClaimLost } else { Outcome::WorsensQuality })
    }

    /// What a point of a size, inserted for a tet of `grade`, must keep to.
    fn limits_at(&self, grade: f64, is_off: bool, (size, lengths): (f64, Lengths)) -> InsertionLimits<'_> {
        let usual = insertion_limits(grade, is_off, (size, self.spacing(lengths)), self.treatment.crowding);
        if self.treatment.small_steps.is_some() {
            // Better tets, but no slivers in the place of one.
            let floor = (SMALL_GAIN * grade).max(SLIVER_DEGREES.to_radians().sin());
            return InsertionLimits { floor, polyhedra: Polyhedra::OfEverySet, ..usual };
        }
        if is_off && grade < bad_grade(true) && matches!(self.treatment.relief, Relief::Boundary) {
            // Step by step, as tets off the boundary count: what is better than the worst tet is taken, however little.
            let floor = strict((GAIN * grade).min(bad_grade(true)));
            return InsertionLimits { floor, polyhedra: Polyhedra::OfEverySet, ..usual };
        }
        usual
    }

    /// Inserts a point into a polyhedron around the tet.
    fn insert_point<S: TetStore>(
        &self,
        store: &mut S,
        kit: &mut Kit,
        (tet, row): (TetId, [VertexId; 4]),
        lengths: Lengths,
    ) -> Result<Outcome> {
        let Some(vertex) = kit.spare.pop() else { return Ok(Outcome::NotApplicable) };
        kit.tally.tried += 1;
        let size = self.size_at(row);
        let grade = self.measure.grade(store.corners(row));
        let is_off = self.measure.is_strict(&row);
        let limits = self.limits_at(grade, is_off, (size, lengths));
        let Kit { slivers, reconnector, .. } = kit;
        let scratch = &mut reconnector.scratch;
        let (mut outcome, mut place) =
            plan_sliver_insertion(store, tet, vertex, limits, &self.measure, slivers, scratch);
        let small_steps = self.treatment.small_steps.is_some();
        let grows = (grade < bad_grade(is_off) || small_steps) && limits.spacing.is_free();
        if grows && !matches!(outcome, Outcome::Accepted | Outcome::ClaimLost) {
            store.release_claims();
            let floor = if small_steps { limits.floor } else { limits.floor.min(GAIN * grade) };
            let limits = InsertionLimits { floor, ..limits };
            let asked = (limits, if limits.polyhedra == Polyhedra::OfEverySet { 1.0 + 1e-6 } else { GAIN });
            (outcome, place) = plan_grown_insertion(store, (tet, vertex), None, asked, &self.measure, slivers, scratch);
            let edge = shortest_edge(row.map(|v| store.point(v)));
            if let Some(ends) = edge.filter(|_| !matches!(outcome, Outcome::Accepted | Outcome::ClaimLost)) {
                store.release_claims();
                (outcome, place) =
                    plan_grown_insertion(store, (tet, vertex), Some(ends), asked, &self.measure, slivers, scratch);
            }
        }
        if outcome == Outcome::Accepted {
            store.set_point(vertex, place);
        }
        let result = self.commit(store, kit, (outcome, lengths), Some((vertex, size)))?;
        if result == Outcome::Accepted {
            kit.new_sizes.push((vertex, size));
            kit.tally.inserted += 1;
        } else {
            kit.spare.push(vertex);
        }
        Ok(result)
    }
}

/// The shortest edge of a tet, where it is much shorter than the longest.
fn shortest_edge(corners: [DVec3; 4]) -> Option<[usize; 2]> {
    let length = |[i, j]: [usize; 2]| corners[i].distance(corners[j]);
    let shortest = TET_EDGES.into_iter().min_by(|&e, &f| length(e).total_cmp(&length(f)))?;
    let longest = TET_EDGES.into_iter().map(length).fold(0.0, f64::max);
    (length(shortest) < SHORT_EDGE * longest).then_some(shortest)
}

impl<G: TetMeasure + Sync> Job for TreatJob<'_, G> {
    type Item = TetId;

    fn attempt<S: TetStore>(&self, store: &mut S, kit: &mut Kit, tet: TetId) -> Result<Attempt> {
        if !store.try_claim_tet(tet) {
            let gone = !store.is_live(tet);
            store.release_claims();
            return Ok(if gone { Attempt::Done } else { Attempt::ClaimLost });
        }
        let row = store.vertices(tet);
        let before =
            if row.contains(&VertexId::GHOST) { f64::INFINITY } else { self.measure.grade(store.corners(row)) };
        if before >= self.treatment.goal {
            store.release_claims();
            return Ok(Attempt::Done);
        }
        let lengths = self.lengths_at(&row, store.corners(row));
        store.release_claims();
        match self.reconnect(store, kit, (tet, lengths))? {
            Outcome::Accepted => {
                kit.tally.done += 1;
                return Ok(Attempt::Done);
            }
            Outcome::ClaimLost => return Ok(Attempt::ClaimLost),
            _ => {}
        }
        let mut improved = self.move_vertices(store, kit, (row, lengths));
        if self.treatment.changes_vertices && !improved {
            if !store.try_claim_tet(tet) {
                store.release_claims();
                return Ok(Attempt::ClaimLost);
            }
            let fingerprint = ball_fingerprint(store, tet, self.salt(lengths), &mut kit.ball);
            store.release_claims();
            if kit.failed_tets.has(fingerprint) {
                return Ok(Attempt::Done);
            }
            for operation in 0..3 {
                if improved {
                    break;
                }
                let outcome = match operation {
                    0 if self.treatment.reconnects_polyhedra => {
                        self.reconnect_polyhedron(store, kit, (tet, row), lengths)?
                    }
                    1 => self.remove_vertex(store, kit, (row, lengths))?,
                    2 => self.insert_point(store, kit, (tet, row), lengths)?,
                    _ => Outcome::NotApplicable,
                };
                match outcome {
                    Outcome::Accepted => improved = true,
                    Outcome::ClaimLost => return Ok(Attempt::ClaimLost),
                    _ => {}
                }
            }
            if !improved {
                kit.failed_tets.add(fingerprint);
            }
        }
        kit.tally.done += u64::from(improved);
        Ok(Attempt::Done)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_better_the_tet_the_more_is_asked_of_a_point() {
        let sine = |degrees: f64| degrees.to_radians().sin();
        let limits = |degrees, off, crowding| insertion_limits(sine(degrees), off, (2.0, Spacing::FREE), crowding);
        for crowding in [Crowding::Allowed, Crowding::Refused] {
            let flat = limits(1.0, false, crowding);
            assert!(flat.floor == GAIN * sine(1.0) && flat.size == 2.0);
            let poor = limits(3.0, false, crowding);
            assert_eq!(poor.floor, if crowding == Crowding::Allowed { GAIN * sine(3.0) } else { sine(10.0) });
            assert_eq!(limits(7.0, false, crowding).floor, sine(10.0));
            let beside = limits(12.0, false, crowding);
            assert!(beside.floor == sine(18.0) && beside.polyhedra == Polyhedra::OfLargestAngle);
            let off = limits(12.0, true, crowding);
            assert!(off.floor == sine(10.0) && off.polyhedra == Polyhedra::OfEveryPair, "bad off the boundary");
            assert_eq!(limits(16.0, true, crowding).floor, sine(18.0));
        }
    }

    #[test]
    fn lengths_are_given_up_only_for_what_may_not_stay() {
        let over = |height: f64| [DVec3::ZERO, DVec3::X, DVec3::new(0.5, 0.9, 0.0), DVec3::new(0.5, 0.3, height)];
        let (inside, beside) = ([4, 5, 6, 7].map(VertexId), [0, 5, 6, 7].map(VertexId));
        let lengths = |row: &[VertexId; 4], height, treatment: &Treatment| {
            let measure = StrictInside { angles: BiasedSine, on_boundary: &[true; 4], relief: Relief::Nothing };
            TreatJob { sizes: &[], measure, treatment }.lengths_at(row, over(height))
        };
        for crowding in [Crowding::Allowed, Crowding::Refused] {
            let treatment = Treatment::everything(0.4, crowding);
            let of_bad = if crowding == Crowding::Allowed { Lengths::Free } else { Lengths::Kept };
            for (row, height, expected) in [
                (&beside, 0.01, Lengths::Free),
                (&inside, 0.01, Lengths::Free),
                (&beside, 0.04, of_bad),
                (&beside, 0.06, Lengths::Kept),
                (&inside, 0.06, of_bad),
                (&inside, 0.8, Lengths::Kept),
            ] {
                assert_eq!(lengths(row, height, &treatment), expected, "{height} {crowding:?}");
            }
        }
        assert_eq!(lengths(&inside, 0.8, &Treatment::of_skew_faces()), Lengths::Free);
    }
}
