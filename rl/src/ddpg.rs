//! One update of DDPG (Lillicrap et al. 2016) with a value per arm and behaviour cloning of advice.
//!
//! The order is that of section 2.1 of the paper: the critic's target from the target networks, the critic's loss, the
//! actor's loss, a step of Adam for each, and Polyak averaging of the target networks. Both gradients are taken at the
//! same parameters, so the critic's half and the actor's half of an update can run in parallel.

use rand_chacha::ChaCha8Rng;
use tandem_core::{Stream, TaskSpec, episode_rng};
use tandem_policy::{
    Adam, Matrix, MatrixMut, MlpShape, Workspace, all_finite, backward_input, backward_parameters,
    forward, polyak_update, tanh,
};

mod config;
mod state;
#[cfg(test)]
mod tests;

pub use config::DdpgConfig;
pub use state::CriticBatch;

/// A batch of `b` transitions. An input is a normalised observation followed by a normalised goal.
#[derive(Debug, Clone, PartialEq)]
pub struct Batch {
    /// Inputs before the step, shape `[b, n_observation + n_goal]`.
    pub inputs: Vec<f32>,
    /// Executed actions, in [-1, 1], shape `[b, n_action]`.
    pub actions: Vec<f32>,
    /// One reward per critic head, shape `[b, n_heads]`.
    pub rewards: Vec<f32>,
    /// Inputs after the step, with the same goal, shape `[b, n_observation + n_goal]`.
    pub next_inputs: Vec<f32>,
    /// Mask of behaviour cloning: 1 where the executed component was the teacher's, else 0, shape `[b, n_action]`.
    pub bc_mask: Vec<f32>,
}

impl Batch {
    /// Creates a batch of zeros, to be filled repeatedly.
    #[must_use]
    pub fn new(layout: impl Into<TaskSpec>, n_heads: usize, batch_size: usize) -> Self {
        let layout = layout.into();
        let n_input = layout.n_observation() + layout.n_goal();
        Self {
            inputs: vec![0.0; batch_size * n_input],
            actions: vec![0.0; batch_size * layout.n_action()],
            rewards: vec![0.0; batch_size * n_heads],
            next_inputs: vec![0.0; batch_size * n_input],
            bc_mask: vec![0.0; batch_size * layout.n_action()],
        }
    }
}

/// Losses of an update, at the parameters before it: means over its batches.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UpdateLosses {
    /// Squared error of the critic: mean over the batch, sum over the heads.
    pub critic_loss: f64,
    /// The actor's loss: negative value, action penalty and behaviour cloning.
    pub actor_loss: f64,
    /// Value of the actor's own actions: mean over the batch and the heads.
    pub mean_q: f64,
}

/// An error that ends learning.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DdpgError {
    /// An update gave an infinite number or NaN; the parameters are useless from then on.
    #[error("update {update} left {what} that is not finite")]
    NotFinite {
        /// The location of the number.
        what: &'static str,
        /// The update, from 1.
        update: u64,
    },
    /// A stored state lacks a vector or has one of another length.
    #[error("stored {name:?} has {got} numbers, expected {expected}")]
    Restore {
        /// The vector.
        name: &'static str,
        /// Its length, 0 if it is missing.
        got: usize,
        /// The length in the networks.
        expected: usize,
    },
}

/// Actor, critic, their target networks and optimisers.
#[derive(Debug, Clone)]
pub struct Ddpg {
    config: DdpgConfig,
    n_threads: usize,
    n_updates: u64,
    actor: Network,
    critic: Network,
    actor_half: ActorHalf,
    critic_half: CriticHalf,
}

/// A network and its target network, as flat parameter vectors.
#[derive(Debug, Clone)]
struct Network {
    shape: MlpShape,
    online: Vec<f32>,
    target: Vec<f32>,
}

impl Network {
    fn new(shape: MlpShape, rng: &mut ChaCha8Rng) -> Self {
        let online = shape.initialise(rng);
        Self { shape, target: online.clone(), online }
    }
}

impl Ddpg {
    /// Creates networks for `layout`, initialised from `run_seed`. The critic has one head per reward.
    #[must_use]
    pub fn new(
        config: DdpgConfig,
        layout: impl Into<TaskSpec>,
        rewards: Rewards,
        run_seed: u64,
    ) -> Self {
        let layout = layout.into();
        let (n_hidden, n_hidden_layers) = (config.n_hidden, config.n_hidden_layers);
        let network = |shape, number| {
            Network::new(shape, &mut episode_rng(run_seed, number, Stream::Initialisation))
        };
        let actor = network(MlpShape::actor(&layout, n_hidden, n_hidden_layers), 0);
        let critic =
            network(MlpShape::critic(&layout, n_hidden, n_hidden_layers, rewards.n_heads), 1);
        let actor_half = ActorHalf::new(&config, &actor.shape, &critic.shape);
        let critic_half = CriticHalf::new(&config, rewards.lowest, &actor.shape, &critic.shape);
        Self { config, n_threads: 1, n_updates: 0, actor, critic, actor_half, critic_half }
    }

