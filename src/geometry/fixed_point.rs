//! The in-sphere test in whole numbers: exact, and as fast as about a hundred multiplications.
//!
//! # Method
//! All coordinates of a point set are multiplied by one power of two that brings the largest below 2^60. A coordinate
//! that is a whole number then (all but those that are more than 2^7 times smaller than the largest and use their last bits) is
//! exact in 64 bits, whatever grid the points lie on.
//! 1. Differences: 61 bits and a sign; squared distances: 124 bits; cross products: 124 bits and a sign.
//! 2. Triple products: three words of 64 bits.
//! 3. Their products with squared distances, summed by columns of 64 bits; the sign is that of the sum.
//! # Source
//! The determinant of [Shewchuk1997], expanded by the squared distances; fixed-width arithmetic in place of expansions.
//! # Invariants
//! The sign is exact, zero included; where a coordinate does not fit there is no answer.

use glam::DVec3;

/// Scaled coordinates stay below 2^60, so that differences stay below 2^61.
const COORDINATE_BITS: i32 = 60;

/// The power of two that makes whole numbers of the coordinates of a point set.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FixedPoint {
    scale: f64,
}

impl FixedPoint {
    /// For coordinates of at most this magnitude; `None` where the power of two is not a normal number.
    pub fn for_magnitude(largest: f64) -> Option<Self> {
        // The exponent as it stands in the bits: largest < 2^(exponent + 1).
        let exponent = (largest.to_bits() >> 52 & 0x7ff) as i32 - 1023;
        let scale = f64::from(COORDINATE_BITS - 1 - exponent).exp2();
        (largest.is_normal() && scale.is_normal()).then_some(Self { scale })
    }

    /// The sign of the in-sphere determinant: 1 when `e` lies inside the sphere of the positive tet a b c d, 0 on it.
    pub fn insphere(&self, a: DVec3, b: DVec3, c: DVec3, d: DVec3, e: DVec3) -> Option<f64> {
        let e = self.whole(e)?;
        let row = |p: DVec3| self.whole(p).map(|p| Row::new([p[0] - e[0], p[1] - e[1], p[2] - e[2]]));
        let [p, q, r, s] = [row(a)?, row(b)?, row(c)?, row(d)?];
        // Laplace: the triple products of s with two of p q r, times the lift of the third; and that of p q r.
        let (qr, rp, pq) = (q.cross(&r), r.cross(&p), p.cross(&q));
        let mut sum = Columns::default();
        sum.add(&Triple::new(&qr, &s), p.lift, 1);
        sum.add(&Triple::new(&rp, &s), q.lift, 1);
        sum.add(&Triple::new(&pq, &s), r.lift, 1);
        sum.add(&Triple::new(&qr, &p), s.lift, -1);
        Some(sum.sign())
    }

    #[inline]
    fn whole(&self, point: DVec3) -> Option<[i64; 3]> {
        let scaled = point * self.scale;
        let whole = [scaled.x as i64, scaled.y as i64, scaled.z as i64];
        (DVec3::new(whole[0] as f64, whole[1] as f64, whole[2] as f64) == scaled).then_some(whole)
    }
}

fn product(a: i64, b: i64) -> i128 {
    i128::from(a) * i128::from(b)
}

/// A point relative to the query point, with its squared distance.
struct Row {
    offset: [i64; 3],
    lift: u128,
}

impl Row {
    #[inline]
    fn new(offset: [i64; 3]) -> Self {
        let lift = offset.into_iter().map(|x| product(x, x)).sum::<i128>() as u128;
        Self { offset, lift }
    }

    #[inline]
    fn cross(&self, other: &Self) -> [i128; 3] {
        let (p, q) = (&self.offset, &other.offset);
        let entry = |i: usize, j: usize| product(p[i], q[j]) - product(p[j], q[i]);
        [entry(1, 2), entry(2, 0), entry(0, 1)]
    }
}

/// A triple product: `high * 2^64 + low`.
struct Triple {
    high: i128,
    low: u64,
}

impl Triple {
    #[inline]
    fn new(cross: &[i128; 3], row: &Row) -> Self {
        let (mut high, mut low) = (0i128, 0i128);
        for axis in 0..3 {
            let (upper, lower) = ((cross[axis] >> 64) as i64, cross[axis] as u64);
            let offset = row.offset[axis];
            high += product(upper, offset);
            // Below 2^125 in magnitude, three of them below 2^127.
            low += i128::from(lower) * i128::from(offset);
        }
        Self { high: high + (low >> 64), low: low as u64 }
    }
}

/// A sum of five columns of weight 2^(64 i), each far from overflow.
#[derive(Default)]
struct Columns([i128; 5]);

