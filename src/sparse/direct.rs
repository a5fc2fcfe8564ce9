//! Direct sparse factorisation: Cholesky with a fill-reducing order, LU where the matrix is not positive definite.
//!
//! # Method
//! The crate `faer` orders (approximate minimum degree), factors by supernodes, and solves. It runs on one thread: the
//! order of its sums must not depend on the number of workers.
//!
//! # Cost
//! Memory and time of a 3-D factorisation: about n^(4/3) and n^2. For systems up to some ten thousand nodes.
//!
//! # Limits
//! A singular matrix gives [`Outcome::Breakdown`]. Cancellation is honoured before and after the factorisation only.

use faer::prelude::Solve;
use faer::sparse::{SparseColMat, Triplet};
use faer::{Mat, Par, Side};
use glam::DVec3;

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::parallel::ordered_reduce::ordered_norm;
use crate::sparse::block_csr::BlockCsr;
use crate::sparse::conjugate_gradient::{Outcome, SolveReport, residual_of};

/// Residual above which a factorisation counts as failed: the matrix is singular to working precision.
const SINGULAR_RESIDUAL: f64 = 1e-6;

/// Solves `matrix * solution = right`.
///
/// # Errors
/// [`Error::Cancelled`]; [`Error::OutOfMemory`] where the factor does not fit.
pub fn solve_direct(
    matrix: &BlockCsr,
    right: &[DVec3],
    solution: &mut [DVec3],
    context: &RunContext,
) -> Result<SolveReport> {
    context.check()?;
    faer::set_global_parallelism(Par::Seq);
    let n = 3 * matrix.row_count();
    let mut triplets = Vec::with_capacity(9 * matrix.blocks().len());
    for row in 0..matrix.row_count() {
        for (column, block) in matrix.pattern().row(row).iter().zip(matrix.row_blocks(row)) {
            for (c, values) in block.to_cols_array_2d().into_iter().enumerate() {
                for (r, value) in values.into_iter().enumerate() {
                    triplets.push(Triplet::new(3 * row + r, 3 * *column as usize + c, value));
                }
            }
        }
    }
    let failed =
        |reason| SolveReport { outcome: Outcome::Breakdown(reason), iterations: 0, relative_residual: f64::NAN };
    let sparse = SparseColMat::<usize, f64>::try_new_from_triplets(n, n, &triplets)
        .map_err(|_| Error::OutOfMemory { what: "the sparse matrix", bytes: 24 * triplets.len() as u64 })?;
    drop(triplets);
    let column = Mat::from_fn(n, 1, |i, _| right[i / 3][i % 3]);
    let solved = match sparse.sp_cholesky(Side::Lower) {
        Ok(factor) => factor.solve(&column),
        Err(_) => {
            context.check()?;
            match sparse.sp_lu() {
                Ok(factor) => factor.solve(&column),
                Err(_) => return Ok(failed("the matrix is singular")),
            }
        }
    };
    context.check()?;
    for (node, value) in solution.iter_mut().enumerate() {
        *value = DVec3::new(solved[(3 * node, 0)], solved[(3 * node + 1, 0)], solved[(3 * node + 2, 0)]);
    }
    let right_norm = ordered_norm(right);
    let norm = ordered_norm(&residual_of(matrix, right, solution));
    let relative_residual = if right_norm > 0.0 { norm / right_norm } else { norm };
    if !relative_residual.is_finite() || relative_residual > SINGULAR_RESIDUAL {
        solution.fill(DVec3::ZERO);
        return Ok(failed("the matrix is singular"));
    }
    Ok(SolveReport { outcome: Outcome::Converged, iterations: 0, relative_residual })
}
