//! The adaptive loop: warp, correct, mesh, match, fit, until nothing changes.
//!
//! # Method
//! Each iteration, on a grid that is coarse in the first ones and fine in the later ones:
//! 1. The moving scan (linear) and its segmentation (nearest) are warped by the field so far.
//! 2. The cavity is found and taken out of the segmentation ([`super::resection`]).
//! 3. The corrected segmentation is meshed.
//! 4. Blocks of the fixed scan, denser around the cavity, are searched in the warped one, and blocks of the warped one in the fixed
//!    one, but not tumour and not around the cavity; blocks of the moving scan without correspondence are paired with the brain surface.
//! 5. Matches that contradict their neighbours are dropped ([`super::neighborhood_test`]).
//! 6. The mechanics turn the others into the field since the rigid start ([`super::deformation_solve`]).
//!
//! The loop ends after the given number of iterations, or on the fine grid when the update and the number of blocks without
//! correspondence are small.
//!
//! # Source
//! [Drakopoulos2017] section 3.7.2, figure 35.
//!
//! # Differences
//! The coarse first iterations, the search in both directions, the denser blocks around the cavity and the test against neighbours are
//! ours. The thesis fits an update per iteration and adds the updates: so do the errors of their matches (measured on simulated
//! operations: 0.65 mm far from the cavity, 0.35 mm with one fit of the whole). Tissue left in the fixed scan always has a counterpart in the
//! moving scan, so that blocks of the fixed scan are not misled by a resection.
//!
//! # Invariants
//! Same bits for any number of threads.

use std::time::Instant;

use glam::{DMat3, DMat4, DVec3};
use rayon::prelude::*;

use super::block_matching::{BlockMatch, MatchImage, MatchOutcome, MatchSettings, match_blocks};
use super::deformation_solve::{BlockMeasurements, materials, solve_deformation, with_shape_functions};
use super::displacement_field::{before_rigid, field_of_mesh, repair_folds, rigid_field};
use super::feature_points::select_features;
use super::missing_correspondence::pair_with_surface;
use super::neighborhood_test::agreeing;
use super::options::{FeatureOptions, MatchingDirection, MeshOptions, Options, Resection, apply};
use super::report::IterationReport;
use super::resection::{CAVITY_REACH, Scene, fill_hole, find_cavity, grow, resected_model};
use super::working_grid::coarser;
use crate::context::RunContext;
use crate::error::{Error, Finding, FindingCode, Result, Severity};
use crate::fem::displacement_fit::MeasurementStatus;
use crate::image::gaussian::smooth;
use crate::image::grid::Grid;
use crate::image::interpolation::nearest_offset;
use crate::image::label_image::LabelImage;
use crate::image::resample::{map_voxels, resample_linear};
use crate::image::scalar_image::ScalarImage;
use crate::image::vector_image::VectorImage;
use crate::image::warp::{warp_labels, warp_scan};
use crate::mesh::mixed_mesh::MixedMesh;

/// Makes the mesh of a label image.
pub type Mesher<'a> = &'a (dyn Fn(&LabelImage, &MeshOptions, &RunContext) -> Result<MixedMesh> + Sync);

/// Voxels of the coarse grid are this much larger than those of the fine one.
const COARSE: f64 = 2.0;

/// Share of the iterations on the coarse grid.
const COARSE_SHARE: f64 = 0.34;

/// How hard matched blocks pull against the mesh at a trade-off of 1: chosen on simulated operations.
const DATA_STIFFNESS: f64 = 8.0;

/// Matches are compared with their neighbours up to this distance, voxels.
const REACH: f64 = 9.0;

/// Uncertainty of a single match, voxels.
const UNCERTAINTY: f64 = 0.3;

/// Rim of the cavity that blocks leave out, mm: half of a thick slice.
const CAVITY_RIM: f64 = 1.25;

/// This far around the cavity blocks are selected more densely, mm.
const DENSE_REACH: f64 = 18.0;

/// How much more densely.
const DENSER: f64 = 4.0;

/// Folding limit while the loop runs; the returned field is held to the caller's limit.
const LOOP_JACOBIAN: f64 = 0.05;

