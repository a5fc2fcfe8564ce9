//! The editable tet mesh: points, tet vertices, packed neighbours, flags and labels.
//!
//! # Method
//! Arrays with rows of fixed size; freed slots are kept in a list and reused, last freed first. Vertices and neighbours of a
//! tet stand side by side, so that a step of a walk costs one cache line.
//! Outside the convex hull, tets with the vertex [`VertexId::GHOST`] close the mesh, one on every hull face:
//! ```text
//!            ghost                 the hull face a b c is shared by the finite tet below it and by a tet whose
//!           /  |  \                fourth vertex is the ghost. Two such tets that share the hull edge a b are
//!          a---|---b               neighbours across the face a b ghost. Every tet then has four neighbours, and
//!           \  |  /                walks and cavities need no special case at the hull. With the ghost replaced by
//!              c                   a point far outside, such a tet is positive.
//! ```
//! A complex whose outside was carved away has `TetFace::NONE` behind its boundary faces instead.
//!
//! # Invariants
//! [`TetComplex::check_invariants`]: see there. Local numbering is that of `mesh::numbering`.
//!
//! # Cost
//! 24 B a point + 4 B a vertex; 32 + 2 + 2 = 36 B a tet. At most 2^30 - 1 tets.

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::mixed_mesh::{ElementKind, MixedMesh};
use super::numbering::TET_FACES;
use super::tet_flags::TetFlags;
use super::tet_store::{TetStore, has_ghost};
use crate::error::{Error, Result};
use crate::index::{Label, TetFace, TetId, VertexId};

/// Most tets of one complex: `TetFace` packs `4 * tet + face` and keeps the last word as `NONE`.
pub const MAX_TETS: usize = (1 << 30) - 1;

/// Four ghosts, or no neighbours: the same word.
pub(super) const FREE_HALF: [u32; 4] = [VertexId::GHOST.0; 4];
const _: () = assert!(VertexId::GHOST.0 == TetFace::NONE.0);

/// What [`TetComplex::check_invariants`] found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Violation {
    /// The tet at fault, or `TetId::NONE`.
    pub tet: TetId,
    /// What is wrong.
    pub text: String,
}

impl std::fmt::Display for Violation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "tet {}: {}", self.tet.0, self.text)
    }
}

/// An editable mesh of tets; see the module docs and the picture in `mesh::tet_store`.
#[derive(Debug, Clone, Default)]
pub struct TetComplex {
    /// World millimetres; 24 B / vertex.
    pub(super) points: Vec<DVec3>,
    /// Rows of half a tet: half `2 t + 1` holds the vertices of tet `t` in positive order, ghost allowed (four ghosts in a
    /// free slot), half `2 t + 2` its neighbours: entry `f` is the side that faces face `f`. The first half is padding:
    /// large allocations start 16 bytes after a page, and with it no row straddles a cache line. 32 B / tet.
    pub(super) halves: Vec<[u32; 4]>,
    /// 2 B / tet.
    pub(super) tet_flags: Vec<TetFlags>,
    /// 2 B / tet.
    pub(super) tet_labels: Vec<Label>,
    /// One live tet at each vertex, `TetId::NONE` for a vertex without tets. 4 B / vertex.
    pub(super) vertex_tet: Vec<TetId>,
    /// Free slots, last freed last. 4 B / free slot.
    pub(super) free_slots: Vec<TetId>,
}

impl TetComplex {
    /// A complex of points without tets.
    ///
    /// # Errors
    /// [`Error::CapacityExceeded`] where the vertex ids do not suffice.
    pub fn with_points(points: Vec<DVec3>) -> Result<Self> {
        if let Some(last) = points.len().checked_sub(1) {
            VertexId::try_new(last)?;
        }
        let vertex_tet = vec![TetId::NONE; points.len()];
        Ok(Self { points, vertex_tet, ..Self::default() })
    }

