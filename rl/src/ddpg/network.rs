//! A network with its target network and its optimiser, and the tasks that change them.

use std::sync::atomic::{AtomicBool, Ordering};

use rand_chacha::ChaCha8Rng;
use tandem_policy::{
    Activations, Adam, AdamPart, AlignedVec, Matrix, MlpShape, ParameterBlock, TransposedBlock,
    TransposedParameters, all_finite, elementwise_blocks, polyak_update,
};

/// A network, its target network and its optimiser. Parameters are flat vectors.
#[derive(Debug, Clone)]
pub(super) struct Network {
    pub(super) shape: MlpShape,
    pub(super) online: AlignedVec,
    /// A copy of `online` for forward passes.
    pub(super) online_transposed: TransposedParameters,
    /// The target network. It has no backward pass, so there is no other copy of it.
    pub(super) target_transposed: TransposedParameters,
    /// Gradient of the loss with respect to `online` in the last update.
    pub(super) gradient: AlignedVec,
    pub(super) adam: Adam,
    blocks: Vec<ParameterBlock>,
}

impl Network {
    pub(super) fn new(shape: MlpShape, learning_rate: f32, rng: &mut ChaCha8Rng) -> Self {
        let online = AlignedVec::from(&*shape.initialise(rng));
        let online_transposed = TransposedParameters::new(&shape, &online);
        Self {
            target_transposed: online_transposed.clone(),
            gradient: AlignedVec::zeros(online.len()),
            adam: Adam::new(online.len(), learning_rate),
            blocks: shape.parameter_blocks(),
            shape,
            online,
            online_transposed,
        }
    }

    /// Returns the parameters of the target network, shape `[n_parameters]`.
    pub(super) fn target(&self) -> Vec<f32> {
        self.target_transposed.transposed_back(&self.shape)
    }

    /// Replaces the parameters of both networks, each of shape `[n_parameters]`.
    pub(super) fn set(&mut self, online: &[f32], target: &[f32]) {
        self.online.copy_from_slice(online);
        self.online_transposed.update(&self.shape, online);
        self.target_transposed.update(&self.shape, target);
    }

    /// Returns the tasks that compute the gradient and make a step of Adam with it.
    pub(super) fn step<'a>(
        &'a mut self,
        gradient: &'a ParameterGradientInputs<'_>,
    ) -> Vec<StepTask<'a>> {
        let lengths = self.blocks.iter().map(|block| block.len(&self.shape));
        let parts = self.adam.step_in_parts(&mut self.online, lengths);
        let mut rest = &mut *self.gradient;
        let tasks = self.blocks.iter().zip(parts).map(|(block, adam)| {
            let (values, others) = std::mem::take(&mut rest).split_at_mut(adam.parameters().len());
            rest = others;
            StepTask { gradient, block, values, adam }
        });
        tasks.collect()
    }

    /// Returns the tasks that copy `online` for forward passes.
    pub(super) fn transpose(&mut self) -> Vec<TransposeTask<'_>> {
        let Self { shape, online, online_transposed, .. } = self;
        let blocks = online_transposed.blocks(shape).into_iter();
        blocks.map(|block| TransposeTask { shape, parameters: online, block }).collect()
    }

    /// Returns the tasks that move the target network toward the online one.
    pub(super) fn polyak(&mut self) -> Vec<PolyakTask<'_>> {
        let mut target = self.target_transposed.as_mut_slice();
        let mut online = self.online_transposed.as_slice();
        let tasks = elementwise_blocks(target.len()).map(|length| {
            let (target_part, target_rest) = std::mem::take(&mut target).split_at_mut(length);
            let (online_part, online_rest) = online.split_at(length);
            (target, online) = (target_rest, online_rest);
            PolyakTask { target: target_part, online: online_part }
        });
        tasks.collect()
    }
}

/// The inputs of a parameter gradient: batch, activations and output gradient.
#[derive(Debug)]
pub(super) struct ParameterGradientInputs<'a> {
    shape: MlpShape,
    input: Matrix<'a>,
    activations: &'a Activations,
    /// Gradient of the loss with respect to the output, shape `[b, n_output]`.
    output_gradient: &'a [f32],
    /// Set to `false` by the first step that leaves a parameter infinite or NaN.
    parameters_are_finite: AtomicBool,
}

impl<'a> ParameterGradientInputs<'a> {
    /// Collects the inputs after a backward pass over every row of `input`, shape `[b, n_input]`.
    pub(super) const fn new(
        shape: MlpShape,
        input: Matrix<'a>,
        activations: &'a Activations,
        output_gradient: &'a [f32],
    ) -> Self {
        Self {
            shape,
            input,
            activations,
            output_gradient,
            parameters_are_finite: AtomicBool::new(true),
        }
    }

    /// Returns `true` if all parameters are finite after the steps with this gradient.
    pub(super) fn parameters_are_finite(&self) -> bool {
        self.parameters_are_finite.load(Ordering::Relaxed)
    }
}

/// A step of Adam for a block of parameters.
#[derive(Debug)]
pub(super) struct StepTask<'a> {
    gradient: &'a ParameterGradientInputs<'a>,
    block: &'a ParameterBlock,
    /// Gradient of the loss with respect to the block's parameters.
    values: &'a mut [f32],
    adam: AdamPart<'a>,
}

impl StepTask<'_> {
    pub(super) fn run(mut self) {
        let ParameterGradientInputs {
            shape,
            input,
            activations,
            output_gradient,
            parameters_are_finite,
        } = self.gradient;
        activations.parameter_gradient(shape, self.block, *input, output_gradient, self.values);
        self.adam.apply(self.values);
        if !all_finite(self.adam.parameters()) {
            parameters_are_finite.store(false, Ordering::Relaxed);
        }
    }
}

/// The transposition of a block of weights.
#[derive(Debug)]
pub(super) struct TransposeTask<'a> {
    shape: &'a MlpShape,
    parameters: &'a [f32],
    block: TransposedBlock<'a>,
}

impl TransposeTask<'_> {
    pub(super) fn run(self) {
        self.block.update(self.shape, self.parameters);
    }
}

/// Polyak averaging of some parameters.
#[derive(Debug)]
pub(super) struct PolyakTask<'a> {
    target: &'a mut [f32],
    online: &'a [f32],
}

impl PolyakTask<'_> {
    pub(super) fn run(self, keep: f32) {
        polyak_update(self.target, self.online, keep);
    }
}