/// Both scans, values from 0 (background) to about 1.
#[derive(Debug, Clone, Copy)]
pub struct Scans<'a> {
    /// Fixed scan.
    pub fixed: &'a ScalarImage,
    /// Its foreground.
    pub foreground: &'a [bool],
    /// Whether the foreground is the caller's mask.
    pub foreground_is_given: bool,
    /// Moving scan.
    pub moving: &'a ScalarImage,
    /// Its segmentation.
    pub segmentation: &'a LabelImage,
    /// Mesh of the segmentation, moving space, for the first iteration.
    pub mesh: Option<&'a MixedMesh>,
}

/// A matched block of the last iteration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Block {
    /// Its place in the moving scan, LPS mm.
    pub moving: DVec3,
    /// Its place in the fixed scan, LPS mm.
    pub fixed: DVec3,
    /// Similarity.
    pub similarity: f64,
    /// Whether it was rejected as an outlier or lies outside of the mesh.
    pub is_rejected: bool,
}

/// What the loop found.
#[derive(Debug, Clone)]
pub struct LoopResult {
    /// Fixed to moving, on a grid of the fixed space.
    pub field: VectorImage,
    /// The first mesh, fixed space before any deformation but the rigid one.
    pub first_mesh: MixedMesh,
    /// Blocks of the last iteration.
    pub blocks: Vec<Block>,
    /// Cavity on the coarse grid.
    pub cavity: Vec<bool>,
    /// The coarse grid.
    pub coarse_grid: Grid,
    /// One report per iteration.
    pub iterations: Vec<IterationReport>,
}

/// One resolution of the fixed scan.
struct Scale {
    grid: Grid,
    fixed: MatchImage,
    foreground: Vec<bool>,
    /// Gaussian for the warped scan, voxels per axis.
    sigma: [f64; 3],
}

/// Runs the loop from a rigid transform.
///
/// # Errors
/// [`Error::InvalidInput`] for windows larger than the image or labels without material; [`Error::NoResult`] where no block
/// is left; those of the mesher; [`Error::Cancelled`].
pub fn adaptive_loop(
    scans: &Scans,
    grid: &Grid,
    rigid: &DMat4,
    options: &Options,
    mesher: Mesher,
    context: &RunContext,
) -> Result<LoopResult> {
    let count = if options.adaptive.enabled { options.adaptive.max_iterations } else { 1 };
    let coarse_count = if count < 2 { 0 } else { ((count as f64 * COARSE_SHARE).round() as usize).max(1) };
    let coarse = Scale::new(scans, &coarser(grid, COARSE)?, options)?;
    let fine = Scale::new(scans, grid, options)?;
    let mut state = State {
        scans,
        options,
        context,
        mesher,
        rigid,
        coarse: &coarse,
        field: rigid_field(rigid, &coarse.grid)?,
        first_mesh: None,
        blocks: Vec::new(),
        cavity: Vec::new(),
        reports: Vec::new(),
    };
    for iteration in 0..count {
        context.check()?;
        context.progress("registration", 0.15 + 0.7 * iteration as f64 / count as f64);
        let is_coarse = iteration < coarse_count;
        let window = window_of(options.matching.half_window, iteration, coarse_count);
        state.iterate(if is_coarse { &coarse } else { &fine }, window)?;
        if !is_coarse && state.is_settled() {
            break;
        }
    }
    state.finish()
}

/// The window of an iteration: whole on the first one of each grid, then halved down to two voxels: what is left to find shrinks.
fn window_of(whole: [usize; 3], iteration: usize, coarse_count: usize) -> [usize; 3] {
    if coarse_count == 0 {
        return whole;
    }
    let later = if iteration < coarse_count { iteration } else { 1 + iteration - coarse_count };
    whole.map(|half| (half >> later.min(2)).max(2).min(half))
}

