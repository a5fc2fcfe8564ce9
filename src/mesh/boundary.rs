//! The faces of the elements of a finished mesh: its labelled boundary (faces with one element, and faces between two labels), and the
//! volume that the faces of an element enclose.
//!
//! # Method
//! Boundary:
//! 1. List the faces of all elements, each with its sorted vertices, in element order.
//! 2. Sort them; equal neighbours are the two sides of one face.
//! 3. Keep a face with one side, or with two labels; it is written outward from the side with the smaller label.
//!
//! # Invariants
//! The result does not depend on anything but the mesh: faces come in the order of their first element.
//!
//! # Cost
//! 28 bytes per face of an element while it runs; one sort.

use glam::DVec3;

use crate::index::VertexId;
use crate::mesh::mixed_mesh::{BoundaryFaces, ElementKind, MixedMesh};
use crate::mesh::numbering::{HEX_FACES, PYRAMID_BASE, PYRAMID_TRIANGLES, TET_FACES, WEDGE_QUADS, WEDGE_TRIANGLES};

/// The corner vertices of the faces of an element kind, outward; triangles have three, quadrilaterals four.
pub fn faces_of(kind: ElementKind) -> Vec<&'static [usize]> {
    match kind {
        ElementKind::Tet | ElementKind::QuadraticTet => TET_FACES.iter().map(|f| &f[..]).collect(),
        ElementKind::Hexahedron | ElementKind::QuadraticHexahedron => HEX_FACES.iter().map(|f| &f[..]).collect(),
        ElementKind::Wedge => {
            WEDGE_TRIANGLES.iter().map(|f| &f[..]).chain(WEDGE_QUADS.iter().map(|f| &f[..])).collect()
        }
        ElementKind::Pyramid => {
            std::iter::once(&PYRAMID_BASE[..]).chain(PYRAMID_TRIANGLES.iter().map(|f| &f[..])).collect()
        }
    }
}

/// One side of a face: sorted vertices (a triangle has the sentinel last), element, local face.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Side {
    key: [u32; 4],
    element: u32,
    face: u32,
}

/// A face of the mesh: the side it is seen from, and the element behind it (-1: none).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct FacePair {
    /// Element from which the face is outward.
    pub element: u32,
    /// Local face of that element, as [`faces_of`] lists them.
    pub face: u32,
    /// The element behind it.
    pub neighbor: i64,
}

/// Every face of a mesh once, seen from its first element, in the order of first element and local face.
///
/// Faces with more than two elements come once per further pair; `mesh::validation` finds such meshes.
pub fn face_pairs(mesh: &MixedMesh) -> Vec<FacePair> {
    let mut sides = Vec::new();
    for element in 0..mesh.element_count() {
        let (kind, vertices) = mesh.element(element);
        for (face, corners) in faces_of(kind).iter().enumerate() {
            let mut key = [u32::MAX; 4];
            corners.iter().zip(&mut key).for_each(|(&c, k)| *k = vertices[c].0);
            key.sort_unstable();
            sides.push(Side { key, element: element as u32, face: face as u32 });
        }
    }
    sides.sort_unstable();
    let mut pairs = Vec::with_capacity(sides.len() / 2 + 1);
    let mut at = 0;
    while at < sides.len() {
        let Side { key, element, face } = sides[at];
        let shared = sides.get(at + 1).is_some_and(|next| next.key == key);
        let neighbor = if shared { i64::from(sides[at + 1].element) } else { -1 };
        pairs.push(FacePair { element, face, neighbor });
        at += 1 + usize::from(shared);
    }
    pairs.sort_unstable();
    pairs
}

