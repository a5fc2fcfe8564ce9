//! One round of Delaunay insertions on several threads.
//!
//! # Method
//! Vertex ids are places on the Hilbert curve, so that an interval of ids is a compact part of space.
//! 1. The ids are cut into one interval per thread (a circle: the last interval may continue at the first id), with
//!    equally many points to insert in each.
//! 2. Each thread inserts the points of its interval. It may remove a tet only if it owns all the vertices of that tet, ghost
//!    excepted; a point whose cavity or walk needs another's vertex is deferred.
//! 3. The deferred points are tried again with the cuts moved by half an interval: what lay at a cut now lies inside
//!    a part. After that, or when few are left, one thread finishes alone.
//! # Source
//! Partition by intervals of a space-filling curve that moves between passes [MarotPellerinRemacle2019] section 3.
//! # Differences
//! Ownership of a vertex is a comparison of its id; no claim word exists, and a round needs no atomic exchange.
//!
//! # Protocol
//! (The words are atomic, `parallel::shared_rows`; threads join between passes.)
//! - A tet one of whose vertices is mine can be removed by nobody else: to remove it takes all of its vertices. So every tet
//!   that shares a face with a tet of my own is alive while I look at it, its vertices do not change, and the entry of its
//!   neighbours at the common face is written by nobody else.
//! - A walk reads rows that others may be writing. It trusts only rows with a vertex of mine: another thread writes
//!   into a row of its own, one that never had and never gets a vertex of mine in that pass. Any other row ends it.
//! - Slots are dealt to the threads before the pass and reused by the thread that freed them; who runs out defers.
//!
//! # Invariants
//! The set of tets after a round is that of one thread: the Delaunay tetrahedralization of the points is unique.

use std::ops::Range;

use rayon::prelude::*;

use super::cavity::{Cavity, Insertion};
use super::delaunay_kernel::{DelaunayReport, Kernel};
use super::kernel_mesh::{KernelMesh, StoredPoint};
use super::point_location::{Location, WalkRandom, locate};
use crate::context::RunContext;
use crate::error::Result;
use crate::index::{TetFace, TetId, VertexId};
use crate::parallel::shared_rows::{SharedBytes, SharedWords};

/// Points per thread below which a round is not worth a partition: the parts would be all boundary.
pub(super) const SMALLEST_ROUND: usize = 4000;

/// Passes over the deferred points before one thread finishes.
const PASSES: usize = 3;

/// Slots dealt beyond what the points inserted so far needed, per point and per thread.
const SLOT_MARGIN: f64 = 1.08;
const EXTRA_SLOTS: usize = 4096;

/// Ids per place to start a walk from.
const HINT_SPAN: usize = 256;

/// Insertions between two looks at the cancellation flag.
const CHECK_INTERVAL: usize = 1024;

/// The shared mesh as one thread sees it.
struct SharedMesh<'a> {
    points: &'a [StoredPoint],
    halves: SharedWords<'a>,
    marks: SharedBytes<'a>,
    /// Owned ids: `first`, and `count` in all, going round at `points.len()`.
    first: u32,
    count: u32,
    free: Vec<TetId>,
}

impl KernelMesh for SharedMesh<'_> {
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
    fn owns(&self, vertex: VertexId) -> bool {
        vertex.is_ghost() || self.owns_finite(vertex)
    }

    #[inline]
    fn is_stable(&self, vertices: &[VertexId; 4]) -> bool {
        vertices.iter().any(|&v| !v.is_ghost() && self.owns_finite(v))
    }

    #[inline]
    fn room(&self) -> usize {
        self.free.len()
    }

    #[inline]
    fn take_slot(&mut self) -> TetId {
        self.free.pop().expect("the cavity checked that there is room")
    }

    #[inline]
    fn free_slot(&mut self, tet: TetId) {
        self.set_row(tet, [VertexId::GHOST; 4], [TetFace::NONE; 4]);
        self.free.push(tet);
    }
}

impl SharedMesh<'_> {
    #[inline]
    fn owns_finite(&self, vertex: VertexId) -> bool {
        let offset = vertex.0.wrapping_sub(self.first);
        let offset = if vertex.0 < self.first { offset.wrapping_add(self.points.len() as u32) } else { offset };
        offset < self.count
    }
}

