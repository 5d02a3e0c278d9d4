//! The state with which a run starts: new, or from its newest checkpoint.

use std::path::{Path, PathBuf};

use tandem_core::TaskSpec;
use tandem_core::work::{PublishedActor, RunTerms, SlotOrder};
use tandem_net::{EncodedResponse, MAX_MESSAGE_BYTES};
use tandem_proto::{encode_actor, pb};
use tandem_rl::trainer::Trainer;
use tandem_system::atomic_file;
use tandem_telemetry::events::RunResumed;

use super::evaluations::Evaluations;
use super::halt::Halt;
use super::persistence::Persistence;
use super::progress_publisher::ProgressPublisher;
use super::run_lock::RunLock;
use super::{Context, LearnerLoop, reached_limit};
use crate::advice_account::{AccountOptions, AdviceAccount, RunStart};
use crate::checkpoint::{self, CheckpointError, Restored, Resumption};
use crate::error::Error;
use crate::evaluation_store::PendingEvaluation;
use crate::progress::Phase;
use crate::shared::LearnerConfig;

/// Upper bound of the tags, lengths and integers of an encoded episode: 11 fields and the tag of the episode itself.
const EPISODE_OVERHEAD_BYTES: usize = 12 * 11;
/// Upper bound of the fields of a submission other than the episodes; the largest is the text of a difference between
/// two plays.
const SUBMISSION_OVERHEAD_BYTES: usize = 4096;

/// The state with which a run starts.
pub(super) struct InitialState {
    pub(super) trainer: Trainer,
    resumption: Resumption,
    is_resumed: bool,
    /// True if the run was started before.
    was_started: bool,
    lock: RunLock,
}

impl InitialState {
    /// Locks the run directory and loads the newest checkpoint, or creates the state of a new run.
    pub(super) fn load(context: Context<'_>) -> Result<Self, Error> {
        let config = context.config;
        let lock = RunLock::take(config, context.shutdown)?;
        let checkpoints = config.out.join("checkpoint");
        let restored = if config.resume {
            checkpoint::load_newest(&checkpoints, &config.run)?
        } else {
            refuse_former_run(&config.out)?;
            None
        };
        let is_resumed = restored.is_some();
        let was_started = config.resume && was_started(config);
        let (mut trainer, resumption) = match restored {
            Some(Restored { path, trainer, resumption }) => {
                RunResumed { round: trainer.counters().round, path: &path }.emit();
                (trainer, resumption)
            }
            None => {
                if config.resume {
                    tracing::info!(path = ?checkpoints, "no checkpoint yet, the run starts anew");
                }
                new_run(config)?
            }
        };
        trainer.set_threads(config.n_threads);
        let n_bytes = EncodedResponse::encode(&encode_actor(&trainer.publish())).message_bytes();
        if n_bytes > MAX_MESSAGE_BYTES {
            return Err(Error::NetworksTooLarge { n_bytes });
        }
        check_slots(&trainer)?;
        Ok(Self { trainer, resumption, is_resumed, was_started, lock })
    }

    /// Returns true if the run has reached one of its limits.
    pub(super) fn is_complete(&self, config: &LearnerConfig) -> bool {
        let Resumption { history, wall_s, .. } = &self.resumption;
        let round = self.trainer.counters().round;
        reached_limit(&config.run, history, round, *wall_s).is_some()
    }

    /// Opens the run's account at the teacher if the run asks for advice.
    pub(super) fn open_account(&self, context: Context<'_>) -> Result<Option<AdviceAccount>, Halt> {
        let config = context.config;
        let advice = &config.run.advice;
        if !advice.asks() {
            return Ok(None);
        }
        let address =
            config.teacher.as_deref().ok_or_else(|| Error::NoTeacher(advice.strategy.clone()))?;
        let task = &self.trainer.task;
        let one_arm = task.single_arm().expect("checked: an advised task has a task of one arm");
        let options = AccountOptions {
            client_config: &config.client_config,
            address,
            one_arm: &one_arm,
            terms: pb::OpenAccountRequest {
                name: config.run.name.clone(),
                budget: config.run.advice_budget(),
                strategy: advice.strategy.clone(),
            },
            renamed: self.resumption.account.clone(),
            first_policy: self.resumption.teacher_policy.clone(),
            had_other_policy: self.resumption.had_other_policy,
            view: context.shared.teacher.clone(),
            clock: config.clock.clone(),
            start: match self.is_resumed {
                true => RunStart::Resumed { spent: self.trainer.counters().advice_spent },
                false if self.was_started => RunStart::Restarted,
                false => RunStart::New,
            },
        };
        let warnings = &context.shared.warnings;
        Ok(Some(AdviceAccount::open(options, warnings, context.runtime, context.shutdown)?))
    }
}

/// Checks that a worker can send the episodes of every slot in one message.
fn check_slots(trainer: &Trainer) -> Result<(), Error> {
    let max_episode_bytes = max_episode_bytes(&trainer.task);
    let check = |order: &SlotOrder| {
        let n_bytes = SUBMISSION_OVERHEAD_BYTES + order.episodes.len() * max_episode_bytes;
        if n_bytes > MAX_MESSAGE_BYTES {
            return Err(Error::SlotTooLarge { n_bytes, kind: order.kind });
        }
        Ok(())
    };
    // The first slot of each kind is the largest.
    trainer.evaluation_orders(0).first().map_or(Ok(()), check)?;
    trainer.training_orders(0, 0).first().map_or(Ok(()), check)
}

/// Returns an upper bound of the size of an encoded episode within the message that submits it.
fn max_episode_bytes(task: &TaskSpec) -> usize {
    let n_steps = task.episode_steps();
    let n_numbers =
        (n_steps + 1) * task.n_observation() + task.n_goal() + n_steps * task.n_action();
    // One byte per step for each of the advised arms and the contacts.
    size_of::<f32>() * n_numbers + 2 * n_steps + EPISODE_OVERHEAD_BYTES
}

