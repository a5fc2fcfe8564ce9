//! Points in elements: location, and the matrix H of shape values.
//!
//! # Method
//! 1. Element bounding boxes are entered into a uniform grid of about one element per cell.
//! 2. A point tries the elements of its cell in increasing order; the reference coordinates come from a linear solve
//!    (tets) or Newton's iteration (others); the first element that contains it within a tolerance wins.
//! 3. A point outside of all elements can be moved to the nearest element within a distance: it gets the values of the
//!    closest point of that element's reference domain.
//!
//! # Invariants
//! The result depends on the mesh and the point only. Rows of H sum to one.
//!
//! # Cost
//! About 4 bytes per element and cell it touches, 4 bytes per cell; a query looks at a few elements.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use crate::error::Result;
use crate::fem::element_mesh::ElementMesh;
use crate::fem::shape_functions::{MAX_NODES, reference_center, shape_functions};
use crate::index::{ElementId, VertexId};
use crate::mesh::mixed_mesh::ElementKind;

/// How far outside of an element, in reference coordinates, a point still counts as inside: shared faces must not leak.
const INSIDE_TOLERANCE: f64 = 1e-9;

/// Newton steps; mildly distorted elements need about five.
const NEWTON_STEPS: usize = 20;

/// Grid cells at most, whatever the mesh.
const MAX_CELLS: usize = 1 << 24;

/// Where a point lies in a mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointInElement {
    /// The element.
    pub element: ElementId,
    /// Reference coordinates in it.
    pub reference: DVec3,
}

/// A grid over the elements of a mesh.
#[derive(Debug, Clone)]
pub struct PointLocator<'a> {
    mesh: ElementMesh<'a>,
    low: DVec3,
    inverse_cell: DVec3,
    size: [usize; 3],
    offsets: Vec<u32>,
    entries: Vec<u32>,
}

impl<'a> PointLocator<'a> {
    /// Builds the grid.
    ///
    /// # Errors
    /// As [`ElementMesh::check`].
    pub fn new(mesh: ElementMesh<'a>) -> Result<Self> {
        mesh.check()?;
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for node in mesh.connectivity {
            low = low.min(mesh.points[node.index()]);
            high = high.max(mesh.points[node.index()]);
        }
        if mesh.element_count() == 0 {
            (low, high) = (DVec3::ZERO, DVec3::ONE);
        }
        let extent = (high - low).max(DVec3::splat(1e-12 * (1.0 + high.abs().max_element())));
        let cells = mesh.element_count().clamp(1, MAX_CELLS) as f64;
        let edge = (extent.x * extent.y * extent.z / cells).cbrt().max(extent.max_element() / 1024.0);
        let size = [extent.x, extent.y, extent.z].map(|e| ((e / edge).ceil() as usize).clamp(1, 1024));
        let inverse_cell = DVec3::new(size[0] as f64, size[1] as f64, size[2] as f64) / extent;
        let mut locator = Self { mesh, low, inverse_cell, size, offsets: Vec::new(), entries: Vec::new() };
        locator.fill();
        Ok(locator)
    }

    fn fill(&mut self) {
        let boxes: Vec<[[usize; 3]; 2]> = (0..self.mesh.element_count())
            .into_par_iter()
            .map(|element| {
                let (low, high) = self.element_box(element);
                [self.cell_of(low), self.cell_of(high)]
            })
            .collect();
        let mut offsets = vec![0u32; self.size.iter().product::<usize>() + 1];
        let size = self.size;
        let for_each_cell = |[low, high]: &[[usize; 3]; 2], work: &mut dyn FnMut(usize)| {
            for k in low[2]..=high[2] {
                for j in low[1]..=high[1] {
                    (low[0]..=high[0]).for_each(|i| work(i + size[0] * (j + size[1] * k)));
                }
            }
        };
        for range in &boxes {
            for_each_cell(range, &mut |cell| offsets[cell + 1] += 1);
        }
        for cell in 1..offsets.len() {
            offsets[cell] += offsets[cell - 1];
        }
        let mut fill = offsets.clone();
        let mut entries = vec![0u32; *offsets.last().unwrap_or(&0) as usize];
        for (element, range) in boxes.iter().enumerate() {
            for_each_cell(range, &mut |cell| {
                entries[fill[cell] as usize] = element as u32;
                fill[cell] += 1;
            });
        }
        self.offsets = offsets;
        self.entries = entries;
    }

    fn element_box(&self, element: usize) -> (DVec3, DVec3) {
        let (_, nodes) = self.mesh.element(element);
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for node in nodes {
            low = low.min(self.mesh.points[node.index()]);
            high = high.max(self.mesh.points[node.index()]);
        }
        // Quadratic edges can bulge past their nodes.
        let slack = (high - low) * if nodes.len() > 8 { 0.25 } else { 1e-9 };
        (low - slack, high + slack)
    }

