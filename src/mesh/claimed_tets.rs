//! A tet complex edited by several threads at once: the store of one thread, under claims.
//!
//! # Method
//! For one pass the arrays of a [`TetComplex`] are shared as atomic words ([`with_claims`]), vertices get claim words,
//! and free slots, with the room asked for, are dealt to the threads. Each thread edits through its [`ClaimedTets`], by the
//! rules of `mesh::tet_store`. When the pass ends the complex is a plain one again.
//!
//! # Protocol
//! - *Claim and look again*: a thread reads the row of a tet without owning it, claims its vertices, and reads again
//!   ([`TetStore::try_claim_tet`]). If the row is unchanged the tet is live and stays so: whoever changes or frees a row
//!   holds the vertices it had and those it gets, so every word equal to a vertex that I hold now was written by an
//!   earlier holder of that vertex, whose release I acquired. All such writes are ordered before my second look, and
//!   the last of them left exactly this row; a later one would have to hold one of my vertices.
//! - *Freed and reused slots*: a freed row is four ghosts, never equal to a row with four different vertices; a reused
//!   one passes the second look only if it is a live tet of the same vertices again, which is as good.
//! - *Neighbour entries* are written by holders of the face's three vertices: both sides of a face by the same holder.
//! - *No deadlock*: claims never wait.
//!
//! # Cost
//! Accesses are plain moves; a claim costs one compare-exchange per vertex and attempt.

use glam::DVec3;

use super::tet_complex::TetComplex;
use super::tet_flags::TetFlags;
use super::tet_store::TetStore;
use crate::error::{Error, Result};
use crate::index::{Label, TetFace, TetId, VertexId};
use crate::parallel::claim_table::{Claim, ClaimTable};
use crate::parallel::id_allocator::{IdAllocator, IdPool};
use crate::parallel::shared_rows::{SharedLongs, SharedShorts, SharedWords};

/// The view of one thread. Its claims are released, and its free slots handed back, when it is dropped.
pub struct ClaimedTets<'a> {
    holder: u32,
    /// Three words a vertex: the bits of the coordinates.
    points: SharedLongs<'a>,
    /// Four words of padding, then four vertices and four neighbours a tet.
    rows: SharedWords<'a>,
    flags: SharedShorts<'a>,
    labels: SharedShorts<'a>,
    vertex_tet: SharedWords<'a>,
    claims: &'a ClaimTable,
    ids: IdAllocator<'a>,
    held: Vec<VertexId>,
}

