//! Removes an edge: the n-m flip over all triangulations of its ring, and its recursive form; the 2-3 flip.
//!
//! # Method
//! ```text
//!        v                 The n tets around u v have the ring p0 ... pn-1. Every triangulation of the ring's
//!      / | \               polygon gives 2 (n - 2) tets: each triangle with u and with v. The best one, by the
//!    p0--+--p2             worst tet, is found for all ring intervals from short to long. It exists only where
//!      \ | /               all its tets are positive.
//!        u                 Where there is none, the ring is shortened by 2-3 flips of its faces, and the recursive
//!                          form removes an edge from u or v to the ring; then all is tried again.
//! ```
//! Within the recursion, the removal of the edge from u to p makes the outer ring shorter only where the two tets that
//! both shells share become one: v has to be an ear of the inner ring. So the inner removal is planned with that ear.
//! # Source
//! [GeorgeBorouchaki2003] and [Shewchuk2002] for the removal over triangulations of the ring; [Drakopoulos2017] 4.5.3 for
//! the recursive form, [Si2015] for shortening rings and for shells that share two tets at most.

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
    let ears = ears_of(mesh, [u, v], &ring);
    plan_ring([u, v], mesh, &old, (&ring, &ears), (None, None))
}

/// For each vertex p of the ring of u v, with its neighbours o and q, whether the tets o p q v and o q p u are positive.
fn ears_of(mesh: &ConstrainedMesh, [u, v]: [VertexId; 2], ring: &[VertexId]) -> Vec<[bool; 2]> {
    let n = ring.len();
    let ear = |i: usize| {
        let (o, p, q) = (ring[(i + n - 1) % n], ring[i], ring[(i + 1) % n]);
        [mesh.orient([o, p, q, v]) > 0.0, mesh.orient([o, q, p, u]) > 0.0]
    };
    (0..n).map(ear).collect()
}

/// Where a span of the ring is cut, and the worst shape that leaves.
#[derive(Clone, Copy)]
struct Cut {
    shape: f64,
    middle: usize,
}

/// Whether the segment `aim` meets a face that has none of its ends.
fn meets_aim(mesh: &ConstrainedMesh, aim: Option<[VertexId; 2]>, face: [VertexId; 3]) -> bool {
    aim.is_some_and(|[a, b]| {
        let free = !face.contains(&a) && !face.contains(&b);
        free && segment_meets_triangle(mesh.at(a), mesh.at(b), face.map(|v| mesh.at(v)))
    })
}

