//! The learning thread: opens rounds, waits for their episodes, learns, publishes, evaluates, saves.
//!
//! [`LearnerLoop`] owns the trainer and three parts with state of their own: the evaluations, the persistence of the
//! run directory, and the publisher of the progress.

mod evaluations;
mod halt;
mod initial_state;
mod persistence;
mod progress_publisher;
mod run_lock;

use std::time::Duration;

use tandem_core::work::{PublishedActor, SlotOrder};
use tandem_core::{AdviceUnit, Episode, EpisodeKind, TaskSpec};
use tandem_rl::RunConfig;
use tandem_rl::trainer::{RoundStats, Trainer};
use tandem_telemetry::events::{
    ParametersPublished, RoundFinished, RunFinished, RunInterrupted, WorkerSilent,
};
use tokio_util::sync::CancellationToken;

use crate::advice_account::{AdviceAccount, Mismatch};
use crate::checkpoint::RenamedAccount;
use crate::error::Error;
use crate::evaluation_store::EvaluationHistory;
use crate::progress::Phase;
use crate::runtime::Runtime;
use crate::shared::{LearnerConfig, Shared};
use crate::warnings::Source;
use crate::work_queue::SilentWorker;
use evaluations::Evaluations;
use halt::Halt;
use initial_state::{InitialState, write_run_file};
use persistence::{LoopState, Persistence};
use progress_publisher::ProgressPublisher;

/// Pause between two checks for silent workers and a lost account while episodes are awaited.
const WAIT_TICK: Duration = Duration::from_millis(200);
/// Workers that are logged by name if they fall silent at the same time.
const MAX_SILENT_LINES: usize = 100;

/// The end reason of a run that was interrupted.
pub const INTERRUPTED: &str = "interrupted";

/// The outcome of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct RunOutcome {
    /// The limit that ended the run, or [`INTERRUPTED`].
    pub reason: String,
    /// True if the run was stopped before its end and can be resumed.
    pub interrupted: bool,
    /// SHA-256 over the whole learning state, hexadecimal.
    pub digest: String,
}

/// The environment of the learning thread.
#[derive(Clone, Copy)]
pub(crate) struct Context<'a> {
    pub(crate) config: &'a LearnerConfig,
    pub(crate) shared: &'a Shared,
    pub(crate) runtime: &'a Runtime,
    pub(crate) shutdown: &'a CancellationToken,
}

/// Runs the whole run on the calling thread.
pub(crate) fn run(context: Context<'_>) -> Result<RunOutcome, Error> {
    let initial = InitialState::load(context)?;
    // A complete run asks no teacher: at most evaluations are left.
    let account = match initial.is_complete(context.config) {
        true => Ok(None),
        false => initial.open_account(context),
    };
    let account = match account {
        Ok(account) => account,
        Err(Halt::Interrupted) => {
            let (round, digest) = (initial.trainer.counters().round, initial.trainer.digest());
            return Ok(outcome(None, round, digest));
        }
        Err(Halt::Failed(error)) => return Err(error),
    };
    write_run_file(context.config)?;
    let mut learner = LearnerLoop::new(context, initial, account);
    match learner.run_rounds() {
        Ok(reason) => learner.finish(Some(reason)),
        Err(Halt::Interrupted) => learner.finish(None),
        Err(Halt::Failed(error)) => {
            // A state with numbers that are not finite is useless; a run can resume from any other.
            if !matches!(error, Error::Diverged(_)) {
                learner.save();
            }
            Err(error)
        }
    }
}

/// Reports the end of a run that has reached the limit `reason`, or was interrupted, and returns the outcome.
fn outcome(reason: Option<String>, round: u64, digest: String) -> RunOutcome {
    let interrupted = reason.is_none();
    match reason.as_deref() {
        Some(reason) => RunFinished { reason, round, digest: &digest }.emit(),
        None => RunInterrupted { round, digest: &digest }.emit(),
    }
    let reason = reason.unwrap_or_else(|| INTERRUPTED.to_owned());
    RunOutcome { reason, interrupted, digest }
}

/// The training loop over rounds.
struct LearnerLoop<'a> {
    context: Context<'a>,
    trainer: Trainer,
    /// The parameters that play the round that is being awaited.
    acting: PublishedActor,
    account: Option<AdviceAccount>,
    /// The digest of the teacher's policy when the run began, if it is known.
    teacher_policy: Option<String>,
    /// True if the teacher advised by another policy, too, before this learner started.
    had_other_policy: bool,
    /// The account, unless it has the run's name.
    renamed_account: Option<RenamedAccount>,
    evaluations: Evaluations<'a>,
    persistence: Persistence<'a>,
    progress: ProgressPublisher<'a>,
    /// Time of the latest check for silent workers.
    reclaimed_at: Option<Duration>,
}

