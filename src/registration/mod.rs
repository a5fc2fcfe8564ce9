//! Moving and fixed scan to displacement field by physics-based non-rigid registration (PBNRR, Adaptive PBNRR).
//!
//! # Method
//! 1. [`options`]: plain values from the parameter table.
//! 2. [`foreground`]: which voxels belong to the patient; checks of the input.
//! 3. [`rigid`]: rotation and translation by mutual information.
//! 4. [`working_grid`]: one isotropic grid for both scans.
//! 5. [`adaptive_loop`]: warp, [`resection`], mesh ([`structured_mesh`] or the mesher passed in), [`feature_points`],
//!    [`block_matching`] ([`similarity`], [`block_refinement`], [`structure_tensor`]), [`missing_correspondence`], [`neighborhood_test`], [`deformation_solve`],
//!    [`displacement_field`].
//! 6. Field, inverse, warped scan and segmentation, deformed mesh; [`accuracy`].
//!
//! # Source
//! [Drakopoulos2017] chapter 3, appendix A; [Clatz2005].
//!
//! # Invariants
//! Same bits for any number of threads. The field is finite and its Jacobian determinant positive, or a finding says where not.
//!
//! # Limits
//! The fixed scan has to be skull-stripped, or to come with a mask of its tissue.

pub mod accuracy;
pub mod adaptive_loop;
pub mod block_matching;
pub mod block_refinement;
pub mod canny;
pub mod deformation_solve;
pub mod displacement_field;
pub mod feature_points;
pub mod foreground;
pub mod missing_correspondence;
pub mod neighborhood_test;
pub mod options;
mod options_table;
pub mod report;
pub mod resection;
pub mod rigid;
pub mod similarity;
pub mod structure_tensor;
pub mod structured_mesh;
pub mod working_grid;

use std::time::Instant;

use glam::{DMat4, DVec3};

use crate::context::RunContext;
use crate::error::{Error, Finding, FindingCode, Result, Severity};
use crate::image::grid::Grid;
use crate::image::label_image::LabelImage;
use crate::image::scalar_image::ScalarImage;
use crate::image::vector_image::VectorImage;
use crate::image::warp::{warp_labels, warp_scan};
use crate::index::Label;
use crate::mesh::mixed_mesh::{ArrayData, MixedMesh, NamedArray};

use accuracy::{edge_distances, landmark_errors};
use adaptive_loop::{Block, LoopResult, Mesher, Scans, adaptive_loop};
use displacement_field::{
    fade_to_rigid, invert, invert_point, jacobian_determinants, repair_folds, resample_field, rigid_field,
};
use foreground::{bright_value, foreground};
use options::{MeshMethod, MeshOptions, Options, apply};
use report::Report;
use rigid::find_rigid;
use structured_mesh::structured_hexahedra;
use working_grid::working_grid;

/// What a run reads.
#[derive(Debug, Clone, Copy)]
pub struct Input<'a> {
    /// The intraoperative scan.
    pub fixed: &'a ScalarImage,
    /// The preoperative scan.
    pub moving: &'a ScalarImage,
    /// Segmentation of the moving scan.
    pub segmentation: &'a LabelImage,
    /// Mask of the tissue in the fixed scan.
    pub fixed_mask: Option<&'a LabelImage>,
    /// Mesh of the segmentation, moving space.
    pub mesh: Option<&'a MixedMesh>,
    /// Landmarks for evaluation: fixed points, their moving counterparts.
    pub landmarks: Option<(&'a [DVec3], &'a [DVec3])>,
}

/// What a run hands back.
#[derive(Debug, Clone)]
pub struct Output {
    /// Fixed to moving, on the fixed grid.
    pub field: VectorImage,
    /// Moving to fixed, on the moving grid.
    pub inverse: VectorImage,
    /// Moving scan on the fixed grid.
    pub warped: ScalarImage,
    /// Segmentation on the fixed grid, without the resected tissue.
    pub labels: LabelImage,
    /// Mesh of the moving segmentation, moved to the fixed scan; array `displacement` per point.
    pub mesh: MixedMesh,
    /// Matched blocks of the last iteration.
    pub blocks: Vec<Block>,
    /// The rigid start, fixed to moving points.
    pub rigid: DMat4,
}

