//! Run directories.

use std::io::ErrorKind;
use std::path::Path;

use anyhow::anyhow;

use crate::exit::{Exit, Failed};

/// Rejects a path at which no directory can be created: a file, or a path below one.
pub(crate) fn check_path(out: &Path) -> Result<(), Failed> {
    let is_in_the_way = |path: &&Path| path.exists() && !path.is_dir();
    match out.ancestors().find(is_in_the_way) {
        Some(file) if file == out => Err(Failed::usage(format!(
            "--out {}: it is a file, expected a directory for the run",
            out.display()
        ))),
        Some(file) => Err(Failed::usage(format!(
            "--out {}: {} is a file, expected a directory",
            out.display(),
            file.display()
        ))),
        None => Ok(()),
    }
}

/// Creates the directory `out` unless it exists.
pub(crate) fn create(out: &Path) -> Result<(), Failed> {
    check_path(out)?;
    std::fs::create_dir_all(out).map_err(|error| {
        let exit = match error.kind() {
            ErrorKind::InvalidFilename | ErrorKind::InvalidInput => Exit::Usage,
            _ => Exit::TryAgain,
        };
        Failed::new(exit, anyhow!(error).context(format!("cannot create {}", out.display())))
    })
}
