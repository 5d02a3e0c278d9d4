//! Replays: a logged episode is simulated again and compared with its log, bit for bit.

use tandem_core::{Contacts, TaskSpec};
use tandem_telemetry::{EpisodeLog, LoggedTransition};

use crate::config::EnvironmentConfig;
use crate::environment::{EnvironmentClient, Failure};
use crate::record::{RecordError, rewards_per_arm, start_of, world_of};

/// Simulates a log's actions again and compares observations, goals, contacts and rewards with the log, bit for bit. A
/// truncated log is compared up to its end.
///
/// # Errors
/// [`RecordError::Differs`] with the first value that differs, [`RecordError::NoSimulator`] if the task is not
/// built-in. Other errors mean that the log's world cannot be built or simulated.
pub fn replay_log(log: &EpisodeLog) -> Result<(), RecordError> {
    let comparison = Comparison::of(log)?;
    let mut world = world_of(&log.metadata)?;
    let mut observation = vec![0.0; comparison.task.n_observation()];
    world.observe(&mut observation);
    for (step_idx, logged) in log.transitions.iter().enumerate() {
        comparison.check_before(step_idx, &observation, world.goal())?;
        let contacts = world.step(&logged.action)?;
        world.observe(&mut observation);
        comparison.check_after(step_idx, &observation, contacts)?;
    }
    comparison.check_last_observation(&observation)
}

/// As [`replay_log`], in an environment of the server of `config`. The episode is played again if the server fails,
/// with the number of attempts of `config`.
///
/// # Errors
/// As [`replay_log`], and [`RecordError::Environment`] if the server serves another task, or cannot be used.
pub async fn replay_log_on(config: EnvironmentConfig, log: &EpisodeLog) -> Result<(), RecordError> {
    let environment = |error| RecordError::Environment(Box::new(error));
    let comparison = Comparison::of(log)?;
    let mut environments = EnvironmentClient::new(config);
    environments.check(comparison.task).await.map_err(environment)?;
    loop {
        match comparison.play_on(&mut environments).await {
            Ok(()) => return Ok(()),
            Err(PlayError::Record(error)) => return Err(error),
            Err(PlayError::Server(failure)) => {
                environments.recover(failure).await.map_err(environment)?;
            }
        }
    }
}

/// An error of an episode on a server.
enum PlayError {
    Record(RecordError),
    Server(Failure),
}

impl From<RecordError> for PlayError {
    fn from(error: RecordError) -> Self {
        Self::Record(error)
    }
}

impl From<Failure> for PlayError {
    fn from(failure: Failure) -> Self {
        Self::Server(failure)
    }
}

/// The comparison of a log with the same episode, simulated again.
#[derive(Clone, Copy)]
struct Comparison<'a> {
    log: &'a EpisodeLog,
    task: &'a TaskSpec,
}

impl<'a> Comparison<'a> {
    fn of(log: &'a EpisodeLog) -> Result<Self, RecordError> {
        if log.transitions.is_empty() {
            return Err(RecordError::NoSteps);
        }
        Ok(Self { log, task: &log.metadata.task })
    }

    async fn play_on(self, environments: &mut EnvironmentClient) -> Result<(), PlayError> {
        let start = start_of(&self.log.metadata)?;
        let reset = environments.reset(&[start], self.task).await?;
        let mut observation = reset.observations;
        for (step_idx, logged) in self.log.transitions.iter().enumerate() {
            self.check_before(step_idx, &observation, &reset.goals)?;
            let reply = environments.step(&logged.action, self.task).await?;
            let contacts = reply.contacts.first().copied().unwrap_or(Contacts::NONE);
            observation = reply.observations;
            self.check_after(step_idx, &observation, contacts)?;
        }
        Ok(self.check_last_observation(&observation)?)
    }

    /// Compares the observation before a step and the goal.
    fn check_before(
        self,
        step_idx: usize,
        observation: &[f32],
        goal: &[f32],
    ) -> Result<(), RecordError> {
        let logged = &self.log.transitions[step_idx];
        compare(step_idx, "observation", &logged.observation, observation)?;
        compare(step_idx, "goal", &logged.goal, goal)
    }

    /// Compares contacts and rewards of a step before `observation`.
    fn check_after(
        self,
        step_idx: usize,
        observation: &[f32],
        contacts: Contacts,
    ) -> Result<(), RecordError> {
        let logged = &self.log.transitions[step_idx];
        let [logged_contacts, contacts] = [logged.contacts, contacts].map(|c| [c.bits().into()]);
        compare(step_idx, "contacts", &logged_contacts, &contacts)?;
        self.check_rewards(step_idx, logged, observation)
    }

    fn check_rewards(
        self,
        step_idx: usize,
        logged: &LoggedTransition,
        observation: &[f32],
    ) -> Result<(), RecordError> {
        let achieved: Vec<f32> = self.task.achieved_goal(observation).collect();
        let reward = self.task.sparse_reward(&achieved, &logged.goal);
        compare(step_idx, "reward", &[logged.reward], &[reward])?;
        let played = rewards_per_arm(self.task, observation, &logged.goal);
        compare(step_idx, "rewards_per_arm", &logged.rewards_per_arm, &played)
    }

    fn check_last_observation(self, observation: &[f32]) -> Result<(), RecordError> {
        let n_steps = self.log.transitions.len();
        self.log.last_observation.as_deref().map_or(Ok(()), |last_observation| {
            compare(n_steps, "observation", last_observation, observation)
        })
    }
}

fn compare(
    step: usize,
    field: &'static str,
    logged: &[f32],
    played: &[f32],
) -> Result<(), RecordError> {
    let pairs = logged.iter().zip(played).enumerate();
    let mut different = pairs.filter(|(_, (logged, played))| logged.to_bits() != played.to_bits());
    different.next().map_or(Ok(()), |(component, (logged, played))| {
        Err(RecordError::Differs { step, field, component, logged: *logged, played: *played })
    })
}
