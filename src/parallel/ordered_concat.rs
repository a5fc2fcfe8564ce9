//! The parts that the chunks of a parallel loop made, as one array in the order of the chunks.
//!
//! # Method
//! The array is made once at its full length and cut where the parts meet; each part is copied into its piece by one
//! thread, which also is the first to touch that memory.
//!
//! # Cost
//! One copy, in parallel; parts and array are there at the same time, a part is freed when it is copied.

use bytemuck::Zeroable;
use rayon::prelude::*;

use crate::parallel::pieces::pieces;

/// Appends the parts in their order.
pub fn ordered_concat<T: Copy + Zeroable + Send + Sync>(parts: Vec<Vec<T>>) -> Vec<T> {
    let total = parts.iter().map(Vec::len).sum();
    // Pages of zeros, which the copies touch first.
    let mut all = bytemuck::allocation::zeroed_vec(total);
    let cut = pieces(&mut all, parts.iter().map(Vec::len));
    cut.into_par_iter().zip(parts).for_each(|(piece, part)| piece.copy_from_slice(&part));
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_stand_in_their_order() {
        let parts: Vec<Vec<u32>> = (0..100u32).map(|i| (0..i % 7).map(|j| 10 * i + j).collect()).collect();
        assert_eq!(ordered_concat(parts.clone()), parts.concat());
        assert!(ordered_concat(Vec::<Vec<u8>>::new()).is_empty());
    }
}
