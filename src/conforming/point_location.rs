//! Finds the tet that contains a point by walking through the mesh.
//!
//! # Method
//! From a tet near the point the walk crosses a face that has the point strictly beyond it, and never back through the
//! face it came in by; it ends in a tet none of whose faces does, or in a ghost tet. The first face looked at is
//! chosen at random in every tet, so that the walk cannot circle for ever.
//! # Source
//! Remembering stochastic walk [DevillersPionTeillaud2002].
//! # Invariants
//! Orientation is exact: the tet found contains the point, boundary included; a ghost tet found sees it strictly
//! beyond its hull face.
//! # Cost
//! A few tets where consecutive points are near each other, O(n^(1/3)) at random.

use glam::DVec3;

use super::kernel_mesh::KernelMesh;
use crate::geometry::predicates::{offset_orientation, orient3d};
use crate::index::{TetId, VertexId};
use crate::mesh::numbering::TET_FACES;

/// Where a walk ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Location {
    /// In this tet, or, for a ghost tet, strictly beyond its hull face.
    Tet(TetId),
    /// On this vertex.
    Vertex(VertexId),
    /// The way leads through tets that another thread may change.
    Unreachable,
}

/// A small generator for the walk's coin: quality does not matter, speed does.
#[derive(Debug, Clone)]
pub(super) struct WalkRandom(pub u32);

impl WalkRandom {
    #[inline]
    fn next_face(&mut self) -> usize {
        // Numerical recipes' linear congruential generator; the high bits are the random ones.
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (self.0 >> 30) as usize
    }
}

/// Walks from `start` to `point`.
pub(super) fn locate<M: KernelMesh>(mesh: &M, point: DVec3, start: TetId, random: &mut WalkRandom) -> Location {
    let mut tet = start;
    let mut vertices = mesh.vertices(tet);
    if !mesh.is_stable(&vertices) {
        return Location::Unreachable;
    }
    if let Some(ghost) = vertices.iter().position(|v| v.is_ghost()) {
        // Enter by the hull face; the walk may well come out again.
        tet = mesh.neighbors(tet)[ghost].tet();
        vertices = mesh.vertices(tet);
    }
    let mut entry = 4;
    'walk: loop {
        if !mesh.is_stable(&vertices) {
            return Location::Unreachable;
        }
        if vertices.iter().any(|v| v.is_ghost()) {
            return Location::Tet(tet);
        }
        let points =
            [mesh.point(vertices[0]), mesh.point(vertices[1]), mesh.point(vertices[2]), mesh.point(vertices[3])];
        let offsets = [points[0] - point, points[1] - point, points[2] - point, points[3] - point];
        let first = random.next_face();
        for turn in 0..4 {
            let face = (first + turn) & 3;
            if face == entry {
                continue;
            }
            let [a, b, c] = TET_FACES[face];
            let rough = offset_orientation(offsets[a], offsets[b], offsets[c]);
            if rough.unwrap_or_else(|| orient3d(points[a], points[b], points[c], point)) > 0.0 {
                let next = mesh.neighbors(tet)[face];
                tet = next.tet();
                entry = next.face();
                vertices = mesh.vertices(tet);
                continue 'walk;
            }
        }
        return match points.iter().position(|&p| p == point) {
            Some(corner) => Location::Vertex(vertices[corner]),
            None => Location::Tet(tet),
        };
    }
}
