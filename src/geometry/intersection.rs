//! Do segments and triangles meet? Answers by exact predicates.
//!
//! # Method
//! 1. A closed segment meets a closed triangle when its ends are not strictly on one side of the plane and the line
//!    passes no edge on the wrong side; in the plane of the triangle the test is made in a projection that keeps the
//!    triangle's area.
//! 2. Two triangles that share vertices are tested for meeting *beyond* what they share: an edge against the triangle
//!    on the other side of the shared vertex; the side of the third vertex for a shared edge.
//!
//! # Source
//! [Shewchuk1997] for the predicates; the case analysis is ours.
//!
//! # Invariants
//! Equal points must have equal ids: merge them first.

use glam::DVec3;
use robust::Coord;

use crate::geometry::predicates::orient3d;

/// How two triangles of a complex meet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Meeting {
    /// Not at all, or only in what they share.
    Proper,
    /// The same three vertices.
    Duplicate,
    /// They share an edge and overlap in a plane.
    Overlap,
    /// They cross or touch.
    Crossing,
}

/// Exact sign of the turn a b c after dropping coordinate `axis`.
fn projected_turn(a: DVec3, b: DVec3, c: DVec3, axis: usize) -> f64 {
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    let flat = |p: DVec3| Coord { x: p[u], y: p[v] };
    robust::orient2d(flat(a), flat(b), flat(c))
}

/// Whether three points lie on one line, exactly.
pub fn is_collinear(a: DVec3, b: DVec3, c: DVec3) -> bool {
    (0..3).all(|axis| projected_turn(a, b, c, axis) == 0.0)
}

/// Whether the closed segment p q meets the closed triangle a b c, which has an area.
pub fn segment_meets_triangle(p: DVec3, q: DVec3, [a, b, c]: [DVec3; 3]) -> bool {
    // Boxes apart: cheaper than a test of orientation, and far cheaper than one of points in a plane.
    if p.max(q).cmplt(a.min(b).min(c)).any() || p.min(q).cmpgt(a.max(b).max(c)).any() {
        return false;
    }
    let side_p = orient3d(a, b, c, p);
    let side_q = orient3d(a, b, c, q);
    if (side_p > 0.0 && side_q > 0.0) || (side_p < 0.0 && side_q < 0.0) {
        return false;
    }
    if side_p == 0.0 && side_q == 0.0 {
        return coplanar_segment_meets_triangle(p, q, [a, b, c]);
    }
    let turns = [orient3d(p, q, a, b), orient3d(p, q, b, c), orient3d(p, q, c, a)];
    turns.iter().all(|&t| t >= 0.0) || turns.iter().all(|&t| t <= 0.0)
}

/// Whether the closed segment p q meets the closed triangle a b c, all in one plane.
pub fn coplanar_segment_meets_triangle(p: DVec3, q: DVec3, [a, b, c]: [DVec3; 3]) -> bool {
    let Some(axis) = (0..3).find(|&axis| projected_turn(a, b, c, axis) != 0.0) else { return false };
    let turn = |x, y, z| projected_turn(x, y, z, axis);
    let inside = |x: DVec3| {
        let sides = [turn(a, b, x), turn(b, c, x), turn(c, a, x)];
        sides.iter().all(|&s| s >= 0.0) || sides.iter().all(|&s| s <= 0.0)
    };
    let crosses = |x: DVec3, y: DVec3| {
        let (sp, sq, sx, sy) = (turn(x, y, p), turn(x, y, q), turn(p, q, x), turn(p, q, y));
        // On one line the inside tests of the ends decide; no need to treat it here.
        (sp * sq < 0.0 && sx * sy <= 0.0) || (sp * sq <= 0.0 && sx * sy < 0.0)
    };
    inside(p) || inside(q) || crosses(a, b) || crosses(b, c) || crosses(c, a)
}

/// Whether the open segment p q crosses the relative interior of the triangle in one inner point.
pub fn segment_pierces_triangle(p: DVec3, q: DVec3, [a, b, c]: [DVec3; 3]) -> bool {
    let side_p = orient3d(a, b, c, p);
    let side_q = orient3d(a, b, c, q);
    if side_p == 0.0 || side_q == 0.0 || (side_p > 0.0) == (side_q > 0.0) {
        return false;
    }
    let turns = [orient3d(p, q, a, b), orient3d(p, q, b, c), orient3d(p, q, c, a)];
    turns.iter().all(|&t| t > 0.0) || turns.iter().all(|&t| t < 0.0)
}

/// The vertices of a triangle, those first that another one has too, and how many these are.
fn shared_first(ids: [u32; 3], others: [u32; 3]) -> ([u32; 3], usize) {
    let mut sorted = ids;
    sorted.sort_by_key(|v| !others.contains(v));
    (sorted, ids.iter().filter(|v| others.contains(v)).count())
}

