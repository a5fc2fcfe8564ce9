//! The storage of the Delaunay kernel: what a cavity reads and writes, leaner and denser than the editable complex.
//!
//! # Method
//! A tet is one row of 32 bytes, its four vertices and its four packed neighbours side by side, so that a visit costs
//! one cache line; a point is one row of 32 bytes with the index that it has in the input. Vertex ids are positions
//! in storage order (the Hilbert order). [`ExclusiveMesh`] is used by one thread; `delaunay_parallel` has the other one.
//!
//! # Invariants
//! A free slot has four ghosts. `NONE` never stands in a live row after an insertion.
//!
//! # Cost
//! 33 B a slot, 32 B a point. The complex takes the rows over as they are.

use glam::DVec3;
use rayon::iter::ParallelExtend;

use crate::error::{Error, Result};
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::tet_complex::MAX_TETS;

/// A point in storage order.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(32))]
pub(super) struct StoredPoint {
    /// World millimetres.
    pub point: DVec3,
    /// Index in the caller's array.
    pub input: u32,
}

/// What the kernel's steps need of a mesh.
pub(super) trait KernelMesh {
    /// Whether other threads change the mesh at the same time: a row is trusted only once it is claimed.
    const IS_SHARED: bool;
    fn point(&self, vertex: VertexId) -> DVec3;
    fn vertices(&self, tet: TetId) -> [VertexId; 4];
    fn neighbors(&self, tet: TetId) -> [TetFace; 4];
    fn set_row(&mut self, tet: TetId, vertices: [VertexId; 4], neighbors: [TetFace; 4]);
    fn set_neighbor(&mut self, side: TetFace, other: TetFace);
    fn is_marked(&self, tet: TetId) -> bool;
    fn set_mark(&mut self, tet: TetId, marked: bool);
    /// Makes this tet one that only this thread changes; false where another thread has it.
    fn claim(&mut self, tet: TetId) -> bool;
    /// Whether so many slots can be taken now.
    fn has_room(&mut self, slots: usize) -> bool;
    fn take_slot(&mut self) -> TetId;
    fn free_slot(&mut self, tet: TetId);

    #[inline]
    fn glue(&mut self, side: TetFace, other: TetFace) {
        self.set_neighbor(side, other);
        self.set_neighbor(other, side);
    }
}

/// Rows of half a tet: half `2 t + 1` holds the vertices of tet `t`, half `2 t + 2` its neighbours. The first half is
/// padding: large allocations start 16 bytes after a page, and with it no row straddles a cache line.
#[derive(Debug, Default)]
pub(super) struct KernelRows {
    pub halves: Vec<[u32; 4]>,
    pub marks: Vec<u8>,
    pub free: Vec<TetId>,
}

impl KernelRows {
    pub fn with_capacity(tets: usize) -> Result<Self> {
        let mut rows = Self { halves: vec![[u32::MAX; 4]], ..Self::default() };
        rows.reserve(tets)?;
        Ok(rows)
    }

    pub fn slots(&self) -> usize {
        self.marks.len()
    }

    /// Makes sure that at least `count` slots can be taken without an allocation.
    pub fn reserve(&mut self, count: usize) -> Result<()> {
        let needed = self.slots() + count;
        if needed > MAX_TETS {
            return Err(Error::CapacityExceeded { what: "tets", needed: needed as u64, limit: MAX_TETS as u64 });
        }
        let failed = |_| Error::OutOfMemory { what: "tets", bytes: 33 * count as u64 };
        self.halves.try_reserve_exact((2 * needed + 1).saturating_sub(self.halves.len())).map_err(failed)?;
        self.marks.try_reserve_exact(needed.saturating_sub(self.marks.len())).map_err(failed)
    }

    /// Adds `count` free slots that are not in the list of free ones; returns the first.
    pub fn extend(&mut self, count: usize) -> Result<usize> {
        self.reserve(count)?;
        let first = self.slots();
        // In parallel: it is the first touch of most of the memory.
        self.halves.par_extend(rayon::iter::repeat_n([u32::MAX; 4], 2 * count));
        self.marks.resize(first + count, 0);
        Ok(first)
    }

