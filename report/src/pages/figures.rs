//! The files of a page's figures.

use std::path::{Path, PathBuf};

use crate::error::Error;
use crate::files::read_error;
use crate::{plots, trials};

/// Returns the directory of the figures of the page at `path`.
pub(super) fn directory(path: &Path) -> PathBuf {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!("{stem}-figures"))
}

/// Removes the figures in `directory` that are not in `written`: those of an earlier report. Files with names that no
/// figure has are kept.
pub(super) fn remove_former(directory: &Path, written: &[PathBuf]) -> Result<(), Error> {
    if !directory.is_dir() {
        return Ok(());
    }
    for entry in std::fs::read_dir(directory).map_err(read_error(directory))? {
        let entry = entry.map_err(read_error(directory))?;
        let path = entry.path();
        let is_figure = entry.file_name().to_str().is_some_and(is_figure);
        let is_file = entry.file_type().is_ok_and(|file_type| file_type.is_file());
        if is_figure && is_file && !written.contains(&path) {
            std::fs::remove_file(&path).map_err(|source| Error::Io {
                action: "remove",
                path,
                source,
            })?;
        }
    }
    Ok(())
}

/// Returns true if reports give files this name.
fn is_figure(name: &str) -> bool {
    match name.rsplit_once('.') {
        Some((stem, "svg")) => plots::is_file_stem(stem) || trials::is_file_stem(stem),
        Some((stem, "png")) => plots::is_file_stem(stem) || is_film(stem),
        _ => false,
    }
}

fn is_film(stem: &str) -> bool {
    let parts: Vec<&str> = stem.split('-').collect();
    matches!(parts[..], ["film", number, "success" | "failure"] if number.parse::<usize>().is_ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_recognised_by_their_names() {
        for name in [
            "push-2-success-environment-steps-strategies.svg",
            "push-2-success-environment-steps-strategies.png",
            "push-success-without-contact-environment-steps-mc-act-abs.svg",
            "lab~reach-2-mean-q-paper-epochs-others-12.svg",
            "pick-and-place-from-scratch.svg",
            "trial-push-student-push-1.5-closed-loop-seed777-4.svg",
            "trial-push-student-open-loop-seed1-4-again2.svg",
            "film-1-success.png",
            "film-12-failure.png",
        ] {
            assert!(is_figure(name), "{name}");
        }
        for name in [
            "mine.svg",
            "push-2-success-environment-steps.svg",
            "push-2-success-environment-steps-mine.svg",
            "push-2-success-environment-steps-others-x.svg",
            "push-2-success-environment-steps-strategies.gif",
            "mine-from-scratch.svg",
            "trial-push-seed1.svg",
            "trial-push-seed1-2-mine.svg",
            "film-mine.png",
            "film-1-success.svg",
            "film-1-success.png.bak",
        ] {
            assert!(!is_figure(name), "{name}");
        }
    }

    #[test]
    fn former_figures_are_removed_and_other_files_are_kept() {
        let parent = tempfile::tempdir().unwrap();
        let figures = directory(&parent.path().join("a.html"));
        remove_former(&figures, &[]).unwrap();
        std::fs::create_dir_all(figures.join("film-3-success.png")).unwrap();
        for name in ["film-1-success.png", "film-2-success.png", "mine.png"] {
            std::fs::write(figures.join(name), "").unwrap();
        }
        remove_former(&figures, &[figures.join("film-1-success.png")]).unwrap();
        let names = std::fs::read_dir(&figures).unwrap().flatten().map(|entry| entry.file_name());
        let mut names: Vec<_> = names.map(|name| name.into_string().unwrap()).collect();
        names.sort();
        assert_eq!(names, ["film-1-success.png", "film-3-success.png", "mine.png"]);
    }
}
