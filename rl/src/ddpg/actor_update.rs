//! The actor's part of an update.

use std::ops::Range;

use tandem_policy::{Activations, Matrix, MatrixMut, MlpShape, RowBlock};

use super::network::ParameterGradientInputs;
use super::{
    Batch, BatchRows, DdpgConfig, Pass, Scratch, Sizes, action_columns, split_rows, squash,
    write_columns,
};

/// The actor's part of an update: its batch, values and gradients.
#[derive(Debug, Clone)]
pub(super) struct ActorUpdate {
    /// Input and the actor's action, shape `[b, n_input + n_action]`.
    input: Vec<f32>,
    /// The critic's value of it, shape `[b, n_heads]`.
    q: Vec<f32>,
    /// Gradient of the loss with respect to `q`: the same number everywhere.
    q_gradient: Vec<f32>,
    /// Gradient of the loss with respect to the action, then to the action before its tanh, shape `[b, n_action]`.
    action_gradient: Vec<f32>,
    /// The batch's mask of behaviour cloning without the components that the filter leaves out, shape `[b, n_action]`.
    bc_mask: Vec<f32>,
    /// The actor's activations for its actions.
    activations: Activations,
}

/// Consecutive rows of [`ActorUpdate`].
#[derive(Debug)]
pub(super) struct ActorRows<'a> {
    batch: BatchRows<'a>,
    input: &'a mut [f32],
    q: &'a mut [f32],
    q_gradient: &'a [f32],
    action_gradient: &'a mut [f32],
    bc_mask: &'a mut [f32],
    activations: RowBlock<'a>,
}

impl ActorUpdate {
    pub(super) fn new(config: &DdpgConfig, actor: &MlpShape, critic: &MlpShape) -> Self {
        let b = config.transitions_per_update();
        Self {
            input: vec![0.0; b * critic.n_input],
            q: vec![0.0; b * critic.n_output],
            q_gradient: vec![-1.0 / config.batch_size as f32; b * critic.n_output],
            action_gradient: vec![0.0; b * actor.n_output],
            bc_mask: vec![0.0; b * actor.n_output],
            activations: Activations::new(actor, b),
        }
    }

    /// Splits all vectors into blocks of rows.
    pub(super) fn rows<'a>(
        &'a mut self,
        batch: &'a Batch,
        blocks: &[Range<usize>],
        sizes: Sizes,
    ) -> Vec<ActorRows<'a>> {
        let Self { input, q, q_gradient, action_gradient, bc_mask, activations } = self;
        let q_gradient = &**q_gradient;
        let mut inputs = split_rows(input, sizes.n_input + sizes.n_action, blocks);
        let mut qs = split_rows(q, sizes.n_heads, blocks);
        let mut action_gradients = split_rows(action_gradient, sizes.n_action, blocks);
        let mut bc_masks = split_rows(bc_mask, sizes.n_action, blocks);
        let rows =
            blocks.iter().zip(activations.blocks(blocks)).map_while(|(block, activations)| {
                Some(ActorRows {
                    batch: batch.rows(block, sizes),
                    input: inputs.next()?,
                    q: qs.next()?,
                    q_gradient: &q_gradient[..block.len() * sizes.n_heads],
                    action_gradient: action_gradients.next()?,
                    bc_mask: bc_masks.next()?,
                    activations,
                })
            });
        rows.collect()
    }

    /// Returns the inputs of the gradient with respect to the actor's parameters, after all `b` rows of `batch`.
    pub(super) fn gradient_inputs<'a>(
        &'a self,
        actor: &MlpShape,
        batch: &'a Batch,
        b: usize,
    ) -> ParameterGradientInputs<'a> {
        let input = Matrix::new(&batch.inputs, b, actor.n_input);
        ParameterGradientInputs::new(*actor, input, &self.activations, &self.action_gradient)
    }

    /// Returns the loss and the mean value, after all rows of `batch`.
    pub(super) fn loss_and_mean_q(
        &self,
        config: &DdpgConfig,
        bc_weight: f32,
        batch: &Batch,
    ) -> (f64, f64) {
        let b = config.transitions_per_update();
        let n_action = self.action_gradient.len() / b;
        let n_state_action = self.input.len() / b;
        let terms = ActionTerms::new(config, bc_weight, n_action);
        let executed_rows =
            batch.actions.chunks_exact(n_action).zip(self.bc_mask.chunks_exact(n_action));
        let mut loss = 0.0;
        for (input, (executed, bc_mask)) in
            self.input.chunks_exact(n_state_action).zip(executed_rows)
        {
            let actions = &input[n_state_action - n_action..];
            for ((action, executed), bc_mask) in actions.iter().zip(executed).zip(bc_mask) {
                loss += terms.loss(*action, bc_mask * (action - executed));
            }
        }
        let action_loss = loss / config.batches_per_update as f64;
        let sum_q: f64 = self.q.iter().copied().map(f64::from).sum();
        (action_loss - sum_q / b as f64, sum_q / self.q.len() as f64)
    }
}

