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

use crate::index::VertexId;
use crate::lattice::element_score::{Threshold, tet_fails, tet_score};
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

/// Moves `points` by `displacements`, damped where a tet would score below `bound` (degrees) and worse than before.
pub fn move_guarded(
    points: &mut [DVec3],
    tets: &[[VertexId; 4]],
    incidence: &Incidence,
    displacements: &[DVec3],
    bound: f64,
) -> GuardedMove {
    let before: Vec<DVec3> = points.to_vec();
    let mut factors = vec![1.0f64; points.len()];
    points.par_iter_mut().zip(displacements).for_each(|(p, d)| *p += *d);
    let corners = |points: &[DVec3], t: u32| {
        let [a, b, c, d] = tets[t as usize];
        [points[a.index()], points[b.index()], points[c.index()], points[d.index()]]
    };
    let threshold = Threshold::of(bound);
    let is_spoiled = |points: &[DVec3], t: u32| {
        let moved = corners(points, t);
        tet_fails(moved, &threshold) && tet_score(moved) < tet_score(corners(&before, t))
    };
    let mut bad: Vec<u32> =
        (0..tets.len() as u32).into_par_iter().with_min_len(1024).filter(|t| is_spoiled(points, *t)).collect();
    let mut round = 0;
    while !bad.is_empty() {
        let mut moved: Vec<VertexId> = bad.iter().flat_map(|t| tets[*t as usize]).collect();
        moved.sort_unstable();
        moved.dedup();
        moved.retain(|v| factors[v.index()] > 0.0);
        for v in &moved {
            let factor = &mut factors[v.index()];
            *factor = if round < HALVINGS { *factor / 2.0 } else { 0.0 };
            points[v.index()] = before[v.index()] + displacements[v.index()] * *factor;
        }
        let mut touched: Vec<u32> = moved.iter().flat_map(|v| incidence.of(v.index())).copied().collect();
        touched.sort_unstable();
        touched.dedup();
        bad = touched.into_par_iter().filter(|t| is_spoiled(points, *t)).collect();
        round += 1;
    }
    GuardedMove {
        damped: factors.iter().filter(|f| **f > 0.0 && **f < 1.0).count(),
        undone: factors.iter().filter(|f| **f == 0.0).count(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let result = move_guarded(&mut points, &tets, &incidence, &displacements, 5.0);
        assert!(tets.iter().all(|t| tet_score(t.map(|v| points[v.index()])) > 5.0));
        assert_eq!(points[4], DVec3::splat(5.5));
        assert!(result.damped + result.undone > 0);
    }
}
