//! One update of DDPG (Lillicrap et al. 2016) with a value per arm and behaviour cloning of advice.
//!
//! It has the steps of section 2.2 of the paper, with the target networks of section 4.2: the critic's target and loss
//! (equation 5), the actor's loss (equation 4), a step of Adam for each, and Polyak averaging of the target networks.
//! Both gradients are taken at the same parameters, so the updates of critic and actor can run in parallel.
//!
//! An update has three steps, each of which waits for the one before: all passes over the rows of the batch, in blocks
//! of rows; the gradients and Adam, in blocks of parameters; and the transposed weights for the next passes. The blocks
//! are tasks that any number of threads take one after the other. Which tasks there are depends on sizes only, and no
//! number is summed across tasks, so the bits do not depend on the number of threads.

use std::ops::Range;

use tandem_core::{Stream, TaskSpec, episode_rng};
use tandem_policy::{Activations, MatrixMut, MlpShape, tanh};

mod actor_update;
mod config;
mod critic_update;
mod network;
mod state;
#[cfg(test)]
mod tests;
mod threads;

use actor_update::{ActorRows, ActorUpdate, QFilter};
use critic_update::{CriticRows, CriticUpdate};
use network::Network;
use threads::{for_each, in_pool};

pub use config::{DdpgConfig, UpdateSettings};
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
    pub fn new(task: impl Into<TaskSpec>, n_heads: usize, batch_size: usize) -> Self {
        let task = task.into();
        let n_input = task.n_observation() + task.n_goal();
        Self {
            inputs: vec![0.0; batch_size * n_input],
            actions: vec![0.0; batch_size * task.n_action()],
            rewards: vec![0.0; batch_size * n_heads],
            next_inputs: vec![0.0; batch_size * n_input],
            bc_mask: vec![0.0; batch_size * task.n_action()],
        }
    }

    /// Returns the given rows.
    fn rows(&self, rows: &Range<usize>, sizes: Sizes) -> BatchRows<'_> {
        let Sizes { n_input, n_action, n_heads } = sizes;
        fn of<'a>(values: &'a [f32], rows: &Range<usize>, n_columns: usize) -> &'a [f32] {
            &values[rows.start * n_columns..rows.end * n_columns]
        }
        BatchRows {
            n_rows: rows.len(),
            inputs: of(&self.inputs, rows, n_input),
            actions: of(&self.actions, rows, n_action),
            rewards: of(&self.rewards, rows, n_heads),
            next_inputs: of(&self.next_inputs, rows, n_input),
            bc_mask: of(&self.bc_mask, rows, n_action),
        }
    }
}

/// Some consecutive rows of a [`Batch`].
#[derive(Debug, Clone, Copy)]
struct BatchRows<'a> {
    n_rows: usize,
    inputs: &'a [f32],
    actions: &'a [f32],
    rewards: &'a [f32],
    next_inputs: &'a [f32],
    bc_mask: &'a [f32],
}

/// Lengths of the rows of a batch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Sizes {
    n_input: usize,
    n_action: usize,
    n_heads: usize,
}

/// Losses of an update, at the parameters before it: means over its batches.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UpdateLosses {
    /// Squared error of the critic (equation 5 of the paper): mean over the batch, sum over the heads.
    pub critic_loss: f64,
    /// The actor's loss: the negative value, summed over the heads (equation 4 of the paper), the action penalty and
    /// behaviour cloning; mean over the batch.
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
    n_updates: u64,
    actor: Network,
    critic: Network,
    actor_update: ActorUpdate,
    critic_update: CriticUpdate,
    /// The critic's head that values each component of an action; `None` is the sum of all heads.
    heads: Vec<Option<usize>>,
    /// Blocks of rows of the passes.
    row_blocks: Vec<Range<usize>>,
    /// One for each thread.
    scratch: Vec<Scratch>,
}

/// The settings and networks of the passes of an update, which all rows share.
#[derive(Debug, Clone, Copy)]
struct Pass<'a> {
    config: &'a DdpgConfig,
    settings: UpdateSettings,
    actor: &'a Network,
    critic: &'a Network,
}

/// A thread's memory for the passes whose activations are not used after them.
#[derive(Debug, Clone)]
struct Scratch {
    actor: Activations,
    critic: Activations,
}

