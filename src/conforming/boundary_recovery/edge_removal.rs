//! Removes an edge: the n-m flip over all triangulations of its ring, and its recursive form; the 2-3 flip.
//!
//! # Method
//! ```text
//!        v                 The n tets around u v have the ring p0 ... pn-1. Every triangulation of the ring's
//!      / | \               polygon gives 2 (n - 2) tets: each triangle with u and with v. The best one, by the
//!    p0--+--p2             worst tet, is found for all ring intervals from short to long. It exists only where
//!      \ | /               all its tets are positive.
//!        u                 Where there is none, the recursive form removes an edge from u or v to the ring, which
//!                          shortens the ring, and tries again.
//! ```
//! # Source
//! [GeorgeBorouchaki2003] and [Shewchuk2002] for the removal over triangulations of the ring; [Drakopoulos2017] 4.5.3 for
//! the recursive form.

use super::constrained_mesh::{ConstrainedMesh, edge_key};
use crate::error::Result;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::TET_FACES;
use crate::mesh::tet_store::TetStore;
use crate::mesh::topology::{ShellKind, ShellTet, collect_shell, find_edge};

/// Tets to be replaced, and what replaces them.
#[derive(Debug, Clone, Default)]
pub struct Plan {
    /// Live tets.
    pub old: Vec<TetId>,
    /// Rows of the new ones, positive.
    pub new: Vec<[VertexId; 4]>,
}

/// Six times the volume over the cube of the root mean square edge: positive only for a positive tet.
pub fn shape(mesh: &ConstrainedMesh, tet: [VertexId; 4]) -> f64 {
    let volume = mesh.orient(tet);
    if volume <= 0.0 {
        return volume.min(0.0);
    }
    let [a, b, c, d] = tet.map(|v| mesh.at(v));
    let squares = [a - b, b - c, c - a, a - d, b - d, c - d].map(|e| e.length_squared());
    let mean = squares.iter().sum::<f64>() / 6.0;
    // A positive tet stays positive where the quotient underflows.
    (volume / (mean * mean.sqrt())).max(f64::MIN_POSITIVE)
}

/// The ring of an edge and its tets; `None` where the edge does not exist, lies on the hull or has more than `limit`.
pub fn ring_of(mesh: &ConstrainedMesh, u: VertexId, v: VertexId, limit: usize) -> Option<(Vec<TetId>, Vec<VertexId>)> {
    let start = find_edge(&mesh.complex, u, v, &mut Vec::new())?;
    ring_from(mesh, start, limit)
}

fn ring_from(mesh: &ConstrainedMesh, start: ShellTet, limit: usize) -> Option<(Vec<TetId>, Vec<VertexId>)> {
    let mut shell = Vec::new();
    if collect_shell(&mesh.complex, start, limit, &mut shell) != ShellKind::Closed {
        return None;
    }
    let ring: Vec<VertexId> = shell.iter().map(|s| mesh.complex.vertices(s.tet)[s.c]).collect();
    if ring.iter().any(|v| v.is_ghost()) {
        return None;
    }
    Some((shell.iter().map(|s| s.tet).collect(), ring))
}

/// The best removal of the edge u v, or `None` where it is a constraint or cannot be removed alone.
pub fn plan_removal(mesh: &ConstrainedMesh, u: VertexId, v: VertexId, limit: usize) -> Option<Plan> {
    if mesh.is_segment(u, v) {
        return None;
    }
    let (old, ring) = ring_of(mesh, u, v, limit)?;
    let n = ring.len();
    if n < 3 {
        return None;
    }
    let pair = |i: usize, j: usize, k: usize| {
        let (p, q, r) = (ring[i], ring[j], ring[k]);
        shape(mesh, [p, q, r, v]).min(shape(mesh, [p, r, q, u]))
    };
    // best[i * n + k]: worst shape of the best triangulation of p_i ... p_k, and its middle vertex.
    let mut best = vec![(f64::INFINITY, 0_usize); n * n];
    for length in 2..n {
        for i in 0..n - length {
            let k = i + length;
            let mut found = (0.0, usize::MAX);
            for j in i + 1..k {
                let sides = best[i * n + j].0.min(best[j * n + k].0);
                if sides > found.0 {
                    let worst = sides.min(pair(i, j, k));
                    if worst > found.0 {
                        found = (worst, j);
                    }
                }
            }
            best[i * n + k] = found;
        }
    }
    if best[n - 1].0 <= 0.0 {
        return None;
    }
    let mut new = Vec::with_capacity(2 * n - 4);
    let mut stack = vec![(0, n - 1)];
    while let Some((i, k)) = stack.pop() {
        if k - i < 2 {
            continue;
        }
        let j = best[i * n + k].1;
        let (p, q, r) = (ring[i], ring[j], ring[k]);
        new.extend([[p, q, r, v], [p, r, q, u]]);
        stack.extend([(i, j), (j, k)]);
    }
    Some(Plan { old, new })
}

/// The 2-3 flip of a side, or `None` where the face is a constraint or the flip is not valid.
pub fn plan_flip_23(mesh: &ConstrainedMesh, side: TetFace) -> Option<Plan> {
    let other = mesh.complex.neighbor(side);
    if other == TetFace::NONE || mesh.is_subface(side) {
        return None;
    }
    let (p, q) = (mesh.complex.apex(side), mesh.complex.apex(other));
    if p.is_ghost() || q.is_ghost() {
        return None;
    }
    let v = mesh.complex.vertices(side.tet());
    let [x, y, z] = TET_FACES[side.face()].map(|i| v[i]);
    let new = vec![[p, q, x, y], [p, q, y, z], [p, q, z, x]];
    if v.iter().any(|v| v.is_ghost()) || new.iter().any(|&tet| mesh.orient(tet) <= 0.0) {
        return None;
    }
    Some(Plan { old: vec![side.tet(), other.tet()], new })
}

/// Removes the edge u v, if need be after removing up to `depth` levels of edges at its ends. `tries` bounds the work.
///
/// # Errors
/// As [`TetStore::create_tet`].
pub fn remove_edge(
    mesh: &mut ConstrainedMesh,
    [u, v]: [VertexId; 2],
    depth: usize,
    limit: usize,
    tries: &mut usize,
) -> Result<bool> {
    if mesh.is_segment(u, v) {
        return Ok(false);
    }
    loop {
        if let Some(plan) = plan_removal(mesh, u, v, limit) {
            return Ok(mesh.replace(&plan.old, &plan.new)?.is_some());
        }
        if depth == 0 || *tries == 0 {
            return Ok(false);
        }
        let Some((_, ring)) = ring_of(mesh, u, v, 4 * limit) else { return Ok(!mesh.has_edge(u, v)) };
        let mut shortened = false;
        'ring: for &p in &ring {
            for end in [u, v] {
                if *tries == 0 {
                    break 'ring;
                }
                *tries -= 1;
                let key = edge_key(end, p);
                if !mesh.is_segment(end, p) && remove_edge(mesh, key, depth - 1, limit, tries)? {
                    shortened = true;
                    break 'ring;
                }
            }
        }
        if !shortened {
            return Ok(false);
        }
        if !mesh.has_edge(u, v) {
            return Ok(true);
        }
    }
}
