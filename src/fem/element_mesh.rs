//! A borrowed view of points, elements and labels: what the finite elements need of a mesh.
//!
//! # Method
//! A finished [`MixedMesh`] gives such a view without a copy; engines that keep tets in rows of four give theirs through
//! [`TetTopology`], which adds the offsets and types.

use glam::DVec3;

use crate::error::{Error, Result};
use crate::index::VertexId;
use crate::mesh::mixed_mesh::{ElementKind, MixedMesh};

/// Points, elements and labels of a model. Frame and unit are the caller's; millimetres in this crate.
#[derive(Debug, Clone, Copy)]
pub struct ElementMesh<'a> {
    /// Nodes.
    pub points: &'a [DVec3],
    /// VTK cell type per element.
    pub types: &'a [u8],
    /// Start of each element in `connectivity`, one more at the end.
    pub offsets: &'a [i64],
    /// Nodes of all elements in VTK's order.
    pub connectivity: &'a [VertexId],
    /// Caller's label per element: picks the material.
    pub labels: &'a [i32],
}

impl<'a> ElementMesh<'a> {
    /// The view of a finished mesh.
    pub fn from_mixed(mesh: &'a MixedMesh) -> Self {
        Self {
            points: &mesh.points,
            types: &mesh.types,
            offsets: &mesh.offsets,
            connectivity: &mesh.connectivity,
            labels: &mesh.labels,
        }
    }

    /// Number of elements.
    pub fn element_count(&self) -> usize {
        self.types.len()
    }

    /// Kind and nodes of an element.
    ///
    /// # Panics
    /// For an unknown type: excluded by [`ElementMesh::check`].
    #[inline]
    pub fn element(&self, index: usize) -> (ElementKind, &'a [VertexId]) {
        let kind = ElementKind::from_vtk_type(self.types[index]).expect("types are checked");
        (kind, &self.connectivity[self.offsets[index] as usize..self.offsets[index + 1] as usize])
    }

    /// Copies the nodes' points of an element into `out`; returns the kind.
    #[inline]
    pub fn element_points(&self, index: usize, out: &mut [DVec3; 20]) -> ElementKind {
        let (kind, nodes) = self.element(index);
        for (slot, node) in out.iter_mut().zip(nodes) {
            *slot = self.points[node.index()];
        }
        kind
    }

    /// Checks lengths, types, ids and finiteness.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] naming the first violation.
    pub fn check(&self) -> Result<()> {
        let n = self.types.len();
        if self.offsets.len() != n + 1 || self.labels.len() != n {
            return Err(Error::argument("elements", format!("{n} types, {} labels", self.labels.len())));
        }
        if self.offsets[n] as usize != self.connectivity.len() || self.offsets[0] != 0 {
            return Err(Error::argument("offsets", "do not span the connectivity"));
        }
        for i in 0..n {
            let nodes = ElementKind::from_vtk_type(self.types[i]).map(|k| k.node_count() as i64);
            if nodes != Some(self.offsets[i + 1] - self.offsets[i]) {
                return Err(Error::argument("types", format!("element {i} has a wrong type or node count")));
            }
        }
        if let Some(node) = self.connectivity.iter().find(|v| v.index() >= self.points.len()) {
            return Err(Error::argument("connectivity", format!("node {} of {}", node.0, self.points.len())));
        }
        if let Some(i) = self.points.iter().position(|p| !p.is_finite()) {
            return Err(Error::argument("points", format!("point {i} is not finite")));
        }
        Ok(())
    }
}

/// Offsets and types for tets kept in rows of four.
#[derive(Debug, Clone)]
pub struct TetTopology {
    types: Vec<u8>,
    offsets: Vec<i64>,
}

impl TetTopology {
    /// For `count` tets.
    pub fn new(count: usize) -> Self {
        Self { types: vec![ElementKind::Tet.vtk_type(); count], offsets: (0..=count as i64).map(|i| 4 * i).collect() }
    }

    /// The view of tets with their points and labels.
    pub fn view<'a>(&'a self, points: &'a [DVec3], tets: &'a [[VertexId; 4]], labels: &'a [i32]) -> ElementMesh<'a> {
        ElementMesh { points, types: &self.types, offsets: &self.offsets, connectivity: tets.as_flattened(), labels }
    }
}
