//! Puts a point on a missing segment in sight of its ends.
//!
//! # Method
//! Flat tets may lie before an end of a segment, in a plane of the surface, where no part of the segment however short is
//! an edge: they are as thin as rounding.
//! 1. The point goes in the middle of the longest way without a crossing. All tets between it and the ends make room for
//!    it, with those that they hide: then it has edges to the ends.
//! 2. Where a constraint is in the way, some of these tets pass behind it:
//! ```text
//!        s                s is the new point, a b edges of the flat tets, g a segment before them by rounding: s sees
//!                         a and not b. The edge a b is split at m, between a and g, and m is moved towards s, away
//!     a--m--g--b          from g: what stands before a then ends at m.
//! ```
//!    The edges that are hidden in part are split and lifted one after the other, until 1 works.
//!
//! # Source
//! [GeorgeBorouchaki2003] for points on constraints; the way through flat tets is ours.

use glam::DVec3;

use super::constrained_mesh::{ConstrainedMesh, EdgeKey, edge_key};
use super::edge_removal::ring_of;
use super::partition_elimination::kernel_point;
use super::steiner_points::{Place, crossed_places, insert_with, locate};
use crate::error::Result;
use crate::geometry::intersection::segment_meets_triangle;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::TET_EDGES;
use crate::mesh::tet_store::TetStore;

/// Edges lifted for one point.
const MOST_LIFTED: usize = 30;
/// Edges above one another, of which the topmost is lifted.
const MOST_ABOVE: usize = 20;
/// Most tets around an edge that is lifted.
const MOST_RING: usize = 60;
/// Share of an edge by which it is lifted at least: far above rounding.
const LEAST_LIFT: f64 = 1e-9;
/// Share of an edge at its ends where it is not split.
const FOOT_SHARE: f64 = 1e-3;

/// Puts a point on a missing segment in sight of its ends; `None` where no point could be inserted: then nothing has changed,
/// as points that were lifted in vain only crowd what the next rounds meet.
///
/// # Errors
/// Those of vertex and tet creation.
pub fn insert_in_sight(mesh: &mut ConstrainedMesh, edge: EdgeKey) -> Result<Option<VertexId>> {
    let (count, lifted) = (mesh.complex.points().len(), mesh.volume_points.len());
    mesh.begin_trial();
    let steiner = insert_lifting(mesh, edge)?;
    mesh.end_trial(steiner.is_some())?;
    if steiner.is_none() {
        mesh.forget_points(count);
        mesh.volume_points.truncate(lifted);
    }
    Ok(steiner)
}

fn insert_lifting(mesh: &mut ConstrainedMesh, [a, b]: EdgeKey) -> Result<Option<VertexId>> {
    for _ in 0..MOST_LIFTED {
        let Some(places) = crossed_places(mesh, [a, b]) else { return Ok(None) };
        // The longest way without a crossing.
        let shares: Vec<f64> = std::iter::once(0.0).chain(places.iter().map(|p| p.0)).chain([1.0]).collect();
        let gap = |i: &usize| shares[i + 1] - shares[*i];
        let Some(widest) = (0..shares.len() - 1).max_by(|i, j| gap(i).total_cmp(&gap(j))) else { return Ok(None) };
        let point = mesh.at(a).lerp(mesh.at(b), 0.5 * (shares[widest] + shares[widest + 1]));
        let hint = mesh.complex.tet_of(a);
        let Some(host) = locate(mesh, point, hint).filter(|&host| !mesh.complex.points_of(host).contains(&point))
        else {
            return Ok(None);
        };
        let mut lifted = None;
        // One end in sight at least, where not both can be.
        for (i, wanted) in [&places[..], &places[..widest], &places[widest..]].into_iter().enumerate() {
            let forced = tets_of(host, wanted);
            if forced.iter().any(|&tet| mesh.complex.is_ghost_tet(tet)) {
                continue;
            }
            match insert_with(mesh, point, forced.clone())? {
                Ok(steiner) => return Ok(Some(steiner)),
                Err(tets) if i == 0 => lifted = lift_hidden(mesh, point, &forced, &tets)?,
                Err(_) => {}
            }
            if lifted.is_some() {
                break;
            }
        }
        let Some(lifted) = lifted else { return Ok(None) };
        mesh.volume_points.push(lifted);
    }
    Ok(None)
}

