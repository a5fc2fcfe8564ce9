//! Two scans of a patient become a displacement field.

use glam::{DMat4, DVec3};

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::image::label_image::LabelImage;
use crate::image::voxel_image::VoxelImage;
use crate::mesh::mixed_mesh::MixedMesh;
use crate::parameters::{ParameterSet, Table};

pub use super::Output;

/// The parameters of this kind of job.
pub const PARAMETERS: Table = crate::registration::options::PARAMETERS;

/// What a run reads.
#[derive(Clone, Copy)]
pub struct Input<'a> {
    /// The intraoperative scan; the field is defined on its grid.
    pub fixed: &'a VoxelImage,
    /// The preoperative scan.
    pub moving: &'a VoxelImage,
    /// Segmentation of the moving scan: 1 brain, 2 tumour, more labels allowed.
    pub segmentation: &'a LabelImage,
    /// Mask of the tissue in the fixed scan, where the host has one.
    pub fixed_mask: Option<&'a LabelImage>,
    /// A mesh of the moving segmentation to use instead of making one.
    pub mesh: Option<&'a MixedMesh>,
    /// Rigid transform from fixed to moving points, LPS mm; `None` lets the engine find it as its parameters say.
    pub rigid: Option<DMat4>,
    /// Landmark pairs for evaluation only: fixed points and their moving counterparts, LPS mm; same length.
    pub landmarks: Option<(&'a [DVec3], &'a [DVec3])>,
}

/// Finds the displacement field from fixed to moving points.
///
/// # Errors
/// Those of the registration engine.
pub fn run(_input: &Input, _parameters: &ParameterSet, _context: &RunContext) -> Result<Output> {
    Err(Error::Unsupported { reason: "this build has no registration engine".into() })
}
