//! Insertion of a vertex with its in-sphere reconnection as one replacement: cavity out, star in.
//!
//! # Method
//! ```text
//!      +-----+             1. From the tet that contains p the cavity grows across faces that are no constraint to
//!     / \ . / \               tets of the same label whose circumsphere contains p.
//!    /   \ /   \           2. Every border face must see p, exactly. One that does not turns its tet out of the cavity,
//!   +-----p-----+             which grows anew without it.
//!    \   / \   /           3. The cavity is deleted; each border face with p makes a tet; these meet across the edges of
//!     \ /   \ /               the border.
//!      +-----+
//! ```
//! # Source
//! [Bowyer1981], [Watson1981]; constrained faces as walls and correction of the cavity: [GeorgeHechtSaltel1991].
//!
//! # Differences
//! [Drakopoulos2017] 4.7 splits the containing tet and restores empty circumspheres by flips. In a Delaunay
//! neighbourhood the result is the same, for a third of the tets created on the way. Where an earlier pass by another
//! objective left the neighbourhood not Delaunay, step 2 leaves less of the cavity; where a vertex would be lost the caller
//! splits and flips.
//!
//! # Invariants
//! Generic over the store: all vertices of the cavity are claimed before anything is written. Every vertex, constrained
//! face and constrained edge of the cavity is on its border, so that none is lost. A plan that is not accepted changes
//! nothing.
//!
//! # Cost
//! About twenty in-sphere tests and thirty new tets a vertex; no allocation once the buffers have grown.

use glam::DVec3;
use rustc_hash::FxHashMap;

use super::flips::Outcome;
use crate::error::Result;
use crate::geometry::predicates::{insphere, orient3d};
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::{TET_EDGE_BETWEEN, TET_EDGES, TET_FACES, sorted_edge};
use crate::mesh::tet_store::TetStore;

/// Borders up to twice this size are glued by search in a list, larger ones by a map.
const LINEAR: usize = 48;
/// Times that a cavity may grow anew: each turns at least one tet out, in the end all but the first, which is a cavity by
/// itself. In refinement more than three are rare, but giving up after eight left splits among flat tets to flips that got
/// stuck, and such places spread from round to round.
const CORRECTIONS: usize = 256;

/// A border face of the cavity: (a, b, c, p) is positive.
#[derive(Debug, Clone, Copy)]
struct BorderFace {
    corners: [VertexId; 3],
    /// The side beyond, or `NONE` at the end of the mesh.
    beyond: TetFace,
    /// The cavity's tet.
    tet: TetId,
    constrained: bool,
    /// Constraints of the edges a b, b c, c a.
    edges: [bool; 3],
}

/// Buffers of one thread, and the cavity planned last.
#[derive(Debug, Clone, Default)]
pub struct CavityScratch {
    cavity: Vec<TetId>,
    excluded: Vec<TetId>,
    border: Vec<BorderFace>,
    /// Corners of the first tet and the apexes that joined.
    vertices: Vec<VertexId>,
    distinct: Vec<VertexId>,
    open: Vec<([VertexId; 2], TetFace)>,
    open_map: FxHashMap<[VertexId; 2], TetFace>,
}

impl CavityScratch {
    /// Number of tets that the commit creates.
    pub fn created(&self) -> usize {
        self.border.len()
    }

    /// Plans the insertion of `point`, which lies inside `tet`, claimed by the caller.
    pub fn plan<S: TetStore + ?Sized>(&mut self, store: &mut S, tet: TetId, point: DVec3) -> Outcome {
        self.cavity.clear();
        let outcome = self.plan_marked(store, tet, point);
        self.unmark(store);
        outcome
    }

    /// Takes the scratch marks of the cavity's tets away.
    fn unmark<S: TetStore + ?Sized>(&self, store: &mut S) {
        for &tet in &self.cavity {
            store.set_flags(tet, store.flags(tet).with_mark(false));
        }
    }

    /// Takes a tet in. Whoever looks at its mark holds the vertices of a face of it, so no other thread's mark is seen.
    fn add<S: TetStore + ?Sized>(&mut self, store: &mut S, tet: TetId) {
        self.cavity.push(tet);
        store.set_flags(tet, store.flags(tet).with_mark(true));
    }

