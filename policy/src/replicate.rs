//! A policy for several arms that consists of copies of a one-arm policy.

use std::collections::BTreeMap;

use tandem_core::task::Part;
use tandem_core::{ArmIndex, TaskSpec};

use crate::mlp::MlpShape;
use crate::normalizer::NormalizerSnapshot;
use crate::policy::Policy;

impl Policy {
    /// Creates a policy for `task` in which each arm acts, and is valued, as by this one-arm policy.
    ///
    /// The networks are wider by the number of arms and block-diagonal, and the critic has one head per arm. The
    /// metadata is empty.
    ///
    /// # Panics
    /// If this policy has several arms or critic heads, its task is not the [one-arm task](TaskSpec::single_arm) of
    /// `task`, or a vector has the wrong length; see [`Policy::check`].
    #[must_use]
    pub fn replicated(&self, task: &TaskSpec) -> Self {
        assert_eq!(
            (self.task.n_arms(), self.n_heads),
            (1, 1),
            "only a one-arm policy can be copied"
        );
        let of_one_arm = task.single_arm();
        let is_same = of_one_arm.is_some_and(|one| one.difference(&self.task).is_none());
        assert!(is_same, "arms of another task");
        let n_arms = task.n_arms();
        let (n_hidden, n_heads) = (self.n_hidden * n_arms, n_arms);
        let actor_shape = MlpShape::actor(task, n_hidden, self.n_hidden_layers);
        let critic_shape = MlpShape::critic(task, n_hidden, self.n_hidden_layers, n_heads);
        let mut actor = vec![0.0; actor_shape.n_parameters()];
        let mut critic = vec![0.0; critic_shape.n_parameters()];
        for arm in task.arms() {
            let first_hidden = arm.0 * self.n_hidden;
            let inputs = state_columns(task, arm);
            let actions: Vec<usize> = task.action_of(arm).iter().collect();
            let n_state = task.n_observation() + task.n_goal();
            let joined: Vec<usize> =
                inputs.iter().copied().chain(actions.iter().map(|i| n_state + i)).collect();
            let block = Block { first_hidden, inputs: &inputs, outputs: &actions };
            block.write(&self.actor_shape(), &self.actor, &actor_shape, &mut actor);
            let block = Block { first_hidden, inputs: &joined, outputs: &[arm.0] };
            block.write(&self.critic_shape(), &self.critic, &critic_shape, &mut critic);
        }
        let observations = task.arms().map(|arm| task.observation_of(arm));
        let goals = task.arms().map(|arm| task.goal_of(arm));
        Self {
            task: task.clone(),
            n_hidden,
            n_hidden_layers: self.n_hidden_layers,
            n_heads,
            actor,
            critic,
            observation_normalizer: repeated(&self.observation_normalizer, observations),
            goal_normalizer: repeated(&self.goal_normalizer, goals),
            metadata: BTreeMap::new(),
        }
    }
}

/// Returns the indices of `arm`'s numbers in the concatenation of observation and goal.
fn state_columns(task: &TaskSpec, arm: ArmIndex) -> Vec<usize> {
    let goals = task.goal_of(arm).iter().map(|i| task.n_observation() + i);
    task.observation_of(arm).iter().chain(goals).collect()
}

/// The place of a network in one that is wider.
struct Block<'a> {
    /// Its first unit in each hidden layer.
    first_hidden: usize,
    /// The columns of its inputs in the first layer.
    inputs: &'a [usize],
    /// The rows of its outputs in the last layer.
    outputs: &'a [usize],
}

impl Block<'_> {
    /// Writes the parameters `source` of a network of shape `source_shape` into those of the wider one.
    fn write(
        &self,
        source_shape: &MlpShape,
        source: &[f32],
        shape: &MlpShape,
        parameters: &mut [f32],
    ) {
        let hidden: Vec<usize> =
            (self.first_hidden..self.first_hidden + source_shape.n_hidden).collect();
        for layer in 0..shape.n_layers() {
            let columns = if layer == 0 { self.inputs } else { &hidden };
            let rows = if layer == shape.n_hidden_layers { self.outputs } else { &hidden };
            let (weight, bias) = (shape.weight(layer), shape.bias(layer));
            let source_rows = source[source_shape.weight(layer)].chunks_exact(columns.len());
            let source_biases = &source[source_shape.bias(layer)];
            for ((row, numbers), offset) in rows.iter().zip(source_rows).zip(source_biases) {
                let start = weight.start + row * shape.layer_input(layer);
                for (column, number) in columns.iter().zip(numbers) {
                    parameters[start + column] = *number;
                }
                parameters[bias.start + row] = *offset;
            }
        }
    }
}

