//! The interfaces that a rollout uses, so that it cannot distinguish a network from a test.

use tandem_core::rng::{Stream, episode_rng};
use tandem_core::scene::Scene;
use tandem_core::work::EpisodeStart;
use tandem_core::{Contacts, StepAdvice, StepQuery};
use tandem_policy::{Actor, BlindActor};
use tandem_sim::{Env, SimError};

/// A source of actions, such as an actor network.
pub trait Act {
    /// Writes the actions for n observations.
    ///
    /// Shapes: `observations` `[n, n_observation]`, `goals` `[n, n_goal]`, `actions` `[n, n_action]`; actions are
    /// in [-1, 1].
    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]);

    /// Returns true if an advised student that acts `action`, shape `[n_action]`, is to ask the teacher. Shapes:
    /// `observation` `[n_observation]`, `goal` `[n_goal]`.
    fn asks(&mut self, _observation: &[f32], _goal: &[f32], _action: &[f32]) -> bool {
        true
    }
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

    /// Returns the units of the budget that were left after the latest advice; `None` if that is unknown.
    fn budget_left(&self) -> Option<u64> {
        None
    }
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

/// Environments in which the episodes of a slot are played in lock step, one episode in each; n is their number.
pub trait Environment {
    /// Starts the episodes of `starts`, each independent of all others, and writes the first observations, shape
    /// `[n, n_observation]`, and the goals, shape `[n, n_goal]`.
    ///
    /// # Errors
    /// When the environments can no longer be used.
    fn reset(
        &mut self,
        starts: &[EpisodeStart],
        observations: &mut [f32],
        goals: &mut [f32],
    ) -> Result<(), EnvironmentError>;

    /// Executes `actions`, shape `[n, n_action]`, and writes the next observations, shape `[n, n_observation]`, and the
    /// contacts during this step, shape `[n]`.
    ///
    /// # Errors
    /// When the state of an environment is no longer finite, or the environments can no longer be used.
    fn step(
        &mut self,
        actions: &[f32],
        observations: &mut [f32],
        contacts: &mut [Contacts],
    ) -> Result<(), EnvironmentError>;

    /// Returns the number of steps of the current episode of environment `environment`, from 0, in which the link
    /// avoidance limited the motion of an arm; `None` if it is not counted.
    fn avoidance_steps(&self, _environment: usize) -> Option<u32> {
        None
    }

    /// Returns the bodies of environment `environment`, from 0, at this moment; `None` if they are unknown.
    fn scene(&self, environment: usize) -> Option<Scene>;
}

/// An error of environments.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum EnvironmentError {
    /// A step failed.
    #[error("environment {environment} failed")]
    Step {
        /// The index of the environment.
        environment: usize,
        /// The cause.
        source: SimError,
    },
    /// The server of the environments has failed, or the worker is stopping.
    #[error("the environments can no longer be used")]
    Gone,
}

/// Simulated environments in this process.
#[derive(Clone)]
pub struct Simulator {
    prototype: Env,
    environments: Vec<Env>,
}

impl Simulator {
    /// Creates environments that behave as `prototype` does.
    #[must_use]
    pub const fn new(prototype: Env) -> Self {
        Self { prototype, environments: Vec::new() }
    }
}

impl Environment for Simulator {
    fn reset(
        &mut self,
        starts: &[EpisodeStart],
        observations: &mut [f32],
        goals: &mut [f32],
    ) -> Result<(), EnvironmentError> {
        let layout = self.prototype.layout();
        self.environments.resize_with(starts.len(), || self.prototype.clone());
        let observations = observations.chunks_exact_mut(layout.n_observation());
        let rows = observations.zip(goals.chunks_exact_mut(layout.n_goal()));
        for ((env, start), (observation, goal)) in
            self.environments.iter_mut().zip(starts).zip(rows)
        {
            let mut rng = episode_rng(start.seed, start.number, Stream::Reset);
            env.reset(&mut rng, start.world.for_kind(start.kind));
            env.observe(observation);
            goal.copy_from_slice(env.goal());
        }
        Ok(())
    }

    fn step(
        &mut self,
        actions: &[f32],
        observations: &mut [f32],
        contacts: &mut [Contacts],
    ) -> Result<(), EnvironmentError> {
        let layout = self.prototype.layout();
        let actions = actions.chunks_exact(layout.n_action());
        let rows = actions.zip(observations.chunks_exact_mut(layout.n_observation()));
        let environments = self.environments.iter_mut().zip(contacts).enumerate();
        for ((environment, (env, contacts)), (action, observation)) in environments.zip(rows) {
            let failed = |source| EnvironmentError::Step { environment, source };
            *contacts = env.step(action).map_err(failed)?;
            env.observe(observation);
        }
        Ok(())
    }

    fn scene(&self, environment: usize) -> Option<Scene> {
        self.environments.get(environment).map(Env::scene)
    }
}

impl Act for BlindActor {
    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        self.act(observations, goals, actions);
    }
}

impl Act for Actor {
    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        self.act(observations, goals, actions);
    }

    fn asks(&mut self, observation: &[f32], goal: &[f32], action: &[f32]) -> bool {
        self.asks(observation, goal, action)
    }
}