    /// A complex made of whole rows, as a kernel leaves them: padding, then vertices and neighbours of each tet, none of
    /// them free, neighbours complete. Labels are background, flags clear, and `vertex_tet` is computed.
    ///
    /// # Errors
    /// [`Error::CapacityExceeded`] where ids do not suffice.
    pub fn from_rows(points: Vec<DVec3>, halves: Vec<[u32; 4]>) -> Result<Self> {
        let mut complex = Self::with_points(points)?;
        let count = halves.len() / 2;
        check_tet_count(count)?;
        assert_eq!(halves.len(), 2 * count + 1, "padding and two halves a tet");
        complex.tet_flags = vec![TetFlags::LIVE; count];
        complex.tet_labels = vec![Label::BACKGROUND; count];
        complex.halves = halves;
        complex.rebuild_vertex_tets();
        Ok(complex)
    }

    /// All points, by vertex.
    #[inline]
    pub fn points(&self) -> &[DVec3] {
        &self.points
    }

    /// Appends a vertex without tets.
    ///
    /// # Errors
    /// [`Error::CapacityExceeded`] where the vertex ids do not suffice.
    pub fn push_point(&mut self, point: DVec3) -> Result<VertexId> {
        let id = VertexId::try_new(self.points.len())?;
        self.points.push(point);
        self.vertex_tet.push(TetId::NONE);
        Ok(id)
    }

    /// Removes the vertices from `count` on; none of them may have tets.
    pub fn truncate_points(&mut self, count: usize) {
        debug_assert!(self.vertex_tet[count.min(self.vertex_tet.len())..].iter().all(|&t| t == TetId::NONE));
        self.points.truncate(count);
        self.vertex_tet.truncate(count);
    }

    /// Number of live tets, ghost tets included.
    pub fn live_count(&self) -> usize {
        self.tet_flags.len() - self.free_slots.len()
    }

