//! Recovers edges that constraints lock, with few points in the volume.
//!
//! # Method
//! Segments that turn around each other, as the diagonals of a twisted prism, leave no room for the last of them.
//! ```text
//!     a------c          a b is missing, c d is a segment near it on another plane. A point s between them sees both:
//!      \  s             joined to what is around it, it opens the knot for a b, and often for its neighbours.
//!     d------b
//! ```
//! 1. The missing edge is tried once more: a point for one edge often serves the next ones.
//! 2. Else the segments in and beside the crossed tets are taken, nearest first; s is the middle of the shortest way, or
//!    that of the crossed tets.
//! 3. s is inserted, and the edge recovered by reconnections; where that fails everything is undone.
//! 4. Where no single point serves, the edge is locked in several places, as by the notches of Chazelle's polyhedron, one
//!    behind the other: s stays for a second and a third point, whose places are sought in the mesh with s.
//!
//! # Source
//! [Si2015] for points in the volume between segments that lock each other; the trials with undoing and several points at
//! once: ours.
//!
//! # Invariants
//! Only segments out of the plane of the edge count, so that s keeps off facets between the two. A point that lies
//! exactly on another facet is moved off it when that facet is wanted (`free_face`).

use glam::DVec3;

use super::Effort;
use super::constrained_mesh::{ConstrainedMesh, EdgeKey, FaceKey, edge_key};
use super::crossings::{Crossing, Path, tets_along, trace};
use super::edge_recovery::recover_edge;
use super::steiner_points::insert_point;
use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::predicates::orient3d;
use crate::geometry::segment::squared_distance;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::TET_EDGES;
use crate::mesh::tet_store::TetStore;

/// Places tried for one point; with 8, surfaces with many notches take nearly twice the time and keep as many points.
const MOST_PLACES: usize = 4;
/// Passes over the missing edges.
const MOST_PASSES: usize = 10;
/// Points put in for one edge at once. On Chazelle's polyhedron of 4 to 6 notches 2 leave a tenth fewer points than 1, 3 a
/// sixth in the same time, as fewer edges are split; 4 save a fiftieth more in half as much time again.
const MOST_TOGETHER: usize = 3;
/// Places tried for each point but the last of several; 2 leave a twentieth more points, 4 no fewer.
const FIRST_PLACES: usize = 3;
/// Lines closer than this share of the distance of the segments lie nearly in one plane.
const LEAST_GAP: f64 = 0.05;
/// Share of a segment at its ends that places keep off: a point there makes a short edge.
const END_SHARE: f64 = 0.05;
/// Share of its distance that the middle of the crossed tets counts with: it opens the knot for other edges too, as in twisted
/// prisms. 1 leaves as many points, 2 a tenth more; always first, a few more in long notches.
const MIDDLE_SHARE: f64 = 0.5;
/// Edges looked at after a point was put in place, at first.
const SHORT_TRIES: usize = 20;
/// Edges looked at in later passes: 150 take a tenth more time on Chazelle's polyhedra and leave as many points.
const LONG_TRIES: usize = 50;
/// Halvings of the way by which a point leaves a face.
const MOST_HALVINGS: i32 = 40;

/// Recovers what can be recovered of `missing` with a few points each at most; returns what is still missing.
///
/// # Errors
/// `Cancelled`, `LimitReached`, and those of vertex and tet creation.
pub fn unlock_edges(
    mesh: &mut ConstrainedMesh,
    mut missing: Vec<EdgeKey>,
    effort: &Effort,
    context: &RunContext,
) -> Result<Vec<EdgeKey>> {
    // A point that opens a knot mostly shows it at once; what resists gets the whole effort.
    let short = Effort { tries: effort.tries.min(SHORT_TRIES), tets: 0, everywhere: false, ..*effort };
    // Searches for fillings leave no fewer points.
    let long = Effort { tries: effort.tries.min(LONG_TRIES), tets: 0, ..*effort };
    for pass in 0..MOST_PASSES {
        let before = missing.len();
        let mut left = Vec::new();
        for edge in missing {
            context.check()?;
            let trial = if pass == 0 { &short } else { &long };
            let together = pass.clamp(1, MOST_TOGETHER);
            if !recover_edge(mesh, edge, trial)? && !unlock_edge(mesh, edge, trial, together)? {
                left.push(edge);
            }
        }
        missing = left;
        // A pass that recovers little is not worth another one of its kind.
        if missing.is_empty() || (pass >= MOST_TOGETHER && 10 * (before - missing.len()) < before) {
            break;
        }
    }
    Ok(missing)
}

