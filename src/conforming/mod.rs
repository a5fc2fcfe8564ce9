//! Surface triangulation to tetrahedra that keep the surface exactly (CDT3D).
//!
//! # Method
//! 1. `input_check`: everything that is wrong with the surface; an invalid one ends here.
//! 2. `delaunay_kernel`: Delaunay tetrahedralization of the surface's points.
//! 3. `boundary_recovery`: every edge and facet of the surface becomes an edge and a face of the mesh; where it fails, 2 and 3
//!    are repeated with deeper searches, twice at most.
//! 4. `domain_labels`: outside is removed, regions get their labels.
//! 5. `volume_generation`: refinement and quality improvement, where asked for; `boundary_slivers` on demand.
//!
//! # Source
//! [Drakopoulos2017] chapter 4, [Drakopoulos2019].
//!
//! # Invariants
//! The surface's points are the first points of the mesh, bit for bit, in their order (equal points merged, unused
//! ones left out); every facet is a face of the mesh (unless boundary slivers are deleted on demand); no other point lies on the surface.

pub mod assembly;
pub mod bad_tets;
pub mod boundary_recovery;
mod boundary_sizes;
pub mod boundary_slivers;
mod cavity;
pub mod cavity_insertion;
pub mod delaunay_kernel;
mod delaunay_numbering;
mod delaunay_parallel;
pub mod domain_labels;
mod edge_lengths;
pub mod enclosure;
mod failed_attempts;
pub mod fault_picture;
pub mod fewest_slivers;
pub mod flip_criteria;
pub mod flips;
mod forced_slivers;
pub mod front;
mod front_clearance;
pub mod input_check;
mod kernel_mesh;
pub mod local_reconnection;
mod lowest_tets;
pub mod needle_faces;
pub mod options;
pub mod parallel_reconnection;
pub mod point_filter;
mod point_location;
pub mod point_placement;
pub mod quality_improvement;
pub mod refinement;
mod region_annealing;
mod region_search;
pub mod report;
pub mod sliver_removal;
pub mod small_polyhedron;
pub mod smoothing;
pub mod spacing;
pub mod tet_prediction;
pub mod vertex_insertion;
pub mod volume_generation;

#[cfg(test)]
mod option_effects_tests;
#[cfg(test)]
mod reconnection_stress_tests;
#[cfg(test)]
mod recovery_tests;
#[cfg(test)]
mod sizing_tests;
#[cfg(test)]
mod test_meshes;
#[cfg(test)]
pub(crate) mod test_surfaces;
#[cfg(test)]
mod tests;

use std::time::Instant;

use crate::conforming::assembly::{Carved, carve, finish};
use crate::conforming::boundary_recovery::constrained_mesh::ConstrainedMesh;
use crate::conforming::boundary_recovery::{
    EdgeOrder, is_locked, merge_in_volume, recover, remove_from_volume, restore_surface,
};
use crate::conforming::boundary_slivers::delete_boundary_slivers;
use crate::conforming::delaunay_kernel::{DelaunayOptions, PointOrder, TetNumbers, tetrahedralize};
use crate::conforming::domain_labels::{Region, label_domain};
use crate::conforming::input_check::CheckedSurface;
use crate::conforming::options::{Options, RecoveryMode};
use crate::conforming::report::Report;
use crate::conforming::volume_generation::{VolumeInput, generate_volume};
use crate::context::RunContext;
use crate::error::{Error, Finding, FindingCode, Result, Severity};
use crate::index::{Label, VertexId};
use crate::mesh::mixed_mesh::MixedMesh;
use crate::mesh::sizing::Sizing;
use crate::mesh::surface_mesh::{PatchRole, SurfaceMesh};
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;

/// Meshes the regions that a surface bounds.
///
/// # Errors
/// `InvalidInput` with every finding about the surface; `NoResult` naming what could not be recovered; `Cancelled`;
/// `LimitReached`; `CapacityExceeded`; `OutOfMemory`.
pub fn run(
    surface: &SurfaceMesh,
    sizing: Option<&Sizing>,
    options: &Options,
    context: &RunContext,
) -> Result<(MixedMesh, Report)> {
    let start = Instant::now();
    if let Some(sizing) = sizing {
        sizing.check()?;
    }
    let mut report = Report::default();
    context.progress("input check", 0.0);
    let checked = input_check::check(surface, options, context)?.into_valid()?;
    checked.findings.iter().cloned().for_each(|finding| context.report(finding));
    report.check = checked.report;
    context.progress("delaunay", 0.03);
    let mesh = match options.boundary_recovery {
        RecoveryMode::Off => hull_mesh(&checked, options, context, &mut report)?,
        _ => domain_mesh((surface, sizing), &checked, options, context, &mut report)?,
    };
    report.total_seconds = start.elapsed().as_secs_f64();
    Ok((mesh, report))
}

