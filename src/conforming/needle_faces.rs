//! Needles of the boundary, and how much worse than others the tets on them may be.
//!
//! # Method
//! A tet on a triangle with a tiny angle has a tiny dihedral angle at the needle's tip, however good everything around it
//! is. Its grade is raised by the factor that makes a dihedral angle of the needle's own count as the angle below which a
//! tet is bad: so an operation that betters other tets is not refused for the sake of one that is forced.
//!
//! # Source
//! [KlingnerShewchuk2007] grades configurations by their worst tet; what the boundary forces is graded apart here.
//!
//! # Cost
//! Two lists over the vertices and a hash of the needles; a look-up for tets with three vertices on needles.

use glam::DVec3;
use rustc_hash::FxHashMap;

use crate::index::VertexId;

/// The triangles of the boundary with an angle below a limit.
#[derive(Debug, Clone, Default)]
pub struct NeedleFaces {
    /// Whether a vertex is on a needle; those beyond the end are not. 1 B / vertex.
    has_needle: Vec<bool>,
    /// The factors of the needles by their ascending vertices.
    reliefs: FxHashMap<[VertexId; 3], f64>,
}

impl NeedleFaces {
    /// The needles among `triangles`: those with an angle below `degrees`, which is what that angle then counts as.
    pub fn new(points: &[DVec3], triangles: &[[VertexId; 3]], degrees: f64) -> Self {
        let limit = degrees.to_radians().sin();
        let mut needles = Self { has_needle: vec![false; points.len()], reliefs: FxHashMap::default() };
        for triangle in triangles {
            let [a, b, c] = triangle.map(|v| points[v.index()]);
            let sides = [a.distance(b), b.distance(c), c.distance(a)];
            let double_area = (b - a).cross(c - a).length();
            // The smallest angle lies between the two longer sides.
            let shortest = sides.into_iter().fold(f64::INFINITY, f64::min);
            let sine = double_area * shortest / sides.into_iter().product::<f64>();
            if sine > 0.0 && sine < limit {
                let mut key = *triangle;
                key.sort_unstable();
                needles.reliefs.insert(key, limit / sine);
                triangle.iter().for_each(|v| needles.has_needle[v.index()] = true);
            }
        }
        needles
    }

    /// The factor for tets with these three or four vertices: that of the sharpest needle among their faces, or 1.
    pub fn relief(&self, vertices: &[VertexId]) -> f64 {
        let is_on_needle = |v: &&VertexId| self.has_needle.get(v.index()).copied().unwrap_or(false);
        if vertices.iter().filter(is_on_needle).count() < 3 {
            return 1.0;
        }
        let factor = |skipped: usize| {
            let mut others = vertices.iter().enumerate().filter(|(i, _)| *i != skipped).map(|(_, v)| *v);
            let mut key = [(); 3].map(|()| others.next().unwrap_or(VertexId::GHOST));
            key.sort_unstable();
            self.reliefs.get(&key).copied().unwrap_or(1.0)
        };
        // Of three vertices none is left out.
        let skipped = if vertices.len() == 3 { 3..4 } else { 0..4 };
        skipped.map(factor).fold(1.0, f64::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::flip_criteria::{BiasedSine, Relief, StrictInside, TetMeasure, Weight};

    #[test]
    fn a_dihedral_angle_of_the_needles_own_counts_as_the_limit() {
        let points = [DVec3::ZERO, DVec3::X, DVec3::new(1.0, 0.01, 0.0), DVec3::new(0.4, 0.2, 0.5), DVec3::Y];
        let [needle, fair] = [[2, 0, 1], [0, 1, 4]].map(|face| face.map(VertexId));
        let needles = NeedleFaces::new(&points, &[needle, fair], 2.5);
        let relief = needles.relief(&needle);
        let sine = 0.01f64.atan().sin();
        assert!((relief * sine - 2.5f64.to_radians().sin()).abs() < 1e-12);
        assert_eq!(needles.relief(&[VertexId(3), VertexId(0), VertexId(1), VertexId(2)]), relief);
        for others in [[0, 1, 3, 4], [0, 2, 3, 4], [3, 4, 7, 8]] {
            assert_eq!(needles.relief(&others.map(VertexId)), 1.0);
        }
        let measure = StrictInside { angles: BiasedSine, on_boundary: &[true; 5], relief: Relief::Needles(&needles) };
        let lenient = StrictInside { relief: Relief::Boundary, ..measure };
        assert_eq!(lenient.weight(&fair), Weight::Lenient);
        assert_eq!(lenient.weight(&[VertexId(9)]), Weight::Strict);
        assert_eq!(measure.weight(&needle), Weight::Relieved(relief));
        assert_eq!(measure.weight(&fair), Weight::Plain);
        assert_eq!(measure.weight(&[VertexId(9)]), Weight::Strict);
        assert!(Weight::Relieved(3.0).of(0.1) > Weight::Plain.of(0.1));
    }
}
