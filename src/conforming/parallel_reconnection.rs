//! Drives insertions, reconnections and improvements over many tets: alone, or speculatively on several threads.
//!
//! # Method
//! 1. A pass is a list of items (vertices to insert, tets to reconnect or improve, vertices to smooth) and a job, which
//!    is written once for any store.
//! 2. With one thread the items are worked off in order on the complex itself.
//! 3. With several, the complex is shared under claims ([`crate::mesh::claimed_tets`]); items are cut into buckets that
//!    threads hand over ([`crate::parallel::speculative`]). An attempt that loses a claim changes nothing and is tried
//!    again, in the end alone. Faces whose flip lost a claim in the middle of a cascade are finished by one thread.
//!
//! # Source
//! [Drakopoulos2017] 4.8; B.3 `nthreads`, `nthreadsq`, `nbuckets`, `nbucketsq`, `frbtransf`, `cbtransf`, `frbtransfq`,
//! `cbtransfq`, `sortp`, `sortpq`.
//!
//! # Differences
//! Insertion, deactivation, creation and sorting are parallel too, which the thesis leaves sequential.
//!
//! # Invariants
//! The mesh is valid after every pass at any thread count. With one thread the result is always the same.
//!
//! # Limits
//! A claimed store has room for a given number of new tets; items without room are worked off in another round.

mod edge_splitting;
mod tet_treatment;

use edge_splitting::SplitJob;
pub use edge_splitting::longest_excess;
use tet_treatment::TreatJob;
pub use tet_treatment::{Crowding, FLAT_BELOW, LONGEST, Lengths, SPACING, Treatment, count_of_bad};

use rayon::prelude::*;

use super::edge_lengths::LengthScratch;
use super::failed_attempts::{FailedAttempts, FailedTets};
use super::flip_criteria::{BiasedSine, StrictInside, UnskewedSine};
use super::flips::{Accept, Outcome, plan_contraction};
use super::front::UNSETTLED;
use super::local_reconnection::{FlipCounts, FourFour, Objective, Reconnector};
use super::options::Options;
use super::sliver_removal::SliverScratch;
use super::small_polyhedron::PolyhedronScratch;
use super::smoothing::{Smoother, SmoothingRule};
use super::spacing::Spacing;
use super::vertex_insertion::{Insertion, InsertionRule, insert_vertex};
use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::tetrahedron::dihedral_cosines;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::claimed_tets::{ClaimedTets, with_claims};
use crate::mesh::numbering::TET_EDGES;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;
use crate::parallel::claim_table::ClaimTable;
use crate::parallel::speculative::{Attempt, SpeculativeCounts, Worker, run_speculative};
use crate::parallel::work_queue::WorkSettings;
use crate::statistics::Statistics;

/// A vertex to insert and where to walk from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Insert {
    /// The vertex; its point and clearance are set.
    pub vertex: VertexId,
    /// A tet near its point.
    pub start: TetId,
    /// A vertex of that tet: where the walk starts when the tet is gone.
    pub near: VertexId,
}

/// A vertex that was not inserted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rejected {
    /// The vertex.
    pub vertex: VertexId,
    /// Whether the walk to its point failed, or something stood in the way; else another vertex is too close.
    pub unreached: bool,
}

/// The user bit of tets without short edges, see [`Driver::collapse_small_edges`].
pub const LONG: usize = 2;

/// Most flips that one tet may set off in a pass.
const BUDGET: usize = 64;
/// Room that one attempt may need: the tets of the largest cavity.
const ATTEMPT_ROOM: usize = 256;
/// New tets per inserted vertex, with what is in flight.
const TETS_PER_INSERT: usize = 9;
/// Passes with fewer items run on one thread: sharing would cost more than it brings.
const MIN_PARALLEL: usize = 128;
/// Meshes with fewer tets are made by one thread: they take a second or two, and by how much their counts differ from run to
/// run on several threads, up to a twelfth, would be seen.
const MIN_SHARED_TETS: usize = 8192;
/// An insertion round is shared where the cavities of all threads, as large as those of the round before, take less than
/// this part of the mesh: rounds grow by eight and cavities shrink as much.
const MEETING: usize = 16;
/// Items between two looks at cancellation.
const CHECK_INTERVAL: usize = 256;
/// Rounds for items that found no room.
const ROOM_ROUNDS: usize = 8;