    fn plan_marked<S: TetStore + ?Sized>(&mut self, store: &mut S, tet: TetId, point: DVec3) -> Outcome {
        self.excluded.clear();
        for _ in 0..CORRECTIONS {
            match self.grow(store, tet, point) {
                Outcome::Accepted => {}
                other => return other,
            }
            let before = self.excluded.len();
            for face in &self.border {
                let [a, b, c] = store.triangle(face.corners);
                if orient3d(a, b, c, point) > 0.0 || self.excluded.contains(&face.tet) {
                    continue;
                }
                if face.tet == tet {
                    return Outcome::WouldInvert; // on a face that has to stay
                }
                self.excluded.push(face.tet);
            }
            if self.excluded.len() == before {
                return if self.keeps_all(store) { Outcome::Accepted } else { Outcome::Constrained };
            }
        }
        Outcome::WouldInvert
    }

    /// Whether no vertex of the cavity is closer to `point` than `factor` times the average of the two sizes. The cavity of
    /// a Delaunay neighbourhood has the nearest vertex.
    pub fn is_clear<S: TetStore + ?Sized>(
        &self,
        store: &S,
        sizes: &[f64],
        point: DVec3,
        size: f64,
        factor: f64,
    ) -> bool {
        self.vertices.iter().all(|&vertex| {
            let limit = 0.5 * factor * (size + sizes[vertex.index()]);
            store.point(vertex).distance_squared(point) >= limit * limit
        })
    }

    fn grow<S: TetStore + ?Sized>(&mut self, store: &mut S, start: TetId, point: DVec3) -> Outcome {
        self.unmark(store);
        self.cavity.clear();
        self.border.clear();
        self.add(store, start);
        self.vertices.clear();
        self.vertices.extend(store.vertices(start));
        let label = store.label(start);
        let mut next = 0;
        while next < self.cavity.len() {
            let tet = self.cavity[next];
            next += 1;
            let (row, neighbors, flags) = (store.vertices(tet), store.neighbors(tet), store.flags(tet));
            // Read at once, so that the processor waits for the four of them together.
            let mut rows = [[VertexId::GHOST; 4]; 4];
            for (row, side) in rows.iter_mut().zip(neighbors).filter(|(_, side)| *side != TetFace::NONE) {
                *row = store.vertices(side.tet());
            }
            for face in 0..4 {
                let beyond = neighbors[face];
                let constrained = flags.is_face_constrained(face);
                if beyond != TetFace::NONE && !constrained {
                    let other = beyond.tet();
                    if store.flags(other).is_marked() {
                        continue;
                    }
                    let apex = rows[face][beyond.face()];
                    let joins = !apex.is_ghost()
                        && store.label(other) == label
                        && !self.excluded.contains(&other)
                        && is_inside(store, rows[face], point);
                    if joins {
                        if !store.try_claim(apex) {
                            return Outcome::ClaimLost;
                        }
                        self.add(store, other);
                        self.vertices.push(apex);
                        continue;
                    }
                }
                let [i, j, k] = TET_FACES[face];
                let has_edges = flags.has_constrained_edge();
                let edge = |i: usize, j: usize| has_edges && flags.is_edge_constrained(TET_EDGE_BETWEEN[i][j]);
                // Inwards, so that p is on the positive side.
                self.border.push(BorderFace {
                    corners: [row[i], row[k], row[j]],
                    beyond,
                    tet,
                    constrained,
                    edges: [edge(i, k), edge(k, j), edge(j, i)],
                });
            }
        }
        // A face taken as border before the tet beyond it came in from another side is none.
        let is_member = |side: TetFace| store.flags(side.tet()).is_marked();
        self.border.retain(|f| f.constrained || f.beyond == TetFace::NONE || !is_member(f.beyond));
        Outcome::Accepted
    }

    /// Whether every vertex and constrained edge of the cavity is on its border, and no constrained face inside.
    fn keeps_all<S: TetStore + ?Sized>(&mut self, store: &S) -> bool {
        let wall =
            |f: &BorderFace| f.constrained && f.beyond != TetFace::NONE && store.flags(f.beyond.tet()).is_marked();
        if self.border.iter().any(wall) {
            return false;
        }
        // The border turns once around p, so it is a sphere: n faces have n / 2 + 2 vertices.
        let on_border = self.border.len() / 2 + 2;
        // Never more than one vertex a tet beside the first three: without inner edges there is nothing to count.
        if self.cavity.len() + 3 != on_border && self.count_vertices() != on_border {
            return false;
        }
        self.keeps_edges(store)
    }

