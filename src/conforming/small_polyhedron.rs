//! Small polyhedron reconnection: the best tets on the vertices of a polyhedron grown around a bad tet.
//!
//! # Method
//! ```text
//!   +-----+-----+       1. The polyhedron grows from the bad tet by whole apexes, with all tets that then have no other
//!   |\   / \   /|          vertices. A border face on which no vertex makes a better tet has to go: the apex beyond it
//!   | \ / x \ / |          is next, or, where it may not be crossed, the one that suits it best. Without such a face it
//!   |  +-----+  |          is the apex beyond most of the border.
//!   | / \   / \ |       2. Where every border face has a candidate, the best filling is searched. The front is the set of
//!   +-----+-----+          faces with an empty side; a step puts a tet on one of them, faces that meet their mirror
//!                          image vanish.
//!                       3. The face with the fewest candidates is taken; candidates come best first. One not above the
//!                          worst tet of the best filling so far is none: a face left without any ends the branch.
//! ```
//! Only vertices that are there take part. Those on the border stay; one inside that the filling does not use goes.
//!
//! # Source
//! [LiuSun2006] for the operation and its branch and bound; [MarotRemacle2020] for the growing polyhedron as an improver's
//! last resort.
//!
//! # Differences
//! Every new tet has to be better than the tet at hand from the first step on, so that most branches end at once; tets that
//! are no better stay out, since what is worse was tried before. Growth goes where the search is blocked.
//!
//! # Invariants
//! Constrained faces bound the polyhedron; a tet with which a constrained face or edge, or a vertex that one of them touches,
//! would come to lie inside stays out. Positive tets that close the border tile it: tests of intersection only save time.
//!
//! # Cost
//! Exponential at worst: the steps are limited. A millisecond or two a polyhedron, so only for the few worst tets.

use glam::DVec3;

use super::flip_criteria::TetMeasure;
use super::flips::{Accept, FlipScratch, Outcome, grade_of, touches_constraint};
use super::front_clearance::{Clearance, Face, bits, mirrored, other_faces, turned};
use crate::geometry::predicates::orient3d;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::TET_EDGES;
use crate::mesh::tet_store::TetStore;

/// Most vertices of a polyhedron: less than the bits of a mask, and not much more than the search can fill.
const MOST_VERTICES: usize = 26;
/// Vertices of the smallest polyhedron that is searched: below it edge and face removal have found what there is.
const LEAST_VERTICES: usize = 8;
/// Most tets tried around one bad tet. Fillings that exist are mostly found within a few hundred.
const STEPS: usize = 4000;

/// Heights over a face at which a new apex for it is tried, in shares of the root of twice its area. The first makes a
/// regular tet of a regular face; the others are halves.
const HEIGHTS: [f64; 4] = [0.88, 0.44, 0.22, 0.11];

/// A face with an empty side.
#[derive(Debug, Clone, Copy)]
struct FrontFace {
    /// Smallest vertex first, turned so that a positive tet lies on it.
    face: Face,
    candidates: u64,
    /// Whether a step placed it: the tests against the border do not cover it.
    is_new: bool,
}

/// Buffers of one thread.
#[derive(Debug, Clone, Default)]
pub struct PolyhedronScratch {
    cavity: Vec<TetId>,
    border: Vec<TetFace>,
    /// Apexes beyond the border with the number of border faces they are seen from.
    beyond: Vec<(VertexId, usize)>,
    refused: Vec<VertexId>,
    filling: Filling,
}

/// The search for the best filling of one polyhedron.
#[derive(Debug, Clone, Default)]
struct Filling {
    ids: Vec<VertexId>,
    clearance: Clearance,
    /// Grades by the rank of four ascending vertices: negative where the tet of that order is; NaN where unknown.
    grades: Vec<f64>,
    /// The fronts of all steps on the way, one after the other.
    fronts: Vec<FrontFace>,
    tets: Vec<[u8; 4]>,
    best: Vec<[u8; 4]>,
    /// Grade of the worst tet of the best filling, or what it has to be above.
    bound: f64,
    goal: f64,
    /// Tets below this grade, which is that of the tet at hand, stay as they are.
    least: f64,
    steps_left: usize,
}