impl LearnerLoop<'_> {
    /// Learns round after round until the run reaches a limit, and returns that limit.
    fn run_rounds(&mut self) -> Result<String, Halt> {
        // A run that was interrupted while it awaited an evaluation awaits it here: its success may end the run.
        self.complete_overdue_evaluations()?;
        if let Some(reason) = self.reached_limit()? {
            return Ok(reason);
        }
        self.open_round(self.trainer.counters().round, self.acting.version)?;
        self.publish_progress(Phase::Collecting);
        if self.trainer.counters().round == 0 && self.evaluations.is_due(0) {
            self.schedule_evaluation(&self.trainer.stats());
            self.order_evaluation();
        }
        loop {
            if let Some(reason) = self.reached_limit()? {
                return Ok(reason);
            }
            self.run_round()?;
            let (persistence, mut state) = self.persistence_and_state();
            persistence.persist_if_due(&mut state);
        }
    }

    /// Awaits the open round, learns from it and opens the next one. After an interruption, and after any error but
    /// divergence, the run can resume from the present state.
    fn run_round(&mut self) -> Result<(), Halt> {
        let (timings, start) = (&self.context.shared.timings, self.context.shared.timings.now());
        let episodes = self.wait_for(EpisodeKind::Training, self.acting.version)?;
        timings.record(&timings.collect_seconds, start);
        let spent = self.settle(&episodes)?;
        let round = self.trainer.counters().round;
        let lagged = self.context.config.run.rounds.lag == 1;
        if lagged {
            self.open_round_after(round + 1, round, spent)?;
        }
        // Nothing is awaited from here to the end of learning: a round is learned completely or not at all.
        let before = self.trainer.publish();
        let stats = self.learn(&episodes, spent)?;
        let newest = self.trainer.publish();
        self.context.shared.publish(&newest);
        self.acting = if lagged { before } else { newest };
        if self.evaluations.is_due(self.trainer.counters().round) {
            self.schedule_evaluation(&stats);
        }
        if !lagged {
            self.open_round(round + 1, round + 1)?;
        }
        self.order_evaluation();
        timings.record(&timings.round_seconds, start);
        self.complete_overdue_evaluations()
    }

    /// Settles the leases of a round's episodes and returns the units of advice spent so far. The teacher's account,
    /// not the worker, determines what an episode has cost.
    fn settle(&mut self, episodes: &[Episode]) -> Result<u64, Halt> {
        let spent = self.trainer.counters().advice_spent;
        let Some(account) = &mut self.account else { return Ok(spent) };
        let settlement = account.settle(episodes, spent)?;
        if let Some(Mismatch { claimed, charged }) = settlement.mismatch {
            let (round, name) = (self.trainer.counters().round, account.name());
            let warning = format!(
                "the episodes of round {round} claim {claimed} units of advice, the teacher's account {name:?} was \
                 charged {charged}: the account counts"
            );
            self.context.shared.warnings.set_first(Source::Claims, &warning);
        }
        Ok(spent + settlement.units)
    }

    fn learn(&mut self, episodes: &[Episode], advice_spent: u64) -> Result<RoundStats, Halt> {
        self.trainer.ingest(episodes);
        self.progress.record_acted(episodes);
        self.trainer.correct_advice_spent(advice_spent);
        if let Some(warning) = self.trainer.implausible_statistic() {
            self.context.shared.warnings.set_first(Source::Statistics, &warning);
        }
        self.publish_progress(Phase::Updating);
        let on_update = self.progress.on_update(self.trainer.counters());
        let stats = self.trainer.learn(on_update)?;
        let counters = self.trainer.counters();
        self.progress.record_round(counters);
        self.publish_progress(Phase::Collecting);
        RoundFinished {
            round: counters.round,
            env_steps: counters.env_steps,
            updates: counters.updates,
            training_success: stats.training_success,
            training_moved: stats.training_moved,
            advice_spent: counters.advice_spent,
        }
        .emit();
        ParametersPublished { version: counters.round }.emit();
        Ok(stats)
    }

    /// Orders the slots of a round, after opening its leases.
    fn open_round(&mut self, round: u64, version: u64) -> Result<(), Halt> {
        self.open_round_after(round, version, self.trainer.counters().advice_spent)
    }

    /// Does the same as [`Self::open_round`] after `spent` units of advice.
    fn open_round_after(&mut self, round: u64, version: u64, spent: u64) -> Result<(), Halt> {
        if is_beyond_end(&self.context.config.run, round) {
            return Ok(());
        }
        let orders = self.trainer.training_orders(round, version);
        if let Some(account) = &mut self.account {
            let payers = payers(&orders, self.context.config.run.advice.unit);
            let units = units_per_episode(&orders, &self.trainer.task);
            let allowances = account.open_leases(payers, units, spent)?;
            let allowances = allowances.iter().map(|each| (each.episode, each.units));
            self.context.shared.lock().queue.limit_claims(allowances);
        }
        self.order(orders);
        Ok(())
    }

    /// Adds slots to the queue and wakes the workers that wait for one.
    fn order(&self, orders: Vec<SlotOrder>) {
        let mut state = self.context.shared.lock();
        orders.into_iter().for_each(|order| state.queue.push(order));
        drop(state);
        self.context.shared.work.notify_waiters();
    }

    /// Waits for all episodes of `kind` with parameter version `version`.
    fn wait_for(&mut self, kind: EpisodeKind, version: u64) -> Result<Vec<Episode>, Halt> {
        let Context { shared, runtime, shutdown, .. } = self.context;
        let phase = match kind {
            EpisodeKind::Training => Phase::Collecting,
            EpisodeKind::Evaluation => Phase::Evaluating,
        };
        loop {
            self.restore_lost_account()?;
            self.reclaim_slots();
            let mut state = shared.lock();
            if state.queue.is_complete(kind, version) {
                return Ok(state.queue.take(kind, version));
            }
            drop(state);
            if self.progress.is_due() {
                self.publish_progress(phase);
            }
            if shutdown.is_cancelled() {
                return Err(Halt::Interrupted);
            }
            let arrived = shared.arrived.clone();
            let next = async move { tokio::time::timeout(WAIT_TICK, arrived.notified()).await };
            if runtime.wait_on(next).is_none() {
                return Err(Halt::Interrupted);
            }
        }
    }

    /// Requeues the slots of silent workers and reports these workers. The check visits all workers, so it does not run
    /// for every slot that arrives.
    fn reclaim_slots(&mut self) {
        let now = (self.context.config.clock)();
        if self.reclaimed_at.is_none_or(|before| now.saturating_sub(before) >= WAIT_TICK) {
            self.reclaimed_at = Some(now);
            let fell_silent = self.context.shared.lock().queue.reclaim(now);
            report_silent(&fell_silent);
        }
    }

    /// Opens the account again if the teacher has lost it.
    fn restore_lost_account(&mut self) -> Result<(), Halt> {
        let spent = self.trainer.counters().advice_spent;
        let Some(account) = self.account.as_mut().filter(|account| account.is_lost()) else {
            return Ok(());
        };
        // A reopened account may charge an episode beyond its first lease.
        self.context.shared.lock().queue.lift_claim_limits();
        Ok(account.restore_if_lost(spent)?)
    }

    /// Returns the limit that ends the run now.
    fn reached_limit(&self) -> Result<Option<String>, Halt> {
        if self.context.shutdown.is_cancelled() {
            return Err(Halt::Interrupted);
        }
        let (history, round) = (self.evaluations.history(), self.trainer.counters().round);
        Ok(reached_limit(&self.context.config.run, history, round, self.progress.wall_s()))
    }

    /// Evaluates the final parameters of a run that has reached the limit `reason`, saves everything and returns the
    /// outcome.
    fn finish(&mut self, mut reason: Option<String>) -> Result<RunOutcome, Error> {
        let round = self.trainer.counters().round;
        if reason.is_some() {
            match self.complete_all_evaluations() {
                Ok(()) => {}
                Err(Halt::Interrupted) => reason = None,
                Err(Halt::Failed(error)) => return Err(error),
            }
        }
        self.save();
        let outcome = outcome(reason, round, self.trainer.digest());
        self.publish_progress(Phase::Ended);
        self.persistence.check_written()?;
        Ok(outcome)
    }

    /// Evaluates the present parameters and completes all evaluations.
    fn complete_all_evaluations(&mut self) -> Result<(), Halt> {
        if !self.evaluations.covers(self.trainer.counters().round) {
            self.schedule_evaluation(&self.trainer.stats());
            self.order_evaluation();
        }
        // The learning state is saved before anything else is awaited.
        self.save();
        self.publish_progress(Phase::Evaluating);
        while let Some(version) = self.evaluations.oldest_version() {
            self.complete_evaluation(version)?;
        }
        Ok(())
    }

    fn schedule_evaluation(&mut self, stats: &RoundStats) {
        self.evaluations.schedule(&self.trainer, stats, self.progress.wall_s());
    }

    /// Orders the episodes of the evaluation that was scheduled after the latest round, if there is one.
    fn order_evaluation(&self) {
        let round = self.trainer.counters().round;
        if self.evaluations.is_pending(round) {
            self.order(self.trainer.evaluation_orders(round));
        }
    }

    /// Completes the evaluations that must be complete by now.
    fn complete_overdue_evaluations(&mut self) -> Result<(), Halt> {
        while let Some(version) = self.evaluations.overdue_version(self.trainer.counters().round) {
            self.complete_evaluation(version)?;
        }
        Ok(())
    }

    /// Waits for the oldest pending evaluation, that of the parameters `version`, and completes it.
    fn complete_evaluation(&mut self, version: u64) -> Result<(), Halt> {
        let episodes = self.wait_for(EpisodeKind::Evaluation, version)?;
        self.evaluations.complete(&episodes);
        self.progress.keep_evaluated(&episodes);
        self.write_records();
        self.progress.publish_evaluations(self.evaluations.history());
        Ok(())
    }

    fn publish_progress(&mut self, phase: Phase) {
        self.progress.publish(phase, &self.trainer, &self.trainer.stats());
    }

    fn write_records(&mut self) {
        self.persistence.write_records(&mut self.evaluations, self.progress.wall_s());
    }

    fn save(&mut self) {
        let (persistence, mut state) = self.persistence_and_state();
        persistence.save(&mut state);
    }
}

