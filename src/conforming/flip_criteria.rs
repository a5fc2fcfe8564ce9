//! What a flip improves: measures of one tet, and the objective functions over configurations.
//!
//! # Method
//! A [`TetMeasure`] grades one tet, higher is better, at most 0 for a tet that is flat or inverted; a configuration is
//! as good as its worst tet. The Laplacian edge weight grades a whole configuration, because the tets at an edge add up.
//!
//! # Source
//! 1. In-sphere criterion: [Drakopoulos2017] 4.7, figure 68a.
//! 2. Max-min Laplacian edge weight: [Drakopoulos2017] 4.7, figure 68b; [Barth1991]: the weight of an edge is the sum
//!    over its tets of -(n_k . n_l) / V, with the area vectors of the two faces opposite to the edge's ends.
//! 3. Min-max skew: the largest dihedral angle; [Drakopoulos2017] B.3 `mrecm 3`, 4.5.
//! 4. Biased minimum sine: [KlingnerShewchuk2007] section 2.
//! 5. The same with skew faces shunned: skewness as [OpenFOAM] defines it.
//!
//! # Differences
//! The weight of an edge on the border of a configuration counts only the tets inside: what lies outside is the same
//! before and after.
//!
//! # Invariants
//! Measures are floating point: exact orientation decides validity, in `flips`.

use glam::DVec3;

use super::needle_faces::NeedleFaces;
use crate::geometry::predicates::{insphere, orient3d};
use crate::geometry::tetrahedron::{dihedral_cosines, face_normals, largest_skewness, volume6};
use crate::index::{TetFace, VertexId};
use crate::mesh::numbering::TET_EDGES;
use crate::mesh::tet_store::TetStore;

/// Grades one tet by its points in positive order.
pub trait TetMeasure {
    /// Tells measures apart where results are kept in mind.
    const KIND: u64;

    /// The grade: higher is better, at most 0 when flat or inverted.
    fn grade(&self, corners: [DVec3; 4]) -> f64;

    /// The direction in which the grade grows fastest when the last corner moves, of any length; by difference quotients
    /// over `2 h` where a measure knows no better.
    fn slope(&self, [a, b, c, at]: [DVec3; 4], h: f64) -> DVec3 {
        let along = |axis: DVec3| self.grade([a, b, c, at + h * axis]) - self.grade([a, b, c, at - h * axis]);
        DVec3::new(along(DVec3::X), along(DVec3::Y), along(DVec3::Z))
    }

    /// Whether tets whose vertices beside the one being moved or inserted are these get the grade of [`strict`].
    #[inline]
    fn is_strict(&self, _vertices: &[VertexId]) -> bool {
        false
    }

    /// How the grade of tets with these vertices, beside one being moved or inserted, counts.
    #[inline]
    fn weight(&self, vertices: &[VertexId]) -> Weight {
        if self.is_strict(vertices) { Weight::Strict } else { Weight::Plain }
    }
}

/// How the grade of a tet counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Weight {
    /// As it is.
    Plain,
    /// As [`strict`] makes it.
    Strict,
    /// Times a factor, for what the boundary forces.
    Relieved(f64),
    /// As [`lenient`] makes it.
    Lenient,
}

impl Weight {
    /// What a grade counts.
    #[inline]
    pub fn of(self, grade: f64) -> f64 {
        match self {
            Self::Plain => grade,
            Self::Strict => strict(grade),
            Self::Relieved(factor) => grade * factor,
            Self::Lenient => lenient(grade),
        }
    }
}

/// Every valid tet is as good as any other: for boundary recovery.
#[derive(Debug, Clone, Copy, Default)]
pub struct AnyPositive;

impl TetMeasure for AnyPositive {
    const KIND: u64 = 0;

    #[inline]
    fn grade(&self, [a, b, c, d]: [DVec3; 4]) -> f64 {
        if orient3d(a, b, c, d) > 0.0 { 1.0 } else { -1.0 }
    }
}