/// Shares `complex` between `threads` views while `job` runs, with room for `room` more tets than there are now. The
/// table of claims is kept by the caller from pass to pass: all free before and after.
///
/// # Errors
/// `CapacityExceeded` or `OutOfMemory` for the room.
pub fn with_claims<R>(
    complex: &mut TetComplex,
    claims: &mut ClaimTable,
    threads: usize,
    room: usize,
    job: impl FnOnce(Vec<ClaimedTets<'_>>) -> R,
) -> Result<R> {
    let missing = room.saturating_sub(complex.free_slots.len());
    complex.add_free_slots(missing)?;
    // Dealt from the end: the slots freed last.
    let pool = IdPool::new(bytemuck::cast_vec(std::mem::take(&mut complex.free_slots)));
    claims.grow_to(complex.points.len());
    let claims = &*claims;
    let points = SharedLongs::new(bytemuck::cast_slice_mut(&mut complex.points));
    let rows = SharedWords::new(complex.halves.as_flattened_mut());
    let flags = SharedShorts::new(bytemuck::cast_slice_mut(&mut complex.tet_flags));
    let labels = SharedShorts::new(bytemuck::cast_slice_mut(&mut complex.tet_labels));
    let vertex_tet = SharedWords::new(bytemuck::cast_slice_mut(&mut complex.vertex_tet));
    let views = (0..threads.max(1) as u32)
        .map(|holder| ClaimedTets {
            holder,
            points,
            rows,
            flags,
            labels,
            vertex_tet,
            claims,
            ids: pool.allocator(),
            held: Vec::new(),
        })
        .collect();
    let result = job(views);
    debug_assert!(claims.is_all_free());
    complex.free_slots = bytemuck::cast_vec(pool.into_free());
    Ok(result)
}

/// The first word of a tet's vertices.
#[inline]
fn vertices_at(tet: TetId) -> usize {
    8 * tet.index() + 4
}

/// The first word of a tet's neighbours.
#[inline]
fn neighbors_at(tet: TetId) -> usize {
    8 * tet.index() + 8
}

/// The word of one neighbour.
#[inline]
fn neighbor_at(side: TetFace) -> usize {
    neighbors_at(side.tet()) + side.face()
}

impl TetStore for ClaimedTets<'_> {
    #[inline]
    fn vertex_count(&self) -> usize {
        self.vertex_tet.len()
    }

    #[inline]
    fn slot_count(&self) -> usize {
        self.flags.len()
    }

    #[inline]
    fn point(&self, vertex: VertexId) -> DVec3 {
        let [x, y, z] = self.points.load_row::<3>(3 * vertex.index());
        DVec3::new(f64::from_bits(x), f64::from_bits(y), f64::from_bits(z))
    }

    #[inline]
    fn vertices(&self, tet: TetId) -> [VertexId; 4] {
        let [a, b, c, d] = self.rows.load_row::<4>(vertices_at(tet));
        [VertexId(a), VertexId(b), VertexId(c), VertexId(d)]
    }

    #[inline]
    fn neighbors(&self, tet: TetId) -> [TetFace; 4] {
        let [a, b, c, d] = self.rows.load_row::<4>(neighbors_at(tet));
        [TetFace(a), TetFace(b), TetFace(c), TetFace(d)]
    }

    #[inline]
    fn neighbor(&self, side: TetFace) -> TetFace {
        TetFace(self.rows.load(neighbor_at(side)))
    }

    #[inline]
    fn flags(&self, tet: TetId) -> TetFlags {
        TetFlags::from_bits(self.flags.load(tet.index()))
    }

    #[inline]
    fn label(&self, tet: TetId) -> Label {
        Label(self.labels.load(tet.index()))
    }

    #[inline]
    fn tet_of(&self, vertex: VertexId) -> TetId {
        TetId(self.vertex_tet.load(vertex.index()))
    }

    #[inline]
    fn set_point(&mut self, vertex: VertexId, point: DVec3) {
        self.points.store_row(3 * vertex.index(), [point.x.to_bits(), point.y.to_bits(), point.z.to_bits()]);
    }

    fn create_tet(&mut self, vertices: [VertexId; 4], label: Label) -> Result<TetId> {
        let Some(id) = self.ids.take() else {
            return Err(Error::LimitReached { reason: "no free tet is left in this pass".into() });
        };
        let tet = TetId(id);
        self.rows.store_row(neighbors_at(tet), [TetFace::NONE.0; 4]);
        self.flags.store(tet.index(), TetFlags::LIVE.bits());
        self.labels.store(tet.index(), label.0);
        self.rows.store_row::<4>(vertices_at(tet), bytemuck::cast(vertices));
        for v in vertices {
            if !v.is_ghost() {
                self.vertex_tet.store(v.index(), id);
            }
        }
        Ok(tet)
    }

    fn delete_tet(&mut self, tet: TetId) {
        self.rows.store_row(vertices_at(tet), [VertexId::GHOST.0; 4]);
        self.rows.store_row(neighbors_at(tet), [TetFace::NONE.0; 4]);
        self.flags.store(tet.index(), TetFlags::DELETED.bits());
        self.ids.recycle(tet.0);
    }

    #[inline]
    fn glue(&mut self, side: TetFace, other: TetFace) {
        self.rows.store(neighbor_at(side), other.0);
        self.rows.store(neighbor_at(other), side.0);
    }

    #[inline]
    fn unglue(&mut self, side: TetFace) {
        self.rows.store(neighbor_at(side), TetFace::NONE.0);
    }

    #[inline]
    fn set_vertices(&mut self, tet: TetId, vertices: [VertexId; 4]) {
        self.rows.store_row::<4>(vertices_at(tet), bytemuck::cast(vertices));
    }

    #[inline]
    fn set_flags(&mut self, tet: TetId, flags: TetFlags) {
        debug_assert!(!flags.is_deleted());
        self.flags.store(tet.index(), flags.bits());
    }

    #[inline]
    fn set_label(&mut self, tet: TetId, label: Label) {
        self.labels.store(tet.index(), label.0);
    }

    #[inline]
    fn set_tet_of(&mut self, vertex: VertexId, tet: TetId) {
        self.vertex_tet.store(vertex.index(), tet.0);
    }

    #[inline]
    fn try_claim(&mut self, vertex: VertexId) -> bool {
        if vertex.is_ghost() {
            return true;
        }
        match self.claims.try_claim(vertex.index(), self.holder) {
            Claim::Taken => {
                self.held.push(vertex);
                true
            }
            Claim::Held => true,
            Claim::Lost => false,
        }
    }

    #[inline]
    fn release_claims(&mut self) {
        for vertex in self.held.drain(..) {
            self.claims.release(vertex.index(), self.holder);
        }
    }

    #[inline]
    fn has_room(&mut self, count: usize) -> bool {
        self.ids.has_room(count)
    }
}