/// Recovers an edge with so many points at most; whether that worked. Else nothing changes.
fn unlock_edge(mesh: &mut ConstrainedMesh, edge: EdgeKey, effort: &Effort, together: usize) -> Result<bool> {
    let Some(tets) = tets_along(mesh, edge[0], edge[1]) else { return Ok(true) };
    unlock_at(mesh, edge, &places_between(mesh, edge, &tets), (effort, together))
}

/// Recovers an edge with a point at one of the places, and others beside it.
fn unlock_at(
    mesh: &mut ConstrainedMesh,
    edge: EdgeKey,
    places: &[DVec3],
    (effort, together): (&Effort, usize),
) -> Result<bool> {
    let most = if together > 1 { FIRST_PLACES } else { MOST_PLACES };
    for &place in places.iter().take(most) {
        if mesh.cancel.is_cancelled() {
            return Ok(false);
        }
        if together == 1 {
            if let Some(steiner) = insert_to_recover(mesh, place, &[edge], effort)? {
                mesh.volume_points.push(steiner);
                return Ok(true);
            }
        } else if unlock_beside(mesh, edge, place, (effort, together))? {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Puts a point at a place and recovers an edge with it, or with others, whose places are sought then; else nothing changes.
fn unlock_beside(
    mesh: &mut ConstrainedMesh,
    edge: EdgeKey,
    place: DVec3,
    (effort, together): (&Effort, usize),
) -> Result<bool> {
    let count = mesh.complex.points().len();
    mesh.begin_trial();
    let hint = mesh.complex.tet_of(edge[0]);
    let mut is_whole = false;
    if let Some(steiner) = insert_point(mesh, place, hint)? {
        is_whole = recover_edge(mesh, edge, effort)?;
        if !is_whole && let Some(tets) = tets_along(mesh, edge[0], edge[1]) {
            let places = places_between(mesh, edge, &tets);
            is_whole = unlock_at(mesh, edge, &places, (effort, together - 1))?;
        }
        if is_whole {
            mesh.volume_points.push(steiner);
        }
    }
    mesh.end_trial(is_whole)?;
    if !is_whole {
        mesh.forget_points(count);
    }
    Ok(is_whole)
}

/// Puts a point at a place where all of some edges are recovered then; else nothing changes.
///
/// # Errors
/// `LimitReached`, and those of vertex and tet creation.
pub fn insert_to_recover(
    mesh: &mut ConstrainedMesh,
    place: DVec3,
    edges: &[EdgeKey],
    effort: &Effort,
) -> Result<Option<VertexId>> {
    let count = mesh.complex.points().len();
    mesh.begin_trial();
    let hint = mesh.complex.tet_of(edges[0][0]);
    let steiner = insert_point(mesh, place, hint)?;
    let mut is_whole = steiner.is_some();
    for &edge in edges {
        is_whole = is_whole && recover_edge(mesh, edge, effort)?;
    }
    mesh.end_trial(is_whole)?;
    if !is_whole {
        mesh.forget_points(count);
    }
    Ok(steiner.filter(|_| is_whole))
}

/// The middle of the vertices of some tets.
fn middle_of(mesh: &ConstrainedMesh, tets: &[TetId]) -> DVec3 {
    let mut vertices: Vec<VertexId> = tets.iter().flat_map(|&tet| mesh.complex.vertices(tet)).collect();
    vertices.sort_unstable();
    vertices.dedup();
    vertices.retain(|v| !v.is_ghost());
    vertices.iter().map(|&v| mesh.at(v)).sum::<DVec3>() / vertices.len() as f64
}

/// Places between the edge and the segments in and beside the tets, nearest segment first, and the middle of the tets.
fn places_between(mesh: &ConstrainedMesh, edge: EdgeKey, tets: &[TetId]) -> Vec<DVec3> {
    let mut region = tets.to_vec();
    for &tet in tets {
        let others = (0..4).map(|face| mesh.complex.neighbor(TetFace::new(tet, face)));
        region.extend(others.filter(|&other| other != TetFace::NONE).map(TetFace::tet));
    }
    let mut segments: Vec<EdgeKey> = Vec::new();
    for &tet in &region {
        let v = mesh.complex.vertices(tet);
        let keys = TET_EDGES.map(|[i, j]| edge_key(v[i], v[j]));
        segments
            .extend(keys.into_iter().filter(|k| mesh.is_segment(k[0], k[1]) && k.iter().all(|v| !edge.contains(v))));
    }
    segments.sort_unstable();
    segments.dedup();
    let ends = edge.map(|v| mesh.at(v));
    let mut places: Vec<(f64, DVec3)> = Vec::new();
    for segment in segments {
        let others = segment.map(|v| mesh.at(v));
        let [p, q] = closest_points(ends, others);
        let distance = p.distance(q);
        let normal = (ends[1] - ends[0]).cross(others[1] - others[0]).normalize_or_zero();
        if normal.dot(others[0] - ends[0]).abs() > LEAST_GAP * distance {
            places.push((distance, 0.5 * (p + q)));
        }
    }
    let middle = middle_of(mesh, tets);
    places.push((MIDDLE_SHARE * squared_distance(middle, ends[0], ends[1]).sqrt(), middle));
    places.sort_by(|l, r| l.0.total_cmp(&r.0));
    places.truncate(MOST_PLACES);
    places.into_iter().map(|(_, place)| place).collect()
}

/// Nearly the points of two segments that are closest to each other, off the ends.
pub fn closest_points([a, b]: [DVec3; 2], [c, d]: [DVec3; 2]) -> [DVec3; 2] {
    let (u, v, w) = (b - a, d - c, a - c);
    let (uu, uv, vv, uw, vw) = (u.dot(u), u.dot(v), v.dot(v), u.dot(w), v.dot(w));
    let inner = |share: f64| share.clamp(END_SHARE, 1.0 - END_SHARE);
    let determinant = uu * vv - uv * uv;
    let s = if determinant > 0.0 { inner((uv * vw - vv * uw) / determinant) } else { 0.5 };
    let t = inner((uv * s + vw) / vv);
    [a + u * inner((uv * t - uw) / uu), c + v * t]
}

/// Moves points of the volume that lie in a missing face off its plane; whether one was moved.
pub fn free_face(mesh: &mut ConstrainedMesh, face: FaceKey) -> bool {
    let [a, b, c] = face.map(|v| mesh.at(v));
    let normal = (b - a).cross(c - a).normalize_or_zero();
    // A point on the border of the face may be off it by rounding; to move one too many does no harm.
    let slack = DVec3::splat(1e-9 * (b - a).length().max((c - a).length()));
    let (low, high) = (a.min(b).min(c) - slack, a.max(b).max(c) + slack);
    let mut moved = false;
    for vertex in mesh.volume_points.clone() {
        let place = mesh.at(vertex);
        let in_box = (place - low).min_element() >= 0.0 && (high - place).min_element() >= 0.0;
        if in_box && orient3d(a, b, c, place) == 0.0 {
            moved |= leave_plane(mesh, vertex, [a, b, c], normal);
        }
    }
    moved
}

/// Moves points of the volume that lie exactly on a missing edge off the facets at it; whether one was moved.
pub fn free_edge(mesh: &mut ConstrainedMesh, edge: EdgeKey) -> bool {
    let Some(Path::Through(crossings)) = trace(mesh, edge[0], edge[1]) else { return false };
    let thirds = mesh.wings.get(&edge).cloned().unwrap_or_default();
    let [a, b] = edge.map(|v| mesh.at(v));
    let mut moved = false;
    for crossing in crossings {
        let Crossing::Vertex(vertex) = crossing else { continue };
        if mesh.volume_points.contains(&vertex) {
            moved |= thirds.iter().any(|&third| {
                let c = mesh.at(third);
                leave_plane(mesh, vertex, [a, b, c], (b - a).cross(c - a).normalize_or_zero())
            });
        }
    }
    moved
}

/// Moves a free vertex along the normal of a plane, as far as its ball allows; whether it left the plane.
fn leave_plane(mesh: &mut ConstrainedMesh, vertex: VertexId, [a, b, c]: [DVec3; 3], normal: DVec3) -> bool {
    let front = mesh.shape_of(&mesh.ball(vertex)).front;
    if front.iter().flatten().any(|v| v.is_ghost()) {
        return false;
    }
    let place = mesh.at(vertex);
    let faces: Vec<[DVec3; 3]> = front.iter().map(|f| f.map(|v| mesh.at(v))).collect();
    let size = faces.iter().flatten().map(|p| p.distance(place)).fold(0.0, f64::max);
    let ways = (1..MOST_HALVINGS).flat_map(|i| [1.0, -1.0].map(|sign| sign * size * 0.5_f64.powi(i)));
    let sees = |x: DVec3| faces.iter().all(|&[a, b, c]| orient3d(a, b, c, x) > 0.0);
    let free = ways.map(|way| place + normal * way).find(|&x| orient3d(a, b, c, x) != 0.0 && sees(x));
    if let Some(free) = free {
        mesh.complex.set_point(vertex, free);
    }
    free.is_some()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::boundary_recovery::edge_recovery::recover_edges;
    use crate::conforming::boundary_recovery::efforts;
    use crate::conforming::options::Options;
    use crate::conforming::test_meshes::enclosed_mesh;
    use crate::conforming::test_surfaces::{chazelle, twisted_prism};

    /// The Delaunay mesh of a twisted prism in a box of corners, which misses the diagonals of the prism.
    fn knot() -> ConstrainedMesh {
        let surface = twisted_prism(3, 20.0, 1);
        ConstrainedMesh::new(enclosed_mesh(&surface.points), &surface.facets)
    }

    #[test]
    fn locked_edges_are_there_after_points_were_added() {
        let mut mesh = knot();
        let context = RunContext::with_threads(1).unwrap();
        let effort = &efforts(&Options::default())[2];
        let missing = mesh.missing_segments();
        assert!(!missing.is_empty());
        let left = unlock_edges(&mut mesh, missing, effort, &context).unwrap();
        assert_eq!(left, mesh.missing_segments());
        assert!(left.is_empty() && mesh.volume_points.len() <= 3, "{left:?} {:?}", mesh.volume_points);
        mesh.complex.check_invariants().unwrap();
        assert!(mesh.complex.finite_tets().all(|tet| mesh.complex.is_positive(tet)));
    }

    #[test]
    fn an_edge_locked_in_several_places_gets_several_points() {
        let surface = chazelle(4, 0.1);
        let mut mesh = ConstrainedMesh::new(enclosed_mesh(&surface.points), &surface.facets);
        let context = RunContext::with_threads(1).unwrap();
        let effort = Effort { tets: 0, ..efforts(&Options::default())[2] };
        let mut missing = mesh.missing_segments();
        missing = recover_edges(&mut mesh, missing, &effort, &context).unwrap();
        let mut counts = Vec::new();
        for edge in missing {
            for together in 1..=MOST_TOGETHER {
                let (before, points) = (mesh.volume_points.len(), mesh.complex.points().len());
                let is_there = unlock_edge(&mut mesh, edge, &effort, together).unwrap();
                let added = mesh.volume_points.len() - before;
                assert_eq!(is_there, mesh.has_edge(edge[0], edge[1]));
                assert!(added <= together && mesh.complex.points().len() == points + added);
                assert!(mesh.complex.finite_tets().all(|tet| mesh.complex.is_positive(tet)));
                if is_there {
                    counts.push(added);
                    break;
                }
            }
        }
        mesh.complex.check_invariants().unwrap();
        assert!(counts.contains(&2) || counts.contains(&3), "{counts:?}");
    }

    #[test]
    fn an_undone_trial_leaves_the_tets_as_they_were() {
        let mut mesh = knot();
        let rows = |mesh: &ConstrainedMesh| {
            let mut rows: Vec<_> = mesh.complex.finite_tets().map(|tet| (tet, mesh.complex.vertices(tet))).collect();
            rows.iter_mut().for_each(|(_, row)| row.sort_unstable());
            rows
        };
        let (before, count) = (rows(&mesh), mesh.complex.points().len());
        mesh.begin_trial();
        let hint = mesh.complex.tet_of(VertexId(0));
        let steiner = insert_point(&mut mesh, DVec3::new(0.1, 0.05, 0.45), hint).unwrap().unwrap();
        assert_ne!(rows(&mesh), before);
        mesh.end_trial(false).unwrap();
        assert!(mesh.has_vertex(VertexId(0)) && steiner.index() == count);
        mesh.forget_points(count);
        assert_eq!(rows(&mesh), before);
        mesh.complex.check_invariants().unwrap();
    }

    #[test]
    fn a_point_of_the_volume_leaves_a_wanted_face() {
        let mut mesh = knot();
        let corners = [0, 1, 2].map(VertexId);
        let middle = corners.iter().map(|&v| mesh.at(v)).sum::<DVec3>() / 3.0;
        let place = DVec3::new(middle.x, middle.y, mesh.at(corners[0]).z);
        let hint = mesh.complex.tet_of(corners[0]);
        let steiner = insert_point(&mut mesh, place, hint).unwrap().unwrap();
        mesh.volume_points.push(steiner);
        assert!(free_face(&mut mesh, corners));
        assert!(mesh.orient([corners[0], corners[1], corners[2], steiner]) != 0.0);
        assert!(mesh.complex.finite_tets().all(|tet| mesh.complex.is_positive(tet)));
        assert!(!free_face(&mut mesh, corners));
    }

    #[test]
    fn a_point_of_the_volume_leaves_a_wanted_edge() {
        let points = [[-2., 0., 0.], [2., 0., 0.], [0., 2., 1.], [0., -2., 1.], [0., 0., -2.], [0., 0., 0.]];
        let complex = enclosed_mesh(&points.map(DVec3::from_array));
        let facets = [[0, 1, 2], [0, 1, 3], [0, 1, 4]].map(|f| f.map(VertexId));
        let mut mesh = ConstrainedMesh::new(complex, &facets);
        let (edge, middle) = ([VertexId(0), VertexId(1)], VertexId(5));
        let is_on_edge = |mesh: &ConstrainedMesh| match trace(mesh, edge[0], edge[1]) {
            Some(Path::Through(crossings)) => crossings.contains(&Crossing::Vertex(middle)),
            _ => false,
        };
        assert!(is_on_edge(&mesh) && !free_edge(&mut mesh, edge), "a point of the surface stays");
        mesh.volume_points.push(middle);
        assert!(free_edge(&mut mesh, edge) && !is_on_edge(&mesh));
        assert!(mesh.complex.finite_tets().all(|tet| mesh.complex.is_positive(tet)));
        assert!(!free_edge(&mut mesh, edge));
    }

    #[test]
    fn closest_points_of_crossing_lines() {
        let [p, q] = closest_points([-DVec3::X, DVec3::X], [DVec3::new(0.0, -1.0, 1.0), DVec3::new(0.0, 1.0, 1.0)]);
        assert!(p.length() < 1e-12 && (q - DVec3::Z).length() < 1e-12, "{p} {q}");
    }
}
