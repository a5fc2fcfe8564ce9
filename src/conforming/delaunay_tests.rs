//! Tests of the Delaunay kernel: brute force on small sets, invariants and Euler's relation on larger ones.

use super::*;
use crate::geometry::perturbation::is_in_perturbed_sphere;
use crate::mesh::tet_store::TetStore;

/// Deterministic numbers in [0, 1).
pub(crate) fn sequence(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed;
    move || {
        state = mix(state.wrapping_add(0x9e37_79b9_7f4a_7c15));
        (state >> 11) as f64 / (1u64 << 53) as f64
    }
}

fn random_points(count: usize, seed: u64) -> Vec<DVec3> {
    let mut next = sequence(seed);
    (0..count).map(|_| DVec3::new(next(), next(), next())).collect()
}

fn grid_points(side: usize, step: f64) -> Vec<DVec3> {
    let at = |i: usize| i as f64 * step;
    (0..side * side * side).map(|i| DVec3::new(at(i % side), at(i / side % side), at(i / side / side))).collect()
}

fn sphere_points(count: usize, seed: u64) -> Vec<DVec3> {
    random_points(count, seed).into_iter().map(|p| (p - DVec3::splat(0.5)).normalize() * 10.0).collect()
}

fn context(threads: usize) -> RunContext {
    RunContext::with_threads(threads).unwrap()
}

fn checked(points: &[DVec3], order: PointOrder) -> Delaunay {
    let result =
        tetrahedralize(points, &DelaunayOptions { order, seed: 3, ..Default::default() }, &context(1)).unwrap();
    result.complex.check_invariants().unwrap();
    result.complex.check_orientation().unwrap();
    assert!(
        result
            .complex
            .points()
            .iter()
            .zip(points)
            .all(|(a, b)| a.to_array().map(f64::to_bits) == b.to_array().map(f64::to_bits))
    );
    result
}

/// Every tet's sphere is empty of every other point, by the perturbed predicate.
fn assert_delaunay(result: &Delaunay) {
    let complex = &result.complex;
    let duplicates: Vec<VertexId> = result.duplicates.iter().map(|d| d.0).collect();
    for tet in complex.finite_tets() {
        let vertices = complex.vertices(tet);
        let [a, b, c, d] = complex.points_of(tet);
        for (i, &p) in complex.points().iter().enumerate() {
            let v = VertexId(i as u32);
            if !vertices.contains(&v) && !duplicates.contains(&v) {
                assert!(!is_in_perturbed_sphere(a, b, c, d, p), "tet {} contains point {i}", tet.0);
            }
        }
    }
    // Nothing sees a hull face from outside.
    for tet in complex.live_tets().filter(|&t| complex.is_ghost_tet(t)) {
        let ghost = complex.local_vertex(tet, VertexId::GHOST).unwrap();
        let [a, b, c] = TET_FACES[ghost].map(|i| complex.point(complex.vertices(tet)[i]));
        assert!(complex.points().iter().all(|&p| orient3d(a, c, b, p) <= 0.0));
    }
}

/// The tets as a sorted list of sorted rows.
pub(crate) fn tet_set(complex: &TetComplex) -> Vec<[VertexId; 4]> {
    let mut rows: Vec<[VertexId; 4]> = complex
        .finite_tets()
        .map(|t| {
            let mut row = complex.vertices(t);
            row.sort_unstable();
            row
        })
        .collect();
    rows.sort_unstable();
    rows
}

#[test]
fn small_sets_are_delaunay_by_brute_force() {
    let cases = [
        random_points(4, 1),
        random_points(5, 2),
        random_points(150, 3),
        sphere_points(120, 4),
        grid_points(5, 1.0),
        grid_points(5, 0.1),
        grid_points(2, 1e-6),
        random_points(100, 5).into_iter().map(|p| p * 1e-6 + DVec3::splat(1e6)).collect(),
        random_points(100, 6).into_iter().map(|p| DVec3::new(p.x, p.y, p.z * 1e-12)).collect(),
        (0..60).map(|i| DVec3::new(f64::from(i), f64::from(i * i), f64::from(i * i * i))).collect(),
    ];
    for (i, points) in cases.iter().enumerate() {
        let spatial = checked(points, PointOrder::Spatial);
        assert_delaunay(&spatial);
        for order in [PointOrder::Input, PointOrder::Random] {
            let other = checked(points, order);
            assert_eq!(tet_set(&spatial.complex), tet_set(&other.complex), "case {i}, {order:?}");
        }
    }
}

