//! Surfaces on their way out: a given surface, or the boundary of a mesh, whole or per label or pair of labels.
//!
//! # Method
//! Boundary faces of a mesh become triangles (quadrilaterals are cut in two) on only those points they use. Each pair
//! of labels, or each patch where the mesh has patches, is one patch of the result.

use rustc_hash::FxHashMap;

use crate::error::{Error, Result};
use crate::index::VertexId;
use crate::mesh::mixed_mesh::{ArrayData, MixedMesh, NamedArray, Space};
use crate::mesh::surface_mesh::{Patch, PatchRole, SurfaceMesh};

/// Which faces of a mesh's boundary.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SurfaceSelection {
    /// All of them.
    All,
    /// The closed surface of one label, outward.
    Label(i32),
    /// The interface of two labels, outward from the first; 0 is the outside.
    Pair(i32, i32),
}

/// A surface with what its file says beside it.
#[derive(Debug, Clone)]
pub struct SurfaceExport {
    /// Points and triangles.
    pub surface: SurfaceMesh,
    /// Arrays on triangles.
    pub arrays: Vec<NamedArray>,
    /// Frame of the points.
    pub space: Space,
}

/// A boundary triangle with the labels on both sides, outward from the first.
struct Side {
    triangle: [VertexId; 3],
    labels: [i32; 2],
    patch: i32,
}

impl SurfaceExport {
    /// A surface of no anatomical frame.
    pub fn of_surface(surface: &SurfaceMesh, space: Space) -> Self {
        Self { surface: surface.clone(), arrays: Vec::new(), space }
    }

    /// The selected boundary faces of a mesh.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] where the mesh has no such face.
    pub fn of_mesh(mesh: &MixedMesh, selection: SurfaceSelection) -> Result<Self> {
        let sides = selected_sides(mesh, selection);
        if sides.is_empty() {
            return Err(Error::argument("surface", format!("the mesh has no boundary face for {selection:?}")));
        }
        let mut surface = SurfaceMesh::default();
        let mut numbers: Vec<VertexId> = vec![VertexId::NONE; mesh.points.len()];
        for side in &sides {
            let triangle = side.triangle.map(|v| {
                if numbers[v.index()] == VertexId::NONE {
                    numbers[v.index()] = VertexId::from_index(surface.points.len());
                    surface.points.push(mesh.points[v.index()]);
                }
                numbers[v.index()]
            });
            surface.facets.push(triangle);
        }
        assign_patches(&sides, mesh.boundary.patches.is_empty(), &mut surface);
        let array = |name: &str, values: Vec<i32>| NamedArray {
            name: name.into(),
            components: 1,
            data: ArrayData::Int(values),
        };
        let arrays = vec![
            array("label", sides.iter().map(|s| s.labels[0]).collect()),
            array("outer_label", sides.iter().map(|s| s.labels[1]).collect()),
        ];
        Ok(Self { surface, arrays, space: mesh.space })
    }
}

/// The pairs of labels that the boundary separates, sorted.
pub fn label_pairs(mesh: &MixedMesh) -> Vec<[i32; 2]> {
    let mut pairs = mesh.boundary.labels.clone();
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

fn selected_sides(mesh: &MixedMesh, selection: SurfaceSelection) -> Vec<Side> {
    let boundary = &mesh.boundary;
    let triangles = boundary.triangles.len();
    let mut sides = Vec::new();
    let mut add = |face: usize, corners: &[VertexId]| {
        let labels = boundary.labels[face];
        let turned = match selection {
            SurfaceSelection::All => false,
            SurfaceSelection::Label(label) if labels[0] == label => false,
            SurfaceSelection::Label(label) if labels[1] == label => true,
            SurfaceSelection::Pair(inner, outer) if labels == [inner, outer] => false,
            SurfaceSelection::Pair(inner, outer) if labels == [outer, inner] => true,
            _ => return,
        };
        let patch = boundary.patches.get(face).copied().unwrap_or(0);
        for k in 2..corners.len() {
            let [a, b, c] = [corners[0], corners[k - 1], corners[k]];
            let (triangle, labels) = if turned { ([a, c, b], [labels[1], labels[0]]) } else { ([a, b, c], labels) };
            sides.push(Side { triangle, labels, patch });
        }
    };
    boundary.triangles.iter().enumerate().for_each(|(i, t)| add(i, t));
    boundary.quads.iter().enumerate().for_each(|(i, q)| add(triangles + i, q));
    sides
}

fn assign_patches(sides: &[Side], by_pair: bool, surface: &mut SurfaceMesh) {
    if !by_pair {
        surface.facet_patches = sides.iter().map(|s| s.patch).collect();
        return;
    }
    let mut pairs: Vec<[i32; 2]> = sides.iter().map(|s| s.labels).collect();
    pairs.sort_unstable();
    pairs.dedup();
    let numbers: FxHashMap<[i32; 2], i32> = pairs.iter().enumerate().map(|(i, p)| (*p, i as i32 + 1)).collect();
    surface.facet_patches = sides.iter().map(|s| numbers[&s.labels]).collect();
    surface.patches = pairs
        .iter()
        .map(|p| Patch { id: numbers[p], role: PatchRole::Wall, name: format!("surface_{}_{}", p[0], p[1]) })
        .collect();
}
