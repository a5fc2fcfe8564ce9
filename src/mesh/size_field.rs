//! Target edge lengths: those of the boundary, bounded by sources, a background mesh, surfaces and the host's function.
//!
//! # Method
//! 1. At a boundary vertex: the average of the lengths of its boundary edges, times `cdf`, at most `dfmax`.
//! 2. Elsewhere: what the refinement interpolates, bounded by every part of a [`Sizing`] and by the source surfaces:
//!    size at the nearest point of the source plus decay times distance.
//!
//! # Source
//! [Drakopoulos2017] 4.7.1 (initial distribution function), 4.10.1 (`cdfm`, `dfmax`), 4.12 (background mesh, source
//! surfaces); B.3 `cdf`, `dfmax`.
//!
//! # Invariants
//! Every size handed out is finite and positive; a host's function that breaks this ends the run with an error.
//!
//! # Cost
//! Sources: linear in their number. Background: a walk from the element found last. Source surfaces: nearest point of
//! a kd-tree over their vertices, O(log n).
//!
//! # Limits
//! A source surface is seen through its vertices: the distance to it is that to the nearest vertex.

use glam::DVec3;

use crate::error::{Error, Result};
use crate::geometry::tetrahedron::{barycentric, volume6};
use crate::index::{Label, TetFace, TetId, VertexId};
use crate::mesh::mixed_mesh::{ElementKind, MixedMesh};
use crate::mesh::numbering::sorted_edge;
use crate::mesh::sizing::Sizing;
use crate::mesh::surface_mesh::SurfaceMesh;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;

/// Growth of the edge length per unit of distance from a source surface.
pub const SURFACE_DECAY: f64 = 0.1;

/// Vertices and sizes of source surfaces, in a kd-tree whose nodes are the medians of their ranges.
#[derive(Debug, Clone, Default)]
struct SourcePoints {
    /// Point and size, in the order of the tree. 32 B / point.
    rows: Vec<(DVec3, f64)>,
}

impl SourcePoints {
    fn build(mut rows: Vec<(DVec3, f64)>) -> Self {
        fn split(rows: &mut [(DVec3, f64)], axis: usize) {
            if rows.len() < 2 {
                return;
            }
            let middle = rows.len() / 2;
            rows.select_nth_unstable_by(middle, |a, b| a.0[axis].total_cmp(&b.0[axis]));
            let (low, high) = rows.split_at_mut(middle);
            split(low, (axis + 1) % 3);
            split(&mut high[1..], (axis + 1) % 3);
        }
        split(&mut rows, 0);
        Self { rows }
    }

    /// The smallest of `size + decay * distance` over all points.
    fn bound(&self, point: DVec3) -> f64 {
        fn nearest(rows: &[(DVec3, f64)], axis: usize, point: DVec3, best: &mut (f64, f64)) {
            let Some(&(at, size)) = rows.get(rows.len() / 2) else { return };
            let middle = rows.len() / 2;
            let squared = at.distance_squared(point);
            if squared < best.0 {
                *best = (squared, size);
            }
            let offset = point[axis] - at[axis];
            let (low, high) = (&rows[..middle], &rows[middle + 1..]);
            let (near, far) = if offset < 0.0 { (low, high) } else { (high, low) };
            nearest(near, (axis + 1) % 3, point, best);
            if offset * offset < best.0 {
                nearest(far, (axis + 1) % 3, point, best);
            }
        }
        if self.rows.is_empty() {
            return f64::INFINITY;
        }
        let mut best = (f64::INFINITY, f64::INFINITY);
        nearest(&self.rows, 0, point, &mut best);
        best.1 + SURFACE_DECAY * best.0.sqrt()
    }
}

/// A background mesh of tets with a size at each vertex.
#[derive(Debug, Clone)]
struct Background {
    complex: TetComplex,
    sizes: Vec<f64>,
    /// Where walks start: tets spread over the mesh.
    samples: Vec<TetId>,
}

impl Background {
    fn new(mesh: &MixedMesh, sizes: &[f64]) -> Result<Self> {
        let mut complex = TetComplex::with_points(mesh.points.clone())?;
        for element in 0..mesh.element_count() {
            let (kind, vertices) = mesh.element(element);
            if !matches!(kind, ElementKind::Tet | ElementKind::QuadraticTet) {
                let reason = "the background mesh has elements other than tets".to_owned();
                return Err(Error::Unsupported { reason });
            }
            let mut row = [vertices[0], vertices[1], vertices[2], vertices[3]];
            let corners = row.map(|v| mesh.points[v.index()]);
            if volume6(corners) < 0.0 {
                row.swap(0, 1);
            }
            complex.create_tet(row, Label(1))?;
        }
        complex.pair_faces()?;
        let stride = (complex.live_count() / 256).max(1);
        let samples = complex.live_tets().step_by(stride).collect();
        Ok(Self { complex, sizes: sizes.to_vec(), samples })
    }