impl Scale {
    fn new(scans: &Scans, grid: &Grid, options: &Options) -> Result<Self> {
        let spacing = grid.spacing().x;
        let fixed = resample_linear(scans.fixed, grid, |p| p)?;
        let foreground = map_voxels(grid, |point, _| {
            let fixed_grid = scans.fixed.grid();
            let at = nearest_offset(fixed_grid.size(), fixed_grid.world_to_index(point));
            at.is_some_and(|at| scans.foreground[at])
        });
        // Half a voxel of smoothing at least keeps the resampling from aliasing.
        let source = scans.fixed.grid().spacing().min_element();
        let sigma = options.matching.noise_sigma.max(if spacing > 1.5 * source { 0.5 * spacing } else { 0.0 });
        let fixed = smooth(fixed.voxels(), grid.size(), [sigma / spacing; 3]);
        // The moving scan is smoothed as much as the thicker slices of the fixed scan smooth that one.
        let (thick, thin) = (scans.fixed.grid().spacing(), scans.moving.grid().spacing().element_product().cbrt());
        let extra = thick.to_array().map(|s| ((s * s - thin * thin).max(0.0) / 8.0).sqrt());
        let sigma = extra.map(|e| (sigma * sigma + e * e).sqrt() / spacing);
        let fixed = MatchImage::new(fixed, grid.size(), options.features.half_block, options.matching.metric);
        Ok(Self { grid: *grid, fixed, foreground, sigma })
    }
}

struct State<'a> {
    scans: &'a Scans<'a>,
    options: &'a Options,
    context: &'a RunContext,
    mesher: Mesher<'a>,
    rigid: &'a DMat4,
    coarse: &'a Scale,
    field: VectorImage,
    first_mesh: Option<MixedMesh>,
    blocks: Vec<Block>,
    cavity: Vec<bool>,
    reports: Vec<IterationReport>,
}

