//! The command line: parses, calls the pipeline, writes; no algorithm.
//!
//! # Method
//! The flags of the three jobs are made from the engines' parameter tables (`arguments`); `jobs` reads the inputs, runs
//! the pipeline and writes what was asked for; the other subcommands have a module each. Results go to stdout, one line
//! about a failure to stderr, and the exit code says what kind of failure it was.

mod arguments;
mod check;
mod convert;
mod exit_code;
mod file_names;
mod info;
mod job_inputs;
mod job_outputs;
mod jobs;
mod progress;
mod quality;
mod report;
mod slicer_xml;
mod warp;

use std::process::ExitCode;

use meshwright::Error;
use meshwright::pipeline::JobKind;

fn main() -> ExitCode {
    let arguments = arguments::normalized(std::env::args_os());
    let matches = match arguments::command().try_get_matches_from(arguments) {
        Ok(matches) => matches,
        Err(error) => return report::usage_error(&error),
    };
    let Some((name, matches)) = matches.subcommand() else {
        return report::failure(&Error::Unsupported { reason: "no subcommand given".into() });
    };
    if let Some(kind) = JobKind::ALL.into_iter().find(|kind| kind.name() == name) {
        return report::outcome(jobs::run(kind, matches));
    }
    report::outcome(match name {
        "quality" => quality::run(matches),
        "check" => check::run(matches),
        "convert" => convert::run(matches),
        "info" => info::run(matches),
        "warp" => warp::run(matches),
        other => Err(Error::Unsupported { reason: format!("no subcommand {other}") }),
    })
}
