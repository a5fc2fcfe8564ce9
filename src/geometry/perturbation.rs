//! The in-sphere test that never says "on": symbolic perturbation of co-spherical points.
//!
//! # Method
//! A point is in the sphere of a tet when its lift, the squared norm, lies below the hyperplane through the four lifted
//! vertices. Each lift is raised by an infinitesimal amount of its own, the larger the later its point comes in the
//! lexicographic order of coordinates, each of a higher order of magnitude than all earlier ones. Where five points
//! are co-spherical, the sign of the test is then that of the first non-zero derivative by a lift, from the largest
//! amount down:
//! ```text
//! raising the lift of e                        takes e out of the sphere: -1
//! raising the lift of a, at barycentric        raises the hyperplane at e by a's share of e: the sign of
//!    coordinate (e b c d) / (a b c d) of e       orient3d(e, b, c, d); likewise b, c and d
//! ```
//! # Source
//! [DevillersTeillaud2003].
//! # Invariants
//! The answer depends only on coordinates, not on ids or insertion order: the Delaunay tetrahedralization of a point
//! set is unique, and none of its tets is flat.

use glam::{BVec3, DVec3};

use super::granularity::Granularity;
use super::predicates::{corners_of_box, insphere, orient3d_in};

/// Whether a finite point comes after another in the lexicographic order of coordinates.
#[inline]
fn is_later(first: DVec3, second: DVec3) -> bool {
    // Without branches: which coordinate decides cannot be foreseen.
    let by_z = (first.y == second.y) & (first.z > second.z);
    (first.x > second.x) | (first.x == second.x) & ((first.y > second.y) | by_z)
}

/// Whether `e` lies in the perturbed sphere of the positive tet a b c d, for five different points.
pub fn is_in_perturbed_sphere(a: DVec3, b: DVec3, c: DVec3, d: DVec3, e: DVec3) -> bool {
    let sign = insphere(a, b, c, d, e);
    if sign != 0.0 {
        return sign > 0.0;
    }
    is_cospherical_point_inside([a, b, c, d], e, &Granularity::NONE)
}

/// The same for a point already known to be co-spherical with the tet; all of them have this granularity.
pub fn is_cospherical_point_inside(tet: [DVec3; 4], e: DVec3, granularity: &Granularity) -> bool {
    let points = [tet[0], tet[1], tet[2], tet[3], e];
    // From the last point down; nearly always the first that is looked at decides.
    let mut left = [0, 1, 2, 3, 4];
    for count in (1..=5).rev() {
        let mut last = 0;
        for i in 1..count {
            last = if is_later(points[left[i]], points[left[last]]) { i } else { last };
        }
        let i = left[last];
        if i == 4 {
            return false;
        }
        let mut corners = tet;
        corners[i] = e;
        let sign = orient3d_in(granularity, corners[0], corners[1], corners[2], corners[3]);
        if sign != 0.0 {
            return sign > 0.0;
        }
        left[last] = left[count - 1];
    }
    false
}

/// The same for a tet given relative to e, whose in-sphere determinant floating point has found to be zero exactly
/// ([`Granularity::makes_insphere_exact`]), or `None` where e lies in the plane of the three vertices that decide.
#[inline]
pub fn is_exact_cospherical_point_inside(offsets: [DVec3; 4]) -> Option<bool> {
    // Such coordinates are at most 2^16 units: their cubes times two units squared are below the bound of 2^48. So they and their
    // differences are digits of one number, which sorts as the points do, takes 53 bits, and is 0 for e.
    let key = |p: DVec3| p.x * DIGIT * DIGIT + p.y * DIGIT + p.z;
    let [a, b, c, d] = offsets;
    let keys = [key(a), key(b), key(c), key(d)];
    let last = keys[0].max(keys[1]).max(keys[2].max(keys[3]));
    if last < 0.0 {
        return Some(false);
    }
    // The orientation with e in place of the last point, as the triple product of the other three.
    let (p, q, r, sign) = if keys[0] == last {
        (b, c, d, 1.0)
    } else if keys[1] == last {
        (a, c, d, -1.0)
    } else if keys[2] == last {
        (a, b, d, 1.0)
    } else {
        (a, b, c, -1.0)
    };
    let orientation = sign * p.dot(q.cross(r));
    (orientation != 0.0).then_some(orientation > 0.0)
}

/// Above the sum of 2^17, the largest difference of coordinates of 2^16, and of what smaller digits add.
const DIGIT: f64 = (1u32 << 18) as f64;

