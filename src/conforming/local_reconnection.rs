//! Local reconnection: the flips 2-3, 3-2 and 4-4 under an objective function, from element to element.
//!
//! # Method
//! 1. A face between two tets is considered once from each side that changed. If the edge between the two apexes
//!    crosses the face, the candidate is the flip 2-3; else the edge of the face that the crossing misses is removed,
//!    by 3-2 with three tets around it, by one of the two configurations of 4-4 with four.
//! 2. The objective function decides ([`Objective`]); exact orientation decides validity.
//! 3. The faces of new tets are considered in turn, until nothing changes or the budget of the pass is used up.
//!
//! # Source
//! [Drakopoulos2017] 4.7 (connectivity optimization, figures 68 and 69), B.3 `mrecm`, `mrec4`, `mrec4q`.
//!
//! # Differences
//! The in-sphere pass follows each insertion at once, while its tets are in the cache, instead of after all of them;
//! the second objective runs as a pass of its own over the tets that changed.
//!
//! # Invariants
//! Generic over the store: alone it runs to the end, under claims an attempt that loses a claim changes nothing and is
//! counted. The in-sphere flips strictly lower the lifted surface, so they end; the other objectives are cut off by the
//! budget.
//!
//! # Cost
//! About a microsecond a flip; no allocation once the buffers have grown.

use crate::conforming::cavity_insertion::CavityScratch;
use crate::conforming::flip_criteria::{MaxAngle, TetMeasure, min_edge_weight};
use crate::conforming::flips::{FlipScratch, Outcome, collect_ring, commit};
use crate::error::Result;
use crate::geometry::predicates::{insphere, orient3d};
use crate::geometry::tetrahedron::exceeds_angle;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::tet_store::{TetStore, has_ghost};
use crate::mesh::topology::ShellTet;

/// What a reconnection has to improve.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Objective {
    /// Empty circumspheres.
    InSphere,
    /// The smallest Laplacian edge weight grows.
    EdgeWeight,
    /// The largest dihedral angle shrinks.
    Skew,
}

/// Which four-tet configurations are tried.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FourFour {
    /// None, except the degenerate flips that the in-sphere objective needs.
    Off,
    /// The first that improves.
    First,
    /// The better of the two.
    Best,
}

/// How often what was tried came to what.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct FlipCounts {
    /// Faces considered.
    pub tried: u64,
    /// Flips carried out.
    pub accepted: u64,
    /// Attempts given up because another thread held a vertex.
    pub lost: u64,
}

impl FlipCounts {
    /// Adds the counts of another thread or pass.
    pub fn add(&mut self, other: Self) {
        self.tried += other.tried;
        self.accepted += other.accepted;
        self.lost += other.lost;
    }
}

/// What one thread needs to reconnect: buffers, new tets, counts.
#[derive(Debug, Clone, Default)]
pub struct Reconnector {
    /// Buffers of the flips.
    pub scratch: FlipScratch,
    /// Buffers of insertion.
    pub cavity: CavityScratch,
    /// Tets created since the list was last taken; some may be gone again.
    pub fresh: Vec<TetId>,
    /// Counts of this thread.
    pub counts: FlipCounts,
    /// Faces whose attempt lost a claim, to be tried again.
    pub lost: Vec<TetFace>,
    /// The user bit of tets that objectives other than empty circumspheres leave alone.
    pub spared: Option<usize>,
    stack: Vec<TetFace>,
}

/// Cosine of the angle (105 degrees) above which a tet is considered for the second objective: tets without a large angle
/// have little to gain, and leaving them out saves most of the attempts.
const LARGE_ANGLE_COSINE: f64 = -0.258_8;

/// Relative gain below which the edge weight counts as equal: no flip back and forth.
const WEIGHT_GAIN: f64 = 1e-9;

