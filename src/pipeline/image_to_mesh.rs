//! A segmented image becomes a mesh.

use glam::DVec3;

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::image::label_image::LabelImage;
use crate::lattice::{self, Options};
use crate::parameters::{ParameterSet, Table, Value};

pub use super::Output;

/// The parameters of this kind of job.
pub const PARAMETERS: Table = lattice::PARAMETERS;

/// What a run reads.
#[derive(Debug, Clone, Copy)]
pub struct Input<'a> {
    /// The segmentation.
    pub labels: &'a LabelImage,
    /// Points that become vertices of the mesh, LPS mm: electrodes, landmarks. May be empty.
    pub fixed_points: &'a [DVec3],
}

/// Meshes the labelled region.
///
/// # Errors
/// Those of the lattice engine; [`Error::Io`] for an unreadable `multiple-fidelities` file.
pub fn run(input: &Input, parameters: &ParameterSet, context: &RunContext) -> Result<Output> {
    let mut options = Options::from_parameters(&with_fidelity_file(parameters)?)?;
    options.fixed_points.extend_from_slice(input.fixed_points);
    let (output, report) = lattice::run(input.labels, &options, context)?;
    Output {
        mesh: Some(output.mesh),
        meshes: output.meshes,
        images: output.images,
        points: output.points,
        statistics: report.statistics(),
        ..Output::default()
    }
    .with_mesh_figures(context)
}

/// The parameters with the contents of the `multiple-fidelities` file in place of its name.
fn with_fidelity_file(parameters: &ParameterSet) -> Result<ParameterSet> {
    let mut set = parameters.clone();
    if let Some(path) = parameters.text("multiple-fidelities") {
        let text = std::fs::read_to_string(&path).map_err(|e| Error::io(&path, e))?;
        for (label, fidelity) in lattice::options::parse_fidelities(&text)? {
            set.set_for_label("fidelity", label, Value::Real(fidelity))?;
        }
    }
    Ok(set)
}