    fn cell_of(&self, point: DVec3) -> [usize; 3] {
        let cell = ((point - self.low) * self.inverse_cell).to_array();
        std::array::from_fn(|d| (cell[d].max(0.0) as usize).min(self.size[d] - 1))
    }

    fn in_cell(&self, cell: [usize; 3]) -> &[u32] {
        let at = cell[0] + self.size[0] * (cell[1] + self.size[1] * cell[2]);
        &self.entries[self.offsets[at] as usize..self.offsets[at + 1] as usize]
    }

    /// The element that contains a point; `None` outside of the mesh.
    pub fn locate(&self, point: DVec3) -> Option<PointInElement> {
        if !point.is_finite() {
            return None;
        }
        self.in_cell(self.cell_of(point)).iter().find_map(|&element| {
            let reference = self.reference_coordinates(element as usize, point)?;
            let kind = self.mesh.element(element as usize).0;
            let excess = outside_by(kind, reference);
            (excess <= INSIDE_TOLERANCE).then_some(PointInElement { element: ElementId(element), reference })
        })
    }

    /// The element that contains a point, or the one whose clamped point is nearest within `distance`.
    pub fn locate_near(&self, point: DVec3, distance: f64) -> Option<PointInElement> {
        if let Some(found) = self.locate(point) {
            return Some(found);
        }
        if !point.is_finite() {
            return None;
        }
        let (low, high) = (self.cell_of(point - DVec3::splat(distance)), self.cell_of(point + DVec3::splat(distance)));
        let mut best: Option<(f64, PointInElement)> = None;
        for k in low[2]..=high[2] {
            for j in low[1]..=high[1] {
                for i in low[0]..=high[0] {
                    for &element in self.in_cell([i, j, k]) {
                        let kind = self.mesh.element(element as usize).0;
                        let Some(reference) = self.reference_coordinates(element as usize, point) else { continue };
                        let reference = clamp_to_reference(kind, reference);
                        let at = PointInElement { element: ElementId(element), reference };
                        let squared = self.position(&at).distance_squared(point);
                        let nearer = best.is_none_or(|(b, p)| (squared, element) < (b, p.element.0));
                        if squared <= distance * distance && nearer {
                            best = Some((squared, at));
                        }
                    }
                }
            }
        }
        best.map(|(_, found)| found)
    }

    /// The point of a reference position.
    pub fn position(&self, at: &PointInElement) -> DVec3 {
        self.interpolate(at, self.mesh.points)
    }

    /// Interpolates a vector per node.
    pub fn interpolate(&self, at: &PointInElement, values: &[DVec3]) -> DVec3 {
        let (kind, nodes) = self.mesh.element(at.element.index());
        let shape = shape_functions(kind, at.reference);
        nodes.iter().zip(shape.values).map(|(node, value)| values[node.index()] * value).sum()
    }

    /// One row of H: nodes and shape values.
    pub fn weights(&self, at: &PointInElement) -> (&'a [VertexId], [f64; MAX_NODES]) {
        let (kind, nodes) = self.mesh.element(at.element.index());
        (nodes, shape_functions(kind, at.reference).values)
    }

    /// Reference coordinates of a point in (or near) an element.
    fn reference_coordinates(&self, element: usize, point: DVec3) -> Option<DVec3> {
        let mut nodes = [DVec3::ZERO; 20];
        let kind = self.mesh.element_points(element, &mut nodes);
        if kind == ElementKind::Tet {
            let matrix = DMat3::from_cols(nodes[1] - nodes[0], nodes[2] - nodes[0], nodes[3] - nodes[0]);
            let reference = matrix.inverse() * (point - nodes[0]);
            return reference.is_finite().then_some(reference);
        }
        let (low, high) = self.element_box(element);
        let margin = (high - low) * 0.5;
        if point.cmplt(low - margin).any() || point.cmpgt(high + margin).any() {
            return None;
        }
        newton(kind, &nodes[..kind.node_count()], point)
    }
}

fn newton(kind: ElementKind, nodes: &[DVec3], point: DVec3) -> Option<DVec3> {
    let mut reference = reference_center(kind);
    for _ in 0..NEWTON_STEPS {
        let shape = shape_functions(kind, reference);
        let mut residual = point;
        let mut matrix = DMat3::ZERO;
        for (i, node) in nodes.iter().enumerate() {
            residual -= *node * shape.values[i];
            matrix.x_axis += *node * shape.gradients[i].x;
            matrix.y_axis += *node * shape.gradients[i].y;
            matrix.z_axis += *node * shape.gradients[i].z;
        }
        let step = matrix.inverse() * residual;
        if !step.is_finite() {
            return None;
        }
        // A long step has left the range where the map is one to one.
        reference += step.clamp_length_max(2.0);
        if step.length_squared() < 1e-24 {
            return Some(reference);
        }
        if reference.abs().max_element() > 8.0 {
            return None;
        }
    }
    // Newton's iteration still moves: near the apex of a pyramid it converges slowly, but close enough.
    let shape = shape_functions(kind, reference);
    let reached: DVec3 = nodes.iter().zip(shape.values).map(|(n, v)| *n * v).sum();
    let size = nodes.iter().map(|n| n.distance_squared(nodes[0])).fold(0.0, f64::max);
    (reached.distance_squared(point) < 1e-18 * size).then_some(reference)
}

