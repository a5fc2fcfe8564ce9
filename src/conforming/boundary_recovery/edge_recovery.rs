//! Makes missing edges of the surface edges of the mesh, without new points.
//!
//! # Method
//! For a missing edge a b, in a pass of one effort:
//! 1. What the segment passes through first, seen from a and then from b, is removed by 2-3 and n-m flips, as long as
//!    that works. No flip puts a new face into the way, so that what shortens a ring is kept even where the removal
//!    fails: the next pass starts from there.
//! 2. With an effort that looks everywhere, any crossing is removed where fewer are left afterwards.
//! 3. The union of the crossed tets is filled anew so that it contains the edge: a filling that contains any face a b p
//!    does, so each vertex p of the union is tried as a sheet (`cavity_filling`). The union is enlarged by neighbours,
//!    one at a time and all at once.
//!
//! Efforts grow from pass to pass; passes go on while they recover edges.
//!
//! # Source
//! [GeorgeHechtSaltel1991], [GeorgeBorouchaki2003], [Drakopoulos2017] 4.6.1; [Si2015] for starting at the ends and for
//! keeping shorter rings; filling the crossed tets: ours.

use super::Effort;
use super::constrained_mesh::{ConstrainedMesh, EdgeKey, edge_key};
use super::crossings::{Crossing, Path, first_crossing, tets_along, trace};
use super::edge_removal::{Journal, Plan, plan_flip_23, remove_edge};
use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::intersection::segment_meets_triangle;
use crate::geometry::segment::squared_distance;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::TET_FACES;
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
    let mut tries = effort.tries;
    let mut budget = effort.budget;
    if clear_from_ends(mesh, [a, b], effort, &mut tries)? {
        return Ok(true);
    }
    if effort.everywhere {
        let Some(mut path) = trace(mesh, a, b) else { return Ok(false) };
        while let Path::Through(crossings) = &path {
            match shorten(mesh, [a, b], crossings.len(), effort, &mut tries)? {
                Some(shorter) => path = shorter,
                None => break,
            }
        }
        if path == Path::Present {
            return Ok(true);
        }
    }
    if effort.tets == 0 {
        return Ok(false);
    }
    let Some(tets) = tets_along(mesh, a, b) else { return Ok(true) };
    if tets.is_empty() || tets.len() > effort.tets {
        return Ok(false);
    }
    if fill_with_edge(mesh, &tets, [a, b], effort.steps, &mut budget)? {
        return Ok(true);
    }
    if effort.grow {
        for grown in grown_cavities(mesh, &tets, effort.tets) {
            if fill_with_edge(mesh, &grown, [a, b], effort.steps, &mut budget)? {
                return Ok(true);
            }
        }
    }
    Ok(false)
}

/// Fills the union of `tets` so that it contains the edge.
pub fn fill_with_edge(
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
        let Some(new) = mesh.fill(&shape.front, &sheets, steps, budget) else { continue };
        if contains_edges(&new, &shape.segments) && mesh.replace(tets, &new)? {
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

/// Removes the first thing that the segment passes through, again and again, from both ends; whether the edge is there.
fn clear_from_ends(mesh: &mut ConstrainedMesh, [a, b]: EdgeKey, effort: &Effort, tries: &mut usize) -> Result<bool> {
    for ends in [[a, b], [b, a]] {
        loop {
            let crossing = match first_crossing(mesh, ends) {
                Some(Path::Present) => return Ok(true),
                Some(Path::Through(crossings)) => crossings[0],
                None => break,
            };
            if !clear_crossing(mesh, crossing, ends, effort, tries)? {
                break;
            }
        }
    }
    Ok(false)
}

/// Removes one crossing; no change puts anything new into the way.
fn clear_crossing(
    mesh: &mut ConstrainedMesh,
    crossing: Crossing,
    ends: [VertexId; 2],
    effort: &Effort,
    tries: &mut usize,
) -> Result<bool> {
    let mut journal = Journal::default();
    for attempt in attempts_at(mesh, crossing, ends) {
        let changed = match attempt {
            Attempt::Flip(plan) => journal.commit(mesh, &plan)?,
            Attempt::Remove(edge, hint) => {
                remove_edge(mesh, (edge, hint), effort.reach(Some(ends)), tries, &mut journal)?
            }
        };
        if changed {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Removes a crossed face or edge so that fewer than `count` things are crossed; `None` (and no change) where none can be.
fn shorten(
    mesh: &mut ConstrainedMesh,
    [a, b]: EdgeKey,
    count: usize,
    effort: &Effort,
    tries: &mut usize,
) -> Result<Option<Path>> {
    let mut journal = Journal::default();
    for position in 0..count {
        if mesh.cancel.is_cancelled() {
            return Ok(None);
        }
        // Anew each time: an attempt that was taken back has other tet ids.
        let Some(Path::Through(crossings)) = trace(mesh, a, b) else { return Ok(None) };
        let Some(&crossing) = crossings.get(position) else { return Ok(None) };
        for attempt in attempts_at(mesh, crossing, [a, b]) {
            let changed = match attempt {
                Attempt::Flip(plan) => journal.commit(mesh, &plan)?,
                Attempt::Remove(edge, hint) => {
                    remove_edge(mesh, (edge, hint), effort.reach(Some([a, b])), tries, &mut journal)?
                }
            };
            if !changed {
                if journal.mark() > 0 {
                    // The edge has a shorter ring now: a later pass starts from there, unless more is crossed.
                    match trace(mesh, a, b) {
                        Some(path) if path.crossing_count() < count => return Ok(Some(path)),
                        Some(path) if path.crossing_count() == count => journal = Journal::default(),
                        _ => journal.take_back(mesh, 0)?,
                    }
                    break;
                }
                continue;
            }
            match trace(mesh, a, b) {
                Some(path) if path.crossing_count() < count => return Ok(Some(path)),
                _ => journal.take_back(mesh, 0)?,
            }
        }
    }
    Ok(None)
}

/// One way to get rid of a crossing.
enum Attempt {
    Flip(Plan),
    Remove(EdgeKey, TetId),
}

/// The 2-3 flip of a crossed face, or the removal of the edges that stand in its way; the removal of a crossed edge.
fn attempts_at(mesh: &ConstrainedMesh, crossing: Crossing, aim: [VertexId; 2]) -> Vec<Attempt> {
    let side = match crossing {
        Crossing::Edge(tet, [u, v]) => return vec![Attempt::Remove(edge_key(u, v), tet)],
        Crossing::Vertex(_) => return Vec::new(),
        Crossing::Face(side) => side,
    };
    let mut attempts = Vec::new();
    if let Some(plan) = plan_flip_23(mesh, side, Some(aim)) {
        attempts.push(Attempt::Flip(plan));
    }
    let any = !attempts.is_empty();
    let (p, q) = (mesh.complex.apex(side), mesh.complex.apex(mesh.complex.neighbor(side)));
    let v = mesh.complex.vertices(side.tet());
    if q.is_ghost() {
        return Vec::new();
    }
    let [x, y, z] = TET_FACES[side.face()].map(|i| v[i]);
    let edges = [[x, y], [y, z], [z, x]].into_iter().filter(|&[s, t]| any || mesh.orient([p, q, s, t]) <= 0.0);
    attempts.extend(edges.map(|[s, t]| Attempt::Remove(edge_key(s, t), side.tet())));
    attempts
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