    /// The interpolated size, or infinite outside.
    fn bound(&self, point: DVec3) -> f64 {
        let center = |tet: TetId| self.complex.points_of(tet).iter().sum::<DVec3>() / 4.0;
        let start = self
            .samples
            .iter()
            .copied()
            .min_by(|a, b| center(*a).distance_squared(point).total_cmp(&center(*b).distance_squared(point)));
        let Some(mut tet) = start else { return f64::INFINITY };
        for _ in 0..self.complex.slot_count() {
            let corners = self.complex.points_of(tet);
            let weights = barycentric(corners, point);
            let mut order = [0, 1, 2, 3];
            order.sort_unstable_by(|&i, &j| weights[i].total_cmp(&weights[j]));
            if weights[order[0]] >= -1e-12 {
                let row = self.complex.vertices(tet);
                return weights.iter().zip(row).map(|(w, v)| w * self.sizes[v.index()]).sum();
            }
            let next = order
                .into_iter()
                .filter(|&face| weights[face] < 0.0)
                .map(|face| self.complex.neighbor(TetFace::new(tet, face)))
                .find(|side| *side != TetFace::NONE);
            match next {
                Some(side) => tet = side.tet(),
                None => return f64::INFINITY,
            }
        }
        f64::INFINITY
    }
}

/// Everything that bounds the edge length at a point.
#[derive(Clone, Default)]
pub struct SizeField {
    sizing: Sizing,
    limit: f64,
    /// By label; labels beyond the end have none.
    label_limits: Vec<f64>,
    surfaces: SourcePoints,
    background: Option<std::sync::Arc<Background>>,
}

impl SizeField {
    /// The field of a host's sizing and of source surfaces; `limit` is the largest size anywhere (infinite for none).
    ///
    /// # Errors
    /// As [`Sizing::check`]; [`Error::Unsupported`] for a background mesh that is not of tets.
    pub fn new(sizing: &Sizing, surfaces: &[&SurfaceMesh], limit: f64) -> Result<Self> {
        sizing.check()?;
        let mut rows = Vec::new();
        for surface in surfaces {
            let sizes = average_edges(surface.points.len(), &surface.points, &surface.facets);
            rows.extend(surface.points.iter().copied().zip(sizes).filter(|(_, size)| *size > 0.0));
        }
        let background = match &sizing.background {
            Some((mesh, sizes)) => Some(std::sync::Arc::new(Background::new(mesh, sizes)?)),
            None => None,
        };
        let surfaces = SourcePoints::build(rows);
        Ok(Self { sizing: sizing.clone(), limit, label_limits: Vec::new(), surfaces, background })
    }

    /// The same field with a largest size anywhere and one per label.
    #[must_use]
    pub fn with_limits(mut self, limit: f64, by_label: Vec<f64>) -> Self {
        (self.limit, self.label_limits) = (limit, by_label);
        self
    }

    /// Whether nothing but the boundary decides.
    pub fn is_free(&self) -> bool {
        self.limit.is_infinite()
            && self.label_limits.iter().all(|l| l.is_infinite())
            && self.sizing.sources.is_empty()
            && self.sizing.function.is_none()
            && self.surfaces.rows.is_empty()
            && self.background.is_none()
    }

    /// As [`SizeField::bounded`], and at most the limit of the label.
    ///
    /// # Errors
    /// As there.
    pub fn bounded_in(&self, label: Label, point: DVec3, wanted: f64) -> Result<f64> {
        let limit = self.label_limits.get(label.index()).copied().unwrap_or(f64::INFINITY);
        self.bounded(point, wanted.min(limit))
    }

    /// The size at `point` where the surroundings want `wanted`: at most that, and at most every bound.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] where the host's function returns something that is not finite and positive.
    pub fn bounded(&self, point: DVec3, wanted: f64) -> Result<f64> {
        let mut size = wanted.min(self.limit);
        for source in &self.sizing.sources {
            size = size.min(source.size + source.decay * source.shape.distance(point));
        }
        size = size.min(self.surfaces.bound(point));
        if let Some(background) = &self.background {
            size = size.min(background.bound(point));
        }
        if let Some(function) = &self.sizing.function {
            let value = function(point, size);
            if !(value.is_finite() && value > 0.0) {
                let place = format!("({}, {}, {})", point.x, point.y, point.z);
                return Err(Error::argument("size function", format!("returned {value} at {place}")));
            }
            size = size.min(value);
        }
        Ok(size)
    }
}

