//! The 3 x 3 block matrix and its product.
//!
//! # Method
//! Compressed rows of [`DMat3`] blocks on a [`Pattern`]. Rows are assembled and multiplied independently: no two
//! threads write the same row, so no atomics are needed and results do not depend on the number of threads.
//!
//! # Cost
//! 72 bytes per block beside the pattern's 4; a product reads each block once.

use std::ops::Range;

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use crate::parallel::pieces::pieces;
use crate::sparse::pattern::Pattern;

/// Rows that one task multiplies or assembles.
pub const ROW_CHUNK: usize = 512;

/// A sparse matrix of 3 x 3 blocks; symmetric in all uses of this crate.
#[derive(Debug, Clone)]
pub struct BlockCsr {
    pattern: Pattern,
    blocks: Vec<DMat3>,
}

impl BlockCsr {
    /// The zero matrix on a pattern.
    pub fn zero(pattern: Pattern) -> Self {
        // Pages of zeros, which whoever fills the rows touches first.
        let blocks = bytemuck::allocation::zeroed_vec(pattern.entry_count());
        Self { pattern, blocks }
    }

    /// Where blocks are stored.
    pub fn pattern(&self) -> &Pattern {
        &self.pattern
    }

    /// All blocks, row by row.
    pub fn blocks(&self) -> &[DMat3] {
        &self.blocks
    }

    /// Number of block rows; the matrix has three times as many rows.
    pub fn row_count(&self) -> usize {
        self.pattern.row_count()
    }

    /// Blocks of one row, in the order of [`Pattern::row`].
    #[inline]
    pub fn row_blocks(&self, row: usize) -> &[DMat3] {
        &self.blocks[self.pattern.offsets()[row]..self.pattern.offsets()[row + 1]]
    }

    /// The diagonal block of a row.
    pub fn diagonal(&self, row: usize) -> DMat3 {
        self.blocks[self.pattern.diagonal(row)]
    }

    /// Adds to the block (row, column); ignored where the pattern has none.
    pub fn add(&mut self, row: usize, column: usize, block: DMat3) {
        if let Some(at) = self.pattern.position(row, column) {
            self.blocks[at] += block;
        }
    }

    /// Replaces the diagonal block of a row.
    pub fn set_diagonal(&mut self, row: usize, block: DMat3) {
        self.blocks[self.pattern.diagonal(row)] = block;
    }

    /// Fills the matrix in parallel: `fill(rows, blocks)` writes the blocks of a range of rows, which begin at
    /// `pattern.offsets()[rows.start]`.
    pub fn fill_rows(&mut self, fill: impl Fn(&Pattern, Range<usize>, &mut [DMat3]) + Sync) {
        let Self { pattern, blocks } = self;
        let row_count = pattern.row_count();
        let pattern: &Pattern = pattern;
        let chunk = |begin: usize| begin..(begin + ROW_CHUNK).min(row_count);
        let chunks: Vec<Range<usize>> = (0..row_count).step_by(ROW_CHUNK).map(chunk).collect();
        let count = |rows: &Range<usize>| pattern.offsets()[rows.end] - pattern.offsets()[rows.start];
        let parts = pieces(blocks, chunks.iter().map(count));
        chunks.into_par_iter().zip(parts).for_each(|(rows, part)| fill(pattern, rows, part));
    }

    /// `product = self * vector`.
    pub fn multiply(&self, vector: &[DVec3], product: &mut [DVec3]) {
        debug_assert!(vector.len() == self.row_count() && product.len() == self.row_count());
        product.par_chunks_mut(ROW_CHUNK).enumerate().for_each(|(chunk, out)| {
            for (at, value) in out.iter_mut().enumerate() {
                let row = chunk * ROW_CHUNK + at;
                let mut sum = DVec3::ZERO;
                for (column, block) in self.pattern.row(row).iter().zip(self.row_blocks(row)) {
                    sum += *block * vector[*column as usize];
                }
                *value = sum;
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;
    use crate::index::VertexId;
    use crate::sparse::pattern::Incidence;

    #[test]
    fn the_product_is_that_of_an_independent_library() {
        // Two tets that share a face.
        let connectivity = [0, 1, 2, 3, 1, 2, 3, 4].map(VertexId);
        let offsets = [0, 4, 8];
        let incidence = Incidence::new(5, &offsets, &connectivity).unwrap();
        let context = RunContext::with_threads(1).unwrap();
        let pattern = Pattern::from_elements(&incidence, &offsets, &connectivity, &context).unwrap();
        let mut matrix = BlockCsr::zero(pattern);
        let mut triplets = sprs::TriMat::new((15, 15));
        let mut seed = 1_u32;
        for element in connectivity.chunks(4) {
            for (row, column) in element.iter().flat_map(|r| element.iter().map(move |c| (r.index(), c.index()))) {
                let mut next = || {
                    seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    f64::from(seed >> 16) / 65536.0 - 0.5
                };
                let block = DMat3::from_cols_array(&std::array::from_fn(|_| next()));
                matrix.add(row, column, block);
                for (i, j) in (0..3).flat_map(|i| (0..3).map(move |j| (i, j))) {
                    triplets.add_triplet(3 * row + i, 3 * column + j, block.row(i)[j]);
                }
            }
        }
        let vector: Vec<DVec3> = (0..5).map(|i| DVec3::new(i as f64, 1.0 - i as f64, 0.5)).collect();
        let flat: Vec<f64> = vector.iter().flat_map(|v| v.to_array()).collect();
        let expected = &triplets.to_csr::<usize>() * &sprs::CsVec::new(15, (0..15).collect(), flat);
        let mut product = vec![DVec3::ZERO; 5];
        matrix.multiply(&vector, &mut product);
        for (row, value) in product.iter().flat_map(|v| v.to_array()).enumerate() {
            assert!((value - expected.get(row).copied().unwrap_or(0.0)).abs() < 1e-12);
        }
    }
}
