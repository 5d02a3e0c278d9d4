//! Policies that treat interchangeable arms alike.
//!
//! Where arms are interchangeable, the best action of a scene and that of the scene with its arms exchanged are the same
//! but for the exchange. A trained network fulfils this only approximately. The mean of what it computes for the scene
//! and, exchanged back, for the exchanged scene fulfils it exactly, and is more accurate because the errors of the two
//! differ. It is computed by one network of twice the width, so a symmetrised policy is a policy like any other.

use tandem_core::task::Part;
use tandem_core::work::PublishedActor;
use tandem_core::{ArmIndex, TaskSpec};

use crate::mlp::MlpShape;
use crate::normalizer::NormalizerSnapshot;
use crate::policy::Policy;

/// The metadata entry of a symmetrised policy, with the value 1.
const SYMMETRIZED_KEY: &str = "symmetrized";

impl Policy {
    /// Returns true if the policy was [symmetrised](Self::symmetrized).
    #[must_use]
    pub fn is_symmetrized(&self) -> bool {
        self.metadata.contains_key(SYMMETRIZED_KEY)
    }

    /// Returns the policy that treats the arms alike: its actor, before tanh, and its critic are the means of this
    /// policy's and of this policy's with the arms in reverse order. The policy itself if its arms are not
    /// interchangeable or it is symmetrised already.
    ///
    /// The networks are twice as wide. Where a normalised number is outside the range to which inputs are clipped, the
    /// reversed half differs from this policy's.
    ///
    /// # Panics
    /// If a vector has the wrong length; see [`Policy::check`].
    #[must_use]
    pub fn symmetrized(self) -> Self {
        if !self.task.has_interchangeable_arms() || self.is_symmetrized() {
            return self;
        }
        let (observation, goal) = (&self.observation_normalizer, &self.goal_normalizer);
        let inputs = reversed_inputs(&self.task, observation, goal);
        let actions = reversed(&self.task, TaskSpec::action_of, self.task.n_action());
        let n_state = inputs.len();
        let joined = inputs.iter().copied().chain(actions.iter().map(|from| Input {
            from: n_state + from,
            factor: 1.0,
            offset: 0.0,
        }));
        let joined: Vec<_> = joined.collect();
        let heads: Vec<_> = (0..self.n_heads).rev().collect();
        let actor = symmetrized(&self.actor_shape(), &self.actor, &inputs, &actions);
        let critic = symmetrized(&self.critic_shape(), &self.critic, &joined, &heads);
        let mut metadata = self.metadata;
        metadata.insert(SYMMETRIZED_KEY.to_owned(), "1".to_owned());
        Self { n_hidden: 2 * self.n_hidden, actor, critic, metadata, ..self }
    }
}

/// Returns the actor of [`Policy::symmetrized`] for a published actor of `task`, without its gate.
///
/// # Panics
/// If a vector has the wrong length; see [`Actor::new`](crate::Actor::new).
#[must_use]
pub fn symmetrized_actor(task: &TaskSpec, published: &PublishedActor) -> PublishedActor {
    let published = PublishedActor { gate: None, ..published.clone() };
    if !task.has_interchangeable_arms() {
        return published;
    }
    let normalizer =
        |mean: &[f32], std: &[f32]| NormalizerSnapshot { mean: mean.to_vec(), std: std.to_vec() };
    let observation = normalizer(&published.observation_mean, &published.observation_std);
    let goal = normalizer(&published.goal_mean, &published.goal_std);
    let inputs = reversed_inputs(task, &observation, &goal);
    let actions = reversed(task, TaskSpec::action_of, task.n_action());
    let shape = MlpShape::actor(task, published.n_hidden, published.n_hidden_layers);
    let actor = symmetrized(&shape, &published.actor, &inputs, &actions);
    PublishedActor { n_hidden: 2 * published.n_hidden, actor, ..published }
}

/// An input of a network as a function of another vector of inputs: `offset + factor * input[from]`.
#[derive(Debug, Clone, Copy)]
struct Input {
    from: usize,
    factor: f64,
    offset: f64,
}

/// Returns, for each place of a vector of `n` numbers, the place of the same number of the arm that takes its arm's place
/// when the order of the arms is reversed.
fn reversed(
    task: &TaskSpec,
    part_of: impl Fn(&TaskSpec, ArmIndex) -> &Part,
    n: usize,
) -> Vec<usize> {
    let mut places: Vec<usize> = (0..n).collect();
    let arms: Vec<_> = task.arms().collect();
    for (to, from) in arms.iter().zip(arms.iter().rev()) {
        for (to, from) in part_of(task, *to).iter().zip(part_of(task, *from).iter()) {
            places[to] = from;
        }
    }
    places
}

