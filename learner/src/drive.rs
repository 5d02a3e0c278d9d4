//! The thread that learns: opens rounds, waits for their episodes, updates, publishes, judges, saves, stops.

mod judge;
mod progress;

use std::collections::VecDeque;
use std::path::PathBuf;
use std::time::Duration;

use tandem_core::layout::EPISODE_STEPS;
use tandem_core::work::{PublishedActor, RunTerms, SlotOrder};
use tandem_core::{Episode, EpisodeKind};
use tandem_policy::Policy;
use tandem_proto::pb;
use tandem_telemetry::events::{
    CheckpointSaved, ParametersPublished, RoundFinished, RunFinished, WorkerSilent,
};
use tandem_telemetry::{MetricsLog, MetricsRow};
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;
use tracing::warn;

use crate::board::Silent;
use crate::checkpoint::{self, Resumption};
use crate::error::Error;
use crate::shared::{LearnerConfig, Shared};
use crate::teacher::{Ledger, TeacherError};
use crate::trainer::{RoundFigures, Trainer};

/// Rounds after which an evaluation must be in; until then it fills the workers' gaps.
const EVALUATION_PATIENCE_ROUNDS: u64 = 4;
/// Pause between two looks at the stop conditions while episodes are awaited.
const WAIT_TICK: Duration = Duration::from_millis(200);
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
    runtime: &Handle,
    shutdown: &CancellationToken,
) -> Result<Ended, Error> {
    match Drive::start(config, shared, runtime, shutdown) {
        Ok(mut drive) => {
            let reason = drive.rounds()?;
            drive.finish(reason)
        }
        Err(Error::Teacher(TeacherError::Stopped)) => Ok(Ended {
            reason: "stopped before the first round".to_owned(),
            interrupted: true,
            digest: String::new(),
        }),
        Err(error) => Err(error),
    }
}

/// Why rounds end.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Stop {
    Reached(String),
    Interrupted,
}

/// An evaluation whose episodes are being played.
struct Pending {
    version: u64,
    policy: Policy,
    row: MetricsRow,
}

struct Drive<'a> {
    config: &'a LearnerConfig,
    shared: &'a Shared,
    shutdown: &'a CancellationToken,
    trainer: Trainer,
    /// Plays the round that is being awaited.
    acting: PublishedActor,
    ledger: Option<Ledger>,
    metrics: MetricsLog,
    pending: VecDeque<Pending>,
    best: Option<MetricsRow>,
    wall_before_s: f64,
    rates: VecDeque<(f64, u64, u64)>,
    success_reached: Option<f64>,
    /// The round of the latest row of metrics.
    judged_round: Option<u64>,
}

impl<'a> Drive<'a> {
    fn start(
        config: &'a LearnerConfig,
        shared: &'a Shared,
        runtime: &Handle,
        shutdown: &'a CancellationToken,
    ) -> Result<Self, Error> {
        let checkpoints = config.out.join("checkpoint");
        let (mut trainer, acting, wall_before_s) = if config.resume {
            let (trainer, Resumption { acting, wall_s }) =
                checkpoint::load_newest(&checkpoints, &config.run)?;
            (trainer, acting, wall_s)
        } else {
            let trainer = Trainer::new(config.run.clone())?;
            let acting = trainer.publish();
            (trainer, acting, 0.0)
        };
        trainer.set_threads(config.n_threads);
        let ledger = open_ledger(config, &trainer, runtime, shutdown)?;
        let (metrics, rows) = open_metrics(config, trainer.counters().round)?;
        let judged_round = rows.last().map(|row| row.round);
        let best = rows.into_iter().rfind(|row| row.best);
        let terms = RunTerms {
            layout: trainer.layout,
            account: ledger.as_ref().map(|ledger| ledger.account().to_owned()),
            exploration: config.run.exploration(),
            world: config.run.world_terms(),
        };
        shared.publish(acting.clone());
        shared.publish(trainer.publish());
        let drive = Self {
            config,
            shared,
            shutdown,
            trainer,
            acting,
            ledger,
            metrics,
            pending: VecDeque::new(),
            best,
            wall_before_s,
            rates: VecDeque::new(),
            success_reached: None,
            judged_round,
        };
        drive.tell("starting", &RoundFigures::default());
        shared.lock().terms = Some(terms);
        Ok(drive)
    }

    /// Learns round after round until something stops it.
    fn rounds(&mut self) -> Result<Stop, Error> {
        self.open_round(self.trainer.counters().round, self.acting.version)?;
        loop {
            if let Some(stop) = self.stop() {
                return Ok(stop);
            }
            let Some(episodes) = self.wait_for(EpisodeKind::Training, self.acting.version) else {
                return Ok(Stop::Interrupted);
            };
            if let Some(ledger) = &mut self.ledger {
                ledger.settle(&episodes)?;
            }
            let round = self.trainer.counters().round;
            let lagged = self.config.run.rounds.lag == 1;
            if lagged {
                self.acting = self.trainer.publish();
                self.open_round(round + 1, round)?;
            }
            let figures = self.learn(&episodes)?;
            let newest = self.trainer.publish();
            self.shared.publish(newest.clone());
            if !lagged {
                self.acting = newest;
                self.open_round(round + 1, round + 1)?;
            }
            self.judge(&figures)?;
            if self.trainer.counters().round.is_multiple_of(self.config.run.checkpoint.every_rounds)
            {
                self.save();
            }
        }
    }