    /// Whether every constrained edge of the cavity is on its border.
    fn keeps_edges<S: TetStore + ?Sized>(&mut self, store: &S) -> bool {
        if !self.cavity.iter().any(|&tet| store.flags(tet).has_constrained_edge()) {
            return true;
        }
        self.open_map.clear();
        for face in &self.border {
            let [a, b, c] = face.corners;
            for (constrained, edge) in face.edges.into_iter().zip([[a, b], [b, c], [c, a]]) {
                if constrained {
                    self.open_map.insert(sorted_edge(edge[0], edge[1]), TetFace::NONE);
                }
            }
        }
        self.cavity.iter().all(|&tet| {
            let (flags, row) = (store.flags(tet), store.vertices(tet));
            !flags.has_constrained_edge()
                || TET_EDGES.iter().enumerate().all(|(edge, &[i, j])| {
                    !flags.is_edge_constrained(edge) || self.open_map.contains_key(&sorted_edge(row[i], row[j]))
                })
        })
    }

    /// Number of different vertices of the cavity.
    fn count_vertices(&mut self) -> usize {
        if self.vertices.len() > 2 * LINEAR {
            self.vertices.sort_unstable();
            self.vertices.dedup();
            return self.vertices.len();
        }
        self.distinct.clear();
        for &vertex in &self.vertices {
            if !self.distinct.contains(&vertex) {
                self.distinct.push(vertex);
            }
        }
        self.distinct.len()
    }

    /// Carries out the plan with `vertex` as the new vertex, whose point is set; the new tets go to `created`. The
    /// caller has made sure that there is room.
    ///
    /// # Errors
    /// As [`TetStore::create_tet`].
    pub fn commit<S: TetStore + ?Sized>(
        &mut self,
        store: &mut S,
        vertex: VertexId,
        created: &mut Vec<TetId>,
    ) -> Result<()> {
        let label = store.label(self.cavity[0]);
        for &tet in &self.cavity {
            store.delete_tet(tet);
        }
        self.open.clear();
        self.open_map.clear();
        let by_hash = self.border.len() > 2 * LINEAR;
        for face in &self.border {
            let [a, b, c] = face.corners;
            let tet = store.create_tet([a, b, c, vertex], label)?;
            created.push(tet);
            if face.beyond != TetFace::NONE {
                store.glue(TetFace::new(tet, 3), face.beyond);
            }
            if face.constrained || face.edges != [false; 3] {
                let mut flags = store.flags(tet).with_face(3, face.constrained);
                for (constrained, [i, j]) in face.edges.into_iter().zip([[0, 1], [1, 2], [2, 0]]) {
                    flags = flags.with_edge(TET_EDGE_BETWEEN[i][j], constrained);
                }
                store.set_flags(tet, flags);
            }
            // Face 2 has the edge a b, face 0 b c, face 1 c a; the neighbour has the same edge the other way round.
            for (from, to, local) in [(a, b, 2), (b, c, 0), (c, a, 1)] {
                let side = TetFace::new(tet, local);
                if by_hash {
                    match self.open_map.remove(&[to, from]) {
                        Some(other) => store.glue(side, other),
                        None => drop(self.open_map.insert([from, to], side)),
                    }
                } else {
                    match self.open.iter().rposition(|(edge, _)| *edge == [to, from]) {
                        Some(at) => store.glue(side, self.open.swap_remove(at).1),
                        None => self.open.push(([from, to], side)),
                    }
                }
            }
        }
        debug_assert!(self.open.is_empty() && self.open_map.is_empty(), "the border is closed");
        Ok(())
    }
}

