//! The interfaces that a rollout uses, so that it cannot distinguish a network from a test.

use tandem_core::rng::{Stream, episode_rng};
use tandem_core::work::EpisodeOrder;
use tandem_core::{Contacts, StepAdvice, StepQuery, WorldSettings};
use tandem_policy::Actor;
use tandem_sim::{Env, SimError};

/// A source of actions, such as an actor network.
pub trait Act {
    /// Writes the actions for n observations.
    ///
    /// Shapes: `observations` `[n, n_observation]`, `goals` `[n, n_goal]`, `actions` `[n, n_action]`; actions are
    /// in [-1, 1].
    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]);
}

/// A source of advice, such as a connection to a teacher.
pub trait Advisor {
    /// Returns the teacher's advice on each of `queries`, in their order.
    ///
    /// Blocks until the teacher has answered, even if it is away.
    ///
    /// # Errors
    /// When the worker is stopping and the teacher can no longer be asked.
    fn advise(&mut self, queries: Vec<StepQuery>) -> Result<Vec<StepAdvice>, AdvisorGone>;
}

/// The error of an advisor that can no longer ask the teacher.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the teacher can no longer be asked, the worker is stopping")]
pub struct AdvisorGone;

/// The advisor of evaluations and of runs without a teacher, which never ask for advice. Every request is an error.
#[derive(Debug, Clone, Copy)]
pub struct NoAdvisor;

impl Advisor for NoAdvisor {
    fn advise(&mut self, _queries: Vec<StepQuery>) -> Result<Vec<StepAdvice>, AdvisorGone> {
        Err(AdvisorGone)
    }
}

/// An environment in which episodes are played. A clone behaves identically.
pub trait Environment: Clone {
    /// Resets the environment to the start of an episode, independent of the episodes before it.
    fn reset(&mut self, order: EpisodeOrder, settings: WorldSettings);

    /// Writes the observation, shape `[n_observation]`.
    fn observe(&self, observation: &mut [f32]);

    /// Returns the goal, shape `[n_goal]`: a target position for each object, in metres.
    fn goal(&self) -> &[f32];

    /// Executes an action, shape `[n_action]`, and returns the contacts during this step.
    ///
    /// # Errors
    /// When the state is no longer finite.
    fn step(&mut self, action: &[f32]) -> Result<Contacts, SimError>;
}

impl Environment for Env {
    fn reset(&mut self, order: EpisodeOrder, settings: WorldSettings) {
        self.reset(&mut episode_rng(order.seed, order.number, Stream::Reset), settings);
    }

    fn observe(&self, observation: &mut [f32]) {
        self.observe(observation);
    }

    fn goal(&self) -> &[f32] {
        self.goal()
    }

    fn step(&mut self, action: &[f32]) -> Result<Contacts, SimError> {
        self.step(action)
    }
}

impl Act for Actor {
    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        self.act(observations, goals, actions);
    }
}
