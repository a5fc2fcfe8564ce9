//! What stands in the way of edges and faces between the vertices of a polyhedron: for all vertices at once, as bit masks.
//!
//! # Method
//! 1. For three vertices, on which side of their plane each of the others lies: two masks, found when first asked for.
//! 2. A segment meets a triangle when its ends are not on one side of it and it passes its edges on one side. The tests are
//!    orientations of four vertices each, three of which do not change with the last vertex:
//! ```text
//!            v            edge u v and face p q r, for every v:       face x y v and edge p q, for every v:
//!      q    /             sides of p q r; of u p q, u q r, u r p      sides of x y p and x y q; of p q x and p q y
//!     / \  /
//!    p---r/               so that a few operations on words answer for up to 64 vertices. What lies in one plane is
//!        u                looked at one by one.
//! ```
//! # Source
//! The orientations of all quadruples decide everything: [BjornerEtAl1999], chirotopes. Masks over the last element: ours.
//!
//! # Invariants
//! Exact tests; the answers do not depend on the order of the questions.
//!
//! # Cost
//! For n vertices n tests of orientation for each triple that is asked for; about 20 operations for a row of answers.

use glam::DVec3;
use rustc_hash::FxHashMap;

use crate::conforming::front_clearance::{Face, bits};
use crate::geometry::intersection::coplanar_segment_meets_triangle;
use crate::geometry::predicates::Plane;

/// On which side of the plane of three vertices the others lie: in neither mask those in the plane.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Sides {
    above: u64,
    below: u64,
}

impl Sides {
    /// No vertex is on both sides.
    const UNKNOWN: Self = Self { above: u64::MAX, below: u64::MAX };

    fn decided(self) -> u64 {
        self.above | self.below
    }
}

/// For each number below 64 how many pairs of smaller ones there are, and how many triples.
const PAIRS: [usize; 64] = counts_below([0; 64], 1);
const TRIPLES: [usize; 64] = counts_below(PAIRS, 0);

/// Sums of all before, each with `step` times its place added.
const fn counts_below(of: [usize; 64], step: usize) -> [usize; 64] {
    let mut counts = [0; 64];
    let mut k = 1;
    while k < 64 {
        counts[k] = counts[k - 1] + of[k - 1] + step * (k - 1);
        k += 1;
    }
    counts
}

/// The vertices of a polyhedron.
#[derive(Debug, Default)]
pub struct Obstruction {
    points: Vec<DVec3>,
    /// By the rank of three ascending vertices.
    sides: Vec<Sides>,
    /// Whether an edge meets a face in its plane.
    coplanar: FxHashMap<[u8; 5], bool>,
}

impl Obstruction {
    /// Begins with other points, at most 64.
    pub fn reset(&mut self, points: impl Iterator<Item = DVec3>) {
        self.points.clear();
        self.points.extend(points);
        let n = self.points.len();
        debug_assert!(n <= u64::BITS as usize);
        self.sides.clear();
        self.sides.resize(n * n.saturating_sub(1) * n.saturating_sub(2) / 6, Sides::UNKNOWN);
        self.coplanar.clear();
    }

    /// The place of a vertex.
    #[inline]
    pub fn point(&self, v: u8) -> DVec3 {
        self.points[usize::from(v)]
    }

    /// The vertices with which the face makes a positive tet.
    #[inline]
    pub fn above(&mut self, [a, b, c]: Face) -> u64 {
        self.sides(a, b, c).above
    }

    #[inline]
    fn sides(&mut self, a: u8, b: u8, c: u8) -> Sides {
        // Without branches: the order of the three is anything.
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        let middle = a ^ b ^ c ^ low ^ high;
        let is_odd = (a > b) ^ (b > c) ^ (a > c);
        let rank = TRIPLES[usize::from(high) % 64] + PAIRS[usize::from(middle) % 64] + usize::from(low);
        let mut sides = self.sides[rank];
        if sides.above & sides.below != 0 {
            sides = self.sides_of([low, middle, high]);
            self.sides[rank] = sides;
        }
        let flip = (sides.above ^ sides.below) & u64::from(is_odd).wrapping_neg();
        Sides { above: sides.above ^ flip, below: sides.below ^ flip }
    }

    #[cold]
    fn sides_of(&self, face: Face) -> Sides {
        let plane = Plane::through(face.map(|v| self.point(v)));
        let (mut above, mut below) = (0, 0);
        for (v, &point) in self.points.iter().enumerate() {
            let side = if face.contains(&(v as u8)) { 0.0 } else { plane.side(point) };
            above |= u64::from(side > 0.0) << v;
            below |= u64::from(side < 0.0) << v;
        }
        Sides { above, below }
    }

