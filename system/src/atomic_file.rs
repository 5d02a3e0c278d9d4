//! Files that are replaced atomically.
//!
//! The new contents go to a temporary file in the same directory, which is synced and then renamed. At any moment, even
//! after a power cut, the path leads to the complete old file or to the complete new one. The temporary file of a
//! killed writer stays and is overwritten by the next one. Writers of the same path must exclude one another, for
//! example with a [`DirectoryLock`](crate::DirectoryLock).

use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

/// Extension of temporary files. It is appended to the whole file name.
pub const TEMPORARY_EXTENSION: &str = "tmp";

/// Replaces the file `path` with `bytes`.
///
/// # Errors
/// As [`replace_with`].
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    replace_with(path, |mut file| file.write_all(bytes))
}

/// Replaces the file that `path` names with `bytes`, or writes them to it if it is no regular file, as `/dev/stdout`.
/// If `path` is a link, the file that it leads to is replaced.
///
/// # Errors
/// As [`replace_with`].
pub fn replace_target(path: &Path, bytes: &[u8]) -> io::Result<()> {
    match fs::metadata(path) {
        Ok(metadata) if !metadata.is_file() => fs::write(path, bytes),
        Ok(_) => replace(&fs::canonicalize(path)?, bytes),
        Err(_) => replace(path, bytes),
    }
}

/// Replaces the file `path` with what `write` writes, and returns the value of `write`.
///
/// # Errors
/// When `write` fails or the file system refuses. The temporary file is then removed and the old file is unchanged,
/// unless only the sync of the directory failed.
pub fn replace_with<T, E: From<io::Error>>(
    path: &Path,
    write: impl FnOnce(&File) -> Result<T, E>,
) -> Result<T, E> {
    let temporary = temporary_path(path)?;
    let replaced = File::create(&temporary).map_err(E::from).and_then(|file| {
        let value = write(&file)?;
        publish(&file, &temporary, path)?;
        Ok(value)
    });
    if replaced.is_err() {
        drop(fs::remove_file(&temporary));
    }
    replaced
}

/// Syncs `file`, renames it from `temporary` to `path` in the same directory and syncs the directory.
///
/// # Errors
/// When the file system refuses. Unlike [`replace_with`], this function keeps the temporary file.
pub fn publish(file: &File, temporary: &Path, path: &Path) -> io::Result<()> {
    file.sync_all()?;
    fs::rename(temporary, path)?;
    sync_parent(path)
}

/// Creates `directory` with its parents, unless it exists, and syncs every directory that contains a new one.
///
/// # Errors
/// When the file system refuses.
pub fn create_directory(directory: &Path) -> io::Result<()> {
    if directory.is_dir() || directory.as_os_str().is_empty() {
        return Ok(());
    }
    let created = match (fs::create_dir(directory), directory.parent()) {
        (Err(error), Some(parent)) if error.kind() == io::ErrorKind::NotFound => {
            create_directory(parent)?;
            fs::create_dir(directory)
        }
        (created, _) => created,
    };
    match created {
        // Another process was faster, whose sync may still be due.
        Err(error) if !directory.is_dir() => Err(error),
        _ => sync_parent(directory),
    }
}

/// Syncs the names in the directory that contains `path`.
fn sync_parent(path: &Path) -> io::Result<()> {
    let Some(parent) = path.parent() else { return Ok(()) };
    let parent = if parent.as_os_str().is_empty() { Path::new(".") } else { parent };
    File::open(parent)?.sync_all()
}

fn temporary_path(path: &Path) -> io::Result<PathBuf> {
    let mut name = path.file_name().ok_or(io::ErrorKind::InvalidFilename)?.to_owned();
    name.push(".");
    name.push(TEMPORARY_EXTENSION);
    Ok(path.with_file_name(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(directory: &Path) -> Vec<String> {
        let entries = fs::read_dir(directory).expect("readable");
        let name = |entry: io::Result<fs::DirEntry>| entry.expect("an entry").file_name();
        let mut names: Vec<_> =
            entries.map(|entry| name(entry).into_string().expect("UTF-8")).collect();
        names.sort();
        names
    }

    #[test]
    fn a_file_is_created_and_replaced() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("run.toml");
        for contents in ["first", "", "a longer text"] {
            replace(&path, contents.as_bytes()).expect("writes");
            assert_eq!(fs::read_to_string(&path).expect("readable"), contents);
        }
        assert_eq!(names(directory.path()), ["run.toml"]);
    }

    #[test]
    fn the_target_of_a_link_is_replaced_and_a_device_is_written() {
        let directory = tempfile::tempdir().expect("a directory");
        let [file, link] = ["page.html", "latest.html"].map(|name| directory.path().join(name));
        replace_target(&file, b"old").expect("writes");
        std::os::unix::fs::symlink(&file, &link).expect("a link");
        replace_target(&link, b"new").expect("writes");
        assert_eq!(fs::read(&file).expect("readable"), b"new");
        assert!(link.is_symlink());
        replace_target(Path::new("/dev/null"), b"nothing").expect("writes");
        assert!(replace_target(directory.path(), b"").is_err());
        assert_eq!(names(directory.path()), ["latest.html", "page.html"]);
    }

    #[test]
    fn a_failed_write_leaves_the_old_file_and_no_temporary_one() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("run.toml");
        replace(&path, b"old").expect("writes");
        let error = replace_with(&path, |mut file| {
            file.write_all(b"half of the n")?;
            Err::<(), _>(io::Error::from(io::ErrorKind::StorageFull))
        });
        assert_eq!(error.expect_err("refused").kind(), io::ErrorKind::StorageFull);
        assert_eq!(fs::read(&path).expect("readable"), b"old");
        assert_eq!(names(directory.path()), ["run.toml"]);
    }

    #[test]
    fn a_failed_rename_keeps_its_error_and_removes_the_temporary_file() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("taken");
        fs::create_dir(&path).expect("creates");
        let error = replace(&path, b"text").expect_err("a directory is in the way");
        assert_eq!(error.kind(), io::ErrorKind::IsADirectory);
        assert_eq!(names(directory.path()), ["taken"]);
        let missing = directory.path().join("missing/file");
        assert_eq!(replace(&missing, b"").expect_err("refused").kind(), io::ErrorKind::NotFound);
        assert_eq!(
            replace(Path::new("/"), b"").expect_err("refused").kind(),
            io::ErrorKind::InvalidFilename
        );
    }

    #[test]
    fn a_temporary_file_left_by_a_killed_writer_is_overwritten() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("policy.safetensors");
        let left = directory.path().join("policy.safetensors.tmp");
        fs::write(&left, "a long text of a killed writer").expect("writes");
        replace(&path, b"new").expect("writes");
        assert_eq!(fs::read(&path).expect("readable"), b"new");
        assert_eq!(names(directory.path()), ["policy.safetensors"]);
    }

    #[test]
    fn directories_are_created_once() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("a/b/c");
        create_directory(&path).expect("creates");
        create_directory(&path).expect("exists");
        create_directory(&directory.path().join("a/d/../e")).expect("creates");
        assert_eq!(names(&directory.path().join("a")), ["b", "d", "e"]);
        assert!(path.is_dir());
        let file = directory.path().join("file");
        fs::write(&file, "").expect("writes");
        let error = create_directory(&file).expect_err("a file is in the way");
        assert_eq!(error.kind(), io::ErrorKind::AlreadyExists);
        let error = create_directory(&file.join("below")).expect_err("a file is in the way");
        assert_eq!(error.kind(), io::ErrorKind::NotADirectory);
    }
}
