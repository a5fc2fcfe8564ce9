//! `meshwright warp IN OUT --field FIELD`: carries an image, points or a mesh of the same patient through a field.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clap::{Arg, ArgAction, ArgMatches, Command, value_parser};
use glam::DVec3;
use meshwright::context::RunContext;
use meshwright::pipeline::warp::{Direction, Interpolation, warp_image, warp_points};
use meshwright::{Error, Result, io};

use crate::arguments::{self, Content};
use crate::file_names;
use crate::job_inputs::lps_mesh;

/// The flags of the subcommand.
pub fn command() -> Command {
    let path = |name: &'static str, help: &'static str| {
        Arg::new(name).long(name).value_name("FILE").value_parser(value_parser!(PathBuf)).help(help)
    };
    let flag = |name: &'static str, help: &'static str| Arg::new(name).long(name).action(ArgAction::SetTrue).help(help);
    Command::new("warp")
        .about("Carries an image, points (.csv, LPS mm) or a mesh of the moving scan to the fixed scan")
        .arg(Arg::new("input").required(true).value_parser(value_parser!(PathBuf)).help("Image, .csv or mesh"))
        .arg(Arg::new("output").required(true).value_parser(value_parser!(PathBuf)).help("File to write"))
        .arg(path("field", "Displacement field of `register`, fixed to moving").required(true))
        .arg(path("reference", "Image whose grid the warped image gets; without it the grid of the field"))
        .arg(flag("nearest", "Nearest voxel instead of linear interpolation: for labels"))
        .arg(flag("to-moving", "Points and meshes go from the fixed to the moving scan instead"))
}

/// Reads, warps, writes.
///
/// # Errors
/// Those of the readers, the pipeline and the writers.
pub fn run(matches: &ArgMatches) -> Result<()> {
    let path = |name| arguments::path(matches, name);
    let (Some(input), Some(output), Some(field)) = (path("input"), path("output"), path("field")) else {
        return Err(Error::State { reason: "input, output and --field are needed".into() });
    };
    file_names::refuse_clashes_of(matches, &["input", "field", "reference"], &["output"])?;
    io::check_writable(output)?;
    let field = io::read_image(field)?;
    let direction = if matches.get_flag("to-moving") { Direction::FixedToMoving } else { Direction::MovingToFixed };
    if io::is_image_path(input) {
        let image = io::read_image(input)?;
        let grid = path("reference").map(|file| io::read_image(file)).transpose()?.map(|image| image.grid);
        let how = if matches.get_flag("nearest") { Interpolation::Nearest } else { Interpolation::Linear };
        let context = RunContext::with_threads(0)?;
        let warped = context.install(|| warp_image(&image, &field, grid.as_ref(), how))?;
        return io::write_image(&warped, output);
    }
    if input.extension().is_some_and(|e| e.eq_ignore_ascii_case("csv")) {
        let mut points = read_points(input)?;
        warp_points(&mut points, &field, direction)?;
        let mut text = String::from("x,y,z\n");
        for p in points {
            // Writing to a text in memory cannot fail.
            let _ = writeln!(text, "{},{},{}", p.x, p.y, p.z);
        }
        return io::write_atomically(output, |out| out.write_all(text.as_bytes()));
    }
    let mut mesh = lps_mesh(input)?;
    // A format of surfaces would lose the elements without a word.
    let content = if mesh.element_count() > 0 { Content::Elements } else { Content::Any };
    let options = arguments::write_options(matches, output, content)?;
    warp_points(&mut mesh.points, &field, direction)?;
    io::write_mesh(&mesh, output, &options)
}

/// The last three columns of each row; lines of names and comments before the first numbers are passed over.
fn read_points(path: &Path) -> Result<Vec<DVec3>> {
    let text = std::fs::read_to_string(path).map_err(|source| Error::io(path, source))?;
    let mut points = Vec::new();
    for (number, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty() && !l.starts_with('#')) {
        let words: Vec<&str> = line.split([',', ';', '\t', ' ']).map(str::trim).filter(|w| !w.is_empty()).collect();
        let tail = &words[words.len().saturating_sub(3)..];
        let numbers: Option<Vec<f64>> = tail.iter().map(|w| w.parse().ok().filter(|v: &f64| v.is_finite())).collect();
        match numbers.as_deref() {
            Some(&[x, y, z]) => points.push(DVec3::new(x, y, z)),
            _ if points.is_empty() => {}
            _ => return Err(Error::format(path, format!("line {}: three numbers are needed", number + 1))),
        }
    }
    Ok(points)
}