impl Reconnector {
    /// Commits the plan and lists the new tets; false, with nothing changed, where the store has no room.
    ///
    /// # Errors
    /// As [`commit`].
    pub fn commit<S: TetStore + ?Sized>(&mut self, store: &mut S) -> Result<bool> {
        if !store.has_room(self.scratch.plan.new.len()) {
            return Ok(false);
        }
        commit(store, &mut self.scratch)?;
        self.fresh.extend_from_slice(&self.scratch.created);
        self.counts.accepted += 1;
        Ok(true)
    }

    /// Commits the insertion planned in `cavity`; false, with nothing changed, where the store has no room.
    ///
    /// # Errors
    /// As [`commit`].
    pub fn commit_cavity<S: TetStore + ?Sized>(&mut self, store: &mut S, vertex: VertexId) -> Result<bool> {
        if !store.has_room(self.cavity.created()) {
            return Ok(false);
        }
        self.cavity.commit(store, vertex, &mut self.fresh)?;
        self.counts.accepted += 1;
        Ok(true)
    }

    /// Restores empty circumspheres after `vertex` was inserted by the last commit: considers the faces opposite to it.
    ///
    /// # Errors
    /// As [`commit`].
    pub fn reconnect_around<S: TetStore + ?Sized>(&mut self, store: &mut S, vertex: VertexId) -> Result<()> {
        self.stack.clear();
        self.push_opposite(store, vertex);
        while let Some(side) = self.stack.pop() {
            if store.vertices(side.tet())[side.face()] != vertex {
                continue;
            }
            match self.reconnect_face(store, side, Objective::InSphere, FourFour::Off)? {
                Outcome::Accepted => self.push_opposite(store, vertex),
                Outcome::ClaimLost => self.lost.push(side),
                _ => {}
            }
            store.release_claims();
        }
        Ok(())
    }

    fn push_opposite<S: TetStore + ?Sized>(&mut self, store: &S, vertex: VertexId) {
        for &tet in &self.scratch.created {
            if let Some(local) = store.local_vertex(tet, vertex) {
                self.stack.push(TetFace::new(tet, local));
            }
        }
    }

    /// Reconnects from the faces of `tet` on until nothing changes or `budget` flips are made; returns the flips made.
    ///
    /// # Errors
    /// As [`commit`].
    pub fn reconnect_from<S: TetStore + ?Sized>(
        &mut self,
        store: &mut S,
        tet: TetId,
        objective: Objective,
        four: FourFour,
        budget: usize,
    ) -> Result<usize> {
        self.stack.clear();
        if !may_gain(store, tet, objective) {
            return Ok(0);
        }
        self.stack.extend((0..4).map(|face| TetFace::new(tet, face)));
        let mut flips = 0;
        while let Some(side) = self.stack.pop() {
            match self.reconnect_face(store, side, objective, four)? {
                Outcome::Accepted => {
                    flips += 1;
                    if flips < budget {
                        let created = self.scratch.created.iter().filter(|&&t| may_gain(store, t, objective));
                        self.stack.extend(created.flat_map(|&t| (0..4).map(move |f| TetFace::new(t, f))));
                    }
                }
                Outcome::ClaimLost => self.lost.push(side),
                _ => {}
            }
            store.release_claims();
        }
        Ok(flips)
    }

    /// Considers one face; carries out the flip that the objective wants, if any.
    ///
    /// # Errors
    /// As [`commit`].
    pub fn reconnect_face<S: TetStore + ?Sized>(
        &mut self,
        store: &mut S,
        side: TetFace,
        objective: Objective,
        four: FourFour,
    ) -> Result<Outcome> {
        self.counts.tried += 1;
        let mut outcome = self.plan_face(store, side, objective, four);
        if let (Outcome::Accepted, Some(bit)) = (outcome, self.spared.filter(|_| objective != Objective::InSphere))
            && self.scratch.plan.old.iter().any(|&tet| store.flags(tet).has_user_bit(bit))
        {
            outcome = Outcome::Constrained;
        }
        if outcome == Outcome::Accepted && !self.commit(store)? {
            outcome = Outcome::ClaimLost; // to be finished when there is room again
        }
        self.counts.lost += u64::from(outcome == Outcome::ClaimLost);
        Ok(outcome)
    }