/// Whether `point` lies strictly inside the circumsphere of a tet.
#[inline]
fn is_inside<S: TetStore + ?Sized>(store: &S, row: [VertexId; 4], point: DVec3) -> bool {
    let [a, b, c, d] = store.corners(row);
    insphere(a, b, c, d, point) > 0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::delaunay_kernel::{DelaunayOptions, tetrahedralize};
    use crate::context::RunContext;
    use crate::index::Label;
    use crate::mesh::tet_complex::TetComplex;

    /// The corners of the unit cube and `count` points inside, by a linear congruential generator.
    fn cube_points(count: usize) -> Vec<DVec3> {
        let mut state = 7u32;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            0.02 + 0.96 * f64::from(state >> 8) / f64::from(1 << 24)
        };
        let corner = |i: u32| DVec3::new(f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2));
        (0..8).map(corner).chain((0..count).map(|_| DVec3::new(next(), next(), next()))).collect()
    }

    fn delaunay(points: &[DVec3]) -> TetComplex {
        let options = DelaunayOptions::default();
        let mut complex = tetrahedralize(points, &options, &RunContext::with_threads(1).unwrap()).unwrap().complex;
        let tets: Vec<TetId> = complex.finite_tets().collect();
        tets.into_iter().for_each(|tet| complex.set_label(tet, Label(1)));
        complex
    }

    fn containing(complex: &TetComplex, point: DVec3) -> TetId {
        let sees = |tet: TetId| {
            (0..4).all(|face| {
                let [a, b, c] = complex.triangle(complex.face_vertices(TetFace::new(tet, face)));
                orient3d(a, b, c, point) < 0.0
            })
        };
        complex.finite_tets().find(|&tet| sees(tet)).expect("points are in general position")
    }

    fn insert_all(complex: &mut TetComplex, points: &[DVec3]) -> Vec<Outcome> {
        let mut scratch = CavityScratch::default();
        let mut created = Vec::new();
        let mut insert = |&point: &DVec3| {
            let tet = containing(complex, point);
            let outcome = scratch.plan(complex, tet, point);
            if outcome == Outcome::Accepted {
                let vertex = complex.push_point(point).unwrap();
                scratch.commit(complex, vertex, &mut created).unwrap();
            }
            outcome
        };
        points.iter().map(&mut insert).collect()
    }

    #[test]
    fn insertion_one_by_one_gives_the_delaunay_tets() {
        let points = cube_points(300);
        let mut complex = delaunay(&points[..30]);
        let outcomes = insert_all(&mut complex, &points[30..]);
        assert!(outcomes.iter().all(|o| *o == Outcome::Accepted));
        complex.check_invariants().unwrap();
        complex.check_orientation().unwrap();
        let sorted = |complex: &TetComplex| {
            let mut rows: Vec<[VertexId; 4]> = complex.finite_tets().map(|t| complex.vertices(t)).collect();
            rows.iter_mut().for_each(|row| row.sort_unstable());
            rows.sort_unstable();
            rows
        };
        // The eight corners are co-spherical, but inner points separate them.
        assert_eq!(sorted(&complex), sorted(&delaunay(&points)));
    }

    #[test]
    fn constrained_faces_and_edges_stay_and_bound_the_cavity() {
        let points = cube_points(400);
        let mut complex = delaunay(&points[..40]);
        // Every seventh inner face is a wall.
        let tets: Vec<TetId> = complex.finite_tets().step_by(7).collect();
        let mut walls: Vec<[VertexId; 3]> = Vec::new();
        for tet in tets {
            complex.constrain_face(TetFace::new(tet, 1), true);
            let mut wall = complex.face_vertices(TetFace::new(tet, 1));
            wall.sort_unstable();
            walls.push(wall);
        }
        walls.sort_unstable();
        walls.dedup();
        let outcomes = insert_all(&mut complex, &points[40..]);
        assert!(outcomes.iter().filter(|o| **o == Outcome::Accepted).count() > 300);
        complex.check_invariants().unwrap();
        complex.check_orientation().unwrap();
        let mut kept: Vec<[VertexId; 3]> = Vec::new();
        for tet in complex.finite_tets() {
            for side in (0..4).map(|face| TetFace::new(tet, face)) {
                if complex.is_face_constrained(side) {
                    let mut wall = complex.face_vertices(side);
                    wall.sort_unstable();
                    kept.push(wall);
                }
            }
        }
        kept.sort_unstable();
        kept.dedup();
        assert_eq!(kept, walls);
    }
}
