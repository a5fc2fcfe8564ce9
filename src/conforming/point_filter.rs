//! Which candidate points stand far enough from everything to become vertices.
//!
//! # Method
//! A candidate is rejected when it lies
//! 1. outside the boundary or on it: the walk to it meets a constrained face;
//! 2. closer to a boundary face of the tets around than `cdfn` times the average of its size and the face's;
//! 3. closer to a vertex of the tets around than `cdfn` times the average of the two sizes;
//! 4. closer than that to another accepted candidate: those before it in the order are vertices by then, so rule 3,
//!    applied again at the moment of insertion, decides.
//!
//! "Around" is the containing tet and the tets behind its faces. The mesh is kept Delaunay by the reconnection that
//! follows each insertion, so the nearest vertices are there.
//!
//! # Source
//! [Drakopoulos2017] 4.7.1 (point creation), B.3 `cdfn`.
//!
//! # Differences
//! The average of the two sizes, as B.3 words `cdfn`, not the larger: where fine and coarse parts of the boundary meet, no
//! point ahead of the fine one would be as far from the coarse one's vertices as these ask for.
//!
//! The distance from boundary vertices and faces follows the distribution function only where triangles are well shaped:
//! the average edge of a needle is half its length, and keeping that far from its sides would leave parts with needles
//! on them (extrusions, gears) without a point ([`clearances`]).
//!
//! The thesis keeps a list of accepted candidates per tet and compares within a tet and its neighbours before the
//! insertion; here the insertion itself compares, which also sees candidates two tets away. The first test runs in
//! parallel over all candidates and leaves few for the second.
//!
//! # Cost
//! A short walk and at most eight distances a candidate.

use glam::DVec3;

use crate::geometry::predicates::{offset_orientation, orient3d};
use crate::geometry::tetrahedron::barycentric;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::TET_FACES;
use crate::mesh::tet_store::{TetStore, has_ghost};

use super::flips::Feature;

/// Longest walk; candidates lie a few tets from where they were made.
const MAX_STEPS: usize = 2000;

/// Where a walk ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Walk {
    /// In this tet, boundary included.
    Inside(TetId),
    /// At a constrained face or the end of the mesh.
    Blocked,
    /// Too long.
    Lost,
    /// At a tet that another thread removed.
    Gone,
}

/// Walks from `start` to the tet that contains `point`, across constrained faces only where `crosses_walls`.
///
/// # Source
/// Remembering walk with a rotating first face, [DevillersPionTeillaud2002].
pub fn walk<S: TetStore + ?Sized>(store: &S, start: TetId, point: DVec3, crosses_walls: bool) -> Walk {
    let mut tet = start;
    let mut entered = 4;
    let mut blocked = false;
    for step in 0..MAX_STEPS {
        let row = store.vertices(tet);
        if row[0] == row[1] {
            return Walk::Gone;
        }
        if has_ghost(row) {
            return Walk::Blocked;
        }
        let corners = store.corners(row);
        // Relative to the point, so that most faces are decided by one triple product.
        let offsets = [corners[0] - point, corners[1] - point, corners[2] - point, corners[3] - point];
        let mut next = TetFace::NONE;
        for turn in 0..4 {
            let face = (step + turn) & 3;
            if face == entered {
                continue;
            }
            let [a, b, c] = TET_FACES[face];
            let rough = offset_orientation(offsets[a], offsets[b], offsets[c]);
            if rough.unwrap_or_else(|| orient3d(corners[a], corners[b], corners[c], point)) > 0.0 {
                let side = TetFace::new(tet, face);
                let other = store.neighbor(side);
                if other == TetFace::NONE || !crosses_walls && store.is_face_constrained(side) {
                    blocked = true; // another face may still lead there
                    continue;
                }
                next = other;
                break;
            }
        }
        if next == TetFace::NONE {
            return if blocked { Walk::Blocked } else { Walk::Inside(tet) };
        }
        blocked = false;
        (tet, entered) = (next.tet(), next.face());
    }
    Walk::Lost
}

/// Whether `point` lies in `tet`, boundary included.
pub fn contains<S: TetStore + ?Sized>(store: &S, tet: TetId, point: DVec3) -> bool {
    let row = store.vertices(tet);
    !has_ghost(row) && {
        let corners = store.corners(row);
        TET_FACES.iter().all(|&[a, b, c]| orient3d(corners[a], corners[b], corners[c], point) <= 0.0)
    }
}

/// The smallest feature of `tet` that contains `point`, which lies in it. With `tolerance` above 0, a point whose
/// barycentric weights are below it counts as lying on the face or edge.
pub fn feature_of<S: TetStore + ?Sized>(store: &S, tet: TetId, point: DVec3, tolerance: f64) -> Feature {
    let row = store.vertices(tet);
    let corners = store.corners(row);
    let weights = if tolerance > 0.0 { barycentric(corners, point) } else { [1.0; 4] };
    let mut off = [false; 4];
    for face in 0..4 {
        let [a, b, c] = TET_FACES[face].map(|i| corners[i]);
        off[face] = weights[face] >= tolerance && orient3d(a, b, c, point) != 0.0;
    }
    let remaining: [usize; 4] = std::array::from_fn(|i| i);
    match off.iter().filter(|o| **o).count() {
        4 => Feature::Tet(tet),
        3 => Feature::Face(TetFace::new(tet, off.iter().position(|o| !o).unwrap_or(0))),
        2 => {
            let mut ends = remaining.into_iter().filter(|&i| off[i]);
            Feature::Edge(tet, ends.next().unwrap_or(0), ends.next().unwrap_or(1))
        }
        _ => Feature::Vertex(row[off.iter().position(|o| *o).unwrap_or(0)]),
    }
}