impl<'a> LearnerLoop<'a> {
    /// Borrows the persistence together with the state that it writes.
    fn persistence_and_state(&mut self) -> (&mut Persistence<'a>, LoopState<'_, 'a>) {
        let warns_of_policy = self.context.shared.warnings.of(Source::Policy).is_some();
        let state = LoopState {
            trainer: &self.trainer,
            acting: &self.acting,
            evaluations: &mut self.evaluations,
            wall_s: self.progress.wall_s(),
            teacher_policy: self.teacher_policy.as_deref(),
            had_other_policy: self.had_other_policy || warns_of_policy,
            renamed_account: self.renamed_account.as_ref(),
        };
        (&mut self.persistence, state)
    }
}

/// Returns the limit that a run has reached after `round` rounds and `wall_s` seconds; `None` before its end.
fn reached_limit(
    run: &RunConfig,
    history: &EvaluationHistory,
    round: u64,
    wall_s: f64,
) -> Option<String> {
    let stop = &run.stop;
    if let Some(success) = history.first_reaching(stop.until_success) {
        return Some(format!("success rate {success:.3} reached"));
    }
    if is_beyond_end(run, round) {
        return Some(format!("{} environment steps reached", stop.max_env_steps));
    }
    let is_over = stop.max_minutes > 0.0 && wall_s >= stop.max_minutes * 60.0;
    is_over.then(|| format!("{} minutes are over", stop.max_minutes))
}

