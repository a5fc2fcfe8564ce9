//! Checks a finished mesh: orientation, conformity, duplicates, boundary.
//!
//! # Method
//! 1. Shape of the arrays ([`MixedMesh::check_shape`]), finite points.
//! 2. Orientation by exact predicates: every corner of every element spans a positive tet.
//! 3. Faces are grouped by their smallest vertex and compared within a group: at most two elements share a face, from
//!    its two sides, with the same corners in the same cyclic order; equal elements are found the same way.
//! 4. No free triangle lies on a free quadrilateral: triangles against half a quadrilateral do not conform.
//! 5. The boundary list, where there is one: every face that one element has alone is listed, every listed face is a
//!    face of the elements it names.
//!
//! # Cost
//! O(elements); 8 bytes per face of temporary memory. Parallel over vertices and deterministic: the violation reported
//! is the one of the smallest element or vertex.

use glam::DVec3;
use rayon::prelude::*;

use crate::geometry::predicates::orient3d;
use crate::index::VertexId;
use crate::mesh::mixed_mesh::{ElementKind, MixedMesh};
use crate::mesh::numbering::{HEX_FACES, PYRAMID_BASE, PYRAMID_TRIANGLES, TET_FACES, WEDGE_QUADS, WEDGE_TRIANGLES};

/// What is wrong with a mesh.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Violation {
    /// Arrays of the wrong length, unknown types, ids out of range.
    #[error("{0}")]
    Shape(String),
    /// A coordinate that is not finite.
    #[error("point {0} is not finite")]
    NonFinitePoint(usize),
    /// An element that is flat or inverted at a corner, or repeats a vertex.
    #[error("element {0} is not positively oriented")]
    Orientation(usize),
    /// Two elements with the same vertices.
    #[error("elements {0} and {1} are equal")]
    Duplicate(usize, usize),
    /// A face with three elements.
    #[error("elements {0}, {1} and {2} share a face")]
    FaceOfThree(usize, usize, usize),
    /// Two elements on the same side of a face.
    #[error("elements {0} and {1} lie on the same side of a face")]
    SameSide(usize, usize),
    /// Two quadrilaterals with the same vertices in another order.
    #[error("elements {0} and {1} share four vertices but no quadrilateral")]
    TwistedQuad(usize, usize),
    /// A triangle of one element covers half of a quadrilateral of another.
    #[error("a triangle of element {0} lies on a quadrilateral of element {1}")]
    TriangleOnQuad(usize, usize),
    /// A face of one element alone that the boundary does not list.
    #[error("element {0} has an outer face that the boundary does not list")]
    UnlistedBoundary(usize),
    /// A listed boundary face that is no face of the elements it names.
    #[error("boundary face {0} is no face of its elements")]
    StrayBoundary(usize),
}

/// Up to six faces of an element, outward; triangles repeat no vertex and have three entries.
fn faces_of(kind: ElementKind) -> &'static [&'static [usize]] {
    const TET: [&[usize]; 4] = [&TET_FACES[0], &TET_FACES[1], &TET_FACES[2], &TET_FACES[3]];
    const PYRAMID: [&[usize]; 5] =
        [&PYRAMID_BASE, &PYRAMID_TRIANGLES[0], &PYRAMID_TRIANGLES[1], &PYRAMID_TRIANGLES[2], &PYRAMID_TRIANGLES[3]];
    const WEDGE: [&[usize]; 5] =
        [&WEDGE_TRIANGLES[0], &WEDGE_TRIANGLES[1], &WEDGE_QUADS[0], &WEDGE_QUADS[1], &WEDGE_QUADS[2]];
    const HEX: [&[usize]; 6] =
        [&HEX_FACES[0], &HEX_FACES[1], &HEX_FACES[2], &HEX_FACES[3], &HEX_FACES[4], &HEX_FACES[5]];
    match kind {
        ElementKind::Tet | ElementKind::QuadraticTet => &TET,
        ElementKind::Pyramid => &PYRAMID,
        ElementKind::Wedge => &WEDGE,
        ElementKind::Hexahedron | ElementKind::QuadraticHexahedron => &HEX,
    }
}