/// How two triangles with areas meet; `ids` tell which vertices they share.
pub fn triangle_pair(first: [u32; 3], second: [u32; 3], at: impl Fn(u32) -> DVec3) -> Meeting {
    let (own, shared) = shared_first(first, second);
    let (other, _) = shared_first(second, first);
    let corners = |ids: [u32; 3]| ids.map(&at);
    let crossing = |meets: bool| if meets { Meeting::Crossing } else { Meeting::Proper };
    match shared {
        3 => Meeting::Duplicate,
        2 => {
            let ([a, b, c], d) = (corners(own), at(other[2]));
            if orient3d(a, b, c, d) != 0.0 {
                return Meeting::Proper;
            }
            let Some(axis) = (0..3).find(|&axis| projected_turn(a, b, c, axis) != 0.0) else { return Meeting::Proper };
            let same_side = (projected_turn(a, b, c, axis) > 0.0) == (projected_turn(a, b, d, axis) > 0.0);
            if same_side { Meeting::Overlap } else { Meeting::Proper }
        }
        1 => crossing(
            segment_meets_triangle(at(own[1]), at(own[2]), corners(second))
                || segment_meets_triangle(at(other[1]), at(other[2]), corners(first)),
        ),
        _ => {
            let (t, s) = (corners(first), corners(second));
            if separated_by_plane(t, s) || separated_by_plane(s, t) {
                return Meeting::Proper;
            }
            let edges = [[0, 1], [1, 2], [2, 0]];
            crossing(
                edges
                    .iter()
                    .any(|&[i, j]| segment_meets_triangle(t[i], t[j], s) || segment_meets_triangle(s[i], s[j], t)),
            )
        }
    }
}

/// Whether all of `points` lie strictly on one side of the plane of `triangle`.
fn separated_by_plane(triangle: [DVec3; 3], points: [DVec3; 3]) -> bool {
    let side = |p| orient3d(triangle[0], triangle[1], triangle[2], p);
    let first = side(points[0]);
    first != 0.0 && points[1..].iter().all(|&p| side(p) * first.signum() > 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pair(points: &[[f64; 3]], first: [u32; 3], second: [u32; 3]) -> Meeting {
        let at = |v: u32| DVec3::from_array(points[v as usize]);
        let result = triangle_pair(first, second, at);
        assert_eq!(result, triangle_pair(second, first, at));
        result
    }

    #[test]
    fn shared_edges_overlap_only_on_the_same_side() {
        let points = [[0., 0., 0.], [1., 0., 0.], [0., 1., 0.], [0.3, 2., 0.], [0., -1., 0.], [0., 1., 1e-300]];
        assert_eq!(pair(&points, [0, 1, 2], [0, 1, 3]), Meeting::Overlap);
        assert_eq!(pair(&points, [0, 1, 2], [0, 1, 4]), Meeting::Proper);
        assert_eq!(pair(&points, [0, 1, 2], [1, 2, 0]), Meeting::Duplicate);
    }

    #[test]
    fn shared_vertices_cross_only_beyond_them() {
        let points =
            [[0., 0., 0.], [2., 0., 0.], [0., 2., 0.], [0.5, 0.5, 1.], [0.5, 0.5, -1.], [-1., 0., 0.], [0., -1., 0.]];
        assert_eq!(pair(&points, [0, 1, 2], [0, 3, 4]), Meeting::Crossing);
        assert_eq!(pair(&points, [0, 1, 2], [0, 5, 6]), Meeting::Proper);
        assert_eq!(pair(&points, [0, 1, 2], [0, 5, 3]), Meeting::Proper);
    }

    #[test]
    fn disjoint_triangles_touch_at_points_and_planes() {
        let points = [
            [0., 0., 0.],
            [2., 0., 0.],
            [0., 2., 0.],
            [0.5, 0.5, 0.],
            [0.5, 0.5, 1.],
            [1., 0.5, 1.],
            [0.1, 0.1, 0.],
            [0.2, 0.1, 0.],
            [0.1, 0.2, 0.],
            [5., 5., 0.],
            [6., 5., 0.],
            [5., 6., 0.],
        ];
        assert_eq!(pair(&points, [0, 1, 2], [3, 4, 5]), Meeting::Crossing);
        assert_eq!(pair(&points, [0, 1, 2], [6, 7, 8]), Meeting::Crossing);
        assert_eq!(pair(&points, [0, 1, 2], [9, 10, 11]), Meeting::Proper);
    }

    #[test]
    fn collinear_points_are_found_exactly() {
        let a = DVec3::new(0.1, 0.2, 0.3);
        assert!(is_collinear(a, a * 2.0, a * 4.0));
        assert!(!is_collinear(a, a * 2.0, a * 4.0 + DVec3::new(0.0, 0.0, 1e-15)));
    }
}
