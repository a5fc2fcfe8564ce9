//! Least squares by Golub-Kahan bidiagonalisation, for systems that may be singular.
//!
//! # Method
//! The recurrence of [PaigeSaunders1982] on the matrix scaled from both sides by the inverse square roots of its
//! diagonal (which keeps it symmetric, so no transposed product is needed); the residual is the true one, up to the
//! scaling. It converges as conjugate gradients on the normal equations: slowly, but without breakdown.
//!
//! # Source
//! [PaigeSaunders1982].

use glam::DVec3;

use crate::context::RunContext;
use crate::error::Result;
use crate::parallel::ordered_reduce::ordered_norm;
use crate::sparse::block_csr::BlockCsr;
use crate::sparse::conjugate_gradient::{Outcome, SolveReport, StoppingRule, add_scaled, residual_of, scale_and_add};

/// Iterations between two recomputations of the true residual.
const CHECK_EVERY: usize = 16;

/// Solves `matrix * solution = right` in the least-squares sense from the given start in `solution`.
///
/// # Errors
/// [`crate::Error::Cancelled`] or [`crate::Error::LimitReached`] between iterations.
pub fn lsqr(
    matrix: &BlockCsr,
    right: &[DVec3],
    solution: &mut [DVec3],
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
        return Ok(report(Outcome::Converged, 0, 0.0));
    }
    let scale = diagonal_scale(matrix);
    let start = solution.to_vec();
    let product = |vector: &[DVec3], out: &mut Vec<DVec3>| {
        let scaled: Vec<DVec3> = vector.iter().zip(&scale).map(|(v, s)| *v * *s).collect();
        matrix.multiply(&scaled, out);
        out.iter_mut().zip(&scale).for_each(|(o, s)| *o *= *s);
    };
    // [PaigeSaunders1982] section 2: beta u = b, alpha v = A^T u.
    let mut left = residual_of(matrix, right, solution);
    left.iter_mut().zip(&scale).for_each(|(l, s)| *l *= *s);
    let mut beta = normalize(&mut left);
    let mut work = vec![DVec3::ZERO; right.len()];
    product(&left, &mut work);
    let mut right_vector = work.clone();
    let mut alpha = normalize(&mut right_vector);
    let mut direction = right_vector.clone();
    let mut update = vec![DVec3::ZERO; right.len()];
    let (mut phi_bar, mut rho_bar) = (beta, alpha);
    let mut norm = ordered_norm(&residual_of(matrix, right, solution));
    for iteration in 0..rule.max_iterations {
        context.check()?;
        if norm <= rule.relative_tolerance * right_norm {
            return Ok(report(Outcome::Converged, iteration, norm));
        }
        if alpha == 0.0 || beta == 0.0 {
            return Ok(report(Outcome::Breakdown("the least-squares solution leaves this residual"), iteration, norm));
        }
        product(&right_vector, &mut work);
        scale_and_add(&mut left, -alpha, &work);
        beta = normalize(&mut left);
        product(&left, &mut work);
        scale_and_add(&mut right_vector, -beta, &work);
        alpha = normalize(&mut right_vector);
        let rho = rho_bar.hypot(beta);
        let (cosine, sine) = (rho_bar / rho, beta / rho);
        let theta = sine * alpha;
        rho_bar = -cosine * alpha;
        let phi = cosine * phi_bar;
        phi_bar *= sine;
        add_scaled(&mut update, phi / rho, &direction);
        scale_and_add(&mut direction, -theta / rho, &right_vector);
        if (iteration + 1) % CHECK_EVERY == 0 || iteration + 1 == rule.max_iterations || alpha == 0.0 || beta == 0.0 {
            for (at, value) in solution.iter_mut().enumerate() {
                *value = start[at] + update[at] * scale[at];
            }
            norm = ordered_norm(&residual_of(matrix, right, solution));
        }
    }
    let converged = norm <= rule.relative_tolerance * right_norm;
    let outcome = if converged { Outcome::Converged } else { Outcome::IterationsExhausted };
    Ok(report(outcome, rule.max_iterations, norm))
}

fn diagonal_scale(matrix: &BlockCsr) -> Vec<DVec3> {
    let inverse_root = |value: f64| if value > 0.0 { 1.0 / value.sqrt() } else { 1.0 };
    (0..matrix.row_count())
        .map(|row| {
            let block = matrix.diagonal(row);
            DVec3::new(inverse_root(block.x_axis.x), inverse_root(block.y_axis.y), inverse_root(block.z_axis.z))
        })
        .collect()
}

/// Scales to length one; returns the length before.
fn normalize(vector: &mut [DVec3]) -> f64 {
    let norm = ordered_norm(vector);
    if norm > 0.0 {
        vector.iter_mut().for_each(|v| *v /= norm);
    }
    norm
}
