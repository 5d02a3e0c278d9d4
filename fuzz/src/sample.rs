//! A minimal run and its files.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use tandem_core::layout::EPISODE_STEPS;
use tandem_core::scene::{ArmScene, Cuboid, Scene};
use tandem_core::{ArmAdvice, Contacts, Episode, EpisodeKind, Layout, Task};
use tandem_rl::RunConfig;
use tandem_rl::config::Recipe;
use tandem_rl::trainer::Trainer;
use tandem_telemetry::{EpisodeMetadata, EpisodeRecorder, Error, TransitionRecord};

/// Returns a run with one pushing arm, networks of two units and a replay buffer of four episodes.
pub fn run_config() -> RunConfig {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 1);
    config.ddpg.n_hidden = 2;
    config.ddpg.n_hidden_layers = 1;
    config.ddpg.batch_size = 4;
    config.rounds.slots = 1;
    config.rounds.rollouts = 1;
    config.rounds.updates_per_env_step = 0.02;
    config.replay.capacity_transitions = 4 * EPISODE_STEPS;
    config
}

/// Returns a trainer of [`run_config`] that has learned `n_rounds` rounds of made-up episodes.
pub fn trainer(n_rounds: u64) -> Trainer {
    let mut trainer = Trainer::new(run_config()).expect("the configuration is valid");
    for number in 0..n_rounds {
        trainer.ingest(&[episode(number)]);
        trainer.learn(|_| ()).expect("the numbers are finite");
    }
    trainer
}

/// The task of [`run_config`] and its number of arms.
const LAYOUT: Layout = Layout::new(Task::Push, 1);

/// Returns a made-up episode of [`run_config`]'s task.
pub fn episode(number: u64) -> Episode {
    let layout = LAYOUT;
    Episode {
        number,
        kind: EpisodeKind::Training,
        parameter_version: 0,
        task: layout.into(),
        observations: vec![0.25; (EPISODE_STEPS + 1) * layout.n_observation()],
        goal: vec![0.5; layout.n_goal()],
        actions: vec![-0.5; EPISODE_STEPS * layout.n_action()],
        advised_arms: vec![1; EPISODE_STEPS],
        contacts: vec![Contacts::ARM_TABLE; EPISODE_STEPS],
        advice_charged: 3,
        avoidance_steps: Some(2),
        queried_steps: Some(4),
    }
}

/// Records the first two steps of a made-up episode in the log `path`.
///
/// # Errors
/// If the log cannot be written.
pub fn record_episode(path: &Path) -> Result<PathBuf, Error> {
    let episode = episode(7);
    let layout = LAYOUT;
    let mut recorder = EpisodeRecorder::create(path, &metadata(layout))?;
    let mut scene = scene();
    for step_idx in 0..2 {
        let advice = ArmAdvice {
            teacher_action: vec![0.5; layout.n_action()],
            q_teacher: -1.5,
            q_student: -2.0,
            importance: 0.5,
            distance: 0.75,
            overridden: true,
        };
        let step = TransitionRecord {
            step: u32::try_from(step_idx).expect("a small number"),
            observation: episode.observation(step_idx),
            goal: &episode.goal,
            action: episode.action(step_idx),
            reward: -1.0,
            rewards_per_arm: &[-1.0],
            advised_arms: 1,
            contacts: Contacts::ARM_TABLE,
            advice: &[advice],
            budget_left: Some(7),
        };
        recorder.record_step(&scene, &step)?;
        scene.time_s += 0.04;
    }
    recorder.record_outcome(&scene, episode.observation(2))?;
    recorder.finish()
}

fn metadata(layout: Layout) -> EpisodeMetadata {
    EpisodeMetadata {
        run: "sample".to_owned(),
        episode: 7,
        seed: 1,
        kind: EpisodeKind::Evaluation,
        parameter_version: 3,
        task: layout.into(),
        policy_digest: "5f3a".to_owned(),
        world: BTreeMap::from([("substeps".to_owned(), "20".to_owned())]),
    }
}

fn scene() -> Scene {
    let cube = Cuboid {
        centre: [0.1, 0.2, 0.02],
        orientation: [0.0, 0.0, 0.0, 1.0],
        half_extents_m: [0.02; 3],
    };
    let arm = ArmScene {
        base: [0.0; 3],
        joint_angles_rad: [0.0; 6],
        joint_points: vec![[0.0; 3]],
        links: Vec::new(),
        hand: Vec::new(),
        end_effector: [0.0; 3],
    };
    Scene {
        time_s: 0.0,
        arms: vec![arm],
        objects: vec![cube],
        goals: vec![[0.1; 3]],
        goal_tolerance_m: 0.05,
        table: cube,
    }
}
