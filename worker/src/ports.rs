//! What a rollout needs from outside, so that it cannot tell a network from a test.

use tandem_core::rng::{Stream, episode_rng};
use tandem_core::work::EpisodeOrder;
use tandem_core::{Contacts, StepAdvice, StepQuery, WorldSettings};
use tandem_policy::Actor;
use tandem_sim::{Env, SimError};

/// Chooses actions.
pub trait Act {
    /// Writes what is to be done for each of n observations.
    ///
    /// Shapes: `observations` `[n, n_observation]`, `goals` `[n, n_goal]`, `actions` `[n, n_action]`; actions are
    /// in [−1, 1].
    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]);
}

/// Answers for a teacher.
pub trait Advisor {
    /// The teacher's verdict on each of the steps, in their order.
    ///
    /// Returns only with the whole answer: a teacher that is away is waited for.
    ///
    /// # Errors
    /// When no answer will come any more, because the worker is stopping.
    fn advise(&mut self, queries: Vec<StepQuery>) -> Result<Vec<StepAdvice>, AdvisorGone>;
}

/// No answer will come any more.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the teacher can no longer be asked, the worker is stopping")]
pub struct AdvisorGone;

/// The advisor of those who ask nobody: evaluations and runs without a teacher.
#[derive(Debug, Clone, Copy)]
pub struct NoAdvisor;

impl Advisor for NoAdvisor {
    fn advise(&mut self, _queries: Vec<StepQuery>) -> Result<Vec<StepAdvice>, AdvisorGone> {
        Err(AdvisorGone)
    }
}

/// A world in which an episode is played. A clone plays the same episodes.
pub trait World: Clone {
    /// Puts the world into the start state of an episode; what was played before has no influence on it.
    fn reset(&mut self, order: EpisodeOrder, settings: WorldSettings);

    /// Writes the observation, shape `[n_observation]`.
    fn observe(&self, observation: &mut [f32]);

    /// Where the objects shall be, shape `[n_goal]`.
    fn goal(&self) -> &[f32];

    /// Executes an action, shape `[n_action]`, and tells what touched what meanwhile.
    ///
    /// # Errors
    /// When the state is no longer finite.
    fn step(&mut self, action: &[f32]) -> Result<Contacts, SimError>;
}

impl World for Env {
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
