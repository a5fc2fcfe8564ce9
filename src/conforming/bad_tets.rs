//! Where the improvement has to work: the tets that a rule finds bad, in the whole mesh or around what has changed.
//!
//! # Method
//! 1. A [`Scope`] marks vertices; a scan looks at the tets with marks enough.
//! 2. A scan sifts the tets in parallel chunks: bad ones worst first, by id where they are equally bad.
//! 3. What a scan finds good is kept in user bits of the tet's flags ([`Known`]), for the next to skip it.
//!
//! # Invariants
//! The order of the tets found does not depend on the number of threads.
//!
//! # Cost
//! Linear in the number of tets; of those known to be good the flags are read only.

use glam::DVec3;
use rayon::prelude::*;

use super::flip_criteria::{BiasedSine, TetMeasure, UnskewedSine};
use super::forced_slivers::sliver_cosine;
use super::parallel_reconnection::Touched;
use crate::context::RunContext;
use crate::geometry::tetrahedron::{dihedral_cosines, edge_vectors, exceeds_angle, face_skewness, volume6};
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::TET_FACES;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_flags::TetFlags;
use crate::mesh::tet_store::TetStore;

/// Tets per parallel chunk.
const CHUNK: usize = 2048;

/// Mark of a vertex whose tets are all within a scope.
const WHOLE: u8 = 3;
/// Mark of a vertex of a new tet: a tet is within a scope with three of these, as the new tet itself and those that share
/// a face with it. Round a vertex with many tets the others are as they were, and what failed there fails again.
const OF_NEW_TET: u8 = 1;

/// The tets that a scan looks at: all, or those whose vertices' marks add up to `WHOLE`. Vertices newer than the marks
/// count as whole.
#[derive(Default)]
pub struct Scope(Option<Vec<u8>>);

impl Scope {
    fn of_vertices(complex: &TetComplex, vertices: impl IntoIterator<Item = VertexId>) -> Self {
        let mut marks = vec![0; complex.vertex_count()];
        vertices.into_iter().filter(|v| !v.is_ghost()).for_each(|v| marks[v.index()] = WHOLE);
        Self(Some(marks))
    }

    /// What treatments changed, and the tets beside it.
    pub fn of_changes(complex: &TetComplex, changes: &Touched) -> Self {
        let mut marks = vec![0; complex.vertex_count()];
        changes.made.iter().filter(|v| !v.is_ghost()).for_each(|v| marks[v.index()] = OF_NEW_TET);
        changes.moved.iter().filter(|v| !v.is_ghost()).for_each(|v| marks[v.index()] = WHOLE);
        Self(Some(marks))
    }

    /// What treatments changed, and two rings of tets around it: as far as polyhedra grow.
    pub fn beside_changes(complex: &TetComplex, context: &RunContext, changes: Touched) -> Self {
        let mut scope = Self::of_vertices(complex, changes.made.into_iter().chain(changes.moved));
        scope.add_rings(complex, context, 1);
        scope
    }

    /// The vertices of some tets and `rings` rings around them.
    pub fn around(complex: &TetComplex, context: &RunContext, tets: &[TetId], rings: usize) -> Self {
        let mut scope = Self::of_vertices(complex, tets.iter().flat_map(|&t| complex.vertices(t)));
        scope.add_rings(complex, context, rings);
        scope
    }

    fn add_rings(&mut self, complex: &TetComplex, context: &RunContext, rings: usize) {
        for _ in 0..rings {
            let reached = context.install(|| complex.finite_tets_where(|tet| self.holds(&complex.vertices(tet))));
            *self = Self::of_vertices(complex, reached.into_iter().flat_map(|tet| complex.vertices(tet)));
        }
    }

    /// Whether not all tets are looked at.
    pub fn is_partial(&self) -> bool {
        self.0.is_some()
    }

    /// Whether a tet of these vertices is looked at.
    #[inline]
    pub fn holds(&self, row: &[VertexId]) -> bool {
        match &self.0 {
            None => true,
            Some(marks) => {
                let mark = |v: &VertexId| if v.is_ghost() { 0 } else { marks.get(v.index()).copied().unwrap_or(WHOLE) };
                row.iter().map(mark).sum::<u8>() >= WHOLE
            }
        }
    }
}

