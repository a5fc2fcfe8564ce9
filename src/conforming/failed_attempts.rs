//! What was tried at vertices in vain, so that it is not tried again before something has changed there.
//!
//! # Method
//! Each bad tet has its vertices moved and removed, and a vertex has many bad tets. On parts with needles, three of four searches
//! began where an earlier one had failed. A [`fingerprint`](Star::fingerprint) of all that an attempt depends on is kept
//! of each vertex where it failed last.
//!
//! # Invariants
//! Two stars with the same fingerprint are the same, but for one chance in 2^64; then a vertex stays as it is, and is valid.

use glam::DVec3;
use rustc_hash::FxHashMap;

use super::flip_criteria::{TetMeasure, Weight};
use super::smoothing::Star;
use super::spacing::Spacing;
use crate::index::VertexId;

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
    fn only_the_last_failure_counts() {
        let mut failed = FailedAttempts::default();
        assert!(!failed.has(VertexId(3), 7) && failed.last_at(VertexId(3)).is_none());
        failed.add(VertexId(3), 7);
        assert!(failed.has(VertexId(3), 7) && !failed.has(VertexId(4), 7));
        failed.add(VertexId(3), 8);
        assert!(!failed.has(VertexId(3), 7) && failed.last_at(VertexId(3)) == Some(8));
    }
}
