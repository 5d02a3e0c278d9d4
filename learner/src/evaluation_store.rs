//! The results of evaluations: rows of metrics, and the best and the latest policy.
//!
//! A checkpoint contains all of them; the files in the run directory are copies for users. A copy that cannot be
//! written stays due until the write succeeds.

use std::io;
use std::path::{Path, PathBuf};

use tandem_policy::Policy;
use tandem_rl::trainer::{Counters, RoundStats};
use tandem_system::atomic_file;
use tandem_telemetry::{MetricsLog, MetricsRow, tensorboard};

/// The results of all complete evaluations.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct EvaluationHistory {
    /// One row of metrics per evaluation, oldest first.
    pub rows: Vec<MetricsRow>,
    /// The policy of the latest row that is marked as best.
    pub best: Option<Policy>,
    /// The policy of the latest row.
    pub last: Option<Policy>,
}

impl EvaluationHistory {
    /// Returns the row of the best policy.
    #[must_use]
    pub fn best_row(&self) -> Option<&MetricsRow> {
        self.rows.iter().rfind(|row| row.best)
    }

    /// Returns the first success rate of at least `until`; `None` if `until` is 0.
    #[must_use]
    pub fn first_reaching(&self, until: f64) -> Option<f64> {
        let enough = self.rows.iter().map(|row| row.success).find(|success| *success >= until);
        enough.filter(|_| until > 0.0)
    }
}

/// An evaluation whose episodes are being played, with the data for its row.
#[derive(Debug, Clone, PartialEq)]
pub struct PendingEvaluation {
    /// The run's counters when it was scheduled; the round is also the parameter version.
    pub counters: Counters,
    /// Statistics of the round before it.
    pub stats: RoundStats,
    /// Wall time of the run when it was scheduled, seconds.
    pub wall_s: f64,
    /// The policy that is evaluated.
    pub policy: Policy,
}

/// A file that cannot be written.
#[derive(Debug)]
pub(crate) struct UnwrittenFile {
    /// Its description.
    pub(crate) what: String,
    /// The error.
    pub(crate) cause: String,
}

/// The results, and their copies in the run directory.
#[derive(Debug)]
pub(crate) struct EvaluationStore {
    out: PathBuf,
    /// The start of the run, seconds since 1970.
    started_s: f64,
    /// True if files contain the symmetrised policies.
    symmetrized: bool,
    history: EvaluationHistory,
    metrics_due: bool,
    events_due: bool,
    best_due: bool,
    last_due: bool,
}

impl EvaluationStore {
    /// Continues with `history`. All copies in `out` are due, because those there may be of another state. The run
    /// started at `started_s`, seconds since 1970. `symmetrized` is the run's setting `evaluation.symmetrized`.
    pub(crate) fn new(
        out: &Path,
        history: EvaluationHistory,
        started_s: f64,
        symmetrized: bool,
    ) -> Self {
        Self {
            out: out.to_owned(),
            started_s,
            symmetrized,
            metrics_due: true,
            events_due: true,
            best_due: history.best.is_some(),
            last_due: history.last.is_some(),
            history,
        }
    }

    /// Returns the results.
    pub(crate) const fn history(&self) -> &EvaluationHistory {
        &self.history
    }

    /// Adds an evaluation's row and its policy.
    pub(crate) fn add(&mut self, row: MetricsRow, policy: Policy) {
        if row.best {
            self.history.best = Some(policy.clone());
            self.best_due = true;
        }
        self.history.rows.push(row);
        self.history.last = Some(policy);
        (self.metrics_due, self.events_due, self.last_due) = (true, true, true);
    }

    /// Writes the copies that are due; returns those that could not be written.
    pub(crate) fn write(&mut self) -> Vec<UnwrittenFile> {
        let mut unwritten = Vec::new();
        if self.metrics_due {
            let written = write_rows(&self.out.join("metrics.jsonl"), &self.history.rows);
            self.metrics_due = still_due(written, "metrics.jsonl", &mut unwritten);
        }
        if self.events_due {
            let path = self.out.join(tensorboard::PATH);
            let written = write_events(&path, &self.history.rows, self.started_s);
            self.events_due = still_due(written, "tensorboard", &mut unwritten);
        }
        for (policy, due, name) in [
            (&self.history.best, &mut self.best_due, "policy/best.safetensors"),
            (&self.history.last, &mut self.last_due, "policy/last.safetensors"),
        ] {
            if let Some(policy) = policy.as_ref().filter(|_| *due) {
                let policy = policy.clone();
                let policy = if self.symmetrized { policy.symmetrized() } else { policy };
                *due = still_due(write_policy(&self.out.join(name), &policy), name, &mut unwritten);
            }
        }
        unwritten
    }

    /// Returns true if a copy is due.
    pub(crate) const fn is_due(&self) -> bool {
        self.metrics_due || self.events_due || self.best_due || self.last_due
    }
}

type AnyError = Box<dyn std::error::Error + Send + Sync>;

/// Returns true if the file is still due, and adds it to `unwritten`.
fn still_due(
    written: Result<(), AnyError>,
    what: &str,
    unwritten: &mut Vec<UnwrittenFile>,
) -> bool {
    let Err(error) = written else { return false };
    unwritten.push(UnwrittenFile { what: what.to_owned(), cause: innermost(error.as_ref()) });
    true
}

