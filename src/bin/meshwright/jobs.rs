//! The three jobs: reads the inputs, runs the pipeline, writes what was asked for.
//!
//! # Method
//! 1. Values from the command line, checked against the table; the places of all outputs are looked at first, so that
//!    a long run does not end at a missing folder.
//! 2. Inputs are read, the pipeline runs, Ctrl-C cancels it.
//! 3. Outputs are written, each whole or not at all; statistics and findings go to `--json` also when the run failed.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::ArgMatches;
use meshwright::context::{CancelToken, RunContext, WorkerPool};
use meshwright::mesh::surface_mesh::Patch;
use meshwright::parameters::{Kind, ParameterSet, find};
use meshwright::pipeline::{JobKind, Output, image_to_mesh, registration, surface_to_mesh};
use meshwright::statistics::Statistics;
use meshwright::{Error, Finding, Result, io};
use serde_json::json;

use crate::arguments::{self, Content, EmptyText};
use crate::progress::Progress;
use crate::{file_names, job_inputs, job_outputs, report, slicer_xml};

/// Runs a job.
///
/// # Errors
/// Those of the files and of the pipeline.
pub fn run(kind: JobKind, matches: &ArgMatches) -> Result<()> {
    if arguments::is_given(matches, "xml") {
        return report::print(&slicer_xml::describe(kind));
    }
    let begin = Instant::now();
    let set = arguments::parameters(matches, kind.parameters(), EmptyText::of_caller())?;
    check_outputs(matches, &set)?;
    let cancel = CancelToken::default();
    let handler = cancel.clone();
    // Where the system refuses a handler, Ctrl-C ends the process as ever.
    let _ = ctrlc::set_handler(move || handler.cancel());
    let context = RunContext::new(WorkerPool::new(arguments::threads(matches))?, cancel);
    let quiet = arguments::is_given(matches, "quiet");
    let mut progress = Progress::new(kind.name(), arguments::is_given(matches, "slicer-progress"), quiet);
    let mut statistics = Statistics::default();
    let result = run_pipeline(kind, &set, &context, &mut progress, &mut statistics)
        .and_then(|(output, patches)| finish(matches, &set, kind, (&output, patches), &mut statistics));
    progress.finish();
    statistics.set("time.total", begin.elapsed().as_secs_f64());
    statistics.set("threads", context.threads() as f64);
    add_process_figures(&mut statistics);
    let mut findings = context.take_findings();
    if let Err(error) = &result {
        // A failed run's findings come with its error; the same ones may stand in the record too.
        let more: Vec<Finding> = error.findings().iter().filter(|f| !findings.contains(f)).cloned().collect();
        findings.extend(more);
    }
    if let Some(path) = arguments::path(matches, "json") {
        let error = result.as_ref().err().map(ToString::to_string);
        let value = json!({
            "program": "meshwright",
            "version": env!("CARGO_PKG_VERSION"),
            "command": kind.name(),
            "error": error,
            "statistics": report::nested(statistics.entries()),
            "findings": report::findings_json(&findings),
        });
        report::write_json(&value, path)?;
    }
    let summary = result?;
    if let Some(path) = arguments::path(matches, "returnparameterfile") {
        job_outputs::write_return_parameters(&statistics, path)?;
    }
    if !quiet {
        report::show_findings(&findings);
        if arguments::path(matches, "json").is_none_or(|p| p != Path::new("-")) {
            report::print(&format!("{summary}\n"))?;
        }
    }
    Ok(())
}

/// Looks at every output before the work starts: none is an input or another output, each format holds what it is for, each
/// folder is there.
fn check_outputs(matches: &ArgMatches, set: &ParameterSet) -> Result<()> {
    let (mut inputs, mut outputs): (Vec<(&str, PathBuf)>, Vec<(&str, PathBuf)>) = Default::default();
    for parameter in set.table() {
        match parameter.kind {
            Kind::InputFile { .. } => inputs.extend(set.text(parameter.name).map(|t| (parameter.name, t.into()))),
            Kind::OutputFile { .. } => outputs.extend(set.text(parameter.name).map(|t| (parameter.name, t.into()))),
            _ => {}
        }
    }
    for (name, path) in &outputs {
        check_format(matches, set, name, path)?;
    }
    if let Some(path) = arguments::path(matches, "output-surface") {
        arguments::write_options(matches, path, Content::Surface)?;
    }
    for name in ["output-surface", "returnparameterfile", "json"] {
        outputs.extend(arguments::path(matches, name).map(|path| (name, path.clone())));
    }
    outputs.iter().filter(|(_, p)| p != Path::new("-")).try_for_each(|(_, path)| io::check_writable(path))?;
    check_surfaces_of_labels(matches, &inputs, &mut outputs)?;
    file_names::refuse_clashes(&as_named(&inputs), &as_named(&outputs))
}

