//! How well a finished mesh represents the image it comes from.
//!
//! # Method
//! 1. Quality: `mesh::quality`, histogram of dihedral angles in steps of 5 degrees and extremes.
//! 2. Volumes: elements of a label against its voxels; the sum of all elements against the volume that the boundary
//!    encloses (they differ where elements overlap or leave gaps).
//! 3. Distances, per label: two-sided Hausdorff distance between the vertices on the label's surface and the centres
//!    of its boundary voxels (a face neighbour has another label); mean distance between the two surfaces, both ways.
//!
//! # Source
//! [Drakopoulos2017] 2.5, appendix B.1.

use glam::DVec3;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::label_image::LabelImage;
use crate::index::VertexId;
use crate::mesh::boundary::element_volume;
use crate::mesh::fidelity::{CenteredBox, Triangle, hausdorff, mean_distance};
use crate::mesh::mixed_mesh::{BoundaryFaces, MixedMesh};
use crate::mesh::quality::mesh_quality;
use crate::statistics::Statistics;

/// Histogram and extremes of the elements' quality.
///
/// # Errors
/// As [`mesh_quality`].
pub fn evaluate_quality(mesh: &MixedMesh, context: &RunContext) -> Result<Statistics> {
    Ok(mesh_quality(mesh, context)?.statistics())
}

/// `label.<value>.volume`, `.voxel_volume` [mm^3] and `.volume_error` [%], `mesh.volume`, `mesh.enclosed_volume`.
/// `boundary` is that of the mesh, here and below.
pub fn evaluate_volume(mesh: &MixedMesh, boundary: &BoundaryFaces, image: &LabelImage) -> Statistics {
    let mut statistics = Statistics::default();
    let voxel = image.grid().spacing().element_product() * image.grid().direction().determinant().abs();
    let voxels = image.voxel_counts();
    let mut volumes = vec![0.0; image.label_count()];
    let mut total = 0.0;
    for e in 0..mesh.element_count() {
        let volume = element_volume(mesh, e);
        total += volume;
        if let Some(label) = image.label_of(i64::from(mesh.labels[e])) {
            volumes[label.index()] += volume;
        }
    }
    for label in 1..image.label_count() {
        let (value, expected) = (image.values()[label], voxels[label] as f64 * voxel);
        statistics.set(format!("label.{value}.volume"), volumes[label]);
        statistics.set(format!("label.{value}.voxel_volume"), expected);
        if expected > 0.0 {
            let error = 100.0 * (volumes[label] - expected) / expected;
            statistics.set(format!("label.{value}.volume_error"), error);
        }
    }
    statistics.set("mesh.volume", total);
    statistics.set("mesh.enclosed_volume", enclosed_volume(mesh, boundary));
    statistics
}

/// Vertices of a face of the boundary.
fn corners_of(boundary: &BoundaryFaces, face: usize) -> &[VertexId] {
    match face.checked_sub(boundary.triangles.len()) {
        None => &boundary.triangles[face],
        Some(quad) => &boundary.quads[quad],
    }
}

/// Volume inside of the outer boundary, by the divergence theorem.
fn enclosed_volume(mesh: &MixedMesh, boundary: &BoundaryFaces) -> f64 {
    let origin = mesh.points.first().copied().unwrap_or_default();
    let point = |v: VertexId| mesh.points[v.index()] - origin;
    let mut sixfold = 0.0;
    for (face, labels) in boundary.labels.iter().enumerate() {
        if labels[1] != 0 {
            continue;
        }
        let corners = corners_of(boundary, face);
        for i in 1..corners.len() - 1 {
            sixfold += point(corners[0]).cross(point(corners[i])).dot(point(corners[i + 1]));
        }
    }
    sixfold / 6.0
}

