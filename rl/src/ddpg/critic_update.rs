//! The critic's part of an update.

use std::ops::Range;

use tandem_policy::{Activations, Matrix, MatrixMut, MlpShape, RowBlock};

use super::network::ParameterGradientInputs;
use super::{
    Batch, BatchRows, DdpgConfig, Pass, Scratch, Sizes, action_columns, split_rows, squash,
    write_columns,
};

/// The critic's part of an update: its batch, values and gradients.
#[derive(Debug, Clone)]
pub(super) struct CriticUpdate {
    /// The lowest reward of a step.
    lowest_reward: f32,
    /// Input and executed action, shape `[b, n_input + n_action]`.
    pub(super) input: Vec<f32>,
    /// Next input and the target actor's action.
    next_input: Vec<f32>,
    /// Values of the executed actions, shape `[b, n_heads]`.
    q: Vec<f32>,
    /// The targets of `q`, shape `[b, n_heads]`.
    pub(super) targets: Vec<f32>,
    /// Gradient of the loss with respect to `q`.
    q_gradient: Vec<f32>,
    /// The critic's activations for the executed actions.
    activations: Activations,
}

/// Consecutive rows of [`CriticUpdate`].
#[derive(Debug)]
pub(super) struct CriticRows<'a> {
    lowest_reward: f32,
    batch: BatchRows<'a>,
    input: &'a mut [f32],
    next_input: &'a mut [f32],
    q: &'a mut [f32],
    targets: &'a mut [f32],
    q_gradient: &'a mut [f32],
    activations: RowBlock<'a>,
}

impl CriticUpdate {
    pub(super) fn new(config: &DdpgConfig, lowest_reward: f32, critic: &MlpShape) -> Self {
        let b = config.transitions_per_update();
        Self {
            lowest_reward,
            input: vec![0.0; b * critic.n_input],
            next_input: vec![0.0; b * critic.n_input],
            q: vec![0.0; b * critic.n_output],
            targets: vec![0.0; b * critic.n_output],
            q_gradient: vec![0.0; b * critic.n_output],
            activations: Activations::new(critic, b),
        }
    }

    /// Splits all vectors into blocks of rows.
    pub(super) fn rows<'a>(
        &'a mut self,
        batch: &'a Batch,
        blocks: &[Range<usize>],
        sizes: Sizes,
    ) -> Vec<CriticRows<'a>> {
        let Self { lowest_reward, input, next_input, q, targets, q_gradient, activations } = self;
        let n_state_action = sizes.n_input + sizes.n_action;
        let mut inputs = split_rows(input, n_state_action, blocks);
        let mut next_inputs = split_rows(next_input, n_state_action, blocks);
        let mut qs = split_rows(q, sizes.n_heads, blocks);
        let mut all_targets = split_rows(targets, sizes.n_heads, blocks);
        let mut q_gradients = split_rows(q_gradient, sizes.n_heads, blocks);
        let rows =
            blocks.iter().zip(activations.blocks(blocks)).map_while(|(block, activations)| {
                Some(CriticRows {
                    lowest_reward: *lowest_reward,
                    batch: batch.rows(block, sizes),
                    input: inputs.next()?,
                    next_input: next_inputs.next()?,
                    q: qs.next()?,
                    targets: all_targets.next()?,
                    q_gradient: q_gradients.next()?,
                    activations,
                })
            });
        rows.collect()
    }

    /// Returns the inputs of the gradient with respect to the critic's parameters, after all `b` rows.
    pub(super) fn gradient_inputs(
        &self,
        critic: &MlpShape,
        b: usize,
    ) -> ParameterGradientInputs<'_> {
        let input = Matrix::new(&self.input, b, critic.n_input);
        ParameterGradientInputs::new(*critic, input, &self.activations, &self.q_gradient)
    }

    /// Returns the loss, the mean of `(q - targets)^2` over the `b` rows.
    pub(super) fn loss(&self, b: usize) -> f64 {
        let mut loss = 0.0;
        for (q, target) in self.q.iter().zip(&self.targets) {
            let error = q - target;
            loss += f64::from(error) * f64::from(error);
        }
        loss / b as f64
    }
}

impl<'a> CriticRows<'a> {
    /// Computes the values, their targets and the gradients of the critic's loss with respect to all activations.
    /// Returns the values of the executed actions, shape `[n_rows, n_heads]`.
    pub(super) fn differentiate(mut self, pass: Pass<'_>, scratch: &mut Scratch) -> &'a [f32] {
        let Pass { config, settings, actor, critic } = pass;
        let BatchRows { n_rows, inputs, actions, rewards, next_inputs, .. } = self.batch;
        let (n_input, n_action) = (actor.shape.n_input, actor.shape.n_output);
        let (n_state_action, n_heads) = (critic.shape.n_input, critic.shape.n_output);

        // Q'(s', pi'(s')): the target actor writes its actions into the target critic's input.
        write_columns(self.next_input, n_state_action, 0, next_inputs, n_input);
        let next_inputs = Matrix::new(next_inputs, n_rows, n_input);
        let mut action_columns =
            action_columns(self.next_input, &actor.shape, n_state_action, n_rows);
        scratch.actor.block(n_rows).forward(
            &actor.shape,
            &actor.target_transposed,
            next_inputs,
            &mut action_columns,
        );
        squash(&mut action_columns);
        scratch.critic.block(n_rows).forward(
            &critic.shape,
            &critic.target_transposed,
            Matrix::new(self.next_input, n_rows, n_state_action),
            &mut MatrixMut::new(self.targets, n_rows, n_heads),
        );
        for (target, reward) in self.targets.iter_mut().zip(rewards) {
            *target = critic_target(settings.discount, self.lowest_reward, *reward, *target);
        }

        // Q(s, a)
        write_columns(self.input, n_state_action, 0, inputs, n_input);
        write_columns(self.input, n_state_action, n_input, actions, n_action);
        self.activations.forward(
            &critic.shape,
            &critic.online_transposed,
            Matrix::new(self.input, n_rows, n_state_action),
            &mut MatrixMut::new(self.q, n_rows, n_heads),
        );

        // The gradient, summed over the batches, of the mean of (Q - y)^2 in each.
        let values = self.q.iter().zip(&*self.targets);
        for (gradient, (q, target)) in self.q_gradient.iter_mut().zip(values) {
            let error = q - target;
            *gradient = 2.0 * error / config.batch_size as f32;
        }
        self.activations.backward(&critic.shape, &critic.online, self.q_gradient);
        self.q
    }
}

/// Returns the critic's target `y = r + discount * Q'(s', pi'(s'))`, clipped to the range of discounted sums of rewards
/// from the lowest to 0.
///
/// Episodes end by their time limit only, which is no terminal state, so the target always bootstraps.
pub(super) fn critic_target(discount: f32, lowest_reward: f32, reward: f32, next_q: f32) -> f32 {
    (reward + discount * next_q).clamp(lowest_reward / (1.0 - discount), 0.0)
}