    /// Those of `wanted` whose edge to `u` meets the face; none that is a vertex of it.
    pub fn edges_meeting(&mut self, u: u8, face: Face, wanted: u64) -> u64 {
        let [p, q, r] = face;
        let wanted = wanted & !(1 << u | 1 << p | 1 << q | 1 << r);
        if wanted == 0 || face.contains(&u) {
            return 0;
        }
        let plane = self.sides(p, q, r);
        let in_plane = (plane.decided() >> u & 1 == 0).then_some(!plane.decided());
        let across = match (plane.above >> u & 1, in_plane) {
            (1, _) => !plane.above,
            (_, None) => !plane.below,
            _ => plane.decided(),
        };
        let mut met = wanted & across;
        if met != 0 {
            let [a, b, c] = [self.sides(u, p, q), self.sides(u, q, r), self.sides(u, r, p)];
            met &= !(a.below | b.below | c.below) | !(a.above | b.above | c.above);
        }
        for v in bits(wanted & in_plane.unwrap_or(0)) {
            met |= u64::from(self.meets_in_plane([u, v], face)) << v;
        }
        met
    }

    /// Those of `wanted` whose face with x and y meets the edge p q; none that is an end of it, and none at all where x or y
    /// is.
    pub fn faces_meeting(&mut self, [x, y]: [u8; 2], [p, q]: [u8; 2], wanted: u64) -> u64 {
        let wanted = wanted & !(1 << x | 1 << y | 1 << p | 1 << q);
        if wanted == 0 || x == p || x == q || y == p || y == q {
            return 0;
        }
        // The sign of x y p v is that of p before the plane of x y v, turned over, as for q.
        let (first, second) = (self.sides(x, y, p), self.sides(x, y, q));
        let same = (first.above & second.above) | (first.below & second.below);
        let in_plane = wanted & !(first.decided() | second.decided());
        let mut met = wanted & !same & !in_plane;
        if met != 0 {
            let (at_x, at_y) = (self.sides(p, q, x), self.sides(p, q, y));
            // Of p q x y, p q y v and p q v x; the last one is turned over.
            let left = if at_x.below >> y & 1 == 0 { !(at_y.below | at_x.above) } else { 0 };
            let right = if at_x.above >> y & 1 == 0 { !(at_y.above | at_x.below) } else { 0 };
            met &= left | right;
        }
        for v in bits(in_plane) {
            met |= u64::from(self.meets_in_plane([p, q], [x, y, v])) << v;
        }
        met
    }

    #[cold]
    fn meets_in_plane(&mut self, mut edge: [u8; 2], mut face: Face) -> bool {
        edge.sort_unstable();
        face.sort_unstable();
        let Self { coplanar, points, .. } = self;
        let at = |v: u8| points[usize::from(v)];
        let key = [edge[0], edge[1], face[0], face[1], face[2]];
        *coplanar.entry(key).or_insert_with(|| coplanar_segment_meets_triangle(at(edge[0]), at(edge[1]), face.map(at)))
    }
}

/// Faces and edges that new tets keep clear of, with what was found of them.
#[derive(Debug, Default)]
pub struct Obstacles {
    faces: Vec<Face>,
    edges: Vec<[u8; 2]>,
    count: usize,
    /// Counts for what was noted since the faces were cleared.
    stamp: u32,
    /// For the edges to a vertex.
    met_edges: Vec<Known>,
    /// For the faces at the edge of two vertices.
    met_faces: Vec<Known>,
    /// Whether an edge is among the edges.
    has_edge: Vec<u32>,
}

/// With which vertices what was asked for meets the obstacles.
#[derive(Debug, Clone, Copy, Default)]
struct Known {
    stamp: u32,
    asked: u64,
    met: u64,
}

impl Known {
    /// The vertices that were not asked for yet; they are asked for now.
    fn ask(&mut self, wanted: u64, stamp: u32) -> u64 {
        if self.stamp != stamp {
            *self = Self { stamp, ..Self::default() };
        }
        let unknown = wanted & !self.asked;
        self.asked |= wanted;
        unknown
    }
}

impl Obstacles {
    /// Begins with none, for a polyhedron of so many vertices.
    pub fn reset(&mut self, count: usize) {
        self.count = count;
        for known in [&mut self.met_edges, &mut self.met_faces] {
            known.clear();
        }
        self.met_edges.resize(count, Known::default());
        self.met_faces.resize(count * count, Known::default());
        self.has_edge.clear();
        self.has_edge.resize(count * count, 0);
        self.stamp = 0;
        self.clear();
    }

