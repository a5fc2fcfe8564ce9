//! `meshwright convert IN OUT`: the file names say the formats.

use clap::ArgMatches;
use meshwright::{Error, Result, io};

use crate::arguments;

/// Reads one file and writes the other.
///
/// # Errors
/// Those of the reader and the writer.
pub fn run(matches: &ArgMatches) -> Result<()> {
    let input = arguments::path(matches, "input").expect("clap requires the input");
    let output = arguments::path(matches, "output").expect("clap requires the output");
    io::check_writable(output)?;
    if io::is_image_path(output) {
        return io::write_image(&io::read_image(input)?, output);
    }
    Err(Error::Unsupported { reason: format!("{}: unknown ending", output.display()) })
}
