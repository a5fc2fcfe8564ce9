//! Flips: every local reconnection as plan, check and commit.
//!
//! # Method
//! 1. A *plan* function reads the store, claims the vertices of what it would replace, and lists old and new tets.
//! 2. *Check*: constraints and labels while planning; grades of a [`TetMeasure`]; exact orientation of every new tet.
//!    New tets that fill the same closed surface and are all positive tile it: no other test is needed.
//! 3. [`commit`] replaces old by new: it keeps neighbours, constrained faces and constrained edges of the border.
//!
//! ```text
//! 2-3 / 3-2                        4-4 and n-m (edge removal)           multi-face removal: the inverse
//!      d            d              ring c0 .. c(n-1) around a b:        all faces between the apexes a and b
//!     /|\          /|\             every triangle of a triangulation    are replaced by the edge a b
//!    / | \        / | \            of the ring, with a and with b
//!   a-----c  <-> a--|--c
//!    \ | /        \ | /            1-4, 2-6, n-2n: a vertex in a tet, on a face, on an edge; each tet that has the
//!     \|/          \|/             feature gives one tet per vertex of the feature, that vertex replaced.
//!      e            e              4-1, 6-2, 2n-n and any other vertex removal: contraction of an edge.
//! ```
//!
//! # Source
//! [Drakopoulos2017] 4.5 (flips 1-4, 4-1, 2-3, 3-2, 2-6, n-2n, 2-2, 4-4, n-m with n up to 10 and recursive);
//! triangulation of the ring by dynamic programming and multi-face removal: [Shewchuk2002].
//!
//! # Differences
//! The n-m flip is planned at once instead of as a sequence of 2-3 flips: all C_n triangulations of the ring are
//! compared in O(n^3), none of them needs valid intermediate tets. A 2-2 flip on the convex hull is the same function,
//! with the ghost vertex in the ring.
//!
//! # Invariants
//! No plan removes a constrained face or edge, mixes labels or moves the hull. Only [`commit`] writes.
//!
//! # Cost
//! 2-3, 3-2: about a microsecond. No allocation after the scratch buffers have grown. Deterministic.

mod face_removal;
mod vertex_operations;

pub use face_removal::plan_face_removal;
pub use vertex_operations::{Feature, plan_contraction, plan_insertion, plan_vertex_removal, touches_constraint};

use crate::conforming::flip_criteria::TetMeasure;
use crate::error::{Error, Result};
use crate::geometry::predicates::orient3d;
use crate::index::{Label, TetFace, TetId, VertexId};
use crate::mesh::numbering::TET_EDGES;
use crate::mesh::tet_store::TetStore;
use crate::mesh::topology::{ShellKind, ShellTet, collect_shell};

/// Most tets around an edge that a plan takes on: Catalan(14) configurations, still cheap by dynamic programming.
pub const MAX_SHELL: usize = 16;
/// Most tets around a vertex that is removed.
const MAX_BALL: usize = 96;

/// What became of an attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Outcome {
    /// The plan stands, or was carried out.
    Accepted,
    /// No new configuration has only positive tets.
    WouldInvert,
    /// The worst new tet is not better than the worst old one.
    WorsensQuality,
    /// A constrained face or edge, two labels, or the hull stand in the way.
    Constrained,
    /// Another thread holds a vertex.
    ClaimLost,
    /// The configuration is not what this flip needs (too many tets, the tet is gone).
    NotApplicable,
}

/// Old and new tets of one replacement, with their grades.
#[derive(Debug, Clone, Default)]
pub struct Plan {
    /// Tets to delete.
    pub old: Vec<TetId>,
    /// Tets to create, positive.
    pub new: Vec<[VertexId; 4]>,
    /// Label of the new tets.
    pub label: Label,
    /// Grade of the worst old tet.
    pub old_grade: f64,
    /// Grade of the worst new tet.
    pub new_grade: f64,
    /// Vertices that the replacement leaves without tets.
    pub removed_vertices: Vec<VertexId>,
}

impl Plan {
    /// Empties the plan for tets of `label`.
    pub fn reset(&mut self, label: Label) {
        self.old.clear();
        self.new.clear();
        self.label = label;
        self.old_grade = f64::INFINITY;
        self.new_grade = f64::INFINITY;
        self.removed_vertices.clear();
    }

