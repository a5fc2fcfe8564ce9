//! The elastic body that smoothing deforms: hexahedra where the lattice is uniform, pyramids around them, tets elsewhere.
//!
//! # Method
//! 1. The cubes of the mesh become hexahedra with pyramids ([`merged_elements`]), whatever elements the caller wants: a mixed
//!    mesh and a mesh of tets are smoothed by the same displacements and have the same surfaces.
//! 2. Stiffness by Gauss quadrature (tets in closed form), one material per label ([`assemble_stiffness`]).
//! 3. The middle of a hexahedron has no unknowns; it moves by what the trilinear shape functions say there, the mean of the
//!    corners.
//!
//! # Source
//! [Drakopoulos2017] 2.3.5, elements of the mixed mesh.
//!
//! # Invariants
//! Nodes are the vertices of the mesh. Rows of middles hold a unit block, so that the matrix stays positive definite.
//!
//! # Cost
//! A hexahedron takes the place of at least twelve tets and one vertex.

use glam::{DMat3, DVec3};

use crate::context::RunContext;
use crate::error::Result;
use crate::fem::assembly::{ModelPattern, assemble_stiffness};
use crate::fem::element_mesh::ElementMesh;
use crate::fem::element_stiffness::Formulation;
use crate::fem::material::MaterialMap;
use crate::index::VertexId;
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::mixed_elements::merged_elements;
use crate::mesh::mixed_mesh::ElementKind;
use crate::sparse::block_csr::BlockCsr;

/// Elements of the body are better than this: cubes of the lattice are, but for those that a fixed point distorts.
const MIN_SCALED_JACOBIAN: f64 = 0.2;

/// Triangles of a pyramid: it may lie on surfaces with all of them, as the elements of the body are no output.
const TRIANGLES: usize = 4;

/// Elements of an elastic body on the vertices of a mesh.
pub struct ElasticModel {
    types: Vec<u8>,
    offsets: Vec<i64>,
    connectivity: Vec<VertexId>,
    labels: Vec<i32>,
    /// Middle of a hexahedron, and its corners.
    centers: Vec<(VertexId, [VertexId; 8])>,
}

impl ElasticModel {
    /// The body of a mesh of tets, with the caller's value of each label.
    ///
    /// # Errors
    /// As [`merged_elements`].
    pub fn new(mesh: &CandidateMesh, values: &[i32], context: &RunContext) -> Result<Self> {
        let merged = merged_elements(mesh, TRIANGLES, MIN_SCALED_JACOBIAN, context)?;
        let corners = merged.hexahedra.iter().map(|(corners, _)| *corners);
        let mut model = Self {
            types: Vec::new(),
            offsets: vec![0],
            connectivity: Vec::new(),
            labels: Vec::new(),
            centers: merged.centers.iter().copied().zip(corners).collect(),
        };
        let mut push = |kind: ElementKind, nodes: &[VertexId], label: usize| {
            model.types.push(kind.vtk_type());
            model.connectivity.extend_from_slice(nodes);
            model.offsets.push(model.connectivity.len() as i64);
            model.labels.push(values[label]);
        };
        let tets = mesh.tets.iter().zip(&mesh.tet_labels).zip(&merged.is_kept).filter(|(_, kept)| **kept);
        tets.for_each(|((tet, label), _)| push(ElementKind::Tet, tet, label.index()));
        merged.pyramids.iter().for_each(|(p, label)| push(ElementKind::Pyramid, p, label.index()));
        merged.hexahedra.iter().for_each(|(h, label)| push(ElementKind::Hexahedron, h, label.index()));
        Ok(model)
    }

    /// The stiffness of the body.
    ///
    /// # Errors
    /// As [`assemble_stiffness`].
    pub fn stiffness(&self, points: &[DVec3], materials: &MaterialMap, context: &RunContext) -> Result<BlockCsr> {
        let Self { types, offsets, connectivity, labels, .. } = self;
        let mesh = ElementMesh { points, types, offsets, connectivity, labels };
        let pattern = ModelPattern::new(&mesh, context)?;
        let mut matrix = assemble_stiffness(&mesh, &pattern, materials, Formulation::Standard, context)?;
        self.centers.iter().for_each(|(v, _)| matrix.set_diagonal(v.index(), DMat3::IDENTITY));
        Ok(matrix)
    }