/// Corner tets that have to be positive, per kind.
fn corner_tets(kind: ElementKind) -> &'static [[usize; 4]] {
    match kind {
        ElementKind::Tet | ElementKind::QuadraticTet => &[[0, 1, 2, 3]],
        ElementKind::Pyramid => &[[0, 1, 3, 4], [1, 2, 0, 4], [2, 3, 1, 4], [3, 0, 2, 4]],
        ElementKind::Wedge => &[[0, 2, 1, 3], [1, 0, 2, 4], [2, 1, 0, 5], [3, 4, 5, 0], [4, 5, 3, 1], [5, 3, 4, 2]],
        ElementKind::Hexahedron | ElementKind::QuadraticHexahedron => &[
            [0, 1, 3, 4],
            [1, 2, 0, 5],
            [2, 3, 1, 6],
            [3, 0, 2, 7],
            [4, 7, 5, 0],
            [5, 4, 6, 1],
            [6, 5, 7, 2],
            [7, 6, 4, 3],
        ],
    }
}

/// A face in a form that its two sides share.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct FaceKey {
    /// Sorted vertices; `NONE` last for a triangle.
    sorted: [VertexId; 4],
    /// The vertex opposite to the smallest one in a quadrilateral: tells the cyclic orders apart.
    opposite: VertexId,
    /// 0 or 1: which way round seen from the element.
    side: u8,
    element: usize,
}

fn face_key(element: usize, vertices: &[VertexId], face: &[usize]) -> FaceKey {
    let mut sorted = [VertexId::NONE; 4];
    for (slot, &local) in sorted.iter_mut().zip(face) {
        *slot = vertices[local];
    }
    let cycle = sorted;
    let count = face.len();
    let smallest = (0..count).min_by_key(|&i| cycle[i]).unwrap_or(0);
    let (next, previous) = (cycle[(smallest + 1) % count], cycle[(smallest + count - 1) % count]);
    let opposite = if count == 4 { cycle[(smallest + 2) % 4] } else { VertexId::NONE };
    sorted.sort_unstable();
    FaceKey { sorted, opposite, side: u8::from(next < previous), element }
}

/// Checks everything listed in the module's documentation.
///
/// # Errors
/// The first [`Violation`] in the order of the method's steps.
pub fn check_mixed_mesh(mesh: &MixedMesh) -> Result<(), Violation> {
    mesh.check_shape().map_err(|e| Violation::Shape(e.to_string()))?;
    if let Some(point) = mesh.points.iter().position(|p| !p.is_finite()) {
        return Err(Violation::NonFinitePoint(point));
    }
    if let Some(element) = (0..mesh.element_count()).into_par_iter().filter(|&e| !is_positive(mesh, e)).min() {
        return Err(Violation::Orientation(element));
    }
    let groups = FaceGroups::of(mesh);
    let free: Vec<FaceKey> = groups.free_faces(mesh)?;
    check_half_quads(&free)?;
    check_boundary(mesh, &free)
}

fn is_positive(mesh: &MixedMesh, element: usize) -> bool {
    let (kind, vertices) = mesh.element(element);
    corner_tets(kind).iter().all(|corner| {
        let [a, b, c, d]: [DVec3; 4] = corner.map(|local| mesh.points[vertices[local].index()]);
        orient3d(a, b, c, d) > 0.0
    })
}

/// Faces of all elements, by their smallest vertex.
struct FaceGroups {
    starts: Vec<usize>,
    /// `8 * element + face`.
    faces: Vec<u64>,
}

impl FaceGroups {
    fn of(mesh: &MixedMesh) -> Self {
        let mut starts = vec![0usize; mesh.points.len() + 2];
        for_each_face(mesh, |smallest, _| starts[smallest + 2] += 1);
        for vertex in 2..starts.len() {
            starts[vertex] += starts[vertex - 1];
        }
        let mut faces = vec![0u64; *starts.last().unwrap_or(&0)];
        for_each_face(mesh, |smallest, id| {
            faces[starts[smallest + 1]] = id;
            starts[smallest + 1] += 1;
        });
        Self { starts, faces }
    }

