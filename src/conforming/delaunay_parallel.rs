//! One round of Delaunay insertions on several threads.
//!
//! # Method
//! 1. The points of a round, in the order of the curve, are cut into buckets; each thread works through neighbouring ones
//!    and hands some over when others have none left ([`crate::parallel::work_queue`]).
//! 2. A thread walks to its point without any claim, then claims each tet that it looks at: those of the cavity and those
//!    around it. Where another thread has one, nothing was changed; the point is deferred.
//! 3. The deferred points are tried again, the last few by one thread alone.
//!
//! Tets are claimed in blocks of neighbouring slots, and a block is kept for some insertions: the next point is near, so
//! that nearly all claims are one comparison.
//! # Source
//! Buckets as in [Drakopoulos2017] section 4.8; rows side by side along the curve as in [MarotPellerinRemacle2019].
//! # Differences
//! [MarotPellerinRemacle2019] gives each thread an interval of the curve. Points on surfaces make tets across any two
//! intervals: a third of the points had to wait for the end, where claims that move with the thread lose a few in a
//! thousand.
//!
//! # Protocol
//! (The words are atomic, `parallel::shared_rows`; claims are those of `parallel::claim_table`; threads join at the end.)
//! - The row and the mark of a slot are written only by the thread that has its block. So a row that is read under a
//!   claim is whole, as its last writer left it before the release that this claim has acquired.
//! - A cavity is replaced only when all of its tets, all tets around it and all slots for new tets are claimed by one
//!   thread: the entries of neighbours on both sides of its boundary are then written by nobody else.
//! - A walk reads rows without claims, half old and half new at worst. All that it takes from them are numbers of slots and
//!   of points, which exist for as long as the pass lasts; the tet that it ends in is claimed and tested anew.
//! - A claim never waits. Who loses one gives back all blocks: of two threads that need each other's blocks, none can stop
//!   the other twice.
//! - Free slots are dealt in blocks (`parallel::id_allocator`) and reused by the thread that freed them; where none are
//!   left the point is deferred.
//!
//! # Invariants
//! The set of tets after a round is that of one thread: the Delaunay tetrahedralization of the points is unique. The
//! numbers of slots are not: see `delaunay_numbering`.

use std::ops::Range;

use rayon::prelude::*;

use super::cavity::{Cavity, Insertion};
use super::delaunay_kernel::{DelaunayReport, Kernel};
use super::kernel_mesh::{KernelMesh, StoredPoint};
use super::point_location::{Location, locate};
use crate::context::RunContext;
use crate::error::Result;
use crate::index::{TetFace, TetId, VertexId};
use crate::parallel::claim_table::{Claim, ClaimTable};
use crate::parallel::id_allocator::{IdAllocator, IdPool};
use crate::parallel::shared_rows::{SharedBytes, SharedWords};
use crate::parallel::work_queue::{WorkMember, WorkQueue, WorkSettings};

/// Points per thread below which a round is left to one thread: the mesh would be too small to keep out of each other's
/// way in. Less for tests, which want them to be.
pub(super) const SMALLEST_ROUND: usize = if cfg!(test) { 250 } else { 16_000 };

/// Passes over the deferred points before one thread finishes.
const PASSES: usize = 3;

/// Slots made beyond what the points inserted so far needed, per point (points on surfaces get more neighbours the
/// more there are) and per thread.
const SLOT_MARGIN: f64 = 1.25;
const EXTRA_SLOTS: usize = 4096;

/// Slots dealt at a time: with few, the claims of two threads share cache lines (a sixth more CPU time with 256).
const DEALT_SLOTS: usize = 8192;

/// Ids per place to start a walk from.
const HINT_SPAN: usize = 256;

/// Slots of a block are those with the same number but for so many last bits.
const BLOCK_BITS: usize = 4;

/// Insertions after which the blocks are given back: those of the way behind would only be in the way.
const KEPT_INSERTIONS: usize = 32;

/// Points of a bucket; between two buckets a thread looks at the cancellation flag.
const BUCKET: usize = 1024;

/// Attempts at a point whose tet has changed between walk and claim.
const ATTEMPTS: usize = 4;

/// The shared mesh as one thread sees it.
struct SharedMesh<'a> {
    points: &'a [StoredPoint],
    halves: SharedWords<'a>,
    marks: SharedBytes<'a>,
    claims: &'a ClaimTable,
    holder: u32,
    /// Blocks that this thread has claimed.
    held: Vec<u32>,
    free: IdAllocator<'a>,
    /// Free slots in blocks that this thread has claimed.
    ready: Vec<TetId>,
    /// Free slots in blocks that another thread had when they were wanted.
    set_aside: Vec<TetId>,
}