    /// Whether every finite new tet is positive, exactly.
    pub fn is_positive<S: TetStore + ?Sized>(&self, store: &S) -> bool {
        self.new.iter().filter(|tet| !tet.contains(&VertexId::GHOST)).all(|tet| {
            let [a, b, c, d] = store.corners(*tet);
            orient3d(a, b, c, d) > 0.0
        })
    }
}

/// A face of the border, or of a new tet that waits for its partner.
#[derive(Debug, Clone, Copy)]
struct OpenFace {
    sorted: [VertexId; 3],
    side: TetFace,
    constrained: bool,
}

/// Buffers of the flips, reused from one to the next.
#[derive(Debug, Clone, Default)]
pub struct FlipScratch {
    /// The plan made last.
    pub plan: Plan,
    /// Tets created by the last commit, in the order of the plan.
    pub created: Vec<TetId>,
    /// Tets around the edge that was planned last, in turning order.
    pub(crate) shell: Vec<ShellTet>,
    /// Apexes of `shell`.
    pub(crate) ring: Vec<VertexId>,
    ball: Vec<TetId>,
    open: Vec<OpenFace>,
    edges: Vec<[VertexId; 2]>,
    triangulation: Triangulation,
}

/// Which of the grades decides whether a plan stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Accept {
    /// Any valid configuration.
    Valid,
    /// The worst new tet must be better than the worst old one.
    Better,
    /// The worst new tet must be better than this grade.
    Above(f64),
}

impl Accept {
    #[inline]
    pub(super) fn threshold(self, old_grade: f64) -> f64 {
        match self {
            Self::Valid => 0.0,
            // A little more than equal, so that two configurations of the same grade never alternate.
            Self::Better => old_grade.max(0.0) * (1.0 + 1e-9),
            Self::Above(grade) => grade.max(0.0),
        }
    }
}

/// The grade of the tet with these vertices, as it counts.
#[inline]
pub(super) fn grade_of<S: TetStore + ?Sized, M: TetMeasure>(store: &S, measure: &M, tet: [VertexId; 4]) -> f64 {
    measure.weight(&tet).of(measure.grade(store.corners(tet)))
}

/// Claims a tet and refuses what no flip may touch.
#[inline]
fn claim_finite<S: TetStore + ?Sized>(store: &mut S, tet: TetId) -> Outcome {
    if !store.try_claim_tet(tet) {
        return if store.is_live(tet) { Outcome::ClaimLost } else { Outcome::NotApplicable };
    }
    if !store.is_live(tet) {
        Outcome::NotApplicable
    } else if store.is_ghost_tet(tet) {
        Outcome::Constrained
    } else {
        Outcome::Accepted
    }
}

/// Plans the flip 2-3 of the face `side`: the face goes, the edge between its apexes comes.
pub fn plan_23<S: TetStore + ?Sized, M: TetMeasure>(
    store: &mut S,
    side: TetFace,
    measure: &M,
    accept: Accept,
    scratch: &mut FlipScratch,
) -> Outcome {
    let tet = side.tet();
    match claim_finite(store, tet) {
        Outcome::Accepted => {}
        other => return other,
    }
    let other = store.neighbor(side);
    if other == TetFace::NONE || store.is_face_constrained(side) || store.label(tet) != store.label(other.tet()) {
        return Outcome::Constrained;
    }
    let below = store.apex(other);
    if below.is_ghost() {
        return Outcome::Constrained;
    }
    if !store.try_claim(below) {
        return Outcome::ClaimLost;
    }
    let above = store.apex(side);
    let [a, b, c] = store.face_vertices(side);
    // The face is outward from the tet: a b c turns counter-clockwise seen from `below`.
    let new = [[a, b, above, below], [b, c, above, below], [c, a, above, below]];
    let plan = &mut scratch.plan;
    plan.reset(store.label(tet));
    plan.old.extend([tet, other.tet()]);
    plan.old_grade = [store.vertices(tet), store.vertices(other.tet())]
        .into_iter()
        .map(|t| grade_of(store, measure, t))
        .fold(f64::INFINITY, f64::min);
    let threshold = accept.threshold(plan.old_grade);
    for tet in new {
        let grade = grade_of(store, measure, tet);
        plan.new_grade = plan.new_grade.min(grade);
        if grade <= threshold {
            return if grade <= 0.0 { Outcome::WouldInvert } else { Outcome::WorsensQuality };
        }
        plan.new.push(tet);
    }
    if plan.is_positive(store) { Outcome::Accepted } else { Outcome::WouldInvert }
}

