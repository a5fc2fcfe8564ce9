//! Writing what the jobs made.
//!
//! # Method
//! The main mesh goes to `--output`. Every other output row of a table names something of the pipeline's output:
//! `output-bcc-mesh` the mesh `bcc_mesh`, `output-target-points` the points `target_points`, and so on; the
//! registration's rows have their own table below. What was asked for and is not there is an error, not a silence.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clap::ArgMatches;
use glam::DVec3;
use meshwright::io::{SurfaceExport, SurfaceSelection, WriteOptions, label_pairs};
use meshwright::mesh::mixed_mesh::{ArrayData, MixedMesh};
use meshwright::mesh::surface_mesh::Patch;
use meshwright::parameters::{Kind, ParameterSet};
use meshwright::pipeline::{JobKind, Output};
use meshwright::statistics::Statistics;
use meshwright::{Error, Result, io};

use crate::arguments::{self, Content};

/// Rows whose output has another name in [`Output`].
const NAMES: [(&str, &str); 4] = [
    ("output-deformation-field", "displacement"),
    ("output-image", "warped"),
    ("output-inverse-field", "inverse"),
    ("output-segmentation", "labels"),
];

/// What the mesh file of a row holds; the main mesh is [`Content::QuadraticElements`] where these are asked for.
pub fn content_of(row: &str) -> Content {
    if row.ends_with("-surface") { Content::Surface } else { Content::Elements }
}

/// What is written, and how.
pub struct Writer<'a> {
    /// The job.
    pub kind: JobKind,
    /// The command line.
    pub matches: &'a ArgMatches,
    /// What the job made.
    pub output: &'a Output,
    /// Names and roles of the surface's patches.
    pub patches: Vec<Patch>,
}

impl Writer<'_> {
    /// Writes every output that was asked for.
    ///
    /// # Errors
    /// Those of the writers; [`Error::NoResult`] for an output that the run did not make.
    pub fn write(&self, set: &ParameterSet) -> Result<()> {
        for parameter in set.table() {
            if let Kind::OutputFile { .. } = parameter.kind
                && let Some(text) = set.text(parameter.name)
            {
                self.write_one(parameter.name, Path::new(&text))?;
            }
        }
        if let Some(path) = arguments::path(self.matches, "output-surface") {
            write_surfaces(self.matches, path, main_mesh(self.output)?)?;
        }
        Ok(())
    }

    fn options(&self, path: &Path, content: Content) -> Result<WriteOptions> {
        Ok(WriteOptions { patches: self.patches.clone(), ..arguments::write_options(self.matches, path, content)? })
    }

    fn write_one(&self, name: &str, path: &Path) -> Result<()> {
        let output = self.output;
        let main = if self.kind == JobKind::Registration { "output-mesh" } else { "output" };
        if name == main {
            return io::write_mesh(main_mesh(output)?, path, &self.options(path, Content::Elements)?);
        }
        match name {
            "output-blocks" => return write_blocks(output, path),
            "output-transform" => return write_transform(output, path),
            _ => {}
        }
        let wanted = NAMES
            .iter()
            .find(|(row, _)| *row == name)
            .map_or_else(|| name.trim_start_matches("output-").replace('-', "_"), |(_, n)| (*n).to_owned());
        let same = |n: &str| n.replace('-', "_").trim_start_matches("output_") == wanted;
        if let Some((_, image)) = output.images.iter().find(|(n, _)| same(n)) {
            return io::write_image(image, path);
        }
        if let Some((_, mesh)) = output.meshes.iter().find(|(n, _)| same(n)) {
            let options = self.options(path, content_of(name))?;
            if mesh.element_count() == 0 && !mesh.boundary.labels.is_empty() {
                return io::write_surface_export(&SurfaceExport::of_mesh(mesh, SurfaceSelection::All)?, path, &options);
            }
            return io::write_mesh(mesh, path, &options);
        }
        if let Some((_, points)) = output.points.iter().find(|(n, _)| same(n)) {
            let cloud = MixedMesh { points: points.clone(), offsets: vec![0], ..MixedMesh::default() };
            return io::write_mesh(&cloud, path, &self.options(path, Content::Elements)?);
        }
        Err(missing(&wanted.replace('_', " ")))
    }
}

fn main_mesh(output: &Output) -> Result<&MixedMesh> {
    output.mesh.as_ref().ok_or_else(|| missing("mesh"))
}

fn missing(name: &str) -> Error {
    Error::NoResult { message: format!("this run made no {name}"), findings: Vec::new() }
}

/// One file, or one per label or pair of labels with the labels in its name.
fn write_surfaces(matches: &ArgMatches, path: &Path, mesh: &MixedMesh) -> Result<()> {
    let options = arguments::write_options(matches, path, Content::Surface)?;
    let how = matches.get_one::<String>("surfaces").map_or("all", String::as_str);
    if how == "all" {
        return io::write_surface_export(&SurfaceExport::of_mesh(mesh, SurfaceSelection::All)?, path, &options);
    }
    let pairs = label_pairs(mesh);
    let named = |suffix: String| -> PathBuf {
        let (stem, ending) = name_parts(path);
        path.with_file_name(format!("{stem}-{suffix}.{ending}"))
    };
    let selections: Vec<(SurfaceSelection, PathBuf)> = if how == "per-pair" {
        pairs.iter().map(|p| (SurfaceSelection::Pair(p[0], p[1]), named(format!("{}-{}", p[0], p[1])))).collect()
    } else {
        let mut labels: Vec<i32> = pairs.into_iter().flatten().filter(|&l| l != 0).collect();
        labels.sort_unstable();
        labels.dedup();
        labels.into_iter().map(|l| (SurfaceSelection::Label(l), named(l.to_string()))).collect()
    };
    for (selection, path) in selections {
        io::write_surface_export(&SurfaceExport::of_mesh(mesh, selection)?, &path, &options)?;
    }
    Ok(())
}

