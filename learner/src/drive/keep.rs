//! What is kept on the disk, and what is done about a disk that refuses.
//!
//! Training goes on. What could not be written is kept here and tried again, a person is told, and a run does not end
//! well before everything is written.

use std::collections::BTreeMap;

use tandem_telemetry::events::CheckpointSaved;

use super::Drive;
use crate::checkpoint::{self, Resumption, Saved};
use crate::error::Error;
use crate::records::{Unwritten, innermost};
use crate::warnings::Source;

/// Pause before a disk that refused is tried again.
const TRY_AGAIN_S: f64 = 10.0;

/// Why nothing is written to a path that no longer leads to the run directory: another run may be there.
const DISPLACED: &str = "the run directory was moved, removed or replaced";

/// What of a run changes between two checkpoints.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Stand {
    round: u64,
    n_rows: usize,
    n_pending: usize,
}

/// What else may need a person's attention; each kind is reported once.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Notice {
    /// Workers claim other charges than the teacher's account has.
    Advice,
    /// A statistic that normalises inputs is out of all proportion.
    Statistics,
}

/// What the disk has and has not, and what else is wrong.
#[derive(Debug, Default)]
pub(super) struct Keeping {
    /// What the newest checkpoint holds.
    saved: Option<Stand>,
    checkpoint_missing: Option<Unwritten>,
    records_missing: Vec<Unwritten>,
    tried_at_s: f64,
    told: String,
    notices: BTreeMap<Notice, String>,
}

impl Keeping {
    /// What is wrong, for a person; empty when nothing is.
    fn trouble(&self) -> String {
        let missing: Vec<String> = self
            .missing()
            .map(|Unwritten { what, cause }| format!("{what} cannot be written: {cause}"))
            .collect();
        missing.join("; ")
    }

    /// Everything that is wrong, for a person; empty when nothing is.
    fn warning(&self) -> String {
        let trouble = Some(self.trouble()).filter(|trouble| !trouble.is_empty());
        let parts: Vec<String> =
            trouble.into_iter().chain(self.notices.values().cloned()).collect();
        parts.join("; ")
    }

    fn missing(&self) -> impl Iterator<Item = &Unwritten> {
        self.checkpoint_missing.iter().chain(&self.records_missing)
    }
}

impl Drive<'_> {
    /// Reports what needs a person's attention, the first time for each kind of it.
    pub(super) fn notice(&mut self, kind: Notice, text: String) {
        if self.keeping.notices.contains_key(&kind) {
            tracing::debug!(?kind, text, "needs attention again");
            return;
        }
        tracing::warn!(?kind, text, "needs attention");
        self.keeping.notices.insert(kind, text);
        self.publish_warning();
    }

    fn publish_warning(&self) {
        self.shared.warnings.set(Source::Learner, &self.keeping.warning());
    }

    /// Saves a checkpoint when one is due, and tries again what the disk refused before.
    pub(super) fn keep_up(&mut self) {
        let round = self.trainer.counters().round;
        let is_due = round.is_multiple_of(self.config.run.checkpoint.every_rounds);
        let try_again = self.now_s() >= self.keeping.tried_at_s + TRY_AGAIN_S;
        if is_due || (try_again && self.keeping.checkpoint_missing.is_some()) {
            self.save();
        } else if try_again && self.records.is_due() {
            self.write_records();
        }
    }

    /// Saves a checkpoint, unless the newest one holds the present state, and writes the records that are due. When
    /// that fails training goes on and the former checkpoint stays.
    pub(super) fn save(&mut self) {
        let stand = Stand {
            round: self.trainer.counters().round,
            n_rows: self.records.judged().rows.len(),
            n_pending: self.pending.len(),
        };
        if self.keeping.saved != Some(stand) {
            self.save_checkpoint(stand);
        }
        self.write_records();
    }

    fn save_checkpoint(&mut self, stand: Stand) {
        let what = format!("the checkpoint of round {}", stand.round);
        if !self.lock.is_in_place() {
            let cause = DISPLACED.to_owned();
            self.keeping.checkpoint_missing = Some(Unwritten { what, cause });
            return;
        }
        let resumption = Resumption {
            acting: self.acting.clone(),
            judged: self.records.judged().clone(),
            pending: self.pending.iter().cloned().collect(),
            wall_s: self.now_s(),
        };
        let directory = self.config.out.join("checkpoint");
        let keep = self.config.run.checkpoint.keep;
        match checkpoint::save(&directory, &self.trainer, &resumption, keep) {
            Ok(Saved { path, seal }) => {
                CheckpointSaved { round: stand.round, path: &path, digest: &seal }.emit();
                self.keeping.saved = Some(stand);
                self.keeping.checkpoint_missing = None;
            }
            Err(error) => {
                let cause = innermost(&error);
                self.keeping.checkpoint_missing = Some(Unwritten { what, cause });
            }
        }
    }

    /// Writes the records that are due, and tells when something is wrong or no longer is.
    pub(super) fn write_records(&mut self) {
        if self.lock.is_in_place() {
            self.keeping.records_missing = self.records.write();
        } else if self.records.is_due() {
            let (what, cause) = ("metrics.jsonl and policies".to_owned(), DISPLACED.to_owned());
            self.keeping.records_missing = vec![Unwritten { what, cause }];
        }
        self.keeping.tried_at_s = self.now_s();
        let trouble = self.keeping.trouble();
        if trouble == self.keeping.told {
            return;
        }
        if trouble.is_empty() {
            tracing::info!("everything that could not be written is written");
        } else {
            tracing::warn!(
                trouble,
                "cannot write to disk, training continues and the write is repeated"
            );
        }
        self.keeping.told = trouble;
        self.publish_warning();
    }

    /// Refuses to end well while something is not written.
    pub(super) fn refuse_unwritten(&self) -> Result<(), Error> {
        let trouble = self.keeping.trouble();
        if trouble.is_empty() {
            return Ok(());
        }
        let path = self.config.out.clone();
        Err(Error::RunDirectory { action: "write everything to", path, source: trouble.into() })
    }
}