/// What one thread needs and finds.
#[derive(Debug, Clone, Default)]
struct Kit {
    reconnector: Reconnector,
    smoother: Smoother,
    /// The removals of vertices that failed, by the searches that failed before.
    failed_removals: FailedAttempts,
    /// The tets where all was in vain.
    failed_tets: FailedTets,
    ball: Vec<TetId>,
    slivers: SliverScratch,
    polyhedra: PolyhedronScratch,
    lengths: LengthScratch,
    rejected: Vec<Rejected>,
    /// Vertices without tets that sliver removal may use.
    spare: Vec<VertexId>,
    /// Sizes of the vertices taken from `spare`.
    new_sizes: Vec<(VertexId, f64)>,
    removed: Vec<VertexId>,
    /// Vertices that smoothing moved.
    moved: Vec<VertexId>,
    /// What treatments changed.
    touched: Touched,
    tally: Tally,
}

/// The vertices at which treatments changed something; some several times.
#[derive(Debug, Clone, Default)]
pub struct Touched {
    /// Vertices of new tets.
    pub made: Vec<VertexId>,
    /// Vertices that were moved.
    pub moved: Vec<VertexId>,
}

impl Touched {
    /// Whether nothing was changed.
    pub fn is_empty(&self) -> bool {
        self.made.is_empty() && self.moved.is_empty()
    }

    /// Adds another list.
    pub fn append(&mut self, mut other: Self) {
        self.made.append(&mut other.made);
        self.moved.append(&mut other.moved);
    }
}

/// Counts of a driver.
#[derive(Debug, Clone, Copy, Default)]
struct Tally {
    done: u64,
    collapsed: u64,
    smoothed: u64,
    removed: u64,
    /// Insertions tried.
    tried: u64,
    inserted: u64,
    /// Polyhedra tried to reconnect, and reconnected.
    polyhedra: [u64; 2],
}

/// Counts of the points that treatments tried, inserted and removed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct VertexChanges {
    /// Insertions tried.
    pub tried: u64,
    /// Points inserted.
    pub inserted: u64,
    /// Vertices removed.
    pub removed: u64,
}

/// Work on one item, for any store; no claim is held before and after.
trait Job: Sync {
    type Item: Send + Copy;

    fn attempt<S: TetStore>(&self, store: &mut S, kit: &mut Kit, item: Self::Item) -> Result<Attempt>;
}

struct InsertJob<'a> {
    clearances: &'a [f64],
    rule: &'a InsertionRule,
}

impl Job for InsertJob<'_> {
    type Item = Insert;

    fn attempt<S: TetStore>(&self, store: &mut S, kit: &mut Kit, item: Insert) -> Result<Attempt> {
        // The slot may hold another tet by now, anywhere.
        let is_there = store.vertices(item.start).contains(&item.near);
        let start = if is_there { item.start } else { store.tet_of(item.near) };
        let point = store.point(item.vertex);
        let reconnector = &mut kit.reconnector;
        match insert_vertex(store, self.clearances, item.vertex, point, start, self.rule, reconnector)? {
            Insertion::Inserted => {}
            Insertion::ClaimLost => return Ok(Attempt::ClaimLost),
            Insertion::NoRoom => return Ok(Attempt::NoRoom),
            Insertion::TooClose => kit.rejected.push(Rejected { vertex: item.vertex, unreached: false }),
            Insertion::Outside => kit.rejected.push(Rejected { vertex: item.vertex, unreached: true }),
        }
        Ok(Attempt::Done)
    }
}

struct ReconnectJob {
    objective: Objective,
    four: FourFour,
    /// Tets whose largest angle has no smaller cosine are passed over.
    active_cosine: f64,
}

impl ReconnectJob {
    fn is_active<S: TetStore>(&self, store: &S, tet: TetId) -> bool {
        if self.active_cosine > 1.0 {
            return store.is_live(tet);
        }
        let row = store.vertices(tet);
        let is_finite = store.is_live(tet) && !row.contains(&VertexId::GHOST);
        is_finite && dihedral_cosines(store.corners(row)).1 < self.active_cosine
    }
}

impl Job for ReconnectJob {
    type Item = TetId;

    fn attempt<S: TetStore>(&self, store: &mut S, kit: &mut Kit, tet: TetId) -> Result<Attempt> {
        if self.is_active(store, tet) {
            kit.reconnector.reconnect_from(store, tet, self.objective, self.four, BUDGET)?;
        }
        Ok(Attempt::Done)
    }
}

