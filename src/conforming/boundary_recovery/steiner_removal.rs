//! Removes Steiner points from the volume.
//!
//! # Method
//! For each point s, until passes remove none:
//! 1. the ball is joined to one vertex of its link (contraction), which may be another Steiner point, or
//! 2. it is filled on the vertices of its link, where it is small, or
//! 3. it is filled together with neighbouring tets, or
//! 4. edges at s are removed by n-m flips, which thins the ball, and 1 to 3 are tried again.
//!
//! # Source
//! [Drakopoulos2017] 4.6.2 for 4; [GeorgeBorouchaki2003] for 1; the fillings are ours.

use super::Effort;
use super::constrained_mesh::ConstrainedMesh;
use super::edge_recovery::{contains_edges, grown_cavities};
use super::edge_removal::{Journal, Reach, remove_edge};
use super::partition_elimination::kernel_point;
use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::predicates::orient3d;
use crate::index::{TetId, VertexId};
use crate::mesh::tet_store::TetStore;

/// Levels of recursion of the removal of one edge at a point: 5 instead of 2 leave a fifth fewer points, 8 no fewer.
const THINNING_DEPTH: usize = 5;
/// Edges looked at for it.
const THINNING_TRIES: usize = 50;
/// Edges looked at for the whole ball, times the tries of the effort: balls of hundreds of tets would take all the time.
const THINNING_SHARE: usize = 5;
/// Passes in a row without a point removed; each starts where the last one left the balls, and elsewhere on rings.
const MOST_FRUITLESS: usize = 2;

/// Removes what can be removed of `points`; returns what stays, ascending.
///
/// # Errors
/// `Cancelled`, `LimitReached`, and those of tet creation.
pub fn remove_steiner_points(
    mesh: &mut ConstrainedMesh,
    mut points: Vec<VertexId>,
    effort: &Effort,
    context: &RunContext,
) -> Result<Vec<VertexId>> {
    let all = points.clone();
    let mut fruitless = 0;
    for turn in 0.. {
        let effort = &Effort { turn, ..*effort };
        let before = points.len();
        let mut left = Vec::new();
        for vertex in points {
            context.check()?;
            if mesh.has_vertex(vertex) && !remove_vertex(mesh, vertex, effort)? {
                left.push(vertex);
            }
        }
        points = left;
        // A cavity that was enlarged for one point may have swallowed another.
        points.retain(|&vertex| mesh.has_vertex(vertex));
        fruitless = if points.len() < before { 0 } else { fruitless + 1 };
        if points.is_empty() || fruitless == MOST_FRUITLESS {
            break;
        }
        for &vertex in &points {
            center(mesh, vertex);
        }
    }
    for vertex in all {
        if !mesh.has_vertex(vertex) {
            mesh.complex.set_tet_of(vertex, TetId::NONE);
        }
    }
    Ok(points)
}

/// Moves a free vertex to the depth of its ball.
pub fn center(mesh: &mut ConstrainedMesh, vertex: VertexId) {
    let front = mesh.shape_of(&mesh.ball(vertex)).front;
    let faces: Vec<_> = front.iter().map(|f| f.map(|v| mesh.at(v))).collect();
    let old = mesh.at(vertex);
    if let Some(place) = kernel_point(&faces, old, glam::DVec3::ZERO)
        && faces.iter().all(|&[a, b, c]| orient3d(a, b, c, place) > 0.0)
    {
        mesh.complex.set_point(vertex, place);
    }
}

/// Removes one free vertex; false where no way was found.
///
/// # Errors
/// Those of tet creation.
pub fn remove_vertex(mesh: &mut ConstrainedMesh, vertex: VertexId, effort: &Effort) -> Result<bool> {
    let mut budget = effort.budget;
    let ball = mesh.ball(vertex);
    let front = mesh.shape_of(&ball).front;
    if contract(mesh, vertex, &ball, &front)? {
        return Ok(true);
    }
    // A search grows fast with the ball: large ones are thinned first.
    let (is_small, is_medium) = (3 * ball.len() <= 2 * effort.tets, ball.len() <= effort.tets);
    if (is_medium && fill_ball(mesh, vertex, &ball, &front, effort.steps, &mut budget)?)
        || (is_small && effort.grow && fill_grown(mesh, vertex, &ball, effort, &mut budget)?)
    {
        return Ok(true);
    }
    thin_ball(mesh, vertex, effort)?;
    budget = budget.max(effort.budget / 2);
    let thinned = mesh.ball(vertex);
    let front = mesh.shape_of(&thinned).front;
    Ok(contract(mesh, vertex, &thinned, &front)?
        || fill_ball(mesh, vertex, &thinned, &front, effort.steps, &mut budget)?
        || (effort.grow && !is_small && fill_grown(mesh, vertex, &thinned, effort, &mut budget)?))
}

