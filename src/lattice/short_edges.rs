//! Edges much shorter than those around them are contracted where no angle pays for it.
//!
//! # Method
//! Tets whose shortest edge is less than a share of their longest are listed, the shortest edges first. Each such edge is
//! contracted to either of its ends, when the changed tets score as high as the wanted score or as the tets before, whichever
//! is less, and the surfaces allow it ([`contract_edge`]). Where they do not, its ends move apart if asked: an inner one towards the
//! middle of its ball, one on a surface along that, as far as the same scores allow. A few sweeps, after the first only over
//! tets near those that changed.
//!
//! Angles alone do not see such edges: a needle has good ones. A solver does: the shortest edge sets the step in time of an
//! explicit one and the condition number of an implicit one [Shewchuk2002].
//!
//! # Invariants
//! The mesh conforms; no score falls below the wanted one that was not below before.

use rayon::prelude::*;
use rustc_hash::FxHashSet;

use crate::context::RunContext;
use crate::error::Result;
use crate::lattice::element_score::{Ball, Part, Threshold};
use crate::lattice::improvement_mesh::ImprovementMesh;
use crate::lattice::local_transformations::{contract_edge, may_contract};
use crate::lattice::vertex_optimization::{plan_centering, plan_relaxation};
use crate::mesh::numbering::TET_EDGES;

/// Edges between two looks at whether the run is cancelled.
const EDGES_PER_CHECK: usize = 256;

/// What becomes of an edge that cannot be contracted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Uncontracted {
    /// It stays as it is.
    Stay,
    /// Its ends move apart.
    Lengthen,
}

/// Contracts edges below the share `short` of the longest in their tet, in at most `passes` sweeps; returns how many.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn contract_short_edges(
    mesh: &mut ImprovementMesh,
    wanted: f64,
    short: f64,
    passes: usize,
    others: Uncontracted,
    context: &RunContext,
) -> Result<usize> {
    let mut contracted = 0;
    let all = (0..mesh.tets.len() as u32).into_par_iter().with_min_len(4096);
    let mut edges = short_edges(mesh, short, all.take_any_while(|_| !context.is_cancelled()));
    context.check()?;
    for pass in 1..=passes {
        // What changed nowhere near would fail again.
        let mut touched: Vec<u32> = Vec::new();
        // A vertex has many short edges, and one place to go.
        let mut tried = FxHashSet::default();
        for (at, (_, [a, b])) in edges.into_iter().enumerate() {
            context.check_every(EDGES_PER_CHECK, at)?;
            if mesh.shell(a, b).is_empty() {
                continue;
            }
            let places = [a, b].map(|v| mesh.points[v as usize]);
            if contract(mesh, a, b, wanted) {
                contracted += 1;
                touched.extend([a, b]);
            } else if others == Uncontracted::Lengthen {
                move_apart(mesh, [a, b], wanted, &mut tried);
                touched
                    .extend([a, b].iter().zip(places).filter(|(v, p)| mesh.points[**v as usize] != *p).map(|(v, _)| v));
            }
        }
        if pass == passes || touched.is_empty() {
            break;
        }
        let near: Vec<u32> = touched.iter().flat_map(|v| mesh.ball(*v)).flat_map(|t| mesh.tets[*t as usize]).collect();
        edges = short_edges(mesh, short, mesh.tets_of(near).into_par_iter());
    }
    Ok(contracted)
}

/// Square of the length and ends of the short edges of some tets, the shortest first.
fn short_edges(mesh: &ImprovementMesh, short: f64, tets: impl ParallelIterator<Item = u32>) -> Vec<(f64, [u32; 2])> {
    let short_edge = |t: u32| {
        let tet = mesh.tets[t as usize];
        let corners = mesh.corners(t);
        let lengths = TET_EDGES.map(|[a, b]| corners[a].distance_squared(corners[b]));
        let longest = lengths.into_iter().fold(0.0, f64::max);
        let (length, [a, b]) =
            lengths.into_iter().zip(TET_EDGES).fold((f64::INFINITY, [0, 1]), |l, r| if r.0 < l.0 { r } else { l });
        let [a, b] = [tet[a], tet[b]];
        (length < short * short * longest).then(|| (length, [a.min(b), a.max(b)]))
    };
    let mesh_tets = tets.filter(|t| mesh.part(*t) == Part::Mesh && mesh.is_live(*t));
    let mut edges: Vec<(f64, [u32; 2])> = mesh_tets.filter_map(short_edge).collect();
    edges.sort_unstable_by(|l, r| l.0.total_cmp(&r.0).then(l.1.cmp(&r.1)));
    edges.dedup_by_key(|(_, ends)| *ends);
    edges
}