impl Ddpg {
    /// Creates networks for `task`, initialised from `run_seed`. The critic has one head per reward.
    #[must_use]
    pub fn new(
        config: DdpgConfig,
        task: impl Into<TaskSpec>,
        rewards: Rewards,
        run_seed: u64,
    ) -> Self {
        let task = task.into();
        let (n_hidden, n_hidden_layers) = (config.n_hidden, config.n_hidden_layers);
        let network = |shape, number, learning_rate| {
            let mut rng = episode_rng(run_seed, number, Stream::Initialisation);
            Network::new(shape, learning_rate, &mut rng)
        };
        let actor_shape = MlpShape::actor(&task, n_hidden, n_hidden_layers);
        let critic_shape = MlpShape::critic(&task, n_hidden, n_hidden_layers, rewards.n_heads);
        let row_blocks = critic_shape.row_blocks(config.transitions_per_update());
        let mut ddpg = Self {
            n_updates: 0,
            actor: network(actor_shape, 0, config.actor_learning_rate),
            critic: network(critic_shape, 1, config.critic_learning_rate),
            actor_update: ActorUpdate::new(&config, &actor_shape, &critic_shape),
            critic_update: CriticUpdate::new(&config, rewards.lowest, &critic_shape),
            heads: heads_of_actions(&task, rewards.n_heads),
            row_blocks,
            scratch: Vec::new(),
            config,
        };
        ddpg.set_threads(1);
        ddpg
    }

    /// Makes one gradient step of critic and actor on `batch`, which holds the transitions of all batches of an update.
    /// The gradients of the batches are summed. `settings` are those of the present round.
    ///
    /// # Errors
    /// When a loss or a parameter is no longer finite. The networks are unusable then.
    ///
    /// # Panics
    /// When the batch does not have [`DdpgConfig::transitions_per_update`] rows, or belongs to another task.
    pub fn update(
        &mut self,
        settings: UpdateSettings,
        batch: &Batch,
    ) -> Result<UpdateLosses, DdpgError> {
        self.check_size(batch);
        self.actor.adam.set_learning_rate(settings.actor_learning_rate);
        self.critic.adam.set_learning_rate(settings.critic_learning_rate);
        let n_threads = self.scratch.len();
        let finite = in_pool(n_threads, || {
            self.pass_over_rows(settings, batch);
            self.step_parameters(batch)
        });
        let Self { config, actor_update, critic_update, .. } = self;
        let critic_loss = critic_update.loss(config.transitions_per_update());
        let (actor_loss, mean_q) = actor_update.loss_and_mean_q(config, settings.bc_weight, batch);
        self.n_updates += 1;
        let checks = [
            ("a critic loss", critic_loss.is_finite()),
            ("an actor loss", actor_loss.is_finite()),
            ("a critic parameter", finite.critic),
            ("an actor parameter", finite.actor),
        ];
        match checks.into_iter().find(|(_, finite)| !finite) {
            Some((what, _)) => Err(DdpgError::NotFinite { what, update: self.n_updates }),
            None => Ok(UpdateLosses { critic_loss, actor_loss, mean_q }),
        }
    }

    fn check_size(&self, batch: &Batch) {
        let b = self.config.transitions_per_update();
        let Sizes { n_input, n_action, n_heads } = self.sizes();
        for (values, n_columns, what) in [
            (&batch.inputs, n_input, "inputs"),
            (&batch.actions, n_action, "actions"),
            (&batch.rewards, n_heads, "rewards"),
            (&batch.next_inputs, n_input, "next inputs"),
            (&batch.bc_mask, n_action, "masks"),
        ] {
            assert_eq!(values.len(), b * n_columns, "{what} of a batch of another size");
        }
    }

    const fn sizes(&self) -> Sizes {
        let Self { actor, critic, .. } = self;
        let (n_input, n_action) = (actor.shape.n_input, actor.shape.n_output);
        Sizes { n_input, n_action, n_heads: critic.shape.n_output }
    }

