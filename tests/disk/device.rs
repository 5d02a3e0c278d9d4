//! A disk that fails on demand: a directory, and an object that is preloaded into the programs that write there.

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

/// What the call that is hit does, and later ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mode {
    /// A write writes its first half; the call fails. Later calls succeed.
    Once,
    /// The same, and later calls fail.
    Dead,
    /// A write writes its first half; the process that called is killed.
    Kill,
    /// The same, and so is every process that makes a later call. What was not synced is lost.
    Cut,
}

impl Mode {
    /// As the shim calls it.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Once => "once",
            Self::Dead => "dead",
            Self::Kill => "kill",
            Self::Cut => "cut",
        }
    }
}

/// A fault of the disk.
#[derive(Debug, Clone)]
pub(crate) struct Fault {
    pub(crate) mode: Mode,
    pub(crate) errno: i32,
    /// Which call is hit, from 1, of those whose line contains `pattern`.
    pub(crate) at: usize,
    /// A part of `NAME PATH`: the called function and the path below the disk's directory.
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

/// A disk.
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

    /// The directory whose files fail.
    pub(crate) fn root(&self) -> PathBuf {
        self.keep.path().join("disk")
    }

    /// A path beside the directory, for files that do not fail.
    pub(crate) fn beside(&self, name: &str) -> PathBuf {
        self.keep.path().join(name)
    }

    /// Lets the program that `command` starts, and all that it starts, use the disk.
    pub(crate) fn attach(&self, command: &mut Command, fault: Option<&Fault>) {
        command
            .env("LD_PRELOAD", &SHIM.1)
            .env("FAULTY_DISK_ROOT", self.root())
            .env("FAULTY_DISK_STATE", self.beside("state"));
        if let Some(Fault { mode, errno, at, pattern }) = fault {
            let mode = mode.name();
            command.env("FAULTY_DISK_FAULT", format!("{mode} {errno} {at} {pattern}"));
        }
    }

    /// Whether the fault has been hit.
    pub(crate) fn is_hit(&self) -> bool {
        fs::read(self.beside("state/counters")).expect("readable")[8] == 1
    }

    /// The calls until now; `! ` stands before those that failed.
    pub(crate) fn calls(&self) -> Vec<String> {
        let text = fs::read_to_string(self.beside("state/calls")).unwrap_or_default();
        text.lines().map(str::to_owned).collect()
    }

    /// Takes from every file what was not synced before the power was cut. Names stay as they are, as on a file system
    /// with a journal of its metadata.
    pub(crate) fn lose_unsynced(&self) {
        for path in files_below(&self.root()) {
            let inode = fs::metadata(&path).expect("a file").ino();
            let synced = fs::read(self.beside("state").join(inode.to_string())).unwrap_or_default();
            fs::write(&path, synced).expect("writes");
        }
    }
}

fn files_below(directory: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(directory).expect("a directory").flatten().map(|entry| entry.path());
    entries.flat_map(|path| if path.is_dir() { files_below(&path) } else { vec![path] }).collect()
}
