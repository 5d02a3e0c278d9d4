//! A policy that acts without end, for goals that a visitor moves.

use tandem_core::layout::GOAL_TOLERANCE_M;
use tandem_core::reward::{distance, is_success};
use tandem_core::scene::{Point, Scene};
use tandem_core::{ArmIndex, Layout, Stream, WorldSettings, episode_rng};
use tandem_policy::{Actor, Policy};
use tandem_sim::{Env, WorldConfig};

use crate::error::Error;

/// Seed of the starts.
const SEED: u64 = 2;

/// Returns the task of a policy that the simulator can play.
pub(crate) fn built_in(policy: &Policy) -> Result<Layout, Error> {
    let not_built_in = || Error::NotBuiltIn(policy.task.name().to_owned());
    policy.task.as_built_in().ok_or_else(not_built_in)
}

/// A world, the policy that acts in it, and the goals.
pub struct Live {
    env: Env,
    actor: Actor,
    /// Shape `[n_observation]`.
    observation: Vec<f32>,
    /// Shape `[n_action]`.
    action: Vec<f32>,
    n_steps_since_change: u32,
    n_steps_to_success: Option<u32>,
}

impl Live {
    /// Creates the world of `policy`, in the start state `number`.
    ///
    /// # Errors
    /// If the policy is of no built-in task, or if it or the world cannot be built.
    pub fn new(policy: &Policy, number: u64) -> Result<Self, Error> {
        let layout = built_in(policy)?;
        let mut live = Self {
            env: Env::new(layout, &WorldConfig::default())?,
            actor: policy.actor().map_err(|error| Error::Policy(error.into()))?,
            observation: vec![0.0; layout.n_observation()],
            action: vec![0.0; layout.n_action()],
            n_steps_since_change: 0,
            n_steps_to_success: None,
        };
        live.restart(number);
        Ok(live)
    }

    /// Returns the task and the number of arms.
    #[must_use]
    pub fn layout(&self) -> Layout {
        self.env.layout()
    }

    /// Returns the lowest and the highest goal, metres.
    #[must_use]
    pub fn goal_heights_m(&self) -> [f32; 2] {
        let [_, _, heights_m] = self.env.goal_area();
        heights_m
    }

    /// Starts again, in the start state `number`.
    pub fn restart(&mut self, number: u64) {
        self.env.reset(&mut episode_rng(SEED, number, Stream::Reset), WorldSettings::default());
        self.env.observe(&mut self.observation);
        self.note_change();
    }

    /// Executes one action of the policy.
    ///
    /// # Errors
    /// If the physics produces a number that is not finite; the world must then be started again.
    pub fn step(&mut self) -> Result<(), Error> {
        self.actor.act(&self.observation, self.env.goal(), &mut self.action);
        self.env.step(&self.action)?;
        self.env.observe(&mut self.observation);
        self.n_steps_since_change += 1;
        if self.is_success() && self.n_steps_to_success.is_none() {
            self.n_steps_to_success = Some(self.n_steps_since_change);
        }
        Ok(())
    }

    /// Moves an arm's goal to `point`, world frame, metres, or to the nearest place where episodes have goals.
    pub fn move_goal(&mut self, arm: ArmIndex, point: Point) {
        let before = self.env.goal().to_vec();
        self.env.move_goal(arm, point);
        if before != self.env.goal() {
            self.note_change();
        }
    }

    /// Returns a snapshot of all bodies and of the goals, world frame.
    #[must_use]
    pub fn scene(&self) -> Scene {
        self.env.scene()
    }

    /// Returns the distances of the objects from their goals, metres, in arm order.
    pub fn distances_m(&self) -> impl Iterator<Item = f32> {
        let layout = self.layout();
        layout.arms().map(move |arm| {
            distance(
                &self.observation[layout.achieved_goal_of(arm)],
                &self.env.goal()[layout.goal_of(arm)],
            )
        })
    }

    /// Returns which objects are within the tolerance of their goals, in arm order.
    pub fn achieved(&self) -> impl Iterator<Item = bool> {
        self.distances_m().map(|distance_m| distance_m <= GOAL_TOLERANCE_M)
    }

    /// Returns whether every object is within the tolerance of its goal.
    #[must_use]
    pub fn is_success(&self) -> bool {
        is_success(self.layout(), &self.observation, self.env.goal())
    }

    /// Returns whether every object is where the policy has learned to act: on or above the table, in or near the area
    /// of its arm's goals.
    #[must_use]
    pub fn is_in_reach(&self) -> bool {
        const MARGIN_M: f32 = 0.08;
        let (layout, area) = (self.layout(), self.env.goal_area());
        layout.arms().all(|arm| {
            let object = &self.observation[layout.achieved_goal_of(arm)];
            let mut axes = object.iter().zip(area);
            axes.all(|(x, [low, high])| (low - MARGIN_M..=high + MARGIN_M).contains(x))
        })
    }

    /// Returns the number of control steps since a goal was moved or the world was started.
    #[must_use]
    pub const fn n_steps_since_change(&self) -> u32 {
        self.n_steps_since_change
    }

    /// Returns the number of control steps from then to the first success, if there was one.
    #[must_use]
    pub const fn n_steps_to_success(&self) -> Option<u32> {
        self.n_steps_to_success
    }

    fn note_change(&mut self) {
        self.n_steps_since_change = 0;
        self.n_steps_to_success = None;
    }
}
