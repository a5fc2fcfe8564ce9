//! Faces of a polyhedron that is being filled with tets, and whether a tet keeps clear of them.
//!
//! # Method
//! Vertices have small local numbers. A tet on a face adds three edges and three faces; they are clear of others where no edge
//! meets a face of which it has no vertex. What was found is kept, by the numbers packed.
//!
//! # Source
//! [LiuChenChen2007] and [LiuSun2006], whose searches ask for it.
//!
//! # Invariants
//! Exact tests; the answers do not depend on the order of the questions.

use glam::DVec3;
use rustc_hash::FxHashMap;

use crate::geometry::intersection::segment_meets_triangle;

/// Vertices of one polyhedron: the bits of a mask.
pub const MOST_VERTICES: usize = 64;

/// Bits of a packed vertex.
const BITS: u32 = MOST_VERTICES.ilog2();

/// Three local vertices.
pub type Face = [u8; 3];

/// The same face from its smallest vertex.
pub fn turned([a, b, c]: Face) -> Face {
    if a < b && a < c {
        [a, b, c]
    } else if b < c {
        [b, c, a]
    } else {
        [c, a, b]
    }
}

/// The same face seen from the other side.
pub fn mirrored([a, b, c]: Face) -> Face {
    [a, c, b]
}

/// The three faces beside `face` of the tet on it, as the tets beyond them see them.
pub fn other_faces([a, b, c]: Face, v: u8) -> [Face; 3] {
    [turned([b, c, v]), turned([a, v, c]), turned([a, b, v])]
}

/// The positions of the set bits.
pub fn bits(mut mask: u64) -> impl Iterator<Item = u8> {
    std::iter::from_fn(move || {
        let bit = mask.trailing_zeros();
        mask &= mask.wrapping_sub(1);
        (bit < u64::BITS).then_some(bit as u8)
    })
}

fn packed(vertices: &[u8]) -> u32 {
    vertices.iter().fold(0, |key, &v| key << BITS | u32::from(v))
}

/// The points of a polyhedron, its faces at the start, and what is known of what meets what.
#[derive(Debug, Clone, Default)]
pub struct Clearance {
    /// Places of the vertices, at most [`MOST_VERTICES`].
    pub points: Vec<DVec3>,
    start_faces: Vec<Face>,
    start_edges: Vec<[u8; 2]>,
    /// Whether an edge is clear of the faces at the start, by its two vertices.
    clear_edges: Vec<Option<bool>>,
    /// Whether a face is clear of the edges at the start.
    clear_faces: FxHashMap<u32, bool>,
    /// Whether an edge meets a face.
    meetings: FxHashMap<u32, bool>,
}

impl Clearance {
    /// Begins with other points, none at first.
    pub fn reset(&mut self) {
        self.points.clear();
        self.meetings.clear();
    }

    /// Sets the faces at the start and their edges, each once, when all points are there.
    pub fn set_start(&mut self, faces: impl IntoIterator<Item = Face>, edges: impl IntoIterator<Item = [u8; 2]>) {
        self.start_faces.clear();
        self.start_faces.extend(faces);
        self.start_edges.clear();
        self.start_edges.extend(edges);
        self.clear_edges.clear();
        self.clear_edges.resize(self.points.len() * self.points.len(), None);
        self.clear_faces.clear();
    }

    /// The faces at the start.
    pub fn start_faces(&self) -> &[Face] {
        &self.start_faces
    }

    /// Whether the edges and faces that the tet on a face adds keep clear of all faces at the start.
    pub fn is_clear_of_start(&mut self, [a, b, c]: Face, v: u8) -> bool {
        [a, b, c].iter().all(|&u| self.is_edge_clear(u, v))
            && [[a, b, v], [b, c, v], [c, a, v]].into_iter().all(|triangle| self.is_face_clear(triangle))
    }

    fn is_edge_clear(&mut self, u: u8, v: u8) -> bool {
        let Self { clear_edges, start_faces, points, .. } = self;
        let slot = usize::from(u.min(v)) * points.len() + usize::from(u.max(v));
        *clear_edges[slot].get_or_insert_with(|| {
            let at = |v: u8| points[usize::from(v)];
            let meets =
                |f: &Face| !f.contains(&u) && !f.contains(&v) && segment_meets_triangle(at(u), at(v), f.map(at));
            !start_faces.iter().any(meets)
        })
    }

    fn is_face_clear(&mut self, mut face: Face) -> bool {
        face.sort_unstable();
        let Self { clear_faces, start_edges, points, .. } = self;
        *clear_faces.entry(packed(&face)).or_insert_with(|| {
            let at = |v: u8| points[usize::from(v)];
            let corners = face.map(at);
            let meets = |[p, q]: &[u8; 2]| {
                !face.contains(p) && !face.contains(q) && segment_meets_triangle(at(*p), at(*q), corners)
            };
            !start_edges.iter().any(meets)
        })
    }

    /// Whether the edges and faces that the tet on a face adds keep clear of another, apart from shared vertices.
    pub fn is_clear_of(&mut self, face: Face, v: u8, other: Face) -> bool {
        if other == face {
            return true;
        }
        for u in face {
            if !other.contains(&u) && !other.contains(&v) && self.meets([u, v], other) {
                return false;
            }
        }
        let ([x, y, z], [p, q, r]) = (face, other);
        for triangle in [[x, y, v], [y, z, v], [z, x, v]] {
            for edge in [[p, q], [q, r], [r, p]] {
                let is_apart = !triangle.contains(&edge[0]) && !triangle.contains(&edge[1]);
                if is_apart && self.meets(edge, triangle) {
                    return false;
                }
            }
        }
        true
    }

    fn meets(&mut self, mut edge: [u8; 2], mut face: Face) -> bool {
        edge.sort_unstable();
        face.sort_unstable();
        let Self { meetings, points, .. } = self;
        *meetings.entry(packed(&[edge[0], edge[1], face[0], face[1], face[2]])).or_insert_with(|| {
            let at = |v: u8| points[usize::from(v)];
            segment_meets_triangle(at(edge[0]), at(edge[1]), face.map(at))
        })
    }
}
