//! Segmented image to mesh by adaptive body-centred cubic lattice refinement (CBC3D).
//!
//! # Method
//! 1. Clean-up of the voxels.
//! 2. Exact distance transform of all labels in one pass (`image::distance_transform`).
//! 3. Body-centred cubic tets over the labelled region ([`bcc_lattice`]).
//! 4. Red-green refinement ([`red_green`]) where the distance changes sign ([`subdivision_criteria`]) until the
//!    voxel count of every label reaches its fidelity ([`voxel_fidelity`]); the loop is [`adaptive_refinement`].
//! 5. Labels by centroid, relabelled so that surfaces can move ([`element_labels`]).
//! 6. Smoothing ([`smoothing`]): the lattice is cut flat at the image border ([`border_clipping`]), surfaces are pulled to the
//!    image boundary, elements improved, around what stays bad by a search ([`iterated_search`]).
//! 7. What the mesh has lost is told ([`lost_components`]), and what it has of other pieces or of another topology ([`topology_findings`]).
//! 8. World coordinates, surfaces, mid-edge nodes ([`finishing`]).
//!
//! # Source
//! [Drakopoulos2017] chapter 2; [Molino2003] for the lattice and its refinement.
//!
//! # Invariants
//! The mesh conforms, its elements are positive, its labels are the caller's. The same bits for any number of threads.

pub mod adaptive_refinement;
pub mod banded_system;
pub mod bcc_lattice;
pub mod border_clipping;
pub mod border_edges;
pub mod border_snapping;
pub mod boundary_targets;
pub mod bridge_cuts;
pub mod candidate_mesh;
pub mod centerlines;
pub mod change_log;
pub mod chord_splits;
pub mod closed_passages;
pub mod deepest_segments;
pub mod distance_spline;
pub mod duplicated_interfaces;
pub mod elastic_model;
pub mod element_labels;
pub mod element_score;
pub mod euler_ranges;
pub mod evaluation;
pub mod face_adjacency;
pub mod finishing;
pub mod fixed_points;
pub mod image_contacts;
pub mod improvement_mesh;
pub mod interface_carving;
pub mod interface_topology;
pub mod iterated_search;
pub mod kept_components;
pub mod last_repair;
pub mod lattice_improvement;
pub mod local_transformations;
pub mod loose_pieces;
pub mod lost_components;
pub mod low_tets;
pub mod mesh_regions;
pub mod missed_voxels;
pub mod mixed_elements;
#[cfg(test)]
mod option_effects_tests;
pub mod options;
pub mod pinch_fillings;
pub mod planned_batches;
pub mod progress_shares;
pub mod projected_gradient;
pub mod red_green;
pub mod red_green_tables;
pub mod region_gaps;
pub mod region_joints;
pub mod report;
pub mod scaffold;
pub mod second_differences;
pub mod short_edges;
pub mod smooth_distance;
pub mod smoothing;
pub mod stray_voxels;
pub mod subdivision_criteria;
pub mod subvoxel_surface;
pub mod surface_approach;
pub mod surface_crossings;
pub mod surface_cuts;
pub mod surface_deformation;
pub mod surface_edge_flips;
pub mod surface_relabelling;
pub mod surface_spikes;
pub mod surface_stars;
#[cfg(test)]
mod test_images;
#[cfg(test)]
mod test_meshes;
pub mod topology_differences;
pub mod topology_findings;
#[cfg(test)]
mod topology_tests;
pub mod tube_fitting;
pub mod tube_joints;
pub mod tubular_parts;
pub mod untangling;
pub mod vertex_balls;
pub mod vertex_optimization;
pub mod vertex_order;
pub mod vertex_table;
pub mod volume_offsets;
pub mod voxel_bricks;
pub mod voxel_cleanup;
pub mod voxel_fidelity;

use std::time::{Duration, Instant};

use glam::DVec3;

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::image::grid::Grid;
use crate::image::label_image::LabelImage;
use crate::image::voxel_image::{VoxelData, VoxelImage};
use crate::mesh::mixed_mesh::MixedMesh;