/// What a search came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Search {
    Found,
    /// No vertex suits this border face.
    Blocked(usize),
    Failed,
}

/// Plans the best reconnection of a polyhedron around `tet`, the first on the way whose tets are all better than it.
/// Fillings of `goal` or better are as good as any. `spare` is a vertex without tets; where it takes part, the second value
/// is its place, to be set before the commit.
pub fn plan_polyhedron_reconnection<S: TetStore + ?Sized, M: TetMeasure>(
    store: &mut S,
    (tet, spare): (TetId, VertexId),
    goal: f64,
    measure: &M,
    scratch: &mut PolyhedronScratch,
    flips: &mut FlipScratch,
) -> (Outcome, Option<DVec3>) {
    if !store.is_live(tet) || store.is_ghost_tet(tet) {
        return (Outcome::NotApplicable, None);
    }
    if !store.try_claim(spare) || !store.try_claim_tet(tet) {
        return (Outcome::ClaimLost, None);
    }
    let before = grade_of(store, measure, store.vertices(tet));
    scratch.begin(store, tet, (Accept::Better.threshold(before), goal));
    let (mut last, mut place) = (Search::Failed, None);
    while scratch.filling.ids.len() < MOST_VERTICES && scratch.filling.steps_left > 0 {
        let blocked = match last {
            Search::Blocked(face) => Some(face),
            _ => None,
        };
        match scratch.take_next_apex(store, measure, blocked) {
            Outcome::Accepted => {}
            Outcome::ClaimLost => return (Outcome::ClaimLost, None),
            _ => {
                place = blocked.filter(|_| place.is_none()).and_then(|at| scratch.place_for(store, scratch.border[at]));
                let Some(place) = place else { return (Outcome::WorsensQuality, None) };
                scratch.filling.add_vertex(spare, place);
            }
        }
        last = scratch.search(store, measure);
        if last == Search::Found {
            scratch.write_plan(store, before, flips);
            let is_new = flips.plan.new.as_flattened().contains(&spare);
            flips.plan.removed_vertices.retain(|v| *v != spare);
            // The place is not in the store yet: orientations were tested in the search as exactly.
            return (Outcome::Accepted, place.filter(|_| is_new));
        }
    }
    (Outcome::WorsensQuality, None)
}

impl PolyhedronScratch {
    fn begin<S: TetStore + ?Sized>(&mut self, store: &S, tet: TetId, (bound, goal): (f64, f64)) {
        self.cavity.clear();
        self.cavity.push(tet);
        self.refused.clear();
        self.filling.reset(bound, goal);
        store.vertices(tet).into_iter().for_each(|v| self.filling.add_vertex(v, store.point(v)));
        self.collect_border(store);
    }

    fn collect_border<S: TetStore + ?Sized>(&mut self, store: &S) {
        self.border.clear();
        for &tet in &self.cavity {
            for (face, other) in store.neighbors(tet).into_iter().enumerate() {
                if other == TetFace::NONE || !self.cavity.contains(&other.tet()) {
                    self.border.push(TetFace::new(tet, face));
                }
            }
        }
    }

    /// The best filling of the polyhedron, where its border does not tell at once that there is none.
    fn search<S: TetStore + ?Sized, M: TetMeasure>(&mut self, store: &S, measure: &M) -> Search {
        self.filling.set_border(store, &self.border);
        if let Some(face) = self.filling.face_without_apex(measure) {
            return Search::Blocked(face);
        }
        if self.filling.ids.len() < LEAST_VERTICES { Search::Failed } else { self.filling.solve(measure) }
    }

