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
//! The vertices of the cavity get numbers of their own and are lifted once, relative to p; the sphere test across a face of a
//! cavity tet then needs only the apex behind it. A ghost tet is in the cavity when p lies strictly beyond its hull face, or
//! in the plane of that face and the finite tet behind it is in the cavity.
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
use crate::geometry::granularity::Granularity;
use crate::geometry::perturbation::{
    is_box_corner_inside, is_cospherical_point_inside, is_exact_cospherical_point_inside,
};
use crate::geometry::predicates::{
    FaceCofactors, LiftedPoint, face_cofactors, insphere_error_bound, insphere_exact, orient3d_in,
};
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::TET_FACES;

/// Vertices of a cavity up to which the edge matrix is used, and of most cavities, whose part of it stays in the fastest cache;
/// larger ones (one in a million) use a hash map.
const MATRIX_VERTICES: usize = 64;
const FEW_VERTICES: usize = 32;

/// Slots of the table of a cavity's vertices at first.
const FIRST_SLOTS: usize = 128;

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

/// Constants of a point set that decide in-sphere tests.
#[derive(Debug, Clone, Copy)]
pub(super) struct Arithmetic {
    /// Error bound of every in-sphere determinant within the extent of all points.
    static_bound: f64,
    /// Where floating point is exact.
    granularity: Granularity,
    /// Whole numbers for the exact tests.
    fixed: Option<FixedPoint>,
}

impl Arithmetic {
    /// For points within this box.
    pub fn new(points: impl Iterator<Item = DVec3>, low: DVec3, high: DVec3) -> Self {
        let extent = high - low;
        let largest = low.abs().max(high.abs()).max_element();
        Self {
            static_bound: insphere_error_bound(extent, extent.length_squared()),
            granularity: Granularity::of(points, largest),
            fixed: FixedPoint::for_magnitude(largest),
        }
    }
}

/// A tet of the cavity, with the cavity's numbers of its vertices.
#[derive(Debug, Clone, Copy)]
struct CavityTet {
    tet: TetId,
    corners: [u32; 4],
}

/// A face where the cavity ends.
#[derive(Debug, Clone, Copy)]
struct BoundaryFace {
    /// The side outside that faces the cavity.
    outside: TetFace,
    /// The cavity's numbers of its vertices, outward from the cavity.
    corners: [u32; 3],
}

/// The vertices of a cavity, numbered as they come.
#[derive(Default)]
struct CavityVertices {
    ids: Vec<VertexId>,
    /// Relative to the new point; anything for the ghost.
    rows: Vec<LiftedPoint>,
    /// Numbers by hash of the id, `EMPTY` elsewhere; at most half full.
    table: Vec<u32>,
    /// Slots in use.
    slots: Vec<u32>,
}

const EMPTY: u32 = u32::MAX;

impl CavityVertices {
    fn clear(&mut self) {
        self.ids.clear();
        self.rows.clear();
        for slot in self.slots.drain(..) {
            self.table[slot as usize] = EMPTY;
        }
    }

    /// The number of a vertex, a new one when it comes first.
    #[inline]
    fn number_of(&mut self, id: VertexId, row: LiftedPoint) -> u32 {
        if 2 * self.ids.len() >= self.table.len() {
            self.grow();
        }
        let slot = self.slot_of(id);
        if self.table[slot] == EMPTY {
            self.table[slot] = self.ids.len() as u32;
            self.slots.push(slot as u32);
            self.ids.push(id);
            self.rows.push(row);
        }
        self.table[slot]
    }

    /// The slot that a vertex has or gets.
    #[inline]
    fn slot_of(&self, id: VertexId) -> usize {
        let last = self.table.len() - 1;
        // Fibonacci hashing: the high bits of the product spread neighbouring ids.
        let mut slot = id.0.wrapping_mul(0x9e37_79b1) as usize >> (32 - self.table.len().trailing_zeros());
        while self.table[slot] != EMPTY && self.ids[self.table[slot] as usize] != id {
            slot = (slot + 1) & last;
        }
        slot
    }