/// Fills the ball of a vertex, enlarged by neighbours, on the other vertices.
fn fill_grown(
    mesh: &mut ConstrainedMesh,
    vertex: VertexId,
    ball: &[TetId],
    effort: &Effort,
    budget: &mut usize,
) -> Result<bool> {
    for grown in grown_cavities(mesh, ball, effort.tets) {
        let shape = mesh.shape_of(&grown);
        if shape.front.iter().any(|f| f.contains(&vertex)) {
            continue;
        }
        mesh.cavities[0] += 1;
        let Some(new) = mesh.fill(&shape.front, &shape.sheets, effort.steps, budget) else {
            continue;
        };
        if (effort.yields || contains_edges(&new, &shape.segments)) && mesh.replace(&grown, &new)? {
            mesh.cavities[1] += 1;
            mesh.complex.set_tet_of(vertex, TetId::NONE);
            return Ok(true);
        }
    }
    Ok(false)
}

/// Fills the ball of a vertex on the other vertices.
fn fill_ball(
    mesh: &mut ConstrainedMesh,
    vertex: VertexId,
    ball: &[TetId],
    front: &[[VertexId; 3]],
    steps: usize,
    budget: &mut usize,
) -> Result<bool> {
    if front.iter().flatten().any(|&v| v.is_ghost() || v == vertex) {
        return Ok(false);
    }
    mesh.cavities[0] += 1;
    let Some(new) = mesh.fill(front, &[], steps, budget) else { return Ok(false) };
    if !mesh.replace(ball, &new)? {
        return Ok(false);
    }
    mesh.cavities[1] += 1;
    mesh.complex.set_tet_of(vertex, TetId::NONE);
    Ok(true)
}

/// Joins the front of the ball of a vertex to one vertex of it, which that vertex moves to.
fn contract(mesh: &mut ConstrainedMesh, vertex: VertexId, ball: &[TetId], front: &[[VertexId; 3]]) -> Result<bool> {
    if front.iter().flatten().any(|&v| v.is_ghost() || v == vertex) {
        return Ok(false);
    }
    let mut targets: Vec<VertexId> = front.iter().flatten().copied().collect();
    targets.sort_unstable();
    targets.dedup();
    let mut new: Vec<[VertexId; 4]> = Vec::with_capacity(front.len());
    for target in targets {
        new.clear();
        new.extend(front.iter().filter(|f| !f.contains(&target)).map(|&[a, b, c]| [a, b, c, target]));
        if mesh.replace(ball, &new)? {
            mesh.complex.set_tet_of(vertex, TetId::NONE);
            return Ok(true);
        }
    }
    Ok(false)
}

/// Removes edges at the vertex while that shortens its ball.
///
/// # Errors
/// Those of tet creation.
pub fn thin_ball(mesh: &mut ConstrainedMesh, vertex: VertexId, effort: &Effort) -> Result<()> {
    let mut total = THINNING_SHARE * effort.tries;
    loop {
        let ball = mesh.ball(vertex);
        // Each neighbour with a tet of the edge to it, which may be gone by then: balls may be large.
        let corners = ball.iter().flat_map(|&tet| mesh.complex.vertices(tet).map(|v| (v, tet)));
        let mut link: Vec<(VertexId, TetId)> = corners.filter(|(v, _)| *v != vertex && !v.is_ghost()).collect();
        link.sort_by_key(|(v, _)| *v);
        link.dedup_by_key(|(v, _)| *v);
        for (other, tet) in link {
            if mesh.cancel.is_cancelled() {
                return Ok(());
            }
            // What is around an edge that lost its tet has changed: the next round has it anew, or it is gone.
            if !mesh.complex.is_live(tet) || mesh.complex.local_vertex(tet, other).is_none() {
                continue;
            }
            let mut tries = total.min(THINNING_TRIES);
            let before = tries;
            let depth = effort.depth.min(THINNING_DEPTH);
            let reach = Reach { depth, ring: effort.ring, turn: effort.turn, yields: effort.yields, aim: None };
            remove_edge(mesh, ([vertex, other], tet), reach, &mut tries, &mut Journal::default())?;
            total -= before - tries;
        }
        // A round that removes little is not worth another one.
        if 10 * mesh.ball(vertex).len() > 9 * ball.len() {
            return Ok(());
        }
    }
}
