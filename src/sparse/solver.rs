//! The solvers by name, and one call for all of them.
//!
//! # Method
//! [`solve`] prepares the preconditioner of the chosen [`SolverKind`] and runs it; every solver starts from the given
//! vector, stops by the same rule and reports the same way.
//!
//! Where incomplete Cholesky breaks down, block Jacobi starts again from the given vector, and a finding says so.

use glam::DVec3;

use crate::context::RunContext;
use crate::error::{Finding, FindingCode, Result, Severity};
use crate::sparse::bicgstab::bicgstab;
use crate::sparse::block_csr::BlockCsr;
use crate::sparse::conjugate_gradient::{Outcome, SolveReport, StoppingRule, conjugate_gradient};
use crate::sparse::direct::solve_direct;
use crate::sparse::lsqr::lsqr;
use crate::sparse::preconditioner::{BlockJacobi, IncompleteCholesky, PointJacobi, Preconditioner};

/// Which solver.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SolverKind {
    /// Conjugate gradients with incomplete block Cholesky: the default, fewest iterations.
    #[default]
    IncompleteCholeskyCg,
    /// Conjugate gradients with block Jacobi: least memory.
    BlockJacobiCg,
    /// Conjugate gradients with the diagonal: the thesis's JCG.
    JacobiCg,
    /// Stabilised bi-conjugate gradients with block Jacobi: the thesis's BICGSTAB.
    BiCgStab,
    /// Least squares: the thesis's LSQR.
    Lsqr,
    /// Sparse factorisation: the thesis's LU.
    Direct,
}

impl SolverKind {
    /// The solver of a name, as the parameter tables list them: `iccg`, `bjcg`, `jcg`, `bicgstab`, `lsqr`, `direct`.
    pub fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "iccg" => Self::IncompleteCholeskyCg,
            "bjcg" => Self::BlockJacobiCg,
            "jcg" => Self::JacobiCg,
            "bicgstab" => Self::BiCgStab,
            "lsqr" => Self::Lsqr,
            "direct" | "lu" => Self::Direct,
            _ => return None,
        })
    }
}

/// A solver whose preconditioner is ready: for several right sides with one matrix.
pub struct PreparedSolver<'a> {
    matrix: &'a BlockCsr,
    kind: SolverKind,
    preconditioner: Option<Box<dyn Preconditioner + 'a>>,
}

impl<'a> PreparedSolver<'a> {
    /// Builds the preconditioner.
    pub fn new(matrix: &'a BlockCsr, kind: SolverKind, context: &RunContext) -> Self {
        let preconditioner: Option<Box<dyn Preconditioner + 'a>> = context.install(|| match kind {
            SolverKind::IncompleteCholeskyCg => Some(Box::new(IncompleteCholesky::new(matrix)) as Box<_>),
            SolverKind::BlockJacobiCg | SolverKind::BiCgStab => Some(Box::new(BlockJacobi::new(matrix)) as Box<_>),
            SolverKind::JacobiCg => Some(Box::new(PointJacobi::new(matrix)) as Box<_>),
            SolverKind::Lsqr | SolverKind::Direct => None,
        });
        Self { matrix, kind, preconditioner }
    }

    /// Solves `matrix * solution = right` from the start in `solution`.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`]; [`crate::Error::OutOfMemory`] of a factorisation.
    pub fn solve(
        &self,
        right: &[DVec3],
        solution: &mut [DVec3],
        rule: &StoppingRule,
        context: &RunContext,
    ) -> Result<SolveReport> {
        if self.kind == SolverKind::IncompleteCholeskyCg {
            return self.solve_or_fall_back(right, solution, rule, context);
        }
        self.solve_once(right, solution, rule, context)
    }

    /// Block Jacobi after a breakdown of incomplete Cholesky: rounding in its factor is what it can avoid.
    fn solve_or_fall_back(
        &self,
        right: &[DVec3],
        solution: &mut [DVec3],
        rule: &StoppingRule,
        context: &RunContext,
    ) -> Result<SolveReport> {
        let start = solution.to_vec();
        let first = self.solve_once(right, solution, rule, context)?;
        let Outcome::Breakdown(reason) = first.outcome else { return Ok(first) };
        let text = format!("conjugate gradients with incomplete Cholesky: {reason}; solved again with block Jacobi");
        let finding = Finding::new(FindingCode::NotConverged, Severity::Warning, text);
        context.report(finding.with_ids(first.iterations as i64, -1));
        solution.copy_from_slice(&start);
        Self::new(self.matrix, SolverKind::BlockJacobiCg, context).solve_once(right, solution, rule, context)
    }

    fn solve_once(
        &self,
        right: &[DVec3],
        solution: &mut [DVec3],
        rule: &StoppingRule,
        context: &RunContext,
    ) -> Result<SolveReport> {
        context.install(|| match (self.kind, &self.preconditioner) {
            (SolverKind::BiCgStab, Some(p)) => bicgstab(self.matrix, right, solution, p.as_ref(), rule, context),
            (SolverKind::Lsqr, _) => lsqr(self.matrix, right, solution, rule, context),
            (_, Some(p)) => conjugate_gradient(self.matrix, right, solution, p.as_ref(), rule, context),
            (_, None) => solve_direct(self.matrix, right, solution, context),
        })
    }
}

