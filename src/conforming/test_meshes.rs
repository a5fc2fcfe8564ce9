//! Meshes that the engine's tests change.

use glam::DVec3;

use crate::conforming::delaunay_kernel::{DelaunayOptions, PointOrder, tetrahedralize};
use crate::conforming::enclosure::enclosing_corners;
use crate::context::RunContext;
use crate::index::{Label, TetId};
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
