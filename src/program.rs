//! The file and the name with which this program starts itself again.

use std::ffi::OsString;
use std::io;
use std::path::{Path, PathBuf};

/// The link to the file of the running program. It leads there even if the file has been replaced or removed.
#[cfg(target_os = "linux")]
const RUNNING: &str = "/proc/self/exe";

/// Returns a path that starts the running build of this program. On Linux, it does so even if the program's file has
/// been removed or replaced by another build since the start.
pub(crate) fn file() -> io::Result<PathBuf> {
    #[cfg(target_os = "linux")]
    if Path::new(RUNNING).exists() {
        return Ok(RUNNING.into());
    }
    std::env::current_exe()
}

/// Returns the name with which this program was started.
pub(crate) fn name() -> OsString {
    std::env::args_os().next().unwrap_or_else(|| "tandem".into())
}

/// Names this process after the program: the system would call it `exe`, after the path that started it.
pub(crate) fn set_process_name() {
    #[cfg(target_os = "linux")]
    rustix::thread::set_name(c"tandem").ok();
}