/// Weight of an obtuse angle's sine: between 0.62, where the angles aimed at, 18 and 150 degrees, get the same grade, and
/// 0.555, where those demanded do, 12 and 158.
const OBTUSE_WEIGHT: f64 = 0.58;

/// The smallest sine of the dihedral angles, sines of obtuse angles reduced.
#[derive(Debug, Clone, Copy, Default)]
pub struct BiasedSine;

impl BiasedSine {
    /// The grade of a tet whose smallest angle is `min` and whose largest angle is `max` degrees.
    pub fn grade_of_angles(min: f64, max: f64) -> f64 {
        let sine = |degrees: f64| {
            let weight = if degrees > 90.0 { OBTUSE_WEIGHT } else { 1.0 };
            weight * degrees.to_radians().sin()
        };
        sine(min).min(sine(max))
    }
}

impl TetMeasure for BiasedSine {
    const KIND: u64 = 1;

    #[inline]
    fn grade(&self, corners: [DVec3; 4]) -> f64 {
        let six_volume = volume6(corners);
        if six_volume <= 0.0 {
            return six_volume.min(0.0);
        }
        let normals = face_normals(corners);
        // Written out: closures over arrays are not inlined reliably, and this is the hottest function of improvement.
        let inverse = [
            normals[0].length_squared().recip(),
            normals[1].length_squared().recip(),
            normals[2].length_squared().recip(),
            normals[3].length_squared().recip(),
        ];
        // The faces k and l meet at the edge i j: sin^2 = (6 V |ij|)^2 / (|n_k|^2 |n_l|^2).
        let at_edge = |i: usize, j: usize, k: usize, l: usize| {
            let squared = (corners[j] - corners[i]).length_squared() * inverse[k] * inverse[l];
            let is_obtuse = normals[k].dot(normals[l]) > 0.0;
            if is_obtuse { squared * (OBTUSE_WEIGHT * OBTUSE_WEIGHT) } else { squared }
        };
        let first = at_edge(0, 1, 2, 3).min(at_edge(0, 2, 1, 3)).min(at_edge(0, 3, 1, 2));
        let second = at_edge(1, 2, 0, 3).min(at_edge(1, 3, 0, 2)).min(at_edge(2, 3, 0, 1));
        let worst = first.min(second);
        let grade = six_volume * worst.sqrt();
        if grade.is_finite() { grade } else { 0.0 }
    }

    /// The gradient of the logarithm: of volume and length of the worst edge, less those of the two areas beside it.
    fn slope(&self, corners: [DVec3; 4], _h: f64) -> DVec3 {
        let [a, b, c, at] = corners;
        let up = (b - a).cross(c - a);
        let six_volume = volume6(corners);
        if six_volume <= 0.0 {
            return up;
        }
        let normals = face_normals(corners);
        let inverse = normals.map(|normal| normal.length_squared().recip());
        let squared_sine = |[i, j]: [usize; 2]| {
            let [k, l] = opposite([i, j]);
            let squared = (corners[j] - corners[i]).length_squared() * inverse[k] * inverse[l];
            let is_obtuse = normals[k].dot(normals[l]) > 0.0;
            if is_obtuse { squared * (OBTUSE_WEIGHT * OBTUSE_WEIGHT) } else { squared }
        };
        let (mut least, mut worst) = (f64::INFINITY, TET_EDGES[0]);
        for edge in TET_EDGES {
            let value = squared_sine(edge);
            if value < least {
                (least, worst) = (value, edge);
            }
        }
        let mut slope = up / six_volume;
        if let [end, 3] | [3, end] = worst {
            slope += (at - corners[end]) / at.distance_squared(corners[end]);
        }
        for face in opposite(worst).into_iter().filter(|face| *face != 3) {
            // The area grows with the height over the edge that the face shares with a b c.
            let [p, q] = match face {
                0 => [b, c],
                1 => [a, c],
                _ => [a, b],
            };
            let along = (q - p).normalize_or_zero();
            let height = (at - p) - (at - p).dot(along) * along;
            slope -= height / height.length_squared();
        }
        if slope.is_finite() { slope } else { up }
    }
}

