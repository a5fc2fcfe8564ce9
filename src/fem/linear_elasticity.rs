//! Linear elasticity from mesh to displacements: assemble, constrain, solve, report.
//!
//! # Method
//! `K u = f` with prescribed displacements and point loads.
//!
//! # Source
//! [Hughes2000].
//!
//! # Limits
//! A model that can move as a whole has no unique solution: the report's outcome then is a breakdown or exhausted
//! iterations, and the displacements are finite but not an equilibrium.

use glam::DVec3;

use crate::context::RunContext;
use crate::error::Result;
use crate::fem::assembly::{ModelPattern, assemble_stiffness};
use crate::fem::constraints::{PointLoad, PrescribedDisplacement, apply_loads, prescribe};
use crate::fem::element_mesh::ElementMesh;
use crate::fem::element_stiffness::Formulation;
use crate::fem::material::MaterialMap;
use crate::sparse::conjugate_gradient::{SolveReport, StoppingRule};
use crate::sparse::solver::{SolverKind, solve};

/// A boundary value problem on a mesh.
#[derive(Debug, Clone)]
pub struct ElasticProblem {
    /// Material per label.
    pub materials: MaterialMap,
    /// Element formulation.
    pub formulation: Formulation,
    /// Given displacements.
    pub prescribed: Vec<PrescribedDisplacement>,
    /// Given forces.
    pub loads: Vec<PointLoad>,
    /// Solver.
    pub solver: SolverKind,
    /// When the solver stops.
    pub stopping: StoppingRule,
}

/// Solves the problem; one displacement per node, unit of the points.
///
/// # Errors
/// As [`assemble_stiffness`] and [`crate::sparse::solver::solve`].
pub fn solve_elasticity(
    mesh: &ElementMesh,
    problem: &ElasticProblem,
    context: &RunContext,
) -> Result<(Vec<DVec3>, SolveReport)> {
    mesh.check()?;
    let model = ModelPattern::new(mesh, context)?;
    let mut matrix = assemble_stiffness(mesh, &model, &problem.materials, problem.formulation, context)?;
    let mut right = vec![DVec3::ZERO; mesh.points.len()];
    apply_loads(&problem.loads, &mut right);
    prescribe(&problem.prescribed, &mut matrix, &mut right);
    let mut displacements = vec![DVec3::ZERO; mesh.points.len()];
    let report = solve(&matrix, &right, &mut displacements, problem.solver, &problem.stopping, context)?;
    Ok((displacements, report))
}