    /// The ids of all live tets, ghost tets included, in slot order.
    pub fn live_tets(&self) -> impl Iterator<Item = TetId> + '_ {
        self.tet_flags.iter().enumerate().filter(|(_, f)| !f.is_deleted()).map(|(i, _)| TetId::from_index(i))
    }

    /// The ids of all live tets without the ghost vertex, in slot order.
    pub fn finite_tets(&self) -> impl Iterator<Item = TetId> + '_ {
        self.live_tets().filter(|&t| !self.is_ghost_tet(t))
    }

    /// The ids of the live tets without the ghost vertex that `keep` chooses, in slot order. Runs on the rayon pool it is
    /// called in.
    pub fn finite_tets_where(&self, keep: impl Fn(TetId) -> bool + Sync) -> Vec<TetId> {
        const CHUNK: usize = 4096;
        let flags = self.tet_flags.par_iter().enumerate().with_min_len(CHUNK);
        flags
            .filter(|(_, flags)| !flags.is_deleted())
            .map(|(slot, _)| TetId::from_index(slot))
            .filter(|&tet| !self.is_ghost_tet(tet) && keep(tet))
            .collect()
    }

    /// Reserves room for `additional` tets.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`] where it cannot be had.
    pub fn try_reserve_tets(&mut self, additional: usize) -> Result<()> {
        let bytes = additional as u64 * 36;
        let failed = |_| Error::OutOfMemory { what: "tets", bytes };
        self.halves.try_reserve(2 * additional + 1).map_err(failed)?;
        self.tet_flags.try_reserve(additional).map_err(failed)?;
        self.tet_labels.try_reserve(additional).map_err(failed)
    }

    /// Adds `additional` free slots, so that a parallel pass finds them.
    ///
    /// # Errors
    /// [`Error::CapacityExceeded`] or [`Error::OutOfMemory`].
    pub fn add_free_slots(&mut self, additional: usize) -> Result<()> {
        let old = self.tet_flags.len();
        check_tet_count(old + additional)?;
        self.try_reserve_tets(additional)?;
        let new = old + additional;
        self.halves.resize(2 * new + 1, FREE_HALF);
        self.tet_flags.resize(new, TetFlags::DELETED);
        self.tet_labels.resize(new, Label::BACKGROUND);
        self.free_slots.extend((old..new).rev().map(TetId::from_index));
        Ok(())
    }

    /// Number of free slots.
    pub fn free_slot_count(&self) -> usize {
        self.free_slots.len()
    }

    /// Points every vertex to one of its live tets, a finite one where there is one.
    pub fn rebuild_vertex_tets(&mut self) {
        self.vertex_tet.fill(TetId::NONE);
        let mut ghosts = Vec::new();
        for i in 0..self.tet_flags.len() {
            let (tet, row) = (TetId::from_index(i), self.vertices(TetId::from_index(i)));
            if self.tet_flags[i].is_deleted() {
                continue;
            }
            if has_ghost(row) {
                ghosts.push(tet);
                continue;
            }
            for v in row {
                self.vertex_tet[v.index()] = tet;
            }
        }
        // A ghost tet only where there is no other.
        for tet in ghosts {
            for v in self.vertices(tet).into_iter().filter(|v| !v.is_ghost()) {
                let known = self.vertex_tet[v.index()];
                if known == TetId::NONE || self.is_ghost_tet(known) {
                    self.vertex_tet[v.index()] = tet;
                }
            }
        }
    }

    /// Pairs the faces of all live tets from their vertices alone; faces without a partner get `TetFace::NONE`.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] where three tets share a face, or two from the same side.
    pub fn pair_faces(&mut self) -> Result<()> {
        let mut open = rustc_hash::FxHashMap::default();
        for i in 0..self.tet_flags.len() {
            self.halves[2 * i + 2] = FREE_HALF;
            if self.tet_flags[i].is_deleted() {
                continue;
            }
            for face in 0..4 {
                let side = TetFace::new(TetId::from_index(i), face);
                let key = turned_to_smallest(self.face_vertices(side));
                let mirror = [key[0], key[2], key[1]];
                if let Some(other) = open.remove(&mirror) {
                    self.glue(side, other);
                } else if open.insert(key, side).is_some() {
                    return Err(Error::argument(
                        "tets",
                        format!("tets overlap at face {} {} {}", key[0].0, key[1].0, key[2].0),
                    ));
                }
            }
        }
        Ok(())
    }

    /// Checks structure: free slots are marked and listed once; live tets have four different known vertices and at
    /// most one ghost; neighbour entries mirror each other and the two sides have the same vertices, turned over;
    /// constraint bits agree across faces; every vertex with tets points to a live tet that contains it; no scratch
    /// mark is left.
    ///
    /// # Errors
    /// The first [`Violation`] found.
    pub fn check_invariants(&self) -> std::result::Result<(), Violation> {
        let fail = |tet, text: String| Err(Violation { tet, text });
        let n = self.tet_flags.len();
        if self.tet_labels.len() != n
            || self.halves.len() != 2 * n + usize::from(n > 0)
            || self.vertex_tet.len() != self.points.len()
        {
            return fail(TetId::NONE, "arrays of different lengths".into());
        }
        let free: FxHashSet<TetId> = self.free_slots.iter().copied().collect();
        let deleted = self.tet_flags.iter().filter(|f| f.is_deleted()).count();
        if free.len() != self.free_slots.len() || deleted != free.len() {
            return fail(TetId::NONE, format!("{deleted} slots deleted, {} listed", self.free_slots.len()));
        }
        let mut used = vec![false; self.points.len()];
        for tet in (0..n).map(TetId::from_index) {
            if self.flags(tet).is_deleted() {
                if !free.contains(&tet) || self.vertices(tet) != [VertexId::GHOST; 4] {
                    return fail(tet, "deleted but not listed or not wiped".into());
                }
            } else if let Err(text) = self.check_tet(tet, &mut used) {
                return fail(tet, text);
            }
        }
        for (v, &tet) in self.vertex_tet.iter().enumerate() {
            let vertex = VertexId::from_index(v);
            let good = match tet.some() {
                None => !used[v],
                Some(t) => t.index() < n && self.is_live(t) && self.local_vertex(t, vertex).is_some(),
            };
            if !good {
                return fail(tet, format!("is not a live tet of vertex {v}"));
            }
        }
        Ok(())
    }

    fn check_tet(&self, tet: TetId, used: &mut [bool]) -> std::result::Result<(), String> {
        let vertices = self.vertices(tet);
        for (i, v) in vertices.iter().enumerate() {
            if vertices[..i].contains(v) || !(v.is_ghost() || v.index() < self.points.len()) {
                return Err(format!("vertices {:?}", vertices.map(|v| v.0)));
            }
            if !v.is_ghost() {
                used[v.index()] = true;
            }
        }
        if self.flags(tet).is_marked() {
            return Err("a scratch mark was left".into());
        }
        for face in 0..4 {
            let side = TetFace::new(tet, face);
            let other = self.neighbor(side);
            if other == TetFace::NONE {
                continue;
            }
            if other.tet().index() >= self.tet_flags.len() || !self.is_live(other.tet()) {
                return Err(format!("neighbour across face {face} is not live"));
            }
            if self.neighbor(other) != side {
                return Err(format!("neighbour across face {face} does not point back"));
            }
            let [a, b, c] = turned_to_smallest(self.face_vertices(other));
            if turned_to_smallest(self.face_vertices(side)) != [a, c, b] {
                return Err(format!("face {face} and its mirror differ"));
            }
            self.check_constraints_across(side, other)?;
        }
        Ok(())
    }

    fn check_constraints_across(&self, side: TetFace, other: TetFace) -> std::result::Result<(), String> {
        if self.is_face_constrained(side) != self.is_face_constrained(other) {
            return Err(format!("face {} is constrained on one side only", side.face()));
        }
        let corners = TET_FACES[side.face()];
        for i in 0..3 {
            let (p, q) = (corners[i], corners[(i + 1) % 3]);
            let local = |l: usize| self.local_vertex(other.tet(), self.vertices(side.tet())[l]);
            if let (Some(r), Some(s)) = (local(p), local(q))
                && self.is_edge_constrained(side.tet(), p, q) != self.is_edge_constrained(other.tet(), r, s)
            {
                return Err(format!("edge {p} {q} is constrained in one tet only"));
            }
        }
        Ok(())
    }

    /// Checks with exact arithmetic that every finite tet is positive.
    ///
    /// # Errors
    /// The first tet that is not.
    pub fn check_orientation(&self) -> std::result::Result<(), Violation> {
        match self.finite_tets().find(|&t| !self.is_positive(t)) {
            None => Ok(()),
            Some(tet) => Err(Violation { tet, text: "not positive".into() }),
        }
    }

    /// The finite tets as a finished mesh, with the caller's value of each label; every point is kept, in order.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn to_mixed_mesh(&self, label_values: &[i32]) -> Result<MixedMesh> {
        let mut mesh = MixedMesh { points: self.points.clone(), ..MixedMesh::default() };
        if mesh.offsets.is_empty() {
            mesh.offsets.push(0);
        }
        for tet in self.finite_tets() {
            let value = label_values.get(self.label(tet).index()).copied().unwrap_or(0);
            mesh.connectivity.extend(self.vertices(tet));
            mesh.offsets.push(mesh.connectivity.len() as i64);
            mesh.types.push(ElementKind::Tet.vtk_type());
            mesh.labels.push(value);
        }
        Ok(mesh)
    }
}

