//! Matched blocks to a displacement of the model's nodes.
//!
//! # Method
//! 1. Materials per label; the filling of the resected region gets a fraction of the modulus of label 1.
//! 2. Weights are scaled to a mean of 1, so that trade-off and rejection do not depend on the contrast of the scans.
//! 3. Approximation steps that reject outliers, then interpolation steps ([`crate::fem::displacement_fit`]).
//! 4. Quadratic elements are made from linear ones by nodes on the edges.
//!
//! # Source
//! [Clatz2005] section III-C; [Drakopoulos2017] section 3.7.1 (FEM solver), table 9.
//!
//! # Limits
//! Quadratic shape functions for tets and hexahedra only: pyramids and wedges are refused.

use std::collections::BTreeMap;

use glam::{DMat3, DVec3};

use super::options::{MechanicsOptions, Options, ShapeFunctions};
use crate::context::RunContext;
use crate::error::{Error, Finding, FindingCode, Result, Severity};
use crate::fem::displacement_fit::{Fit, FitOptions, Measurements, displacement_fit};
use crate::fem::element_mesh::ElementMesh;
use crate::fem::element_stiffness::Formulation;
use crate::fem::material::{Material, MaterialMap};
use crate::index::VertexId;
use crate::mesh::mixed_mesh::{ElementKind, MixedMesh};
use crate::mesh::numbering::QUADRATIC_TET_EDGES;
use crate::sparse::conjugate_gradient::StoppingRule;

/// Poisson ratio of the filling of the resected region: it takes up volume freely.
const RESECTED_POISSON_RATIO: f64 = 0.1;

/// Measurements this far outside of the mesh count at its nearest element, mm: half an element.
const CAPTURE_DISTANCE: f64 = 3.0;

/// Edges of the 20-node hexahedron in VTK's order: node `8 + i` lies on edge `i`.
const HEXAHEDRON_EDGES: [[usize; 2]; 12] =
    [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]];

/// Measured displacements, world mm.
#[derive(Debug, Clone, Default)]
pub struct BlockMeasurements {
    /// Where.
    pub points: Vec<DVec3>,
    /// What.
    pub displacements: Vec<DVec3>,
    /// Confidence, symmetric.
    pub weights: Vec<DMat3>,
}

/// Materials of a model with the caller's labels; `resected` is the label of the filling.
///
/// # Errors
/// [`Error::InvalidInput`] for a label without material.
pub fn materials(options: &Options, labels: &[i32], resected: i32, heterogeneous: bool) -> Result<MaterialMap> {
    let brain = options.material(1).ok_or_else(|| Error::Internal { reason: "label 1 has no material".into() })?;
    let mut entries = Vec::new();
    for &label in labels {
        let entry = if label == resected {
            let softness = options.adaptive.resected_stiffness.max(1e-6);
            Material::new(brain.young_modulus * softness, RESECTED_POISSON_RATIO)?
        } else {
            let own = options.material(i64::from(label)).ok_or_else(|| {
                Error::input(format!("label {label} has no material: give young-modulus and poisson-ratio for it"))
            })?;
            let used = if heterogeneous { own } else { brain };
            Material::new(used.young_modulus, used.poisson_ratio)?
        };
        entries.push((label, entry));
    }
    Ok(MaterialMap::new(None, entries))
}

/// Fits the displacements of the nodes of `mesh` to the measurements.
///
/// # Errors
/// [`Error::NoResult`] where no measurement lies in the mesh or all are rejected; those of the fit.
pub fn solve_deformation(
    mesh: &MixedMesh,
    measurements: &BlockMeasurements,
    materials: MaterialMap,
    stiffness_of_data: f64,
    mechanics: &MechanicsOptions,
    context: &RunContext,
) -> Result<Fit> {
    let weights = normalized(&measurements.weights);
    let options = FitOptions {
        formulation: match mechanics.shape_functions {
            ShapeFunctions::Linear | ShapeFunctions::Quadratic => Formulation::Standard,
            ShapeFunctions::LinearExtra | ShapeFunctions::QuadraticExtra => Formulation::ExtraShapeFunctions,
        },
        trade_off: mechanics.trade_off * stiffness_of_data,
        rejected_fraction: mechanics.rejection_fraction.min(0.999),
        rejection_steps: mechanics.approximation_steps,
        interpolation_steps: mechanics.interpolation_steps,
        capture_distance: CAPTURE_DISTANCE,
        solver: mechanics.solver,
        stopping: StoppingRule { relative_tolerance: mechanics.tolerance, max_iterations: mechanics.max_iterations },
        ..FitOptions::new(materials)
    };
    let data =
        Measurements { points: &measurements.points, displacements: &measurements.displacements, weights: &weights };
    let fit = displacement_fit(&ElementMesh::from_mixed(mesh), &data, &options, context)?;
    if mechanics.rejection_fraction >= 1.0 || fit.displacements.iter().any(|d| !d.is_finite()) {
        return Err(Error::NoResult {
            message: "no block is left after the rejection of outliers: lower rejection-fraction".into(),
            findings: Vec::new(),
        });
    }
    if let Some(failure) = fit.first_failure() {
        let text = format!(
            "the solver stopped after {} iterations at a residual of {:.1e}: {:?}",
            failure.iterations, failure.relative_residual, failure.outcome
        );
        let finding = Finding::new(FindingCode::NotConverged, Severity::Warning, text);
        context.report(finding.with_ids(failure.iterations as i64, -1));
    }
    Ok(fit)
}