/// The triangulation of the ring with the best worst tet, all positive, without a new face that the segment `aim` meets;
/// with the triangle at the vertex `ear` and its two neighbours. `ears` is that of [`ears_of`].
fn plan_ring(
    [u, v]: [VertexId; 2],
    mesh: &ConstrainedMesh,
    old: &[TetId],
    (ring, ears): (&[VertexId], &[[bool; 2]]),
    (aim, ear): (Option<[VertexId; 2]>, Option<VertexId>),
) -> Option<Plan> {
    let n = ring.len();
    // Every triangulation of a polygon has two ears, and a triangle three.
    let (valid, wanted) = (ears.iter().filter(|ear| **ear == [true; 2]).count(), if n == 3 { 3 } else { 2 });
    let ear_at = ear.map(|ear| ring.iter().position(|&p| p == ear));
    if n < 3 || valid < wanted || ear_at.is_some_and(|at| at.is_none_or(|at| ears[at] != [true; 2])) {
        return None;
    }
    let met = |face: [VertexId; 3]| meets_aim(mesh, aim, face);
    let from = usize::from(ear.is_some());
    let rotated: Vec<VertexId>;
    let ring = match ear_at.flatten() {
        Some(at) => {
            rotated = ring[at..].iter().chain(&ring[..at]).copied().collect();
            &rotated
        }
        None => ring,
    };
    let none = Cut { shape: 0.0, middle: usize::MAX };
    // best[i * n + k]: the best triangulation of p_i ... p_k.
    let mut best = vec![Cut { shape: f64::INFINITY, middle: 0 }; n * n];
    for length in 2..n {
        for i in from..n - length {
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
    if best[from * n + n - 1].shape <= 0.0 {
        return None;
    }
    let mut new = Vec::with_capacity(2 * n - 4);
    if from == 1 {
        let (p, q, r) = (ring[0], ring[1], ring[n - 1]);
        if met([p, q, r]) {
            return None;
        }
        new.extend([[p, q, r, v], [p, r, q, u]]);
    }
    let mut stack = vec![(from, n - 1)];
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

/// The 2-3 flip of a side, or `None` where the face is a constraint, the flip is not valid or a new face meets the aim.
pub fn plan_flip_23(mesh: &ConstrainedMesh, side: TetFace, aim: Option<[VertexId; 2]>) -> Option<Plan> {
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
    if [x, y, z].iter().any(|&w| meets_aim(mesh, aim, [p, q, w])) {
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
        Ok(self.commit_ids(mesh, plan)?.is_some())
    }

    /// The same; the new tets in the order of the plan.
    fn commit_ids(&mut self, mesh: &mut ConstrainedMesh, plan: &Plan) -> Result<Option<Vec<TetId>>> {
        let old: Vec<[VertexId; 4]> = plan.old.iter().map(|&t| mesh.complex.vertices(t)).collect();
        let Some(ids) = mesh.replace(&plan.old, &plan.new)? else { return Ok(None) };
        self.0.push((old, ids.clone()));
        Ok(Some(ids))
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
    /// Where the search for an edge to the ring starts.
    pub turn: usize,
    /// A segment that new faces keep clear of.
    pub aim: Option<[VertexId; 2]>,
}

/// Removes the edge u v with backtracking: by the n-m flip, else its ring is shortened, by 2-3 flips and then by the
/// removal of edges from its ends to the ring, up to `depth` levels of them. `tries` bounds the edges looked at. Where
/// that fails, the mesh is as it was; with an aim, rings may be shorter. `hint`, a tet that may have the edge or `NONE`,
/// saves the search in a ball, which is large at the corners around everything.
///
/// # Errors
/// As [`TetStore::create_tet`].
pub fn remove_edge(
    mesh: &mut ConstrainedMesh,
    (edge, hint): ([VertexId; 2], TetId),
    reach: Reach,
    tries: &mut usize,
    journal: &mut Journal,
) -> Result<bool> {
    let mut removal = Removal { reach, tries, journal, open: Vec::new() };
    if mesh.is_segment(edge[0], edge[1]) {
        return Ok(false);
    }
    match shell_start(mesh, edge, &[hint]) {
        Some(start) => removal.remove_at(mesh, start),
        None => Ok(true),
    }
}

/// A shell tet of the edge: one of `hints`, of which some may be gone, or what a search finds; `None` without the edge.
fn shell_start(mesh: &ConstrainedMesh, [u, v]: [VertexId; 2], hints: &[TetId]) -> Option<ShellTet> {
    let at = |tet: TetId| {
        let place = |w| mesh.complex.local_vertex(tet, w);
        place(u).zip(place(v)).map(|(a, b)| ShellTet::new(tet, a, b))
    };
    let live = |tet: &&TetId| **tet != TetId::NONE && mesh.complex.is_live(**tet);
    let hinted = hints.iter().filter(live).find_map(|&tet| at(tet));
    hinted.or_else(|| find_edge(&mesh.complex, u, v, &mut Vec::new()))
}

/// One recursive removal.
struct Removal<'a> {
    reach: Reach,
    tries: &'a mut usize,
    journal: &'a mut Journal,
    /// Edges whose removal is under way, outermost first.
    open: Vec<[VertexId; 2]>,
}

impl Removal<'_> {
    fn remove_at(&mut self, mesh: &mut ConstrainedMesh, start: ShellTet) -> Result<bool> {
        let row = mesh.complex.vertices(start.tet);
        let edge = [row[start.a], row[start.b]];
        let mark = self.journal.mark();
        let mut start = start;
        let mut is_first = true;
        // The outer ring gets shorter only where its tets at the spoke become one: the far end is an ear of this ring.
        let ear = self.open.last().and_then(|outer| outer.iter().copied().find(|v| !edge.contains(v)));
        while let Some((old, ring)) = ring_from(mesh, start, self.reach.ring) {
            let taken: Vec<bool> = old.iter().map(|&tet| self.is_taken(mesh, tet)).collect();
            // The shells of nested removals share no tets but the two at the spoke: that ends the recursion early,
            // where it would only turn in a circle.
            if is_first && taken.iter().filter(|&&t| t).count() > 2 {
                return Ok(false);
            }
            is_first = false;
            let ears = ears_of(mesh, edge, &ring);
            if let Some(plan) = plan_ring(edge, mesh, &old, (&ring, &ears), (self.reach.aim, ear)) {
                if self.journal.commit(mesh, &plan)? {
                    return Ok(true);
                }
                break;
            }
            // A shorter ring needs an ear; without one only its spokes are left.
            let shorter = match ears.contains(&[true; 2]) {
                true => self.cut_ears(mesh, edge, &old, &ring, &taken)?,
                false => None,
            };
            if self.open.len() >= self.reach.depth {
                break;
            }
            let (old, ring, ears) = match shorter {
                None => (old, ring, ears),
                Some(start) => match ring_from(mesh, start, self.reach.ring) {
                    Some((old, ring)) => {
                        let ears = ears_of(mesh, edge, &ring);
                        (old, ring, ears)
                    }
                    None => break,
                },
            };
            if !self.remove_spoke(mesh, edge, &old, (&ring, &ears))? {
                break;
            }
            match shell_start(mesh, edge, &old) {
                Some(found) => start = found,
                None => return Ok(true),
            }
        }
        // A shorter ring is progress on the way to a segment, though the edge is still there: later passes start from
        // it, and as no change puts anything new into the way they cannot turn back.
        if self.reach.aim.is_none() {
            self.journal.take_back(mesh, mark)?;
        }
        Ok(false)
    }

    /// Whether the tet has an edge whose removal is under way.
    fn is_taken(&self, mesh: &ConstrainedMesh, tet: TetId) -> bool {
        let row = mesh.complex.vertices(tet);
        self.open.iter().any(|edge| edge.iter().all(|v| row.contains(v)))
    }

    /// Shortens a ring by 2-3 flips, none of which touches a shell of the outer removals; a tet of the edge afterwards,
    /// or `None` where nothing changed.
    fn cut_ears(
        &mut self,
        mesh: &mut ConstrainedMesh,
        [u, v]: [VertexId; 2],
        old: &[TetId],
        ring: &[VertexId],
        taken: &[bool],
    ) -> Result<Option<ShellTet>> {
        // old[i] lies between ring[i] and ring[i + 1].
        let mut ring: Vec<(VertexId, TetId, bool)> =
            ring.iter().zip(old).zip(taken).map(|((&p, &tet), &taken)| (p, tet, taken)).collect();
        let mut changed = None;
        let mut unchanged = 0;
        let mut i = 0;
        while ring.len() > 3 && unchanged < ring.len() {
            let n = ring.len();
            i %= n;
            let (before, after) = ((i + n - 1) % n, (i + 1) % n);
            let (o, p, q) = (ring[before].0, ring[i].0, ring[after].0);
            unchanged += 1;
            let free = !ring[before].2 && !ring[i].2;
            let new = [[o, p, q, v], [o, q, p, u], [o, q, u, v]];
            if free && new.iter().all(|&tet| mesh.orient(tet) > 0.0) && self.keeps_clear(mesh, [o, q], [p, u, v]) {
                let plan = Plan { old: vec![ring[before].1, ring[i].1], new: new.to_vec() };
                if let Some(ids) = self.journal.commit_ids(mesh, &plan)? {
                    ring[before].1 = ids[2];
                    ring.remove(i);
                    changed = Some(ids[2]);
                    unchanged = 0;
                    continue;
                }
            }
            i += 1;
        }
        let Some(tet) = changed else { return Ok(None) };
        let place = |w| mesh.complex.local_vertex(tet, w);
        Ok(place(u).zip(place(v)).map(|(a, b)| ShellTet::new(tet, a, b)))
    }

    /// Whether no face of the edge p q with a vertex of `thirds` meets the aim.
    fn keeps_clear(&self, mesh: &ConstrainedMesh, [p, q]: [VertexId; 2], thirds: [VertexId; 3]) -> bool {
        thirds.iter().all(|&third| !meets_aim(mesh, self.reach.aim, [p, q, third]))
    }

    /// Removes an edge from an end to the ring without which the ring would be shorter; false where none can be.
    fn remove_spoke(
        &mut self,
        mesh: &mut ConstrainedMesh,
        [u, v]: [VertexId; 2],
        old: &[TetId],
        (ring, ears): (&[VertexId], &[[bool; 2]]),
    ) -> Result<bool> {
        let n = ring.len();
        let turn = self.reach.turn;
        for i in (0..n).map(|i| (i + turn) % n) {
            let [p, after] = [ring[i], ring[(i + 1) % n]];
            // The ring could do without p but for an edge from p to an end that is in the way.
            let end = match ears[i] {
                [true, false] => u,
                [false, true] => v,
                _ => continue,
            };
            // An attempt that failed may have changed what lies around the ring, but not the shell.
            let row = mesh.complex.vertices(old[i]);
            if !mesh.complex.is_live(old[i]) || ![u, v, p, after].iter().all(|w| row.contains(w)) {
                continue;
            }
            if *self.tries == 0 {
                break;
            }
            if mesh.is_segment(end, p) {
                continue;
            }
            *self.tries -= 1;
            let place = |w| mesh.complex.local_vertex(old[i], w);
            let (Some(from), Some(to)) = (place(end), place(p)) else { continue };
            self.open.push([u, v]);
            let removed = self.remove_at(mesh, ShellTet::new(old[i], from, to));
            self.open.pop();
            if removed? {
                return Ok(true);
            }
        }
        Ok(false)
    }
}
