//! Access to an editable tet mesh: one trait, so that an operation is written once and runs alone or beside others.
//!
//! # Method
//! A topological operation is generic over [`TetStore`] and proceeds in three steps: *plan* reads rows through the
//! trait, claims every vertex whose tets it will replace and computes what it would do; *check* looks at quality and
//! constraints; *commit* creates, glues and deletes tets. [`crate::mesh::tet_complex::TetComplex`] implements the trait for one thread, where
//! every claim succeeds; `mesh::claimed_tets` implements it for one of several
//! threads.
//!
//! # Invariants
//! The rules of a claimed store, which every operation keeps (they cost nothing in an exclusive one):
//! 1. A tet may be created, deleted, flagged or labelled only by the holder of all its vertices (ghost excepted: it
//!    needs no claim).
//! 2. The neighbour entry of a face, and its mirror, may be written by the holder of the three vertices of that face.
//! 3. Hence a live tet one of whose vertices is held by me stays alive and keeps its vertices; what else is read may
//!    change at any time and is read again after claiming.
//! 4. `tet_of(v)` and the point of `v` may be written by the holder of `v`.

use glam::DVec3;

use super::numbering::{TET_EDGE_BETWEEN, TET_FACES};
use super::tet_flags::TetFlags;
use crate::error::Result;
use crate::geometry::predicates::orient3d;
use crate::index::{Label, TetFace, TetId, VertexId};

/// Whether one of four vertices is the ghost.
#[inline]
pub fn has_ghost([a, b, c, d]: [VertexId; 4]) -> bool {
    a.is_ghost() | b.is_ghost() | c.is_ghost() | d.is_ghost()
}

/// Reads and writes the rows of a tet mesh.
pub trait TetStore {
    /// Number of vertices, the ghost not counted.
    fn vertex_count(&self) -> usize;

    /// Number of slots; tet ids are below it.
    fn slot_count(&self) -> usize;

    /// The point of a vertex, world millimetres.
    fn point(&self, vertex: VertexId) -> DVec3;

    /// The vertices of a tet in positive order; four ghosts for a free slot.
    fn vertices(&self, tet: TetId) -> [VertexId; 4];

    /// For each face the side of the neighbour that faces it; `TetFace::NONE` where there is none.
    fn neighbors(&self, tet: TetId) -> [TetFace; 4];

    /// The side that faces `side`, or `TetFace::NONE`.
    fn neighbor(&self, side: TetFace) -> TetFace;

    /// The flags of a slot.
    fn flags(&self, tet: TetId) -> TetFlags;

    /// The label of a tet.
    fn label(&self, tet: TetId) -> Label;

    /// A live tet at `vertex`, or `TetId::NONE` for a vertex without tets.
    fn tet_of(&self, vertex: VertexId) -> TetId;

    /// Moves a vertex.
    fn set_point(&mut self, vertex: VertexId, point: DVec3);

    /// Makes a tet without neighbours and without flags, and points `tet_of` of its vertices to it.
    ///
    /// # Errors
    /// `CapacityExceeded` at 2^30 tets; `LimitReached` where a claimed store has no free slot left (the driver makes
    /// room and starts another round).
    fn create_tet(&mut self, vertices: [VertexId; 4], label: Label) -> Result<TetId>;

    /// Frees the slot of a tet. The neighbours' entries and `tet_of` are the caller's to mend.
    fn delete_tet(&mut self, tet: TetId);

    /// Makes two sides neighbours of each other.
    fn glue(&mut self, side: TetFace, other: TetFace);

    /// Removes the neighbour of one side (the other side is left as it is).
    fn unglue(&mut self, side: TetFace);

    /// Replaces the vertices of a live tet; neighbours, flags and label stay.
    fn set_vertices(&mut self, tet: TetId, vertices: [VertexId; 4]);

    /// Replaces the flags of a live tet.
    fn set_flags(&mut self, tet: TetId, flags: TetFlags);

    /// Replaces the label of a live tet.
    fn set_label(&mut self, tet: TetId, label: Label);

    /// Says which tet represents a vertex.
    fn set_tet_of(&mut self, vertex: VertexId, tet: TetId);

