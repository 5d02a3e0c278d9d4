//! Writes checkpoints and records, and handles a disk that cannot be written to.
//!
//! Training continues. Data that could not be written stays in memory, the write is repeated, the progress shows a
//! warning, and a run does not end successfully before everything is written.

use tandem_core::work::PublishedActor;
use tandem_rl::trainer::Trainer;
use tandem_telemetry::events::CheckpointSaved;

use super::evaluations::Evaluations;
use super::run_lock::RunLock;
use crate::checkpoint::{self, RenamedAccount, Resumption, Saved};
use crate::error::Error;
use crate::evaluation_store::{UnwrittenFile, innermost};
use crate::shared::{LearnerConfig, Shared};
use crate::timings::Timings;
use crate::warnings::{Source, Warnings};

/// Pause before a failed write is repeated.
const RETRY_AFTER_S: f64 = 10.0;
/// Wall time of the run that may be missing in its final checkpoint.
const MAX_UNSAVED_S: f64 = 1.0;

/// The cause of a write that is not attempted because another run may use the path now.
const DISPLACED: &str = "the run directory was moved, removed or replaced";

/// Identifies the state in a checkpoint, among the states of one run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct CheckpointKey {
    round: u64,
    n_rows: usize,
    n_pending: usize,
}

/// The state of the loop that is written to disk.
pub(super) struct LoopState<'a, 'c> {
    pub(super) trainer: &'a Trainer,
    pub(super) acting: &'a PublishedActor,
    pub(super) evaluations: &'a mut Evaluations<'c>,
    pub(super) wall_s: f64,
    pub(super) teacher_policy: Option<&'a str>,
    pub(super) had_other_policy: bool,
    pub(super) renamed_account: Option<&'a RenamedAccount>,
}

impl LoopState<'_, '_> {
    fn key(&self) -> CheckpointKey {
        CheckpointKey {
            round: self.trainer.counters().round,
            n_rows: self.evaluations.history().rows.len(),
            n_pending: self.evaluations.pending().len(),
        }
    }
}

/// Writes to the run directory, and holds its lock.
pub(super) struct Persistence<'a> {
    config: &'a LearnerConfig,
    warnings: &'a Warnings,
    timings: &'a Timings,
    lock: RunLock,
    /// The state in the newest checkpoint.
    saved: Option<CheckpointKey>,
    /// Wall time in the newest checkpoint.
    saved_wall_s: f64,
    unwritten_checkpoint: Option<UnwrittenFile>,
    unwritten_records: Vec<UnwrittenFile>,
    /// Wall time of the latest attempts to write a checkpoint and the records.
    checkpoint_attempt_s: f64,
    records_attempt_s: f64,
    /// The trouble that was logged last.
    logged_trouble: String,
}

impl<'a> Persistence<'a> {
    pub(super) const fn new(config: &'a LearnerConfig, shared: &'a Shared, lock: RunLock) -> Self {
        Self {
            config,
            warnings: &shared.warnings,
            timings: &shared.timings,
            lock,
            saved: None,
            saved_wall_s: 0.0,
            unwritten_checkpoint: None,
            unwritten_records: Vec::new(),
            checkpoint_attempt_s: 0.0,
            records_attempt_s: 0.0,
            logged_trouble: String::new(),
        }
    }

    /// Saves a checkpoint if one is due, and repeats failed writes after a pause.
    pub(super) fn persist_if_due(&mut self, state: &mut LoopState<'_, '_>) {
        let round = state.trainer.counters().round;
        let is_due = round.is_multiple_of(self.config.run.checkpoint.every_rounds);
        let is_retry = |attempt_s: f64| state.wall_s >= attempt_s + RETRY_AFTER_S;
        let is_unwritten = self.unwritten_checkpoint.is_some();
        if is_due || (is_unwritten && is_retry(self.checkpoint_attempt_s)) {
            self.save(state);
        } else if state.evaluations.has_unwritten() && is_retry(self.records_attempt_s) {
            self.write_records(state.evaluations, state.wall_s);
        }
    }

