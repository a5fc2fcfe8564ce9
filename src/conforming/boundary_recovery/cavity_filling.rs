//! Fills a polyhedron with tets on its own vertices, by a search that knows when it is beaten.
//!
//! # Method
//! The front is a set of faces with a side that is still empty. A step puts a tet on one of them; faces that meet their
//! mirror image vanish, others join the front. The polyhedron is filled when the front is empty.
//! 1. For every front face the set of vertices that could be its apex is kept as a bit mask: the tet must be positive,
//!    and its new edges and faces must not meet the front.
//! 2. The face with the fewest candidates is taken: one without any ends the branch at once.
//! 3. Its candidates are tried in order: those that close most faces first, then the better shaped.
//! 4. As the filled part only grows, a candidate that is out stays out below: masks are only thinned.
//! ```text
//!   a face that must exist inside is put into the front from both sides: the two copies together bound nothing,
//!   but each has to be covered by a tet.
//! ```
//! # Source
//! [LiuChenChen2007] for the search over small polyhedra; the masks, the choice of the face and the sheets are ours.
//!
//! # Invariants
//! A returned filling has positive tets only, and the front as its boundary; that it covers the polyhedron once follows
//! (`constrained_mesh`). The tests against the front only save time.
//!
//! # Cost
//! Exponential in the worst case, so the number of tets placed is limited by the caller. At most 64 vertices.

use glam::DVec3;

use super::obstruction::{Obstacles, Obstruction};
use crate::conforming::front_clearance::{Face, MOST_VERTICES, bits, mirrored, other_faces, turned};
use crate::context::CancelToken;
use crate::index::VertexId;

/// Every face is tested against every other at the start: faces squared over this, in steps.
const SETUP_SHARE: usize = 16;
/// Faces of a front that cost one more step.
const STEP_SHARE: usize = 8;

/// The search for a filling of one polyhedron; its buffers serve one after the other.
#[derive(Debug, Default)]
pub struct CavityFilling {
    ids: Vec<VertexId>,
    /// Scratch of the start.
    faces: Vec<Face>,
    obstruction: Obstruction,
    /// What is there at the start, what the step under way adds, and all that steps on the way added and that is still open.
    start: Obstacles,
    added: Obstacles,
    open: Obstacles,
    /// The fronts of all steps on the way, one after the other.
    fronts: Vec<FrontFace>,
    tets: Vec<[u8; 4]>,
    steps_left: usize,
}

#[derive(Debug, Clone, Copy)]
struct FrontFace {
    /// Smallest vertex first, turned so that a positive tet lies on it.
    face: Face,
    candidates: u64,
    /// Whether it was placed by a step: then the tests against the start do not cover it.
    is_new: bool,
}

/// Fills the polyhedron bounded by `front` (a tet `(a, b, c, apex)` on each face is positive), containing every face of
/// `sheets`, with at most `steps` tets placed, which `budget` pays for. `None` where there is no filling or it was not
/// found, or `cancel` was used: nothing is left of the budget then.
pub fn fill_cavity(
    filling: &mut CavityFilling,
    (front, sheets): (&[[VertexId; 3]], &[[VertexId; 3]]),
    point_of: impl Fn(VertexId) -> DVec3,
    (steps, cancel): (usize, &CancelToken),
    budget: &mut usize,
) -> Option<Vec<[VertexId; 4]>> {
    let setup = 2 + front.len() * front.len() / SETUP_SHARE;
    if *budget <= setup {
        return None;
    }
    *budget -= setup;
    let steps = steps.min(*budget);
    if !filling.begin(front, sheets, point_of, steps) {
        return None;
    }
    let end = filling.start.faces().len();
    let mut order: Vec<(u32, usize)> = Vec::with_capacity(end);
    for i in 0..end {
        let face = filling.start.faces()[i];
        // Vertices on the right side of a face cost little, and a face that has few of them soon shows that there is no
        // filling: the costly tests begin with such faces.
        let candidates = filling.obstruction.above(face);
        order.push((candidates.count_ones(), i));
        filling.fronts.push(FrontFace { face, candidates, is_new: false });
    }
    order.sort_unstable();
    for (_, i) in order {
        if cancel.is_cancelled() {
            *budget = 0;
            return None;
        }
        let FrontFace { face, candidates, .. } = filling.fronts[i];
        let clear = filling.start.clear_of(&mut filling.obstruction, face, candidates);
        filling.fronts[i].candidates = clear;
        if clear == 0 {
            return None;
        }
    }
    filling.steps_left = steps;
    let found = filling.search(0, cancel);
    *budget = if cancel.is_cancelled() { 0 } else { *budget - (steps - filling.steps_left) };
    let ids = &filling.ids;
    found.then(|| filling.tets.iter().map(|t| t.map(|i| ids[usize::from(i)])).collect())
}

