//! Makes missing facets faces of the mesh, without new points, once their edges are there.
//!
//! # Method
//! For a missing face, with the edges that pierce it and the tets around them:
//! 1. Piercing edges are removed by n-m flips, where fewer pierce afterwards.
//! 2. The border of the face cuts the surface of the crossed tets in two; each part is closed by the face and filled.
//! 3. The crossed tets are enlarged by neighbours and filled with the face as a sheet.
//!
//! # Source
//! [GeorgeBorouchaki2003], [Drakopoulos2017] 4.6.1; filling both sides: [LiuChenChen2007].

use rustc_hash::FxHashMap;

use super::Effort;
use super::constrained_mesh::{ConstrainedMesh, EdgeKey, FaceKey, edge_key};
use super::crossings::{FaceCrossing, tets_across};
use super::edge_recovery::{contains_edges, grown_cavities};
use super::edge_removal::{Journal, remove_edge};
use crate::context::RunContext;
use crate::error::Result;
use crate::index::{TetId, VertexId};

/// Recovers what can be recovered of `missing` with one effort; returns what is still missing.
///
/// # Errors
/// `Cancelled`, `LimitReached`, and those of tet creation.
pub fn recover_faces(
    mesh: &mut ConstrainedMesh,
    mut missing: Vec<FaceKey>,
    effort: &Effort,
    context: &RunContext,
) -> Result<Vec<FaceKey>> {
    loop {
        let before = missing.len();
        let mut left = Vec::new();
        for face in missing {
            context.check()?;
            if !recover_face(mesh, face, effort)? {
                left.push(face);
            }
        }
        // A pass that recovers little is not worth another one.
        if left.is_empty() || 10 * (before - left.len()) < before {
            return Ok(left);
        }
        missing = left;
    }
}

/// Recovers one face; false where the effort did not suffice or an edge of it is missing.
///
/// # Errors
/// Those of tet creation.
pub fn recover_face(mesh: &mut ConstrainedMesh, face: FaceKey, effort: &Effort) -> Result<bool> {
    let [a, b, c] = face;
    if [[a, b], [b, c], [a, c]].iter().any(|e| !mesh.has_edge(e[0], e[1])) {
        return Ok(false);
    }
    let Some(mut crossing) = tets_across(mesh, face) else { return Ok(true) };
    let (mut budget, mut tries) = (effort.budget, effort.tries);
    loop {
        if crossing.edges.is_empty() {
            return Ok(false);
        }
        match remove_piercing(mesh, face, &crossing, effort, &mut tries)? {
            None => return Ok(true),
            Some(fewer) if fewer.edges.len() < crossing.edges.len() => crossing = fewer,
            Some(same) => {
                crossing = same;
                break;
            }
        }
    }
    if crossing.tets.is_empty() || crossing.tets.len() > effort.tets {
        return Ok(false);
    }
    if fill_both_sides(mesh, &crossing.tets, face, effort.steps, &mut budget)? {
        return Ok(true);
    }
    if effort.grow {
        for grown in grown_cavities(mesh, &crossing.tets, effort.tets) {
            if fill_with_face(mesh, &grown, face, effort.steps, &mut budget)? {
                return Ok(true);
            }
        }
    }
    Ok(false)
}

/// Removes one piercing edge so that fewer pierce; `None` where the face appeared.
fn remove_piercing(
    mesh: &mut ConstrainedMesh,
    face: FaceKey,
    crossing: &FaceCrossing,
    effort: &Effort,
    tries: &mut usize,
) -> Result<Option<FaceCrossing>> {
    let count = crossing.edges.len();
    let mut journal = Journal::default();
    for &[u, v] in &crossing.edges {
        if !remove_edge(mesh, ([u, v], TetId::NONE), effort.reach(None), tries, &mut journal)? {
            continue;
        }
        match tets_across(mesh, face) {
            None => return Ok(None),
            Some(fewer) if !fewer.edges.is_empty() && fewer.edges.len() < count => return Ok(Some(fewer)),
            Some(_) => journal.take_back(mesh, 0)?,
        }
    }
    Ok(tets_across(mesh, face))
}

