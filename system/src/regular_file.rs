//! Reading files of bounded size into memory.

use std::fs;
use std::io::{self, ErrorKind};
use std::path::Path;

/// Larger files are refused.
const MAX_BYTES: u64 = 4 << 30;

/// Reads a regular file. Pipes and devices are refused: they may never end, and opening a pipe waits for its writer.
///
/// # Errors
/// When the file cannot be read, has more than 4 GiB or is not a regular file.
pub fn read(path: &Path) -> io::Result<Vec<u8>> {
    let file = fs::metadata(path)?;
    if !file.is_file() && !file.is_dir() {
        return Err(io::Error::new(ErrorKind::InvalidInput, "it is not a regular file"));
    }
    if file.len() > MAX_BYTES {
        return Err(io::Error::new(ErrorKind::FileTooLarge, "it has more than 4 GiB"));
    }
    fs::read(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_files_devices_and_directories_are_refused() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("file");
        fs::write(&path, "all").expect("writes");
        assert_eq!(read(&path).expect("readable"), b"all");
        let file = fs::File::create(&path).expect("creates");
        file.set_len(MAX_BYTES + 1).expect("a sparse file");
        assert_eq!(read(&path).expect_err("too large").kind(), ErrorKind::FileTooLarge);
        let device = read(Path::new("/dev/zero")).expect_err("a device");
        assert_eq!(device.to_string(), "it is not a regular file");
        assert_eq!(
            read(directory.path()).expect_err("a directory").kind(),
            ErrorKind::IsADirectory
        );
    }
}