struct SmoothJob<'a> {
    rule: &'a SmoothingRule,
    /// The rule for vertices beside the boundary.
    near_boundary: &'a SmoothingRule,
    on_boundary: &'a [bool],
    sizes: &'a [f64],
}

impl Job for SmoothJob<'_> {
    type Item = VertexId;

    fn attempt<S: TetStore>(&self, store: &mut S, kit: &mut Kit, vertex: VertexId) -> Result<Attempt> {
        if self.on_boundary.get(vertex.index()).copied().unwrap_or(false) {
            return Ok(Attempt::Done);
        }
        let tet = store.tet_of(vertex);
        let is_near = tet != TetId::NONE
            && store.vertices(tet).iter().any(|v| self.on_boundary.get(v.index()).copied().unwrap_or(false));
        let rule = if is_near { self.near_boundary } else { self.rule };
        let spacing = Spacing { sizes: self.sizes, factor: SPACING, longest: f64::INFINITY };
        let outcome = kit.smoother.smooth(store, vertex, &BiasedSine, rule, spacing);
        store.release_claims();
        if outcome == Outcome::Accepted {
            kit.tally.smoothed += 1;
            kit.moved.push(vertex);
        }
        Ok(if outcome == Outcome::ClaimLost { Attempt::ClaimLost } else { Attempt::Done })
    }
}

struct CollapseJob;

impl Job for CollapseJob {
    type Item = [VertexId; 2];

    fn attempt<S: TetStore>(&self, store: &mut S, kit: &mut Kit, [a, b]: [VertexId; 2]) -> Result<Attempt> {
        for (vertex, target) in [(a, b), (b, a)] {
            if store.tet_of(vertex) == TetId::NONE || store.tet_of(target) == TetId::NONE {
                continue;
            }
            let scratch = &mut kit.reconnector.scratch;
            match plan_contraction(store, vertex, target, &BiasedSine, Accept::Better, scratch) {
                Outcome::Accepted => {
                    let committed = kit.reconnector.commit(store)?;
                    store.release_claims();
                    if committed {
                        kit.tally.collapsed += 1;
                        kit.removed.push(vertex);
                        break;
                    }
                }
                Outcome::ClaimLost => {
                    store.release_claims();
                    return Ok(Attempt::ClaimLost);
                }
                _ => store.release_claims(),
            }
        }
        Ok(Attempt::Done)
    }
}

/// A thread's view, kit and job.
struct Thread<'a, 'b, J> {
    store: ClaimedTets<'a>,
    kit: Kit,
    job: &'b J,
}

impl<J: Job> Worker for Thread<'_, '_, J> {
    type Item = J::Item;

    fn attempt(&mut self, item: &J::Item, _more: &mut Vec<J::Item>) -> Result<Attempt> {
        if !self.store.has_room(ATTEMPT_ROOM) {
            return Ok(Attempt::NoRoom);
        }
        self.job.attempt(&mut self.store, &mut self.kit, *item)
    }
}

/// Runs passes and counts.
pub struct Driver {
    context: RunContext,
    threads: usize,
    settings: WorkSettings,
    sorts: bool,
    /// Fewest tets of a mesh that threads share.
    shared_from: usize,
    kits: Vec<Kit>,
    spare: Vec<VertexId>,
    flips: FlipCounts,
    speculative: SpeculativeCounts,
    /// Kept from pass to pass: a new table for every pass would cost more than small passes do.
    claims: ClaimTable,
}

impl Driver {
    /// The driver of refinement.
    pub fn for_refinement(options: &Options, context: &RunContext) -> Self {
        let threads = limited(options.refinement_threads, context.threads());
        let mut settings = WorkSettings::for_threads(threads);
        if options.buckets > 0 {
            settings.buckets = options.buckets;
        }
        settings.transfer_share = options.transfer_fraction;
        settings.transfer_decay = options.transfer_reduction;
        // The points were sorted before they became vertices, and what they change follows their order.
        let mut driver = Self::new(context, threads, settings, false);
        driver.kits.iter_mut().for_each(|kit| kit.reconnector.spared = Some(UNSETTLED));
        driver
    }

