//! The thread that learns: opens rounds, waits for their episodes, learns, publishes, judges, saves, stops.

mod judge;
mod keep;
mod progress;
mod start;

use std::collections::VecDeque;
use std::time::Duration;

use tandem_core::layout::EPISODE_STEPS;
use tandem_core::work::{PublishedActor, SlotOrder};
use tandem_core::{Episode, EpisodeKind};
use tandem_telemetry::events::{ParametersPublished, RoundFinished, RunFinished, WorkerSilent};
use tokio_util::sync::CancellationToken;

use crate::board::Silent;
use crate::error::Error;
use crate::records::{Pending, Records};
use crate::runtime::Runtime;
use crate::shared::{LearnerConfig, Shared};
use crate::teacher::{Ledger, Mismatch, TeacherError};
use keep::{Keeping, Notice};
use start::{Beginning, RunLock, keep_run_file};
use tandem_rl::trainer::{RoundFigures, Trainer};

/// Rounds after which an evaluation must be in; until then it fills the workers' gaps.
const EVALUATION_PATIENCE_ROUNDS: u64 = 4;
/// Pause between two looks at what else may have happened while episodes are awaited.
const WAIT_TICK: Duration = Duration::from_millis(200);
/// Workers that are named in the log when they fall silent at the same time.
const MAX_SILENT_LINES: usize = 100;
/// Span over which the rates in the progress are taken.
const RATE_SPAN_S: f64 = 15.0;
/// Units of advice that an episode can use: one a step.
#[expect(clippy::cast_possible_truncation, reason = "an episode has 50 steps")]
const UNITS_PER_EPISODE: u32 = EPISODE_STEPS as u32;
/// Rounds of the paper's epoch: 50 cycles of the HER reference implementation (decision 005).
const ROUNDS_PER_PAPER_EPOCH: f64 = 50.0;

/// How a run ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Ended {
    /// In words.
    pub reason: String,
    /// Whether it was stopped from outside and can go on.
    pub interrupted: bool,
    /// SHA-256 over the whole learning state.
    pub digest: String,
}

/// Runs the whole run on the calling thread.
pub(crate) fn run(
    config: &LearnerConfig,
    shared: &Shared,
    runtime: &Runtime,
    shutdown: &CancellationToken,
) -> Result<Ended, Error> {
    let beginning = Beginning::of(config, shutdown)?;
    let ledger = match beginning.open_ledger(config, &shared.warnings, (runtime, shutdown)) {
        Err(Error::Teacher(TeacherError::Stopped)) => {
            let (round, digest) = (beginning.trainer.counters().round, beginning.trainer.digest());
            let reason = "interrupted".to_owned();
            RunFinished { reason: &reason, round, digest: &digest }.emit();
            return Ok(Ended { reason, interrupted: true, digest });
        }
        ledger => ledger?,
    };
    keep_run_file(config)?;
    let mut drive = Drive::new(config, shared, (runtime, shutdown), beginning, ledger);
    match drive.rounds() {
        Ok(stop) => drive.finish(stop),
        Err(error) => {
            // A state whose numbers are no longer finite is of no use; any other is what a run goes on from.
            if !matches!(error, Error::Diverged(_)) {
                drive.save();
            }
            Err(error)
        }
    }
}

/// Why rounds end.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Stop {
    Reached(String),
    Interrupted,
}

struct Drive<'a> {
    config: &'a LearnerConfig,
    shared: &'a Shared,
    runtime: &'a Runtime,
    shutdown: &'a CancellationToken,
    trainer: Trainer,
    /// Plays the round that is being awaited.
    acting: PublishedActor,
    ledger: Option<Ledger>,
    records: Records,
    pending: VecDeque<Pending>,
    keeping: Keeping,
    wall_before_s: f64,
    rates: VecDeque<(f64, u64, u64)>,
    lock: RunLock,
}

