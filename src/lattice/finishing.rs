//! The finished mesh: world coordinates, the caller's labels, surfaces per label and label pair, mid-edge nodes.
//!
//! # Method
//! 1. Points go from the local frame to the world; where the grid is left-handed, elements are mirrored.
//! 2. Faces between labels, and between a label and the outside, become the boundary.
//! 3. On request each edge gets a node in its middle.
//!
//! # Invariants
//! Elements stay in the order tets, pyramids, hexahedra. A face between two labels is listed once, outward from the
//! smaller caller's label.

use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::image::grid::Grid;
use crate::index::VertexId;
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::face_adjacency::{OUTSIDE, neighbors_of};
use crate::mesh::mixed_mesh::{BoundaryFaces, ElementKind, MixedMesh, Space};
use crate::mesh::numbering::{HEX_FACES, PYRAMID_BASE, PYRAMID_TRIANGLES, QUADRATIC_TET_EDGES, TET_FACES};

/// Tets per parallel work item.
const CHUNK: usize = 1 << 14;

/// The mesh in world coordinates with the caller's labels and its boundary; `neighbors` of the tets where they are known and there
/// is nothing but tets.
///
/// # Errors
/// [`Error::CapacityExceeded`], [`Error::Internal`] for a mesh that does not conform; [`Error::Cancelled`],
/// [`Error::LimitReached`].
pub fn to_world(
    mesh: &CandidateMesh,
    neighbors: Option<Vec<[u32; 4]>>,
    grid: &Grid,
    values: &[i32],
    context: &RunContext,
) -> Result<MixedMesh> {
    let mut result = MixedMesh {
        points: mesh.points.par_iter().map(|p| grid.local_to_world(*p)).collect(),
        space: Space::Lps,
        ..MixedMesh::default()
    };
    let mirrored = !grid.is_right_handed();
    let entries = 4 * mesh.tets.len() + 5 * mesh.pyramids.len() + 8 * mesh.hexahedra.len();
    result.connectivity.reserve_exact(entries);
    let offset_of_tet = |t: usize| 4 * t as i64;
    result.offsets = (0..=mesh.tets.len()).into_par_iter().map(offset_of_tet).collect();
    result.types = vec![ElementKind::Tet.vtk_type(); mesh.tets.len()];
    for (kind, count) in [(ElementKind::Pyramid, mesh.pyramids.len()), (ElementKind::Hexahedron, mesh.hexahedra.len())]
    {
        result.types.resize(result.types.len() + count, kind.vtk_type());
        for _ in 0..count {
            let last = result.offsets[result.offsets.len() - 1];
            result.offsets.push(last + kind.node_count() as i64);
        }
    }
    let order = |order: &[usize], row: &[VertexId], out: &mut Vec<VertexId>| out.extend(order.iter().map(|i| row[*i]));
    let (pyramid, hex): (&[usize], &[usize]) = match mirrored {
        false => (&[0, 1, 2, 3, 4], &[0, 1, 2, 3, 4, 5, 6, 7]),
        true => (&[0, 3, 2, 1, 4], &[0, 3, 2, 1, 4, 7, 6, 5]),
    };
    result.connectivity.extend_from_slice(mesh.tets.as_flattened());
    let mut neighbors = neighbors;
    if mirrored {
        result.connectivity.par_chunks_exact_mut(4).for_each(|tet| tet.swap(2, 3));
        neighbors.iter_mut().for_each(|rows| rows.par_iter_mut().for_each(|row| row.swap(2, 3)));
    }
    mesh.pyramids.iter().for_each(|p| order(pyramid, p, &mut result.connectivity));
    mesh.hexahedra.iter().for_each(|h| order(hex, h, &mut result.connectivity));
    let labels = mesh.tet_labels.iter().chain(&mesh.pyramid_labels).chain(&mesh.hexahedron_labels);
    result.labels = labels.map(|l| values[l.index()]).collect();
    result.boundary = match neighbors {
        Some(neighbors) => boundary_of_tets(&result, &neighbors)?,
        None => boundary_of(&result, context)?,
    };
    Ok(result)
}