/// Repeats the statistics of one arm for each of `parts`, which cover a vector.
fn repeated<'a>(
    one: &NormalizerSnapshot,
    parts: impl ExactSizeIterator<Item = &'a Part>,
) -> NormalizerSnapshot {
    let n = one.mean.len() * parts.len();
    let mut all = NormalizerSnapshot { mean: vec![0.0; n], std: vec![1.0; n] };
    for part in parts {
        part.write(&mut all.mean, &one.mean);
        part.write(&mut all.std, &one.std);
    }
    all
}

#[cfg(test)]
mod tests {
    use tandem_core::rng::uniform;
    use tandem_core::{Layout, Stream, Task, episode_rng};

    use super::*;

    const LAYOUT: Layout = Layout::new(Task::PickAndPlace, 1);

    fn one_arm() -> Policy {
        let (n_hidden, n_hidden_layers) = (9, 2);
        let mut rng = episode_rng(5, 0, Stream::Initialisation);
        let mut draw = |n: usize, low: f32, high: f32| -> Vec<f32> {
            (0..n).map(|_| uniform(&mut rng, low, high)).collect()
        };
        let actor = MlpShape::actor(LAYOUT, n_hidden, n_hidden_layers).n_parameters();
        let critic = MlpShape::critic(LAYOUT, n_hidden, n_hidden_layers, 1).n_parameters();
        let (n_observation, n_goal) = (LAYOUT.n_observation(), LAYOUT.n_goal());
        Policy {
            task: LAYOUT.into(),
            n_hidden,
            n_hidden_layers,
            n_heads: 1,
            actor: draw(actor, -0.5, 0.5),
            critic: draw(critic, -0.5, 0.5),
            observation_normalizer: NormalizerSnapshot {
                mean: draw(n_observation, -0.2, 0.2),
                std: draw(n_observation, 0.5, 2.0),
            },
            goal_normalizer: NormalizerSnapshot {
                mean: draw(n_goal, -0.2, 0.2),
                std: draw(n_goal, 0.5, 2.0),
            },
            metadata: BTreeMap::new(),
        }
    }

    /// Two arms whose numbers are interleaved in every vector.
    fn interleaved() -> TaskSpec {
        let concatenated = Layout::new(Task::PickAndPlace, 2).description();
        let every_other = |arm_idx: usize, n: usize| (0..n).map(|i| 2 * i + arm_idx).collect();
        let mut description = concatenated.clone();
        description.name = "interleaved".to_owned();
        for (arm_idx, arm) in description.arms.iter_mut().enumerate() {
            arm.observation = every_other(arm_idx, 28);
            arm.goal = every_other(arm_idx, 3);
            arm.action = every_other(arm_idx, 4);
            arm.position = Vec::new();
        }
        description.achieved_goal = (0..6).map(|i| 6 + i).collect();
        let bound = |idx: usize| concatenated.observation_bound[idx / 2];
        description.observation_bound = (0..56).map(bound).collect();
        TaskSpec::new(description).unwrap()
    }

    #[test]
    fn each_arm_acts_and_is_valued_as_by_the_one_arm_policy() {
        let one = one_arm();
        check_copies(&one, &Layout::new(Task::PickAndPlace, 2).into());
        let task = interleaved();
        check_copies(&Policy { task: task.single_arm().unwrap(), ..one }, &task);
    }

    fn check_copies(one: &Policy, task: &TaskSpec) {
        let both = one.replicated(task);
        both.check().unwrap();
        let mut rng = episode_rng(6, 0, Stream::Initialisation);
        let mut draw = |n: usize| (0..n).map(|_| uniform(&mut rng, -1.0, 1.0)).collect::<Vec<_>>();
        let (observation, goal) = (draw(task.n_observation()), draw(task.n_goal()));
        let actions_taken = draw(task.n_action());

        let (mut acting, mut valuing) = (both.actor().unwrap(), both.critic().unwrap());
        let mut actions = vec![0.0; task.n_action()];
        acting.act(&observation, &goal, &mut actions);
        let mut values = vec![0.0; 2];
        valuing.q(&observation, &goal, &actions_taken, &mut values);
        for arm in task.arms() {
            let observation = task.observation_of(arm).of(&observation);
            let goal = task.goal_of(arm).of(&goal);
            let mut action = vec![0.0; LAYOUT.n_action()];
            one.actor().unwrap().act(&observation, &goal, &mut action);
            let mut value = vec![0.0];
            let alone = task.action_of(arm).of(&actions_taken);
            one.critic().unwrap().q(&observation, &goal, &alone, &mut value);
            for (got, expected) in task.action_of(arm).of(&actions).iter().zip(&action) {
                assert!((got - expected).abs() < 1e-5, "arm {arm:?}: {got} against {expected}");
            }
            let got = values[arm.0];
            assert!((got - value[0]).abs() < 1e-5, "arm {arm:?}: {got} against {}", value[0]);
        }
    }
}