use adaptive_refinement::RefinementInput;
use face_adjacency::neighbors_of;
use subdivision_criteria::Targets;

pub use candidate_mesh::CandidateMesh;
pub use options::{Options, PARAMETERS, ShapeFunctions};
pub use report::Report;

/// Largest ratio of two spacings. Scans reach 20 (slices of 8 mm with pixels of 0.4 mm). Along the shortest spacing elements are as
/// short as it, so that time and memory grow with the square of the ratio: a ball in 12^3 voxels of 0.02 x 1 x 1 mm takes 1.6 million
/// elements and 1.9 GB, one in voxels of 1 mm 5600 elements and 13 MB.
const LARGEST_SPACING_RATIO: f64 = 50.0;

/// Coarsest cubes where the caller gives no spacing, mm: the thesis's default.
const DEFAULT_SPACING: f64 = 8.0;

/// Without a given spacing the longest side of the image holds at least this many cubes.
const CUBES_ALONG_IMAGE: f64 = 12.0;

/// Lattice spacings tried for a wanted number of vertices; each halves the bracket.
const SPACING_TRIES: usize = 7;

/// A number of vertices within 5 % of the wanted one is taken (difference of logarithms).
const TARGET_TOLERANCE: f64 = 0.05;

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
/// [`Error::InvalidInput`] for an image of background only or of voxels much longer than wide, [`Error::ParameterValue`] for
/// options that do not fit the image, [`Error::NoResult`] where no label has an element, [`Error::Cancelled`],
/// [`Error::LimitReached`].
pub fn run(image: &LabelImage, options: &Options, context: &RunContext) -> Result<(Output, Report)> {
    if let Some(seconds) = options.time_limit {
        context.set_time_limit(Some(Duration::from_secs_f64(seconds.min(1e9))));
    }
    context.install(|| mesh_image(image, options, context))
}

fn mesh_image(original: &LabelImage, options: &Options, context: &RunContext) -> Result<(Output, Report)> {
    let begin = Instant::now();
    let mut report = Report::default();
    check_spacings(original.grid())?;
    check_labels(original, options)?;
    context.progress("clean-up", 0.0);
    let clean = report.timed("cleanup", || voxel_cleanup::clean(original, options, context))?;
    report.merge(&clean.figures);
    let (image, values) = (clean.image.as_ref(), clean.values.as_slice());
    let targets = Targets::new(values, options)?;
    let region_threshold = options.check_mesh_topology.then_some(options.mesh_region_threshold);
    let input = RefinementInput { image, values, targets: &targets, spacing: 0.0, region_threshold };
    let (mut candidate, neighbors) = candidate_of(&input, options, &mut report, context)?;
    // As long as the tets stay.
    let mut neighbors = Some(neighbors);
    if !options.fixed_points.is_empty() {
        let found = fixed_points::snap(&mut candidate, &options.fixed_points, image.grid(), context);
        report.set("mesh.fixed_points", found as f64);
    }
    let mut output = Output::default();
    let finish = |candidate: &CandidateMesh, neighbors: Option<Vec<[u32; 4]>>| {
        finishing::to_world(candidate, neighbors, image.grid(), values, context)
    };
    if options.keep_bcc_mesh {
        output.meshes.push(("bcc_mesh".into(), finish(&candidate, None)?));
    }
    if options.keep_bcc_surface {
        output.meshes.push(("bcc_surface".into(), finishing::surface_of(&finish(&candidate, None)?)?));
    }
    if let Some(neighbors) = neighbors.take_if(|_| options.smoothing_iterations > 0) {
        let points = smoothing::smooth(&mut candidate, neighbors, &clean, options, &mut report, context)?;
        smoothing_outputs(points, image, options, &mut output);
        context.check()?;
        report.timed("lost_components", || lost_components::find_lost(&mut candidate, image, context))?;
    }
    neighbors = tell_differences(&candidate, neighbors, image, values, options, &mut report, context)?;
    context.progress("finishing", progress_shares::FINISHING);
    if options.mixed_elements {
        // Neighbours of tets that are no more.
        neighbors = None;
        let limit = options.max_surface_triangles_on_pyramid;
        let worst = options.min_scaled_jacobian;
        report.timed("mixed_elements", || mixed_elements::merge_cubes(&mut candidate, limit, worst, context))?;
        report.set("mesh.hexahedra", candidate.hexahedra.len() as f64);
        report.set("mesh.pyramids", candidate.pyramids.len() as f64);
    }
    context.check()?;
    let mut mesh = report.timed("finishing", || finish(&candidate, neighbors))?;
    context.check()?;
    refuse_empty(&mesh)?;
    if options.keep_smooth_mesh {
        output.meshes.push(("smooth_mesh".into(), mesh.clone()));
    }
    if options.keep_smooth_surface {
        output.meshes.push(("smooth_surface".into(), finishing::surface_of(&mesh)?));
    }
    drop(candidate);
    context.check()?;
    evaluate(&mesh, original, options, &mut report, context)?;
    if !options.duplicated_interfaces.is_empty() {
        let copies = duplicated_interfaces::duplicate(&mut mesh, &options.duplicated_interfaces)?;
        report.set("mesh.duplicated_vertices", copies as f64);
    }
    if options.shape_functions == ShapeFunctions::Quadratic {
        report.timed("quadratic", || finishing::make_quadratic(&mut mesh))?;
    }
    report.set("mesh.tets", mesh.types.iter().filter(|t| matches!(**t, 10 | 24)).count() as f64);
    report.set("mesh.points", mesh.points.len() as f64);
    report.set("mesh.elements", mesh.element_count() as f64);
    report.set("time.total", begin.elapsed().as_secs_f64());
    output.mesh = mesh;
    Ok((output, report))
}

