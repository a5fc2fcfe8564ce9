//! Preconditioners: point Jacobi, block Jacobi, incomplete block Cholesky.
//!
//! # Method
//! - [`PointJacobi`]: the inverse diagonal; with conjugate gradients the JCG of the thesis.
//! - [`BlockJacobi`]: the inverse 3 x 3 diagonal blocks.
//! - [`IncompleteCholesky`]: block L D L^T without fill [MeijerinkVanDerVorst1977], in fixed blocks of rows; couplings
//!   between blocks of rows are dropped, so the blocks are factored and solved in parallel with the same result for
//!   any number of threads. Where a pivot comes out not positive definite, or smaller than a thousandth of the
//!   matrix's own diagonal block, the part starts again with its diagonal blocks enlarged by a thousandth, then by
//!   twice as much, and so on [Manteuffel1980], [LinMore1999]: the factor stays positive definite with entries of bounded size.
//!
//! # Differences
//! The shift is per part of rows, so that one stiff corner does not weaken the factor elsewhere; it multiplies the 3 x 3 diagonal block.
//!
//! # Cost
//! Incomplete Cholesky: 72 bytes per stored lower block; one apply costs about one product.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use crate::sparse::block_csr::BlockCsr;

/// Rows per independently factored part: large enough that few couplings are dropped (about 4 % of a 3-D mesh in
/// breadth-first or lattice order), small enough that eight threads find work on 10^5 rows.
const PART_ROWS: usize = 8192;

/// Rows per task of the diagonal preconditioners.
const ROW_CHUNK: usize = 4096;

/// First enlargement of the diagonal blocks of a part whose factor breaks down [LinMore1999]: `1e-3` there.
const FIRST_SHIFT: f64 = 1e-3;

/// Past this shift the matrix is far from positive definite, and a part keeps its diagonal blocks only.
const LAST_SHIFT: f64 = 4.0;

/// Least pivot as a share of the diagonal block: entries of L stay below its inverse, so that rounding cannot make the factor
/// indefinite. Exact factors of meshes with a fixed point have pivots above it unless springs differ by more.
const LEAST_PIVOT: f64 = 1e-3;

/// Approximates `matrix^-1 * residual`.
pub trait Preconditioner: Send + Sync {
    /// Writes the approximation into `result`.
    fn apply(&self, residual: &[DVec3], result: &mut [DVec3]);
}

/// The inverse of the diagonal.
#[derive(Debug, Clone)]
pub struct PointJacobi(Vec<DVec3>);

impl PointJacobi {
    /// From the diagonal of a matrix; zero entries count as one.
    pub fn new(matrix: &BlockCsr) -> Self {
        let inverse = |value: f64| if value != 0.0 && value.is_finite() { 1.0 / value } else { 1.0 };
        Self(
            (0..matrix.row_count())
                .into_par_iter()
                .map(|row| {
                    let block = matrix.diagonal(row);
                    DVec3::new(inverse(block.x_axis.x), inverse(block.y_axis.y), inverse(block.z_axis.z))
                })
                .collect(),
        )
    }
}

impl Preconditioner for PointJacobi {
    fn apply(&self, residual: &[DVec3], result: &mut [DVec3]) {
        result.par_chunks_mut(ROW_CHUNK).enumerate().for_each(|(chunk, out)| {
            let begin = chunk * ROW_CHUNK;
            for (at, value) in out.iter_mut().enumerate() {
                *value = residual[begin + at] * self.0[begin + at];
            }
        });
    }
}

/// The inverses of the diagonal blocks.
#[derive(Debug, Clone)]
pub struct BlockJacobi(Vec<DMat3>);

impl BlockJacobi {
    /// From the diagonal blocks of a matrix; a singular block counts as the identity.
    pub fn new(matrix: &BlockCsr) -> Self {
        Self((0..matrix.row_count()).into_par_iter().map(|row| inverse_or_identity(matrix.diagonal(row))).collect())
    }

    /// Takes the diagonal block of one row anew.
    pub fn refresh(&mut self, matrix: &BlockCsr, row: usize) {
        self.0[row] = inverse_or_identity(matrix.diagonal(row));
    }
}

impl Preconditioner for BlockJacobi {
    fn apply(&self, residual: &[DVec3], result: &mut [DVec3]) {
        result.par_chunks_mut(ROW_CHUNK).enumerate().for_each(|(chunk, out)| {
            let begin = chunk * ROW_CHUNK;
            for (at, value) in out.iter_mut().enumerate() {
                *value = self.0[begin + at] * residual[begin + at];
            }
        });
    }
}

fn inverse_or_identity(block: DMat3) -> DMat3 {
    let scale = block.x_axis.length().max(block.y_axis.length()).max(block.z_axis.length());
    let determinant = block.determinant();
    if determinant.is_finite() && determinant.abs() > 1e-14 * scale.powi(3) {
        block.inverse()
    } else if scale > 0.0 && scale.is_finite() {
        DMat3::from_diagonal(DVec3::splat(1.0 / scale))
    } else {
        DMat3::IDENTITY
    }
}

/// Leading minors of a symmetric block are positive.
fn is_positive_definite(block: &DMat3) -> bool {
    let first = block.x_axis.x;
    let second = block.x_axis.x * block.y_axis.y - block.y_axis.x * block.x_axis.y;
    first > 0.0 && second > 0.0 && block.determinant() > 0.0
}

/// Block L D L^T of the parts of a matrix on its own pattern.
#[derive(Debug, Clone)]
pub struct IncompleteCholesky {
    parts: Vec<Part>,
}

