//! Files that are replaced as a whole.

use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::Path;

/// Writes beside `path`, syncs and renames: at any moment, a power cut included, `path` is the old file or the new one.
///
/// # Errors
/// When the file system refuses; the old file is then untouched, unless only the rename could not be synced.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let unfinished = path.with_extension("tmp");
    let written = File::create(&unfinished)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_all()))
        .and_then(|()| fs::rename(&unfinished, path));
    if written.is_err() {
        drop(fs::remove_file(&unfinished));
    }
    written?;
    path.parent().filter(|parent| parent.is_dir()).map_or(Ok(()), sync_directory)
}

/// Makes sure that the names in `directory` are on the disk.
pub(crate) fn sync_directory(directory: &Path) -> io::Result<()> {
    File::open(directory)?.sync_all()
}