    fn write_plan<S: TetStore + ?Sized>(&self, store: &S, before: f64, flips: &mut FlipScratch) {
        let plan = &mut flips.plan;
        plan.reset(store.label(self.cavity[0]));
        plan.old.extend_from_slice(&self.cavity);
        let Filling { best, ids, bound, .. } = &self.filling;
        (plan.old_grade, plan.new_grade) = (before, *bound);
        plan.new.extend(best.iter().map(|t| t.map(|i| ids[usize::from(i)])));
        let is_unused = |v: &&VertexId| !plan.new.as_flattened().contains(v);
        plan.removed_vertices.extend(ids.iter().filter(is_unused));
    }

    /// Whether the polyhedron may grow over a border face.
    fn may_cross<S: TetStore + ?Sized>(&self, store: &S, side: TetFace) -> bool {
        let other = store.neighbor(side);
        other != TetFace::NONE
            && !store.is_face_constrained(side)
            && !store.apex(other).is_ghost()
            && store.label(other.tet()) == store.label(side.tet())
            && !self.refused.contains(&store.apex(other))
    }

    /// Lets an apex beyond the border in, with every tet that it completes: for the sake of the border face number
    /// `blocked`, if there is one.
    fn take_next_apex<S: TetStore + ?Sized, M: TetMeasure>(
        &mut self,
        store: &mut S,
        measure: &M,
        blocked: Option<usize>,
    ) -> Outcome {
        let wanted = blocked.map(|at| self.border[at]);
        loop {
            let next = match wanted {
                Some(side) if self.may_cross(store, side) => Some(store.apex(store.neighbor(side))),
                Some(side) => self.apex_for(store, measure, side),
                None => self.apex_seen_most(store),
            };
            let Some(apex) = next else { return Outcome::Constrained };
            if !store.try_claim(apex) {
                return Outcome::ClaimLost;
            }
            let count = self.cavity.len();
            self.filling.add_vertex(apex, store.point(apex));
            self.complete(store, measure);
            if self.cavity.len() > count {
                return Outcome::Accepted;
            }
            self.filling.drop_last_vertex();
            self.refused.push(apex);
        }
    }

    /// The apex beyond the border that makes the best tet with a face which may not be crossed.
    fn apex_for<S: TetStore + ?Sized, M: TetMeasure>(&self, store: &S, measure: &M, side: TetFace) -> Option<VertexId> {
        let [a, b, c] = store.triangle(store.face_vertices(side));
        let apexes = self.border.iter().filter(|s| self.may_cross(store, **s)).map(|s| store.apex(store.neighbor(*s)));
        let row = store.face_vertices(side);
        let weight = |v: VertexId| measure.weight(&[row[0], row[1], row[2], v]);
        let grades = apexes.map(|v| (weight(v).of(measure.grade([a, c, b, store.point(v)])), v));
        let best = grades.max_by(|x, y| x.0.total_cmp(&y.0).then(y.1.cmp(&x.1)));
        best.filter(|(grade, _)| *grade > self.filling.bound).map(|(_, v)| v)
    }

    /// A place in the polyhedron for a new apex of a border face.
    fn place_for<S: TetStore + ?Sized>(&self, store: &S, side: TetFace) -> Option<DVec3> {
        let [a, b, c] = store.triangle(store.face_vertices(side));
        let (centroid, inwards) = ((a + b + c) / 3.0, (c - a).cross(b - a));
        let scale = inwards.length().sqrt();
        let contains = |point: DVec3| {
            let sees = |tet: TetId, face: usize| {
                let [p, q, r] = store.triangle(store.face_vertices(TetFace::new(tet, face)));
                orient3d(p, q, r, point) < 0.0
            };
            self.cavity.iter().any(|&tet| (0..4).all(|face| sees(tet, face)))
        };
        let heights = HEIGHTS.iter().map(|height| centroid + height * scale * inwards.normalize_or_zero());
        heights.into_iter().find(|place| contains(*place))
    }

