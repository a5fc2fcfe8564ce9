//! What a mesh file holds, before it becomes a mesh or a surface.
//!
//! # Method
//! Readers fill one neutral record: points, cells with VTK's numbers and node order, one tag per cell. Two conversions
//! follow: to a [`MixedMesh`] (volume cells become elements, faces its boundary) and to a [`SurfaceMesh`] (triangles as
//! they are, polygons cut up).
//!
//! # Invariants
//! `offsets` has one entry more than `types`; `tags` has one per cell. Indices are not checked until a conversion.

use glam::DVec3;

use crate::error::{Error, Finding, FindingCode, Result, Severity};
use crate::index::VertexId;
use crate::mesh::mixed_mesh::{BoundaryFaces, ElementKind, MixedMesh, NamedArray, Space};
use crate::mesh::surface_mesh::{Patch, RegionSeed, SurfaceMesh};

/// VTK's numbers of the cells that are no volume elements.
pub mod cell {
    /// Two points.
    pub const LINE: u8 = 3;
    /// Three points.
    pub const TRIANGLE: u8 = 5;
    /// Triangles in a row, each sharing an edge with the last.
    pub const TRIANGLE_STRIP: u8 = 6;
    /// Any number of points.
    pub const POLYGON: u8 = 7;
    /// Four points, axis order.
    pub const PIXEL: u8 = 8;
    /// Four points.
    pub const QUAD: u8 = 9;
    /// Eight points, axis order.
    pub const VOXEL: u8 = 11;
    /// Six nodes.
    pub const QUADRATIC_TRIANGLE: u8 = 22;
}

/// The content of a mesh file.
#[derive(Debug, Default)]
pub struct FileMesh {
    /// Coordinates as in the file.
    pub points: Vec<DVec3>,
    /// VTK cell types.
    pub types: Vec<u8>,
    /// Start of each cell in `connectivity`, one more at the end.
    pub offsets: Vec<i64>,
    /// Point numbers from 0, unchecked.
    pub connectivity: Vec<i64>,
    /// Label or patch per cell.
    pub tags: Vec<i32>,
    /// Names and roles of tags.
    pub patches: Vec<Patch>,
    /// Regions.
    pub regions: Vec<RegionSeed>,
    /// Holes.
    pub holes: Vec<DVec3>,
    /// Arrays on points.
    pub point_data: Vec<NamedArray>,
    /// Arrays on cells.
    pub cell_data: Vec<NamedArray>,
    /// Frame of the points.
    pub space: Space,
}

impl FileMesh {
    /// Nothing yet.
    pub fn new() -> Self {
        Self { offsets: vec![0], space: Space::Unspecified, ..Self::default() }
    }

    /// Adds a cell.
    pub fn push(&mut self, kind: u8, nodes: impl IntoIterator<Item = i64>, tag: i32) {
        self.connectivity.extend(nodes);
        self.types.push(kind);
        self.offsets.push(self.connectivity.len() as i64);
        self.tags.push(tag);
    }

    /// Whether a cell is a volume element.
    pub fn has_volume(&self) -> bool {
        self.types.iter().any(|&t| t == cell::VOXEL || ElementKind::from_vtk_type(t).is_some())
    }

    /// The frame of a `SPACE=` tag.
    pub fn space_of_name(name: &str) -> Space {
        match name.trim().to_uppercase().as_str() {
            "RAS" => Space::Ras,
            "LPS" => Space::Lps,
            _ => Space::Unspecified,
        }
    }

    /// Takes the tags from the first cell array that holds labels.
    pub fn adopt_tags(&mut self) {
        use crate::mesh::mixed_mesh::ArrayData;
        const NAMES: [&str; 12] = [
            "label",
            "labels",
            "medit:ref",
            "gmsh:physical",
            "patch",
            "CellEntityIds",
            "material",
            "cell_label",
            "region",
            "domain",
            "subdomain",
            "ModelFaceID",
        ];
        let found = NAMES.iter().find_map(|name| {
            self.cell_data.iter().position(|a| a.name.eq_ignore_ascii_case(name) && a.components == 1)
        });
        let Some(position) = found else { return };
        if self.cell_data[position].data.len() != self.types.len() {
            return;
        }
        self.tags = match &self.cell_data[position].data {
            ArrayData::Int(values) => values.clone(),
            ArrayData::Long(values) => values.iter().map(|&v| v as i32).collect(),
            ArrayData::Real(values) => values.iter().map(|&v| v as i32).collect(),
        };
        self.cell_data.retain(|a| !NAMES.iter().any(|name| a.name.eq_ignore_ascii_case(name)));
    }

    /// The surface: every triangle, polygons cut into triangles without new points; volume cells are passed over.
    ///
    /// # Errors
    /// [`Error::InvalidInput`] with a finding for each vertex that is no point; a file without any face.
    pub fn into_surface(mut self) -> Result<SurfaceMesh> {
        let mut facets = Vec::with_capacity(self.types.len());
        let mut facet_patches = Vec::with_capacity(self.types.len());
        let mut findings = Vec::new();
        for i in 0..self.types.len() {
            let nodes = &self.connectivity[self.offsets[i] as usize..self.offsets[i + 1] as usize];
            let valid = |n: &i64| (0..self.points.len() as i64).contains(n);
            if let Some(bad) = nodes.iter().find(|n| !valid(n)) {
                let text =
                    format!("face {i} uses point {bad}, the file has points 0 to {}", self.points.len() as i64 - 1);
                findings
                    .push(Finding::new(FindingCode::IndexOutOfRange, Severity::Error, text).with_ids(i as i64, *bad));
                continue;
            }
            let before = facets.len();
            cut_into_triangles(self.types[i], nodes, &self.points, &mut facets);
            facet_patches.resize(facet_patches.len() + facets.len() - before, self.tags[i]);
        }
        if !findings.is_empty() {
            let message = format!("{}; {} such faces", findings[0].text, findings.len());
            return Err(Error::InvalidInput { message, findings });
        }
        if facets.is_empty() {
            return Err(Error::input(format!("the file has {} points and no triangle", self.points.len())));
        }
        Ok(SurfaceMesh {
            points: std::mem::take(&mut self.points),
            facets,
            facet_patches,
            patches: std::mem::take(&mut self.patches),
            regions: std::mem::take(&mut self.regions),
            holes: std::mem::take(&mut self.holes),
        })
    }