impl Columns {
    /// Adds `triple * lift`, or takes it away.
    #[inline]
    fn add(&mut self, triple: &Triple, lift: u128, sign: i128) {
        let (lift_high, lift_low) = ((lift >> 64) as u64, lift as u64);
        let (upper, middle) = ((triple.high >> 64) as i64, triple.high as u64);
        for (place, factor) in [(0, triple.low), (1, middle)] {
            for (shift, word) in [(0, lift_low), (1, lift_high)] {
                let product = u128::from(factor) * u128::from(word);
                self.0[place + shift] += sign * (product as u64 as i128);
                self.0[place + shift + 1] += sign * ((product >> 64) as i128);
            }
        }
        // The upper word carries the sign; its products with 64 bits are below 2^127.
        for (place, word) in [(2, lift_low), (3, lift_high)] {
            let product = i128::from(upper) * i128::from(word);
            self.0[place] += sign * (product as u64 as i128);
            self.0[place + 1] += sign * (product >> 64);
        }
    }

    fn sign(mut self) -> f64 {
        let mut rest = 0;
        for i in 0..4 {
            self.0[i + 1] += self.0[i] >> 64;
            rest |= self.0[i] as u64;
        }
        match self.0[4].signum() {
            0 if rest != 0 => 1.0,
            sign => sign as f64,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::predicates::insphere_exact;
    use super::*;
    use crate::geometry::spatial_sort::mix;

    fn sequence(seed: u64) -> impl FnMut() -> f64 {
        let mut state = seed;
        move || {
            state = mix(state.wrapping_add(0x9e37_79b9_7f4a_7c15));
            (state >> 11) as f64 / (1u64 << 53) as f64
        }
    }

    #[test]
    fn signs_are_those_of_exact_arithmetic() {
        let mut next = sequence(31);
        let (mut on, mut answered) = (0, 0);
        for case in 0..24_000 {
            let mut point = || {
                let p = DVec3::new(next(), next(), next());
                match case % 6 {
                    0 => p,
                    1 => (p * 3.0).floor() * 0.1,
                    2 => (p * 3.0).floor(),
                    3 => (p - DVec3::splat(0.5)).normalize(),
                    4 => p * 1e-6 + DVec3::splat(1e6),
                    _ => (p * 3.0).floor() * -0.3e12,
                }
            };
            let points = [point(), point(), point(), point(), point()];
            let largest = points.iter().fold(0.0, |m: f64, p| m.max(p.abs().max_element()));
            let [a, b, c, d, e] = points;
            if let Some(sign) = FixedPoint::for_magnitude(largest).and_then(|f| f.insphere(a, b, c, d, e)) {
                assert_eq!(sign.partial_cmp(&0.0), insphere_exact(a, b, c, d, e).partial_cmp(&0.0), "{points:?}");
                on += usize::from(sign == 0.0);
                answered += 1;
            }
        }
        assert!(on > 1000 && answered > 20_000, "{on} {answered}");
    }

    #[test]
    fn the_largest_differences_do_not_overflow() {
        // Corners of a cube around the origin that fills the range, and a point a last bit off its sphere.
        let corner = |i: usize| DVec3::new([-1.0, 1.0][i & 1], [-1.0, 1.0][i >> 1 & 1], [-1.0, 1.0][i >> 2]);
        let largest = 2f64.powi(40) * (1.0 + f64::EPSILON);
        let fixed = FixedPoint::for_magnitude(largest).unwrap();
        let [a, b, c, d] = [0, 1, 2, 4].map(|i| corner(i) * 2f64.powi(40));
        let orientation = crate::geometry::predicates::orient3d(a, b, c, d).signum();
        for (factor, wanted) in [(1.0 - f64::EPSILON, 1.0), (1.0, 0.0), (1.0 + f64::EPSILON, -1.0)] {
            let e = corner(7) * 2f64.powi(40) * factor;
            assert_eq!(fixed.insphere(a, b, c, d, e), Some(wanted * orientation));
        }
    }

    #[test]
    fn coordinates_that_do_not_fit_have_no_answer() {
        assert!(FixedPoint::for_magnitude(0.0).is_none() && FixedPoint::for_magnitude(f64::NAN).is_none());
        assert!(FixedPoint::for_magnitude(1e-305).is_none());
        let fixed = FixedPoint::for_magnitude(1.0).unwrap();
        assert!(fixed.insphere(DVec3::X, DVec3::Y, DVec3::Z, DVec3::ONE, DVec3::splat(1e-17)).is_none());
        assert!(fixed.insphere(DVec3::X, DVec3::Y, DVec3::Z, DVec3::ONE, DVec3::ZERO).is_some());
    }
}
