//! Which numbers of an observation, a goal and an action belong to which arm.

use std::fmt;
use std::ops::Range;
use std::str::FromStr;

/// Numbers that describe one arm and its object (section 4.1 of the paper: R28).
pub const OBSERVATION_PER_ARM: usize = 28;
/// Numbers of one arm's goal: where its object shall be, metres, in the arm's own frame.
pub const GOAL_PER_ARM: usize = 3;
/// Where the end effector's position stands within its arm's part of the observation.
pub const HAND_POSITION: Range<usize> = 0..3;
/// Where an object's position stands within its arm's part of the observation.
pub const OBJECT_POSITION: Range<usize> = 3..6;
/// Distance between the centres of two arms' workspaces, the origins of their own frames, metres. The second arm is
/// the first turned by half a turn, so each arm's x points at the other.
pub const WORKSPACES_APART_M: f32 = 0.24;
/// Control steps of an episode.
pub const EPISODE_STEPS: usize = 50;
/// Distance between object and goal, metres, within which the goal counts as achieved.
pub const GOAL_TOLERANCE_M: f32 = 0.05;

/// What the arms have to do (section 4.1 of the paper).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Task {
    /// Push an object over the table to its goal, gripper locked shut.
    Push,
    /// Grasp an object and bring it to its goal, on the table or in the air.
    PickAndPlace,
}

impl Task {
    /// Every task, in the order of the paper.
    pub const ALL: [Self; 2] = [Self::Push, Self::PickAndPlace];

    /// The name used on the command line and in files.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Push => "push",
            Self::PickAndPlace => "pick-and-place",
        }
    }

    /// Numbers of one arm's action: end-effector displacement (3) and, when the gripper is used, its input (1).
    #[must_use]
    pub const fn action_per_arm(self) -> usize {
        match self {
            Self::Push => 3,
            Self::PickAndPlace => 4,
        }
    }
}

impl fmt::Display for Task {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A name that is no task's.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("unknown task {0:?}: expected push or pick-and-place")]
pub struct UnknownTask(pub String);

impl FromStr for Task {
    type Err = UnknownTask;

    fn from_str(name: &str) -> Result<Self, UnknownTask> {
        Self::ALL
            .into_iter()
            .find(|task| task.name() == name)
            .ok_or_else(|| UnknownTask(name.to_owned()))
    }
}

/// One of a layout's arms, counted from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ArmIndex(pub usize);

/// A task and the number of arms that do it: fixes the length of every vector.
///
/// Vectors of several arms are the arms' own vectors one after another, in arm order (the paper's `d_1 || d_2`).
/// Each arm's numbers are in its own frame, so a part can be handed to a policy for one arm as it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Layout {
    /// What the arms do.
    pub task: Task,
    /// How many arms do it, 1 or more.
    pub n_arms: usize,
}

impl Layout {
    /// A layout of `n_arms` arms doing `task`.
    #[must_use]
    pub const fn new(task: Task, n_arms: usize) -> Self {
        Self { task, n_arms }
    }

    /// The layout of one of the arms alone: the teacher's.
    #[must_use]
    pub const fn single_arm(self) -> Self {
        Self { task: self.task, n_arms: 1 }
    }

    /// Length of an observation.
    #[must_use]
    pub const fn n_observation(self) -> usize {
        OBSERVATION_PER_ARM * self.n_arms
    }

    /// Length of a goal, achieved or desired.
    #[must_use]
    pub const fn n_goal(self) -> usize {
        GOAL_PER_ARM * self.n_arms
    }

    /// Length of an action.
    #[must_use]
    pub const fn n_action(self) -> usize {
        self.task.action_per_arm() * self.n_arms
    }

    /// The arms, in order.
    pub fn arms(self) -> impl ExactSizeIterator<Item = ArmIndex> {
        (0..self.n_arms).map(ArmIndex)
    }

    /// Where `arm`'s numbers stand in an observation: the paper's state map `f_i^s` (equation 7).
    #[must_use]
    pub const fn observation_of(self, arm: ArmIndex) -> Range<usize> {
        arm.0 * OBSERVATION_PER_ARM..(arm.0 + 1) * OBSERVATION_PER_ARM
    }

    /// Where `arm`'s numbers stand in a goal.
    #[must_use]
    pub const fn goal_of(self, arm: ArmIndex) -> Range<usize> {
        arm.0 * GOAL_PER_ARM..(arm.0 + 1) * GOAL_PER_ARM
    }

    /// Where `arm`'s numbers stand in an action: the paper's maps `f^a` and `h_i^a` (equations 8 and 9).
    #[must_use]
    pub const fn action_of(self, arm: ArmIndex) -> Range<usize> {
        arm.0 * self.task.action_per_arm()..(arm.0 + 1) * self.task.action_per_arm()
    }

    /// Where `arm`'s object position, its achieved goal, stands in an observation.
    #[must_use]
    pub const fn achieved_goal_of(self, arm: ArmIndex) -> Range<usize> {
        arm.0 * OBSERVATION_PER_ARM + OBJECT_POSITION.start
            ..arm.0 * OBSERVATION_PER_ARM + OBJECT_POSITION.end
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_four_environments_have_the_papers_sizes() {
        let check = |task, n_arms, sizes| {
            let layout = Layout::new(task, n_arms);
            assert_eq!((layout.n_observation(), layout.n_goal(), layout.n_action()), sizes);
        };
        check(Task::Push, 1, (28, 3, 3));
        check(Task::Push, 2, (56, 6, 6));
        check(Task::PickAndPlace, 1, (28, 3, 4));
        check(Task::PickAndPlace, 2, (56, 6, 8));
    }

    #[test]
    fn the_arms_parts_cover_every_vector_once() {
        let layout = Layout::new(Task::PickAndPlace, 3);
        let covered = |part: &dyn Fn(ArmIndex) -> Range<usize>| {
            layout.arms().flat_map(part).collect::<Vec<_>>()
        };
        assert_eq!(covered(&|arm| layout.observation_of(arm)), (0..84).collect::<Vec<_>>());
        assert_eq!(covered(&|arm| layout.goal_of(arm)), (0..9).collect::<Vec<_>>());
        assert_eq!(covered(&|arm| layout.action_of(arm)), (0..12).collect::<Vec<_>>());
        assert_eq!(layout.achieved_goal_of(ArmIndex(2)), 59..62);
    }

    #[test]
    fn a_task_is_read_back_from_its_name() {
        for task in Task::ALL {
            assert_eq!(task.name().parse(), Ok(task));
        }
        assert!("pick".parse::<Task>().is_err());
    }
}
