//! Moves vertices: optimal point placement, average of centroids, smart acceptance, and search for the best place.
//!
//! # Method
//! ```text
//!      b-------f        The ball of P is star-shaped around P: its border faces, turned inwards, with P give its tets.
//!     / \     / \       Optimal placement: the average over the faces of  centroid + sqrt(2/3) * mean edge * normal.
//!    /   \ P /   \      Centroid average: the average of the tets' centroids.
//!   *-----*-*-----e     P' = P + c (average - P); c halves while a tet would be inverted or, smart, be worse than
//!                       the worst before. The search climbs the grade of the worst tets instead of taking a target.
//! ```
//! # Source
//! [Drakopoulos2017] 4.9.2 equations (9) and (10), B.3 `msmth`, `csmth`, `vsmthb`, `nsmth`, 4.12 (smart smoothing);
//! search for the best worst element: [FreitagOllivierGooch1997].
//!
//! # Differences
//! The search follows the slopes of the worst tets' grades and halves its step; it needs no linear program.
//!
//! # Invariants
//! A vertex on a constraint never moves. Every tet of a moved ball is positive by exact arithmetic, and has no user bit.
//!
//! # Cost
//! A ball has 24 tets on average: about two microseconds a target, ten to fifty a search. No allocation in the kernel.

use glam::DVec3;

use super::failed_attempts::FailedAttempts;
use super::flip_criteria::{TetMeasure, Weight};
use super::flips::{Outcome, touches_constraint};
use super::spacing::Spacing;
use crate::geometry::predicates::orient3d;
use crate::geometry::star_kernel::StarKernel;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::TET_FACES;
use crate::mesh::tet_flags::TetFlags;
use crate::mesh::tet_store::{TetStore, has_ghost};
use crate::mesh::topology::BallWalk;

/// Height of the regular tet over its edge.
const EQUILATERAL_HEIGHT: f64 = 0.816_496_580_927_726;
/// Most times a coefficient is halved.
const HALVINGS: usize = 3;
/// Factor by which a smart move betters the worst tet. Smaller moves go on for long and change nothing worth having.
const LEAST_GAIN: f64 = 1.005;
/// Most steps of a search; it usually stops before.
const SEARCH_STEPS: usize = 12;
/// Tets whose grade is within this factor of the worst pull at a search step.
const ACTIVE_FACTOR: f64 = 1.1;

/// Which point a vertex moves towards.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Target {
    /// Average of the optimal placements over the faces of the ball.
    OptimalPlacement,
    /// Average of the centroids of the tets.
    Centroids,
}

/// When a move is accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Acceptance {
    /// When every tet stays positive.
    Valid,
    /// When, besides, the worst tet is not worse than before.
    Smart,
}

/// How vertices are smoothed.
#[derive(Debug, Clone, Copy)]
pub struct SmoothingRule {
    /// First target; the other is tried where it gives no acceptable place.
    pub target: Target,
    /// Share of the way.
    pub coefficient: f64,
    /// When a move is accepted.
    pub acceptance: Acceptance,
}

/// Border faces of a star-shaped region, each positive with a point inside it.
#[derive(Debug, Clone, Default)]
pub struct Star {
    /// Corners (a, b, c) with (a, b, c, P) positive. 72 B / face.
    pub faces: Vec<[DVec3; 3]>,
    /// How the grades of the faces' tets count, in the order of `faces`; read by the search only. 16 B / face.
    pub weights: Vec<Weight>,
    grades: Vec<f64>,
}

impl Star {
    /// A star whose faces all count the same.
    #[cfg(test)]
    pub fn of_faces(faces: &[[DVec3; 3]], weight: Weight) -> Self {
        Self { faces: faces.to_vec(), weights: vec![weight; faces.len()], grades: Vec::new() }
    }