/// The same triangle, same sense, written from its smallest vertex.
fn turned_to_smallest([a, b, c]: [VertexId; 3]) -> [VertexId; 3] {
    if a <= b && a <= c {
        [a, b, c]
    } else if b <= c {
        [b, c, a]
    } else {
        [c, a, b]
    }
}

fn check_tet_count(count: usize) -> Result<()> {
    if count > MAX_TETS {
        return Err(Error::CapacityExceeded { what: "tets", needed: count as u64, limit: MAX_TETS as u64 });
    }
    Ok(())
}

impl TetStore for TetComplex {
    #[inline]
    fn vertex_count(&self) -> usize {
        self.points.len()
    }

    #[inline]
    fn slot_count(&self) -> usize {
        self.tet_flags.len()
    }

    #[inline]
    fn point(&self, vertex: VertexId) -> DVec3 {
        self.points[vertex.index()]
    }

    #[inline]
    fn vertices(&self, tet: TetId) -> [VertexId; 4] {
        bytemuck::cast(self.halves[2 * tet.index() + 1])
    }

    #[inline]
    fn neighbors(&self, tet: TetId) -> [TetFace; 4] {
        bytemuck::cast(self.halves[2 * tet.index() + 2])
    }

    #[inline]
    fn neighbor(&self, side: TetFace) -> TetFace {
        TetFace(self.halves[2 * side.tet().index() + 2][side.face()])
    }

