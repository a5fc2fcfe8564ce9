//! Leaves fewer Steiner points in the volume than can be removed one by one.
//!
//! # Method
//! A point that resists removal mostly holds one segment: without the point, all but that segment can be recovered.
//! ```text
//!     a       c        s opens the knot of segments for a b, and t for c d. Without both, a b and c d are missing; a
//!      \  s  /         point between s and t, or at one of them, often opens the knot for both.
//!      / t   \
//!     d       b
//! ```
//! 1. Two neighbouring points are removed by flips that may remove segments too, faces being no constraints meanwhile.
//!    Segments that are lost are recovered by flips that may not remove any.
//! 2. One point is put between the two or at one of them, and what is missing is recovered; then the faces that were lost.
//! 3. A point is removed alone, and the one segment that is missing then takes the place of another one, which is missing
//!    in its stead, and so on, until one finds room (`edge_rerouting`): most find it at other Steiner points.
//!
//! Whatever does not end with every constraint in its place is undone.
//!
//! # Source
//! [Si2015] and [GeorgeBorouchaki2003] remove points one by one and keep what is recovered; to give segments up for fewer
//! points is ours.
//!
//! # Invariants
//! The constraints that were there before are there afterwards; the number of points never grows.
//!
//! # Cost
//! A fixed number of trials for each point that is there and for each success: it always ends. Many points are left as
//! they are.

use glam::DVec3;
use rustc_hash::FxHashSet;

use super::Effort;
use super::constrained_mesh::{ConstrainedMesh, EdgeKey, edge_key};
use super::crossings::tets_along;
use super::edge_recovery::recover_edge;
use super::edge_rerouting::take_place;
use super::face_recovery::recover_face;
use super::steiner_removal::remove_vertex;
use super::volume_points::insert_to_recover;
use crate::context::RunContext;
use crate::error::Result;
use crate::index::{TetId, VertexId};
use crate::mesh::tet_store::TetStore;

/// Levels of edge removal by which points are removed with segments in their way: 2 leave a point more on some surfaces, a
/// pass with 2 before that with 3 a few fewer for a sixth more time.
const DEPTH: usize = 3;
/// Edges looked at to remove a point, times what thinning takes: 300 leave no fewer points.
const REMOVAL_TRIES: usize = 100;

/// Neighbours that a point is merged with: 6 leave a tenth fewer points than 3, 8 no fewer.
const NEIGHBORS: usize = 6;
/// Most points that are merged. Among so few each can matter; where there are more (knots) removal has left far fewer than other
/// methods do, and merging these too takes a tenth more time over all surfaces that were measured.
const MOST_POINTS: usize = 24;
/// Most segments that one point is to bring back.
const MOST_MISSING: usize = 4;
/// Passes of growing depth by which lost segments are recovered without a point.
const SHALLOW_PASSES: usize = 4;
/// Edges looked at for one segment.
const TRIES: usize = 50;
/// Most tets around a point that is merged with another, in place of which it is put: of a hundred that were, none had more
/// than 28, and what holds more edges than that holds more than a segment or two.
const MOST_BALL: usize = 40;
/// Most vertices that the ball of that point shares with what missing segments cross: those of a face.
const MOST_SHARED: usize = 3;
/// Tries to move a gap.
const MOST_MOVES: usize = 30;
/// Tries in a row that leave a gap where it is: three with each of `MOVE_DEPTHS`. 7 are the most after which one still moved
/// on to where it was filled.
const MOST_UNMOVED: usize = 9;
/// Levels of edge removal with which gaps are moved, in turn.
const MOVE_DEPTHS: [usize; 3] = [2, 3, 5];

/// Merges and drops what can be of `points`, which lie in the volume; returns those that are there then.
///
/// # Errors
/// `Cancelled`, `LimitReached`, and those of vertex and tet creation.
pub fn merge_steiner_points(
    mesh: &mut ConstrainedMesh,
    mut points: Vec<VertexId>,
    efforts: (&[Effort], &[Effort]),
    context: &RunContext,
) -> Result<Vec<VertexId>> {
    if points.len() > MOST_POINTS {
        return Ok(points);
    }
    let merging = Merging::new(efforts);
    let mut next = 0;
    let mut tried: FxHashSet<[VertexId; 2]> = FxHashSet::default();
    while next < points.len() {
        context.check()?;
        let vertex = points[next];
        // Of two points the one or the other may go first: to try it both ways leaves one point fewer in a hundred.
        let mut others = nearest(mesh, &points, vertex);
        others.retain(|&other| tried.insert(edge_key(vertex, other)));
        match merging.leave_out(mesh, vertex, &others)? {
            Some(new) => {
                points.extend(new);
                points.retain(|&vertex| mesh.has_vertex(vertex));
            }
            None => next += 1,
        }
    }
    Ok(points)
}