/// Merges one end of an edge into the other, where that is good enough.
fn contract(mesh: &mut ImprovementMesh, a: u32, b: u32, wanted: f64) -> bool {
    [(a, b), (b, a)].into_iter().any(|(from, to)| {
        may_contract(mesh, from, to) && {
            let needed = Threshold::of(mesh.lowest(mesh.ball(from)).min(wanted));
            contract_edge(mesh, from, to, &needed)
        }
    })
}

/// Lengthens an edge by moving its ends to better places, where no score falls below the wanted one that was not below; those
/// that have been `tried` stay.
fn move_apart(mesh: &mut ImprovementMesh, [a, b]: [u32; 2], wanted: f64, tried: &mut FxHashSet<u32>) {
    let mut ball = Ball::default();
    for (v, other) in [(a, b), (b, a)] {
        if !tried.insert(v) {
            continue;
        }
        let bound = Threshold::of(wanted);
        let target = if mesh.is_on_surface(v) {
            plan_relaxation(mesh, v, &bound, &mut ball)
        } else {
            plan_centering(mesh, v, wanted, &mut ball)
        };
        let from = mesh.points[other as usize];
        if let Some(place) = target
            && place.distance_squared(from) > mesh.points[v as usize].distance_squared(from)
        {
            mesh.move_vertex(v, place);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use crate::image::label_image::LabelImage;
    use crate::index::{Label, VertexId};
    use crate::lattice::boundary_targets::SourcePoints;
    use crate::lattice::candidate_mesh::CandidateMesh;
    use crate::lattice::subvoxel_surface::SubvoxelSurface;
    use glam::{DMat3, DVec3};

    #[test]
    fn a_vertex_close_to_another_goes_and_the_space_stays_filled() {
        // An octahedron around two vertices next to each other on its axis.
        let ring = [DVec3::X, DVec3::Y, DVec3::NEG_X, DVec3::NEG_Y];
        let mut points = vec![DVec3::NEG_Z, DVec3::ZERO, DVec3::Z * 0.05, DVec3::Z];
        points.extend(ring);
        let v = VertexId::from_index;
        let mut tets = Vec::new();
        for (low, high) in [(0, 1), (1, 2), (2, 3)] {
            for i in 0..4 {
                tets.push([v(low), v(high), v(4 + i), v(4 + (i + 1) % 4)]);
            }
        }
        let mut mesh =
            CandidateMesh { points, tet_labels: vec![Label(1); tets.len()], tets, ..CandidateMesh::default() };
        let grid = Grid::new([4; 3], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let image = LabelImage::new(grid, vec![Label(1); 64], vec![0, 1]).unwrap();
        let surface = SubvoxelSurface::new(&image, &RunContext::with_threads(1).unwrap()).unwrap();
        let mut work = ImprovementMesh::new(&mut mesh, &SourcePoints::default(), surface);
        // Without sources no vertex is on a surface: those of the outside are held instead.
        [0, 3, 4, 5, 6, 7].into_iter().for_each(|v: usize| work.fixed[v] = true);
        let context = RunContext::with_threads(1).unwrap();
        context.cancel_token().cancel();
        let cancelled = contract_short_edges(&mut work, 15.0, 0.2, 3, Uncontracted::Lengthen, &context);
        assert!(matches!(cancelled, Err(crate::error::Error::Cancelled)));
        let context = RunContext::with_threads(1).unwrap();
        assert_eq!(contract_short_edges(&mut work, 15.0, 0.2, 3, Uncontracted::Lengthen, &context).unwrap(), 1);
        work.finish(&mut mesh);
        assert_eq!((mesh.points.len(), mesh.tets.len()), (7, 8));
        let volume: f64 =
            mesh.tets.iter().map(|t| crate::geometry::tetrahedron::volume(t.map(|v| mesh.points[v.index()]))).sum();
        assert!((volume - 4.0 / 3.0).abs() < 1e-12);
    }
}
