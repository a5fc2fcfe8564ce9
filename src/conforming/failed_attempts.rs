//! What was tried in vain, so that it is not tried again before something has changed there.
//!
//! # Method
//! Each bad tet has its vertices moved and removed, and a vertex has many bad tets. On parts with needles, three of four searches
//! began where an earlier one had failed. A [`fingerprint`](Star::fingerprint) of all that an attempt depends on is kept
//! of each vertex where it failed last.
//!
//! The search for a new point beside a tet, dearer still, depends mostly on the balls of the tet's vertices
//! ([`ball_fingerprint`]); where polyhedra grow beyond them, a change farther away is not seen.
//!
//! # Invariants
//! Two stars with the same fingerprint are the same, but for one chance in 2^64; then a vertex stays as it is, and is valid.

use glam::DVec3;
use rustc_hash::{FxHashMap, FxHashSet};

use super::flip_criteria::{TetMeasure, Weight};
use super::smoothing::Star;
use super::spacing::Spacing;
use crate::index::{TetId, VertexId};
use crate::mesh::tet_store::TetStore;
use crate::mesh::topology::collect_ball;

/// Fingerprints of the attempts that failed last, by vertex.
#[derive(Debug, Clone, Default)]
pub struct FailedAttempts {
    of: FxHashMap<VertexId, u64>,
}

impl FailedAttempts {
    /// Whether the last attempt at the vertex failed, and was the same.
    #[inline]
    pub fn has(&self, vertex: VertexId, fingerprint: u64) -> bool {
        self.of.get(&vertex) == Some(&fingerprint)
    }

    /// The fingerprint of the attempt that failed last at the vertex.
    #[inline]
    pub fn last_at(&self, vertex: VertexId) -> Option<u64> {
        self.of.get(&vertex).copied()
    }

    /// Keeps a failed attempt in mind.
    pub fn add(&mut self, vertex: VertexId, fingerprint: u64) {
        self.of.insert(vertex, fingerprint);
    }
}

/// Most tets kept in mind; with more the list begins anew. 32 MB.
const MOST_TETS: usize = 1 << 20;

/// Fingerprints of the tets where all was in vain.
#[derive(Debug, Clone, Default)]
pub struct FailedTets {
    known: FxHashSet<u64>,
}

impl FailedTets {
    /// Whether all was in vain at such a tet.
    #[inline]
    pub fn has(&self, fingerprint: u64) -> bool {
        self.known.contains(&fingerprint)
    }

    /// Keeps a tet in mind.
    pub fn add(&mut self, fingerprint: u64) {
        if self.known.len() >= MOST_TETS {
            self.known.clear();
        }
        self.known.insert(fingerprint);
    }
}

/// A number that tells apart what lies around a tet whose vertices are claimed, `salt` being that of the attempt; the same
/// whatever the order of tets and vertices.
pub fn ball_fingerprint<S: TetStore + ?Sized>(store: &S, tet: TetId, salt: u64, ball: &mut Vec<TetId>) -> u64 {
    let of_point = |v: VertexId| match v.is_ghost() {
        true => 1,
        false => store.point(v).to_array().iter().fold(salt, |hash, c| mixed(hash, c.to_bits())),
    };
    let mut sum = 0u64;
    for vertex in store.vertices(tet) {
        collect_ball(store, vertex, tet, ball);
        for &at in ball.iter() {
            let corners = store.vertices(at).into_iter().fold(0u64, |hash, v| hash.wrapping_add(of_point(v)));
            sum = sum.wrapping_add(mixed(salt, corners));
        }
    }
    // The tet itself, which others around may resemble.
    mixed(sum, store.vertices(tet).into_iter().fold(0u64, |hash, v| hash.wrapping_add(of_point(v))))
}

/// The number of an attempt with such parameters.
pub fn salt_of(words: &[u64]) -> u64 {
    words.iter().fold(0, |hash, word| mixed(hash, *word))
}

/// One step of the hash: what two words have in common does not cancel.
#[inline]
fn mixed(hash: u64, word: u64) -> u64 {
    let product = (hash ^ word).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    product ^ (product >> 32)
}