#[test]
fn larger_sets_fill_their_hull() {
    for (points, volume) in [(random_points(20_000, 7), None), (grid_points(20, 0.5), Some(9.5f64.powi(3)))] {
        let result = checked(&points, PointOrder::Spatial);
        let sum: f64 = result
            .complex
            .finite_tets()
            .map(|t| {
                let [a, b, c, d] = result.complex.points_of(t);
                orient3d(a, b, c, d) / 6.0
            })
            .sum();
        assert!(volume.is_none_or(|v| (sum - v).abs() < 1e-9 * v), "{sum}");
        // The ghosts close the hull: vertices - edges + faces = 2 for a triangulated sphere.
        let ghosts = result.complex.live_count() - result.complex.finite_tets().count();
        assert_eq!(ghosts % 2, 0);
    }
}

#[test]
fn duplicates_are_reported_with_the_smallest_index_kept() {
    let mut points = random_points(200, 8);
    for i in 0..50 {
        points.push(points[i * 3]);
        points.push(points[i * 3]);
    }
    let result = checked(&points, PointOrder::Spatial);
    assert_eq!(result.duplicates.len(), 100);
    for (duplicate, kept) in &result.duplicates {
        assert_eq!(points[duplicate.index()], points[kept.index()]);
        assert!(kept.index() < 200 && duplicate.index() >= 200);
    }
    assert_delaunay(&result);
}

#[test]
fn sets_without_volume_are_refused() {
    let line: Vec<DVec3> = (0..50).map(|i| DVec3::splat(f64::from(i))).collect();
    let plane: Vec<DVec3> = random_points(50, 9).into_iter().map(|p| DVec3::new(p.x, p.y, p.x)).collect();
    for (points, word) in [
        (vec![], "no points"),
        (vec![DVec3::ONE; 9], "equal"),
        (line, "line"),
        (plane, "plane"),
        (vec![DVec3::ZERO, DVec3::NAN, DVec3::ONE], "not finite"),
        (vec![DVec3::ZERO, DVec3::splat(1e80), DVec3::ONE], "above"),
    ] {
        let error = tetrahedralize(&points, &DelaunayOptions::default(), &context(1)).unwrap_err();
        assert!(matches!(error, Error::InvalidInput { .. }) && error.to_string().contains(word), "{error}");
    }
}

#[test]
fn cancellation_ends_the_run() {
    let context = context(1);
    context.cancel_token().cancel();
    let error = tetrahedralize(&random_points(5000, 1), &DelaunayOptions::default(), &context).unwrap_err();
    assert!(matches!(error, Error::Cancelled));
}

#[test]
fn any_number_of_threads_makes_the_same_tets() {
    let mut doubled = random_points(15_000, 21);
    doubled.extend_from_within(..5_000);
    let cases = [random_points(30_000, 20), sphere_points(12_000, 22), grid_points(27, 0.1), doubled];
    for (i, points) in cases.iter().enumerate() {
        let alone = checked(points, PointOrder::Spatial);
        for threads in [2, 5] {
            let options = DelaunayOptions { order: PointOrder::Spatial, seed: 3, ..Default::default() };
            let result = tetrahedralize(points, &options, &context(threads)).unwrap();
            result.complex.check_invariants().unwrap();
            assert_eq!(result.report.threads, threads);
            assert!(tet_set(&result.complex) == tet_set(&alone.complex), "case {i}, {threads} threads");
            assert_eq!(result.duplicates, alone.duplicates);
        }
    }
}

#[test]
fn many_threads_on_a_small_mesh_get_in_each_others_way_and_agree() {
    // A plane, a hub above it and points repeated: large cavities, ghosts in one plane, and every claim contended.
    let mut points: Vec<DVec3> = random_points(3000, 23).into_iter().map(|p| DVec3::new(p.x, p.y, 0.0)).collect();
    points.extend(random_points(40, 24).into_iter().map(|p| p * 0.01 + DVec3::new(0.5, 0.5, 3.0)));
    points.extend_from_within(..500);
    let alone = tet_set(&checked(&points, PointOrder::Spatial).complex);
    for run in 0..10 {
        let threads = [2, 8][run % 2];
        let result = tetrahedralize(&points, &DelaunayOptions::default(), &context(threads)).unwrap();
        result.complex.check_invariants().unwrap();
        assert!(tet_set(&result.complex) == alone, "run {run}");
        assert!(result.report.threads == threads && result.duplicates.len() == 500);
    }
}

#[test]
fn reproducible_numbers_do_not_depend_on_threads() {
    let mut points = random_points(6000, 25);
    points.extend(grid_points(14, 0.1));
    points.extend_from_within(..1000);
    let rows = |threads| {
        let options = DelaunayOptions { numbers: TetNumbers::Reproducible, ..Default::default() };
        let complex = tetrahedralize(&points, &options, &context(threads)).unwrap().complex;
        complex.check_invariants().unwrap();
        complex.check_orientation().unwrap();
        let slots = (0..complex.slot_count()).map(TetId::from_index);
        slots.map(|t| (complex.vertices(t), complex.neighbors(t))).collect::<Vec<_>>()
    };
    let alone = rows(1);
    assert!([2, 3, 7].into_iter().all(|threads| rows(threads) == alone));
}
