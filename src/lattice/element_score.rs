//! One figure for the shape of a tet, and of the ball of a vertex that may move.
//!
//! # Method
//! - The score of a tet is its smallest dihedral angle in degrees, or 0.6 times what the largest lacks to 180 where that is
//!   less; inverted tets rank below zero by how far they are inverted.
//! - Angles are compared by the squares of their cosines with the cosines' signs, which need no roots; the angle itself, by a
//!   polynomial, is taken once per tet or per ball.
//! - A [`Ball`] keeps for each tet of a vertex what does not change when the vertex moves: the opposite face, its normal and
//!   its area. A trial that fails is remembered: the tet that failed it is asked first by the next trial.
//!
//! # Source
//! [AbramowitzStegun1964] 4.4.46 for the arc cosine.
//!
//! # Cost
//! About 80 multiplications per tet and trial; a failing trial mostly costs one tet.

use glam::DVec3;

use crate::geometry::tetrahedron::{edge_vectors, face_normals, volume6};
use crate::lattice::scaffold::SCAFFOLD_ANGLE;

/// The largest angle counts this much less than the smallest: 15 and 155 degrees score alike.
const LARGE_ANGLE_WEIGHT: f64 = 0.6;

/// Cosines at their worst over some tets, as signed squares.
#[derive(Debug, Clone, Copy)]
struct Worst {
    /// Of the smallest angle.
    acute: f64,
    /// Of what the largest angle lacks to 180 degrees.
    obtuse: f64,
    /// Below zero where a tet is flat or inverted: how far.
    inverted: f64,
}

impl Worst {
    const NONE: Self = Self { acute: -1.0, obtuse: -1.0, inverted: 0.0 };

    #[inline]
    fn join(self, other: Self) -> Self {
        let larger = |a: f64, b: f64| if a > b { a } else { b };
        Self {
            acute: larger(self.acute, other.acute),
            obtuse: larger(self.obtuse, other.obtuse),
            inverted: self.inverted.min(other.inverted),
        }
    }

    /// Whether a join that began with `other` has become worse than that.
    #[inline]
    fn is_below(&self, other: &Self) -> bool {
        self.acute > other.acute || self.obtuse > other.obtuse || self.inverted < other.inverted
    }

    /// Degrees; zero or negative for flat and inverted tets.
    #[inline]
    fn score(self) -> f64 {
        if self.inverted < 0.0 {
            return self.inverted;
        }
        let angle = |square: f64| angle_of(square.abs().sqrt().copysign(square));
        angle(self.acute).min(LARGE_ANGLE_WEIGHT * angle(self.obtuse))
    }
}

/// The arc cosine in degrees, within 2e-6 degrees, decreasing. [AbramowitzStegun1964] 4.4.46.
#[inline]
fn angle_of(cosine: f64) -> f64 {
    const TERMS: [f64; 8] = [
        1.570_796_305_0,
        -0.214_598_801_6,
        0.088_978_987_4,
        -0.050_174_304_6,
        0.030_891_881_0,
        -0.017_088_125_6,
        0.006_670_090_1,
        -0.001_262_491_1,
    ];
    let x = cosine.abs().min(1.0);
    let sum = TERMS.iter().rev().fold(0.0, |sum, term| sum * x + term);
    let angle = ((1.0 - x).sqrt() * sum).to_degrees();
    if cosine < 0.0 { 180.0 - angle } else { angle }
}

/// The square of a number with its sign: it orders as the number does.
#[inline]
fn signed_square(x: f64) -> f64 {
    x * x.abs()
}

/// A score to be reached, as the cosines that may not be passed.
#[derive(Debug, Clone, Copy)]
pub struct Threshold {
    own: Limits,
    scaffold: Limits,
}

/// Cosines that the angles of a tet may not pass, as signed squares.
#[derive(Debug, Clone, Copy)]
struct Limits {
    acute: f64,
    obtuse: f64,
    inverted: f64,
}

/// What a tet is part of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// The mesh.
    Mesh,
    /// The scaffold around it, whose shape counts only where it is nearly flat.
    Scaffold,
}

impl Part {
    /// A score of a tet of this part as the rest is compared with it.
    #[inline]
    fn weighted(self, score: f64) -> f64 {
        if self == Self::Scaffold && score >= SCAFFOLD_ANGLE { f64::INFINITY } else { score }
    }
}