    /// Makes one gradient step of critic and actor on `batch`, which holds the transitions of all batches of an update.
    /// The gradients of the batches are summed.
    ///
    /// # Errors
    /// When a loss or a parameter is no longer finite.
    ///
    /// # Panics
    /// When the batch does not have the configured size and layout.
    pub fn update(&mut self, batch: &Batch) -> Result<UpdateLosses, DdpgError> {
        let Self { config, n_threads, actor, critic, actor_half, critic_half, .. } = self;
        let (critic_loss, (actor_loss, mean_q)) = join(
            *n_threads,
            || critic_half.differentiate(config, actor, critic, batch),
            || actor_half.differentiate(config, actor, critic, batch),
        );
        let (critic_finite, actor_finite) = join(
            *n_threads,
            || critic_half.optimizer.apply(critic),
            || actor_half.optimizer.apply(actor),
        );
        self.n_updates += 1;
        let checks = [
            ("a critic loss", critic_loss.is_finite()),
            ("an actor loss", actor_loss.is_finite()),
            ("a critic parameter", critic_finite),
            ("an actor parameter", actor_finite),
        ];
        match checks.into_iter().find(|(_, finite)| !finite) {
            Some((what, _)) => Err(DdpgError::NotFinite { what, update: self.n_updates }),
            None => Ok(UpdateLosses { critic_loss, actor_loss, mean_q }),
        }
    }

    /// Moves both target networks toward the online ones: `target = polyak_keep * target + (1 - polyak_keep) * online`.
    pub fn polyak(&mut self) {
        let Self { config, n_threads, actor, critic, .. } = self;
        let move_target = |network: &mut Network| {
            polyak_update(&mut network.target, &network.online, config.polyak_keep);
        };
        join(*n_threads, || move_target(critic), || move_target(actor));
    }

    /// Switches between the usual learning rates and that of the cooldown.
    pub fn set_cooldown(&mut self, is_cooldown: bool) {
        let Self { config, actor_half, critic_half, .. } = self;
        let rate = |usual| if is_cooldown { config.cooldown_learning_rate } else { usual };
        actor_half.optimizer.adam.set_learning_rate(rate(config.actor_learning_rate));
        critic_half.optimizer.adam.set_learning_rate(rate(config.critic_learning_rate));
    }

    /// Sets whether the two halves of an update run one after the other (1) or in parallel (2). The results are the
    /// same, bit for bit.
    pub const fn set_threads(&mut self, n_threads: usize) {
        self.n_threads = n_threads;
    }
}

/// The rewards that the critic learns the value of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rewards {
    /// Rewards per step: 1, or one per arm.
    pub n_heads: usize,
    /// The lowest possible reward; the highest is 0.
    pub lowest: f32,
}

impl Rewards {
    /// Returns rewards of -1 while a goal is pending, else 0.
    #[must_use]
    pub const fn sparse(n_heads: usize) -> Self {
        Self { n_heads, lowest: -1.0 }
    }
}

/// The critic's half of an update.
#[derive(Debug, Clone)]
struct CriticHalf {
    /// The lowest reward of a step.
    lowest_reward: f32,
    /// Input and executed action, shape `[b, n_input + n_action]`.
    input: Vec<f32>,
    /// Next input and the target actor's action.
    next_input: Vec<f32>,
    /// Values of the executed actions, shape `[b, n_heads]`.
    q: Vec<f32>,
    /// The target networks' values of the next inputs, shape `[b, n_heads]`.
    next_q: Vec<f32>,
    /// The targets of `q`, shape `[b, n_heads]`.
    targets: Vec<f32>,
    /// The loss's gradient by `q`.
    q_gradient: Vec<f32>,
    actor_workspace: Workspace,
    critic_workspace: Workspace,
    optimizer: NetworkOptimizer,
}

impl CriticHalf {
    fn new(config: &DdpgConfig, lowest_reward: f32, actor: &MlpShape, critic: &MlpShape) -> Self {
        let b = config.transitions_per_update();
        Self {
            lowest_reward,
            input: vec![0.0; b * critic.n_input],
            next_input: vec![0.0; b * critic.n_input],
            q: vec![0.0; b * critic.n_output],
            next_q: vec![0.0; b * critic.n_output],
            targets: vec![0.0; b * critic.n_output],
            q_gradient: vec![0.0; b * critic.n_output],
            actor_workspace: Workspace::new(actor, b),
            critic_workspace: Workspace::new(critic, b),
            optimizer: NetworkOptimizer::new(critic, config.critic_learning_rate),
        }
    }

