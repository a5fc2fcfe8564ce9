//! Boundary recovery on shapes that have no tetrahedralization of their own, or hardly one.

use glam::{DQuat, DVec3, EulerRot};

use super::test_surfaces::{chazelle, cube, joined, mapped, strips, twisted_prism};
use super::*;
use crate::error::Error;
use crate::mesh::validation::check_mixed_mesh;

/// Runs without refinement: points and facets must be there as they were given. Returns the points added in the volume.
fn recovered(surface: &SurfaceMesh) -> usize {
    let options = Options { refine: false, ..Options::default() };
    let (mesh, report) = run(surface, None, &options, &RunContext::with_threads(1).unwrap()).unwrap();
    check_mixed_mesh(&mesh).unwrap();
    assert_eq!(mesh.points[..surface.points.len()], surface.points[..]);
    let keys = |faces: &[[VertexId; 3]]| {
        let sorted = |mut face: [VertexId; 3]| {
            face.sort_unstable();
            face
        };
        let mut keys: Vec<_> = faces.iter().copied().map(sorted).collect();
        keys.sort_unstable();
        keys
    };
    assert_eq!(keys(&mesh.boundary.triangles), keys(&surface.facets));
    report.recovery.steiner_in_volume
}

#[test]
fn twisted_prisms_need_at_most_one_point() {
    for corners in [3, 4, 5, 6, 8] {
        for turn in [-25.0, -20.0, 20.0] {
            let added = recovered(&twisted_prism(corners, turn, 1));
            assert!(added <= usize::from(turn > 0.0), "{corners} corners, turn {turn}: {added} points");
        }
    }
}

#[test]
fn flat_long_and_far_prisms_are_recovered() {
    for (scale, offset) in [(DVec3::new(1.0, 1.0, 1e-3), 0.0), (DVec3::new(1.0, 1.0, 1e3), 0.0), (DVec3::ONE, 1e6)] {
        let surface = mapped(&twisted_prism(6, -20.0, 3), |p| p * scale + DVec3::splat(offset));
        assert_eq!(recovered(&surface), 0, "{scale} {offset}");
    }
}

#[test]
fn strips_of_1_to_3600_need_few_points() {
    for scale in [1e-6, 1.0, 1e6] {
        let added = recovered(&mapped(&strips(10, 3600.0), |p| p * scale));
        assert!(added <= 5, "TetGen 1.5 leaves 5 points, not {added}");
    }
}

#[test]
fn grids_on_boxes_need_no_point() {
    // The diagonals of neighbouring squares wait for each other: no single order of flips recovers all of these.
    for n in [4, 6, 10] {
        assert_eq!(recovered(&cube(n)), 0, "{n}");
    }
    assert_eq!(recovered(&mapped(&cube(7), |p| DVec3::new(p.x, p.y, 0.1 * p.z))), 0);
}

/// A box cut into slender prisms: `count` strips below and above, fans at both ends. Of two neighbouring prisms the
/// diagonals of the wall between them agree, or neither has tets.
fn drum(count: u32, width: f64) -> SurfaceMesh {
    let side = |z: f64| (0..=count).map(move |i| DVec3::new(0.0, f64::from(i) * width, z));
    let top: Vec<DVec3> = side(0.5).collect();
    let ring: Vec<DVec3> = side(0.0).chain(top.into_iter().rev()).collect();
    let m = ring.len() as u32;
    let mut points = ring.clone();
    points.extend(ring.iter().map(|p| *p + DVec3::X));
    let middle = DVec3::new(0.0, 0.5 * f64::from(count) * width, 0.25);
    points.extend([middle, middle + DVec3::X]);
    let mut facets = Vec::new();
    for i in 0..m {
        let j = (i + 1) % m;
        facets.extend([[i, j, m + j], [i, m + j, m + i], [2 * m, j, i], [2 * m + 1, m + i, m + j]]);
    }
    SurfaceMesh::new(points, facets.into_iter().map(|f| f.map(VertexId)).collect())
}

#[test]
fn a_drum_of_slender_prisms_needs_no_point() {
    for (count, width) in [(22, 1e-3), (40, 1.0 / 3600.0)] {
        assert_eq!(recovered(&drum(count, width)), 0, "{count} strips of {width}");
        assert_eq!(recovered(&mapped(&drum(count, width), turned)), 0, "{count} strips of {width}, turned");
    }
}