/// The local vertices that an edge leaves.
#[inline]
fn opposite([i, j]: [usize; 2]) -> [usize; 2] {
    let all = [0, 1, 2, 3];
    let mut others = [0; 2];
    let mut count = 0;
    for local in all {
        if local != i && local != j {
            others[count] = local;
            count += 1;
        }
    }
    others
}

/// The angle that tets off the boundary are expected to reach at any price for those on it, degrees. The large angle of
/// the same grade is 153.5.
pub const STRICT_ANGLE: f64 = 15.0;

/// The grade of a tet that nothing forces to be bad: below `STRICT_ANGLE` it falls with the thirteenth power, so that no
/// operation pays for a better tet at the boundary, where the surface may force bad angles, with a bad one off it.
#[inline]
pub fn strict(grade: f64) -> f64 {
    let limit = STRICT_ANGLE.to_radians().sin();
    if grade >= limit || grade <= 0.0 { grade } else { grade * (grade / limit).powi(12) }
}

/// The grade of a tet at the boundary where those off it are to be bettered at any price: its eighth root, so that a tet of a
/// hundredth of a degree counts as much as one off the boundary of 15 degrees.
#[inline]
pub fn lenient(grade: f64) -> f64 {
    if grade <= 0.0 { grade } else { grade.sqrt().sqrt().sqrt() }
}

/// The biased sine; tets with skew faces are bad, the skewer the worse: but, up to a skewness of 100, not as bad as
/// [`strict`] makes tets off the boundary at the angles demanded, 12 and 158 degrees.
#[derive(Debug, Clone, Copy, Default)]
pub struct UnskewedSine;

impl UnskewedSine {
    /// Faces of a larger skewness are skew. Solvers ask for less than 4.
    pub const SKEW: f64 = 3.0;
    /// The grade of a tet with a face of that skewness: that of the angle below which a tet at the boundary is bad.
    pub const GRADE: f64 = 0.17;
}

impl TetMeasure for UnskewedSine {
    const KIND: u64 = 2;

    fn grade(&self, corners: [DVec3; 4]) -> f64 {
        let grade = BiasedSine.grade(corners);
        let skewness = if grade > 0.0 { largest_skewness(corners) } else { 0.0 };
        if skewness > Self::SKEW { grade.min(Self::GRADE * (Self::SKEW / skewness).sqrt()) } else { grade }
    }
}

/// A grade of angles, strict with tets that have no vertex on the boundary.
#[derive(Debug, Clone, Copy)]
pub struct StrictInside<'a, G = BiasedSine> {
    /// The grade of angles.
    pub angles: G,
    /// Which vertices lie on the boundary; those beyond the end do not.
    pub on_boundary: &'a [bool],
    /// What counts as better than it is.
    pub relief: Relief<'a>,
}

/// Which tets at the boundary count as better than they are.
#[derive(Debug, Clone, Copy, Default)]
pub enum Relief<'a> {
    /// None.
    #[default]
    Nothing,
    /// Those on needles, which are forced to be bad.
    Needles(&'a NeedleFaces),
    /// All ([`lenient`]).
    Boundary,
}

