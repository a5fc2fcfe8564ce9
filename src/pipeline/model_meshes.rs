//! Meshes of the registration's model: the lattice engine and the surface engine behind its mesh methods.
//!
//! # Method
//! - `cbc3d`: the lattice engine with the `CBC3D` options.
//! - `ld`: the lattice engine with elements of the given size inside and the highest fidelity at the boundaries, where they
//!   are refined down to the voxels.
//! - `delaunay`: the surfaces of a lattice mesh of the given element size, filled by the surface engine with Delaunay
//!   refinement; each region takes the label of most of its elements' middles.
//! - Structured hexahedra are the registration's own.
//!
//! # Source
//! [Drakopoulos2017] appendix B.2 (`meshMethod`, `DelaunayDelta`), section 2.4 (the methods it compares).
//!
//! # Differences
//! The Delaunay and the lattice derefinement meshers of the thesis are other programs of its group. `ld` starts there from a mesh of
//! all voxels and coarsens what fidelity and angles allow; here the mesh is refined from coarse elements until it is faithful, which
//! aims at the same mesh, few elements inside and small ones at the boundary, from the other side.
//!
//! # Invariants
//! Same bits for any number of threads: the surface engine runs its one-thread order here.
//!
//! # Limits
//! `delaunay`: parts of a label that the coarse lattice does not resolve are not meshed.

use glam::DVec3;

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::image::interpolation::nearest_offset;
use crate::image::label_image::LabelImage;
use crate::index::{Label, VertexId};
use crate::mesh::boundary::extract_boundary;
use crate::mesh::mixed_mesh::MixedMesh;
use crate::mesh::surface_mesh::SurfaceMesh;
use crate::parameters::{ParameterSet, Value};
use crate::registration::options::{MeshMethod, MeshOptions};

use super::{image_to_mesh, surface_to_mesh};

/// A tolerance that no element of any image exceeds, in voxels.
const UNBOUNDED_TOLERANCE: f64 = 1e9;

/// Fidelity of `ld`: the highest that a boundary through voxels reaches without elements smaller than these.
const HIGH_FIDELITY: f64 = 0.95;

/// Surface triangles of the Delaunay mesh are not halved below this share of its element size.
const LEAST_SHARE: f64 = 0.5;

/// Smoothing of the surfaces of the Delaunay mesh: none, for smoothing can move a surface through another across a thin gap, and
/// surfaces of an unsmoothed lattice never cross.
const SMOOTHING: i64 = 0;

/// The mesh of a label image by the method of the options.
///
/// # Errors
/// Those of the engines; [`Error::Internal`] for structured hexahedra, which the registration makes itself.
pub fn mesh_of_labels(labels: &LabelImage, options: &MeshOptions, context: &RunContext) -> Result<MixedMesh> {
    match options.method {
        MeshMethod::Cbc3d => cbc3d(labels, options, context),
        MeshMethod::Delaunay => delaunay(labels, options.delaunay_delta, context),
        MeshMethod::LatticeDecimation => {
            let settings = [("fidelity", Value::Real(HIGH_FIDELITY)), ("smoothing-iterations", Value::Integer(0))];
            lattice(labels, options.delaunay_delta, &settings, &[], context)
        }
        MeshMethod::StructuredHexahedra => {
            Err(Error::Internal { reason: "structured hexahedra are made by the registration".into() })
        }
    }
}

fn cbc3d(labels: &LabelImage, options: &MeshOptions, context: &RunContext) -> Result<MixedMesh> {
    // The mesh carries displacements: its boundary need not be better than the fidelity asks for.
    let settings = [
        ("surface-tolerance", Value::Real(UNBOUNDED_TOLERANCE)),
        ("fidelity", Value::Real(options.fidelity)),
        ("smoothing-iterations", Value::Integer(options.smoothing_iterations as i64)),
    ];
    lattice(labels, options.lattice_spacing, &settings, &options.label_fidelities, context)
}

