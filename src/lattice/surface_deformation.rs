//! Physics-based smoothing: the surfaces are pulled to the image boundary, an elastic body follows.
//!
//! # Method
//! Each iteration:
//! 1. Displacement of each source point: to the sub-voxel surface where its sides meet, within the search radius (a factor
//!    times the mean length of its edges); where there is none, to the mean of the target points that fit. It is cut to a
//!    factor times the mean edge length.
//! 2. Solve `(K + f H^T H) U = f H^T D` for the displacements of all vertices: K linear elasticity with a material per
//!    label on tets, pyramids and hexahedra ([`ElasticModel`]), H picks the source points, f the flexibility and the
//!    confidence of the point.
//! 3. Source points of elements that U would spoil get their confidence scaled down; solve again, a few tries, as long as each one
//!    leaves at most half of them. Where the first try leaves more, the iterations that follow make none.
//! 4. The move is made under the guard of [`move_guarded`], which damps it where an element is still spoiled.
//! 5. Where several labels meet that are no vessels, the iterations end once one has moved the surfaces by little.
//!
//! # Source
//! [Drakopoulos2017] 2.3.5 eq. 1 and 2.
//!
//! # Differences
//! Sub-voxel surfaces instead of voxel centres; local damping instead of an end for the whole mesh. K is that of the mesh
//! before the first iteration: all moves together stay below an edge, and the lattice has the better shapes.
//!
//! # Invariants
//! No element gets worse than before and below the bound at once. Vertices on border planes stay in them. Same bits for any number of threads.

use std::ops::Range;

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::fem::material::{Material, MaterialMap};
use crate::image::label_image::LabelImage;
use crate::index::VertexId;
use crate::lattice::boundary_targets::{SourcePoints, TargetPoints};
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::elastic_model::ElasticModel;
use crate::lattice::element_score::{Part, Threshold, tet_fails, tet_score};
use crate::lattice::options::Options;
use crate::lattice::progress_shares;
use crate::lattice::subvoxel_surface::{Side, SubvoxelSurface};
use crate::lattice::untangling::{GuardedMove, GuardedTets, move_guarded};
use crate::parallel::ordered_reduce::ordered_sum;
use crate::sparse::block_csr::BlockCsr;
use crate::sparse::conjugate_gradient::{StoppingRule, conjugate_gradient_from};
use crate::sparse::pattern::Incidence;
use crate::sparse::preconditioner::BlockJacobi;

/// Accuracy of the displacements: a hundredth of a move is far below what the next iteration corrects.
const RELATIVE_TOLERANCE: f64 = 1e-2;

/// Iterations per solve at most; the guard takes whatever has been reached.
const MAX_SOLVER_ITERATIONS: usize = 60;

/// Share of the source points at spoiled elements that may be left after a try for another one to follow: where many are left the pull
/// of their neighbours spoils the elements, and no scale of their own helps. On an atlas of 116 labels 81 to 100 % are left after
/// the first try; with one try in the first iteration instead of one in each it has 1 % fewer low tets after the deformation.
const MOST_LEFT: f64 = 0.5;

/// Stiffness of a vertex that must not move, in units of the flexibility.
const HELD: f64 = 1e6;

/// Mean move of the source points in an iteration, in voxels of the smallest spacing, after which no other one follows where surfaces
/// [follow the staircase](SubvoxelSurface::follows_staircase): what is left is less from one iteration to the next, is held back by the
/// guard more and more, and what comes after the deformation brings the vertices onto their surfaces at a lower cost. On an atlas
/// of brain lobes five iterations move them by 0.257, 0.149, 0.068, 0.025 and 0.008 voxel and undo 0, 0, 4, 20 and 52 thousand moves;
/// with the first three distances, angles and volumes in the end are the same, and a third fewer tets are low before the improvement.
/// On tori the largest distance would be 0.45 voxel instead of 0.37: one body may be so smooth that every bit shows.
const SETTLED: f64 = 0.1;