/// Best triangulation of a polygon by dynamic programming.
#[derive(Debug, Clone)]
struct Triangulation {
    grade: [[f64; MAX_SHELL]; MAX_SHELL],
    apex: [[u8; MAX_SHELL]; MAX_SHELL],
}

impl Default for Triangulation {
    fn default() -> Self {
        Self { grade: [[0.0; MAX_SHELL]; MAX_SHELL], apex: [[0; MAX_SHELL]; MAX_SHELL] }
    }
}

impl Triangulation {
    /// Fills the table for `count` corners; `triangle(i, j, k, bound)` grades one with i < j < k and may return
    /// anything not above `bound` as soon as it knows that the grade is not.
    fn solve(
        &mut self,
        count: usize,
        threshold: f64,
        mut triangle: impl FnMut(usize, usize, usize, f64) -> f64,
    ) -> f64 {
        for i in 0..count - 1 {
            self.grade[i][i + 1] = f64::INFINITY;
        }
        for span in 2..count {
            for i in 0..count - span {
                let k = i + span;
                let (mut best, mut apex) = (threshold, 0);
                for j in i + 1..k {
                    let sides = self.grade[i][j].min(self.grade[j][k]);
                    if sides > best {
                        let grade = sides.min(triangle(i, j, k, best));
                        if grade > best {
                            (best, apex) = (grade, j as u8);
                        }
                    }
                }
                self.grade[i][k] = if apex == 0 { f64::NEG_INFINITY } else { best };
                self.apex[i][k] = apex;
            }
        }
        self.grade[0][count - 1]
    }

    /// Calls `visit` with every triangle of the best triangulation.
    fn visit(&self, count: usize, mut visit: impl FnMut(usize, usize, usize)) {
        let mut stack = [(0u8, 0u8); MAX_SHELL];
        stack[0] = (0, (count - 1) as u8);
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let (i, k) = stack[depth];
            if k - i < 2 {
                continue;
            }
            let j = self.apex[usize::from(i)][usize::from(k)];
            visit(usize::from(i), usize::from(j), usize::from(k));
            stack[depth] = (i, j);
            stack[depth + 1] = (j, k);
            depth += 2;
        }
    }
}

/// Plans the removal of the edge of `start` by the best triangulation of its ring: flips 3-2, 4-4, n-m for n up to
/// `limit`. On the convex hull (the ghost in the ring) it is the flip 2-2, where the four hull points are coplanar.
pub fn plan_edge_removal<S: TetStore + ?Sized, M: TetMeasure>(
    store: &mut S,
    start: ShellTet,
    limit: usize,
    measure: &M,
    accept: Accept,
    scratch: &mut FlipScratch,
) -> Outcome {
    let outcome = collect_ring(store, start, limit.min(MAX_SHELL), scratch);
    if outcome != Outcome::Accepted {
        return outcome;
    }
    let row = store.vertices(start.tet);
    let (a, b) = (row[start.a], row[start.b]);
    let FlipScratch { plan, ring, shell, triangulation, .. } = scratch;
    let ghost_at = ring.iter().position(|v| v.is_ghost());
    if let Some(at) = ghost_at {
        let (next, previous) = (ring[(at + 1) % ring.len()], ring[(at + ring.len() - 1) % ring.len()]);
        if orient3d(store.point(a), store.point(b), store.point(next), store.point(previous)) != 0.0 {
            return Outcome::Constrained; // another diagonal would move the hull
        }
        // From the ghost on, so that the rest is a path whose ends close the polygon.
        ring.rotate_left(at);
        ring.remove(0);
    }
    for tet in shell.iter() {
        let vertices = store.vertices(tet.tet);
        plan.old.push(tet.tet);
        if !vertices.contains(&VertexId::GHOST) {
            plan.old_grade = plan.old_grade.min(grade_of(store, measure, vertices));
        }
    }
    let count = ring.len();
    if count < 3 {
        return Outcome::NotApplicable;
    }
    let threshold = accept.threshold(plan.old_grade);
    let reader = &*store;
    plan.new_grade = triangulation.solve(count, threshold, |i, j, k, bound| {
        let upper = grade_of(reader, measure, [ring[i], ring[j], ring[k], b]);
        if upper <= bound { upper } else { upper.min(grade_of(reader, measure, [ring[i], ring[k], ring[j], a])) }
    });
    if plan.new_grade <= threshold {
        return Outcome::WorsensQuality;
    }
    triangulation.visit(count, |i, j, k| {
        plan.new.extend([[ring[i], ring[j], ring[k], b], [ring[i], ring[k], ring[j], a]]);
    });
    if ghost_at.is_some() {
        let (first, last) = (ring[0], ring[count - 1]);
        plan.new.extend([[last, VertexId::GHOST, first, b], [last, first, VertexId::GHOST, a]]);
    }
    if plan.is_positive(store) { Outcome::Accepted } else { Outcome::WouldInvert }
}