fn lattice(
    labels: &LabelImage,
    spacing: f64,
    settings: &[(&str, Value)],
    fidelities: &[(i64, f64)],
    context: &RunContext,
) -> Result<MixedMesh> {
    let mut parameters = ParameterSet::new(image_to_mesh::PARAMETERS);
    parameters.set("lattice-spacing", Value::Real(spacing))?;
    for (name, value) in settings {
        parameters.set(name, value.clone())?;
    }
    for (label, fidelity) in fidelities {
        parameters.set_for_label("fidelity", *label, Value::Real(*fidelity))?;
    }
    let input = image_to_mesh::Input { labels, fixed_points: &[] };
    let mesh = image_to_mesh::run(&input, &parameters, context)?.mesh;
    mesh.ok_or_else(|| Error::Internal { reason: "the lattice engine made no mesh".into() })
}

fn delaunay(labels: &LabelImage, size: f64, context: &RunContext) -> Result<MixedMesh> {
    let settings = [
        ("surface-tolerance", Value::Real(UNBOUNDED_TOLERANCE)),
        ("min-element-size", Value::Real(LEAST_SHARE * size)),
        ("smoothing-iterations", Value::Integer(SMOOTHING)),
    ];
    let coarse = lattice(labels, size, &settings, &[], context)?;
    let boundary = extract_boundary(&coarse);
    let mut parameters = ParameterSet::new(surface_to_mesh::PARAMETERS);
    // One thread: speculative reconnection would make the mesh depend on their number.
    parameters.set("refinement-threads", Value::Integer(1))?;
    parameters.set("quality-threads", Value::Integer(1))?;
    parameters.set("size-limit", Value::Real(size))?;
    let surface = used_surface(&coarse.points, &boundary.triangles)?;
    let input = surface_to_mesh::Input { surface: &surface, sizing: None };
    // A context of its own: the notes about edges where several labels meet are no news to the caller.
    let inner = RunContext::new(context.pool(), context.cancel_token());
    let mesh = surface_to_mesh::run(&input, &parameters, &inner)?.mesh;
    let mesh = mesh.ok_or_else(|| Error::Internal { reason: "the surface engine made no mesh".into() })?;
    labelled(&mesh, labels)
}

/// The triangles with the points that they use.
fn used_surface(points: &[DVec3], triangles: &[[VertexId; 3]]) -> Result<SurfaceMesh> {
    let mut id_of = vec![VertexId::NONE; points.len()];
    let (mut used, mut facets) = (Vec::new(), Vec::with_capacity(triangles.len()));
    for triangle in triangles {
        for vertex in triangle {
            if id_of[vertex.index()] == VertexId::NONE {
                id_of[vertex.index()] = VertexId::try_new(used.len())?;
                used.push(points[vertex.index()]);
            }
        }
        facets.push(triangle.map(|vertex| id_of[vertex.index()]));
    }
    Ok(SurfaceMesh::new(used, facets))
}

