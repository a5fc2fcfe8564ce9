//! Unit tests of the flips.

use super::*;
use crate::conforming::flip_criteria::{AnyPositive, BiasedSine};
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::topology::find_edge;
use glam::DVec3;

/// `n` tets around the edge 0 1.
fn wheel(n: u32) -> TetComplex {
    let mut points = vec![DVec3::ZERO, DVec3::Z];
    points.extend((0..n).map(|i| {
        let angle = f64::from(i) / f64::from(n) * std::f64::consts::TAU;
        DVec3::new(angle.cos(), angle.sin(), 0.45 + 0.1 * f64::from(i % 2))
    }));
    let mut complex = TetComplex::with_points(points).unwrap();
    for i in 0..n {
        complex.create_tet([0, 1, 2 + i, 2 + (i + 1) % n].map(VertexId), Label(1)).unwrap();
    }
    complex.pair_faces().unwrap();
    complex
}

fn volume(complex: &TetComplex) -> f64 {
    complex.finite_tets().map(|t| crate::geometry::tetrahedron::volume(complex.points_of(t))).sum()
}

fn assert_valid(complex: &TetComplex, expected: f64) {
    complex.check_invariants().unwrap();
    complex.check_orientation().unwrap();
    assert!((volume(complex) - expected).abs() < 1e-12);
}

fn edge(complex: &TetComplex, a: u32, b: u32) -> Option<ShellTet> {
    find_edge(complex, VertexId(a), VertexId(b), &mut Vec::new())
}

#[test]
fn edge_removal_and_face_removal_are_inverse() {
    for n in 3..=10 {
        let mut complex = wheel(n);
        let before = volume(&complex);
        let mut scratch = FlipScratch::default();
        let start = edge(&complex, 0, 1).unwrap();
        let outcome = plan_edge_removal(&mut complex, start, 10, &BiasedSine, Accept::Valid, &mut scratch);
        assert_eq!(outcome, Outcome::Accepted);
        commit(&mut complex, &mut scratch).unwrap();
        assert_eq!(complex.live_count(), 2 * n as usize - 4);
        assert!(edge(&complex, 0, 1).is_none());
        assert_valid(&complex, before);
        // Any face of the ring's triangulation leads back to the edge.
        let tet = complex.finite_tets().find(|&t| complex.local_vertex(t, VertexId(1)).is_some()).unwrap();
        let side = TetFace::new(tet, complex.local_vertex(tet, VertexId(1)).unwrap());
        let outcome = plan_face_removal(&mut complex, side, &AnyPositive, Accept::Valid, &mut scratch);
        if n <= 4 {
            assert_eq!(outcome, Outcome::Accepted, "n = {n}");
            commit(&mut complex, &mut scratch).unwrap();
            assert_valid(&complex, before);
        }
    }
}

#[test]
fn flip_23_keeps_volume_and_constraints() {
    let mut complex = wheel(3);
    let mut scratch = FlipScratch::default();
    let start = edge(&complex, 0, 1).unwrap();
    let border = TetFace::new(start.tet, start.a);
    complex.constrain_face(border, true);
    let mut vertices = complex.face_vertices(border);
    vertices.sort_unstable();
    let before = volume(&complex);
    assert_eq!(plan_edge_removal(&mut complex, start, 10, &BiasedSine, Accept::Valid, &mut scratch), Outcome::Accepted);
    commit(&mut complex, &mut scratch).unwrap();
    let constrained = |complex: &TetComplex| {
        let mut found = Vec::new();
        for tet in complex.live_tets() {
            found.extend((0..4).filter(|&f| complex.flags(tet).is_face_constrained(f)).map(|f| {
                let mut face = complex.face_vertices(TetFace::new(tet, f));
                face.sort_unstable();
                face
            }));
        }
        found
    };
    assert_eq!(constrained(&complex), [vertices]);
    let tet = complex.live_tets().next().unwrap();
    let inner = (0..4).map(|f| TetFace::new(tet, f)).find(|&s| complex.neighbor(s) != TetFace::NONE).unwrap();
    assert_eq!(plan_23(&mut complex, inner, &BiasedSine, Accept::Valid, &mut scratch), Outcome::Accepted);
    commit(&mut complex, &mut scratch).unwrap();
    assert_eq!(constrained(&complex), [vertices]);
    assert_valid(&complex, before);
    assert_eq!(complex.live_count(), 3);
}