impl Drop for ClaimedTets<'_> {
    fn drop(&mut self) {
        self.release_claims();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::topology::{ShellTet, collect_shell};

    /// A cube of `n^3` cells of six tets each.
    fn cube(n: u32) -> TetComplex {
        let side = n + 1;
        let at = |i: u32, j: u32, k: u32| i + side * (j + side * k);
        let points = (0..side.pow(3))
            .map(|v| DVec3::new(f64::from(v % side), f64::from(v / side % side), f64::from(v / side / side)))
            .collect();
        let mut complex = TetComplex::with_points(points).unwrap();
        for cell in 0..n.pow(3) {
            let c = [cell % n, cell / n % n, cell / n / n];
            for (order, even) in [
                ([0, 1, 2], true),
                ([1, 2, 0], true),
                ([2, 0, 1], true),
                ([0, 2, 1], false),
                ([2, 1, 0], false),
                ([1, 0, 2], false),
            ] {
                // Kuhn's path from the lowest corner to the highest, one axis at a time.
                let mut p = c;
                let mut row = vec![at(p[0], p[1], p[2])];
                for axis in order {
                    p[axis] += 1;
                    row.push(at(p[0], p[1], p[2]));
                }
                if !even {
                    row.swap(2, 3);
                }
                complex.create_tet([row[0], row[1], row[2], row[3]].map(VertexId), Label(1)).unwrap();
            }
        }
        complex.pair_faces().unwrap();
        complex.check_invariants().unwrap();
        complex.check_orientation().unwrap();
        complex
    }

    /// Replaces a claimed tet by itself in another slot, with its vertices turned.
    fn replace(store: &mut ClaimedTets<'_>, tet: TetId) -> Result<bool> {
        if !store.try_claim_tet(tet) || !store.has_room(1) {
            return Ok(false);
        }
        let [a, b, c, d] = store.vertices(tet);
        let outside = store.neighbors(tet);
        let label = store.label(tet);
        store.delete_tet(tet);
        let new = store.create_tet([b, c, a, d], label)?;
        for (face, from) in [(0, 1), (1, 2), (2, 0), (3, 3)] {
            if outside[from] != TetFace::NONE {
                store.glue(TetFace::new(new, face), outside[from]);
            }
        }
        Ok(true)
    }

    #[test]
    fn threads_that_replace_tets_leave_a_valid_complex() {
        let rounds = if cfg!(miri) { 40 } else { 20_000 };
        let mut complex = cube(3);
        let before = complex.live_count();
        let replaced: usize = with_claims(&mut complex, &mut ClaimTable::default(), 4, 1000, |views| {
            std::thread::scope(|scope| {
                let threads: Vec<_> = views
                    .into_iter()
                    .map(|mut store| {
                        scope.spawn(move || {
                            let mut state = store.holder + 1;
                            let mut count = 0;
                            for _ in 0..rounds {
                                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                                let tet = TetId((state >> 8) % store.slot_count() as u32);
                                count += usize::from(replace(&mut store, tet).unwrap());
                                store.release_claims();
                            }
                            count
                        })
                    })
                    .collect();
                threads.into_iter().map(|t| t.join().unwrap()).sum()
            })
        })
        .unwrap();
        assert!(replaced > 0);
        assert_eq!(complex.live_count(), before);
        complex.check_invariants().unwrap();
        complex.check_orientation().unwrap();
    }

    #[test]
    fn claims_exclude_the_other_view_until_released() {
        let mut complex = cube(1);
        with_claims(&mut complex, &mut ClaimTable::default(), 2, 10, |mut views| {
            let mut second = views.pop().unwrap();
            let mut first = views.pop().unwrap();
            assert!(first.try_claim_tet(TetId(0)));
            assert!(!second.try_claim_tet(TetId(1)), "all six tets share the diagonal");
            second.release_claims();
            first.release_claims();
            assert!(second.try_claim_tet(TetId(1)) && second.try_claim(VertexId::GHOST));
            let mut shell = Vec::new();
            collect_shell(&second, ShellTet::new(TetId(0), 0, 3), 99, &mut shell);
            assert_eq!(shell.len(), 6);
        })
        .unwrap();
        complex.check_invariants().unwrap();
    }
}
