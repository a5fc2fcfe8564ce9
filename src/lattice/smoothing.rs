//! Smoothing of the candidate mesh: deformation, then quality improvement within the distance bound.
//!
//! # Method
//! 1. Source and target points ([`boundary_targets`](crate::lattice::boundary_targets)).
//! 2. Elastic deformation to the sub-voxel surfaces
//!    ([`surface_deformation`](crate::lattice::surface_deformation)).
//!
//! # Source
//! [Drakopoulos2017] 2.3.5.

use glam::DVec3;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::label_image::LabelImage;
use crate::index::VertexId;
use crate::lattice::boundary_targets::{SourcePoints, TargetPoints};
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::face_adjacency::neighbors_of;
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
    Ok(points)
}
