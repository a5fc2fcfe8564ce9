//! Stabilised bi-conjugate gradients, the default of the thesis's registration.
//!
//! # Method
//! The right-preconditioned recurrence of [VanDerVorst1992] with the first residual as shadow residual; when the shadow
//! products vanish the method restarts from the present residual.
//!
//! # Source
//! [VanDerVorst1992].
//!
//! # Limits
//! Repeated breakdown ends the run with [`Outcome::Breakdown`].

use glam::DVec3;

use crate::context::RunContext;
use crate::error::Result;
use crate::parallel::ordered_reduce::{ordered_dot, ordered_norm};
use crate::sparse::block_csr::BlockCsr;
use crate::sparse::conjugate_gradient::{Outcome, SolveReport, StoppingRule, add_scaled, residual_of, scale_and_add};
use crate::sparse::preconditioner::Preconditioner;

/// Relative size below which a product counts as vanished.
const VANISHED: f64 = 1e-30;

/// Solves `matrix * solution = right` from the given start in `solution`.
///
/// # Errors
/// [`crate::Error::Cancelled`] or [`crate::Error::LimitReached`] between iterations.
pub fn bicgstab(
    matrix: &BlockCsr,
    right: &[DVec3],
    solution: &mut [DVec3],
    preconditioner: &dyn Preconditioner,
    rule: &StoppingRule,
    context: &RunContext,
) -> Result<SolveReport> {
    let n = right.len();
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
        return Ok(report(Outcome::Converged, 0, 0.0));
    }
    let mut residual = residual_of(matrix, right, solution);
    let mut shadow = residual.clone();
    let [mut direction, mut direction_hat, mut product, mut step_hat, mut step_product] =
        std::array::from_fn(|_| vec![DVec3::ZERO; n]);
    let (mut rho_before, mut alpha, mut omega) = (1.0, 1.0, 1.0);
    let mut norm = ordered_norm(&residual);
    let mut restarted_at = None;
    let mut fresh = true;
    for iteration in 0..rule.max_iterations {
        context.check()?;
        if norm <= rule.relative_tolerance * right_norm {
            return Ok(report(Outcome::Converged, iteration, norm));
        }
        let mut rho = ordered_dot(&shadow, &residual);
        if rho.abs() < VANISHED * norm * norm || !rho.is_finite() || omega == 0.0 {
            if restarted_at == Some(iteration) || !norm.is_finite() {
                return Ok(report(Outcome::Breakdown("the shadow residual is orthogonal"), iteration, norm));
            }
            restarted_at = Some(iteration + 1);
            residual = residual_of(matrix, right, solution);
            shadow.copy_from_slice(&residual);
            rho = ordered_dot(&shadow, &residual);
            fresh = true;
        }
        if fresh {
            direction.copy_from_slice(&residual);
            fresh = false;
        } else {
            let beta = rho / rho_before * (alpha / omega);
            add_scaled(&mut direction, -omega, &product);
            scale_and_add(&mut direction, beta, &residual);
        }
        preconditioner.apply(&direction, &mut direction_hat);
        matrix.multiply(&direction_hat, &mut product);
        let denominator = ordered_dot(&shadow, &product);
        if denominator == 0.0 || !denominator.is_finite() {
            return Ok(report(
                Outcome::Breakdown("the matrix maps the direction to the shadow's kernel"),
                iteration,
                norm,
            ));
        }
        alpha = rho / denominator;
        add_scaled(solution, alpha, &direction_hat);
        add_scaled(&mut residual, -alpha, &product);
        preconditioner.apply(&residual, &mut step_hat);
        matrix.multiply(&step_hat, &mut step_product);
        let square = ordered_dot(&step_product, &step_product);
        omega = if square > 0.0 { ordered_dot(&step_product, &residual) / square } else { 0.0 };
        add_scaled(solution, omega, &step_hat);
        add_scaled(&mut residual, -omega, &step_product);
        norm = ordered_norm(&residual);
        rho_before = rho;
    }
    let converged = norm <= rule.relative_tolerance * right_norm;
    let outcome = if converged { Outcome::Converged } else { Outcome::IterationsExhausted };
    Ok(report(outcome, rule.max_iterations, norm))
}