    /// The apex beyond most border faces; the first of these, since the border is in the order of growth.
    fn apex_seen_most<S: TetStore + ?Sized>(&mut self, store: &S) -> Option<VertexId> {
        self.beyond.clear();
        for at in 0..self.border.len() {
            let side = self.border[at];
            if self.may_cross(store, side) {
                let apex = store.apex(store.neighbor(side));
                match self.beyond.iter_mut().find(|(v, _)| *v == apex) {
                    Some((_, count)) => *count += 1,
                    None => self.beyond.push((apex, 1)),
                }
            }
        }
        self.beyond.iter().rev().max_by_key(|(_, count)| *count).map(|(v, _)| *v)
    }

    /// Adds tets beyond the border whose vertices all belong to the polyhedron and which are better than the bad one.
    fn complete<S: TetStore + ?Sized, M: TetMeasure>(&mut self, store: &S, measure: &M) {
        let label = store.label(self.cavity[0]);
        let mut at = 0;
        while at < self.cavity.len() {
            let tet = self.cavity[at];
            for (face, other) in store.neighbors(tet).into_iter().enumerate() {
                let is_wall = other == TetFace::NONE || store.is_face_constrained(TetFace::new(tet, face));
                if is_wall || self.cavity.contains(&other.tet()) || store.label(other.tet()) != label {
                    continue;
                }
                let is_known = self.filling.ids.contains(&store.apex(other));
                // Equal grades count as better: both tets beside an edge often have the same.
                if !is_known || grade_of(store, measure, store.vertices(other.tet())) < self.filling.least {
                    continue;
                }
                self.cavity.push(other.tet());
                if !self.keeps_all(store, other.tet()) {
                    self.cavity.pop();
                }
            }
            at += 1;
        }
        self.collect_border(store);
    }

    /// Whether nothing constrained is inside the polyhedron for the sake of the tet let in last.
    fn keeps_all<S: TetStore + ?Sized>(&mut self, store: &S, tet: TetId) -> bool {
        self.collect_border(store);
        let on_border = |ends: &[VertexId]| {
            self.border.iter().any(|&side| {
                let face = store.face_vertices(side);
                ends.iter().all(|v| face.contains(v))
            })
        };
        let (row, flags, neighbors) = (store.vertices(tet), store.flags(tet), store.neighbors(tet));
        let is_inside = |face: usize| neighbors[face] != TetFace::NONE && self.cavity.contains(&neighbors[face].tet());
        let is_lost = |edge: usize| {
            let [i, j] = TET_EDGES[edge];
            flags.is_edge_constrained(edge) && !on_border(&[row[i], row[j]])
        };
        let is_free = |v: VertexId| !self.cavity.iter().any(|&t| touches_constraint(store, t, v));
        row.iter().all(|&v| on_border(&[v]) || is_free(v))
            && !(0..4).any(|face| flags.is_face_constrained(face) && is_inside(face))
            && !(flags.has_constrained_edge() && (0..6).any(is_lost))
    }
}

impl Filling {
    fn reset(&mut self, bound: f64, goal: f64) {
        self.ids.clear();
        self.clearance.reset();
        self.grades.clear();
        // The tets beside an edge often have the same grade, up to rounding.
        (self.least, self.bound, self.goal) = (bound * (1.0 - 1e-6), bound, goal);
        self.steps_left = STEPS;
    }

    fn add_vertex(&mut self, vertex: VertexId, point: DVec3) {
        debug_assert!(self.ids.len() < MOST_VERTICES);
        self.ids.push(vertex);
        self.clearance.points.push(point);
        // A new vertex is the largest of its quadruples: the ranks of the others stay.
        self.grades.resize(rank([0, 0, 0, self.ids.len() as u8]), f64::NAN);
    }

    fn drop_last_vertex(&mut self) {
        self.ids.pop();
        self.clearance.points.pop();
        self.grades.truncate(rank([0, 0, 0, self.ids.len() as u8]));
    }