    /// Grade of the worst tet between the faces and `point`; stops early below `bound`.
    #[inline]
    pub fn grade<M: TetMeasure>(&self, measure: &M, point: DVec3, bound: f64) -> f64 {
        let mut worst = f64::INFINITY;
        for &[a, b, c] in &self.faces {
            worst = worst.min(measure.grade([a, b, c, point]));
            if worst <= bound {
                break;
            }
        }
        worst
    }

    /// As [`Star::grade`], with the grades of [`strict`] where they apply.
    #[inline]
    fn strict_grade<M: TetMeasure>(&self, measure: &M, point: DVec3, bound: f64) -> f64 {
        let mut worst = f64::INFINITY;
        for (&[a, b, c], weight) in self.faces.iter().zip(&self.weights) {
            let grade = measure.grade([a, b, c, point]);
            worst = worst.min(weight.of(grade));
            if worst <= bound {
                break;
            }
        }
        worst
    }

    /// The grade at `point`; the face of the worst tet becomes the first, so that trials which worsen it end at once.
    fn put_worst_first<M: TetMeasure>(&mut self, measure: &M, point: DVec3) -> f64 {
        let (mut worst, mut at) = (f64::INFINITY, 0);
        for (number, &[a, b, c]) in self.faces.iter().enumerate() {
            let grade = measure.grade([a, b, c, point]);
            if grade < worst {
                (worst, at) = (grade, number);
            }
        }
        if !self.faces.is_empty() {
            self.faces.swap(0, at);
        }
        worst
    }

    /// Whether every tet between the faces and `point` is positive, exactly.
    #[inline]
    pub fn is_visible_from(&self, point: DVec3) -> bool {
        self.faces.iter().all(|&[a, b, c]| orient3d(a, b, c, point) > 0.0)
    }

    fn target(&self, target: Target, at: DVec3) -> DVec3 {
        let mut sum = DVec3::ZERO;
        for &[a, b, c] in &self.faces {
            let centroid = (a + b + c) / 3.0;
            sum += match target {
                Target::Centroids => 0.75 * centroid + 0.25 * at,
                Target::OptimalPlacement => {
                    let mean_edge = (a.distance(b) + b.distance(c) + c.distance(a)) / 3.0;
                    // Inwards: (a, b, c, P) is positive, so the normal points to P.
                    let normal = (b - a).cross(c - a).normalize_or_zero();
                    centroid + EQUILATERAL_HEIGHT * mean_edge * normal
                }
            };
        }
        sum / self.faces.len() as f64
    }

    /// Climbs from `start` to a place where the worst tet is as good as the search can make it; returns the place and
    /// its grade, which is not below that of `start`.
    pub fn search<M: TetMeasure>(&mut self, measure: &M, start: DVec3) -> (DVec3, f64) {
        self.search_steps(measure, start, SEARCH_STEPS)
    }

    /// [`Star::search`] with at most so many steps.
    pub fn search_steps<M: TetMeasure>(&mut self, measure: &M, start: DVec3, steps: usize) -> (DVec3, f64) {
        let mut at = start;
        let mut step =
            0.2 * self.faces.iter().map(|[a, ..]| a.distance_squared(start)).fold(f64::INFINITY, f64::min).sqrt();
        let smallest = 1e-3 * step;
        let mut best = self.grades_at(measure, at);
        for _ in 0..steps {
            if step <= smallest {
                break;
            }
            let direction = self.ascent(measure, at, best, step);
            let mut improved = false;
            while step > smallest {
                let trial = at + step * direction;
                let grade = self.strict_grade(measure, trial, best);
                if grade > best {
                    at = trial;
                    improved = grade > best * 1.002 + 1e-6;
                    best = self.grades_at(measure, at);
                    step *= 1.6;
                    break;
                }
                step *= 0.5;
            }
            if !improved {
                break;
            }
        }
        (at, best)
    }

