//! Reads files that the command line names: run files, sweep files, motions, certificates, tokens.
//!
//! They may come from a pipe, as in `--run <(generate)`, whose size and time are limited.

use std::fs::File;
use std::io::{self, ErrorKind, Read as _};
use std::path::Path;
use std::sync::mpsc::sync_channel;
use std::time::Duration;

/// Size limit of a file; a long motion has some megabytes.
const MAX_BYTES: usize = 16 << 20;
/// Time in which a pipe or a device must reach its end.
const TIMEOUT: Duration = Duration::from_secs(10);

/// Reads a text file.
///
/// # Errors
/// When it cannot be read, is not UTF-8, is too large or does not end in time.
pub(crate) fn text(path: &Path) -> io::Result<String> {
    let not_utf8 = |_| io::Error::new(ErrorKind::InvalidData, "it is not UTF-8");
    String::from_utf8(bytes(path)?).map_err(not_utf8)
}

/// Reads a file up to its end.
///
/// # Errors
/// As for [`text`], except that any bytes will do.
pub(crate) fn bytes(path: &Path) -> io::Result<Vec<u8>> {
    let name = path.to_owned();
    in_time(path, move || {
        let mut bytes = Vec::new();
        File::open(name)?.take(MAX_BYTES as u64 + 1).read_to_end(&mut bytes)?;
        if bytes.len() > MAX_BYTES {
            let what = format!("it has more than {} MiB", MAX_BYTES >> 20);
            return Err(io::Error::new(ErrorKind::FileTooLarge, what));
        }
        Ok(bytes)
    })?
}

/// Runs `read`, which reads `path`, with a timeout for pipes and devices: opening a pipe waits for its writer.
///
/// # Errors
/// When the time is over. The waiting thread ends with the process.
pub(crate) fn in_time<T: Send + 'static>(
    path: &Path,
    read: impl FnOnce() -> T + Send + 'static,
) -> io::Result<T> {
    if std::fs::metadata(path).is_ok_and(|file| !file.is_file() && !file.is_dir()) {
        let (sender, receiver) = sync_channel(1);
        std::thread::Builder::new().spawn(move || sender.send(read()).ok())?;
        let what = format!("no end of it came within {TIMEOUT:?}");
        return receiver
            .recv_timeout(TIMEOUT)
            .map_err(|_elapsed| io::Error::new(ErrorKind::TimedOut, what));
    }
    Ok(read())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_read_whole_or_rejected() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("text");
        let read = |content: &[u8]| {
            std::fs::write(&path, content).expect("writes");
            text(&path).map_err(|error| error.to_string())
        };
        assert_eq!(read(b"seed = 1\n").as_deref(), Ok("seed = 1\n"));
        assert_eq!(read(b"\xff").expect_err("no text"), "it is not UTF-8");
        assert_eq!(read(&vec![b'#'; MAX_BYTES]).expect("fits").len(), MAX_BYTES);
        assert_eq!(
            read(&vec![b'#'; MAX_BYTES + 1]).expect_err("too large"),
            "it has more than 16 MiB"
        );
    }

    #[test]
    fn an_endless_device_is_rejected() {
        let error = bytes(Path::new("/dev/zero")).expect_err("endless").to_string();
        assert_eq!(error, "it has more than 16 MiB");
        assert_eq!(bytes(Path::new("/dev/null")).expect("is empty"), b"");
    }
}
