//! Where floating-point determinants are exact: coordinates that are whole multiples of one power of two.
//!
//! # Method
//! Grids with whole or dyadic coordinates are full of coincidences, which a filter cannot decide: the determinant is
//! zero and any bound of its error is not. But differences, products and sums of multiples of a unit u are multiples of its
//! powers, and those below 2^53 times that power are computed without error. So with determinants bounded in units the computed
//! value is the exact one, zero included. The filters' own products of largest coordinates serve as that bound.
//!
//! # Invariants
//! What is called exact is: every intermediate result of the determinant is a multiple of a power of the unit, in
//! magnitude at most 2^53 times that power.
//!
//! # Limits
//! Coordinates that use most of their bits have a unit so small that nothing is called exact.

use glam::DVec3;

use super::predicates::{insphere_error_bound, orient_error_bound};

/// Bits between the largest coordinate and the unit above which no determinant of different points is worth a look.
const MOST_BITS: i32 = 40;

/// The unit of a point set, as the filter bounds up to which its determinants are exact.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Granularity {
    orient: f64,
    insphere: f64,
}

impl Granularity {
    /// Nothing is known to be exact.
    pub const NONE: Self = Self { orient: 0.0, insphere: 0.0 };

    /// That of these points, whose coordinates are at most `largest` in magnitude.
    pub fn of(points: impl Iterator<Item = DVec3>, largest: f64) -> Self {
        let least = exponent(largest) - MOST_BITS;
        let mut unit = i32::MAX;
        for coordinate in points.flat_map(|p| p.to_array()).filter(|&x| x != 0.0) {
            unit = unit.min(lowest_bit(coordinate));
            if unit < least {
                return Self::NONE;
            }
        }
        // Fifth powers have to be normal numbers.
        if !(-150..150).contains(&unit) {
            return Self::NONE;
        }
        let unit = f64::from(unit).exp2();
        // 6 products of three differences: below 2^3 times that of the largest, which may so be 2^50 cubed units.
        let orient = orient_error_bound(DVec3::splat(unit)) * 50f64.exp2();
        // 24 products with squared distances: below 2^5 times that of the largest.
        let insphere = insphere_error_bound(DVec3::splat(unit), unit * unit) * 48f64.exp2();
        Self { orient, insphere }
    }

    /// Whether an orientation is exact whose filter has this bound.
    #[inline]
    pub fn makes_orientation_exact(&self, bound: f64) -> bool {
        bound <= self.orient
    }

    /// Whether an in-sphere determinant is exact whose filter has this bound.
    #[inline]
    pub fn makes_insphere_exact(&self, bound: f64) -> bool {
        bound <= self.insphere
    }
}

/// The power of two of the highest bit.
fn exponent(x: f64) -> i32 {
    (x.to_bits() >> 52 & 0x7ff) as i32 - 1023
}

/// The power of two of the lowest bit of a number that is not zero.
#[inline]
fn lowest_bit(x: f64) -> i32 {
    // The bit above the mantissa stands for the leading 1 (of subnormal numbers too, which are far below any unit used).
    exponent(x) - 52 + (x.to_bits() | 1 << 52).trailing_zeros() as i32
}

#[cfg(test)]
mod tests {
    use super::super::predicates::{insphere, insphere_exact, offset_orientation, offset_orientation_in};
    use super::super::spatial_sort::mix;
    use super::*;

    #[test]
    fn lowest_bits_are_found() {
        for (x, bit) in [(1.0, 0), (-3.0, 0), (12.0, 2), (0.75, -2), (f64::EPSILON + 1.0, -52), (-96.0, 5)] {
            assert_eq!(lowest_bit(x), bit, "{x}");
        }
    }

    #[test]
    fn what_is_called_exact_is() {
        let mut state = 3;
        let mut next = || {
            state = mix(state + 1);
            state
        };
        let (mut orientations, mut spheres) = (0, 0);
        for case in 0..20_000 {
            // Differences of few bits, far from the origin or near, in units large and small.
            let bits = [3, 9, 16, 20][case % 4];
            let (unit, offset) = [(1.0, 0.0), (2f64.powi(-9), 77.0), (2f64.powi(12), -4096.0)][case % 3];
            let mut point = || DVec3::from_array([0; 3].map(|_| (next() % (1 << bits)) as f64 * unit + offset));
            let [a, b, c, d, e] = [0; 5].map(|_| point());
            let points = [a, b, c, d, e];
            let largest = points.iter().fold(0.0, |m: f64, p| m.max(p.abs().max_element()));
            let granularity = Granularity::of(points.into_iter(), largest);
            if offset_orientation(a - d, b - d, c - d).is_none()
                && let Some(det) = offset_orientation_in(&granularity, a - d, b - d, c - d)
            {
                let coord = |p: DVec3| robust::Coord3D { x: p.x, y: p.y, z: p.z };
                let exact = -robust::orient3d(coord(a), coord(b), coord(c), coord(d));
                assert_eq!(det.partial_cmp(&0.0), exact.partial_cmp(&0.0), "{points:?}");
                orientations += 1;
            }
            let largest = points.iter().fold(DVec3::ZERO, |m, &p| m.max((p - e).abs()));
            let lift = points.iter().fold(0.0, |m: f64, &p| m.max((p - e).length_squared()));
            if granularity.makes_insphere_exact(insphere_error_bound(largest, lift)) {
                assert_eq!(insphere(a, b, c, d, e), insphere_exact(a, b, c, d, e), "{points:?}");
                spheres += 1;
            }
        }
        assert!(orientations > 20 && spheres > 4000, "{orientations} {spheres}");
    }

    #[test]
    fn fine_coordinates_have_no_unit() {
        let points = [DVec3::splat(0.1), DVec3::ONE];
        assert_eq!(Granularity::of(points.into_iter(), 1.0), Granularity::NONE);
        assert_eq!(Granularity::of([DVec3::splat(1e-60)].into_iter(), 1e-60), Granularity::NONE);
    }
}