/// Returns the normalised inputs of the scene with its arms in reverse order, as functions of those of the scene.
fn reversed_inputs(
    task: &TaskSpec,
    observation: &NormalizerSnapshot,
    goal: &NormalizerSnapshot,
) -> Vec<Input> {
    let n_observation = task.n_observation();
    let observations = reversed(task, TaskSpec::observation_of, n_observation);
    let goals = reversed(task, TaskSpec::goal_of, task.n_goal());
    let places = observations.into_iter().chain(goals.into_iter().map(|from| n_observation + from));
    let joined = |observation: &[f32], goal: &[f32]| -> Vec<f64> {
        observation.iter().chain(goal).copied().map(f64::from).collect()
    };
    let (mean, std) = (joined(&observation.mean, &goal.mean), joined(&observation.std, &goal.std));
    let input = |(to, from): (usize, usize)| Input {
        from,
        factor: std[from] / std[to],
        offset: (mean[from] - mean[to]) / std[to],
    };
    places.enumerate().map(input).collect()
}

/// Returns the parameters of a network of twice the width of `parameters`, of shape `shape`. It computes the mean of
/// that network's outputs and of its outputs for the `inputs`, taken from the places `outputs`.
fn symmetrized(
    shape: &MlpShape,
    parameters: &[f32],
    inputs: &[Input],
    outputs: &[usize],
) -> Vec<f32> {
    mean_of(shape, [parameters, &with_ends(shape, parameters, inputs, outputs)])
}

/// Returns the parameters of a network that computes what `parameters` compute for the `inputs`, output `outputs[i]` in
/// place `i`.
#[expect(clippy::cast_possible_truncation, reason = "parameters are in single precision")]
fn with_ends(
    shape: &MlpShape,
    parameters: &[f32],
    inputs: &[Input],
    outputs: &[usize],
) -> Vec<f32> {
    let mut changed = parameters.to_vec();
    let rows = parameters[shape.weight(0)].chunks_exact(shape.n_input);
    let changed_rows = changed[shape.weight(0)].chunks_exact_mut(shape.n_input);
    let mut biases: Vec<f64> = Vec::with_capacity(shape.layer_output(0));
    for ((row, changed_row), bias) in rows.zip(changed_rows).zip(&parameters[shape.bias(0)]) {
        let mut shifted = f64::from(*bias);
        for (number, input) in row.iter().copied().map(f64::from).zip(inputs) {
            changed_row[input.from] = (number * input.factor) as f32;
            shifted += number * input.offset;
        }
        biases.push(shifted);
    }
    for (changed, bias) in changed[shape.bias(0)].iter_mut().zip(biases) {
        *changed = bias as f32;
    }
    let last = shape.n_hidden_layers;
    let (weight, bias, n_in) = (shape.weight(last), shape.bias(last), shape.layer_input(last));
    for (row, output) in outputs.iter().enumerate() {
        let source = &parameters[weight.start + output * n_in..][..n_in];
        changed[weight.start + row * n_in..][..n_in].copy_from_slice(source);
        changed[bias.start + row] = parameters[bias.start + output];
    }
    changed
}

/// Returns the parameters of a network of twice the width that computes the mean of two networks of shape `shape`.
fn mean_of(shape: &MlpShape, networks: [&[f32]; 2]) -> Vec<f32> {
    let wide = MlpShape { n_hidden: 2 * shape.n_hidden, ..*shape };
    let mut mean = vec![0.0; wide.n_parameters()];
    for (block, parameters) in networks.into_iter().enumerate() {
        for layer in 0..shape.n_layers() {
            let (n_in, n_out) = (shape.layer_input(layer), shape.layer_output(layer));
            let (first_row, share) =
                if layer == shape.n_hidden_layers { (0, 0.5) } else { (block * n_out, 1.0) };
            let first_column = if layer == 0 { 0 } else { block * n_in };
            let (weight, bias) = (wide.weight(layer), wide.bias(layer));
            for (row, numbers) in parameters[shape.weight(layer)].chunks_exact(n_in).enumerate() {
                let start = weight.start + (first_row + row) * wide.layer_input(layer);
                for (to, number) in mean[start + first_column..].iter_mut().zip(numbers) {
                    *to = share * number;
                }
            }
            let biases = mean[bias.start + first_row..].iter_mut();
            for (to, number) in biases.zip(&parameters[shape.bias(layer)]) {
                *to += share * number;
            }
        }
    }
    mean
}

#[cfg(test)]
mod tests {
    use tandem_core::rng::uniform;
    use tandem_core::{Layout, Stream, Task, episode_rng};

    use super::*;

    const LAYOUT: Layout = Layout::new(Task::SharedPickAndPlace, 2);