    /// Saves a checkpoint unless the newest one contains this state and the run's wall time, and writes the records. A
    /// failure leaves the former checkpoint in place. If only the wall time is missing in that one, nothing counts as
    /// unwritten.
    pub(super) fn save(&mut self, state: &mut LoopState<'_, '_>) {
        let key = state.key();
        if self.saved != Some(key) || state.wall_s > self.saved_wall_s + MAX_UNSAVED_S {
            self.save_checkpoint(key, state);
        }
        self.write_records(state.evaluations, state.wall_s);
    }

    fn save_checkpoint(&mut self, key: CheckpointKey, state: &LoopState<'_, '_>) {
        self.checkpoint_attempt_s = state.wall_s;
        let what = format!("the checkpoint of round {}", key.round);
        if !self.lock.is_in_place() {
            let cause = DISPLACED.to_owned();
            self.unwritten_checkpoint = Some(UnwrittenFile { what, cause });
            return;
        }
        let resumption = Resumption {
            acting: state.acting.clone(),
            history: state.evaluations.history().clone(),
            pending: state.evaluations.pending().iter().cloned().collect(),
            wall_s: state.wall_s,
            teacher_policy: state.teacher_policy.map(str::to_owned),
            had_other_policy: state.had_other_policy,
            account: state.renamed_account.cloned(),
        };
        let directory = self.config.out.join("checkpoint");
        let keep = self.config.run.checkpoint.keep;
        let start = self.timings.now();
        match checkpoint::save(&directory, state.trainer, &resumption, keep) {
            Ok(Saved { path, seal }) => {
                self.timings.record(&self.timings.checkpoint_seconds, start);
                CheckpointSaved { round: key.round, path: &path, digest: &seal }.emit();
                (self.saved, self.saved_wall_s) = (Some(key), state.wall_s);
                self.unwritten_checkpoint = None;
            }
            Err(error) => {
                self.timings.checkpoint_failures.inc();
                let cause = innermost(&error);
                if self.saved == Some(key) {
                    tracing::warn!(cause, "cannot update the wall time in the newest checkpoint");
                } else {
                    self.unwritten_checkpoint = Some(UnwrittenFile { what, cause });
                }
            }
        }
    }

    /// Writes the records that are out of date, and reports the beginning and the end of trouble with the disk.
    pub(super) fn write_records(&mut self, evaluations: &mut Evaluations<'_>, wall_s: f64) {
        if self.lock.is_in_place() {
            self.unwritten_records = evaluations.write();
        } else if evaluations.has_unwritten() {
            let (what, cause) = ("metrics.jsonl and policies".to_owned(), DISPLACED.to_owned());
            self.unwritten_records = vec![UnwrittenFile { what, cause }];
        }
        self.records_attempt_s = wall_s;
        let trouble = self.trouble();
        if trouble == self.logged_trouble {
            return;
        }
        if trouble.is_empty() {
            tracing::info!("all pending writes have succeeded");
        } else {
            tracing::warn!(
                trouble,
                "cannot write to disk, training continues and the write is repeated"
            );
        }
        self.warnings.set(Source::Disk, &trouble);
        self.logged_trouble = trouble;
    }

    /// Returns an error while something is not written.
    pub(super) fn check_written(&self) -> Result<(), Error> {
        let trouble = self.trouble();
        if trouble.is_empty() {
            return Ok(());
        }
        Err(Error::Unwritten { out: self.config.out.clone(), trouble })
    }

    /// Returns the files that cannot be written and the causes; empty if there are none.
    fn trouble(&self) -> String {
        let unwritten = self.unwritten_checkpoint.iter().chain(&self.unwritten_records);
        let lines: Vec<String> = unwritten
            .map(|UnwrittenFile { what, cause }| format!("{what} cannot be written: {cause}"))
            .collect();
        lines.join("; ")
    }
}
