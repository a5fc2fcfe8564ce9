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

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use crate::context::RunContext;
use crate::error::Result;
use crate::lattice::element_score::{Ball, Part, Threshold};
use crate::lattice::improvement_mesh::ImprovementMesh;
use crate::lattice::local_transformations::{contraction_is_good, may_contract, merge_into};
use crate::lattice::planned_batches::{PlannedChange, Touched, change_in_order};
use crate::lattice::vertex_optimization::{plan_centering, plan_relaxation};
use crate::mesh::numbering::{TET_EDGES, sorted_edge};

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
    let all = (0..mesh.tets.len() as u32).into_par_iter().with_min_len(4096);
    let mut edges = short_edges(mesh, short, context.until_cancelled(all));
    context.check()?;
    let mut contracted = 0;
    for pass in 1..=passes {
        let mut sweep = Sweep { wanted, others, contracted: 0, touched: Vec::new(), tried: FxHashSet::default() };
        change_in_order(mesh, &edges, &mut sweep, context)?;
        contracted += sweep.contracted;
        if pass == passes || sweep.touched.is_empty() {
            break;
        }
        let touched = sweep.touched.iter();
        let near: Vec<u32> = touched.flat_map(|v| mesh.ball(*v)).flat_map(|t| mesh.tets[*t as usize]).collect();
        edges = short_edges(mesh, short, mesh.tets_of(near).into_par_iter());
    }
    Ok(contracted)
}

/// What becomes of an edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Contraction {
    /// It is no more.
    Gone,
    /// The first end is merged into the second.
    Merge(u32, u32),
    /// It cannot be contracted.
    Refused,
}

/// One sweep over short edges.
struct Sweep {
    wanted: f64,
    others: Uncontracted,
    contracted: usize,
    /// Vertices of which something changed: what changed nowhere near would fail again.
    touched: Vec<u32>,
    /// Vertices that had their chance to move: a vertex has many short edges, and one place to go.
    tried: FxHashSet<u32>,
}

/// What is to be done at an edge, and where its ends are to go if it can only be lengthened.
struct Plan {
    contraction: Contraction,
    places: [Option<DVec3>; 2],
}

impl PlannedChange for Sweep {
    type Item = [u32; 2];
    type Plan = Plan;

    fn append_vertices(&self, _: &ImprovementMesh, edge: &[u32; 2], vertices: &mut Vec<u32>) {
        vertices.extend(edge);
    }

    fn plan(&self, mesh: &ImprovementMesh, edge: &[u32; 2], ball: &mut Ball) -> Plan {
        let contraction = contraction_of(mesh, *edge, self.wanted);
        let is_moved = contraction == Contraction::Refused && self.others == Uncontracted::Lengthen;
        let may_move = |v: &u32| is_moved && !self.tried.contains(v);
        let places = edge.map(|v| Some(v).filter(may_move).and_then(|v| better_place(mesh, v, self.wanted, ball)));
        Plan { contraction, places }
    }

    fn change(
        &mut self,
        mesh: &mut ImprovementMesh,
        edge: &[u32; 2],
        plan: Plan,
        touched: &mut Touched,
    ) -> Option<[u32; 2]> {
        match plan.contraction {
            Contraction::Merge(from, to) => {
                touched.mark(mesh, from);
                merge_into(mesh, from, to);
                self.contracted += 1;
                self.touched.extend(edge);
            }
            Contraction::Refused if self.others == Uncontracted::Lengthen => {
                self.move_apart(mesh, *edge, plan.places, touched);
            }
            Contraction::Gone | Contraction::Refused => (),
        }
        None
    }
}

impl Sweep {
    /// Lengthens an edge by moving its ends to the better places that are planned.
    fn move_apart(
        &mut self,
        mesh: &mut ImprovementMesh,
        edge: [u32; 2],
        planned: [Option<DVec3>; 2],
        touched: &mut Touched,
    ) {
        let mut is_as_planned = true;
        for (end, v) in edge.into_iter().enumerate() {
            if !self.tried.insert(v) {
                continue;
            }
            // The second end sees the first one elsewhere once that has moved.
            let target = if is_as_planned {
                planned[end]
            } else {
                mesh.with_scratch(|mesh, ball| better_place(mesh, v, self.wanted, ball))
            };
            let from = mesh.points[edge[1 - end] as usize];
            if let Some(place) = target
                && place.distance_squared(from) > mesh.points[v as usize].distance_squared(from)
            {
                touched.mark(mesh, v);
                mesh.move_vertex(v, place);
                self.touched.push(v);
                is_as_planned = false;
            }
        }
    }
}

/// Ends of the short edges of some tets, the shortest first.
fn short_edges(mesh: &ImprovementMesh, short: f64, tets: impl ParallelIterator<Item = u32>) -> Vec<[u32; 2]> {
    let short_edge = |t: u32| {
        let tet = mesh.tets[t as usize];
        let corners = mesh.corners(t);
        let lengths = TET_EDGES.map(|[a, b]| corners[a].distance_squared(corners[b]));
        let longest = lengths.into_iter().fold(0.0, f64::max);
        let (length, [a, b]) =
            lengths.into_iter().zip(TET_EDGES).fold((f64::INFINITY, [0, 1]), |l, r| if r.0 < l.0 { r } else { l });
        let [a, b] = [tet[a], tet[b]];
        (length < short * short * longest).then(|| (length, sorted_edge(a, b)))
    };
    let mesh_tets = tets.filter(|t| mesh.part(*t) == Part::Mesh && mesh.is_live(*t));
    let mut edges: Vec<(f64, [u32; 2])> = mesh_tets.filter_map(short_edge).collect();
    edges.sort_unstable_by(|l, r| l.0.total_cmp(&r.0).then(l.1.cmp(&r.1)));
    edges.dedup_by_key(|(_, ends)| *ends);
    edges.into_iter().map(|(_, ends)| ends).collect()
}

/// Which end of an edge can be merged into the other, where that is good enough.
fn contraction_of(mesh: &ImprovementMesh, [a, b]: [u32; 2], wanted: f64) -> Contraction {
    if mesh.shell(a, b).is_empty() {
        return Contraction::Gone;
    }
    let is_good = |(from, to): &(u32, u32)| {
        may_contract(mesh, *from, *to) && {
            let needed = Threshold::of(mesh.lowest(mesh.ball(*from)).min(wanted));
            contraction_is_good(mesh, *from, *to, &needed)
        }
    };
    let good = [(a, b), (b, a)].into_iter().find(is_good);
    good.map_or(Contraction::Refused, |(from, to)| Contraction::Merge(from, to))
}

/// A place for an end of an edge where no score falls below the wanted one that was not below; `ball` is a scratch buffer.
fn better_place(mesh: &ImprovementMesh, v: u32, wanted: f64, ball: &mut Ball) -> Option<DVec3> {
    if mesh.is_on_surface(v) {
        plan_relaxation(mesh, v, &Threshold::of(wanted), ball)
    } else {
        plan_centering(mesh, v, wanted, ball)
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
