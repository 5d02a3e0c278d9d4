//! Positions of the arms, objects and goals in the latest evaluation's first episodes, for playback.

use serde::Serialize;
use tandem_core::layout::{HAND_POSITION, OBJECT_POSITION, World};
use tandem_core::task::Norm;
use tandem_core::{ArmIndex, Episode, Layout, TaskSpec, layout};

/// Indices of the openings of the fingers within an arm's part of an observation, metres.
const FINGER_OPENINGS: std::ops::Range<usize> = 9..12;
/// Duration of a control step of a task that does not state it, seconds.
const STEP_S: f32 = 0.04;

/// A point in the world frame of two arms, metres.
type Point = [f32; 3];

/// The episodes that a page can play.
#[derive(Debug, Serialize)]
pub(crate) struct Playback {
    /// Round of the evaluated policy.
    round: u64,
    /// Simulated duration of a control step, seconds.
    step_s: f32,
    /// Distance of an object from its goal up to which the goal counts as achieved, metres.
    tolerance_m: f32,
    /// True if that distance is the maximum norm.
    is_cube: bool,
    /// Base of each arm; empty if the task does not have the arms of the simulator.
    bases: Vec<Point>,
    episodes: Vec<PlayedEpisode>,
}

#[derive(Debug, Serialize)]
struct PlayedEpisode {
    number: u64,
    success: bool,
    /// Goal of each part.
    goals: Vec<Point>,
    /// The parts before each step and after the last one: shape `[n_steps + 1, n_parts]`.
    steps: Vec<Vec<PartState>>,
    /// Steps with a contact between the arms.
    contacts: Vec<usize>,
}

/// An arm and its object, or the numbers that are common to all arms.
#[derive(Debug, Serialize)]
struct PartState {
    #[serde(skip_serializing_if = "Option::is_none")]
    hand: Option<Point>,
    /// Mean opening of the fingers, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    opening: Option<f32>,
    object: Point,
    at_goal: bool,
}

impl Playback {
    /// Returns the episodes; `None` if there are none, or their goals are no points.
    pub(crate) fn of(episodes: &[Episode]) -> Option<Self> {
        let first = episodes.first()?;
        let task = &first.task;
        let parts = parts(task);
        if parts.is_empty() {
            return None;
        }
        let built_in = task.as_built_in();
        let world = built_in.map(|layout| layout.task.world());
        Some(Self {
            round: first.parameter_version,
            step_s: world.map_or(STEP_S, World::control_step_s),
            tolerance_m: task.tolerance(),
            is_cube: task.norm() == Norm::Maximum,
            bases: built_in.map_or_else(Vec::new, bases),
            episodes: episodes.iter().map(|episode| played(episode, &parts)).collect(),
        })
    }
}

/// A part of the goal that is a point.
#[derive(Debug, Clone, Copy)]
enum GoalPart {
    Arm(ArmIndex),
    Common,
}

fn parts(task: &TaskSpec) -> Vec<GoalPart> {
    let mut parts: Vec<GoalPart> = task.arms().map(GoalPart::Arm).collect();
    parts.push(GoalPart::Common);
    parts.retain(|part| {
        let numbers = match part {
            GoalPart::Arm(arm) => task.goal_of(*arm),
            GoalPart::Common => task.common_goal(),
        };
        matches!(numbers.len(), 2 | 3)
    });
    parts
}

/// Returns the bases of the simulator's arms, which stand behind the origins of their frames.
fn bases(layout: Layout) -> Vec<Point> {
    let behind = -layout.task.world().mico_base_distance_m();
    layout.arms().map(|arm| in_world(Some(layout), arm, [behind, 0.0, 0.0])).collect()
}

fn played(episode: &Episode, parts: &[GoalPart]) -> PlayedEpisode {
    let task = &episode.task;
    let state = |step_idx: usize| {
        let observation = episode.observation(step_idx);
        parts.iter().map(|part| part_state(task, *part, observation, &episode.goal)).collect()
    };
    let touches = |(step_idx, contacts): (usize, &tandem_core::Contacts)| {
        contacts.contains(tandem_core::Contacts::ARM_ARM).then_some(step_idx)
    };
    PlayedEpisode {
        number: episode.number,
        success: episode.succeeded(),
        goals: parts.iter().map(|part| goal(task, *part, &episode.goal)).collect(),
        steps: (0..=episode.n_steps()).map(state).collect(),
        contacts: episode.contacts.iter().enumerate().filter_map(touches).collect(),
    }
}