/// Registers two scans; `mesher` serves the mesh methods other than structured hexahedra.
///
/// # Errors
/// [`Error::InvalidInput`] for scans or segmentations that cannot be registered, [`Error::NoResult`] where no block is left,
/// [`Error::Unsupported`] from the mesher, [`Error::Cancelled`], [`Error::LimitReached`].
pub fn run(input: &Input, options: &Options, mesher: Mesher, context: &RunContext) -> Result<(Output, Report)> {
    let start = Instant::now();
    let mut report = Report::default();
    context.progress("rigid", 0.02);
    check_segmentation(input, options)?;
    let inside = foreground(input.fixed, input.fixed_mask, "fixed")?;
    foreground(input.moving, None, "moving")?;
    check_overlap(input, options)?;
    let rigid = rigid_start(input, &inside, options, &mut report, context)?;
    report.seconds[0] = start.elapsed().as_secs_f64();
    context.progress("registration", 0.15);
    let fixed = normalized(input.fixed)?;
    let moving = normalized(input.moving)?;
    let scans = Scans {
        fixed: &fixed,
        foreground: &inside,
        foreground_is_given: input.fixed_mask.is_some(),
        moving: &moving,
        segmentation: input.segmentation,
        mesh: input.mesh,
    };
    let grid = working_grid(input.fixed.grid(), &inside, input.moving.grid(), options.matching.working_spacing)?;
    let hexahedra = |labels: &LabelImage, mesh: &MeshOptions, _: &RunContext| {
        structured_hexahedra(labels, mesh.hexahedron_size, mesh.hexahedra)
    };
    let mesher = if options.mesh.method == MeshMethod::StructuredHexahedra { &hexahedra } else { mesher };
    let found = adaptive_loop(&scans, &grid, &rigid, options, mesher, context)?;
    report.iterations.clone_from(&found.iterations);
    report.seconds[1] = start.elapsed().as_secs_f64() - report.seconds[0];
    context.progress("output", 0.86);
    let output = outputs(input, &inside, found, rigid, options, &mut report, context)?;
    report.seconds[2] = start.elapsed().as_secs_f64() - report.seconds[0] - report.seconds[1];
    context.progress("evaluation", 0.96);
    evaluate(input, &output, options, &mut report)?;
    report.seconds[4] = start.elapsed().as_secs_f64();
    report.seconds[3] = report.seconds[4] - report.seconds[..3].iter().sum::<f64>();
    Ok((output, report))
}

/// A segmentation has labels, each with a material, and lies where the moving scan is.
fn check_segmentation(input: &Input, options: &Options) -> Result<()> {
    let labels = input.segmentation;
    let mut present = vec![false; labels.label_count()];
    labels.voxels().iter().for_each(|l| present[l.index()] = true);
    if !present.iter().skip(1).any(|p| *p) {
        return Err(Error::input("the segmentation has no label: every voxel is 0"));
    }
    for (value, _) in labels.values().iter().zip(&present).skip(1).filter(|(_, p)| **p) {
        if options.material(i64::from(*value)).is_none() {
            return Err(Error::input(format!(
                "label {value} of the segmentation has no material: give young-modulus and poisson-ratio for it"
            )));
        }
    }
    let (segmented, scan) = (world_box(labels.grid()), world_box(input.moving.grid()));
    // Another grid is fine as long as nearly all of its labelled voxels lie in the moving scan.
    let size = labels.grid().size();
    let (mut inside, mut all) = (0usize, 0usize);
    let moving = input.moving.grid();
    let last = moving.size().map(|n| n as f64 - 0.5);
    for (at, _) in labels.voxels().iter().enumerate().filter(|(_, l)| **l != Label::BACKGROUND) {
        let [i, j, k] = feature_points::voxel_of(at, size);
        let place = moving.world_to_index(labels.grid().index_to_world(DVec3::new(i as f64, j as f64, k as f64)));
        all += 1;
        inside += usize::from((0..3).all(|axis| place[axis] >= -0.5 && place[axis] <= last[axis]));
    }
    if inside * 10 < all * 9 {
        return Err(Error::input(format!(
            "the segmentation does not lie on the moving scan: {} of {all} labelled voxels are outside; segmentation {} to {}, scan {} to {} (LPS mm)",
            all - inside,
            segmented.0,
            segmented.1,
            scan.0,
            scan.1
        )));
    }
    Ok(())
}

