//! Sparse measured displacements to node displacements: approximation, trimming of outliers, then interpolation.
//!
//! # Method
//! Unknowns u (node displacements), measurements d at points, H the shape values at these points, S a symmetric 3 x 3
//! weight per measurement, K the stiffness of the mesh.
//! 1. Locate the measurements; those outside of the mesh are left out.
//! 2. Approximation with rejection, `rejection_steps` times: `f = K u`, solve `(K + H^T S H) u' = H^T S d + f`, order the
//!    measurements by `|S (H u' - d)|` and drop the worst `F_r N / N_rej` of them; H^T S H is updated for the dropped.
//! 3. Interpolation, `interpolation_steps` times: the same solve without dropping. The forces f take over the load, so
//!    that u goes from the approximation (balanced with the mesh's energy) towards `H u = d`.
//!
//! With no rejection and no interpolation step there is one approximation: `(K + H^T S H) u = H^T S d`.
//! The pattern of K already couples all nodes of an element, so that H^T S H adds no entry.
//!
//! # Source
//! [Clatz2005] section III-C, algorithm 2; thesis 3.7.1 and 2.3.5 eq. 2.
//!
//! # Differences
//! The scale of the weights against the mesh is one number ([`FitOptions::trade_off`]) times the mean diagonal stiffness,
//! see [`WeightScale`]: the balance does not depend on Young's modulus or on the number of measurements. Ties in the
//! order of errors are broken by the measurement's number.
//!
//! # Invariants
//! Same bits for any number of threads. The displacements are finite, whatever the outcome.
//!
//! # Cost
//! One assembly and `rejection_steps + interpolation_steps` solves, each started from the last solution.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::fem::assembly::{ModelPattern, assemble_stiffness};
use crate::fem::element_mesh::ElementMesh;
use crate::fem::element_stiffness::Formulation;
use crate::fem::material::MaterialMap;
use crate::fem::point_interpolation::{PointInElement, PointLocator};
use crate::sparse::block_csr::BlockCsr;
use crate::sparse::conjugate_gradient::{Outcome, SolveReport, StoppingRule};
use crate::sparse::solver::{PreparedSolver, SolverKind};

/// Measured displacements; the arrays have the same length.
#[derive(Debug, Clone, Copy)]
pub struct Measurements<'a> {
    /// Where, in the frame of the mesh.
    pub points: &'a [DVec3],
    /// What, unit of the points.
    pub displacements: &'a [DVec3],
    /// Symmetric positive semi-definite weight per measurement: confidence times structure tensor; `DMat3::IDENTITY` for a
    /// measurement that is trusted fully in every direction.
    pub weights: &'a [DMat3],
}

/// What the weights are multiplied by.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum WeightScale {
    /// By `trade_off * (mean diagonal of K over all nodes) * (nodes / measurements)`: at 1, measurements and mesh pull about
    /// equally hard, whatever the modulus and the number of measurements [Clatz2005].
    #[default]
    Balanced,
    /// By `trade_off * (mean diagonal of K)` only: each measurement pulls with the stiffness of a node, so that more
    /// measurements pull harder.
    PerMeasurement,
    /// By `trade_off` only: the weights are stiffnesses in the unit of K.
    Absolute,
}

/// Options of a fit.
#[derive(Debug, Clone)]
pub struct FitOptions {
    /// Material per label.
    pub materials: MaterialMap,
    /// Element formulation.
    pub formulation: Formulation,
    /// How hard measurements pull against the mesh.
    pub trade_off: f64,
    /// What `trade_off` multiplies.
    pub weight_scale: WeightScale,
    /// Fraction of the measurements dropped over all rejection steps, [0, 1): F_r.
    pub rejected_fraction: f64,
    /// Steps with rejection: N_rej.
    pub rejection_steps: usize,
    /// Steps from approximation to interpolation after the rejection.
    pub interpolation_steps: usize,
    /// Measurements this far outside of the mesh (unit of the points) are taken at the nearest element; 0 leaves them out.
    pub capture_distance: f64,
    /// Solver.
    pub solver: SolverKind,
    /// When each solve stops.
    pub stopping: StoppingRule,
}

impl FitOptions {
    /// Plain approximation with these materials: no rejection, no interpolation.
    pub fn new(materials: MaterialMap) -> Self {
        Self {
            materials,
            formulation: Formulation::Standard,
            trade_off: 1.0,
            weight_scale: WeightScale::Balanced,
            rejected_fraction: 0.0,
            rejection_steps: 0,
            interpolation_steps: 0,
            capture_distance: 0.0,
            solver: SolverKind::default(),
            stopping: StoppingRule { relative_tolerance: 1e-7, max_iterations: 2000 },
        }
    }
}