/// `label.<value>.hausdorff`, `label.<value>.mean_distance`, `fidelity.hausdorff` [mm].
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn evaluate_fidelity(
    mesh: &MixedMesh,
    boundary: &BoundaryFaces,
    image: &LabelImage,
    context: &RunContext,
) -> Result<Statistics> {
    let mut statistics = Statistics::default();
    let mut largest = 0.0f64;
    let mut image_surfaces = image_surfaces(image);
    let mut mesh_surfaces = mesh_surfaces(mesh, boundary, image);
    for label in 1..image.label_count() {
        context.check()?;
        let (voxels, squares) = std::mem::take(&mut image_surfaces[label]);
        let triangles = std::mem::take(&mut mesh_surfaces[label]);
        if voxels.is_empty() {
            continue;
        }
        let value = image.values()[label];
        let mut vertices: Vec<DVec3> = triangles.iter().flat_map(|t| t.0).collect();
        vertices.sort_unstable_by(|a, b| a.to_array().partial_cmp(&b.to_array()).expect("coordinates are finite"));
        vertices.dedup();
        let distance = hausdorff(&vertices, &voxels);
        let samples: Vec<(DVec3, f64)> = triangles.iter().flat_map(samples_of).collect();
        let area = |b: &CenteredBox| {
            let side = 2.0 * b.half;
            side.x * side.y + side.y * side.z + side.z * side.x
        };
        let centers: Vec<(DVec3, f64)> = squares.iter().map(|s| (s.center, area(s))).collect();
        let mean = 0.5 * (mean_distance(&samples, &squares) + mean_distance(&centers, &triangles));
        statistics.set(format!("label.{value}.hausdorff"), distance);
        statistics.set(format!("label.{value}.mean_distance"), mean);
        largest = largest.max(distance);
    }
    statistics.set("fidelity.hausdorff", largest);
    Ok(statistics)
}

/// Four points of a triangle with a quarter of its area each.
fn samples_of(triangle: &Triangle) -> [(DVec3, f64); 4] {
    let [a, b, c] = triangle.0;
    let quarter = (b - a).cross(c - a).length() / 8.0;
    let center = (a + b + c) / 3.0;
    [center, (4.0 * a + b + c) / 6.0, (a + 4.0 * b + c) / 6.0, (a + b + 4.0 * c) / 6.0].map(|p| (p, quarter))
}

/// Per label, in the local frame: centres of boundary voxels, and the squares to voxels of other labels.
fn image_surfaces(image: &LabelImage) -> Vec<(Vec<DVec3>, Vec<CenteredBox>)> {
    let size = image.grid().size();
    let spacing = image.grid().spacing();
    let mut surfaces = vec![(Vec::new(), Vec::new()); image.label_count()];
    for k in 0..size[2] {
        for j in 0..size[1] {
            for i in 0..size[0] {
                let own = image.at(i, j, k);
                if own.is_background() {
                    continue;
                }
                let center = DVec3::new(i as f64, j as f64, k as f64) * spacing;
                let mut on_boundary = false;
                for (axis, step) in [(0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0), (2, -1.0), (2, 1.0)] {
                    let mut at = [i, j, k];
                    let moved = at[axis] as f64 + step;
                    let inside = moved >= 0.0 && moved < size[axis] as f64;
                    at[axis] = moved.max(0.0) as usize;
                    if inside && image.at(at[0], at[1], at[2]) == own {
                        continue;
                    }
                    on_boundary = true;
                    let (mut half, mut offset) = (0.5 * spacing, DVec3::ZERO);
                    half[axis] = 0.0;
                    offset[axis] = 0.5 * step * spacing[axis];
                    surfaces[own.index()].1.push(CenteredBox { center: center + offset, half });
                }
                if on_boundary {
                    surfaces[own.index()].0.push(center);
                }
            }
        }
    }
    surfaces
}

/// Per label, in the local frame: the triangles of its surface.
fn mesh_surfaces(mesh: &MixedMesh, boundary: &BoundaryFaces, image: &LabelImage) -> Vec<Vec<Triangle>> {
    let grid = image.grid();
    let local = |v: VertexId| grid.world_to_index(mesh.points[v.index()]) * grid.spacing();
    let mut surfaces = vec![Vec::new(); image.label_count()];
    for (face, sides) in boundary.labels.iter().enumerate() {
        let corners = corners_of(boundary, face);
        for side in sides {
            let Some(label) = image.label_of(i64::from(*side)).filter(|l| !l.is_background()) else { continue };
            for i in 1..corners.len() - 1 {
                let triangle = [corners[0], corners[i], corners[i + 1]].map(local);
                // A mesh from a file may have points without a place: what has none has no distance.
                if triangle.iter().all(|p| p.is_finite()) {
                    surfaces[label.index()].push(Triangle(triangle));
                }
            }
        }
    }
    surfaces
}