/// Vertices per parallel work item.
const VERTEX_CHUNK: usize = 4096;

/// What the deformation did.
#[derive(Debug, Clone, Copy, Default)]
pub struct DeformationSummary {
    /// Iterations done.
    pub iterations: usize,
    /// Conjugate-gradient iterations of all solves.
    pub solver_iterations: usize,
    /// Solves with scaled confidence.
    pub scaled_tries: usize,
    /// Moves that were damped or undone.
    pub guarded: GuardedMove,
}

/// Everything a deformation reads.
pub struct Deformation<'a> {
    /// The image, local frame.
    pub image: &'a LabelImage,
    /// Its sub-voxel surfaces.
    pub surface: &'a SubvoxelSurface<'a>,
    /// Surface vertices.
    pub sources: &'a SourcePoints,
    /// Boundary voxels.
    pub targets: &'a TargetPoints,
    /// Caller's value per label.
    pub values: &'a [i32],
    /// Options of the engine.
    pub options: &'a Options,
}

/// Runs the iterations of the deformation on the tets of a mesh.
///
/// # Errors
/// [`crate::Error::InvalidArgument`] for a material out of range; [`crate::Error::Cancelled`],
/// [`crate::Error::LimitReached`].
pub fn deform(mesh: &mut CandidateMesh, input: &Deformation, context: &RunContext) -> Result<DeformationSummary> {
    let mut summary = DeformationSummary::default();
    if input.sources.vertices.is_empty() {
        return Ok(summary);
    }
    let materials = materials(input)?;
    context.check()?;
    let model = ElasticModel::new(mesh, input.values, context)?;
    if !input.options.mixed_elements {
        mesh.cubes.clear();
    }
    context.check()?;
    let mut held = vec![false; mesh.points.len()];
    mesh.fixed.iter().for_each(|v| held[v.index()] = true);
    let mut matrix = model.stiffness(&mesh.points, &materials, context)?;
    for vertex in &mesh.fixed {
        matrix.add(vertex.index(), vertex.index(), DMat3::from_diagonal(DVec3::splat(HELD)));
    }
    let diagonals: Vec<DMat3> = input.sources.vertices.iter().map(|v| matrix.diagonal(v.index())).collect();
    let rows: Vec<i64> = (0..=mesh.tets.len() as i64).map(|t| 4 * t).collect();
    let own = Incidence::new(mesh.points.len(), &rows, mesh.tets.as_flattened())?;
    let body = Body { model, diagonals, held, near: tets_at_sources(mesh, input.sources), incidence: &own };
    let scaffold = std::mem::take(&mut mesh.scaffold);
    let rows: Vec<i64> = (0..=scaffold.tets.len() as i64).map(|t| 4 * t).collect();
    let vertices = mesh.points.len() + scaffold.points.len();
    let around = Incidence::new(vertices, &rows, scaffold.tets.as_flattened())?;
    context.check()?;
    let preconditioner = BlockJacobi::new(&matrix);
    let mut springs = Springs { matrix, preconditioner, pulls: vec![0.0; input.sources.vertices.len()] };
    let mut tries = Tries { allowed: input.options.max_confidence_iterations };
    let shares = (progress_shares::TARGETED, progress_shares::DEFORMED);
    let settled = if input.surface.follows_staircase() { SETTLED * input.surface.spacing().min_element() } else { 0.0 };
    for iteration in 0..input.options.smoothing_iterations {
        context.progress("deformation", progress_shares::within(shares, iteration, input.options.smoothing_iterations));
        context.check()?;
        let displacements = displacements_of(mesh, input, &body, &mut springs, &mut tries, &mut summary, context)?;
        let bound = input.options.min_dihedral_angle;
        let groups = [
            GuardedTets { tets: &mesh.tets, incidence: &own, part: Part::Mesh },
            GuardedTets { tets: &scaffold.tets, incidence: &around, part: Part::Scaffold },
        ];
        context.check()?;
        let before = (settled > 0.0).then(|| source_places(mesh, input.sources));
        let guarded = move_guarded(&mut mesh.points, &scaffold.points, &groups, &displacements, bound, context)?;
        summary.guarded.damped += guarded.damped;
        summary.guarded.undone += guarded.undone;
        summary.iterations += 1;
        if before.is_some_and(|before| mean_distance(&before, &source_places(mesh, input.sources)) < settled) {
            break;
        }
    }
    mesh.scaffold = scaffold;
    context.check()?;
    Ok(summary)
}