/// Tells what the mesh of tets has lost of the image, and where its topology is another, as far as that is asked for. Takes
/// and returns the neighbours of the tets where they are known.
fn tell_differences(
    mesh: &CandidateMesh,
    neighbors: Option<Vec<[u32; 4]>>,
    image: &LabelImage,
    values: &[i32],
    options: &Options,
    report: &mut Report,
    context: &RunContext,
) -> Result<Option<Vec<[u32; 4]>>> {
    lost_components::tell_lost(&mesh.lost, image, values, context);
    let is_checked = options.check_mesh_topology;
    if options.smoothing_iterations == 0 && !is_checked {
        return Ok(neighbors);
    }
    let tets = bytemuck::cast_slice(&mesh.tets);
    let neighbors = match neighbors {
        Some(neighbors) => neighbors,
        None => report.timed("adjacency", || neighbors_of(tets, mesh.points.len(), context))?,
    };
    let pinched = report.timed("topology_findings", || {
        topology_findings::tell_pieces(mesh, &neighbors, image, values, context)?;
        topology_findings::tell_topology(mesh, &neighbors, image, values, is_checked, context)
    })?;
    report.set("topology.pinched_vertices", pinched as f64);
    Ok(Some(neighbors))
}

/// Refuses voxels that are much longer than wide.
fn check_spacings(grid: &Grid) -> Result<()> {
    let spacing = grid.spacing();
    let ratio = spacing.max_element() / spacing.min_element();
    if ratio <= LARGEST_SPACING_RATIO {
        return Ok(());
    }
    let place = format!("one spacing of {:?} mm is {ratio:.6e} times another", spacing.to_array());
    Err(Error::input(format!(
        "voxels are too long to be meshed: {place}, where at most {LARGEST_SPACING_RATIO} are taken"
    )))
}

/// A mesh of no element is no result, whatever made it so.
fn refuse_empty(mesh: &MixedMesh) -> Result<()> {
    if mesh.element_count() > 0 {
        return Ok(());
    }
    let message = "no label of the image has an element: the lattice is too coarse for all of them".into();
    Err(Error::NoResult { message, findings: Vec::new() })
}

/// Options for labels that the caller's image does not have are refused.
fn check_labels(image: &LabelImage, options: &Options) -> Result<()> {
    Targets::new(image.values(), options).map(|_| ())
}

