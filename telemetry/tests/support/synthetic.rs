//! A synthetic episode of two arms that push: smooth motion and plausible bodies without physics.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use tandem_core::scene::{ArmScene, Capsule, Cuboid, Point, Scene};
use tandem_core::task::{ArmDescription, Norm, TaskDescription};
use tandem_core::{ArmAdvice, Contacts, EpisodeKind, Layout, Task, TaskSpec};
use tandem_telemetry::{
    EpisodeMetadata, EpisodeRecorder, Error, LoggedTransition, TransitionRecord,
};

pub(crate) const LAYOUT: Layout = Layout::new(Task::Push, 2);
pub(crate) const N_STEPS: u32 = 50;
const UPRIGHT: [f32; 4] = [0.0, 0.0, 0.0, 1.0];

pub(crate) fn metadata() -> EpisodeMetadata {
    EpisodeMetadata {
        run: "synthetic".to_owned(),
        episode: 7,
        seed: u64::MAX,
        kind: EpisodeKind::Evaluation,
        parameter_version: 3,
        task: LAYOUT.into(),
        policy_digest: "5f3a".to_owned(),
        world: BTreeMap::from([("substeps".to_owned(), "20".to_owned())]),
    }
}

/// Returns the scene at `progress` of the episode, 0 to 1.
pub(crate) fn scene(progress: f32) -> Scene {
    let arm_at = |side: f32| {
        let hand =
            [0.10 * side - 0.16 * side * progress, 0.18 * side - 0.26 * side * progress, 0.05];
        (
            arm([0.52 * side, 0.0, 0.0], hand),
            cube([hand[0] - 0.05 * side, hand[1] - 0.04 * side, 0.0225], 0.0225),
        )
    };
    let ((left, left_object), (right, right_object)) = (arm_at(-1.0), arm_at(1.0));
    Scene {
        time_s: f64::from(progress) * 2.0,
        arms: vec![left, right],
        objects: vec![left_object, right_object],
        goals: vec![[0.11, 0.12, 0.0225], [-0.11, -0.12, 0.0225]],
        goal_tolerance_m: 0.05,
        table: Cuboid {
            centre: [0.0, 0.0, -0.02],
            orientation: UPRIGHT,
            half_extents_m: [0.70, 0.45, 0.02],
        },
    }
}

/// Returns the steps of the episode. All numbers differ, so that a test detects swapped ones.
pub(crate) fn transitions() -> Vec<LoggedTransition> {
    transitions_of(&LAYOUT.into())
}

/// Returns a task of two arms that is not built-in, with so many numbers of the goal per arm, which are the first ones
/// of its part of the observation.
pub(crate) fn described(n_goal_per_arm: usize) -> TaskSpec {
    const N_OBSERVATION: usize = 5;
    let part = |n: usize, arm_idx: usize| (arm_idx * n..(arm_idx + 1) * n).collect::<Vec<_>>();
    let arm = |arm_idx| ArmDescription {
        observation: part(N_OBSERVATION, arm_idx),
        goal: part(n_goal_per_arm, arm_idx),
        action: part(2, arm_idx),
        position: Vec::new(),
        lateral: Vec::new(),
        hand: Vec::new(),
    };
    let achieved = |arm_idx| (0..n_goal_per_arm).map(move |idx| arm_idx * N_OBSERVATION + idx);
    TaskSpec::new(TaskDescription {
        base: 0.0,
        contact_distances: Vec::new(),
        name: "lab/reach".to_owned(),
        n_observation: 2 * N_OBSERVATION,
        n_goal: 2 * n_goal_per_arm,
        n_action: 4,
        achieved_goal: (0..2).flat_map(achieved).collect(),
        episode_steps: 12,
        tolerance: 0.2,
        norm: Norm::Euclidean,
        interchangeable_arms: true,
        reports_contacts: false,
        origin_distance: 0.0,
        recombination_gap: 0.0,
        observation_bound: vec![1.0; 2 * N_OBSERVATION],
        goal_bound: vec![1.0; 2 * n_goal_per_arm],
        arms: vec![arm(0), arm(1)],
        manipulation: tandem_core::task::Manipulation::default(),
        reflection: tandem_core::task::Reflection::default(),
    })
    .expect("a valid task")
}

/// Returns the steps of an episode of a task with two arms.
pub(crate) fn transitions_of(task: &TaskSpec) -> Vec<LoggedTransition> {
    let numbers = |step: u32, offset: f32, n: usize| -> Vec<f32> {
        (0_u8..)
            .take(n)
            .map(|i| (offset + f32::from(i) * 0.173 + step as f32 * 0.031).sin())
            .collect()
    };
    (0_u32..)
        .take(task.episode_steps())
        .map(|step| LoggedTransition {
            observation: numbers(step, 0.0, task.n_observation()),
            goal: numbers(0, 1.0, task.n_goal()),
            action: numbers(step, 2.0, task.n_action()),
            reward: if step < 40 { -1.0 } else { 0.0 },
            rewards_per_arm: vec![-1.0, 0.0],
            advised_arms: u8::from(step.is_multiple_of(3)) * 2,
            contacts: if step == 20 {
                Contacts::ARM_ARM | Contacts::ARM_TABLE
            } else {
                Contacts::NONE
            },
            advice: if step.is_multiple_of(2) {
                vec![advice(step, false), advice(step, true)]
            } else {
                Vec::new()
            },
            budget_left: step.is_multiple_of(2).then(|| 1000 - u64::from(step)),
        })
        .collect()
}