/// Corners of the box of a grid, world mm.
fn world_box(grid: &Grid) -> (DVec3, DVec3) {
    let last = DVec3::from_array(grid.size().map(|n| n as f64 - 1.0));
    (0..8).fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), corner| {
        let pick = DVec3::new((corner & 1) as f64, (corner >> 1 & 1) as f64, (corner >> 2) as f64);
        let point = grid.index_to_world(last * pick);
        (low.min(point), high.max(point))
    })
}

/// The scans share space, after the transform from outside where there is one.
fn check_overlap(input: &Input, options: &Options) -> Result<()> {
    if options.rigid.start == options::RigidStart::MassCenters && options.rigid.initial.is_none() {
        return Ok(());
    }
    let shift = options.rigid.initial.unwrap_or(DMat4::IDENTITY);
    let fixed = input.fixed.grid();
    let moving = input.moving.grid();
    let (size, last) = (fixed.size(), moving.size().map(|n| n as f64 - 0.5));
    // A lattice of points across the fixed scan: enough to see whether anything is shared.
    const STEPS: usize = 12;
    let shared = (0..STEPS.pow(3)).any(|n| {
        let [i, j, k] = feature_points::voxel_of(n, [STEPS; 3]).map(|x| x as f64 / (STEPS - 1) as f64);
        let index = DVec3::new(i, j, k) * DVec3::from_array(size.map(|n| n as f64 - 1.0));
        let place = moving.world_to_index(apply(&shift, fixed.index_to_world(index)));
        (0..3).all(|axis| place[axis] >= -0.5 && place[axis] <= last[axis])
    });
    if shared {
        return Ok(());
    }
    let (a, b) = (world_box(fixed), world_box(moving));
    Err(Error::input(format!(
        "the scans do not overlap: fixed {} to {}, moving {} to {} (LPS mm); give initial-transform, or rigid-start mass-centers",
        a.0, a.1, b.0, b.1
    )))
}

fn rigid_start(
    input: &Input,
    inside: &[bool],
    options: &Options,
    report: &mut Report,
    context: &RunContext,
) -> Result<DMat4> {
    if !options.rigid.search {
        return Ok(options.rigid.initial.unwrap_or(DMat4::IDENTITY));
    }
    let found = find_rigid(input.fixed, inside, input.moving, &options.rigid, context)?;
    report.rigid_information = Some([found.start_information, found.mutual_information]);
    report.rigid_iterations = found.iterations;
    Ok(found.matrix)
}

/// Values from 0 (background) to about 1 (bright tissue).
fn normalized(scan: &ScalarImage) -> Result<ScalarImage> {
    let range = bright_value(scan) - scan.background();
    let scale = if range.abs() > 0.0 { 1.0 / range } else { 1.0 };
    let voxels = scan.voxels().iter().map(|v| (v - scan.background()) * scale).collect();
    ScalarImage::new(*scan.grid(), voxels, 0.0)
}

fn outputs(
    input: &Input,
    inside: &[bool],
    found: LoopResult,
    rigid: DMat4,
    options: &Options,
    report: &mut Report,
    context: &RunContext,
) -> Result<Output> {
    let LoopResult { field: mut loop_field, first_mesh, blocks, cavity, coarse_grid, .. } = found;
    let first = repair_folds(&mut loop_field, options.adaptive.min_jacobian);
    let mut field = resample_field(&loop_field, input.fixed.grid())?;
    fade_to_rigid(&mut field, inside, &rigid, options.adaptive.fade_distance);
    let second = repair_folds(&mut field, options.adaptive.min_jacobian);
    report.folded_before = first.folded_before + second.folded_before;
    report.smoothed = first.smoothed + second.smoothed;
    describe_field(&field, inside, &rigid, report, context);
    context.check()?;
    let to_fixed = rigid.inverse();
    let moving_inside = foreground(input.moving, None, "moving")?;
    let inverse = invert(&loop_field, &field, input.moving.grid(), &moving_inside, &to_fixed)?;
    context.check()?;
    let warped = warp_scan(input.moving, &field, input.fixed.grid())?;
    let mut labels = warp_labels(input.segmentation, &field, input.fixed.grid())?;
    remove_cavity(&mut labels, &cavity, &coarse_grid);
    let mesh = deformed_mesh(first_mesh, &loop_field, &rigid);
    Ok(Output { field, inverse, warped, labels, mesh, blocks, rigid })
}

