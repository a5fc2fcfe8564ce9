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
use crate::mesh::topology::{ShellTet, find_edge};

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

/// Most vertices of a ring, whatever the options say.
pub const MOST_RING: usize = 64;

/// The tets around an edge and the ring of their apexes: tet i lies between the vertices i and i + 1. Rings are looked at
/// by the hundred thousand, so that nothing of them is allocated.
#[derive(Debug, Clone, Copy)]
pub struct Ring {
    count: usize,
    tets: [TetId; MOST_RING],
    vertices: [VertexId; MOST_RING],
}

impl Default for Ring {
    fn default() -> Self {
        Self { count: 0, tets: [TetId::NONE; MOST_RING], vertices: [VertexId::GHOST; MOST_RING] }
    }
}

impl Ring {
    /// Becomes the ring around the edge of `start`; false where it reaches the hull or has more than `limit` tets.
    fn collect(&mut self, mesh: &ConstrainedMesh, start: ShellTet, limit: usize) -> bool {
        self.count = 0;
        let mut current = start;
        loop {
            let apex = mesh.complex.vertices(current.tet)[current.c];
            if self.count == limit.min(MOST_RING) || apex.is_ghost() {
                return false;
            }
            self.tets[self.count] = current.tet;
            self.vertices[self.count] = apex;
            self.count += 1;
            match current.next(&mesh.complex) {
                Some(next) if next.tet == start.tet => return true,
                Some(next) => current = next,
                None => return false,
            }
        }
    }

    /// The tets, turning around the edge.
    #[inline]
    pub fn tets(&self) -> &[TetId] {
        &self.tets[..self.count]
    }

    /// The vertices of the ring.
    #[inline]
    pub fn vertices(&self) -> &[VertexId] {
        &self.vertices[..self.count]
    }
}

/// The ring of an edge, looked for in the tet `hint` first; `None` where the edge does not exist, lies on the hull or
/// has more than `limit` tets.
pub fn ring_of(mesh: &ConstrainedMesh, edge: [VertexId; 2], hint: TetId, limit: usize) -> Option<Ring> {
    let mut ring = Ring::default();
    ring.collect(mesh, shell_start(mesh, edge, &[hint])?, limit).then_some(ring)
}

/// The best removal of the edge u v, or `None` where it is a constraint or cannot be removed alone. `hint` as in
/// [`remove_edge`].
pub fn plan_removal(mesh: &ConstrainedMesh, edge: [VertexId; 2], hint: TetId, limit: usize) -> Option<Plan> {
    if mesh.is_segment(edge[0], edge[1]) {
        return None;
    }
    let ring = ring_of(mesh, edge, hint, limit)?;
    plan_ring(mesh, edge, (&ring, Ears::of(mesh, edge, &ring)), (None, None))
}

/// For each vertex p of the ring of u v, with its neighbours o and q, a bit whether the tet o p q v is positive, and one
/// whether o q p u is.
#[derive(Debug, Clone, Copy)]
struct Ears {
    upper: u64,
    lower: u64,
}

impl Ears {
    fn of(mesh: &ConstrainedMesh, [u, v]: [VertexId; 2], ring: &Ring) -> Self {
        let ring = ring.vertices();
        let n = ring.len();
        let (mut upper, mut lower) = (0, 0);
        let mut o = ring[n - 1];
        for i in 0..n {
            let (p, q) = (ring[i], ring[if i + 1 == n { 0 } else { i + 1 }]);
            upper |= u64::from(mesh.orient([o, p, q, v]) > 0.0) << i;
            lower |= u64::from(mesh.orient([o, q, p, u]) > 0.0) << i;
            o = p;
        }
        Self { upper, lower }
    }

    /// The vertices whose two tets are positive.
    fn both(self) -> u64 {
        self.upper & self.lower
    }

