//! Sparse measured displacements to node displacements: approximation, trimming of outliers, then interpolation.
//!
//! # Method
//! Unknowns u (node displacements), measurements d at points, H the shape values at these points, S a symmetric 3 x 3
//! weight per measurement, K the stiffness of the mesh.
//! 1. Locate the measurements; those outside of the mesh are left out.
//! 2. Approximation with rejection, `rejection_steps` times: solve `(K + H^T S H) u = H^T S d`, order the measurements by
//!    `|S (H u - d)|` and drop the worst `F_r N / N_rej` of them; H^T S H is updated for the dropped. Then one more
//!    approximation with what is left.
//! 3. Interpolation, `interpolation_steps` times: `f = K u`, solve `(K + H^T S H) u' = H^T S d + f`. The forces f take over
//!    the load, so that u goes from the approximation (balanced with the mesh's energy) towards `H u = d`.
//!
//! With no rejection and no interpolation step there is one approximation.
//! The pattern of K already couples all nodes of an element, so that H^T S H adds no entry.
//!
//! # Source
//! [Clatz2005] section III-C, algorithm 2; thesis 3.7.1 and 2.3.5 eq. 2.
//!
//! # Differences
//! The scale of the weights against the mesh is one number ([`FitOptions::trade_off`]) times the mean diagonal stiffness,
//! see [`WeightScale`]: the balance does not depend on Young's modulus or on the number of measurements. The
//! source adds `f = K u` in the rejection steps too; there f keeps the pull of measurements that are dropped later (the
//! outlier test below then ends 1.2 off), so we start f after the last rejection. Ties in the
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

