//! Recovers an edge that flips cannot, with points in the volume only.
//!
//! # Method
//! 1. A point s is put on the missing edge a b, where it crosses the mesh, and the parts a s and s b are recovered, by
//!    flips or in the same way again. Only these two edges are wanted: no facet is split.
//! 2. s is taken off the edge at once. Its ball is filled on its own vertices so that it contains a b, or else
//! ```text
//!        p                p           two vertices p and q of the link that have edges to a and to b are chosen. The
//!      / | \            /   \         faces a b p and a b q cut the ball in two; each half is filled on its own
//!    a---s---b   ->   a-------b       vertices or joined to a new point beside s that sees its whole boundary.
//!      \ | /            \   /
//!        q                q
//! ```
//!    Such a point exists close to s: s sees the link strictly, and the two half spaces of the faces share directions.
//! 3. Where that fails the ball is thinned by removing edges at s, and 2 is tried again.
//!
//! # Source
//! [GeorgeBorouchaki2003] for points beside the edge instead of on it; [Si2015] for points in the volume before points on
//! the boundary; cutting the ball along two faces: ours.
//!
//! # Limits
//! Where a point cannot be taken off the edge, the segment counts as split, and `partition_elimination` tries again.

use rustc_hash::FxHashSet;

use super::Effort;
use super::constrained_mesh::{ConstrainedMesh, EdgeKey, edge_key};
use super::edge_recovery::{fill_with_edge, recover_edge};
use super::face_recovery::parts_of_front;
use super::partition_elimination::kernel_point;
use super::sight_insertion::insert_in_sight;
use super::steiner_points::insert_on_segment;
use super::steiner_removal::{remove_vertex, thin_ball};
use crate::context::RunContext;
use crate::error::Result;
use crate::index::{TetId, VertexId};
use crate::mesh::tet_store::TetStore;

/// Levels of points on parts of one edge.
const DEPTH: usize = 6;
/// Steps of one search for a filling.
const FILL_STEPS: usize = 150;
/// Steps of all searches for one point; 2500 leave no fewer points.
const FILL_BUDGET: usize = 1000;

/// What became of an edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Bridge {
    /// The mesh has the edge.
    Present,
    /// A point stays on the edge; its parts are in the mesh or not.
    Split(VertexId),
    /// No point could be put on it.
    Missing,
}

/// Recovers the edge with points in the volume, which are appended to `volume`.
///
/// # Errors
/// `Cancelled`, `LimitReached`, and those of vertex and tet creation.
pub fn bridge_edge(
    mesh: &mut ConstrainedMesh,
    edge: EdgeKey,
    effort: &Effort,
    volume: &mut Vec<VertexId>,
    context: &RunContext,
) -> Result<Bridge> {
    bridge(mesh, edge, DEPTH, effort, volume, context)
}

/// Splits the edge where its parts have most chance to be edges, after [`bridge_edge`] split it in vain.
///
/// # Errors
/// As [`bridge_edge`].
pub fn split_in_sight(mesh: &mut ConstrainedMesh, edge: EdgeKey) -> Result<Bridge> {
    Ok(insert_in_sight(mesh, edge)?.map_or(Bridge::Missing, Bridge::Split))
}

fn bridge(
    mesh: &mut ConstrainedMesh,
    edge: EdgeKey,
    depth: usize,
    effort: &Effort,
    volume: &mut Vec<VertexId>,
    context: &RunContext,
) -> Result<Bridge> {
    context.check()?;
    if recover_edge(mesh, edge, effort)? {
        return Ok(Bridge::Present);
    }
    if depth == 0 {
        return Ok(Bridge::Missing);
    }
    let Some(steiner) = insert_on_segment(mesh, edge)? else { return Ok(Bridge::Missing) };
    let parts = edge.map(|end| edge_key(end, steiner));
    let mut complete = true;
    for part in parts {
        complete &= bridge(mesh, part, depth - 1, effort, volume, context)? == Bridge::Present;
        if !complete {
            break;
        }
        mesh.wings.insert(part, Vec::new());
    }
    for part in parts {
        mesh.wings.remove(&part);
    }
    if complete {
        if take_off(mesh, steiner, edge, volume)? {
            return Ok(Bridge::Present);
        }
        thin_between(mesh, steiner, parts, effort)?;
        if take_off(mesh, steiner, edge, volume)? {
            return Ok(Bridge::Present);
        }
    }
    if depth < DEPTH {
        // A part of a larger edge: its point goes, or becomes one of the volume beside the edge.
        if !remove_vertex(mesh, steiner, effort)? {
            volume.push(steiner);
        }
        return Ok(Bridge::Missing);
    }
    Ok(Bridge::Split(steiner))
}

fn thin_between(mesh: &mut ConstrainedMesh, steiner: VertexId, parts: [EdgeKey; 2], effort: &Effort) -> Result<()> {
    for part in parts {
        mesh.wings.insert(part, Vec::new());
    }
    let result = thin_ball(mesh, steiner, effort);
    for part in parts {
        mesh.wings.remove(&part);
    }
    result
}