    /// The driver of quality improvement.
    pub fn for_quality(options: &Options, context: &RunContext) -> Self {
        let refinement = limited(options.refinement_threads, context.threads());
        let threads = limited(options.quality_threads, refinement);
        let mut settings = WorkSettings::for_threads(threads);
        if options.quality_buckets > 0 {
            settings.buckets = options.quality_buckets;
        }
        settings.transfer_share = options.quality_transfer_fraction;
        settings.transfer_decay = options.quality_transfer_reduction;
        Self::new(context, threads, settings, options.sort_quality)
    }

    fn new(context: &RunContext, threads: usize, settings: WorkSettings, sorts: bool) -> Self {
        Self {
            context: context.clone(),
            threads,
            settings,
            sorts,
            shared_from: MIN_SHARED_TETS,
            kits: vec![Kit::default(); threads],
            spare: Vec::new(),
            flips: FlipCounts::default(),
            speculative: SpeculativeCounts::default(),
            claims: ClaimTable::default(),
        }
    }

    /// Lets threads share meshes however small, for tests of what they do to each other.
    #[cfg(test)]
    pub fn share_all_meshes(&mut self) {
        self.shared_from = 0;
    }

    /// Forgets the numbers of vertices and tets, but not what failed: that is told by places.
    pub fn turn_to_another_mesh(&mut self) {
        self.spare.clear();
        for kit in &mut self.kits {
            let Kit { spare, new_sizes, removed, moved, touched, rejected, reconnector, .. } = kit;
            spare.clear();
            new_sizes.clear();
            removed.clear();
            moved.clear();
            rejected.clear();
            *touched = Touched::default();
            reconnector.fresh.clear();
            reconnector.lost.clear();
        }
    }

    /// The flip counts since the last call.
    pub fn take_counts(&mut self) -> FlipCounts {
        let mut counts = FlipCounts::default();
        for kit in &mut self.kits {
            counts.add(std::mem::take(&mut kit.reconnector.counts));
        }
        self.flips.add(counts);
        counts
    }

    /// The points that treatments have tried, inserted and removed so far.
    pub fn vertex_changes(&self) -> VertexChanges {
        let sum = |pick: fn(&Tally) -> u64| self.kits.iter().map(|k| pick(&k.tally)).sum();
        VertexChanges { tried: sum(|t| t.tried), inserted: sum(|t| t.inserted), removed: sum(|t| t.removed) }
    }

    /// Adds the figures of all passes.
    pub fn record(&self, figures: &mut Statistics, prefix: &str) {
        let sum = |pick: fn(&Tally) -> u64| self.kits.iter().map(|k| pick(&k.tally)).sum::<u64>() as f64;
        for (name, value) in [
            ("threads", self.threads as f64),
            ("edges_collapsed", sum(|t| t.collapsed)),
            ("vertices_smoothed", sum(|t| t.smoothed)),
            ("vertices_removed", sum(|t| t.removed)),
            ("points_tried", sum(|t| t.tried)),
            ("vertices_inserted", sum(|t| t.inserted)),
            ("polyhedra_tried", sum(|t| t.polyhedra[0])),
            ("polyhedra_reconnected", sum(|t| t.polyhedra[1])),
            ("attempts", self.speculative.attempts as f64),
            ("attempts_lost", self.speculative.lost as f64),
            ("finished_alone", self.speculative.finished_alone as f64),
            ("bucket_transfers", self.speculative.transfers as f64),
        ] {
            figures.set(format!("{prefix}.{name}"), value);
        }
    }

    /// How many threads share a pass over so many items.
    fn threads_for(&self, complex: &TetComplex, items: usize) -> usize {
        let is_small = items < MIN_PARALLEL || complex.live_count() < self.shared_from;
        if is_small { 1 } else { self.threads }
    }

    /// Does all items, on as many threads as the pass is worth.
    fn run<J: Job>(&mut self, complex: &mut TetComplex, job: &J, items: Vec<J::Item>, room: usize) -> Result<()> {
        if self.threads_for(complex, items.len()) == 1 {
            return self.run_alone(complex, job, &items);
        }
        let mut items = items;
        for _ in 0..ROOM_ROUNDS {
            if items.is_empty() {
                return Ok(());
            }
            let kits = std::mem::take(&mut self.kits);
            let room = room.min(items.len().saturating_mul(2 * TETS_PER_INSERT)) + 4 * self.threads * ATTEMPT_ROOM;
            let (context, settings) = (&self.context, self.settings);
            let (result, kits) = with_claims(complex, &mut self.claims, self.threads, room, |views| {
                let mut threads: Vec<Thread<J>> =
                    views.into_iter().zip(kits).map(|(store, kit)| Thread { store, kit, job }).collect();
                let result = run_speculative(context, &mut threads, items, settings);
                (result, threads.into_iter().map(|t| t.kit).collect::<Vec<_>>())
            })?;
            self.kits = kits;
            let (counts, left) = result?;
            self.speculative.add(counts);
            items = left;
        }
        self.run_alone(complex, job, &items)
    }