/// Tets of the scope, without those that `skips` knows from their flags: those that a rule finds bad, worst first, and the
/// others in the order of storage.
pub fn sift(
    complex: &TetComplex,
    context: &RunContext,
    scope: &Scope,
    skips: impl Fn(TetFlags) -> bool + Sync,
    is_bad: impl Fn(TetId) -> Option<f64> + Sync,
) -> (Vec<TetId>, Vec<TetId>) {
    let slots = complex.slot_count();
    let look_at = |chunk: usize| {
        let (mut bad, mut good): (Vec<(f64, TetId)>, Vec<TetId>) = (Vec::new(), Vec::new());
        for tet in (chunk * CHUNK..slots.min((chunk + 1) * CHUNK)).map(TetId::from_index) {
            let flags = complex.flags(tet);
            let usable = !flags.is_deleted()
                && !skips(flags)
                && scope.holds(&complex.vertices(tet))
                && !complex.label(tet).is_background()
                && !complex.is_ghost_tet(tet);
            if usable {
                match is_bad(tet) {
                    Some(grade) => bad.push((grade, tet)),
                    None => good.push(tet),
                }
            }
        }
        (bad, good)
    };
    let parts: Vec<_> = context.install(|| (0..slots.div_ceil(CHUNK)).into_par_iter().map(look_at).collect());
    let mut bad: Vec<(f64, TetId)> = Vec::new();
    let mut good = Vec::new();
    for (some_bad, some_good) in parts {
        bad.extend(some_bad);
        good.extend(some_good);
    }
    // By id within a grade: the same order for any thread count.
    bad.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    (bad.into_iter().map(|(_, tet)| tet).collect(), good)
}

/// Whether a tet has a dihedral angle above `degrees`, as its cosine.
fn angle_above(complex: &TetComplex, degrees: f64) -> impl Fn(TetId) -> Option<f64> + Sync + '_ {
    let limit = degrees.to_radians().cos();
    move |tet| {
        let corners = complex.points_of(tet);
        exceeds_angle(corners, limit).then(|| dihedral_cosines(corners).1)
    }
}

/// Whether a tet has a grade below `limit`, as that grade.
pub fn grade_below(complex: &TetComplex, limit: f64) -> impl Fn(TetId) -> Option<f64> + Sync + '_ {
    move |tet| {
        let grade = BiasedSine.grade(complex.points_of(tet));
        (grade < limit).then_some(grade)
    }
}

/// The user bit of tets without an angle above that of [`Known`].
const BLUNT: usize = 0;
/// The user bit of tets whose grade is at least that of [`Known`].
const GRADED: usize = 1;

/// What user bits say of tets from one scan to the next: most are good from the first pass on. New tets have none of them,
/// and moving a vertex takes them away.
pub struct Known {
    /// Degrees.
    pub angle: f64,
    /// As [`BiasedSine`] has it.
    pub grade: f64,
}

impl Known {
    /// Tets of the scope with a dihedral angle above `degrees`, largest first.
    pub fn tets_above(
        &self,
        complex: &mut TetComplex,
        context: &RunContext,
        scope: &Scope,
        degrees: f64,
    ) -> Vec<TetId> {
        let is_blunt_enough = degrees >= self.angle;
        let is_good_enough = degrees >= 90.0 && BiasedSine::grade_of_angles(90.0, degrees) <= self.grade;
        let skips = |flags: TetFlags| {
            is_blunt_enough && flags.has_user_bit(BLUNT) || is_good_enough && flags.has_user_bit(GRADED)
        };
        let (bad, good) = sift(complex, context, scope, skips, angle_above(complex, degrees));
        if degrees <= self.angle {
            Self::mark(complex, &good, BLUNT);
        }
        bad
    }

    /// Tets of the scope with a grade below `limit`, worst first.
    pub fn tets_below(&self, complex: &mut TetComplex, context: &RunContext, scope: &Scope, limit: f64) -> Vec<TetId> {
        let skips = |flags: TetFlags| limit <= self.grade && flags.has_user_bit(GRADED);
        let (bad, good) = sift(complex, context, scope, skips, grade_below(complex, limit));
        if limit >= self.grade {
            Self::mark(complex, &good, GRADED);
        }
        bad
    }

