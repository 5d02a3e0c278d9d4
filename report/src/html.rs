//! Reports as one HTML file that needs nothing else.

use std::path::{Path, PathBuf};

use tandem_telemetry::MetricsRow;

use crate::comparison::{Comparison, paper_table};
use crate::curve::{Axis, CurveOptions, Quantity, Series, curve_svg};
use crate::error::Error;
use crate::figures::{Figure, figures as comparison_figures};
use crate::paper;
use crate::run::Run;
use crate::table::{Table, duration, interval, number, share, thousands};
use crate::trials::{Pictured, Trials, trials_body};

const STYLE: &str = include_str!("report.css");

/// Writes `report.html` into the run directory `run_dir` and returns its path.
///
/// # Errors
/// When the run's metrics cannot be read or the file cannot be written.
pub fn run_report_html(run_dir: &Path) -> Result<PathBuf, Error> {
    let run = Run::load(run_dir, &mut Vec::new())?;
    let path = run_dir.join("report.html");
    write(&path, &run_page(&run)?)?;
    Ok(path)
}

/// What a report consists of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Written {
    /// The page.
    pub page: PathBuf,
    /// Its pictures, each a file beside it.
    pub figures: Vec<PathBuf>,
}

/// Writes a page with the tables and pictures of `comparison` and `trials` to `path`, and each picture as a file of its
/// own beside it.
///
/// # Errors
/// When a curve cannot be drawn or a file cannot be written.
pub fn report_html(
    comparison: &Comparison,
    trials: &Trials,
    pictured: Pictured,
    path: &Path,
) -> Result<Written, Error> {
    let curves = comparison_figures(comparison)?;
    let pictures = trials.pictures(pictured);
    let mut written = Written { page: path.to_owned(), figures: Vec::new() };
    for figure in curves.iter().chain(&pictures) {
        let svg_path = path.with_file_name(&figure.file_name);
        write(&svg_path, &figure.svg)?;
        written.figures.push(svg_path);
    }
    let (has_runs, has_trials) = (!comparison.sections.is_empty(), !trials.groups.is_empty());
    let mut body = String::new();
    if has_trials {
        body.push_str(&trials_body(trials, &pictures));
    }
    if has_runs || !has_trials {
        body.push_str(&comparison_body(comparison, &curves));
    }
    let title = match (has_runs, has_trials) {
        (true, true) => "Trials and runs compared",
        (false, true) => "Trials compared",
        (_, false) => "Runs compared",
    };
    write(path, &page(title, &body))?;
    Ok(written)
}

fn comparison_body(comparison: &Comparison, drawn: &[Figure]) -> String {
    let mut body = String::new();
    for section in &comparison.sections {
        let tables = section.tables();
        body.extend(tables.iter().map(titled_table));
    }
    body.push_str(&figures(drawn));
    body.push_str(&titled_table(&paper_table()));
    body.push_str(&format!("<p>{}</p><p>{}</p>", escaped(paper::SOURCE), escaped(NOTES)));
    body
}

/// How the figures of a comparison are meant.
const NOTES: &str = "IE: epoch of the first evaluation with 10 % of the maximum success. RT: epochs from there to 90 % of it. \
     MSR: maximum success. ELR: 90 % of MSR over the epochs to reach it. Of several runs: mean (smallest–largest), and how \
     many have the figure where not all do; intervals are Wilson's 95 % over the episodes of all runs together and know \
     nothing of the differences between seeds. The best of many evaluations is a choice and flatters; held-out goals do not.";

pub(crate) fn titled_table(shown: &Table) -> String {
    let header: Vec<&str> = shown.header.iter().map(String::as_str).collect();
    format!("<h2>{}</h2>{}", escaped(&shown.title), table(&header, &shown.lines))
}

fn run_page(run: &Run) -> Result<String, Error> {
    let mut body = match (run.best(), run.last()) {
        (Some(best), Some(last)) => {
            format!("{}{}", tiles(best, last), framed(&curves(run)?.each_ref().map(String::as_str)))
        }
        _ => "<p>No evaluation yet.</p>".to_owned(),
    };
    if !run.rows.is_empty() {
        let lines: Vec<Vec<String>> = run.rows.iter().map(evaluation_cells).collect();
        body.push_str(&format!("<h2>Evaluations</h2>{}", table(&EVALUATION_HEADER, &lines)));
    }
    if let Some(text) = &run.configuration {
        body.push_str(&format!("<h2>Configuration</h2><pre>{}</pre>", escaped(text)));
    }
    Ok(page(&run.name, &body))
}

