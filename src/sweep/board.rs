//! The content of the dashboard of a sweep: the runs as their directories and processes report them.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use serde_json::Value;
use tandem_dashboard::{RunPace, SweepResult, SweepRunState, SweepRunView, SweepView};
use tandem_telemetry::{MetricsLog, MetricsRow};
use tokio::sync::watch;

use super::run_status::{RunStatus, State};
use crate::clock;

/// The state of all runs, and where it is sent.
pub(super) struct Board {
    view: SweepView,
    /// The latest message of each run, once it has been started.
    progress: Vec<Option<watch::Receiver<Value>>>,
    started_at: Instant,
    sender: watch::Sender<SweepView>,
}

impl Board {
    /// Returns the board of a sweep that has just started.
    pub(super) fn new(name: &str, out: &Path, n_jobs: usize, statuses: &[RunStatus]) -> Self {
        let view = SweepView {
            name: name.to_owned(),
            directory: out.display().to_string(),
            n_jobs,
            runs: statuses.iter().map(run_view).collect(),
            ..SweepView::default()
        };
        let sender = watch::Sender::new(view.clone());
        Self { progress: vec![None; statuses.len()], view, started_at: clock::now(), sender }
    }

    /// Returns the snapshots.
    pub(super) fn views(&self) -> watch::Receiver<SweepView> {
        self.sender.subscribe()
    }

    /// Follows the messages of a run that was started.
    pub(super) fn started(&mut self, idx: usize, progress: watch::Receiver<Value>) {
        self.progress[idx] = Some(progress);
        let run = &mut self.view.runs[idx];
        (run.state, run.result) = (SweepRunState::Running, None);
        run.failure.clear();
        self.send();
    }

    /// Shows how a run ended. A run without a new status is saved.
    pub(super) fn ended(&mut self, idx: usize, status: &RunStatus) {
        self.progress[idx] = None;
        let run = &mut self.view.runs[idx];
        let steps = run.env_steps;
        let dashboard = String::new();
        *run = SweepRunView { dashboard, ..run_view(status) };
        run.env_steps = run.env_steps.max(steps);
        if run.state == SweepRunState::Waiting {
            run.state = match (&status.failure, &status.left_out) {
                (Some(_), _) => SweepRunState::Failed,
                (None, Some(_)) => SweepRunState::LeftOut,
                (None, None) => SweepRunState::Saved,
            };
        }
        self.send();
    }

    /// Takes over the latest message of every running run.
    pub(super) fn refresh(&mut self, statuses: &[RunStatus]) {
        let running = self.progress.iter_mut().zip(&mut self.view.runs).zip(statuses);
        for ((progress, run), status) in running {
            let Some(progress) = progress else { continue };
            if progress.has_changed().unwrap_or(false) {
                let message = progress.borrow_and_update().clone();
                show_message(run, &message, &status.dir);
            }
        }
        self.send();
    }

    /// Shows the end of the sweep.
    pub(super) fn end(&mut self, how: &str) {
        how.clone_into(&mut self.view.end);
        self.send();
    }

    fn send(&mut self) {
        self.view.wall_s = self.started_at.elapsed().as_secs_f64();
        self.sender.send_replace(self.view.clone());
    }
}

/// Returns the state of a run that is not running.
fn run_view(status: &RunStatus) -> SweepRunView {
    let (name, config) = (&status.run.name, &status.run.config);
    let group = name.strip_suffix(&format!("-seed{}", config.seed)).unwrap_or(name);
    let task = config.task.replace('/', "-");
    let group = group.strip_prefix(&format!("{task}-")).unwrap_or(group);
    let evaluations = rows(&status.dir);
    let failure = status.failure.as_ref().or(status.left_out.as_ref());
    let mut view = SweepRunView {
        name: name.clone(),
        task: config.task.clone(),
        group: group.to_owned(),
        seed: config.seed,
        failure: failure.cloned().unwrap_or_default(),
        max_env_steps: config.stop.max_env_steps,
        env_steps: evaluations.last().map_or(0, |row| row.env_steps),
        evaluations,
        ..SweepRunView::default()
    };
    if let State::Finished(summary) = &status.state {
        let number = |key: &str| summary[key].as_f64().unwrap_or(f64::NAN);
        let (success, low, high) =
            (number("success"), number("success_low"), number("success_high"));
        view.state = SweepRunState::Finished;
        view.result = Some(SweepResult { success, low, high });
        view.env_steps = summary["env_steps"].as_u64().unwrap_or(view.env_steps);
        view.pace.advice_spent = summary["advice_spent"].as_u64().unwrap_or_default();
    }
    view
}