    fn run_alone<J: Job>(&mut self, complex: &mut TetComplex, job: &J, items: &[J::Item]) -> Result<()> {
        for (number, &item) in items.iter().enumerate() {
            self.context.check_every(CHECK_INTERVAL, number)?;
            job.attempt(complex, &mut self.kits[0], item)?;
        }
        Ok(())
    }

    /// Finishes the flips that lost a claim in the middle of a cascade; returns all new tets since the last call.
    fn finish_lost(&mut self, complex: &mut TetComplex, objective: Objective, four: FourFour) -> Result<Vec<TetId>> {
        let mut lost: Vec<TetFace> = Vec::new();
        let mut fresh = Vec::new();
        for kit in &mut self.kits {
            lost.append(&mut kit.reconnector.lost);
        }
        for side in lost {
            self.kits[0].reconnector.reconnect_face(complex, side, objective, four)?;
        }
        for kit in &mut self.kits {
            kit.reconnector.lost.clear();
            fresh.append(&mut kit.reconnector.fresh);
        }
        Ok(fresh)
    }

    /// Inserts vertices in this order, one round after the other, of which `ends` are the ends; returns those that were not
    /// inserted. `fresh` gains the tets that are new. While cavities are so large that threads would stand in each other's
    /// way, one thread makes them.
    ///
    /// # Errors
    /// [`crate::error::Error::Cancelled`], or what the store refuses.
    pub fn insert(
        &mut self,
        complex: &mut TetComplex,
        clearances: &[f64],
        (inserts, ends): (&[Insert], &[usize]),
        rule: &InsertionRule,
        fresh: &mut Vec<TetId>,
    ) -> Result<Vec<Rejected>> {
        let mut begin = 0;
        let mut cavity = usize::MAX;
        for &end in ends {
            let room = TETS_PER_INSERT * (end - begin);
            let job = InsertJob { clearances, rule };
            let known = self.made_and_rejected();
            if end == inserts.len() || cavity.saturating_mul(MEETING * self.threads) < complex.vertex_count() {
                self.run(complex, &job, inserts[begin..end].to_vec(), room)?;
            } else {
                self.run_alone(complex, &job, &inserts[begin..end])?;
            }
            let (made, rejected) = self.made_and_rejected();
            cavity = (made - known.0) / (end - begin).saturating_sub(rejected - known.1).max(1);
            begin = end;
        }
        fresh.append(&mut self.finish_lost(complex, Objective::InSphere, FourFour::Off)?);
        Ok(self.kits.iter_mut().flat_map(|kit| std::mem::take(&mut kit.rejected)).collect())
    }

    /// Numbers of new tets and of rejected vertices that the threads have listed.
    fn made_and_rejected(&self) -> (usize, usize) {
        self.kits
            .iter()
            .fold((0, 0), |(made, rejected), kit| (made + kit.reconnector.fresh.len(), rejected + kit.rejected.len()))
    }

    /// Reconnects from every tet of `tets`, which is replaced by those and all new ones; up to `repeats` times from
    /// what is new.
    ///
    /// # Errors
    /// As [`Driver::insert`].
    pub fn reconnect(
        &mut self,
        complex: &mut TetComplex,
        tets: &mut Vec<TetId>,
        objective: Objective,
        four: FourFour,
        repeats: usize,
    ) -> Result<()> {
        let mut begin = 0;
        for _ in 0..repeats.min(16) {
            let end = tets.len();
            let mut items = tets[begin..end].to_vec();
            if self.sorts {
                sort_along_curve(complex, &mut items, |t| complex.vertices(*t)[0])?;
            }
            self.run(complex, &ReconnectJob { objective, four, active_cosine: f64::INFINITY }, items, end)?;
            begin = end;
            tets.append(&mut self.finish_lost(complex, objective, four)?);
            if tets.len() == end {
                break;
            }
        }
        Ok(())
    }

