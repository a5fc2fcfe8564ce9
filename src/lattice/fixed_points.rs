//! The caller's points become vertices: electrodes, landmarks.
//!
//! # Method
//! For each point the nearest vertices are tried in turn; the first is moved there that no other point has and whose
//! tets all keep at least a share of their height. A point for which there is none, or outside of the image, is a finding.
//!
//! # Differences
//! Not in the thesis.
//!
//! # Invariants
//! Tets stay positive. Vertices at fixed points are listed in `CandidateMesh::fixed` and are not moved afterwards.

use glam::DVec3;
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::{Finding, FindingCode, Severity};
use crate::geometry::tetrahedron::volume6;
use crate::image::grid::Grid;
use crate::index::VertexId;
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::mesh::mixed_mesh::ElementKind;
use crate::mesh::quality::scaled_jacobian;

/// Vertices tried per point: those of the tet around it and their nearest neighbours.
const TRIES: usize = 12;

/// Least scaled Jacobian of a tet beside a moved vertex; lattice tets have 0.5 and more.
const MIN_SCALED_JACOBIAN: f64 = 0.15;

/// How far past the border of the image a point may be and still lie on it, voxels: the rounding of decimals.
const BORDER_SLACK: f64 = 1e-3;

/// Moves vertices to the points (LPS mm); returns how many vertices are at one. A point that is given again has its vertex.
pub fn snap(mesh: &mut CandidateMesh, points: &[DVec3], grid: &Grid, context: &RunContext) -> usize {
    let mut taken = 0;
    for (number, world) in points.iter().enumerate() {
        if points[..number].contains(world) {
            continue;
        }
        let index = grid.world_to_index(*world);
        let why = if !is_inside(grid, index) {
            "it is outside of the image"
        } else if !snap_one(mesh, index * grid.spacing()) {
            "no vertex near it can be moved there"
        } else {
            taken += 1;
            continue;
        };
        let [x, y, z] = world.to_array();
        let text = format!("fixed point {number} ({x}, {y}, {z}) cannot become a vertex: {why}");
        let finding = Finding::new(FindingCode::Other, Severity::Warning, text).with_ids(number as i64, -1);
        context.report(finding.at(world.to_array()));
    }
    taken
}

/// Whether a continuous index lies in a voxel of the image.
fn is_inside(grid: &Grid, index: DVec3) -> bool {
    let size = DVec3::from_array(grid.size().map(|s| s as f64));
    index.cmpge(DVec3::splat(-0.5 - BORDER_SLACK)).all() && index.cmple(size - 0.5 + BORDER_SLACK).all()
}

fn snap_one(mesh: &mut CandidateMesh, point: DVec3) -> bool {
    let mut near: Vec<(f64, u32)> =
        mesh.points.par_iter().enumerate().map(|(v, p)| (p.distance_squared(point), v as u32)).collect();
    let tries = TRIES.min(near.len());
    if tries == 0 {
        return false;
    }
    near.select_nth_unstable_by(tries - 1, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    near.truncate(tries);
    near.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    for (_, v) in near {
        let vertex = VertexId(v);
        if mesh.fixed.contains(&vertex) {
            continue;
        }
        let ball: Vec<[VertexId; 4]> = mesh.tets.par_iter().filter(|t| t.contains(&vertex)).copied().collect();
        let moved = |w: VertexId| if w == vertex { point } else { mesh.points[w.index()] };
        let is_good = |tet: &[VertexId; 4]| scaled_jacobian(ElementKind::Tet, &tet.map(moved)) > MIN_SCALED_JACOBIAN;
        let stays_positive = |tet: &[VertexId; 4]| {
            let place = |w: VertexId| if w == vertex { point } else { mesh.scaffold.place(&mesh.points, w) };
            !tet.contains(&vertex) || volume6(tet.map(place)) > 0.0
        };
        if ball.iter().all(is_good) && mesh.scaffold.tets.par_iter().all(stays_positive) {
            mesh.points[vertex.index()] = point;
            mesh.fixed.push(vertex);
            return true;
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::Label;
    use glam::DMat3;

    fn one_tet() -> (Grid, CandidateMesh) {
        let grid = Grid::new([2, 2, 2], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let mesh = CandidateMesh {
            points: vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z],
            tets: vec![[0, 1, 2, 3].map(VertexId)],
            tet_labels: vec![Label(1)],
            ..CandidateMesh::default()
        };
        (grid, mesh)
    }

    #[test]
    fn a_vertex_moves_to_the_point_and_a_point_outside_is_a_finding() {
        let context = RunContext::with_threads(1).unwrap();
        let (grid, mut mesh) = one_tet();
        let points = [DVec3::new(0.1, 0.1, 0.05), DVec3::new(-9.0, 40.0, 7.0)];
        assert_eq!(snap(&mut mesh, &points, &grid, &context), 1);
        assert_eq!((mesh.points[0], mesh.fixed.as_slice()), (points[0], [VertexId(0)].as_slice()));
        let findings = context.take_findings();
        assert_eq!(findings.len(), 1);
        assert_eq!(findings[0].text, "fixed point 1 (-9, 40, 7) cannot become a vertex: it is outside of the image");
        assert_eq!(findings[0].point, [-9.0, 40.0, 7.0]);
    }

    #[test]
    fn a_point_given_twice_takes_one_vertex_without_a_finding() {
        let context = RunContext::with_threads(1).unwrap();
        let (grid, mut mesh) = one_tet();
        let point = DVec3::new(0.1, 0.1, 0.05);
        assert_eq!(snap(&mut mesh, &[point, point], &grid, &context), 1);
        assert_eq!((mesh.points[0], mesh.fixed.as_slice()), (point, [VertexId(0)].as_slice()));
        assert!(context.take_findings().is_empty());
    }
}