pub(crate) fn last_observation() -> Vec<f32> {
    vec![0.25; LAYOUT.n_observation()]
}

/// Returns a recorder with the whole episode and a log line.
pub(crate) fn recorded(path: &Path) -> Result<EpisodeRecorder, Error> {
    let mut recorder = EpisodeRecorder::create(path, &metadata())?;
    for (step, transition) in (0..).zip(transitions()) {
        recorder.record_step(&scene(step as f32 / N_STEPS as f32), &record(step, &transition))?;
    }
    recorder.log("a synthetic episode")?;
    recorder.record_outcome(&scene(1.0), &last_observation())?;
    Ok(recorder)
}

pub(crate) fn write_log(path: &Path) -> Result<PathBuf, Error> {
    recorded(path)?.finish()
}

/// Writes an episode of a task that is not built-in.
pub(crate) fn write_described_log(path: &Path, task: &TaskSpec) -> Result<PathBuf, Error> {
    let metadata = EpisodeMetadata { task: task.clone(), ..metadata() };
    let mut recorder = EpisodeRecorder::create(path, &metadata)?;
    for (step, transition) in (0..).zip(&transitions_of(task)) {
        recorder.record_step(None, &record(step, transition))?;
    }
    recorder.record_outcome(None, &vec![0.5; task.n_observation()])?;
    recorder.finish()
}

pub(crate) fn record(step: u32, transition: &LoggedTransition) -> TransitionRecord<'_> {
    TransitionRecord {
        step,
        observation: &transition.observation,
        goal: &transition.goal,
        action: &transition.action,
        reward: transition.reward,
        rewards_per_arm: &transition.rewards_per_arm,
        advised_arms: transition.advised_arms,
        contacts: transition.contacts,
        advice: &transition.advice,
        budget_left: transition.budget_left,
    }
}

fn advice(step: u32, overridden: bool) -> ArmAdvice {
    let q_teacher = -2.0 - step as f32;
    ArmAdvice {
        teacher_action: vec![0.1, -0.2, 0.3],
        q_teacher,
        q_student: q_teacher - 0.5,
        importance: 0.5,
        distance: 0.75,
        overridden,
    }
}

/// Returns an arm with its hand at `hand`, pointing down. Shoulder and elbow are in the vertical plane of base and
/// hand.
fn arm(base: Point, hand: Point) -> ArmScene {
    let (upper_m, lower_m) = (0.41_f32, 0.38_f32);
    let shoulder = [base[0], base[1], base[2] + 0.27];
    let wrist = [hand[0], hand[1], hand[2] + 0.20];
    let (dx, dy) = (wrist[0] - shoulder[0], wrist[1] - shoulder[1]);
    let reach = dx.hypot(dy);
    let rise = wrist[2] - shoulder[2];
    let straight = reach.hypot(rise).min(upper_m + lower_m - 1e-3);
    let bend = ((upper_m * upper_m + straight * straight - lower_m * lower_m)
        / (2.0 * upper_m * straight))
        .acos();
    let pitch = rise.atan2(reach) + bend;
    let elbow = [
        shoulder[0] + dx / reach * upper_m * pitch.cos(),
        shoulder[1] + dy / reach * upper_m * pitch.cos(),
        shoulder[2] + upper_m * pitch.sin(),
    ];
    let palm = [hand[0], hand[1], hand[2] + 0.06];
    let bar = |from, to, radius_m| Capsule { from, to, radius_m };
    let pad = |offset_m: f32| Cuboid {
        centre: [hand[0] + offset_m, hand[1], hand[2] + 0.01],
        orientation: UPRIGHT,
        half_extents_m: [0.006, 0.014, 0.03],
    };
    let plate = Cuboid { centre: palm, orientation: UPRIGHT, half_extents_m: [0.04, 0.03, 0.015] };
    ArmScene {
        base,
        joint_angles_rad: [0.1, 0.2, 0.3, 0.4, 0.5, 0.6],
        joint_points: vec![base, shoulder, elbow, wrist, hand],
        links: vec![
            bar(base, shoulder, 0.045),
            bar(shoulder, elbow, 0.04),
            bar(elbow, wrist, 0.035),
            bar(wrist, palm, 0.032),
        ],
        hand: vec![plate, pad(-0.012), pad(0.012)],
        end_effector: hand,
    }
}

fn cube(centre: Point, half_m: f32) -> Cuboid {
    Cuboid { centre, orientation: UPRIGHT, half_extents_m: [half_m; 3] }
}