    /// Reconnects from every tet whose largest angle is above `degrees`, in the order of storage: the list of active
    /// tets that is not grouped.
    ///
    /// # Errors
    /// As [`Driver::insert`].
    pub fn reconnect_ungrouped(
        &mut self,
        complex: &mut TetComplex,
        degrees: f64,
        objective: Objective,
        four: FourFour,
    ) -> Result<()> {
        let tets = self.context.install(|| complex.finite_tets_where(|_| true));
        let room = tets.len();
        let job = ReconnectJob { objective, four, active_cosine: degrees.to_radians().cos() };
        self.run(complex, &job, tets, room)?;
        self.finish_lost(complex, objective, four).map(|_| ())
    }

    /// Collapses edges of tets with vertices `within` that are shorter than `factor` times the smaller size of their ends,
    /// where one end is free to go and no tet around gets worse than the worst of them was. Tets without such edges get the
    /// user bit `LONG`, and those that have it are passed over: the factor is the same in all calls.
    ///
    /// # Errors
    /// As [`Driver::insert`].
    pub fn collapse_small_edges(
        &mut self,
        complex: &mut TetComplex,
        sizes: &[f64],
        factor: f64,
        within: &(impl Fn(&[VertexId; 4]) -> bool + Sync),
    ) -> Result<()> {
        const CHUNK: usize = 2048;
        let reader = &*complex;
        let chunks = reader.slot_count().div_ceil(CHUNK);
        let look_at = |chunk: usize| {
            let (mut short, mut long) = (Vec::new(), Vec::new());
            for tet in (chunk * CHUNK..reader.slot_count().min((chunk + 1) * CHUNK)).map(TetId::from_index) {
                let flags = reader.flags(tet);
                if !flags.is_deleted() && !flags.has_user_bit(LONG) && within(&reader.vertices(tet)) {
                    let known = short.len();
                    short.extend(short_edges(reader, sizes, tet, factor));
                    if short.len() == known {
                        long.push(tet);
                    }
                }
            }
            (short, long)
        };
        let found: Vec<_> = self.context.install(|| (0..chunks).into_par_iter().map(look_at).collect());
        let mut short = Vec::new();
        for (edges, tets) in found {
            short.extend(edges);
            tets.into_iter().for_each(|tet| complex.set_flags(tet, complex.flags(tet).with_user_bit(LONG, true)));
        }
        short.sort_unstable();
        short.dedup();
        self.run(complex, &CollapseJob, short, ATTEMPT_ROOM)?;
        self.finish_lost(complex, Objective::EdgeWeight, FourFour::Off).map(|_| ())
    }

    /// Smooths vertices; those with a neighbour on the boundary move `boundary_factor` of the way. Returns those that
    /// moved: where one found no better place, the next round will hardly find one.
    ///
    /// # Errors
    /// As [`Driver::insert`].
    pub fn smooth(
        &mut self,
        complex: &mut TetComplex,
        vertices: Vec<VertexId>,
        (on_boundary, sizes): (&[bool], &[f64]),
        rule: &SmoothingRule,
        boundary_factor: f64,
    ) -> Result<Vec<VertexId>> {
        let near_boundary = SmoothingRule { coefficient: rule.coefficient * boundary_factor, ..*rule };
        let job = SmoothJob { rule, near_boundary: &near_boundary, on_boundary, sizes };
        self.run(complex, &job, vertices, 0)?;
        Ok(self.kits.iter_mut().flat_map(|kit| std::mem::take(&mut kit.moved)).collect())
    }

    /// Improves bad tets one by one; returns how many operations were carried out.
    ///
    /// # Errors
    /// As [`Driver::insert`].
    pub fn treat(
        &mut self,
        complex: &mut TetComplex,
        sizes: &mut Vec<f64>,
        on_boundary: &[bool],
        bad: Vec<TetId>,
        treatment: &Treatment<'_>,
    ) -> Result<usize> {
        let before: u64 = self.kits.iter().map(|k| k.tally.done).sum();
        if treatment.changes_vertices {
            self.deal_spares(complex, sizes, bad.len())?;
        }
        let room = 4 * bad.len();
        if treatment.shuns_skew_faces {
            let measure = StrictInside { angles: UnskewedSine, on_boundary, relief: treatment.relief };
            self.run(complex, &TreatJob { sizes, measure, treatment }, bad, room)?;
        } else {
            let measure = StrictInside { angles: BiasedSine, on_boundary, relief: treatment.relief };
            self.run(complex, &TreatJob { sizes, measure, treatment }, bad, room)?;
        }
        self.take_new_sizes(sizes);
        self.finish_lost(complex, Objective::EdgeWeight, FourFour::Off)?;
        let after: u64 = self.kits.iter().map(|k| k.tally.done).sum();
        Ok((after - before) as usize)
    }

