//! The cavity of a new vertex: the tets whose spheres contain it, and the tets that fill the hole.
//!
//! # Method
//! ```text
//!   before            cavity            after          1. from the tet that contains p, spread over faces while the
//!   *-----*           *-----*           *-----*           sphere across the face contains p;
//!   |\   /|           |     |           |\   /|        2. each face where the spread stops, with p, makes a tet;
//!   | \ / |    ->     |  p  |    ->     |  p  |        3. two of these are neighbours where their faces share an
//!   |  *  |           |     |           |/   \|           edge: the edge, seen from one, is looked up by the other.
//!   *-----*           *-----*           *-----*
//! ```
//! The sphere test across a face of a cavity tet needs only the apex behind it: the face's part of the determinant
//! comes from the coordinates of the cavity tet, already relative to p. A ghost tet is in the cavity when p lies
//! strictly beyond its hull face, or in the plane of that face and the finite tet behind it is in the cavity.
//! # Source
//! [Bowyer1981], [Watson1981]; edge matrix for the neighbours as in [MarotPellerinRemacle2019] section 2.
//! # Invariants
//! With exact predicates and the perturbation of `geometry::perturbation` the cavity is star-shaped around p, and no
//! new tet is flat. Unless the outcome is `Inserted`, the mesh is as it was.
//! # Cost
//! About 20 tets removed and 27 made in a random mesh. Scratch is reused.

use glam::DVec3;
use rustc_hash::FxHashMap;

use super::kernel_mesh::KernelMesh;
use crate::geometry::fixed_point::FixedPoint;
use crate::geometry::perturbation::is_cospherical_point_inside;
use crate::geometry::predicates::{
    FaceCofactors, LiftedPoint, are_box_corners, face_cofactors, insphere, insphere_error_bound, insphere_exact,
    orient3d,
};
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::TET_FACES;

/// Vertices of a cavity boundary up to which the edge matrix is used; larger ones (one in a million) use a hash map.
const MATRIX_VERTICES: usize = 64;

/// Slots of the table from vertex to matrix row; at most half full.
const TABLE_SLOTS: usize = 2 * MATRIX_VERTICES;

/// What became of an insertion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Insertion {
    /// Done; a tet at the new vertex.
    Inserted(TetId),
    /// Another thread has claimed a tet that is needed.
    Claimed,
    /// Another thread has changed the tet to start from: it is not one of the cavity any more.
    Moved,
    /// Too few free slots.
    NoRoom,
}

/// A face where the cavity ends.
#[derive(Debug, Clone, Copy)]
struct BoundaryFace {
    /// The side outside that faces the cavity.
    outside: TetFace,
    /// Its vertices, outward from the cavity.
    vertices: [VertexId; 3],
}

/// Scratch of one thread, and the static filter of its point set.
pub(super) struct Cavity {
    tets: Vec<TetId>,
    boundary: Vec<BoundaryFace>,
    new_tets: Vec<TetId>,
    /// `matrix[row of u][row of v]`: the side waiting for its neighbour across the edge u v; `NONE` between uses.
    matrix: Vec<TetFace>,
    table: [(VertexId, u8); TABLE_SLOTS],
    used_slots: Vec<u8>,
    edges: FxHashMap<(VertexId, VertexId), TetFace>,
    /// Error bound of every in-sphere determinant within the extent of all points.
    static_bound: f64,
    /// Whole numbers for the exact tests.
    fixed: Option<FixedPoint>,
    /// Determinants that the filters could not decide.
    pub exact_tests: u64,
}

impl Cavity {
    /// Scratch for points within a box of this extent.
    pub fn new(extent: DVec3, fixed: Option<FixedPoint>) -> Self {
        Self {
            tets: Vec::new(),
            boundary: Vec::new(),
            new_tets: Vec::new(),
            matrix: vec![TetFace::NONE; MATRIX_VERTICES * MATRIX_VERTICES],
            table: [(VertexId::NONE, 0); TABLE_SLOTS],
            used_slots: Vec::new(),
            edges: FxHashMap::default(),
            static_bound: insphere_error_bound(extent, extent.length_squared()),
            fixed,
            exact_tests: 0,
        }
    }

    /// Inserts `vertex` into the mesh; `start` is the tet that contains it, or a ghost tet that sees it.
    pub fn insert<M: KernelMesh>(&mut self, mesh: &mut M, vertex: VertexId, start: TetId) -> Insertion {
        let outcome = match self.collect(mesh, mesh.point(vertex), start) {
            Err(reason) => reason,
            Ok(()) if !mesh.has_room(self.boundary.len().saturating_sub(self.tets.len())) => Insertion::NoRoom,
            Ok(()) => Insertion::Inserted(self.fill(mesh, vertex)),
        };
        if !matches!(outcome, Insertion::Inserted(_)) {
            for &tet in &self.tets {
                mesh.set_mark(tet, false);
            }
        }
        outcome
    }

