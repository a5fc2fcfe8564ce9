//! Meshes that the engine's tests change.

use glam::DVec3;

use crate::conforming::delaunay_kernel::{DelaunayOptions, PointOrder, tetrahedralize};
use crate::conforming::enclosure::enclosing_corners;
use crate::context::RunContext;
use crate::index::{Label, TetFace, TetId, VertexId};
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;

/// The Delaunay tets of points by a linear congruential generator: many are slivers.
pub fn random_mesh(seed: u32, count: usize) -> TetComplex {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(state >> 8) / f64::from(1 << 24)
    };
    let points: Vec<DVec3> = (0..count).map(|_| DVec3::new(next(), next(), next())).collect();
    let options = DelaunayOptions::default();
    let mut complex = tetrahedralize(&points, &options, &RunContext::with_threads(1).unwrap()).unwrap().complex;
    let tets: Vec<TetId> = complex.finite_tets().collect();
    tets.into_iter().for_each(|tet| complex.set_label(tet, Label(1)));
    complex
}

/// The Delaunay tets of points, which keep their order, and of the corners of a box around them: where recovery starts.
pub fn enclosed_mesh(points: &[DVec3]) -> TetComplex {
    let all: Vec<DVec3> = points.iter().copied().chain(enclosing_corners(points)).collect();
    let options = DelaunayOptions { order: PointOrder::Input, ..Default::default() };
    tetrahedralize(&all, &options, &RunContext::with_threads(1).unwrap()).unwrap().complex
}

/// Constrains some faces inside the mesh: one in every `step` tets.
pub fn add_walls(complex: &mut TetComplex, step: usize) {
    for number in (0..complex.slot_count()).step_by(step) {
        let side = TetFace::new(TetId::from_index(number), number % 4);
        let is_inside = complex.is_live(side.tet())
            && !complex.is_ghost_tet(side.tet())
            && !complex.is_ghost_tet(complex.neighbor(side).tet());
        if is_inside {
            for side in [side, complex.neighbor(side)] {
                complex.set_flags(side.tet(), complex.flags(side.tet()).with_face(side.face(), true));
            }
        }
    }
}

/// The constrained faces, sorted; each from both sides.
pub fn walls(complex: &TetComplex) -> Vec<[VertexId; 3]> {
    let sides = complex.finite_tets().flat_map(|tet| (0..4).map(move |face| TetFace::new(tet, face)));
    let mut faces: Vec<_> = sides
        .filter(|side| complex.is_face_constrained(*side))
        .map(|side| {
            let mut face = complex.face_vertices(side);
            face.sort_unstable();
            face
        })
        .collect();
    faces.sort_unstable();
    faces
}