    fn mark(complex: &mut TetComplex, tets: &[TetId], bit: usize) {
        for &tet in tets {
            complex.set_flags(tet, complex.flags(tet).with_user_bit(bit, true));
        }
    }

    /// Takes all bits away, for the next engine.
    pub fn forget(complex: &mut TetComplex) {
        for tet in (0..complex.slot_count()).map(TetId::from_index) {
            let flags = complex.flags(tet);
            if !flags.is_deleted() {
                complex.set_flags(tet, flags.without_user_bits());
            }
        }
    }
}

/// Number of slivers: tets with an angle below 2 or above 178 degrees.
pub fn sliver_count(complex: &TetComplex, context: &RunContext) -> usize {
    slivers(complex, context).len()
}

/// The slivers, flattest first.
pub fn slivers(complex: &TetComplex, context: &RunContext) -> Vec<TetId> {
    let sliver = |tet: TetId| sliver_cosine(complex.points_of(tet));
    sift(complex, context, &Scope::default(), |_| false, sliver).0
}

/// Whether a face of the tet may be skew. The apex of one stands more than 12 of the face's extents beside its centroid
/// and at most 1 / 1.2 of that above it: six times the volume is less than 0.082 of the cube of the longest edge.
fn may_be_skew(corners: [DVec3; 4]) -> bool {
    const MOST: f64 = 0.082;
    let squared = edge_vectors(corners).into_iter().map(|edge| edge.length_squared()).fold(0.0, f64::max);
    volume6(corners).powi(2) < MOST * MOST * squared.powi(3)
}

/// The tets with faces that solvers find skew, the skewest face first.
pub fn tets_with_skew_faces(complex: &TetComplex, context: &RunContext, scope: &Scope) -> Vec<TetId> {
    let is_skew = |tet: TetId| {
        if !may_be_skew(complex.points_of(tet)) {
            return None;
        }
        let (row, neighbors) = (complex.vertices(tet), complex.neighbors(tet));
        let skewness = |face: usize| {
            let other = neighbors[face];
            let beyond = (other != TetFace::NONE && !complex.label(other.tet()).is_background())
                .then(|| complex.apex(other))
                .filter(|apex| !apex.is_ghost())
                .map(|apex| complex.point(apex));
            let corners = TET_FACES[face].map(|local| complex.point(row[local]));
            face_skewness(corners, complex.point(row[face]), beyond)
        };
        let worst = (0..4).map(skewness).fold(0.0, f64::max);
        (worst > UnskewedSine::SKEW).then_some(-worst)
    };
    sift(complex, context, scope, |_| false, is_skew).0
}

/// The vertices of some tets, each once, ascending.
pub fn vertices_of(complex: &TetComplex, tets: &[TetId]) -> Vec<VertexId> {
    let Scope(marks) = Scope::of_vertices(complex, tets.iter().flat_map(|&t| complex.vertices(t)));
    let marks = marks.into_iter().flatten().enumerate();
    marks.filter(|(_, mark)| *mark > 0).map(|(v, _)| VertexId::from_index(v)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::Label;

    #[test]
    fn what_new_tets_do_not_touch_is_not_tried_again() {
        // A fan of tets around the edge 0 1: 2 3, 3 4, ..., 6 7.
        let mut points = vec![DVec3::ZERO, DVec3::Z];
        points.extend((0..6).map(|i| {
            let turn = 0.9 * f64::from(i);
            DVec3::new(turn.cos(), turn.sin(), 0.5)
        }));
        let mut complex = TetComplex::with_points(points).unwrap();
        for i in 2..7 {
            complex.create_tet([0, 1, i, i + 1].map(VertexId), Label(1)).unwrap();
        }
        let held = |changes: &Touched| {
            let scope = Scope::of_changes(&complex, changes);
            complex.finite_tets().map(|tet| scope.holds(&complex.vertices(tet))).collect::<Vec<_>>()
        };
        let made = Touched { made: complex.vertices(TetId::from_index(2)).to_vec(), moved: Vec::new() };
        assert_eq!(held(&made), [false, true, true, true, false]);
        let moved = Touched { made: Vec::new(), moved: vec![VertexId(7)] };
        assert_eq!(held(&moved), [false, false, false, false, true]);
        assert!(Scope::of_changes(&complex, &Touched::default()).holds(&[VertexId(8)]), "newer than the marks");
    }
}