    #[inline]
    pub fn vertices(&self, tet: TetId) -> [VertexId; 4] {
        bytemuck::cast(self.halves[2 * tet.index() + 1])
    }

    pub fn is_free(&self, slot: usize) -> bool {
        self.halves[2 * slot + 1] == [u32::MAX; 4]
    }

    /// Moves the rows together over the free slots, in slot order, mends the neighbours and gives back what is left over.
    pub fn compact(&mut self) {
        // Fill each hole with the last live tet: few rows move, and locality is kept but for them.
        self.free.sort_unstable();
        let mut end = self.slots();
        for hole in std::mem::take(&mut self.free) {
            while end > 0 && self.is_free(end - 1) {
                end -= 1;
            }
            let to = hole.index();
            if to >= end {
                break;
            }
            end -= 1;
            self.halves[2 * to + 1] = self.halves[2 * end + 1];
            self.halves[2 * to + 2] = self.halves[2 * end + 2];
            self.halves[2 * end + 1] = [u32::MAX; 4];
            for face in 0..4 {
                let other = TetFace(self.halves[2 * to + 2][face]);
                self.halves[2 * other.tet().index() + 2][other.face()] = TetFace::new(hole, face).0;
            }
        }
        self.trim();
    }

    /// Gives back the free slots at the end.
    pub fn trim(&mut self) {
        let mut end = self.slots();
        while end > 0 && self.is_free(end - 1) {
            end -= 1;
        }
        self.marks.truncate(end);
        self.halves.truncate(2 * end + 1);
        self.marks.shrink_to_fit();
        self.halves.shrink_to_fit();
    }
}

/// The mesh of one thread.
pub(super) struct ExclusiveMesh<'a> {
    pub points: &'a [StoredPoint],
    pub rows: &'a mut KernelRows,
}

impl KernelMesh for ExclusiveMesh<'_> {
    const IS_SHARED: bool = false;

    #[inline]
    fn point(&self, vertex: VertexId) -> DVec3 {
        self.points[vertex.index()].point
    }

    #[inline]
    fn vertices(&self, tet: TetId) -> [VertexId; 4] {
        self.rows.vertices(tet)
    }

    #[inline]
    fn neighbors(&self, tet: TetId) -> [TetFace; 4] {
        bytemuck::cast(self.rows.halves[2 * tet.index() + 2])
    }

    #[inline]
    fn set_row(&mut self, tet: TetId, vertices: [VertexId; 4], neighbors: [TetFace; 4]) {
        self.rows.halves[2 * tet.index() + 1] = bytemuck::cast(vertices);
        self.rows.halves[2 * tet.index() + 2] = bytemuck::cast(neighbors);
    }

    #[inline]
    fn set_neighbor(&mut self, side: TetFace, other: TetFace) {
        self.rows.halves[2 * side.tet().index() + 2][side.face()] = other.0;
    }

    #[inline]
    fn is_marked(&self, tet: TetId) -> bool {
        self.rows.marks[tet.index()] != 0
    }

    #[inline]
    fn set_mark(&mut self, tet: TetId, marked: bool) {
        self.rows.marks[tet.index()] = u8::from(marked);
    }

    #[inline]
    fn claim(&mut self, _tet: TetId) -> bool {
        true
    }

    #[inline]
    fn has_room(&mut self, slots: usize) -> bool {
        MAX_TETS - self.rows.slots() + self.rows.free.len() >= slots
    }

    #[inline]
    fn take_slot(&mut self) -> TetId {
        self.rows.free.pop().unwrap_or_else(|| {
            self.rows.halves.extend([[u32::MAX; 4]; 2]);
            self.rows.marks.push(0);
            TetId::from_index(self.rows.marks.len() - 1)
        })
    }

    #[inline]
    fn free_slot(&mut self, tet: TetId) {
        self.set_row(tet, [VertexId::GHOST; 4], [TetFace::NONE; 4]);
        self.rows.free.push(tet);
    }
}
