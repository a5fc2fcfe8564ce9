//! Two scans of a patient become a displacement field.
//!
//! # Method
//! The scans become single-precision images, the mesh methods of the parameters become functions that the engine calls
//! (`model_meshes`); structured hexahedra are the engine's own.

use glam::{DMat4, DVec3};

use crate::context::RunContext;
use crate::error::{Error, Finding, FindingCode, Result, Severity};
use crate::image::label_image::LabelImage;
use crate::image::scalar_image::ScalarImage;
use crate::image::voxel_image::{VoxelData, VoxelImage};
use crate::mesh::mixed_mesh::{ArrayData, MixedMesh, NamedArray};
use crate::parameters::{ParameterSet, Table};
use crate::registration::options::{Options, check_rigid};
use crate::registration::{self as engine, adaptive_loop::Block};

pub use super::Output;
use super::model_meshes::mesh_of_labels;

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
/// The output has the images `displacement` (fixed grid), `inverse` (moving grid), `warped`, `labels`; the deformed mesh; the points
/// `source_points` (moving scan) and `target_points` (fixed scan) of the matched blocks with the arrays `similarity` and
/// `rejected`; the array `rigid`.
///
/// # Errors
/// Those of the registration engine and of the mesher; [`Error::InvalidArgument`] for a transform that is not rigid.
pub fn run(input: &Input, parameters: &ParameterSet, context: &RunContext) -> Result<Output> {
    let mut options = Options::from_parameters(parameters)?;
    if let Some(rigid) = input.rigid {
        check_rigid(&rigid).map_err(|reason| Error::argument("rigid", reason))?;
        options.rigid.initial = Some(rigid);
        options.rigid.search &= parameters.is_set("rigid-initialization");
    }
    let fixed = scan(input.fixed, "fixed", context)?;
    let moving = scan(input.moving, "moving", context)?;
    let engine_input = engine::Input {
        fixed: &fixed,
        moving: &moving,
        segmentation: input.segmentation,
        fixed_mask: input.fixed_mask,
        mesh: input.mesh,
        landmarks: input.landmarks,
    };
    let (output, report) = context.install(|| engine::run(&engine_input, &options, &mesh_of_labels, context))?;
    let rigid = output.rigid.transpose().to_cols_array().to_vec();
    let mut result = Output {
        mesh: Some(output.mesh),
        images: vec![
            ("displacement".into(), output.field.to_voxel_image()),
            ("inverse".into(), output.inverse.to_voxel_image()),
            ("warped".into(), output.warped.into_voxel_image()),
            ("labels".into(), label_voxels(&output.labels)),
        ],
        statistics: report.statistics(),
        ..Output::default()
    };
    add_blocks(&output.blocks, &mut result);
    result.arrays.push(NamedArray { name: "rigid".into(), components: 16, data: ArrayData::Real(rigid) });
    Ok(result)
}

fn scan(image: &VoxelImage, name: &str, context: &RunContext) -> Result<ScalarImage> {
    let (scan, replaced) = ScalarImage::from_voxel_image(image)?;
    if replaced > 0 {
        let text = format!("{replaced} voxels of the {name} scan are not finite and count as outside");
        context.report(Finding::new(FindingCode::Other, Severity::Warning, text).with_ids(replaced as i64, -1));
    }
    Ok(scan)
}

/// Labels with the caller's values.
fn label_voxels(labels: &LabelImage) -> VoxelImage {
    let values = labels.values();
    let voxels = labels.voxels();
    let largest = values.iter().copied().max().unwrap_or(0);
    let data = if let Ok(table) = values.iter().map(|v| u8::try_from(*v)).collect::<std::result::Result<Vec<_>, _>>() {
        VoxelData::U8(voxels.iter().map(|l| table[l.index()]).collect())
    } else {
        debug_assert!(largest > 255);
        VoxelData::I32(voxels.iter().map(|l| values[l.index()]).collect())
    };
    VoxelImage { grid: *labels.grid(), components: 1, data }
}

fn add_blocks(blocks: &[Block], result: &mut Output) {
    result.points.push(("source_points".into(), blocks.iter().map(|b| b.moving).collect()));
    result.points.push(("target_points".into(), blocks.iter().map(|b| b.fixed).collect()));
    let similarity = ArrayData::Real(blocks.iter().map(|b| b.similarity).collect());
    let rejected = ArrayData::Int(blocks.iter().map(|b| i32::from(b.is_rejected)).collect());
    result.arrays.push(NamedArray { name: "similarity".into(), components: 1, data: similarity });
    result.arrays.push(NamedArray { name: "rejected".into(), components: 1, data: rejected });
}
