//! Actor and critic for inference on a few observations at a time.

use tandem_core::TaskSpec;
use tandem_core::work::PublishedActor;

use crate::elementwise::tanh;
use crate::error::Error;
use crate::mlp::MlpShape;
use crate::normalizer::NormalizerSnapshot;
use crate::packed::{MAX_ROWS, PackedMlp};
use crate::validation::{check_network_size, check_normalizer, check_parameters};

mod gate;

pub use gate::QueryGate;

/// Normalisation of observations and goals for the input of a network.
#[derive(Debug, Clone)]
struct Inputs {
    task: TaskSpec,
    observation: NormalizerSnapshot,
    goal: NormalizerSnapshot,
}

impl Inputs {
    fn new(
        task: TaskSpec,
        observation: NormalizerSnapshot,
        goal: NormalizerSnapshot,
    ) -> Result<Self, Error> {
        check_normalizer(
            ["observation mean", "observation std"],
            &observation,
            task.n_observation(),
        )?;
        check_normalizer(["goal mean", "goal std"], &goal, task.n_goal())?;
        Ok(Self { task, observation, goal })
    }

    /// Returns the number of rows of `observations` and `goals`.
    fn n_rows(&self, observations: &[f32], goals: &[f32]) -> usize {
        let n_rows = observations.len() / self.task.n_observation();
        let expected = (n_rows * self.task.n_observation(), n_rows * self.task.n_goal());
        assert_eq!(
            (observations.len(), goals.len()),
            expected,
            "observations and goals of another task"
        );
        n_rows
    }

    /// Writes row `row_idx` of `observations` and `goals`, normalised, to the start of `input`.
    fn write(&self, observations: &[f32], goals: &[f32], row_idx: usize, input: &mut [f32]) {
        let (n_observation, n_goal) = (self.task.n_observation(), self.task.n_goal());
        let (observation, rest) = input.split_at_mut(n_observation);
        self.observation
            .normalize(&observations[row_idx * n_observation..][..n_observation], observation);
        self.goal.normalize(&goals[row_idx * n_goal..][..n_goal], &mut rest[..n_goal]);
    }
}

/// An actor `π(s, g)`, which chooses actions: a network of shape [`MlpShape::actor`] over normalised observation and
/// goal, followed by tanh.
///
/// The action for an observation has the same bits in any batch, and on every machine with fused multiply-add.
#[derive(Debug, Clone)]
pub struct Actor {
    version: u64,
    gate: Option<QueryGate>,
    inputs: Inputs,
    network: PackedMlp,
}

impl Actor {
    /// Creates an actor, with its gate if there is one, from parameters that a learner published.
    ///
    /// # Errors
    /// Returns an error if a size is out of range, a vector does not have the length that follows from `task` and the
    /// sizes, a number is not finite, or a standard deviation is not above 0.
    pub fn new(task: impl Into<TaskSpec>, published: PublishedActor) -> Result<Self, Error> {
        let task = task.into();
        let gate = QueryGate::new(&task, &published)?;
        let PublishedActor { version, n_hidden, n_hidden_layers, actor, .. } = published;
        check_network_size(n_hidden, n_hidden_layers)?;
        let shape = MlpShape::actor(&task, n_hidden, n_hidden_layers);
        check_parameters("actor", &actor, shape.n_parameters())?;
        let observation =
            NormalizerSnapshot { mean: published.observation_mean, std: published.observation_std };
        let goal = NormalizerSnapshot { mean: published.goal_mean, std: published.goal_std };
        let inputs = Inputs::new(task, observation, goal)?;
        Ok(Self { version, gate, inputs, network: PackedMlp::new(&shape, &actor) })
    }

    /// Returns the version under which the parameters were published.
    #[must_use]
    pub const fn version(&self) -> u64 {
        self.version
    }

    /// Returns the task.
    #[must_use]
    pub const fn task(&self) -> &TaskSpec {
        &self.inputs.task
    }

