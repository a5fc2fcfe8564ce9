//! Finds the tet that contains a point by walking through the mesh.
//!
//! # Method
//! From a tet near the point the walk crosses a face that has the point strictly beyond it, and never back through the
//! face it came in by; it ends in a tet none of whose faces does, or in a ghost tet. The face opposite to the vertex
//! nearest to the point is tried last: so the walk turns around that vertex before it leaves it, and does not follow
//! the long tets that points on surfaces make.
//! # Source
//! Visibility walk [DevillersPionTeillaud2002]; it cannot circle, because a Delaunay mesh is acyclic as seen from any
//! point [Edelsbrunner1990].
//! # Invariants
//! Orientation is exact: the tet found contains the point, boundary included; a ghost tet found sees it strictly
//! beyond its hull face. Where other threads change the mesh, a row may be read half old and half new: every step is
//! still one between existing slots and points, and whoever claims the tet found has to look at it again.
//! # Cost
//! A few tets where consecutive points are near each other, O(n^(1/3)) at random.

use glam::DVec3;

use super::kernel_mesh::KernelMesh;
use crate::geometry::granularity::Granularity;
use crate::geometry::predicates::{offset_orientation_in, orient3d};
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::TET_FACES;

/// Where a walk ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Location {
    /// In this tet, or, for a ghost tet, strictly beyond its hull face.
    Tet(TetId),
    /// On this vertex.
    Vertex(VertexId),
    /// Lost among tets that other threads change.
    Lost,
}

/// Steps after which a walk among the changes of other threads is given up; the longest of millions took a tenth.
const SHARED_STEPS: usize = 1 << 14;

/// Walks from `start` to `point`, in a point set of this granularity.
pub(super) fn locate<M: KernelMesh>(mesh: &M, point: DVec3, start: TetId, granularity: &Granularity) -> Location {
    let mut tet = start;
    let mut vertices = mesh.vertices(tet);
    if let Some(ghost) = vertices.iter().position(|v| v.is_ghost()) {
        // Enter by the hull face; the walk may well come out again.
        let inner = mesh.neighbors(tet)[ghost];
        if M::IS_SHARED && inner == TetFace::NONE {
            return Location::Lost;
        }
        tet = inner.tet();
        vertices = mesh.vertices(tet);
    }
    let mut entry = 4;
    let mut steps = 0;
    'walk: loop {
        if M::IS_SHARED {
            steps += 1;
            if steps > SHARED_STEPS {
                return Location::Lost;
            }
        }
        if vertices.iter().any(|v| v.is_ghost()) {
            return Location::Tet(tet);
        }
        let points =
            [mesh.point(vertices[0]), mesh.point(vertices[1]), mesh.point(vertices[2]), mesh.point(vertices[3])];
        let offsets = [points[0] - point, points[1] - point, points[2] - point, points[3] - point];
        let mut nearest = 0;
        for i in 1..4 {
            if offsets[i].length_squared() < offsets[nearest].length_squared() {
                nearest = i;
            }
        }
        for turn in 1..5 {
            let face = (nearest + turn) & 3;
            if face == entry {
                continue;
            }
            let [a, b, c] = TET_FACES[face];
            let rough = offset_orientation_in(granularity, offsets[a], offsets[b], offsets[c]);
            if rough.unwrap_or_else(|| orient3d(points[a], points[b], points[c], point)) > 0.0 {
                let next = mesh.neighbors(tet)[face];
                if M::IS_SHARED && next == TetFace::NONE {
                    return Location::Lost;
                }
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