fn source_places(mesh: &CandidateMesh, sources: &SourcePoints) -> Vec<DVec3> {
    let vertices = sources.vertices.par_iter().with_min_len(VERTEX_CHUNK);
    vertices.map(|v| mesh.points[v.index()]).collect()
}

/// The mean distance between points and others, the same for any number of threads.
fn mean_distance(points: &[DVec3], others: &[DVec3]) -> f64 {
    let of_chunk = |range: Range<usize>| range.map(|at| points[at].distance(others[at])).sum();
    ordered_sum(points.len(), of_chunk) / points.len() as f64
}

/// What stays the same in all iterations.
struct Body<'a> {
    /// The elements of the elastic body.
    model: ElasticModel,
    /// Diagonal block of the stiffness at each source point.
    diagonals: Vec<DMat3>,
    /// Vertices that must not move.
    held: Vec<bool>,
    /// Tets with a source point.
    near: Vec<u32>,
    /// Tets of each vertex.
    incidence: &'a Incidence,
}

/// The stiffness with the springs that pull the source points; only what changes is set anew.
struct Springs {
    matrix: BlockCsr,
    preconditioner: BlockJacobi,
    /// Stiffness of the spring at each source point.
    pulls: Vec<f64>,
}

impl Springs {
    /// Sets the springs of the source points; `diagonals` are their blocks without one.
    fn set(&mut self, sources: &SourcePoints, pulls: &[f64], diagonals: &[DMat3]) {
        // Most stay as they are.
        for at in (0..pulls.len()).filter(|at| self.pulls[*at] != pulls[*at]).collect::<Vec<usize>>() {
            let row = sources.vertices[at].index();
            self.pulls[at] = pulls[at];
            self.matrix.set_diagonal(row, diagonals[at] + DMat3::from_diagonal(DVec3::splat(pulls[at])));
            self.preconditioner.refresh(&self.matrix, row);
        }
    }
}

/// Tries with scaled confidence, as long as they help.
#[derive(Debug, Clone, Copy)]
struct Tries {
    /// In an iteration, at most.
    allowed: usize,
}

impl Tries {
    /// Whether another try follows in an iteration after so many, which left so many source points at spoiled elements, and the solve
    /// before it as many as that.
    fn allow_another(&mut self, made: usize, left: usize, before: Option<usize>) -> bool {
        let helps = before.is_none_or(|before| left as f64 <= MOST_LEFT * before as f64);
        if made == 1 && !helps {
            self.allowed = 0;
        }
        helps && left > 0
    }
}

/// Sets the value of each source point, of one per vertex: its position, its vertex and the value are given.
fn for_each_source<T: Send>(sources: &SourcePoints, values: &mut [T], set: impl Fn(usize, usize, &mut T) + Sync) {
    values.par_chunks_mut(VERTEX_CHUNK).enumerate().for_each(|(chunk, values)| {
        let begin = chunk * VERTEX_CHUNK;
        let first = sources.vertices.partition_point(|v| v.index() < begin);
        let end = begin + values.len();
        let own = sources.vertices[first..].iter().take_while(|v| v.index() < end);
        own.zip(first..).for_each(|(v, at)| set(at, v.index(), &mut values[v.index() - begin]));
    });
}

fn tets_at_sources(mesh: &CandidateMesh, sources: &SourcePoints) -> Vec<u32> {
    let is_near = |t: &u32| mesh.tets[*t as usize].iter().any(|v| sources.position_of(*v).is_some());
    (0..mesh.tets.len() as u32).into_par_iter().with_min_len(4096).filter(is_near).collect()
}

