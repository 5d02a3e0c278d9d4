//! Logs of single episodes, and their replay.
//!
//! An episode of a built-in task is logged after it was played, by simulating its actions again. Every such log thereby
//! verifies that the simulator is deterministic, bit for bit. An episode of another task is logged as it was played.

use std::path::{Path, PathBuf};

use tandem_core::reward::{REWARD_ACHIEVED, REWARD_PENDING};
use tandem_core::rng::{Stream, episode_rng};
use tandem_core::scene::Scene;
use tandem_core::settings::OutOfRange;
use tandem_core::work::{EpisodeOrder, EpisodeStart, RunTerms};
use tandem_core::{Episode, EpisodeKind, Layout, TaskSpec, WorldSettings};
use tandem_sim::{Env, SimError, WorldConfig};
use tandem_telemetry::{EpisodeMetadata, EpisodeRecorder, TransitionRecord};

use crate::rollout::world_settings;
use crate::trace::{Trace, TracedAdvice};

/// A probability of earlier versions: training episodes that started with the hands anywhere above the table.
const WIDE_START_SHARE: &str = "wide_start_share";

/// An error in recording or replaying an episode.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The world cannot be built, or a step failed.
    #[error(transparent)]
    World(#[from] SimError),
    /// The log cannot be written.
    #[error(transparent)]
    Log(#[from] tandem_telemetry::Error),
    /// The replayed episode differs from the original.
    #[error("episode {episode}, simulated again, differs before step {step}")]
    Diverged {
        /// The episode's number.
        episode: u64,
        /// The first step before which the observation differs; 0 is the start.
        step: usize,
    },
    /// The replayed episode differs from its log.
    #[error(
        "step {step}: {field}[{component}] is {logged} in the log, {played} when simulated again"
    )]
    Differs {
        /// The first step that differs, from 0; the number of steps means the final observation.
        step: usize,
        /// The step's vector that differs.
        field: &'static str,
        /// The index within the vector.
        component: usize,
        /// The value in the log.
        logged: f32,
        /// The simulated value.
        played: f32,
    },
    /// The log contains no steps to compare.
    #[error("the log holds no step")]
    NoSteps,
    /// The log's metadata lack a part of the world's configuration.
    #[error("metadata entry {key:?} of the world is {got:?}, expected a number")]
    Metadata {
        /// The key of the entry.
        key: &'static str,
        /// The value, if there is one.
        got: Option<String>,
    },
    /// A setting of the world is out of its range.
    #[error(transparent)]
    Setting(#[from] OutOfRange),
    /// The episode may have started in a way that only earlier versions simulate.
    #[error("the log has {WIDE_START_SHARE} = {0}: this version has no such starts")]
    RemovedStart(String),
    /// The simulator does not have the task of the episode.
    #[error(
        "the episode is of task {task:?}, which only its environments can simulate again: name them by --env or --env-command"
    )]
    NoSimulator {
        /// The task's name.
        task: String,
    },
    /// The server of the environments failed.
    #[error(transparent)]
    Environment(Box<crate::error::Error>),
}

/// Returns the metadata of an episode that was played by `order`.
///
/// `policy_digest` is the digest of the parameters that played it: [`tandem_policy::actor_digest`] in a run,
/// [`Policy::digest`](tandem_policy::Policy::digest) where the whole policy is at hand.
#[must_use]
pub fn metadata_of(
    order: EpisodeOrder,
    episode: &Episode,
    terms: &RunTerms,
    policy_digest: String,
) -> EpisodeMetadata {
    EpisodeMetadata {
        run: terms.run.clone(),
        episode: order.number,
        seed: order.seed,
        kind: episode.kind,
        parameter_version: episode.parameter_version,
        task: episode.task.clone(),
        policy_digest,
        world: world_settings(&order, episode.kind, terms)
            .log_entries()
            .into_iter()
            .map(|(key, value)| (key.to_owned(), value))
            .collect(),
    }
}

/// Returns the start of a logged episode.
///
/// # Errors
/// When the metadata lack an entry or have one that is out of its range, or only earlier versions have such starts.
pub fn start_of(metadata: &EpisodeMetadata) -> Result<EpisodeStart, RecordError> {
    let entry = |key: &str| metadata.world.get(key).map(String::as_str);
    let settings = WorldSettings::from_log_entries(entry)
        .map_err(|key| RecordError::Metadata { key, got: entry(key).map(str::to_owned) })?;
    settings.check()?;
    let is_training = metadata.kind == EpisodeKind::Training;
    if let Some(share) = entry(WIDE_START_SHARE).filter(|share| is_training && *share != "0") {
        return Err(RecordError::RemovedStart(share.to_owned()));
    }
    let world = settings.for_kind(metadata.kind);
    Ok(EpisodeStart { number: metadata.episode, seed: metadata.seed, kind: metadata.kind, world })
}

