//! Boundary sliver deletion: flat tets with two faces on the outer boundary go, and the surface takes the other diagonal.
//!
//! # Method
//! ```text
//!      c                    c        The sliver a b c d has the boundary faces a b c and b a d; its angle at their
//!     /|\                  / \       common edge is large. Without it the boundary goes over a c d and c b d: the
//!    / | \                /   \      quadrilateral's other diagonal. No point moves.
//!   a--+--b     ->       a-----b
//!    \ | /   seen from    \   /      before: edge a b on the surface; after: edge c d
//!     \|/    outside       \ /
//!      d                    d
//! ```
//! A sliver is deleted where its patch is the same on both faces, the edge is not a bend of the surface, the new edge is
//! none (`angrbfdd`), and the new triangles have no large angle that the old ones had not (`angrbfmxp`). Deleting one may
//! make the next one a boundary tet, so the search is repeated (`ndbs`).
//!
//! # Source
//! [Drakopoulos2017] 4.9.3, figure 75; B.3 `mdbs`, `ndbs`, `angdbs`, `angrbfdd`, `angrbfmxp`.
//!
//! # Invariants
//! The one step that changes the surface: its triangles, never its points. Off by default.
//!
//! # Limits
//! Faces between two regions and edges of more than two facets stay.

use rustc_hash::FxHashMap;

use super::boundary_recovery::constrained_mesh::{FaceKey, edge_key, face_key};
use super::options::Options;
use crate::geometry::tetrahedron::dihedral_angles;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::{TET_EDGE_BETWEEN, TET_EDGES, TET_OPPOSITE_EDGES};
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;
use crate::mesh::topology::{ShellTet, collect_shell};

/// Limits of the deletion, degrees.
#[derive(Debug, Clone, Copy)]
struct Limits {
    sliver: f64,
    bend: f64,
    surface: f64,
}

/// A sliver that may go: its boundary faces are those opposite to the local vertices c and d.
struct Deletion {
    tet: TetId,
    /// Local vertices: the edge a b of the surface, then c and d.
    corners: [usize; 4],
}

/// Deletes boundary slivers; `subfaces` and `patches` are the facets of the mesh and their patches. Returns how many.
pub fn delete_boundary_slivers(
    complex: &mut TetComplex,
    subfaces: &mut FxHashMap<FaceKey, u32>,
    patches: &[i32],
    options: &Options,
) -> usize {
    let limits = Limits {
        sliver: options.boundary_sliver_angle,
        bend: options.discontinuity_angle,
        surface: options.surface_angle_limit,
    };
    let mut facets_at: FxHashMap<[VertexId; 2], u32> = FxHashMap::default();
    for &[a, b, c] in subfaces.keys() {
        for edge in [edge_key(a, b), edge_key(b, c), edge_key(a, c)] {
            *facets_at.entry(edge).or_default() += 1;
        }
    }
    let mut deleted = 0;
    for _ in 0..options.boundary_sliver_repeats {
        let tets: Vec<TetId> = complex.finite_tets().collect();
        let before = deleted;
        for tet in tets {
            if let Some(deletion) = find_deletion(complex, tet, subfaces, patches, &facets_at, limits) {
                delete(complex, &deletion, subfaces, &mut facets_at);
                deleted += 1;
            }
        }
        if deleted == before {
            break;
        }
    }
    deleted
}

