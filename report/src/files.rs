//! Reading of input files, and writing of reports.

use std::io::ErrorKind;
use std::path::Path;

use serde::de::DeserializeOwned;
use tandem_system::{atomic_file, regular_file};

use crate::error::Error;

/// The first line of a file that is not a row.
#[derive(Debug)]
pub(crate) struct InvalidLine {
    /// Number of the line, from 1.
    pub(crate) line: usize,
    /// The cause.
    pub(crate) problem: String,
}

impl InvalidLine {
    /// Returns a warning that rows of `path` from this line on are ignored; `kind` is what a row should be.
    pub(crate) fn warning(&self, path: &Path, kind: &str) -> String {
        let Self { line, problem } = self;
        format!(
            "{}, line {line}, is not a {kind} ({problem}); it and the following lines are ignored",
            path.display()
        )
    }
}

/// Reads the rows of a JSON Lines file up to the first invalid line.
pub(crate) fn read_rows<T: DeserializeOwned>(
    path: &Path,
) -> Result<(Vec<T>, Option<InvalidLine>), Error> {
    let bytes = read_bytes(path)?;
    let mut rows = Vec::new();
    for (line_idx, line) in bytes.split_inclusive(|byte| *byte == b'\n').enumerate() {
        match serde_json::from_slice(line) {
            Ok(row) => rows.push(row),
            Err(error) => {
                let text = error.to_string();
                // The parser counts lines within the single line that it was given.
                let problem = text.split(" at line ").next().unwrap_or(&text).to_owned();
                return Ok((rows, Some(InvalidLine { line: line_idx + 1, problem })));
            }
        }
    }
    Ok((rows, None))
}

/// Reads a regular file.
pub(crate) fn read_bytes(path: &Path) -> Result<Vec<u8>, Error> {
    regular_file::read(path).map_err(read_error(path))
}

/// Reads a text file, or returns `None` if it does not exist.
pub(crate) fn read_if_present(path: &Path) -> Result<Option<String>, Error> {
    match read_text(path) {
        Ok(text) => Ok(Some(text)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(read_error(path)(error)),
    }
}

/// Reads a text from a regular file.
pub(crate) fn read_text(path: &Path) -> std::io::Result<String> {
    let not_utf8 = |_| std::io::Error::new(ErrorKind::InvalidData, "it is not UTF-8");
    String::from_utf8(regular_file::read(path)?).map_err(not_utf8)
}

/// Writes `content` to `path`. A former file stays as it is if that fails.
pub(crate) fn write(path: &Path, content: &[u8]) -> Result<(), Error> {
    atomic_file::replace_target(path, content).map_err(write_error(path))
}

/// Creates a directory unless it exists.
pub(crate) fn create_directory(path: &Path) -> Result<(), Error> {
    std::fs::create_dir_all(path).map_err(write_error(path))
}

/// Returns a function for `map_err` on writing `path`.
fn write_error(path: &Path) -> impl FnOnce(std::io::Error) -> Error {
    move |source| Error::Io { action: "write", path: path.to_owned(), source }
}

/// Returns a function for `map_err` on reading `path`.
pub(crate) fn read_error(path: &Path) -> impl FnOnce(std::io::Error) -> Error {
    move |source| Error::Io { action: "read", path: path.to_owned(), source }
}