fn smoothing_outputs(points: smoothing::SmoothingPoints, image: &LabelImage, options: &Options, output: &mut Output) {
    let grid = image.grid();
    if options.keep_target_image {
        let mut marks = vec![0u8; grid.voxel_count()];
        points.targets.iter().for_each(|[i, j, k]| marks[grid.offset(*i, *j, *k)] = 1);
        let image = VoxelImage { grid: *grid, components: 1, data: VoxelData::U8(marks) };
        output.images.push(("target_points".into(), image));
    }
    if options.keep_source_points {
        let sources = points.sources.iter().map(|p| grid.local_to_world(*p)).collect();
        output.points.push(("source_points".into(), sources));
    }
    if options.keep_target_points {
        let center = |voxel: &[usize; 3]| grid.index_to_world(DVec3::from_array(voxel.map(|v| v as f64)));
        output.points.push(("target_points".into(), points.targets.iter().map(center).collect()));
    }
}

fn evaluate(
    mesh: &MixedMesh,
    image: &LabelImage,
    options: &Options,
    report: &mut Report,
    context: &RunContext,
) -> Result<()> {
    if options.evaluate_quality {
        report.merge(&evaluation::evaluate_quality(mesh, context)?);
    }
    if options.evaluate_volume {
        report.merge(&evaluation::evaluate_volume(mesh, &mesh.boundary, image));
    }
    if options.evaluate_fidelity {
        report.merge(&evaluation::evaluate_fidelity(mesh, &mesh.boundary, image, context)?);
    }
    Ok(())
}

/// The mesh before smoothing, with the spacing that the options ask for.
fn candidate_of(
    input: &RefinementInput,
    options: &Options,
    report: &mut Report,
    context: &RunContext,
) -> Result<(CandidateMesh, Vec<[u32; 4]>)> {
    let spacing = options.lattice_spacing.unwrap_or_else(|| adapted_spacing(input.image));
    let refine = |spacing: f64, report: &mut Report| {
        adaptive_refinement::refine(&RefinementInput { spacing, ..*input }, options, report, context)
    };
    let Some(wanted) = options.target_vertices else { return refine(spacing, report) };
    // The number of vertices falls with some power of the spacing, in steps where a level comes or goes: a bracket in
    // the logarithm of the spacing, at most SPACING_TRIES times, keeping the nearest.
    let (mut low, mut high) = (f64::NAN, f64::NAN);
    let mut spacing = spacing;
    let mut best = None;
    for _ in 0..SPACING_TRIES {
        let mut tried = Report::default();
        let candidate = refine(spacing, &mut tried)?;
        let ratio = candidate.0.points.len() as f64 / wanted as f64;
        let off = ratio.ln().abs();
        if ratio > 1.0 {
            low = spacing
        } else {
            high = spacing
        }
        if best.as_ref().is_none_or(|(o, _): &(f64, _)| off < *o) {
            best = Some((off, candidate));
            report.merge(&tried.statistics());
        }
        if off < TARGET_TOLERANCE {
            break;
        }
        spacing = match (low.is_nan(), high.is_nan()) {
            (false, false) => (low * high).sqrt(),
            _ => (spacing * ratio.cbrt().clamp(0.25, 4.0)).min(longest_side(input.image)),
        };
    }
    best.map(|(_, candidate)| candidate).ok_or_else(|| Error::Internal { reason: "no spacing was tried".into() })
}

fn longest_side(image: &LabelImage) -> f64 {
    let grid = image.grid();
    (DVec3::from_array(grid.size().map(|s| s as f64)) * grid.spacing()).max_element()
}

