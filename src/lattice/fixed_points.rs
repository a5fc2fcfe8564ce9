//! The caller's points become vertices: electrodes, landmarks.
//!
//! # Method
//! For each point the nearest vertices are tried in turn; the first is moved there that no other point has and whose
//! tets all keep at least a share of their height. A point for which there is none is a finding.
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

/// Moves vertices to the points (LPS mm); returns how many points found one.
pub fn snap(mesh: &mut CandidateMesh, points: &[DVec3], grid: &Grid, context: &RunContext) -> usize {
    let mut taken = 0;
    for (number, world) in points.iter().enumerate() {
        let local = grid.world_to_index(*world) * grid.spacing();
        if snap_one(mesh, local) {
            taken += 1;
            continue;
        }
        let text = format!("fixed point {number} cannot become a vertex: no vertex near it can be moved there");
        let finding = Finding::new(FindingCode::Other, Severity::Warning, text).with_ids(number as i64, -1);
        context.report(finding.at(world.to_array()));
    }
    taken
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

    #[test]
    fn a_vertex_moves_to_the_point_and_a_far_point_is_a_finding() {
        let context = RunContext::with_threads(1).unwrap();
        let grid = Grid::new([2, 2, 2], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let mut mesh = CandidateMesh {
            points: vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z],
            tets: vec![[0, 1, 2, 3].map(VertexId)],
            tet_labels: vec![Label(1)],
            ..CandidateMesh::default()
        };
        let points = [DVec3::new(0.1, 0.1, 0.05), DVec3::new(-9.0, 40.0, 7.0)];
        assert_eq!(snap(&mut mesh, &points, &grid, &context), 1);
        assert_eq!((mesh.points[0], mesh.fixed.as_slice()), (points[0], [VertexId(0)].as_slice()));
        assert_eq!(context.take_findings().len(), 1);
    }
}