impl State<'_> {
    fn iterate(&mut self, scale: &Scale, half_window: [usize; 3]) -> Result<()> {
        let mut report = IterationReport { spacing: scale.grid.spacing().x, ..IterationReport::default() };
        let mut clock = Instant::now();
        let mut lap = |slot: &mut f64| {
            *slot = clock.elapsed().as_secs_f64();
            clock = Instant::now();
        };
        let (mesh, filling) = self.model(&mut report)?;
        lap(&mut report.seconds[1]);
        let warped = self.warped(scale)?;
        let tissue = self.tissue(scale);
        lap(&mut report.seconds[0]);
        let matches = self.matches(scale, &warped, &tissue, half_window, &mut report)?;
        lap(&mut report.seconds[2]);
        let mut field = self.solve(&mesh, filling, &matches, scale.grid.spacing().x, &mut report)?;
        lap(&mut report.seconds[3]);
        repair_folds(&mut field, LOOP_JACOBIAN);
        report.mean_update = mean_distance(&field, &self.field, &self.coarse.foreground);
        self.field = field;
        lap(&mut report.seconds[4]);
        self.reports.push(report);
        Ok(())
    }

    /// Finds the cavity and meshes the corrected segmentation; returns the mesh and the label of the filling.
    fn model(&mut self, report: &mut IterationReport) -> Result<(MixedMesh, i32)> {
        let coarse = self.coarse;
        let warped = self.warped(coarse)?;
        let labels = warp_labels(self.scans.segmentation, &self.field, &coarse.grid)?;
        let scene = Scene {
            size: coarse.grid.size(),
            spacing: coarse.grid.spacing().x,
            fixed: coarse.fixed.values(),
            foreground: &coarse.foreground,
            foreground_is_given: self.scans.foreground_is_given,
            warped: warped.values(),
            labels: &labels,
        };
        let is_adaptive = self.options.adaptive.enabled;
        let mode = if is_adaptive { self.options.adaptive.resection } else { Resection::Off };
        self.cavity = find_cavity(&scene, mode);
        report.cavity = self.cavity.iter().filter(|c| **c).count() as f64 * scene.spacing.powi(3);
        let parts = resected_model(&scene, &self.cavity, is_adaptive);
        let mesh = match (self.scans.mesh, &self.first_mesh) {
            (Some(given), None) => self.given_mesh(given),
            _ if is_adaptive => (self.mesher)(&parts.model, &self.options.mesh, self.context)?,
            _ => (self.mesher)(&labels, &self.options.mesh, self.context)?,
        };
        if self.first_mesh.is_none() {
            self.first_mesh = Some(mesh.clone());
        }
        let mesh = with_shape_functions(mesh, self.options.mechanics.shape_functions)?;
        (report.nodes, report.elements) = (mesh.points.len(), mesh.element_count());
        Ok((mesh, parts.filling))
    }

    /// The caller's mesh in the fixed space.
    fn given_mesh(&self, mesh: &MixedMesh) -> MixedMesh {
        let to_fixed = self.rigid.inverse();
        let mut mesh = mesh.clone();
        mesh.points.iter_mut().for_each(|p| *p = super::options::apply(&to_fixed, *p));
        mesh
    }

    fn warped(&self, scale: &Scale) -> Result<MatchImage> {
        let scan = warp_scan(self.scans.moving, &self.field, &scale.grid)?;
        let values = smooth(scan.voxels(), scale.grid.size(), scale.sigma);
        Ok(MatchImage::new(values, scale.grid.size(), self.options.features.half_block, self.options.matching.metric))
    }

    /// Voxels of a scale that are neither in the cavity nor at its rim, where fluid mixes with tissue; background beside the brain
    /// counts, its edge is structure.
    fn tissue(&self, scale: &Scale) -> Vec<bool> {
        let grid = &self.coarse.grid;
        let hole = map_voxels(&scale.grid, |point, _| {
            let at = nearest_offset(grid.size(), grid.world_to_index(point));
            at.is_some_and(|at| self.cavity[at])
        });
        let steps = (CAVITY_RIM / scale.grid.spacing().x) as usize;
        grow(hole, |_| true, scale.grid.size(), steps).into_iter().map(|h| !h).collect()
    }

    /// Voxels of a scale where blocks of the moving scan may have no counterpart: tumour, and what lies around the cavity.
    fn uncertain(&self, scale: &Scale, tissue: &[bool], labels: &LabelImage) -> Vec<bool> {
        if tissue.iter().all(|t| *t) {
            return vec![false; tissue.len()];
        }
        let tumor = labels.label_of(2);
        let hole = tissue.iter().map(|t| !t).collect();
        let steps = (CAVITY_REACH / scale.grid.spacing().x).ceil() as usize;
        let near = grow(hole, |_| true, scale.grid.size(), steps);
        near.into_iter().zip(labels.voxels()).map(|(near, label)| near || Some(*label) == tumor).collect()
    }

    fn matches(
        &self,
        scale: &Scale,
        warped: &MatchImage,
        tissue: &[bool],
        half_window: [usize; 3],
        report: &mut IterationReport,
    ) -> Result<Matches> {
        let options = &self.options.matching;
        let settings = MatchSettings {
            size: scale.grid.size(),
            spacing: scale.grid.spacing().x,
            half_block: self.options.features.half_block,
            half_window,
            metric: options.metric,
            min_similarity: options.min_similarity,
        };
        settings.check()?;
        let both = options.direction == MatchingDirection::Both;
        let features = FeatureOptions {
            // Both scans share the wanted number of blocks.
            selection_fraction: self.options.features.selection_fraction * if both { 0.5 } else { 1.0 },
            ..self.options.features.clone()
        };
        let mut result = Matches::default();
        if options.direction != MatchingDirection::MovingToFixed {
            let mask: Vec<bool> = scale.foreground.iter().zip(tissue).map(|(f, t)| *f && *t).collect();
            let mut centers = select_features(scale.fixed.values(), settings.size, &mask, &features);
            self.add_near_cavity(&mut centers, scale, tissue, mask, &features);
            let found = match_blocks(&scale.fixed, tissue, warped, &centers, &settings, self.context)?;
            report.blocks += found.len();
            report.missing += found.iter().filter(|m| m.outcome != MatchOutcome::Found).count();
            result.add(&found, &scale.grid, Side::Fixed);
        }
        if options.direction != MatchingDirection::FixedToMoving {
            let labels = warp_labels(self.scans.segmentation, &self.field, &scale.grid)?;
            let uncertain = self.uncertain(scale, tissue, &labels);
            let mask: Vec<bool> =
                (0..tissue.len()).map(|at| labels.voxels()[at].0 != 0 && tissue[at] && !uncertain[at]).collect();
            let centers = select_features(warped.values(), settings.size, &mask, &features);
            let mut found = self.match_moving(scale, warped, tissue, &centers, &settings)?;
            let remaining: Vec<bool> = scale.foreground.iter().zip(tissue).map(|(f, t)| *f && *t).collect();
            let (paired, missing) = pair_with_surface(&mut found, &remaining, &settings);
            report.blocks += found.len();
            report.paired += paired;
            report.missing += missing;
            result.add(&found, &scale.grid, Side::Moving);
        }
        if result.data.points.is_empty() {
            return Err(Error::NoResult {
                message: format!(
                    "none of {} blocks has a correspondence: do the scans show the same patient?",
                    report.blocks
                ),
                findings: Vec::new(),
            });
        }
        Ok(result)
    }

    /// More blocks around the cavity: tissue moves most there, and the scan often varies little.
    fn add_near_cavity(
        &self,
        centers: &mut Vec<usize>,
        scale: &Scale,
        tissue: &[bool],
        mut mask: Vec<bool>,
        features: &FeatureOptions,
    ) {
        if tissue.iter().all(|t| *t) {
            return;
        }
        let size = scale.grid.size();
        let hole = tissue.iter().map(|t| !t).collect();
        let near = grow(hole, |_| true, size, (DENSE_REACH / scale.grid.spacing().x).ceil() as usize);
        mask.iter_mut().zip(&near).for_each(|(mask, near)| *mask &= *near);
        let fraction = (features.selection_fraction * DENSER).min(1.0);
        let features = FeatureOptions { selection_fraction: fraction, ..features.clone() };
        let mut taken = vec![false; mask.len()];
        centers.iter().for_each(|at| taken[*at] = true);
        let more = select_features(scale.fixed.values(), size, &mask, &features);
        centers.extend(more.into_iter().filter(|at| !taken[*at]));
    }

    /// Blocks of the moving scan in the fixed scan, whose cavity is filled: its edge would attract them.
    fn match_moving(
        &self,
        scale: &Scale,
        warped: &MatchImage,
        tissue: &[bool],
        centers: &[usize],
        settings: &MatchSettings,
    ) -> Result<Vec<BlockMatch>> {
        if tissue.iter().all(|t| *t) {
            return match_blocks(warped, tissue, &scale.fixed, centers, settings, self.context);
        }
        let hole: Vec<bool> = tissue.iter().map(|t| !t).collect();
        let values = fill_hole(scale.fixed.values(), &hole, settings.size);
        let filled = MatchImage::new(values, settings.size, settings.half_block, settings.metric);
        match_blocks(warped, tissue, &filled, centers, settings, self.context)
    }

    /// The field that fits all matches: the mechanics act on the displacement since the rigid start, not on an update of it, so that
    /// errors of the matches do not add up over the iterations.
    fn solve(
        &mut self,
        mesh: &MixedMesh,
        filling: i32,
        matches: &Matches,
        spacing: f64,
        report: &mut IterationReport,
    ) -> Result<VectorImage> {
        let mut labels: Vec<i32> = mesh.labels.clone();
        labels.sort_unstable();
        labels.dedup();
        let materials = materials(self.options, &labels, filling, self.options.adaptive.enabled)?;
        let Matches { data, .. } = matches;
        let agrees = agreeing(&data.points, &data.displacements, &data.weights, REACH * spacing, UNCERTAINTY * spacing);
        let moving: Vec<DVec3> = data
            .points
            .iter()
            .zip(&data.displacements)
            .map(|(point, step)| *point + *step + self.field.at_clamped(*point + *step))
            .collect();
        let to_fixed = self.rigid.inverse();
        let kept: Vec<usize> = (0..agrees.len()).filter(|n| agrees[*n]).collect();
        let total = BlockMeasurements {
            points: kept.iter().map(|n| data.points[*n]).collect(),
            displacements: kept.iter().map(|n| apply(&to_fixed, moving[*n]) - data.points[*n]).collect(),
            weights: kept.iter().map(|n| data.weights[*n]).collect(),
        };
        let fit = solve_deformation(mesh, &total, materials, DATA_STIFFNESS, &self.options.mechanics, self.context)?;
        let mut is_rejected = vec![true; agrees.len()];
        kept.iter().zip(&fit.status).for_each(|(n, status)| is_rejected[*n] = *status != MeasurementStatus::Used);
        report.rejected = is_rejected.iter().filter(|r| **r).count();
        report.solver_iterations = fit.solves.iter().map(|s| s.iterations).sum();
        self.blocks = (0..agrees.len())
            .map(|n| Block {
                moving: moving[n],
                fixed: data.points[n],
                similarity: matches.similarity[n],
                is_rejected: is_rejected[n],
            })
            .collect();
        let deformation = field_of_mesh(mesh, &fit.displacements, &self.coarse.grid)?;
        before_rigid(&deformation, self.rigid)
    }

    fn is_settled(&self) -> bool {
        self.reports.last().is_some_and(|report| {
            let missing = report.missing as f64 / report.blocks.max(1) as f64;
            report.mean_update < self.options.adaptive.min_update
                && missing < self.options.matching.zero_blocks_fraction.max(0.0)
        })
    }

    fn finish(self) -> Result<LoopResult> {
        let missing = self.reports.last().map_or(0, |r| r.missing);
        if missing > 0 {
            let text = format!("{missing} blocks of the last iteration have no correspondence and do not count");
            let finding = Finding::new(FindingCode::MissingCorrespondence, Severity::Note, text);
            self.context.report(finding.with_ids(missing as i64, -1));
        }
        let first_mesh = self.first_mesh.ok_or_else(|| Error::Internal { reason: "the loop made no mesh".into() })?;
        Ok(LoopResult {
            field: self.field,
            first_mesh,
            blocks: self.blocks,
            cavity: self.cavity,
            coarse_grid: self.coarse.grid,
            iterations: self.reports,
        })
    }
}