impl<G: TetMeasure> TetMeasure for StrictInside<'_, G> {
    const KIND: u64 = 16 + G::KIND;

    #[inline]
    fn grade(&self, corners: [DVec3; 4]) -> f64 {
        self.angles.grade(corners)
    }

    #[inline]
    fn slope(&self, corners: [DVec3; 4], h: f64) -> DVec3 {
        self.angles.slope(corners, h)
    }

    #[inline]
    fn is_strict(&self, vertices: &[VertexId]) -> bool {
        !vertices.iter().any(|v| self.on_boundary.get(v.index()).copied().unwrap_or(false))
    }

    #[inline]
    fn weight(&self, vertices: &[VertexId]) -> Weight {
        if self.is_strict(vertices) {
            return Weight::Strict;
        }
        match self.relief {
            Relief::Nothing => Weight::Plain,
            Relief::Boundary => Weight::Lenient,
            Relief::Needles(needles) => match needles.relief(vertices) {
                factor if factor > 1.0 => Weight::Relieved(factor),
                _ => Weight::Plain,
            },
        }
    }
}

/// One plus the cosine of the largest dihedral angle: the min-max skew criterion.
#[derive(Debug, Clone, Copy, Default)]
pub struct MaxAngle;

impl TetMeasure for MaxAngle {
    const KIND: u64 = 3;

    #[inline]
    fn grade(&self, corners: [DVec3; 4]) -> f64 {
        if volume6(corners) <= 0.0 { 0.0 } else { 1.0 + dihedral_cosines(corners).1 }
    }
}

/// Whether the apex beyond `side` lies inside the circumsphere of the tet of `side`; false at the hull.
#[inline]
pub fn violates_in_sphere<S: TetStore + ?Sized>(store: &S, side: TetFace) -> bool {
    let other = store.neighbor(side);
    if other == TetFace::NONE {
        return false;
    }
    let apex = store.apex(other);
    let vertices = store.vertices(side.tet());
    if apex.is_ghost() || vertices.contains(&VertexId::GHOST) {
        return false;
    }
    let [a, b, c, d] = store.corners(vertices);
    insphere(a, b, c, d, store.point(apex)) > 0.0
}

/// Most tets of a configuration graded by its edge weights.
pub const MAX_WEIGHTED: usize = 8;