/// The thesis's spacing, smaller for small images, larger for large voxels, moved by a factor of at most the root of two so that
/// halving it ends where boundaries are resolved: a step that lands a little above that is halved once more, for eight times the
/// elements.
fn adapted_spacing(image: &LabelImage) -> f64 {
    let voxel = (image.grid().spacing().length_squared() / 3.0).sqrt();
    let resolved = subdivision_criteria::RESOLVED_EDGE * voxel;
    let wanted = DEFAULT_SPACING.max(resolved).min(longest_side(image) / CUBES_ALONG_IMAGE);
    resolved * (wanted / resolved).log2().round().exp2()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::tetrahedron::volume;
    use crate::image::grid::SPACING_RANGE;
    use crate::index::Label;
    use crate::lattice::test_images::spaced_image;
    use crate::mesh::validation::check_mixed_mesh;
    use crate::parameters::ParameterSet;
    use glam::DMat3;

    #[test]
    fn the_spacing_follows_voxels_that_are_larger_than_the_default() {
        for (voxel, wanted) in [(7.0, 14.0), (100.0, 200.0), (1e6, 2e6)] {
            let grid = Grid::new([96; 3], DVec3::splat(voxel), DVec3::ZERO, DMat3::IDENTITY).unwrap();
            let image = LabelImage::new(grid, vec![Label(1); 96 * 96 * 96], vec![0, 1]).unwrap();
            assert!((adapted_spacing(&image) / wanted - 1.0).abs() < 1e-9, "{voxel}");
        }
    }

    fn mesh_of(image: &LabelImage, options: &[(&str, &str)]) -> Result<MixedMesh> {
        let mut set = ParameterSet::new(PARAMETERS);
        options.iter().try_for_each(|(name, value)| set.set_text(name, value))?;
        let context = RunContext::with_threads(1)?;
        run(image, &Options::from_parameters(&set)?, &context).map(|(output, _)| output.mesh)
    }

    #[test]
    fn voxels_of_any_size_are_meshed_and_needles_refused() {
        let ball = |size: usize, spacing: DVec3| {
            let center = (size as f64 / 2.0 - 0.6) * spacing;
            spaced_image([size; 3], spacing, |p| u16::from(((p - center) / spacing).length() < 0.35 * size as f64))
        };
        for size in SPACING_RANGE {
            let mesh = mesh_of(&ball(12, DVec3::splat(size)), &[]).unwrap();
            check_mixed_mesh(&mesh).unwrap();
            let volume: f64 = mesh.tets().unwrap().iter().map(|t| volume(t.map(|v| mesh.points[v.index()]))).sum();
            let voxels = volume / size.powi(3);
            assert!(
                (voxels / (4.0 / 3.0 * std::f64::consts::PI * 4.2f64.powi(3)) - 1.0).abs() < 0.1,
                "{size}: {voxels}"
            );
        }
        // Edges of two voxels of the smallest spacing: a mesh of the longest voxels is a large one, of however few.
        check_mixed_mesh(&mesh_of(&ball(6, DVec3::new(1.0, 1.0, LARGEST_SPACING_RATIO)), &[]).unwrap()).unwrap();
        for spacing in [[1.0, 1.0, 51.0], [1e-3, 1.0, 1.0], [1e6, 1e-6, 1.0]] {
            let refused = mesh_of(&ball(12, DVec3::from(spacing)), &[]);
            assert!(matches!(&refused, Err(Error::InvalidInput { .. })), "{spacing:?}: {refused:?}");
        }
    }

    #[test]
    fn a_mesh_without_an_element_is_an_error() {
        let mesh = mesh_of(&spaced_image([3; 3], DVec3::ONE, |_| 1), &[]).unwrap();
        refuse_empty(&mesh).unwrap();
        assert!(matches!(refuse_empty(&MixedMesh::default()), Err(Error::NoResult { .. })));
    }

    #[test]
    fn the_spacing_halves_to_edges_of_two_voxels_whatever_the_voxel() {
        for voxel in [0.7, 0.93, 0.94, 1.0, 1.06, 1.9] {
            let grid = Grid::new([96; 3], DVec3::splat(voxel), DVec3::ZERO, DMat3::IDENTITY).unwrap();
            let image = LabelImage::new(grid, vec![Label(1); 96 * 96 * 96], vec![0, 1]).unwrap();
            let spacing = adapted_spacing(&image);
            let halvings = (spacing / (2.0 * voxel)).log2();
            assert!((halvings - halvings.round()).abs() < 1e-9, "{voxel}: {spacing}");
            let wanted = (8.0 * voxel).min(8.0);
            assert!((spacing / wanted).log2().abs() <= 0.5 + 1e-9, "{voxel}: {spacing}");
        }
    }
}
