//! The thread that learns: opens rounds, waits for their episodes, updates, publishes, judges, saves, stops.

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::time::Duration;

use tandem_core::work::{PublishedActor, RunTerms, SlotOrder};
use tandem_core::{Episode, EpisodeKind, EpisodeOutcome, EvaluationSummary};
use tandem_policy::Policy;
use tandem_proto::pb;
use tandem_telemetry::{MetricsLog, MetricsRow};
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};

use crate::checkpoint::{self, Resumption};
use crate::service::{Error, LearnerConfig, Shared};
use crate::teacher::{Ledger, TeacherError};
use crate::trainer::{RoundFigures, Trainer};

/// Rounds after which an evaluation must be in; until then it fills the workers' gaps.
const EVALUATION_PATIENCE_ROUNDS: u64 = 4;
/// Pause between two looks at the stop conditions while episodes are awaited.
const WAIT_TICK: Duration = Duration::from_millis(200);
/// Span over which the rates in the progress are taken.
const RATE_SPAN_S: f64 = 15.0;
/// Rounds of the paper's epoch (section 4.2; DESIGN: 50 cycles of the reference implementation).
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
        drive.tell("starting", 0, &RoundFigures::default());
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
        self.tell("collecting", 0, &figures);
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
            ledger.open_leases(advised, tandem_core::layout::EPISODE_STEPS as u32)?;
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
            for worker in state.board.reclaim((self.config.clock)()) {
                warn!(worker, "worker is silent, its slots are given to others");
            }
            state = self.shared.wait(state, WAIT_TICK);
        }
    }

    /// Starts an evaluation when one is due, and takes in those that are done or overdue.
    fn judge(&mut self, figures: &RoundFigures) -> Result<(), Error> {
        let round = self.trainer.counters().round;
        if round.is_multiple_of(self.config.run.rounds_per_evaluation()) {
            self.start_evaluation(figures);
        }
        while let Some(oldest) = self.pending.front() {
            let overdue = round >= oldest.row.round + EVALUATION_PATIENCE_ROUNDS;
            if !overdue {
                break;
            }
            if !self.finish_evaluation()? {
                break;
            }
        }
        Ok(())
    }

    fn start_evaluation(&mut self, figures: &RoundFigures) {
        let version = self.trainer.counters().round;
        let row = self.row(figures);
        self.pending.push_back(Pending {
            version,
            policy: self.trainer.policy(BTreeMap::new()),
            row,
        });
        self.add(self.trainer.evaluation_orders(version));
    }

    /// Takes in the oldest pending evaluation. Gives whether it could: false when interrupted.
    fn finish_evaluation(&mut self) -> Result<bool, Error> {
        let Some(pending) = self.pending.front() else { return Ok(false) };
        let Some(episodes) = self.wait_for(EpisodeKind::Evaluation, pending.version) else {
            return Ok(false);
        };
        let Some(Pending { mut policy, mut row, .. }) = self.pending.pop_front() else {
            return Ok(false);
        };
        let outcomes: Vec<EpisodeOutcome> = episodes.iter().map(EpisodeOutcome::of).collect();
        judge_into(&mut row, &EvaluationSummary::of(&outcomes));
        row.best = self.best.as_ref().is_none_or(|best| is_better(&row, best));
        info!(
            round = row.round,
            env_steps = row.env_steps,
            success = row.success,
            mean_q = row.mean_q,
            "evaluated"
        );
        self.metrics.append(&row).map_err(self.in_run_directory("append to", "metrics.jsonl"))?;
        self.judged_round = Some(row.round);
        policy.metadata = self.metadata(&row);
        if row.best {
            self.save_policy(&policy, "best")?;
            self.best = Some(row.clone());
        }
        self.save_policy(&policy, "last")?;
        let until = self.config.run.stop.until_success;
        if until > 0.0 && row.success >= until {
            self.success_reached = Some(row.success);
        }
        let evaluation = evaluation_message(&row);
        let best = self.best.as_ref().map(evaluation_message);
        self.shared.progress.send_modify(|progress| {
            progress.evaluation = Some(evaluation);
            progress.best = best;
        });
        Ok(true)
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
                self.tell("evaluating", 0, &self.trainer.figures());
                while !self.pending.is_empty() && self.finish_evaluation()? {}
                (reason, false)
            }
        };
        if interrupted {
            self.save();
        }
        let digest = self.trainer.digest();
        self.tell("ended", 0, &self.trainer.figures());
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
            Ok(path) => info!(?path, round = self.trainer.counters().round, "checkpoint saved"),
            Err(error) => {
                let cause =
                    std::error::Error::source(&error).map(ToString::to_string).unwrap_or_default();
                warn!(%error, cause, "checkpoint not saved, training goes on");
            }
        }
    }

    fn save_policy(&self, policy: &Policy, name: &str) -> Result<(), Error> {
        let directory = self.config.out.join("policy");
        let path = directory.join(format!("{name}.safetensors"));
        std::fs::create_dir_all(&directory).map_err(self.in_run_directory("create", "policy"))?;
        policy.save(&path).map_err(|source| Error::RunDirectory {
            action: "write",
            path,
            source: source.into(),
        })
    }

    fn in_run_directory<E: std::error::Error + Send + Sync + 'static>(
        &self,
        action: &'static str,
        name: &str,
    ) -> impl FnOnce(E) -> Error + use<E> {
        let path = self.config.out.join(name);
        move |source| Error::RunDirectory { action, path, source: source.into() }
    }

    fn metadata(&self, row: &MetricsRow) -> BTreeMap<String, String> {
        let run = &self.config.run;
        let entries = [
            ("run", run.name.clone()),
            ("seed", run.seed.to_string()),
            (
                "recipe",
                if run.recipe == crate::config::Recipe::Tandem { "tandem" } else { "paper" }
                    .to_owned(),
            ),
            ("strategy", run.advice.strategy.clone()),
            ("advice_share", run.advice.share.to_string()),
            ("substeps", run.world.substeps.to_string()),
            ("program", self.config.version.clone()),
            ("env_steps", row.env_steps.to_string()),
            ("updates", row.updates.to_string()),
            ("advice_spent", row.advice_spent.to_string()),
            ("wall_s", format!("{:.1}", row.wall_s)),
            ("evaluation_seed", run.evaluation.seed.to_string()),
            ("evaluation_episodes", row.n_episodes.to_string()),
            ("evaluation_success", row.success.to_string()),
        ];
        entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
    }

    /// A row of metrics for the present state, without the evaluation's figures.
    fn row(&self, figures: &RoundFigures) -> MetricsRow {
        let counters = self.trainer.counters();
        MetricsRow {
            round: counters.round,
            env_steps: counters.env_steps,
            episodes: counters.episodes,
            updates: counters.updates,
            paper_epochs: counters.round as f64 / ROUNDS_PER_PAPER_EPOCH,
            wall_s: self.now_s(),
            mean_q: figures.mean_q,
            critic_loss: figures.critic_loss,
            actor_loss: figures.actor_loss,
            advice_spent: counters.advice_spent,
            budget_left: self.budget_left(),
            training_success: figures.training_success,
            training_moved: figures.training_moved,
            ..MetricsRow::default()
        }
    }

    fn budget_left(&self) -> u64 {
        self.ledger.as_ref().map_or(0, Ledger::left)
    }

    fn now_s(&self) -> f64 {
        self.wall_before_s + (self.config.clock)().as_secs_f64()
    }

    /// Publishes the progress.
    fn tell(&self, phase: &str, n_updates: u64, figures: &RoundFigures) {
        let counters = self.trainer.counters();
        let rate =
            |count: fn(&(f64, u64, u64)) -> u64| match (self.rates.front(), self.rates.back()) {
                (Some(first), Some(last)) if last.0 > first.0 => {
                    (count(last) - count(first)) as f64 / (last.0 - first.0)
                }
                _ => 0.0,
            };
        let run = &self.config.run;
        let workers = self.workers();
        self.shared.progress.send_modify(|progress| {
            progress.task.clone_from(&run.task);
            progress.n_arms = run.arms as u32;
            progress.strategy.clone_from(&run.advice.strategy);
            progress.round = counters.round;
            progress.env_steps = counters.env_steps;
            progress.episodes = counters.episodes;
            progress.updates = counters.updates + n_updates;
            progress.wall_s = self.now_s();
            progress.env_steps_per_s = rate(|(_, env_steps, _)| *env_steps);
            progress.updates_per_s = rate(|(_, _, updates)| *updates);
            progress.advice_spent = counters.advice_spent;
            progress.budget_left = self.budget_left();
            progress.phase = phase.to_owned();
            progress.training_success = figures.training_success;
            progress.workers = workers;
            if progress.best.is_none() {
                progress.best = self.best.as_ref().map(evaluation_message);
            }
        });
    }

    fn workers(&self) -> Vec<pb::WorkerProgress> {
        let state = self.shared.lock();
        let progress = |(worker_id, worker): (u64, &crate::board::Worker)| pb::WorkerProgress {
            worker_id,
            name: worker.name.clone(),
            episodes: worker.n_episodes,
            doing: worker.slot.map_or_else(|| "waiting".to_owned(), |slot| format!("slot {slot}")),
        };
        state.board.workers().map(progress).collect()
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
    Ok(Some(Ledger::open(address, &terms, spent, runtime.clone(), shutdown.clone())?))
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

fn judge_into(row: &mut MetricsRow, summary: &EvaluationSummary) {
    row.n_episodes = summary.n_episodes as u64;
    row.success = summary.success;
    row.success_low = summary.interval.low;
    row.success_high = summary.interval.high;
    row.success_joint = summary.success_joint;
    row.success_per_arm.clone_from(&summary.success_per_arm);
    row.collision_rate = summary.collision_rate;
    row.collision_rate_before_success = summary.collision_rate_before_success;
    row.moved = summary.moved;
    row.mean_return = summary.mean_return;
}

/// Whether an evaluation beats another: more success, or as much with fewer contacts.
fn is_better(row: &MetricsRow, than: &MetricsRow) -> bool {
    row.success > than.success
        || (row.success >= than.success && row.collision_rate < than.collision_rate)
}

fn evaluation_message(row: &MetricsRow) -> pb::Evaluation {
    pb::Evaluation {
        round: row.round,
        env_steps: row.env_steps,
        n_episodes: row.n_episodes as u32,
        success: row.success,
        success_low: row.success_low,
        success_high: row.success_high,
        success_joint: row.success_joint,
        success_per_arm: row.success_per_arm.clone(),
        collision_rate: row.collision_rate,
        mean_q: row.mean_q,
    }
}