/// The least that a filling costs unless the front falls into parts: each tet but the last, which takes four faces away,
/// leaves at most two fewer.
fn least_steps(front: usize) -> usize {
    (0..front.saturating_sub(2) / 2).map(|placed| step_cost(front - 2 * placed)).sum()
}

/// A step costs what its front costs to look through.
fn step_cost(front: usize) -> usize {
    1 + front / STEP_SHARE
}

impl CavityFilling {
    /// Begins with another polyhedron; false where it has too many vertices, or too many faces for so many steps.
    fn begin(
        &mut self,
        front: &[[VertexId; 3]],
        sheets: &[[VertexId; 3]],
        point_of: impl Fn(VertexId) -> DVec3,
        steps: usize,
    ) -> bool {
        let Self { ids, faces, .. } = self;
        ids.clear();
        ids.extend(front.iter().chain(sheets).flatten());
        ids.sort_unstable();
        ids.dedup();
        if ids.len() > MOST_VERTICES || ids.last().is_none_or(|v| v.is_ghost()) {
            return false;
        }
        let local = |v: VertexId| ids.binary_search(&v).expect("every vertex of a face was collected") as u8;
        faces.clear();
        for face in front {
            let face = turned(face.map(local));
            // A face and its mirror image bound nothing: both go.
            match faces.iter().position(|&f| f == mirrored(face)) {
                Some(position) => drop(faces.swap_remove(position)),
                None => faces.push(face),
            }
        }
        for sheet in sheets {
            let face = turned(sheet.map(local));
            if !faces.contains(&face) && !faces.contains(&mirrored(face)) {
                faces.extend([face, mirrored(face)]);
            }
        }
        if least_steps(faces.len()) > steps {
            return false;
        }
        self.obstruction.reset(ids.iter().map(|&v| point_of(v)));
        for obstacles in [&mut self.start, &mut self.added, &mut self.open] {
            obstacles.reset(ids.len());
        }
        for &face in faces.iter() {
            self.start.add(face, |_| true);
        }
        self.fronts.clear();
        self.tets.clear();
        true
    }

    /// Fills what the fronts from `begin` on bound.
    fn search(&mut self, begin: usize, cancel: &CancelToken) -> bool {
        let end = self.fronts.len();
        let Some(at) = (begin..end).min_by_key(|&i| self.fronts[i].candidates.count_ones()) else { return true };
        let FrontFace { face, candidates, .. } = self.fronts[at];
        let mut order = [(0_usize, 0.0_f64, 0_u8); MOST_VERTICES];
        let order = self.ordered(face, candidates, begin, &mut order);
        let least = least_steps(end - begin).max(1);
        for &(_, _, apex) in order.iter() {
            if self.steps_left < least || cancel.is_cancelled() {
                return false;
            }
            self.steps_left = self.steps_left.saturating_sub(step_cost(end - begin));
            if self.place((begin, end), at, apex) {
                self.tets.push([face[0], face[1], face[2], apex]);
                if self.search(end, cancel) {
                    return true;
                }
                self.tets.pop();
            }
            self.fronts.truncate(end);
        }
        false
    }