    /// Begins with none again.
    pub fn clear(&mut self) {
        self.stamp += 1;
        self.faces.clear();
        self.edges.clear();
    }

    /// Adds a face, and those of its edges that count.
    pub fn add(&mut self, face: Face, counts: impl Fn([u8; 2]) -> bool) {
        self.faces.push(face);
        for edge in edges_of(face) {
            let slot = self.slot(edge);
            if self.has_edge[slot] != self.stamp && counts(edge) {
                self.has_edge[slot] = self.stamp;
                self.edges.push(edge);
            }
        }
    }

    /// The faces.
    pub fn faces(&self) -> &[Face] {
        &self.faces
    }

    /// Whether the edge is one of those that count.
    pub fn has_edge(&self, edge: [u8; 2]) -> bool {
        self.has_edge[self.slot(edge)] == self.stamp
    }

    fn slot(&self, [u, v]: [u8; 2]) -> usize {
        usize::from(u.min(v)) * self.count + usize::from(u.max(v))
    }

    /// Those of `vertices` whose tet on the face keeps clear of all obstacles, apart from shared vertices.
    pub fn clear_of(&mut self, obstruction: &mut Obstruction, face: Face, vertices: u64) -> u64 {
        let mut left = vertices;
        for u in face {
            let known = &mut self.met_edges[usize::from(u)];
            let mut unknown = known.ask(left, self.stamp);
            for &face in &self.faces {
                if unknown == 0 {
                    break;
                }
                let met = obstruction.edges_meeting(u, face, unknown);
                known.met |= met;
                unknown &= !met;
            }
            left &= !known.met;
        }
        for pair in edges_of(face) {
            let slot = self.slot(pair);
            let known = &mut self.met_faces[slot];
            let mut unknown = known.ask(left, self.stamp);
            for &edge in &self.edges {
                if unknown == 0 {
                    break;
                }
                let met = obstruction.faces_meeting(pair, edge, unknown);
                known.met |= met;
                unknown &= !met;
            }
            left &= !known.met;
        }
        left
    }
}

fn edges_of([a, b, c]: Face) -> [[u8; 2]; 3] {
    [[a, b], [b, c], [c, a]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::intersection::segment_meets_triangle;

    /// Points on a small grid, so that many lie in one plane.
    fn grid_points(count: usize, mut seed: u32) -> Vec<DVec3> {
        let mut points: Vec<DVec3> = Vec::new();
        while points.len() < count {
            let mut next = || {
                seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                f64::from(seed >> 16 & 3) * 0.1
            };
            let point = DVec3::new(next(), next(), next());
            if !points.contains(&point) {
                points.push(point);
            }
        }
        points
    }

    #[test]
    fn the_masks_are_what_the_tests_one_by_one_say() {
        let points = grid_points(11, 7);
        let n = points.len() as u8;
        let at = |v: u8| points[usize::from(v)];
        let all = (1 << n) - 1;
        let mut obstruction = Obstruction::default();
        obstruction.reset(points.iter().copied());
        let has_area = |f: Face| !crate::geometry::intersection::is_collinear(at(f[0]), at(f[1]), at(f[2]));
        let (mut meeting, mut compared) = (0, 0);
        for p in 0..n {
            for q in (0..n).filter(|&q| q != p) {
                for x in (0..n).filter(|x| ![p, q].contains(x)) {
                    if !has_area([p, q, x]) {
                        continue;
                    }
                    let across: Vec<u64> = (0..n).map(|u| obstruction.edges_meeting(u, [p, q, x], all)).collect();
                    for u in 0..n {
                        for v in (0..n).filter(|v| *v != u) {
                            let is_apart = [u, v].iter().all(|w| ![p, q, x].contains(w));
                            let expected = is_apart && segment_meets_triangle(at(u), at(v), [p, q, x].map(at));
                            assert_eq!(across[usize::from(u)] >> v & 1 == 1, expected, "{u} {v} {:?}", [p, q, x]);
                            // The same seen from the face.
                            if has_area([u, v, x]) {
                                let row = obstruction.faces_meeting([u, v], [p, q], 1 << x);
                                let is_apart = [p, q].iter().all(|w| ![u, v, x].contains(w)) && x != u && x != v;
                                let expected = is_apart && segment_meets_triangle(at(p), at(q), [u, v, x].map(at));
                                assert_eq!(row == 1 << x, expected, "{:?} {p} {q}", [u, v, x]);
                                meeting += u32::from(expected);
                                compared += 1;
                            }
                        }
                    }
                }
            }
        }
        assert!(meeting > 1000 && compared > 10 * meeting / 9);
    }
}