/// The figures that matter most.
fn tiles(best: &MetricsRow, last: &MetricsRow) -> String {
    let per_arm: Vec<String> = best.success_per_arm.iter().map(|success| share(*success)).collect();
    let tiles = [
        (
            "best success",
            share(best.success),
            format!("95 % interval {}, {} episodes", interval(best), best.n_episodes),
        ),
        ("joint norm", share(best.success_joint), format!("each arm: {}", per_arm.join(" / "))),
        (
            "with contact",
            share(best.collision_rate),
            format!("before success: {}", share(best.collision_rate_before_success)),
        ),
        (
            "reached after",
            thousands(best.env_steps),
            format!("env steps, {}", duration(best.wall_s)),
        ),
        (
            "advice spent",
            thousands(last.advice_spent),
            format!("{} left", thousands(last.budget_left)),
        ),
        (
            "whole run",
            duration(last.wall_s),
            format!("{} env steps, {} updates", thousands(last.env_steps), thousands(last.updates)),
        ),
    ];
    let tile = |(label, value, note): &(&str, String, String)| {
        format!(
            "<div class=tile><span>{label}</span><strong>{}</strong><small>{}</small></div>",
            escaped(value),
            escaped(note)
        )
    };
    format!("<div class=tiles>{}</div>", tiles.iter().map(tile).collect::<String>())
}

/// Success, mean Q, contacts, advice.
fn curves(run: &Run) -> Result<[String; 4], Error> {
    const AXIS: Axis = Axis::EnvSteps;
    let series = |named: &[(&str, Quantity)]| -> Vec<Series> {
        named.iter().map(|(name, quantity)| Series::of(name, &run.rows, AXIS, *quantity)).collect()
    };
    let success = series(&[
        ("success", Quantity::Success),
        ("joint norm", Quantity::SuccessJoint),
        ("training episodes", Quantity::TrainingSuccess),
        ("object moved", Quantity::Moved),
    ]);
    let contacts = series(&[
        ("any", Quantity::CollisionRate),
        ("before success", Quantity::CollisionRateBeforeSuccess),
    ]);
    Ok([
        curve_svg(&success, &CurveOptions::shares("Success", AXIS))?,
        curve_svg(&series(&[("", Quantity::MeanQ)]), &CurveOptions::figures("Mean Q", AXIS))?,
        curve_svg(&contacts, &CurveOptions::shares("Episodes with contact", AXIS))?,
        curve_svg(
            &series(&[("", Quantity::AdviceSpent)]),
            &CurveOptions::figures("Advice spent", AXIS),
        )?,
    ])
}

const EVALUATION_HEADER: [&str; 12] = [
    "round",
    "env steps",
    "updates",
    "paper epochs",
    "time",
    "success",
    "95 % interval",
    "joint",
    "contact",
    "moved",
    "mean Q",
    "advice spent",
];

fn evaluation_cells(row: &MetricsRow) -> Vec<String> {
    vec![
        row.round.to_string(),
        thousands(row.env_steps),
        thousands(row.updates),
        format!("{:.2}", row.paper_epochs),
        duration(row.wall_s),
        share(row.success),
        interval(row),
        share(row.success_joint),
        share(row.collision_rate),
        share(row.moved),
        number(row.mean_q),
        thousands(row.advice_spent),
    ]
}

fn table(header: &[&str], lines: &[Vec<String>]) -> String {
    let row = |tag: &str, cells: &mut dyn Iterator<Item = &str>| {
        let cells: String = cells.map(|cell| format!("<{tag}>{}</{tag}>", escaped(cell))).collect();
        format!("<tr>{cells}</tr>")
    };
    let body: String =
        lines.iter().map(|line| row("td", &mut line.iter().map(String::as_str))).collect();
    format!(
        "<div class=scroll><table><thead>{}</thead><tbody>{body}</tbody></table></div>",
        row("th", &mut header.iter().copied())
    )
}

/// The pictures of `drawn`.
pub(crate) fn figures(drawn: &[Figure]) -> String {
    let svgs: Vec<&str> = drawn.iter().map(|figure| figure.svg.as_str()).collect();
    framed(&svgs)
}

fn framed(svgs: &[&str]) -> String {
    let figures: String = svgs.iter().map(|svg| format!("<figure>{svg}</figure>")).collect();
    format!("<div class=figures>{figures}</div>")
}

fn page(title: &str, body: &str) -> String {
    let title = escaped(title);
    format!(
        "<!doctype html>\n<html lang=en><head><meta charset=utf-8><meta name=viewport content=\"width=device-width\">\
         <title>{title}</title><style>{STYLE}</style></head><body><main><h1>{title}</h1>{body}</main></body></html>\n"
    )
}

pub(crate) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

fn write(path: &Path, text: &str) -> Result<(), Error> {
    std::fs::write(path, text).map_err(|source| Error::Io {
        action: "write",
        path: path.to_owned(),
        source,
    })
}
