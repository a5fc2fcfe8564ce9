//! The advancing front: which tets are still too large or too flat, and which of their faces points advance from.
//!
//! # Method
//! 1. A tet is satisfied when every edge is shorter than `cdff` times the average size of its ends and its largest
//!    dihedral angle is below `angmax`; then it is marked and leaves the list of active tets.
//! 2. A face of an active tet belongs to the front when it lies on the boundary or on a satisfied tet.
//! 3. An active tet that outlives the insertion of its candidates rests until one of its neighbours becomes satisfied.
//!
//! # Source
//! [Drakopoulos2017] 4.7.1 (element activation and deactivation, front).
//!
//! # Differences
//! The list of active tets is always grouped (`ordt`); without grouping every pass visits all tets, as the thesis's
//! shuffled list does.
//!
//! # Invariants
//! New tets are active: their marks are clear. The marks are user bits 0 to 2 of the tet flags.
//!
//! # Cost
//! Linear in the tets that are new or woken, not in the mesh; the rule runs in parallel; deterministic.

use glam::DVec3;
use rayon::prelude::*;

use crate::geometry::tetrahedron::{edge_vectors, exceeds_angle};
use crate::index::{TetFace, TetId};
use crate::mesh::numbering::TET_EDGES;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;

/// The user bit that marks satisfied tets.
pub const SATISFIED: usize = 0;
/// The user bit of tets that rest: their candidates were inserted or found something too close, and so it will be until
/// a neighbour becomes satisfied, because candidates depend on the front faces only and points that reject them stay.
pub const RESTING: usize = 1;
/// The user bit of tets with an edge that is not short enough: points will replace them. The second objective leaves them
/// alone: long tets that are not Delaunay are not found by the cavities that should replace them, and ahead of a round
/// front, where all vertices lie nearly on a sphere, a few of them spoil the whole volume.
pub const UNSETTLED: usize = 2;
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
        self.is_short(corners, sizes) && !exceeds_angle(corners, self.angle_cosine)
    }

    /// Whether all edges of a tet are short enough.
    #[inline]
    pub fn is_short(&self, corners: [DVec3; 4], sizes: [f64; 4]) -> bool {
        let edges = edge_vectors(corners);
        TET_EDGES.iter().zip(edges).all(|([i, j], edge)| {
            let average = 0.5 * (sizes[*i] + sizes[*j]);
            edge.length_squared() < self.factor_squared * average * average
        })
    }
}

/// The sizes at the corners of a tet.
#[inline]
pub fn corner_sizes<S: TetStore + ?Sized>(store: &S, sizes: &[f64], tet: TetId) -> [f64; 4] {
    let [a, b, c, d] = store.vertices(tet);
    [sizes[a.index()], sizes[b.index()], sizes[c.index()], sizes[d.index()]]
}

/// What becomes of a listed tet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fate {
    /// Dead, a ghost or no longer of interest.
    Dropped,
    /// It does what the rule asks for.
    Done,
    /// It does not.
    Left,
}

/// Drops dead tets, ghosts and repetitions from `tets` (slots are used again at once, so some are listed several times);
/// marks those with an edge that is too long and returns the others.
pub fn settled_of(complex: &mut TetComplex, sizes: &[f64], rule: Satisfaction, tets: &mut Vec<TetId>) -> Vec<TetId> {
    let reader = &*complex;
    let fate = |&tet: &TetId| {
        if reader.flags(tet).is_deleted() || reader.is_ghost_tet(tet) {
            return Fate::Dropped;
        }
        let is_short = rule.is_short(reader.points_of(tet), corner_sizes(reader, sizes, tet));
        if is_short { Fate::Done } else { Fate::Left }
    };
    let fates: Vec<Fate> = tets.par_iter().with_min_len(CHUNK).map(fate).collect();
    let mut fates = fates.into_iter();
    let mut settled = Vec::new();
    tets.retain(|&tet| {
        let fate = fates.next().unwrap_or(Fate::Dropped);
        if fate == Fate::Dropped || complex.flags(tet).is_queued() {
            return false;
        }
        let flags = complex.flags(tet).with_queued(true);
        if fate == Fate::Done {
            settled.push(tet);
            complex.set_flags(tet, flags);
        } else {
            complex.set_flags(tet, flags.with_user_bit(UNSETTLED, true));
        }
        true
    });
    unqueue(complex, tets);
    settled
}

fn unqueue(complex: &mut TetComplex, tets: &[TetId]) {
    for &tet in tets {
        complex.set_flags(tet, complex.flags(tet).with_queued(false));
    }
}

/// Marks the satisfied tets of `active` and drops them, dead ones, repeated ones, ghosts and background from the list.
pub fn deactivate(complex: &mut TetComplex, sizes: &[f64], rule: Satisfaction, active: &mut Vec<TetId>) {
    let listed = std::mem::take(active);
    active.reserve(listed.len() / 2);
    let reader = &*complex;
    let fate = |&tet: &TetId| {
        let flags = reader.flags(tet);
        if flags.is_deleted()
            || flags.has_user_bit(SATISFIED)
            || reader.label(tet).is_background()
            || reader.is_ghost_tet(tet)
        {
            return Fate::Dropped;
        }
        let is_done =
            !flags.has_user_bit(UNSETTLED) && rule.holds(reader.points_of(tet), corner_sizes(reader, sizes, tet));
        if is_done { Fate::Done } else { Fate::Left }
    };
    let fates: Vec<Fate> = listed.par_iter().with_min_len(CHUNK).map(fate).collect();
    for (tet, fate) in listed.into_iter().zip(fates) {
        let flags = complex.flags(tet);
        if fate == Fate::Dropped || flags.is_queued() || flags.has_user_bit(SATISFIED) {
            continue;
        }
        if fate == Fate::Left {
            complex.set_flags(tet, flags.with_queued(true));
            active.push(tet);
            continue;
        }
        complex.set_flags(tet, flags.with_user_bit(SATISFIED, true));
        for side in complex.neighbors(tet) {
            // A new front face wakes the tet behind it.
            if side != TetFace::NONE && complex.flags(side.tet()).has_user_bit(RESTING) {
                let flags = complex.flags(side.tet()).with_user_bit(RESTING, false);
                complex.set_flags(side.tet(), flags);
                active.push(side.tet());
            }
        }
    }
    unqueue(complex, active);
}

/// Puts the tets of `active` to rest and empties the list: their candidates become vertices, which replaces most of the
/// tets, or find a vertex too close, which stays.
pub fn rest(complex: &mut TetComplex, active: &mut Vec<TetId>) {
    for tet in active.drain(..) {
        let flags = complex.flags(tet).with_user_bit(RESTING, true);
        complex.set_flags(tet, flags);
    }
}

/// Adds those of `tets` to the list that still rest.
pub fn wake(complex: &mut TetComplex, tets: impl Iterator<Item = TetId>, active: &mut Vec<TetId>) {
    for tet in tets {
        let flags = complex.flags(tet);
        if complex.is_live(tet) && flags.has_user_bit(RESTING) {
            complex.set_flags(tet, flags.with_user_bit(RESTING, false));
            active.push(tet);
        }
    }
}

/// Whether a face of an active tet belongs to the front.
#[inline]
pub fn is_front<S: TetStore + ?Sized>(store: &S, side: TetFace) -> bool {
    let other = store.neighbor(side);
    other == TetFace::NONE || store.is_face_constrained(side) || store.flags(other.tet()).has_user_bit(SATISFIED)
}
