//! Sums in fixed chunks: the same bits for any number of threads.
//!
//! # Method
//! The index range is cut into chunks of a fixed length; each chunk is summed from its first to its last entry by one
//! thread; the partial sums are added in the order of the chunks.
//!
//! # Invariants
//! The result depends on the data and on [`CHUNK`] only, never on the number of threads or their timing.

use std::ops::Range;

use glam::DVec3;
use rayon::prelude::*;

/// Entries per chunk: long enough to hide the cost of a task, short enough to keep many threads busy.
pub const CHUNK: usize = 4096;

/// Adds `part(range)` over the chunks of `0..len`, in order.
pub fn ordered_sum(len: usize, part: impl Fn(Range<usize>) -> f64 + Sync) -> f64 {
    if len <= CHUNK {
        return part(0..len);
    }
    let parts: Vec<f64> = (0..len.div_ceil(CHUNK))
        .into_par_iter()
        .map(|chunk| part(chunk * CHUNK..((chunk + 1) * CHUNK).min(len)))
        .collect();
    parts.iter().sum()
}

/// The inner product of two vectors of 3-vectors.
pub fn ordered_dot(left: &[DVec3], right: &[DVec3]) -> f64 {
    debug_assert_eq!(left.len(), right.len());
    ordered_sum(left.len(), |range| left[range.clone()].iter().zip(&right[range]).map(|(l, r)| l.dot(*r)).sum())
}

/// The Euclidean norm of a vector of 3-vectors.
pub fn ordered_norm(vector: &[DVec3]) -> f64 {
    ordered_dot(vector, vector).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;

    #[test]
    fn the_sum_has_the_same_bits_for_any_number_of_threads() {
        let values: Vec<DVec3> =
            (0..50_000).map(|i| DVec3::new((f64::from(i)).sin(), 1.0 / (1.0 + f64::from(i)), 0.1)).collect();
        let sums: Vec<u64> = [1, 2, 3]
            .into_iter()
            .map(|threads| {
                let context = RunContext::with_threads(threads).unwrap();
                context.install(|| ordered_dot(&values, &values)).to_bits()
            })
            .collect();
        assert!(sums.iter().all(|s| *s == sums[0]));
    }
}