    fn grades_at<M: TetMeasure>(&mut self, measure: &M, point: DVec3) -> f64 {
        self.grades.clear();
        self.grades.extend(self.faces.iter().zip(&self.weights).map(|(&[a, b, c], weight)| {
            let grade = measure.grade([a, b, c, point]);
            weight.of(grade)
        }));
        self.grades.iter().copied().fold(f64::INFINITY, f64::min)
    }

    /// A direction in which all of the worst tets improve, as far as three rounds of correction find one.
    fn ascent<M: TetMeasure>(&self, measure: &M, at: DVec3, worst: f64, step: f64) -> DVec3 {
        const MOST: usize = 8;
        let limit = (ACTIVE_FACTOR * worst).max(worst + 0.01);
        let mut slopes = [DVec3::ZERO; MOST];
        let mut count = 0;
        let h = 1e-3 * step;
        for (&[a, b, c], grade) in self.faces.iter().zip(&self.grades) {
            if *grade > limit || count == MOST {
                continue;
            }
            slopes[count] = measure.slope([a, b, c, at], h).normalize_or_zero();
            count += 1;
        }
        let slopes = &slopes[..count];
        let mut direction = slopes.iter().sum::<DVec3>().normalize_or_zero();
        for _ in 0..4 {
            let against = slopes.iter().copied().min_by(|s, t| s.dot(direction).total_cmp(&t.dot(direction)));
            match against {
                // Towards the least-norm point of the slopes' hull: the direction that helps the most hindered most.
                Some(slope) if slope.dot(direction) < 0.3 => {
                    direction = (direction + (0.5 - slope.dot(direction)) * slope).normalize_or_zero();
                }
                _ => break,
            }
        }
        direction
    }
}

/// Buffers of one thread's smoothing.
#[derive(Debug, Clone, Default)]
pub struct Smoother {
    /// The star of the vertex at hand.
    pub star: Star,
    kernel: StarKernel,
    /// Whether searches also start from the deepest point of the ball's kernel.
    pub seeks_kernel: bool,
    ball: Vec<TetId>,
    /// The searches that led nowhere.
    pub failed: FailedAttempts,
}

impl Smoother {
    /// Claims the ball of a vertex that no constraint touches, and builds its star.
    fn gather<S: TetStore + ?Sized, M: TetMeasure>(&mut self, store: &mut S, vertex: VertexId, measure: &M) -> Outcome {
        if !store.try_claim(vertex) {
            return Outcome::ClaimLost;
        }
        let Some(start) = store.tet_of(vertex).some() else { return Outcome::NotApplicable };
        self.star.faces.clear();
        self.star.weights.clear();
        if !store.try_claim_all(&store.vertices(start)) {
            return Outcome::ClaimLost;
        }
        let mut walk = BallWalk::new(start, &mut self.ball);
        while let Some(tet) = walk.next() {
            let (row, neighbors) = (store.vertices(tet), store.neighbors(tet));
            let no_end = neighbors.iter().all(|side| *side != TetFace::NONE);
            let is_free = store.flags(tet).constraints() == TetFlags::LIVE && no_end;
            if has_ghost(row) || (!is_free && touches_constraint(store, tet, vertex)) {
                return Outcome::Constrained;
            }
            let local = store.local_vertex(tet, vertex).unwrap_or(0);
            let [i, j, k] = TET_FACES[local];
            let [a, b, c] = store.triangle([row[i], row[j], row[k]]);
            self.star.faces.push([a, c, b]);
            self.star.weights.push(measure.weight(&[row[i], row[j], row[k]]));
            for face in 0..4 {
                // The face's vertices are held, so that only the apex beyond is to be claimed.
                if face != local && neighbors[face] != TetFace::NONE && walk.meet(neighbors[face].tet()) {
                    let apex = store.apex(neighbors[face]);
                    if !store.try_claim(apex) {
                        return Outcome::ClaimLost;
                    }
                }
            }
        }
        Outcome::Accepted
    }

