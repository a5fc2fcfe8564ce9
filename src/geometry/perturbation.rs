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

use std::cmp::Ordering;

use glam::DVec3;

use super::predicates::{insphere, orient3d};

/// Lexicographic order of finite points.
#[inline]
pub fn compare_points(first: DVec3, second: DVec3) -> Ordering {
    let by = |a: f64, b: f64| a.partial_cmp(&b).unwrap_or(Ordering::Equal);
    by(first.x, second.x).then(by(first.y, second.y)).then(by(first.z, second.z))
}

/// Whether `e` lies in the perturbed sphere of the positive tet a b c d, for five different points.
pub fn is_in_perturbed_sphere(a: DVec3, b: DVec3, c: DVec3, d: DVec3, e: DVec3) -> bool {
    let sign = insphere(a, b, c, d, e);
    if sign != 0.0 {
        return sign > 0.0;
    }
    is_cospherical_point_inside([a, b, c, d], e)
}

/// The same for a point already known to be co-spherical with the tet.
pub fn is_cospherical_point_inside(tet: [DVec3; 4], e: DVec3) -> bool {
    // The fifth and the others from the largest down; nearly always the first that is looked at decides.
    let mut left = [0, 1, 2, 3, 4];
    for count in (1..=5).rev() {
        let point = |i: usize| if i < 4 { tet[i] } else { e };
        let mut largest = 0;
        for i in 1..count {
            if compare_points(point(left[i]), point(left[largest])).is_gt() {
                largest = i;
            }
        }
        let i = left[largest];
        if i == 4 {
            return false;
        }
        let mut corners = tet;
        corners[i] = e;
        let sign = orient3d(corners[0], corners[1], corners[2], corners[3]);
        if sign != 0.0 {
            return sign > 0.0;
        }
        left[largest] = left[count - 1];
    }
    false
}

#[cfg(test)]
mod tests {
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
}
