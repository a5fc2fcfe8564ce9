//! The mesh on its way through the engine: made by the lattice, moved by smoothing, finished at the end.
//!
//! # Method
//! Arrays in the image's local frame (`Grid::local_to_world`), where the voxel grid is axis-aligned; compact labels.
//! Every step after the lattice takes it by mutable reference and keeps its invariants.
//!
//! # Invariants
//! Elements are positively oriented in the local frame and conforming, vertices are all used, no element is
//! background. `fixed` vertices do not move.

use glam::DVec3;

use crate::image::connected_components::Component;
use crate::index::{Label, VertexId};
use crate::lattice::scaffold::Scaffold;

/// Elements of the lattice with their labels, local frame.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CandidateMesh {
    /// Local coordinates, mm. 24 B / vertex.
    pub points: Vec<DVec3>,
    /// `n x 4` vertices, positive orientation. 16 B / tet.
    pub tets: Vec<[VertexId; 4]>,
    /// Label per tet. 2 B / tet.
    pub tet_labels: Vec<Label>,
    /// `n x 5` vertices, VTK order.
    pub pyramids: Vec<[VertexId; 5]>,
    /// Label per pyramid.
    pub pyramid_labels: Vec<Label>,
    /// `n x 8` vertices, VTK order.
    pub hexahedra: Vec<[VertexId; 8]>,
    /// Label per hexahedron.
    pub hexahedron_labels: Vec<Label>,
    /// Cubes of tets that the elastic model takes as hexahedra, and that `mixed_elements` may merge once the vertices have
    /// moved; empty where nobody asks for them.
    pub cubes: Vec<MergeableCube>,
    /// Vertices at the caller's fixed points.
    pub fixed: Vec<VertexId>,
    /// Background elements around the mesh, for smoothing; empty before and after.
    pub scaffold: Scaffold,
    /// Components of the image that have no element.
    pub lost: Vec<Component>,
}

/// A lattice vertex whose 24 tets can become a hexahedron with pyramids.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MergeableCube {
    /// The vertex that vanishes.
    pub center: VertexId,
    /// Corners in VTK's order.
    pub corners: [VertexId; 8],
    /// Vertices across the faces, in the order of `numbering::HEX_FACES`.
    pub apexes: [VertexId; 6],
    /// The most triangles that one of its pyramids would have on a surface.
    pub surface_triangles: u8,
}

/// The new number of a vertex that is gone.
pub const GONE: u32 = u32::MAX;

impl MergeableCube {
    /// Its vertices: the middle, the corners, those across the faces.
    pub fn vertices(&self) -> impl Iterator<Item = VertexId> {
        std::iter::once(self.center).chain(self.corners).chain(self.apexes)
    }
}

impl CandidateMesh {
    /// Follows new numbers in what the mesh says of single vertices; a cube that lost a vertex has lost tets too, and goes.
    pub fn renumber_records(&mut self, new_of: &[u32]) {
        let number = |v: &mut VertexId| *v = VertexId(new_of[v.index()]);
        self.fixed.iter_mut().for_each(number);
        self.cubes.retain(|cube| cube.vertices().all(|v| new_of[v.index()] != GONE));
        for cube in &mut self.cubes {
            number(&mut cube.center);
            cube.corners.iter_mut().for_each(number);
            cube.apexes.iter_mut().for_each(number);
        }
    }

    /// Number of elements of all kinds.
    pub fn element_count(&self) -> usize {
        self.tets.len() + self.pyramids.len() + self.hexahedra.len()
    }

    /// Vertices and labels of all elements: tets, pyramids, hexahedra.
    pub fn elements(&self) -> impl Iterator<Item = (&[VertexId], Label)> {
        let tets = self.tets.iter().zip(&self.tet_labels).map(|(e, l)| (e.as_slice(), *l));
        let pyramids = self.pyramids.iter().zip(&self.pyramid_labels).map(|(e, l)| (e.as_slice(), *l));
        let hexahedra = self.hexahedra.iter().zip(&self.hexahedron_labels).map(|(e, l)| (e.as_slice(), *l));
        tets.chain(pyramids).chain(hexahedra)
    }
}