/// Returns true if a run has made its environment steps before `round`.
fn is_beyond_end(run: &RunConfig, round: u64) -> bool {
    let max = run.stop.max_env_steps;
    max > 0 && round * run.env_steps_per_round() >= max
}

/// Returns the episodes that pay for advice, in their order: every advised one, or the first of each slot if a unit
/// pays for its lock step.
fn payers(orders: &[SlotOrder], unit: AdviceUnit) -> Vec<u64> {
    let n_payers = match unit {
        AdviceUnit::EnvStep => usize::MAX,
        AdviceUnit::SlotStep => 1,
    };
    let advised = |slot: &'_ SlotOrder| {
        let advised = slot.episodes.iter().filter(|order| order.advised).take(n_payers);
        advised.map(|order| order.number).collect::<Vec<_>>()
    };
    orders.iter().flat_map(advised).collect()
}

/// Returns the most units that an advised episode can use: one for each step on which it asks.
fn units_per_episode(orders: &[SlotOrder], task: &TaskSpec) -> u32 {
    let n_steps = u32::try_from(task.episode_steps()).expect("an episode has few steps");
    let advised = orders.iter().flat_map(|slot| &slot.episodes).filter(|order| order.advised);
    let units =
        advised.map(|order| order.advised_steps.map_or(n_steps, |asked| asked.min(n_steps)));
    units.max().unwrap_or(0)
}

/// Logs the workers that fell silent, the first [`MAX_SILENT_LINES`] by name: there can be thousands.
fn report_silent(fell_silent: &[SilentWorker]) {
    let n_logged = fell_silent.len().min(MAX_SILENT_LINES);
    let (logged, rest) = fell_silent.split_at(n_logged);
    for SilentWorker { worker_id, name, n_slots } in logged {
        WorkerSilent { worker_id: *worker_id, name, n_slots: *n_slots }.emit();
    }
    if !rest.is_empty() {
        tracing::warn!(n = rest.len(), "more workers silent");
    }
}

#[cfg(test)]
mod tests;
