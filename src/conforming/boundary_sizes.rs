//! The size field of the boundary: linear over the mesh of the boundary's vertices alone.
//!
//! # Method
//! The mesh as it is before refinement is kept with its sizes. A new point is looked up in it by a walk from the tet where
//! the nearest corner of its tet was found.
//!
//! # Source
//! [Drakopoulos2017] 4.7.1 (distribution function, interpolated at new points).
//!
//! # Differences
//! The thesis interpolates in the mesh that is being refined. Where sizes change fast, on parts with fine holes beside
//! coarse walls, the first points stand far from the fine side with sizes between, and what is interpolated from them
//! later is several times what the boundary asks for: points ahead of the fine side are refused then. Where sizes change
//! slowly, both agree, and the mesh that is refined is smoother: so this field only bounds the other.
//!
//! # Cost
//! The tets of the boundary's mesh once more, 4 B a vertex; a walk of a few tets a candidate.

use glam::DVec3;

use super::point_filter::{Walk, interpolated_size, walk};
use crate::index::{TetId, VertexId};
use crate::mesh::renumbering::Renumbering;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;

/// The boundary's mesh, its sizes, and where the vertices of the refined mesh lie in it.
pub struct BoundarySizes {
    mesh: TetComplex,
    sizes: Vec<f64>,
    /// Per vertex of the refined mesh a tet of `mesh` at it; `NONE` where the vertex was not found. 4 B / vertex.
    tets: Vec<TetId>,
}

impl BoundarySizes {
    /// The field of `mesh` as it is now, with a size per vertex.
    pub fn new(mesh: &TetComplex, sizes: &[f64]) -> Self {
        let tets = (0..sizes.len()).map(|v| mesh.tet_of(VertexId::from_index(v))).collect();
        Self { mesh: mesh.clone(), sizes: sizes.to_vec(), tets }
    }

    /// The size at `point`, which lies in `tet` of the refined mesh, and the tet of the boundary's mesh with it; `None`
    /// where no walk leads there.
    pub fn at<S: TetStore + ?Sized>(
        &self,
        refined: &S,
        tet: TetId,
        point: DVec3,
        minimum_weight: f64,
    ) -> Option<(f64, TetId)> {
        let mut corners = refined.vertices(tet);
        let distance = |v: &VertexId| refined.point(*v).distance_squared(point);
        corners.sort_unstable_by(|v, w| distance(v).total_cmp(&distance(w)));
        let starts = corners.iter().map(|v| self.tets[v.index()]).filter(|start| *start != TetId::NONE);
        let found = starts.map(|start| walk(&self.mesh, start, point, true)).find_map(|end| match end {
            Walk::Inside(found) if self.mesh.label(found) == refined.label(tet) => Some(found),
            _ => None,
        })?;
        Some((interpolated_size(&self.mesh, &self.sizes, found, point, minimum_weight), found))
    }

    /// Notes where a vertex of the refined mesh lies.
    pub fn set_place(&mut self, vertex: VertexId, tet: TetId) {
        if self.tets.len() <= vertex.index() {
            self.tets.resize(vertex.index() + 1, TetId::NONE);
        }
        self.tets[vertex.index()] = tet;
    }

    /// Follows a renumbering of the refined mesh.
    pub fn renumber(&mut self, renumbering: &Renumbering) {
        self.tets.resize(renumbering.old_of_vertex.len(), TetId::NONE);
        self.tets = renumbering.of_vertices(&self.tets);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::test_meshes::random_mesh;
    use crate::index::Label;

    #[test]
    fn the_field_is_linear_and_found_from_any_known_corner() {
        let mut mesh = random_mesh(5, 200);
        let tets: Vec<TetId> = mesh.finite_tets().collect();
        tets.iter().for_each(|&tet| mesh.set_label(tet, Label(1)));
        let linear = |p: DVec3| 3.0 + p.x - 0.5 * p.y + 0.25 * p.z;
        let sizes: Vec<f64> = (0..200).map(|v| linear(mesh.point(VertexId(v)))).collect();
        let mut field = BoundarySizes::new(&mesh, &sizes);
        for &tet in &tets {
            let center = mesh.points_of(tet).iter().sum::<DVec3>() / 4.0;
            let (size, found) = field.at(&mesh, tet, center, 0.0).unwrap();
            assert!(found == tet && (size - linear(center)).abs() < 1e-12);
        }
        // Three corners of a tet that were not found leave the fourth; without any there is no size.
        let row = mesh.vertices(tets[0]);
        let center = mesh.points_of(tets[0]).iter().sum::<DVec3>() / 4.0;
        row[1..].iter().for_each(|&v| field.set_place(v, TetId::NONE));
        assert_eq!(field.at(&mesh, tets[0], center, 0.0).unwrap().1, tets[0]);
        field.set_place(row[0], TetId::NONE);
        assert!(field.at(&mesh, tets[0], center, 0.0).is_none());
        // Another region's sizes are none of this one's.
        let mut other = mesh.clone();
        other.set_label(tets[1], Label(2));
        let center = mesh.points_of(tets[1]).iter().sum::<DVec3>() / 4.0;
        assert!(BoundarySizes::new(&mesh, &sizes).at(&other, tets[1], center, 0.0).is_none());
    }
}
