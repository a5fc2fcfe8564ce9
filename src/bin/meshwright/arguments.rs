//! The flags: made from the parameter tables, so that every option exists under both of its names.

use std::ffi::OsString;
use std::path::PathBuf;

use clap::{Arg, ArgAction, ArgMatches, Command, value_parser};

/// The whole command line.
pub fn command() -> Command {
    Command::new("meshwright")
        .version(env!("CARGO_PKG_VERSION"))
        .about("Mesh generation and registration: segmented images, surfaces and brain scans in; meshes and fields out")
        .subcommand_required(true)
        .arg_required_else_help(true)
        .subcommand(
            Command::new("convert")
                .about("Converts images, meshes and surfaces; the file names say the formats")
                .arg(file("input", "File to read"))
                .arg(file("output", "File to write"))
                .args(format_arguments()),
        )
        .subcommand(
            Command::new("info")
                .about("Prints what a file holds: geometry, labels, counts")
                .arg(file("file", "Image, mesh or surface"))
                .arg(json_argument()),
        )
}

fn file(name: &'static str, help: &'static str) -> Arg {
    Arg::new(name).value_name("FILE").help(help).required(true).value_parser(value_parser!(PathBuf))
}

fn json_argument() -> Arg {
    Arg::new("json")
        .long("json")
        .value_name("FILE")
        .help("Write the figures as JSON to FILE; to standard output without FILE or with -")
        .num_args(0..=1)
        .default_missing_value("-")
        .value_parser(value_parser!(PathBuf))
}

/// How files are written: frame, format, text or bytes, packed.
fn format_arguments() -> [Arg; 5] {
    let choice = |name: &'static str, choices: &[&'static str]| {
        Arg::new(name).long(name).value_parser(choices.to_vec()).help_heading("Files")
    };
    let flag = |name: &'static str| Arg::new(name).long(name).action(ArgAction::SetTrue).help_heading("Files");
    [
        choice("space", &["lps", "ras"])
            .help("Frame of the coordinates in written meshes [default: that of the input]"),
        choice("format-version", &["2.2", "4.1", "4.2", "5.1"])
            .help("Version of .vtk (4.2, 5.1) and .msh (2.2, 4.1) files [default: 4.2 and 4.1]"),
        flag("ascii").help("Write text where a format has both text and bytes"),
        flag("compress").help("Pack the blocks of .vtu and .vtp files"),
        flag("volume-only").help("Leave out the boundary triangles where a format holds both"),
    ]
}

/// Arguments with the thesis's single hyphen (`-latticeSpacing`) brought to two.
pub fn normalized(arguments: impl Iterator<Item = OsString>) -> Vec<OsString> {
    let with_two = |argument: OsString| match argument.to_str() {
        Some(text)
            if text.len() > 2 && text.starts_with('-') && text[1..].starts_with(|c: char| c.is_ascii_alphabetic()) =>
        {
            OsString::from(format!("-{text}"))
        }
        _ => argument,
    };
    arguments.map(with_two).collect()
}

/// The path given for `name`.
pub fn path<'a>(matches: &'a ArgMatches, name: &str) -> Option<&'a PathBuf> {
    matches.try_get_one::<PathBuf>(name).ok().flatten()
}
