//! Reading a record at once.

use std::fs;
use std::io::{self, ErrorKind};
use std::path::Path;

/// Larger records are not read into memory.
const MAX_BYTES: u64 = 4 << 30;

/// Reads a regular file: a pipe or a device may never end, and opening a pipe waits for its writer.
///
/// # Errors
/// When the file cannot be read, has more than 4 GiB or is no regular file.
pub fn read_regular(path: &Path) -> io::Result<Vec<u8>> {
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
    fn what_may_have_no_end_is_not_opened() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        fs::write(&path, "all").unwrap();
        assert_eq!(read_regular(&path).unwrap(), b"all");
        fs::File::create(&path).unwrap().set_len(MAX_BYTES + 1).unwrap();
        assert_eq!(read_regular(&path).unwrap_err().kind(), ErrorKind::FileTooLarge);
        let device = read_regular(Path::new("/dev/zero")).unwrap_err();
        assert_eq!(device.to_string(), "it is not a regular file");
        assert_eq!(read_regular(directory.path()).unwrap_err().kind(), ErrorKind::IsADirectory);
    }
}
