//! A surface triangulation becomes a mesh.

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::mesh::sizing::Sizing;
use crate::mesh::surface_mesh::SurfaceMesh;
use crate::parameters::{ParameterSet, Table};

pub use super::Output;

/// The parameters of this kind of job.
pub const PARAMETERS: Table = &[];

/// What a run reads.
#[derive(Clone, Copy)]
pub struct Input<'a> {
    /// The surface, with patches, regions and holes.
    pub surface: &'a SurfaceMesh,
    /// What the host says about element sizes, beside what the parameters say.
    pub sizing: Option<&'a Sizing>,
}

/// Meshes the regions that the surface bounds.
///
/// # Errors
/// Those of the conforming engine; [`Error::InvalidInput`] carries every finding about the surface.
pub fn run(_input: &Input, _parameters: &ParameterSet, _context: &RunContext) -> Result<Output> {
    Err(Error::Unsupported { reason: "this build has no conforming engine".into() })
}
