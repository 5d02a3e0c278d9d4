//! The built-in tasks, which the simulator implements, and the layout of their observations, goals and actions.
//!
//! The learner, the teacher and the workers take these numbers from a [`TaskSpec`](crate::TaskSpec).

use std::fmt;
use std::ops::Range;
use std::str::FromStr;

pub mod observation;

pub use observation::{HAND_POSITION, OBJECT_POSITION};

/// Length of one arm's part of an observation (section 4.1 and Table 1 of the paper); [`observation`] has its
/// quantities.
pub const OBSERVATION_PER_ARM: usize = 28;
/// Length of one arm's part of a goal: the desired position (x, y, z) of its object, arm frame, metres.
pub const GOAL_PER_ARM: usize = 3;
/// Distance between the origins of the frames of two arms, metres. In the classic world these are the centres of their
/// workspaces.
///
/// The second arm is the first one rotated by 180° about z, so each arm's x axis points at the other arm.
pub const WORKSPACE_DISTANCE_M: f32 = 0.24;
/// Control steps per episode of the built-in tasks. The paper gives no number; the Fetch environments (Plappert et al.
/// 2018), on which it builds, have 50.
pub const EPISODE_STEPS: usize = 50;
/// Distance between object and goal up to which the goal counts as achieved, metres: the paper's `ε`, for which it
/// gives no value. This is that of the Fetch environments (Plappert et al. 2018), on which it builds.
pub const GOAL_TOLERANCE_M: f32 = 0.05;

/// A built-in manipulation task in one of three worlds. Push and pick and place are those of the paper (section 4.1).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Task {
    /// Push an object across the table to its goal with a closed gripper, in the classic world.
    Push,
    /// Grasp an object and move it to its goal, on the table or in the air, in the classic world.
    PickAndPlace,
    /// [`Task::Push`] in the shared world.
    SharedPush,
    /// [`Task::PickAndPlace`] in the shared world.
    SharedPickAndPlace,
    /// Grasp a bar at both ends and carry it, level, to its goal above the table, in the slow world. The object of each
    /// arm is its own handle.
    CarryBar,
}

/// The world of a built-in task: speed of the arms, and areas of objects and goals.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum World {
    /// Fast hands; objects and goals of two arms lie in adjacent areas.
    Classic,
    /// Hands as slow as the paper's arms, 0.2 m/s, and one area for the objects and goals of both arms.
    Shared,
    /// The hands and workspaces of the classic world, as slow as those of the shared one, with palms that give way.
    Slow,
}

impl World {
    /// All worlds.
    pub const ALL: [Self; 3] = [Self::Classic, Self::Shared, Self::Slow];
    /// The world of tasks whose world is not named.
    pub const DEFAULT: Self = Self::Shared;

    /// Returns the name used on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Classic => "classic",
            Self::Shared => "shared",
            Self::Slow => "slow",
        }
    }

    /// Returns the duration of a control step in simulated time, seconds.
    #[must_use]
    pub const fn control_step_s(self) -> f32 {
        match self {
            Self::Classic => 0.04,
            Self::Shared | Self::Slow => 0.25,
        }
    }

    /// Returns the number of physics steps per control step, as a multiple of the setting `world.substeps`.
    #[must_use]
    pub const fn substeps_factor(self) -> u32 {
        match self {
            Self::Classic => 1,
            Self::Shared | Self::Slow => 4,
        }
    }

    /// Returns the distance of a Mico's base behind the origin of its arm's frame, metres, in a work cell that performs
    /// the tasks of this world.
    #[must_use]
    pub const fn mico_base_distance_m(self) -> f32 {
        match self {
            Self::Classic | Self::Slow => 0.27,
            Self::Shared => 0.22,
        }
    }
}

impl fmt::Display for World {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl Task {
    /// All tasks: first those of the paper, in its order.
    pub const ALL: [Self; 5] = [
        Self::Push,
        Self::PickAndPlace,
        Self::SharedPush,
        Self::SharedPickAndPlace,
        Self::CarryBar,
    ];
    /// The tasks in the classic world, in the order of the paper.
    pub const CLASSIC: [Self; 2] = [Self::Push, Self::PickAndPlace];
    /// The tasks in the shared world, in the order of the paper.
    pub const SHARED: [Self; 2] = [Self::SharedPush, Self::SharedPickAndPlace];
    /// The task of a run that names none.
    pub const DEFAULT: Self = Self::SharedPush;