impl Threshold {
    /// The threshold of a score in degrees.
    pub fn of(score: f64) -> Self {
        Self { own: Limits::of(score), scaffold: Limits::of(score.min(SCAFFOLD_ANGLE)) }
    }

    #[inline]
    fn limits(&self, part: Part) -> &Limits {
        match part {
            Part::Mesh => &self.own,
            Part::Scaffold => &self.scaffold,
        }
    }
}

impl Limits {
    fn of(score: f64) -> Self {
        if score <= 0.0 {
            // Only tets that are inverted further fail.
            return Self { acute: f64::INFINITY, obtuse: f64::INFINITY, inverted: score };
        }
        let cosine = |degrees: f64| signed_square(degrees.min(180.0).to_radians().cos());
        Self { acute: cosine(score), obtuse: cosine(score / LARGE_ANGLE_WEIGHT), inverted: 0.0 }
    }

    #[inline]
    fn is_failed_by(&self, worst: &Worst) -> bool {
        worst.acute > self.acute || worst.obtuse > self.obtuse || worst.inverted < self.inverted
    }
}

/// Rank of a flat or inverted tet: below zero by its volume against its size.
#[cold]
fn inversion_of(volume: f64, corners: [DVec3; 4]) -> f64 {
    let size = edge_vectors(corners).iter().map(|e| e.length_squared()).fold(0.0, f64::max);
    if size > 0.0 { (volume / (size * size.sqrt())).clamp(-1.0, 0.0) * 10.0 - 1e-3 } else { -10.0 }
}

#[inline]
fn worst_of(normals: [DVec3; 4], scale: [f64; 4]) -> Worst {
    let (mut acute, mut obtuse) = (-1.0f64, -1.0f64);
    for (k, l) in [(2, 3), (1, 3), (1, 2), (0, 3), (0, 2), (0, 1)] {
        let cosine = -signed_square(normals[k].dot(normals[l])) * (scale[k] * scale[l]);
        acute = if cosine > acute { cosine } else { acute };
        obtuse = if -cosine > obtuse { -cosine } else { obtuse };
    }
    Worst { acute, obtuse, inverted: 0.0 }
}

#[inline]
fn worst_of_tet(corners: [DVec3; 4]) -> Worst {
    let volume = volume6(corners);
    let normals = face_normals(corners);
    let scale = scales_of(&normals);
    if !(volume > 0.0) || !scale.iter().all(|s| s.is_finite()) {
        return Worst { inverted: inversion_of(volume, corners), ..Worst::NONE };
    }
    worst_of(normals, scale)
}

/// Reciprocals of the squared lengths.
#[inline]
fn scales_of(normals: &[DVec3; 4]) -> [f64; 4] {
    let of = |n: DVec3| n.length_squared().recip();
    [of(normals[0]), of(normals[1]), of(normals[2]), of(normals[3])]
}

/// Score of a tet in degrees: the smallest dihedral angle, or 0.6 times what the largest lacks to 180 where that is less; zero
/// or negative when flat or inverted.
#[inline]
pub fn tet_score(corners: [DVec3; 4]) -> f64 {
    worst_of_tet(corners).score()
}

/// Whether the score of a tet is below a threshold; cheaper than the score.
#[inline]
pub fn tet_fails(corners: [DVec3; 4], threshold: &Threshold) -> bool {
    part_fails(corners, Part::Mesh, threshold)
}

/// The score of a tet of the mesh or the scaffold.
#[inline]
pub fn part_score(corners: [DVec3; 4], part: Part) -> f64 {
    part.weighted(tet_score(corners))
}

/// The lowest [`part_score`] of tets that are joined one after the other; the angle is taken once.
#[derive(Debug, Clone, Copy, Default)]
pub struct LowestScore {
    own: Option<Worst>,
    scaffold: Option<Worst>,
}

impl LowestScore {
    /// One more tet.
    #[inline]
    pub fn join(&mut self, corners: [DVec3; 4], part: Part) {
        let of_part = if part == Part::Mesh { &mut self.own } else { &mut self.scaffold };
        let worst = worst_of_tet(corners);
        *of_part = Some(of_part.map_or(worst, |known| known.join(worst)));
    }

    /// Degrees; infinite without tets.
    pub fn score(&self) -> f64 {
        let of = |worst: Option<Worst>, part: Part| worst.map_or(f64::INFINITY, |worst| part.weighted(worst.score()));
        of(self.own, Part::Mesh).min(of(self.scaffold, Part::Scaffold))
    }
}