/// Claims and lists the closed shell of an edge in the scratch's `shell` and `ring`; the plan is reset.
pub fn collect_ring<S: TetStore + ?Sized>(
    store: &mut S,
    start: ShellTet,
    limit: usize,
    scratch: &mut FlipScratch,
) -> Outcome {
    match claim_finite(store, start.tet) {
        Outcome::Accepted => {}
        other => return other,
    }
    if store.is_edge_constrained(start.tet, start.a, start.b) {
        return Outcome::Constrained;
    }
    match collect_shell(store, start, limit, &mut scratch.shell) {
        ShellKind::Closed => {}
        ShellKind::Open => return Outcome::Constrained,
        ShellKind::TooLarge => return Outcome::NotApplicable,
    }
    let label = store.label(start.tet);
    scratch.plan.reset(label);
    scratch.ring.clear();
    for at in 0..scratch.shell.len() {
        let tet = scratch.shell[at];
        let apex = store.vertices(tet.tet)[tet.c];
        let leaves_hull = !apex.is_ghost() && !store.is_ghost_tet(tet.tet) && store.label(tet.tet) != label;
        if store.is_face_constrained(TetFace::new(tet.tet, tet.c)) || leaves_hull {
            return Outcome::Constrained;
        }
        if !store.try_claim(apex) {
            return Outcome::ClaimLost;
        }
        scratch.ring.push(apex);
    }
    Outcome::Accepted
}

/// Carries out the plan in `scratch`: deletes the old tets, creates and glues the new ones, keeps every constraint of
/// the border. `scratch.created` lists the new tets.
///
/// # Errors
/// `LimitReached` (nothing is changed) where the store has no room; `Internal` where the plan does not fill the border.
pub fn commit<S: TetStore + ?Sized>(store: &mut S, scratch: &mut FlipScratch) -> Result<()> {
    let FlipScratch { plan, open, edges, created, .. } = scratch;
    if !store.has_room(plan.new.len()) {
        return Err(Error::LimitReached { reason: "no room for more tets in this pass".into() });
    }
    open.clear();
    edges.clear();
    created.clear();
    for &tet in &plan.old {
        collect_border(store, tet, &plan.old, open, edges);
    }
    for &tet in &plan.old {
        store.delete_tet(tet);
    }
    for &vertices in &plan.new {
        let tet = store.create_tet(vertices, plan.label)?;
        created.push(tet);
        glue_faces(store, tet, vertices, open);
        if !edges.is_empty() {
            mark_edges(store, tet, vertices, edges);
        }
    }
    plan.removed_vertices.iter().for_each(|&vertex| store.set_tet_of(vertex, TetId::NONE));
    debug_assert!(open.iter().all(|f| f.side == TetFace::NONE), "the plan fills its border");
    Ok(())
}

#[inline]
fn sorted3([a, b, c]: [VertexId; 3]) -> [VertexId; 3] {
    let (low, high) = if a < b { (a, b) } else { (b, a) };
    if c < low {
        [c, low, high]
    } else if c < high {
        [low, c, high]
    } else {
        [low, high, c]
    }
}

