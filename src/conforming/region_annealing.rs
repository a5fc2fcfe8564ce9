//! Simulated annealing of a small region, for the sake of tets that may not stay: operations at random, worse ones too.
//!
//! # Method
//! 1. A tet that is beyond what may stay is chosen, or one near it, or any; one of its faces, edges or vertices gets an
//!    operation: flip 2-3, removal of an edge, a move, a contraction or an insertion.
//! 2. The operation is carried out where what its tets cost falls, or grows by less than chance and the temperature allow.
//! 3. The temperature falls; the state with the fewest such tets, and the least cost among these, is kept, or the last one
//!    where none had fewer than the first.
//!
//! A tet off the boundary beyond the demanded angles costs most; one at the boundary little, with the logarithm of its grade: it
//! only has to stay valid. Where slivers are to go ([`Aim::FewerBad`]), those cost as much.
//!
//! # Source
//! [KirkpatrickGelattVecchi1983].
//!
//! # Invariants
//! Every state is valid: constraints and the border of the region are kept, tets are positive by exact arithmetic.
//!
//! # Cost
//! Some microseconds a step, so up to half a second a region: for the last tets that nothing else betters. One thread;
//! deterministic.

use glam::DVec3;

use super::flip_criteria::{BiasedSine, Relief, StrictInside, TetMeasure};
use super::flips::{
    Accept, Feature, FlipScratch, Outcome, commit, plan_23, plan_contraction, plan_edge_removal, plan_insertion,
    touches_constraint,
};
use super::forced_slivers::sliver_cosine;
use super::region_search::{Aim, grade_off_boundary};
use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::predicates::orient3d;
use crate::geometry::spatial_sort::mix;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::{TET_EDGES, TET_FACES};
use crate::mesh::quality::SLIVER_DEGREES;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;
use crate::mesh::topology::{ShellTet, collect_ball};

/// Operations tried.
const STEPS: usize = 200_000;
/// Temperatures at the beginning, in turns, and at the end: a tet beyond the angles costs one and more. Of seven of Chazelle's
/// polyhedra where 0.6 leaves a tet, 2 and 6 help on two to three each, not the same ones.
const HOTTEST: [f64; 3] = [2.0, 0.6, 6.0];
/// The same where slivers are to go: as few are left as with the ones above, in a sixth less time on two surfaces.
const HOTTEST_FOR_SLIVERS: [f64; HOTTEST.len()] = [0.3, 0.6, 1.2];
const COLDEST: f64 = 0.02;
/// Steps between two looks for the tets beyond the angles.
const LOOK_INTERVAL: usize = 64;
/// Most tets around an edge that is removed.
const EDGE_LIMIT: usize = 8;
/// Tets of this grade, that of 15 degrees, lack nothing.
const LACKING: f64 = 0.26;
/// What a tet at the boundary costs, or one off it within the angles, for each factor of e that its grade is lower.
const COST_OF_LACK: [f64; 2] = [0.03, 0.2];
/// What a point costs beside its tets.
const COST_OF_POINT: f64 = 0.3;
/// What the words that are mixed differ by, odd and of about as many ones as zeros: the golden ratio's, as SplitMix64 has it.
const STRIDE: u64 = 0x9e37_79b9_7f4a_7c15;
/// Shares of the way to a tet of the ball that a vertex moves at most.
const MOVES: [f64; 4] = [0.05, 0.2, 0.5, 1.0];

/// What a region is annealed for, and what it keeps.
#[derive(Debug, Clone, Copy)]
pub struct Annealing<'a> {
    /// Whether slivers at the boundary are beyond what may stay.
    pub aim: Aim,
    /// Which vertices lie on the boundary; those beyond the end do not.
    pub on_boundary: &'a [bool],
}

impl Annealing<'_> {
    fn is_on_boundary(&self, vertex: VertexId) -> bool {
        self.on_boundary.get(vertex.index()).copied().unwrap_or(false)
    }

    /// The grade that a tet would need to stay, where it has less.
    fn limit_beyond(&self, row: &[VertexId; 4], corners: [DVec3; 4]) -> Option<f64> {
        let is_off = !row.iter().any(|v| self.is_on_boundary(*v));
        let limit = if is_off { grade_off_boundary() } else { SLIVER_DEGREES.to_radians().sin() };
        let may_be_beyond = (is_off || self.aim == Aim::FewerBad) && BiasedSine.grade(corners) < limit;
        // Large angles weigh more in the grade: not all of so low a grade are slivers. Those that walls force count too, so
        // that no others come on the same walls.
        (may_be_beyond && (is_off || sliver_cosine(corners).is_some())).then_some(limit)
    }
}

/// What tets cost, and how many of them are beyond the demanded angles.
#[derive(Debug, Clone, Copy, Default, PartialEq, PartialOrd)]
struct Cost {
    beyond: i32,
    cost: f64,
}

impl Cost {
    fn add(&mut self, other: Self) {
        self.beyond += other.beyond;
        self.cost += other.cost;
    }