    /// Numbers of each arm's part of vectors, in order, for two arms.
    fn exchanged(numbers: &[f32]) -> Vec<f32> {
        let (first, second) = numbers.split_at(numbers.len() / 2);
        [second, first].concat()
    }

    struct Scene {
        observation: Vec<f32>,
        goal: Vec<f32>,
        actions: Vec<f32>,
    }

    /// Within the normalisers' clipping.
    fn scene(policy: &Policy, number: u64) -> Scene {
        let mut rng = episode_rng(3, number, Stream::Reset);
        let mut draw = |normalizer: &NormalizerSnapshot| -> Vec<f32> {
            let numbers = normalizer.mean.iter().zip(&normalizer.std);
            numbers.map(|(mean, std)| mean + std * uniform(&mut rng, -0.5, 0.5)).collect()
        };
        let (observation, goal) =
            (draw(&policy.observation_normalizer), draw(&policy.goal_normalizer));
        let actions = (0..LAYOUT.n_action()).map(|_| uniform(&mut rng, -1.0, 1.0)).collect();
        Scene { observation, goal, actions }
    }

    impl Scene {
        fn exchanged(&self) -> Self {
            let [observation, goal, actions] =
                [&self.observation, &self.goal, &self.actions].map(|numbers| exchanged(numbers));
            Self { observation, goal, actions }
        }

        fn act(&self, policy: &Policy) -> Vec<f32> {
            let mut actions = vec![0.0; LAYOUT.n_action()];
            policy.actor().unwrap().act(&self.observation, &self.goal, &mut actions);
            actions
        }

        fn q(&self, policy: &Policy) -> Vec<f32> {
            let mut q = vec![0.0; policy.n_heads];
            policy.critic().unwrap().q(&self.observation, &self.goal, &self.actions, &mut q);
            q
        }
    }

    fn assert_near(got: &[f32], expected: impl IntoIterator<Item = f32>) {
        for (got, expected) in got.iter().zip(expected) {
            assert!((got - expected).abs() < 2e-5, "{got} instead of {expected}");
        }
    }

    /// The normalisers of the two arms are equal, so that nothing is clipped in one place only.
    fn sample(n_heads: usize) -> Policy {
        let mut policy = Policy::sample(LAYOUT, n_heads);
        for normalizer in [&mut policy.observation_normalizer, &mut policy.goal_normalizer] {
            for numbers in [&mut normalizer.mean, &mut normalizer.std] {
                let half = numbers.len() / 2;
                let (first, second) = numbers.split_at_mut(half);
                for (first, second) in first.iter().zip(second) {
                    *second = first * 1.25;
                }
            }
        }
        policy
    }

    #[test]
    fn networks_compute_the_mean_over_both_orders_of_the_arms() {
        for n_heads in [1, 2] {
            let policy = sample(n_heads);
            let both = policy.clone().symmetrized();
            both.check().unwrap();
            for number in 0..10 {
                let scene = scene(&policy, number);
                let reversed = scene.exchanged();
                let raw = |action: f32| action.atanh();
                let means = scene.act(&policy).into_iter().zip(exchanged(&reversed.act(&policy)));
                assert_near(
                    &scene.act(&both),
                    means.map(|(one, other)| f32::midpoint(raw(one), raw(other)).tanh()),
                );
                let of_reversed = reversed.q(&policy).into_iter().rev();
                let means = scene.q(&policy).into_iter().zip(of_reversed);
                assert_near(&scene.q(&both), means.map(|(one, other)| f32::midpoint(one, other)));
            }
        }
    }

    #[test]
    fn exchanging_the_arms_exchanges_their_actions() {
        let both = sample(2).symmetrized();
        let scene = scene(&both, 1);
        assert_near(&exchanged(&scene.act(&both)), scene.exchanged().act(&both));
    }

    #[test]
    fn a_published_actor_becomes_that_of_the_symmetrised_policy() {
        let policy = sample(2);
        let published = symmetrized_actor(&policy.task, &policy.published(7));
        assert_eq!(published, policy.symmetrized().published(7));
    }

    #[test]
    fn nothing_changes_twice_or_for_one_arm() {
        let both = sample(2).symmetrized();
        assert_eq!(both.clone().symmetrized(), both);
        let one = Policy::sample(Layout::new(Task::SharedPickAndPlace, 1), 1);
        assert_eq!(one.clone().symmetrized(), one);
    }

    #[test]
    fn places_of_reversed_arms_follow_the_description() {
        let task: TaskSpec = LAYOUT.into();
        let places = reversed(&task, TaskSpec::action_of, task.n_action());
        let of = |arm: usize| task.action_of(ArmIndex(arm)).iter().collect::<Vec<_>>();
        assert_eq!(places, [of(1), of(0)].concat());
    }
}