fn find_deletion(
    complex: &TetComplex,
    tet: TetId,
    subfaces: &FxHashMap<FaceKey, u32>,
    patches: &[i32],
    facets_at: &FxHashMap<[VertexId; 2], u32>,
    limits: Limits,
) -> Option<Deletion> {
    let (neighbors, flags, row) = (complex.neighbors(tet), complex.flags(tet), complex.vertices(tet));
    let mut outer = (0..4).filter(|&face| neighbors[face] == TetFace::NONE);
    let (c, d) = (outer.next()?, outer.next()?);
    if outer.next().is_some() {
        return None;
    }
    let across = TET_EDGE_BETWEEN[c][d];
    let [a, b] = TET_OPPOSITE_EDGES[across];
    let edge = TET_EDGE_BETWEEN[a][b];
    let angles = dihedral_angles(complex.points_of(tet));
    let inner_is_free = !flags.is_face_constrained(a) && !flags.is_face_constrained(b);
    let is_sliver = angles[edge] > limits.sliver;
    let bends = angles[edge].min(angles[across]) < limits.bend;
    if !is_sliver || bends || !inner_is_free || flags.is_edge_constrained(across) {
        return None;
    }
    let facet_of = |face: usize| subfaces.get(&face_key(complex.face_vertices(TetFace::new(tet, face))));
    let (first, second) = (*facet_of(c)?, *facet_of(d)?);
    let is_simple = facets_at.get(&edge_key(row[a], row[b])) == Some(&2);
    if patches.get(first as usize) != patches.get(second as usize) || !is_simple {
        return None;
    }
    // The new edge must be the surface's only at this place: all its tets lie in one fan that this tet closes.
    let mut shell = Vec::new();
    collect_shell(complex, ShellTet::new(tet, c, d), usize::MAX, &mut shell);
    if shell.iter().any(|s| complex.label(s.tet) != complex.label(tet)) {
        return None;
    }
    let largest = |triangles: [[usize; 3]; 2]| {
        triangles.into_iter().map(|t| largest_angle(complex, t.map(|i| row[i]))).fold(0.0, f64::max)
    };
    let (old, new) = (largest([[a, b, c], [a, b, d]]), largest([[a, c, d], [b, c, d]]));
    (new <= old || new <= limits.surface).then_some(Deletion { tet, corners: [a, b, c, d] })
}

/// The largest angle of a triangle, degrees.
fn largest_angle(complex: &TetComplex, triangle: [VertexId; 3]) -> f64 {
    let [p, q, r] = triangle.map(|v| complex.point(v));
    let at = |o: glam::DVec3, x: glam::DVec3, y: glam::DVec3| (x - o).angle_between(y - o).to_degrees();
    at(p, q, r).max(at(q, r, p)).max(at(r, p, q))
}