    /// Gives the middles of hexahedra the displacement that the corners have there.
    pub fn move_centers(&self, displacements: &mut [DVec3]) {
        for (center, corners) in &self.centers {
            displacements[center.index()] = corners.iter().map(|v| displacements[v.index()]).sum::<DVec3>() / 8.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fem::material::Material;
    use crate::image::label_image::LabelImage;
    use crate::lattice::adaptive_refinement::{RefinementInput, refine};
    use crate::lattice::options::{Options, PARAMETERS};
    use crate::lattice::report::Report;
    use crate::lattice::subdivision_criteria::Targets;
    use crate::lattice::test_images::voxel_image;
    use crate::parameters::ParameterSet;

    const VALUES: [i32; 3] = [0, 1, 2];

    /// Two halves of a ball.
    fn halves() -> LabelImage {
        let center = DVec3::new(11.3, 11.7, 11.1);
        voxel_image(24, |p| if p.distance(center) < 10.0 { 1 + u16::from(p.x > 14.0) } else { 0 })
    }

    fn lattice_mesh(context: &RunContext) -> CandidateMesh {
        let mut set = ParameterSet::new(PARAMETERS);
        set.set_text("surface-tolerance", "100").unwrap();
        let options = Options::from_parameters(&set).unwrap();
        let image = halves();
        let targets = Targets::new(&VALUES, &options).unwrap();
        let input =
            RefinementInput { image: &image, values: &VALUES, targets: &targets, spacing: 4.0, region_threshold: None };
        refine(&input, &options, &mut Report::default(), context).unwrap().0
    }

    fn forces(matrix: &BlockCsr, points: &[DVec3], field: impl Fn(DVec3) -> DVec3) -> Vec<DVec3> {
        let displacements: Vec<DVec3> = points.iter().map(|p| field(*p)).collect();
        let mut result = vec![DVec3::ZERO; points.len()];
        matrix.multiply(&displacements, &mut result);
        result
    }

    #[test]
    fn the_body_has_all_three_kinds_and_the_volume_of_the_mesh() {
        let context = RunContext::with_threads(1).unwrap();
        let mesh = lattice_mesh(&context);
        let model = ElasticModel::new(&mesh, &VALUES, &context).unwrap();
        let count = |kind: ElementKind| model.types.iter().filter(|t| **t == kind.vtk_type()).count();
        let kinds = [ElementKind::Tet, ElementKind::Pyramid, ElementKind::Hexahedron].map(count);
        assert!(kinds.iter().all(|count| *count > 20), "{kinds:?}");
        assert_eq!(kinds[2], model.centers.len());
        // Stretching along x costs the energy E V / 2 where Poisson's ratio is zero: the elements fill the mesh once.
        let material = Material::new(1.0, 0.0).unwrap();
        let mut matrix = model.stiffness(&mesh.points, &MaterialMap::uniform(material), &context).unwrap();
        model.centers.iter().for_each(|(v, _)| matrix.set_diagonal(v.index(), DMat3::ZERO));
        let forces = forces(&matrix, &mesh.points, |p| DVec3::X * p.x);
        let energy: f64 = forces.iter().zip(&mesh.points).map(|(f, p)| f.x * p.x).sum();
        let corners = |t: &[VertexId; 4]| t.map(|v| mesh.points[v.index()]);
        let volume: f64 = mesh.tets.iter().map(|t| crate::geometry::tetrahedron::volume(corners(t))).sum();
        assert!((energy / volume - 1.0).abs() < 1e-12, "{energy} {volume}");
    }

    #[test]
    fn a_linear_field_is_in_balance_at_every_inner_vertex_of_a_label_and_moves_the_middles() {
        let context = RunContext::with_threads(2).unwrap();
        let mesh = lattice_mesh(&context);
        let model = ElasticModel::new(&mesh, &VALUES, &context).unwrap();
        let soft = Material::new(0.0021, 0.45).unwrap();
        let materials = MaterialMap::new(Some(soft), vec![(2, Material::new(0.1, 0.3).unwrap())]);
        let mut matrix = model.stiffness(&mesh.points, &materials, &context).unwrap();
        model.centers.iter().for_each(|(v, _)| matrix.set_diagonal(v.index(), DMat3::ZERO));
        let field = |p: DVec3| DVec3::new(0.01 * p.x + 0.02 * p.y, 0.03 * p.z - 0.01 * p.y, 0.02 * p.x + 0.5);
        // Inner vertices: all tets of one label, closed; faces met once lie on a surface.
        let mut faces: std::collections::BTreeMap<[u32; 3], (usize, u32)> = std::collections::BTreeMap::new();
        for (tet, label) in mesh.tets.iter().zip(&mesh.tet_labels) {
            for leave_out in 0..4 {
                let mut face: Vec<u32> = (0..4).filter(|i| *i != leave_out).map(|i| tet[i].0).collect();
                face.sort_unstable();
                let (count, sum) = faces.entry([face[0], face[1], face[2]]).or_default();
                *count += 1;
                *sum += u32::from(label.0);
            }
        }
        let mut is_inner = vec![true; mesh.points.len()];
        let on_surface = faces.iter().filter(|(_, (count, sum))| *count == 1 || *sum == 3);
        on_surface.for_each(|(face, _)| face.iter().for_each(|v| is_inner[*v as usize] = false));
        let forces = forces(&matrix, &mesh.points, field);
        model.centers.iter().for_each(|(v, _)| is_inner[v.index()] = false);
        let inner = (0..mesh.points.len()).filter(|v| is_inner[*v]);
        assert!(inner.clone().count() > 10, "{}", inner.count());
        inner.for_each(|v| assert!(forces[v].length() < 1e-12, "{v}: {}", forces[v]));
        assert!(forces.iter().any(|f| f.length() > 1e-4), "surfaces carry the load");
        let mut displacements: Vec<DVec3> = mesh.points.iter().map(|p| field(*p)).collect();
        model.centers.iter().for_each(|(v, _)| displacements[v.index()] = DVec3::NAN);
        model.move_centers(&mut displacements);
        let error = |(u, p): (&DVec3, &DVec3)| u.distance(field(*p));
        assert!(displacements.iter().zip(&mesh.points).map(error).all(|e| e < 1e-12));
    }
}
