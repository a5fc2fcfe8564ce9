//! Exact orientation and in-sphere tests with our sign convention.
//!
//! # Method
//! ```text
//!            d
//!           /|\         orient3d(a, b, c, d) > 0  when  ((b - a) x (c - a)) . (d - a) > 0:
//!          / | \        seen from d, the triangle a b c turns clockwise; from outside (below), counter-clockwise
//!         a--|--c       is (a, c, b), the outward face of the tet. This is VTK's order of a positive tet.
//!          \ | /
//!            b          insphere(a, b, c, d, e) > 0 when e lies inside the sphere of a positive tet a b c d.
//! ```
//! 1. A floating-point determinant of the coordinates relative to one point.
//! 2. Semi-static filter: its error is below a constant times the product of the largest relative coordinates by
//!    axis (and the largest squared distance). A caller that knows the extent of all its points can put the same
//!    bound of the extent in front ([`insphere_error_bound`]), which costs one comparison.
//!    Points that are known to lie on a grid of few bits need no more: there the determinant is exact
//!    ([`super::granularity`]).
//! 3. In-sphere only: the same determinant with about 100 bits ([`super::double_double`]), which decides all but true
//!    coincidences. A caller that knows the largest coordinate can put whole numbers in front ([`super::fixed_point`]),
//!    which decide those too.
//! 4. Where nothing decided: adaptive exact arithmetic.
//! # Source
//! [Shewchuk1997], through the crate `robust`; the filter constants are derived below.
//! # Invariants
//! The sign is exact, zero included, for coordinates whose products neither overflow nor underflow. The magnitude is
//! the determinant's up to rounding.

use glam::{BVec3, DVec3};
use robust::Coord3D;

use super::double_double::DoubleDouble;
use super::granularity::Granularity;

/// Half an ulp of 1.
const EPSILON: f64 = f64::EPSILON / 2.0;

/// A determinant of three differences a row: six products of three factors, each with at most 3 roundings of
/// differences, 2 of products and 3 of sums: error <= 6 * 8 * epsilon * (products of maxima), with a margin of 1.3.
const ORIENT_FACTOR: f64 = 64.0 * EPSILON;

/// 24 products of three coordinates and a squared distance; a product carries at most 3 roundings of differences, 5 of
/// the squared distance, and 9 of products and sums: error <= 24 * 17 * epsilon * (products of maxima), margin 1.5.
const INSPHERE_FACTOR: f64 = 640.0 * EPSILON;

/// As `INSPHERE_FACTOR` for sums and products of at most 2^-101 error each; the differences are exact.
const EXTENDED_FACTOR: f64 = 640.0 * EXTENDED_EPSILON;

/// 2^-101, see `double_double`.
const EXTENDED_EPSILON: f64 = EPSILON * EPSILON * 32.0;

/// Products may lose everything below the smallest normal number; far above that, far below any real determinant.
const UNDERFLOW_GUARD: f64 = 1e-280;

fn coord(point: DVec3) -> Coord3D<f64> {
    Coord3D { x: point.x, y: point.y, z: point.z }
}

