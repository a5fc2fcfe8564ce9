//! Tests of the drivers' settings and of improvement passes on small meshes.

use glam::DVec3;

use super::*;
use crate::conforming::flip_criteria::TetMeasure;
use crate::conforming::quality_improvement::boundary_vertices;
use crate::conforming::smoothing::{Acceptance, Target};
use crate::index::Label;

#[test]
fn drivers_take_the_options_of_work_sharing() {
    let context = RunContext::with_threads(3).unwrap();
    let options = Options {
        buckets: 7,
        quality_buckets: 9,
        transfer_fraction: 0.25,
        transfer_reduction: 0.5,
        quality_transfer_fraction: 0.75,
        quality_transfer_reduction: 0.125,
        quality_threads: 2,
        ..Options::default()
    };
    let (first, second) = (Driver::for_refinement(&options, &context), Driver::for_quality(&options, &context));
    let settings = |d: &Driver| (d.threads, d.settings.buckets, d.settings.transfer_share, d.settings.transfer_decay);
    assert_eq!(settings(&first), (3, 7, 0.25, 0.5));
    assert_eq!(settings(&second), (2, 9, 0.75, 0.125));
}

/// Boxes of six tets around a diagonal, `n` a side, every inner vertex shifted by up to `shift` of the spacing.
fn shaken_grid(n: usize, shift: f64) -> TetComplex {
    let id = |i: usize, j: usize, k: usize| VertexId::from_index((k * (n + 1) + j) * (n + 1) + i);
    let mut state = 1u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f64 / (1u64 << 30) as f64 - 1.0
    };
    let mut points = Vec::new();
    for k in 0..=n {
        for j in 0..=n {
            for i in 0..=n {
                let inner = [i, j, k].iter().all(|c| (1..n).contains(c));
                let shake = DVec3::new(random(), random(), random()) * if inner { shift } else { 0.0 };
                points.push(DVec3::new(i as f64, j as f64, k as f64) + shake);
            }
        }
    }
    let mut complex = TetComplex::with_points(points).unwrap();
    for k in 0..n {
        for j in 0..n {
            for i in 0..n {
                for [p, q] in [[0, 1], [1, 0], [0, 2], [2, 0], [1, 2], [2, 1]] {
                    let mut corner = [i, j, k];
                    let mut row = [id(i, j, k); 4];
                    for (at, axis) in [p, q, 3 - p - q].into_iter().enumerate() {
                        corner[axis] += 1;
                        row[at + 1] = id(corner[0], corner[1], corner[2]);
                    }
                    let is_even = [[0, 1], [1, 2], [2, 0]].contains(&[p, q]);
                    let row = if is_even { row } else { [row[1], row[0], row[2], row[3]] };
                    complex.create_tet(row, Label(1)).unwrap();
                }
            }
        }
    }
    complex.pair_faces().unwrap();
    complex.rebuild_vertex_tets();
    complex.check_orientation().unwrap();
    complex
}

fn worst(complex: &TetComplex) -> f64 {
    complex.finite_tets().map(|t| BiasedSine.grade(complex.points_of(t))).fold(f64::INFINITY, f64::min)
}

fn volume(complex: &TetComplex) -> f64 {
    complex.finite_tets().map(|t| crate::geometry::tetrahedron::volume(complex.points_of(t))).sum()
}

fn check(complex: &TetComplex, wanted: f64) {
    complex.check_invariants().unwrap();
    complex.check_orientation().unwrap();
    assert!((volume(complex) - wanted).abs() < 1e-9 * wanted);
}

#[test]
fn smart_smoothing_never_lowers_the_worst_tet() {
    let context = RunContext::with_threads(1).unwrap();
    let mut driver = Driver::for_quality(&Options::default(), &context);
    let mut complex = shaken_grid(5, 0.2);
    let on_boundary = boundary_vertices(&complex, &context);
    let before = worst(&complex);
    let rule = SmoothingRule { target: Target::OptimalPlacement, coefficient: 0.5, acceptance: Acceptance::Smart };
    let vertices: Vec<VertexId> = (0..complex.vertex_count()).map(VertexId::from_index).collect();
    let outside: Vec<DVec3> = complex.points().to_vec();
    driver.smooth(&mut complex, vertices, (&on_boundary, &[]), &rule, 0.5).unwrap();
    assert!(worst(&complex) > before);
    let moved = |v: usize| complex.points()[v] != outside[v];
    assert!((0..outside.len()).all(|v| !on_boundary[v] || !moved(v)) && (0..outside.len()).any(moved));
    check(&complex, 125.0);
}