#[test]
fn constrained_edges_are_kept() {
    let mut complex = wheel(5);
    for tet in complex.live_tets().collect::<Vec<_>>() {
        let flags = complex.flags(tet).with_edge(0, true);
        complex.set_flags(tet, flags);
    }
    let start = edge(&complex, 0, 1).unwrap();
    let mut scratch = FlipScratch::default();
    let outcome = plan_edge_removal(&mut complex, start, 10, &BiasedSine, Accept::Valid, &mut scratch);
    assert_eq!(outcome, Outcome::Constrained);
}

#[test]
fn insertion_and_contraction_are_inverse() {
    for kind in 0..3 {
        let mut complex = wheel(6);
        let before = volume(&complex);
        let start = edge(&complex, 0, 1).unwrap();
        let corners = complex.points_of(start.tet);
        let (point, feature, count) = match kind {
            0 => (corners.iter().sum::<DVec3>() / 4.0, Feature::Tet(start.tet), 4 - 1),
            1 => {
                let side = TetFace::new(start.tet, start.c);
                let face = complex.face_vertices(side).map(|v| complex.point(v));
                (face.iter().sum::<DVec3>() / 3.0, Feature::Face(side), 6 - 2)
            }
            _ => (DVec3::new(0.0, 0.0, 0.5), Feature::Edge(start.tet, start.a, start.b), 6),
        };
        let vertex = complex.push_point(point).unwrap();
        let mut scratch = FlipScratch::default();
        let outcome = plan_insertion(&mut complex, feature, vertex, &BiasedSine, &mut scratch);
        assert_eq!(outcome, Outcome::Accepted);
        commit(&mut complex, &mut scratch).unwrap();
        assert_eq!(complex.live_count(), 6 + count);
        assert_valid(&complex, before);
        let outcome = plan_vertex_removal(&mut complex, vertex, &BiasedSine, Accept::Valid, &mut scratch);
        assert_eq!(outcome, Outcome::Accepted);
        commit(&mut complex, &mut scratch).unwrap();
        assert_eq!(complex.live_count(), 6);
        assert_valid(&complex, before);
    }
}

#[test]
fn hull_diagonal_flips_only_when_coplanar() {
    // A square pyramid whose base is two hull faces, closed by ghosts.
    for lift in [0.0, -0.1] {
        let points = [[0.0, 0.0, 0.0], [1.0, 0.0, lift], [1.0, 1.0, 0.0], [0.0, 1.0, lift], [0.5, 0.5, 1.0]];
        let mut complex = TetComplex::with_points(points.map(DVec3::from_array).to_vec()).unwrap();
        for row in [[0, 1, 2, 4], [0, 2, 3, 4]] {
            complex.create_tet(row.map(VertexId), Label(0)).unwrap();
        }
        let hull = [[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]];
        for [a, b, c] in hull {
            complex.create_tet([VertexId(a), VertexId(b), VertexId(c), VertexId::GHOST], Label(0)).unwrap();
        }
        complex.pair_faces().unwrap();
        complex.rebuild_vertex_tets();
        let start = edge(&complex, 0, 2).unwrap();
        let start = if complex.is_ghost_tet(start.tet) { start.next(&complex).unwrap() } else { start };
        let start = if complex.is_ghost_tet(start.tet) { start.next(&complex).unwrap() } else { start };
        let mut scratch = FlipScratch::default();
        let outcome = plan_edge_removal(&mut complex, start, 10, &AnyPositive, Accept::Valid, &mut scratch);
        if lift == 0.0 {
            assert_eq!(outcome, Outcome::Accepted);
            commit(&mut complex, &mut scratch).unwrap();
            assert!(edge(&complex, 1, 3).is_some() && edge(&complex, 0, 2).is_none());
            complex.check_invariants().unwrap();
            complex.check_orientation().unwrap();
        } else {
            assert_eq!(outcome, Outcome::Constrained);
        }
    }
}
