//! Slivers, and whether the boundary forces them.
//!
//! # Method
//! A sliver has a dihedral angle below 2 or above 178 degrees. It is forced where two walls of it meet at the bad angle, or a
//! wall of it has an own angle beyond the limits: a needle's tet has hardly an angle larger than the needle's tip.
//!
//! Between walls much closer than their triangles are wide no angle of the boundary is bad, but nearly every tet is a sliver. There
//! slivers crowd ([`crowded_slivers`]): what betters one of them leaves the others, at the price of points far too close.
//!
//! # Invariants
//! Walls are the constrained faces; the ends of a piece of a mesh are none.

use glam::DVec3;
use rustc_hash::FxHashSet;

use crate::geometry::tetrahedron::{dihedral_angles, dihedral_cosines};
use crate::index::TetId;
use crate::mesh::numbering::{TET_FACES, TET_OPPOSITE_EDGES};
use crate::mesh::quality::SLIVER_DEGREES;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;
use crate::mesh::topology::collect_ball;

/// The cosine of the largest angle of a tet that is a sliver.
pub fn sliver_cosine(corners: [DVec3; 4]) -> Option<f64> {
    let limit = SLIVER_DEGREES.to_radians().cos();
    let (largest, smallest) = dihedral_cosines(corners);
    (largest > limit || smallest < -limit).then_some(smallest)
}

/// Whether the boundary forces a sliver: two of its faces on the boundary meet at the bad angle, or a face on the boundary
/// has an own angle beyond the limits. Other slivers could go, if only with many small tets beside the boundary.
pub fn is_forced_sliver(complex: &TetComplex, tet: TetId) -> bool {
    let (row, flags) = (complex.vertices(tet), complex.flags(tet));
    let is_wall = |face: usize| flags.is_face_constrained(face);
    let is_extreme = |degrees: f64| !(SLIVER_DEGREES..=180.0 - SLIVER_DEGREES).contains(&degrees);
    let has_extreme_corner = |face: usize| {
        let p = TET_FACES[face].map(|local| complex.point(row[local]));
        (0..3).any(|i| is_extreme((p[(i + 1) % 3] - p[i]).angle_between(p[(i + 2) % 3] - p[i]).to_degrees()))
    };
    let angles = dihedral_angles(complex.points_of(tet));
    let meets_between_walls = |edge: usize| {
        let [i, j] = TET_OPPOSITE_EDGES[edge];
        is_wall(i) && is_wall(j) && is_extreme(angles[edge])
    };
    (0..4).any(|face| is_wall(face) && has_extreme_corner(face)) || (0..6).any(meets_between_walls)
}

/// Share of the tets at a sliver's vertices from which slivers crowd: between thin walls it is nearly all of them.
const CROWDED: f64 = 0.5;

/// Which of some slivers have mostly others around them.
pub fn crowded_slivers(complex: &TetComplex, slivers: &[TetId]) -> Vec<bool> {
    let known: FxHashSet<TetId> = slivers.iter().copied().collect();
    let mut ball = Vec::new();
    let is_crowded = |tet: &TetId| {
        let mut counts = [0usize; 2];
        for vertex in complex.vertices(*tet) {
            collect_ball(complex, vertex, *tet, &mut ball);
            for at in ball.iter().filter(|at| !complex.is_ghost_tet(**at) && !complex.label(**at).is_background()) {
                counts[usize::from(known.contains(at))] += 1;
            }
        }
        counts[1] as f64 > CROWDED * (counts[0] + counts[1]) as f64
    };
    slivers.iter().map(is_crowded).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::delaunay_kernel::{DelaunayOptions, tetrahedralize};
    use crate::context::RunContext;
    use crate::index::{Label, VertexId};

    fn slivers(complex: &TetComplex) -> Vec<TetId> {
        complex.finite_tets().filter(|tet| sliver_cosine(complex.points_of(*tet)).is_some()).collect()
    }

    /// One tet over the triangle a b c; its boundary is all of its faces.
    fn alone(c: DVec3, apex: DVec3) -> TetComplex {
        let mut complex = TetComplex::with_points(vec![DVec3::ZERO, DVec3::X, c, apex]).unwrap();
        let tet = complex.create_tet([0, 1, 2, 3].map(VertexId), Label(1)).unwrap();
        let walls = (0..4).fold(complex.flags(tet), |flags, face| flags.with_face(face, true));
        complex.set_flags(tet, walls);
        complex
    }

    /// A grid of `n` by `n` boxes of some height, six tets each.
    fn plate(n: usize, height: f64) -> TetComplex {
        let context = RunContext::with_threads(1).unwrap();
        let at = |k: usize| {
            DVec3::new((k % (n + 1)) as f64, (k / (n + 1) % (n + 1)) as f64, height * (k / (n + 1) / (n + 1)) as f64)
        };
        let points: Vec<DVec3> = (0..2 * (n + 1) * (n + 1)).map(at).collect();
        let mut complex = tetrahedralize(&points, &DelaunayOptions::default(), &context).unwrap().complex;
        let tets: Vec<TetId> = complex.finite_tets().collect();
        tets.into_iter().for_each(|tet| complex.set_label(tet, Label(1)));
        complex
    }

    #[test]
    fn slivers_crowd_in_thin_plates() {
        let (thin, thick) = (plate(6, 0.01), plate(6, 1.0));
        let found = slivers(&thin);
        assert!(found.len() > 150 && crowded_slivers(&thin, &found).into_iter().all(|is_crowded| is_crowded));
        // One tet alone does not crowd, whichever it is.
        let first: Vec<TetId> = thick.finite_tets().take(1).collect();
        assert_eq!(crowded_slivers(&thick, &first), [false]);
    }

    #[test]
    fn slivers_are_forced_by_angles_of_the_boundary_only() {
        let context = RunContext::with_threads(1).unwrap();
        let flat_wedge = alone(DVec3::Y, DVec3::new(0.2, 0.2, 0.002));
        let needle = alone(DVec3::new(1.0, 0.01, 0.0), DVec3::new(0.2, 0.2, 0.3));
        let regular = alone(DVec3::Y, DVec3::Z);
        for (complex, count) in [(&flat_wedge, 1), (&needle, 1), (&regular, 0)] {
            let found = slivers(complex);
            assert_eq!(found.len(), count);
            assert!(found.iter().all(|tet| is_forced_sliver(complex, *tet)));
        }
        // The same flat tet with all others around it: nothing forces it.
        let points = vec![
            DVec3::ZERO,
            DVec3::X,
            DVec3::Y,
            DVec3::new(0.5, 0.5, 0.002),
            DVec3::new(0.3, 0.3, -3.0),
            DVec3::new(0.3, 0.3, 3.0),
        ];
        let delaunay = DelaunayOptions::default();
        let mut complex = tetrahedralize(&points, &delaunay, &context).unwrap().complex;
        let tets: Vec<TetId> = complex.finite_tets().collect();
        tets.into_iter().for_each(|tet| complex.set_label(tet, Label(1)));
        let found = slivers(&complex);
        assert!(!found.is_empty() && found.iter().all(|tet| !is_forced_sliver(&complex, *tet)), "{found:?}");
    }
}
