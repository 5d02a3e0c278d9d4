//! Tasks as data: everything that the learner, the teacher and the workers know about a task.
//!
//! A [`TaskDescription`] is plain data from a file or a message; [`TaskSpec::new`] checks it. The built-in tasks have
//! descriptions like any other.

use std::sync::Arc;

use crate::layout::{ArmIndex, Layout, Task};
use crate::reward::sparse_reward_within;

use reflection::ReflectionMap;

mod built_in;
mod check;
mod derived;
mod description;
mod manipulation;
mod part;
mod reflection;
#[cfg(test)]
mod tests;

pub use check::InvalidTask;
pub use description::{ArmDescription, Norm, TaskDescription, TaskDifference};
pub use manipulation::{ArmManipulation, Condition, Manipulation};
pub use part::Part;
pub use reflection::Reflection;

/// Largest number of arms of a task. An episode has one bit per arm and step.
pub const MAX_ARMS: usize = 8;
/// Largest length of an observation, a goal or an action.
pub const MAX_NUMBERS: usize = 4096;
/// Largest number of control steps of an episode.
pub const MAX_EPISODE_STEPS: usize = 10_000;

/// A checked task. It determines the length of every vector and the part of each arm; a clone is cheap.
///
/// # Panics
/// Methods panic if the index of an arm is not below [`n_arms`](Self::n_arms), or a vector is shorter than the task
/// says.
#[derive(Debug, Clone)]
pub struct TaskSpec(Arc<Checked>);

#[derive(Debug)]
struct Checked {
    description: TaskDescription,
    arms: Vec<ArmParts>,
    common_observation: Part,
    common_goal: Part,
    common_achieved_goal: Part,
    reflection: Option<ReflectionMap>,
    built_in: Option<Layout>,
}

/// The parts of one arm.
#[derive(Debug)]
struct ArmParts {
    observation: Part,
    goal: Part,
    action: Part,
    achieved_goal: Part,
    position: Part,
    lateral: Part,
    hand: Part,
}

impl TaskSpec {
    /// Checks a description.
    ///
    /// # Errors
    /// Names the first field that is inconsistent or exceeds a limit.
    pub fn new(description: TaskDescription) -> Result<Self, InvalidTask> {
        check::check(&description)?;
        let task = description.name.parse::<Task>().ok();
        let built_in = task.map(|task| Layout::new(task, description.arms.len()));
        Ok(Self::of_checked(description, built_in))
    }

    /// Creates a built-in task.
    ///
    /// # Panics
    /// If `n_arms` is 0 or exceeds [`MAX_ARMS`].
    #[must_use]
    pub fn built_in(task: Task, n_arms: usize) -> Self {
        assert!((1..=MAX_ARMS).contains(&n_arms), "{n_arms} arms, expected 1 to {MAX_ARMS}");
        let layout = Layout::new(task, n_arms);
        Self::of_checked(layout.description(), Some(layout))
    }

    fn of_checked(description: TaskDescription, built_in: Option<Layout>) -> Self {
        let achieved = |goal: &[usize]| {
            Part::new(goal.iter().map(|idx| description.achieved_goal[*idx]).collect())
        };
        let parts = |arm: &ArmDescription| ArmParts {
            observation: Part::new(arm.observation.clone()),
            goal: Part::new(arm.goal.clone()),
            action: Part::new(arm.action.clone()),
            achieved_goal: achieved(&arm.goal),
            position: Part::new(arm.position.clone()),
            lateral: Part::new(arm.lateral.clone()),
            hand: Part::new(arm.hand.clone()),
        };
        let arms: Vec<ArmParts> = description.arms.iter().map(parts).collect();
        let goals: Vec<&[usize]> = description.arms.iter().map(|arm| &arm.goal[..]).collect();
        let observations: Vec<&[usize]> =
            description.arms.iter().map(|arm| &arm.observation[..]).collect();
        let common_goal = unowned(description.n_goal, &goals);
        Self(Arc::new(Checked {
            arms,
            common_observation: Part::new(unowned(description.n_observation, &observations)),
            common_achieved_goal: achieved(&common_goal),
            common_goal: Part::new(common_goal),
            reflection: ReflectionMap::new(&description),
            built_in,
            description,
        }))
    }

    /// Returns the description.
    #[must_use]
    pub fn description(&self) -> &TaskDescription {
        &self.0.description
    }

    /// Returns the layout of the built-in task, `None` for other tasks.
    #[must_use]
    pub fn as_built_in(&self) -> Option<Layout> {
        self.0.built_in
    }

