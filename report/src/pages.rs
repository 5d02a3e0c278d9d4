//! Reports as HTML pages that load nothing from elsewhere.

mod comparison;
mod run;
mod trials;

use std::path::{Path, PathBuf};

use crate::comparison::Comparison;
use crate::error::Error;
use crate::files::write_text;
use crate::html::page;
use crate::plots::comparison_plots;
use crate::run::Run;
use crate::trials::{PlottedTrials, Trials};

/// Writes `report.html` into the run directory `run_dir` and returns its path.
///
/// # Errors
/// If the run's metrics cannot be read or the file cannot be written.
pub fn run_report_html(run_dir: &Path) -> Result<PathBuf, Error> {
    let run = Run::load(run_dir, &mut Vec::new())?;
    let path = run_dir.join("report.html");
    write_text(&path, &page(&run.name, &run::body(&run)?))?;
    Ok(path)
}

/// The files of a report.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReportFiles {
    /// The HTML page, which contains all plots.
    pub page: PathBuf,
    /// The plots as SVG files, in the directory of the page.
    pub plots: Vec<PathBuf>,
}

/// Writes a page with the tables and plots of `comparison` and `trials` to `path`, and each plot to an SVG file in the
/// same directory.
///
/// # Errors
/// If a curve cannot be drawn or a file cannot be written.
pub fn report_html(
    comparison: &Comparison,
    trials: &Trials,
    plotted: PlottedTrials,
    path: &Path,
) -> Result<ReportFiles, Error> {
    let curves = comparison_plots(comparison)?;
    let trial_plots = trials.plots(plotted);
    let mut files = ReportFiles { page: path.to_owned(), plots: Vec::new() };
    for plot in curves.iter().chain(&trial_plots) {
        let svg_path = path.with_file_name(&plot.file_name);
        write_text(&svg_path, &plot.svg)?;
        files.plots.push(svg_path);
    }
    let (has_runs, has_trials) = (!comparison.sections.is_empty(), !trials.groups.is_empty());
    let mut body = String::new();
    if has_trials {
        body.push_str(&trials::body(trials, &trial_plots));
    }
    if has_runs || !has_trials {
        body.push_str(&comparison::body(comparison, &curves));
    }
    let title = match (has_runs, has_trials) {
        (true, true) => "Comparison of trials and runs",
        (false, true) => "Comparison of trials",
        (_, false) => "Comparison of runs",
    };
    write_text(path, &page(title, &body))?;
    Ok(files)
}