    fn subtract(&mut self, other: Self) {
        self.beyond -= other.beyond;
        self.cost -= other.cost;
    }
}

/// The region as it is at a step.
struct State<'a> {
    complex: &'a mut TetComplex,
    sizes: &'a mut Vec<f64>,
    annealing: &'a Annealing<'a>,
    temperature: f64,
    /// A vertex without tets, for an insertion.
    spare: Option<VertexId>,
}

impl State<'_> {
    fn cost(&self, row: [VertexId; 4]) -> Cost {
        let corners = self.complex.corners(row);
        let grade = BiasedSine.grade(corners).max(f64::MIN_POSITIVE);
        if let Some(limit) = self.annealing.limit_beyond(&row, corners) {
            return Cost { beyond: 1, cost: 1.0 + (limit / grade).ln() };
        }
        let [at_boundary, off_boundary] = COST_OF_LACK;
        let is_at_boundary = row.iter().any(|v| self.annealing.is_on_boundary(*v));
        let share = if is_at_boundary { at_boundary } else { off_boundary };
        Cost { beyond: 0, cost: share * (LACKING / grade).ln().max(0.0) }
    }

    fn sum(&self, tets: impl Iterator<Item = TetId>) -> Cost {
        let mut sum = Cost::default();
        tets.for_each(|tet| sum.add(self.cost(self.complex.vertices(tet))));
        sum
    }
}

/// Anneals regions.
#[derive(Default)]
pub struct Annealer {
    flips: FlipScratch,
    ball: Vec<TetId>,
    /// The tets beyond the angles, at the last look.
    beyond: Vec<TetId>,
    /// Random numbers drawn so far.
    drawn: u64,
    /// Regions annealed so far.
    count: usize,
}

impl Annealer {
    fn next_random(&mut self, below: usize) -> usize {
        self.drawn += 1;
        (mix(self.drawn.wrapping_mul(STRIDE)) >> 33) as usize % below
    }

    fn random_share(&mut self) -> f64 {
        self.next_random(1 << 24) as f64 / f64::from(1 << 24)
    }

    /// Whether chance allows what costs so much.
    fn allows(&mut self, cost: f64, temperature: f64) -> bool {
        cost <= 0.0 || self.random_share() < (-cost / temperature).exp()
    }

    /// Leaves the best state on the way, or the last, where none has fewer tets beyond what may stay than the first. Beyond
    /// the border of the region there is nothing; `sizes` grows with the vertices.
    ///
    /// # Errors
    /// [`crate::error::Error::Cancelled`], or what the store refuses.
    pub fn anneal(
        &mut self,
        complex: &mut TetComplex,
        sizes: &mut Vec<f64>,
        annealing: &Annealing,
        context: &RunContext,
    ) -> Result<()> {
        let hottest = match annealing.aim {
            Aim::OffBoundary => HOTTEST,
            Aim::FewerBad => HOTTEST_FOR_SLIVERS,
        }[self.count % HOTTEST.len()];
        self.count += 1;
        let mut state = State { complex, sizes, annealing, temperature: hottest, spare: None };
        let start = state.sum(state.complex.finite_tets());
        let mut now = start;
        let mut best = (now, state.complex.clone(), state.sizes.clone());
        let cooling = (COLDEST / hottest).powf(1.0 / STEPS as f64);
        for step in 0..STEPS {
            if step % LOOK_INTERVAL == 0 {
                context.check()?;
                let is_beyond = |tet: &TetId| state.cost(state.complex.vertices(*tet)).beyond > 0;
                self.beyond.clear();
                self.beyond.extend(state.complex.finite_tets().filter(is_beyond));
            }
            // Costs are compared now and then only: the region is copied for the best.
            if now.beyond < best.0.beyond || step % LOOK_INTERVAL == 0 && now < best.0 {
                best = (now, state.complex.clone(), state.sizes.clone());
                if now.beyond == 0 {
                    break;
                }
            }
            state.temperature *= cooling;
            let tet = self.choose(&state);
            now.add(self.step(&mut state, tet)?);
        }
        // The last state is as cold as the best, and elsewhere: who anneals again does not begin where that led nowhere.
        if best.0.beyond < start.beyond || now.beyond > start.beyond {
            (*state.complex, *state.sizes) = (best.1, best.2);
        }
        Ok(())
    }

    /// A tet beyond the angles or up to three faces from it, or any.
    fn choose(&mut self, state: &State) -> TetId {
        if !self.beyond.is_empty() && self.next_random(3) > 0 {
            let number = self.next_random(self.beyond.len());
            let mut tet = self.beyond[number];
            if state.complex.is_live(tet) {
                for _ in 0..self.next_random(4) {
                    let side = state.complex.neighbor(TetFace::new(tet, self.next_random(4)));
                    tet = if side == TetFace::NONE { tet } else { side.tet() };
                }
                return tet;
            }
        }
        loop {
            let tet = TetId::from_index(self.next_random(state.complex.slot_count()));
            if state.complex.is_live(tet) {
                return tet;
            }
        }
    }

