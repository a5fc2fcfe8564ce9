//! How well a mesh stands for what it was made from: its image, or its surface.
//!
//! # Method
//! Against an image: every voxel centre gets the label of the element that holds it (the first one on a shared face);
//! per label, F1 is the share of the label's voxels that the mesh gives that label, F2 the share of the mesh's voxels
//! of the label that the image gives it, `dice` their harmonic mean. Volumes, and distances between the surfaces, are those of
//! [`lattice::evaluation`](crate::lattice::evaluation).
//! Against a surface: how many of its points are vertices bit for bit, how many of its triangles are faces, and how many
//! other points lie on the mesh's boundary.
//!
//! # Cost
//! Elements in parallel over their bounding boxes; one byte-sized lookup per voxel.

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use crate::context::RunContext;
use crate::error::Result;
use crate::image::label_image::LabelImage;
use crate::lattice::evaluation::{evaluate_fidelity, evaluate_volume};
use crate::mesh::boundary::{element_volume, extract_boundary, faces_of};
use crate::mesh::mixed_mesh::MixedMesh;
use crate::mesh::surface_mesh::SurfaceMesh;
use crate::statistics::Statistics;

/// Elements that are painted between two looks at the cancellation flag.
const CHUNK: usize = 4096;

/// Elements and volume per label, as `label.N.elements` and `label.N.volume` [mm^3].
pub fn label_figures(mesh: &MixedMesh) -> Statistics {
    let mut labels = std::collections::BTreeMap::new();
    for element in 0..mesh.element_count() {
        let entry = labels.entry(mesh.labels[element]).or_insert((0u64, 0.0f64));
        entry.0 += 1;
        entry.1 += element_volume(mesh, element);
    }
    let mut figures = Statistics::default();
    for (label, (count, volume)) in labels {
        figures.set(format!("label.{label}.elements"), count as f64);
        figures.set(format!("label.{label}.volume"), volume);
    }
    figures
}

/// Compares a mesh (LPS) with the segmentation it was made from. Figures are named `label.N.f1`, `.f2`, `.dice`, `fidelity.min_f1`,
/// `.min_f2`, `.foreign_voxels` (where the mesh has a label that the image has not), and as [`evaluate_volume`] and
/// [`evaluate_fidelity`] do.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn compare_with_image(mesh: &MixedMesh, image: &LabelImage, context: &RunContext) -> Result<Statistics> {
    let painted = paint(mesh, image, context)?;
    // Per compact label: voxels of the image, of the mesh, of both.
    let mut counts = vec![[0u64; 3]; image.label_count()];
    let mut foreign = 0u64;
    for (voxel, label) in image.voxels().iter().enumerate() {
        counts[label.index()][0] += 1;
        match painted[voxel].map_or(Some(crate::index::Label::BACKGROUND), |v| image.label_of(i64::from(v))) {
            Some(in_mesh) => {
                counts[in_mesh.index()][1] += 1;
                counts[label.index()][2] += u64::from(in_mesh == *label);
            }
            None => foreign += 1,
        }
    }
    let boundary = extract_boundary(mesh);
    let mut figures = evaluate_volume(mesh, &boundary, image);
    figures.extend(&evaluate_fidelity(mesh, &boundary, image, context)?);
    let mut worst = (1.0f64, 1.0f64);
    for (label, [in_image, in_mesh, both]) in counts.iter().enumerate().skip(1) {
        let value = image.values()[label];
        let share = |whole: u64| if whole == 0 { 0.0 } else { *both as f64 / whole as f64 };
        let (f1, f2) = (share(*in_image), share(*in_mesh));
        worst = (worst.0.min(f1), worst.1.min(f2));
        figures.set(format!("label.{value}.f1"), f1);
        figures.set(format!("label.{value}.f2"), f2);
        figures.set(format!("label.{value}.dice"), 2.0 * *both as f64 / (in_image + in_mesh).max(1) as f64);
    }
    figures.set("fidelity.min_f1", worst.0);
    figures.set("fidelity.min_f2", worst.1);
    figures.set("fidelity.foreign_voxels", foreign as f64);
    Ok(figures)
}

