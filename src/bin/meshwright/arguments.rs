//! The flags: made from the parameter tables, so that every option exists under both of its names.
//!
//! # Method
//! A row of a table gives `--its-name`, with the thesis's name and the spelling with underscores as aliases; a row that
//! can be given per label also `--its-name-for LABEL=VALUE`. Values stay text here; the table's own parser checks them.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use clap::{Arg, ArgAction, ArgMatches, Command, value_parser};
use meshwright::context::MAX_THREADS;
use meshwright::io::{Compression, Encoding, MeshFormat, Surfaces, WriteOptions};
use meshwright::mesh::mixed_mesh::Space;
use meshwright::parameters::{Kind, Multiplicity, Parameter, ParameterSet, Table, Value};
use meshwright::pipeline::JobKind;
use meshwright::{Error, Result};

/// The whole command line.
pub fn command() -> Command {
    let mut command = Command::new("meshwright")
        .version(env!("CARGO_PKG_VERSION"))
        .about("Mesh generation and registration: segmented images, surfaces and brain scans in; meshes and fields out")
        .subcommand_required(true)
        .arg_required_else_help(true);
    for kind in JobKind::ALL {
        command = command.subcommand(job_command(kind));
    }
    command.subcommands([quality_command(), check_command(), convert_command(), info_command(), crate::warp::command()])
}

fn quality_command() -> Command {
    Command::new("quality")
        .about("Measures a mesh: angles, shapes, volumes per label, distance to its image or surface")
        .arg(file("mesh", "Mesh to measure"))
        .arg(
            Arg::new("image")
                .long("image")
                .value_name("FILE")
                .value_parser(value_parser!(PathBuf))
                .help("Segmented image the mesh was made from"),
        )
        .arg(
            Arg::new("surface")
                .long("surface")
                .value_name("FILE")
                .value_parser(value_parser!(PathBuf))
                .help("Surface the mesh was made from"),
        )
        .args([json_argument(), threads_argument()])
}

fn check_command() -> Command {
    Command::new("check")
        .about("Lists everything that keeps a surface from being meshed, with ids and places")
        .arg(file("surface", "Surface to check"))
        .arg(
            Arg::new("picture")
                .long("picture")
                .value_name("FILE")
                .value_parser(value_parser!(PathBuf))
                .help("Write the faulty points, edges and triangles as .vtp"),
        )
        .args([json_argument(), threads_argument()])
}

fn convert_command() -> Command {
    Command::new("convert")
        .about("Converts images, meshes and surfaces; the file names say the formats")
        .arg(file("input", "File to read"))
        .arg(file("output", "File to write"))
        .args(format_arguments())
}

fn info_command() -> Command {
    Command::new("info")
        .about("Prints what a file holds: geometry, labels, counts")
        .arg(file("file", "Image, mesh or surface"))
        .arg(json_argument())
}

/// The subcommand of a job: the rows of its table, then what all jobs share.
fn job_command(kind: JobKind) -> Command {
    let about = match kind {
        JobKind::ImageToMesh => "Meshes a segmented image",
        JobKind::SurfaceToMesh => "Meshes the inside of a surface triangulation",
        JobKind::Registration => "Registers a preoperative scan to an intraoperative one",
    };
    let mut command = Command::new(kind.name()).about(about).next_line_help(true);
    for parameter in kind.parameters() {
        command = command.args(table_arguments(parameter));
    }
    command.args(shared_arguments(kind))
}

