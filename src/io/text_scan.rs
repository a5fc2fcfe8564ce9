//! Words and numbers of a text file, with the line for messages.
//!
//! # Invariants
//! A count is believed only as far as the rest of the file could hold it: [`TextScan::count`].

use std::path::{Path, PathBuf};

use super::atomic_file::open;
use crate::error::{Error, Result};

/// A file in memory with a reading position.
pub struct TextScan {
    bytes: Vec<u8>,
    at: usize,
    path: PathBuf,
    comment: u8,
}

/// The whole of a file.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] for an empty file, [`Error::OutOfMemory`].
pub fn read_whole(path: &Path) -> Result<Vec<u8>> {
    use std::io::Read;
    let (mut file, length) = open(path)?;
    let mut bytes = Vec::new();
    bytes.try_reserve_exact(length as usize).map_err(|_| Error::OutOfMemory { what: "file", bytes: length })?;
    file.read_to_end(&mut bytes).map_err(|source| Error::io(path, source))?;
    if bytes.is_empty() {
        return Err(Error::format(path, "the file is empty"));
    }
    Ok(bytes)
}

impl TextScan {
    /// Reads a file whose comments run from `comment` to the end of the line (0: none).
    ///
    /// # Errors
    /// As [`read_whole`].
    pub fn open(path: &Path, comment: u8) -> Result<Self> {
        Ok(Self::new(read_whole(path)?, path, comment))
    }

    /// Scans bytes already read.
    pub fn new(bytes: Vec<u8>, path: &Path, comment: u8) -> Self {
        Self { bytes, at: 0, path: path.to_path_buf(), comment }
    }

    /// The bytes of the whole file.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Position of the next byte.
    pub fn position(&self) -> usize {
        self.at
    }

    /// Goes to a byte.
    pub fn seek(&mut self, at: usize) {
        self.at = at.min(self.bytes.len());
    }

    /// Line of the next byte, from 1.
    pub fn line_number(&self) -> usize {
        1 + self.bytes[..self.at].iter().filter(|&&b| b == b'\n').count()
    }

    /// An error at the present line.
    pub fn refuse(&self, reason: impl std::fmt::Display) -> Error {
        Error::format(&self.path, format!("line {}: {reason}", self.line_number()))
    }

    /// The path, for messages.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The next word, `None` at the end.
    pub fn word(&mut self) -> Option<&str> {
        self.skip_space();
        let begin = self.at;
        while self.at < self.bytes.len()
            && !self.bytes[self.at].is_ascii_whitespace()
            && (self.comment == 0 || self.bytes[self.at] != self.comment)
        {
            self.at += 1;
        }
        // Words of a binary file are no numbers and no keywords: an empty word is refused by whoever parses it.
        (self.at > begin).then(|| std::str::from_utf8(&self.bytes[begin..self.at]).unwrap_or(""))
    }

    /// The next word without moving past it; [`TextScan::line`] then gives the line that the word is on.
    pub fn peek(&mut self) -> Option<String> {
        self.skip_space();
        let at = self.at;
        let word = self.word().map(str::to_owned);
        self.at = at;
        word
    }

    /// The rest of the present line without comment, trimmed; `None` at the end of the file.
    pub fn line(&mut self) -> Option<&str> {
        if self.at >= self.bytes.len() {
            return None;
        }
        let begin = self.at;
        let end = self.bytes[begin..].iter().position(|&b| b == b'\n').map_or(self.bytes.len(), |n| begin + n);
        self.at = (end + 1).min(self.bytes.len());
        let line = &self.bytes[begin..end];
        let stop = if self.comment == 0 { None } else { line.iter().position(|&b| b == self.comment) };
        Some(std::str::from_utf8(&line[..stop.unwrap_or(line.len())]).unwrap_or("").trim())
    }

    /// Refuses what follows the last row that the file claims.
    ///
    /// # Errors
    /// [`Error::Format`] with the line, what stands there, and `claims`, the counts that are wrong then.
    pub fn expect_end(&mut self, claims: impl std::fmt::Display) -> Result<()> {
        match self.peek() {
            None => Ok(()),
            Some(word) => {
                let text: String = word.chars().take(40).collect();
                Err(self.refuse(format!("'{text}' where the file should end: more than the {claims} claimed")))
            }
        }
    }

    /// Whether only white space and comments follow.
    pub fn at_end(&mut self) -> bool {
        self.skip_space();
        self.at >= self.bytes.len()
    }

    fn skip_space(&mut self) {
        while self.at < self.bytes.len() {
            let byte = self.bytes[self.at];
            if self.comment != 0 && byte == self.comment {
                while self.at < self.bytes.len() && self.bytes[self.at] != b'\n' {
                    self.at += 1;
                }
            } else if byte.is_ascii_whitespace() {
                self.at += 1;
            } else {
                break;
            }
        }
    }

    fn number<T: std::str::FromStr>(&mut self, what: &str) -> Result<T> {
        let Some(word) = self.word() else { return Err(self.refuse(format!("the file ends where {what} should be"))) };
        match word.parse() {
            Ok(value) => Ok(value),
            Err(_) => {
                let text: String = word.chars().take(40).collect();
                Err(self.refuse(format!("'{text}' is not {what}")))
            }
        }
    }

    /// The next word as a real number; `nan` and `inf` are numbers here.
    ///
    /// # Errors
    /// [`Error::Format`] with the line.
    pub fn real(&mut self) -> Result<f64> {
        self.number("a number")
    }

    /// The next word as a whole number.
    ///
    /// # Errors
    /// [`Error::Format`] with the line.
    pub fn integer(&mut self) -> Result<i64> {
        self.number("a whole number")
    }

    /// Three reals.
    ///
    /// # Errors
    /// [`Error::Format`] with the line.
    pub fn point(&mut self) -> Result<glam::DVec3> {
        Ok(glam::DVec3::new(self.real()?, self.real()?, self.real()?))
    }

    /// Three reals: point `number`, from 0, of as many as the file claims.
    ///
    /// # Errors
    /// [`Error::Format`] with the line and the claim, which is wrong where something else stands in the point's place.
    pub fn point_of(&mut self, number: usize, claimed: usize) -> Result<glam::DVec3> {
        let at = self.at;
        let Ok(x) = self.real() else {
            self.at = at;
            let text: String = self.peek().unwrap_or_else(|| "the end of the file".into()).chars().take(40).collect();
            return Err(
                self.refuse(format!("'{text}' where point {number} should begin; {claimed} points are claimed"))
            );
        };
        Ok(glam::DVec3::new(x, self.real()?, self.real()?))
    }

    /// A count of things of at least `letters` bytes each.
    ///
    /// # Errors
    /// [`Error::Format`] for a negative count, or one that the rest of the file cannot hold.
    pub fn count(&mut self, what: &str, letters: usize) -> Result<usize> {
        let count: i64 = self.number(what)?;
        self.believable(count, what, letters)
    }

    /// Checks a count that was read elsewhere.
    ///
    /// # Errors
    /// As [`TextScan::count`].
    pub fn believable(&self, count: i64, what: &str, letters: usize) -> Result<usize> {
        let rest = self.bytes.len() - self.at;
        match usize::try_from(count) {
            // The last thing needs no separator behind it.
            Ok(count) if count.saturating_mul(letters) <= rest + 1 => Ok(count),
            _ => Err(self.refuse(format!("{count} {what} are claimed, {rest} bytes follow"))),
        }
    }
}