impl KernelMesh for SharedMesh<'_> {
    const IS_SHARED: bool = true;

    #[inline]
    fn point(&self, vertex: VertexId) -> glam::DVec3 {
        self.points[vertex.index()].point
    }

    #[inline]
    fn vertices(&self, tet: TetId) -> [VertexId; 4] {
        bytemuck::cast(self.halves.load_row::<4>(8 * tet.index() + 4))
    }

    #[inline]
    fn neighbors(&self, tet: TetId) -> [TetFace; 4] {
        bytemuck::cast(self.halves.load_row::<4>(8 * tet.index() + 8))
    }

    #[inline]
    fn set_row(&mut self, tet: TetId, vertices: [VertexId; 4], neighbors: [TetFace; 4]) {
        self.halves.store_row::<4>(8 * tet.index() + 4, bytemuck::cast(vertices));
        self.halves.store_row::<4>(8 * tet.index() + 8, bytemuck::cast(neighbors));
    }

    #[inline]
    fn set_neighbor(&mut self, side: TetFace, other: TetFace) {
        self.halves.store(8 * side.tet().index() + 8 + side.face(), other.0);
    }

    #[inline]
    fn is_marked(&self, tet: TetId) -> bool {
        self.marks.load(tet.index()) != 0
    }

    #[inline]
    fn set_mark(&mut self, tet: TetId, marked: bool) {
        self.marks.store(tet.index(), u8::from(marked));
    }

    #[inline]
    fn claim(&mut self, tet: TetId) -> bool {
        let block = tet.index() >> BLOCK_BITS;
        match self.claims.try_claim(block, self.holder) {
            Claim::Held => true,
            Claim::Taken => {
                self.held.push(block as u32);
                true
            }
            Claim::Lost => false,
        }
    }

    fn has_room(&mut self, slots: usize) -> bool {
        while self.ready.len() < slots {
            let Some(id) = self.free.take() else { return false };
            let slot = TetId(id);
            if self.claim(slot) { self.ready.push(slot) } else { self.set_aside.push(slot) }
        }
        true
    }

    #[inline]
    fn take_slot(&mut self) -> TetId {
        self.ready.pop().expect("the cavity checked that there is room")
    }

    #[inline]
    fn free_slot(&mut self, tet: TetId) {
        self.set_row(tet, [VertexId::GHOST; 4], [TetFace::NONE; 4]);
        self.free.recycle(tet.0);
    }
}

impl SharedMesh<'_> {
    fn release_all(&mut self) {
        for block in self.held.drain(..) {
            self.claims.release(block as usize, self.holder);
        }
        // Their blocks may be another thread's next time; what was set aside may be free by then.
        for slot in self.ready.drain(..).chain(self.set_aside.drain(..)) {
            self.free.recycle(slot.0);
        }
    }
}

/// What one thread brings back.
#[derive(Default)]
struct Part {
    deferred: Vec<u32>,
    duplicates: Vec<(VertexId, VertexId)>,
    exact_tests: u64,
}

/// Inserts positions `range` of the order with `threads` threads.
pub(super) fn insert_round(
    kernel: &mut Kernel<'_>,
    range: Range<usize>,
    threads: usize,
    report: &mut DelaunayReport,
) -> Result<()> {
    report.threads = threads;
    let mut waiting = kernel.order[range.clone()].to_vec();
    let hints = hints(kernel);
    for _ in 0..PASSES {
        if waiting.len() < SMALLEST_ROUND * threads / 4 {
            break;
        }
        let live = kernel.rows.slots() - kernel.rows.free.len();
        let per_point = (SLOT_MARGIN * live as f64 / (range.end - waiting.len()).max(1) as f64).clamp(7.0, 32.0);
        let room = (waiting.len() as f64 * per_point) as usize + EXTRA_SLOTS * threads;
        waiting = insert_pass(kernel, waiting, &hints, (threads, room), report)?;
        report.deferred += waiting.len() as u64;
        waiting.sort_unstable();
    }
    // The rest, alone; the order's slots of this round are free for it.
    let end = range.start + waiting.len();
    kernel.order[range.start..end].copy_from_slice(&waiting);
    kernel.restart();
    kernel.insert_range(range.start, end)
}