fn table_arguments(parameter: &'static Parameter) -> Vec<Arg> {
    let mut arg = Arg::new(parameter.name).long(parameter.name).help(help_of(parameter)).help_heading(parameter.group);
    let underscored = parameter.name.replace('-', "_");
    let mut aliases: Vec<String> = parameter.alias.map(str::to_owned).into_iter().collect();
    if underscored != parameter.name {
        aliases.push(underscored);
    }
    aliases.retain(|a| a != parameter.name);
    arg = arg.visible_aliases(aliases.clone().into_iter().take(usize::from(parameter.alias.is_some())));
    arg = arg.aliases(aliases.into_iter().skip(usize::from(parameter.alias.is_some())));
    arg = match parameter.kind {
        Kind::Flag => arg.num_args(0..=1).default_missing_value("true").value_name("on|off"),
        Kind::Integer { .. } => arg.value_name("N").allow_hyphen_values(true),
        Kind::Real { .. } => arg.value_name("X").allow_hyphen_values(true),
        Kind::Choice(_) => arg.value_name("CHOICE"),
        Kind::Text => arg.value_name("TEXT").allow_hyphen_values(true),
        Kind::InputFile { .. } | Kind::OutputFile { .. } => arg.value_name("FILE"),
    };
    arg = arg.action(ArgAction::Append);
    if parameter.multiplicity != Multiplicity::PerLabel {
        return vec![arg];
    }
    let name = format!("{}-for", parameter.name);
    let per_label = Arg::new(name.clone())
        .long(name.clone())
        .alias(name.replace('-', "_"))
        .value_name("LABEL=X")
        .action(ArgAction::Append)
        .help_heading(parameter.group)
        .help(format!("The same for one label; may be given several times. {}", parameter.doc));
    vec![arg, per_label]
}

fn help_of(parameter: &Parameter) -> String {
    let mut text = parameter.doc.to_owned();
    let mut facts = Vec::new();
    match parameter.kind {
        Kind::Choice(choices) => {
            facts.push(choices.iter().enumerate().map(|(i, c)| format!("{i} {c}")).collect::<Vec<_>>().join(", "))
        }
        Kind::Integer { min, max } => facts.push(format!("range {min} to {max}")),
        Kind::Real { min, max, open_min } => {
            let bound = if open_min { "above " } else { "" };
            facts.push(if max.is_finite() {
                format!("range {bound}{min} to {max}")
            } else {
                format!("at least {bound}{min}")
            });
        }
        _ => {}
    }
    if !parameter.unit.is_empty() {
        facts.push(format!("unit {}", parameter.unit));
    }
    match (parameter.default_value(), parameter.kind) {
        (Some(Value::Integer(v)), Kind::Choice(choices)) => {
            facts.push(format!("default {}", choices.get(v as usize).unwrap_or(&"")));
        }
        (Some(Value::Flag(v)), _) => facts.push(format!("default {}", if v { "on" } else { "off" })),
        (Some(Value::Integer(v)), _) => facts.push(format!("default {v}")),
        (Some(Value::Real(v)), _) => facts.push(format!("default {v}")),
        (Some(Value::Text(v)), _) => facts.push(format!("default {v}")),
        (None, _) => {}
    }
    if !facts.is_empty() {
        text.push_str(&format!(" [{}]", facts.join("; ")));
    }
    text
}

fn shared_arguments(kind: JobKind) -> Vec<Arg> {
    let run = "Run";
    let flag = |name: &'static str, help: &'static str| {
        Arg::new(name).long(name).action(ArgAction::SetTrue).help(help).help_heading(run)
    };
    let mut all = vec![
        threads_argument().help_heading(run),
        json_argument().help_heading(run),
        flag("xml", "Print 3D Slicer's description of this subcommand and exit"),
        flag("quiet", "Print nothing but errors"),
        flag("slicer-progress", "Print progress as 3D Slicer's tags on standard output").alias("slicer_progress"),
        Arg::new("returnparameterfile")
            .long("returnparameterfile")
            .value_name("FILE")
            .value_parser(value_parser!(PathBuf))
            .help("Write the figures of the result as `name = value` lines for 3D Slicer")
            .help_heading(run),
    ];
    if kind != JobKind::Registration {
        all.extend([
            Arg::new("output-surface")
                .long("output-surface")
                .value_name("FILE")
                .value_parser(value_parser!(PathBuf))
                .help("Write the boundary triangles, with the labels on both sides")
                .help_heading("Files"),
            Arg::new("surfaces")
                .long("surfaces")
                .value_parser(["all", "per-label", "per-pair"])
                .default_value("all")
                .help("One surface file, or one per label or pair of labels; the labels are added to the file's name")
                .help_heading("Files"),
        ]);
    }
    all.extend(format_arguments());
    // A table's own row of the same name wins.
    all.retain(|arg| !kind.parameters().iter().any(|p| arg.get_id() == p.name));
    all
}