/// Builds the world of a logged episode of a built-in task, in the episode's start state.
///
/// # Errors
/// When the task is not built-in, the metadata lack an entry or have one that is out of its range, only earlier
/// versions have such starts, or the world cannot be built.
pub fn world_of(metadata: &EpisodeMetadata) -> Result<Env, RecordError> {
    let no_simulator = || RecordError::NoSimulator { task: metadata.task.name().to_owned() };
    world_in(metadata.task.as_built_in().ok_or_else(no_simulator)?, metadata)
}

fn world_in(layout: Layout, metadata: &EpisodeMetadata) -> Result<Env, RecordError> {
    let start = start_of(metadata)?;
    let mut world = Env::new(layout, &WorldConfig::from(start.world))?;
    let mut rng = episode_rng(start.seed, start.number, Stream::Reset);
    world.reset(&mut rng, start.world);
    Ok(world)
}

/// Returns the file name of an episode's log.
#[must_use]
pub fn log_name(episode: &Episode) -> String {
    match episode.kind {
        EpisodeKind::Training => {
            format!("train-{:06}-{:06}.mcap", episode.parameter_version, episode.number)
        }
        EpisodeKind::Evaluation => {
            format!("eval-{:06}-{:03}.mcap", episode.parameter_version, episode.number)
        }
    }
}

/// Logs `episode` at `path` and returns the finished file's path. An episode of a built-in task is simulated again, in
/// the world that `metadata` describes, for the scenes of its log.
///
/// # Errors
/// When the world cannot be built, the episode, simulated again, differs from `episode`, or the log cannot be written.
/// An incomplete log, `NAME.mcap.part`, may remain then.
pub fn record_episode(
    metadata: &EpisodeMetadata,
    episode: &Episode,
    path: &Path,
) -> Result<PathBuf, RecordError> {
    let mut world = match metadata.task.as_built_in() {
        Some(layout) => Some(world_in(layout, metadata)?),
        None => None,
    };
    let mut recorder = EpisodeRecorder::create(path, metadata)?;
    for step_idx in 0..episode.n_steps() {
        let scene = world.as_ref().map(Env::scene);
        record_step(&mut recorder, scene.as_ref(), episode, step_idx, None)?;
        if let Some(world) = &mut world {
            check_replay(world, episode, step_idx)?;
            if world.step(episode.action(step_idx))? != episode.contacts[step_idx] {
                return Err(RecordError::Diverged { episode: episode.number, step: step_idx + 1 });
            }
        }
    }
    if let Some(world) = &world {
        check_replay(world, episode, episode.n_steps())?;
    }
    let scene = world.as_ref().map(Env::scene);
    recorder.record_outcome(scene.as_ref(), episode.last_observation())?;
    Ok(recorder.finish()?)
}

/// Logs `episode` at `path` with the scenes and the advice of its `trace`, and returns the finished file's path.
/// Nothing is simulated.
///
/// # Errors
/// When the log cannot be written. An incomplete log, `NAME.mcap.part`, may remain then.
pub fn record_traced(
    metadata: &EpisodeMetadata,
    episode: &Episode,
    trace: &Trace,
    path: &Path,
) -> Result<PathBuf, RecordError> {
    let mut recorder = EpisodeRecorder::create(path, metadata)?.in_one_piece();
    for step_idx in 0..episode.n_steps() {
        let (scene, advice) = (trace.scenes.get(step_idx), trace.advice.get(step_idx));
        record_step(&mut recorder, scene, episode, step_idx, advice)?;
    }
    recorder.record_outcome(trace.scenes.last(), episode.last_observation())?;
    Ok(recorder.finish()?)
}

fn record_step(
    recorder: &mut EpisodeRecorder,
    scene: Option<&Scene>,
    episode: &Episode,
    step_idx: usize,
    advice: Option<&TracedAdvice>,
) -> Result<(), RecordError> {
    let after = episode.observation(step_idx + 1);
    let rewards_per_arm = rewards_per_arm(&episode.task, after, &episode.goal);
    let transition = TransitionRecord {
        step: u32::try_from(step_idx).expect("an episode's steps are few"),
        observation: episode.observation(step_idx),
        goal: &episode.goal,
        action: episode.action(step_idx),
        reward: episode.joint_reward(step_idx),
        rewards_per_arm: &rewards_per_arm,
        advised_arms: episode.advised_arms[step_idx],
        contacts: episode.contacts[step_idx],
        advice: advice.map_or(&[], |advice| advice.arms.as_slice()),
        budget_left: advice.and_then(|advice| advice.budget_left),
    };
    Ok(recorder.record_step(scene, &transition)?)
}

