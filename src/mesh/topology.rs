//! Traversal of a tet mesh: the shell of an edge, the ball of a vertex, the tet of an edge or a face.
//!
//! # Method
//! ```text
//!        d                 The shell of the edge a b is walked around it: in the tet (a, b, c, d), positive, the walk
//!      / | \               leaves through the face a b d (opposite to c) into (a, b, d, e), and so on. The apexes
//!     c--ab--e             c, d, e, ... turn around the edge by the right hand from a to b.
//!      \ | /
//! ```
//! The ball of a vertex is collected breadth-first over the three faces at the vertex.
//!
//! # Invariants
//! Nothing is written: traversals run on any [`TetStore`]. On a claimed store the shell is stable while both ends of
//! the edge are held, the ball while the vertex is held.
//!
//! # Cost
//! Linear in the tets visited, plus a hash set in balls of more than 64 tets.

use rustc_hash::FxHashSet;

use super::numbering::{TET_EDGE_BETWEEN, TET_EDGES, TET_OPPOSITE_EDGES};
use super::tet_store::TetStore;
use crate::index::{TetFace, TetId, VertexId};

/// Balls up to this size are searched in a table on the stack, larger ones by a set that grows.
const SMALL_BALL: usize = 64;
/// Slots of that table: at most half of them are taken.
const BALL_SLOTS: usize = 128;

/// One tet of a shell: its local vertices with `(a, b, c, d)` positive, `a b` the edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ShellTet {
    /// The tet.
    pub tet: TetId,
    /// Local number of the first end of the edge.
    pub a: usize,
    /// Local number of the second end of the edge.
    pub b: usize,
    /// Local number of the apex where the walk came in (the face opposite to it is left through).
    pub c: usize,
    /// Local number of the apex that the next tet shares.
    pub d: usize,
}

impl ShellTet {
    /// The shell tet for the directed edge between local vertices `a` and `b`.
    #[inline]
    pub fn new(tet: TetId, a: usize, b: usize) -> Self {
        let edge = TET_EDGE_BETWEEN[a][b];
        let [c, d] = TET_OPPOSITE_EDGES[edge];
        if TET_EDGES[edge][0] == a { Self { tet, a, b, c, d } } else { Self { tet, a, b, c: d, d: c } }
    }

    /// The next tet around the edge, or `None` where the mesh ends.
    #[inline]
    pub fn next<S: TetStore + ?Sized>(self, store: &S) -> Option<Self> {
        let other = store.neighbor(TetFace::new(self.tet, self.c));
        if other == TetFace::NONE {
            return None;
        }
        let vertices = store.vertices(self.tet);
        let next = store.vertices(other.tet());
        let place = |v: VertexId| next.iter().position(|&w| w == v);
        let (a, b, c) = (place(vertices[self.a])?, place(vertices[self.b])?, place(vertices[self.d])?);
        Some(Self { tet: other.tet(), a, b, c, d: other.face() })
    }

    /// The previous tet around the edge, or `None` where the mesh ends.
    #[inline]
    pub fn previous<S: TetStore + ?Sized>(self, store: &S) -> Option<Self> {
        let other = store.neighbor(TetFace::new(self.tet, self.d));
        if other == TetFace::NONE {
            return None;
        }
        let vertices = store.vertices(self.tet);
        let next = store.vertices(other.tet());
        let place = |v: VertexId| next.iter().position(|&w| w == v);
        let (a, b, d) = (place(vertices[self.a])?, place(vertices[self.b])?, place(vertices[self.c])?);
        Some(Self { tet: other.tet(), a, b, c: other.face(), d })
    }
}

/// Whether a shell goes all around its edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ShellKind {
    /// The last tet's successor is the first.
    Closed,
    /// The edge lies on the end of the mesh; the tets run from one end to the other.
    Open,
    /// More tets than the limit given; the list is incomplete.
    TooLarge,
}