    /// Tries one operation at a tet; what the region costs more then.
    fn step(&mut self, state: &mut State, tet: TetId) -> Result<Cost> {
        let measure =
            StrictInside { angles: BiasedSine, on_boundary: state.annealing.on_boundary, relief: Relief::Boundary };
        let mut cost_of_points = 0.0;
        let kind = self.next_random(16);
        let outcome = match kind {
            0..4 => {
                let side = TetFace::new(tet, self.next_random(4));
                plan_23(state.complex, side, &measure, Accept::Valid, &mut self.flips)
            }
            4..9 => {
                let [a, b] = TET_EDGES[self.next_random(6)];
                let start = ShellTet::new(tet, a, b);
                plan_edge_removal(state.complex, start, EDGE_LIMIT, &measure, Accept::Valid, &mut self.flips)
            }
            9..14 => return Ok(self.move_vertex(state, tet)),
            14 => {
                let row = state.complex.vertices(tet);
                let from = self.next_random(4);
                let to = (from + 1 + self.next_random(3)) % 4;
                cost_of_points = -COST_OF_POINT;
                plan_contraction(state.complex, row[from], row[to], &measure, Accept::Valid, &mut self.flips)
            }
            _ => {
                cost_of_points = COST_OF_POINT;
                self.plan_point(state, tet)?
            }
        };
        if outcome != Outcome::Accepted {
            return Ok(Cost::default());
        }
        let mut change = Cost::default();
        self.flips.plan.new.iter().for_each(|row| change.add(state.cost(*row)));
        change.subtract(state.sum(self.flips.plan.old.iter().copied()));
        if !self.allows(change.cost + cost_of_points, state.temperature) {
            return Ok(Cost::default());
        }
        commit(state.complex, &mut self.flips)?;
        if kind == 15 {
            state.spare = None;
        }
        Ok(change)
    }

    /// Plans a point in the middle of an edge, a face or the tet.
    fn plan_point(&mut self, state: &mut State, tet: TetId) -> Result<Outcome> {
        let (edge, face) = (TET_EDGES[self.next_random(6)], self.next_random(4));
        let (feature, locals): (Feature, &[usize]) = match self.next_random(3) {
            0 => (Feature::Edge(tet, edge[0], edge[1]), &edge),
            1 => (Feature::Face(TetFace::new(tet, face)), &TET_FACES[face]),
            _ => (Feature::Tet(tet), &[0, 1, 2, 3]),
        };
        let row = state.complex.vertices(tet);
        let place = locals.iter().map(|&i| state.complex.point(row[i])).sum::<DVec3>() / locals.len() as f64;
        let size = locals.iter().map(|&i| state.sizes[row[i].index()]).sum::<f64>() / locals.len() as f64;
        let vertex = match state.spare {
            Some(vertex) => vertex,
            None => {
                state.sizes.push(size);
                state.complex.push_point(place)?
            }
        };
        state.spare = Some(vertex);
        state.complex.set_point(vertex, place);
        state.sizes[vertex.index()] = size;
        Ok(plan_insertion(state.complex, feature, vertex, &BiasedSine, &mut self.flips))
    }

    /// Tries to move a vertex of the tet; what the region costs more then.
    fn move_vertex(&mut self, state: &mut State, tet: TetId) -> Cost {
        let vertex = state.complex.vertices(tet)[self.next_random(4)];
        let mut ball = std::mem::take(&mut self.ball);
        collect_ball(state.complex, vertex, tet, &mut ball);
        let is_held = ball.iter().any(|&t| touches_constraint(state.complex, t, vertex));
        let change = if is_held || state.annealing.is_on_boundary(vertex) {
            Cost::default()
        } else {
            self.shift(state, vertex, &ball)
        };
        self.ball = ball;
        change
    }

    fn shift(&mut self, state: &mut State, vertex: VertexId, ball: &[TetId]) -> Cost {
        let before = state.complex.point(vertex);
        // Towards a tet of the ball: flat balls are left along their long sides.
        let center = state.complex.points_of(ball[self.next_random(ball.len())]).iter().sum::<DVec3>() / 4.0;
        let share = MOVES[self.next_random(MOVES.len())] * (2.0 * self.random_share() - 0.7);
        let old = state.sum(ball.iter().copied());
        state.complex.set_point(vertex, before + share * (center - before));
        let is_positive = |&tet: &TetId| {
            let [a, b, c, d] = state.complex.points_of(tet);
            orient3d(a, b, c, d) > 0.0
        };
        if ball.iter().all(is_positive) {
            let mut change = state.sum(ball.iter().copied());
            change.subtract(old);
            if self.allows(change.cost, state.temperature) {
                return change;
            }
        }
        state.complex.set_point(vertex, before);
        Cost::default()
    }
}