/// The host of a point and the tets around some crossings, each once.
fn tets_of(host: TetId, places: &[Place]) -> Vec<TetId> {
    let mut tets: Vec<TetId> = std::iter::once(host).chain(places.iter().flat_map(|p| p.1.clone())).collect();
    tets.sort_unstable();
    tets.dedup();
    tets
}

/// Splits an edge of `forced` that a segment of `tets` hides in part from the point, and lifts the new vertex.
fn lift_hidden(mesh: &mut ConstrainedMesh, point: DVec3, forced: &[TetId], tets: &[TetId]) -> Result<Option<VertexId>> {
    let mut region = tets.to_vec();
    for &tet in tets {
        let others = (0..4).map(|face| mesh.complex.neighbor(TetFace::new(tet, face)));
        region.extend(others.filter(|&other| other != TetFace::NONE).map(TetFace::tet));
    }
    let edges_of = |tets: &[TetId], is_segment: bool| {
        let rows = tets.iter().map(|&tet| mesh.complex.vertices(tet));
        let mut edges: Vec<EdgeKey> = rows.flat_map(|v| TET_EDGES.map(|[i, j]| edge_key(v[i], v[j]))).collect();
        edges.retain(|e| !e[1].is_ghost() && mesh.is_segment(e[0], e[1]) == is_segment);
        edges.sort_unstable();
        edges.dedup();
        edges
    };
    let segments = edges_of(&region, true);
    for edge in edges_of(forced, false) {
        let ends = edge.map(|v| mesh.at(v));
        let hides = |segment: &&EdgeKey| {
            let [p, q] = segment.map(|v| mesh.at(v));
            let apart = segment.iter().all(|v| !edge.contains(v));
            apart && p != point && q != point && segment_meets_triangle(p, q, [point, ends[0], ends[1]])
        };
        let mut shares: Vec<f64> = segments
            .iter()
            .filter(hides)
            .map(|segment| hidden_share(point, ends, segment.map(|v| mesh.at(v))))
            .filter(|share| *share > 0.0 && *share < 1.0)
            .collect();
        if shares.is_empty() {
            continue;
        }
        shares.extend([0.0, 1.0]);
        shares.sort_by(f64::total_cmp);
        let walls: Vec<[DVec3; 3]> =
            segments.iter().filter(hides).flat_map(|segment| facets_at(mesh, *segment)).collect();
        for pair in shares.windows(2) {
            let near = ends[0].lerp(ends[1], 0.5 * (pair[0] + pair[1]));
            if walls.iter().any(|wall| segment_meets_triangle(point, near, *wall)) {
                continue; // what ends there still passes behind the segment
            }
            let direction = (point - near).normalize_or_zero();
            let lifted = lift_edge(mesh, edge, (near, direction), &mut Vec::new())?;
            if lifted.is_some() {
                return Ok(lifted);
            }
        }
    }
    Ok(None)
}