    /// Returns true if a student that acts `action`, shape `[n_action]`, is to ask for advice: always without a
    /// [gate](QueryGate). Shapes: `observation` `[n_observation]`, `goal` `[n_goal]`.
    ///
    /// # Panics
    /// If the lengths do not match the task.
    pub fn asks(&mut self, observation: &[f32], goal: &[f32], action: &[f32]) -> bool {
        self.gate.as_mut().is_none_or(|gate| gate.asks(observation, goal, action))
    }

    /// Writes the actions, in [−1, 1], shape `[n, n_action]`, for `observations`, shape `[n, n_observation]`, and
    /// `goals`, shape `[n, n_goal]`.
    ///
    /// # Panics
    /// If the lengths do not match the task or each other.
    pub fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        let n_rows = self.inputs.n_rows(observations, goals);
        let n_action = self.inputs.task.n_action();
        assert_eq!(actions.len(), n_rows * n_action, "actions of another task");
        for first in (0..n_rows).step_by(MAX_ROWS) {
            let n_now = MAX_ROWS.min(n_rows - first);
            for row in 0..n_now {
                self.inputs.write(observations, goals, first + row, self.network.input_row(row));
            }
            self.network.run(n_now);
            for (row, action) in
                actions[first * n_action..].chunks_exact_mut(n_action).take(n_now).enumerate()
            {
                for (component, raw) in action.iter_mut().zip(self.network.output_row(row)) {
                    *component = tanh(*raw);
                }
            }
        }
    }
}

/// A critic `Q(s, g, a)`, which estimates the expected discounted return of actions (equation 2 of the paper), one
/// number per head, in units of reward: a network of shape [`MlpShape::critic`].
///
/// As for [`Actor`], the bits of a row do not depend on the batch.
#[derive(Debug, Clone)]
pub struct Critic {
    n_heads: usize,
    inputs: Inputs,
    network: PackedMlp,
}

impl Critic {
    /// Creates a critic from `parameters`, shape `[n_parameters]` of `shape`, with the normalisation of its inputs.
    ///
    /// # Errors
    /// Returns an error if a size is out of range, the input of `shape` or the length of a vector does not match
    /// `task`, a number is not finite, or a standard deviation is not above 0.
    pub fn new(
        task: impl Into<TaskSpec>,
        shape: &MlpShape,
        parameters: &[f32],
        observation: NormalizerSnapshot,
        goal: NormalizerSnapshot,
    ) -> Result<Self, Error> {
        let task = task.into();
        check_network_size(shape.n_hidden, shape.n_hidden_layers)?;
        let fitting =
            MlpShape::critic(&task, shape.n_hidden, shape.n_hidden_layers, shape.n_output);
        if fitting.n_input != shape.n_input {
            return Err(Error::WrongLength {
                name: "critic input",
                got: shape.n_input,
                expected: fitting.n_input,
            });
        }
        check_parameters("critic", parameters, shape.n_parameters())?;
        let inputs = Inputs::new(task, observation, goal)?;
        Ok(Self { n_heads: shape.n_output, inputs, network: PackedMlp::new(shape, parameters) })
    }

    /// Returns the number of values per action: 1, or one per arm.
    #[must_use]
    pub const fn n_heads(&self) -> usize {
        self.n_heads
    }

