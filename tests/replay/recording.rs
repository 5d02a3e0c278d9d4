//! Recorded episodes of every kind, and the program that plays them again.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;
use tandem_core::work::{EpisodeExploration, EpisodeOrder, RunTerms, SlotOrder};
use tandem_core::{
    AdviceTerms, ArmAdvice, EpisodeKind, Exploration, Layout, StepAdvice, StepQuery, Task, World,
    WorldSettings,
};
use tandem_policy::{Actor, Policy};
use tandem_sim::{Env, WorldConfig};
use tandem_worker::ports::{AdvisorGone, Simulator};
use tandem_worker::record::{log_name, metadata_of, record_episode};
use tandem_worker::rollout::play_slot;
use tandem_worker::{Advisor, ComposedTeachers};

/// Number of episodes per slot.
pub(crate) const N_TOGETHER: u64 = 2;

/// The purpose, start and exploration of an episode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Kind {
    Evaluation,
    Explored,
    Uniform,
    Advised,
    SpecialStart,
}

pub(crate) const KINDS: [Kind; 5] =
    [Kind::Evaluation, Kind::Explored, Kind::Uniform, Kind::Advised, Kind::SpecialStart];

/// Returns the shipped teacher of `task` in the classic world, whose vectors have the same lengths in both worlds.
pub(crate) fn teacher(task: Task) -> Actor {
    let classic =
        task.of_one_arm().in_world(World::Classic).expect("every teacher has a classic task");
    let name = format!("policies/teacher-{classic}-classic.safetensors");
    let policy = Policy::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join(name)).expect("ships");
    policy.actor().expect("usable")
}

/// A teacher that takes over one or both arms on two of three steps.
pub(crate) struct EagerTeacher(Actor, Layout);

impl EagerTeacher {
    pub(crate) fn verdict(&mut self, query: &StepQuery) -> StepAdvice {
        let mut action = query.proposed_action.clone();
        let mut arms = Vec::new();
        for arm in self.1.arms() {
            let mut teacher_action = vec![0.0; self.1.single_arm().n_action()];
            let observation = &query.observation[self.1.observation_of(arm)];
            self.0.act(observation, &query.goal[self.1.goal_of(arm)], &mut teacher_action);
            let overridden = !(query.step as usize + arm.0).is_multiple_of(3);
            if overridden {
                action[self.1.action_of(arm)].copy_from_slice(&teacher_action);
            }
            arms.push(ArmAdvice {
                teacher_action,
                q_teacher: -1.0,
                q_student: -2.0,
                importance: 1.0,
                distance: 0.5,
                overridden,
            });
        }
        StepAdvice { action, charged: arms.iter().any(|arm| arm.overridden), arms, repeated: false }
    }
}

impl Advisor for EagerTeacher {
    fn advise(&mut self, queries: Vec<StepQuery>) -> Result<Vec<StepAdvice>, AdvisorGone> {
        Ok(queries.iter().map(|query| self.verdict(query)).collect())
    }
}

pub(crate) fn terms(layout: Layout, kind: Kind, substeps: u32) -> RunTerms {
    let prob = if kind == Kind::SpecialStart { 1.0 } else { 0.3 };
    RunTerms {
        symmetrized_evaluation: false,
        run: "replay".to_owned(),
        task: layout.into(),
        account: Some("replay".to_owned()),
        advice: AdviceTerms::default(),
        exploration: Exploration {
            noise_std: 0.2,
            random_action_prob: 0.3,
            sticky_random_mean_steps: 4.0,
            joint_random_actions: false,
        },
        world: WorldSettings {
            grasped_start_prob: prob,
            substeps,
            randomization: prob,
            ..WorldSettings::default()
        },
    }
}

pub(crate) fn slot(kind: Kind) -> SlotOrder {
    let first = N_TOGETHER * KINDS.iter().position(|other| *other == kind).expect("listed") as u64;
    let order = |number| EpisodeOrder {
        number,
        seed: 31,
        advised: kind == Kind::Advised,
        exploration: match kind {
            Kind::Uniform => EpisodeExploration::Uniform,
            _ => EpisodeExploration::Noise,
        },
        record: true,
        advised_steps: None,
    };
    let played_for =
        if kind == Kind::Evaluation { EpisodeKind::Evaluation } else { EpisodeKind::Training };
    SlotOrder {
        slot: 0,
        parameter_version: 3,
        kind: played_for,
        episodes: (first..first + N_TOGETHER).map(order).collect(),
    }
}

/// Plays a slot of a kind, records it as a worker does and returns the log paths.
pub(crate) fn record(layout: Layout, kind: Kind, substeps: u32, directory: &Path) -> Vec<PathBuf> {
    let (terms, slot) = (terms(layout, kind, substeps), slot(kind));
    let world = Env::new(layout, &WorldConfig { substeps, ..WorldConfig::default() });
    let mut actor = ComposedTeachers::new(teacher(layout.task), layout);
    let mut advisor = EagerTeacher(teacher(layout.task), layout);
    let mut world = Simulator::new(world.expect("in range"));
    let episodes = play_slot(&mut world, &slot, &terms, &mut actor, &mut advisor).expect("plays");
    let write = |(order, episode)| {
        let path = directory.join(log_name(episode));
        let metadata = metadata_of(order, episode, &terms, String::new());
        record_episode(&metadata, episode, &path).expect("recorded")
    };
    slot.episodes.iter().copied().zip(&episodes).map(write).collect()
}

/// Records one two-arm pick-and-place episode.
pub(crate) fn one_log(directory: &Path) -> PathBuf {
    record(Layout::new(Task::PickAndPlace, 2), Kind::Advised, 10, directory).remove(0)
}

pub(crate) fn tandem(args: &[&str], paths: &[&Path]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(args).args(paths).output().expect("runs")
}

pub(crate) fn stdout(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Returns the only line on standard error.
pub(crate) fn error_line(output: &Output) -> String {
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(errors.lines().count(), 1, "{errors}");
    assert!(errors.starts_with("tandem: "), "{errors}");
    errors
}

pub(crate) fn summary(output: &Output) -> Value {
    serde_json::from_str(stdout(output).lines().last().expect("a line")).expect("JSON")
}
