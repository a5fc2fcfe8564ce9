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

use super::constrained_mesh::ConstrainedMesh;
use crate::error::Result;
use crate::geometry::intersection::segment_meets_triangle;
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
    plan_ring([u, v], mesh, &old, &ring, None)
}

/// Where a span of the ring is cut, and the worst shape that leaves.
#[derive(Clone, Copy)]
struct Cut {
    shape: f64,
    middle: usize,
}

/// The triangulation of the ring with the best worst tet, all positive, without a new face that the segment `aim` meets.
fn plan_ring(
    [u, v]: [VertexId; 2],
    mesh: &ConstrainedMesh,
    old: &[TetId],
    ring: &[VertexId],
    aim: Option<[VertexId; 2]>,
) -> Option<Plan> {
    let n = ring.len();
    if n < 3 {
        return None;
    }
    let met = |face: [VertexId; 3]| {
        aim.is_some_and(|[a, b]| {
            let free = !face.contains(&a) && !face.contains(&b);
            free && segment_meets_triangle(mesh.at(a), mesh.at(b), face.map(|v| mesh.at(v)))
        })
    };
    let none = Cut { shape: 0.0, middle: usize::MAX };
    // best[i * n + k]: the best triangulation of p_i ... p_k.
    let mut best = vec![Cut { shape: f64::INFINITY, middle: 0 }; n * n];
    for length in 2..n {
        for i in 0..n - length {
            let k = i + length;
            let mut found = none;
            let inner = length < n - 1;
            if inner && (met([ring[i], ring[k], u]) || met([ring[i], ring[k], v])) {
                best[i * n + k] = none;
                continue;
            }
            for j in i + 1..k {
                let sides = best[i * n + j].shape.min(best[j * n + k].shape);
                if sides <= found.shape {
                    continue;
                }
                let (p, q, r) = (ring[i], ring[j], ring[k]);
                let mut worst = sides.min(shape(mesh, [p, q, r, v]));
                if worst > found.shape {
                    worst = worst.min(shape(mesh, [p, r, q, u]));
                }
                if worst > found.shape && !met([p, q, r]) {
                    found = Cut { shape: worst, middle: j };
                }
            }
            best[i * n + k] = found;
        }
    }
    if best[n - 1].shape <= 0.0 {
        return None;
    }
    let mut new = Vec::with_capacity(2 * n - 4);
    let mut stack = vec![(0, n - 1)];
    while let Some((i, k)) = stack.pop() {
        if k - i < 2 {
            continue;
        }
        let j = best[i * n + k].middle;
        let (p, q, r) = (ring[i], ring[j], ring[k]);
        new.extend([[p, q, r, v], [p, r, q, u]]);
        stack.extend([(i, j), (j, k)]);
    }
    Some(Plan { old: old.to_vec(), new })
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

/// Changes that may be taken back: of each the rows of the old tets, and the new tets.
#[derive(Debug, Default)]
pub struct Journal(Vec<(Vec<[VertexId; 4]>, Vec<TetId>)>);

impl Journal {
    /// Commits a plan and notes it; false where it is not valid.
    ///
    /// # Errors
    /// As [`TetStore::create_tet`].
    pub fn commit(&mut self, mesh: &mut ConstrainedMesh, plan: &Plan) -> Result<bool> {
        let old: Vec<[VertexId; 4]> = plan.old.iter().map(|&t| mesh.complex.vertices(t)).collect();
        let Some(ids) = mesh.replace(&plan.old, &plan.new)? else { return Ok(false) };
        self.0.push((old, ids));
        Ok(true)
    }

    /// Changes noted so far.
    pub fn mark(&self) -> usize {
        self.0.len()
    }

    /// Takes back all changes after the first `length`. Slots are given out last freed first: in reverse order the old
    /// tets get their old ids, so that what was noted earlier stays valid.
    ///
    /// # Errors
    /// As [`TetStore::create_tet`].
    pub fn take_back(&mut self, mesh: &mut ConstrainedMesh, length: usize) -> Result<()> {
        while self.0.len() > length
            && let Some((mut rows, mut ids)) = self.0.pop()
        {
            rows.reverse();
            ids.reverse();
            mesh.replace(&ids, &rows)?;
        }
        Ok(())
    }
}

/// How far the recursion of an edge removal may go.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reach {
    /// Levels of edges removed to make room.
    pub depth: usize,
    /// Most tets around an edge.
    pub ring: usize,
    /// A segment that new faces keep clear of.
    pub aim: Option<[VertexId; 2]>,
}