/// Fills the union of `tets` on both sides of the face.
fn fill_both_sides(
    mesh: &mut ConstrainedMesh,
    tets: &[TetId],
    face: FaceKey,
    steps: usize,
    budget: &mut usize,
) -> Result<bool> {
    let shape = mesh.shape_of(tets);
    let Some(parts) = split_front(&shape.front, face).filter(|_| shape.sheets.is_empty()) else {
        return fill_with_face(mesh, tets, face, steps, budget);
    };
    let mut new = Vec::new();
    for part in parts {
        mesh.cavities[0] += 1;
        let Some(filled) = mesh.fill(&part, &[], steps, budget) else { return Ok(false) };
        mesh.cavities[1] += 1;
        new.extend(filled);
    }
    Ok(contains_edges(&new, &shape.segments) && mesh.replace(tets, &new)?)
}

fn fill_with_face(
    mesh: &mut ConstrainedMesh,
    tets: &[TetId],
    face: FaceKey,
    steps: usize,
    budget: &mut usize,
) -> Result<bool> {
    let shape = mesh.shape_of(tets);
    let mut sheets = shape.sheets;
    sheets.push(face);
    mesh.cavities[0] += 1;
    let Some(new) = mesh.fill(&shape.front, &sheets, steps, budget) else { return Ok(false) };
    if !contains_edges(&new, &shape.segments) || !mesh.replace(tets, &new)? {
        return Ok(false);
    }
    mesh.cavities[1] += 1;
    Ok(true)
}

/// The two parts of a closed front that the border of `face` separates, each closed by the face; `None` where it does
/// not cut the front in two.
pub fn split_front(front: &[[VertexId; 3]], face: FaceKey) -> Option<[Vec<[VertexId; 3]>; 2]> {
    let [a, b, c] = face;
    let border = [edge_key(a, b), edge_key(b, c), edge_key(a, c)];
    let mut parts = parts_of_front(front, &border, [a, b])?;
    parts[0].push([b, a, c]);
    parts[1].push([a, b, c]);
    Some(parts)
}

/// The faces of a closed front on the two sides of a cycle of edges: first those on the side of the face that has the
/// edge `along`, one of the cycle, in this direction; `None` where the cycle does not cut the front in two.
pub fn parts_of_front(
    front: &[[VertexId; 3]],
    cycle: &[EdgeKey],
    along: [VertexId; 2],
) -> Option<[Vec<[VertexId; 3]>; 2]> {
    let mut at_edge: FxHashMap<EdgeKey, Vec<usize>> = FxHashMap::default();
    for (i, &[x, y, z]) in front.iter().enumerate() {
        for key in [edge_key(x, y), edge_key(y, z), edge_key(x, z)] {
            at_edge.entry(key).or_default().push(i);
        }
    }
    let directed = |[x, y, z]: [VertexId; 3], u: VertexId, v: VertexId| [[x, y], [y, z], [z, x]].contains(&[u, v]);
    let [from, to] = along;
    let mut seen = vec![false; front.len()];
    let mut parts = [Vec::new(), Vec::new()];
    for (part, (u, v)) in parts.iter_mut().zip([(from, to), (to, from)]) {
        let seed = *at_edge.get(&edge_key(from, to))?.iter().find(|&&i| directed(front[i], u, v))?;
        if std::mem::replace(&mut seen[seed], true) {
            return None;
        }
        let mut stack = vec![seed];
        while let Some(i) = stack.pop() {
            part.push(front[i]);
            let [x, y, z] = front[i];
            for key in [edge_key(x, y), edge_key(y, z), edge_key(x, z)] {
                if cycle.contains(&key) {
                    continue;
                }
                for &j in &at_edge[&key] {
                    if !std::mem::replace(&mut seen[j], true) {
                        stack.push(j);
                    }
                }
            }
        }
    }
    seen.iter().all(|&s| s).then_some(parts)
}