/// Splits an edge and moves the new vertex off it, where its ring has most room. Flat tets of the ring leave none: then the
/// edges opposite in these, which lie above it, are lifted instead; the topmost has room.
fn lift_edge(
    mesh: &mut ConstrainedMesh,
    edge: EdgeKey,
    (near, direction): (DVec3, DVec3),
    open: &mut Vec<EdgeKey>,
) -> Result<Option<VertexId>> {
    open.push(edge);
    let Some(ring) = ring_of(mesh, edge, TetId::NONE, MOST_RING) else { return Ok(None) };
    let ring = ring.tets();
    let front = mesh.shape_of(ring).front;
    let faces: Vec<[DVec3; 3]> = front.iter().map(|f| f.map(|v| mesh.at(v))).collect();
    let ends = edge.map(|v| mesh.at(v));
    let start = foot_on_edge(ends, (near, direction));
    let least = LEAST_LIFT * ends[0].distance(ends[1]);
    let place = kernel_point(&faces, start, direction).filter(|x| (*x - start).dot(direction) > least);
    let Some(place) = place else {
        let is_near = |x: DVec3| (x - start).dot(direction).abs() <= least;
        for &tet in ring {
            let row = mesh.complex.vertices(tet);
            let others: Vec<VertexId> = row.into_iter().filter(|v| !edge.contains(v)).collect();
            let opposite = edge_key(others[0], others[1]);
            let is_flat = others.iter().all(|&v| is_near(mesh.at(v)));
            if is_flat
                && open.len() < MOST_ABOVE
                && !open.contains(&opposite)
                && !mesh.is_segment(opposite[0], opposite[1])
            {
                let lifted = lift_edge(mesh, opposite, (near, direction), open)?;
                if lifted.is_some() {
                    return Ok(lifted);
                }
            }
        }
        return Ok(None);
    };
    let count = mesh.complex.points().len();
    let vertex = mesh.complex.push_point(place)?;
    let new: Vec<[VertexId; 4]> = front.iter().map(|&[a, b, c]| [a, b, c, vertex]).collect();
    if !mesh.replace(ring, &new)? {
        mesh.complex.truncate_points(count);
        return Ok(None);
    }
    Ok(Some(vertex))
}

/// The point of an edge next to a line, off the ends; `direction` is a unit vector.
fn foot_on_edge([a, b]: [DVec3; 2], (near, direction): (DVec3, DVec3)) -> DVec3 {
    let across = |v: DVec3| v - direction * direction.dot(v);
    let (along, off) = (across(b - a), across(near - a));
    let share = (along.dot(off) / along.length_squared()).clamp(FOOT_SHARE, 1.0 - FOOT_SHARE);
    a.lerp(b, if share.is_finite() { share } else { 0.5 })
}

/// The parts of facets that are to be at a segment.
fn facets_at(mesh: &ConstrainedMesh, segment: EdgeKey) -> Vec<[DVec3; 3]> {
    let thirds = mesh.wings.get(&segment).map_or(&[][..], Vec::as_slice);
    thirds.iter().map(|&third| [segment[0], segment[1], third].map(|v| mesh.at(v))).collect()
}

/// Where, as a share of the edge, the segment hides it from the point: where the plane of point and segment cuts it.
fn hidden_share(point: DVec3, [a, b]: [DVec3; 2], [p, q]: [DVec3; 2]) -> f64 {
    let normal = (p - point).cross(q - point);
    normal.dot(a - point) / normal.dot(a - b)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::tet_complex::TetComplex;

    #[test]
    fn a_point_in_sight_has_edges_past_a_flat_tet() {
        let flat = 1e-20;
        let points = [[0., 0., 0.], [1., 0., flat], [-1., 1., flat], [-1., -1., flat], [3., 0., 1.]];
        let mut complex = TetComplex::with_points(points.map(DVec3::from_array).to_vec()).unwrap();
        for row in [[1, 3, 2, 0], [1, 2, 3, 4]] {
            complex.create_tet(row.map(VertexId), crate::index::Label(0)).unwrap();
        }
        complex.pair_faces().unwrap();
        let mut mesh = ConstrainedMesh::new(complex, &[]);
        mesh.complex.check_invariants().unwrap();
        assert!(mesh.complex.finite_tets().all(|tet| mesh.complex.is_positive(tet)));
        let [a, b] = [VertexId(0), VertexId(4)];
        assert!(!mesh.has_edge(a, b));
        let steiner = insert_in_sight(&mut mesh, [a, b]).unwrap().unwrap();
        assert!(mesh.has_edge(a, steiner) && mesh.has_edge(steiner, b));
        mesh.complex.check_invariants().unwrap();
        assert!(mesh.complex.finite_tets().all(|tet| mesh.complex.is_positive(tet)));
        assert_eq!(insert_in_sight(&mut mesh, [a, steiner]).unwrap(), None, "nothing lies between");
    }
}
