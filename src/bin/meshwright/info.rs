//! `meshwright info FILE`: geometry, labels and counts of an image, a mesh or a surface.

use std::path::Path;

use clap::ArgMatches;
use glam::DVec3;
use meshwright::image::voxel_image::VoxelImage;
use meshwright::mesh::mixed_mesh::{ElementKind, MixedMesh, NamedArray, Space};
use meshwright::mesh::surface_mesh::SurfaceMesh;
use meshwright::{Result, io, with_voxels};
use serde_json::{Map, Value, json};

use crate::{arguments, file_names, report};

/// Different values up to which an image's values are listed as labels.
const LISTED_LABELS: usize = 4096;

/// Prints the description of a file.
///
/// # Errors
/// Those of the reader.
pub fn run(matches: &ArgMatches) -> Result<()> {
    file_names::refuse_clashes_of(matches, &["file"], &["json"])?;
    let path = arguments::path(matches, "file").expect("clap requires the file");
    let description = describe(path)?;
    match arguments::path(matches, "json") {
        Some(target) => report::write_json(&Value::Object(description), target),
        None => report::print(&as_lines(&description, "")),
    }
}

fn describe(path: &Path) -> Result<Map<String, Value>> {
    if !io::is_mesh_path(path) {
        return Ok(describe_image(&io::read_image(path)?));
    }
    Ok(match io::read_content(path)? {
        io::Content::Mesh(mesh) => describe_mesh(&mesh),
        io::Content::Surface(surface, space) => describe_surface(&surface, space),
    })
}

fn space_name(space: Space) -> &'static str {
    match space {
        Space::Lps => "LPS",
        Space::Ras => "RAS",
        Space::Unspecified => "unspecified",
    }
}

/// Counts of values, sorted by value.
fn counted(values: impl Iterator<Item = i32>) -> Value {
    let mut counts = std::collections::BTreeMap::new();
    values.for_each(|v| *counts.entry(v).or_insert(0u64) += 1);
    Value::Object(counts.into_iter().map(|(v, n)| (v.to_string(), json!(n))).collect())
}

fn bounds(points: &[DVec3]) -> Value {
    let low = points.iter().copied().fold(DVec3::INFINITY, DVec3::min);
    let high = points.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
    if points.is_empty() { Value::Null } else { json!([low.to_array(), high.to_array()]) }
}

fn describe_mesh(mesh: &MixedMesh) -> Map<String, Value> {
    let mut object = Map::new();
    object.insert("kind".into(), json!("mesh"));
    object.insert("space".into(), json!(space_name(mesh.space)));
    object.insert("points".into(), json!(mesh.points.len()));
    object.insert("elements".into(), json!(mesh.element_count()));
    let kinds = [
        ("tets", ElementKind::Tet),
        ("pyramids", ElementKind::Pyramid),
        ("wedges", ElementKind::Wedge),
        ("hexahedra", ElementKind::Hexahedron),
        ("quadratic_tets", ElementKind::QuadraticTet),
        ("quadratic_hexahedra", ElementKind::QuadraticHexahedron),
    ];
    for (name, kind) in kinds {
        let count = mesh.types.iter().filter(|&&t| t == kind.vtk_type()).count();
        if count > 0 {
            object.insert(name.into(), json!(count));
        }
    }
    object.insert("bounds".into(), bounds(&mesh.points));
    object.insert("labels".into(), counted(mesh.labels.iter().copied()));
    object.insert("boundary_triangles".into(), json!(mesh.boundary.triangles.len()));
    object.insert("boundary_quads".into(), json!(mesh.boundary.quads.len()));
    let names = |arrays: &[NamedArray]| json!(arrays.iter().map(|a| a.name.clone()).collect::<Vec<_>>());
    object.insert("point_arrays".into(), names(&mesh.point_data));
    object.insert("element_arrays".into(), names(&mesh.element_data));
    object
}

fn describe_surface(surface: &SurfaceMesh, space: Space) -> Map<String, Value> {
    let mut object = Map::new();
    object.insert("kind".into(), json!("surface"));
    object.insert("space".into(), json!(space_name(space)));
    object.insert("points".into(), json!(surface.points.len()));
    object.insert("triangles".into(), json!(surface.facets.len()));
    object.insert("bounds".into(), bounds(&surface.points));
    object.insert("patches".into(), counted(surface.facet_patches.iter().copied()));
    object.insert("regions".into(), json!(surface.regions.len()));
    object.insert("holes".into(), json!(surface.holes.len()));
    object
}

/// `name: value` lines; nested groups are indented.
fn as_lines(object: &Map<String, Value>, indent: &str) -> String {
    let mut text = String::new();
    for (name, value) in object {
        match value {
            Value::Object(inner) => {
                text.push_str(&format!("{indent}{name}:\n{}", as_lines(inner, &format!("{indent}  "))));
            }
            Value::String(plain) => text.push_str(&format!("{indent}{name}: {plain}\n")),
            other => text.push_str(&format!("{indent}{name}: {other}\n")),
        }
    }
    text
}

fn describe_image(image: &VoxelImage) -> Map<String, Value> {
    let grid = &image.grid;
    let rows = |matrix: glam::DMat3| {
        let t = matrix.transpose();
        json!([t.x_axis.to_array(), t.y_axis.to_array(), t.z_axis.to_array()])
    };
    let mut object = Map::new();
    object.insert("kind".into(), json!("image"));
    object.insert("size".into(), json!(grid.size()));
    object.insert("spacing".into(), json!(grid.spacing().to_array()));
    object.insert("origin".into(), json!(grid.origin().to_array()));
    object.insert("direction".into(), rows(grid.direction()));
    object.insert("space".into(), json!("LPS"));
    object.insert("handedness".into(), json!(if grid.is_right_handed() { "right" } else { "left" }));
    object.insert("type".into(), json!(image.data.type_name()));
    object.insert("components".into(), json!(image.components));
    let (low, high) = value_range(image);
    object.insert("minimum".into(), report::number(low));
    object.insert("maximum".into(), report::number(high));
    if image.components == 1
        && let Ok(labels) = image.to_label_image()
        && labels.label_count() <= LISTED_LABELS
    {
        let volume = grid.spacing().element_product() * grid.direction().determinant().abs();
        object.insert("voxel_volume".into(), json!(volume));
        let counted =
            labels.values().iter().zip(labels.voxel_counts()).map(|(value, n)| (value.to_string(), json!(n))).collect();
        object.insert("labels".into(), Value::Object(counted));
    }
    object
}

fn value_range(image: &VoxelImage) -> (f64, f64) {
    use meshwright::image::voxel_image::VoxelValue;
    with_voxels!(&image.data, values => values.iter().map(|v| v.to_f64()).fold(
        (f64::INFINITY, f64::NEG_INFINITY),
        |(low, high), v| (low.min(v), high.max(v)),
    ))
}
