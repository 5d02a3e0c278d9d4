//! An episode as a worker sends it to the learner.

use std::ops::BitOr;

use crate::layout::{ArmIndex, EPISODE_STEPS, GOAL_TOLERANCE_M, Layout};
use crate::reward::{achieved_goal, distance, is_success, sparse_reward};

/// Displacement of an object, metres, above which its episode counts as "moved".
pub const MOVED_M: f32 = 0.05;

/// The purpose of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EpisodeKind {
    /// Played with exploration and advice, for the replay buffer.
    Training,
    /// Played by the policy alone, for the success rate.
    Evaluation,
}

/// The set of contacts during one control step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Contacts(u8);

impl Contacts {
    /// No contact.
    pub const NONE: Self = Self(0);
    /// Parts of two arms touched or overlapped.
    pub const ARM_ARM: Self = Self(1);
    /// Part of an arm touched the table.
    pub const ARM_TABLE: Self = Self(2);

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

    /// Returns the contacts as bits: bit 0 is [`ARM_ARM`](Self::ARM_ARM), bit 1 [`ARM_TABLE`](Self::ARM_TABLE).
    #[must_use]
    pub const fn bits(self) -> u8 {
        self.0
    }

    /// Returns the contacts that `bits` encode, or `None` if an undefined bit is set.
    #[must_use]
    pub const fn from_bits(bits: u8) -> Option<Self> {
        if bits & !3 == 0 { Some(Self(bits)) } else { None }
    }
}

impl BitOr for Contacts {
    type Output = Self;

    fn bitor(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}

/// A complete episode: [`EPISODE_STEPS`] transitions with one goal.
#[derive(Debug, Clone, PartialEq)]
pub struct Episode {
    /// Number within the run (training) or within the goal set (evaluation).
    pub number: u64,
    /// Its purpose.
    pub kind: EpisodeKind,
    /// Version of the policy's parameters.
    pub parameter_version: u64,
    /// Task and arms, which determine the length of every vector below.
    pub layout: Layout,
    /// Observations before each step and after the last one, shape `[EPISODE_STEPS + 1, n_observation]`.
    pub observations: Vec<f32>,
    /// Desired goal, arm frames, metres, shape `[n_goal]`.
    pub goal: Vec<f32>,
    /// Actions as executed, in [−1, 1], shape `[EPISODE_STEPS, n_action]`.
    pub actions: Vec<f32>,
    /// For each step a bit set: bit `a` is set if arm `a` executed the teacher's action. Shape `[EPISODE_STEPS]`.
    pub advised_arms: Vec<u8>,
    /// Contacts during each step, shape `[EPISODE_STEPS]`.
    pub contacts: Vec<Contacts>,
    /// Units of the advice budget that the episode cost: one for each step with at least one advised arm.
    pub advice_charged: u32,
}

impl Episode {
    /// Returns a training episode in which every number is zero, to be filled in.
    #[must_use]
    pub fn zeros(layout: Layout, number: u64) -> Self {
        Self {
            number,
            kind: EpisodeKind::Training,
            parameter_version: 0,
            layout,
            observations: vec![0.0; (EPISODE_STEPS + 1) * layout.n_observation()],
            goal: vec![0.0; layout.n_goal()],
            actions: vec![0.0; EPISODE_STEPS * layout.n_action()],
            advised_arms: vec![0; EPISODE_STEPS],
            contacts: vec![Contacts::NONE; EPISODE_STEPS],
            advice_charged: 0,
        }
    }

    /// Returns the observation before step `step_idx`, shape `[n_observation]`; `EPISODE_STEPS` gives the final one.
    ///
    /// # Panics
    /// If `step_idx` exceeds `EPISODE_STEPS`.
    #[must_use]
    pub fn observation(&self, step_idx: usize) -> &[f32] {
        let n = self.layout.n_observation();
        &self.observations[step_idx * n..(step_idx + 1) * n]
    }

    /// Returns the action executed in step `step_idx`, shape `[n_action]`.
    ///
    /// # Panics
    /// If `step_idx` is not below `EPISODE_STEPS`.
    #[must_use]
    pub fn action(&self, step_idx: usize) -> &[f32] {
        let n = self.layout.n_action();
        &self.actions[step_idx * n..(step_idx + 1) * n]
    }

    /// Returns the position of `arm`'s object before step `step_idx`, arm frame, metres, shape `[3]`.
    #[must_use]
    pub fn achieved(&self, step_idx: usize, arm: ArmIndex) -> &[f32] {
        &self.observation(step_idx)[self.layout.achieved_goal_of(arm)]
    }

    /// Returns `true` if `arm`'s object is within the tolerance of its goal after the last step.
    #[must_use]
    pub fn arm_succeeded(&self, arm: ArmIndex) -> bool {
        distance(self.achieved(EPISODE_STEPS, arm), &self.goal[self.layout.goal_of(arm)])
            <= GOAL_TOLERANCE_M
    }

    /// Returns `true` if every object is within the tolerance of its goal after the last step.
    #[must_use]
    pub fn succeeded(&self) -> bool {
        is_success(self.layout, self.observation(EPISODE_STEPS), &self.goal)
    }

    /// Returns `true` if the norm over all arms' distances together is within the tolerance after the last step.
    #[must_use]
    pub fn succeeded_jointly(&self) -> bool {
        self.joint_reward(EPISODE_STEPS - 1) > -0.5
    }

    /// Returns the joint reward of step `step_idx`: the [`sparse_reward`] of all arms' goals together.
    #[must_use]
    pub fn joint_reward(&self, step_idx: usize) -> f32 {
        let achieved: Vec<f32> =
            achieved_goal(self.layout, self.observation(step_idx + 1)).collect();
        sparse_reward(&achieved, &self.goal)
    }

    /// Returns `true` if any object ended more than [`MOVED_M`] from its start.
    #[must_use]
    pub fn moved(&self) -> bool {
        self.layout
            .arms()
            .any(|arm| distance(self.achieved(0, arm), self.achieved(EPISODE_STEPS, arm)) > MOVED_M)
    }
}