    /// Checks that faces meet properly and returns those of one element alone, sorted.
    fn free_faces(&self, mesh: &MixedMesh) -> Result<Vec<FaceKey>, Violation> {
        let per_vertex = |vertex: usize| -> Result<Vec<FaceKey>, Violation> {
            let ids = &self.faces[self.starts[vertex]..self.starts[vertex + 1]];
            let mut keys: Vec<FaceKey> = ids
                .iter()
                .map(|id| {
                    let (element, face) = ((id >> 3) as usize, (id & 7) as usize);
                    let (kind, vertices) = mesh.element(element);
                    face_key(element, vertices, faces_of(kind)[face])
                })
                .collect();
            keys.sort_unstable();
            let mut free = Vec::new();
            for group in keys.chunk_by(|a, b| a.sorted == b.sorted) {
                match group {
                    [one] => free.push(*one),
                    [a, b] => check_pair(mesh, a, b)?,
                    [a, b, c, ..] => return Err(Violation::FaceOfThree(a.element, b.element, c.element)),
                    [] => {}
                }
            }
            Ok(free)
        };
        let results: Vec<Result<Vec<FaceKey>, Violation>> = (0..mesh.points.len())
            .into_par_iter()
            .with_min_len(1024)
            .map(per_vertex)
            .filter(|r| !matches!(r, Ok(f) if f.is_empty()))
            .collect();
        let mut free = Vec::new();
        for result in results {
            free.extend(result?);
        }
        free.sort_unstable();
        Ok(free)
    }
}

fn check_pair(mesh: &MixedMesh, a: &FaceKey, b: &FaceKey) -> Result<(), Violation> {
    let (first, second) = (a.element.min(b.element), a.element.max(b.element));
    if a.opposite != b.opposite {
        return Err(Violation::TwistedQuad(first, second));
    }
    if a.side == b.side {
        let sorted = |element: usize| {
            let mut vertices = mesh.element(element).1.to_vec();
            vertices.sort_unstable();
            vertices
        };
        let equal = sorted(first) == sorted(second);
        return Err(if equal { Violation::Duplicate(first, second) } else { Violation::SameSide(first, second) });
    }
    Ok(())
}

fn for_each_face(mesh: &MixedMesh, mut visit: impl FnMut(usize, u64)) {
    for element in 0..mesh.element_count() {
        let (kind, vertices) = mesh.element(element);
        for (face, corners) in faces_of(kind).iter().enumerate() {
            let smallest = corners.iter().map(|&local| vertices[local]).min().map_or(0, VertexId::index);
            visit(smallest, (element as u64) << 3 | face as u64);
        }
    }
}

fn check_half_quads(free: &[FaceKey]) -> Result<(), Violation> {
    for quad in free.iter().filter(|f| f.sorted[3] != VertexId::NONE) {
        for left_out in 0..4 {
            let mut triangle = quad.sorted;
            triangle[left_out] = VertexId::NONE;
            triangle.sort_unstable();
            let at = free.partition_point(|f| f.sorted < triangle);
            if free.get(at).is_some_and(|f| f.sorted == triangle) {
                return Err(Violation::TriangleOnQuad(free[at].element, quad.element));
            }
        }
    }
    Ok(())
}

