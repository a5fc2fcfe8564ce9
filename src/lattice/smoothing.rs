//! Smoothing of the candidate mesh: deformation, then quality improvement within the distance bound.
//!
//! # Method
//! 1. Source and target points ([`boundary_targets`](crate::lattice::boundary_targets)).
//! 2. Elastic deformation to the sub-voxel surfaces
//!    ([`surface_deformation`](crate::lattice::surface_deformation)).
//! 3. Relaxation, volumes, optimisation, local transformations
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
use crate::image::label_image::LabelImage;
use crate::index::VertexId;
use crate::lattice::boundary_targets::{SourcePoints, TargetPoints};
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::face_adjacency::neighbors_of;
use crate::lattice::lattice_improvement::{ImprovementOptions, Transformations, improve};
use crate::lattice::options::Options;
use crate::lattice::report::Report;
use crate::lattice::subvoxel_surface::SubvoxelSurface;
use crate::lattice::surface_deformation::{Deformation, deform};

/// Point sets that smoothing worked with, for whoever debugs.
#[derive(Debug, Clone, Default)]
pub struct SmoothingPoints {
    /// Surface vertices before smoothing, local frame, mm.
    pub sources: Vec<DVec3>,
    /// Target voxels (i, j, k).
    pub targets: Vec<[usize; 3]>,
}

/// Smooths a mesh of tets in place.
///
/// # Errors
/// As [`deform`].
pub fn smooth(
    mesh: &mut CandidateMesh,
    image: &LabelImage,
    values: &[i32],
    options: &Options,
    report: &mut Report,
    context: &RunContext,
) -> Result<SmoothingPoints> {
    let surface = SubvoxelSurface::new(image);
    let rows: &[[u32; 4]] = bytemuck::cast_slice(&mesh.tets);
    let neighbors = neighbors_of(rows, mesh.points.len())?;
    let sources = SourcePoints::new(&mesh.points, &mesh.tets, &mesh.tet_labels, &neighbors, &surface);
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
    let input = Deformation { image, surface: &surface, sources: &sources, targets: &targets, values, options };
    let summary = report.timed("deformation", || deform(mesh, &input, context))?;
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
    let result = report.timed("improvement", || improve(mesh, image, &sources, &improvement, context))?;
    report.set("improvement.low_before", result.low_before as f64);
    report.set("improvement.low_after", result.low_after as f64);
    report.set("improvement.lowest_score", result.lowest);
    report.set("improvement.edge_removals", result.counts.edge_removals as f64);
    report.set("improvement.face_exchanges", result.counts.face_exchanges as f64);
    report.set("improvement.contractions", result.counts.contractions as f64);
    report.set("improvement.splits", result.counts.splits as f64);
    report.set("improvement.turned_edges", result.counts.turned_edges as f64);
    if sources.vertices.iter().zip(&points.sources).all(|(v, p)| mesh.points.get(v.index()) == Some(p)) {
        let text = "smoothing could not move any surface vertex";
        context.report(Finding::new(FindingCode::SmoothingStopped, Severity::Warning, text));
    }
    Ok(points)
}
