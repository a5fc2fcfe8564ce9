//! `meshwright convert IN OUT`: the file names say the formats.

use std::path::Path;

use clap::ArgMatches;
use meshwright::io::SurfaceExport;
use meshwright::mesh::mixed_mesh::Space;
use meshwright::{Error, Result, io};

use crate::arguments::{self, Content};
use crate::file_names;

/// Reads one file and writes the other.
///
/// # Errors
/// Those of the reader and the writer; [`Error::Unsupported`] between an image and a mesh.
pub fn run(matches: &ArgMatches) -> Result<()> {
    let input = arguments::path(matches, "input").expect("clap requires the input");
    let output = arguments::path(matches, "output").expect("clap requires the output");
    file_names::refuse_clashes_of(matches, &["input"], &["output"])?;
    if io::is_image_path(output) {
        io::check_writable(output)?;
        if io::is_mesh_path(input) {
            return Err(no_way(input, output));
        }
        return io::write_image(&io::read_image(input)?, output);
    }
    let options = arguments::write_options(matches, output, Content::Any)?;
    io::check_writable(output)?;
    if io::is_image_path(input) {
        return Err(no_way(input, output));
    }
    let content = io::read_content(input)?;
    match content {
        io::Content::Mesh(mesh) => io::write_mesh(&mesh, output, &options),
        io::Content::Surface(surface, space) => {
            let space = if space == Space::Unspecified { options.space.unwrap_or(space) } else { space };
            io::write_surface_export(&SurfaceExport::of_surface(&surface, space), output, &options)
        }
    }
}

fn no_way(input: &Path, output: &Path) -> Error {
    let reason =
        format!("{} to {}: images and meshes are not converted into one another", input.display(), output.display());
    Error::Unsupported { reason }
}
