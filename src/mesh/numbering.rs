//! Local numbering of tet, pyramid, wedge and hexahedron: drawn once, here, in VTK's node order.
//!
//! ```text
//! tet (VTK 10)          pyramid (VTK 14)        wedge (VTK 13)          hexahedron (VTK 12)
//!        3                     4                   3-------5                7-------6
//!       /|\                   /|\                  |\     /|               /|      /|
//!      / | \                 / | \                 |  \ /  |              4-------5 |
//!     0--|--2               3--|--2                |   4   |              | 3-----|-2
//!      \ | /               /   | /                 0---|---2              |/      |/
//!        1                0-----1                   \  |  /               0-------1
//!                                                      1
//! ```
//! A tet is positive when `geometry::predicates::orient3d(0, 1, 2, 3) > 0`; a pyramid and a hexahedron are positive
//! when their base 0 1 2 3 turns counter-clockwise seen from the apex or the top; a wedge when, seen from its top
//! 3 4 5, the base 0 1 2 turns clockwise in VTK's documentation of VTK_WEDGE (outward normal of 0 1 2).
//! Faces are listed with outward normals. Tet face `f` is opposite to vertex `f`.

/// Vertices of tet face `f`, outward normal; face `f` is opposite to vertex `f`.
pub const TET_FACES: [[usize; 3]; 4] = [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]];

/// Vertices of the six edges of a tet.
pub const TET_EDGES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];

/// For each edge of [`TET_EDGES`], the opposite edge `(c, d)` such that `(a, b, c, d)` is an even permutation of
/// `(0, 1, 2, 3)`: the tet a b c d is positive when 0 1 2 3 is.
pub const TET_OPPOSITE_EDGES: [[usize; 2]; 6] = [[2, 3], [3, 1], [1, 2], [0, 3], [2, 0], [0, 1]];

/// The ends of an edge, the lower one first.
#[inline]
pub fn sorted_edge<T: Ord + Copy>(a: T, b: T) -> [T; 2] {
    [a.min(b), a.max(b)]
}

/// The number in [`TET_EDGES`] of the edge between two local vertices; 6 on the diagonal.
pub const TET_EDGE_BETWEEN: [[usize; 4]; 4] = [[6, 0, 1, 2], [0, 6, 3, 4], [1, 3, 6, 5], [2, 4, 5, 6]];

/// Faces of a hexahedron, outward normals.
pub const HEX_FACES: [[usize; 4]; 6] =
    [[0, 4, 7, 3], [1, 2, 6, 5], [0, 1, 5, 4], [3, 7, 6, 2], [0, 3, 2, 1], [4, 5, 6, 7]];

/// The quadrilateral base of a pyramid, outward normal.
pub const PYRAMID_BASE: [usize; 4] = [0, 3, 2, 1];

/// The triangles of a pyramid, outward normals.
pub const PYRAMID_TRIANGLES: [[usize; 3]; 4] = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]];

/// The triangles of a wedge, outward normals (VTK's order: 0 1 2 points out of the wedge).
pub const WEDGE_TRIANGLES: [[usize; 3]; 2] = [[0, 1, 2], [3, 5, 4]];

/// The quadrilaterals of a wedge, outward normals.
pub const WEDGE_QUADS: [[usize; 4]; 3] = [[0, 3, 4, 1], [1, 4, 5, 2], [2, 5, 3, 0]];

/// Mid-edge nodes of the 10-node tet in VTK's order (VTK 24): node `4 + i` lies on edge `i` of this table.
pub const QUADRATIC_TET_EDGES: [[usize; 2]; 6] = [[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::predicates::orient3d;
    use glam::DVec3;

    #[test]
    fn tet_faces_point_outward() {
        let p = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
        for (f, [a, b, c]) in TET_FACES.into_iter().enumerate() {
            // The opposite vertex lies behind an outward face.
            assert!(orient3d(p[a], p[b], p[c], p[f]) < 0.0);
        }
    }

    #[test]
    fn edge_numbers_match_the_edge_list() {
        for (e, [a, b]) in TET_EDGES.into_iter().enumerate() {
            assert_eq!((TET_EDGE_BETWEEN[a][b], TET_EDGE_BETWEEN[b][a]), (e, e));
        }
    }

    #[test]
    fn opposite_edges_keep_the_orientation() {
        let p = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
        for ([a, b], [c, d]) in TET_EDGES.into_iter().zip(TET_OPPOSITE_EDGES) {
            assert!(orient3d(p[a], p[b], p[c], p[d]) > 0.0);
        }
    }
}
