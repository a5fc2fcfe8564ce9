//! Operations on vertices: insertion into a tet, face or edge, contraction onto a neighbour, removal.
//!
//! # Method
//! ```text
//!   insertion: each tet that has the feature (tet, face or edge) gives one tet per vertex of the feature, that vertex
//!   replaced by the new one: flips 1-4, 2-6, n-2n.
//!   contraction of v onto t: tets with both go, in the others t takes the place of v: flips 4-1, 6-2, 2n-n and beyond.
//!   removal: the best contraction over all neighbours.
//! ```
//!
//! # Source
//! [Drakopoulos2017] 4.5; contraction as an improver's operation: [KlingnerShewchuk2007].
//!
//! # Invariants
//! Plans only, as in [`super`]: nothing is written before [`super::commit`]. A vertex that a constraint touches stays.

use super::{Accept, FlipScratch, MAX_BALL, Outcome, claim_finite, collect_ring, grade_of};
use crate::conforming::flip_criteria::TetMeasure;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::tet_store::TetStore;
use crate::mesh::topology::{ShellTet, collect_ball};

/// Where a point lies in a tet: the smallest feature that contains it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Feature {
    /// Strictly inside the tet.
    Tet(TetId),
    /// On a face.
    Face(TetFace),
    /// On an edge, by local vertices.
    Edge(TetId, usize, usize),
    /// On a vertex.
    Vertex(VertexId),
}

/// Plans the insertion of `vertex` (whose point is set) at a feature: flips 1-4, 2-6 and n-2n.
pub fn plan_insertion<S: TetStore + ?Sized, M: TetMeasure>(
    store: &mut S,
    feature: Feature,
    vertex: VertexId,
    measure: &M,
    scratch: &mut FlipScratch,
) -> Outcome {
    let tet = match feature {
        Feature::Tet(tet) | Feature::Edge(tet, ..) => tet,
        Feature::Face(side) => side.tet(),
        Feature::Vertex(_) => return Outcome::NotApplicable,
    };
    match claim_finite(store, tet) {
        Outcome::Accepted => {}
        other => return other,
    }
    let row = store.vertices(tet);
    let label = store.label(tet);
    let mut on_feature = [true; 4];
    scratch.plan.reset(label);
    match feature {
        Feature::Face(side) => {
            let other = store.neighbor(side);
            if other == TetFace::NONE || store.is_face_constrained(side) || store.is_ghost_tet(other.tet()) {
                return Outcome::Constrained;
            }
            if !store.try_claim(store.apex(other)) {
                return Outcome::ClaimLost;
            }
            on_feature[side.face()] = false;
            scratch.plan.old.extend([tet, other.tet()]);
        }
        Feature::Edge(_, a, b) => {
            let outcome = collect_ring(store, ShellTet::new(tet, a, b), usize::MAX, scratch);
            if outcome != Outcome::Accepted {
                return outcome;
            }
            if scratch.ring.iter().any(|v| v.is_ghost()) {
                return Outcome::Constrained;
            }
            on_feature = [false; 4];
            (on_feature[a], on_feature[b]) = (true, true);
            scratch.plan.old.extend(scratch.shell.iter().map(|s| s.tet));
        }
        _ => scratch.plan.old.push(tet),
    }
    let plan = &mut scratch.plan;
    for at in 0..plan.old.len() {
        let vertices = store.vertices(plan.old[at]);
        plan.old_grade = plan.old_grade.min(grade_of(store, measure, vertices));
        for local in 0..4 {
            if row.iter().zip(on_feature).any(|(v, on)| on && *v == vertices[local]) {
                let mut new = vertices;
                new[local] = vertex;
                plan.new_grade = plan.new_grade.min(grade_of(store, measure, new));
                plan.new.push(new);
            }
        }
    }
    if plan.is_positive(store) { Outcome::Accepted } else { Outcome::WouldInvert }
}

/// Plans the removal of `vertex` by contraction onto its neighbour `target`: with a ball of four tets the flip 4-1, of
/// a face's six the flip 6-2, of an edge's the flip 2n-n.
pub fn plan_contraction<S: TetStore + ?Sized, M: TetMeasure>(
    store: &mut S,
    vertex: VertexId,
    target: VertexId,
    measure: &M,
    accept: Accept,
    scratch: &mut FlipScratch,
) -> Outcome {
    let outcome = claim_ball(store, vertex, scratch);
    if outcome != Outcome::Accepted {
        return outcome;
    }
    let old_grade = ball_grade(store, measure, &scratch.ball);
    contract_claimed(store, [vertex, target], old_grade, measure, accept, scratch)
}

