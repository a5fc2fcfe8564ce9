//! The finished mesh: what every engine returns and every writer and host reads.
//!
//! # Method
//! Structure of arrays in VTK's layout, so that hosts read it without a copy: points, element types, offsets into one
//! connectivity array, one caller's label per element, and the labelled boundary surface.
//!
//! # Invariants
//! [`MixedMesh::check_shape`]: offsets match types, ids are in range, arrays have the right lengths. Geometric validity
//! is `mesh::validation`'s.

use glam::DVec3;

use crate::error::{Error, Result};
use crate::index::VertexId;

/// Kinds of volume elements, with VTK's numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u8)]
pub enum ElementKind {
    /// 4 vertices.
    Tet = 10,
    /// 8 vertices.
    Hexahedron = 12,
    /// 6 vertices.
    Wedge = 13,
    /// 5 vertices.
    Pyramid = 14,
    /// 10 nodes.
    QuadraticTet = 24,
    /// 20 nodes.
    QuadraticHexahedron = 25,
}

impl ElementKind {
    /// VTK's cell type.
    pub fn vtk_type(self) -> u8 {
        self as u8
    }

    /// The kind of a VTK cell type.
    pub fn from_vtk_type(vtk_type: u8) -> Option<Self> {
        [Self::Tet, Self::Hexahedron, Self::Wedge, Self::Pyramid, Self::QuadraticTet, Self::QuadraticHexahedron]
            .into_iter()
            .find(|kind| kind.vtk_type() == vtk_type)
    }

    /// Nodes of one element.
    pub fn node_count(self) -> usize {
        match self {
            Self::Tet => 4,
            Self::Pyramid => 5,
            Self::Wedge => 6,
            Self::Hexahedron => 8,
            Self::QuadraticTet => 10,
            Self::QuadraticHexahedron => 20,
        }
    }

    /// Corner vertices of one element; the nodes after them are mid-edge nodes.
    pub fn corner_count(self) -> usize {
        match self {
            Self::QuadraticTet => 4,
            Self::QuadraticHexahedron => 8,
            other => other.node_count(),
        }
    }
}

/// Labelled triangles (and quadrilaterals) between labels and around the domain.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct BoundaryFaces {
    /// `n x 3` vertices, outward from `labels[i][0]`. 12 B / face.
    pub triangles: Vec<[VertexId; 3]>,
    /// Quadrilaterals of mixed meshes, `m x 4`, outward from their first label.
    pub quads: Vec<[VertexId; 4]>,
    /// Caller's labels on both sides (inner, outer; 0 = outside) for the triangles, then the quads.
    pub labels: Vec<[i32; 2]>,
    /// Elements on both sides (inner, outer; -1 = none), as `labels`.
    pub elements: Vec<[i64; 2]>,
    /// Patch id of the input surface (surface engine), as `labels`; empty where there is none.
    pub patches: Vec<i32>,
}

/// A named array on points or elements.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedArray {
    /// Name in files and in C.
    pub name: String,
    /// Values per point or element.
    pub components: usize,
    /// Values, row-major.
    pub data: ArrayData,
}

/// Values of a [`NamedArray`].
#[derive(Debug, Clone, PartialEq)]
pub enum ArrayData {
    /// Whole numbers.
    Int(Vec<i32>),
    /// Large whole numbers.
    Long(Vec<i64>),
    /// Reals.
    Real(Vec<f64>),
}

impl ArrayData {
    /// Number of values.
    pub fn len(&self) -> usize {
        match self {
            Self::Int(v) => v.len(),
            Self::Long(v) => v.len(),
            Self::Real(v) => v.len(),
        }
    }

    /// Whether there is no value.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// The world frame of a mesh's coordinates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Space {
    /// Left, posterior, superior: DICOM and ITK. The default for images.
    #[default]
    Lps,
    /// Right, anterior, superior: NIfTI and Slicer's scene.
    Ras,
    /// No anatomical frame: surfaces of parts and aircraft.
    Unspecified,
}