/// Factor of the rows `begin..begin + inverse_pivots.len()`.
#[derive(Debug, Clone)]
struct Part {
    begin: usize,
    /// Start of each row's strictly lower entries.
    offsets: Vec<u32>,
    /// Columns relative to `begin`.
    columns: Vec<u32>,
    /// Strictly lower blocks of L.
    lower: Vec<DMat3>,
    /// Inverses of the blocks of D.
    inverse_pivots: Vec<DMat3>,
}

impl IncompleteCholesky {
    /// Factors a symmetric matrix.
    pub fn new(matrix: &BlockCsr) -> Self {
        let rows = matrix.row_count();
        let parts = (0..rows.div_ceil(PART_ROWS))
            .into_par_iter()
            .map(|part| Part::factor(matrix, part * PART_ROWS, ((part + 1) * PART_ROWS).min(rows)))
            .collect();
        Self { parts }
    }
}

impl Part {
    /// Factors with the smallest shift that works.
    fn factor(matrix: &BlockCsr, begin: usize, end: usize) -> Self {
        let mut shift = 0.0;
        while shift <= LAST_SHIFT {
            if let Some(part) = Self::factor_shifted(matrix, begin, end, shift) {
                return part;
            }
            shift = if shift == 0.0 { FIRST_SHIFT } else { 2.0 * shift };
        }
        Self {
            begin,
            offsets: vec![0; end - begin + 1],
            columns: Vec::new(),
            lower: Vec::new(),
            inverse_pivots: (begin..end).map(|row| inverse_or_identity(matrix.diagonal(row))).collect(),
        }
    }

    /// `None` where a pivot is too small.
    fn factor_shifted(matrix: &BlockCsr, begin: usize, end: usize, shift: f64) -> Option<Self> {
        let mut part = Self {
            begin,
            offsets: vec![0],
            columns: Vec::new(),
            lower: Vec::new(),
            inverse_pivots: Vec::with_capacity(end - begin),
        };
        for row in begin..end {
            let row_start = part.columns.len();
            for (column, block) in matrix.pattern().row(row).iter().zip(matrix.row_blocks(row)) {
                let column = *column as usize;
                if column >= begin && column < row {
                    part.columns.push((column - begin) as u32);
                    part.lower.push(*block);
                }
            }
            part.offsets.push(part.columns.len() as u32);
            part.eliminate_row(row_start, matrix.diagonal(row) * (1.0 + shift))?;
        }
        Some(part)
    }

    /// Turns the row's entries, which begin at `row_start` and hold the matrix's blocks, into entries of L, and appends
    /// the pivot: `W_ij = A_ij - sum_k L_ik D_k L_jk^T`, `L_ij = W_ij D_j^-1`, `D_i = A_ii - sum_j L_ij W_ij^T`.
    /// `None` where the pivot is too small.
    fn eliminate_row(&mut self, row_start: usize, diagonal: DMat3) -> Option<()> {
        let mut pivot = diagonal;
        let row_end = self.columns.len();
        // `lower` holds W = L D for finished entries of this row until the row is done.
        for at in row_start..row_end {
            let other = self.columns[at] as usize;
            let (mut mine, mut theirs) = (row_start, self.offsets[other] as usize);
            let their_end = self.offsets[other + 1] as usize;
            let mut value = self.lower[at];
            while mine < at && theirs < their_end {
                match self.columns[mine].cmp(&self.columns[theirs]) {
                    std::cmp::Ordering::Less => mine += 1,
                    std::cmp::Ordering::Greater => theirs += 1,
                    std::cmp::Ordering::Equal => {
                        value -= self.lower[mine] * self.lower[theirs].transpose();
                        mine += 1;
                        theirs += 1;
                    }
                }
            }
            self.lower[at] = value;
        }
        for at in row_start..row_end {
            let scaled = self.lower[at];
            let factor = scaled * self.inverse_pivots[self.columns[at] as usize];
            pivot -= factor * scaled.transpose();
            self.lower[at] = factor;
        }
        // Rounding leaves the pivot a little unsymmetric, and the factor has to be symmetric.
        let pivot = 0.5 * (pivot + pivot.transpose());
        if !is_positive_definite(&(pivot - LEAST_PIVOT * diagonal)) {
            return None;
        }
        let inverse = inverse_or_identity(pivot);
        self.inverse_pivots.push(0.5 * (inverse + inverse.transpose()));
        Some(())
    }

    fn solve(&self, residual: &[DVec3], result: &mut [DVec3]) {
        let rows = self.inverse_pivots.len();
        for row in 0..rows {
            let mut value = residual[row];
            for at in self.offsets[row] as usize..self.offsets[row + 1] as usize {
                value -= self.lower[at] * result[self.columns[at] as usize];
            }
            result[row] = value;
        }
        for (value, inverse) in result.iter_mut().zip(&self.inverse_pivots) {
            *value = *inverse * *value;
        }
        for row in (0..rows).rev() {
            let value = result[row];
            for at in self.offsets[row] as usize..self.offsets[row + 1] as usize {
                result[self.columns[at] as usize] -= self.lower[at].transpose_mul_vec3(value);
            }
        }
    }
}

impl Preconditioner for IncompleteCholesky {
    fn apply(&self, residual: &[DVec3], result: &mut [DVec3]) {
        result.par_chunks_mut(PART_ROWS).zip(&self.parts).for_each(|(out, part)| {
            part.solve(&residual[part.begin..part.begin + out.len()], out);
        });
    }
}