/// The tets of the regions that lie in a label, with the label's value.
fn labelled(mesh: &MixedMesh, labels: &LabelImage) -> Result<MixedMesh> {
    let tets = mesh.tets()?;
    let regions = mesh.labels.iter().copied().max().unwrap_or(0).max(0) as usize + 1;
    let mut votes = vec![vec![0u32; labels.label_count()]; regions];
    for (tet, region) in tets.iter().zip(&mesh.labels) {
        let middle = tet.iter().map(|v| mesh.points[v.index()]).sum::<DVec3>() * 0.25;
        let at = nearest_offset(labels.grid().size(), labels.grid().world_to_index(middle));
        let label = at.map_or(Label::BACKGROUND, |at| labels.voxels()[at]);
        votes[*region as usize][label.index()] += 1;
    }
    // The smaller label wins a tie.
    let winner = |votes: &Vec<u32>| (0..votes.len()).max_by_key(|&l| (votes[l], std::cmp::Reverse(l))).unwrap_or(0);
    let value_of: Vec<i32> = votes.iter().map(|v| labels.values()[winner(v)]).collect();
    let is_kept = |region: &i32| winner(&votes[*region as usize]) != 0;
    let mut id_of = vec![VertexId::NONE; mesh.points.len()];
    let (mut points, mut kept, mut values) = (Vec::new(), Vec::new(), Vec::new());
    for (tet, region) in tets.iter().zip(&mesh.labels).filter(|(_, region)| is_kept(region)) {
        for vertex in tet {
            if id_of[vertex.index()] == VertexId::NONE {
                id_of[vertex.index()] = VertexId::try_new(points.len())?;
                points.push(mesh.points[vertex.index()]);
            }
        }
        kept.push(tet.map(|vertex| id_of[vertex.index()]));
        values.push(value_of[*region as usize]);
    }
    MixedMesh::from_tets(points, &kept, values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use crate::image::voxel_image::{VoxelData, VoxelImage};
    use crate::mesh::quality::mesh_quality;
    use crate::registration::options::Options;
    use glam::DMat3;

    const SIZE: usize = 44;

    /// A ball of label 1 about a ball of label 4, with an empty bubble beside it; anisotropic and left-handed.
    fn two_balls() -> LabelImage {
        let direction = DMat3::from_rotation_z(0.3) * DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0));
        let grid = Grid::new([SIZE; 3], DVec3::new(1.0, 1.1, 0.9), DVec3::new(9.0, -4.0, 30.0), direction).unwrap();
        let middle = DVec3::splat(0.5 * (SIZE as f64 - 1.0)) * grid.spacing();
        let voxels = (0..SIZE.pow(3))
            .map(|at| {
                let index = [at % SIZE, at / SIZE % SIZE, at / (SIZE * SIZE)].map(|x| x as f64);
                let place = DVec3::from_array(index) * grid.spacing() - middle;
                let in_bubble = (place - DVec3::new(-11.0, 0.0, 0.0)).length() < 5.0;
                match place.length() {
                    _ if in_bubble => 0,
                    r if r < 6.0 => 4u8,
                    r => u8::from(r < 19.0),
                }
            })
            .collect();
        VoxelImage::new(grid, 1, VoxelData::U8(voxels)).unwrap().to_label_image().unwrap()
    }

    fn volumes(mesh: &MixedMesh) -> [f64; 2] {
        let mut sums = [0.0; 2];
        for (tet, label) in mesh.tets().unwrap().iter().zip(&mesh.labels) {
            let [a, b, c, d] = tet.map(|v| mesh.points[v.index()]);
            assert!([1, 4].contains(label));
            sums[usize::from(*label == 4)] += (b - a).cross(c - a).dot(d - a) / 6.0;
        }
        sums
    }

    #[test]
    fn every_method_fills_the_labels_and_its_size_acts() {
        let labels = two_balls();
        let wanted = [1u16, 2].map(|label| {
            let count = labels.voxels().iter().filter(|l| l.0 == label).count();
            count as f64 * labels.grid().spacing().element_product()
        });
        for method in [MeshMethod::Cbc3d, MeshMethod::Delaunay, MeshMethod::LatticeDecimation] {
            // Boundaries of `ld` end where halving its size reaches the fidelity: sizes of one series compare the inside, which has
            // room for larger elements than 1.5 mm only.
            let sizes = if matches!(method, MeshMethod::LatticeDecimation) { [6.0, 1.5] } else { [5.0, 3.0] };
            let counts = sizes.map(|size| {
                let defaults = Options::default().mesh;
                let options = MeshOptions { method, delaunay_delta: size, lattice_spacing: size, ..defaults };
                let meshes = [1, 2].map(|threads| {
                    mesh_of_labels(&labels, &options, &RunContext::with_threads(threads).unwrap()).unwrap()
                });
                assert!(meshes[0] == meshes[1], "{method:?} depends on the threads");
                let [mesh, _] = meshes;
                for (found, wanted) in volumes(&mesh).iter().zip(wanted) {
                    assert!((found / wanted - 1.0).abs() < 0.2, "{method:?} {size}: {found} of {wanted}");
                }
                let quality = mesh_quality(&mesh, &RunContext::with_threads(1).unwrap()).unwrap();
                assert!(quality.min_scaled_jacobian > 0.02, "{method:?} {size}: {}", quality.min_scaled_jacobian);
                mesh.element_count()
            });
            assert!(counts[1] > counts[0] + counts[0] / 5, "{method:?} {counts:?}");
        }
    }
}