/// The labelled faces of a mesh of linear tets, pyramids and hexahedra.
///
/// # Errors
/// [`Error::Internal`] for a mesh that does not conform; [`Error::Cancelled`], [`Error::LimitReached`].
pub fn boundary_of(mesh: &MixedMesh, context: &RunContext) -> Result<BoundaryFaces> {
    if !mesh.is_all_tets() {
        return boundary_of_mixed(mesh, context);
    }
    let tets = bytemuck::cast_slice(mesh.tets()?);
    boundary_of_tets(mesh, &neighbors_of(tets, mesh.points.len(), context)?)
}

fn boundary_of_tets(mesh: &MixedMesh, neighbors: &[[u32; 4]]) -> Result<BoundaryFaces> {
    let tets: &[[u32; 4]] = bytemuck::cast_slice(mesh.tets()?);
    let part = |(chunk, rows): (usize, &[[u32; 4]])| {
        let mut boundary = BoundaryFaces::default();
        for (t, near) in rows.iter().enumerate().map(|(at, near)| (chunk * CHUNK + at, near)) {
            for (f, other) in near.iter().enumerate() {
                let outer = (*other != OUTSIDE).then_some(*other as usize);
                if is_listed_from(mesh, t, outer) {
                    boundary.triangles.push(TET_FACES[f].map(|v| VertexId(tets[t][v])));
                    push_sides(mesh, &mut boundary, t, outer);
                }
            }
        }
        boundary
    };
    let parts: Vec<BoundaryFaces> = neighbors.par_chunks(CHUNK).enumerate().map(part).collect();
    let mut boundary = BoundaryFaces::default();
    for part in parts {
        boundary.triangles.extend(part.triangles);
        boundary.labels.extend(part.labels);
        boundary.elements.extend(part.elements);
    }
    Ok(boundary)
}

/// Whether a face is on the boundary and listed from this side.
fn is_listed_from(mesh: &MixedMesh, inner: usize, outer: Option<usize>) -> bool {
    outer.is_none_or(|outer| mesh.labels[inner] < mesh.labels[outer])
}

fn push_sides(mesh: &MixedMesh, boundary: &mut BoundaryFaces, inner: usize, outer: Option<usize>) {
    boundary.labels.push([mesh.labels[inner], outer.map_or(0, |o| mesh.labels[o])]);
    boundary.elements.push([inner as i64, outer.map_or(-1, |o| o as i64)]);
}

/// Vertices of the faces of an element, outward; triangles have three.
pub(super) fn faces_of(kind: ElementKind, nodes: &[VertexId]) -> Vec<Vec<VertexId>> {
    let pick = |face: &[usize]| face.iter().map(|v| nodes[*v]).collect();
    match kind {
        ElementKind::Tet => TET_FACES.iter().map(|f| pick(f)).collect(),
        ElementKind::Pyramid => {
            PYRAMID_TRIANGLES.iter().map(|f| pick(f)).chain(std::iter::once(pick(&PYRAMID_BASE))).collect()
        }
        _ => HEX_FACES.iter().map(|f| pick(f)).collect(),
    }
}