/// The lowest [`part_score`] of some tets, infinite for none.
pub fn lowest_score(tets: impl Iterator<Item = ([DVec3; 4], Part)>) -> f64 {
    let mut lowest = LowestScore::default();
    tets.for_each(|(corners, part)| lowest.join(corners, part));
    lowest.score()
}

/// Whether [`part_score`] is below a threshold; cheaper than the score.
#[inline]
pub fn part_fails(corners: [DVec3; 4], part: Part, threshold: &Threshold) -> bool {
    threshold.limits(part).is_failed_by(&worst_of_tet(corners))
}

/// The face of a tet that stays when the opposite vertex moves.
#[derive(Debug, Clone, Copy)]
struct Opposite {
    corners: [DVec3; 3],
    /// Outward normal, length twice the area.
    normal: DVec3,
    /// Reciprocal of the normal's squared length.
    scale: f64,
}

impl Opposite {
    #[inline]
    fn worst_with(&self, place: DVec3) -> Worst {
        let [a, b, c] = [self.corners[0] - place, self.corners[1] - place, self.corners[2] - place];
        let volume = self.normal.dot(a);
        // Outward normals of the faces opposite to the three corners.
        let normals = [self.normal, c.cross(b), a.cross(c), b.cross(a)];
        let of = |n: DVec3| n.length_squared().recip();
        let scale = [self.scale, of(normals[1]), of(normals[2]), of(normals[3])];
        if !(volume > 0.0) || !scale.iter().all(|s| s.is_finite()) {
            let [a, b, c] = self.corners;
            return Worst { inverted: inversion_of(volume, [place, a, b, c]), ..Worst::NONE };
        }
        worst_of(normals, scale)
    }
}

/// The tets of a vertex, ready for trials of its place; a scratch buffer that is filled anew for each vertex.
#[derive(Debug, Clone, Default)]
pub struct Ball {
    faces: Vec<Opposite>,
    scaffold: Vec<Opposite>,
}

impl Ball {
    /// Forgets all tets.
    pub fn clear(&mut self) {
        self.faces.clear();
        self.scaffold.clear();
    }

    /// Takes a tet by its face opposite to the vertex, outward.
    #[inline]
    pub fn push(&mut self, corners: [DVec3; 3], part: Part) {
        let [a, b, c] = corners;
        let normal = (b - a).cross(c - a);
        let face = Opposite { corners, normal, scale: normal.length_squared().recip() };
        match part {
            Part::Mesh => self.faces.push(face),
            Part::Scaffold => self.scaffold.push(face),
        }
    }

    /// The lowest score of the scaffold's tets with the vertex at a place.
    #[inline]
    fn scaffold_score(&self, place: DVec3) -> f64 {
        if self.scaffold.is_empty() {
            return f64::INFINITY;
        }
        let lowest = self.scaffold.iter().fold(Worst::NONE, |lowest, face| lowest.join(face.worst_with(place)));
        Part::Scaffold.weighted(lowest.score())
    }

    /// The lowest score with the vertex at a place.
    pub fn score(&mut self, place: DVec3) -> f64 {
        let mut lowest = Worst::NONE;
        let (mut first, mut first_score) = (0, f64::INFINITY);
        for (at, face) in self.faces.iter().enumerate() {
            let worst = face.worst_with(place);
            let joined = lowest.join(worst);
            if joined.is_below(&lowest) {
                let score = joined.score();
                if score < first_score {
                    (first, first_score) = (at, score);
                }
                lowest = joined;
            }
        }
        if first > 0 {
            self.faces.swap(0, first);
        }
        let own = if self.faces.is_empty() { f64::INFINITY } else { lowest.score() };
        own.min(self.scaffold_score(place))
    }

    /// The lowest score with the vertex at a place, where no tet fails the threshold.
    #[inline]
    pub fn score_above(&mut self, place: DVec3, threshold: &Threshold) -> Option<f64> {
        let mut lowest = Worst::NONE;
        for at in 0..self.faces.len() {
            let worst = self.faces[at].worst_with(place);
            if threshold.own.is_failed_by(&worst) {
                self.faces.swap(0, at);
                return None;
            }
            lowest = lowest.join(worst);
        }
        let own = if self.faces.is_empty() { f64::INFINITY } else { lowest.score() };
        if self.scaffold.is_empty() {
            return Some(own);
        }
        let mut lowest = Worst::NONE;
        for at in 0..self.scaffold.len() {
            let worst = self.scaffold[at].worst_with(place);
            if threshold.scaffold.is_failed_by(&worst) {
                self.scaffold.swap(0, at);
                return None;
            }
            lowest = lowest.join(worst);
        }
        Some(own.min(Part::Scaffold.weighted(lowest.score())))
    }

