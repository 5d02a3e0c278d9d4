//! What evaluations bring: rows of metrics and the policies that are kept.
//!
//! The checkpoint holds all of it; the files in the run directory are copies for people. A copy that cannot be written
//! stays due until there is room.

use std::path::{Path, PathBuf};

use tandem_policy::Policy;
use tandem_telemetry::{MetricsLog, MetricsRow};

use tandem_rl::trainer::{Counters, RoundFigures};

/// What the evaluations have brought so far. It grows by a row each.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Judged {
    /// Every row of metrics, oldest first.
    pub rows: Vec<MetricsRow>,
    /// The policy of the latest row that is marked best.
    pub best: Option<Policy>,
    /// The policy of the latest row.
    pub last: Option<Policy>,
}

impl Judged {
    /// The row of the best policy.
    #[must_use]
    pub fn best_row(&self) -> Option<&MetricsRow> {
        self.rows.iter().rfind(|row| row.best)
    }

    /// The first success rate of at least `until`, which is above 0.
    #[must_use]
    pub fn reached(&self, until: f64) -> Option<f64> {
        let enough = self.rows.iter().map(|row| row.success).find(|success| *success >= until);
        enough.filter(|_| until > 0.0)
    }
}

/// An evaluation whose episodes are being played: everything that its row will need.
#[derive(Debug, Clone, PartialEq)]
pub struct Pending {
    /// How far the run was; the round is also the version that plays.
    pub counters: Counters,
    /// What the round before showed.
    pub figures: RoundFigures,
    /// Seconds that the run had taken.
    pub wall_s: f64,
    /// What is judged.
    pub policy: Policy,
}

/// A file that cannot be written.
#[derive(Debug)]
pub(crate) struct Unwritten {
    /// In words.
    pub(crate) what: String,
    /// Why not.
    pub(crate) cause: String,
}

/// Everything judged, and its copies in the run directory.
#[derive(Debug)]
pub(crate) struct Records {
    out: PathBuf,
    judged: Judged,
    metrics_due: bool,
    best_due: bool,
    last_due: bool,
}

impl Records {
    /// Goes on from `judged`; the copies in `out` are due, since others may be there.
    pub(crate) fn new(out: &Path, judged: Judged) -> Self {
        Self {
            out: out.to_owned(),
            metrics_due: true,
            best_due: judged.best.is_some(),
            last_due: judged.last.is_some(),
            judged,
        }
    }

    pub(crate) const fn judged(&self) -> &Judged {
        &self.judged
    }

    /// Adds an evaluation's row and what was judged.
    pub(crate) fn add(&mut self, row: MetricsRow, policy: Policy) {
        if row.best {
            self.judged.best = Some(policy.clone());
            self.best_due = true;
        }
        self.judged.rows.push(row);
        self.judged.last = Some(policy);
        (self.metrics_due, self.last_due) = (true, true);
    }

    /// Writes what is due; gives what could not be written.
    pub(crate) fn write(&mut self) -> Vec<Unwritten> {
        let mut unwritten = Vec::new();
        if self.metrics_due {
            let written = write_rows(&self.out.join("metrics.jsonl"), &self.judged.rows);
            self.metrics_due = note(written, "metrics.jsonl", &mut unwritten);
        }
        for (policy, due, name) in [
            (&self.judged.best, &mut self.best_due, "policy/best.safetensors"),
            (&self.judged.last, &mut self.last_due, "policy/last.safetensors"),
        ] {
            if let Some(policy) = policy.as_ref().filter(|_| *due) {
                *due = note(write_policy(&self.out.join(name), policy), name, &mut unwritten);
            }
        }
        unwritten
    }

    pub(crate) const fn is_due(&self) -> bool {
        self.metrics_due || self.best_due || self.last_due
    }
}

type AnyError = Box<dyn std::error::Error + Send + Sync>;

/// Whether a file is still due, and why.
fn note(written: Result<(), AnyError>, what: &str, unwritten: &mut Vec<Unwritten>) -> bool {
    let Err(error) = written else { return false };
    unwritten.push(Unwritten { what: what.to_owned(), cause: innermost(error.as_ref()) });
    true
}

fn write_rows(path: &Path, rows: &[MetricsRow]) -> Result<(), AnyError> {
    if let Some(directory) = path.parent() {
        std::fs::create_dir_all(directory)?;
    }
    let (mut log, n_written) = MetricsLog::restore(path, rows)?;
    for row in &rows[n_written..] {
        log.append(row)?;
    }
    Ok(())
}

fn write_policy(path: &Path, policy: &Policy) -> Result<(), AnyError> {
    if let Some(directory) = path.parent() {
        std::fs::create_dir_all(directory)?;
    }
    Ok(policy.save(path)?)
}

/// The cause of an error that has no cause itself: for a file, what the file system says.
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

    use super::*;
    use tandem_rl::config::{Recipe, RunConfig};
    use tandem_rl::trainer::Trainer;

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
    fn what_cannot_be_written_is_named_and_written_in_order_when_it_can() {
        let directory = tempfile::tempdir().expect("a directory");
        let out = directory.path().join("run");
        std::fs::write(&out, "a file where a directory should be").expect("writes");
        let mut records = Records::new(&out, Judged::default());
        records.add(row(1, true), policy("first"));
        records.add(row(2, false), policy("second"));
        let unwritten: Vec<String> = records.write().into_iter().map(|file| file.what).collect();
        assert_eq!(
            unwritten,
            ["metrics.jsonl", "policy/best.safetensors", "policy/last.safetensors"]
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
    fn what_a_lost_future_left_gives_way() {
        let directory = tempfile::tempdir().expect("a directory");
        let out = directory.path();
        let mut lost = Records::new(out, Judged::default());
        lost.add(row(1, true), policy("first"));
        let kept = lost.judged().clone();
        lost.add(row(2, true), policy("second"));
        assert!(lost.write().is_empty());
        assert!(Records::new(out, kept).write().is_empty());
        assert_eq!(rounds(out), [1]);
        assert_eq!(name_of(&out.join("policy/best.safetensors")), "first");
        assert_eq!(name_of(&out.join("policy/last.safetensors")), "first");
    }

    #[test]
    fn a_success_rate_is_reached_by_the_first_row_that_has_it() {
        let judged =
            Judged { rows: vec![row(1, true), row(5, true), row(3, false)], ..Judged::default() };
        assert_eq!(judged.reached(0.3), Some(0.5));
        assert_eq!(judged.reached(0.6), None);
        assert_eq!(judged.reached(0.0), None, "never");
        assert_eq!(judged.best_row().map(|row| row.round), Some(5));
    }
}
