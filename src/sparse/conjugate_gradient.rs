//! Preconditioned conjugate gradients; stopping and breakdown are results with data.
//!
//! # Method
//! The recurrence of [HestenesStiefel1952] with a symmetric positive definite preconditioner. Inner products are summed
//! in fixed chunks. The run stops when the residual norm falls below the tolerance times the norm of the right side.
//!
//! # Source
//! [HestenesStiefel1952]; with the diagonal of the matrix as preconditioner it is the JCG of the thesis, table 9.
//!
//! # Limits
//! An indefinite matrix or preconditioner ends the run with [`Outcome::Breakdown`] and the best vector so far.

use glam::DVec3;
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::parallel::ordered_reduce::{CHUNK, ordered_dot, ordered_norm};
use crate::sparse::block_csr::BlockCsr;
use crate::sparse::preconditioner::Preconditioner;

/// When an iteration ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StoppingRule {
    /// Residual norm over the norm of the right side.
    pub relative_tolerance: f64,
    /// Iterations at most.
    pub max_iterations: usize,
}

impl Default for StoppingRule {
    fn default() -> Self {
        Self { relative_tolerance: 1e-8, max_iterations: 2000 }
    }
}

/// How a solve ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// The tolerance is met.
    Converged,
    /// The iterations ran out.
    IterationsExhausted,
    /// The method cannot go on; the text says why.
    Breakdown(&'static str),
}

/// What a solve did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SolveReport {
    /// How it ended.
    pub outcome: Outcome,
    /// Iterations done; 0 for a direct solve.
    pub iterations: usize,
    /// Residual norm over the norm of the right side, recomputed at the end for direct solves.
    pub relative_residual: f64,
}

impl SolveReport {
    /// Whether the tolerance is met.
    pub fn is_converged(&self) -> bool {
        self.outcome == Outcome::Converged
    }
}

/// `target += factor * step`.
pub(crate) fn add_scaled(target: &mut [DVec3], factor: f64, step: &[DVec3]) {
    target.par_chunks_mut(CHUNK).zip(step.par_chunks(CHUNK)).for_each(|(target, step)| {
        target.iter_mut().zip(step).for_each(|(t, s)| *t += factor * *s);
    });
}

/// `target = addend + factor * target`.
pub(crate) fn scale_and_add(target: &mut [DVec3], factor: f64, addend: &[DVec3]) {
    target.par_chunks_mut(CHUNK).zip(addend.par_chunks(CHUNK)).for_each(|(target, addend)| {
        target.iter_mut().zip(addend).for_each(|(t, a)| *t = *a + factor * *t);
    });
}

/// `right - matrix * solution`.
pub(crate) fn residual_of(matrix: &BlockCsr, right: &[DVec3], solution: &[DVec3]) -> Vec<DVec3> {
    if solution.iter().all(|s| *s == DVec3::ZERO) {
        return right.to_vec();
    }
    let mut residual = vec![DVec3::ZERO; right.len()];
    matrix.multiply(solution, &mut residual);
    scale_and_add(&mut residual, -1.0, right);
    residual
}

/// Solves `matrix * solution = right` from the given start in `solution`.
///
/// # Errors
/// [`crate::Error::Cancelled`] or [`crate::Error::LimitReached`], twice an iteration.
pub fn conjugate_gradient(
    matrix: &BlockCsr,
    right: &[DVec3],
    solution: &mut [DVec3],
    preconditioner: &dyn Preconditioner,
    rule: &StoppingRule,
    context: &RunContext,
) -> Result<SolveReport> {
    let mut residual = residual_of(matrix, right, solution);
    conjugate_gradient_from(matrix, right, [solution, &mut residual], preconditioner, rule, context)
}

/// As [`conjugate_gradient`], where the residual of the start is known; it is that of the solution afterwards, up to rounding.
///
/// # Errors
/// As [`conjugate_gradient`].
pub fn conjugate_gradient_from(
    matrix: &BlockCsr,
    right: &[DVec3],
    [solution, residual]: [&mut [DVec3]; 2],
    preconditioner: &dyn Preconditioner,
    rule: &StoppingRule,
    context: &RunContext,
) -> Result<SolveReport> {
    let right_norm = ordered_norm(right);
    let report = |outcome, iterations, norm: f64| SolveReport {
        outcome,
        iterations,
        relative_residual: if right_norm > 0.0 { norm / right_norm } else { norm },
    };
    if !right_norm.is_finite() {
        return Ok(report(Outcome::Breakdown("the right side is not finite"), 0, f64::NAN));
    }
    if right_norm == 0.0 {
        solution.fill(DVec3::ZERO);
        residual.fill(DVec3::ZERO);
        return Ok(report(Outcome::Converged, 0, 0.0));
    }
    let mut scaled = vec![DVec3::ZERO; right.len()];
    let mut direction = vec![DVec3::ZERO; right.len()];
    let mut product = vec![DVec3::ZERO; right.len()];
    let mut norm = ordered_norm(residual);
    let mut rho_before = 0.0;
    for iteration in 0..rule.max_iterations {
        context.check()?;
        if norm <= rule.relative_tolerance * right_norm {
            return Ok(report(Outcome::Converged, iteration, norm));
        }
        preconditioner.apply(residual, &mut scaled);
        let rho = ordered_dot(residual, &scaled);
        if !(rho > 0.0 && rho.is_finite()) {
            return Ok(report(Outcome::Breakdown("the preconditioner is not positive definite"), iteration, norm));
        }
        let beta = if iteration == 0 { 0.0 } else { rho / rho_before };
        scale_and_add(&mut direction, beta, &scaled);
        context.check()?;
        matrix.multiply(&direction, &mut product);
        let curvature = ordered_dot(&direction, &product);
        if !(curvature > 0.0 && curvature.is_finite()) {
            return Ok(report(Outcome::Breakdown("the matrix is not positive definite"), iteration, norm));
        }
        let alpha = rho / curvature;
        add_scaled(solution, alpha, &direction);
        add_scaled(residual, -alpha, &product);
        norm = ordered_norm(residual);
        rho_before = rho;
    }
    let converged = norm <= rule.relative_tolerance * right_norm;
    let outcome = if converged { Outcome::Converged } else { Outcome::IterationsExhausted };
    Ok(report(outcome, rule.max_iterations, norm))
}