/// One solve, again with scaled confidence where it would spoil elements.
fn displacements_of(
    mesh: &CandidateMesh,
    input: &Deformation,
    body: &Body<'_>,
    springs: &mut Springs,
    tries: &mut Tries,
    summary: &mut DeformationSummary,
    context: &RunContext,
) -> Result<Vec<DVec3>> {
    let edges = mean_edge_lengths(mesh, input.sources, body.incidence);
    context.check()?;
    let wanted = source_displacements(mesh, input, &edges, context)?;
    let mut confidence: Vec<f64> = wanted.iter().map(|w| f64::from(u8::from(w.is_some()))).collect();
    let mut displacements = vec![DVec3::ZERO; mesh.points.len()];
    let mut right = vec![DVec3::ZERO; mesh.points.len()];
    let mut residual = vec![DVec3::ZERO; mesh.points.len()];
    let mut left = None;
    for made in 0..=tries.allowed {
        let pulls: Vec<f64> = confidence.iter().map(|c| input.options.flexibility * c).collect();
        let force = |(at, v): (usize, &VertexId)| {
            if body.held[v.index()] { DVec3::ZERO } else { wanted[at].unwrap_or(DVec3::ZERO) * pulls[at] }
        };
        let forces: Vec<DVec3> = input.sources.vertices.par_iter().enumerate().with_min_len(4096).map(force).collect();
        // Only the springs change: a product with the whole matrix costs as much as an iteration. The forces of the springs are
        // added first. At the first attempt nothing has moved, and there are no forces yet.
        for_each_source(input.sources, &mut residual, |at, row, residual| {
            let weaker = springs.pulls[at] - pulls[at];
            *residual += forces[at] - right[row] + weaker * displacements[row];
        });
        for_each_source(input.sources, &mut right, |at, _, right| *right = forces[at]);
        springs.set(input.sources, &pulls, &body.diagonals);
        let rule = StoppingRule { relative_tolerance: RELATIVE_TOLERANCE, max_iterations: MAX_SOLVER_ITERATIONS };
        let Springs { matrix, preconditioner, .. } = springs;
        let unknowns = [displacements.as_mut_slice(), residual.as_mut_slice()];
        let solve = conjugate_gradient_from(matrix, &right, unknowns, preconditioner, &rule, context)?;
        summary.solver_iterations += solve.iterations;
        if made == tries.allowed {
            break;
        }
        let spoiled = spoiled_sources(mesh, input, body, &displacements);
        if !tries.allow_another(made, spoiled.len(), left) {
            break;
        }
        left = Some(spoiled.len());
        spoiled.into_iter().for_each(|at| confidence[at] *= input.options.confidence_factor);
        summary.scaled_tries += 1;
    }
    body.model.move_centers(&mut displacements);
    displacements.iter_mut().zip(&body.held).filter(|(_, held)| **held).for_each(|(d, _)| *d = DVec3::ZERO);
    displacements.iter_mut().filter(|d| !d.is_finite()).for_each(|d| *d = DVec3::ZERO);
    stay_in_planes(mesh, input, &mut displacements);
    Ok(displacements)
}

/// Source points stay within the image, and those on a border plane in it. With the outermost vertices of the scaffold these are
/// the outside of everything that moves: only where that keeps its place, elements that stay positive cannot overlap.
fn stay_in_planes(mesh: &CandidateMesh, input: &Deformation, displacements: &mut [DVec3]) {
    for (at, vertex) in input.sources.vertices.iter().enumerate() {
        let place = mesh.points[vertex.index()];
        displacements[vertex.index()] = input.surface.within_borders(place + displacements[vertex.index()]) - place;
        for side in input.sources.sides(at) {
            if let Side::Border(plane) = side {
                let (axis, position) = input.surface.border(*plane);
                displacements[vertex.index()][axis] = position - place[axis];
            }
        }
    }
}