/// What became of a measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MeasurementStatus {
    /// It shaped the result.
    Used,
    /// Dropped as an outlier in the rejection step of this number, from 0.
    Rejected(u32),
    /// It lies in no element, or is not finite.
    Outside,
}

/// Result of a fit.
#[derive(Debug, Clone)]
pub struct Fit {
    /// One displacement per node, unit of the points.
    pub displacements: Vec<DVec3>,
    /// One status per measurement.
    pub status: Vec<MeasurementStatus>,
    /// `|H u - d|` per measurement at the end; NaN outside.
    pub errors: Vec<f64>,
    /// One report per solve.
    pub solves: Vec<SolveReport>,
}

impl Fit {
    /// The first solve that did not converge.
    pub fn first_failure(&self) -> Option<&SolveReport> {
        self.solves.iter().find(|s| !s.is_converged())
    }
}

/// A measurement inside of an element.
struct Located {
    index: usize,
    at: PointInElement,
    weight: DMat3,
}

/// Fits node displacements to measurements.
///
/// # Errors
/// [`Error::InvalidArgument`] for arrays of different lengths, options out of range, a label without material or an
/// inverted element; [`Error::NoResult`] when no measurement lies in the mesh; [`Error::Cancelled`],
/// [`Error::LimitReached`]. A solve that does not converge is no error: see [`Fit::solves`].
pub fn displacement_fit(
    mesh: &ElementMesh,
    measurements: &Measurements,
    options: &FitOptions,
    context: &RunContext,
) -> Result<Fit> {
    check(measurements, options)?;
    let model = ModelPattern::new(mesh, context)?;
    let locator = context.install(|| PointLocator::new(*mesh))?;
    let stiffness = assemble_stiffness(mesh, &model, &options.materials, options.formulation, context)?;
    let mut fit = Fitter::new(locator, &stiffness, measurements, options, context)?;
    for step in 0..options.rejection_steps {
        fit.solve()?;
        fit.reject(step as u32);
    }
    for _ in 0..options.interpolation_steps.max(usize::from(options.rejection_steps == 0)) {
        fit.solve()?;
    }
    Ok(fit.finish())
}

fn check(measurements: &Measurements, options: &FitOptions) -> Result<()> {
    let n = measurements.points.len();
    if measurements.displacements.len() != n || measurements.weights.len() != n {
        return Err(Error::argument("measurements", "points, displacements and weights differ in number"));
    }
    if !(options.trade_off > 0.0 && options.trade_off.is_finite()) {
        return Err(Error::argument("trade_off", format!("{} is not positive", options.trade_off)));
    }
    if !(0.0..1.0).contains(&options.rejected_fraction) {
        return Err(Error::argument("rejected_fraction", format!("{} is outside [0, 1)", options.rejected_fraction)));
    }
    Ok(())
}

struct Fitter<'a> {
    locator: PointLocator<'a>,
    stiffness: &'a BlockCsr,
    measurements: &'a Measurements<'a>,
    options: &'a FitOptions,
    context: &'a RunContext,
    /// Measurements in use, in increasing order of their number.
    used: Vec<Located>,
    located: usize,
    status: Vec<MeasurementStatus>,
    displacements: Vec<DVec3>,
    solves: Vec<SolveReport>,
}

impl<'a> Fitter<'a> {
    fn new(
        locator: PointLocator<'a>,
        stiffness: &'a BlockCsr,
        measurements: &'a Measurements<'a>,
        options: &'a FitOptions,
        context: &'a RunContext,
    ) -> Result<Self> {
        let n = measurements.points.len();
        let found: Vec<Option<PointInElement>> = context.install(|| {
            (0..n)
                .into_par_iter()
                .map(|i| {
                    let usable = measurements.displacements[i].is_finite() && measurements.weights[i].is_finite();
                    usable.then(|| locator.locate_near(measurements.points[i], options.capture_distance)).flatten()
                })
                .collect()
        });
        let located = found.iter().flatten().count();
        if located == 0 {
            return Err(Error::NoResult {
                message: format!("none of {n} measured displacements lies in the mesh"),
                findings: Vec::new(),
            });
        }
        let scale = weight_scale(stiffness, options, located);
        let mut used = Vec::with_capacity(located);
        let mut status = vec![MeasurementStatus::Outside; n];
        for (index, at) in found.into_iter().enumerate() {
            if let Some(at) = at {
                status[index] = MeasurementStatus::Used;
                used.push(Located { index, at, weight: measurements.weights[index] * scale });
            }
        }
        let displacements = vec![DVec3::ZERO; stiffness.row_count()];
        Ok(Self {
            locator,
            stiffness,
            measurements,
            options,
            context,
            used,
            located,
            status,
            displacements,
            solves: Vec::new(),
        })
    }

