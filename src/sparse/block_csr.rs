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
        let blocks = vec![DMat3::ZERO; pattern.entry_count()];
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
        self.pattern.position(row, row).map_or(DMat3::ZERO, |at| self.blocks[at])
    }

    /// Adds to the block (row, column); ignored where the pattern has none.
    pub fn add(&mut self, row: usize, column: usize, block: DMat3) {
        if let Some(at) = self.pattern.position(row, column) {
            self.blocks[at] += block;
        }
    }

    /// Fills the matrix in parallel: `fill(rows, blocks)` writes the blocks of a range of rows, which begin at
    /// `pattern.offsets()[rows.start]`.
    pub fn fill_rows(&mut self, fill: impl Fn(&Pattern, Range<usize>, &mut [DMat3]) + Sync) {
        let Self { pattern, blocks } = self;
        let row_count = pattern.row_count();
        let mut parts = Vec::with_capacity(row_count.div_ceil(ROW_CHUNK));
        let mut rest: &mut [DMat3] = blocks;
        for begin in (0..row_count).step_by(ROW_CHUNK) {
            let end = (begin + ROW_CHUNK).min(row_count);
            let (part, tail) = rest.split_at_mut(pattern.offsets()[end] - pattern.offsets()[begin]);
            parts.push((begin..end, part));
            rest = tail;
        }
        let pattern: &Pattern = pattern;
        parts.into_par_iter().for_each(|(rows, part)| fill(pattern, rows, part));
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
