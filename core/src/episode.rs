//! An episode as a worker sends it to the learner.

use std::borrow::Cow;
use std::ops::BitOr;

use crate::layout::ArmIndex;
use crate::task::TaskSpec;

/// The purpose of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EpisodeKind {
    /// Played with exploration and advice, for the replay buffer.
    Training,
    /// Played by the policy alone, for the success rate.
    Evaluation,
}

/// The set of contacts during one control step. An environment may say which arms touched the table; it then does so
/// for all of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Contacts(u8);

impl Contacts {
    /// No contact.
    pub const NONE: Self = Self(0);
    /// Parts of two arms touched or overlapped.
    pub const ARM_ARM: Self = Self(1);
    /// Part of an arm touched the table.
    pub const ARM_TABLE: Self = Self(2);
    /// Part of this arm touched the table, by the arm's index. Includes [`ARM_TABLE`](Self::ARM_TABLE).
    pub const TABLE_OF: [Self; 2] = [Self(2 | 4), Self(2 | 8)];

    /// Returns `true` if this set includes all contacts of `other`.
    #[must_use]
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// Returns `true` if there was any contact.
    #[must_use]
    pub const fn any(self) -> bool {
        self.0 != 0
    }

    /// Returns `true` if `arm` touched the table, or any two arms touched each other: the set does not say which ones.
    #[must_use]
    pub fn involves(self, arm: ArmIndex) -> bool {
        self.contains(Self::ARM_ARM) || self.touches_table(arm)
    }

    /// Returns `true` if `arm` touched the table. If the environment did not say which arms did, all of them count.
    #[must_use]
    pub fn touches_table(self, arm: ArmIndex) -> bool {
        let knows_arms = Self::TABLE_OF.iter().any(|of_arm| self.contains(*of_arm));
        match Self::TABLE_OF.get(arm.0) {
            Some(of_arm) if knows_arms => self.contains(*of_arm),
            _ => self.contains(Self::ARM_TABLE) && !knows_arms,
        }
    }

    /// Returns these contacts without saying which arms touched the table.
    #[must_use]
    pub const fn of_any_arm(self) -> Self {
        Self(self.0 & (Self::ARM_ARM.0 | Self::ARM_TABLE.0))
    }

    /// Returns the contacts as bits: bit 0 is [`ARM_ARM`](Self::ARM_ARM), bit 1 [`ARM_TABLE`](Self::ARM_TABLE), bits 2
    /// and 3 are the arms of [`TABLE_OF`](Self::TABLE_OF).
    #[must_use]
    pub const fn bits(self) -> u8 {
        self.0
    }

    /// Returns the contacts that `bits` encode, or `None` if an undefined bit is set, or bit 2 or 3
    /// without bit 1.
    #[must_use]
    pub const fn from_bits(bits: u8) -> Option<Self> {
        let contradicts = bits & 0b1100 != 0 && bits & 0b10 == 0;
        if bits & !0b1111 == 0 && !contradicts { Some(Self(bits)) } else { None }
    }
}

impl BitOr for Contacts {
    type Output = Self;

    fn bitor(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}

/// A complete episode: the transitions of all its steps, with one goal.
///
/// In the shapes below, `n` is the number of [steps](TaskSpec::episode_steps) of the task.
#[derive(Debug, Clone, PartialEq)]
pub struct Episode {
    /// Number within the run (training) or within the goal set (evaluation).
    pub number: u64,
    /// Its purpose.
    pub kind: EpisodeKind,
    /// Version of the policy's parameters.
    pub parameter_version: u64,
    /// The task, which determines the length of every vector below.
    pub task: TaskSpec,
    /// Observations before each step and after the last one, shape `[n + 1, n_observation]`.
    pub observations: Vec<f32>,
    /// Desired goal, shape `[n_goal]`.
    pub goal: Vec<f32>,
    /// Actions as executed, in [−1, 1], shape `[n, n_action]`.
    pub actions: Vec<f32>,
    /// For each step a bit set: bit `a` is set if arm `a` executed the teacher's action. Shape `[n]`.
    pub advised_arms: Vec<u8>,
    /// Contacts during each step, shape `[n]`.
    pub contacts: Vec<Contacts>,
    /// Units of the advice budget that the episode claims: one for each step on which it has an advised arm. Under
    /// [`AdviceUnit::SlotStep`](crate::AdviceUnit::SlotStep), the first advised episode of a slot claims one for each
    /// step on which any episode of the slot has an advised arm, and the others claim none.
    pub advice_charged: u32,
    /// Number of steps in which the link avoidance limited the motion of an arm; `None` if the environment does not
    /// count them.
    pub avoidance_steps: Option<u32>,
    /// Number of steps on which the teacher was asked; `None` if the worker does not count them.
    pub queried_steps: Option<u32>,
}

impl Episode {
    /// Returns a training episode in which every number is zero, to be filled in.
    #[must_use]
    pub fn zeros(task: impl Into<TaskSpec>, number: u64) -> Self {
        let task = task.into();
        let n_steps = task.episode_steps();
        Self {
            number,
            kind: EpisodeKind::Training,
            parameter_version: 0,
            observations: vec![0.0; (n_steps + 1) * task.n_observation()],
            goal: vec![0.0; task.n_goal()],
            actions: vec![0.0; n_steps * task.n_action()],
            advised_arms: vec![0; n_steps],
            contacts: vec![Contacts::NONE; n_steps],
            advice_charged: 0,
            avoidance_steps: None,
            queried_steps: None,
            task,
        }
    }