/// The same for corners of a box along the axes, or `None` where the five points are none: by their places in it alone.
#[inline]
pub fn is_box_corner_inside(points: &[DVec3; 5]) -> Option<bool> {
    let (low, high) = corners_of_box(points);
    // As numbers of three bits the corners are in lexicographic order; their places in the list stand behind.
    let mut keys = [0i32; 5];
    let mut are_corners = true;
    for (place, p) in points.iter().enumerate() {
        let at_high = p.cmpeq(high);
        are_corners &= at_high | p.cmpeq(low) == BVec3::TRUE;
        let corner = i32::from(at_high.x) << 2 | i32::from(at_high.y) << 1 | i32::from(at_high.z);
        keys[place] = corner << 3 | place as i32;
    }
    if !are_corners {
        return None;
    }
    let corners = keys.map(|key| [key >> 5, key >> 4 & 1, key >> 3 & 1]);
    loop {
        let i = (keys[0].max(keys[1]).max(keys[2].max(keys[3])).max(keys[4]) & 7) as usize;
        if i == 4 {
            return Some(false);
        }
        let mut tet = [corners[0], corners[1], corners[2], corners[3]];
        tet[i] = corners[4];
        let [p, q, r] = [0, 1, 2].map(|k: usize| [0, 1, 2].map(|axis: usize| tet[k][axis] - tet[3][axis]));
        let minor = |i: usize, j: usize| q[i] * r[j] - q[j] * r[i];
        // As `orient3d`, with the opposite sign.
        let det = p[0] * minor(1, 2) + p[1] * minor(2, 0) + p[2] * minor(0, 1);
        if det != 0 {
            return Some(det < 0);
        }
        keys[i] = -8; // below all others; the fifth, which ends the loop, is not passed over
    }
}

#[cfg(test)]
mod tests {
    use super::super::predicates::orient3d;
    use super::*;

    #[test]
    fn five_points_of_a_cube_are_decided_consistently() {
        // Of the eight corners, every positive tet and every other corner: even permutations must agree, and of the
        // two ways to triangulate five co-spherical points exactly one is Delaunay.
        let corner = |i: u32| DVec3::new(f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2));
        let mut decided = 0;
        for code in 0..8u32.pow(5) {
            let p: Vec<DVec3> = (0..5).map(|k| corner(code >> (3 * k) & 7)).collect();
            if orient3d(p[0], p[1], p[2], p[3]) <= 0.0 || p[..4].contains(&p[4]) {
                continue;
            }
            assert_eq!(insphere(p[0], p[1], p[2], p[3], p[4]), 0.0);
            let inside = is_in_perturbed_sphere(p[0], p[1], p[2], p[3], p[4]);
            // A box of other sides, some of them turned by nothing but the order of its corners.
            let stretch = |q: DVec3| q * DVec3::new(0.1, 7.0, 3e-9) - DVec3::splat(0.3);
            let five = [0, 1, 2, 3, 4].map(|i: usize| stretch(p[i]));
            assert_eq!(is_box_corner_inside(&five), Some(inside));
            assert_eq!(inside, is_in_perturbed_sphere(p[1], p[2], p[0], p[3], p[4]));
            assert_eq!(inside, is_in_perturbed_sphere(p[1], p[0], p[3], p[2], p[4]));
            // The neighbour across the face 0 1 2 with apex 4, if there is one, must see it the same way.
            if orient3d(p[1], p[0], p[2], p[4]) > 0.0 {
                assert_eq!(inside, is_in_perturbed_sphere(p[1], p[0], p[2], p[4], p[3]));
                decided += 1;
            }
        }
        assert!(decided > 100);
    }

    #[test]
    fn digits_decide_as_coordinates_do() {
        let mut state = 9;
        let mut next = || {
            state = crate::geometry::spatial_sort::mix(state + 1);
            state
        };
        let (mut decided, mut inside) = (0, 0);
        for case in 0..60_000 {
            // Small grids are full of co-spherical points; long ones reach the largest coordinates.
            let scale = [DVec3::ONE, DVec3::new(16384.0, 1.0, 1.0), DVec3::new(1.0, 1.0, 16384.0)][case % 3] * 0.25;
            let mut point = || DVec3::from_array([0; 3].map(|_| (next() % 4) as f64)) * scale + DVec3::splat(5.0);
            let [a, b, c, d, e] = [0; 5].map(|_| point());
            if orient3d(a, b, c, d) <= 0.0 || [a, b, c, d].contains(&e) || insphere(a, b, c, d, e) != 0.0 {
                continue;
            }
            let wanted = is_cospherical_point_inside([a, b, c, d], e, &Granularity::NONE);
            if let Some(answer) = is_exact_cospherical_point_inside([a - e, b - e, c - e, d - e]) {
                assert_eq!(answer, wanted, "{a} {b} {c} {d} {e}");
                decided += 1;
                inside += usize::from(answer);
            }
        }
        assert!(decided > 200 && inside > 50 && inside < decided, "{decided} {inside}");
    }
}
