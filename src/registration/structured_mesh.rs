//! Structured hexahedra over the labelled voxels: the mesh of appendix A.
//!
//! # Method
//! 1. The box of the labelled voxels is divided into equal hexahedra along the axes of the image.
//! 2. A hexahedron that holds enough labelled voxels is kept; its label is the one of most of its voxels.
//! 3. Their corners are numbered in the order of the lattice.
//!
//! # Source
//! [Drakopoulos2017] appendix A.2.2 and table 23; `-meshMethod 3` of appendix B.2.
//!
//! # Invariants
//! All elements have positive volume, also for an image whose axes are left-handed; the mesh is conforming.
//!
//! # Cost
//! One pass over the voxels.

use glam::DVec3;

use crate::error::{Error, Result};
use crate::image::label_image::LabelImage;
use crate::index::VertexId;
use crate::mesh::mixed_mesh::{ElementKind, MixedMesh};

/// A hexahedron is kept when at least this share of it is labelled: below it, the boundary layer is mostly background.
const MIN_SHARE: f64 = 0.1;

/// Structured hexahedra of about `edge` mm; `counts` replaces the number along an axis where it is given.
///
/// # Errors
/// [`Error::InvalidInput`] for an image without label; [`Error::CapacityExceeded`] past the index range.
pub fn structured_hexahedra(labels: &LabelImage, edge: f64, counts: [Option<usize>; 3]) -> Result<MixedMesh> {
    let lattice = Lattice::new(labels, edge, counts)?;
    let kept = lattice.element_labels(labels);
    let mut node_ids = vec![VertexId::NONE; lattice.nodes.iter().product()];
    let corners = |cell: usize| -> [usize; 8] {
        let [ci, cj, _] = lattice.cells;
        let [ni, nj, _] = lattice.nodes;
        let base = cell % ci + ni * (cell / ci % cj + nj * (cell / (ci * cj)));
        let (j, k) = (ni, ni * nj);
        // VTK's order; a left-handed frame swaps bottom and top.
        let bottom = [base, base + 1, base + 1 + j, base + j];
        let top = bottom.map(|n| n + k);
        let (first, second) = if labels.grid().is_right_handed() { (bottom, top) } else { (top, bottom) };
        [first[0], first[1], first[2], first[3], second[0], second[1], second[2], second[3]]
    };
    for (cell, _) in kept.iter().enumerate().filter(|(_, label)| **label != 0) {
        corners(cell).into_iter().for_each(|node| node_ids[node] = VertexId(0));
    }
    let mut mesh = MixedMesh { offsets: vec![0], ..MixedMesh::default() };
    for (node, id) in node_ids.iter_mut().enumerate().filter(|(_, id)| **id != VertexId::NONE) {
        *id = VertexId::try_new(mesh.points.len())?;
        mesh.points.push(lattice.point(labels, node));
    }
    for (cell, label) in kept.into_iter().enumerate().filter(|(_, label)| *label != 0) {
        mesh.connectivity.extend(corners(cell).map(|node| node_ids[node]));
        mesh.types.push(ElementKind::Hexahedron.vtk_type());
        mesh.offsets.push(mesh.connectivity.len() as i64);
        mesh.labels.push(label);
    }
    mesh.check_shape()?;
    Ok(mesh)
}

/// The lattice of cells over the labelled box.
struct Lattice {
    /// First voxel of the box.
    first: [usize; 3],
    /// Voxels per cell along each axis; need not be whole.
    step: DVec3,
    cells: [usize; 3],
    nodes: [usize; 3],
}

impl Lattice {
    fn new(labels: &LabelImage, edge: f64, counts: [Option<usize>; 3]) -> Result<Self> {
        let size = labels.grid().size();
        let (mut first, mut last) = (size, [0; 3]);
        for (at, _) in labels.voxels().iter().enumerate().filter(|(_, label)| label.0 != 0) {
            let voxel = [at % size[0], at / size[0] % size[1], at / (size[0] * size[1])];
            for axis in 0..3 {
                first[axis] = first[axis].min(voxel[axis]);
                last[axis] = last[axis].max(voxel[axis]);
            }
        }
        if first[0] > last[0] {
            return Err(Error::input("the segmentation has no label"));
        }
        let (mut cells, mut step) = ([1; 3], DVec3::ONE);
        for axis in 0..3 {
            let voxels = (last[axis] - first[axis] + 1) as f64;
            let length = voxels * labels.grid().spacing()[axis];
            cells[axis] = counts[axis].unwrap_or((length / edge).round().max(1.0) as usize);
            step[axis] = voxels / cells[axis] as f64;
        }
        Ok(Self { first, step, cells, nodes: cells.map(|n| n + 1) })
    }

    /// World point of a node: cells end half a voxel outside of the outermost centres.
    fn point(&self, labels: &LabelImage, node: usize) -> DVec3 {
        let [ni, nj, _] = self.nodes;
        let place = DVec3::new((node % ni) as f64, (node / ni % nj) as f64, (node / (ni * nj)) as f64);
        let first = DVec3::from_array(self.first.map(|x| x as f64 - 0.5));
        labels.grid().index_to_world(first + place * self.step)
    }

    /// Caller's label per cell; 0 for cells that are not kept.
    fn element_labels(&self, labels: &LabelImage) -> Vec<i32> {
        let size = labels.grid().size();
        let kinds = labels.label_count();
        let mut votes = vec![0u32; self.cells.iter().product::<usize>() * kinds];
        for (at, label) in labels.voxels().iter().enumerate().filter(|(_, label)| label.0 != 0) {
            let voxel = [at % size[0], at / size[0] % size[1], at / (size[0] * size[1])];
            let cell = [0, 1, 2].map(|axis| {
                let place = ((voxel[axis] - self.first[axis]) as f64 + 0.5) / self.step[axis];
                (place as usize).min(self.cells[axis] - 1)
            });
            votes[(cell[0] + self.cells[0] * (cell[1] + self.cells[1] * cell[2])) * kinds + label.index()] += 1;
        }
        let least = (MIN_SHARE * self.step.element_product()) as u32;
        votes
            .chunks(kinds)
            .map(|votes| {
                let total: u32 = votes.iter().sum();
                // Of equal votes the first label wins.
                let most = (1..kinds).rev().max_by_key(|label| votes[*label]).unwrap_or(0);
                if total > least { labels.values()[most] } else { 0 }
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use crate::index::Label;
    use crate::mesh::validation::check_mixed_mesh;
    use glam::DMat3;

    #[test]
    fn a_two_label_box_becomes_valid_hexahedra_in_any_frame() {
        for direction in [DMat3::IDENTITY, DMat3::from_diagonal(DVec3::new(1.0, -1.0, 1.0))] {
            let grid = Grid::new([12, 10, 8], DVec3::new(1.0, 1.0, 2.0), DVec3::ZERO, direction).unwrap();
            let voxels = (0..960)
                .map(|at| {
                    let i = at % 12;
                    Label(if (2..8).contains(&i) { 1 } else { 2 * u16::from((8..10).contains(&i)) })
                })
                .collect();
            let labels = LabelImage::new(grid, voxels, vec![0, 1, 5]).unwrap();
            let mesh = structured_hexahedra(&labels, 2.0, [None, Some(5), None]).unwrap();
            check_mixed_mesh(&mesh).unwrap();
            assert_eq!(mesh.element_count(), 4 * 5 * 8);
            assert_eq!(mesh.labels.iter().filter(|l| **l == 5).count(), 40);
        }
    }
}