fn delete(
    complex: &mut TetComplex,
    deletion: &Deletion,
    subfaces: &mut FxHashMap<FaceKey, u32>,
    facets_at: &mut FxHashMap<[VertexId; 2], u32>,
) {
    let tet = deletion.tet;
    let row = complex.vertices(tet);
    let [a, b, c, d] = deletion.corners;
    let [va, vb, vc, vd] = deletion.corners.map(|i| row[i]);
    // The face opposite to a becomes the boundary at b, and the other way round.
    let behind = [complex.neighbor(TetFace::new(tet, a)), complex.neighbor(TetFace::new(tet, b))];
    for (old, new) in [([va, vb, vc], [va, vc, vd]), ([va, vb, vd], [vb, vc, vd])] {
        if let Some(facet) = subfaces.remove(&face_key(old)) {
            subfaces.insert(face_key(new), facet);
        }
    }
    facets_at.remove(&edge_key(va, vb));
    facets_at.insert(edge_key(vc, vd), 2);
    let mut shell = Vec::new();
    collect_shell(complex, ShellTet::new(tet, c, d), usize::MAX, &mut shell);
    for side in behind {
        complex.unglue(side);
        complex.constrain_face(side, true);
    }
    for spoke in shell.iter().filter(|s| s.tet != tet) {
        let flags = complex.flags(spoke.tet);
        let row = complex.vertices(spoke.tet);
        for (edge, [i, j]) in TET_EDGES.into_iter().enumerate() {
            if edge_key(row[i], row[j]) == edge_key(vc, vd) {
                complex.set_flags(spoke.tet, flags.with_edge(edge, true));
            }
        }
    }
    complex.delete_tet(tet);
    for (vertex, side) in [(va, behind[1]), (vb, behind[0]), (vc, behind[0]), (vd, behind[0])] {
        complex.set_tet_of(vertex, side.tet());
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::conforming::boundary_recovery::constrained_mesh::face_key;
    use crate::conforming::refinement::boundary_triangles;
    use crate::context::RunContext;
    use crate::geometry::tetrahedron::volume;
    use crate::index::Label;

    /// A flat tet 0 1 2 3 on two tets that share its edge 2 3 and the apex 4; the outside is constrained. The edge 0 1
    /// of the surface is raised by `rise`; its triangles are of one patch.
    fn roof(rise: f64) -> (TetComplex, FxHashMap<FaceKey, u32>) {
        let points = [[0.0, 0.0, rise], [1.0, 1.0, rise], [1.2, -0.2, 0.0], [-0.2, 1.2, 0.0], [0.5, 0.5, -1.0]];
        let mut complex = TetComplex::with_points(points.map(DVec3::from_array).to_vec()).unwrap();
        for tet in [[0, 1, 2, 3], [0, 2, 3, 4], [1, 3, 2, 4]] {
            let row: [VertexId; 4] = tet.map(VertexId);
            let row = if volume(complex.corners(row)) > 0.0 { row } else { [row[1], row[0], row[2], row[3]] };
            complex.create_tet(row, Label(1)).unwrap();
        }
        complex.pair_faces().unwrap();
        complex.rebuild_vertex_tets();
        let outside = boundary_triangles(&complex, &alone());
        let subfaces: FxHashMap<FaceKey, u32> = outside.iter().zip(0..).map(|(f, i)| (face_key(*f), i)).collect();
        let edges: Vec<_> =
            outside.iter().flat_map(|&[a, b, c]| [edge_key(a, b), edge_key(b, c), edge_key(c, a)]).collect();
        for tet in complex.finite_tets().collect::<Vec<_>>() {
            let (row, neighbors, mut flags) = (complex.vertices(tet), complex.neighbors(tet), complex.flags(tet));
            for (face, neighbor) in neighbors.into_iter().enumerate() {
                flags = flags.with_face(face, neighbor == TetFace::NONE);
            }
            for (edge, [i, j]) in TET_EDGES.into_iter().enumerate() {
                flags = flags.with_edge(edge, edges.contains(&edge_key(row[i], row[j])));
            }
            complex.set_flags(tet, flags);
        }
        (complex, subfaces)
    }

    fn alone() -> RunContext {
        RunContext::with_threads(1).unwrap()
    }

    fn deleted(rise: f64, change: fn(&mut Options)) -> usize {
        let (mut complex, mut subfaces) = roof(rise);
        let mut options = Options { surface_angle_limit: 140.0, ..Options::default() };
        change(&mut options);
        let count = delete_boundary_slivers(&mut complex, &mut subfaces, &[7; 8], &options);
        complex.check_invariants().unwrap();
        let mut outside: Vec<_> = boundary_triangles(&complex, &alone()).into_iter().map(face_key).collect();
        let mut keys: Vec<_> = subfaces.into_keys().collect();
        outside.sort_unstable();
        keys.sort_unstable();
        assert_eq!(outside, keys);
        count
    }

    #[test]
    fn a_flat_tet_goes_and_the_surface_takes_the_other_diagonal() {
        let (mut complex, mut subfaces) = roof(0.01);
        assert_eq!(delete_boundary_slivers(&mut complex, &mut subfaces, &[7; 8], &Options::default()), 1);
        assert_eq!(complex.finite_tets().count(), 2);
        let new = |a: u32| face_key([VertexId(a), VertexId(2), VertexId(3)]);
        assert!(subfaces.contains_key(&new(0)) && subfaces.contains_key(&new(1)));
        for tet in complex.finite_tets() {
            let local = |v: u32| complex.local_vertex(tet, VertexId(v)).unwrap();
            assert!(complex.is_edge_constrained(tet, local(2), local(3)));
        }
        assert_eq!(deleted(0.01, |_| {}), 1);
    }

    #[test]
    fn each_limit_keeps_the_sliver() {
        // The sliver's large angles are near 169 and 164 degrees, the new triangles' largest 109, the old ones' 71.
        assert_eq!(deleted(0.1, |_| {}), 1);
        assert_eq!(deleted(0.1, |o| o.boundary_sliver_angle = 170.0), 0);
        assert_eq!(deleted(0.1, |o| o.discontinuity_angle = 170.0), 0);
        assert_eq!(deleted(0.1, |o| o.surface_angle_limit = 100.0), 0);
        assert_eq!(deleted(0.1, |o| o.boundary_sliver_repeats = 0), 0);
    }

    #[test]
    fn two_patches_keep_their_border() {
        let (mut complex, mut subfaces) = roof(0.01);
        let patches: Vec<i32> = (0..8).collect();
        assert_eq!(delete_boundary_slivers(&mut complex, &mut subfaces, &patches, &Options::default()), 0);
    }
}