/// Removes the edge u v, if need be after removing up to `depth` levels of edges at its ends, with backtracking. `tries`
/// bounds the edges looked at. Where that fails, the mesh is as it was; with an aim, rings may be shorter.
///
/// # Errors
/// As [`TetStore::create_tet`].
pub fn remove_edge(
    mesh: &mut ConstrainedMesh,
    edge: [VertexId; 2],
    reach: Reach,
    tries: &mut usize,
    journal: &mut Journal,
) -> Result<bool> {
    Removal { reach, tries, journal, open: Vec::new(), ball: Vec::new() }.remove(mesh, edge)
}

/// One recursive removal.
struct Removal<'a> {
    reach: Reach,
    tries: &'a mut usize,
    journal: &'a mut Journal,
    /// Edges whose removal is under way, outermost first.
    open: Vec<[VertexId; 2]>,
    ball: Vec<TetId>,
}

impl Removal<'_> {
    fn remove(&mut self, mesh: &mut ConstrainedMesh, [u, v]: [VertexId; 2]) -> Result<bool> {
        if mesh.is_segment(u, v) {
            return Ok(false);
        }
        match find_edge(&mesh.complex, u, v, &mut self.ball) {
            Some(start) => self.remove_at(mesh, start),
            None => Ok(true),
        }
    }

    fn remove_at(&mut self, mesh: &mut ConstrainedMesh, start: ShellTet) -> Result<bool> {
        let row = mesh.complex.vertices(start.tet);
        let (u, v) = (row[start.a], row[start.b]);
        let Some((old, ring)) = ring_from(mesh, start, self.reach.ring) else { return Ok(false) };
        // The shells of nested removals share no tets but the two at the spoke: that ends the recursion early, where it
        // would only turn in a circle.
        let rows = old.iter().map(|&tet| mesh.complex.vertices(tet));
        let taken = |row: &[VertexId; 4]| self.open.iter().any(|edge| edge.iter().all(|v| row.contains(v)));
        if rows.filter(taken).count() > 2 {
            return Ok(false);
        }
        if let Some(plan) = plan_ring([u, v], mesh, &old, &ring, self.reach.aim) {
            return self.journal.commit(mesh, &plan);
        }
        if self.open.len() >= self.reach.depth {
            return Ok(false);
        }
        let n = ring.len();
        for i in 0..n {
            let [before, p, after] = [ring[(i + n - 1) % n], ring[i], ring[(i + 1) % n]];
            // The ring could do without p but for an edge from p to an end that is in the way.
            let at_v = mesh.orient([before, p, after, v]) <= 0.0;
            let at_u = mesh.orient([before, after, p, u]) <= 0.0;
            let end = match (at_u, at_v) {
                (true, false) => u,
                (false, true) => v,
                _ => continue,
            };
            if *self.tries == 0 {
                break;
            }
            if mesh.is_segment(end, p) {
                continue;
            }
            *self.tries -= 1;
            let mark = self.journal.mark();
            let place = |w| mesh.complex.local_vertex(old[i], w);
            let (Some(from), Some(to)) = (place(end), place(p)) else { continue };
            self.open.push([u, v]);
            let removed = self.remove_at(mesh, ShellTet::new(old[i], from, to));
            self.open.pop();
            if !removed? {
                continue;
            }
            if self.remove(mesh, [u, v])? {
                return Ok(true);
            }
            // A shorter ring is progress on the way to a segment, though the edge is still there: later passes start
            // from it, and as no change puts anything new into the way they cannot turn back.
            if self.reach.aim.is_some() {
                return Ok(false);
            }
            self.journal.take_back(mesh, mark)?;
        }
        Ok(false)
    }
}