    /// Step 1, or why not.
    fn collect<M: KernelMesh>(&mut self, mesh: &mut M, point: DVec3, start: TetId) -> Result<(), Insertion> {
        self.tets.clear();
        self.boundary.clear();
        if M::IS_SHARED {
            self.check_start(mesh, point, start)?;
        }
        mesh.set_mark(start, true);
        self.tets.push(start);
        let mut next = 0;
        while next < self.tets.len() {
            let tet = self.tets[next];
            next += 1;
            let vertices = mesh.vertices(tet);
            let neighbors = mesh.neighbors(tet);
            let is_finite = !vertices.iter().any(|v| v.is_ghost());
            let mut rows = [LiftedPoint::default(); 4];
            if is_finite {
                for i in 0..4 {
                    rows[i] = LiftedPoint::new(mesh.point(vertices[i]) - point);
                }
            }
            for face in 0..4 {
                let side = neighbors[face];
                if !mesh.claim(side.tet()) {
                    return Err(Insertion::Claimed);
                }
                if mesh.is_marked(side.tet()) {
                    continue;
                }
                let corners = TET_FACES[face];
                let other = mesh.vertices(side.tet());
                let conflict = if is_finite && !other[side.face()].is_ghost() {
                    let face = [&rows[corners[0]], &rows[corners[1]], &rows[corners[2]]];
                    self.has_apex_conflict(mesh, point, &other, side.face(), face)
                } else {
                    self.has_conflict(mesh, point, side.tet(), &other)?
                };
                if conflict {
                    mesh.set_mark(side.tet(), true);
                    self.tets.push(side.tet());
                } else {
                    self.boundary.push(BoundaryFace {
                        outside: side,
                        vertices: [vertices[corners[0]], vertices[corners[1]], vertices[corners[2]]],
                    });
                }
            }
        }
        Ok(())
    }

    /// Whether the tet that a walk ended in is one of the cavity still, now that nobody else can change it.
    fn check_start<M: KernelMesh>(&mut self, mesh: &mut M, point: DVec3, start: TetId) -> Result<(), Insertion> {
        if !mesh.claim(start) {
            return Err(Insertion::Claimed);
        }
        let vertices = mesh.vertices(start);
        let is_free = vertices.iter().filter(|v| v.is_ghost()).count() > 1;
        if is_free || vertices.iter().any(|&v| !v.is_ghost() && mesh.point(v) == point) {
            return Err(Insertion::Moved);
        }
        if self.has_conflict(mesh, point, start, &vertices)? { Ok(()) } else { Err(Insertion::Moved) }
    }

    /// Whether the sphere of a finite tet contains the point, given the rows of the face opposite to `apex`.
    #[inline(always)]
    fn has_apex_conflict<M: KernelMesh>(
        &mut self,
        mesh: &M,
        point: DVec3,
        other: &[VertexId; 4],
        apex: usize,
        face: [&LiftedPoint; 3],
    ) -> bool {
        let cofactors: FaceCofactors = face_cofactors(face[0], face[1], face[2]);
        let row = LiftedPoint::new(mesh.point(other[apex]) - point);
        let det = cofactors.dot(&row);
        if det > self.static_bound {
            return true;
        }
        if det < -self.static_bound {
            return false;
        }
        let [a, b, c] = face;
        let largest = a.offset.abs().max(b.offset.abs()).max(c.offset.abs().max(row.offset.abs()));
        let bound = insphere_error_bound(largest, a.lift.max(b.lift).max(c.lift.max(row.lift)));
        if det > bound {
            return true;
        }
        if det < -bound {
            return false;
        }
        self.exact_conflict(other.map(|v| mesh.point(v)), point)
    }

    #[inline(never)]
    fn exact_conflict(&mut self, tet: [DVec3; 4], point: DVec3) -> bool {
        self.exact_tests += 1;
        let [a, b, c, d] = tet;
        let sign = if are_box_corners([a, b, c, d, point]) {
            0.0
        } else {
            let fixed = self.fixed.and_then(|fixed| fixed.insphere(a, b, c, d, point));
            fixed.unwrap_or_else(|| insphere_exact(a, b, c, d, point))
        };
        if sign == 0.0 { is_cospherical_point_inside(tet, point) } else { sign > 0.0 }
    }