    /// Splits the edges of some tets that are far too long, where that betters the lengths and lowers no angle that counts;
    /// returns how many were split.
    ///
    /// # Errors
    /// As [`Driver::insert`].
    pub fn split_long_edges(
        &mut self,
        complex: &mut TetComplex,
        sizes: &mut Vec<f64>,
        on_boundary: &[bool],
        tets: Vec<TetId>,
    ) -> Result<usize> {
        let before: u64 = self.kits.iter().map(|k| k.tally.done).sum();
        self.deal_spares(complex, sizes, tets.len())?;
        let room = 8 * tets.len();
        self.run(complex, &SplitJob::new(sizes, on_boundary), tets, room)?;
        self.take_new_sizes(sizes);
        let after: u64 = self.kits.iter().map(|k| k.tally.done).sum();
        Ok((after - before) as usize)
    }

    /// Notes the sizes of the points that threads have inserted and takes back the spare vertices.
    fn take_new_sizes(&mut self, sizes: &mut [f64]) {
        for kit in &mut self.kits {
            for (vertex, size) in kit.new_sizes.drain(..) {
                sizes[vertex.index()] = size;
            }
            self.spare.append(&mut kit.spare);
            self.spare.append(&mut kit.removed);
        }
    }

    /// What treatments changed since the last call.
    pub fn take_touched(&mut self) -> Touched {
        let mut all = Touched::default();
        self.kits.iter_mut().for_each(|kit| all.append(std::mem::take(&mut kit.touched)));
        all
    }

    /// Gives the threads of a pass spare vertices, enough for each bad tet to take one. A pass of one thread finds the same
    /// ones however many threads there are: numbers of vertices decide between equals.
    fn deal_spares(&mut self, complex: &mut TetComplex, sizes: &mut Vec<f64>, wanted: usize) -> Result<()> {
        for kit in &mut self.kits {
            self.spare.append(&mut kit.removed);
        }
        let threads = self.threads_for(complex, wanted);
        while self.spare.len() < wanted + threads {
            self.spare.push(complex.push_point(glam::DVec3::ZERO)?);
            sizes.push(0.0);
        }
        let share = self.spare.len().div_ceil(threads);
        for kit in &mut self.kits[..threads] {
            let keep = self.spare.len().saturating_sub(share);
            kit.spare.extend(self.spare.drain(keep..));
        }
        Ok(())
    }
}

/// The option's thread count, or all; never more than there are.
fn limited(option: usize, all: usize) -> usize {
    if option == 0 { all } else { option.min(all) }.max(1)
}

/// Sorts items along a Hilbert curve through their points (`sortp`).
fn sort_along_curve<T: Copy>(
    complex: &TetComplex,
    items: &mut Vec<T>,
    vertex_of: impl Fn(&T) -> VertexId,
) -> Result<()> {
    let place = |item: &T| {
        let vertex = vertex_of(item);
        if vertex.is_ghost() { glam::DVec3::ZERO } else { complex.point(vertex) }
    };
    let points: Vec<glam::DVec3> = items.iter().map(place).collect();
    let order = crate::geometry::spatial_sort::hilbert_order(&points)?;
    *items = order.into_iter().map(|i| items[i as usize]).collect();
    Ok(())
}

fn short_edges(complex: &TetComplex, sizes: &[f64], tet: TetId, factor: f64) -> impl Iterator<Item = [VertexId; 2]> {
    let row = complex.vertices(tet);
    let usable = complex.is_live(tet) && !row.contains(&VertexId::GHOST);
    let edges = if usable {
        TET_EDGES.map(|[i, j]| {
            let (a, b) = (row[i].min(row[j]), row[i].max(row[j]));
            let limit = factor * sizes[a.index()].min(sizes[b.index()]);
            (complex.point(a).distance_squared(complex.point(b)) < limit * limit).then_some([a, b])
        })
    } else {
        [None; 6]
    };
    edges.into_iter().flatten()
}

#[cfg(test)]
mod tests;
