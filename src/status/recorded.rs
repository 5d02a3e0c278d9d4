//! The status of runs of which no learner is running, from their directories.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use serde_json::{Value, json};
use tandem_learner::service::encode_evaluation;
use tandem_proto::pb;
use tandem_report::Run;
use tandem_report::table::thousands;

use super::lines;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::output;
use crate::progress_json::progress_json;
use crate::run_directory::{self, RunState};
use crate::run_file;
use crate::shell::shell_word;

/// Prints the progress of the run in `dir`, which no learner is working on.
///
/// # Errors
/// After printing, if the run is not complete: nothing works on it.
pub(super) fn show(dir: &Path, prints_json: bool) -> Result<(), Failed> {
    let state = run_directory::state(dir);
    let progress = progress_of(dir, state)?;
    if prints_json {
        let mut shown = progress_json(&progress);
        shown["state"] = state.to_string().into();
        output::print(shown)?;
    } else if progress.evaluation.is_some() {
        lines(&progress).iter().try_for_each(output::print)?;
    }
    if state == RunState::Complete {
        return Ok(());
    }
    let (shown, word) = (dir.display(), shell_word(dir));
    let what = anyhow!(
        "no learner of a `tandem train` is running in {shown} ({state}); `tandem train --resume --out {word}` continues it"
    );
    Err(Failed::new(Exit::TryAgain, what))
}

/// Prints a line for each run in `parent`, and one for each directory in it that holds runs.
pub(super) fn list(parent: &Path, prints_json: bool) -> Result<(), Failed> {
    let runs: Vec<Listed> = run_directory::runs_in(parent).into_iter().map(Listed::read).collect();
    let directories = run_directory::parents_in(parent);
    if prints_json {
        let directories: Vec<Value> = directories.iter().map(parent_json).collect();
        let runs: Vec<Value> = runs.iter().map(Listed::json).collect();
        return output::print(json!({"runs": runs, "directories": directories}));
    }
    let width = |texts: &mut dyn Iterator<Item = usize>| texts.max().unwrap_or(0);
    let name_width = width(&mut runs.iter().map(|run| run.path.display().to_string().len()));
    let state_width = width(&mut runs.iter().map(|run| run.state.len()));
    for run in &runs {
        let (path, state, result) = (run.path.display().to_string(), &run.state, run.result());
        let line = format!("{path:name_width$}  {state:state_width$}  {result}");
        output::print(line.trim_end())?;
    }
    for (path, states) in &directories {
        let (shown, n_complete, n) = (path.display(), n_complete(states), states.len());
        output::print(format_args!("{shown}: {n_complete} of {n} runs complete"))?;
    }
    Ok(())
}

fn n_complete(states: &[RunState]) -> usize {
    states.iter().filter(|state| **state == RunState::Complete).count()
}

fn parent_json((path, states): &(PathBuf, Vec<RunState>)) -> Value {
    let n_complete = n_complete(states);
    json!({"directory": path.to_string_lossy(), "n_runs": states.len(), "n_complete": n_complete})
}

/// A run of a list.
struct Listed {
    path: PathBuf,
    state: String,
    latest: Option<pb::Evaluation>,
}

impl Listed {
    fn read(path: PathBuf) -> Self {
        let is_running = matches!(run_directory::lock(&path), Ok(None));
        let state = match is_running {
            true => "running".to_owned(),
            false => run_directory::state(&path).to_string(),
        };
        let run = Run::load(&path, &mut Vec::new()).unwrap_or_default();
        let latest = run.last().map(encode_evaluation);
        Self { path, state, latest }
    }

    /// Returns the latest evaluation; nothing before the first.
    fn result(&self) -> String {
        self.latest.as_ref().map_or_else(String::new, |latest| {
            format!("{} env steps, success {:.3}", thousands(latest.env_steps), latest.success)
        })
    }

    fn json(&self) -> Value {
        let latest = self.latest.as_ref();
        json!({
            "directory": self.path.to_string_lossy(), "state": self.state,
            "env_steps": latest.map(|latest| latest.env_steps),
            "success": latest.map(|latest| latest.success),
            "success_without_contact": latest.and_then(|latest| latest.success_without_contact),
        })
    }
}

/// Returns the progress of a run at its last evaluation. What only a summary has is missing before the run is complete.
fn progress_of(dir: &Path, state: RunState) -> Result<pb::Progress, Failed> {
    let config = run_file::resolve(Some(&dir.join("run.toml")), &[])?;
    let mut warnings = Vec::new();
    let run = match dir.join("metrics.jsonl").exists() {
        true => Run::load(dir, &mut warnings).or_exit(Exit::Data, String::new)?,
        false => Run::default(),
    };
    warnings.iter().for_each(output::message);
    let mut progress = pb::Progress {
        task: config.task.to_string(),
        n_arms: u32::try_from(config.arms).unwrap_or(u32::MAX),
        strategy: config.advice.strategy.to_string(),
        best: run.best().map(encode_evaluation),
        evaluation: run.last().map(encode_evaluation),
        ended: state == RunState::Complete,
        max_env_steps: config.stop.max_env_steps,
        max_minutes: config.stop.max_minutes,
        ..Default::default()
    };
    if progress.ended {
        let summary = run_directory::summary(dir).unwrap_or_default();
        let text = |key: &str| summary[key].as_str().unwrap_or_default().to_owned();
        (progress.digest, progress.environment) = (text("digest"), text("environment"));
        progress.environment_failures = summary["environment_failures"].as_u64().unwrap_or(0);
        progress.end_reason = state.to_string();
    }
    if let Some(last) = run.last() {
        progress.round = last.round;
        progress.env_steps = last.env_steps;
        progress.episodes = last.episodes;
        progress.updates = last.updates;
        progress.wall_s = last.wall_s;
        progress.advice_spent = last.advice_spent;
        progress.advice_queries = last.advice_queries;
        progress.budget_left = last.budget_left;
        progress.training_success = last.training_success;
    }
    Ok(progress)
}