    #[cold]
    fn grow(&mut self) {
        let slots = (2 * self.table.len()).max(FIRST_SLOTS);
        self.table = vec![EMPTY; slots];
        self.slots.clear();
        for number in 0..self.ids.len() {
            let slot = self.slot_of(self.ids[number]);
            self.table[slot] = number as u32;
            self.slots.push(slot as u32);
        }
    }
}

/// Scratch of one thread.
pub(super) struct Cavity {
    tets: Vec<CavityTet>,
    vertices: CavityVertices,
    boundary: Vec<BoundaryFace>,
    new_tets: Vec<TetId>,
    /// At the numbers of u and v: the side waiting for its neighbour across the edge u v; `NONE` between uses.
    matrix: Vec<TetFace>,
    edges: FxHashMap<(u32, u32), TetFace>,
    arithmetic: Arithmetic,
    /// Determinants that the filters could not decide.
    pub exact_tests: u64,
}

impl Cavity {
    /// Scratch for points of such arithmetic.
    pub fn new(arithmetic: Arithmetic) -> Self {
        Self {
            tets: Vec::new(),
            vertices: CavityVertices::default(),
            boundary: Vec::new(),
            new_tets: Vec::new(),
            matrix: vec![TetFace::NONE; MATRIX_VERTICES * MATRIX_VERTICES],
            edges: FxHashMap::default(),
            arithmetic,
            exact_tests: 0,
        }
    }

    /// The granularity of the points.
    pub fn granularity(&self) -> Granularity {
        self.arithmetic.granularity
    }

    /// Inserts `vertex` into the mesh; `start` is the tet that contains it, or a ghost tet that sees it.
    pub fn insert<M: KernelMesh>(&mut self, mesh: &mut M, vertex: VertexId, start: TetId) -> Insertion {
        let outcome = match self.collect(mesh, mesh.point(vertex), start) {
            Err(reason) => reason,
            Ok(()) if !mesh.has_room(self.boundary.len().saturating_sub(self.tets.len())) => Insertion::NoRoom,
            Ok(()) => Insertion::Inserted(self.fill(mesh, vertex)),
        };
        if !matches!(outcome, Insertion::Inserted(_)) {
            for cavity_tet in &self.tets {
                mesh.set_mark(cavity_tet.tet, false);
            }
        }
        outcome
    }

    /// Step 1, or why not.
    fn collect<M: KernelMesh>(&mut self, mesh: &mut M, point: DVec3, start: TetId) -> Result<(), Insertion> {
        self.tets.clear();
        self.boundary.clear();
        self.vertices.clear();
        if M::IS_SHARED {
            self.check_start(mesh, point, start)?;
        }
        let corners = mesh.vertices(start).map(|v| self.vertices.number_of(v, lifted(mesh, v, point)));
        mesh.set_mark(start, true);
        self.tets.push(CavityTet { tet: start, corners });
        let mut next = 0;
        while next < self.tets.len() {
            let CavityTet { tet, corners } = self.tets[next];
            next += 1;
            self.spread(mesh, point, (tet, corners))?;
        }
        Ok(())
    }

