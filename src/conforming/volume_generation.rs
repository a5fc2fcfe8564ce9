//! From a boundary-conforming mesh to the finished volume grid: sizes, refinement, improvement, unused vertices out.
//!
//! # Method
//! 1. The size field of the host's sizing, the options' sources, source surfaces and region limits.
//! 2. Refinement ([`super::refinement`]) where asked for; quality improvement ([`super::quality_improvement`]).
//! 3. Between the two, vertices and tets are renumbered along a curve: improvement visits them in all orders.
//! 4. Candidates that never became vertices leave holes in the numbering; the last vertices move into them.
//!
//! # Source
//! [Drakopoulos2017] 4.3 steps 3 and 4.
//!
//! # Invariants
//! The first `surface_points` vertices keep their numbers and points; constrained faces and edges stay as they are.

use super::options::Options;
use super::quality_improvement::{improve, treat_flat_tets};
use super::refinement::{boundary_triangles, check_limits, initial_sizes, refine};
use glam::DVec3;

use crate::context::RunContext;
use crate::error::Result;
use crate::index::{TetId, VertexId};
use crate::mesh::size_field::SizeField;
use crate::mesh::sizing::Sizing;
use crate::mesh::surface_mesh::SurfaceMesh;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;
use crate::parallel::pinning::PinnedWorkers;
use crate::statistics::Statistics;

/// What decides sizes, beside the boundary and the options.
#[derive(Clone, Copy, Default)]
pub struct VolumeInput<'a> {
    /// The host's sizing.
    pub sizing: Option<&'a Sizing>,
    /// Surfaces that are only sources of sizes.
    pub source_surfaces: &'a [&'a SurfaceMesh],
    /// Largest edge length per label of the complex; labels beyond the end have no limit.
    pub region_limits: &'a [Option<f64>],
    /// Vertices of the surface, the first ones of the complex.
    pub surface_points: usize,
}

/// Refines and improves a mesh whose boundary is recovered: labels set, boundary faces constrained.
///
/// # Errors
/// Those of [`refine`] and [`improve`].
pub fn generate_volume(
    complex: &mut TetComplex,
    input: &VolumeInput,
    options: &Options,
    context: &RunContext,
) -> Result<Statistics> {
    let mut sizing = input.sizing.cloned().unwrap_or_default();
    sizing.sources.extend_from_slice(&options.size_sources);
    let mut figures = Statistics::default();
    // The caller knows these by number, Steiner points of the recovery among them.
    let recovered = complex.vertex_count();
    let mut options = options.clone();
    // A poor surface needs every flip there is.
    options.flip_44 |= largest_surface_angle(complex, context) > options.low_quality_surface_angle;
    let options = &options;
    let free = SizeField::new(&sizing, input.source_surfaces, f64::INFINITY)?;
    let mut sizes = initial_sizes(complex, &free, options.size_factor, context)?;
    let limit = if options.size_limit < 0.0 {
        f64::INFINITY
    } else if options.size_limit == 0.0 {
        sizes.iter().copied().fold(0.0, f64::max)
    } else {
        options.size_limit
    };
    sizes.iter_mut().for_each(|size| *size = size.min(limit));
    let limits = input.region_limits.iter().map(|l| l.unwrap_or(f64::INFINITY)).collect();
    let field = free.with_limits(limit, limits);
    if !options.refine {
        check_limits(options, complex.live_count() as f64, "made")?;
        return Ok(figures);
    }
    let pinned = options.pin_threads.then(|| PinnedWorkers::new(context));
    if let Some(pinned) = &pinned {
        figures.set("threads.pinned", pinned.count() as f64);
    }
    figures.extend(&refine(complex, &mut sizes, &field, options, context)?);
    treat_flat_tets(complex, &mut sizes, options, context)?;
    if options.count_slivers {
        let slivers = super::bad_tets::sliver_count(complex, context);
        figures.set("refinement.slivers", slivers as f64);
    }
    if options.quality_passes > 0 {
        let renumbering = context.install(|| complex.renumber_along_curve(recovered))?;
        sizes = renumbering.of_vertices(&sizes);
    }
    figures.extend(&improve(complex, &mut sizes, options, context)?);
    drop(pinned);
    drop_unused_vertices(complex, input.surface_points);
    Ok(figures)
}

/// The largest angle in a triangle of the boundary, degrees.
fn largest_surface_angle(complex: &TetComplex, context: &RunContext) -> f64 {
    let angle_at = |at: DVec3, p: DVec3, q: DVec3| (p - at).angle_between(q - at).to_degrees();
    boundary_triangles(complex, context)
        .into_iter()
        .map(|triangle| {
            let [a, b, c] = triangle.map(|v| complex.point(v));
            angle_at(a, b, c).max(angle_at(b, c, a)).max(angle_at(c, a, b))
        })
        .fold(0.0, f64::max)
}

/// Moves the last vertices into the numbers that no tet uses, from `first` on.
pub fn drop_unused_vertices(complex: &mut TetComplex, first: usize) {
    let count = complex.vertex_count();
    let is_used = |complex: &TetComplex, v: usize| complex.tet_of(VertexId::from_index(v)) != TetId::NONE;
    let mut number: Vec<VertexId> = Vec::new();
    let (mut hole, mut last) = (first, count);
    loop {
        while hole < last && is_used(complex, hole) {
            hole += 1;
        }
        while last > hole && !is_used(complex, last - 1) {
            last -= 1;
        }
        if hole >= last {
            break;
        }
        if number.is_empty() {
            number = (0..count).map(VertexId::from_index).collect();
        }
        let (from, to) = (VertexId::from_index(last - 1), VertexId::from_index(hole));
        complex.set_point(to, complex.point(from));
        complex.set_tet_of(to, complex.tet_of(from));
        complex.set_tet_of(from, TetId::NONE);
        number[from.index()] = to;
    }
    if !number.is_empty() {
        for tet in (0..complex.slot_count()).map(TetId::from_index) {
            let row = complex.vertices(tet);
            if complex.is_live(tet) && row.iter().any(|v| !v.is_ghost() && v.index() >= last) {
                complex.set_vertices(tet, row.map(|v| if v.is_ghost() { v } else { number[v.index()] }));
            }
        }
    }
    complex.truncate_points(last);
}
