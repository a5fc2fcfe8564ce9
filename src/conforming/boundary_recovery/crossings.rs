//! What lies in the way of a missing edge or face.
//!
//! # Method
//! 1. An edge a b is crossed by the tets whose closed faces the open segment meets: they are collected from the balls of
//!    its ends over the faces it meets, with exact tests. A segment through an edge of the mesh collects its whole shell.
//! 2. The same way as a sequence of faces and edges (`trace`): its length measures how far an edge is from being there.
//! 3. A face whose edges exist is crossed by the tets around the edges of the mesh that pierce it: a tet that meets the
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
use crate::mesh::topology::{ShellTet, collect_shell};

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

/// Steps of a walk around a vertex before its whole ball is looked at.
const MOST_WALK: usize = 200;

/// One thing that the open segment between two vertices passes through.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Crossing {
    /// The inside of a face.
    Face(TetFace),
    /// The inside of an edge, from vertex to vertex; a tet that has it.
    Edge(TetId, [VertexId; 2]),
    /// A vertex.
    Vertex(VertexId),
}

/// The way of a segment through the mesh.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Path {
    /// The mesh has the edge.
    Present,
    /// What it passes through, in order.
    Through(Vec<Crossing>),
}

impl Path {
    /// Things passed through.
    pub fn crossing_count(&self) -> usize {
        match self {
            Self::Present => 0,
            Self::Through(crossings) => crossings.len(),
        }
    }
}

/// What the open segment a b passes through first after a; the way is at most one crossing long, and `None` where the
/// walk loses its way.
pub fn first_crossing(mesh: &ConstrainedMesh, [a, b]: [VertexId; 2]) -> Option<Path> {
    if let Some(tet) = tet_toward(mesh, [a, b]) {
        return match mesh.complex.local_vertex(tet, b) {
            Some(_) => Some(Path::Present),
            None => exit_of(mesh, tet, [a, b], &[a]).map(|crossing| Path::Through(vec![crossing])),
        };
    }
    let ball = mesh.ball(a);
    if ball.iter().any(|&tet| mesh.complex.local_vertex(tet, b).is_some()) {
        return Some(Path::Present);
    }
    ball.iter().find_map(|&tet| exit_of(mesh, tet, [a, b], &[a])).map(|crossing| Path::Through(vec![crossing]))
}

/// The tet at a that the segment a b enters or lies on, by a walk from tet to tet around a: balls may be large. `None`
/// where the walk meets the hull or does not end.
fn tet_toward(mesh: &ConstrainedMesh, [a, b]: [VertexId; 2]) -> Option<TetId> {
    let mut tet = mesh.complex.tet_of(a).some()?;
    let mut came_from = TetFace::NONE;
    for step in 0..MOST_WALK {
        let v = mesh.complex.vertices(tet);
        if v.iter().any(|v| v.is_ghost()) {
            return None;
        }
        if v.contains(&b) {
            return Some(tet);
        }
        // Faces in turns: a fixed order can walk in a circle.
        let exit = (0..4).map(|i| TetFace::new(tet, (i + step) % 4)).find(|&side| {
            let [x, y, z] = TET_FACES[side.face()].map(|i| v[i]);
            side != came_from && v[side.face()] != a && mesh.orient([x, y, z, b]) > 0.0
        });
        let Some(side) = exit else { return Some(tet) };
        came_from = mesh.complex.neighbor(side);
        if came_from == TetFace::NONE {
            return None;
        }
        tet = came_from.tet();
    }
    None
}

/// Follows the open segment a b from feature to feature; `None` where the walk loses its way.
pub fn trace(mesh: &ConstrainedMesh, a: VertexId, b: VertexId) -> Option<Path> {
    let mut found = Vec::new();
    let mut candidates = tet_toward(mesh, [a, b]).map_or_else(|| mesh.ball(a), |tet| vec![tet]);
    let mut entry: Vec<VertexId> = vec![a];
    if candidates.iter().any(|&tet| mesh.complex.local_vertex(tet, b).is_some()) {
        return Some(Path::Present);
    }
    loop {
        let crossing = candidates.iter().find_map(|&tet| exit_of(mesh, tet, [a, b], &entry))?;
        found.push(crossing);
        if found.len() > MOST_TETS {
            return None;
        }
        match crossing {
            Crossing::Face(side) => {
                entry = mesh.complex.face_vertices(side).to_vec();
                candidates = vec![mesh.complex.neighbor(side).tet()];
            }
            Crossing::Edge(tet, [u, v]) => {
                entry = vec![u, v];
                let place = |w| mesh.complex.local_vertex(tet, w);
                let start = ShellTet::new(tet, place(u)?, place(v)?);
                let mut shell = Vec::new();
                collect_shell(&mesh.complex, start, MOST_TETS, &mut shell);
                candidates = shell.iter().map(|s| s.tet).collect();
            }
            Crossing::Vertex(v) => {
                entry = vec![v];
                candidates = mesh.ball(v);
            }
        }
        if candidates.iter().any(|&tet| mesh.complex.local_vertex(tet, b).is_some()) {
            return Some(Path::Through(found));
        }
    }
}

/// Where the segment leaves a tet that it enters through the vertices of `entry`; `None` where it does not pass.
fn exit_of(mesh: &ConstrainedMesh, tet: TetId, [a, b]: [VertexId; 2], entry: &[VertexId]) -> Option<Crossing> {
    let v = mesh.complex.vertices(tet);
    if v.iter().any(|v| v.is_ghost()) {
        return None;
    }
    for (face, corners) in TET_FACES.iter().enumerate() {
        let [x, y, z] = corners.map(|i| v[i]);
        if entry.iter().all(|e| [x, y, z].contains(e)) {
            continue;
        }
        // The segment has to leave through the face: a inside of its plane, b outside.
        if mesh.orient([x, y, z, b]) <= 0.0 || mesh.orient([x, y, z, a]) >= 0.0 {
            continue;
        }
        let signs = [[x, y], [y, z], [z, x]].map(|[s, t]| mesh.orient([a, b, s, t]));
        if signs.iter().any(|s| *s > 0.0) && signs.iter().any(|s| *s < 0.0) {
            continue;
        }
        let side = TetFace::new(tet, face);
        return Some(match signs.map(|s| s == 0.0) {
            [false, false, false] => Crossing::Face(side),
            [true, false, false] => Crossing::Edge(tet, [x, y]),
            [false, true, false] => Crossing::Edge(tet, [y, z]),
            [false, false, true] => Crossing::Edge(tet, [z, x]),
            [true, true, _] => Crossing::Vertex(y),
            [_, true, true] => Crossing::Vertex(z),
            [true, _, true] => Crossing::Vertex(x),
        });
    }
    None
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