    /// Step 1 across the faces of one tet.
    #[inline(always)]
    fn spread<M: KernelMesh>(
        &mut self,
        mesh: &mut M,
        point: DVec3,
        (tet, corners): (TetId, [u32; 4]),
    ) -> Result<(), Insertion> {
        let neighbors = mesh.neighbors(tet);
        // Read at once, so that the processor waits for them together.
        let mut rows = [[VertexId::GHOST; 4]; 4];
        let mut open = [0; 4];
        let mut open_count = 0;
        for face in 0..4 {
            let other = neighbors[face].tet();
            if !mesh.claim(other) {
                return Err(Insertion::Claimed);
            }
            if !mesh.is_marked(other) {
                rows[face] = mesh.vertices(other);
                open[open_count] = face;
                open_count += 1;
            }
        }
        let is_finite = !corners.iter().any(|&corner| self.vertices.ids[corner as usize].is_ghost());
        for &face in &open[..open_count] {
            let (side, other) = (neighbors[face], rows[face]);
            let triangle = TET_FACES[face].map(|i| corners[i]);
            let apex = other[side.face()];
            let apex_row = lifted(mesh, apex, point);
            let conflict = if is_finite && !apex.is_ghost() {
                let [a, b, c] = triangle.map(|corner| &self.vertices.rows[corner as usize]);
                let points = || other.map(|v| mesh.point(v));
                self.arithmetic.is_in_sphere([a, b, c, &apex_row], points, point, &mut self.exact_tests)
            } else {
                self.has_conflict(mesh, point, side.tet(), &other)?
            };
            if !conflict {
                self.boundary.push(BoundaryFace { outside: side, corners: triangle });
                continue;
            }
            mesh.set_mark(side.tet(), true);
            // The other tet has the same triangle, turned over.
            let [a, b, c] = triangle;
            let places = TET_FACES[side.face()];
            let first = other[places[0]];
            let turned = if first == self.vertices.ids[a as usize] {
                [a, c, b]
            } else if first == self.vertices.ids[b as usize] {
                [b, a, c]
            } else {
                [c, b, a]
            };
            let mut corners = [0; 4];
            corners[side.face()] = self.vertices.number_of(apex, apex_row);
            for (place, corner) in places.into_iter().zip(turned) {
                corners[place] = corner;
            }
            self.tets.push(CavityTet { tet: side.tet(), corners });
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

    /// The general test, for ghost tets and across their faces.
    fn has_conflict<M: KernelMesh>(
        &mut self,
        mesh: &mut M,
        point: DVec3,
        tet: TetId,
        vertices: &[VertexId; 4],
    ) -> Result<bool, Insertion> {
        let Some(ghost) = vertices.iter().position(|v| v.is_ghost()) else {
            let [a, b, c, d] = vertices.map(|v| lifted(mesh, v, point));
            let points = || vertices.map(|v| mesh.point(v));
            return Ok(self.arithmetic.is_in_sphere([&a, &b, &c, &d], points, point, &mut self.exact_tests));
        };
        let [a, b, c] = TET_FACES[ghost].map(|i| mesh.point(vertices[i]));
        // The ghost lies on the positive side of its hull face turned over.
        let beyond = orient3d_in(&self.arithmetic.granularity, a, c, b, point);
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
        for cavity_tet in &self.tets {
            mesh.set_mark(cavity_tet.tet, false);
        }
        // Freed slots are used first: they are warm.
        self.new_tets.clear();
        let reused = self.tets.len().min(self.boundary.len());
        self.new_tets.extend(self.tets[..reused].iter().map(|cavity_tet| cavity_tet.tet));
        for _ in reused..self.boundary.len() {
            self.new_tets.push(mesh.take_slot());
        }
        for cavity_tet in &self.tets[reused..] {
            mesh.free_slot(cavity_tet.tet);
        }
        let vertices = self.vertices.ids.len();
        if vertices <= FEW_VERTICES {
            self.fill_by_matrix::<M, FEW_VERTICES>(mesh, vertex);
        } else if vertices <= MATRIX_VERTICES {
            self.fill_by_matrix::<M, MATRIX_VERTICES>(mesh, vertex);
        } else {
            self.fill_by_map(mesh, vertex);
        }
        self.new_tets[self.new_tets.len() - 1]
    }

    fn fill_by_matrix<M: KernelMesh, const WIDTH: usize>(&mut self, mesh: &mut M, vertex: VertexId) {
        let matrix = &mut self.matrix[..WIDTH * WIDTH];
        for (&BoundaryFace { outside, corners: [a, b, c] }, &tet) in self.boundary.iter().zip(&self.new_tets) {
            let (p, q, r) = (a as usize, b as usize, c as usize);
            let ids = &self.vertices.ids;
            let none = TetFace::NONE;
            mesh.set_row(tet, [vertex, ids[p], ids[q], ids[r]], [outside, none, none, none]);
            mesh.set_neighbor(outside, TetFace::new(tet, 0));
            // The edge opposite to a in this face is b c, and so on; the other face has it as c b.
            for (face, u, v) in [(1, q, r), (2, r, p), (3, p, q)] {
                let side = TetFace::new(tet, face);
                let waiting = std::mem::replace(&mut matrix[v * WIDTH + u], none);
                if waiting == none {
                    matrix[u * WIDTH + v] = side;
                } else {
                    mesh.glue(side, waiting);
                }
            }
        }
    }

    fn fill_by_map<M: KernelMesh>(&mut self, mesh: &mut M, vertex: VertexId) {
        for (&BoundaryFace { outside, corners: [a, b, c] }, &tet) in self.boundary.iter().zip(&self.new_tets) {
            let [p, q, r] = [a, b, c].map(|corner| self.vertices.ids[corner as usize]);
            mesh.set_row(tet, [vertex, p, q, r], [outside, TetFace::NONE, TetFace::NONE, TetFace::NONE]);
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

/// A vertex relative to the new point; anything for the ghost.
#[inline(always)]
fn lifted<M: KernelMesh>(mesh: &M, vertex: VertexId, point: DVec3) -> LiftedPoint {
    if vertex.is_ghost() { LiftedPoint::default() } else { LiftedPoint::new(mesh.point(vertex) - point) }
}

/// What floating point says of a point and the sphere of a positive tet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Filtered {
    Inside,
    Outside,
    /// On the sphere, exactly.
    On,
    Unknown,
}

impl Arithmetic {
    /// Whether the sphere of a tet contains the point. The first array has its vertices relative to the point; `points` are
    /// asked for where the filters cannot decide, and such cases counted.
    #[inline(always)]
    fn is_in_sphere(
        &self,
        relative: [&LiftedPoint; 4],
        points: impl FnOnce() -> [DVec3; 4],
        point: DVec3,
        exact_tests: &mut u64,
    ) -> bool {
        match self.filtered(relative) {
            Filtered::Inside => true,
            Filtered::Outside => false,
            undecided => {
                *exact_tests += 1;
                self.decide(undecided, points(), point)
            }
        }
    }

    /// Of a tet whose vertices are relative to the point.
    #[inline(always)]
    fn filtered(&self, [a, b, c, d]: [&LiftedPoint; 4]) -> Filtered {
        let cofactors: FaceCofactors = face_cofactors(a, b, c);
        let det = cofactors.dot(d);
        if det > self.static_bound {
            return Filtered::Inside;
        }
        if det < -self.static_bound {
            return Filtered::Outside;
        }
        let largest = a.offset.abs().max(b.offset.abs()).max(c.offset.abs().max(d.offset.abs()));
        let bound = insphere_error_bound(largest, a.lift.max(b.lift).max(c.lift.max(d.lift)));
        let bound_or_zero = if self.granularity.makes_insphere_exact(bound) { 0.0 } else { bound };
        if det > bound_or_zero {
            Filtered::Inside
        } else if det < -bound_or_zero {
            Filtered::Outside
        } else if bound_or_zero == 0.0 {
            Filtered::On
        } else {
            Filtered::Unknown
        }
    }

    /// Decides what the filters could not, from the points themselves; those on the sphere by perturbation.
    #[inline(never)]
    fn decide(&self, filtered: Filtered, tet: [DVec3; 4], point: DVec3) -> bool {
        let [a, b, c, d] = tet;
        if filtered == Filtered::On {
            if let Some(inside) = is_exact_cospherical_point_inside(tet.map(|p| p - point)) {
                return inside;
            }
        } else {
            if let Some(inside) = is_box_corner_inside(&[a, b, c, d, point]) {
                return inside;
            }
            let sign = self.fixed.and_then(|fixed| fixed.insphere(a, b, c, d, point));
            let sign = sign.unwrap_or_else(|| insphere_exact(a, b, c, d, point));
            if sign != 0.0 {
                return sign > 0.0;
            }
        }
        is_cospherical_point_inside(tet, point, &self.granularity)
    }
}
