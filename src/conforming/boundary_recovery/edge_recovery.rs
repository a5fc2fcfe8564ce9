//! Makes missing edges of the surface edges of the mesh, without new points.
//!
//! # Method
//! For a missing edge a b, with the tets it crosses:
//! 1. Their union is filled anew so that it contains the edge: a filling that contains any face a b p does, so each
//!    vertex p of the union is tried as a sheet (`cavity_filling`).
//! 2. Crossed faces and edges are removed by 2-3 and n-m flips where fewer tets are crossed afterwards; then 1 again.
//! 3. The union is enlarged by neighbours, one at a time and all at once, and filled.
//!
//! Efforts grow from pass to pass; passes go on while they recover edges.
//!
//! # Source
//! [GeorgeHechtSaltel1991], [GeorgeBorouchaki2003], [Drakopoulos2017] 4.6.1; filling the crossed tets: ours.

use super::Effort;
use super::cavity_filling::fill_cavity;
use super::constrained_mesh::{ConstrainedMesh, EdgeKey, edge_key};
use super::crossings::tets_along;
use super::edge_removal::{plan_flip_23, plan_removal, remove_edge};
use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::intersection::segment_meets_triangle;
use crate::geometry::segment::squared_distance;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::tet_store::TetStore;

/// Recovers what can be recovered of `missing` with one effort; returns what is still missing.
///
/// # Errors
/// `Cancelled`, `LimitReached`, and those of tet creation.
pub fn recover_edges(
    mesh: &mut ConstrainedMesh,
    mut missing: Vec<EdgeKey>,
    effort: &Effort,
    context: &RunContext,
) -> Result<Vec<EdgeKey>> {
    loop {
        let before = missing.len();
        let mut left = Vec::new();
        for edge in missing {
            context.check()?;
            if !recover_edge(mesh, edge, effort)? {
                left.push(edge);
            }
        }
        // A pass that recovers little is not worth another one.
        if left.is_empty() || 10 * (before - left.len()) < before {
            return Ok(left);
        }
        missing = left;
    }
}