/// What one thread brings back.
#[derive(Default)]
struct Part {
    deferred: Vec<u32>,
    duplicates: Vec<(VertexId, VertexId)>,
    free: Vec<TetId>,
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
    waiting.sort_unstable();
    for pass in 0..PASSES {
        if waiting.len() < SMALLEST_ROUND * threads / 4 {
            break;
        }
        let live = kernel.rows.slots() - kernel.rows.free.len();
        let per_point = (SLOT_MARGIN * live as f64 / (range.end - waiting.len()).max(1) as f64).clamp(7.0, 32.0);
        let room = (waiting.len() as f64 * per_point) as usize + EXTRA_SLOTS * threads;
        let deferred = insert_pass(kernel, &waiting, threads, (pass, room), report)?;
        report.deferred += deferred.len() as u64;
        waiting = deferred;
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
    waiting: &[u32],
    threads: usize,
    (pass, room): (usize, usize),
    report: &mut DelaunayReport,
) -> Result<Vec<u32>> {
    // Cuts between equally many waiting points, moved by a part of an interval in later passes.
    let shift = waiting.len() * pass / (PASSES.max(2) * threads);
    let cut_at = |k: usize| (waiting.len() * k / threads + shift) % waiting.len();
    let hints = hints(kernel);
    let missing = room.saturating_sub(kernel.rows.free.len());
    let first_new = kernel.rows.extend(missing)?;
    let mut free = std::mem::take(&mut kernel.rows.free);
    free.extend((first_new..kernel.rows.slots()).map(TetId::from_index));
    let share = free.len() / threads;
    let halves = SharedWords::new(kernel.rows.halves.as_flattened_mut());
    let marks = SharedBytes::new(&mut kernel.rows.marks);
    let total = kernel.points.len() as u32;
    let mut jobs = Vec::new();
    for k in 0..threads {
        let (begin, end) = (cut_at(k), cut_at((k + 1) % threads));
        let mine: Vec<u32> =
            if begin < end { waiting[begin..end].to_vec() } else { [&waiting[begin..], &waiting[..end]].concat() };
        let first = waiting[begin];
        let count = if first < waiting[end] { waiting[end] - first } else { total - first + waiting[end] };
        let mut slots = if k + 1 == threads { std::mem::take(&mut free) } else { free.split_off(free.len() - share) };
        slots.reverse();
        let mesh = SharedMesh { points: kernel.points, halves, marks, first, count, free: slots };
        jobs.push((mesh, mine, Cavity::new(kernel.extent, kernel.fixed)));
    }
    let context = kernel.context;
    let parts: Vec<Result<Part>> =
        jobs.into_par_iter().map(|(mesh, mine, cavity)| insert_part(mesh, &mine, cavity, &hints, context)).collect();
    let mut deferred = Vec::new();
    for part in parts {
        let mut part = part?;
        deferred.append(&mut part.deferred);
        kernel.duplicates.append(&mut part.duplicates);
        kernel.rows.free.append(&mut part.free);
        report.exact_tests += part.exact_tests;
    }
    // Low slots are taken first: high ones that stay free are cut off at the end.
    kernel.rows.free.sort_unstable_by(|a, b| b.cmp(a));
    Ok(deferred)
}

/// Step 2 on one thread.
fn insert_part(
    mut mesh: SharedMesh<'_>,
    mine: &[u32],
    mut cavity: Cavity,
    hints: &[TetId],
    context: &RunContext,
) -> Result<Part> {
    let mut part = Part::default();
    let mut random = WalkRandom(mesh.first);
    let mut hint = TetId::NONE;
    for (number, &id) in mine.iter().enumerate() {
        if number % CHECK_INTERVAL == 0 {
            context.check()?;
        }
        let vertex = VertexId(id);
        let point = mesh.point(vertex);
        let mut location = Location::Unreachable;
        for start in [hint, hints[id as usize / HINT_SPAN]] {
            if start != TetId::NONE {
                location = locate(&mesh, point, start, &mut random);
            }
            if location != Location::Unreachable {
                break;
            }
        }
        match location {
            Location::Vertex(kept) => part.duplicates.push((vertex, kept)),
            Location::Unreachable => part.deferred.push(id),
            Location::Tet(tet) => match cavity.insert(&mut mesh, vertex, tet) {
                Insertion::Inserted(tet) => hint = tet,
                Insertion::NotOwned | Insertion::NoRoom => part.deferred.push(id),
            },
        }
    }
    part.free = mesh.free;
    part.exact_tests = cavity.exact_tests;
    Ok(part)
}

/// A tet near every span of ids: one with a vertex in it, or else the one of the span before.
fn hints(kernel: &Kernel<'_>) -> Vec<TetId> {
    let mut hints = vec![TetId::NONE; kernel.points.len() / HINT_SPAN + 1];
    for slot in 0..kernel.rows.slots() {
        let tet = TetId::from_index(slot);
        for v in kernel.rows.vertices(tet) {
            if !v.is_ghost() {
                hints[v.index() / HINT_SPAN] = tet;
            }
        }
    }
    let mut last = TetId::NONE;
    for hint in &mut hints {
        if *hint == TetId::NONE {
            *hint = last;
        }
        last = *hint;
    }
    hints
}