    /// Returns the name used in files and messages.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Push => "push",
            Self::PickAndPlace => "pick-and-place",
            Self::SharedPush => "shared-push",
            Self::SharedPickAndPlace => "shared-pick-and-place",
            Self::CarryBar => "carry-bar",
        }
    }

    /// Returns the world in which the task is performed.
    #[must_use]
    pub const fn world(self) -> World {
        match self {
            Self::Push | Self::PickAndPlace => World::Classic,
            Self::SharedPush | Self::SharedPickAndPlace => World::Shared,
            Self::CarryBar => World::Slow,
        }
    }

    /// Returns the same task in `world`, or `None` if it does not exist there.
    #[must_use]
    pub const fn in_world(self, world: World) -> Option<Self> {
        match (self, world) {
            (Self::Push | Self::SharedPush, World::Classic) => Some(Self::Push),
            (Self::PickAndPlace | Self::SharedPickAndPlace, World::Classic) => {
                Some(Self::PickAndPlace)
            }
            (Self::Push | Self::SharedPush, World::Shared) => Some(Self::SharedPush),
            (Self::PickAndPlace | Self::SharedPickAndPlace, World::Shared) => {
                Some(Self::SharedPickAndPlace)
            }
            (Self::CarryBar, World::Slow) => Some(Self::CarryBar),
            (_, World::Slow) | (Self::CarryBar, _) => None,
        }
    }

    /// Returns the task of each arm taken by itself, which is that of the teacher.
    #[must_use]
    pub const fn of_one_arm(self) -> Self {
        match self {
            Self::CarryBar => Self::PickAndPlace,
            _ => self,
        }
    }

    /// Returns the smallest number of arms that perform the task.
    #[must_use]
    pub const fn min_arms(self) -> usize {
        if self.shares_object() { 2 } else { 1 }
    }

    /// Returns true if all arms act on one object; otherwise each has its own.
    #[must_use]
    pub const fn shares_object(self) -> bool {
        matches!(self, Self::CarryBar)
    }

    /// Returns true if the paper has the task too.
    #[must_use]
    pub const fn is_in_paper(self) -> bool {
        !self.shares_object()
    }

    /// Returns true if the arms grasp their objects; otherwise they push them with closed grippers.
    #[must_use]
    pub const fn grasps(self) -> bool {
        match self {
            Self::Push | Self::SharedPush => false,
            Self::PickAndPlace | Self::SharedPickAndPlace | Self::CarryBar => true,
        }
    }

    /// Returns the length of one arm's part of an action: a displacement of the end effector (3) and, in pick and
    /// place, the gripper's input (1).
    #[must_use]
    pub const fn action_per_arm(self) -> usize {
        if self.grasps() { 4 } else { 3 }
    }
}

impl fmt::Display for Task {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// An unknown name of a task.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "unknown task {0:?}: expected push, pick-and-place, shared-push, shared-pick-and-place or carry-bar"
)]
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

/// The index of an arm within a layout or a task, from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ArmIndex(pub usize);

/// A built-in task and the number of arms, which together determine the length of every vector.
///
/// The vector of several arms is the concatenation of the vectors of each arm, in arm order (`d_1 || d_2` in the
/// paper). Each arm's numbers are in the arm's own frame, so a one-arm policy can use an arm's part unchanged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Layout {
    /// The task.
    pub task: Task,
    /// Number of arms, 1 to [`MAX_ARMS`](crate::task::MAX_ARMS). The simulator has worlds for 1 and 2.
    pub n_arms: usize,
}

impl Layout {
    /// Creates the layout of `n_arms` arms that perform `task`.
    #[must_use]
    pub const fn new(task: Task, n_arms: usize) -> Self {
        Self { task, n_arms }
    }

    /// Returns the layout of each arm taken by itself, which is the layout of the teacher.
    #[must_use]
    pub const fn single_arm(self) -> Self {
        Self { task: self.task.of_one_arm(), n_arms: 1 }
    }

    /// Returns the length of an observation.
    #[must_use]
    pub const fn n_observation(self) -> usize {
        OBSERVATION_PER_ARM * self.n_arms
    }

    /// Returns the length of a goal, achieved or desired.
    #[must_use]
    pub const fn n_goal(self) -> usize {
        GOAL_PER_ARM * self.n_arms
    }

    /// Returns the length of an action.
    #[must_use]
    pub const fn n_action(self) -> usize {
        self.task.action_per_arm() * self.n_arms
    }

    /// Returns the indices of the arms, in order.
    pub fn arms(self) -> impl ExactSizeIterator<Item = ArmIndex> {
        (0..self.n_arms).map(ArmIndex)
    }

    /// Returns the range of `arm`'s part of an observation: the paper's state map `f_i^s` (equation 7).
    #[must_use]
    pub const fn observation_of(self, arm: ArmIndex) -> Range<usize> {
        arm.0 * OBSERVATION_PER_ARM..(arm.0 + 1) * OBSERVATION_PER_ARM
    }

    /// Returns the range of `arm`'s part of a goal.
    #[must_use]
    pub const fn goal_of(self, arm: ArmIndex) -> Range<usize> {
        arm.0 * GOAL_PER_ARM..(arm.0 + 1) * GOAL_PER_ARM
    }

    /// Returns the range of `arm`'s part of an action: the paper's maps `f^a` and `h_i^a` (equations 8 and 9).
    #[must_use]
    pub const fn action_of(self, arm: ArmIndex) -> Range<usize> {
        arm.0 * self.task.action_per_arm()..(arm.0 + 1) * self.task.action_per_arm()
    }

    /// Returns the range of the position of `arm`'s object, its achieved goal, in an observation.
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
    fn the_parts_of_the_arms_cover_every_vector_once() {
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
    fn a_task_parses_from_its_name() {
        for task in Task::ALL {
            assert_eq!(task.name().parse(), Ok(task));
        }
        assert!("pick".parse::<Task>().is_err());
    }
}