    fn set_border<S: TetStore + ?Sized>(&mut self, store: &S, border: &[TetFace]) {
        let Self { clearance, ids, .. } = self;
        let local = |v: VertexId| ids.iter().position(|w| *w == v).unwrap_or(0) as u8;
        // Outward from its tet: turned, a tet inside is positive on it.
        let inward = |&side: &TetFace| {
            let [a, b, c] = store.face_vertices(side).map(local);
            turned([a, c, b])
        };
        let faces: Vec<Face> = border.iter().map(inward).collect();
        // Each edge of a closed surface runs both ways.
        let edges = faces.iter().flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]]).filter(|[p, q]| p < q);
        clearance.set_start(faces.iter().copied(), edges);
        self.tets.clear();
        self.best.clear();
        self.fronts.clear();
    }

    /// The first border face that makes no tet above the bound with any vertex.
    fn face_without_apex<M: TetMeasure>(&mut self, measure: &M) -> Option<usize> {
        let has_apex = |filling: &mut Self, face: Face| {
            let others = (0..filling.clearance.points.len() as u8).filter(|v| !face.contains(v));
            others.into_iter().any(|v| filling.grade(measure, face, v) > filling.bound)
        };
        (0..self.clearance.start_faces().len()).find(|&at| !has_apex(self, self.clearance.start_faces()[at]))
    }

    /// Searches the best filling above the bound; it is in `best`, and its grade in `bound`.
    fn solve<M: TetMeasure>(&mut self, measure: &M) -> Search {
        for at in 0..self.clearance.start_faces().len() {
            let face = self.clearance.start_faces()[at];
            let candidates = self.candidates(measure, face);
            if candidates == 0 {
                return Search::Blocked(at);
            }
            self.fronts.push(FrontFace { face, candidates, is_new: false });
        }
        self.search(measure, 0, f64::INFINITY);
        if self.best.is_empty() { Search::Failed } else { Search::Found }
    }

    /// Fills the front from `begin` on, with tets of grade `low` and better placed so far.
    fn search<M: TetMeasure>(&mut self, measure: &M, begin: usize, low: f64) {
        let end = self.fronts.len();
        if begin == end {
            self.bound = low;
            self.best.clone_from(&self.tets);
            return;
        }
        let narrowest = (begin..end).min_by_key(|&i| self.fronts[i].candidates.count_ones()).unwrap_or(begin);
        let FrontFace { face, candidates, .. } = self.fronts[narrowest];
        let mut order = [(0.0, 0u8); MOST_VERTICES];
        let mut count = 0;
        for v in bits(candidates) {
            order[count] = (self.grade(measure, face, v), v);
            count += 1;
        }
        let order = &mut order[..count];
        order.sort_unstable_by(|x, y| y.0.total_cmp(&x.0).then(x.1.cmp(&y.1)));
        for &(grade, apex) in order.iter() {
            if self.steps_left == 0 || grade.min(low) <= self.bound || self.bound >= self.goal {
                return;
            }
            self.steps_left -= 1;
            if self.place(measure, (begin, end), narrowest, apex) {
                self.tets.push([face[0], face[1], face[2], apex]);
                self.search(measure, end, grade.min(low));
                self.tets.pop();
            }
            self.fronts.truncate(end);
        }
    }

    /// Appends the front after a tet was put on face number `at`; false where that may not be, or a face is left without a
    /// candidate.
    fn place<M: TetMeasure>(&mut self, measure: &M, (begin, end): (usize, usize), at: usize, apex: u8) -> bool {
        let face = self.fronts[at].face;
        for i in begin..end {
            let other = self.fronts[i];
            if other.is_new && !self.clearance.is_clear_of(face, apex, other.face) {
                return false;
            }
        }
        for i in (begin..end).filter(|&i| i != at) {
            self.fronts.push(self.fronts[i]);
        }
        for other in other_faces(face, apex) {
            let mirror = mirrored(other);
            let meets = |f: &FrontFace| f.face == mirror || f.face == other;
            match self.fronts[end..].iter().position(meets) {
                Some(i) if self.fronts[end + i].face == mirror => drop(self.fronts.swap_remove(end + i)),
                Some(_) => return false, // its far side is taken
                None => {
                    let candidates = self.candidates(measure, other);
                    if candidates == 0 {
                        return false;
                    }
                    self.fronts.push(FrontFace { face: other, candidates, is_new: true });
                }
            }
        }
        true
    }

    /// The vertices whose tet on the face is above the bound and clear of the border.
    fn candidates<M: TetMeasure>(&mut self, measure: &M, face: Face) -> u64 {
        let mut mask = 0;
        for v in 0..self.clearance.points.len() as u8 {
            if !face.contains(&v)
                && self.grade(measure, face, v) > self.bound
                && self.clearance.is_clear_of_start(face, v)
            {
                mask |= 1 << v;
            }
        }
        mask
    }

    /// The grade of the tet on a face; negative where it is inverted.
    fn grade<M: TetMeasure>(&mut self, measure: &M, [a, b, c]: Face, v: u8) -> f64 {
        let mut row = [a, b, c, v];
        // Sorting four by five exchanges; each turns the tet over.
        let mut is_odd = false;
        for [i, j] in [[0, 1], [2, 3], [0, 2], [1, 3], [1, 2]] {
            if row[i] > row[j] {
                row.swap(i, j);
                is_odd = !is_odd;
            }
        }
        let rank = rank(row);
        if self.grades[rank].is_nan() {
            let [p, q, r, s] = row.map(|i| self.clearance.points[usize::from(i)]);
            let is_positive = orient3d(p, q, r, s) > 0.0;
            let grade = measure.grade(if is_positive { [p, q, r, s] } else { [p, r, q, s] }).max(0.0);
            let grade = measure.weight(&row.map(|i| self.ids[usize::from(i)])).of(grade);
            self.grades[rank] = if is_positive { grade } else { -grade };
        }
        if is_odd { -self.grades[rank] } else { self.grades[rank] }
    }
}

