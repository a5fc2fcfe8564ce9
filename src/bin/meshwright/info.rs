//! `meshwright info FILE`: geometry, labels and counts of an image, a mesh or a surface.

use std::path::Path;

use clap::ArgMatches;
use meshwright::image::voxel_image::VoxelImage;
use meshwright::{Result, io, with_voxels};
use serde_json::{Map, Value, json};

use crate::{arguments, report};

/// Different values up to which an image's values are listed as labels.
const LISTED_LABELS: usize = 4096;

/// Prints the description of a file.
///
/// # Errors
/// Those of the reader.
pub fn run(matches: &ArgMatches) -> Result<()> {
    let path = arguments::path(matches, "file").expect("clap requires the file");
    let description = describe(path)?;
    match arguments::path(matches, "json") {
        Some(target) => report::write_json(&Value::Object(description), target),
        None => report::print(&as_lines(&description, "")),
    }
}

fn describe(path: &Path) -> Result<Map<String, Value>> {
    Ok(describe_image(&io::read_image(path)?))
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
        let mut counts = vec![0u64; labels.label_count()];
        labels.voxels().iter().for_each(|l| counts[l.index()] += 1);
        let volume = grid.spacing().element_product() * grid.direction().determinant().abs();
        object.insert("voxel_volume".into(), json!(volume));
        let counted = labels.values().iter().zip(counts).map(|(value, n)| (value.to_string(), json!(n))).collect();
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