/// Plans the removal of `vertex` by the best contraction onto any neighbour.
pub fn plan_vertex_removal<S: TetStore + ?Sized, M: TetMeasure>(
    store: &mut S,
    vertex: VertexId,
    measure: &M,
    accept: Accept,
    scratch: &mut FlipScratch,
) -> Outcome {
    let outcome = claim_ball(store, vertex, scratch);
    if outcome != Outcome::Accepted {
        return outcome;
    }
    scratch.ring.clear();
    for &tet in &scratch.ball {
        for v in store.vertices(tet) {
            if v != vertex && !scratch.ring.contains(&v) {
                scratch.ring.push(v);
            }
        }
    }
    let old_grade = ball_grade(store, measure, &scratch.ball);
    let (mut best, mut bound, mut last) = (None, accept, Outcome::WouldInvert);
    for at in 0..scratch.ring.len() {
        let target = scratch.ring[at];
        last = contract_claimed(store, [vertex, target], old_grade, measure, bound, scratch);
        if last == Outcome::Accepted {
            best = Some(target);
            bound = Accept::Above(scratch.plan.new_grade);
        }
    }
    match best {
        Some(target) => contract_claimed(store, [vertex, target], old_grade, measure, accept, scratch),
        None => last,
    }
}

/// Claims the whole ball of a vertex that no constraint touches, and lists it.
fn claim_ball<S: TetStore + ?Sized>(store: &mut S, vertex: VertexId, scratch: &mut FlipScratch) -> Outcome {
    if !store.try_claim(vertex) {
        return Outcome::ClaimLost;
    }
    let Some(start) = store.tet_of(vertex).some() else { return Outcome::NotApplicable };
    collect_ball(store, vertex, start, &mut scratch.ball);
    if scratch.ball.len() > MAX_BALL {
        return Outcome::NotApplicable;
    }
    let label = store.label(start);
    for at in 0..scratch.ball.len() {
        let tet = scratch.ball[at];
        if store.label(tet) != label || touches_constraint(store, tet, vertex) {
            return Outcome::Constrained;
        }
        for v in store.vertices(tet) {
            if v.is_ghost() {
                return Outcome::Constrained;
            }
            if !store.try_claim(v) {
                return Outcome::ClaimLost;
            }
        }
    }
    Outcome::Accepted
}

/// Whether a constrained face or edge of `tet`, or the end of the mesh, is at `vertex`.
pub fn touches_constraint<S: TetStore + ?Sized>(store: &S, tet: TetId, vertex: VertexId) -> bool {
    let Some(local) = store.local_vertex(tet, vertex) else { return false };
    let (flags, neighbors) = (store.flags(tet), store.neighbors(tet));
    (0..4).any(|other| {
        other != local
            && (flags.is_face_constrained(other)
                || neighbors[other] == TetFace::NONE
                || store.is_edge_constrained(tet, local, other))
    })
}

/// The grade of the worst tet of a ball.
fn ball_grade<S: TetStore + ?Sized, M: TetMeasure>(store: &S, measure: &M, ball: &[TetId]) -> f64 {
    ball.iter().map(|&tet| grade_of(store, measure, store.vertices(tet))).fold(f64::INFINITY, f64::min)
}

fn contract_claimed<S: TetStore + ?Sized, M: TetMeasure>(
    store: &S,
    [vertex, target]: [VertexId; 2],
    old_grade: f64,
    measure: &M,
    accept: Accept,
    scratch: &mut FlipScratch,
) -> Outcome {
    let FlipScratch { plan, ball, .. } = scratch;
    plan.reset(store.label(ball[0]));
    plan.old_grade = old_grade;
    plan.old.extend_from_slice(ball);
    let threshold = accept.threshold(plan.old_grade);
    for &tet in ball.iter() {
        let row = store.vertices(tet);
        if row.contains(&target) {
            continue;
        }
        let new = row.map(|v| if v == vertex { target } else { v });
        let grade = grade_of(store, measure, new);
        plan.new_grade = plan.new_grade.min(grade);
        if grade <= threshold {
            return if grade <= 0.0 { Outcome::WouldInvert } else { Outcome::WorsensQuality };
        }
        plan.new.push(new);
    }
    plan.removed_vertices.push(vertex);
    if plan.new.len() < plan.old.len() && plan.is_positive(store) { Outcome::Accepted } else { Outcome::WouldInvert }
}
