//! Segmented image to mesh by adaptive body-centred cubic lattice refinement (CBC3D).
//!
//! # Method
//! 1. Clean-up of the voxels.
//! 2. Exact distance transform of all labels in one pass (`image::distance_transform`).
//! 3. Body-centred cubic tets over the labelled region ([`bcc_lattice`]).
//! 4. Red-green refinement ([`red_green`]) where the distance changes sign ([`subdivision_criteria`]) until the
//!    voxel count of every label reaches its fidelity ([`voxel_fidelity`]); the loop is [`adaptive_refinement`].
//! 5. Labels by centroid, relabelled so that surfaces can move ([`element_labels`]).
//! 6. World coordinates, surfaces, mid-edge nodes ([`finishing`]).
//!
//! # Source
//! [Drakopoulos2017] chapter 2; [Molino2003] for the lattice and its refinement.
//!
//! # Invariants
//! The mesh conforms, its elements are positive, its labels are the caller's. The same bits for any number of threads.

pub mod adaptive_refinement;
pub mod bcc_lattice;
pub mod boundary_targets;
pub mod candidate_mesh;
pub mod element_labels;
pub mod face_adjacency;
pub mod finishing;
pub mod improvement_mesh;
pub mod lattice_improvement;
pub mod local_transformations;
pub mod options;
pub mod red_green;
pub mod red_green_tables;
pub mod report;
pub mod smoothing;
pub mod subdivision_criteria;
pub mod subvoxel_surface;
pub mod surface_deformation;
pub mod untangling;
pub mod vertex_optimization;
pub mod voxel_fidelity;

use std::time::Duration;

use glam::DVec3;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::label_image::LabelImage;
use crate::image::voxel_image::VoxelImage;
use crate::mesh::mixed_mesh::MixedMesh;

pub use candidate_mesh::CandidateMesh;
pub use options::{Options, PARAMETERS, ShapeFunctions};
pub use report::Report;

/// Coarsest cubes where the caller gives no spacing, mm: the thesis's default.
const DEFAULT_SPACING: f64 = 8.0;

/// Without a given spacing the longest side of the image holds at least this many cubes.
const CUBES_ALONG_IMAGE: f64 = 8.0;

/// What the engine hands back.
#[derive(Debug, Clone, Default)]
pub struct Output {
    /// The mesh, world coordinates, caller's labels.
    pub mesh: MixedMesh,
    /// Meshes asked for beside it, by name.
    pub meshes: Vec<(String, MixedMesh)>,
    /// Images asked for, by name.
    pub images: Vec<(String, VoxelImage)>,
    /// Point sets asked for, by name.
    pub points: Vec<(String, Vec<DVec3>)>,
}

/// Meshes the labelled voxels of `image`.
///
/// # Errors
/// [`crate::Error::InvalidInput`] for an image of background only, [`crate::Error::ParameterValue`] for options that do
/// not fit the image, [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn run(image: &LabelImage, options: &Options, context: &RunContext) -> Result<(Output, Report)> {
    if let Some(seconds) = options.time_limit {
        context.set_time_limit(Some(Duration::from_secs_f64(seconds.min(1e9))));
    }
    context.install(|| mesh_image(image, options, context))
}

fn mesh_image(image: &LabelImage, options: &Options, context: &RunContext) -> Result<(Output, Report)> {
    let mut report = Report::default();
    let values = image.values().to_vec();
    let targets = subdivision_criteria::Targets::new(&values, options)?;
    let input = adaptive_refinement::RefinementInput {
        image,
        values: &values,
        targets: &targets,
        spacing: options.lattice_spacing.unwrap_or_else(|| adapted_spacing(image)),
    };
    let mut candidate = adaptive_refinement::refine(&input, options, &mut report, context)?;
    if options.smoothing_iterations > 0 {
        smoothing::smooth(&mut candidate, image, &values, options, &mut report, context)?;
    }
    context.progress("finishing", 0.95);
    let mut mesh = report.timed("finishing", || finishing::to_world(&candidate, image.grid(), &values))?;
    if options.shape_functions == ShapeFunctions::Quadratic {
        report.timed("quadratic", || finishing::make_quadratic(&mut mesh))?;
    }
    report.set("mesh.tets", candidate.tets.len() as f64);
    report.set("mesh.points", mesh.points.len() as f64);
    report.set("mesh.elements", mesh.element_count() as f64);
    Ok((Output { mesh, ..Output::default() }, report))
}

/// The thesis's spacing, smaller for small images.
fn adapted_spacing(image: &LabelImage) -> f64 {
    let grid = image.grid();
    let size = DVec3::from_array(grid.size().map(|s| s as f64)) * grid.spacing();
    DEFAULT_SPACING.min(size.max_element() / CUBES_ALONG_IMAGE)
}