    /// Returns the task's name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.0.description.name
    }

    /// Returns true if the task says at which distance hands are in contact.
    #[must_use]
    pub fn describes_contacts(&self) -> bool {
        !self.0.description.contact_distances.is_empty()
    }

    /// Returns the length of an observation.
    #[must_use]
    pub fn n_observation(&self) -> usize {
        self.0.description.n_observation
    }

    /// Returns the length of a goal, achieved or desired.
    #[must_use]
    pub fn n_goal(&self) -> usize {
        self.0.description.n_goal
    }

    /// Returns the length of an action.
    #[must_use]
    pub fn n_action(&self) -> usize {
        self.0.description.n_action
    }

    /// Returns the number of arms.
    #[must_use]
    pub fn n_arms(&self) -> usize {
        self.0.arms.len()
    }

    /// Returns the indices of the arms, in order.
    pub fn arms(&self) -> impl ExactSizeIterator<Item = ArmIndex> + use<> {
        (0..self.n_arms()).map(ArmIndex)
    }

    /// Returns `arm`'s part of an observation: the paper's state map `f_i^s` (equation 7).
    #[must_use]
    pub fn observation_of(&self, arm: ArmIndex) -> &Part {
        &self.0.arms[arm.0].observation
    }

    /// Returns `arm`'s part of a goal.
    #[must_use]
    pub fn goal_of(&self, arm: ArmIndex) -> &Part {
        &self.0.arms[arm.0].goal
    }

    /// Returns `arm`'s part of an action: the paper's maps `f^a` and `h_i^a` (equations 8 and 9).
    #[must_use]
    pub fn action_of(&self, arm: ArmIndex) -> &Part {
        &self.0.arms[arm.0].action
    }

    /// Returns the indices, in an observation, of what `arm` achieved, in the order of [`goal_of`](Self::goal_of).
    #[must_use]
    pub fn achieved_goal_of(&self, arm: ArmIndex) -> &Part {
        &self.0.arms[arm.0].achieved_goal
    }

    /// Returns the indices, in an observation, of `arm`'s positions along the axis on which the arms face each other.
    #[must_use]
    pub fn position_of(&self, arm: ArmIndex) -> &Part {
        &self.0.arms[arm.0].position
    }

    /// Returns the indices, in an observation, of the coordinates of [`Self::position_of`] along the perpendicular
    /// axis, which may be empty: see [`ArmDescription::lateral`].
    #[must_use]
    pub fn lateral_of(&self, arm: ArmIndex) -> &Part {
        &self.0.arms[arm.0].lateral
    }

    /// Returns the indices, in an observation, of the coordinates of `arm`'s hand, which may be empty: see
    /// [`ArmDescription::hand`].
    #[must_use]
    pub fn hand_of(&self, arm: ArmIndex) -> &Part {
        &self.0.arms[arm.0].hand
    }

    /// Returns the numbers of an observation that belong to no arm.
    #[must_use]
    pub fn common_observation(&self) -> &Part {
        &self.0.common_observation
    }

    /// Returns the numbers of a goal that belong to no arm; all arms must achieve them.
    #[must_use]
    pub fn common_goal(&self) -> &Part {
        &self.0.common_goal
    }

    /// Returns the indices, in an observation, of what was achieved of [`common_goal`](Self::common_goal).
    #[must_use]
    pub fn common_achieved_goal(&self) -> &Part {
        &self.0.common_achieved_goal
    }

    /// Returns the number of control steps per episode.
    #[must_use]
    pub fn episode_steps(&self) -> usize {
        self.0.description.episode_steps
    }

    /// Returns the distance up to which a goal counts as achieved, in the unit of the goal.
    #[must_use]
    pub fn tolerance(&self) -> f32 {
        self.0.description.tolerance
    }

    /// Returns the norm of the difference between achieved and desired goal.
    #[must_use]
    pub fn norm(&self) -> Norm {
        self.0.description.norm
    }

    /// Returns the largest magnitude that number `idx` of an observation can have.
    #[must_use]
    pub fn observation_bound(&self, idx: usize) -> f32 {
        self.0.description.observation_bound[idx]
    }

    /// Returns the largest magnitude that number `idx` of a goal can have.
    #[must_use]
    pub fn goal_bound(&self, idx: usize) -> f32 {
        self.0.description.goal_bound[idx]
    }

    /// Returns true if the parts of the arms can be exchanged; there is more than one arm.
    #[must_use]
    pub fn has_interchangeable_arms(&self) -> bool {
        self.0.description.interchangeable_arms && self.n_arms() > 1
    }

    /// Returns true if parts of two arms from different steps can be recombined; there are two arms.
    #[must_use]
    pub fn has_recombinable_arms(&self) -> bool {
        self.n_arms() == 2 && !self.position_of(ArmIndex(0)).is_empty()
    }

    /// Returns true if all arms act on one object.
    #[must_use]
    pub fn shares_object(&self) -> bool {
        self.0.description.manipulation.shared_object
    }

    /// Returns the number of control steps at the end of an episode after all of which the goal must be achieved.
    #[must_use]
    pub fn success_steps(&self) -> usize {
        self.0.description.manipulation.success_steps
    }

    /// Returns the index of the action that opens `arm`'s gripper if it is positive, if the task names one.
    #[must_use]
    pub fn gripper_of(&self, arm: ArmIndex) -> Option<usize> {
        self.manipulation_of(arm).and_then(|manipulation| manipulation.gripper)
    }

    /// Returns true if `arm` holds its object in `observation`; false if the task does not define that.
    #[must_use]
    pub fn arm_holds(&self, arm: ArmIndex, observation: &[f32]) -> bool {
        self.manipulation_of(arm).is_some_and(|manipulation| {
            let holding = &manipulation.holding;
            !holding.is_empty() && holding.iter().all(|one| one.holds(self.norm(), observation))
        })
    }

    fn manipulation_of(&self, arm: ArmIndex) -> Option<&ArmManipulation> {
        self.0.description.manipulation.arms.get(arm.0)
    }

    /// Returns true if steps report contacts between arms and with the table.
    #[must_use]
    pub fn reports_contacts(&self) -> bool {
        self.0.description.reports_contacts
    }

    /// Returns the goal that `observation` achieves, shape `[n_goal]`.
    pub fn achieved_goal(&self, observation: &[f32]) -> impl Iterator<Item = f32> {
        self.0.description.achieved_goal.iter().map(|idx| observation[*idx])
    }

    /// Returns the distance between two goals, shape `[n_goal]`, or between two parts of goals.
    ///
    /// # Panics
    /// If the goals differ in length.
    #[must_use]
    pub fn distance(&self, achieved: &[f32], desired: &[f32]) -> f32 {
        self.norm().distance(achieved, desired)
    }

    /// Returns the sparse reward `−(‖achieved − desired‖ > ε)` of section 4.1 of the paper.
    ///
    /// Given the goals of all arms, shape `[n_goal]`, the result is the joint reward; given those of one arm, it is the
    /// arm's own reward.
    ///
    /// # Panics
    /// If the two goals differ in length.
    #[must_use]
    pub fn sparse_reward(&self, achieved: &[f32], desired: &[f32]) -> f32 {
        sparse_reward_within(self.tolerance(), self.distance(achieved, desired))
    }

    /// Returns the distance between what `arm` achieves in `observation`, shape `[n_observation]`, and its part of
    /// `goal`, shape `[n_goal]`, in the unit of the goal.
    #[must_use]
    pub fn goal_distance_of(&self, arm: ArmIndex, observation: &[f32], goal: &[f32]) -> f32 {
        let achieved = self.achieved_goal_of(arm).of(observation);
        self.distance(&achieved, &self.goal_of(arm).of(goal))
    }

    /// Returns the [distance](Self::goal_distance_of) of each arm from its goal, then that from the part of the goal
    /// common to all arms if there is one: shape `[n_arms]` or `[n_arms + 1]`.
    #[must_use]
    pub fn goal_distances(&self, observation: &[f32], goal: &[f32]) -> Vec<f32> {
        let of_arms = self.arms().map(|arm| self.goal_distance_of(arm, observation, goal));
        let (achieved, desired) = (self.common_achieved_goal(), self.common_goal());
        let has_common = !desired.is_empty();
        let common =
            has_common.then(|| self.distance(&achieved.of(observation), &desired.of(goal)));
        of_arms.chain(common).collect()
    }

    /// Returns true if `arm`'s part of the goal and the part common to all arms are achieved.
    ///
    /// `observation` has shape `[n_observation]`, `goal` shape `[n_goal]`.
    ///
    /// # Panics
    /// If a slice is too short.
    #[must_use]
    pub fn arm_reaches_goal(&self, arm: ArmIndex, observation: &[f32], goal: &[f32]) -> bool {
        self.goal_distance_of(arm, observation, goal) <= self.tolerance()
            && self.common_goal_is_achieved(observation, goal)
    }

    /// Returns true if `arm` reaches its goal, as by [`arm_reaches_goal`](Self::arm_reaches_goal), and satisfies all
    /// other [conditions](ArmManipulation) of the task.
    ///
    /// # Panics
    /// If a slice is too short.
    #[must_use]
    pub fn arm_succeeds(&self, arm: ArmIndex, observation: &[f32], goal: &[f32]) -> bool {
        self.arm_reaches_goal(arm, observation, goal) && self.arm_meets_conditions(arm, observation)
    }

    /// Returns true if `arm` satisfies all conditions of success other than the distance to the goal: it holds its
    /// object and meets the further conditions, as far as the task has any.
    ///
    /// # Panics
    /// If `observation` is too short.
    #[must_use]
    pub fn arm_meets_conditions(&self, arm: ArmIndex, observation: &[f32]) -> bool {
        let holds = |condition: &Condition| condition.holds(self.norm(), observation);
        self.manipulation_of(arm).is_none_or(|its| its.all_conditions().all(holds))
    }

    /// Returns true if every arm's part of the goal, and the part common to all arms, are achieved, and every other
    /// condition of the task holds.
    ///
    /// `observation` has shape `[n_observation]`, `goal` shape `[n_goal]`. An episode is a success if this holds after
    /// each of its last [`success_steps`](Self::success_steps) steps. With several arms the distance of the goal is a
    /// weaker criterion than a joint reward of 0.
    ///
    /// # Panics
    /// If a slice is too short.
    #[must_use]
    pub fn is_success(&self, observation: &[f32], goal: &[f32]) -> bool {
        self.arms().all(|arm| self.arm_succeeds(arm, observation, goal))
    }

    /// Returns true if what any arm, or all arms together, achieved differs by more than the tolerance between two
    /// observations, shape `[n_observation]`: in the built-in tasks, if an object was displaced by more than 5 cm.
    #[must_use]
    pub fn is_displaced(&self, first: &[f32], later: &[f32]) -> bool {
        let has_moved =
            |part: &Part| self.distance(&part.of(first), &part.of(later)) > self.tolerance();
        self.arms().any(|arm| has_moved(self.achieved_goal_of(arm)))
            || has_moved(self.common_achieved_goal())
    }

    fn common_goal_is_achieved(&self, observation: &[f32], goal: &[f32]) -> bool {
        let (achieved, desired) = (self.common_achieved_goal(), self.common_goal());
        desired.is_empty()
            || self.distance(&achieved.of(observation), &desired.of(goal)) <= self.tolerance()
    }

    /// Returns the parts of all arms of an observation, concatenated in arm order, as a teacher for one arm expects
    /// them.
    #[must_use]
    pub fn observation_in_arm_order(&self, observation: &[f32]) -> Vec<f32> {
        self.in_arm_order(observation, Self::observation_of)
    }

    /// Returns the parts of all arms of a goal, concatenated in arm order.
    #[must_use]
    pub fn goal_in_arm_order(&self, goal: &[f32]) -> Vec<f32> {
        self.in_arm_order(goal, Self::goal_of)
    }

    /// Returns the parts of all arms of an action, concatenated in arm order.
    #[must_use]
    pub fn action_in_arm_order(&self, action: &[f32]) -> Vec<f32> {
        self.in_arm_order(action, Self::action_of)
    }

    fn in_arm_order(&self, vector: &[f32], part_of: fn(&Self, ArmIndex) -> &Part) -> Vec<f32> {
        self.arms().flat_map(|arm| part_of(self, arm).of(vector).into_owned()).collect()
    }

    /// Writes the actions of all arms, concatenated in arm order, into `action`: the inverse of
    /// [`action_in_arm_order`](Self::action_in_arm_order).
    ///
    /// # Panics
    /// If a slice is not of length [`n_action`](Self::n_action).
    pub fn write_action_in_arm_order(&self, in_arm_order: &[f32], action: &mut [f32]) {
        let n_per_arm = self.action_of(ArmIndex(0)).len();
        for (arm, numbers) in self.arms().zip(in_arm_order.chunks_exact(n_per_arm)) {
            self.action_of(arm).write(action, numbers);
        }
    }

    /// Returns the first field in which two tasks differ.
    #[must_use]
    pub fn difference(&self, other: &Self) -> Option<TaskDifference> {
        if self == other { None } else { self.description().difference(other.description()) }
    }
}

impl From<Layout> for TaskSpec {
    /// Creates a built-in task. See [`TaskSpec::built_in`] for its panics.
    fn from(layout: Layout) -> Self {
        Self::built_in(layout.task, layout.n_arms)
    }
}

impl From<&Self> for TaskSpec {
    fn from(task: &Self) -> Self {
        task.clone()
    }
}

impl PartialEq for TaskSpec {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0) || self.0.description == other.0.description
    }
}

/// Returns the indices below `n` that no arm has.
fn unowned(n: usize, parts: &[&[usize]]) -> Vec<usize> {
    let mut is_owned = vec![false; n];
    parts.iter().copied().flatten().for_each(|idx| is_owned[*idx] = true);
    (0..n).filter(|idx| !is_owned[*idx]).collect()
}