fn as_named<'a>(files: &'a [(&'static str, PathBuf)]) -> Vec<file_names::Named<'a>> {
    files.iter().map(|(name, path)| (*name, path.as_path())).collect()
}

/// Whether the format that the name of a table's output stands for holds what is written there.
fn check_format(matches: &ArgMatches, set: &ParameterSet, name: &str, path: &Path) -> Result<()> {
    let row = &set.table()[find(set.table(), name)?];
    let Kind::OutputFile { extensions } = row.kind else { return Ok(()) };
    if arguments::is_device(path) {
        return Ok(());
    }
    if extensions.contains(&".vtk") {
        let is_quadratic =
            name == "output" && find(set.table(), "shape-functions").is_ok_and(|_| set.integer("shape-functions") == 1);
        let content = if is_quadratic { Content::QuadraticElements } else { job_outputs::content_of(name) };
        arguments::write_options(matches, path, content)?;
    } else if extensions.contains(&".nrrd") && !io::is_image_path(path) {
        let reason = format!("{}: images are written as {}", path.display(), extensions.join(" "));
        return Err(Error::Unsupported { reason });
    }
    Ok(())
}

/// Where the surfaces go to a file per label or pair of labels, their names are not known yet: no other file may have
/// one that could be theirs. The name that was given is not written then.
fn check_surfaces_of_labels(
    matches: &ArgMatches,
    inputs: &[(&'static str, PathBuf)],
    outputs: &mut Vec<(&'static str, PathBuf)>,
) -> Result<()> {
    let is_one_file = matches.try_get_one::<String>("surfaces").ok().flatten().is_none_or(|how| how == "all");
    let Some(path) = arguments::path(matches, "output-surface").filter(|_| !is_one_file) else { return Ok(()) };
    outputs.retain(|(name, _)| *name != "output-surface");
    let Some(place) = file_names::resolved(path) else { return Ok(()) };
    for (name, other) in inputs.iter().chain(&*outputs) {
        if file_names::resolved(other).is_some_and(|other| job_outputs::is_surface_of_labels(&place, &other)) {
            return Err(file_names::clash("output-surface", other, name));
        }
    }
    Ok(())
}

fn run_pipeline(
    kind: JobKind,
    set: &ParameterSet,
    context: &RunContext,
    progress: &mut Progress,
    statistics: &mut Statistics,
) -> Result<(Output, Vec<Patch>)> {
    let begin = Instant::now();
    let mut patches = Vec::new();
    let mut tick = |stage: &'static str, fraction: f64| {
        progress.show(stage, fraction);
        ControlFlow::Continue(())
    };
    let output = match kind {
        JobKind::ImageToMesh => {
            let inputs = job_inputs::ImageInputs::read(set)?;
            statistics.set("time.read", begin.elapsed().as_secs_f64());
            let input = image_to_mesh::Input { labels: &inputs.labels, fixed_points: &inputs.fixed_points };
            context.run(&mut tick, |context| image_to_mesh::run(&input, set, context))?
        }
        JobKind::SurfaceToMesh => {
            let inputs = job_inputs::SurfaceInputs::read(set)?;
            statistics.set("time.read", begin.elapsed().as_secs_f64());
            patches = inputs.patches(set)?;
            let input = surface_to_mesh::Input { surface: &inputs.surface, sizing: inputs.sizing.as_ref() };
            context.run(&mut tick, |context| surface_to_mesh::run(&input, set, context))?
        }
        JobKind::Registration => {
            let inputs = job_inputs::RegistrationInputs::read(set)?;
            statistics.set("time.read", begin.elapsed().as_secs_f64());
            context.run(&mut tick, |context| registration::run(&inputs.as_input(), set, context))?
        }
    };
    statistics.extend(&output.statistics);
    Ok((output, patches))
}

/// Writes the outputs; returns the line that says what was made.
fn finish(
    matches: &ArgMatches,
    set: &ParameterSet,
    kind: JobKind,
    (output, patches): (&Output, Vec<Patch>),
    statistics: &mut Statistics,
) -> Result<String> {
    let begin = Instant::now();
    if let Some(mesh) = &output.mesh {
        statistics.set("mesh.points", mesh.points.len() as f64);
        statistics.set("mesh.elements", mesh.element_count() as f64);
    }
    job_outputs::Writer { kind, matches, output, patches }.write(set)?;
    statistics.set("time.write", begin.elapsed().as_secs_f64());
    Ok(job_outputs::summary(kind, output, statistics))
}

/// Peak memory and processor time of the process, where the system tells them.
fn add_process_figures(statistics: &mut Statistics) {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak =
        status.lines().find_map(|l| l.strip_prefix("VmHWM:")?.trim().strip_suffix(" kB")?.trim().parse::<f64>().ok());
    if let Some(kilobytes) = peak {
        statistics.set("memory.peak", kilobytes * 1024.0);
    }
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // Fields 14 and 15, counted behind the name in parentheses, in hundredths of a second.
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or("").split_whitespace().collect();
    let ticks = |n: usize| fields.get(n).and_then(|f| f.parse::<f64>().ok());
    if let (Some(user), Some(system)) = (ticks(11), ticks(12)) {
        statistics.set("time.cpu", (user + system) / 100.0);
    }
}
