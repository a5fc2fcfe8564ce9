//! Smoothing of the candidate mesh: deformation, then quality improvement within the distance bound.
//!
//! # Method
//! 1. The lattice is cut flat where the image ends ([`border_clipping`](crate::lattice::border_clipping)).
//! 2. Source and target points ([`boundary_targets`](crate::lattice::boundary_targets)).
//! 3. Elastic deformation to the sub-voxel surfaces
//!    ([`surface_deformation`](crate::lattice::surface_deformation)).
//! 4. Relaxation, volumes, optimisation, local transformations
//!    ([`lattice_improvement`](crate::lattice::lattice_improvement)).
//!
//! # Source
//! [Drakopoulos2017] 2.3.5.
//!
//! # Differences
//! The thesis gives up when an element stays bad, and ends with angles of 5 degrees; here moves are damped locally and the
//! improvement follows.
//!
//! # Limits
//! Elements are tets: hexahedra and pyramids are merged afterwards from tets that smoothing left whole.

use glam::DVec3;

use crate::context::RunContext;
use crate::error::{Finding, FindingCode, Result, Severity};
use crate::index::VertexId;
use crate::lattice::border_clipping::clip_at_border;
use crate::lattice::boundary_targets::{SourcePoints, TargetPoints};
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::face_adjacency::neighbors_of;
use crate::lattice::lattice_improvement::{ImprovementOptions, Transformations, improve};
use crate::lattice::loose_pieces::{FarPieces, relabel_loose_pieces};
use crate::lattice::options::Options;
use crate::lattice::progress_shares;
use crate::lattice::report::Report;
use crate::lattice::subvoxel_surface::SubvoxelSurface;
use crate::lattice::surface_deformation::{Deformation, deform};
use crate::lattice::voxel_cleanup::CleanImage;

/// Point sets that smoothing worked with, for whoever debugs.
#[derive(Debug, Clone, Default)]
pub struct SmoothingPoints {
    /// Surface vertices before smoothing, local frame, mm.
    pub sources: Vec<DVec3>,
    /// Target voxels (i, j, k).
    pub targets: Vec<[usize; 3]>,
}