/// Sign of the volume of the tet a b c d (six times the volume, magnitude approximate): positive in VTK's order.
#[inline]
pub fn orient3d(a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> f64 {
    match offset_orientation(a - d, b - d, c - d) {
        Some(det) => det,
        None => orient3d_exact(a, b, c, d),
    }
}

/// [`orient3d`] of three points given relative to the fourth, or `None` where floating point cannot decide.
#[inline]
pub fn offset_orientation(p: DVec3, q: DVec3, r: DVec3) -> Option<f64> {
    offset_orientation_in(&Granularity::NONE, p, q, r)
}

/// The same for points of a known granularity.
#[inline]
pub fn offset_orientation_in(granularity: &Granularity, p: DVec3, q: DVec3, r: DVec3) -> Option<f64> {
    let det = -p.dot(q.cross(r));
    let largest = p.abs().max(q.abs()).max(r.abs());
    let bound = orient_error_bound(largest);
    if det > bound || det < -bound || granularity.makes_orientation_exact(bound) {
        Some(det)
    } else if largest.min_element() == 0.0 {
        // A difference is zero only between equal numbers: the points share a coordinate plane.
        Some(0.0)
    } else {
        None
    }
}

/// [`orient3d`] of points of a known granularity.
#[inline]
pub fn orient3d_in(granularity: &Granularity, a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> f64 {
    match offset_orientation_in(granularity, a - d, b - d, c - d) {
        Some(det) => det,
        None => orient3d_exact(a, b, c, d),
    }
}

/// A bound of the error of an orientation whose differences are at most `largest` by axis.
#[inline]
pub fn orient_error_bound(largest: DVec3) -> f64 {
    ORIENT_FACTOR * (largest.x * largest.y * largest.z) + UNDERFLOW_GUARD
}

/// The plane of three points, for the sides of many others: [`orient3d`] with what does not change kept.
#[derive(Debug, Clone, Copy)]
pub struct Plane {
    points: [DVec3; 3],
    normal: DVec3,
    /// Largest coordinates by axis of the second and third point relative to the first.
    largest: DVec3,
}

impl Plane {
    /// The plane of a b c.
    #[inline]
    pub fn through(points: [DVec3; 3]) -> Self {
        let [a, b, c] = points;
        let (p, q) = (b - a, c - a);
        Self { points, normal: p.cross(q), largest: p.abs().max(q.abs()) }
    }

    /// The sign of `orient3d(a, b, c, d)`.
    #[inline]
    pub fn side(&self, d: DVec3) -> f64 {
        let [a, b, c] = self.points;
        let offset = d - a;
        // As in `offset_orientation`, relative to a: the same number of roundings.
        let det = self.normal.dot(offset);
        let largest = self.largest.max(offset.abs());
        let bound = ORIENT_FACTOR * (largest.x * largest.y * largest.z) + UNDERFLOW_GUARD;
        if det > bound || det < -bound { det } else { orient3d(a, b, c, d) }
    }
}

/// `robust` follows [Shewchuk1997]: positive when d lies below the plane of a b c seen counter-clockwise.
#[cold]
fn orient3d_exact(a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> f64 {
    -robust::orient3d(coord(a), coord(b), coord(c), coord(d))
}

/// Positive when `e` lies inside the circumsphere of the positive tet a b c d, zero on it.
#[inline]
pub fn insphere(a: DVec3, b: DVec3, c: DVec3, d: DVec3, e: DVec3) -> f64 {
    let rows = [LiftedPoint::new(a - e), LiftedPoint::new(b - e), LiftedPoint::new(c - e), LiftedPoint::new(d - e)];
    let det = face_cofactors(&rows[0], &rows[1], &rows[2]).dot(&rows[3]);
    let bound = insphere_row_bound(&rows);
    if det > bound || det < -bound { det } else { insphere_exact(a, b, c, d, e) }
}

/// The same for a caller that has already tried floating point.
#[cold]
#[inline(never)]
pub fn insphere_exact(a: DVec3, b: DVec3, c: DVec3, d: DVec3, e: DVec3) -> f64 {
    if are_box_corners(&[a, b, c, d, e]) {
        return 0.0;
    }
    let (det, bound) = insphere_extended(a, b, c, d, e);
    if det > bound || det < -bound {
        return det;
    }
    -robust::insphere(coord(a), coord(b), coord(c), coord(d), coord(e))
}

/// Whether five points are corners of one box along the axes, and so exactly on one sphere: what grids are full of.
#[inline]
pub fn are_box_corners(points: &[DVec3; 5]) -> bool {
    let (low, high) = corners_of_box(points);
    points.iter().all(|p| p.cmpeq(low) | p.cmpeq(high) == BVec3::TRUE)
}

/// The box of five points.
#[inline]
pub fn corners_of_box([a, b, c, d, e]: &[DVec3; 5]) -> (DVec3, DVec3) {
    (a.min(*b).min(c.min(*d)).min(*e), a.max(*b).max(c.max(*d)).max(*e))
}

/// The determinant with about 100 bits, and a bound of its error.
fn insphere_extended(a: DVec3, b: DVec3, c: DVec3, d: DVec3, e: DVec3) -> (f64, f64) {
    let row = |p: DVec3| {
        let offset = [
            DoubleDouble::difference(p.x, e.x),
            DoubleDouble::difference(p.y, e.y),
            DoubleDouble::difference(p.z, e.z),
        ];
        let [x, y, z] = offset;
        (offset, x * x + y * y + z * z)
    };
    let cross = |p: &[DoubleDouble; 3], q: &[DoubleDouble; 3]| {
        [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]]
    };
    let dot = |p: &[DoubleDouble; 3], q: &[DoubleDouble; 3]| p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
    let rows = [row(a), row(b), row(c), row(d)];
    let [(p, p_lift), (q, q_lift), (r, r_lift), (s, s_lift)] = &rows;
    // Laplace: the triple products of d with two of a b c, times the lift of the third; and that of a b c.
    let (qr, rp, pq) = (cross(q, r), cross(r, p), cross(p, q));
    let det = dot(&qr, s) * *p_lift + dot(&rp, s) * *q_lift + dot(&pq, s) * *r_lift - dot(&qr, p) * *s_lift;
    let largest = (0..3).map(|i| rows.iter().fold(0.0, |m: f64, row| m.max(row.0[i].high.abs()))).product::<f64>();
    let lift = rows.iter().fold(0.0, |m: f64, row| m.max(row.1.high));
    (det.high, EXTENDED_FACTOR * largest * lift + UNDERFLOW_GUARD)
}

/// A point relative to the query point of an in-sphere test, with its squared distance.
#[derive(Debug, Clone, Copy, Default)]
pub struct LiftedPoint {
    /// Relative coordinates.
    pub offset: DVec3,
    /// Their squared norm.
    pub lift: f64,
}

impl LiftedPoint {
    /// Lifts an offset from the query point.
    #[inline]
    pub fn new(offset: DVec3) -> Self {
        Self { offset, lift: offset.length_squared() }
    }
}

/// The part of an in-sphere determinant that depends on one face: its product with the lifted apex is the determinant.
#[derive(Debug, Clone, Copy)]
pub struct FaceCofactors {
    offset: DVec3,
    lift: f64,
}

impl FaceCofactors {
    /// The in-sphere determinant of the tet (face, apex): positive when the query point is inside.
    #[inline]
    pub fn dot(&self, apex: &LiftedPoint) -> f64 {
        self.offset.dot(apex.offset) + self.lift * apex.lift
    }
}

/// The cofactors of the face a b c of a tet (a, b, c, apex), positive, all relative to the query point.
#[inline]
pub fn face_cofactors(a: &LiftedPoint, b: &LiftedPoint, c: &LiftedPoint) -> FaceCofactors {
    let (bc, ca, ab) = (b.offset.cross(c.offset), c.offset.cross(a.offset), a.offset.cross(b.offset));
    // The determinant with rows (offset, lift) of a, b, c, apex, expanded by the apex; the sign makes "inside" positive.
    FaceCofactors { offset: bc * a.lift + ca * b.lift + ab * c.lift, lift: -a.offset.dot(bc) }
}

/// A bound of the error of [`FaceCofactors::dot`] for rows whose coordinates are at most `largest` by axis and whose
/// lifts are at most `lift`.
#[inline]
pub fn insphere_error_bound(largest: DVec3, lift: f64) -> f64 {
    INSPHERE_FACTOR * (largest.x * largest.y * largest.z) * lift + UNDERFLOW_GUARD
}

/// The bound for four given rows.
#[inline]
pub fn insphere_row_bound(rows: &[LiftedPoint; 4]) -> f64 {
    let [a, b, c, d] = rows;
    let largest = a.offset.abs().max(b.offset.abs()).max(c.offset.abs().max(d.offset.abs()));
    insphere_error_bound(largest, a.lift.max(b.lift).max(c.lift.max(d.lift)))
}

/// Whether three points lie on one line, exactly.
pub fn are_collinear(a: DVec3, b: DVec3, c: DVec3) -> bool {
    let plane = |u: fn(DVec3) -> (f64, f64)| {
        let p = [a, b, c].map(|q| {
            let (x, y) = u(q);
            robust::Coord { x, y }
        });
        robust::orient2d(p[0], p[1], p[2]) == 0.0
    };
    plane(|p| (p.x, p.y)) && plane(|p| (p.y, p.z)) && plane(|p| (p.z, p.x))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signs_follow_the_drawing() {
        let (a, b, c, d) = (DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z);
        assert!(orient3d(a, b, c, d) > 0.0);
        assert!(orient3d(a, c, b, d) < 0.0);
        assert_eq!(orient3d(a, b, c, DVec3::new(0.3, 0.4, 0.0)), 0.0);
        assert!(insphere(a, b, c, d, DVec3::splat(0.4)) > 0.0);
        assert!(insphere(a, b, c, d, DVec3::splat(2.0)) < 0.0);
        assert_eq!(insphere(a, b, c, d, DVec3::splat(1.0)), 0.0);
    }

    /// Deterministic numbers in [0, 1).
    fn sequence(seed: u64) -> impl FnMut() -> f64 {
        let mut state = seed;
        move || {
            state = crate::geometry::spatial_sort::mix(state.wrapping_add(0x9e37_79b9_7f4a_7c15));
            (state >> 11) as f64 / (1u64 << 53) as f64
        }
    }

    #[test]
    fn filters_never_contradict_exact_arithmetic() {
        let mut next = sequence(5);
        for case in 0..20_000 {
            // From general position to nearly (and exactly) degenerate: small integers with a rare tiny shift.
            let size = [1.0, 4.0, 1e6, 1e-6][case % 4];
            let mut point = || {
                let mut p = DVec3::new(next(), next(), next());
                if case % 8 >= 4 {
                    p = (p * 4.0).floor() + DVec3::splat(if next() < 0.2 { next() * 1e-15 } else { 0.0 });
                }
                p * size
            };
            let [a, b, c, d, e] = [point(), point(), point(), point(), point()];
            let exact = orient3d_exact(a, b, c, d);
            assert_eq!(orient3d(a, b, c, d).partial_cmp(&0.0), exact.partial_cmp(&0.0), "{a} {b} {c} {d}");
            let exact = insphere_exact(a, b, c, d, e);
            assert_eq!(insphere(a, b, c, d, e).partial_cmp(&0.0), exact.partial_cmp(&0.0), "{a} {b} {c} {d} {e}");
        }
    }

    #[test]
    fn corners_of_a_box_are_found() {
        let corner = |i: usize| DVec3::new([0.1, 0.3][i & 1], [7.7, -3.0][i >> 1 & 1], [0.7, 1e-9][i >> 2]);
        let five = [0, 3, 5, 6, 7].map(corner);
        assert!(are_box_corners(&five));
        assert_eq!(
            -robust::insphere(coord(five[0]), coord(five[1]), coord(five[2]), coord(five[3]), coord(five[4])),
            0.0
        );
        let mut moved = five;
        moved[4].y = 0.5;
        assert!(!are_box_corners(&moved));
    }

    #[test]
    fn extended_determinant_stays_within_its_bound() {
        let mut next = sequence(11);
        let mut decided = 0;
        for _ in 0..3000 {
            let mut point = || (DVec3::new(next(), next(), next()) - DVec3::splat(0.5)).normalize() + DVec3::splat(3.0);
            let [a, b, c, d, e] = [point(), point(), point(), point(), point()];
            let exact = -robust::insphere(coord(a), coord(b), coord(c), coord(d), coord(e));
            let (det, bound) = insphere_extended(a, b, c, d, e);
            if det.abs() > bound {
                assert_eq!(det > 0.0, exact > 0.0);
                decided += 1;
            } else {
                assert!(exact.abs() <= 2.0 * bound);
            }
        }
        assert!(decided > 2900);
    }

    #[test]
    fn collinear_points_are_found() {
        assert!(are_collinear(DVec3::ZERO, DVec3::ONE, DVec3::splat(3.0)));
        assert!(!are_collinear(DVec3::ZERO, DVec3::ONE, DVec3::new(3.0, 3.0, 3.0000000001)));
    }
}