fn file(name: &'static str, help: &'static str) -> Arg {
    Arg::new(name).value_name("FILE").help(help).required(true).value_parser(value_parser!(PathBuf))
}

fn threads_argument() -> Arg {
    Arg::new("threads")
        .long("threads")
        .value_name("N")
        .value_parser(value_parser!(i64).range(0..=MAX_THREADS as i64))
        .allow_hyphen_values(true)
        .default_value("0")
        .help("Worker threads; 0 takes one per core")
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
        choice("space", &["lps", "ras", "none"]).help(
            "Frame of the coordinates in written meshes; none keeps them and writes no tag, for readers of .vtu that \
             know no text arrays, as meshio [default: that of the input]",
        ),
        choice("format-version", &["2.2", "4.1", "4.2", "5.1"])
            .help("Version of .vtk (4.2, 5.1) and .msh (2.2, 4.1) files [default: 4.2 and 4.1]"),
        flag("ascii").help("Write text where a format has both text and bytes"),
        flag("compress").help("Pack the blocks of .vtu and .vtp files"),
        flag("volume-only").help("Leave out the boundary triangles where a format holds both"),
    ]
}

/// What goes into a mesh file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Content {
    /// Volume elements or points: a format of surfaces would lose them.
    Elements,
    /// Volume elements with nodes on edges.
    QuadraticElements,
    /// A surface alone.
    Surface,
    /// What the format holds of it: a conversion may leave the surface alone.
    Any,
}

impl Content {
    /// Refuses a format that cannot hold it.
    fn check(self, format: MeshFormat, path: &Path) -> Result<()> {
        let (test, what): (fn(MeshFormat) -> bool, &str) = match self {
            Self::Elements => (MeshFormat::holds_elements, "volume elements"),
            Self::QuadraticElements => (MeshFormat::holds_quadratic_elements, "quadratic elements"),
            Self::Surface => (MeshFormat::holds_lone_surface, "surface alone"),
            Self::Any => return Ok(()),
        };
        if test(format) {
            return Ok(());
        }
        let endings = MeshFormat::endings_of(test);
        Err(Error::Unsupported { reason: format!("{} would hold no {what}; {endings} do", path.display()) })
    }
}

/// The write options that the format flags ask for, for a file of the given name and content.
///
/// # Errors
/// [`Error::Unsupported`] for an unknown ending, a format that does not hold the content, or a version that the format
/// has not.
pub fn write_options(matches: &ArgMatches, path: &Path, content: Content) -> Result<WriteOptions> {
    let given = |name: &str| matches.try_get_one::<String>(name).ok().flatten().map(String::as_str);
    let flag = |name: &str| matches.try_get_one::<bool>(name).ok().flatten() == Some(&true);
    let format = match MeshFormat::of_path(path) {
        // Devices have no ending.
        Err(_) if is_device(path) && content == Content::Surface => MeshFormat::Vtp,
        Err(_) if is_device(path) => MeshFormat::Vtu,
        other => other?,
    };
    content.check(format, path)?;
    let format = match (format, given("format-version")) {
        (MeshFormat::Vtk42, Some("5.1")) => MeshFormat::Vtk51,
        (MeshFormat::Msh41, Some("2.2")) => MeshFormat::Msh22,
        (MeshFormat::Vtk42, Some("2.2" | "4.1")) | (MeshFormat::Msh41, Some("4.2" | "5.1")) => {
            return Err(Error::Unsupported { reason: format!("{}: no such version of this format", path.display()) });
        }
        (format, _) => format,
    };
    let space = match given("space") {
        Some("ras") => Some(Space::Ras),
        Some("none") => Some(Space::Unspecified),
        Some(_) => Some(Space::Lps),
        None => None,
    };
    Ok(WriteOptions {
        format: Some(format),
        space,
        encoding: if flag("ascii") { Encoding::Ascii } else { Encoding::Binary },
        compression: if flag("compress") { Compression::Zlib } else { Compression::None },
        surfaces: if flag("volume-only") { Surfaces::Omit } else { Surfaces::Include },
        patches: Vec::new(),
    })
}