/// In which scan the blocks were selected.
#[derive(Clone, Copy, PartialEq)]
enum Side {
    Fixed,
    Moving,
}

/// Matches of both directions as displacements from the fixed point to the warped point.
#[derive(Default)]
struct Matches {
    data: BlockMeasurements,
    similarity: Vec<f64>,
}

impl Matches {
    fn add(&mut self, found: &[BlockMatch], grid: &Grid, side: Side) {
        let frame = grid.direction();
        let size = grid.size();
        for block in found.iter().filter(|m| m.outcome == MatchOutcome::Found) {
            let voxel = super::feature_points::voxel_of(block.at, size).map(|x| x as f64);
            let center = grid.index_to_world(DVec3::from_array(voxel));
            let shift = frame * block.shift;
            let weight: DMat3 = frame * block.confidence * frame.transpose();
            // A block of the warped scan at x that lies at x + s in the fixed scan: from there the way back is -s.
            let (point, step) = if side == Side::Fixed { (center, shift) } else { (center + shift, -shift) };
            self.data.points.push(point);
            self.data.displacements.push(step);
            self.data.weights.push(weight);
            self.similarity.push(f64::from(block.similarity));
        }
    }
}

/// Mean length of the difference of two fields over a mask.
fn mean_distance(left: &VectorImage, right: &VectorImage, mask: &[bool]) -> f64 {
    const CHUNK: usize = 1 << 14;
    let parts: Vec<(f64, usize)> = left
        .vectors()
        .par_chunks(CHUNK)
        .zip(right.vectors().par_chunks(CHUNK))
        .zip(mask.par_chunks(CHUNK))
        .map(|((left, right), mask)| {
            let masked = left.iter().zip(right).zip(mask).filter(|(_, m)| **m);
            masked.fold((0.0, 0), |(sum, count), ((l, r), _)| (sum + f64::from((*l - *r).length()), count + 1))
        })
        .collect();
    let (sum, count) = parts.into_iter().fold((0.0, 0), |(s, c), (a, b)| (s + a, c + b));
    sum / count.max(1) as f64
}
