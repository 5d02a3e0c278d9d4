//! Tells the program which commit it was built from.
#![expect(clippy::disallowed_methods, reason = "a build's settings come from its environment")]

use std::path::Path;
use std::process::Command;

/// Set where there is no repository, as in a container's build.
const COMMIT: &str = "TANDEM_COMMIT";

fn main() {
    println!("cargo:rerun-if-env-changed={COMMIT}");
    watch_sources();
    let told = std::env::var(COMMIT).ok().filter(|commit| !commit.is_empty());
    let commit = told.or_else(own_commit);
    let version = env!("CARGO_PKG_VERSION");
    let shown = commit.map_or_else(|| version.to_owned(), |commit| format!("{version} ({commit})"));
    println!("cargo:rustc-env=TANDEM_VERSION={shown}");
}

/// A commit, or an edit that makes the tree differ from it, changes what there is to tell.
fn watch_sources() {
    for name in ["logs/HEAD", "index"] {
        let path = git(&["rev-parse", "--git-path", name]);
        if let Some(path) = path.filter(|path| Path::new(path).exists()) {
            println!("cargo:rerun-if-changed={path}");
        }
    }
    println!("cargo:rerun-if-changed=src");
    let folders = std::fs::read_dir(".").into_iter().flatten().flatten();
    for sources in folders.map(|folder| folder.path().join("src")).filter(|path| path.is_dir()) {
        println!("cargo:rerun-if-changed={}", sources.display());
    }
}

/// The commit of this repository; nothing where the sources lie in somebody else's.
fn own_commit() -> Option<String> {
    let in_folder_of_another = git(&["rev-parse", "--show-prefix"]).is_some();
    let commit = git(&["describe", "--always", "--dirty", "--exclude=*", "--abbrev=12"]);
    commit.filter(|_| !in_folder_of_another)
}

/// What git says on one line; nothing where there is no git or no repository.
fn git(args: &[&str]) -> Option<String> {
    let output =
        Command::new("git").args(args).output().ok().filter(|output| output.status.success())?;
    let text = String::from_utf8(output.stdout).ok()?;
    Some(text.trim().to_owned()).filter(|text| !text.is_empty())
}