/// Takes a point off the edge between two neighbours of it, so that the mesh has the edge; false where no way was found.
fn take_off(
    mesh: &mut ConstrainedMesh,
    steiner: VertexId,
    [a, b]: EdgeKey,
    volume: &mut Vec<VertexId>,
) -> Result<bool> {
    let ball = mesh.ball(steiner);
    if ball.iter().any(|&tet| mesh.complex.is_ghost_tet(tet)) {
        return Ok(false);
    }
    let mut budget = FILL_BUDGET;
    if fill_with_edge(mesh, &ball, [a, b], FILL_STEPS, &mut budget)? {
        mesh.complex.set_tet_of(steiner, TetId::NONE);
        return Ok(true);
    }
    let front = mesh.shape_of(&ball).front;
    let mut edges: FxHashSet<EdgeKey> = FxHashSet::default();
    for &[x, y, z] in &front {
        edges.extend([edge_key(x, y), edge_key(y, z), edge_key(x, z)]);
    }
    let mut pages: Vec<VertexId> = front.iter().flatten().copied().filter(|&v| v != a && v != b).collect();
    pages.sort_unstable();
    pages.dedup();
    pages.retain(|&v| edges.contains(&edge_key(a, v)) && edges.contains(&edge_key(b, v)));
    let mut fillings: Vec<(usize, Vec<[VertexId; 4]>, Vec<glam::DVec3>)> = Vec::new();
    for (i, &p) in pages.iter().enumerate() {
        for &q in &pages[i + 1..] {
            let Some(parts) = cut_front(&front, [a, b], [p, q]) else { continue };
            if let Some((tets, points)) = fill_parts(mesh, steiner, &parts, [a, b], &mut budget) {
                fillings.push((points.len(), tets, points));
            }
        }
    }
    fillings.sort_by_key(|f| f.0);
    for (_, mut tets, points) in fillings {
        let count = mesh.complex.points().len();
        let mut added = Vec::with_capacity(points.len());
        for point in points {
            added.push(mesh.complex.push_point(point)?);
        }
        // Rows with the placeholder of a point get its vertex.
        for row in &mut tets {
            for v in row.iter_mut() {
                if v.0 >= PLACEHOLDER {
                    *v = added[(v.0 - PLACEHOLDER) as usize];
                }
            }
        }
        if mesh.replace(&ball, &tets)? {
            mesh.complex.set_tet_of(steiner, TetId::NONE);
            volume.extend(added);
            return Ok(true);
        }
        mesh.complex.truncate_points(count);
    }
    Ok(false)
}

/// Ids from here on stand for the new points of a filling.
const PLACEHOLDER: u32 = u32::MAX - 16;

type Filling = (Vec<[VertexId; 4]>, Vec<glam::DVec3>);

/// Fills the halves of a ball: each on its own vertices or with one point.
fn fill_parts(
    mesh: &mut ConstrainedMesh,
    steiner: VertexId,
    parts: &[Vec<[VertexId; 3]>; 2],
    edge: EdgeKey,
    budget: &mut usize,
) -> Option<Filling> {
    let (mut tets, mut points) = (Vec::new(), Vec::new());
    for part in parts {
        if let Some(filled) = mesh.fill(part, &[], FILL_STEPS, budget) {
            tets.extend(filled);
            continue;
        }
        let faces: Vec<_> = part.iter().map(|f| f.map(|v| mesh.at(v))).collect();
        let closing = part.iter().zip(&faces).filter(|(f, _)| edge.iter().all(|v| f.contains(v)));
        let inward = closing.map(|(_, [a, b, c])| (b - a).cross(c - a).normalize_or_zero()).sum();
        let place = kernel_point(&faces, mesh.at(steiner), inward)?;
        let vertex = VertexId(PLACEHOLDER + points.len() as u32);
        points.push(place);
        tets.extend(part.iter().map(|&[a, b, c]| [a, b, c, vertex]));
    }
    Some((tets, points))
}

/// The two parts of a closed front that the cycle a p b q separates, each closed by the faces a b p and a b q; `None`
/// where it does not cut the front in two.
fn cut_front(front: &[[VertexId; 3]], [a, b]: EdgeKey, pages: [VertexId; 2]) -> Option<[Vec<[VertexId; 3]>; 2]> {
    let border: Vec<EdgeKey> = pages.iter().flat_map(|&p| [edge_key(a, p), edge_key(b, p)]).collect();
    let [p, q] = pages;
    // The half on the left of a -> p is closed by p a b, and has q on its other border; the other half mirrored.
    let mut parts = parts_of_front(front, &border, [a, p])?;
    parts[0].extend([[p, a, b], [a, q, b]]);
    parts[1].extend([[a, p, b], [q, a, b]]);
    Some(parts)
}