/// The average length of the edges at each point of a triangulation; 0 for points without triangles.
pub fn average_edges(count: usize, points: &[DVec3], facets: &[[VertexId; 3]]) -> Vec<f64> {
    let mut edges: Vec<[VertexId; 2]> =
        facets.iter().flat_map(|[a, b, c]| [[*a, *b], [*b, *c], [*c, *a]]).map(|[a, b]| sorted_edge(a, b)).collect();
    edges.sort_unstable();
    edges.dedup();
    let (mut sums, mut numbers) = (vec![0.0; count], vec![0u32; count]);
    for [a, b] in edges {
        let length = points[a.index()].distance(points[b.index()]);
        for v in [a, b] {
            sums[v.index()] += length;
            numbers[v.index()] += 1;
        }
    }
    sums.iter().zip(&numbers).map(|(sum, n)| if *n > 0 { sum / f64::from(*n) } else { 0.0 }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::sizing::{SizeSource, SourceShape};
    use std::sync::Arc;

    fn grid_surface() -> SurfaceMesh {
        let points: Vec<DVec3> =
            (0..6).flat_map(|i| (0..6).map(move |j| DVec3::new(f64::from(i), f64::from(j), 0.0))).collect();
        let mut facets = Vec::new();
        for i in 0..5u32 {
            for j in 0..5u32 {
                let v = |a: u32, b: u32| VertexId(6 * a + b);
                facets.push([v(i, j), v(i + 1, j), v(i, j + 1)]);
                facets.push([v(i + 1, j), v(i + 1, j + 1), v(i, j + 1)]);
            }
        }
        SurfaceMesh::new(points, facets)
    }

    #[test]
    fn bounds_combine_by_the_smallest() {
        let source = SizeSource { shape: SourceShape::Point(DVec3::ZERO), size: 0.5, decay: 0.1 };
        let sizing = Sizing { sources: vec![source], ..Sizing::default() };
        let field = SizeField::new(&sizing, &[], 3.0).unwrap();
        assert!(!field.is_free());
        assert_eq!(field.bounded(DVec3::new(10.0, 0.0, 0.0), 9.0).unwrap(), 1.5);
        assert_eq!(field.bounded(DVec3::new(100.0, 0.0, 0.0), 9.0).unwrap(), 3.0);
        assert_eq!(field.bounded(DVec3::ZERO, 0.2).unwrap(), 0.2);
    }

    #[test]
    fn unusable_values_of_the_function_are_errors() {
        for value in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let sizing = Sizing { function: Some(Arc::new(move |_, _| value)), ..Sizing::default() };
            let field = SizeField::new(&sizing, &[], f64::INFINITY).unwrap();
            assert!(matches!(field.bounded(DVec3::ZERO, 1.0), Err(Error::InvalidArgument { .. })));
        }
    }

    #[test]
    fn source_surface_is_found_by_its_nearest_vertex() {
        let surface = grid_surface();
        let field = SizeField::new(&Sizing::default(), &[&surface], f64::INFINITY).unwrap();
        let sizes = average_edges(36, &surface.points, &surface.facets);
        for point in [DVec3::new(2.2, 3.1, 1.0), DVec3::new(-4.0, 2.0, 0.5), DVec3::new(5.0, 5.0, -2.0)] {
            let nearest = (0..36)
                .min_by(|&i, &j| surface.points[i].distance(point).total_cmp(&surface.points[j].distance(point)));
            let i = nearest.unwrap();
            let expected = sizes[i] + SURFACE_DECAY * surface.points[i].distance(point);
            assert!((field.bounded(point, 100.0).unwrap() - expected).abs() < 1e-12);
        }
    }

    #[test]
    fn background_is_interpolated_and_does_not_bound_outside() {
        let points = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
        let mesh = MixedMesh::from_tets(points, &[[0, 1, 2, 3].map(VertexId)], vec![1]).unwrap();
        let sizing = Sizing { background: Some((Arc::new(mesh), vec![1.0, 2.0, 3.0, 4.0])), ..Sizing::default() };
        let field = SizeField::new(&sizing, &[], f64::INFINITY).unwrap();
        assert!((field.bounded(DVec3::splat(0.25), 9.0).unwrap() - 2.5).abs() < 1e-12);
        assert_eq!(field.bounded(DVec3::ONE, 9.0).unwrap(), 9.0);
    }
}
