//! Removes Steiner points from the volume.
//!
//! # Method
//! For each point s, until a pass removes none:
//! 1. the ball is joined to one vertex of its link (contraction), or
//! 2. it is filled on the vertices of its link, or
//! 3. it is filled together with a neighbouring tet, or
//! 4. edges at s are removed by n-m flips, which thins the ball, and 1 and 2 are tried again, or
//! 5. two Steiner points next to each other become one.
//!
//! # Source
//! [Drakopoulos2017] 4.6.2 for 4; [GeorgeBorouchaki2003] for 1; the fillings are ours.

use super::Effort;
use super::cavity_filling::fill_cavity;
use super::constrained_mesh::ConstrainedMesh;
use super::edge_recovery::{contains_edges, grown_cavities};
use super::edge_removal::{Journal, Reach, plan_removal, remove_edge};
use super::partition_elimination::kernel_point;
use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::predicates::orient3d;
use crate::index::{TetId, VertexId};
use crate::mesh::tet_store::TetStore;

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
    for pass in 0.. {
        let before = points.len();
        let mut left = Vec::new();
        for vertex in points {
            context.check()?;
            if !remove_vertex(mesh, vertex, effort)? {
                left.push(vertex);
            }
        }
        points = left;
        if points.is_empty() || (points.len() == before && pass > 0) {
            break;
        }
        for &vertex in &points {
            center(mesh, vertex);
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
    if contract_or_fill(mesh, vertex, effort.steps, &mut budget)? {
        return Ok(true);
    }
    let ball = mesh.ball(vertex);
    if effort.grow && ball.len() <= effort.tets {
        for grown in grown_cavities(mesh, &ball, effort.tets) {
            let shape = mesh.shape_of(&grown);
            if shape.front.iter().any(|f| f.contains(&vertex)) {
                continue;
            }
            mesh.cavities[0] += 1;
            let Some(new) = fill_cavity(&shape.front, &shape.sheets, |v| mesh.at(v), effort.steps, &mut budget) else {
                continue;
            };
            if contains_edges(&new, &shape.segments) && mesh.replace(&grown, &new)? {
                mesh.cavities[1] += 1;
                mesh.complex.set_tet_of(vertex, TetId::NONE);
                return Ok(true);
            }
        }
    }
    thin_ball(mesh, vertex, effort)?;
    budget = budget.max(effort.budget / 2);
    contract_or_fill(mesh, vertex, effort.steps, &mut budget)
}

fn contract_or_fill(mesh: &mut ConstrainedMesh, vertex: VertexId, steps: usize, budget: &mut usize) -> Result<bool> {
    let ball = mesh.ball(vertex);
    let front = mesh.shape_of(&ball).front;
    if front.iter().flatten().any(|&v| v.is_ghost() || v == vertex) {
        return Ok(false);
    }
    let mut targets: Vec<VertexId> = front.iter().flatten().copied().collect();
    targets.sort_unstable();
    targets.dedup();
    for target in targets {
        let cone = front.iter().filter(|f| !f.contains(&target)).map(|&[a, b, c]| [a, b, c, target]);
        let new: Vec<[VertexId; 4]> = cone.collect();
        if mesh.replace(&ball, &new)? {
            mesh.complex.set_tet_of(vertex, TetId::NONE);
            return Ok(true);
        }
    }
    mesh.cavities[0] += 1;
    let Some(new) = fill_cavity(&front, &[], |v| mesh.at(v), steps, budget) else { return Ok(false) };
    if !mesh.replace(&ball, &new)? {
        return Ok(false);
    }
    mesh.cavities[1] += 1;
    mesh.complex.set_tet_of(vertex, TetId::NONE);
    Ok(true)
}

/// Removes edges at the vertex while that shortens its ball.
pub fn thin_ball(mesh: &mut ConstrainedMesh, vertex: VertexId, effort: &Effort) -> Result<()> {
    let mut tries = effort.tries;
    loop {
        let ball = mesh.ball(vertex);
        // Each neighbour with a tet of the edge to it, which stays until something changes: balls may be large.
        let corners = ball.iter().flat_map(|&tet| mesh.complex.vertices(tet).map(|v| (v, tet)));
        let mut link: Vec<(VertexId, TetId)> = corners.filter(|(v, _)| *v != vertex && !v.is_ghost()).collect();
        link.sort_by_key(|(v, _)| *v);
        link.dedup_by_key(|(v, _)| *v);
        let mut thinned = false;
        for (other, tet) in link {
            if let Some(plan) = plan_removal(mesh, [vertex, other], tet, effort.ring) {
                thinned |= mesh.replace(&plan.old, &plan.new)?;
            } else if effort.depth > 0 {
                let reach = Reach { depth: effort.depth.min(2), ring: effort.ring, turn: 0, aim: None };
                thinned |= remove_edge(mesh, ([vertex, other], tet), reach, &mut tries, &mut Journal::default())?;
            }
            if thinned {
                break;
            }
        }
        if !thinned || mesh.ball(vertex).len() >= ball.len() {
            return Ok(());
        }
    }
}