impl ActorRows<'_> {
    /// Computes the actions, their values and the gradients of the actor's loss with respect to all activations of the
    /// actor. Advice is cloned where `filter` keeps it.
    pub(super) fn differentiate(
        mut self,
        filter: Option<QFilter<'_>>,
        pass: Pass<'_>,
        scratch: &mut Scratch,
    ) {
        let Pass { config, settings, actor, critic } = pass;
        let BatchRows { n_rows, inputs, .. } = self.batch;
        let n_input = actor.shape.n_input;
        let (n_state_action, n_heads) = (critic.shape.n_input, critic.shape.n_output);

        // Q(s, pi(s)): the actor writes its actions into the critic's input.
        write_columns(self.input, n_state_action, 0, inputs, n_input);
        let mut action_columns = action_columns(self.input, &actor.shape, n_state_action, n_rows);
        self.activations.forward(
            &actor.shape,
            &actor.online_transposed,
            Matrix::new(inputs, n_rows, n_input),
            &mut action_columns,
        );
        squash(&mut action_columns);
        let mut values = scratch.critic.block(n_rows);
        values.forward(
            &critic.shape,
            &critic.online_transposed,
            Matrix::new(self.input, n_rows, n_state_action),
            &mut MatrixMut::new(self.q, n_rows, n_heads),
        );

        self.bc_mask.copy_from_slice(self.batch.bc_mask);
        if let Some(filter) = filter {
            filter.apply(self.q, self.bc_mask);
        }

        // The gradient of -Q, summed over the heads, with respect to the action.
        values.backward(&critic.shape, &critic.online, self.q_gradient);
        values.input_gradient(
            &critic.shape,
            &critic.online,
            self.q_gradient,
            n_input..n_state_action,
            self.action_gradient,
        );
        self.add_action_terms(config, settings.bc_weight, n_input);
        self.activations.backward(&actor.shape, &actor.online, self.action_gradient);
    }

    /// Adds the gradient of the terms of the loss that depend on the action directly, and propagates the gradient back
    /// through the tanh.
    fn add_action_terms(&mut self, config: &DdpgConfig, bc_weight: f32, n_input: usize) {
        let n_action = self.action_gradient.len() / self.batch.n_rows;
        let terms = ActionTerms::new(config, bc_weight, n_action);
        let executed_rows =
            self.batch.actions.chunks_exact(n_action).zip(self.bc_mask.chunks_exact(n_action));
        let rows = self
            .action_gradient
            .chunks_exact_mut(n_action)
            .zip(self.input.chunks_exact(n_input + n_action));
        for ((gradient, input), (executed, bc_mask)) in rows.zip(executed_rows) {
            for i in 0..n_action {
                let action = input[n_input + i];
                gradient[i] += terms.gradient(action, bc_mask[i] * (action - executed[i]));
                gradient[i] *= 1.0 - action * action;
            }
        }
    }
}

/// Leaves advice out of cloning that is worth no more than the actor's own action.
#[derive(Debug, Clone, Copy)]
pub(super) struct QFilter<'a> {
    /// Values of the executed actions, shape `[n_rows, n_heads]`.
    pub(super) executed_q: &'a [f32],
    /// The head that values each component of an action, shape `[n_action]`; `None` is the sum of all heads.
    pub(super) heads: &'a [Option<usize>],
}

impl QFilter<'_> {
    /// Sets components of `bc_mask`, shape `[n_rows, n_action]`, to 0. `own_q` has the values of the actor's actions, shape
    /// `[n_rows, n_heads]`.
    pub(super) fn apply(self, own_q: &[f32], bc_mask: &mut [f32]) {
        let n_rows = bc_mask.len() / self.heads.len();
        let n_heads = own_q.len() / n_rows;
        let values = self.executed_q.chunks_exact(n_heads).zip(own_q.chunks_exact(n_heads));
        for ((executed, own), mask) in values.zip(bc_mask.chunks_exact_mut(self.heads.len())) {
            let gain = |head: usize| executed[head] - own[head];
            for (mask, head) in mask.iter_mut().zip(self.heads) {
                let is_better = match head {
                    Some(head) => gain(*head) > 0.0,
                    None => (0..n_heads).map(gain).sum::<f32>() > 0.0,
                };
                if !is_better {
                    *mask = 0.0;
                }
            }
        }
    }
}

/// The terms of the loss that depend on an action's components directly: the mean squared component, and the squared
/// error to the teacher's component where that was executed.
#[derive(Debug, Clone, Copy)]
struct ActionTerms {
    penalty: f32,
    cloning: f32,
}

impl ActionTerms {
    fn new(config: &DdpgConfig, bc_weight: f32, n_action: usize) -> Self {
        Self {
            penalty: config.action_penalty / (config.batch_size * n_action) as f32,
            cloning: bc_weight / config.batch_size as f32,
        }
    }

    fn gradient(self, action: f32, error: f32) -> f32 {
        2.0 * self.penalty * action + 2.0 * self.cloning * error
    }

    fn loss(self, action: f32, error: f32) -> f64 {
        f64::from(self.penalty * action * action + self.cloning * error * error)
    }
}