    /// Moves the vertex whose ball is held; what user bits say of the shapes of its tets is no longer so.
    fn move_to<S: TetStore + ?Sized>(&self, store: &mut S, vertex: VertexId, place: DVec3) {
        store.set_point(vertex, place);
        for &tet in &self.ball {
            store.set_flags(tet, store.flags(tet).without_user_bits());
        }
    }

    /// Whether the vertex whose ball is held keeps its distances at `place`; those it does not keep now get no worse.
    fn may_move<S: TetStore + ?Sized>(&self, store: &S, vertex: VertexId, place: DVec3, spacing: Spacing<'_>) -> bool {
        let at = store.point(vertex);
        let size = spacing.size_of(vertex);
        let keeps = |other: VertexId| {
            let point = store.point(other);
            let distance = point.distance_squared(place);
            let before = point.distance_squared(at);
            let is_far = spacing.holds(size, other, distance) || distance >= before;
            other == vertex || is_far && (spacing.reaches(size, other, distance) || distance <= before)
        };
        spacing.is_free() || self.ball.iter().all(|&tet| store.vertices(tet).into_iter().all(keeps))
    }

    /// Moves a vertex towards its target.
    pub fn smooth<S: TetStore + ?Sized, M: TetMeasure>(
        &mut self,
        store: &mut S,
        vertex: VertexId,
        measure: &M,
        rule: &SmoothingRule,
        spacing: Spacing<'_>,
    ) -> Outcome {
        let outcome = self.gather(store, vertex, measure);
        if outcome != Outcome::Accepted {
            return outcome;
        }
        let at = store.point(vertex);
        let bound = match rule.acceptance {
            Acceptance::Valid => 0.0,
            Acceptance::Smart => self.star.put_worst_first(measure, at) * LEAST_GAIN,
        };
        let other = match rule.target {
            Target::OptimalPlacement => Target::Centroids,
            Target::Centroids => Target::OptimalPlacement,
        };
        for target in [rule.target, other] {
            let goal = self.star.target(target, at);
            let mut share = rule.coefficient;
            for _ in 0..HALVINGS {
                let trial = at + share * (goal - at);
                let is_better = self.star.grade(measure, trial, bound) > bound;
                if is_better && self.may_move(store, vertex, trial, spacing) && self.star.is_visible_from(trial) {
                    self.move_to(store, vertex, trial);
                    return Outcome::Accepted;
                }
                share *= 0.5;
            }
        }
        Outcome::WorsensQuality
    }

    /// Moves a vertex to the best place that the search finds, if that is better; it does not search where it has failed.
    pub fn optimize<S: TetStore + ?Sized, M: TetMeasure>(
        &mut self,
        store: &mut S,
        vertex: VertexId,
        measure: &M,
        spacing: Spacing<'_>,
    ) -> Outcome {
        let outcome = self.gather(store, vertex, measure);
        if outcome != Outcome::Accepted {
            return outcome;
        }
        let at = store.point(vertex);
        let fingerprint = self.star.fingerprint::<M>(at, spacing);
        if self.failed.has(vertex, fingerprint) {
            return Outcome::WorsensQuality;
        }
        let before = self.star.strict_grade(measure, at, f64::NEG_INFINITY);
        let (mut place, mut after) = self.star.search(measure, at);
        if self.seeks_kernel
            && let Some(deepest) = self.kernel.deepest_point(&self.star.faces)
        {
            let (other, grade) = self.star.search(measure, deepest);
            if grade > after {
                (place, after) = (other, grade);
            }
        }
        let is_better = after > before * (1.0 + 1e-6);
        if is_better && self.may_move(store, vertex, place, spacing) && self.star.is_visible_from(place) {
            self.move_to(store, vertex, place);
            Outcome::Accepted
        } else {
            self.failed.add(vertex, fingerprint);
            Outcome::WorsensQuality
        }
    }
}
