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
pub trait VectorEnv {
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
    /// The steps of each environment's episode in which link avoidance limited an arm.
    avoidance_steps: Vec<u32>,
}

impl Simulator {
    /// Creates environments that behave as `prototype` does.
    #[must_use]
    pub const fn new(prototype: Env) -> Self {
        Self { prototype, environments: Vec::new(), avoidance_steps: Vec::new() }
    }
}

impl VectorEnv for Simulator {
    fn reset(
        &mut self,
        starts: &[EpisodeStart],
        observations: &mut [f32],
        goals: &mut [f32],
    ) -> Result<(), EnvironmentError> {
        let layout = self.prototype.layout();
        self.environments.resize_with(starts.len(), || self.prototype.clone());
        self.avoidance_steps = vec![0; starts.len()];
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
        let environments =
            self.environments.iter_mut().zip(contacts).zip(&mut self.avoidance_steps);
        for ((environment, ((env, contacts), avoidance_steps)), (action, observation)) in
            environments.enumerate().zip(rows)
        {
            let failed = |source| EnvironmentError::Step { environment, source };
            *contacts = env.step(action).map_err(failed)?;
            *avoidance_steps += u32::from(env.n_avoiding_substeps() > 0);
            env.observe(observation);
        }
        Ok(())
    }

    fn avoidance_steps(&self, environment: usize) -> Option<u32> {
        let has_links_to_avoid = self.prototype.layout().n_arms > 1;
        self.avoidance_steps.get(environment).copied().filter(|_| has_links_to_avoid)
    }

    fn scene(&self, environment: usize) -> Option<Scene> {
        self.environments.get(environment).map(Env::scene)
    }
}

impl Act for BlindActor {
    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        // The inherent method, which takes precedence over that of the trait.
        Self::act(self, observations, goals, actions);
    }
}

impl Act for Actor {
    // Both call the inherent methods, which take precedence over those of the trait.
    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        Self::act(self, observations, goals, actions);
    }

    fn asks(&mut self, observation: &[f32], goal: &[f32], action: &[f32]) -> bool {
        Self::asks(self, observation, goal, action)
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::{EpisodeKind, Layout, Task, WorldSettings};
    use tandem_sim::WorldConfig;

    use super::*;

    fn simulator(n_arms: usize) -> Simulator {
        let layout = Layout::new(Task::PickAndPlace, n_arms);
        Simulator::new(Env::new(layout, &WorldConfig::default()).unwrap())
    }

    fn reset(simulator: &mut Simulator) {
        let layout = simulator.prototype.layout();
        let world = WorldSettings::default();
        let start = EpisodeStart { seed: 1, number: 0, kind: EpisodeKind::Evaluation, world };
        let (mut observation, mut goal) =
            (vec![0.0; layout.n_observation()], vec![0.0; layout.n_goal()]);
        simulator.reset(&[start], &mut observation, &mut goal).unwrap();
    }

    fn step(simulator: &mut Simulator, action: &[f32]) {
        let mut observation = vec![0.0; simulator.prototype.layout().n_observation()];
        simulator.step(action, &mut observation, &mut [Contacts::NONE]).unwrap();
    }

    #[test]
    fn steps_of_link_avoidance_are_counted_per_episode() {
        let mut simulator = simulator(2);
        reset(&mut simulator);
        step(&mut simulator, &[0.0; 8]);
        assert_eq!(simulator.avoidance_steps(0), Some(0), "arms at rest avoid nothing");
        // The first arm reaches for the second one, which stays.
        let mut n_steps = 0;
        for _ in 0..40 {
            step(&mut simulator, &[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
            n_steps += u32::from(simulator.environments[0].n_avoiding_substeps() > 0);
        }
        assert!((1..40).contains(&n_steps), "limited in {n_steps} of 40 steps");
        assert_eq!(simulator.avoidance_steps(0), Some(n_steps));
        reset(&mut simulator);
        assert_eq!(simulator.avoidance_steps(0), Some(0), "every episode counts from 0");
        assert_eq!(simulator.avoidance_steps(1), None, "there is one environment");
    }

    #[test]
    fn one_arm_has_no_link_avoidance() {
        let mut simulator = simulator(1);
        reset(&mut simulator);
        step(&mut simulator, &[1.0; 4]);
        assert_eq!(simulator.avoidance_steps(0), None);
    }
}
