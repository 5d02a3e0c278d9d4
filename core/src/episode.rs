//! A whole episode as it travels from a worker to the learner.

use std::ops::BitOr;

use crate::layout::{ArmIndex, EPISODE_STEPS, Layout};
use crate::reward::{achieved_goal, distance, sparse_reward};

/// Distance, metres, that an object must have been displaced for its episode to count as "moved".
pub const MOVED_M: f32 = 0.05;

/// What an episode is played for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EpisodeKind {
    /// With exploration and advice, for the replay buffer.
    Training,
    /// The policy alone, for the success rate.
    Evaluation,
}

/// What touched what during one control step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Contacts(u8);

impl Contacts {
    /// No contact.
    pub const NONE: Self = Self(0);
    /// Parts of two arms touched or overlapped.
    pub const ARM_ARM: Self = Self(1);
    /// Part of an arm touched the table.
    pub const ARM_TABLE: Self = Self(2);

    /// Whether all of `other`'s contacts are among these.
    #[must_use]
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// Whether there was any contact.
    #[must_use]
    pub const fn any(self) -> bool {
        self.0 != 0
    }

    /// The contacts as bits, for a wire.
    #[must_use]
    pub const fn bits(self) -> u8 {
        self.0
    }

    /// The contacts that `bits` stand for, when each bit has a meaning.
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

/// A whole episode: `EPISODE_STEPS` transitions with one goal.
#[derive(Debug, Clone, PartialEq)]
pub struct Episode {
    /// Number within the run (training) or within the goal set (evaluation).
    pub number: u64,
    /// What it was played for.
    pub kind: EpisodeKind,
    /// Version of the parameters that acted.
    pub parameter_version: u64,
    /// Tasks and arms, which fix every length below.
    pub layout: Layout,
    /// Shape `[EPISODE_STEPS + 1, n_observation]`.
    pub observations: Vec<f32>,
    /// Desired goal, shape `[n_goal]`.
    pub goal: Vec<f32>,
    /// Actions as executed, in [−1, 1], shape `[EPISODE_STEPS, n_action]`.
    pub actions: Vec<f32>,
    /// Per step, bit `a` set when arm `a` executed the teacher's action, shape `[EPISODE_STEPS]`.
    pub advised_arms: Vec<u8>,
    /// Per step, what touched what, shape `[EPISODE_STEPS]`.
    pub contacts: Vec<Contacts>,
    /// Units of the advice budget that the episode's advised steps cost: one for each step with an advised arm.
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

    /// The observation before step `step_idx`; `EPISODE_STEPS` gives the last one.
    #[must_use]
    pub fn observation(&self, step_idx: usize) -> &[f32] {
        let n = self.layout.n_observation();
        &self.observations[step_idx * n..(step_idx + 1) * n]
    }

    /// The action executed on step `step_idx`.
    #[must_use]
    pub fn action(&self, step_idx: usize) -> &[f32] {
        let n = self.layout.n_action();
        &self.actions[step_idx * n..(step_idx + 1) * n]
    }

    /// Where `arm`'s object is before step `step_idx`, in the arm's own frame, metres.
    #[must_use]
    pub fn achieved(&self, step_idx: usize, arm: ArmIndex) -> &[f32] {
        &self.observation(step_idx)[self.layout.achieved_goal_of(arm)]
    }

    /// Whether `arm`'s object is at its goal after the last step.
    #[must_use]
    pub fn arm_succeeded(&self, arm: ArmIndex) -> bool {
        distance(self.achieved(EPISODE_STEPS, arm), &self.goal[self.layout.goal_of(arm)])
            <= crate::layout::GOAL_TOLERANCE_M
    }

    /// Whether every object is at its goal after the last step.
    #[must_use]
    pub fn succeeded(&self) -> bool {
        self.layout.arms().all(|arm| self.arm_succeeded(arm))
    }

    /// Whether the joint norm over all arms' goals is within the tolerance after the last step.
    #[must_use]
    pub fn succeeded_jointly(&self) -> bool {
        self.joint_reward_after(EPISODE_STEPS - 1) > -0.5
    }

    /// The joint reward of step `step_idx`.
    #[must_use]
    pub fn joint_reward_after(&self, step_idx: usize) -> f32 {
        let achieved: Vec<f32> =
            achieved_goal(self.layout, self.observation(step_idx + 1)).collect();
        sparse_reward(&achieved, &self.goal)
    }

    /// Whether any object ended more than [`MOVED_M`] from where it started.
    #[must_use]
    pub fn moved(&self) -> bool {
        self.layout
            .arms()
            .any(|arm| distance(self.achieved(0, arm), self.achieved(EPISODE_STEPS, arm)) > MOVED_M)
    }
}
