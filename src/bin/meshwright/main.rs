//! The command line: parses, calls the pipeline, writes; no algorithm.
//!
//! # Method
//! The flags of the three jobs are made from the engines' parameter tables (`arguments`); `jobs` reads the inputs, runs
//! the pipeline and writes what was asked for; the other subcommands have a module each. Results go to stdout, one line
//! about a failure to stderr, and the exit code says what kind of failure it was.

mod arguments;
mod convert;
mod exit_code;
mod info;
mod report;

use std::process::ExitCode;

use meshwright::Error;

fn main() -> ExitCode {
    let arguments = arguments::normalized(std::env::args_os());
    let matches = match arguments::command().try_get_matches_from(arguments) {
        Ok(matches) => matches,
        Err(error) => return report::usage_error(&error),
    };
    let result = match matches.subcommand() {
        Some(("convert", matches)) => convert::run(matches),
        Some(("info", matches)) => info::run(matches),
        _ => Err(Error::Unsupported { reason: "no such subcommand".into() }),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => report::failure(&error),
    }
}
