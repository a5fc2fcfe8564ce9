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

use crate::conforming::front_clearance::{Clearance, Face, MOST_VERTICES, bits, mirrored, other_faces, turned};
use crate::context::CancelToken;
use crate::geometry::predicates::orient3d;
use crate::index::VertexId;

/// Every face is tested against every other at the start: faces squared over this, in steps.
const SETUP_SHARE: usize = 16;
/// Faces of a front that cost one more step.
const STEP_SHARE: usize = 8;

/// A polyhedron being filled.
struct CavityFilling {
    ids: Vec<VertexId>,
    clearance: Clearance,
    steps_left: usize,
    tets: Vec<[u8; 4]>,
}

#[derive(Clone, Copy)]
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
    front: &[[VertexId; 3]],
    sheets: &[[VertexId; 3]],
    point_of: impl Fn(VertexId) -> DVec3,
    (steps, cancel): (usize, &CancelToken),
    budget: &mut usize,
) -> Option<Vec<[VertexId; 4]>> {
    let setup = 2 + front.len() * front.len() / SETUP_SHARE;
    if *budget <= setup {
        return None;
    }
    *budget -= setup;
    let mut ids: Vec<VertexId> = front.iter().flatten().copied().collect();
    ids.extend(sheets.iter().flatten());
    ids.sort_unstable();
    ids.dedup();
    if ids.len() > MOST_VERTICES || ids.last().is_none_or(|v| v.is_ghost()) {
        return None;
    }
    let points = ids.iter().map(|&v| point_of(v)).collect();
    let mut clearance = Clearance::of(points);
    let local = |v: VertexId| ids.binary_search(&v).expect("every vertex of a face was collected") as u8;
    let mut faces: Vec<Face> = Vec::with_capacity(front.len() + 2 * sheets.len());
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
    let mut edges: Vec<[u8; 2]> = faces.iter().flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]]).collect();
    edges.iter_mut().for_each(|edge| edge.sort_unstable());
    edges.sort_unstable();
    edges.dedup();
    clearance.set_start(faces.iter().copied(), edges);
    let mut filling = CavityFilling { ids, clearance, steps_left: 0, tets: Vec::new() };
    let mut start: Vec<FrontFace> =
        faces.iter().map(|&face| FrontFace { face, candidates: 0, is_new: false }).collect();
    // Vertices on the right side of a face cost little, and a face that has few of them soon shows that there is no
    // filling: the costly tests begin with such faces.
    let mut order: Vec<(u32, usize)> = Vec::with_capacity(start.len());
    for (i, front_face) in start.iter_mut().enumerate() {
        front_face.candidates = filling.vertices_before(front_face.face);
        order.push((front_face.candidates.count_ones(), i));
    }
    order.sort_unstable();
    for (_, i) in order {
        if cancel.is_cancelled() {
            *budget = 0;
            return None;
        }
        let FrontFace { face, candidates, .. } = start[i];
        start[i].candidates = filling.clear_candidates(face, candidates, &start);
        if start[i].candidates == 0 {
            return None;
        }
    }
    let steps = steps.min(*budget);
    filling.steps_left = steps;
    let found = filling.search(&start, cancel);
    *budget = if cancel.is_cancelled() { 0 } else { *budget - (steps - filling.steps_left) };
    found.then(|| filling.tets.iter().map(|t| t.map(|i| filling.ids[i as usize])).collect())
}

impl CavityFilling {
    fn search(&mut self, front: &[FrontFace], cancel: &CancelToken) -> bool {
        let Some(position) = (0..front.len()).min_by_key(|&i| front[i].candidates.count_ones()) else { return true };
        let FrontFace { face, candidates, .. } = front[position];
        for apex in self.ordered(face, candidates, front) {
            if self.steps_left == 0 || cancel.is_cancelled() {
                return false;
            }
            // A step costs what its front costs to look through.
            self.steps_left = self.steps_left.saturating_sub(1 + front.len() / STEP_SHARE);
            let Some(next) = self.place(front, position, apex) else { continue };
            self.tets.push([face[0], face[1], face[2], apex]);
            if self.search(&next, cancel) {
                return true;
            }
            self.tets.pop();
        }
        false
    }

