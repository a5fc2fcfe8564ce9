//! `meshwright check SURFACE`: everything that keeps a surface from being meshed.

use std::path::Path;

use clap::ArgMatches;
use meshwright::conforming::{fault_picture, input_check, options::Options, options::PARAMETERS};
use meshwright::context::RunContext;
use meshwright::error::Severity;
use meshwright::parameters::ParameterSet;
use meshwright::{Error, Finding, FindingCode, Result, io};
use serde_json::json;

use crate::{arguments, file_names, report};

/// Prints the findings; a surface with errors ends with the exit code of invalid input.
///
/// # Errors
/// Those of the reader; [`Error::InvalidInput`] for a surface with errors.
pub fn run(matches: &ArgMatches) -> Result<()> {
    file_names::refuse_clashes_of(matches, &["surface"], &["picture", "json"])?;
    let path = arguments::path(matches, "surface").expect("clap requires the surface");
    let json = arguments::path(matches, "json");
    let surface = match io::read_surface(path) {
        Ok(surface) => surface,
        Err(error) => {
            // What the reader found is a finding too.
            let mut findings = error.findings().to_vec();
            if findings.is_empty() && matches!(error, Error::Format { .. } | Error::InvalidInput { .. }) {
                findings.push(Finding::new(FindingCode::Other, Severity::Error, error.to_string()));
            }
            if let Some(target) = json {
                write_findings(&findings, 0, 0, target)?;
            }
            return Err(error);
        }
    };
    let context = RunContext::with_threads(arguments::threads(matches))?;
    let options = Options::from_parameters(&ParameterSet::new(PARAMETERS))?;
    let checked = context
        .run(|_, _| std::ops::ControlFlow::Continue(()), |context| input_check::check(&surface, &options, context))?;
    let findings = checked.findings.clone();
    if let Some(target) = json {
        write_findings(&findings, surface.points.len(), surface.facets.len(), target)?;
    }
    if let Some(target) = arguments::path(matches, "picture") {
        let picture = fault_picture::to_vtp(&surface, &findings);
        io::write_atomically(target, |out| out.write_all(picture.as_bytes()))?;
    }
    if checked.has_errors() {
        let errors = findings.iter().filter(|f| f.severity == Severity::Error).count();
        let message = format!("{}: {errors} errors keep the surface from being meshed", path.display());
        return Err(Error::InvalidInput { message, findings });
    }
    report::show_findings(&findings);
    if json.is_none_or(|p| p != Path::new("-")) {
        let (points, facets) = (surface.points.len(), surface.facets.len());
        report::print(&format!("{}: {points} points, {facets} triangles, no error\n", path.display()))?;
    }
    Ok(())
}

fn write_findings(findings: &[Finding], points: usize, facets: usize, target: &Path) -> Result<()> {
    let errors = findings.iter().filter(|f| f.severity == Severity::Error).count();
    let value = json!({
        "valid": errors == 0,
        "points": points,
        "triangles": facets,
        "errors": errors,
        "findings": report::findings_json(findings),
    });
    report::write_json(&value, target)
}