/// The caller's label of the element at each voxel centre.
fn paint(mesh: &MixedMesh, image: &LabelImage, context: &RunContext) -> Result<Vec<Option<i32>>> {
    let grid = image.grid();
    let index_points: Vec<DVec3> = mesh.points.iter().map(|&p| grid.world_to_index(p)).collect();
    let starts: Vec<usize> = (0..mesh.element_count()).step_by(CHUNK).collect();
    let covered: Vec<Vec<(usize, i32)>> = context.install(|| {
        starts
            .par_iter()
            .map(|&begin| {
                context.check()?;
                let mut voxels = Vec::new();
                for element in begin..(begin + CHUNK).min(mesh.element_count()) {
                    voxels_inside(mesh, element, &index_points, image, &mut voxels);
                }
                Ok(voxels)
            })
            .collect::<Result<_>>()
    })?;
    let mut painted = vec![None; image.voxels().len()];
    for (voxel, label) in covered.into_iter().flatten() {
        // A centre on a shared face belongs to the element of the smaller number.
        painted[voxel].get_or_insert(label);
    }
    Ok(painted)
}

/// Adds the voxels whose centre lies in an element, by the planes of its faces.
fn voxels_inside(
    mesh: &MixedMesh,
    element: usize,
    points: &[DVec3],
    image: &LabelImage,
    voxels: &mut Vec<(usize, i32)>,
) {
    let (kind, vertices) = mesh.element(element);
    let corners = &vertices[..kind.corner_count()];
    let at = |corner: usize| points[corners[corner].index()];
    let low = corners.iter().map(|v| points[v.index()]).fold(DVec3::INFINITY, DVec3::min);
    let high = corners.iter().map(|v| points[v.index()]).fold(DVec3::NEG_INFINITY, DVec3::max);
    let size = image.grid().size();
    let range = |axis: usize| {
        let first = low[axis].ceil().max(0.0) as usize;
        let last = high[axis].floor().min(size[axis] as f64 - 1.0);
        first..if last < 0.0 { 0 } else { last as usize + 1 }
    };
    let center = corners.iter().map(|v| points[v.index()]).sum::<DVec3>() / corners.len() as f64;
    let planes: Vec<(DVec3, DVec3)> = faces_of(kind)
        .iter()
        .map(|face| {
            let normal = (at(face[1]) - at(face[0])).cross(at(face[2]) - at(face[0]));
            // In a mirrored grid the faces turn over.
            (at(face[0]), if normal.dot(center - at(face[0])) > 0.0 { -normal } else { normal })
        })
        .collect();
    for k in range(2) {
        for j in range(1) {
            for i in range(0) {
                let p = DVec3::new(i as f64, j as f64, k as f64);
                if planes.iter().all(|(a, normal)| (p - *a).dot(*normal) <= 0.0) {
                    voxels.push((image.grid().offset(i, j, k), mesh.labels[element]));
                }
            }
        }
    }
}

