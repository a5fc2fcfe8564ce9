//! Multi-face removal: all faces between two apexes, as far as it helps, are replaced by the edge between the apexes.
//!
//! # Method
//! From one face the removal grows over edges: beyond an edge, the next face between the same apexes is taken where the
//! tets that then come are better than the tet that closes the edge.
//!
//! # Source
//! [Shewchuk2002].
//!
//! # Invariants
//! As in [`super`]: a plan writes nothing.

use super::{Accept, FlipScratch, Outcome, claim_finite, grade_of};
use crate::conforming::flip_criteria::TetMeasure;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::tet_store::TetStore;

/// Most faces that a multi-face removal replaces.
const MAX_SANDWICH: usize = 12;

/// A face between the two apexes of a multi-face removal.
#[derive(Clone, Copy)]
struct Sandwich {
    upper: TetId,
    lower: TetId,
    /// Outward from the upper tet.
    face: [VertexId; 3],
}

/// Plans a multi-face removal that starts at `side`: the face and all neighbouring faces between the same two apexes,
/// as far as it helps, are replaced by the edge between the apexes.
pub fn plan_face_removal<S: TetStore + ?Sized, M: TetMeasure>(
    store: &mut S,
    side: TetFace,
    measure: &M,
    accept: Accept,
    scratch: &mut FlipScratch,
) -> Outcome {
    match claim_finite(store, side.tet()) {
        Outcome::Accepted => {}
        other => return other,
    }
    let other = store.neighbor(side);
    if other == TetFace::NONE
        || store.is_face_constrained(side)
        || store.label(side.tet()) != store.label(other.tet())
        || store.is_ghost_tet(other.tet())
    {
        return Outcome::Constrained;
    }
    let apexes = [store.apex(side), store.apex(other)];
    if !store.try_claim(apexes[1]) {
        return Outcome::ClaimLost;
    }
    let root = Sandwich { upper: side.tet(), lower: other.tet(), face: store.face_vertices(side) };
    let mut growth = Growth { store, measure, apexes, faces: [root; MAX_SANDWICH], count: 1, old_grade: f64::INFINITY };
    growth.old_grade = growth.grade_pair(&root);
    let plan = &mut scratch.plan;
    plan.reset(growth.store.label(root.upper));
    let mut new_grade = f64::INFINITY;
    for edge in 0..3 {
        let [u, w] = [root.face[edge], root.face[(edge + 1) % 3]];
        match growth.close_edge(&root, u, w, &mut plan.new) {
            Ok(grade) => new_grade = new_grade.min(grade),
            Err(outcome) => return outcome,
        }
        if new_grade <= 0.0 {
            return Outcome::WouldInvert;
        }
    }
    plan.old_grade = growth.old_grade;
    plan.new_grade = new_grade;
    plan.old.extend(growth.faces[..growth.count].iter().flat_map(|f| [f.upper, f.lower]));
    let threshold = accept.threshold(plan.old_grade);
    if new_grade <= 0.0 {
        Outcome::WouldInvert
    } else if new_grade <= threshold {
        Outcome::WorsensQuality
    } else if plan.is_positive(store) {
        Outcome::Accepted
    } else {
        Outcome::WouldInvert
    }
}

/// A multi-face removal that grows over the edges of its faces.
struct Growth<'a, S: ?Sized, M> {
    store: &'a mut S,
    measure: &'a M,
    apexes: [VertexId; 2],
    faces: [Sandwich; MAX_SANDWICH],
    count: usize,
    old_grade: f64,
}

impl<S: TetStore + ?Sized, M: TetMeasure> Growth<'_, S, M> {
    fn grade_pair(&self, face: &Sandwich) -> f64 {
        let grade = |tet| grade_of(self.store, self.measure, self.store.vertices(tet));
        grade(face.upper).min(grade(face.lower))
    }

    /// The best way to close the border edge `u w` of a face: the tet u w and the apexes, or the face beyond the edge
    /// and its two other edges. Appends the new tets and returns their worst grade.
    fn close_edge(
        &mut self,
        face: &Sandwich,
        u: VertexId,
        w: VertexId,
        new: &mut Vec<[VertexId; 4]>,
    ) -> std::result::Result<f64, Outcome> {
        let [above, below] = self.apexes;
        let direct = [u, w, above, below];
        let direct_grade = grade_of(self.store, self.measure, direct);
        let child = match self.face_beyond(face, u, w)? {
            Some(child) if self.count < MAX_SANDWICH => child,
            _ => {
                new.push(direct);
                return Ok(direct_grade);
            }
        };
        // Taking the child replaces its two tets as well: worth it where what comes is better than the direct tet.
        let child_old = self.grade_pair(&child);
        let (mark, count) = (new.len(), self.count);
        let before = self.old_grade;
        self.faces[self.count] = child;
        self.count += 1;
        let x = child.face[2];
        let mut grade = f64::INFINITY;
        for [p, q] in [[u, x], [x, w]] {
            grade = grade.min(self.close_edge(&child, p, q, new)?);
            if grade <= direct_grade {
                break;
            }
        }
        if grade > direct_grade {
            self.old_grade = self.old_grade.min(child_old);
            return Ok(grade);
        }
        new.truncate(mark);
        self.count = count;
        self.old_grade = before;
        new.push(direct);
        Ok(direct_grade)
    }

    /// The face beyond the edge `u w` that lies between the same apexes, if any: `[u', w', x]` outward from its upper
    /// tet with x the new vertex.
    fn face_beyond(
        &mut self,
        face: &Sandwich,
        u: VertexId,
        w: VertexId,
    ) -> std::result::Result<Option<Sandwich>, Outcome> {
        let third = face.face.into_iter().find(|v| *v != u && *v != w).unwrap_or(u);
        let beyond = |store: &S, tet: TetId| -> Option<(TetId, VertexId)> {
            let local = store.local_vertex(tet, third)?;
            let side = TetFace::new(tet, local);
            let other = store.neighbor(side);
            let blocked = other == TetFace::NONE || store.is_face_constrained(side);
            (!blocked).then(|| (other.tet(), store.apex(other)))
        };
        let (Some((upper, x)), Some((lower, y))) = (beyond(self.store, face.upper), beyond(self.store, face.lower))
        else {
            return Ok(None);
        };
        if x != y || x.is_ghost() || self.faces[..self.count].iter().any(|f| f.upper == upper || f.lower == lower) {
            return Ok(None);
        }
        // The edge u w itself disappears when both sides of it go; the three faces at it must be free.
        let Some(side) = self.store.local_vertex(upper, self.apexes[0]).map(|local| TetFace::new(upper, local)) else {
            return Ok(None);
        };
        let row = self.store.vertices(upper);
        let (Some(lu), Some(lw)) = (row.iter().position(|v| *v == u), row.iter().position(|v| *v == w)) else {
            return Ok(None);
        };
        if self.store.neighbor(side).tet() != lower
            || self.store.is_face_constrained(side)
            || self.store.is_edge_constrained(upper, lu, lw)
        {
            return Ok(None);
        }
        if !self.store.try_claim(x) {
            return Err(Outcome::ClaimLost);
        }
        Ok(Some(Sandwich { upper, lower, face: [w, u, x] }))
    }
}
