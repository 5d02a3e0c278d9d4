//! The end of a sweep: its results, and the runs that have none.

use std::path::Path;

use anyhow::anyhow;
use serde_json::{Value, json};

use super::run_status::{RunStatus, State};
use crate::exit::{Exit, Failed};
use crate::output;
use crate::shell::shell_word;

/// Prints how many runs are finished, or each with its summary.
pub(super) fn print_result(
    statuses: &[RunStatus],
    out: &Path,
    as_json: bool,
) -> Result<(), Failed> {
    let n_finished = statuses.iter().filter(|one| matches!(one.state, State::Finished(_))).count();
    if as_json {
        let runs: Vec<Value> = statuses
            .iter()
            .map(|status| {
                let summary = match &status.state {
                    State::Finished(summary) => summary.clone(),
                    State::New | State::Started => Value::Null,
                };
                json!({
                    "name": status.run.name, "summary": summary, "failure": status.failure,
                    "left_out": status.left_out,
                })
            })
            .collect();
        return output::print(
            json!({"out": out.to_string_lossy(), "finished": n_finished, "runs": runs}),
        );
    }
    output::print(format_args!(
        "finished      {n_finished} of {} runs in {}",
        statuses.len(),
        out.display()
    ))?;
    output::print(format_args!("compare them  tandem report {}", shell_word(out)))
}

/// The runs without a result at the end of a sweep that was not interrupted.
pub(super) struct Unfinished<'a> {
    n_runs: usize,
    failed: Vec<&'a str>,
    left_out: Vec<&'a str>,
}

impl<'a> Unfinished<'a> {
    pub(super) fn of(statuses: &'a [RunStatus]) -> Self {
        let named = |has_reason: fn(&RunStatus) -> bool| {
            let runs = statuses.iter().filter(|status| has_reason(status));
            runs.map(|status| status.run.name.as_str()).collect()
        };
        Self {
            n_runs: statuses.len(),
            failed: named(|status| status.failure.is_some()),
            left_out: named(|status| status.left_out.is_some()),
        }
    }

    /// Describes the end of the sweep in a few words: `complete`, or the number of failed and of left out runs.
    pub(super) fn summary(&self) -> String {
        let counts = [(&self.failed, "failed"), (&self.left_out, "left out")];
        let counts = counts.into_iter().filter(|(runs, _)| !runs.is_empty());
        let texts: Vec<String> = counts
            .map(|(runs, end)| format!("{} of {} runs {end}", runs.len(), self.n_runs))
            .collect();
        if texts.is_empty() { "complete".to_owned() } else { texts.join(", ") }
    }

    /// Returns an error that names the runs, if there are any.
    pub(super) fn check(&self) -> Result<(), Failed> {
        let Self { n_runs, failed, left_out } = self;
        let mut texts = Vec::new();
        if !failed.is_empty() {
            texts.push(format!(
                "{} of {n_runs} runs failed and are retried at the next start: {}; see sweep.log in their directories",
                failed.len(),
                failed.join(", ")
            ));
        }
        if !left_out.is_empty() {
            texts.push(format!(
                "{} of {n_runs} runs were left out because another process uses them: {}",
                left_out.len(),
                left_out.join(", ")
            ));
        }
        match texts.is_empty() {
            true => Ok(()),
            false => Err(Failed::new(Exit::TryAgain, anyhow!("{}", texts.join("; ")))),
        }
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::Task;
    use tandem_rl::RunConfig;
    use tandem_rl::config::Recipe;

    use super::*;
    use crate::sweep::sweep_file::PlannedRun;

    fn status(name: &str) -> RunStatus {
        let config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
        let run = PlannedRun { name: name.to_owned(), config, teacher: None };
        let state = State::Started;
        RunStatus { run, dir: name.into(), state, failure: None, left_out: None, extends_to: None }
    }

    #[test]
    fn a_run_that_is_left_out_has_not_failed() {
        let mut statuses = [status("a"), status("b"), status("c")];
        let end = Unfinished::of(&statuses);
        assert!(end.check().is_ok());
        assert_eq!(end.summary(), "complete");
        statuses[1].leave_out("another process still uses it".to_owned());
        let end = Unfinished::of(&statuses);
        let error = end.check().expect_err("a run has no result");
        let expected = "1 of 3 runs were left out because another process uses them: b";
        assert_eq!((error.exit(), error.line().as_str()), (Exit::TryAgain, expected));
        assert_eq!(end.summary(), "1 of 3 runs left out");
        statuses[2].failure = Some("the disk is full".to_owned());
        let end = Unfinished::of(&statuses);
        let error = end.check().expect_err("two runs have no result").line();
        assert!(error.contains("1 of 3 runs failed"), "{error}");
        assert!(error.contains(": c; see sweep.log in their directories; 1 of 3"), "{error}");
        assert!(error.ends_with("were left out because another process uses them: b"), "{error}");
        assert_eq!(end.summary(), "1 of 3 runs failed, 1 of 3 runs left out");
    }
}