/// The number of four ascending vertices among all such: the combinatorial number system.
fn rank([a, b, c, d]: [u8; 4]) -> usize {
    let [a, b, c, d] = [a, b, c, d].map(usize::from);
    let choose2 = b * b.saturating_sub(1) / 2;
    let choose3 = c * c.saturating_sub(1) * c.saturating_sub(2) / 6;
    let choose4 = d * d.saturating_sub(1) * d.saturating_sub(2) * d.saturating_sub(3) / 24;
    a + choose2 + choose3 + choose4
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::flip_criteria::BiasedSine;
    use crate::conforming::flips::{commit, plan_edge_removal, plan_face_removal};
    use crate::conforming::test_meshes::{add_walls, random_mesh, walls};
    use crate::mesh::tet_complex::TetComplex;
    use crate::mesh::topology::ShellTet;

    /// Plans and, where that is accepted, sets the place of the spare vertex, the last one.
    fn plan(complex: &mut TetComplex, tet: TetId, scratch: &mut PolyhedronScratch, flips: &mut FlipScratch) -> Outcome {
        let spare = VertexId::from_index(complex.vertex_count() - 1);
        let (outcome, place) =
            plan_polyhedron_reconnection(complex, (tet, spare), f64::INFINITY, &BiasedSine, scratch, flips);
        if let Some(place) = place {
            complex.set_point(spare, place);
        }
        outcome
    }

    #[test]
    fn polyhedra_help_where_no_flip_does_and_keep_held_faces() {
        let mut complex = random_mesh(5, 400);
        complex.push_point(DVec3::ZERO).unwrap();
        add_walls(&mut complex, 7);
        let before = walls(&complex);
        let (mut scratch, mut flips) = (PolyhedronScratch::default(), FlipScratch::default());
        let worst = |complex: &TetComplex| -> Vec<TetId> {
            let grade = |tet: &TetId| BiasedSine.grade(complex.points_of(*tet));
            complex.finite_tets().filter(|tet| grade(tet) < 0.1).collect()
        };
        let (mut tried, mut helped, mut removed) = (0, 0, 0);
        for tet in worst(&complex) {
            let is_left = complex.is_live(tet) && BiasedSine.grade(complex.points_of(tet)) < 0.1;
            let flips_help = is_left
                && ((0..4).any(|face| {
                    let side = TetFace::new(tet, face);
                    plan_face_removal(&mut complex, side, &BiasedSine, Accept::Better, &mut flips) == Outcome::Accepted
                }) || TET_EDGES.into_iter().any(|[a, b]| {
                    let start = ShellTet::new(tet, a, b);
                    plan_edge_removal(&mut complex, start, 10, &BiasedSine, Accept::Better, &mut flips)
                        == Outcome::Accepted
                }));
            if !is_left || flips_help {
                continue;
            }
            tried += 1;
            if plan(&mut complex, tet, &mut scratch, &mut flips) == Outcome::Accepted {
                helped += 1;
                assert!(flips.plan.old.contains(&tet) && flips.plan.new_grade > flips.plan.old_grade);
                let grade = |row: &[VertexId; 4]| BiasedSine.grade(complex.corners(*row));
                let new_grade = flips.plan.new.iter().map(grade).fold(f64::INFINITY, f64::min);
                assert!((new_grade - flips.plan.new_grade).abs() < 1e-12);
                assert!(flips.plan.is_positive(&complex));
                removed += flips.plan.removed_vertices.len();
                commit(&mut complex, &mut flips).unwrap();
                complex.push_point(DVec3::ZERO).unwrap();
            }
        }
        complex.check_invariants().unwrap();
        complex.check_orientation().unwrap();
        assert_eq!(walls(&complex), before, "constrained faces stay");
        let lost = (0..400).filter(|&v| complex.tet_of(VertexId(v)) == TetId::NONE).count();
        assert!(lost <= removed, "{lost} vertices lost, {removed} removed");
        assert!(helped > 0 && helped < tried, "{helped} of {tried}");
    }

    /// The worst grade of the best of all fillings of a front, by trying every tet on its first face.
    fn best_of_all(filling: &mut Filling, front: &[Face], low: f64) -> f64 {
        let Some((&face, rest)) = front.split_first() else { return low };
        let mut best = f64::NEG_INFINITY;
        for v in 0..filling.clearance.points.len() as u8 {
            let grade = if face.contains(&v) { -1.0 } else { filling.grade(&BiasedSine, face, v) };
            let clear = grade > 0.0 && filling.clearance.is_clear_of_start(face, v);
            if !clear || !rest.iter().all(|&other| filling.clearance.is_clear_of(face, v, other)) {
                continue;
            }
            let mut next = rest.to_vec();
            for other in other_faces(face, v) {
                match next.iter().position(|f| *f == mirrored(other)) {
                    Some(at) => drop(next.swap_remove(at)),
                    None => next.push(other),
                }
            }
            best = best.max(best_of_all(filling, &next, low.min(grade)));
        }
        best
    }

    #[test]
    fn the_best_filling_of_all_is_found() {
        let mut complex = random_mesh(5, 60);
        complex.push_point(DVec3::ZERO).unwrap();
        let (mut scratch, mut flips) = (PolyhedronScratch::default(), FlipScratch::default());
        let tets: Vec<TetId> = complex.finite_tets().collect();
        let mut compared = 0;
        for tet in tets {
            if plan(&mut complex, tet, &mut scratch, &mut flips) != Outcome::Accepted || scratch.border.len() > 10 {
                continue;
            }
            let front = scratch.filling.clearance.start_faces().to_vec();
            let best = best_of_all(&mut scratch.filling, &front, f64::INFINITY);
            assert!((best - flips.plan.new_grade).abs() < 1e-12, "{best} {}", flips.plan.new_grade);
            compared += 1;
        }
        assert!(compared > 0);
    }

    #[test]
    fn ranks_number_ascending_quadruples() {
        let mut next = 0;
        for d in 3..9 {
            for c in 2..d {
                for b in 1..c {
                    for a in 0..b {
                        assert_eq!(rank([a, b, c, d]), next);
                        next += 1;
                    }
                }
            }
        }
        assert_eq!(rank([0, 0, 0, 9]), next);
    }
}