/// The smallest Laplacian edge weight of a configuration of at most [`MAX_WEIGHTED`] tets; minus infinite when a tet is
/// flat or inverted.
pub fn min_edge_weight<S: TetStore + ?Sized>(store: &S, tets: &[[VertexId; 4]]) -> f64 {
    debug_assert!(tets.len() <= MAX_WEIGHTED);
    // Tets of a configuration share faces: each adds at most one vertex to the first four.
    let mut vertices = [VertexId::GHOST; MAX_WEIGHTED + 3];
    let mut count = 0;
    // The sum of the edge between the local vertices i > j at i (i - 1) / 2 + j.
    let mut sums = [0.0f64; (MAX_WEIGHTED + 3) * (MAX_WEIGHTED + 2) / 2];
    let mut seen = 0u64;
    for tet in tets {
        let corners = store.corners(*tet);
        let six_volume = volume6(corners);
        if six_volume <= 0.0 {
            return f64::NEG_INFINITY;
        }
        let mut local = [0usize; 4];
        for (number, vertex) in local.iter_mut().zip(tet) {
            *number = vertices[..count].iter().position(|v| v == vertex).unwrap_or_else(|| {
                vertices[count] = *vertex;
                count += 1;
                count - 1
            });
        }
        let normals = face_normals(corners);
        let scale = -six_volume.recip();
        for [i, j] in TET_EDGES {
            let (high, low) = (local[i].max(local[j]), local[i].min(local[j]));
            let edge = high * (high - 1) / 2 + low;
            // The faces opposite to the ends of the edge.
            sums[edge] += scale * normals[i].dot(normals[j]);
            seen |= 1 << edge;
        }
    }
    let mut smallest = f64::INFINITY;
    while seen != 0 {
        smallest = smallest.min(sums[seen.trailing_zeros() as usize]);
        seen &= seen - 1;
    }
    smallest
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::tetrahedron::dihedral_range;

    #[test]
    fn biased_sine_follows_the_angles() {
        let tets = [
            [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z],
            [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::new(0.4, 0.4, 0.1)],
            [DVec3::ZERO, DVec3::X, DVec3::new(0.9, 0.2, 0.0), DVec3::Z],
        ];
        for tet in tets {
            let range = dihedral_range(tet);
            let expected = BiasedSine::grade_of_angles(range.min, range.max);
            assert!((BiasedSine.grade(tet) - expected).abs() < 1e-12);
            let skew = 1.0 + range.max.to_radians().cos();
            assert!((MaxAngle.grade(tet) - skew).abs() < 1e-12);
        }
    }

    #[test]
    fn slopes_are_those_of_the_grade() {
        // A measure that knows of differences only.
        struct Numeric;
        impl TetMeasure for Numeric {
            const KIND: u64 = 99;
            fn grade(&self, corners: [DVec3; 4]) -> f64 {
                BiasedSine.grade(corners)
            }
        }
        let mut seed = 5u64;
        let mut random = || {
            seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (seed >> 11) as f64 / (1u64 << 53) as f64
        };
        let mut compared = 0;
        for _ in 0..300 {
            let mut corners = [DVec3::ZERO; 4].map(|_| DVec3::new(random(), random(), random()));
            if volume6(corners) < 0.0 {
                corners.swap(0, 1);
            }
            let (exact, numeric) = (BiasedSine.slope(corners, 1e-6), Numeric.slope(corners, 1e-6));
            // Where two edges are equally bad, differences lie between their slopes.
            compared += usize::from(exact.angle_between(numeric) < 1e-3);
        }
        assert!(compared >= 297, "{compared} of 300");
        let flat = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::new(0.3, 0.3, -0.1)];
        assert!(BiasedSine.slope(flat, 1e-6).angle_between(DVec3::Z) < 1e-9, "out of what is inverted");
    }

    #[test]
    fn strict_grades_keep_their_order_and_fall_below_the_limit() {
        let limit = STRICT_ANGLE.to_radians().sin();
        assert_eq!(strict(limit), limit);
        assert!(strict(0.9 * limit) > strict(0.8 * limit) && strict(0.8 * limit) > 0.0);
        // A tet off the boundary at 12 degrees counts less than one on it at 5.
        assert!(strict(12.0f64.to_radians().sin()) < 6.0f64.to_radians().sin());
        // With leniency at the boundary, less than one there of a hundredth of a degree.
        let sliver = 0.01f64.to_radians().sin();
        assert!(lenient(sliver) > limit && lenient(0.5 * sliver) < lenient(sliver) && lenient(-1.0) == -1.0);
        let measure = StrictInside { angles: BiasedSine, on_boundary: &[true, false], relief: Relief::Nothing };
        assert!(!measure.is_strict(&[VertexId(0), VertexId(1)]) && measure.is_strict(&[VertexId(1), VertexId(9)]));
    }

    #[test]
    fn skew_faces_make_a_tet_bad() {
        // A spire over a small triangle: leaning, its angles stay good for long.
        let spire = |lean: f64| [DVec3::ZERO, DVec3::X, DVec3::new(0.5, 0.8, 0.0), DVec3::new(0.5 + lean, 0.3, 12.0)];
        assert_eq!(UnskewedSine.grade(spire(2.0)), BiasedSine.grade(spire(2.0)));
        let (skew, skewer) = (UnskewedSine.grade(spire(16.0)), UnskewedSine.grade(spire(20.0)));
        assert!(skewer < skew && skew <= UnskewedSine::GRADE && BiasedSine.grade(spire(16.0)) > skew);
    }

    #[test]
    fn flat_and_inverted_tets_grade_at_most_zero() {
        let flat = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::new(1.0, 1.0, 0.0)];
        let inverted = [DVec3::ZERO, DVec3::Y, DVec3::X, DVec3::Z];
        for tet in [flat, inverted, [DVec3::ZERO; 4]] {
            assert!(BiasedSine.grade(tet) <= 0.0 && MaxAngle.grade(tet) <= 0.0 && AnyPositive.grade(tet) <= 0.0);
        }
    }
}