/// Volume of an element: the cones from its first corner over its faces, a quadrilateral as the mean of its two cuts.
pub fn element_volume(mesh: &MixedMesh, element: usize) -> f64 {
    let (kind, vertices) = mesh.element(element);
    let apex = mesh.points[vertices[0].index()];
    let cone = |a: DVec3, b: DVec3, c: DVec3| (a - apex).dot((b - apex).cross(c - apex)) / 6.0;
    let at = |corner: usize| mesh.points[vertices[corner].index()];
    faces_of(kind)
        .iter()
        .map(|face| match **face {
            [a, b, c] => cone(at(a), at(b), at(c)),
            [a, b, c, d] => {
                let cut = cone(at(a), at(b), at(c)) + cone(at(a), at(c), at(d));
                let other = cone(at(b), at(c), at(d)) + cone(at(b), at(d), at(a));
                (cut + other) / 2.0
            }
            _ => 0.0,
        })
        .sum()
}

/// The boundary of a mesh: outer faces and interfaces of labels.
pub fn extract_boundary(mesh: &MixedMesh) -> BoundaryFaces {
    let mut triangles = BoundaryFaces::default();
    let mut quads = BoundaryFaces::default();
    for pair in face_pairs(mesh) {
        let inner = mesh.labels[pair.element as usize];
        let outer = if pair.neighbor < 0 { 0 } else { mesh.labels[pair.neighbor as usize] };
        if pair.neighbor >= 0 && inner == outer {
            continue;
        }
        let turned = pair.neighbor >= 0 && outer < inner;
        let (kind, vertices) = mesh.element(pair.element as usize);
        let corners: Vec<VertexId> = faces_of(kind)[pair.face as usize].iter().map(|&c| vertices[c]).collect();
        let target = if corners.len() == 3 { &mut triangles } else { &mut quads };
        match (corners.as_slice(), turned) {
            (&[a, b, c], false) => target.triangles.push([a, b, c]),
            (&[a, b, c], true) => target.triangles.push([a, c, b]),
            (&[a, b, c, d], false) => target.quads.push([a, b, c, d]),
            (&[a, b, c, d], true) => target.quads.push([a, d, c, b]),
            _ => {}
        }
        let element = i64::from(pair.element);
        target.labels.push(if turned { [outer, inner] } else { [inner, outer] });
        target.elements.push(if turned { [pair.neighbor, element] } else { [element, pair.neighbor] });
    }
    triangles.quads = quads.quads;
    triangles.labels.extend(quads.labels);
    triangles.elements.extend(quads.elements);
    triangles
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ids<const N: usize>(values: [u32; N]) -> [VertexId; N] {
        values.map(VertexId)
    }

    #[test]
    fn two_tets_share_an_interface_outward_from_the_smaller_label() {
        let points = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z, DVec3::ONE];
        let mesh = MixedMesh::from_tets(points.clone(), &[ids([0, 1, 2, 3]), ids([1, 2, 3, 4])], vec![7, 2]).unwrap();
        let boundary = extract_boundary(&mesh);
        assert_eq!(boundary.triangles.len(), 7);
        let interface = boundary.labels.iter().position(|l| *l == [2, 7]).unwrap();
        let [a, b, c] = boundary.triangles[interface].map(|v| points[v.index()]);
        // Outward from the element of label 2, which holds point 4.
        assert!((b - a).cross(c - a).dot(points[4] - a) < 0.0);
        assert_eq!(boundary.elements[interface], [1, 0]);
        assert_eq!(face_pairs(&mesh).len(), 7);
    }

    #[test]
    fn the_boundary_of_a_hexahedron_is_six_quads() {
        let corner = |i: usize| DVec3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2) as f64);
        let mesh = MixedMesh {
            points: [0, 1, 3, 2, 4, 5, 7, 6].map(corner).to_vec(),
            types: vec![12],
            offsets: vec![0, 8],
            connectivity: (0..8).map(VertexId).collect(),
            labels: vec![1],
            ..MixedMesh::default()
        };
        let boundary = extract_boundary(&mesh);
        assert_eq!((boundary.triangles.len(), boundary.quads.len()), (0, 6));
        for quad in &boundary.quads {
            let [a, b, c, _] = quad.map(|v| mesh.points[v.index()]);
            assert!((b - a).cross(c - a).dot(DVec3::splat(0.5) - a) < 0.0);
        }
    }
}