#[inline]
fn collect_border<S: TetStore + ?Sized>(
    store: &S,
    tet: TetId,
    old: &[TetId],
    open: &mut Vec<OpenFace>,
    edges: &mut Vec<[VertexId; 2]>,
) {
    let (row, neighbors, flags) = (store.vertices(tet), store.neighbors(tet), store.flags(tet));
    for face in 0..4 {
        let side = neighbors[face];
        if side != TetFace::NONE && old.contains(&side.tet()) {
            continue;
        }
        let sorted = sorted3([row[(face + 1) & 3], row[(face + 2) & 3], row[(face + 3) & 3]]);
        open.push(OpenFace { sorted, side, constrained: flags.is_face_constrained(face) });
    }
    if flags.has_constrained_edge() {
        for (edge, [i, j]) in TET_EDGES.into_iter().enumerate() {
            if flags.is_edge_constrained(edge) && !edges.contains(&[row[i], row[j]]) {
                edges.push([row[i], row[j]]);
            }
        }
    }
}

#[inline]
fn glue_faces<S: TetStore + ?Sized>(store: &mut S, tet: TetId, row: [VertexId; 4], open: &mut Vec<OpenFace>) {
    let mut flags = store.flags(tet);
    let before = flags;
    for face in 0..4 {
        let sorted = sorted3([row[(face + 1) & 3], row[(face + 2) & 3], row[(face + 3) & 3]]);
        let mine = TetFace::new(tet, face);
        match open.iter().position(|f| f.sorted == sorted) {
            Some(at) => {
                let partner = open.swap_remove(at);
                flags = flags.with_face(face, partner.constrained);
                if partner.side != TetFace::NONE {
                    store.glue(mine, partner.side);
                }
            }
            None => open.push(OpenFace { sorted, side: mine, constrained: false }),
        }
    }
    if flags != before {
        store.set_flags(tet, flags);
    }
}

fn mark_edges<S: TetStore + ?Sized>(store: &mut S, tet: TetId, row: [VertexId; 4], edges: &[[VertexId; 2]]) {
    let mut flags = store.flags(tet);
    for (edge, [i, j]) in TET_EDGES.into_iter().enumerate() {
        if edges.iter().any(|e| *e == [row[i], row[j]] || *e == [row[j], row[i]]) {
            flags = flags.with_edge(edge, true);
        }
    }
    store.set_flags(tet, flags);
}

/// Plans and carries out the removal of an edge at any price in quality: the n-m flip in its recursive form. Where the
/// ring has no valid triangulation, edges from the ends of the edge to its ring are removed first, `depth` levels deep.
///
/// # Errors
/// As [`commit`].
pub fn remove_edge_recursive<S: TetStore + ?Sized>(
    store: &mut S,
    start: ShellTet,
    limit: usize,
    depth: usize,
    scratch: &mut FlipScratch,
) -> Result<Outcome> {
    use crate::conforming::flip_criteria::AnyPositive;
    let row = store.vertices(start.tet);
    let ends = [row[start.a], row[start.b]];
    let mut current = start;
    let mut attempts = limit;
    loop {
        let outcome = plan_edge_removal(store, current, limit, &AnyPositive, Accept::Valid, scratch);
        if outcome == Outcome::Accepted {
            commit(store, scratch)?;
            return Ok(outcome);
        }
        if depth == 0 || attempts == 0 || matches!(outcome, Outcome::Constrained | Outcome::ClaimLost) {
            return Ok(outcome);
        }
        attempts -= 1;
        let mut shell = Vec::new();
        if collect_shell(store, current, 4 * MAX_SHELL, &mut shell) != ShellKind::Closed {
            return Ok(outcome);
        }
        let mut removed = false;
        'ring: for spoke in &shell {
            for end in [spoke.a, spoke.b] {
                let side_edge = ShellTet::new(spoke.tet, end, spoke.c);
                if remove_edge_recursive(store, side_edge, limit, depth - 1, scratch)? == Outcome::Accepted {
                    removed = true;
                    break 'ring;
                }
            }
        }
        let mut ball = Vec::new();
        match crate::mesh::topology::find_edge(store, ends[0], ends[1], &mut ball) {
            None => return Ok(Outcome::Accepted),
            Some(found) if removed => current = found,
            Some(_) => return Ok(outcome),
        }
    }
}

#[cfg(test)]
mod tests;
