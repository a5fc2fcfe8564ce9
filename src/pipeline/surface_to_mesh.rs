//! A surface triangulation becomes a mesh.
//!
//! # Method
//! Reads the options, adds the roles, seeds and holes they give to a copy of the surface, and calls
//! `conforming::run`. [`check`] runs the input check alone and returns every finding.

use crate::conforming;
use crate::conforming::fault_picture;
use crate::conforming::input_check;
use crate::conforming::options::Options;
use crate::context::RunContext;
use crate::error::{Finding, Result, Severity};
use crate::mesh::sizing::Sizing;
use crate::mesh::surface_mesh::{PatchRole, SurfaceMesh};
use crate::parameters::{ParameterSet, Table};
use crate::statistics::Statistics;

pub use super::Output;

/// The parameters of this kind of job.
pub const PARAMETERS: Table = crate::conforming::options::PARAMETERS;

/// What a run reads.
#[derive(Clone, Copy)]
pub struct Input<'a> {
    /// The surface, with patches, regions and holes.
    pub surface: &'a SurfaceMesh,
    /// What the host says about element sizes, beside what the parameters say.
    pub sizing: Option<&'a Sizing>,
}

/// What the input check says.
#[derive(Debug, Clone, Default)]
pub struct CheckOutput {
    /// Every finding, errors first.
    pub findings: Vec<Finding>,
    /// Figures of the surface.
    pub statistics: Statistics,
    /// The findings as JSON.
    pub json: String,
    /// The faulty facets, edges and points as the text of a `.vtp` file.
    pub vtp: String,
}

impl CheckOutput {
    /// Whether the surface can be meshed.
    pub fn is_valid(&self) -> bool {
        self.findings.iter().all(|finding| finding.severity != Severity::Error)
    }
}

/// Meshes the regions that the surface bounds.
///
/// # Errors
/// [`crate::error::Error::InvalidInput`] with every finding for a surface that cannot be meshed; [`crate::error::Error::ParameterValue`];
/// [`crate::error::Error::NoResult`] naming edges and facets; [`crate::error::Error::Cancelled`]; [`crate::error::Error::LimitReached`].
pub fn run(input: &Input, parameters: &ParameterSet, context: &RunContext) -> Result<Output> {
    let options = Options::from_parameters(parameters)?;
    let surface = with_options(input.surface, &options)?;
    let (mesh, report) = conforming::run(&surface, input.sizing, &options, context)?;
    Output { mesh: Some(mesh), statistics: report.statistics(), ..Output::default() }.with_mesh_figures(context)
}

/// Checks a surface and says everything that is wrong with it; an invalid surface is no error here.
///
/// # Errors
/// [`crate::error::Error::ParameterValue`]; [`crate::error::Error::Cancelled`]; [`crate::error::Error::LimitReached`].
pub fn check(surface: &SurfaceMesh, parameters: &ParameterSet, context: &RunContext) -> Result<CheckOutput> {
    let options = Options::from_parameters(parameters)?;
    let surface = with_options(surface, &options)?;
    let checked = input_check::check(&surface, &options, context)?;
    let errors = checked.findings.iter().filter(|f| f.severity == Severity::Error).count();
    let mut statistics = Statistics::default();
    let entries = [
        ("input.points", checked.report.points as f64),
        ("input.facets", checked.report.facets as f64),
        ("input.merged_points", checked.report.merged_points as f64),
        ("input.candidate_pairs", checked.report.candidate_pairs as f64),
        ("findings", checked.findings.len() as f64),
        ("findings.errors", errors as f64),
        ("time.input_check", checked.report.seconds),
    ];
    entries.into_iter().for_each(|(name, value)| statistics.set(name, value));
    let json = fault_picture::to_json(&checked.findings);
    let vtp = fault_picture::to_vtp(&surface, &checked.findings);
    Ok(CheckOutput { findings: checked.findings, statistics, json, vtp })
}

/// The surface with the roles, holes and regions of the options beside its own.
fn with_options(surface: &SurfaceMesh, options: &Options) -> Result<SurfaceMesh> {
    let mut surface = surface.clone();
    for (patch, role) in &options.patch_roles {
        surface.patch_mut(*patch).role = PatchRole::from_name(role)?;
    }
    surface.holes.extend(options.holes.iter().copied());
    surface.regions.extend(options.regions.iter().copied());
    Ok(surface)
}