    #[inline]
    fn flags(&self, tet: TetId) -> TetFlags {
        self.tet_flags[tet.index()]
    }

    #[inline]
    fn label(&self, tet: TetId) -> Label {
        self.tet_labels[tet.index()]
    }

    #[inline]
    fn tet_of(&self, vertex: VertexId) -> TetId {
        self.vertex_tet[vertex.index()]
    }

    #[inline]
    fn set_point(&mut self, vertex: VertexId, point: DVec3) {
        self.points[vertex.index()] = point;
    }

    fn create_tet(&mut self, vertices: [VertexId; 4], label: Label) -> Result<TetId> {
        let tet = if let Some(tet) = self.free_slots.pop() {
            self.halves[2 * tet.index() + 1] = bytemuck::cast(vertices);
            self.halves[2 * tet.index() + 2] = FREE_HALF;
            self.tet_flags[tet.index()] = TetFlags::LIVE;
            self.tet_labels[tet.index()] = label;
            tet
        } else {
            check_tet_count(self.tet_flags.len() + 1)?;
            if self.halves.is_empty() {
                self.halves.push(FREE_HALF);
            }
            self.halves.extend([bytemuck::cast(vertices), FREE_HALF]);
            self.tet_flags.push(TetFlags::LIVE);
            self.tet_labels.push(label);
            TetId::from_index(self.tet_flags.len() - 1)
        };
        for v in vertices {
            if !v.is_ghost() {
                self.vertex_tet[v.index()] = tet;
            }
        }
        Ok(tet)
    }

    fn delete_tet(&mut self, tet: TetId) {
        debug_assert!(self.is_live(tet));
        self.halves[2 * tet.index() + 1] = FREE_HALF;
        self.halves[2 * tet.index() + 2] = FREE_HALF;
        self.tet_flags[tet.index()] = TetFlags::DELETED;
        self.free_slots.push(tet);
    }

    #[inline]
    fn glue(&mut self, side: TetFace, other: TetFace) {
        self.halves[2 * side.tet().index() + 2][side.face()] = other.0;
        self.halves[2 * other.tet().index() + 2][other.face()] = side.0;
    }

    #[inline]
    fn unglue(&mut self, side: TetFace) {
        self.halves[2 * side.tet().index() + 2][side.face()] = TetFace::NONE.0;
    }

    #[inline]
    fn set_vertices(&mut self, tet: TetId, vertices: [VertexId; 4]) {
        self.halves[2 * tet.index() + 1] = bytemuck::cast(vertices);
    }

    #[inline]
    fn set_flags(&mut self, tet: TetId, flags: TetFlags) {
        debug_assert!(!flags.is_deleted());
        self.tet_flags[tet.index()] = flags;
    }

