//! The mesh with the fewest slivers among those that quality improvement came through.
//!
//! # Method
//! Operations better the worst tet of what they touch, also with more tets than before. Between walls much closer than their
//! triangles are wide all of these may be slivers: improvement ends with better worst angles and twice as many slivers then.
//! Where slivers are a large share of the mesh a copy is kept of the best state ([`State`]), and taken in the end.
//!
//! # Invariants
//! What is taken has no more slivers and no more tets that are bad off the boundary than what it replaces.
//!
//! # Cost
//! A copy of the mesh, only where slivers are a large share of up to a million tets: thin plates, needle parts.

use crate::mesh::tet_complex::TetComplex;

/// Share of slivers from which copies are kept. Between thin walls a third to nine tenths of the tets are slivers after a
/// pass; where there are few no copy is worth its memory.
const MANY: f64 = 0.25;
/// Most tets of a mesh that is copied, some 50 MB: a larger one may not double its memory for this.
const MOST_TETS: usize = 1 << 20;

/// What is wrong with a mesh; less is better.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct State {
    /// Tets off the boundary beyond the angles demanded: nothing forces these.
    pub bad_off_boundary: usize,
    /// Tets with an angle below 2 or above 178 degrees.
    pub slivers: usize,
}

/// The best mesh so far, with the size at each vertex.
#[derive(Debug, Default)]
pub struct FewestSlivers {
    best: Option<(State, TetComplex, Vec<f64>)>,
}

impl FewestSlivers {
    /// Keeps a copy of the mesh if slivers are a large share of it and it is better than what is kept.
    pub fn note(&mut self, complex: &TetComplex, sizes: &[f64], state: State) {
        let is_better = self.best.as_ref().is_none_or(|(best, ..)| state < *best);
        let count = complex.live_count();
        if is_better && count <= MOST_TETS && state.slivers as f64 > MANY * count as f64 {
            self.best = Some((state, complex.clone(), sizes.to_vec()));
        }
    }

    /// Puts the best mesh back if it is better than the present one; whether it was.
    pub fn restore(self, complex: &mut TetComplex, sizes: &mut Vec<f64>, state: State) -> bool {
        match self.best {
            Some((best, kept, kept_sizes)) if best < state && best.slivers <= state.slivers => {
                (*complex, *sizes) = (kept, kept_sizes);
                true
            }
            _ => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::test_meshes::random_mesh;

    fn state(bad_off_boundary: usize, slivers: usize) -> State {
        State { bad_off_boundary, slivers }
    }

    #[test]
    fn the_mesh_with_fewest_slivers_is_put_back() {
        let (first, second) = (random_mesh(1, 20), random_mesh(2, 40));
        let many = first.finite_tets().count().max(second.finite_tets().count());
        let after = |noted: State, end: State| {
            let mut fewest = FewestSlivers::default();
            fewest.note(&first, &[1.0; 20], noted);
            fewest.note(&second, &[2.0; 40], state(noted.bad_off_boundary, noted.slivers + 1));
            let (mut complex, mut sizes) = (second.clone(), vec![3.0; 40]);
            let restored = fewest.restore(&mut complex, &mut sizes, end);
            assert_eq!(restored, complex.finite_tets().eq(first.finite_tets()));
            assert_eq!(restored, sizes == [1.0; 20]);
            restored
        };
        assert!(after(state(0, many), state(0, many + 1)));
        assert!(!after(state(0, many), state(0, many)), "no better");
        assert!(!after(state(1, many), state(0, many + 5)), "worse off the boundary");
        assert!(!after(state(0, many), state(1, many - 1)), "more slivers");
        assert!(!after(state(0, first.finite_tets().count() / 5), state(0, many)), "few slivers need no copy");
    }
}
