//! Passes the commit that the program is built from to the compiler.
#![expect(clippy::disallowed_methods, reason = "a build's settings come from its environment")]

use std::path::{Path, PathBuf};
use std::process::Command;

/// The variable that names the commit where there is no repository, as in a container's build.
const COMMIT: &str = "TANDEM_COMMIT";

fn main() {
    println!("cargo:rerun-if-env-changed={COMMIT}");
    let sources = sources();
    watch(&sources);
    let given = std::env::var(COMMIT).ok().filter(|commit| !commit.is_empty());
    let commit = given.or_else(|| own_commit(&sources));
    let version = env!("CARGO_PKG_VERSION");
    let shown = commit.map_or_else(|| version.to_owned(), |commit| format!("{version} ({commit})"));
    println!("cargo:rustc-env=TANDEM_VERSION={shown}");
}

/// The files and folders that the program is compiled from.
fn sources() -> Vec<PathBuf> {
    let folders = std::fs::read_dir(".").into_iter().flatten().flatten().map(|entry| entry.path());
    // A folder with a lock file is a workspace of its own, which the program does not contain.
    let crates = folders.filter(|folder| !folder.join("Cargo.lock").exists());
    let parts = ["Cargo.toml", "build.rs", "src", "assets", "proto"];
    let of_crates = crates
        .filter(|folder| folder.join("Cargo.toml").exists())
        .flat_map(|folder| parts.map(|part| folder.join(part)));
    let of_root = ["src", "Cargo.toml", "Cargo.lock", "build.rs"].map(PathBuf::from);
    of_root.into_iter().chain(of_crates.filter(|path| path.exists())).collect()
}

/// Runs this script again after a commit and after an edit of the sources.
///
/// The index is not watched: reading commands such as `git status` write to it, and each write would recompile the
/// program.
fn watch(sources: &[PathBuf]) {
    let log = git(&["rev-parse", "--git-path", "logs/HEAD"]).map(PathBuf::from);
    for path in log.iter().filter(|path| path.exists()).chain(sources) {
        println!("cargo:rerun-if-changed={}", path.display());
    }
}

/// Returns the commit of this repository, with `-dirty` when the sources differ from it.
///
/// `None` where the sources lie in a folder of another repository, or in none.
fn own_commit(sources: &[PathBuf]) -> Option<String> {
    if git(&["rev-parse", "--show-prefix"]).is_some() {
        return None;
    }
    let commit = git(&["rev-parse", "--short=12", "HEAD"])?;
    let sources = sources.iter().map(PathBuf::as_path).filter_map(Path::to_str);
    let status = ["status", "--porcelain", "--untracked-files=no", "--"];
    let edits = git(&status.into_iter().chain(sources).collect::<Vec<_>>());
    Some(if edits.is_some() { format!("{commit}-dirty") } else { commit })
}

/// Returns the trimmed output of a git command; `None` when it fails or prints nothing.
///
/// The command takes no lock and so does not refresh the index.
fn git(args: &[&str]) -> Option<String> {
    let output = Command::new("git").arg("--no-optional-locks").args(args).output().ok()?;
    let text = String::from_utf8(output.stdout).ok().filter(|_| output.status.success())?;
    Some(text.trim().to_owned()).filter(|text| !text.is_empty())
}