fn boundary_of_mixed(mesh: &MixedMesh, context: &RunContext) -> Result<BoundaryFaces> {
    // Key: sorted vertices, a triangle has u32::MAX last. Value: the two sides.
    let mut sides: Vec<([u32; 4], u32, u8)> = Vec::new();
    for e in 0..mesh.element_count() {
        context.check_every(CHUNK, e)?;
        let (kind, nodes) = mesh.element(e);
        for (f, face) in faces_of(kind, nodes).iter().enumerate() {
            let mut key = [u32::MAX; 4];
            key.iter_mut().zip(face).for_each(|(k, v)| *k = v.0);
            key.sort_unstable();
            sides.push((key, e as u32, f as u8));
        }
    }
    sides.par_sort_unstable();
    context.check()?;
    let mut listed: Vec<(u32, u8, Option<usize>)> = Vec::new();
    for face in sides.chunk_by(|a, b| a.0 == b.0) {
        match face {
            [one] => listed.push((one.1, one.2, None)),
            [a, b] => {
                for (own, other) in [(a, b), (b, a)] {
                    if is_listed_from(mesh, own.1 as usize, Some(other.1 as usize)) {
                        listed.push((own.1, own.2, Some(other.1 as usize)));
                    }
                }
            }
            _ => {
                return Err(Error::Internal { reason: format!("element {} shares a face with two others", face[0].1) });
            }
        }
    }
    listed.sort_unstable();
    let mut boundary = BoundaryFaces::default();
    for triangles in [true, false] {
        context.check()?;
        for (e, f, outer) in &listed {
            let (kind, nodes) = mesh.element(*e as usize);
            let face = &faces_of(kind, nodes)[usize::from(*f)];
            match (triangles, face.as_slice()) {
                (true, [a, b, c]) => boundary.triangles.push([*a, *b, *c]),
                (false, [a, b, c, d]) => boundary.quads.push([*a, *b, *c, *d]),
                _ => continue,
            }
            push_sides(mesh, &mut boundary, *e as usize, *outer);
        }
    }
    Ok(boundary)
}

/// The boundary of a mesh as a mesh without elements: its points and its labelled faces.
///
/// # Errors
/// As [`MixedMesh::check_shape`].
pub fn surface_of(mesh: &MixedMesh) -> Result<MixedMesh> {
    let mut surface = MixedMesh { offsets: vec![0], space: mesh.space, ..MixedMesh::default() };
    let mut renumbered = vec![u32::MAX; mesh.points.len()];
    let mut number = |v: VertexId| {
        if renumbered[v.index()] == u32::MAX {
            renumbered[v.index()] = surface.points.len() as u32;
            surface.points.push(mesh.points[v.index()]);
        }
        VertexId(renumbered[v.index()])
    };
    let triangles = mesh.boundary.triangles.iter().map(|t| t.map(&mut number)).collect();
    let quads = mesh.boundary.quads.iter().map(|q| q.map(&mut number)).collect();
    let labels = mesh.boundary.labels.clone();
    let elements = vec![[-1, -1]; labels.len()];
    surface.boundary = BoundaryFaces { triangles, quads, labels, elements, patches: Vec::new() };
    surface.check_shape()?;
    Ok(surface)
}

/// Turns 4-node tets into 10-node tets with straight edges; the boundary keeps its corner triangles.
///
/// # Errors
/// [`Error::State`] for a mesh of other elements, [`Error::CapacityExceeded`].
pub fn make_quadratic(mesh: &mut MixedMesh) -> Result<()> {
    let tets = mesh.tets()?.to_vec();
    let mut middles: FxHashMap<(u32, u32), VertexId> = FxHashMap::default();
    let mut connectivity = Vec::with_capacity(10 * tets.len());
    for tet in &tets {
        connectivity.extend_from_slice(tet);
        for [a, b] in QUADRATIC_TET_EDGES {
            let (a, b) = (tet[a].0.min(tet[b].0), tet[a].0.max(tet[b].0));
            let next = VertexId::try_new(mesh.points.len())?;
            let node = *middles.entry((a, b)).or_insert(next);
            if node == next {
                mesh.points.push(0.5 * (mesh.points[a as usize] + mesh.points[b as usize]));
            }
            connectivity.push(node);
        }
    }
    mesh.types.fill(ElementKind::QuadraticTet.vtk_type());
    mesh.offsets = (0..=tets.len() as i64).map(|i| 10 * i).collect();
    mesh.connectivity = connectivity;
    Ok(())
}