/// Whether the path is a pipe or a device.
pub fn is_device(path: &Path) -> bool {
    path.metadata().is_ok_and(|m| !m.is_file() && !m.is_dir())
}

/// What an empty text stands for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EmptyText {
    /// An option that was not given: 3D Slicer passes one for every field left empty.
    NotGiven,
    /// A mistake: a variable of a script that is not set.
    Refused,
}

impl EmptyText {
    /// By the name that the binary was called under.
    pub fn of_caller() -> Self {
        if module_kind(std::env::args_os().next()).is_some() { Self::NotGiven } else { Self::Refused }
    }
}

/// The values given on the command line, checked against the table.
///
/// # Errors
/// [`Error::ParameterValue`].
pub fn parameters(matches: &ArgMatches, table: Table, empty: EmptyText) -> Result<ParameterSet> {
    let mut set = ParameterSet::new(table);
    for parameter in table {
        let texts = |name: &str| -> Result<Vec<String>> {
            let given = matches.try_get_many::<String>(name).ok().flatten().unwrap_or_default();
            let (blank, texts): (Vec<String>, Vec<String>) = given.cloned().partition(|text| text.trim().is_empty());
            if !blank.is_empty() && empty == EmptyText::Refused {
                return Err(Error::ParameterValue { name: name.to_owned(), reason: "its value is empty".into() });
            }
            Ok(texts)
        };
        for text in texts(parameter.name)? {
            set.set_text(parameter.name, &text)?;
        }
        if parameter.multiplicity == Multiplicity::PerLabel {
            for text in texts(&format!("{}-for", parameter.name))? {
                let refuse = || Error::ParameterValue {
                    name: format!("{}-for", parameter.name),
                    reason: format!("'{text}' is not LABEL=VALUE"),
                };
                let (label, value) = text.split_once('=').ok_or_else(refuse)?;
                let label: i64 = label.trim().parse().map_err(|_| refuse())?;
                set.set_for_label(parameter.name, label, parameter.parse(value)?)?;
            }
        }
    }
    Ok(set)
}

/// Names under which the binary is one subcommand: 3D Slicer knows a command-line module by its file name.
const MODULE_NAMES: [(&str, JobKind); 3] = [
    ("MeshwrightImageToMesh", JobKind::ImageToMesh),
    ("MeshwrightSurfaceToMesh", JobKind::SurfaceToMesh),
    ("MeshwrightRegister", JobKind::Registration),
];

/// The job of the module that the binary was called as.
fn module_kind(called_as: Option<OsString>) -> Option<JobKind> {
    let name = PathBuf::from(called_as?).file_stem()?.to_owned();
    MODULE_NAMES.iter().find(|(module, _)| name == *module).map(|(_, kind)| *kind)
}

/// Arguments with the thesis's single hyphen (`-latticeSpacing`) brought to two, and with the subcommand that the
/// binary's own name stands for.
pub fn normalized(arguments: impl Iterator<Item = OsString>) -> Vec<OsString> {
    let mut arguments: Vec<OsString> = arguments.collect();
    if let Some(kind) = module_kind(arguments.first().cloned()) {
        arguments.insert(1, kind.name().into());
    }
    let with_two = |argument: OsString| match argument.to_str() {
        Some(text)
            if text.len() > 2
                && text.starts_with('-')
                && text[1..].starts_with(|c: char| c.is_ascii_alphabetic())
                && text.parse::<f64>().is_err() =>
        {
            OsString::from(format!("-{text}"))
        }
        _ => argument,
    };
    arguments.into_iter().map(with_two).collect()
}

/// The path given for `name`.
pub fn path<'a>(matches: &'a ArgMatches, name: &str) -> Option<&'a PathBuf> {
    matches.try_get_one::<PathBuf>(name).ok().flatten()
}

/// Whether a switch was given.
pub fn is_given(matches: &ArgMatches, name: &str) -> bool {
    matches.try_get_one::<bool>(name).ok().flatten() == Some(&true)
}

/// Worker threads asked for; 0 for all.
pub fn threads(matches: &ArgMatches) -> usize {
    matches.try_get_one::<i64>("threads").ok().flatten().map_or(0, |&count| count as usize)
}
