//! No file is both read and written, and none is written twice.
//!
//! # Method
//! Two names stand for one file where the system resolves them to one path; of a file that is not there yet the folder is
//! resolved. An `.img` and the `.hdr` beside it are one image.
//!
//! # Limits
//! A second hard link is another file: what is written replaces a name, so that the other keeps the old bytes. Devices and
//! pipes can be named any number of times.

use std::path::{Path, PathBuf};

use clap::ArgMatches;
use meshwright::{Error, Result};

use crate::arguments;

/// An option with the file that it names.
pub type Named<'a> = (&'a str, &'a Path);

/// Refuses outputs that would replace an input or one another.
///
/// # Errors
/// [`Error::ParameterValue`] naming both options.
pub fn refuse_clashes(inputs: &[Named], outputs: &[Named]) -> Result<()> {
    let mut earlier: Vec<(&str, PathBuf)> =
        inputs.iter().filter_map(|(name, path)| Some((*name, resolved(path)?))).collect();
    for (name, path) in outputs {
        let Some(place) = resolved(path) else { continue };
        if let Some((other, _)) = earlier.iter().find(|(_, p)| *p == place) {
            return Err(clash(name, path, other));
        }
        earlier.push((name, place));
    }
    Ok(())
}

/// [`refuse_clashes`] for the arguments of a subcommand that names files in no table.
///
/// # Errors
/// As [`refuse_clashes`].
pub fn refuse_clashes_of(matches: &ArgMatches, inputs: &[&str], outputs: &[&str]) -> Result<()> {
    fn named<'a>(matches: &'a ArgMatches, names: &[&'a str]) -> Vec<Named<'a>> {
        names.iter().filter_map(|name| Some((*name, arguments::path(matches, name)?.as_path()))).collect()
    }
    refuse_clashes(&named(matches, inputs), &named(matches, outputs))
}

/// The refusal of an output that is the file of another option.
pub fn clash(name: &str, path: &Path, other: &str) -> Error {
    let reason = format!("{} is the file of '{other}' too, and would replace it", path.display());
    Error::ParameterValue { name: name.to_owned(), reason }
}

/// The one path of a file; `None` for standard output, devices, and what lies in no folder.
pub fn resolved(path: &Path) -> Option<PathBuf> {
    if path == Path::new("-") || arguments::is_device(path) {
        return None;
    }
    let in_folder = || {
        let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        Some(folder.canonicalize().ok()?.join(path.file_name()?))
    };
    let path = path.canonicalize().ok().or_else(in_folder)?;
    let name = path.file_name()?.to_string_lossy().to_lowercase();
    let is_voxels = [".img", ".img.gz"].iter().find(|ending| name.ends_with(*ending));
    Some(match is_voxels {
        Some(ending) => {
            let whole = path.file_name()?.to_string_lossy().into_owned();
            path.with_file_name(format!("{}{}", &whole[..whole.len() - ending.len()], ending.replace("img", "hdr")))
        }
        None => path,
    })
}