    /// Stores the gradient of the critic's loss in `optimizer` and returns the loss.
    fn differentiate(
        &mut self,
        config: &DdpgConfig,
        actor: &Network,
        critic: &Network,
        batch: &Batch,
    ) -> f64 {
        let b = config.transitions_per_update();
        let n_input = actor.shape.n_input;
        let n_joined = critic.shape.n_input;

        // Q'(s', pi'(s')): the target actor writes its actions into the target critic's input.
        write_columns(&mut self.next_input, n_joined, 0, &batch.next_inputs, n_input);
        let next_inputs = Matrix::new(&batch.next_inputs, b, n_input);
        let mut action_columns = action_columns(&mut self.next_input, &actor.shape, n_joined, b);
        forward(
            &actor.shape,
            &actor.target,
            next_inputs,
            &mut self.actor_workspace,
            &mut action_columns,
        );
        squash(&mut action_columns);
        let next_joined = Matrix::new(&self.next_input, b, n_joined);
        let mut next_q = MatrixMut::new(&mut self.next_q, b, critic.shape.n_output);
        forward(
            &critic.shape,
            &critic.target,
            next_joined,
            &mut self.critic_workspace,
            &mut next_q,
        );

        // Q(s, a)
        write_columns(&mut self.input, n_joined, 0, &batch.inputs, n_input);
        write_columns(&mut self.input, n_joined, n_input, &batch.actions, actor.shape.n_output);
        let joined = Matrix::new(&self.input, b, n_joined);
        let mut q = MatrixMut::new(&mut self.q, b, critic.shape.n_output);
        forward(&critic.shape, &critic.online, joined, &mut self.critic_workspace, &mut q);

        // Mean of (Q - y)^2, and the sum over the batches of its gradient in each.
        assert_eq!(batch.rewards.len(), self.q.len(), "rewards for another number of heads");
        let mut loss = 0.0;
        let returns = self.targets.iter_mut().zip(&self.next_q).zip(&batch.rewards);
        for ((target, next_q), reward) in returns {
            *target = critic_target(config.discount, self.lowest_reward, *reward, *next_q);
        }
        let values = self.q.iter().zip(&self.targets);
        for (gradient, (q, target)) in self.q_gradient.iter_mut().zip(values) {
            let error = q - target;
            loss += f64::from(error) * f64::from(error);
            *gradient = 2.0 * error / config.batch_size as f32;
        }
        let gradient = &mut self.optimizer.gradient;
        backward_parameters(
            &critic.shape,
            &critic.online,
            joined,
            &mut self.critic_workspace,
            &self.q_gradient,
            gradient,
        );
        loss / b as f64
    }
}

/// Returns the critic's target `y = r + discount * Q'(s', pi'(s'))`, clipped to the range of discounted sums of rewards
/// from the lowest to 0.
///
/// Episodes end by their time limit only, which is no terminal state, so the target always bootstraps.
fn critic_target(discount: f32, lowest_reward: f32, reward: f32, next_q: f32) -> f32 {
    (reward + discount * next_q).clamp(lowest_reward / (1.0 - discount), 0.0)
}

/// The actor's half of an update.
#[derive(Debug, Clone)]
struct ActorHalf {
    /// Input and the actor's action, shape `[b, n_input + n_action]`.
    input: Vec<f32>,
    /// The critic's value of it, shape `[b, n_heads]`.
    q: Vec<f32>,
    /// The loss's gradient by `q`: the same number everywhere.
    q_gradient: Vec<f32>,
    /// The loss's gradient by the action, then by the action before its tanh, shape `[b, n_action]`.
    action_gradient: Vec<f32>,
    actor_workspace: Workspace,
    critic_workspace: Workspace,
    optimizer: NetworkOptimizer,
}

impl ActorHalf {
    fn new(config: &DdpgConfig, actor: &MlpShape, critic: &MlpShape) -> Self {
        let b = config.transitions_per_update();
        Self {
            input: vec![0.0; b * critic.n_input],
            q: vec![0.0; b * critic.n_output],
            q_gradient: vec![-1.0 / config.batch_size as f32; b * critic.n_output],
            action_gradient: vec![0.0; b * actor.n_output],
            actor_workspace: Workspace::new(actor, b),
            critic_workspace: Workspace::new(critic, b),
            optimizer: NetworkOptimizer::new(actor, config.actor_learning_rate),
        }
    }