/// Whether `other` could be one of the files that [`write_surfaces`] makes of `path`: beside it, with one or two labels
/// in its name.
pub fn is_surface_of_labels(path: &Path, other: &Path) -> bool {
    let ((stem, ending), (other_stem, other_ending)) = (name_parts(path), name_parts(other));
    let labels = other_stem.strip_prefix(&stem).and_then(|rest| rest.strip_prefix('-'));
    let is_label = |word: &str| !word.is_empty() && word.bytes().all(|b| b.is_ascii_digit());
    path.parent() == other.parent() && ending == other_ending && labels.is_some_and(|l| l.split('-').all(is_label))
}

/// A file's name before and after its last dot.
fn name_parts(path: &Path) -> (String, String) {
    let text = |part: Option<&std::ffi::OsStr>| part.unwrap_or_default().to_string_lossy().into_owned();
    (text(path.file_stem()), text(path.extension()))
}

/// Values of a named array as reals.
fn array(output: &Output, name: &str) -> Option<Vec<f64>> {
    output.arrays.iter().find(|a| a.name == name).map(|a| match &a.data {
        ArrayData::Real(values) => values.clone(),
        ArrayData::Int(values) => values.iter().map(|&v| f64::from(v)).collect(),
        ArrayData::Long(values) => values.iter().map(|&v| v as f64).collect(),
    })
}

fn points<'a>(output: &'a Output, name: &str) -> Option<&'a [DVec3]> {
    output.points.iter().find(|(n, _)| n == name).map(|(_, p)| &p[..])
}

/// Matched blocks as rows of numbers: position, displacement, similarity, rejected.
fn write_blocks(output: &Output, path: &Path) -> Result<()> {
    let (Some(source), Some(target)) = (points(output, "source_points"), points(output, "target_points")) else {
        return Err(missing("matched blocks"));
    };
    let similarity = array(output, "similarity").unwrap_or_default();
    let rejected = array(output, "rejected").unwrap_or_default();
    let mut text = String::from("x,y,z,dx,dy,dz,similarity,rejected\n");
    for (i, (s, t)) in source.iter().zip(target).enumerate() {
        let d = *t - *s;
        let (q, r) = (similarity.get(i).copied().unwrap_or(f64::NAN), rejected.get(i).copied().unwrap_or(0.0));
        // Writing to a text in memory cannot fail.
        let _ = writeln!(text, "{},{},{},{},{},{},{q},{r}", s.x, s.y, s.z, d.x, d.y, d.z);
    }
    io::write_atomically(path, |out| out.write_all(text.as_bytes()))
}

/// The rigid start as ITK's text transform, LPS, fixed to moving points.
fn write_transform(output: &Output, path: &Path) -> Result<()> {
    let Some(values) = array(output, "rigid").filter(|v| v.len() == 16) else { return Err(missing("rigid transform")) };
    let numbers: Vec<String> =
        [0, 1, 2, 4, 5, 6, 8, 9, 10, 3, 7, 11].iter().map(|&k: &usize| values[k].to_string()).collect();
    let text = format!(
        "#Insight Transform File V1.0\n#Transform 0\nTransform: AffineTransform_double_3_3\nParameters: {}\n\
         FixedParameters: 0 0 0\n",
        numbers.join(" ")
    );
    io::write_atomically(path, |out| out.write_all(text.as_bytes()))
}

/// The figures that Slicer shows beside the module.
pub const RETURN_PARAMETERS: [(&str, &str); 4] = [
    ("number_of_points", "mesh.points"),
    ("number_of_elements", "mesh.elements"),
    ("smallest_dihedral_angle", "quality.min_dihedral"),
    ("seconds", "time.total"),
];

/// Writes `name = value` lines.
///
/// # Errors
/// [`Error::Io`].
pub fn write_return_parameters(statistics: &Statistics, path: &Path) -> Result<()> {
    let mut text = String::new();
    for (name, figure) in RETURN_PARAMETERS {
        if let Some(value) = statistics.value(figure) {
            let _ = writeln!(text, "{name} = {value}");
        }
    }
    io::write_atomically(path, |out| out.write_all(text.as_bytes()))
}

/// One line about what was made.
pub fn summary(kind: JobKind, output: &Output, statistics: &Statistics) -> String {
    let mut parts = Vec::new();
    if let Some(mesh) = &output.mesh {
        parts.push(format!("{} points, {} elements", mesh.points.len(), mesh.element_count()));
    }
    if let (Some(low), Some(high)) =
        (statistics.value("quality.min_dihedral"), statistics.value("quality.max_dihedral"))
    {
        parts.push(format!("dihedral angles {low:.2} to {high:.2} degrees"));
    }
    if let Some((_, image)) = output.images.iter().find(|(n, _)| n == "displacement") {
        let size = image.grid.size();
        parts.push(format!("displacement field of {} x {} x {}", size[0], size[1], size[2]));
    }
    format!("{}: {}", kind.name(), if parts.is_empty() { "done".to_owned() } else { parts.join("; ") })
}