/// Smooths a mesh of tets in place; `neighbors` are those of the tets.
///
/// # Errors
/// As [`deform`].
pub fn smooth(
    mesh: &mut CandidateMesh,
    mut neighbors: Vec<[u32; 4]>,
    clean: &CleanImage,
    options: &Options,
    report: &mut Report,
    context: &RunContext,
) -> Result<SmoothingPoints> {
    let (image, values) = (clean.image.as_ref(), clean.values.as_slice());
    context.progress("target surface", progress_shares::REFINED);
    let surface = report.timed("target_surface", || SubvoxelSurface::new(image, context))?;
    context.check()?;
    let planes = report.timed("border", || clip_at_border(mesh, &surface, context))?;
    report.set("smoothing.border_planes", planes.len() as f64);
    if !planes.is_empty() {
        neighbors = neighbors_of(bytemuck::cast_slice(&mesh.tets), mesh.points.len(), context)?;
    }
    let far = if options.check_mesh_topology { FarPieces::Go } else { FarPieces::Stay };
    let loose = report.timed("loose_pieces", || relabel_loose_pieces(mesh, &neighbors, image, far, context))?;
    if loose > 0 {
        neighbors = neighbors_of(bytemuck::cast_slice(&mesh.tets), mesh.points.len(), context)?;
    }
    report.set("smoothing.loose_pieces", loose as f64);
    context.check()?;
    let (tets, labels) = (&mesh.tets, &mesh.tet_labels);
    let sources = SourcePoints::new(&mesh.points, tets, labels, &neighbors, &surface, &planes, context)?;
    drop(neighbors);
    let targets = TargetPoints::new(image, options.non_connectivity);
    let points = SmoothingPoints {
        sources: sources.vertices.iter().map(|v: &VertexId| mesh.points[v.index()]).collect(),
        targets: if options.keep_target_points || options.keep_target_image {
            targets.voxels().collect()
        } else {
            Vec::new()
        },
    };
    context.check()?;
    let mut lattice = mesh.points.clone();
    lattice.extend(&mesh.scaffold.points);
    let input = Deformation { image, surface: &surface, sources: &sources, targets: &targets, values, options };
    let summary = report.timed("deformation", || deform(mesh, &input, context))?;
    if sources.vertices.iter().zip(&points.sources).all(|(v, p)| mesh.points[v.index()] == *p) {
        let text = "smoothing moved no surface vertex: they have no target, or every move would spoil elements";
        context.report(Finding::new(FindingCode::SmoothingStopped, Severity::Warning, text));
    }
    report.set("smoothing.source_points", sources.vertices.len() as f64);
    report.set("smoothing.target_points", targets.len() as f64);
    report.set("smoothing.iterations", summary.iterations as f64);
    report.set("smoothing.solver_iterations", summary.solver_iterations as f64);
    report.set("smoothing.scaled_tries", summary.scaled_tries as f64);
    report.set("smoothing.damped_moves", summary.guarded.damped as f64);
    report.set("smoothing.undone_moves", summary.guarded.undone as f64);
    let improvement = ImprovementOptions {
        transformations: if options.local_transformations { Transformations::Local } else { Transformations::None },
        laplacian_iterations: options.laplacian_iterations,
        min_dihedral_angle: options.min_dihedral_angle,
    };
    let result =
        report.timed("improvement", || improve(mesh, clean, surface, &sources, lattice, &improvement, context))?;
    report.set("improvement.low_before", result.low_before as f64);
    report.set("improvement.low_after", result.low_after as f64);
    report.set("improvement.lowest_score", result.lowest);
    report.set("improvement.searched", result.searched as f64);
    report.set("improvement.relabelled", result.relabelled as f64);
    report.set("improvement.approached", result.approached as f64);
    report.set("improvement.bridges", result.bridges as f64);
    report.set("improvement.crossings", result.crossings as f64);
    if result.crossings > 0 {
        let text = format!("{} pairs of surface triangles cross: the mesh overlaps itself there", result.crossings);
        context.report(Finding::new(FindingCode::IntersectingTriangles, Severity::Warning, text));
    }
    report.set("improvement.edge_removals", result.counts.edge_removals as f64);
    report.set("improvement.face_exchanges", result.counts.face_exchanges as f64);
    report.set("improvement.contractions", result.counts.contractions as f64);
    report.set("improvement.splits", result.counts.splits as f64);
    report.set("improvement.chords", result.counts.chords as f64);
    report.set("improvement.turned_edges", result.counts.turned_edges as f64);
    report.set("improvement.short_edges", result.counts.short_edges as f64);
    report.set("improvement.spikes", result.counts.spikes as f64);
    Ok(points)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::label_image::LabelImage;
    use crate::index::Label;
    use crate::lattice::face_adjacency::OUTSIDE;
    use crate::lattice::options::PARAMETERS;
    use crate::lattice::test_images::voxel_image as image;
    use crate::lattice::{self, CandidateMesh};
    use crate::mesh::mixed_mesh::MixedMesh;
    use crate::mesh::quality::mesh_quality;
    use crate::mesh::validation::check_mixed_mesh;
    use crate::parameters::ParameterSet;

    fn run(image: &LabelImage, settings: &[(&str, &str)], threads: usize) -> (lattice::Output, Report) {
        let mut set = ParameterSet::new(PARAMETERS);
        let settings = [("lattice-spacing", "4"), ("fidelity", "0.9")].iter().chain(settings);
        settings.for_each(|(name, value)| set.set_text(name, value).unwrap());
        let options = Options::from_parameters(&set).unwrap();
        let context = RunContext::with_threads(threads).unwrap();
        lattice::run(image, &options, &context).unwrap()
    }

    fn mesh(image: &LabelImage, threads: usize) -> MixedMesh {
        run(image, &[], threads).0.mesh
    }

    fn volume_of(mesh: &MixedMesh, label: i32) -> f64 {
        let tets = mesh.tets().unwrap();
        (0..tets.len())
            .filter(|t| mesh.labels[*t] == label)
            .map(|t| crate::geometry::tetrahedron::volume(tets[t].map(|v| mesh.points[v.index()])))
            .sum()
    }

    #[test]
    fn a_ball_becomes_smooth_close_and_well_shaped_for_any_number_of_threads() {
        let center = DVec3::new(15.3, 15.8, 16.1);
        let image = image(32, |p| u16::from(p.distance(center) < 12.0));
        let result = mesh(&image, 1);
        // From three threads on changes are planned before their turn.
        assert!([2, 3].iter().all(|threads| mesh(&image, *threads) == result));
        check_mixed_mesh(&result).unwrap();
        let quality = mesh_quality(&result, &RunContext::with_threads(1).unwrap()).unwrap().statistics();
        assert!(quality.value("quality.min_dihedral").unwrap() > 12.0, "{quality:?}");
        assert!(quality.value("quality.max_dihedral").unwrap() < 160.0);
        let voxels = image.voxels().iter().filter(|l| l.0 == 1).count() as f64;
        assert!((volume_of(&result, 1) / voxels - 1.0).abs() < 0.005);
        let errors: Vec<f64> = result
            .boundary
            .triangles
            .as_flattened()
            .iter()
            .map(|v| (result.points[v.index()].distance(center) - 12.0).abs())
            .collect();
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        // Facets of a coarse mesh are chords: volumes are kept, so vertices stand off by about a tenth of a voxel (measured 0.123).
        assert!(mean < 0.18 && errors.iter().all(|e| *e < 0.7), "{mean}");
    }

    #[test]
    fn labels_that_meet_in_lines_keep_angles_and_volumes() {
        let label = |p: DVec3| {
            let inside = p.distance(DVec3::splat(12.4)) < 9.6;
            if inside { 1 + u16::from(p.x > 12.2) + 2 * u16::from(p.y > 11.7) } else { 0 }
        };
        let image = image(26, label);
        let result = mesh(&image, 1);
        assert!(mesh(&image, 3) == result);
        check_mixed_mesh(&result).unwrap();
        let quality = mesh_quality(&result, &RunContext::with_threads(1).unwrap()).unwrap().statistics();
        assert!(quality.value("quality.min_dihedral").unwrap() > 8.0, "{quality:?}");
        for label in 1..5u16 {
            let voxels = image.voxels().iter().filter(|l| l.0 == label).count() as f64;
            assert!((volume_of(&result, i32::from(label)) / voxels - 1.0).abs() < 0.02, "{label}");
        }
    }

    #[test]
    fn iterations_end_where_several_labels_settle_and_not_where_there_is_one() {
        let center = DVec3::new(15.3, 15.8, 16.1);
        let iterations = |labels: u16, asked: &str| {
            let image = image(32, |p| if p.distance(center) < 12.0 { 1 + u16::from(p.x > 15.0) % labels } else { 0 });
            let report = run(&image, &[("smoothing-iterations", asked)], 2).1.statistics();
            report.value("smoothing.iterations").unwrap()
        };
        assert_eq!([iterations(1, "9"), iterations(2, "1")], [9.0, 1.0]);
        let settled = iterations(2, "9");
        assert!(settled > 1.0 && settled < 9.0, "{settled}");
    }

    #[test]
    fn tissue_cut_by_the_image_border_ends_flat() {
        let image = image(20, |p| u16::from(p.distance(DVec3::new(9.0, 9.4, 0.0)) < 8.0));
        let result = mesh(&image, 1);
        let lowest = result.points.iter().map(|p| p.z).fold(f64::INFINITY, f64::min);
        assert!(lowest >= -0.5 - 0.2, "{lowest}");
        let on_plane = result.points.iter().filter(|p| (p.z + 0.5).abs() < 1e-9).count();
        assert!(on_plane > 30, "{on_plane}");
    }

    #[test]
    fn a_cancelled_smoothing_ends_with_the_error() {
        let image = image(12, |p| u16::from(p.distance(DVec3::splat(5.5)) < 4.0));
        let context = RunContext::with_threads(1).unwrap();
        context.cancel_token().cancel();
        let options = Options::from_parameters(&ParameterSet::new(PARAMETERS)).unwrap();
        let mut mesh = CandidateMesh {
            points: vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z],
            tets: vec![[0, 1, 2, 3].map(VertexId)],
            tet_labels: vec![Label(1)],
            ..CandidateMesh::default()
        };
        let mut report = Report::default();
        let clean =
            crate::lattice::voxel_cleanup::clean(&image, &options, &RunContext::with_threads(1).unwrap()).unwrap();
        let result = smooth(&mut mesh, vec![[OUTSIDE; 4]], &clean, &options, &mut report, &context);
        assert!(matches!(result, Err(crate::Error::Cancelled)));
    }
}