    /// Whether this thread now holds `vertex`; always true in an exclusive store and for the ghost.
    fn try_claim(&mut self, vertex: VertexId) -> bool;

    /// Gives up every claim of this thread.
    fn release_claims(&mut self);

    /// Whether `count` more tets can be created in this pass, so that a commit never fails half-way.
    fn has_room(&mut self, count: usize) -> bool;

    // ---- what follows is the same for every store ----

    /// Claims several vertices; false (with some of them held) as soon as one is another thread's.
    #[inline]
    fn try_claim_all(&mut self, vertices: &[VertexId]) -> bool {
        vertices.iter().all(|&v| self.try_claim(v))
    }

    /// Claims the vertices of a tet and makes sure that it is still the tet it was: afterwards it is stable.
    #[inline]
    fn try_claim_tet(&mut self, tet: TetId) -> bool {
        let [a, b, c, d] = self.vertices(tet);
        let is_claimed = a != b && self.try_claim(a) && self.try_claim(b) && self.try_claim(c) && self.try_claim(d);
        is_claimed && {
            let [e, f, g, h] = self.vertices(tet);
            (a == e) & (b == f) & (c == g) & (d == h)
        }
    }

    /// Whether the slot holds a tet.
    #[inline]
    fn is_live(&self, tet: TetId) -> bool {
        !self.flags(tet).is_deleted()
    }

    /// Whether the tet has the vertex at infinity.
    #[inline]
    fn is_ghost_tet(&self, tet: TetId) -> bool {
        has_ghost(self.vertices(tet))
    }

    /// The local number of `vertex` in `tet`.
    #[inline]
    fn local_vertex(&self, tet: TetId, vertex: VertexId) -> Option<usize> {
        let [a, b, c, d] = self.vertices(tet);
        match vertex {
            v if v == a => Some(0),
            v if v == b => Some(1),
            v if v == c => Some(2),
            v if v == d => Some(3),
            _ => None,
        }
    }

    /// The vertices of a side, outward normal.
    #[inline]
    fn face_vertices(&self, side: TetFace) -> [VertexId; 3] {
        let v = self.vertices(side.tet());
        // Written out here and below: closures of array `map` are not inlined reliably, and these are the hottest reads.
        let [i, j, k] = TET_FACES[side.face()];
        [v[i], v[j], v[k]]
    }

    /// The vertex opposite to a side.
    #[inline]
    fn apex(&self, side: TetFace) -> VertexId {
        self.vertices(side.tet())[side.face()]
    }

    /// The points of four vertices.
    #[inline]
    fn corners(&self, [a, b, c, d]: [VertexId; 4]) -> [DVec3; 4] {
        [self.point(a), self.point(b), self.point(c), self.point(d)]
    }

    /// The points of three vertices.
    #[inline]
    fn triangle(&self, [a, b, c]: [VertexId; 3]) -> [DVec3; 3] {
        [self.point(a), self.point(b), self.point(c)]
    }

    /// The points of a finite tet.
    #[inline]
    fn points_of(&self, tet: TetId) -> [DVec3; 4] {
        self.corners(self.vertices(tet))
    }

    /// Whether the exact volume of a finite tet is positive.
    fn is_positive(&self, tet: TetId) -> bool {
        let [a, b, c, d] = self.points_of(tet);
        orient3d(a, b, c, d) > 0.0
    }

    /// Whether a side lies on a constraint.
    #[inline]
    fn is_face_constrained(&self, side: TetFace) -> bool {
        self.flags(side.tet()).is_face_constrained(side.face())
    }

    /// Whether the edge between two local vertices of a tet is constrained.
    #[inline]
    fn is_edge_constrained(&self, tet: TetId, first: usize, second: usize) -> bool {
        self.flags(tet).is_edge_constrained(TET_EDGE_BETWEEN[first][second])
    }

    /// Constrains or frees a face on both of its sides.
    fn constrain_face(&mut self, side: TetFace, constrained: bool) {
        for s in [side, self.neighbor(side)] {
            if s != TetFace::NONE {
                let flags = self.flags(s.tet()).with_face(s.face(), constrained);
                self.set_flags(s.tet(), flags);
            }
        }
    }
}
