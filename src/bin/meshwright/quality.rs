//! `meshwright quality MESH`: angles, shapes, volumes per label; with an image or a surface also the distance to it.

use std::path::Path;

use clap::ArgMatches;
use glam::DVec3;
use meshwright::context::RunContext;
use meshwright::mesh::boundary::faces_of;
use meshwright::mesh::mixed_mesh::MixedMesh;
use meshwright::mesh::quality::mesh_quality;
use meshwright::mesh::validation::check_mixed_mesh;
use meshwright::statistics::Statistics;
use meshwright::{Error, Result};
use serde_json::{Value, json};

use crate::{arguments, job_inputs, report};

/// Prints the figures.
///
/// # Errors
/// Those of the readers.
pub fn run(matches: &ArgMatches) -> Result<()> {
    let path = arguments::path(matches, "mesh").expect("clap requires the mesh");
    let mesh = job_inputs::lps_mesh(path)?;
    if mesh.element_count() == 0 {
        return Err(Error::input(format!("{}: the file has no volume element", path.display())));
    }
    let context = RunContext::with_threads(arguments::threads(matches))?;
    let mut figures = Statistics::default();
    figures.set("mesh.points", mesh.points.len() as f64);
    figures.set("mesh.elements", mesh.element_count() as f64);
    figures.extend(&mesh_quality(&mesh, &context).statistics());
    add_label_figures(&mesh, &mut figures);
    let fault = check_mixed_mesh(&mesh).err().map(|violation| violation.to_string());
    match arguments::path(matches, "json") {
        Some(target) => {
            let value = json!({
                "file": path.display().to_string(),
                "valid": fault.is_none(),
                "fault": fault,
                "statistics": report::nested(figures.entries()),
            });
            report::write_json(&value, target)
        }
        None => report::print(&as_text(path, &figures, fault.as_deref())),
    }
}

/// Elements and volume per label.
fn add_label_figures(mesh: &MixedMesh, figures: &mut Statistics) {
    let mut labels = std::collections::BTreeMap::new();
    for element in 0..mesh.element_count() {
        let entry = labels.entry(mesh.labels[element]).or_insert((0u64, 0.0f64));
        entry.0 += 1;
        entry.1 += element_volume(mesh, element);
    }
    for (label, (count, volume)) in labels {
        figures.set(format!("label.{label}.elements"), count as f64);
        figures.set(format!("label.{label}.volume"), volume);
    }
}

/// Volume of an element: the cones from its first corner over its faces, a quadrilateral as the mean of its two cuts.
fn element_volume(mesh: &MixedMesh, element: usize) -> f64 {
    let (kind, vertices) = mesh.element(element);
    let apex = mesh.points[vertices[0].index()];
    let cone = |a: DVec3, b: DVec3, c: DVec3| (a - apex).dot((b - apex).cross(c - apex)) / 6.0;
    let at = |corner: usize| mesh.points[vertices[corner].index()];
    faces_of(kind)
        .iter()
        .map(|face| match **face {
            [a, b, c] => cone(at(a), at(b), at(c)),
            [a, b, c, d] => {
                let cut = cone(at(a), at(b), at(c)) + cone(at(a), at(c), at(d));
                let other = cone(at(b), at(c), at(d)) + cone(at(b), at(d), at(a));
                (cut + other) / 2.0
            }
            _ => 0.0,
        })
        .sum()
}

fn as_text(path: &Path, figures: &Statistics, fault: Option<&str>) -> String {
    let mut text = format!("{}\n", path.display());
    match fault {
        None => text.push_str("valid: yes\n"),
        Some(fault) => text.push_str(&format!("valid: no, {fault}\n")),
    }
    let bins: Vec<f64> = (0..36).filter_map(|bin| figures.value(&format!("histogram.dihedral.{bin}"))).collect();
    for (name, value) in figures.entries().iter().filter(|(name, _)| !name.starts_with("histogram.")) {
        let shown = match report::number(*value) {
            Value::Number(number) => number.to_string(),
            _ => value.to_string(),
        };
        text.push_str(&format!("{name}: {shown}\n"));
    }
    if !bins.is_empty() {
        let most = bins.iter().copied().fold(1.0, f64::max);
        text.push_str("dihedral angles, degrees\n");
        for (bin, count) in bins.iter().enumerate() {
            // The longest bar has 50 signs.
            let bar = "#".repeat((count / most * 50.0).ceil() as usize);
            text.push_str(&format!("{:>3} to {:>3} {count:>10} {bar}\n", 5 * bin, 5 * bin + 5));
        }
    }
    text
}