    #[inline]
    fn set_label(&mut self, tet: TetId, label: Label) {
        self.tet_labels[tet.index()] = label;
    }

    #[inline]
    fn set_tet_of(&mut self, vertex: VertexId, tet: TetId) {
        self.vertex_tet[vertex.index()] = tet;
    }

    #[inline]
    fn try_claim(&mut self, _vertex: VertexId) -> bool {
        true
    }

    #[inline]
    fn release_claims(&mut self) {}

    #[inline]
    fn has_room(&mut self, count: usize) -> bool {
        self.live_count() + count <= MAX_TETS
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two tets on a common face.
    fn two_tets() -> TetComplex {
        let points = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z, DVec3::ONE];
        let mut complex = TetComplex::with_points(points).unwrap();
        for row in [[0, 1, 2, 3], [1, 2, 3, 4]] {
            complex.create_tet(row.map(VertexId), Label(1)).unwrap();
        }
        complex.pair_faces().unwrap();
        complex
    }

    #[test]
    fn faces_pair_and_mirror() {
        let complex = two_tets();
        complex.check_invariants().unwrap();
        complex.check_orientation().unwrap();
        let side = TetFace::new(TetId(0), 0);
        assert_eq!(complex.neighbor(side), TetFace::new(TetId(1), 3));
        assert_eq!(complex.neighbor(complex.neighbor(side)), side);
        assert_eq!(complex.apex(complex.neighbor(side)), VertexId(4));
    }

    #[test]
    fn slots_are_reused() {
        let mut complex = two_tets();
        complex.unglue(TetFace::new(TetId(0), 0));
        complex.delete_tet(TetId(1));
        complex.set_tet_of(VertexId(4), TetId::NONE);
        for v in 1..4 {
            complex.set_tet_of(VertexId(v), TetId(0));
        }
        complex.check_invariants().unwrap();
        assert_eq!((complex.live_count(), complex.free_slot_count()), (1, 1));
        assert_eq!(complex.create_tet([1, 2, 3, 4].map(VertexId), Label(1)).unwrap(), TetId(1));
        complex.add_free_slots(3).unwrap();
        complex.check_invariants().unwrap();
        assert_eq!((complex.live_count(), complex.slot_count()), (2, 5));
    }

    #[test]
    fn violations_are_found() {
        let mut complex = two_tets();
        complex.set_flags(TetId(0), TetFlags::LIVE.with_face(0, true));
        assert!(complex.check_invariants().unwrap_err().text.contains("one side"));
        complex.constrain_face(TetFace::new(TetId(0), 0), true);
        complex.check_invariants().unwrap();
        complex.set_flags(TetId(0), complex.flags(TetId(0)).with_edge(EDGE_12, true));
        assert!(complex.check_invariants().is_err());
        let mut complex = two_tets();
        complex.set_vertices(TetId(1), [1, 2, 4, 3].map(VertexId));
        assert!(complex.check_invariants().is_err());
        assert!(complex.check_orientation().is_err());
    }

    /// The edge 1 2 in `numbering::TET_EDGES`.
    const EDGE_12: usize = 3;

    #[test]
    fn overlapping_tets_are_refused() {
        let mut complex = TetComplex::with_points(vec![DVec3::ZERO; 5]).unwrap();
        for row in [[0, 1, 2, 3], [0, 1, 2, 4]] {
            complex.create_tet(row.map(VertexId), Label(1)).unwrap();
        }
        assert!(complex.pair_faces().is_err());
    }

    #[test]
    fn converts_to_a_mixed_mesh() {
        let mesh = two_tets().to_mixed_mesh(&[0, 17]).unwrap();
        mesh.check_shape().unwrap();
        assert_eq!(mesh.labels, [17, 17]);
        assert_eq!(mesh.tets().unwrap().len(), 2);
    }
}