    /// Returns the number of control steps.
    #[must_use]
    pub fn n_steps(&self) -> usize {
        self.task.episode_steps()
    }

    /// Returns the observation before step `step_idx`, shape `[n_observation]`; `n_steps` gives the final one.
    ///
    /// # Panics
    /// If `step_idx` exceeds the number of steps.
    #[must_use]
    pub fn observation(&self, step_idx: usize) -> &[f32] {
        let n = self.task.n_observation();
        &self.observations[step_idx * n..(step_idx + 1) * n]
    }

    /// Returns the action executed in step `step_idx`, shape `[n_action]`.
    ///
    /// # Panics
    /// If `step_idx` is not below the number of steps.
    #[must_use]
    pub fn action(&self, step_idx: usize) -> &[f32] {
        let n = self.task.n_action();
        &self.actions[step_idx * n..(step_idx + 1) * n]
    }

    /// Returns what `arm` has achieved before step `step_idx`, in the order and the unit of its goal.
    ///
    /// # Panics
    /// If `step_idx` exceeds the number of steps, or there is no such arm.
    #[must_use]
    pub fn achieved(&self, step_idx: usize, arm: ArmIndex) -> Cow<'_, [f32]> {
        self.task.achieved_goal_of(arm).of(self.observation(step_idx))
    }

    /// Returns the observation after the last step, shape `[n_observation]`.
    #[must_use]
    pub fn last_observation(&self) -> &[f32] {
        self.observation(self.n_steps())
    }

    /// Returns `true` if `arm` succeeds after each of the last [steps](TaskSpec::success_steps) that count.
    #[must_use]
    pub fn arm_succeeded(&self, arm: ArmIndex) -> bool {
        self.ends_with(|observation| self.task.arm_succeeds(arm, observation, &self.goal))
    }

    /// Returns `true` if every arm succeeds after each of the last [steps](TaskSpec::success_steps) that count.
    #[must_use]
    pub fn succeeded(&self) -> bool {
        self.ends_with(|observation| self.task.is_success(observation, &self.goal))
    }

    /// Returns `true` if every arm succeeds after as many consecutive steps as [count](TaskSpec::success_steps), and
    /// the episode does not end so: an object was lost.
    #[must_use]
    pub fn lost_goal(&self) -> bool {
        let mut n_succeeding = 0;
        let succeeded_before = (1..=self.n_steps()).any(|step_idx| {
            let succeeds = self.task.is_success(self.observation(step_idx), &self.goal);
            n_succeeding = if succeeds { n_succeeding + 1 } else { 0 };
            n_succeeding == self.task.success_steps()
        });
        succeeded_before && !self.succeeded()
    }

    fn ends_with(&self, succeeds: impl Fn(&[f32]) -> bool) -> bool {
        let n_steps = self.n_steps();
        let first = n_steps + 1 - self.task.success_steps();
        (first..=n_steps).all(|step_idx| succeeds(self.observation(step_idx)))
    }

    /// Returns `true` if the norm over all arms' distances together is within the tolerance after the last step. Other
    /// conditions of the task do not count.
    #[must_use]
    pub fn succeeded_jointly(&self) -> bool {
        self.joint_reward(self.n_steps() - 1) > -0.5
    }

    /// Returns the joint reward of step `step_idx`, −1 or 0: the [sparse reward](TaskSpec::sparse_reward) of all arms'
    /// goals together after the step.
    ///
    /// # Panics
    /// If `step_idx` is not below the number of steps.
    #[must_use]
    pub fn joint_reward(&self, step_idx: usize) -> f32 {
        let achieved: Vec<f32> = self.task.achieved_goal(self.observation(step_idx + 1)).collect();
        self.task.sparse_reward(&achieved, &self.goal)
    }

    /// Returns `true` if what any arm, or all arms together, achieved differs by more than the task's tolerance between
    /// the start and the end: in the built-in tasks, if an object ended more than 5 cm from where it was.
    #[must_use]
    pub fn moved(&self) -> bool {
        self.task.is_displaced(self.observation(0), self.last_observation())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_contact_with_the_table_is_that_of_the_arms_it_names_or_of_all() {
        let [first, second] = Contacts::TABLE_OF;
        for (contacts, expected) in [
            (Contacts::NONE, [false, false]),
            (Contacts::ARM_TABLE, [true, true]),
            (first, [true, false]),
            (second, [false, true]),
            (first | second, [true, true]),
            (first | Contacts::ARM_ARM, [true, true]),
            (first.of_any_arm(), [true, true]),
        ] {
            let involved = [0, 1].map(|arm| contacts.involves(ArmIndex(arm)));
            assert_eq!(involved, expected, "{contacts:?}");
            assert_eq!(Contacts::from_bits(contacts.bits()), Some(contacts));
        }
    }

    #[test]
    fn bits_that_contradict_each_other_are_no_contacts() {
        for bits in [0b0100, 0b1001, 0b1_0000] {
            assert_eq!(Contacts::from_bits(bits), None, "{bits:#b}");
        }
    }
}