    /// [Clatz2005] algorithm 2: (K + H^T S H) u' = H^T S d + K u.
    fn solve(&mut self) -> Result<()> {
        self.context.check()?;
        let mut matrix = self.stiffness.clone();
        let mut right = vec![DVec3::ZERO; matrix.row_count()];
        if !self.solves.is_empty() {
            self.context.install(|| self.stiffness.multiply(&self.displacements, &mut right));
        }
        // Sequential, in the order of the measurements: this is a small part of a solve, and keeps the bits.
        for entry in &self.used {
            let (nodes, values) = self.locator.weights(&entry.at);
            let pull = entry.weight * self.measurements.displacements[entry.index];
            for (i, row) in nodes.iter().enumerate() {
                right[row.index()] += pull * values[i];
                for (j, column) in nodes.iter().enumerate() {
                    matrix.add(row.index(), column.index(), entry.weight * (values[i] * values[j]));
                }
            }
        }
        hold_unused_nodes(&mut matrix);
        let before = self.displacements.clone();
        let solver = PreparedSolver::new(&matrix, self.options.solver, self.context);
        let report = solver.solve(&right, &mut self.displacements, &self.options.stopping, self.context)?;
        let is_lost = matches!(report.outcome, Outcome::Breakdown(_)) && !report.relative_residual.is_finite();
        if is_lost || self.displacements.iter().any(|d| !d.is_finite()) {
            self.displacements = before;
        }
        self.solves.push(report);
        Ok(())
    }

    /// Drops the measurements with the largest weighted errors.
    fn reject(&mut self, step: u32) {
        let steps = self.options.rejection_steps;
        let quota =
            |s: usize| (self.options.rejected_fraction * self.located as f64 * s as f64 / steps as f64) as usize;
        let count = (quota(step as usize + 1) - quota(step as usize)).min(self.used.len().saturating_sub(1));
        if count == 0 {
            return;
        }
        let mut errors: Vec<(f64, usize)> = self.context.install(|| {
            self.used
                .par_iter()
                .enumerate()
                .map(|(at, entry)| ((entry.weight * self.misfit(entry)).length(), at))
                .collect()
        });
        let order = |l: &(f64, usize), r: &(f64, usize)| r.0.total_cmp(&l.0).then(l.1.cmp(&r.1));
        errors.select_nth_unstable_by(count - 1, order);
        let mut dropped = vec![false; self.used.len()];
        for (_, at) in &errors[..count] {
            dropped[*at] = true;
            self.status[self.used[*at].index] = MeasurementStatus::Rejected(step);
        }
        let mut at = 0;
        self.used.retain(|_| {
            at += 1;
            !dropped[at - 1]
        });
    }

    fn misfit(&self, entry: &Located) -> DVec3 {
        self.locator.interpolate(&entry.at, &self.displacements) - self.measurements.displacements[entry.index]
    }

    fn finish(self) -> Fit {
        let errors = self.context.install(|| {
            (0..self.status.len())
                .into_par_iter()
                .map(|i| {
                    let at = self.locator.locate_near(self.measurements.points[i], self.options.capture_distance);
                    let reached = at.map(|at| self.locator.interpolate(&at, &self.displacements));
                    reached.map_or(f64::NAN, |r| (r - self.measurements.displacements[i]).length())
                })
                .collect()
        });
        Fit { displacements: self.displacements, status: self.status, errors, solves: self.solves }
    }
}

/// Factor on the caller's weights.
fn weight_scale(stiffness: &BlockCsr, options: &FitOptions, located: usize) -> f64 {
    let mut sum = 0.0;
    let mut count = 0usize;
    for row in 0..stiffness.row_count() {
        let block = stiffness.diagonal(row);
        let mean = (block.x_axis.x + block.y_axis.y + block.z_axis.z) / 3.0;
        if mean > 0.0 {
            sum += mean;
            count += 1;
        }
    }
    let mean = if count > 0 { sum / count as f64 } else { 1.0 };
    match options.weight_scale {
        WeightScale::Balanced => options.trade_off * mean * count.max(1) as f64 / located as f64,
        WeightScale::PerMeasurement => options.trade_off * mean,
        WeightScale::Absolute => options.trade_off,
    }
}

/// Nodes of no element would make the matrix singular: they get a unit spring to where they are.
fn hold_unused_nodes(matrix: &mut BlockCsr) {
    for row in 0..matrix.row_count() {
        if matrix.diagonal(row) == DMat3::ZERO {
            matrix.add(row, row, DMat3::IDENTITY);
        }
    }
}