/// The points nearest to one of them, nearest first.
fn nearest(mesh: &ConstrainedMesh, points: &[VertexId], vertex: VertexId) -> Vec<VertexId> {
    let place = mesh.at(vertex);
    let mut near: Vec<(f64, VertexId)> = Vec::new();
    for &other in points.iter().filter(|&&other| other != vertex) {
        let distance = mesh.at(other).distance_squared(place);
        let rank = near.partition_point(|(d, _)| *d <= distance);
        if rank < NEIGHBORS {
            near.insert(rank, (distance, other));
            near.truncate(NEIGHBORS);
        }
    }
    near.into_iter().map(|(_, other)| other).collect()
}

/// The efforts of the trials.
struct Merging<'a> {
    /// By which points are removed.
    removal: Effort,
    /// By which lost segments are recovered without a point.
    shallow: Vec<Effort>,
    /// By which missing segments are recovered at a point.
    recovery: Effort,
    /// By which faces are recovered.
    faces: &'a [Effort],
}

impl<'a> Merging<'a> {
    fn new((edge_efforts, efforts): (&[Effort], &'a [Effort])) -> Self {
        let flips = edge_efforts[0];
        Self {
            removal: Effort { depth: DEPTH, tries: REMOVAL_TRIES, yields: true, ..flips },
            shallow: edge_efforts[..SHALLOW_PASSES.min(edge_efforts.len())].to_vec(),
            recovery: Effort { depth: efforts[2].depth, tries: TRIES, ..flips },
            faces: &efforts[..3],
        }
    }

    /// Leaves a point out, with one of the others or alone; the points that are there instead, or `None` where that fails.
    fn leave_out(
        &self,
        mesh: &mut ConstrainedMesh,
        vertex: VertexId,
        others: &[VertexId],
    ) -> Result<Option<Vec<VertexId>>> {
        let count = mesh.complex.points().len();
        let place = mesh.at(vertex);
        let mut removed = vec![vertex];
        let mut new = None;
        mesh.begin_trial();
        mesh.keeps_faces = false;
        if let Some(missing) = self.remove(mesh, vertex, &[])?.filter(|missing| missing.len() <= MOST_MISSING) {
            if missing.is_empty() {
                new = Some(Vec::new());
            }
            let crossed = vertices_along(mesh, &missing);
            for &other in others {
                if new.is_some() || mesh.cancel.is_cancelled() {
                    break;
                }
                if !is_apart(mesh, other, &crossed) {
                    continue;
                }
                new = self.merge(mesh, &missing, (place, other))?;
                if new.is_some() {
                    removed.push(other);
                }
            }
            if let ([gap], None) = (&missing[..], &new) {
                new = self.fill_gap(mesh, *gap)?.then(Vec::new);
            }
        }
        mesh.keeps_faces = true;
        let keep = new.is_some() && self.restore_faces(mesh)?;
        mesh.end_trial(keep)?;
        if keep {
            removed.iter().for_each(|&vertex| mesh.complex.set_tet_of(vertex, TetId::NONE));
            return Ok(new);
        }
        mesh.forget_points(count);
        Ok(None)
    }

    /// Removes another point too, and puts one in the stead of both that brings all segments back.
    fn merge(
        &self,
        mesh: &mut ConstrainedMesh,
        missing: &[EdgeKey],
        (place, other): (DVec3, VertexId),
    ) -> Result<Option<Vec<VertexId>>> {
        let place_of_other = mesh.at(other);
        let count = mesh.complex.points().len();
        mesh.begin_trial();
        let mut new = None;
        if let Some(missing) = self.remove(mesh, other, missing)?.filter(|missing| missing.len() <= MOST_MISSING) {
            let places = [0.5 * (place + place_of_other), place, place_of_other];
            new = match missing.is_empty() {
                true => Some(Vec::new()),
                false => self.insert_for(mesh, &missing, places)?.map(|steiner| vec![steiner]),
            };
        }
        mesh.end_trial(new.is_some())?;
        if new.is_none() {
            mesh.forget_points(count);
        }
        Ok(new)
    }

    /// Recovers the faces that the trial under way took from the mesh; whether all constraints are there then.
    fn restore_faces(&self, mesh: &mut ConstrainedMesh) -> Result<bool> {
        let mut faces = mesh.subfaces_lost_in_trial();
        for effort in self.faces {
            let mut left = Vec::new();
            for face in faces {
                if !recover_face(mesh, face, effort)? {
                    left.push(face);
                }
            }
            faces = left;
        }
        Ok(mesh.subfaces_lost_in_trial().is_empty() && mesh.segments_lost_in_trial().is_empty())
    }

    /// Removes a point, with segments where need be; what is missing then of these and of those that were missing before,
    /// or `None` where the point stays.
    fn remove(&self, mesh: &mut ConstrainedMesh, vertex: VertexId, before: &[EdgeKey]) -> Result<Option<Vec<EdgeKey>>> {
        if mesh.has_vertex(vertex) && !remove_vertex(mesh, vertex, &self.removal)? {
            return Ok(None);
        }
        let mut missing = mesh.segments_lost_in_trial();
        missing.extend(before);
        missing.sort_unstable();
        missing.dedup();
        for effort in &self.shallow {
            let mut left = Vec::new();
            for edge in missing {
                if !recover_edge(mesh, edge, effort)? {
                    left.push(edge);
                }
            }
            missing = left;
        }
        Ok(Some(missing))
    }

    /// Puts a point at one of the places so that all missing segments are recovered; `None` where none is.
    fn insert_for(
        &self,
        mesh: &mut ConstrainedMesh,
        missing: &[EdgeKey],
        places: [DVec3; 3],
    ) -> Result<Option<VertexId>> {
        for place in places {
            if let Some(steiner) = insert_to_recover(mesh, place, missing, &self.recovery)? {
                return Ok(Some(steiner));
            }
        }
        Ok(None)
    }

    /// Moves a gap until it is filled: a missing edge takes the place of a segment, which is missing then.
    fn fill_gap(&self, mesh: &mut ConstrainedMesh, edge: EdgeKey) -> Result<bool> {
        let (mut last, mut current) = (edge, edge);
        let mut unmoved = 0;
        for step in 0..MOST_MOVES {
            if unmoved == MOST_UNMOVED {
                break;
            }
            let depth = MOVE_DEPTHS[step % MOVE_DEPTHS.len()];
            let effort = Effort { depth, turn: step, ..self.recovery };
            mesh.begin_trial();
            let left = take_place(mesh, current, &effort)?;
            let next = match left.as_deref() {
                Some([]) => None,
                Some(&[next]) if next != last && next != current => Some(next),
                _ => {
                    mesh.end_trial(false)?;
                    unmoved += 1;
                    continue;
                }
            };
            mesh.end_trial(true)?;
            unmoved = 0;
            match next {
                Some(next) => (last, current) = (current, next),
                None => return Ok(true),
            }
        }
        Ok(false)
    }
}

/// The vertices of the tets that missing segments cross, ascending.
fn vertices_along(mesh: &ConstrainedMesh, missing: &[EdgeKey]) -> Vec<VertexId> {
    let tets = missing.iter().flat_map(|edge| tets_along(mesh, edge[0], edge[1]).unwrap_or_default());
    let mut vertices: Vec<VertexId> = tets.flat_map(|tet| mesh.complex.vertices(tet)).collect();
    vertices.sort_unstable();
    vertices.dedup();
    vertices
}

/// Whether a point that is there still opens a knot of its own, which meets what missing segments cross in a face at most.
/// Where its ball reaches into that, the segments were tried with it in place, and another point there does no more.
fn is_apart(mesh: &ConstrainedMesh, point: VertexId, crossed: &[VertexId]) -> bool {
    if !mesh.has_vertex(point) {
        return true;
    }
    let ball = mesh.ball(point);
    if ball.len() > MOST_BALL {
        return false;
    }
    let mut shared: Vec<VertexId> = ball.iter().flat_map(|&tet| mesh.complex.vertices(tet)).collect();
    shared.retain(|v| crossed.binary_search(v).is_ok());
    shared.sort_unstable();
    shared.dedup();
    shared.len() <= MOST_SHARED
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::boundary_recovery::steiner_points::insert_point;
    use crate::conforming::boundary_recovery::steiner_removal::remove_steiner_points;
    use crate::conforming::boundary_recovery::{EdgeOrder, edge_efforts, efforts, recover, restore_surface};
    use crate::conforming::options::Options;
    use crate::conforming::test_meshes::enclosed_mesh;
    use crate::conforming::test_surfaces::{chazelle, twisted_prism};

    #[test]
    fn fewer_points_hold_the_same_constraints() {
        let (options, context) = (Options::default(), RunContext::with_threads(1).unwrap());
        let (efforts, edge_efforts) = (efforts(&options), edge_efforts(&options));
        let (mut before, mut after) = (0, 0);
        let prisms =
            [(5, 15.0, 8), (12, 8.0, 6), (18, 8.0, 4), (24, 8.0, 6)].map(|(n, turn, m)| twisted_prism(n, turn, m));
        for surface in prisms.into_iter().chain([chazelle(3, 0.1)]) {
            let (facets, mut report) = (&surface.facets, Default::default());
            let start = (&options, EdgeOrder::Ascending);
            let mut mesh = recover(enclosed_mesh(&surface.points), facets, start, &context, &mut report).unwrap();
            let volume = restore_surface(&mut mesh, &options, &context, &mut report).unwrap();
            let volume = remove_steiner_points(&mut mesh, volume, &efforts[2], &context).unwrap();
            let constraints = (mesh.subfaces.clone(), mesh.wings.clone());
            let count = volume.len();
            let left = merge_steiner_points(&mut mesh, volume, (&edge_efforts, &efforts), &context).unwrap();
            assert!(left.len() <= count && left.iter().all(|&v| mesh.has_vertex(v)));
            let points = surface.points.len() + 8;
            let used = (points..mesh.complex.points().len()).filter(|&v| mesh.has_vertex(VertexId::from_index(v)));
            assert_eq!(used.count(), left.len(), "no point but these has tets");
            assert_eq!((&mesh.subfaces, &mesh.wings), (&constraints.0, &constraints.1));
            assert!(mesh.missing_segments().is_empty() && mesh.missing_subfaces().is_empty() && mesh.keeps_faces);
            mesh.complex.check_invariants().unwrap();
            assert!(mesh.complex.finite_tets().all(|tet| mesh.complex.is_positive(tet)));
            (before, after) = (before + count, after + left.len());
        }
        assert!(after < before && after <= 17, "{before} points, {after} afterwards");
    }

    #[test]
    fn a_trial_undoes_what_a_trial_within_kept() {
        let surface = twisted_prism(3, 20.0, 1);
        let mut mesh = ConstrainedMesh::new(enclosed_mesh(&surface.points), &surface.facets);
        let rows = |mesh: &ConstrainedMesh| {
            let mut rows: Vec<_> = mesh.complex.finite_tets().map(|tet| mesh.complex.vertices(tet)).collect();
            rows.iter_mut().for_each(|row| row.sort_unstable());
            rows.sort_unstable();
            rows
        };
        let (before, count) = (rows(&mesh), mesh.complex.points().len());
        mesh.begin_trial();
        for keep in [true, false, true] {
            mesh.begin_trial();
            let inner = rows(&mesh);
            let points = mesh.complex.points().len();
            let place = DVec3::new(0.1, 0.05, 0.3 + 0.1 * points as f64 / count as f64);
            let hint = mesh.complex.tet_of(VertexId(0));
            insert_point(&mut mesh, place, hint).unwrap().unwrap();
            mesh.end_trial(keep).unwrap();
            assert_eq!(rows(&mesh) == inner, !keep);
            if !keep {
                mesh.forget_points(points);
            }
        }
        mesh.end_trial(false).unwrap();
        mesh.forget_points(count);
        assert_eq!(rows(&mesh), before);
        mesh.complex.check_invariants().unwrap();
    }
}