fn delaunay_options(options: &Options) -> DelaunayOptions {
    let order = match options.sort_points {
        0 => PointOrder::Input,
        1 => PointOrder::Random,
        _ => PointOrder::Spatial,
    };
    DelaunayOptions { order, seed: 0, numbers: TetNumbers::Reproducible }
}

/// The Delaunay mesh of the points, as it is: one region 1, no boundary.
fn hull_mesh(
    checked: &CheckedSurface,
    options: &Options,
    context: &RunContext,
    report: &mut Report,
) -> Result<MixedMesh> {
    let clock = Instant::now();
    let mut delaunay = tetrahedralize(&checked.points, &delaunay_options(options), context)?;
    report.delaunay_seconds = clock.elapsed().as_secs_f64();
    let tets: Vec<_> = delaunay.complex.finite_tets().collect();
    report.delaunay_tets = tets.len();
    tets.into_iter().for_each(|tet| delaunay.complex.set_label(tet, Label(1)));
    delaunay.complex.to_mixed_mesh(&[0, 1])
}

/// The facets that are only a source of sizes.
fn source_facets(surface: &SurfaceMesh) -> Option<SurfaceMesh> {
    let is_source = |patch: i32| surface.role_of(patch) == PatchRole::Source;
    let patches = &surface.facet_patches;
    let facets: Vec<_> = surface.facets.iter().zip(patches).filter(|(_, p)| is_source(**p)).map(|(f, _)| *f).collect();
    (!facets.is_empty()).then(|| SurfaceMesh::new(surface.points.clone(), facets))
}

/// Attempts at recovery: one that fails takes a few times as long as one that succeeds.
const MOST_ATTEMPTS: usize = 3;

/// What the first attempt yields that does not end with a part of the surface missing. Each starts anew, with edge removals
/// one level deeper: that changes which of many points lie where, and with it what resists in narrow places.
fn first_recovered<T>(mut attempt: impl FnMut(usize) -> Result<T>) -> Result<T> {
    for deeper in 0..MOST_ATTEMPTS - 1 {
        match attempt(deeper) {
            Err(Error::NoResult { .. }) => {}
            ended => return ended,
        }
    }
    attempt(MOST_ATTEMPTS - 1)
}

/// The Delaunay mesh of the points and of corners around them, from which every attempt at recovery starts.
fn enclosed_mesh(
    checked: &CheckedSurface,
    options: &Options,
    context: &RunContext,
    report: &mut Report,
) -> Result<TetComplex> {
    let clock = Instant::now();
    let mut points = checked.points.clone();
    points.extend(enclosure::enclosing_corners(&checked.points));
    let complex = tetrahedralize(&points, &delaunay_options(options), context)?.complex;
    report.delaunay_seconds = clock.elapsed().as_secs_f64();
    report.delaunay_tets = complex.finite_tets().count();
    context.progress("boundary recovery", 0.1);
    Ok(complex)
}

/// The mesh with the surface in it, and the Steiner points that have to stay in its regions, recovered in one order.
fn mesh_in_order(
    (surface, checked, delaunay): (&SurfaceMesh, &CheckedSurface, &TetComplex),
    (options, order): (&Options, EdgeOrder),
    context: &RunContext,
    report: &mut Report,
) -> Result<(ConstrainedMesh, Vec<VertexId>)> {
    let (mut mesh, volume) = first_recovered(|deeper| {
        let options = Options { recursion_depth: options.recursion_depth + deeper, ..options.clone() };
        let recovery = &mut report.recovery;
        let mut mesh = recover(delaunay.clone(), &checked.facets, (&options, order), context, recovery)?;
        let volume = restore_surface(&mut mesh, &options, context, recovery)?;
        Ok((mesh, volume))
    })?;
    let hidden = label_domain(&mesh, surface, &checked.facet_patches, options.domain, context)?;
    let inside = |v: &VertexId| mesh.ball(*v).iter().any(|tet| !hidden.region_of[tet.index()].is_background());
    let volume: Vec<VertexId> = volume.into_iter().filter(inside).collect();
    let kept = remove_from_volume(&mut mesh, volume, options, context, &mut report.recovery)?;
    Ok((mesh, kept))
}