impl Star {
    /// A number that tells apart stars, places in them, measures, and the lengths to be kept; the same whatever the order of
    /// the faces.
    pub fn fingerprint<M: TetMeasure>(&self, at: DVec3, spacing: Spacing<'_>) -> u64 {
        let of_point = |hash: u64, p: &DVec3| p.to_array().iter().fold(hash, |hash, c| mixed(hash, c.to_bits()));
        let of_weight = |weight: &Weight| match weight {
            Weight::Plain => 1,
            Weight::Strict => 2,
            Weight::Lenient => 3,
            Weight::Relieved(factor) => factor.to_bits(),
        };
        let faces = self.faces.iter().zip(&self.weights);
        let sum = faces.fold(0u64, |sum, (face, weight)| {
            sum.wrapping_add(face.iter().fold(mixed(M::KIND, of_weight(weight)), of_point))
        });
        [spacing.factor, spacing.longest].iter().fold(of_point(sum, &at), |hash, c| mixed(hash, c.to_bits()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::flip_criteria::{BiasedSine, MaxAngle};
    use crate::conforming::test_meshes::random_mesh;

    #[test]
    fn all_that_an_attempt_depends_on_is_in_the_fingerprint() {
        let [a, b, c, d] = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
        let star = |faces: &[[DVec3; 3]], weight| Star::of_faces(faces, weight);
        let faces = [[a, b, c], [a, c, d], [a, d, b], [b, d, c]];
        let at = DVec3::splat(0.2);
        let all = star(&faces, Weight::Plain);
        let same = star(&[faces[2], faces[0], faces[3], faces[1]], Weight::Plain);
        let print = all.fingerprint::<BiasedSine>(at, Spacing::FREE);
        assert_eq!(same.fingerprint::<BiasedSine>(at, Spacing::FREE), print, "the order of the faces is nothing");
        let kept = Spacing { factor: 0.5, ..Spacing::FREE };
        let mut others = vec![
            star(&faces[..3], Weight::Plain).fingerprint::<BiasedSine>(at, Spacing::FREE),
            star(&faces, Weight::Strict).fingerprint::<BiasedSine>(at, Spacing::FREE),
            star(&faces, Weight::Relieved(2.0)).fingerprint::<BiasedSine>(at, Spacing::FREE),
            star(&[faces[0], faces[1], faces[2], [c, d, b]], Weight::Lenient)
                .fingerprint::<BiasedSine>(at, Spacing::FREE),
            all.fingerprint::<MaxAngle>(at, Spacing::FREE),
            all.fingerprint::<BiasedSine>(0.5 * at, Spacing::FREE),
            all.fingerprint::<BiasedSine>(at, kept),
            print,
        ];
        others.sort_unstable();
        others.dedup();
        assert_eq!(others.len(), 8);
    }

    #[test]
    fn tets_are_known_until_something_changes_around_them() {
        let mut complex = random_mesh(5, 60);
        let tets: Vec<TetId> = complex.finite_tets().collect();
        let mut ball = Vec::new();
        let mut failed = FailedTets::default();
        for &tet in &tets {
            failed.add(ball_fingerprint(&complex, tet, 7, &mut ball));
        }
        assert_eq!(failed.known.len(), tets.len(), "all are told apart");
        assert!(!failed.has(ball_fingerprint(&complex, tets[0], salt_of(&[8]), &mut ball)));
        let moved = complex.vertices(tets[3])[0];
        collect_ball(&complex, moved, tets[3], &mut ball);
        let near: FxHashSet<VertexId> = ball.iter().flat_map(|&t| complex.vertices(t)).collect();
        complex.set_point(moved, complex.point(moved) + 1e-9 * DVec3::X);
        let mut ball = Vec::new();
        for &tet in &tets {
            // Tets with a vertex beside the moved one have it in their balls.
            let sees = complex.vertices(tet).iter().any(|v| near.contains(v));
            assert_eq!(failed.has(ball_fingerprint(&complex, tet, 7, &mut ball)), !sees);
        }
    }

    #[test]
    fn only_the_last_failure_counts() {
        let mut failed = FailedAttempts::default();
        assert!(!failed.has(VertexId(3), 7) && failed.last_at(VertexId(3)).is_none());
        failed.add(VertexId(3), 7);
        assert!(failed.has(VertexId(3), 7) && !failed.has(VertexId(4), 7));
        failed.add(VertexId(3), 8);
        assert!(!failed.has(VertexId(3), 7) && failed.last_at(VertexId(3)) == Some(8));
    }
}