/// Returns the state before the first round.
fn new_run(config: &LearnerConfig) -> Result<(Trainer, Resumption), Error> {
    let mut trainer = Trainer::new(config.run.clone())?;
    if config.run.advice.starts_from_teacher() {
        let none = || {
            let needs = "needs the teacher's policy file: give it by --start-from";
            Error::StartFrom(needs.to_owned())
        };
        let teacher = config.start_from.as_ref().ok_or_else(none)?;
        trainer.start_from(teacher).map_err(Error::StartFrom)?;
    }
    let resumption = Resumption::of_new_run(trainer.publish());
    Ok((trainer, resumption))
}

impl<'a> LearnerLoop<'a> {
    /// Creates the loop, publishes the parameters that workers need, and orders pending evaluations again.
    pub(super) fn new(
        context: Context<'a>,
        initial: InitialState,
        account: Option<AdviceAccount>,
    ) -> Self {
        let Context { config, shared, .. } = context;
        let InitialState { trainer, resumption, lock, .. } = initial;
        let Resumption { acting, history, pending, wall_s, teacher_policy, .. } = resumption;
        let Resumption { had_other_policy, account: renamed, .. } = resumption;
        let policy = account.as_ref().and_then(AdviceAccount::policy).map(str::to_owned);
        let renamed_account = account.as_ref().and_then(AdviceAccount::renamed).or(renamed);
        let terms = RunTerms {
            run: config.run.name.clone(),
            task: trainer.task.clone(),
            account: account.as_ref().map(|account| account.name().to_owned()),
            advice: config.run.advice.terms(),
            exploration: config.run.exploration,
            world: config.run.world,
            symmetrized_evaluation: config.run.evaluation.symmetrized,
        };
        publish_parameters(context, &pending, &acting, &trainer);
        // The clock counts from the start of this process, and the run's wall time continues that of its earlier parts.
        let started_s = config.unix_start.as_secs_f64() - wall_s;
        let mut learner = Self {
            context,
            trainer,
            acting,
            account,
            teacher_policy: policy.or(teacher_policy),
            had_other_policy,
            renamed_account,
            evaluations: Evaluations::new(config, history, pending, started_s),
            persistence: Persistence::new(config, shared, lock),
            progress: ProgressPublisher::new(config, shared, wall_s),
            reclaimed_at: None,
        };
        for pending in learner.evaluations.pending() {
            learner.order(learner.trainer.evaluation_orders(pending.counters.round));
        }
        learner.write_records();
        learner.publish_progress(Phase::Starting);
        learner.progress.publish_evaluations(learner.evaluations.history());
        shared.lock().terms = Some(terms);
        learner
    }
}

/// Publishes the parameters of pending evaluations, of the next round, and the newest ones.
fn publish_parameters(
    context: Context<'_>,
    pending: &[PendingEvaluation],
    acting: &PublishedActor,
    trainer: &Trainer,
) {
    for PendingEvaluation { counters, policy, .. } in pending {
        context.shared.publish(&policy.published(counters.round));
    }
    context.shared.publish(acting);
    context.shared.publish(&trainer.publish());
}

/// Returns true if the run was started before: a learner writes the run file once the run's account is open. One that
/// does not write it cannot know, and is resumed by its parent process only.
fn was_started(config: &LearnerConfig) -> bool {
    config.run_file.is_none() || run_file_path(config).exists()
}

/// Refuses to start a new run in the directory of another, which it would overwrite.
fn refuse_former_run(out: &Path) -> Result<(), CheckpointError> {
    let has_rows = std::fs::metadata(out.join("metrics.jsonl")).is_ok_and(|file| file.len() > 0);
    if has_rows || !checkpoint::list(&out.join("checkpoint")).is_empty() {
        return Err(CheckpointError::RunExists(out.to_owned()));
    }
    Ok(())
}

/// Writes the settings with which the run continues.
pub(super) fn write_run_file(config: &LearnerConfig) -> Result<(), Error> {
    let Some(text) = &config.run_file else { return Ok(()) };
    let path = run_file_path(config);
    if std::fs::read(&path).is_ok_and(|there| there == text.as_bytes()) {
        return Ok(());
    }
    atomic_file::replace(&path, text.as_bytes()).map_err(|error| Error::RunDirectory {
        action: "write",
        path,
        source: error.into(),
    })
}

fn run_file_path(config: &LearnerConfig) -> PathBuf {
    config.out.join("run.toml")
}

#[cfg(test)]
mod tests {
    use tandem_core::{Episode, EpisodeKind, Layout, Task};
    use tandem_proto::encode_episode;

    use super::*;

    #[test]
    fn the_size_of_an_episode_is_bounded_closely() {
        let task = TaskSpec::from(Layout::new(Task::PickAndPlace, 2));
        let mut episode = Episode::zeros(task.clone(), u64::MAX);
        episode.kind = EpisodeKind::Evaluation;
        episode.parameter_version = u64::MAX;
        episode.advice_charged = u32::MAX;
        episode.avoidance_steps = Some(u32::MAX);
        episode.queried_steps = Some(u32::MAX);
        let episodes = vec![encode_episode(&episode); 3];
        let message = pb::SubmitEpisodesRequest { episodes, ..Default::default() };
        let n_bytes = EncodedResponse::encode(&message).message_bytes();
        let bound = 3 * max_episode_bytes(&task);
        assert!((n_bytes..n_bytes + 3 * EPISODE_OVERHEAD_BYTES).contains(&bound), "{n_bytes}");
    }
}
