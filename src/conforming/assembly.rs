//! From the recovered mesh to what the next steps and the host read.
//!
//! # Method
//! 1. [`carve`]: the tets of the regions move to a complex of their own, with labels, constraints on faces and edges,
//!    and no neighbour behind the boundary; Steiner points without tets go.
//! 2. [`finish`]: the finished mesh, with every facet as a boundary triangle that knows its patch, both labels and both
//!    elements.
//!
//! # Invariants
//! The points of the surface keep their numbers through both.

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::conforming::boundary_recovery::constrained_mesh::{ConstrainedMesh, FaceKey, edge_key, face_key};
use crate::conforming::domain_labels::{Domain, Region};
use crate::error::Result;
use crate::index::{Label, TetFace, VertexId};
use crate::mesh::mixed_mesh::{MixedMesh, Space};
use crate::mesh::numbering::{TET_EDGES, TET_FACES};
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;

/// Tets per parallel chunk.
const CHUNK: usize = 4096;

/// The tets of the regions, and the facets under the vertex numbers of the new complex.
pub struct Carved {
    /// Tets of the regions only.
    pub complex: TetComplex,
    /// Faces of the surface that bound or cross the regions, with their facets.
    pub subfaces: FxHashMap<FaceKey, u32>,
    /// Vertices behind those of the surface: Steiner points.
    pub steiner: Vec<VertexId>,
}

/// Moves the tets of the regions to a complex of their own; the first `surface_points` vertices stay.
///
/// # Errors
/// Those of tet creation.
pub fn carve(mesh: &ConstrainedMesh, domain: &Domain, surface_points: usize) -> Result<Carved> {
    let old = &mesh.complex;
    let kept: Vec<_> = old.finite_tets().filter(|t| !domain.region_of[t.index()].is_background()).collect();
    let mut number: Vec<VertexId> = vec![VertexId::NONE; old.vertex_count()];
    let mut points: Vec<DVec3> = old.points()[..surface_points].to_vec();
    (0..surface_points).for_each(|i| number[i] = VertexId::from_index(i));
    let mut steiner = Vec::new();
    let mut used = vec![false; old.vertex_count()];
    kept.iter().flat_map(|&t| old.vertices(t)).for_each(|v| used[v.index()] = true);
    for v in (surface_points..old.vertex_count()).filter(|&v| used[v]) {
        number[v] = VertexId::try_new(points.len())?;
        steiner.push(number[v]);
        points.push(old.points()[v]);
    }
    let renumbered = |v: VertexId| number[v.index()];
    let mut complex = TetComplex::with_points(points)?;
    complex.try_reserve_tets(kept.len())?;
    for &tet in &kept {
        complex.create_tet(old.vertices(tet).map(renumbered), domain.region_of[tet.index()])?;
    }
    complex.pair_faces()?;
    let in_use = |key: &FaceKey| key.iter().all(|v| number[v.index()] != VertexId::NONE);
    let subfaces: FxHashMap<FaceKey, u32> = mesh
        .subfaces
        .iter()
        .filter(|(key, _)| in_use(key))
        .map(|(key, &facet)| (face_key(key.map(renumbered)), facet))
        .collect();
    constrain(&mut complex, &subfaces);
    complex.rebuild_vertex_tets();
    Ok(Carved { complex, subfaces, steiner })
}

/// Marks the faces and edges of the surface.
fn constrain(complex: &mut TetComplex, subfaces: &FxHashMap<FaceKey, u32>) {
    let edges: rustc_hash::FxHashSet<_> =
        subfaces.keys().flat_map(|&[a, b, c]| [edge_key(a, b), edge_key(b, c), edge_key(a, c)]).collect();
    let tets: Vec<_> = complex.finite_tets().collect();
    for tet in tets {
        let v = complex.vertices(tet);
        let mut flags = complex.flags(tet);
        for (face, corners) in TET_FACES.iter().enumerate() {
            flags = flags.with_face(face, subfaces.contains_key(&face_key(corners.map(|i| v[i]))));
        }
        for (edge, [i, j]) in TET_EDGES.iter().enumerate() {
            flags = flags.with_edge(edge, edges.contains(&edge_key(v[*i], v[*j])));
        }
        complex.set_flags(tet, flags);
    }
}

/// The finished mesh: tets in slot order, every face of the surface as a boundary triangle in the order of the facets.
/// Runs on the rayon pool it is called in.
///
/// # Errors
/// As [`MixedMesh::from_tets`].
pub fn finish(
    complex: &TetComplex,
    regions: &[Region],
    subfaces: &FxHashMap<FaceKey, u32>,
    facets: &[[VertexId; 3]],
    patches: &[i32],
) -> Result<MixedMesh> {
    let value = |label: Label| if label.is_background() { 0 } else { regions[label.index() - 1].label };
    let tets = complex.finite_tets_where(|_| true);
    let in_parallel = || tets.par_iter().with_min_len(CHUNK);
    let rows: Vec<[VertexId; 4]> = in_parallel().map(|&t| complex.vertices(t)).collect();
    let labels = in_parallel().map(|&t| value(complex.label(t))).collect();
    let mut mesh = MixedMesh::from_tets(complex.points().to_vec(), &rows, labels)?;
    mesh.space = Space::Unspecified;
    let mut element_of = vec![-1_i64; complex.slot_count()];
    tets.iter().enumerate().for_each(|(i, t)| element_of[t.index()] = i as i64);
    // Facet, triangle outward from its first tet, that tet's side.
    let mut faces: Vec<(u32, [VertexId; 3], TetFace)> = Vec::new();
    for tet in complex.finite_tets_where(|tet| complex.flags(tet).has_constrained_face()) {
        for side in (0..4).map(|face| TetFace::new(tet, face)).filter(|&side| complex.is_face_constrained(side)) {
            let triangle = complex.face_vertices(side);
            let Some(&facet) = subfaces.get(&face_key(triangle)) else { continue };
            let other = complex.neighbor(side);
            if other == TetFace::NONE || turned_as(triangle, facets[facet as usize]) {
                faces.push((facet, triangle, side));
            }
        }
    }
    faces.sort_unstable();
    for (facet, triangle, side) in faces {
        let other = complex.neighbor(side);
        let (label, element) = match other {
            TetFace::NONE => (0, -1),
            _ => (value(complex.label(other.tet())), element_of[other.tet().index()]),
        };
        mesh.boundary.triangles.push(triangle);
        mesh.boundary.labels.push([value(complex.label(side.tet())), label]);
        mesh.boundary.elements.push([element_of[side.tet().index()], element]);
        mesh.boundary.patches.push(patches[facet as usize]);
    }
    Ok(mesh)
}

/// Whether a triangle turns like the facet, as far as it shares vertices with it; of a part with fewer than two shared
/// vertices the one with ascending vertices is taken.
fn turned_as(triangle: [VertexId; 3], facet: [VertexId; 3]) -> bool {
    let [a, b, c] = triangle;
    let [x, y, z] = facet;
    if face_key(triangle) == face_key(facet) {
        return [[x, y, z], [y, z, x], [z, x, y]].contains(&triangle);
    }
    // A part of a facet (Steiner points kept on the surface): any fixed choice of one of its two sides will do.
    let smallest = a.min(b).min(c);
    let turned = if a == smallest {
        [a, b, c]
    } else if b == smallest {
        [b, c, a]
    } else {
        [c, a, b]
    };
    turned[1] < turned[2]
}