    /// The mesh: volume cells as elements, triangles and quadrilaterals as its boundary with their tags as patches.
    ///
    /// # Errors
    /// [`Error::InvalidInput`] for an index out of range; [`Error::Unsupported`] for an unknown cell type.
    pub fn into_mixed_mesh(mut self) -> Result<MixedMesh> {
        let points = self.points.len() as i64;
        if let Some(at) = self.connectivity.iter().position(|n| !(0..points).contains(n)) {
            let text = format!("entry {at} of the cells is point {} of {points}", self.connectivity[at]);
            return Err(Error::input(text));
        }
        let mut mesh = MixedMesh { offsets: vec![0], space: self.space, ..MixedMesh::default() };
        let mut kept = Vec::new();
        let mut quads = (Vec::new(), Vec::new());
        for i in 0..self.types.len() {
            let nodes = &self.connectivity[self.offsets[i] as usize..self.offsets[i + 1] as usize];
            let ids = nodes.iter().map(|&n| VertexId(n as u32));
            if let Some(kind) = ElementKind::from_vtk_type(self.types[i]) {
                if nodes.len() != kind.node_count() {
                    return Err(Error::input(format!(
                        "cell {i} has {} nodes, its kind {}",
                        nodes.len(),
                        kind.node_count()
                    )));
                }
                mesh.connectivity.extend(ids);
            } else if self.types[i] == cell::VOXEL && nodes.len() == 8 {
                // Axis order becomes cyclic order.
                mesh.connectivity.extend([0, 1, 3, 2, 4, 5, 7, 6].map(|n| VertexId(nodes[n] as u32)));
            } else {
                push_face(self.types[i], nodes, self.tags[i], &mut mesh.boundary, &mut quads);
                continue;
            }
            mesh.types.push(if self.types[i] == cell::VOXEL { 12 } else { self.types[i] });
            mesh.offsets.push(mesh.connectivity.len() as i64);
            mesh.labels.push(self.tags[i]);
            kept.push(i);
        }
        mesh.boundary.quads = quads.0;
        mesh.boundary.patches.extend(quads.1);
        let faces = mesh.boundary.patches.len();
        mesh.boundary.labels = vec![[0, 0]; faces];
        mesh.boundary.elements = vec![[-1, -1]; faces];
        mesh.points = std::mem::take(&mut self.points);
        mesh.point_data = std::mem::take(&mut self.point_data);
        mesh.element_data = self.cell_data.iter().map(|array| select(array, &kept)).collect();
        mesh.check_shape()?;
        Ok(mesh)
    }
}

fn push_face(
    kind: u8,
    nodes: &[i64],
    tag: i32,
    boundary: &mut BoundaryFaces,
    quads: &mut (Vec<[VertexId; 4]>, Vec<i32>),
) {
    let id = |n: usize| VertexId(nodes[n] as u32);
    match (kind, nodes.len()) {
        (cell::TRIANGLE, 3) | (cell::QUADRATIC_TRIANGLE, 6) => {
            boundary.triangles.push([id(0), id(1), id(2)]);
            boundary.patches.push(tag);
        }
        (cell::QUAD, 4) => {
            quads.0.push([id(0), id(1), id(2), id(3)]);
            quads.1.push(tag);
        }
        _ => {}
    }
}

/// The rows of `array` of the cells that were kept.
fn select(array: &NamedArray, kept: &[usize]) -> NamedArray {
    use crate::mesh::mixed_mesh::ArrayData;
    fn rows<T: Copy>(values: &[T], kept: &[usize], width: usize) -> Vec<T> {
        kept.iter().flat_map(|&i| values[i * width..(i + 1) * width].iter().copied()).collect()
    }
    let width = array.components;
    let data = match &array.data {
        ArrayData::Int(values) => ArrayData::Int(rows(values, kept, width)),
        ArrayData::Long(values) => ArrayData::Long(rows(values, kept, width)),
        ArrayData::Real(values) => ArrayData::Real(rows(values, kept, width)),
    };
    NamedArray { name: array.name.clone(), components: width, data }
}

/// Adds the triangles of a face; indices are in range.
fn cut_into_triangles(kind: u8, nodes: &[i64], points: &[DVec3], facets: &mut Vec<[VertexId; 3]>) {
    let id = |n: i64| VertexId(n as u32);
    match kind {
        cell::TRIANGLE | cell::QUADRATIC_TRIANGLE if nodes.len() >= 3 => {
            facets.push([id(nodes[0]), id(nodes[1]), id(nodes[2])]);
        }
        cell::TRIANGLE_STRIP => {
            for (n, w) in nodes.windows(3).enumerate() {
                let [a, b] = if n % 2 == 0 { [w[0], w[1]] } else { [w[1], w[0]] };
                facets.push([id(a), id(b), id(w[2])]);
            }
        }
        cell::PIXEL if nodes.len() == 4 => {
            let cyclic = [nodes[0], nodes[1], nodes[3], nodes[2]];
            super::polygon::triangulate(&cyclic, points, facets);
        }
        cell::QUAD | cell::POLYGON => super::polygon::triangulate(nodes, points, facets),
        _ => {}
    }
}