    /// Makes all passes that are independent for each row: values, targets, and the gradients with respect to all
    /// activations.
    fn pass_over_rows(&mut self, settings: UpdateSettings, batch: &Batch) {
        enum Rows<'a> {
            Critic(CriticRows<'a>),
            Actor(ActorRows<'a>),
            /// The filter of the actor's rows needs the values of the critic's.
            Both(Box<(CriticRows<'a>, ActorRows<'a>)>),
        }
        let sizes = self.sizes();
        let Self { config, actor, critic, actor_update, critic_update, heads, .. } = self;
        let (pass, heads) = (Pass { config, settings, actor, critic }, &**heads);
        let critic_rows = critic_update.rows(batch, &self.row_blocks, sizes).into_iter();
        let actor_rows = actor_update.rows(batch, &self.row_blocks, sizes).into_iter();
        let tasks = if settings.filters_advice && settings.bc_weight > 0.0 {
            critic_rows.zip(actor_rows).map(|rows| Rows::Both(Box::new(rows))).collect()
        } else {
            critic_rows.map(Rows::Critic).chain(actor_rows.map(Rows::Actor)).collect()
        };
        for_each(&mut self.scratch, tasks, |scratch, rows| match rows {
            Rows::Critic(rows) => {
                rows.differentiate(pass, scratch);
            }
            Rows::Actor(rows) => rows.differentiate(None, pass, scratch),
            Rows::Both(rows) => {
                let (critic_rows, actor_rows) = *rows;
                let executed_q = critic_rows.differentiate(pass, scratch);
                let filter = QFilter { executed_q, heads };
                actor_rows.differentiate(Some(filter), pass, scratch);
            }
        });
    }

    /// Makes a step of Adam with the gradients with respect to the parameters, and returns which parameters are finite.
    fn step_parameters(&mut self, batch: &Batch) -> Finite {
        let b = self.config.transitions_per_update();
        let Self { actor, critic, actor_update, critic_update, scratch, .. } = self;
        let actor_gradient = actor_update.gradient_inputs(&actor.shape, batch, b);
        let critic_gradient = critic_update.gradient_inputs(&critic.shape, b);
        let mut tasks = critic.step(&critic_gradient);
        tasks.extend(actor.step(&actor_gradient));
        for_each(scratch, tasks, |_, task| task.run());
        let finite = Finite {
            actor: actor_gradient.parameters_are_finite(),
            critic: critic_gradient.parameters_are_finite(),
        };
        let mut tasks = critic.transpose();
        tasks.extend(actor.transpose());
        for_each(scratch, tasks, |_, task| task.run());
        finite
    }

    /// Moves both target networks toward the online ones: `target = polyak_keep * target + (1 - polyak_keep) * online`.
    pub fn polyak(&mut self) {
        let Self { config, actor, critic, scratch, .. } = self;
        let keep = config.polyak_keep;
        let mut tasks = critic.polyak();
        tasks.extend(actor.polyak());
        in_pool(scratch.len(), || for_each(scratch, tasks, |_, task| task.run(keep)));
    }

    /// Sets how many threads of the rayon pool work on an update; 0 means 1. The results are the same, bit for bit.
    pub fn set_threads(&mut self, n_threads: usize) {
        let Self { actor, critic, row_blocks, scratch, .. } = self;
        let n_rows = row_blocks.iter().map(Range::len).max().unwrap_or(0);
        scratch.resize_with(n_threads.max(1), || Scratch {
            actor: Activations::new(&actor.shape, n_rows),
            critic: Activations::new(&critic.shape, n_rows),
        });
    }
}

/// Whether all parameters of both networks are finite.
#[derive(Debug, Clone, Copy)]
struct Finite {
    actor: bool,
    critic: bool,
}

/// The rewards that the critic learns the value of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rewards {
    /// Rewards per step: 1, or one per arm.
    pub n_heads: usize,
    /// The lowest possible reward of a step; the highest is 0. The critic's targets are clipped to
    /// `[lowest / (1 - discount), 0]`.
    pub lowest: f32,
}

impl Rewards {
    /// Returns rewards of -1 while a goal is pending, else 0.
    #[must_use]
    pub const fn sparse(n_heads: usize) -> Self {
        Self { n_heads, lowest: -1.0 }
    }
}

/// Returns the critic's head that values each component of an action: that of the component's arm, if every arm has a
/// head.
fn heads_of_actions(task: &TaskSpec, n_heads: usize) -> Vec<Option<usize>> {
    let mut heads = vec![None; task.n_action()];
    if n_heads == task.n_arms() {
        for arm in task.arms() {
            task.action_of(arm).iter().for_each(|idx| heads[idx] = Some(arm.0));
        }
    }
    heads
}

/// Splits rows of `n_columns` numbers into blocks of rows.
fn split_rows<'a>(
    mut rows: &'a mut [f32],
    n_columns: usize,
    blocks: &[Range<usize>],
) -> impl Iterator<Item = &'a mut [f32]> {
    blocks.iter().map(move |block| {
        let (first, rest) = std::mem::take(&mut rows).split_at_mut(block.len() * n_columns);
        rows = rest;
        first
    })
}

/// Copies rows of `n_columns` into the rows of `table`, `row_stride` long, from column `first_column` on.
fn write_columns(
    table: &mut [f32],
    row_stride: usize,
    first_column: usize,
    rows: &[f32],
    n_columns: usize,
) {
    for (row, source) in table.chunks_exact_mut(row_stride).zip(rows.chunks_exact(n_columns)) {
        row[first_column..first_column + n_columns].copy_from_slice(source);
    }
}

/// Returns the columns of a critic's input that contain the action.
fn action_columns<'a>(
    input: &'a mut [f32],
    actor: &MlpShape,
    n_state_action: usize,
    n_rows: usize,
) -> MatrixMut<'a> {
    MatrixMut::with_stride(&mut input[actor.n_input..], n_rows, actor.n_output, n_state_action)
}

/// Applies tanh to every action.
fn squash(actions: &mut MatrixMut<'_>) {
    for row in actions.rows_mut() {
        for component in row {
            *component = tanh(*component);
        }
    }
}