    /// Whether a triangulation of the ring of n vertices may exist, with an ear at the place `at`: one of a triangle has
    /// three ears, every other one two that are no neighbours.
    fn suffice(self, n: usize, at: Option<usize>) -> bool {
        let both = self.both();
        let around = |i: usize| 1_u64 << i | 1 << ((i + 1) % n) | 1 << ((i + n - 1) % n);
        let first = at.unwrap_or(both.trailing_zeros() as usize);
        match (both.count_ones(), at) {
            (0 | 1, _) => false,
            (count, _) if n == 3 => count == 3,
            (_, Some(at)) => both >> at & 1 == 1 && both & !around(at) != 0,
            (2, None) => both & !around(first) != 0,
            _ => true,
        }
    }
}

/// Rings up to this size are planned in a table on the stack.
const SMALL_RING: usize = 8;

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
/// with the triangle at the vertex `ear` and its two neighbours.
fn plan_ring(
    mesh: &ConstrainedMesh,
    [u, v]: [VertexId; 2],
    (around, ears): (&Ring, Ears),
    (aim, ear): (Option<[VertexId; 2]>, Option<VertexId>),
) -> Option<Plan> {
    let mut ring = around.vertices;
    let n = around.count;
    let cut = match ear {
        Some(ear) => ring[..n].iter().position(|&p| p == ear)?,
        None => 0,
    };
    if n < 3 || !ears.suffice(n, ear.map(|_| cut)) {
        return None;
    }
    ring[..n].rotate_left(cut);
    let is_ear = |i: usize| ears.both() >> ((i + cut) % n) & 1 == 1;
    let met = |face: [VertexId; 3]| meets_aim(mesh, aim, face);
    let from = usize::from(ear.is_some());
    let none = Cut { shape: 0.0, middle: usize::MAX };
    // best[i * n + k]: the best triangulation of p_i ... p_k.
    let (mut small, mut large) = ([none; SMALL_RING * SMALL_RING], Vec::new());
    let best: &mut [Cut] = if n <= SMALL_RING {
        &mut small
    } else {
        large.resize(n * n, none);
        &mut large
    };
    for i in from..n - 1 {
        best[i * n + i + 1].shape = f64::INFINITY;
    }
    for length in 2..n {
        for i in from..n - length {
            let k = i + length;
            let mut found = none;
            let inner = length < n - 1;
            if inner && (met([ring[i], ring[k], u]) || met([ring[i], ring[k], v])) {
                continue;
            }
            for j in i + 1..k {
                let sides = best[i * n + j].shape.min(best[j * n + k].shape);
                if sides <= found.shape {
                    continue;
                }
                if length == 2 && !is_ear(j) {
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
    Some(Plan { old: around.tets().to_vec(), new })
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
    let new = [[p, q, x, y], [p, q, y, z], [p, q, z, x]];
    if v.iter().any(|v| v.is_ghost()) || new.iter().any(|&tet| mesh.orient(tet) <= 0.0) {
        return None;
    }
    if [x, y, z].iter().any(|&w| meets_aim(mesh, aim, [p, q, w])) {
        return None;
    }
    Some(Plan { old: vec![side.tet(), other.tet()], new: new.to_vec() })
}

/// Changes that may be taken back.
#[derive(Debug, Default)]
pub struct Journal {
    /// The rows of the old tets of all changes.
    rows: Vec<[VertexId; 4]>,
    /// The new tets of all changes.
    ids: Vec<TetId>,
    /// For each change where its rows and its ids start.
    starts: Vec<[usize; 2]>,
}

impl Journal {
    /// Commits a plan and notes it; false where it is not valid. The new tets are in `mesh.created`.
    ///
    /// # Errors
    /// As [`TetStore::create_tet`].
    pub fn commit(&mut self, mesh: &mut ConstrainedMesh, plan: &Plan) -> Result<bool> {
        let start = [self.rows.len(), self.ids.len()];
        self.rows.extend(plan.old.iter().map(|&t| mesh.complex.vertices(t)));
        if !mesh.replace_by_positive(&plan.old, &plan.new)? {
            self.rows.truncate(start[0]);
            return Ok(false);
        }
        self.ids.extend(&mesh.created);
        self.starts.push(start);
        Ok(true)
    }

    /// Changes noted so far.
    pub fn mark(&self) -> usize {
        self.starts.len()
    }

    /// Takes back all changes after the first `length`. Slots are given out last freed first: in reverse order the old
    /// tets get their old ids, so that what was noted earlier stays valid.
    ///
    /// # Errors
    /// As [`TetStore::create_tet`].
    pub fn take_back(&mut self, mesh: &mut ConstrainedMesh, length: usize) -> Result<()> {
        while self.starts.len() > length
            && let Some([row, id]) = self.starts.pop()
        {
            self.rows[row..].reverse();
            self.ids[id..].reverse();
            mesh.replace_by_positive(&self.ids[id..], &self.rows[row..])?;
            self.rows.truncate(row);
            self.ids.truncate(id);
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
    /// Added to where searches for an edge to the ring start, which changes with the mesh.
    pub turn: usize,
    /// Whether segments may be removed.
    pub yields: bool,
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
    let mut removal = Removal { reach, tries, journal, open: Vec::new(), rings: Vec::new(), left: Vec::new() };
    if !reach.yields && mesh.is_segment(edge[0], edge[1]) {
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

/// A vertex of a ring that is being shortened.
#[derive(Clone, Copy)]
struct Corner {
    vertex: VertexId,
    /// The tet between it and the next vertex.
    tet: TetId,
    /// Whether that has an edge whose removal is under way.
    is_taken: bool,
    /// Whether its two tets with its neighbours are positive.
    is_ear: bool,
}

/// One recursive removal.
struct Removal<'a> {
    reach: Reach,
    tries: &'a mut usize,
    journal: &'a mut Journal,
    /// Edges whose removal is under way, outermost first.
    open: Vec<[VertexId; 2]>,
    /// Rings that are not in use.
    rings: Vec<Ring>,
    /// Scratch of `cut_ears`.
    left: Vec<Corner>,
}

impl Removal<'_> {
    fn remove_at(&mut self, mesh: &mut ConstrainedMesh, start: ShellTet) -> Result<bool> {
        let mut ring = self.rings.pop().unwrap_or_default();
        let removed = self.remove_with(mesh, start, &mut ring);
        self.rings.push(ring);
        removed
    }

    fn remove_with(&mut self, mesh: &mut ConstrainedMesh, start: ShellTet, ring: &mut Ring) -> Result<bool> {
        let row = mesh.complex.vertices(start.tet);
        let edge = [row[start.a], row[start.b]];
        let mark = self.journal.mark();
        let mut start = start;
        let mut is_first = true;
        // The outer ring gets shorter only where its tets at the spoke become one: the far end is an ear of this ring.
        let ear = self.open.last().and_then(|outer| outer.iter().copied().find(|v| !edge.contains(v)));
        while ring.collect(mesh, start, self.reach.ring) {
            let taken = self.taken(mesh, ring.tets());
            // The shells of nested removals share no tets but the two at the spoke: that ends the recursion early,
            // where it would only turn in a circle.
            if is_first && taken.count_ones() > 2 {
                return Ok(false);
            }
            is_first = false;
            let ears = Ears::of(mesh, edge, ring);
            if let Some(plan) = plan_ring(mesh, edge, (ring, ears), (self.reach.aim, ear)) {
                if self.journal.commit(mesh, &plan)? {
                    return Ok(true);
                }
                break;
            }
            // A shorter ring needs an ear; without one only its spokes are left.
            let shorter = match ears.both() {
                0 => None,
                _ => self.cut_ears(mesh, edge, (ring, ears), taken)?,
            };
            if self.open.len() >= self.reach.depth {
                break;
            }
            let ears = match shorter {
                None => ears,
                Some(start) if ring.collect(mesh, start, self.reach.ring) => Ears::of(mesh, edge, ring),
                Some(_) => break,
            };
            if !self.remove_spoke(mesh, edge, (ring, ears))? {
                break;
            }
            match shell_start(mesh, edge, ring.tets()) {
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

    /// For each of the tets a bit whether it has an edge whose removal is under way.
    fn taken(&self, mesh: &ConstrainedMesh, tets: &[TetId]) -> u64 {
        let mut taken = 0;
        for (i, &tet) in tets.iter().enumerate() {
            let [a, b, c, d] = mesh.complex.vertices(tet);
            let has = |v: VertexId| (v == a) | (v == b) | (v == c) | (v == d);
            taken |= u64::from(self.open.iter().any(|&[u, v]| has(u) && has(v))) << i;
        }
        taken
    }

    /// Shortens a ring by 2-3 flips, none of which touches a shell of the outer removals; a tet of the edge afterwards,
    /// or `None` where nothing changed.
    fn cut_ears(
        &mut self,
        mesh: &mut ConstrainedMesh,
        [u, v]: [VertexId; 2],
        (ring, ears): (&Ring, Ears),
        taken: u64,
    ) -> Result<Option<ShellTet>> {
        let mut left = std::mem::take(&mut self.left);
        left.clear();
        left.extend((0..ring.count).map(|i| Corner {
            vertex: ring.vertices[i],
            tet: ring.tets[i],
            is_taken: taken >> i & 1 == 1,
            is_ear: ears.both() >> i & 1 == 1,
        }));
        let mut n = ring.count;
        let mut changed = None;
        let mut unchanged = 0;
        let mut i = 0;
        while n > 3 && unchanged < n {
            i %= n;
            let (before, after) = ((i + n - 1) % n, (i + 1) % n);
            let (o, p, q) = (left[before].vertex, left[i].vertex, left[after].vertex);
            unchanged += 1;
            let free = !left[before].is_taken && !left[i].is_taken && left[i].is_ear;
            if free && mesh.orient([o, q, u, v]) > 0.0 && self.keeps_clear(mesh, [o, q], [p, u, v]) {
                let new = vec![[o, p, q, v], [o, q, p, u], [o, q, u, v]];
                let plan = Plan { old: vec![left[before].tet, left[i].tet], new };
                if self.journal.commit(mesh, &plan)? {
                    let tet = mesh.created[2];
                    left[before].tet = tet;
                    left.copy_within(i + 1..n, i);
                    n -= 1;
                    for at in [i + n - 1, i] {
                        let [o, p, q] = [at + n - 1, at, at + 1].map(|i| left[i % n].vertex);
                        let is_ear = mesh.orient([o, p, q, v]) > 0.0 && mesh.orient([o, q, p, u]) > 0.0;
                        left[at % n].is_ear = is_ear;
                    }
                    changed = Some(tet);
                    unchanged = 0;
                    continue;
                }
            }
            i += 1;
        }
        self.left = left;
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
        (ring, ears): (&Ring, Ears),
    ) -> Result<bool> {
        let n = ring.count;
        // Starting elsewhere each time: attempts that begin alike fail alike.
        let turn = self.reach.turn + mesh.reconnections;
        for i in (0..n).map(|i| (i + turn) % n) {
            let [p, after] = [ring.vertices[i], ring.vertices[(i + 1) % n]];
            // The ring could do without p but for an edge from p to an end that is in the way.
            let end = match (ears.upper >> i & 1, ears.lower >> i & 1) {
                (1, 0) => u,
                (0, 1) => v,
                _ => continue,
            };
            // An attempt that failed may have changed what lies around the ring, but not the shell.
            let tet = ring.tets[i];
            let row = mesh.complex.vertices(tet);
            if !mesh.complex.is_live(tet) || ![u, v, p, after].iter().all(|w| row.contains(w)) {
                continue;
            }
            if *self.tries == 0 {
                break;
            }
            if !self.reach.yields && mesh.is_segment(end, p) {
                continue;
            }
            *self.tries -= 1;
            let place = |w| mesh.complex.local_vertex(tet, w);
            let (Some(from), Some(to)) = (place(end), place(p)) else { continue };
            self.open.push([u, v]);
            let removed = self.remove_at(mesh, ShellTet::new(tet, from, to));
            self.open.pop();
            if removed? {
                return Ok(true);
            }
        }
        Ok(false)
    }
}
