//! Sums of two doubles: about 104 bits, between plain floating point and exact expansions.
//!
//! # Method
//! A value is `high + low` with `low` at most half an ulp of `high`. Products and sums are made of error-free
//! transformations; no fused multiply-add is needed.
//! # Source
//! [Dekker1971]; the error-free transformations as in [Shewchuk1997].
//! # Invariants
//! [`DoubleDouble::difference`] is exact. A sum has an absolute error of at most 2^-103 (|a| + |b|), a product a relative
//! error of at most 2^-101, as long as nothing overflows or underflows.

use std::ops::{Add, Mul, Neg, Sub};

/// 2^27 + 1: splits a double into two halves of 26 bits.
const SPLITTER: f64 = 134_217_729.0;

/// An unevaluated sum of two doubles.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DoubleDouble {
    /// The leading part.
    pub high: f64,
    /// What the leading part lacks.
    pub low: f64,
}

#[inline]
fn two_sum(a: f64, b: f64) -> (f64, f64) {
    let sum = a + b;
    let part = sum - a;
    (sum, (a - (sum - part)) + (b - part))
}

#[inline]
fn fast_two_sum(a: f64, b: f64) -> DoubleDouble {
    let high = a + b;
    DoubleDouble { high, low: b - (high - a) }
}

#[inline]
fn split(a: f64) -> (f64, f64) {
    let c = SPLITTER * a;
    let high = c - (c - a);
    (high, a - high)
}

#[inline]
fn two_product(a: f64, b: f64) -> (f64, f64) {
    let product = a * b;
    let (a_high, a_low) = split(a);
    let (b_high, b_low) = split(b);
    (product, ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low)
}

impl DoubleDouble {
    /// `a - b`, exactly.
    #[inline]
    pub fn difference(a: f64, b: f64) -> Self {
        let (high, low) = two_sum(a, -b);
        Self { high, low }
    }
}

impl Neg for DoubleDouble {
    type Output = Self;

    #[inline]
    fn neg(self) -> Self {
        Self { high: -self.high, low: -self.low }
    }
}

impl Add for DoubleDouble {
    type Output = Self;

    #[inline]
    fn add(self, other: Self) -> Self {
        let (high, low) = two_sum(self.high, other.high);
        fast_two_sum(high, low + (self.low + other.low))
    }
}

impl Sub for DoubleDouble {
    type Output = Self;

    #[inline]
    fn sub(self, other: Self) -> Self {
        self + -other
    }
}

impl Mul for DoubleDouble {
    type Output = Self;

    #[inline]
    fn mul(self, other: Self) -> Self {
        let (high, low) = two_product(self.high, other.high);
        fast_two_sum(high, low + (self.high * other.low + self.low * other.high))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_and_sums_keep_what_doubles_lose() {
        let tiny = f64::EPSILON / 4.0;
        let one = DoubleDouble::difference(1.0, -tiny);
        assert_eq!((one.high, one.low), (1.0, tiny));
        // (1 + t)^2 - 1 - 2 t = t^2, with an error of a few 2^-102.
        let rest = one * one - one - DoubleDouble::difference(tiny, 0.0);
        assert!(rest.high.abs() < 1e-30 && (one * one).low == 2.0 * tiny);
        let third = DoubleDouble { high: 1.0 / 3.0, low: 1.0 / 3.0 * f64::EPSILON / 4.0 };
        let sum = third + third + third;
        assert!((sum.high - 1.0).abs() < 1e-30 && sum.low.abs() < 1e-30);
    }
}