/// Weights with a mean trace of 3.
fn normalized(weights: &[DMat3]) -> Vec<DMat3> {
    let trace = |m: &DMat3| m.x_axis.x + m.y_axis.y + m.z_axis.z;
    let mean = weights.iter().map(trace).sum::<f64>() / (3.0 * weights.len().max(1) as f64);
    let scale = if mean > 0.0 { 1.0 / mean } else { 1.0 };
    weights.iter().map(|w| *w * scale).collect()
}

/// The mesh with the nodes that the shape functions need.
///
/// # Errors
/// [`Error::Unsupported`] for quadratic pyramids and wedges.
pub fn with_shape_functions(mesh: MixedMesh, shape_functions: ShapeFunctions) -> Result<MixedMesh> {
    match shape_functions {
        ShapeFunctions::Linear | ShapeFunctions::LinearExtra => Ok(mesh),
        ShapeFunctions::Quadratic | ShapeFunctions::QuadraticExtra => quadratic(&mesh),
    }
}

fn quadratic(mesh: &MixedMesh) -> Result<MixedMesh> {
    let mut result = MixedMesh { offsets: vec![0], labels: mesh.labels.clone(), ..MixedMesh::default() };
    result.points.clone_from(&mesh.points);
    let mut middles: BTreeMap<(VertexId, VertexId), VertexId> = BTreeMap::new();
    for element in 0..mesh.element_count() {
        let (kind, nodes) = mesh.element(element);
        let (quadratic, edges): (_, &[[usize; 2]]) = match kind {
            ElementKind::Tet => (ElementKind::QuadraticTet, &QUADRATIC_TET_EDGES),
            ElementKind::Hexahedron => (ElementKind::QuadraticHexahedron, &HEXAHEDRON_EDGES),
            ElementKind::QuadraticTet | ElementKind::QuadraticHexahedron => (kind, &[]),
            ElementKind::Pyramid | ElementKind::Wedge => {
                let reason = format!("quadratic shape functions for {kind:?}; use tets or hexahedra");
                return Err(Error::Unsupported { reason });
            }
        };
        result.connectivity.extend_from_slice(nodes);
        for [a, b] in edges {
            let (a, b) = (nodes[*a], nodes[*b]);
            let middle = match middles.get(&(a.min(b), a.max(b))) {
                Some(id) => *id,
                None => {
                    let id = VertexId::try_new(result.points.len())?;
                    result.points.push(0.5 * (mesh.points[a.index()] + mesh.points[b.index()]));
                    middles.insert((a.min(b), a.max(b)), id);
                    id
                }
            };
            result.connectivity.push(middle);
        }
        result.types.push(quadratic.vtk_type());
        result.offsets.push(result.connectivity.len() as i64);
    }
    result.check_shape()?;
    Ok(result)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sparse::solver::SolverKind;

    fn cube() -> MixedMesh {
        let points: Vec<DVec3> =
            (0..27).map(|n| DVec3::new((n % 3) as f64, (n / 3 % 3) as f64, (n / 9) as f64) * 5.0).collect();
        let mut mesh = MixedMesh { points, offsets: vec![0], ..MixedMesh::default() };
        for cell in 0..8 {
            let base = cell % 2 + 3 * (cell / 2 % 2) + 9 * (cell / 4);
            mesh.connectivity.extend([0, 1, 4, 3, 9, 10, 13, 12].map(|n| VertexId(base + n)));
            mesh.offsets.push(mesh.connectivity.len() as i64);
            mesh.types.push(12);
            mesh.labels.push(1);
        }
        mesh
    }

    fn linear(p: DVec3) -> DVec3 {
        DVec3::new(0.1 * p.x + 0.02 * p.y, -0.05 * p.y, 0.5 + 0.03 * p.z)
    }

    #[test]
    fn every_solver_and_shape_function_recovers_a_linear_field_despite_outliers() {
        let context = RunContext::with_threads(1).unwrap();
        let mut measurements = BlockMeasurements::default();
        for n in 0..500 {
            let p = DVec3::new((n % 10) as f64, (n / 10 % 10) as f64, (n / 100) as f64 * 2.0) + 0.5;
            measurements.points.push(p);
            measurements.displacements.push(if n % 23 == 0 { DVec3::splat(6.0) } else { linear(p) });
            measurements.weights.push(DMat3::IDENTITY * 0.3);
        }
        let defaults = Options::default();
        for (solver, shapes) in [
            (SolverKind::JacobiCg, ShapeFunctions::Linear),
            (SolverKind::BiCgStab, ShapeFunctions::LinearExtra),
            (SolverKind::Direct, ShapeFunctions::Quadratic),
            (SolverKind::IncompleteCholeskyCg, ShapeFunctions::QuadraticExtra),
        ] {
            let mechanics = MechanicsOptions { solver, shape_functions: shapes, ..defaults.mechanics.clone() };
            let mesh = with_shape_functions(cube(), shapes).unwrap();
            let materials = materials(&defaults, &[1], 9, true).unwrap();
            let fit = context
                .install(|| solve_deformation(&mesh, &measurements, materials, 100.0, &mechanics, &context))
                .unwrap();
            // Nodes around which there is data; at the rim of the cube the fit extrapolates.
            let is_measured = |p: &DVec3| p.min_element() >= 2.0 && p.max_element() <= 8.0;
            for (point, found) in mesh.points.iter().zip(&fit.displacements).filter(|(p, _)| is_measured(p)) {
                assert!((*found - linear(*point)).length() < 0.3, "{solver:?} {shapes:?} {point} {found}");
            }
        }
    }

    #[test]
    fn a_label_without_material_is_named() {
        let error = materials(&Options::default(), &[1, 2, 3], 9, true).unwrap_err();
        assert!(error.to_string().contains("label 3"));
    }
}
