//! A disk that fails on demand: a directory, and a shared object preloaded into the programs that write there.

use std::fmt;
use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;

use tempfile::TempDir;

/// `Input/output error`.
pub(crate) const EIO: i32 = 5;
/// `No space left on device`.
pub(crate) const ENOSPC: i32 = 28;

/// The preloaded object, compiled by the compiler of the toolchain that built this test.
static SHIM: LazyLock<(TempDir, PathBuf)> = LazyLock::new(|| {
    let keep = tempfile::tempdir().expect("a directory");
    let path = keep.path().join("libshim.so");
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/disk/shim.rs");
    let compiled = Command::new(Path::new(env!("CARGO")).with_file_name("rustc"))
        .args(["--edition", "2024", "--crate-type", "cdylib", "-O", "-D", "warnings", "-o"])
        .args([&path, &source])
        .output()
        .expect("rustc runs");
    assert!(compiled.status.success(), "{}", String::from_utf8_lossy(&compiled.stderr));
    (keep, path)
});

/// The effect of a fault on the affected call and on later calls.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mode {
    /// A write writes its first half and fails. Later calls succeed.
    Once,
    /// As [`Self::Once`], and all later calls fail.
    Dead,
    /// A write writes its first half and the calling process is killed.
    Kill,
    /// As [`Self::Kill`], and every process that makes a later call is killed. Unsynced data is lost.
    Cut,
}

impl Mode {
    /// Returns the name that the shim uses.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Once => "once",
            Self::Dead => "dead",
            Self::Kill => "kill",
            Self::Cut => "cut",
        }
    }
}

/// A disk fault.
#[derive(Debug, Clone)]
pub(crate) struct Fault {
    pub(crate) mode: Mode,
    pub(crate) errno: i32,
    /// One-based index of the affected call among those whose line contains `pattern`.
    pub(crate) at: usize,
    /// A substring of `NAME PATH`: the called function and the path below the disk's directory.
    pub(crate) pattern: String,
}

impl Fault {
    pub(crate) fn new(mode: Mode, at: usize, pattern: &str) -> Self {
        Self { mode, errno: EIO, at, pattern: pattern.to_owned() }
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { mode, errno, at, pattern } = self;
        write!(formatter, "{mode:?}, error {errno}, at call {at} of {pattern:?}")
    }
}

/// A disk that can fail.
#[derive(Debug)]
pub(crate) struct Device {
    keep: TempDir,
}

impl Device {
    pub(crate) fn new() -> Self {
        let keep = tempfile::tempdir().expect("a directory");
        fs::create_dir(keep.path().join("disk")).expect("creates");
        fs::create_dir(keep.path().join("state")).expect("creates");
        fs::write(keep.path().join("state/counters"), [0; 4096]).expect("writes");
        Self { keep }
    }

    /// Returns the directory whose files fail.
    pub(crate) fn root(&self) -> PathBuf {
        self.keep.path().join("disk")
    }

    /// Returns a path outside the directory, for files that do not fail.
    pub(crate) fn sibling(&self, name: &str) -> PathBuf {
        self.keep.path().join(name)
    }

    /// Attaches the disk to the program that `command` starts and to its child processes.
    pub(crate) fn attach(&self, command: &mut Command, fault: Option<&Fault>) {
        command
            .env("LD_PRELOAD", &SHIM.1)
            .env("FAULTY_DISK_ROOT", self.root())
            .env("FAULTY_DISK_STATE", self.sibling("state"));
        if let Some(Fault { mode, errno, at, pattern }) = fault {
            let mode = mode.name();
            command.env("FAULTY_DISK_FAULT", format!("{mode} {errno} {at} {pattern}"));
        }
    }

    /// Returns true once the fault has been triggered.
    pub(crate) fn is_triggered(&self) -> bool {
        fs::read(self.sibling("state/counters")).expect("readable")[8] == 1
    }

    /// Returns the calls so far. Failed calls start with `! `.
    pub(crate) fn calls(&self) -> Vec<String> {
        let text = fs::read_to_string(self.sibling("state/calls")).unwrap_or_default();
        text.lines().map(str::to_owned).collect()
    }

    /// Discards the data that was not synced before the power cut. File names remain, as on a file system with a
    /// metadata journal.
    pub(crate) fn lose_unsynced(&self) {
        for path in files_below(&self.root()) {
            let inode = fs::metadata(&path).expect("a file").ino();
            let synced =
                fs::read(self.sibling("state").join(inode.to_string())).unwrap_or_default();
            fs::write(&path, synced).expect("writes");
        }
    }
}

fn files_below(directory: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(directory).expect("a directory").flatten().map(|entry| entry.path());
    entries.flat_map(|path| if path.is_dir() { files_below(&path) } else { vec![path] }).collect()
}
