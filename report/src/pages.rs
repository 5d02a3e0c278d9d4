//! Reports as HTML pages that load nothing from elsewhere.

mod comparison;
mod figures;
mod run;
mod trials;

use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::bitmap::Converter;
use crate::comparison::{Comparison, FilmStrip};
use crate::error::Error;
use crate::files::{create_directory, write};
use crate::html::page;
use crate::plots::{Plot, comparison_plots};
use crate::run::Run;
use crate::trials::{PlottedTrials, Trials};

/// Writes `report.html` with the film strips `films` into the run directory `run_dir` and returns its path.
///
/// # Errors
/// If the run's metrics cannot be read or the file cannot be written.
pub fn run_report_html(run_dir: &Path, films: &[FilmStrip]) -> Result<PathBuf, Error> {
    let run = Run::load(run_dir, &mut Vec::new())?;
    let path = run_dir.join("report.html");
    write(&path, page(&run.name, &run::body(&run, films)?).as_bytes())?;
    Ok(path)
}

/// The files of a report.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReportFiles {
    /// The HTML page, which contains all plots.
    pub page: PathBuf,
    /// The plots as SVG files, the curves also as PNG files of twice the size, and the film strips as PNG files, in a
    /// directory named after the page: `report-figures` beside `report.html`.
    pub plots: Vec<PathBuf>,
}

/// Writes a page with the tables, plots and film strips of `comparison` and `trials` to `path`, and each figure to a
/// file in a directory beside it; see [`ReportFiles`]. It removes the figures of an earlier report there.
///
/// # Errors
/// If a curve cannot be drawn, or a file cannot be written or removed.
pub fn report_html(
    comparison: &Comparison,
    trials: &Trials,
    plotted: PlottedTrials,
    path: &Path,
) -> Result<ReportFiles, Error> {
    let curves = comparison_plots(comparison)?;
    let trial_plots = trials.plots(plotted);
    let mut files = ReportFiles { page: path.to_owned(), plots: Vec::new() };
    let svgs = curves.all().chain(&trial_plots);
    let svgs = svgs.map(|plot| (PathBuf::from(&plot.file_name), plot.svg.as_bytes()));
    let pngs = pngs(curves.all())?;
    let pngs = pngs.iter().map(|(file_name, png)| (file_name.clone(), png.as_slice()));
    let films = comparison.films.iter();
    let films = films.map(|film| (PathBuf::from(&film.file_name), film.png.as_slice()));
    let directory = figures::directory(path);
    for (file_name, content) in svgs.chain(pngs).chain(films) {
        if files.plots.is_empty() {
            create_directory(&directory)?;
        }
        let figure = directory.join(file_name);
        write(&figure, content)?;
        files.plots.push(figure);
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
    write(path, page(title, &body).as_bytes())?;
    figures::remove_former(&directory, &files.plots)?;
    Ok(files)
}

/// Returns the plots as PNG, each with the name of its file.
fn pngs<'a>(plots: impl Iterator<Item = &'a Plot>) -> Result<Vec<(PathBuf, Vec<u8>)>, Error> {
    let plots: Vec<&Plot> = plots.collect();
    let converter = Converter::new();
    let pngs = plots.par_iter().map(|plot| {
        let file_name = Path::new(&plot.file_name).with_extension("png");
        Ok((file_name, converter.png(&plot.svg, &plot.title)?))
    });
    pngs.collect()
}
