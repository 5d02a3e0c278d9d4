//! `tandem report`: compares runs and trials on the terminal, as an HTML page, as JSON and as CSV.

use std::path::{Path, PathBuf};

use serde_json::json;
use tandem_report::{
    Baseline, Comparison, HeldOut, Pictured, Trials, Written, records, report_html, run, trials,
};

use crate::cli::ReportArgs;
use crate::evaluation::{EvaluatedPolicy, EvaluationResult, measure};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{output, policy_file};

/// Seed and number of the test goals of composed teachers, as for `tandem eval` and at the end of a run.
const HELD_OUT_SEED: u64 = 777;
const HELD_OUT_EPISODES: u64 = 240;

pub(crate) fn report(args: &ReportArgs) -> Result<(), Failed> {
    let found = run::find(&args.paths).or_exit(Exit::Data, String::new)?;
    let trials = Trials::of(found.trials);
    warn(found.warnings.iter().chain(&trials.warnings));
    let comparison = Comparison::of(found.runs, baselines(args)?);
    let page = args.out.clone().unwrap_or_else(|| default_page(&args.paths));
    let pictured = if args.all_trials { Pictured::All } else { Pictured::Failures };
    let written =
        report_html(&comparison, &trials, pictured, &page).or_cannot_write(String::new)?;
    if let Some(path) = &args.csv {
        std::fs::write(path, records::csv(&comparison))
            .or_cannot_write(|| format!("cannot write {}", path.display()))?;
    }
    print(args, &comparison, &trials, &written)
}

fn print(
    args: &ReportArgs,
    comparison: &Comparison,
    trials: &Trials,
    written: &Written,
) -> Result<(), Failed> {
    if args.json {
        let mut value = records::json(comparison);
        value["trials"] = trials::json(trials);
        value["report"] = json!(written.page);
        value["figures"] = json!(written.figures);
        return output::print(value);
    }
    if !trials.groups.is_empty() {
        output::print(trials.text())?;
        output::print("median time: of all trials, failures too; [95 % interval of the share]")?;
    }
    if !comparison.sections.is_empty() {
        output::print(comparison.text())?;
        output::print(
            "of several runs: mean (smallest–largest); [95 % interval of all their episodes]",
        )?;
    }
    let n_pictures = written.figures.len();
    output::print(format_args!(
        "report        {}, {n_pictures} pictures next to it",
        written.page.display()
    ))?;
    if let Some(path) = &args.csv {
        output::print(format_args!("csv           {}", path.display()))?;
    }
    Ok(())
}

fn warn<'a>(warnings: impl Iterator<Item = &'a String>) {
    for warning in warnings {
        output::message(format_args!("tandem: warning: {warning}"));
    }
}

/// Returns the results of policies that no run of the report has trained.
fn baselines(args: &ReportArgs) -> Result<Vec<Baseline>, Failed> {
    let mut baselines = Vec::new();
    for path in &args.evals {
        let held_out = HeldOut::load(path).or_exit(Exit::Data, String::new)?;
        baselines.push(Baseline { label: stem(path), held_out });
    }
    for path in &args.composed_teachers {
        let composed = EvaluatedPolicy::composed(policy_file::load(path)?, 2, path)?;
        let result = measure(&composed, HELD_OUT_EPISODES, HELD_OUT_SEED)?;
        let label = format!("composed {}", stem(path));
        baselines.push(Baseline { label, held_out: held_out(&result) });
    }
    Ok(baselines)
}

fn held_out(result: &EvaluationResult) -> HeldOut {
    let summary = &result.summary;
    HeldOut {
        task: result.layout.task,
        n_arms: result.layout.n_arms,
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

/// Returns `report.html` in the directory of the report, unless there are several directories or it is that of a single
/// run, which has its own page.
fn default_page(paths: &[PathBuf]) -> PathBuf {
    match paths {
        [dir] if dir.is_dir() && !dir.join("metrics.jsonl").exists() => dir.join("report.html"),
        _ => PathBuf::from("report.html"),
    }
}