    /// Candidates of a face: those that close most faces first, then by shape.
    fn ordered(&self, face: Face, candidates: u64, front: &[FrontFace]) -> Vec<u8> {
        let mut order: Vec<(usize, f64, u8)> = bits(candidates)
            .map(|v| {
                let others = other_faces(face, v);
                let closed = others.iter().filter(|&&f| front.iter().any(|g| g.face == mirrored(f))).count();
                (3 - closed, -self.shape(face, v), v)
            })
            .collect();
        order.sort_by(|l, r| l.0.cmp(&r.0).then(l.1.total_cmp(&r.1)).then(l.2.cmp(&r.2)));
        order.into_iter().map(|(_, _, v)| v).collect()
    }

    /// Volume over the cube of the mean edge length: a measure of shape good enough for an order.
    fn shape(&self, face: Face, v: u8) -> f64 {
        let [a, b, c] = face.map(|i| self.clearance.points[i as usize]);
        let d = self.clearance.points[v as usize];
        let squares = [a - b, b - c, c - a, a - d, b - d, c - d].map(|e| e.length_squared());
        (b - a).cross(c - a).dot(d - a) / squares.iter().sum::<f64>().powf(1.5)
    }

    /// The front after a tet was put on face number `position`; `None` where a face is left without a candidate.
    fn place(&mut self, front: &[FrontFace], position: usize, apex: u8) -> Option<Vec<FrontFace>> {
        let face = front[position].face;
        let mut next: Vec<FrontFace> = Vec::with_capacity(front.len() + 2);
        next.extend(front.iter().enumerate().filter(|(i, _)| *i != position).map(|(_, f)| *f));
        let mut added: Vec<Face> = Vec::with_capacity(3);
        for other in other_faces(face, apex) {
            if let Some(i) = next.iter().position(|f| f.face == mirrored(other)) {
                next.swap_remove(i);
            } else if next.iter().any(|f| f.face == other) {
                return None; // the far side of this face is taken
            } else {
                added.push(other);
            }
        }
        for i in 0..next.len() {
            for v in bits(next[i].candidates) {
                if !added.iter().all(|&g| self.clearance.is_clear_of(next[i].face, v, g)) {
                    next[i].candidates &= !(1 << v);
                }
            }
            if next[i].candidates == 0 {
                return None;
            }
        }
        next.extend(added.iter().map(|&face| FrontFace { face, candidates: 0, is_new: true }));
        for i in next.len() - added.len()..next.len() {
            let before = self.vertices_before(next[i].face);
            next[i].candidates = self.clear_candidates(next[i].face, before, &next);
            if next[i].candidates == 0 {
                return None;
            }
        }
        Some(next)
    }

    /// The vertices with which the face makes a positive tet.
    fn vertices_before(&self, face: Face) -> u64 {
        let [a, b, c] = face.map(|i| self.clearance.points[i as usize]);
        let is_before = |v: usize| !face.contains(&(v as u8)) && orient3d(a, b, c, self.clearance.points[v]) > 0.0;
        (0..self.clearance.points.len()).fold(0, |mask, v| mask | u64::from(is_before(v)) << v)
    }

    /// Those of `vertices` whose tet on the face keeps clear of the front.
    fn clear_candidates(&mut self, face: Face, vertices: u64, front: &[FrontFace]) -> u64 {
        let mut mask = 0;
        for v in bits(vertices) {
            if self.clearance.is_clear_of_start(face, v)
                && front.iter().filter(|g| g.is_new).all(|g| self.clearance.is_clear_of(face, v, g.face))
            {
                mask |= 1 << v;
            }
        }
        mask
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fill(points: &[[f64; 3]], front: &[[u32; 3]], sheets: &[[u32; 3]]) -> Option<Vec<[VertexId; 4]>> {
        let ids = |faces: &[[u32; 3]]| faces.iter().map(|f| f.map(VertexId)).collect::<Vec<_>>();
        let point_of = |v: VertexId| DVec3::from_array(points[v.index()]);
        fill_cavity(&ids(front), &ids(sheets), point_of, (10_000, &CancelToken::default()), &mut 20_000)
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
        assert!(fill_cavity(&front, &[], point_of, (10_000, &cancel), &mut budget).is_some());
        assert!(budget > 0);
        cancel.cancel();
        assert_eq!(fill_cavity(&front, &[], point_of, (10_000, &cancel), &mut budget), None);
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