/// As [`mesh_in_order`], in the order that leaves fewer points where edges lock each other; these are merged then.
///
/// Only what is kept is merged, which saves up to a sixth of the time where edges lock each other: on 117 surfaces merging both
/// before choosing left as many points on each.
fn mesh_with_fewest_points(
    input: (&SurfaceMesh, &CheckedSurface),
    options: &Options,
    context: &RunContext,
    report: &mut Report,
) -> Result<(ConstrainedMesh, Vec<VertexId>)> {
    let (mut mesh, left) = mesh_in_better_order(input, options, context, report)?;
    let kept = merge_in_volume(&mut mesh, left, options, context, &mut report.recovery)?;
    Ok((mesh, kept))
}

/// As [`mesh_in_order`], in the order that leaves fewer points.
fn mesh_in_better_order(
    (surface, checked): (&SurfaceMesh, &CheckedSurface),
    options: &Options,
    context: &RunContext,
    report: &mut Report,
) -> Result<(ConstrainedMesh, Vec<VertexId>)> {
    let delaunay = enclosed_mesh(checked, options, context, report)?;
    let input = (surface, checked, &delaunay);
    let (mesh, kept) = mesh_in_order(input, (options, EdgeOrder::Ascending), context, report)?;
    if kept.is_empty() || !is_locked(&report.recovery) {
        return Ok((mesh, kept));
    }
    // Findings and progress are those of the first time.
    let quiet = RunContext::new(context.pool(), context.cancel_token());
    let mut other = report.clone();
    match mesh_in_order(input, (options, EdgeOrder::Descending), &quiet, &mut other) {
        Ok((_, few)) if few.len() >= kept.len() => Ok((mesh, kept)),
        Err(Error::NoResult { .. }) => Ok((mesh, kept)),
        Err(error) => Err(error),
        Ok(better) => {
            for (seconds, first) in other.recovery.seconds.iter_mut().zip(report.recovery.seconds) {
                *seconds += first;
            }
            *report = other;
            Ok(better)
        }
    }
}

/// The mesh of the regions, with the surface in it.
fn domain_mesh(
    (surface, sizing): (&SurfaceMesh, Option<&Sizing>),
    checked: &CheckedSurface,
    options: &Options,
    context: &RunContext,
    report: &mut Report,
) -> Result<MixedMesh> {
    let (mesh, kept) = mesh_with_fewest_points((surface, checked), options, context, report)?;
    // Labels anew: the slots have changed. The findings about regions were reported above.
    let quiet = RunContext::new(context.pool(), context.cancel_token());
    let domain = label_domain(&mesh, surface, &checked.facet_patches, options.domain, &quiet)?;
    report.regions = domain.regions.len();
    for vertex in kept {
        let text = format!("a point was added in the volume at {}", mesh.at(vertex));
        let finding = Finding::new(FindingCode::SteinerPoint, Severity::Note, text);
        context.report(finding.with_ids(i64::from(vertex.0), -1).at(mesh.at(vertex).to_array()));
    }
    let Carved { mut complex, mut subfaces, .. } = carve(&mesh, &domain, checked.points.len())?;
    drop(mesh);
    let regions: &[Region] = &domain.regions;
    let source_surface = source_facets(surface);
    let region_limits: Vec<Option<f64>> = std::iter::once(None).chain(regions.iter().map(|r| r.size)).collect();
    let input = VolumeInput {
        sizing,
        source_surfaces: &source_surface.iter().collect::<Vec<_>>(),
        region_limits: &region_limits,
        surface_points: checked.points.len(),
    };
    report.refinement = generate_volume(&mut complex, &input, options, context)?;
    if options.delete_boundary_slivers {
        let patches = &checked.facet_patches;
        let deleted = delete_boundary_slivers(&mut complex, &mut subfaces, patches, options);
        report.refinement.set("quality.boundary_slivers_deleted", deleted as f64);
    }
    context.install(|| finish(&complex, regions, &subfaces, &checked.facets, &checked.facet_patches))
}