fn goal(task: &TaskSpec, part: GoalPart, goal: &[f32]) -> Point {
    match part {
        GoalPart::Arm(arm) => in_world(task.as_built_in(), arm, point(&task.goal_of(arm).of(goal))),
        GoalPart::Common => rounded(point(&task.common_goal().of(goal))),
    }
}

fn part_state(task: &TaskSpec, part: GoalPart, observation: &[f32], goal: &[f32]) -> PartState {
    let GoalPart::Arm(arm) = part else {
        let object = rounded(point(&task.common_achieved_goal().of(observation)));
        let at_goal = task.is_success(observation, goal);
        return PartState { hand: None, opening: None, object, at_goal };
    };
    let built_in = task.as_built_in();
    let at_goal = task.arm_succeeds(arm, observation, goal);
    let Some(layout) = built_in else {
        let object = rounded(point(&task.achieved_goal_of(arm).of(observation)));
        return PartState { hand: None, opening: None, object, at_goal };
    };
    let own = &observation[layout.observation_of(arm)];
    let fingers = &own[FINGER_OPENINGS];
    PartState {
        hand: Some(in_world(built_in, arm, point(&own[HAND_POSITION]))),
        opening: Some(round(fingers.iter().sum::<f32>() / fingers.len() as f32)),
        object: in_world(built_in, arm, point(&own[OBJECT_POSITION])),
        at_goal,
    }
}

/// Converts a point from an arm's frame to the world of two arms, whose origin is between them.
fn in_world(layout: Option<Layout>, arm: ArmIndex, [x, y, z]: Point) -> Point {
    let half = 0.5 * layout::WORKSPACE_DISTANCE_M;
    rounded(match (layout, arm) {
        (Some(Layout { n_arms: 2.., .. }), ArmIndex(0)) => [x - half, y, z],
        (Some(Layout { n_arms: 2.., .. }), _) => [half - x, -y, z],
        _ => [x, y, z],
    })
}

/// Returns a point with its missing coordinate 0.
fn point(numbers: &[f32]) -> Point {
    std::array::from_fn(|axis| numbers.get(axis).copied().unwrap_or(0.0))
}

/// Rounds to tenths of a millimetre, which is less than a pixel.
fn rounded(point: Point) -> Point {
    point.map(round)
}

fn round(length_m: f32) -> f32 {
    (length_m * 1e4).round() / 1e4
}

#[cfg(test)]
mod tests {
    use tandem_core::Task;

    use super::*;

    #[test]
    fn both_arms_appear_in_the_world_where_the_simulator_has_them() {
        let layout = Layout::new(Task::Push, 2);
        let mut episode = Episode::zeros(layout, 7);
        episode.goal.copy_from_slice(&[0.05, 0.02, 0.0, 0.05, 0.02, 0.0]);
        episode.observations[..3].copy_from_slice(&[0.1, -0.03, 0.2]);
        episode.observations[28..31].copy_from_slice(&[0.1, -0.03, 0.2]);
        episode.observations[9..12].copy_from_slice(&[0.01, 0.02, 0.03]);
        let playback = Playback::of(&[episode]).expect("points");
        let played = &playback.episodes[0];
        assert_eq!((played.number, played.steps.len()), (7, layout::EPISODE_STEPS + 1));
        assert_eq!(played.goals, [[-0.07, 0.02, 0.0], [0.07, -0.02, 0.0]]);
        let [first, second] = &played.steps[0][..] else { panic!("two arms") };
        assert_eq!(first.hand, Some([-0.02, -0.03, 0.2]));
        assert_eq!(second.hand, Some([0.02, 0.03, 0.2]));
        assert_eq!(first.opening, Some(0.02));
        assert!(first.at_goal == (0.05f32.hypot(0.02) < playback.tolerance_m));
        assert_eq!(playback.bases, [[-0.39, 0.0, 0.0], [0.39, 0.0, 0.0]]);
    }

    #[test]
    fn there_is_nothing_to_play_before_the_first_evaluation() {
        assert!(Playback::of(&[]).is_none());
    }
}