fn write_rows(path: &Path, rows: &[MetricsRow]) -> Result<(), AnyError> {
    create_parent(path)?;
    let (mut log, n_written) = MetricsLog::restore(path, rows)?;
    for row in &rows[n_written..] {
        log.append(row)?;
    }
    Ok(())
}

fn write_events(path: &Path, rows: &[MetricsRow], started_s: f64) -> Result<(), AnyError> {
    create_parent(path)?;
    Ok(tensorboard::write_events(path, rows, started_s)?)
}

fn write_policy(path: &Path, policy: &Policy) -> Result<(), AnyError> {
    create_parent(path)?;
    Ok(policy.save(path)?)
}

fn create_parent(path: &Path) -> io::Result<()> {
    path.parent().map_or(Ok(()), atomic_file::create_directory)
}

/// Returns the root cause of an error, such as the message of the file system.
pub(crate) fn innermost(error: &(dyn std::error::Error + 'static)) -> String {
    let mut cause = error;
    while let Some(inner) = cause.source() {
        cause = inner;
    }
    cause.to_string()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use tandem_core::Task;
    use tandem_rl::config::{Recipe, RunConfig};
    use tandem_rl::trainer::Trainer;

    use super::*;

    fn row(round: u64, best: bool) -> MetricsRow {
        MetricsRow { round, best, success: round as f64 / 10.0, ..MetricsRow::default() }
    }

    fn policy(name: &str) -> Policy {
        let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 1);
        config.ddpg.n_hidden = 4;
        let metadata = BTreeMap::from([("name".to_owned(), name.to_owned())]);
        Trainer::new(config).expect("valid").policy(metadata)
    }

    fn name_of(path: &Path) -> String {
        Policy::load(path).expect("whole").metadata["name"].clone()
    }

    fn rounds(out: &Path) -> Vec<u64> {
        let rows = MetricsLog::read_all(&out.join("metrics.jsonl")).expect("rows");
        rows.iter().map(|row| row.round).collect()
    }

    #[test]
    fn unwritten_files_are_named_and_written_in_order_later() {
        let directory = tempfile::tempdir().expect("a directory");
        let out = directory.path().join("run");
        std::fs::write(&out, "a file where a directory should be").expect("writes");
        let mut records = EvaluationStore::new(&out, EvaluationHistory::default(), 0.0, false);
        records.add(row(1, true), policy("first"));
        records.add(row(2, false), policy("second"));
        let unwritten: Vec<String> = records.write().into_iter().map(|file| file.what).collect();
        assert_eq!(
            unwritten,
            ["metrics.jsonl", "tensorboard", "policy/best.safetensors", "policy/last.safetensors"]
        );
        std::fs::remove_file(&out).expect("removes");
        records.add(row(3, false), policy("third"));
        assert!(records.is_due());
        assert!(records.write().is_empty());
        assert!(!records.is_due());
        assert_eq!(rounds(&out), [1, 2, 3]);
        assert_eq!(name_of(&out.join("policy/best.safetensors")), "first");
        assert_eq!(name_of(&out.join("policy/last.safetensors")), "third");
    }

    #[test]
    fn files_of_a_lost_future_are_replaced() {
        let directory = tempfile::tempdir().expect("a directory");
        let out = directory.path();
        let mut lost = EvaluationStore::new(out, EvaluationHistory::default(), 0.0, false);
        lost.add(row(1, true), policy("first"));
        let kept = lost.history().clone();
        lost.add(row(2, true), policy("second"));
        assert!(lost.write().is_empty());
        assert!(EvaluationStore::new(out, kept, 0.0, false).write().is_empty());
        assert_eq!(rounds(out), [1]);
        assert_eq!(name_of(&out.join("policy/best.safetensors")), "first");
        assert_eq!(name_of(&out.join("policy/last.safetensors")), "first");
    }

    #[test]
    fn files_contain_the_symmetrised_policies_and_the_history_those_that_learn() {
        let directory = tempfile::tempdir().expect("a directory");
        let out = directory.path();
        let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
        config.ddpg.n_hidden = 4;
        let policy = Trainer::new(config).expect("valid").policy(BTreeMap::new());
        let mut store = EvaluationStore::new(out, EvaluationHistory::default(), 0.0, true);
        store.add(row(1, true), policy.clone());
        assert!(store.write().is_empty());
        assert_eq!(store.history().best.as_ref(), Some(&policy));
        let file = Policy::load(&out.join("policy/best.safetensors")).expect("whole");
        assert_eq!(file.digest(), policy.symmetrized().digest());
    }

    #[test]
    fn the_first_row_with_enough_success_reaches_a_rate() {
        let history = EvaluationHistory {
            rows: vec![row(1, true), row(5, true), row(3, false)],
            ..EvaluationHistory::default()
        };
        assert_eq!(history.first_reaching(0.3), Some(0.5));
        assert_eq!(history.first_reaching(0.6), None);
        assert_eq!(history.first_reaching(0.0), None, "never");
        assert_eq!(history.best_row().map(|row| row.round), Some(5));
    }
}