    /// Candidates of a face: those that close most faces first, then by shape.
    fn ordered<'a>(
        &self,
        face: Face,
        candidates: u64,
        begin: usize,
        order: &'a mut [(usize, f64, u8); MOST_VERTICES],
    ) -> &'a [(usize, f64, u8)] {
        let mut count = 0;
        for v in bits(candidates) {
            let others = other_faces(face, v);
            let closes = |f: &&Face| self.fronts[begin..].iter().any(|g| g.face == mirrored(**f));
            order[count] = (3 - others.iter().filter(closes).count(), -self.shape(face, v), v);
            count += 1;
        }
        let order = &mut order[..count];
        order.sort_unstable_by(|l, r| l.0.cmp(&r.0).then(l.1.total_cmp(&r.1)).then(l.2.cmp(&r.2)));
        order
    }

    /// Volume over the cube of the mean edge length: a measure of shape good enough for an order.
    fn shape(&self, face: Face, v: u8) -> f64 {
        let [a, b, c] = face.map(|i| self.obstruction.point(i));
        let d = self.obstruction.point(v);
        let squares = [a - b, b - c, c - a, a - d, b - d, c - d].map(|e| e.length_squared());
        let sum = squares.iter().sum::<f64>();
        (b - a).cross(c - a).dot(d - a) / (sum * sum.sqrt())
    }

    /// Appends the front after a tet was put on face number `at`; false where a face is left without a candidate.
    fn place(&mut self, (begin, end): (usize, usize), at: usize, apex: u8) -> bool {
        let face = self.fronts[at].face;
        for i in (begin..end).filter(|&i| i != at) {
            self.fronts.push(self.fronts[i]);
        }
        let mut added = [FrontFace { face, candidates: 0, is_new: true }; 3];
        let mut count = 0;
        for other in other_faces(face, apex) {
            let rest = &self.fronts[end..];
            if let Some(i) = rest.iter().position(|f| f.face == mirrored(other)) {
                self.fronts.swap_remove(end + i);
            } else if rest.iter().any(|f| f.face == other) {
                return false; // the far side of this face is taken
            } else {
                let before = self.obstruction.above(other);
                let candidates = self.start.clear_of(&mut self.obstruction, other, before);
                if candidates == 0 {
                    return false;
                }
                added[count] = FrontFace { face: other, candidates, is_new: true };
                count += 1;
            }
        }
        let Self { obstruction, start, added: obstacles, open, fronts, .. } = self;
        obstacles.clear();
        for added in &added[..count] {
            // The edges of the face that is covered now were there before.
            obstacles.add(added.face, |edge| edge.contains(&apex) && !start.has_edge(edge));
        }
        for front in &mut fronts[end..] {
            front.candidates = obstacles.clear_of(obstruction, front.face, front.candidates);
            if front.candidates == 0 {
                return false;
            }
        }
        let first = fronts.len();
        fronts.extend(&added[..count]);
        open.clear();
        for front in fronts[end..].iter().filter(|f| f.is_new) {
            open.add(front.face, |edge| !start.has_edge(edge));
        }
        for front in &mut fronts[first..] {
            front.candidates = open.clear_of(obstruction, front.face, front.candidates);
            if front.candidates == 0 {
                return false;
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fill(points: &[[f64; 3]], front: &[[u32; 3]], sheets: &[[u32; 3]]) -> Option<Vec<[VertexId; 4]>> {
        let ids = |faces: &[[u32; 3]]| faces.iter().map(|f| f.map(VertexId)).collect::<Vec<_>>();
        let point_of = |v: VertexId| DVec3::from_array(points[v.index()]);
        let faces = (&ids(front)[..], &ids(sheets)[..]);
        let search = (10_000, &CancelToken::default());
        fill_cavity(&mut CavityFilling::default(), faces, point_of, search, &mut 20_000)
    }

    const BIPYRAMID: [[f64; 3]; 5] = [[1., 0., 0.], [-0.5, 0.8, 0.], [-0.5, -0.8, 0.], [0., 0., 1.], [0., 0., -1.]];
    /// Faces of the bipyramid as seen from inside.
    const BIPYRAMID_FACES: [[u32; 3]; 6] = [[0, 3, 1], [1, 3, 2], [2, 3, 0], [0, 1, 4], [1, 2, 4], [2, 0, 4]];

    #[test]
    fn a_sheet_decides_between_two_and_three_tets() {
        assert!(fill(&BIPYRAMID, &BIPYRAMID_FACES, &[]).is_some());
        assert_eq!(fill(&BIPYRAMID, &BIPYRAMID_FACES, &[[0, 1, 2]]).unwrap().len(), 2);
        assert_eq!(fill(&BIPYRAMID, &BIPYRAMID_FACES, &[[0, 3, 4]]).unwrap().len(), 3);
    }

    #[test]
    fn a_cancelled_search_finds_nothing_and_leaves_no_budget() {
        let front = BIPYRAMID_FACES.map(|f| f.map(VertexId));
        let point_of = |v: VertexId| DVec3::from_array(BIPYRAMID[v.index()]);
        let (cancel, mut budget) = (CancelToken::default(), 20_000);
        let mut filling = CavityFilling::default();
        assert!(fill_cavity(&mut filling, (&front, &[]), point_of, (10_000, &cancel), &mut budget).is_some());
        assert!(budget > 0);
        cancel.cancel();
        assert_eq!(fill_cavity(&mut filling, (&front, &[]), point_of, (10_000, &cancel), &mut budget), None);
        assert_eq!(budget, 0);
    }

    #[test]
    fn schoenhardts_polyhedron_has_no_filling() {
        let ring = |z: f64, turn: f64| {
            (0..3).map(move |i| {
                let angle = (f64::from(i) * 120.0 + turn).to_radians();
                [angle.cos(), angle.sin(), z]
            })
        };
        let points: Vec<[f64; 3]> = ring(0.0, 0.0).chain(ring(1.0, 30.0)).collect();
        let ends = [[0, 1, 2], [3, 5, 4]];
        let (mut one, mut two) = (ends.to_vec(), ends.to_vec());
        for i in 0..3 {
            let j = (i + 1) % 3;
            one.extend([[i, 3 + i, j], [j, 3 + i, 3 + j]]);
            two.extend([[i, 3 + j, j], [i, 3 + i, 3 + j]]);
        }
        let found = [fill(&points, &one, &[]), fill(&points, &two, &[])].iter().flatten().count();
        assert_eq!(found, 1, "one choice of diagonals is convex, the other Schoenhardt's");
    }
}