/// Fills the report's figures of the field and reports what folds.
fn describe_field(field: &VectorImage, inside: &[bool], rigid: &DMat4, report: &mut Report, context: &RunContext) {
    let determinants = jacobian_determinants(field);
    let in_tissue = || determinants.iter().zip(inside).filter(|(_, i)| **i).map(|(d, _)| *d);
    report.jacobian_minimum = f64::from(in_tissue().fold(f32::INFINITY, f32::min));
    let folded = in_tissue().filter(|d| *d <= 0.0).count();
    if folded > 0 {
        let text = format!("{folded} voxels of the field fold after the repair");
        context.report(Finding::new(FindingCode::FoldedField, Severity::Warning, text).with_ids(folded as i64, -1));
    }
    let Ok(reference) = rigid_field(rigid, field.grid()) else { return };
    let (mut sum, mut count, mut most) = (0.0, 0usize, 0.0f64);
    for (at, _) in inside.iter().enumerate().filter(|(_, i)| **i) {
        let length = f64::from((field.vectors()[at] - reference.vectors()[at]).length());
        sum += length;
        count += 1;
        most = most.max(length);
    }
    report.displacement = [sum / count.max(1) as f64, most];
}

fn remove_cavity(labels: &mut LabelImage, cavity: &[bool], coarse: &Grid) {
    let grid = *labels.grid();
    let gone = crate::image::resample::map_voxels(&grid, |point, _| {
        let at = crate::image::interpolation::nearest_offset(coarse.size(), coarse.world_to_index(point));
        at.is_some_and(|at| cavity.get(at).copied().unwrap_or(false))
    });
    for (label, _) in labels.voxels_mut().iter_mut().zip(gone).filter(|(_, gone)| *gone) {
        *label = Label::BACKGROUND;
    }
}

/// The first mesh, brought back to the moving scan, then moved by the inverse field.
fn deformed_mesh(mut mesh: MixedMesh, field: &VectorImage, rigid: &DMat4) -> MixedMesh {
    let mut displacement = Vec::with_capacity(3 * mesh.points.len());
    for point in &mut mesh.points {
        let moving = apply(rigid, *point);
        let fixed = invert_point(field, moving, *point);
        displacement.extend((fixed - moving).to_array());
        *point = fixed;
    }
    mesh.point_data.retain(|array| array.name != "displacement");
    mesh.point_data.push(NamedArray {
        name: "displacement".into(),
        components: 3,
        data: ArrayData::Real(displacement),
    });
    mesh
}

fn evaluate(input: &Input, output: &Output, options: &Options, report: &mut Report) -> Result<()> {
    if let Some((fixed, moving)) = input.landmarks {
        if fixed.len() != moving.len() || fixed.is_empty() {
            let reason = format!("{} fixed points, {} moving points", fixed.len(), moving.len());
            return Err(Error::argument("landmarks", reason));
        }
        let before = landmark_errors(fixed, moving, |p| apply(&output.rigid, p));
        let after = landmark_errors(fixed, moving, |p| p + output.field.at_clamped(p));
        report.landmarks = Some([before, after]);
    }
    if options.hausdorff_evaluation {
        let rigid = rigid_field(&output.rigid, input.fixed.grid())?;
        let before = edge_distances(&warp_scan(input.moving, &rigid, input.fixed.grid())?, input.fixed);
        report.edges = Some([before, edge_distances(&output.warped, input.fixed)]);
    }
    Ok(())
}
