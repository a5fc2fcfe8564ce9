//! What lies in the way of a missing edge or face.
//!
//! # Method
//! 1. An edge a b is crossed by the tets whose closed faces the open segment meets: they are collected from the balls of
//!    its ends over the faces it meets, with exact tests. A segment through an edge of the mesh collects its whole shell.
//! 2. A face whose edges exist is crossed by the tets around the edges of the mesh that pierce it: a tet that meets the
//!    inside of the face has such an edge, as the face's border meets no tet. They are collected from the shell of one
//!    edge of the face.
//!
//! # Source
//! [GeorgeHechtSaltel1991].

use rustc_hash::FxHashSet;

use super::constrained_mesh::{ConstrainedMesh, EdgeKey, FaceKey, edge_key};
use crate::geometry::intersection::{segment_meets_triangle, segment_pierces_triangle};
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::{TET_EDGES, TET_FACES};
use crate::mesh::tet_store::TetStore;

/// Crossed tets beyond which a search gives up: such an edge is split instead.
const MOST_TETS: usize = 20_000;

/// The tets that the open segment a b crosses; `None` where the mesh has the edge; empty where they cannot be told.
pub fn tets_along(mesh: &ConstrainedMesh, a: VertexId, b: VertexId) -> Option<Vec<TetId>> {
    let (pa, pb) = (mesh.at(a), mesh.at(b));
    let face_met = |tet: TetId, face: usize| {
        let v = mesh.complex.vertices(tet);
        let corners = TET_FACES[face].map(|i| v[i]);
        !corners.iter().any(|c| c.is_ghost()) && segment_meets_triangle(pa, pb, corners.map(|c| mesh.at(c)))
    };
    let mut found: Vec<TetId> = Vec::new();
    let mut seen: FxHashSet<TetId> = FxHashSet::default();
    for tet in mesh.ball(a) {
        if mesh.complex.is_ghost_tet(tet) {
            continue;
        }
        if mesh.complex.local_vertex(tet, b).is_some() {
            return None;
        }
        let Some(local) = mesh.complex.local_vertex(tet, a) else { continue };
        if face_met(tet, local) && seen.insert(tet) {
            found.push(tet);
        }
    }
    let mut next = 0;
    while next < found.len() {
        let tet = found[next];
        next += 1;
        for face in 0..4 {
            let other = mesh.complex.neighbor(TetFace::new(tet, face));
            if other == TetFace::NONE || seen.contains(&other.tet()) || mesh.complex.is_ghost_tet(other.tet()) {
                continue;
            }
            let beyond = other.tet();
            let at_end = |end: VertexId| mesh.complex.local_vertex(beyond, end);
            let crossed = match (at_end(a), at_end(b)) {
                (Some(_), _) => false, // those at a were tested above
                (_, Some(local)) => face_met(beyond, local),
                (None, None) => {
                    let has_end = TET_FACES[face].iter().any(|&i| {
                        let v = mesh.complex.vertices(tet)[i];
                        v == a || v == b
                    });
                    !has_end && face_met(tet, face)
                }
            };
            if crossed {
                seen.insert(beyond);
                found.push(beyond);
            }
        }
        if found.len() > MOST_TETS {
            return Some(Vec::new());
        }
    }
    Some(found)
}

/// What crosses a face whose edges the mesh has.
#[derive(Debug, Default)]
pub struct FaceCrossing {
    /// The tets whose inside meets the face.
    pub tets: Vec<TetId>,
    /// The edges that pierce it.
    pub edges: Vec<EdgeKey>,
}

/// The crossing of a face; `None` where the mesh has the face; empty where it cannot be told.
pub fn tets_across(mesh: &mut ConstrainedMesh, face: FaceKey) -> Option<FaceCrossing> {
    if mesh.find_face(face).is_some() {
        return None;
    }
    let corners = face.map(|v| mesh.at(v));
    let mut crossing = FaceCrossing::default();
    let mut seen_tets: FxHashSet<TetId> = FxHashSet::default();
    let mut seen_edges: FxHashSet<EdgeKey> = FxHashSet::default();
    let mut stack: Vec<EdgeKey> = Vec::new();
    let add_edges = |mesh: &ConstrainedMesh, tet: TetId, seen: &mut FxHashSet<EdgeKey>, stack: &mut Vec<EdgeKey>| {
        let v = mesh.complex.vertices(tet);
        if v.iter().any(|v| v.is_ghost()) {
            return;
        }
        for [i, j] in TET_EDGES {
            let key = edge_key(v[i], v[j]);
            if key.iter().any(|v| face.contains(v)) || !seen.insert(key) {
                continue;
            }
            if segment_pierces_triangle(mesh.at(key[0]), mesh.at(key[1]), corners) {
                stack.push(key);
            }
        }
    };
    for vertex in face {
        for tet in mesh.ball(vertex) {
            add_edges(mesh, tet, &mut seen_edges, &mut stack);
        }
        if !stack.is_empty() {
            break;
        }
    }
    while let Some(edge) = stack.pop() {
        crossing.edges.push(edge);
        for tet in mesh.ball(edge[0]) {
            if mesh.complex.local_vertex(tet, edge[1]).is_some() && seen_tets.insert(tet) {
                crossing.tets.push(tet);
                add_edges(mesh, tet, &mut seen_edges, &mut stack);
            }
        }
        if crossing.tets.len() > MOST_TETS {
            return Some(FaceCrossing::default());
        }
    }
    Some(crossing)
}
