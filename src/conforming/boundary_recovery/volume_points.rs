//! Recovers edges with few points in the volume, where constraints lock each other.

use super::Effort;
use super::constrained_mesh::{ConstrainedMesh, EdgeKey, FaceKey, edge_key};
use crate::geometry::{intersection::segment_meets_triangle, predicates::orient3d};
use super::crossings::tets_along;
use super::edge_recovery::recover_edge;
use super::steiner_points::insert_point;
use crate::context::RunContext;
use crate::error::Result;
use crate::index::{TetFace, TetId};
use crate::mesh::numbering::TET_EDGES;
use crate::mesh::tet_store::TetStore;
use glam::DVec3;

pub fn unlock_edges(mesh: &mut ConstrainedMesh, missing: Vec<EdgeKey>, effort: &Effort, context: &RunContext) -> Result<Vec<EdgeKey>> {
    let mut left = Vec::new();
    for edge in missing {
        context.check()?;
        if !recover_edge(mesh, edge, effort)? && !unlock_edge(mesh, edge, effort)? {
            left.push(edge);
        }
    }
    Ok(left)
}

fn unlock_edge(mesh: &mut ConstrainedMesh, edge: EdgeKey, effort: &Effort) -> Result<bool> {
    let Some(tets) = tets_along(mesh, edge[0], edge[1]) else { return Ok(true) };
    let mut places = places_for(mesh, edge, &tets);
    let n = std::env::var("NP").ok().and_then(|v| v.parse().ok()).unwrap_or(8);
    places.truncate(n);
    for place in places {
        let count = mesh.complex.points().len();
        mesh.begin_trial();
        let Some(hint) = mesh.ball(edge[0]).first().copied() else { mesh.end_trial(true)?; return Ok(false) };
        let steiner = insert_point(mesh, place, hint)?;
        let recovered = match steiner { Some(_) => recover_edge(mesh, edge, effort)?, None => false };
        mesh.end_trial(recovered)?;
        if let Some(steiner) = steiner {
            if recovered { mesh.volume_points.push(steiner); return Ok(true); }
            mesh.complex.truncate_points(count);
        }
    }
    Ok(false)
}

fn places_for(mesh: &ConstrainedMesh, edge: EdgeKey, tets: &[TetId]) -> Vec<DVec3> {
    let mut region = tets.to_vec();
    for &tet in tets {
        for face in 0..4 {
            let other = mesh.complex.neighbor(TetFace::new(tet, face));
            if other != TetFace::NONE && !mesh.complex.is_ghost_tet(other.tet()) { region.push(other.tet()); }
        }
    }
    let mut segments: Vec<EdgeKey> = Vec::new();
    for &tet in &region {
        let v = mesh.complex.vertices(tet);
        for [i, j] in TET_EDGES {
            let key = edge_key(v[i], v[j]);
            if mesh.is_segment(v[i], v[j]) && !edge.contains(&key[0]) && !edge.contains(&key[1]) { segments.push(key); }
        }
    }
    segments.sort_unstable(); segments.dedup();
    let [a, b] = edge.map(|v| mesh.at(v));
    let mut found: Vec<(f64, DVec3)> = segments.iter().map(|e| {
        let [c, d] = e.map(|v| mesh.at(v));
        let (p, q) = closest(a, b, c, d);
        let normal = (b - a).cross(d - c).normalize_or_zero();
        let gap = normal.dot(c - a).abs();
        let distance = p.distance(q);
        (if gap > 0.05 * distance { distance } else { 0.0 }, 0.5 * (p + q))
    }).filter(|(d, _)| *d > 0.0).collect();
    found.sort_by(|l, r| l.0.total_cmp(&r.0));
    found.into_iter().map(|f| f.1).collect()
}

/// Points of the segments closest to each other.
fn closest(a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> (DVec3, DVec3) {
    let (u, v, w) = (b - a, d - c, a - c);
    let (uu, uv, vv, uw, vw) = (u.dot(u), u.dot(v), v.dot(v), u.dot(w), v.dot(w));
    let det = uu * vv - uv * uv;
    let mut s = if det > 0.0 { ((uv * vw - vv * uw) / det).clamp(0.05, 0.95) } else { 0.5 };
    let t = ((uv * s + vw) / vv).clamp(0.05, 0.95);
    s = ((uv * t - uw) / uu).clamp(0.05, 0.95);
    (a + u * s, c + v * t)
}

/// Moves points of the volume out of a face that is missing; whether one was moved.
pub fn free_face(mesh: &mut ConstrainedMesh, face: FaceKey) -> bool {
    let corners = face.map(|v| mesh.at(v));
    let [a, b, c] = corners;
    let normal = (b - a).cross(c - a).normalize_or_zero();
    let mut moved = false;
    for vertex in mesh.volume_points.clone() {
        let place = mesh.at(vertex);
        if orient3d(a, b, c, place) != 0.0 || !segment_meets_triangle(place - normal, place + normal, corners) {
            continue;
        }
        let front = mesh.shape_of(&mesh.ball(vertex)).front;
        if front.iter().flatten().any(|v| v.is_ghost()) { continue; }
        let faces: Vec<[DVec3; 3]> = front.iter().map(|f| f.map(|v| mesh.at(v))).collect();
        let size = faces.iter().flatten().map(|p| p.distance(place)).fold(0.0, f64::max);
        let steps = (1..40).flat_map(|i| [1.0, -1.0].map(|sign| place + normal * (sign * size * 0.5_f64.powi(i))));
        let sees = |x: DVec3| faces.iter().all(|&[a, b, c]| orient3d(a, b, c, x) > 0.0);
        if let Some(free) = steps.into_iter().find(|&x| orient3d(a, b, c, x) != 0.0 && sees(x)) {
            mesh.complex.set_point(vertex, free);
            moved = true;
        }
    }
    moved
}