    /// Writes the values, shape `[n, n_heads]`, of `actions`, shape `[n, n_action]`, for `observations`, shape
    /// `[n, n_observation]`, and `goals`, shape `[n, n_goal]`.
    ///
    /// # Panics
    /// If the lengths do not match the task or each other.
    pub fn q(&mut self, observations: &[f32], goals: &[f32], actions: &[f32], q: &mut [f32]) {
        let n_rows = self.inputs.n_rows(observations, goals);
        let (n_action, n_heads) = (self.inputs.task.n_action(), self.n_heads);
        let expected = (n_rows * n_action, n_rows * n_heads);
        assert_eq!((actions.len(), q.len()), expected, "actions or values of another task");
        for first in (0..n_rows).step_by(MAX_ROWS) {
            let n_now = MAX_ROWS.min(n_rows - first);
            for row in 0..n_now {
                let input = self.network.input_row(row);
                self.inputs.write(observations, goals, first + row, input);
                let action_start = input.len() - n_action;
                input[action_start..]
                    .copy_from_slice(&actions[(first + row) * n_action..][..n_action]);
            }
            self.network.run(n_now);
            for (row, q) in q[first * n_heads..].chunks_exact_mut(n_heads).take(n_now).enumerate() {
                q.copy_from_slice(self.network.output_row(row));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::rng::uniform;
    use tandem_core::{Layout, Stream, Task, TaskSpec, episode_rng};

    use super::*;
    use crate::policy::Policy;

    const N_ROWS: usize = 70;

    fn inputs(task: &TaskSpec) -> [Vec<f32>; 3] {
        let mut rng = episode_rng(5, 0, Stream::Reset);
        [task.n_observation(), task.n_goal(), task.n_action()]
            .map(|n| (0..N_ROWS * n).map(|_| uniform(&mut rng, -1.0, 1.0)).collect())
    }

    #[test]
    fn a_batch_gives_the_same_bits_as_its_rows_one_by_one() {
        let policy = Policy::sample(Layout::new(Task::PickAndPlace, 2), 2);
        let task = &policy.task;
        let (n_observation, n_goal, n_action) =
            (task.n_observation(), task.n_goal(), task.n_action());
        let [observations, goals, _] = inputs(task);
        let (mut actor, mut critic) = (policy.actor().unwrap(), policy.critic().unwrap());
        let (mut actions, mut q) = (vec![0.0; N_ROWS * n_action], vec![0.0; N_ROWS * 2]);
        actor.act(&observations, &goals, &mut actions);
        critic.q(&observations, &goals, &actions, &mut q);
        for row in 0..N_ROWS {
            let (observation, goal) = (
                &observations[row * n_observation..][..n_observation],
                &goals[row * n_goal..][..n_goal],
            );
            let (mut action, mut values) = (vec![0.0; n_action], [0.0; 2]);
            actor.act(observation, goal, &mut action);
            critic.q(observation, goal, &action, &mut values);
            assert_eq!(action, actions[row * n_action..][..n_action], "action of row {row}");
            assert_eq!(values, q[row * 2..][..2], "values of row {row}");
        }
        assert!(actions.iter().all(|component| component.abs() <= 1.0));
        assert!(q.chunks(2).any(|values| values[0] != values[1]), "the heads differ");
    }

    #[test]
    fn a_value_depends_on_its_own_action_only() {
        let policy = Policy::sample(Layout::new(Task::Push, 1), 1);
        let [observations, goals, mut actions] = inputs(&policy.task);
        let mut critic = policy.critic().unwrap();
        let (mut before, mut after) = (vec![0.0; N_ROWS], vec![0.0; N_ROWS]);
        critic.q(&observations, &goals, &actions, &mut before);
        actions[3] += 0.5;
        critic.q(&observations, &goals, &actions, &mut after);
        assert_ne!(before[1], after[1]);
        before[1] = after[1];
        assert_eq!(before, after, "no other row changed");
    }

    #[test]
    fn parameters_that_do_not_match_are_refused() {
        let policy = Policy::sample(Layout::new(Task::Push, 1), 1);
        let check = |spoil: fn(&mut PublishedActor), expected: &str| {
            let mut published = policy.published(3);
            spoil(&mut published);
            let error = Actor::new(&policy.task, published).expect_err("must be refused");
            assert_eq!(error.to_string(), expected);
        };
        check(|actor| actor.actor.truncate(2178), "actor has 2178 numbers, expected 2179");
        check(|actor| actor.n_hidden_layers = 0, "n_hidden_layers is 0, expected 1 to 64");
        check(|actor| actor.actor[7] = f32::NAN, "actor holds a number that is not finite");
        check(|actor| actor.goal_mean.push(0.0), "goal mean has 4 numbers, expected 3");
        check(
            |actor| actor.observation_std[0] = 0.0,
            "observation std holds a number that is not above 0",
        );
        assert_eq!(
            Actor::new(&policy.task, policy.published(3)).map(|actor| actor.version()).unwrap(),
            3
        );
    }
}
