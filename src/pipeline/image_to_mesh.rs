//! A segmented image becomes a mesh.

use glam::DVec3;

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::image::label_image::LabelImage;
use crate::parameters::{ParameterSet, Table};

pub use super::Output;

/// The parameters of this kind of job.
pub const PARAMETERS: Table = &[];

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
/// Those of the lattice engine.
pub fn run(_input: &Input, _parameters: &ParameterSet, _context: &RunContext) -> Result<Output> {
    Err(Error::Unsupported { reason: "this build has no lattice engine".into() })
}
