//! `meshwright quality MESH`: angles, shapes, volumes per label; with an image or a surface also the distance to it.

use std::ops::ControlFlow;
use std::path::Path;

use clap::ArgMatches;
use meshwright::context::RunContext;
use meshwright::mesh::quality::mesh_quality;
use meshwright::mesh::validation::check_mixed_mesh;
use meshwright::pipeline::evaluation;
use meshwright::statistics::Statistics;
use meshwright::{Error, Result, io};
use serde_json::{Value, json};

use crate::{arguments, file_names, job_inputs, report};

/// Prints the figures.
///
/// # Errors
/// Those of the readers.
pub fn run(matches: &ArgMatches) -> Result<()> {
    file_names::refuse_clashes_of(matches, &["mesh", "image", "surface"], &["json"])?;
    let path = arguments::path(matches, "mesh").expect("clap requires the mesh");
    let mesh = job_inputs::lps_mesh(path)?;
    if mesh.element_count() == 0 {
        return Err(Error::input(format!("{}: the file has no volume element", path.display())));
    }
    let context = RunContext::with_threads(arguments::threads(matches))?;
    let mut figures = Statistics::default();
    figures.set("mesh.points", mesh.points.len() as f64);
    figures.set("mesh.elements", mesh.element_count() as f64);
    figures.extend(&mesh_quality(&mesh, &context)?.statistics());
    figures.extend(&evaluation::label_figures(&mesh));
    if let Some(image) = arguments::path(matches, "image") {
        let labels = job_inputs::read_labels(&image.to_string_lossy())?;
        let compared = context
            .run(|_, _| ControlFlow::Continue(()), |context| evaluation::compare_with_image(&mesh, &labels, context))?;
        figures.extend(&compared);
    }
    if let Some(surface) = arguments::path(matches, "surface") {
        let surface = io::read_surface(surface)?;
        figures.extend(&context.install(|| evaluation::compare_with_surface(&mesh, &surface)));
    }
    let fault = context.install(|| check_mixed_mesh(&mesh)).err().map(|violation| violation.to_string());
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