/// How far reference coordinates lie outside of the reference element; negative inside.
pub fn outside_by(kind: ElementKind, at: DVec3) -> f64 {
    match kind {
        ElementKind::Tet | ElementKind::QuadraticTet => (-at.min_element()).max(at.x + at.y + at.z - 1.0),
        ElementKind::Hexahedron | ElementKind::QuadraticHexahedron => at.abs().max_element() - 1.0,
        ElementKind::Wedge => (-at.x).max(-at.y).max(at.x + at.y - 1.0).max(at.z.abs() - 1.0),
        ElementKind::Pyramid => (-at.z).max(at.x.abs().max(at.y.abs()) - (1.0 - at.z)),
    }
}

fn clamp_to_reference(kind: ElementKind, at: DVec3) -> DVec3 {
    match kind {
        ElementKind::Tet | ElementKind::QuadraticTet => {
            let bary = [1.0 - at.x - at.y - at.z, at.x, at.y, at.z].map(|b| b.max(0.0));
            let sum: f64 = bary.iter().sum();
            DVec3::new(bary[1], bary[2], bary[3]) / sum
        }
        ElementKind::Hexahedron | ElementKind::QuadraticHexahedron => at.clamp(-DVec3::ONE, DVec3::ONE),
        ElementKind::Wedge => {
            let bary = [1.0 - at.x - at.y, at.x, at.y].map(|b| b.max(0.0));
            let sum: f64 = bary.iter().sum();
            DVec3::new(bary[1] / sum, bary[2] / sum, at.z.clamp(-1.0, 1.0))
        }
        ElementKind::Pyramid => {
            let z = at.z.clamp(0.0, 1.0);
            DVec3::new(at.x.clamp(z - 1.0, 1.0 - z), at.y.clamp(z - 1.0, 1.0 - z), z)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fem::shape_functions::reference_nodes;
    use crate::mesh::mixed_mesh::MixedMesh;

    fn one_element(kind: ElementKind) -> MixedMesh {
        let map = |p: DVec3| DVec3::new(2.0 * p.x + 0.3 * p.y, 1.5 * p.y, p.z + 0.2 * p.x * p.y + 5.0);
        MixedMesh {
            points: reference_nodes(kind).into_iter().map(map).collect(),
            types: vec![kind.vtk_type()],
            offsets: vec![0, kind.node_count() as i64],
            connectivity: (0..kind.node_count()).map(VertexId::from_index).collect(),
            labels: vec![1],
            ..MixedMesh::default()
        }
    }

    #[test]
    fn a_point_is_found_and_reproduced_in_every_kind() {
        for kind in [
            ElementKind::Tet,
            ElementKind::Hexahedron,
            ElementKind::Wedge,
            ElementKind::Pyramid,
            ElementKind::QuadraticTet,
            ElementKind::QuadraticHexahedron,
        ] {
            let mesh = one_element(kind);
            let locator = PointLocator::new(ElementMesh::from_mixed(&mesh)).unwrap();
            let reference = reference_center(kind) + DVec3::new(0.05, 0.1, 0.07);
            let shape = shape_functions(kind, reference);
            let point: DVec3 = mesh.points.iter().zip(shape.values).map(|(p, v)| *p * v).sum();
            let found = locator.locate(point).unwrap_or_else(|| panic!("{kind:?}"));
            assert!((found.reference - reference).length() < 1e-9, "{kind:?}");
            assert!((locator.position(&found) - point).length() < 1e-12);
            assert!(locator.locate(point + DVec3::X * 50.0).is_none());
            let near = locator.locate_near(mesh.points[0] - DVec3::splat(0.01), 1.0).expect("within the distance");
            assert!((locator.position(&near) - mesh.points[0]).length() < 0.1, "{kind:?}");
        }
    }

    #[test]
    fn a_point_that_is_not_finite_is_outside() {
        let mesh = one_element(ElementKind::Tet);
        let locator = PointLocator::new(ElementMesh::from_mixed(&mesh)).unwrap();
        assert!(locator.locate(DVec3::NAN).is_none() && locator.locate_near(DVec3::INFINITY, 1.0).is_none());
    }
}