/// A finished mesh.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MixedMesh {
    /// World coordinates, mm. 24 B / point.
    pub points: Vec<DVec3>,
    /// VTK cell type of each element. 1 B / element.
    pub types: Vec<u8>,
    /// Start of each element in `connectivity`, one more at the end. 8 B / element.
    pub offsets: Vec<i64>,
    /// Vertices of all elements, VTK node order. 4 B / entry.
    pub connectivity: Vec<VertexId>,
    /// Caller's label of each element. 4 B / element.
    pub labels: Vec<i32>,
    /// The surface, filled by the engine.
    pub boundary: BoundaryFaces,
    /// Arrays on points.
    pub point_data: Vec<NamedArray>,
    /// Arrays on elements.
    pub element_data: Vec<NamedArray>,
    /// Frame of `points`.
    pub space: Space,
}

impl MixedMesh {
    /// A mesh of tets only.
    ///
    /// # Errors
    /// As [`MixedMesh::check_shape`].
    pub fn from_tets(points: Vec<DVec3>, tets: &[[VertexId; 4]], labels: Vec<i32>) -> Result<Self> {
        let mesh = Self {
            points,
            types: vec![ElementKind::Tet.vtk_type(); tets.len()],
            offsets: (0..=tets.len() as i64).map(|i| 4 * i).collect(),
            connectivity: tets.as_flattened().to_vec(),
            labels,
            ..Self::default()
        };
        mesh.check_shape()?;
        Ok(mesh)
    }

    /// Number of elements.
    pub fn element_count(&self) -> usize {
        self.types.len()
    }

    /// Whether every element is a 4-node tet.
    pub fn is_all_tets(&self) -> bool {
        self.types.iter().all(|&t| t == ElementKind::Tet.vtk_type())
    }

    /// Kind and vertices of an element.
    ///
    /// # Panics
    /// For an unknown type: excluded by [`MixedMesh::check_shape`].
    #[inline]
    pub fn element(&self, index: usize) -> (ElementKind, &[VertexId]) {
        let kind = ElementKind::from_vtk_type(self.types[index]).expect("types are checked by check_shape");
        let (begin, end) = (self.offsets[index] as usize, self.offsets[index + 1] as usize);
        (kind, &self.connectivity[begin..end])
    }

    /// The vertices of all elements in rows of four.
    ///
    /// # Errors
    /// [`Error::State`] for a mesh that is not all tets.
    pub fn tets(&self) -> Result<&[[VertexId; 4]]> {
        if !self.is_all_tets() {
            return Err(Error::State { reason: "the mesh has elements other than 4-node tets".into() });
        }
        Ok(self.connectivity.as_chunks::<4>().0)
    }

    /// Checks lengths, types, offsets and ids.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] naming the first violation; [`Error::CapacityExceeded`] past 2^31 - 1 points.
    pub fn check_shape(&self) -> Result<()> {
        let refuse = |name: &str, reason: String| Err(Error::argument(name, reason));
        let n = self.types.len();
        if self.points.len() > i32::MAX as usize {
            let needed = self.points.len() as u64;
            return Err(Error::CapacityExceeded { what: "points", needed, limit: i32::MAX as u64 });
        }
        if self.offsets.len() != n + 1 || self.offsets[0] != 0 || self.labels.len() != n {
            return refuse(
                "offsets",
                format!("{} offsets, {} labels, {n} types", self.offsets.len(), self.labels.len()),
            );
        }
        for i in 0..n {
            let Some(kind) = ElementKind::from_vtk_type(self.types[i]) else {
                return refuse("types", format!("element {i} has unknown type {}", self.types[i]));
            };
            if self.offsets[i + 1] - self.offsets[i] != kind.node_count() as i64 {
                return refuse("offsets", format!("element {i} has not {} nodes", kind.node_count()));
            }
        }
        if self.offsets[n] != self.connectivity.len() as i64 {
            return refuse(
                "connectivity",
                format!("{} entries, offsets say {}", self.connectivity.len(), self.offsets[n]),
            );
        }
        if let Some(i) = self.connectivity.iter().position(|v| v.index() >= self.points.len()) {
            return refuse(
                "connectivity",
                format!("entry {i} is {} of {} points", self.connectivity[i].0, self.points.len()),
            );
        }
        Ok(())
    }
}