/// Solves `matrix * solution = right` from the start in `solution`.
///
/// # Errors
/// As [`PreparedSolver::solve`].
pub fn solve(
    matrix: &BlockCsr,
    right: &[DVec3],
    solution: &mut [DVec3],
    kind: SolverKind,
    rule: &StoppingRule,
    context: &RunContext,
) -> Result<SolveReport> {
    PreparedSolver::new(matrix, kind, context).solve(right, solution, rule, context)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::VertexId;
    use crate::sparse::conjugate_gradient::{conjugate_gradient_from, residual_of};
    use crate::sparse::pattern::{Incidence, Pattern};
    use glam::DMat3;

    /// A chain of `n` nodes with springs of varying stiffness, and springs to the ground of `ground`.
    fn spring_chain(n: usize, ground: f64) -> BlockCsr {
        let offsets: Vec<i64> = (0..n as i64).map(|i| 2 * i).collect();
        let connectivity: Vec<VertexId> =
            (0..n - 1).flat_map(|i| [VertexId::from_index(i), VertexId::from_index(i + 1)]).collect();
        let incidence = Incidence::new(n, &offsets, &connectivity).unwrap();
        let context = RunContext::with_threads(1).unwrap();
        let pattern = Pattern::from_elements(&incidence, &offsets, &connectivity, &context).unwrap();
        let mut matrix = BlockCsr::zero(pattern);
        for i in 0..n - 1 {
            let s = 1.0 + (i as f64 * 0.7).sin().abs();
            let k = DMat3::from_cols_array(&[2.0 * s, 0.3, 0.1, 0.3, s, 0.2, 0.1, 0.2, 3.0 * s]);
            for (row, column, sign) in [(i, i, 1.0), (i + 1, i + 1, 1.0), (i, i + 1, -1.0), (i + 1, i, -1.0)] {
                matrix.add(row, column, k * sign);
            }
        }
        for i in 0..n {
            matrix.add(i, i, DMat3::from_diagonal(DVec3::splat(ground)));
        }
        matrix
    }

    const KINDS: [SolverKind; 6] = [
        SolverKind::IncompleteCholeskyCg,
        SolverKind::BlockJacobiCg,
        SolverKind::JacobiCg,
        SolverKind::BiCgStab,
        SolverKind::Lsqr,
        SolverKind::Direct,
    ];

    #[test]
    fn all_solvers_find_the_same_solution() {
        let matrix = spring_chain(300, 0.05);
        let exact: Vec<DVec3> = (0..300).map(|i| DVec3::new(f64::from(i).cos(), 1.0, 0.01 * f64::from(i))).collect();
        let mut right = vec![DVec3::ZERO; 300];
        matrix.multiply(&exact, &mut right);
        let context = RunContext::with_threads(2).unwrap();
        let rule = StoppingRule { relative_tolerance: 1e-11, max_iterations: 5000 };
        for kind in KINDS {
            let mut solution = vec![DVec3::ZERO; 300];
            let report = solve(&matrix, &right, &mut solution, kind, &rule, &context).unwrap();
            assert!(report.is_converged(), "{kind:?}: {report:?}");
            let error = solution.iter().zip(&exact).map(|(s, e)| (*s - *e).length()).fold(0.0, f64::max);
            assert!(error < 1e-6, "{kind:?}: {error}");
        }
    }

    #[test]
    fn a_solve_goes_on_from_its_residual_after_springs_change() {
        let mut matrix = spring_chain(300, 0.05);
        let mut right: Vec<DVec3> = (0..300).map(|i| DVec3::new(f64::from(i).cos(), 1.0, 0.3)).collect();
        let context = RunContext::with_threads(1).unwrap();
        let rule = StoppingRule { relative_tolerance: 1e-2, max_iterations: 5000 };
        let (mut solution, mut residual) = (vec![DVec3::ZERO; 300], right.clone());
        let go_on = |matrix: &BlockCsr, right: &[DVec3], residual: &mut [DVec3], solution: &mut [DVec3]| {
            let unknowns = [solution, residual];
            conjugate_gradient_from(matrix, right, unknowns, &BlockJacobi::new(matrix), &rule, &context).unwrap()
        };
        assert!(go_on(&matrix, &right, &mut residual, &mut solution).iterations > 0);
        for row in (0..300).step_by(3) {
            matrix.add(row, row, DMat3::from_diagonal(DVec3::splat(0.4)));
            right[row] += DVec3::X;
            residual[row] += DVec3::X - 0.4 * solution[row];
        }
        assert!(go_on(&matrix, &right, &mut residual, &mut solution).is_converged());
        let exact = residual_of(&matrix, &right, &solution);
        let error = exact.iter().zip(&residual).map(|(e, r)| e.distance(*r)).fold(0.0, f64::max);
        assert!(error < 1e-12, "{error}");
    }

    #[test]
    fn incomplete_cholesky_is_exact_on_a_chain() {
        // A chain has no fill, so the incomplete factor is the complete one and one iteration is enough.
        let matrix = spring_chain(200, 0.01);
        let right = vec![DVec3::ONE; 200];
        let mut solution = vec![DVec3::ZERO; 200];
        let context = RunContext::with_threads(1).unwrap();
        let rule = StoppingRule::default();
        let report = solve(&matrix, &right, &mut solution, SolverKind::IncompleteCholeskyCg, &rule, &context).unwrap();
        assert!(report.is_converged() && report.iterations <= 2, "{report:?}");
    }

    #[test]
    fn a_singular_system_is_reported_and_never_gives_nan() {
        let matrix = spring_chain(50, 0.0);
        // A force that no displacement balances: the chain floats.
        let right = vec![DVec3::X; 50];
        let context = RunContext::with_threads(1).unwrap();
        let rule = StoppingRule { relative_tolerance: 1e-10, max_iterations: 500 };
        for kind in KINDS {
            let mut solution = vec![DVec3::ZERO; 50];
            let report = solve(&matrix, &right, &mut solution, kind, &rule, &context).unwrap();
            assert!(!report.is_converged(), "{kind:?}: {report:?}");
            assert!(solution.iter().all(|s| s.is_finite()), "{kind:?}");
        }
    }

    #[test]
    fn a_matrix_that_is_not_positive_definite_falls_back_with_a_finding() {
        let matrix = spring_chain(50, -4.0);
        let context = RunContext::with_threads(1).unwrap();
        let mut solution = vec![DVec3::ZERO; 50];
        let (right, rule) = (vec![DVec3::X; 50], StoppingRule::default());
        let report = solve(&matrix, &right, &mut solution, SolverKind::default(), &rule, &context).unwrap();
        assert!(matches!(report.outcome, Outcome::Breakdown(_)), "{report:?}");
        let findings = context.take_findings();
        assert!(findings.len() == 1 && findings[0].code == FindingCode::NotConverged, "{findings:?}");
        assert!(solution.iter().all(|s| s.is_finite()));
    }

    #[test]
    fn an_exhausted_iteration_and_a_cancelled_one_say_so() {
        let matrix = spring_chain(300, 0.0001);
        let right = vec![DVec3::X; 300];
        let mut solution = vec![DVec3::ZERO; 300];
        let context = RunContext::with_threads(1).unwrap();
        let rule = StoppingRule { relative_tolerance: 1e-12, max_iterations: 3 };
        let report = solve(&matrix, &right, &mut solution, SolverKind::JacobiCg, &rule, &context).unwrap();
        assert_eq!((report.outcome, report.iterations), (Outcome::IterationsExhausted, 3));
        context.cancel_token().cancel();
        assert!(matches!(
            solve(&matrix, &right, &mut solution, SolverKind::JacobiCg, &rule, &context),
            Err(crate::Error::Cancelled)
        ));
    }
}
