//! Guard of the deformation: moves that invert or spoil an element are damped or undone, vertex by vertex.
//!
//! # Method
//! Every vertex moves by its displacement times a factor, 1 at first. Elements whose score falls below the bound, and below
//! what it was before the move, halve the factors of their vertices; after `HALVINGS` rounds the factors become 0. The
//! loop ends when no such element is left: with all factors at 0 the mesh is the one before, so it always ends.
//!
//! # Source
//! [Drakopoulos2017] 2.3.5, quality control.
//!
//! # Differences
//! The thesis gives the whole mesh back when three tries fail; here the rest of the mesh keeps its move.
//!
//! # Cost
//! One pass over all elements, then passes over the elements of the vertices that changed.

use glam::DVec3;
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::index::VertexId;
use crate::lattice::element_score::{Part, Threshold, part_fails, part_score};
use crate::sparse::pattern::Incidence;

/// Rounds that halve before a vertex is put back.
const HALVINGS: u32 = 3;

/// Outcome of a guarded move.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct GuardedMove {
    /// Vertices that moved a part of their way.
    pub damped: usize,
    /// Vertices that did not move.
    pub undone: usize,
}

/// Tets that a move may not spoil.
#[derive(Clone, Copy)]
pub struct GuardedTets<'a> {
    /// Rows of vertices.
    pub tets: &'a [[VertexId; 4]],
    /// The tets of each vertex.
    pub incidence: &'a Incidence,
    /// What they are part of.
    pub part: Part,
}

/// Moves `points` by `displacements`, damped where a tet would score below `bound` (degrees) and worse than before. Vertices
/// past `points` are those of `still`, which do not move.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`]; the points are part of their way then.
pub fn move_guarded(
    points: &mut [DVec3],
    still: &[DVec3],
    guarded: &[GuardedTets],
    displacements: &[DVec3],
    bound: f64,
    context: &RunContext,
) -> Result<GuardedMove> {
    let before: Vec<DVec3> = points.to_vec();
    let mut factors = vec![1.0f64; points.len()];
    points.par_iter_mut().zip(displacements).for_each(|(p, d)| *p += *d);
    let count = points.len();
    let corners = |points: &[DVec3], tet: &[VertexId; 4]| {
        let [a, b, c, d] = *tet;
        let at = |v: VertexId| points.get(v.index()).copied().unwrap_or_else(|| still[v.index() - count]);
        [at(a), at(b), at(c), at(d)]
    };
    let threshold = Threshold::of(bound);
    let is_spoiled = |points: &[DVec3], group: &GuardedTets, t: u32| {
        let tet = &group.tets[t as usize];
        let moved = corners(points, tet);
        part_fails(moved, group.part, &threshold)
            && part_score(moved, group.part) < part_score(corners(&before, tet), group.part)
    };
    let spoiled = |points: &[DVec3], group: &GuardedTets| -> Vec<u32> {
        let all = (0..group.tets.len() as u32).into_par_iter().with_min_len(1024);
        context.until_cancelled(all).filter(|t| is_spoiled(points, group, *t)).collect()
    };
    let mut bad: Vec<Vec<u32>> = guarded.iter().map(|group| spoiled(points, group)).collect();
    let mut round = 0;
    let mut is_moved = vec![false; count];
    context.check()?;
    while bad.iter().any(|b| !b.is_empty()) {
        let mut moved: Vec<VertexId> = Vec::new();
        for (group, bad) in guarded.iter().zip(&bad) {
            for v in bad.iter().flat_map(|t| &group.tets[*t as usize]) {
                // Those past the points stay where they are.
                let Some(is_moved) = is_moved.get_mut(v.index()) else { continue };
                if factors[v.index()] > 0.0 && !*is_moved {
                    *is_moved = true;
                    moved.push(*v);
                }
            }
        }
        for v in &moved {
            let factor = &mut factors[v.index()];
            *factor = if round < HALVINGS { *factor / 2.0 } else { 0.0 };
            points[v.index()] = before[v.index()] + displacements[v.index()] * *factor;
        }
        let still_bad = |group: &GuardedTets| -> Vec<u32> {
            // Each tet once, at the first of its vertices that moved.
            let is_first = |t: u32, v: VertexId| {
                group.tets[t as usize].into_iter().find(|w| is_moved.get(w.index()) == Some(&true)) == Some(v)
            };
            let stays_bad = |t: u32, v: VertexId| is_first(t, v) && is_spoiled(points, group, t);
            let at_vertex = |v: &VertexId| {
                let v = *v;
                group.incidence.of(v.index()).iter().copied().filter(move |t| stays_bad(*t, v))
            };
            context.until_cancelled(moved.par_iter().with_min_len(64)).flat_map_iter(at_vertex).collect()
        };
        bad = guarded.iter().map(still_bad).collect();
        moved.iter().for_each(|v| is_moved[v.index()] = false);
        round += 1;
        context.check()?;
    }
    Ok(GuardedMove {
        damped: factors.iter().filter(|f| **f > 0.0 && **f < 1.0).count(),
        undone: factors.iter().filter(|f| **f == 0.0).count(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::element_score::tet_score;

    #[test]
    fn a_move_that_inverts_is_damped_and_the_rest_keeps_its_move() {
        let mut points = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z, DVec3::splat(5.0), DVec3::new(6.0, 5.0, 5.0)];
        points.extend([DVec3::new(5.0, 6.0, 5.0), DVec3::new(5.0, 5.0, 6.0)]);
        let v = VertexId::from_index;
        let tets = [[v(0), v(1), v(2), v(3)], [v(4), v(5), v(6), v(7)]];
        let incidence = Incidence::new(8, &[0, 4, 8], tets.as_flattened()).unwrap();
        let mut displacements = vec![DVec3::splat(0.5); 8];
        displacements[..3].fill(DVec3::ZERO);
        displacements[3] = DVec3::Z * -3.0;
        let guarded = [GuardedTets { tets: &tets, incidence: &incidence, part: Part::Mesh }];
        let context = RunContext::with_threads(1).unwrap();
        let result = move_guarded(&mut points, &[], &guarded, &displacements, 5.0, &context).unwrap();
        assert!(tets.iter().all(|t| tet_score(t.map(|v| points[v.index()])) > 5.0));
        assert_eq!(points[4], DVec3::splat(5.5));
        assert!(result.damped + result.undone > 0);
        context.cancel_token().cancel();
        let cancelled = move_guarded(&mut points, &[], &guarded, &displacements, 5.0, &context);
        assert!(matches!(cancelled, Err(crate::Error::Cancelled)));
    }
}