/// Returns the reward of each arm for a step after which `observation` is observed, shape `[n_arms]`.
pub(crate) fn rewards_per_arm(task: &TaskSpec, observation: &[f32], goal: &[f32]) -> Vec<f32> {
    let reward = |arm| match task.arm_reaches_goal(arm, observation, goal) {
        true => REWARD_ACHIEVED,
        false => REWARD_PENDING,
    };
    task.arms().map(reward).collect()
}

/// Checks that the world's observation equals the episode's before step `step_idx`, bit for bit.
fn check_replay(world: &Env, episode: &Episode, step_idx: usize) -> Result<(), RecordError> {
    let expected = episode.observation(step_idx);
    let mut observation = vec![0.0; expected.len()];
    world.observe(&mut observation);
    let same =
        observation.iter().zip(expected).all(|(got, expected)| got.to_bits() == expected.to_bits());
    if same {
        Ok(())
    } else {
        Err(RecordError::Diverged { episode: episode.number, step: step_idx })
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::Contacts;
    use tandem_core::work::SlotOrder;
    use tandem_telemetry::read_episode;

    use super::*;
    use crate::fakes::{FakeActor, slot, terms};
    use crate::ports::{NoAdvisor, Simulator};
    use crate::rollout::play_slot;

    fn played(kind: EpisodeKind) -> (EpisodeMetadata, Episode) {
        let order = SlotOrder { kind, ..slot(&[3], false) };
        let terms = terms();
        let world =
            Env::new(crate::fakes::LAYOUT, &WorldConfig::from(terms.world)).expect("in range");
        let mut actor = FakeActor::Seeker;
        let mut world = Simulator::new(world);
        let episode = play_slot(&mut world, &order, &terms, &mut actor, &mut NoAdvisor)
            .expect("no step fails")
            .remove(0);
        let metadata = metadata_of(order.episodes[0], &episode, &terms, "5f3a".to_owned());
        (metadata, episode)
    }

    #[test]
    fn a_log_contains_the_episode_and_its_world() {
        for kind in [EpisodeKind::Evaluation, EpisodeKind::Training] {
            let (metadata, episode) = played(kind);
            let directory = tempfile::tempdir().expect("a directory");
            let path = directory.path().join(log_name(&episode));
            assert_eq!(record_episode(&metadata, &episode, &path).expect("recorded"), path);
            let log = read_episode(&path).expect("whole");
            assert_eq!(log.metadata, metadata);
            assert_eq!(
                (log.metadata.run.as_str(), log.metadata.policy_digest.as_str()),
                ("run-7", "5f3a")
            );
            let actions: Vec<f32> =
                log.transitions.iter().flat_map(|step| step.action.clone()).collect();
            assert_eq!(actions, episode.actions);
            assert_eq!(log.last_observation.as_deref(), Some(episode.last_observation()));
            let mut start = vec![0.0; episode.task.n_observation()];
            world_of(&log.metadata).expect("described").observe(&mut start);
            assert_eq!(start, episode.observation(0));
        }
    }

    #[test]
    fn an_episode_whose_replay_differs_gets_no_log() {
        let (metadata, mut episode) = played(EpisodeKind::Evaluation);
        let n_observation = episode.task.n_observation();
        episode.observations[7 * n_observation] += 1e-3;
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("eval.mcap");
        let error = record_episode(&metadata, &episode, &path).expect_err("differs");
        assert!(matches!(error, RecordError::Diverged { episode: 3, step: 7 }), "{error}");
        assert!(!path.exists());

        let (metadata, mut episode) = played(EpisodeKind::Evaluation);
        episode.contacts[9] =
            if episode.contacts[9].any() { Contacts::NONE } else { Contacts::ARM_ARM };
        let error = record_episode(&metadata, &episode, &path).expect_err("differs");
        assert!(matches!(error, RecordError::Diverged { episode: 3, step: 10 }), "{error}");
    }

    #[test]
    fn names_sort_by_version_and_number() {
        let (_, mut episode) = played(EpisodeKind::Evaluation);
        assert_eq!(log_name(&episode), "eval-000004-003.mcap");
        episode.kind = EpisodeKind::Training;
        assert_eq!(log_name(&episode), "train-000004-000003.mcap");
    }
}