impl Drive<'_> {
    /// Learns round after round until something stops it.
    fn rounds(&mut self) -> Result<Stop, Error> {
        if let Some(stop) = self.stop() {
            return Ok(stop);
        }
        if !self.open_round(self.trainer.counters().round, self.acting.version)? {
            return Ok(Stop::Interrupted);
        }
        loop {
            if let Some(stop) = self.stop() {
                return Ok(stop);
            }
            if !self.round()? {
                return Ok(Stop::Interrupted);
            }
            self.keep_up();
        }
    }

    /// Awaits the open round, learns it and opens the next; false when the run is interrupted. Whenever it gives false
    /// or an error other than divergence, the state is one that a run can go on from.
    fn round(&mut self) -> Result<bool, Error> {
        let Some(episodes) = self.wait_for(EpisodeKind::Training, self.acting.version)? else {
            return Ok(false);
        };
        let Some(spent_by_now) = self.settle(&episodes)? else { return Ok(false) };
        let round = self.trainer.counters().round;
        let lagged = self.config.run.rounds.lag == 1;
        if lagged && !self.open_round_knowing(round + 1, round, spent_by_now)? {
            return Ok(false);
        }
        // From here to the end of learning nothing is awaited: a round is learned whole or not at all.
        let before = self.trainer.publish();
        let figures = self.learn(&episodes, spent_by_now)?;
        let newest = self.trainer.publish();
        self.shared.publish(&newest);
        self.acting = if lagged { before } else { newest };
        self.note_evaluation(&figures);
        if !lagged && !self.open_round(round + 1, round + 1)? {
            return Ok(false);
        }
        self.order_evaluation();
        self.take_overdue_evaluations()
    }

    /// Settles the leases of a round's episodes and gives the units of advice spent by then; `None` when the run is
    /// interrupted. The teacher's account decides what an episode has cost, not the worker that played it.
    fn settle(&mut self, episodes: &[Episode]) -> Result<Option<u64>, Error> {
        let spent = self.trainer.counters().advice_spent;
        let Some(ledger) = &mut self.ledger else { return Ok(Some(spent)) };
        let Some(settled) = unless_stopped(ledger.settle(episodes, spent))? else {
            return Ok(None);
        };
        if let Some(Mismatch { claimed, charged }) = settled.mismatch {
            let (round, account) = (self.trainer.counters().round, ledger.account().to_owned());
            self.notice(
                Notice::Advice,
                format!(
                    "the episodes of round {round} claim {claimed} units of advice, the teacher's account {account:?} \
                     was charged {charged}: the account counts"
                ),
            );
        }
        Ok(Some(spent + settled.units))
    }

    fn learn(&mut self, episodes: &[Episode], advice_spent: u64) -> Result<RoundFigures, Error> {
        self.trainer.ingest(episodes);
        self.trainer.correct_advice_spent(advice_spent);
        if let Some(absurd) = self.trainer.absurd_statistic() {
            self.notice(Notice::Statistics, absurd);
        }
        self.tell("updating", &self.trainer.figures());
        let counters = self.trainer.counters();
        let mut told_at = self.now_s();
        let (shared, clock, wall_before_s) = (self.shared, &self.config.clock, self.wall_before_s);
        let figures = self.trainer.learn(|n_updates| {
            let now = wall_before_s + clock().as_secs_f64();
            if now - told_at > 1.0 {
                told_at = now;
                shared.progress.send_modify(|progress| {
                    progress.updates = counters.updates + n_updates;
                    progress.wall_s = now;
                    progress.phase = "updating".to_owned();
                });
            }
        })?;
        let counters = self.trainer.counters();
        self.rates.push_back((self.now_s(), counters.env_steps, counters.updates));
        while self.rates.len() > 2 && self.rates[0].0 < self.now_s() - RATE_SPAN_S {
            self.rates.pop_front();
        }
        self.tell("collecting", &figures);
        RoundFinished {
            round: counters.round,
            env_steps: counters.env_steps,
            updates: counters.updates,
            training_success: figures.training_success,
            training_moved: figures.training_moved,
            advice_spent: counters.advice_spent,
        }
        .emit();
        ParametersPublished { version: counters.round }.emit();
        Ok(figures)
    }

    /// Hands out the slots of a round, after its leases are open; false when the run is interrupted.
    fn open_round(&mut self, round: u64, version: u64) -> Result<bool, Error> {
        self.open_round_knowing(round, version, self.trainer.counters().advice_spent)
    }

    /// [`Self::open_round`] when `spent` units of advice are known to be spent.
    fn open_round_knowing(&mut self, round: u64, version: u64, spent: u64) -> Result<bool, Error> {
        if self.is_last(round) {
            return Ok(true);
        }
        let orders = self.trainer.training_orders(round, version);
        if let Some(ledger) = &mut self.ledger {
            let ordered = orders.iter().flat_map(|slot| &slot.episodes);
            let advised = ordered.filter(|order| order.advised).map(|order| order.number).collect();
            let Some(allowances) = unless_stopped(ledger.open_leases(advised, spent))? else {
                return Ok(false);
            };
            self.shared
                .lock()
                .board
                .allow(allowances.iter().map(|each| (each.episode, each.units)));
        }
        self.add(orders);
        Ok(true)
    }

    /// Whether the run is known to end before `round`.
    fn is_last(&self, round: u64) -> bool {
        let max = self.config.run.stop.max_env_steps;
        max > 0 && round * self.config.run.env_steps_per_round() >= max
    }

    fn add(&self, orders: Vec<SlotOrder>) {
        let mut state = self.shared.lock();
        orders.into_iter().for_each(|order| state.board.add(order));
        drop(state);
        self.shared.work.notify_waiters();
    }

    /// Waits until every episode of `kind` played with `version` is in; `None` when the run is interrupted.
    fn wait_for(&mut self, kind: EpisodeKind, version: u64) -> Result<Option<Vec<Episode>>, Error> {
        let spent = self.trainer.counters().advice_spent;
        let mut looked_at = None;
        loop {
            if let Some(ledger) = self.ledger.as_mut().filter(|ledger| ledger.is_lost()) {
                // In an account that is opened anew an episode may be charged beyond its first lease.
                self.shared.lock().board.lift_allowances();
                if unless_stopped(ledger.mend(spent))?.is_none() {
                    return Ok(None);
                }
            }
            let mut state = self.shared.lock();
            if state.board.is_complete(kind, version) {
                return Ok(Some(state.board.take(kind, version)));
            }
            if self.shutdown.is_cancelled() {
                return Ok(None);
            }
            let now = (self.config.clock)();
            // Not with every slot that comes in: all workers are looked at.
            if looked_at.is_none_or(|before| now.saturating_sub(before) >= WAIT_TICK) {
                looked_at = Some(now);
                report_silent(&state.board.reclaim(now));
            }
            drop(state);
            let arrived = self.shared.arrived.clone();
            let news = async move { tokio::time::timeout(WAIT_TICK, arrived.notified()).await };
            if self.runtime.wait_on(news).is_none() {
                return Ok(None);
            }
        }
    }

    fn stop(&self) -> Option<Stop> {
        let stop = &self.config.run.stop;
        if self.shutdown.is_cancelled() {
            return Some(Stop::Interrupted);
        }
        if let Some(success) = self.records.judged().reached(stop.until_success) {
            return Some(Stop::Reached(format!("success rate {success:.3} reached")));
        }
        if self.is_last(self.trainer.counters().round) {
            return Some(Stop::Reached(format!(
                "{} environment steps reached",
                stop.max_env_steps
            )));
        }
        if stop.max_minutes > 0.0 && self.now_s() >= stop.max_minutes * 60.0 {
            return Some(Stop::Reached(format!("{} minutes are over", stop.max_minutes)));
        }
        None
    }

    /// Judges the final parameters, saves everything and says how it ended.
    fn finish(&mut self, stop: Stop) -> Result<Ended, Error> {
        let round = self.trainer.counters().round;
        let reached = match stop {
            Stop::Interrupted => None,
            Stop::Reached(reason) => {
                if round > 0 && !self.is_judged(round) {
                    let figures = self.trainer.figures();
                    self.push_evaluation(&figures);
                    self.order_evaluation();
                }
                // What was learned is safe before anything more is waited for.
                self.save();
                self.tell("evaluating", &self.trainer.figures());
                while self.finish_evaluation()? {}
                self.pending.is_empty().then_some(reason)
            }
        };
        let interrupted = reached.is_none();
        let reason = reached.unwrap_or_else(|| "interrupted".to_owned());
        self.save();
        let digest = self.trainer.digest();
        RunFinished { reason: &reason, round, digest: &digest }.emit();
        self.tell("ended", &self.trainer.figures());
        self.refuse_unwritten()?;
        Ok(Ended { reason, interrupted, digest })
    }
}

/// Logs the workers that fell silent, the first of them by name: there can be thousands.
fn report_silent(fell_silent: &[Silent]) {
    let n_logged = fell_silent.len().min(MAX_SILENT_LINES);
    let (logged, rest) = fell_silent.split_at(n_logged);
    for Silent { worker_id, name, n_slots } in logged {
        WorkerSilent { worker_id: *worker_id, name, n_slots: *n_slots }.emit();
    }
    if !rest.is_empty() {
        tracing::warn!(n = rest.len(), "more workers silent");
    }
}

/// What the teacher answered; `None` when the call was given up because the run is to stop.
fn unless_stopped<T>(outcome: Result<T, TeacherError>) -> Result<Option<T>, TeacherError> {
    match outcome {
        Err(TeacherError::Stopped) => Ok(None),
        outcome => outcome.map(Some),
    }
}
