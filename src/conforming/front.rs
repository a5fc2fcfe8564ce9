//! The advancing front: which tets are still too large or too flat, and which of their faces points advance from.
//!
//! # Method
//! 1. A tet is satisfied when every edge is shorter than `cdff` times the average size of its ends and its largest
//!    dihedral angle is below `angmax`; then it is marked and leaves the list of active tets.
//! 2. A face of an active tet belongs to the front when it lies on the boundary or on a satisfied tet.
//!
//! # Source
//! [Drakopoulos2017] 4.7.1 (element activation and deactivation, front).
//!
//! # Differences
//! The list of active tets is always grouped (`ordt`); without grouping every pass visits all tets, as the thesis's
//! shuffled list does.
//!
//! # Invariants
//! New tets are active: their mark is clear. The mark is user bit 0 of the tet flags.
//!
//! # Cost
//! Linear in the active tets, parallel, deterministic.

use glam::DVec3;
use rayon::prelude::*;

use crate::geometry::tetrahedron::{dihedral_cosines, edge_vectors};
use crate::index::{TetFace, TetId};
use crate::mesh::numbering::TET_EDGES;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;

/// The user bit that marks satisfied tets.
pub const SATISFIED: usize = 0;
/// Tets per parallel chunk.
const CHUNK: usize = 1024;

/// When a tet is satisfied.
#[derive(Debug, Clone, Copy)]
pub struct Satisfaction {
    /// `cdff` squared.
    pub factor_squared: f64,
    /// Cosine of `angmax`.
    pub angle_cosine: f64,
}

impl Satisfaction {
    /// From `cdff` and `angmax` in degrees.
    pub fn new(factor: f64, angle: f64) -> Self {
        Self { factor_squared: factor * factor, angle_cosine: angle.to_radians().cos() }
    }

    /// Whether a tet with these corners and sizes is satisfied.
    #[inline]
    pub fn holds(&self, corners: [DVec3; 4], sizes: [f64; 4]) -> bool {
        let edges = edge_vectors(corners);
        let short = TET_EDGES.iter().zip(edges).all(|([i, j], edge)| {
            let average = 0.5 * (sizes[*i] + sizes[*j]);
            edge.length_squared() < self.factor_squared * average * average
        });
        short && dihedral_cosines(corners).1 > self.angle_cosine
    }
}

/// Marks the satisfied tets of `active` and drops them, dead ones, repeated ones, ghosts and background from the list.
pub fn deactivate(complex: &mut TetComplex, sizes: &[f64], rule: Satisfaction, active: &mut Vec<TetId>) {
    let mut unique = std::mem::take(active);
    unique.retain(|&tet| {
        let flags = complex.flags(tet);
        let keep = !flags.is_deleted()
            && !flags.is_queued()
            && !flags.has_user_bit(SATISFIED)
            && !complex.label(tet).is_background()
            && !complex.is_ghost_tet(tet);
        if keep {
            complex.set_flags(tet, flags.with_queued(true));
        }
        keep
    });
    let reader = &*complex;
    let satisfied: Vec<bool> = unique
        .par_iter()
        .with_min_len(CHUNK)
        .map(|&tet| rule.holds(reader.points_of(tet), reader.vertices(tet).map(|v| sizes[v.index()])))
        .collect();
    for (&tet, &done) in unique.iter().zip(&satisfied) {
        let flags = complex.flags(tet).with_queued(false);
        complex.set_flags(tet, flags.with_user_bit(SATISFIED, done));
    }
    let mut at = 0;
    unique.retain(|_| {
        at += 1;
        !satisfied[at - 1]
    });
    *active = unique;
}

/// Whether a face of an active tet belongs to the front.
#[inline]
pub fn is_front<S: TetStore + ?Sized>(store: &S, side: TetFace) -> bool {
    let other = store.neighbor(side);
    other == TetFace::NONE || store.is_face_constrained(side) || store.flags(other.tet()).has_user_bit(SATISFIED)
}