/// Out of the axes: points of one plane lie on it by rounding only.
fn turned(point: DVec3) -> DVec3 {
    DQuat::from_euler(EulerRot::XYZ, 0.3, 0.7, 1.1) * point
}

#[test]
fn turned_plates_of_strips_are_recovered() {
    for (slenderness, height) in [(3600.0, 1.0), (20_000.0, 1.0), (20_000.0, 0.05), (3600.0, 3e-3), (100.0, 3e-6)] {
        let flat = DVec3::new(1.0, 1.0, height);
        let added = recovered(&mapped(&strips(20, slenderness), |p| turned(p * flat)));
        assert!(added <= 10, "1:{slenderness}, {height}: {added}");
    }
    for (scale, offset) in [(1e-6, 0.0), (1e6, 0.0), (1.0, 1e6)] {
        let added = recovered(&mapped(&strips(20, 500.0), |p| turned(p) * scale + DVec3::splat(offset)));
        assert!(added <= 10, "{scale} {offset}: {added}");
    }
}

#[test]
fn chazelles_polyhedron_is_recovered() {
    for (count, gap) in [(2, 0.1), (4, 0.1), (4, 0.01), (5, 0.1)] {
        let surface = chazelle(count, gap);
        let added = recovered(&surface);
        // Fewer than the places where an edge passes another.
        let places = (count * count) as usize;
        assert!(added < places, "{count} notches, gap {gap}: {added}");
        let added = recovered(&mapped(&surface, turned));
        assert!(added < places, "{count} notches, gap {gap}, turned: {added}");
    }
}

#[test]
fn edges_that_lock_each_other_are_recovered_in_the_better_order() {
    // From the first edge to the last 20 points stay, from the last to the first 16.
    let added = recovered(&mapped(&chazelle(5, 0.02), |p| p * 1e-3));
    assert!(added <= 17, "{added}");
}

#[test]
fn narrow_notches_are_recovered_with_any_effort() {
    // What is recovered by chance fails with other efforts.
    let surface = chazelle(3, 1e-5);
    for recursion_depth in [3, 4, 5, 6] {
        for edge_removal_limit in [7, 10, 13] {
            let options = Options { refine: false, recursion_depth, edge_removal_limit, ..Options::default() };
            let (mesh, report) = run(&surface, None, &options, &RunContext::with_threads(1).unwrap()).unwrap();
            check_mixed_mesh(&mesh).unwrap();
            assert_eq!(mesh.boundary.triangles.len(), surface.facets.len());
            let added = report.recovery.steiner_in_volume;
            assert!(added <= 9, "{recursion_depth} {edge_removal_limit}: {added} points");
        }
    }
}

#[test]
fn plates_that_almost_touch_are_recovered() {
    let plate = |n: usize, from: f64| mapped(&cube(n), |p| DVec3::new(p.x, p.y, from + 0.1 * p.z));
    let pair = joined(&[plate(4, 0.0), plate(5, 0.1 + 1e-6)]);
    let thin = mapped(&cube(5), |p| DVec3::new(p.x, p.y, 1e-6 * p.z));
    for surface in [&pair, &thin] {
        let added = recovered(surface) + recovered(&mapped(surface, turned));
        assert!(added <= 4, "{added}");
    }
}

#[test]
fn a_turned_prism_in_a_box_is_a_region_of_its_own() {
    let inner = mapped(&twisted_prism(3, 20.0, 1), |p| p * 0.2 + DVec3::splat(0.4));
    let added = recovered(&joined(&[cube(2), inner]));
    assert!(added <= 2, "{added}");
}

#[test]
fn cancelling_ends_a_recovery_at_once() {
    let surface = strips(60, 3600.0);
    let options = Options { refine: false, ..Options::default() };
    for milliseconds in [0, 3, 10, 30] {
        let context = RunContext::with_threads(1).unwrap();
        let token = context.cancel_token();
        let result = std::thread::scope(|scope| {
            scope.spawn(|| {
                std::thread::sleep(std::time::Duration::from_millis(milliseconds));
                token.cancel();
            });
            run(&surface, None, &options, &context)
        });
        // It may have been done before.
        assert!(matches!(result, Ok(_) | Err(Error::Cancelled)));
    }
}