/// Fills `shell` with the tets around the edge of `start`, in turning order, at most `limit` of them.
pub fn collect_shell<S: TetStore + ?Sized>(
    store: &S,
    start: ShellTet,
    limit: usize,
    shell: &mut Vec<ShellTet>,
) -> ShellKind {
    shell.clear();
    let mut current = start;
    loop {
        if shell.len() == limit {
            return ShellKind::TooLarge;
        }
        shell.push(current);
        match current.next(store) {
            Some(next) if next.tet == start.tet => return ShellKind::Closed,
            Some(next) => current = next,
            None => break,
        }
    }
    // The mesh ended on this side: what lies before the start comes first.
    let mut before = Vec::new();
    let mut current = start;
    while let Some(previous) = current.previous(store) {
        if shell.len() + before.len() == limit {
            return ShellKind::TooLarge;
        }
        before.push(previous);
        current = previous;
    }
    shell.splice(0..0, before.into_iter().rev());
    ShellKind::Open
}

/// Collects the tets at `vertex` (ghost tets included) into `ball`, starting from `start`, one of them.
pub fn collect_ball<S: TetStore + ?Sized>(store: &S, vertex: VertexId, start: TetId, ball: &mut Vec<TetId>) {
    let mut walk = BallWalk::new(start, ball);
    while let Some(tet) = walk.next() {
        let vertices = store.vertices(tet);
        let neighbors = store.neighbors(tet);
        for face in 0..4 {
            if vertices[face] != vertex && neighbors[face] != TetFace::NONE {
                walk.meet(neighbors[face].tet());
            }
        }
    }
}

/// Breadth-first order of the tets of a ball: each is handed out once and what lies behind its faces is met.
pub struct BallWalk<'a> {
    ball: &'a mut Vec<TetId>,
    next: usize,
    /// Open addressing while the ball is small; the slot of an id is its low bits.
    slots: [TetId; BALL_SLOTS],
    seen: FxHashSet<TetId>,
}

impl<'a> BallWalk<'a> {
    /// Starts at `start`; the tets met are listed in `ball`.
    #[inline]
    pub fn new(start: TetId, ball: &'a mut Vec<TetId>) -> Self {
        ball.clear();
        let mut walk = Self { ball, next: 0, slots: [TetId::NONE; BALL_SLOTS], seen: FxHashSet::default() };
        walk.meet(start);
        walk
    }

    /// The next tet to look at.
    #[inline]
    #[allow(clippy::should_implement_trait, reason = "an iterator could not be told what was met meanwhile")]
    pub fn next(&mut self) -> Option<TetId> {
        let tet = self.ball.get(self.next).copied();
        self.next += 1;
        tet
    }

    /// Takes in a tet of the ball; false where it was met before.
    #[inline]
    pub fn meet(&mut self, tet: TetId) -> bool {
        if self.ball.len() < SMALL_BALL {
            let mut at = tet.index() % BALL_SLOTS;
            while self.slots[at] != TetId::NONE {
                if self.slots[at] == tet {
                    return false;
                }
                at = (at + 1) % BALL_SLOTS;
            }
            self.slots[at] = tet;
            self.ball.push(tet);
            return true;
        }
        if self.seen.is_empty() {
            self.seen.extend(self.ball.iter().copied());
        }
        let is_new = self.seen.insert(tet);
        if is_new {
            self.ball.push(tet);
        }
        is_new
    }
}

/// The tets at `vertex`, ghost tets included; empty for a vertex without tets.
pub fn ball_of<S: TetStore + ?Sized>(store: &S, vertex: VertexId) -> Vec<TetId> {
    let mut ball = Vec::new();
    if let Some(start) = store.tet_of(vertex).some() {
        collect_ball(store, vertex, start, &mut ball);
    }
    ball
}

/// A tet that has the edge between two vertices, or `None` where the mesh has no such edge. `ball` is scratch.
pub fn find_edge<S: TetStore + ?Sized>(
    store: &S,
    first: VertexId,
    second: VertexId,
    ball: &mut Vec<TetId>,
) -> Option<ShellTet> {
    collect_ball(store, first, store.tet_of(first).some()?, ball);
    ball.iter().find_map(|&tet| {
        let b = store.local_vertex(tet, second)?;
        Some(ShellTet::new(tet, store.local_vertex(tet, first)?, b))
    })
}