    /// Mean length of the edges to a vertex at a place; an edge counts once per tet.
    pub fn edge_length(&self, place: DVec3) -> f64 {
        if self.faces.is_empty() {
            return 0.0;
        }
        let sum: f64 = self.faces.iter().flat_map(|f| f.corners).map(|p| p.distance(place)).sum();
        sum / (3 * self.faces.len()) as f64
    }

    /// Mean of the other vertices; each counts once per tet.
    pub fn center(&self) -> Option<DVec3> {
        let sum: DVec3 = self.faces.iter().flat_map(|f| f.corners).sum();
        (!self.faces.is_empty()).then(|| sum / (3 * self.faces.len()) as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REGULAR: [DVec3; 4] = [
        DVec3::new(1.0, 1.0, 1.0),
        DVec3::new(1.0, -1.0, -1.0),
        DVec3::new(-1.0, 1.0, -1.0),
        DVec3::new(-1.0, -1.0, 1.0),
    ];

    #[test]
    fn a_regular_tet_scores_by_its_angle_and_an_inverted_one_below_zero() {
        let mut regular = REGULAR;
        if volume6(regular) < 0.0 {
            regular.swap(0, 1);
        }
        let expected = (1.0f64 / 3.0).acos().to_degrees().min(0.6 * (180.0 - (1.0f64 / 3.0).acos().to_degrees()));
        assert!((tet_score(regular) - expected).abs() < 1e-5);
        regular.swap(0, 1);
        assert!(tet_score(regular) < 0.0);
    }

    #[test]
    fn angles_follow_the_arc_cosine() {
        for n in -1000..=1000 {
            let cosine = f64::from(n) / 1000.0;
            assert!((angle_of(cosine) - cosine.acos().to_degrees()).abs() < 5e-6, "{cosine}");
        }
    }

    #[test]
    fn the_lowest_score_of_a_group_is_that_of_its_worst_tet() {
        assert_eq!(lowest_score(std::iter::empty()), f64::INFINITY);
        let flattened = |by: f64| REGULAR.map(|p| DVec3::new(p.x, p.z, by * p.y));
        for (by, part) in [(0.3, Part::Mesh), (-0.3, Part::Mesh), (0.3, Part::Scaffold), (-0.3, Part::Scaffold)] {
            let tets = [(flattened(1.0), Part::Mesh), (flattened(by), part), (flattened(0.8), Part::Mesh)];
            let expected = tets.iter().map(|(tet, part)| part_score(*tet, *part)).fold(f64::INFINITY, f64::min);
            assert_eq!(lowest_score(tets.into_iter()), expected, "{by} {part:?}");
        }
    }

    #[test]
    fn a_ball_scores_as_its_tets_and_thresholds_agree() {
        // Eight tets around the origin, the vertex moved about, inside and outside.
        let axes = [DVec3::X, DVec3::Y, DVec3::Z];
        let faces: Vec<[DVec3; 3]> = (0..8)
            .map(|octant| {
                let sign = |d: usize| if octant >> d & 1 == 0 { 1.0 } else { -1.0 };
                let [a, b, c]: [DVec3; 3] = std::array::from_fn(|d| axes[d] * sign(d));
                if sign(0) * sign(1) * sign(2) > 0.0 { [a, b, c] } else { [a, c, b] }
            })
            .collect();
        let mut ball = Ball::default();
        faces.iter().for_each(|face| ball.push(*face, Part::Mesh));
        for n in 0..60 {
            let t = f64::from(n);
            let place = DVec3::new((t * 0.7).sin(), (t * 1.3).cos(), (t * 2.1).sin()) * 0.02 * t;
            let separate = faces.iter().map(|[a, b, c]| tet_score([place, *a, *b, *c])).fold(f64::INFINITY, f64::min);
            assert!((ball.score(place) - separate).abs() < 1e-6, "{place}");
            for shift in [-0.5, 0.5] {
                let reached = ball.score_above(place, &Threshold::of(separate + shift));
                assert_eq!(reached.is_some(), shift < 0.0, "{place} {separate}");
            }
        }
    }
}
