//! Separate vertices on both sides of chosen interfaces, for contact.
//!
//! # Method
//! Around each vertex of a chosen interface the elements fall into groups that are connected through faces which are not
//! cut. The first group keeps the vertex, every other group gets a copy. At the rim of an interface all elements are
//! still connected, so the rim stays one vertex.
//!
//! ```text
//!     A | A        A   A
//!     --+--   ->   -----      faces between A and B are cut; the copies lie on the same place
//!     B | B        B   B
//! ```
//! # Differences
//! Not in the thesis.
//!
//! # Invariants
//! A cut face is listed twice in the boundary, once from each side, each with the vertices of its side.

use std::collections::BTreeMap;

use crate::error::Result;
use crate::index::VertexId;
use crate::lattice::finishing::faces_of;
use crate::lattice::options::DuplicatedInterface;
use crate::mesh::mixed_mesh::{BoundaryFaces, MixedMesh};

/// Duplicates the vertices of the chosen interfaces; returns how many copies were made.
///
/// # Errors
/// [`crate::Error::CapacityExceeded`].
pub fn duplicate(mesh: &mut MixedMesh, interfaces: &[DuplicatedInterface]) -> Result<usize> {
    let matches = |a: i32, b: i32| {
        let one = |i: &DuplicatedInterface, a: i32, b: i32| {
            i.first == i64::from(a) && i.second.is_none_or(|second| second == i64::from(b))
        };
        a != b && a != 0 && b != 0 && interfaces.iter().any(|i| one(i, a, b) || one(i, b, a))
    };
    // Elements around the vertices of cut faces, by vertex.
    let mut balls: BTreeMap<VertexId, Vec<usize>> = BTreeMap::new();
    let triangles = mesh.boundary.triangles.len();
    for (face, [a, b]) in mesh.boundary.labels.iter().enumerate() {
        if matches(*a, *b) {
            let corners: &[VertexId] = match face.checked_sub(triangles) {
                None => &mesh.boundary.triangles[face],
                Some(quad) => &mesh.boundary.quads[quad],
            };
            for v in corners {
                balls.entry(*v).or_default();
            }
        }
    }
    if balls.is_empty() {
        return Ok(0);
    }
    for e in 0..mesh.element_count() {
        for v in mesh.element(e).1 {
            if let Some(ball) = balls.get_mut(v) {
                ball.push(e);
            }
        }
    }
    let before = mesh.points.len();
    // Copies by (element, vertex).
    let mut copies: BTreeMap<(usize, VertexId), VertexId> = BTreeMap::new();
    for (vertex, ball) in &balls {
        let groups = groups_of(mesh, *vertex, ball, &matches);
        for group in 1..groups.iter().max().map_or(1, |g| g + 1) {
            let copy = VertexId::try_new(mesh.points.len())?;
            mesh.points.push(mesh.points[vertex.index()]);
            let members = ball.iter().zip(&groups).filter(|(_, g)| **g == group);
            for (e, _) in members {
                copies.insert((*e, *vertex), copy);
            }
        }
    }
    apply(mesh, &copies, &matches);
    Ok(mesh.points.len() - before)
}

/// Group of each element of a ball, numbered from 0 in the order of the ball.
fn groups_of(mesh: &MixedMesh, vertex: VertexId, ball: &[usize], is_cut: &impl Fn(i32, i32) -> bool) -> Vec<usize> {
    let mut group: Vec<usize> = (0..ball.len()).collect();
    let mut behind: BTreeMap<Vec<VertexId>, usize> = BTreeMap::new();
    for (own, e) in ball.iter().enumerate() {
        let (kind, nodes) = mesh.element(*e);
        for mut face in faces_of(kind, nodes).into_iter().filter(|f| f.contains(&vertex)) {
            face.sort_unstable();
            let Some(other) = behind.insert(face, own) else { continue };
            if !is_cut(mesh.labels[*e], mesh.labels[ball[other]]) {
                let (low, high) = (group[own].min(group[other]), group[own].max(group[other]));
                // Balls are small: rewriting all members is cheaper than a forest.
                group.iter_mut().filter(|g| **g == high).for_each(|g| *g = low);
            }
        }
    }
    let mut numbers: Vec<usize> = group.clone();
    numbers.sort_unstable();
    numbers.dedup();
    group.iter().map(|g| numbers.binary_search(g).expect("every group is numbered")).collect()
}

fn apply(mesh: &mut MixedMesh, copies: &BTreeMap<(usize, VertexId), VertexId>, is_cut: &impl Fn(i32, i32) -> bool) {
    for (&(element, vertex), copy) in copies {
        let (begin, end) = (mesh.offsets[element] as usize, mesh.offsets[element + 1] as usize);
        mesh.connectivity[begin..end].iter_mut().filter(|v| **v == vertex).for_each(|v| *v = *copy);
    }
    let of = |element: i64, v: VertexId| copies.get(&(element as usize, v)).copied().unwrap_or(v);
    let old = std::mem::take(&mut mesh.boundary);
    let mut new = BoundaryFaces::default();
    let mut push_sides = |labels: [i32; 2], elements: [i64; 2]| {
        new.labels.push(labels);
        new.elements.push(elements);
    };
    let sides = |face: usize| (old.labels[face], old.elements[face]);
    for (face, corners) in old.triangles.iter().enumerate() {
        let (labels, elements) = sides(face);
        new.triangles.push(corners.map(|v| of(elements[0], v)));
        push_sides(labels, elements);
        if is_cut(labels[0], labels[1]) {
            let [a, b, c] = corners.map(|v| of(elements[1], v));
            new.triangles.push([a, c, b]);
            push_sides([labels[1], labels[0]], [elements[1], elements[0]]);
        }
    }
    for (quad, corners) in old.quads.iter().enumerate() {
        let (labels, elements) = sides(old.triangles.len() + quad);
        new.quads.push(corners.map(|v| of(elements[0], v)));
        push_sides(labels, elements);
        if is_cut(labels[0], labels[1]) {
            let [a, b, c, d] = corners.map(|v| of(elements[1], v));
            new.quads.push([a, d, c, b]);
            push_sides([labels[1], labels[0]], [elements[1], elements[0]]);
        }
    }
    mesh.boundary = new;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;
    use crate::lattice::finishing::boundary_of;
    use glam::DVec3;

    #[test]
    fn two_tets_come_apart_at_their_face() {
        let points = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z, -DVec3::Z];
        let tets = [[0, 1, 2, 3].map(VertexId), [0, 2, 1, 4].map(VertexId)];
        let mut mesh = MixedMesh::from_tets(points, &tets, vec![1, 2]).unwrap();
        mesh.boundary = boundary_of(&mesh, &RunContext::with_threads(1).unwrap()).unwrap();
        assert_eq!(mesh.boundary.triangles.len(), 7);
        let other = [DuplicatedInterface { first: 1, second: Some(3) }];
        assert_eq!(duplicate(&mut mesh, &other).unwrap(), 0);
        let all = [DuplicatedInterface { first: 2, second: None }];
        assert_eq!(duplicate(&mut mesh, &all).unwrap(), 3);
        assert_eq!((mesh.points.len(), mesh.boundary.triangles.len()), (8, 8));
        let (first, second) = (mesh.element(0).1, mesh.element(1).1);
        assert!(first.iter().all(|v| !second.contains(v)));
    }
}