/// Squared distance from `point` to the triangle's plane where its foot lies inside, else to the nearest edge.
pub fn squared_distance_to_triangle(point: DVec3, [a, b, c]: [DVec3; 3]) -> f64 {
    let normal = (b - a).cross(c - a);
    let squared = normal.length_squared();
    if squared > 0.0 {
        let inside = |p: DVec3, q: DVec3| (q - p).cross(point - p).dot(normal) >= 0.0;
        if inside(a, b) && inside(b, c) && inside(c, a) {
            let height = (point - a).dot(normal);
            return height * height / squared;
        }
    }
    let to_segment = |p: DVec3, q: DVec3| {
        let along = q - p;
        let t = ((point - p).dot(along) / along.length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        point.distance_squared(p + t * along)
    };
    to_segment(a, b).min(to_segment(b, c)).min(to_segment(c, a))
}

/// The size of a new point in `tet`: linear between the corners, `minimum_weight` (`cdfm`) of the smallest corner.
#[inline]
pub fn interpolated_size<S: TetStore + ?Sized>(
    store: &S,
    sizes: &[f64],
    tet: TetId,
    point: DVec3,
    minimum_weight: f64,
) -> f64 {
    let row = store.vertices(tet);
    let size_of = |v: VertexId| sizes[v.index()];
    let corner_sizes = [size_of(row[0]), size_of(row[1]), size_of(row[2]), size_of(row[3])];
    let weights = barycentric(store.corners(row), point);
    let smallest = corner_sizes.iter().copied().fold(f64::INFINITY, f64::min);
    let largest = corner_sizes.iter().copied().fold(0.0, f64::max);
    let linear: f64 = weights.iter().zip(corner_sizes).map(|(w, s)| w * s).sum();
    (1.0 - minimum_weight) * linear.clamp(smallest, largest) + minimum_weight * smallest
}

/// Edge of the equilateral triangle of area 1: 2 / 3^(1/4).
const EDGE_OF_UNIT_AREA: f64 = 1.519_671_371_303_185;
/// Where the longest edge at a vertex is longer than this many times the shortest, their average describes neither. On
/// surfaces graded for analysis the ratio stays below 3.
const UNEVEN_EDGES: f64 = 4.0;
/// Share of its size that a vertex with uneven edges keeps clear at least: points closer to it would have edges shorter
/// than half the size field, on a gear nearly every second edge.
const LEAST_CLEARANCE: f64 = 0.5;

/// How far points have to stay from each vertex, before the factor `cdfn`: its size, but at boundary vertices with uneven
/// edges no more than the narrowest triangle there is wide, or half of its size. `scale` is the multiplier of the distribution function.
pub fn clearances(points: &[DVec3], triangles: &[[VertexId; 3]], sizes: &[f64], scale: f64) -> Vec<f64> {
    let mut shortest = vec![f64::INFINITY; sizes.len()];
    let mut longest = vec![0.0f64; sizes.len()];
    let mut width = vec![f64::INFINITY; sizes.len()];
    for triangle in triangles {
        let [a, b, c] = triangle.map(|v| points[v.index()]);
        let lengths = [(b - a).length(), (c - b).length(), (a - c).length()];
        let of_area = width_of(a, b, c);
        for (corner, v) in triangle.iter().map(|v| v.index()).enumerate() {
            for length in [lengths[corner], lengths[(corner + 2) % 3]] {
                shortest[v] = shortest[v].min(length);
                longest[v] = longest[v].max(length);
            }
            width[v] = width[v].min(of_area);
        }
    }
    let bound = |v: usize| {
        let is_uneven = longest[v] > UNEVEN_EDGES * shortest[v];
        if is_uneven { sizes[v].min((scale * width[v]).max(LEAST_CLEARANCE * sizes[v])) } else { sizes[v] }
    };
    (0..sizes.len()).map(bound).collect()
}

/// Whether `point` of size `size` in `tet` keeps its distance from the vertices and boundary faces around (rules 2, 3).
pub fn is_clear<S: TetStore + ?Sized>(
    store: &S,
    sizes: &[f64],
    tet: TetId,
    point: DVec3,
    size: f64,
    near_factor: f64,
) -> bool {
    let row = store.vertices(tet);
    let far_from = |vertex: VertexId| {
        vertex.is_ghost() || {
            let limit = 0.5 * near_factor * (size + sizes[vertex.index()]);
            store.point(vertex).distance_squared(point) >= limit * limit
        }
    };
    if !row.iter().all(|&v| far_from(v)) || !is_clear_of_boundary(store, sizes, tet, point, size, near_factor) {
        return false;
    }
    store.neighbors(tet).into_iter().enumerate().all(|(face, other)| {
        other == TetFace::NONE
            || store.is_face_constrained(TetFace::new(tet, face))
            || (far_from(store.apex(other))
                && is_clear_of_boundary(store, sizes, other.tet(), point, size, near_factor))
    })
}

fn is_clear_of_boundary<S: TetStore + ?Sized>(
    store: &S,
    sizes: &[f64],
    tet: TetId,
    point: DVec3,
    size: f64,
    near_factor: f64,
) -> bool {
    let (flags, neighbors) = (store.flags(tet), store.neighbors(tet));
    if !flags.has_constrained_face() && !neighbors.contains(&TetFace::NONE) {
        return true;
    }
    (0..4).all(|face| {
        let side = TetFace::new(tet, face);
        if neighbors[face] != TetFace::NONE && !flags.is_face_constrained(face) {
            return true;
        }
        let vertices = store.face_vertices(side);
        let corners = store.triangle(vertices);
        let average = vertices.iter().map(|v| sizes[v.index()]).sum::<f64>() / 3.0;
        let limit = 0.5 * near_factor * (size + average.min(needle_width(corners)));
        squared_distance_to_triangle(point, corners) >= limit * limit
    })
}

/// The width of a needle; infinite for other triangles.
fn needle_width([a, b, c]: [DVec3; 3]) -> f64 {
    let squared = [(b - a).length_squared(), (c - b).length_squared(), (a - c).length_squared()];
    let [longest, shortest] =
        [squared.into_iter().fold(0.0, f64::max), squared.into_iter().fold(f64::INFINITY, f64::min)];
    if longest > UNEVEN_EDGES * UNEVEN_EDGES * shortest { width_of(a, b, c) } else { f64::INFINITY }
}

/// The edge of the equilateral triangle that has the area of this one.
fn width_of(a: DVec3, b: DVec3, c: DVec3) -> f64 {
    EDGE_OF_UNIT_AREA * (0.5 * (b - a).cross(c - a).length()).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::Label;
    use crate::mesh::tet_complex::TetComplex;

    #[test]
    fn clearances_follow_the_size_except_at_needles() {
        // A strip of squares in halves, and one needle ten times as long as wide at its end.
        let points: Vec<DVec3> = (0..4)
            .flat_map(|i| [DVec3::new(f64::from(i), 0.0, 0.0), DVec3::new(f64::from(i), 1.0, 0.0)])
            .chain([DVec3::new(13.0, 0.5, 0.0)])
            .collect();
        let mut triangles: Vec<[VertexId; 3]> = (0..3)
            .flat_map(|i| [[2 * i, 2 * i + 2, 2 * i + 3], [2 * i, 2 * i + 3, 2 * i + 1]])
            .map(|t| t.map(VertexId))
            .collect();
        triangles.push([6, 8, 7].map(VertexId));
        let sizes = vec![2.0; points.len() + 1];
        let found = clearances(&points, &triangles, &sizes, 1.2);
        assert!((0..6).all(|v| found[v] == 2.0), "squares are even");
        // The narrowest triangle at the end of the strip is half a square of area 0.5.
        let width = 1.2 * EDGE_OF_UNIT_AREA * 0.5f64.sqrt();
        assert!((found[6] - width).abs() < 1e-12 && (found[7] - width).abs() < 1e-12);
        assert_eq!(found[8], 2.0, "both edges of the tip are long");
        assert_eq!(found[9], 2.0, "not on the surface");
        // Points keep half the size away from the ends of much narrower ones.
        let found = clearances(&points, &triangles, &vec![9.0; points.len() + 1], 1.2);
        assert!(found[6] == 4.5 && found[7] == 4.5 && found[0] == 9.0);
    }

    #[test]
    fn a_small_point_may_stand_nearer_to_a_vertex_with_a_large_size() {
        let points = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
        let mut complex = TetComplex::with_points(points).unwrap();
        complex.create_tet([0, 1, 2, 3].map(VertexId), Label(1)).unwrap();
        complex.pair_faces().unwrap();
        let tet = complex.finite_tets().next().unwrap();
        // 0.25 from the faces, 0.43 from the first vertex. With a factor of 0.5 the average of 1.6 and 0.1 asks for 0.425,
        // the larger would for 0.8; faces are a third of that.
        let point = DVec3::splat(0.25);
        let clear = |size: f64| is_clear(&complex, &[1.6, 0.1, 0.1, 0.1], tet, point, size, 0.5);
        assert!(clear(0.1) && !clear(0.2));
    }

    #[test]
    fn needles_are_as_wide_as_their_area_says() {
        let [a, b] = [DVec3::ZERO, DVec3::X];
        assert_eq!(needle_width([a, b, DVec3::new(0.5, 3.0, 0.0)]), f64::INFINITY);
        let width = needle_width([a, b, DVec3::new(0.5, 10.0, 0.0)]);
        assert!((width * width * 3f64.sqrt() / 4.0 - 5.0).abs() < 1e-12, "an equilateral triangle of the same area");
    }
}