    /// Stores the gradient of the actor's loss in `optimizer` and returns the loss and the mean value.
    fn differentiate(
        &mut self,
        config: &DdpgConfig,
        actor: &Network,
        critic: &Network,
        batch: &Batch,
    ) -> (f64, f64) {
        let b = config.transitions_per_update();
        let n_input = actor.shape.n_input;
        let n_joined = critic.shape.n_input;

        // Q(s, pi(s)): the actor writes its actions into the critic's input.
        write_columns(&mut self.input, n_joined, 0, &batch.inputs, n_input);
        let inputs = Matrix::new(&batch.inputs, b, n_input);
        let mut action_columns = action_columns(&mut self.input, &actor.shape, n_joined, b);
        forward(
            &actor.shape,
            &actor.online,
            inputs,
            &mut self.actor_workspace,
            &mut action_columns,
        );
        squash(&mut action_columns);
        let joined = Matrix::new(&self.input, b, n_joined);
        let mut q = MatrixMut::new(&mut self.q, b, critic.shape.n_output);
        forward(&critic.shape, &critic.online, joined, &mut self.critic_workspace, &mut q);

        // -Q summed over the heads, by the action.
        backward_input(
            &critic.shape,
            &critic.online,
            &mut self.critic_workspace,
            &self.q_gradient,
            n_input..n_joined,
            &mut self.action_gradient,
        );
        let action_loss = self.add_action_terms(config, batch, n_input);
        let gradient = &mut self.optimizer.gradient;
        let workspace = &mut self.actor_workspace;
        backward_parameters(
            &actor.shape,
            &actor.online,
            inputs,
            workspace,
            &self.action_gradient,
            gradient,
        );
        let sum_q: f64 = self.q.iter().copied().map(f64::from).sum();
        (action_loss - sum_q / b as f64, sum_q / self.q.len() as f64)
    }

    /// Adds the terms of the loss that depend on the action directly, propagates the gradient back through the tanh,
    /// and returns these terms: the mean squared action, and the squared error to the teacher's action where that was
    /// executed.
    fn add_action_terms(&mut self, config: &DdpgConfig, batch: &Batch, n_input: usize) -> f64 {
        let n_action = self.action_gradient.len() / config.transitions_per_update();
        let penalty = config.action_penalty / (config.batch_size * n_action) as f32;
        let cloning = config.bc_weight / config.batch_size as f32;
        let mut loss = 0.0;
        let executed_rows =
            batch.actions.chunks_exact(n_action).zip(batch.bc_mask.chunks_exact(n_action));
        let rows = self
            .action_gradient
            .chunks_exact_mut(n_action)
            .zip(self.input.chunks_exact(n_input + n_action));
        for ((gradient, input), (executed, bc_mask)) in rows.zip(executed_rows) {
            for i in 0..n_action {
                let action = input[n_input + i];
                let error = bc_mask[i] * (action - executed[i]);
                gradient[i] += 2.0 * penalty * action + 2.0 * cloning * error;
                gradient[i] *= 1.0 - action * action;
                loss += f64::from(penalty * action * action + cloning * error * error);
            }
        }
        loss / config.batches_per_update as f64
    }
}

/// A network's gradient and optimiser.
#[derive(Debug, Clone)]
struct NetworkOptimizer {
    gradient: Vec<f32>,
    adam: Adam,
}

impl NetworkOptimizer {
    fn new(shape: &MlpShape, learning_rate: f32) -> Self {
        let n_parameters = shape.n_parameters();
        Self { gradient: vec![0.0; n_parameters], adam: Adam::new(n_parameters, learning_rate) }
    }

    /// Makes a step of Adam; returns true if all parameters are still finite.
    fn apply(&mut self, network: &mut Network) -> bool {
        self.adam.step(&mut network.online, &self.gradient);
        all_finite(&network.online)
    }
}

/// Copies rows of `n_columns` into the rows of `table`, `row_stride` long, from column `first_column` on.
fn write_columns(
    table: &mut [f32],
    row_stride: usize,
    first_column: usize,
    rows: &[f32],
    n_columns: usize,
) {
    assert_eq!(rows.len() * row_stride, table.len() * n_columns, "a batch of another size");
    for (row, source) in table.chunks_exact_mut(row_stride).zip(rows.chunks_exact(n_columns)) {
        row[first_column..first_column + n_columns].copy_from_slice(source);
    }
}

/// Returns the columns of a critic's input that contain the action.
fn action_columns<'a>(
    input: &'a mut [f32],
    actor: &MlpShape,
    n_joined: usize,
    b: usize,
) -> MatrixMut<'a> {
    MatrixMut::with_stride(&mut input[actor.n_input..], b, actor.n_output, n_joined)
}

/// Applies tanh to every action.
fn squash(actions: &mut MatrixMut<'_>) {
    for row in actions.rows_mut() {
        for component in row {
            *component = tanh(*component);
        }
    }
}

/// Runs both closures, in parallel if there are two threads.
fn join<A: Send, B: Send>(
    n_threads: usize,
    a: impl FnOnce() -> A + Send,
    b: impl FnOnce() -> B + Send,
) -> (A, B) {
    if n_threads > 1 { rayon::join(a, b) } else { (a(), b()) }
}