/// Compares a mesh with the surface it was made from.
pub fn compare_with_surface(mesh: &MixedMesh, surface: &SurfaceMesh) -> Statistics {
    let bits = |p: DVec3| (p + DVec3::ZERO).to_array().map(f64::to_bits);
    let numbers: FxHashMap<[u64; 3], u32> = mesh.points.iter().enumerate().map(|(i, &p)| (bits(p), i as u32)).collect();
    let used: FxHashSet<u32> = surface.facets.iter().flatten().map(|v| v.0).collect();
    let kept = used.iter().filter(|&&v| numbers.contains_key(&bits(surface.points[v as usize]))).count();
    let mut faces: FxHashSet<[u32; 3]> = FxHashSet::default();
    for element in 0..mesh.element_count() {
        let (kind, vertices) = mesh.element(element);
        for face in faces_of(kind).iter().filter(|f| f.len() == 3) {
            let mut key = [vertices[face[0]].0, vertices[face[1]].0, vertices[face[2]].0];
            key.sort_unstable();
            faces.insert(key);
        }
    }
    let is_face = |facet: &[crate::index::VertexId; 3]| {
        let mut key = [0; 3];
        for (slot, vertex) in key.iter_mut().zip(facet) {
            match numbers.get(&bits(surface.points[vertex.index()])) {
                Some(&number) => *slot = number,
                None => return false,
            }
        }
        key.sort_unstable();
        faces.contains(&key)
    };
    let found = surface.facets.iter().filter(|f| is_face(f)).count();
    let boundary = extract_boundary(mesh);
    let surface_points: FxHashSet<[u64; 3]> = used.iter().map(|&v| bits(surface.points[v as usize])).collect();
    let added: FxHashSet<u32> = boundary
        .triangles
        .iter()
        .flatten()
        .filter(|v| !surface_points.contains(&bits(mesh.points[v.index()])))
        .map(|v| v.0)
        .collect();
    let mut figures = Statistics::default();
    figures.set("surface.points", used.len() as f64);
    figures.set("surface.points_kept", kept as f64);
    figures.set("surface.triangles", surface.facets.len() as f64);
    figures.set("surface.triangles_kept", found as f64);
    figures.set("surface.points_added_on_boundary", added.len() as f64);
    figures.set("mesh.volume", (0..mesh.element_count()).map(|e| element_volume(mesh, e)).sum());
    figures
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use crate::index::{Label, VertexId};
    use glam::DMat3;

    /// A cube from -0.5 to 3.5 in each index direction as one hexahedron of label 5, over a mirrored grid.
    fn cube_and_image() -> (MixedMesh, LabelImage) {
        let direction = DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0));
        let grid = Grid::new([4, 4, 5], DVec3::new(1.0, 2.0, 0.5), DVec3::new(7.0, 0.0, 1.0), direction).unwrap();
        let corner = |(x, y, z): (f64, f64, f64)| grid.index_to_world(DVec3::new(x, y, z));
        let (l, h) = (-0.5, 3.5);
        // Mirrored: the order of the base turns round, so that the element is positive in the world.
        let base = [(l, l, l), (l, h, l), (h, h, l), (h, l, l)];
        let top = base.map(|(x, y, _)| (x, y, h));
        let mesh = MixedMesh {
            points: base.into_iter().chain(top).map(corner).collect(),
            types: vec![12],
            offsets: vec![0, 8],
            connectivity: (0..8).map(VertexId).collect(),
            labels: vec![5],
            ..MixedMesh::default()
        };
        (mesh, LabelImage::new(grid, vec![Label(1); 80], vec![0, 5]).unwrap())
    }

    #[test]
    fn shares_of_voxels_are_counted_in_a_mirrored_grid() {
        let (mesh, image) = cube_and_image();
        let context = RunContext::with_threads(2).unwrap();
        let figures = compare_with_image(&mesh, &image, &context).unwrap();
        assert_eq!(figures.value("label.5.f1"), Some(0.8));
        assert_eq!(figures.value("label.5.f2"), Some(1.0));
        assert!((figures.value("label.5.volume_error").unwrap() + 20.0).abs() < 1e-10);
        assert!((figures.value("mesh.enclosed_volume").unwrap() - 64.0).abs() < 1e-12);
        assert!((element_volume(&mesh, 0) - 64.0).abs() < 1e-12);
        // From a voxel in the middle of the first or the last slice to the nearest corner of the cube.
        let hausdorff = figures.value("label.5.hausdorff").unwrap();
        assert!((hausdorff - DVec3::new(1.5, 3.0, 0.25).length()).abs() < 1e-12, "{hausdorff}");
        assert_eq!(figures.value("fidelity.hausdorff"), Some(hausdorff));
        let mean = figures.value("label.5.mean_distance").unwrap();
        assert!(mean > 0.0 && mean < 0.25, "{mean}");
    }

    #[test]
    fn points_without_a_place_have_no_distance() {
        let (mut mesh, image) = cube_and_image();
        let context = RunContext::with_threads(1).unwrap();
        let hausdorff =
            |mesh: &MixedMesh| compare_with_image(mesh, &image, &context).unwrap().value("label.5.hausdorff").unwrap();
        let whole = hausdorff(&mesh);
        mesh.points[6].x = f64::NAN;
        let rest = hausdorff(&mesh);
        assert!(rest.is_finite() && rest >= whole, "{rest} {whole}");
        mesh.points.fill(DVec3::splat(f64::INFINITY));
        assert_eq!(hausdorff(&mesh), f64::INFINITY);
    }

    #[test]
    fn a_kept_surface_is_recognised() {
        let points = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
        let mesh = MixedMesh::from_tets(points.clone(), &[[0, 1, 2, 3].map(VertexId)], vec![1]).unwrap();
        let facets = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]].map(|f| f.map(VertexId)).to_vec();
        let figures = compare_with_surface(&mesh, &SurfaceMesh::new(points, facets));
        assert_eq!(figures.value("surface.triangles_kept"), Some(4.0));
        assert_eq!(figures.value("surface.points_kept"), Some(4.0));
        assert_eq!(figures.value("surface.points_added_on_boundary"), Some(0.0));
        assert!((figures.value("mesh.volume").unwrap() - 1.0 / 6.0).abs() < 1e-15);
    }
}