/// Share of its stiffness that holds a node where nothing else does: a translation measured at one point of 10^5 nodes is
/// kept to a hundredth, and a direct factorisation has eight digits left.
const HOLDING_SPRING: f64 = 1e-8;

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
        fit.solve(Step::Approximation)?;
        fit.reject(step as u32);
    }
    fit.solve(Step::Approximation)?;
    for _ in 0..options.interpolation_steps {
        fit.solve(Step::Interpolation)?;
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

/// Whether the forces that hold the present displacements are added to the right side.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Step {
    Approximation,
    Interpolation,
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
    fn solve(&mut self, step: Step) -> Result<()> {
        self.context.check()?;
        let mut matrix = self.stiffness.clone();
        let mut right = vec![DVec3::ZERO; matrix.row_count()];
        if step == Step::Interpolation {
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
        hold_free_nodes(&mut matrix);
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

/// What no measurement holds would make the matrix singular: a piece of the mesh without any, or nodes of no element. Every
/// node gets a spring to where it is, too weak to show beside a measurement.
fn hold_free_nodes(matrix: &mut BlockCsr) {
    for row in 0..matrix.row_count() {
        let diagonal = matrix.diagonal(row);
        let spring = if diagonal == DMat3::ZERO { DMat3::IDENTITY } else { diagonal * HOLDING_SPRING };
        matrix.add(row, row, spring);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fem::element_mesh::TetTopology;
    use crate::fem::material::Material;
    use crate::index::VertexId;

    /// `n^3` cubes of six tets each.
    fn box_of_tets(n: usize) -> (Vec<DVec3>, Vec<[VertexId; 4]>) {
        let at = |i: usize, j: usize, k: usize| VertexId::from_index(i + (n + 1) * (j + (n + 1) * k));
        let mut points = Vec::new();
        for k in 0..=n {
            for j in 0..=n {
                points.extend((0..=n).map(|i| DVec3::new(i as f64, j as f64, k as f64)));
            }
        }
        let mut tets = Vec::new();
        for k in 0..n {
            for j in 0..n {
                for i in 0..n {
                    let c = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
                        .map(|o: [usize; 3]| at(i + o[0], j + o[1], k + o[2]));
                    tets.extend(
                        [[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]]
                            .map(|t| t.map(|v| c[v])),
                    );
                }
            }
        }
        (points, tets)
    }

    fn options() -> FitOptions {
        FitOptions::new(MaterialMap::uniform(Material::new(0.0021, 0.45).unwrap()))
    }

    /// Measured points in a fixed irregular pattern.
    fn probes(count: usize, edge: f64) -> Vec<DVec3> {
        let golden = [0.819_172_513_4, 0.671_043_606_7, 0.549_700_477_9];
        (1..=count).map(|i| DVec3::from_array(golden.map(|g| (g * i as f64).fract() * edge))).collect()
    }

    #[test]
    fn a_linear_deformation_is_recovered_through_gross_outliers() {
        let (points, tets) = box_of_tets(4);
        let (labels, topology) = (vec![1; tets.len()], TetTopology::new(tets.len()));
        let field = |p: DVec3| DVec3::new(0.05 * p.y, 0.02 * p.x, -0.03 * p.z);
        let at = probes(400, 4.0);
        let displacements: Vec<DVec3> = at
            .iter()
            .enumerate()
            .map(|(i, p)| field(*p) + if i % 10 == 0 { DVec3::splat(2.0) } else { DVec3::ZERO })
            .collect();
        let weights = vec![DMat3::IDENTITY; at.len()];
        let mut options = options();
        options.trade_off = 20.0;
        (options.rejected_fraction, options.rejection_steps, options.interpolation_steps) = (0.2, 5, 10);
        let measurements = Measurements { points: &at, displacements: &displacements, weights: &weights };
        let runs: Vec<Fit> = [1, 3]
            .into_iter()
            .map(|threads| {
                let context = RunContext::with_threads(threads).unwrap();
                displacement_fit(&topology.view(&points, &tets, &labels), &measurements, &options, &context).unwrap()
            })
            .collect();
        assert_eq!(runs[0].displacements, runs[1].displacements);
        assert_eq!(runs[0].status, runs[1].status);
        let fit = &runs[0];
        assert!(fit.first_failure().is_none());
        assert!((0..400).step_by(10).all(|i| matches!(fit.status[i], MeasurementStatus::Rejected(_))));
        assert_eq!(fit.status.iter().filter(|s| matches!(s, MeasurementStatus::Rejected(_))).count(), 80);
        let error = fit.displacements.iter().zip(&points).map(|(u, p)| (*u - field(*p)).length()).fold(0.0, f64::max);
        // Corners without a measurement relax to zero stress; where there are measurements they are met.
        assert!(error < 0.06, "{error}");
        let used = (0..at.len()).filter(|i| fit.status[*i] == MeasurementStatus::Used).map(|i| fit.errors[i]);
        let worst = used.fold(0.0, f64::max);
        assert!(worst < 0.005, "{worst}");
    }

    #[test]
    fn a_measurement_that_knows_one_direction_only_leaves_the_others_alone() {
        let (points, tets) = box_of_tets(2);
        let (labels, topology) = (vec![1; tets.len()], TetTopology::new(tets.len()));
        let at = probes(60, 2.0);
        let displacements = vec![DVec3::new(0.3, 0.7, -0.2); at.len()];
        // Half of the blocks constrain x only, the others y and z weakly.
        let weights: Vec<DMat3> = (0..at.len())
            .map(|i| DMat3::from_diagonal(if i % 2 == 0 { DVec3::X } else { DVec3::new(0.0, 0.5, 0.5) }))
            .collect();
        let context = RunContext::with_threads(2).unwrap();
        let measurements = Measurements { points: &at, displacements: &displacements, weights: &weights };
        let view = topology.view(&points, &tets, &labels);
        let fit = displacement_fit(&view, &measurements, &options(), &context).unwrap();
        // A common translation costs the mesh nothing, so the approximation meets it exactly.
        assert!(fit.displacements.iter().all(|u| (*u - DVec3::new(0.3, 0.7, -0.2)).length() < 1e-4));
        assert!(fit.errors.iter().all(|e| *e < 1e-4));
    }

    #[test]
    fn a_piece_without_measurements_stays_where_it_is_with_every_solver() {
        let (mut points, mut tets) = box_of_tets(2);
        let (count, shift) = (points.len() as u32, DVec3::X * 10.0);
        points.extend(points.clone().iter().map(|p| *p + shift));
        tets.extend(tets.clone().iter().map(|t| t.map(|v| VertexId(v.0 + count))));
        let (labels, topology) = (vec![1; tets.len()], TetTopology::new(tets.len()));
        let at = probes(60, 2.0);
        let displacements = vec![DVec3::new(0.3, 0.7, -0.2); at.len()];
        let weights = vec![DMat3::IDENTITY; at.len()];
        let measurements = Measurements { points: &at, displacements: &displacements, weights: &weights };
        for solver in [
            SolverKind::IncompleteCholeskyCg,
            SolverKind::BlockJacobiCg,
            SolverKind::JacobiCg,
            SolverKind::BiCgStab,
            SolverKind::Lsqr,
            SolverKind::Direct,
        ] {
            let context = RunContext::with_threads(1).unwrap();
            let options = FitOptions { solver, ..options() };
            let view = topology.view(&points, &tets, &labels);
            let fit = displacement_fit(&view, &measurements, &options, &context).unwrap();
            assert!(fit.first_failure().is_none(), "{solver:?} {:?}", fit.first_failure());
            let (held, free) = fit.displacements.split_at(count as usize);
            assert!(held.iter().all(|u| (*u - displacements[0]).length() < 1e-4), "{solver:?}");
            assert!(free.iter().all(|u| u.length() < 1e-9), "{solver:?}");
        }
    }

    #[test]
    fn measurements_outside_are_left_out_and_none_inside_is_an_error() {
        let (points, tets) = box_of_tets(1);
        let (labels, topology) = (vec![1; tets.len()], TetTopology::new(tets.len()));
        let view = topology.view(&points, &tets, &labels);
        let context = RunContext::with_threads(1).unwrap();
        let at = [DVec3::splat(0.4), DVec3::splat(9.0), DVec3::NAN];
        let measurements = Measurements { points: &at, displacements: &[DVec3::X; 3], weights: &[DMat3::IDENTITY; 3] };
        let fit = displacement_fit(&view, &measurements, &options(), &context).unwrap();
        assert_eq!(fit.status, [MeasurementStatus::Used, MeasurementStatus::Outside, MeasurementStatus::Outside]);
        assert!(fit.displacements.iter().all(|u| u.is_finite()));
        let outside = Measurements { points: &at[1..2], displacements: &[DVec3::X], weights: &[DMat3::IDENTITY] };
        assert!(matches!(displacement_fit(&view, &outside, &options(), &context), Err(Error::NoResult { .. })));
    }
}