/// Recovers one edge; false where the effort did not suffice.
///
/// # Errors
/// Those of tet creation.
pub fn recover_edge(mesh: &mut ConstrainedMesh, [a, b]: EdgeKey, effort: &Effort) -> Result<bool> {
    let Some(mut tets) = tets_along(mesh, a, b) else { return Ok(true) };
    let (mut budget, mut tries) = (effort.budget, effort.tries);
    loop {
        if tets.is_empty() {
            return Ok(false);
        }
        if tets.len() <= effort.tets && fill_with_edge(mesh, &tets, [a, b], effort.steps, &mut budget)? {
            return Ok(true);
        }
        match shorten(mesh, [a, b], tets.len(), effort, &mut tries)? {
            None => return Ok(true),
            Some(shorter) if shorter.len() < tets.len() => tets = shorter,
            Some(same) => {
                tets = same;
                break;
            }
        }
    }
    if !effort.grow || tets.is_empty() || tets.len() > effort.tets {
        return Ok(false);
    }
    for grown in grown_cavities(mesh, &tets, effort.tets) {
        if fill_with_edge(mesh, &grown, [a, b], effort.steps, &mut budget)? {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Fills the union of `tets` so that it contains the edge.
fn fill_with_edge(
    mesh: &mut ConstrainedMesh,
    tets: &[TetId],
    [a, b]: EdgeKey,
    steps: usize,
    budget: &mut usize,
) -> Result<bool> {
    let shape = mesh.shape_of(tets);
    let mut vertices: Vec<VertexId> = shape.front.iter().flatten().copied().collect();
    vertices.sort_unstable();
    vertices.dedup();
    vertices.retain(|&v| v != a && v != b && !v.is_ghost());
    let (pa, pb) = (mesh.at(a), mesh.at(b));
    let distance = |v: VertexId| squared_distance(mesh.at(v), pa, pb);
    vertices.sort_by(|&l, &r| distance(l).total_cmp(&distance(r)).then(l.cmp(&r)));
    for &p in &vertices {
        if cuts_front(mesh, &shape.front, [a, b, p]) {
            continue;
        }
        let mut sheets = shape.sheets.clone();
        sheets.push([a, b, p]);
        mesh.cavities[0] += 1;
        let Some(new) = fill_cavity(&shape.front, &sheets, |v| mesh.at(v), steps, budget) else { continue };
        if contains_edges(&new, &shape.segments) && mesh.replace(tets, &new)?.is_some() {
            mesh.cavities[1] += 1;
            return Ok(true);
        }
    }
    Ok(false)
}

/// Whether an edge of the front passes through the face: then no filling contains it.
fn cuts_front(mesh: &ConstrainedMesh, front: &[[VertexId; 3]], face: [VertexId; 3]) -> bool {
    let corners = face.map(|v| mesh.at(v));
    front.iter().any(|&[x, y, z]| {
        [[x, y], [y, z], [z, x]].iter().any(|[u, v]| {
            // Every edge of a closed front is met once in each direction: one of them is enough.
            u < v && !face.contains(u) && !face.contains(v) && {
                segment_meets_triangle(mesh.at(*u), mesh.at(*v), corners)
            }
        })
    })
}

/// Whether every edge is an edge of a tet.
pub fn contains_edges(tets: &[[VertexId; 4]], edges: &[EdgeKey]) -> bool {
    edges.iter().all(|edge| tets.iter().any(|tet| edge.iter().all(|v| tet.contains(v))))
}

/// Commits a change; keeps it where fewer tets are crossed (`Some(None)`: the edge is there) and takes it back otherwise.
fn tried(
    mesh: &mut ConstrainedMesh,
    [a, b]: EdgeKey,
    old: &[TetId],
    new: &[[VertexId; 4]],
    count: usize,
) -> Result<Option<Option<Vec<TetId>>>> {
    let rows: Vec<[VertexId; 4]> = old.iter().map(|&t| mesh.complex.vertices(t)).collect();
    let Some(ids) = mesh.replace(old, new)? else { return Ok(None) };
    match tets_along(mesh, a, b) {
        None => Ok(Some(None)),
        Some(tets) if !tets.is_empty() && tets.len() < count => Ok(Some(Some(tets))),
        Some(_) => {
            mesh.replace(&ids, &rows)?;
            Ok(None)
        }
    }
}

/// Removes one crossed face or edge so that fewer than `count` tets are crossed; `None` where the edge appeared.
fn shorten(
    mesh: &mut ConstrainedMesh,
    [a, b]: EdgeKey,
    count: usize,
    effort: &Effort,
    tries: &mut usize,
) -> Result<Option<Vec<TetId>>> {
    let Some(tets) = tets_along(mesh, a, b) else { return Ok(None) };
    let mut faces: Vec<[VertexId; 3]> = Vec::new();
    for &tet in &tets {
        for face in 0..4 {
            let side = TetFace::new(tet, face);
            let other = mesh.complex.neighbor(side);
            if other != TetFace::NONE && side.0 < other.0 && tets.contains(&other.tet()) {
                faces.push(mesh.complex.face_vertices(side));
            }
        }
    }
    let mut edges: Vec<EdgeKey> =
        faces.iter().flat_map(|&[x, y, z]| [edge_key(x, y), edge_key(y, z), edge_key(x, z)]).collect();
    edges.sort_unstable();
    edges.dedup();
    for face in faces {
        let Some(side) = mesh.find_face(super::constrained_mesh::face_key(face)) else { continue };
        let Some(plan) = plan_flip_23(mesh, side) else { continue };
        if let Some(result) = tried(mesh, [a, b], &plan.old, &plan.new, count)? {
            return Ok(result);
        }
    }
    for [u, v] in edges {
        if let Some(plan) = plan_removal(mesh, u, v, effort.ring) {
            if let Some(result) = tried(mesh, [a, b], &plan.old, &plan.new, count)? {
                return Ok(result);
            }
        } else if effort.depth > 0 && *tries > 0 && remove_edge(mesh, [u, v], effort.depth, effort.ring, tries)? {
            match tets_along(mesh, a, b) {
                None => return Ok(None),
                Some(shorter) if !shorter.is_empty() && shorter.len() < count => return Ok(Some(shorter)),
                Some(_) => {}
            }
        }
    }
    Ok(tets_along(mesh, a, b))
}

/// The union with one more neighbour each, then with all of them, as far as `limit` allows.
pub fn grown_cavities(mesh: &ConstrainedMesh, tets: &[TetId], limit: usize) -> Vec<Vec<TetId>> {
    let mut neighbors: Vec<TetId> = Vec::new();
    for &tet in tets {
        for face in 0..4 {
            let side = TetFace::new(tet, face);
            let other = mesh.complex.neighbor(side);
            if other == TetFace::NONE || mesh.is_subface(side) {
                continue;
            }
            let beyond = other.tet();
            if !tets.contains(&beyond) && !neighbors.contains(&beyond) && !mesh.complex.is_ghost_tet(beyond) {
                neighbors.push(beyond);
            }
        }
    }
    let mut grown: Vec<Vec<TetId>> = Vec::new();
    if tets.len() < limit {
        for &neighbor in &neighbors {
            grown.push(tets.iter().copied().chain([neighbor]).collect());
        }
    }
    if tets.len() + neighbors.len() <= limit && neighbors.len() > 1 {
        grown.push(tets.iter().copied().chain(neighbors).collect());
    }
    grown
}