    fn plan_face<S: TetStore + ?Sized>(
        &mut self,
        store: &mut S,
        side: TetFace,
        objective: Objective,
        four: FourFour,
    ) -> Outcome {
        let tet = side.tet();
        let row = store.vertices(tet);
        if row[0] == row[1] || has_ghost(row) {
            return Outcome::NotApplicable;
        }
        if !store.try_claim_tet(tet) {
            return Outcome::ClaimLost;
        }
        let other = store.neighbor(side);
        if other == TetFace::NONE || store.is_face_constrained(side) || store.label(tet) != store.label(other.tet()) {
            return Outcome::Constrained;
        }
        let below = store.apex(other);
        if below.is_ghost() {
            return Outcome::Constrained;
        }
        if !store.try_claim(below) {
            return Outcome::ClaimLost;
        }
        let above = row[side.face()];
        let corners = store.face_vertices(side);
        let [a, b, c] = store.triangle(corners);
        let (p, e) = (store.point(above), store.point(below));
        if objective == Objective::InSphere && insphere(a, c, b, p, e) <= 0.0 {
            return Outcome::WorsensQuality;
        }
        let signs = [orient3d(a, b, p, e), orient3d(b, c, p, e), orient3d(c, a, p, e)];
        if signs.iter().all(|s| *s > 0.0) {
            self.plan_23(store, side, other, objective)
        } else {
            self.plan_around_edges(store, side, signs, objective, four)
        }
    }

    fn plan_23<S: TetStore + ?Sized>(
        &mut self,
        store: &S,
        side: TetFace,
        other: TetFace,
        objective: Objective,
    ) -> Outcome {
        let (above, below) = (store.apex(side), store.apex(other));
        let [a, b, c] = store.face_vertices(side);
        let plan = &mut self.scratch.plan;
        plan.reset(store.label(side.tet()));
        plan.old.extend([side.tet(), other.tet()]);
        plan.new.extend([[a, b, above, below], [b, c, above, below], [c, a, above, below]]);
        let old = [store.vertices(side.tet()), store.vertices(other.tet())];
        improves(store, objective, &old, &plan.new)
    }

    fn plan_around_edges<S: TetStore + ?Sized>(
        &mut self,
        store: &mut S,
        side: TetFace,
        signs: [f64; 3],
        objective: Objective,
        four: FourFour,
    ) -> Outcome {
        let tet = side.tet();
        let row = store.vertices(tet);
        let corners = store.face_vertices(side);
        let apex = row[side.face()];
        let mut last = Outcome::WouldInvert;
        for edge in 0..3 {
            if signs[edge] > 0.0 {
                continue;
            }
            let place = |v: VertexId| row.iter().position(|w| *w == v).unwrap_or(0);
            let (a, b) = (place(corners[edge]), place(corners[(edge + 1) % 3]));
            last = collect_ring(store, ShellTet::new(tet, a, b), 4, &mut self.scratch);
            if last != Outcome::Accepted {
                if last == Outcome::ClaimLost {
                    return last;
                }
                continue;
            }
            if self.scratch.ring.iter().any(|v| v.is_ghost()) {
                last = Outcome::Constrained;
                continue;
            }
            let degenerate = objective == Objective::InSphere && signs[edge] == 0.0;
            last = match self.scratch.ring.len() {
                3 => self.plan_ring(store, [row[a], row[b]], &[0], objective),
                4 if degenerate => {
                    // The new edge joins the two apexes of the face.
                    let at = self.scratch.ring.iter().position(|v| *v == apex).unwrap_or(0);
                    self.plan_ring(store, [row[a], row[b]], &[at % 2], objective)
                }
                4 if objective == Objective::InSphere || four == FourFour::Off => Outcome::NotApplicable,
                4 => self.plan_best_of_two(store, [row[a], row[b]], objective, four),
                _ => Outcome::NotApplicable,
            };
            if last == Outcome::Accepted {
                return last;
            }
        }
        last
    }