/// Steps 1 and 2 for the sorted vertices `waiting`, with room for so many new tets; returns those that were deferred.
fn insert_pass(
    kernel: &mut Kernel<'_>,
    waiting: Vec<u32>,
    hints: &[TetId],
    (threads, room): (usize, usize),
    report: &mut DelaunayReport,
) -> Result<Vec<u32>> {
    let missing = room.saturating_sub(kernel.rows.free.len());
    let first_new = kernel.rows.extend(missing)?;
    // Low slots are taken first: high ones that stay free are cut off at the end.
    let mut free: Vec<u32> = (first_new..kernel.rows.slots()).rev().map(|slot| slot as u32).collect();
    free.extend(kernel.rows.free.drain(..).map(|slot| slot.0));
    let pool = IdPool::with_block(free, DEALT_SLOTS);
    let claims = ClaimTable::new((kernel.rows.slots() >> BLOCK_BITS) + 1);
    let settings = WorkSettings { buckets: waiting.len().div_ceil(BUCKET), ..WorkSettings::for_threads(threads) };
    let queue = WorkQueue::new(waiting, threads, settings);
    let halves = SharedWords::new(kernel.rows.halves.as_flattened_mut());
    let marks = SharedBytes::new(&mut kernel.rows.marks);
    let mut jobs = Vec::new();
    for holder in 0..threads as u32 {
        let (points, claims, free) = (kernel.points, &claims, pool.allocator());
        let (held, ready, set_aside) = (Vec::new(), Vec::new(), Vec::new());
        jobs.push(SharedMesh { points, halves, marks, claims, holder, held, free, ready, set_aside });
    }
    let (context, arithmetic) = (kernel.context, kernel.arithmetic);
    let work = |mesh: SharedMesh<'_>| {
        let member = queue.join(mesh.holder as usize);
        let part = insert_part(mesh, member, Cavity::new(arithmetic), hints, context);
        if part.is_err() {
            queue.stop();
        }
        part
    };
    let parts: Vec<Result<Part>> = jobs.into_par_iter().map(work).collect();
    let mut deferred = Vec::new();
    for part in parts {
        let mut part = part?;
        deferred.append(&mut part.deferred);
        kernel.duplicates.append(&mut part.duplicates);
        report.exact_tests += part.exact_tests;
    }
    debug_assert!(claims.is_all_free());
    kernel.rows.free = pool.into_free().into_iter().map(TetId).collect();
    kernel.rows.free.sort_unstable_by(|a, b| b.cmp(a));
    Ok(deferred)
}

/// Step 2 on one thread.
fn insert_part(
    mut mesh: SharedMesh<'_>,
    mut member: WorkMember<'_, u32>,
    mut cavity: Cavity,
    hints: &[TetId],
    context: &RunContext,
) -> Result<Part> {
    let mut part = Part::default();
    while let Some(bucket) = member.next_bucket() {
        context.check()?;
        // Once more at the end of the bucket: by then others have gone on.
        let deferred = insert_bucket(&mut mesh, &mut cavity, &bucket, hints, &mut part);
        let again = insert_bucket(&mut mesh, &mut cavity, &deferred, hints, &mut part);
        part.deferred.extend(again);
    }
    part.exact_tests = cavity.exact_tests;
    Ok(part)
}

/// Inserts the points of one bucket; returns those that have to wait.
fn insert_bucket(
    mesh: &mut SharedMesh<'_>,
    cavity: &mut Cavity,
    bucket: &[u32],
    hints: &[TetId],
    part: &mut Part,
) -> Vec<u32> {
    let mut deferred = Vec::new();
    let mut hint = TetId::NONE;
    for (number, &id) in bucket.iter().enumerate() {
        let starts = [hint, hints[id as usize / HINT_SPAN]];
        match insert_one(mesh, cavity, VertexId(id), starts) {
            Attempt::Inserted(tet) => hint = tet,
            Attempt::Duplicate(kept) => part.duplicates.push((VertexId(id), kept)),
            Attempt::Deferred => deferred.push(id),
        }
        if number % KEPT_INSERTIONS == 0 {
            mesh.release_all();
        }
    }
    mesh.release_all();
    deferred
}

/// What became of a point.
enum Attempt {
    Inserted(TetId),
    Duplicate(VertexId),
    Deferred,
}

fn insert_one(mesh: &mut SharedMesh<'_>, cavity: &mut Cavity, vertex: VertexId, starts: [TetId; 2]) -> Attempt {
    let point = mesh.point(vertex);
    for attempt in 0..ATTEMPTS {
        let start = if starts[0] == TetId::NONE { starts[1] } else { starts[attempt % 2] };
        let tet = match locate(mesh, point, start, &cavity.granularity()) {
            Location::Vertex(kept) => return Attempt::Duplicate(kept),
            Location::Lost => continue,
            Location::Tet(tet) => tet,
        };
        match cavity.insert(mesh, vertex, tet) {
            Insertion::Inserted(tet) => return Attempt::Inserted(tet),
            Insertion::Moved => {}
            Insertion::Claimed | Insertion::NoRoom => break,
        }
    }
    mesh.release_all();
    Attempt::Deferred
}

/// A tet near every span of ids: one with a vertex in it, or else the one of the span before.
fn hints(kernel: &Kernel<'_>) -> Vec<TetId> {
    let mut hints = vec![TetId::NONE; kernel.points.len() / HINT_SPAN + 1];
    let mut first = TetId::NONE;
    for slot in 0..kernel.rows.slots() {
        let tet = TetId::from_index(slot);
        for v in kernel.rows.vertices(tet) {
            if !v.is_ghost() {
                hints[v.index() / HINT_SPAN] = tet;
                first = tet;
            }
        }
    }
    for hint in &mut hints {
        if *hint == TetId::NONE {
            *hint = first;
        }
        first = *hint;
    }
    hints
}