    fn learn(&mut self, episodes: &[Episode]) -> Result<RoundFigures, Error> {
        self.trainer.ingest(episodes);
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

    /// Hands out the slots of a round, after its leases are open.
    fn open_round(&mut self, round: u64, version: u64) -> Result<(), Error> {
        if self.is_last(round) {
            return Ok(());
        }
        let orders = self.trainer.training_orders(round, version);
        if let Some(ledger) = &mut self.ledger {
            let ordered = orders.iter().flat_map(|slot| &slot.episodes);
            let advised = ordered.filter(|order| order.advised).map(|order| order.number).collect();
            ledger.open_leases(advised, UNITS_PER_EPISODE)?;
        }
        self.add(orders);
        Ok(())
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
    fn wait_for(&self, kind: EpisodeKind, version: u64) -> Option<Vec<Episode>> {
        let mut state = self.shared.lock();
        loop {
            if state.board.is_complete(kind, version) {
                return Some(state.board.take(kind, version));
            }
            if self.shutdown.is_cancelled() {
                return None;
            }
            for silent in state.board.reclaim((self.config.clock)()) {
                let Silent { worker_id, name, n_slots } = silent;
                WorkerSilent { worker_id, name: &name, n_slots }.emit();
            }
            state = self.shared.wait(state, WAIT_TICK);
        }
    }

    fn stop(&self) -> Option<Stop> {
        let stop = &self.config.run.stop;
        if self.shutdown.is_cancelled() {
            return Some(Stop::Interrupted);
        }
        if let Some(success) = self.success_reached {
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
        let (reason, interrupted) = match stop {
            Stop::Interrupted => ("interrupted".to_owned(), true),
            Stop::Reached(reason) => {
                self.save();
                let judged = self.pending.back().is_some_and(|pending| pending.version == round)
                    || self.judged_round == Some(round);
                if !judged && round > 0 {
                    let figures = self.trainer.figures();
                    self.start_evaluation(&figures);
                }
                self.tell("evaluating", &self.trainer.figures());
                while !self.pending.is_empty() && self.finish_evaluation()? {}
                (reason, false)
            }
        };
        if interrupted {
            self.save();
        }
        let digest = self.trainer.digest();
        RunFinished { reason: &reason, round, digest: &digest }.emit();
        self.tell("ended", &self.trainer.figures());
        self.shared.progress.send_modify(|progress| progress.digest.clone_from(&digest));
        Ok(Ended { reason, interrupted, digest })
    }

    /// Saves a checkpoint; when that fails training goes on and the former one stays.
    fn save(&self) {
        let resumption = Resumption { acting: self.acting.clone(), wall_s: self.now_s() };
        let directory = self.config.out.join("checkpoint");
        match checkpoint::save(
            &directory,
            &self.trainer,
            &resumption,
            self.config.run.checkpoint.keep,
        ) {
            Ok((path, digest)) => {
                CheckpointSaved {
                    round: self.trainer.counters().round,
                    path: &path,
                    digest: &digest,
                }
                .emit();
            }
            Err(error) => {
                let cause =
                    std::error::Error::source(&error).map(ToString::to_string).unwrap_or_default();
                warn!(%error, cause, "checkpoint not saved, training goes on");
            }
        }
    }
}

/// Opens the run's account when it asks for advice.
fn open_ledger(
    config: &LearnerConfig,
    trainer: &Trainer,
    runtime: &Handle,
    shutdown: &CancellationToken,
) -> Result<Option<Ledger>, Error> {
    let advice = &config.run.advice;
    if !advice.asks() {
        return Ok(None);
    }
    let address =
        config.teacher.as_deref().ok_or_else(|| Error::NoTeacher(advice.strategy.clone()))?;
    let terms = pb::OpenAccountRequest {
        name: config.run.name.clone(),
        budget: advice.budget,
        strategy: advice.strategy.clone(),
    };
    let spent = trainer.counters().advice_spent;
    Ok(Some(Ledger::open((&config.dial, address), &terms, spent, runtime, shutdown)?))
}

/// Opens the metrics of the run directory; what lies after `round` belongs to a lost future and is cut off.
fn open_metrics(
    config: &LearnerConfig,
    round: u64,
) -> Result<(MetricsLog, Vec<MetricsRow>), Error> {
    let path: PathBuf = config.out.join("metrics.jsonl");
    let failed = |source| Error::RunDirectory { action: "open", path: path.clone(), source };
    std::fs::create_dir_all(&config.out).map_err(|error| failed(error.into()))?;
    let mut metrics = MetricsLog::open(&path).map_err(|error| failed(error.into()))?;
    metrics.truncate_after(round).map_err(|error| failed(error.into()))?;
    let rows = MetricsLog::read_all(&path).map_err(|error| failed(error.into()))?;
    Ok((metrics, rows))
}