/// A side with the three vertices given, in any order, or `None` where the mesh has no such face. `ball` is scratch.
pub fn find_face<S: TetStore + ?Sized>(store: &S, face: [VertexId; 3], ball: &mut Vec<TetId>) -> Option<TetFace> {
    collect_ball(store, face[0], store.tet_of(face[0]).some()?, ball);
    ball.iter().find_map(|&tet| {
        let vertices = store.vertices(tet);
        if !face.iter().all(|v| vertices.contains(v)) {
            return None;
        }
        let opposite = vertices.iter().position(|v| !face.contains(v))?;
        Some(TetFace::new(tet, opposite))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::Label;
    use crate::mesh::tet_complex::TetComplex;
    use glam::DVec3;

    /// `n` tets around the edge 0 1 (the z axis), closed or with one left out.
    fn wheel(n: u32, tets: u32) -> TetComplex {
        let mut points = vec![DVec3::ZERO, DVec3::Z];
        points.extend((0..n).map(|i| {
            let angle = f64::from(i) / f64::from(n) * std::f64::consts::TAU;
            DVec3::new(angle.cos(), angle.sin(), 0.5)
        }));
        let mut complex = TetComplex::with_points(points).unwrap();
        for i in 0..tets {
            let row = [0, 1, 2 + i, 2 + (i + 1) % n].map(VertexId);
            complex.create_tet(row, Label(1)).unwrap();
        }
        complex.pair_faces().unwrap();
        complex.check_invariants().unwrap();
        complex.check_orientation().unwrap();
        complex
    }

    #[test]
    fn closed_shell_turns_once() {
        let complex = wheel(7, 7);
        for (tet, flip) in [(3, false), (5, true)] {
            let (a, b) = if flip { (1, 0) } else { (0, 1) };
            let start = ShellTet::new(TetId(tet), a, b);
            let mut shell = Vec::new();
            assert_eq!(collect_shell(&complex, start, 100, &mut shell), ShellKind::Closed);
            assert_eq!(shell.len(), 7);
            for s in &shell {
                let v = complex.vertices(s.tet);
                let p = [s.a, s.b, s.c, s.d].map(|i| complex.point(v[i]));
                assert!(crate::geometry::predicates::orient3d(p[0], p[1], p[2], p[3]) > 0.0);
                assert_eq!(s.next(&complex).unwrap().previous(&complex).unwrap(), *s);
            }
            assert_eq!(collect_shell(&complex, start, 6, &mut shell), ShellKind::TooLarge);
        }
    }

    #[test]
    fn open_shell_runs_from_end_to_end() {
        let complex = wheel(7, 6);
        let mut shell = Vec::new();
        let start = ShellTet::new(TetId(3), 0, 1);
        assert_eq!(collect_shell(&complex, start, 100, &mut shell), ShellKind::Open);
        assert_eq!(shell.iter().map(|s| s.tet.0).collect::<Vec<_>>(), [0, 1, 2, 3, 4, 5]);
    }

    #[test]
    fn ball_and_searches_find_what_is_there() {
        let complex = wheel(90, 90);
        let mut ball = ball_of(&complex, VertexId(0));
        assert_eq!(ball.len(), 90);
        ball.sort_unstable();
        ball.dedup();
        assert_eq!(ball.len(), 90);
        assert_eq!(ball_of(&complex, VertexId(5)).len(), 2);
        let edge = find_edge(&complex, VertexId(1), VertexId(0), &mut ball).unwrap();
        assert_eq!(complex.vertices(edge.tet)[edge.a], VertexId(1));
        assert!(find_edge(&complex, VertexId(2), VertexId(5), &mut ball).is_none());
        assert!(find_face(&complex, [3, 0, 4].map(VertexId), &mut ball).is_some());
        assert!(find_face(&complex, [3, 0, 6].map(VertexId), &mut ball).is_none());
    }
}