fn materials(input: &Deformation) -> Result<MaterialMap> {
    let options = input.options;
    let of = |label: i32| Material::new(options.youngs_modulus.of(label), options.poissons_ratio.of(label));
    let entries = input.values.iter().map(|&v| Ok((v, of(v)?))).collect::<Result<_>>()?;
    Ok(MaterialMap::new(None, entries))
}

/// Mean length of the edges at each source point, mm; an edge counts once per tet.
fn mean_edge_lengths(mesh: &CandidateMesh, sources: &SourcePoints, incidence: &Incidence) -> Vec<f64> {
    let of = |v: &VertexId| {
        let tets = incidence.of(v.index());
        let place = mesh.points[v.index()];
        let others = tets.iter().flat_map(|t| mesh.tets[*t as usize]).filter(|w| w != v);
        let sum: f64 = others.map(|w| mesh.points[w.index()].distance(place)).sum();
        if tets.is_empty() { 0.0 } else { sum / (3 * tets.len()) as f64 }
    };
    sources.vertices.par_iter().with_min_len(256).map(of).collect()
}

/// Where each source point is pulled; `None` where nothing near fits.
fn source_displacements(
    mesh: &CandidateMesh,
    input: &Deformation,
    edges: &[f64],
    context: &RunContext,
) -> Result<Vec<Option<DVec3>>> {
    let sources = (0..input.sources.vertices.len()).into_par_iter().with_min_len(64);
    let displacements = context
        .until_cancelled(sources)
        .map(|at| {
            let vertex = input.sources.vertices[at].index();
            let (point, sides) = (mesh.points[vertex], input.sources.sides(at));
            let radius = input.options.search_radius_factor * edges[at];
            let longest = input.options.edge_length_factor * edges[at];
            let place = input.surface.project(point, sides, radius);
            let place = place.or_else(|| input.targets.mean_within(input.image, point, radius, sides))?;
            Some((place - point).clamp_length_max(longest))
        })
        .collect();
    context.check()?;
    Ok(displacements)
}

/// The source points of elements that the displacements would spoil.
fn spoiled_sources(mesh: &CandidateMesh, input: &Deformation, body: &Body<'_>, displacements: &[DVec3]) -> Vec<usize> {
    let bound = Threshold::of(input.options.min_dihedral_angle);
    let pairs = mesh.points.par_iter().zip(displacements).with_min_len(4096);
    let moved: Vec<DVec3> = pairs.map(|(point, displacement)| *point + *displacement).collect();
    let is_spoiled = |t: &&u32| {
        let tet = mesh.tets[**t as usize];
        let [a, b, c, d] = tet.map(|v| moved[v.index()]);
        tet_fails([a, b, c, d], &bound) && tet_score([a, b, c, d]) < tet_score(tet.map(|v| mesh.points[v.index()]))
    };
    let tets: Vec<u32> = body.near.par_iter().with_min_len(1024).filter(is_spoiled).copied().collect();
    let mut vertices: Vec<VertexId> = tets.into_iter().flat_map(|t| mesh.tets[t as usize]).collect();
    vertices.sort_unstable();
    vertices.dedup();
    vertices.into_iter().filter_map(|v| input.sources.position_of(v)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tries_follow_each_other_as_long_as_they_help() {
        let mut tries = Tries { allowed: 3 };
        assert!(!tries.allow_another(0, 0, None));
        assert!(tries.allow_another(0, 100, None));
        assert!(tries.allow_another(1, 50, Some(100)));
        // The second one left too many, or none: the next iteration tries again.
        assert!(!tries.allow_another(2, 26, Some(50)) && !tries.allow_another(2, 0, Some(50)));
        assert_eq!(tries.allowed, 3);
        assert!(tries.allow_another(0, 100, None));
        assert!(!tries.allow_another(1, 51, Some(100)));
        assert_eq!(tries.allowed, 0);
    }
}