fn check_boundary(mesh: &MixedMesh, free: &[FaceKey]) -> Result<(), Violation> {
    let boundary = &mesh.boundary;
    let count = boundary.triangles.len() + boundary.quads.len();
    if count == 0 {
        return Ok(());
    }
    let listed_vertices = |index: usize| -> &[VertexId] {
        match index.checked_sub(boundary.triangles.len()) {
            None => &boundary.triangles[index],
            Some(quad) => &boundary.quads[quad],
        }
    };
    let sorted_row = |vertices: &[VertexId]| {
        let mut row = [VertexId::NONE; 4];
        row[..vertices.len()].copy_from_slice(vertices);
        row.sort_unstable();
        row
    };
    let mut listed: Vec<[VertexId; 4]> = (0..count).map(|i| sorted_row(listed_vertices(i))).collect();
    for (index, elements) in boundary.elements.iter().enumerate().take(count) {
        for element in elements.iter().filter(|e| **e >= 0) {
            let found = usize::try_from(*element).is_ok_and(|e| {
                e < mesh.element_count() && {
                    let (kind, vertices) = mesh.element(e);
                    faces_of(kind).iter().any(|face| face_key(e, vertices, face).sorted == listed[index])
                }
            });
            if !found {
                return Err(Violation::StrayBoundary(index));
            }
        }
    }
    listed.sort_unstable();
    match free.iter().find(|f| listed.binary_search(&f.sorted).is_err()) {
        Some(face) => Err(Violation::UnlistedBoundary(face.element)),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two_tets() -> MixedMesh {
        let points = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z, DVec3::ONE];
        let tets = [[0, 1, 2, 3], [1, 2, 3, 4]].map(|t: [u32; 4]| t.map(VertexId));
        MixedMesh::from_tets(points, &tets, vec![1, 1]).unwrap()
    }

    fn mixed(points: Vec<DVec3>, elements: &[(ElementKind, &[u32])]) -> MixedMesh {
        let mut mesh = MixedMesh { points, offsets: vec![0], ..MixedMesh::default() };
        for (kind, vertices) in elements {
            mesh.types.push(kind.vtk_type());
            mesh.connectivity.extend(vertices.iter().map(|v| VertexId(*v)));
            mesh.offsets.push(mesh.connectivity.len() as i64);
            mesh.labels.push(1);
        }
        mesh
    }

    fn cube_points() -> Vec<DVec3> {
        [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
            .map(|(x, y, z)| DVec3::new(f64::from(x), f64::from(y), f64::from(z)))
            .to_vec()
    }

    #[test]
    fn accepts_a_valid_mesh() {
        assert_eq!(check_mixed_mesh(&two_tets()), Ok(()));
        let hex = mixed(cube_points(), &[(ElementKind::Hexahedron, &[0, 1, 2, 3, 4, 5, 6, 7])]);
        assert_eq!(check_mixed_mesh(&hex), Ok(()));
    }

    #[test]
    fn finds_inverted_and_duplicate_elements() {
        let mut mesh = two_tets();
        mesh.connectivity.swap(4, 5);
        assert_eq!(check_mixed_mesh(&mesh), Err(Violation::Orientation(1)));
        let points = two_tets().points;
        let tets = [[0, 1, 2, 3], [1, 2, 0, 3]].map(|t: [u32; 4]| t.map(VertexId));
        let twice = MixedMesh::from_tets(points, &tets, vec![1, 1]).unwrap();
        assert_eq!(check_mixed_mesh(&twice), Err(Violation::Duplicate(0, 1)));
    }

    #[test]
    fn finds_overlap_and_faces_of_three() {
        let mut mesh = two_tets();
        mesh.points.push(DVec3::splat(0.9));
        let tets = [[0, 1, 2, 3], [1, 2, 3, 4], [1, 2, 3, 5]].map(|t: [u32; 4]| t.map(VertexId));
        let three = MixedMesh::from_tets(mesh.points.clone(), &tets, vec![1; 3]).unwrap();
        assert!(matches!(check_mixed_mesh(&three), Err(Violation::FaceOfThree(..))));
        let pair = MixedMesh::from_tets(mesh.points, &tets[1..], vec![1; 2]).unwrap();
        assert_eq!(check_mixed_mesh(&pair), Err(Violation::SameSide(0, 1)));
    }

    #[test]
    fn finds_triangles_on_a_quadrilateral() {
        let mut points = cube_points();
        points.push(DVec3::new(0.5, 0.5, 2.0));
        let hex: (ElementKind, &[u32]) = (ElementKind::Hexahedron, &[0, 1, 2, 3, 4, 5, 6, 7]);
        let good = mixed(points.clone(), &[hex, (ElementKind::Pyramid, &[4, 5, 6, 7, 8])]);
        assert_eq!(check_mixed_mesh(&good), Ok(()));
        let bad = mixed(points, &[hex, (ElementKind::Tet, &[4, 5, 6, 8])]);
        assert_eq!(check_mixed_mesh(&bad), Err(Violation::TriangleOnQuad(1, 0)));
    }

    #[test]
    fn checks_the_boundary_list() {
        let mut mesh = two_tets();
        mesh.boundary.triangles = vec![[0, 2, 1].map(VertexId)];
        mesh.boundary.elements = vec![[0, -1]];
        assert!(matches!(check_mixed_mesh(&mesh), Err(Violation::UnlistedBoundary(_))));
        mesh.boundary.elements = vec![[1, -1]];
        assert_eq!(check_mixed_mesh(&mesh), Err(Violation::StrayBoundary(0)));
    }
}
