//! `tandem report`: runs side by side, on the terminal, as a page, as JSON and CSV.

use std::path::{Path, PathBuf};

use serde_json::json;
use tandem_report::{Baseline, Comparison, HeldOut, comparison_html, records, run};

use crate::cli::ReportArgs;
use crate::eval::{Measured, composed, measure};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::files::load_policy;

/// Held-out goals on which composed teachers are measured: those of `tandem eval` and of a run's end.
const HELD_OUT_SEED: u64 = 777;
const HELD_OUT_EPISODES: u64 = 240;

#[expect(clippy::print_stdout, reason = "what the command is for")]
pub(crate) fn report(args: &ReportArgs) -> Result<(), Failed> {
    let found = run::find(&args.paths).or_exit(Exit::Data, String::new)?;
    warn(&found.warnings);
    let comparison = Comparison::of(found.runs, baselines(args)?);
    let page = args.out.clone().unwrap_or_else(|| default_page(&args.paths));
    let written = comparison_html(&comparison, &page).or_exit(Exit::TryAgain, String::new)?;
    if let Some(path) = &args.csv {
        std::fs::write(path, records::csv(&comparison))
            .or_exit(Exit::TryAgain, || format!("cannot write {}", path.display()))?;
    }
    if args.json {
        let mut value = records::json(&comparison);
        value["report"] = json!(written.page);
        value["figures"] = json!(written.figures);
        println!("{value}");
        return Ok(());
    }
    println!("{}", comparison.text());
    println!("of several runs: mean (smallest–largest); [95 % interval of all their episodes]");
    println!("report        {}, {} curves beside it", page.display(), written.figures.len());
    if let Some(path) = &args.csv {
        println!("csv           {}", path.display());
    }
    Ok(())
}

#[expect(clippy::print_stderr, reason = "a warning is for people")]
fn warn(warnings: &[String]) {
    for warning in warnings {
        eprintln!("tandem: warning: {warning}");
    }
}

/// Policies that no run of the report trained.
fn baselines(args: &ReportArgs) -> Result<Vec<Baseline>, Failed> {
    let mut baselines = Vec::new();
    for path in &args.evals {
        let held_out = HeldOut::load(path).or_exit(Exit::Data, String::new)?;
        baselines.push(Baseline { label: stem(path), held_out });
    }
    for path in &args.composed_teachers {
        let subject = composed(load_policy(path)?, 2, path)?;
        let measured = measure(&subject, HELD_OUT_EPISODES, HELD_OUT_SEED)?;
        let label = format!("composed {}", stem(path));
        baselines.push(Baseline { label, held_out: held_out(&measured) });
    }
    Ok(baselines)
}

fn held_out(measured: &Measured) -> HeldOut {
    let summary = &measured.summary;
    HeldOut {
        task: measured.layout.task,
        n_arms: measured.layout.n_arms,
        n_episodes: summary.n_episodes as u64,
        success: summary.success,
        interval: (summary.interval.low, summary.interval.high),
        success_joint: summary.success_joint,
        collision_rate: summary.collision_rate,
    }
}

fn stem(path: &Path) -> String {
    path.file_stem().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// In the directory that is reported on, unless there are several or it is a run's own, which has a page already.
fn default_page(paths: &[PathBuf]) -> PathBuf {
    match paths {
        [dir] if dir.is_dir() && !dir.join("metrics.jsonl").exists() => dir.join("report.html"),
        _ => PathBuf::from("report.html"),
    }
}