#[test]
fn treatment_lifts_the_worst_tets_on_any_number_of_threads() {
    for threads in [1, 3] {
        let context = RunContext::with_threads(threads).unwrap();
        let mut driver = Driver::for_quality(&Options::default(), &context);
        driver.share_all_meshes();
        let mut complex = shaken_grid(9, 0.2);
        let mut sizes = vec![1.0; complex.vertex_count()];
        let on_boundary = boundary_vertices(&complex, &context);
        let before = worst(&complex);
        let goal = BiasedSine::grade_of_angles(24.0, 145.0);
        for treatment in [Treatment::topological(goal), Treatment::everything(goal, Crowding::Allowed)] {
            let bad: Vec<TetId> = complex.finite_tets().collect();
            let done = driver.treat(&mut complex, &mut sizes, &on_boundary, bad, &treatment).unwrap();
            assert_eq!(done == 0, driver.take_touched().is_empty());
            check(&complex, 729.0);
        }
        assert!(worst(&complex) > before && sizes.len() == complex.vertex_count());
    }
}

#[test]
fn what_is_refused_for_its_lengths_does_not_count_as_done() {
    let context = RunContext::with_threads(1).unwrap();
    let mut driver = Driver::for_quality(&Options::default(), &context);
    let mut complex = shaken_grid(5, 0.25);
    let on_boundary = boundary_vertices(&complex, &context);
    let treatment = Treatment::everything(BiasedSine::grade_of_angles(40.0, 110.0), Crowding::Refused);
    let mut counts = [0; 2];
    for size in [0.5, 1.0, 2.5] {
        let mut sizes = vec![size; complex.vertex_count()];
        for tet in complex.finite_tets().collect::<Vec<_>>() {
            if !complex.is_live(tet) {
                continue;
            }
            let done = driver.treat(&mut complex, &mut sizes, &on_boundary, vec![tet], &treatment).unwrap();
            assert_eq!(done > 0, !driver.take_touched().is_empty(), "size {size}");
            counts[usize::from(done > 0)] += 1;
        }
    }
    assert!(counts[0] > 50 && counts[1] > 50, "{counts:?}");
    check(&complex, 125.0);
}

#[test]
fn short_edges_collapse() {
    let context = RunContext::with_threads(1).unwrap();
    let mut driver = Driver::for_quality(&Options::default(), &context);
    let mut complex = shaken_grid(4, 0.0);
    // Two inner vertices nearly meet: the tets between them are flat, so the contraction is an improvement.
    let (a, b) = (VertexId(62), VertexId(63));
    let place = complex.point(a) + DVec3::new(0.1, 0.0, 0.0);
    complex.set_point(b, place);
    let live = complex.live_count();
    let sizes = vec![1.0; complex.vertex_count()];
    driver.collapse_small_edges(&mut complex, &sizes, 0.05, &|_| true).unwrap();
    assert_eq!(complex.live_count(), live);
    driver.collapse_small_edges(&mut complex, &sizes, 0.25, &|_| true).unwrap();
    assert_eq!(complex.live_count(), live, "long by the first factor");
    let tets: Vec<TetId> = complex.finite_tets().collect();
    tets.into_iter().for_each(|tet| complex.set_flags(tet, complex.flags(tet).without_user_bits()));
    driver.collapse_small_edges(&mut complex, &sizes, 0.25, &|_| true).unwrap();
    assert!(complex.live_count() < live);
    check(&complex, 64.0);
}

#[test]
fn smoothing_brings_no_vertices_closer_than_their_sizes_allow() {
    let context = RunContext::with_threads(1).unwrap();
    let moved_with = |size: f64| {
        let mut driver = Driver::for_quality(&Options::default(), &context);
        let mut complex = shaken_grid(5, 0.2);
        let on_boundary = boundary_vertices(&complex, &context);
        let before = complex.points().to_vec();
        let sizes = vec![size; before.len()];
        let rule = SmoothingRule { target: Target::OptimalPlacement, coefficient: 0.5, acceptance: Acceptance::Smart };
        let vertices: Vec<VertexId> = (0..before.len()).map(VertexId::from_index).collect();
        driver.smooth(&mut complex, vertices, (&on_boundary, &sizes), &rule, 0.5).unwrap();
        before.iter().zip(complex.points()).filter(|(old, new)| old != new).count()
    };
    let (free, held) = (moved_with(1.0), moved_with(4.0));
    assert!(free > 10 && held < free / 4, "{free} and {held} of 64");
}

#[test]
fn small_meshes_are_made_by_one_thread() {
    let made = |threads: usize, shares: bool| {
        let context = RunContext::with_threads(threads).unwrap();
        let mut driver = Driver::for_quality(&Options::default(), &context);
        if shares {
            driver.share_all_meshes();
        }
        let mut complex = shaken_grid(9, 0.2);
        let mut sizes = vec![1.0; complex.vertex_count()];
        let on_boundary = boundary_vertices(&complex, &context);
        let bad: Vec<TetId> = complex.finite_tets().collect();
        let treatment = Treatment::topological(BiasedSine::grade_of_angles(24.0, 145.0));
        driver.treat(&mut complex, &mut sizes, &on_boundary, bad, &treatment).unwrap();
        (complex.points().to_vec(), driver.speculative.attempts)
    };
    let alone = made(1, false);
    assert!(alone.1 == 0 && made(3, false) == alone, "the same to the last bit");
    assert!(made(3, true).1 > 0, "shared where asked for");
}