/// Takes over a message of `tandem train --progress-json`. An evaluation in it that is new is read from the run's
/// metrics.
fn show_message(run: &mut SweepRunView, message: &Value, dir: &Path) {
    let number = |key: &str| message[key].as_f64().unwrap_or_default();
    let count = |key: &str| message[key].as_u64().unwrap_or_default();
    let text = |key: &str| message[key].as_str().unwrap_or_default().to_owned();
    run.env_steps = count("env_steps");
    run.pace = RunPace {
        env_steps_per_s: number("env_steps_per_s"),
        updates_per_s: number("updates_per_s"),
        remaining_s: message["remaining_s"].as_f64(),
        advice_spent: count("advice_spent"),
        training_success: number("training_success"),
        warning: text("warning"),
    };
    run.dashboard = text("dashboard");
    let evaluated = message["evaluation"]["round"].as_u64();
    if evaluated > run.evaluations.last().map(|row| row.round) {
        run.evaluations = rows(dir);
    }
}

/// Reads the evaluations of the run in `dir`. A file that is damaged or being written counts as missing here: the run
/// itself reports it.
fn rows(dir: &Path) -> Arc<[MetricsRow]> {
    MetricsLog::read_all(&dir.join("metrics.jsonl")).unwrap_or_default().into()
}

#[cfg(test)]
mod tests {
    use serde_json::json;
    use tandem_core::Task;
    use tandem_rl::RunConfig;
    use tandem_rl::config::Recipe;

    use super::*;
    use crate::sweep::sweep_file::PlannedRun;

    fn status(dir: &Path, state: State) -> RunStatus {
        let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
        (config.name, config.seed) = ("push-ea-seed3".to_owned(), 3);
        let run = PlannedRun { name: config.name.clone(), config, teacher: None };
        let dir = dir.to_owned();
        RunStatus { run, dir, state, failure: None, left_out: None, extends_to: None }
    }

    #[test]
    fn a_run_is_followed_from_its_start_to_its_end() {
        let dir = tempfile::tempdir().expect("a directory");
        let statuses = [status(dir.path(), State::New)];
        let mut board = Board::new("s", dir.path(), 1, &statuses);
        let views = board.views();
        let run = || views.borrow().runs[0].clone();
        assert_eq!((run().group.as_str(), run().state), ("ea", SweepRunState::Waiting));
        let (sender, receiver) = watch::channel(Value::Null);
        board.started(0, receiver);
        board.refresh(&statuses);
        assert_eq!((run().state, run().env_steps), (SweepRunState::Running, 0));
        let row = MetricsRow { round: 2, env_steps: 1600, success: 0.25, ..MetricsRow::default() };
        let text = serde_json::to_string(&row).expect("JSON");
        std::fs::write(dir.path().join("metrics.jsonl"), text + "\n").expect("writes");
        sender.send_replace(json!({
            "env_steps": 1700, "env_steps_per_s": 90.0, "remaining_s": 12.0, "evaluation": {"round": 2}
        }));
        board.refresh(&statuses);
        assert_eq!((run().env_steps, run().pace.remaining_s), (1700, Some(12.0)));
        assert_eq!(run().evaluations.last().map(|row| row.success), Some(0.25));
        board.ended(0, &statuses[0]);
        assert_eq!((run().state, run().env_steps), (SweepRunState::Saved, 1700));
        let mut left_out = status(dir.path(), State::Started);
        left_out.leave_out("another process still uses it".to_owned());
        board.ended(0, &left_out);
        assert_eq!(run().state, SweepRunState::LeftOut);
        assert_eq!(run().failure, "another process still uses it");
        let summary =
            json!({"success": 0.5, "success_low": 0.4, "success_high": 0.6, "env_steps": 1800});
        board.ended(0, &status(dir.path(), State::Finished(summary)));
        assert_eq!(run().state, SweepRunState::Finished);
        assert_eq!(run().result.map(|result| result.success), Some(0.5));
    }
}
