//! Files that appear whole or not at all.
//!
//! # Method
//! The bytes go to a temporary file beside the target, which then takes the target's name in one step. A target that
//! is no regular file (a pipe, a device) cannot be replaced and is written directly.
//!
//! # Invariants
//! After an error neither the target nor the temporary file was left changed or behind.

use std::fs::{self, File, OpenOptions};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};

/// Bytes collected before the system is asked to write: large enough that calls do not count.
const BUFFER_BYTES: usize = 1 << 20;

/// Calls `fill` with a buffered writer whose bytes become the file `path`.
///
/// # Errors
/// [`Error::Io`] with the system's reason.
pub fn write_atomically(path: &Path, fill: impl FnOnce(&mut dyn Write) -> std::io::Result<()>) -> Result<()> {
    let io_error = |source| Error::io(path, source);
    // Through a symbolic link the file it points to is replaced, not the link.
    let target = fs::canonicalize(path).unwrap_or_else(|_| path.to_path_buf());
    if fs::metadata(&target).is_ok_and(|m| !m.is_file() && !m.is_dir()) {
        let mut writer =
            BufWriter::with_capacity(BUFFER_BYTES, OpenOptions::new().write(true).open(&target).map_err(io_error)?);
        return fill(&mut writer).and_then(|()| writer.flush()).map_err(io_error);
    }
    if target.is_dir() {
        return Err(io_error(std::io::Error::from(std::io::ErrorKind::IsADirectory)));
    }
    let mut builder = tempfile::Builder::new();
    builder.prefix(".meshwright-").suffix(".part");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        // As any new file: the umask takes its part when the file is opened.
        builder.permissions(fs::Permissions::from_mode(0o666));
    }
    let temporary = builder.tempfile_in(parent_of(&target)).map_err(|e| io_error(plain_error(e)))?;
    let mut writer = BufWriter::with_capacity(BUFFER_BYTES, temporary);
    fill(&mut writer).and_then(|()| writer.flush()).map_err(io_error)?;
    let temporary = writer.into_inner().map_err(|e| io_error(e.into_error()))?;
    temporary.persist(&target).map_err(|e| io_error(e.error))?;
    Ok(())
}

/// Checks that `path` could be written later: its folder exists. Long runs ask before they start.
///
/// # Errors
/// [`Error::Io`].
pub fn check_writable(path: &Path) -> Result<()> {
    let parent = parent_of(path);
    let metadata = fs::metadata(&parent).map_err(|source| Error::io(path, source))?;
    if !metadata.is_dir() {
        return Err(Error::io(path, std::io::Error::from(std::io::ErrorKind::NotADirectory)));
    }
    if path.is_dir() {
        return Err(Error::io(path, std::io::Error::from(std::io::ErrorKind::IsADirectory)));
    }
    Ok(())
}

fn parent_of(path: &Path) -> PathBuf {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent.to_path_buf(),
        _ => PathBuf::from("."),
    }
}

/// The system's error without the name of the temporary file, which means nothing to the caller.
fn plain_error(error: std::io::Error) -> std::io::Error {
    error.raw_os_error().map_or_else(|| std::io::Error::from(error.kind()), std::io::Error::from_raw_os_error)
}

/// Opens a file for reading and tells its length.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] for an empty file.
pub fn open(path: &Path) -> Result<(File, u64)> {
    let file = File::open(path).map_err(|source| Error::io(path, source))?;
    let metadata = file.metadata().map_err(|source| Error::io(path, source))?;
    if metadata.is_dir() {
        return Err(Error::io(path, std::io::Error::from(std::io::ErrorKind::IsADirectory)));
    }
    if metadata.is_file() && metadata.len() == 0 {
        return Err(Error::format(path, "the file is empty"));
    }
    Ok((file, metadata.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_the_old_file_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.txt");
        write_atomically(&path, |w| w.write_all(b"old")).unwrap();
        let failed = write_atomically(&path, |w| {
            w.write_all(b"new")?;
            Err(std::io::Error::other("stop"))
        });
        assert!(matches!(failed, Err(Error::Io { .. })));
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_missing_folder_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("missing/a.txt");
        assert!(matches!(write_atomically(&path, |w| w.write_all(b"x")), Err(Error::Io { .. })));
        assert!(check_writable(&path).is_err());
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_disk_is_an_error() {
        let path = Path::new("/dev/full");
        assert!(matches!(write_atomically(path, |w| w.write_all(&[0; 100])), Err(Error::Io { .. })));
    }
}