    /// The general test, for ghost tets and across their faces.
    fn has_conflict<M: KernelMesh>(
        &mut self,
        mesh: &mut M,
        point: DVec3,
        tet: TetId,
        vertices: &[VertexId; 4],
    ) -> Result<bool, Insertion> {
        let Some(ghost) = vertices.iter().position(|v| v.is_ghost()) else {
            let points = vertices.map(|v| mesh.point(v));
            let [a, b, c, d] = points;
            let sign = insphere(a, b, c, d, point);
            return Ok(if sign == 0.0 { is_cospherical_point_inside(points, point) } else { sign > 0.0 });
        };
        let [a, b, c] = TET_FACES[ghost].map(|i| mesh.point(vertices[i]));
        // The ghost lies on the positive side of its hull face turned over.
        let beyond = orient3d(a, c, b, point);
        if beyond != 0.0 {
            return Ok(beyond > 0.0);
        }
        let inner = mesh.neighbors(tet)[ghost].tet();
        if !mesh.claim(inner) {
            return Err(Insertion::Claimed);
        }
        if mesh.is_marked(inner) {
            return Ok(true);
        }
        let vertices = mesh.vertices(inner);
        self.has_conflict(mesh, point, inner, &vertices)
    }

    /// Steps 2 and 3; returns the last tet made.
    fn fill<M: KernelMesh>(&mut self, mesh: &mut M, vertex: VertexId) -> TetId {
        for &tet in &self.tets {
            mesh.set_mark(tet, false);
        }
        // Freed slots are used first: they are warm.
        self.new_tets.clear();
        let reused = self.tets.len().min(self.boundary.len());
        self.new_tets.extend_from_slice(&self.tets[..reused]);
        for _ in reused..self.boundary.len() {
            self.new_tets.push(mesh.take_slot());
        }
        for &tet in &self.tets[reused..] {
            mesh.free_slot(tet);
        }
        // A triangulated sphere with F faces has F / 2 + 2 vertices.
        if self.boundary.len() / 2 + 2 <= MATRIX_VERTICES {
            self.fill_by_matrix(mesh, vertex);
        } else {
            self.fill_by_map(mesh, vertex);
        }
        self.new_tets[self.new_tets.len() - 1]
    }

    fn fill_by_matrix<M: KernelMesh>(&mut self, mesh: &mut M, vertex: VertexId) {
        let mut count = 0u8;
        for i in 0..self.boundary.len() {
            let BoundaryFace { outside, vertices: [a, b, c] } = self.boundary[i];
            let tet = self.new_tets[i];
            let mut row = |v| usize::from(row_of(&mut self.table, &mut self.used_slots, &mut count, v));
            let (p, q, r) = (row(a), row(b), row(c));
            mesh.set_row(tet, [vertex, a, b, c], [outside, TetFace::NONE, TetFace::NONE, TetFace::NONE]);
            mesh.set_neighbor(outside, TetFace::new(tet, 0));
            // The edge opposite to a in this face is b c, and so on; the other face has it as c b.
            for (face, u, v) in [(1, q, r), (2, r, p), (3, p, q)] {
                let side = TetFace::new(tet, face);
                let waiting = std::mem::replace(&mut self.matrix[v * MATRIX_VERTICES + u], TetFace::NONE);
                if waiting == TetFace::NONE {
                    self.matrix[u * MATRIX_VERTICES + v] = side;
                } else {
                    mesh.glue(side, waiting);
                }
            }
        }
        for slot in self.used_slots.drain(..) {
            self.table[usize::from(slot)].0 = VertexId::NONE;
        }
    }

    fn fill_by_map<M: KernelMesh>(&mut self, mesh: &mut M, vertex: VertexId) {
        for i in 0..self.boundary.len() {
            let BoundaryFace { outside, vertices: [a, b, c] } = self.boundary[i];
            let tet = self.new_tets[i];
            mesh.set_row(tet, [vertex, a, b, c], [outside, TetFace::NONE, TetFace::NONE, TetFace::NONE]);
            mesh.set_neighbor(outside, TetFace::new(tet, 0));
            for (face, u, v) in [(1, b, c), (2, c, a), (3, a, b)] {
                let side = TetFace::new(tet, face);
                match self.edges.remove(&(v, u)) {
                    Some(waiting) => mesh.glue(side, waiting),
                    None => {
                        self.edges.insert((u, v), side);
                    }
                }
            }
        }
        debug_assert!(self.edges.is_empty());
    }
}

/// The matrix row of a vertex, a new one at its first appearance. The ghost is stored one below the sentinel.
#[inline]
fn row_of(table: &mut [(VertexId, u8); TABLE_SLOTS], used: &mut Vec<u8>, count: &mut u8, vertex: VertexId) -> u8 {
    let key = if vertex.is_ghost() { VertexId(u32::MAX - 1) } else { vertex };
    // Fibonacci hashing: the high bits of the product spread neighbouring ids.
    let mut slot = (key.0.wrapping_mul(0x9e37_79b1) >> (32 - TABLE_SLOTS.trailing_zeros())) as usize;
    loop {
        let entry = &mut table[slot];
        if entry.0 == key {
            return entry.1;
        }
        if entry.0 == VertexId::NONE {
            *entry = (key, *count);
            used.push(slot as u8);
            *count += 1;
            return entry.1;
        }
        slot = (slot + 1) % TABLE_SLOTS;
    }
}