    fn plan_best_of_two<S: TetStore + ?Sized>(
        &mut self,
        store: &S,
        ends: [VertexId; 2],
        objective: Objective,
        four: FourFour,
    ) -> Outcome {
        let order: &[usize] = if four == FourFour::First || objective == Objective::InSphere { &[0] } else { &[0, 1] };
        match self.plan_ring(store, ends, order, objective) {
            Outcome::Accepted => Outcome::Accepted,
            _ if order.len() == 1 => self.plan_ring(store, ends, &[1], objective),
            other => other,
        }
    }

    /// Plans the removal of the edge `ends` whose shell and ring (three or four vertices) are in the scratch. With four,
    /// `diagonals` lists the configurations to compare: number d joins the ring's vertices d and d + 2.
    fn plan_ring<S: TetStore + ?Sized>(
        &mut self,
        store: &S,
        [a, b]: [VertexId; 2],
        diagonals: &[usize],
        objective: Objective,
    ) -> Outcome {
        let FlipScratch { plan, ring, shell, .. } = &mut self.scratch;
        let mut old = [[VertexId::GHOST; 4]; 4];
        plan.old.clear();
        for (row, tet) in old.iter_mut().zip(shell.iter()) {
            *row = store.vertices(tet.tet);
            plan.old.push(tet.tet);
        }
        let old = &old[..ring.len()];
        let fan = |i: usize, j: usize, k: usize| {
            let n = ring.len();
            let (r, s, t) = (ring[i % n], ring[j % n], ring[k % n]);
            [[r, s, t, b], [r, t, s, a]]
        };
        let mut best: Option<(f64, usize)> = None;
        let before = grade(store, objective, old);
        for &d in diagonals {
            plan.new.clear();
            plan.new.extend(fan(d, d + 1, d + 2));
            if ring.len() == 4 {
                plan.new.extend(fan(d + 2, d + 3, d));
            }
            if !plan.is_positive(store) {
                continue;
            }
            let after = grade(store, objective, &plan.new);
            if is_gain(objective, before, after) && best.is_none_or(|(g, _)| after > g) {
                best = Some((after, d));
            }
        }
        let Some((_, d)) = best else { return Outcome::WorsensQuality };
        plan.new.clear();
        plan.new.extend(fan(d, d + 1, d + 2));
        if ring.len() == 4 {
            plan.new.extend(fan(d + 2, d + 3, d));
        }
        Outcome::Accepted
    }
}

/// Whether a tet is worth a look: those without a large angle gain nothing from the second objective.
fn may_gain<S: TetStore + ?Sized>(store: &S, tet: TetId, objective: Objective) -> bool {
    let row = store.vertices(tet);
    let is_gone = row[0] == row[1] || has_ghost(row);
    !is_gone && (objective == Objective::InSphere || exceeds_angle(store.corners(row), LARGE_ANGLE_COSINE))
}

/// How good a configuration is; higher is better.
fn grade<S: TetStore + ?Sized>(store: &S, objective: Objective, tets: &[[VertexId; 4]]) -> f64 {
    match objective {
        Objective::InSphere => 0.0,
        Objective::EdgeWeight => min_edge_weight(store, tets),
        Objective::Skew => tets.iter().map(|t| MaxAngle.grade(store.corners(*t))).fold(f64::INFINITY, f64::min),
    }
}

fn is_gain(objective: Objective, before: f64, after: f64) -> bool {
    // For in-spheres the test was made before the plan.
    objective == Objective::InSphere || after > before + WEIGHT_GAIN * before.abs()
}

/// Whether valid new tets are better than the old ones.
fn improves<S: TetStore + ?Sized>(
    store: &S,
    objective: Objective,
    old: &[[VertexId; 4]],
    new: &[[VertexId; 4]],
) -> Outcome {
    if is_gain(objective, grade(store, objective, old), grade(store, objective, new)) {
        Outcome::Accepted
    } else {
        Outcome::WorsensQuality
    }
}
