//! Multilayer perceptrons over batches: ReLU between layers, linear output, hand-written gradients.

use std::ops::Range;

use rand_chacha::ChaCha8Rng;
use tandem_core::TaskSpec;
use tandem_core::rng::uniform;

use crate::matrix::{Matrix, MatrixMut};

mod parts;

pub use parts::{
    Activations, ParameterBlock, RowBlock, TransposedBlock, TransposedParameters,
    elementwise_blocks,
};

/// The sizes of a network: input, hidden layers of equal width, output.
///
/// Its parameters are one flat vector: for each layer the weight, shape `[out, in]`, row-major, then the bias, shape
/// `[out]`. Layers are numbered from 0; the last one, number `n_hidden_layers`, is the output layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MlpShape {
    /// Length of an input row.
    pub n_input: usize,
    /// Units of each hidden layer.
    pub n_hidden: usize,
    /// Number of hidden layers.
    pub n_hidden_layers: usize,
    /// Length of an output row.
    pub n_output: usize,
}

impl MlpShape {
    /// Returns the shape of an actor, which maps normalised observation and goal to an action before its tanh.
    #[must_use]
    pub fn actor(task: impl Into<TaskSpec>, n_hidden: usize, n_hidden_layers: usize) -> Self {
        let task = task.into();
        let n_input = task.n_observation() + task.n_goal();
        Self { n_input, n_hidden, n_hidden_layers, n_output: task.n_action() }
    }

    /// Returns the shape of a critic, which maps normalised observation and goal, then the action, to one value per
    /// head.
    #[must_use]
    pub fn critic(
        task: impl Into<TaskSpec>,
        n_hidden: usize,
        n_hidden_layers: usize,
        n_heads: usize,
    ) -> Self {
        let task = task.into();
        let n_input = task.n_observation() + task.n_goal() + task.n_action();
        Self { n_input, n_hidden, n_hidden_layers, n_output: n_heads }
    }

    /// Returns the length of the parameter vector.
    #[must_use]
    pub const fn n_parameters(&self) -> usize {
        self.layer_start(self.n_layers())
    }

    /// Returns the number of layers: the hidden layers and the output layer.
    #[must_use]
    pub const fn n_layers(&self) -> usize {
        self.n_hidden_layers + 1
    }

    /// Returns the length of an input row of layer `layer`.
    #[must_use]
    pub const fn layer_input(&self, layer: usize) -> usize {
        if layer == 0 { self.n_input } else { self.n_hidden }
    }

    /// Returns the length of an output row of layer `layer`.
    #[must_use]
    pub const fn layer_output(&self, layer: usize) -> usize {
        if layer == self.n_hidden_layers { self.n_output } else { self.n_hidden }
    }

    /// Returns the range of the weight of layer `layer`, shape `[out, in]`, within the parameters.
    #[must_use]
    pub const fn weight(&self, layer: usize) -> Range<usize> {
        let start = self.layer_start(layer);
        start..start + self.layer_input(layer) * self.layer_output(layer)
    }

    /// Returns the range of the bias of layer `layer`, shape `[out]`, within the parameters.
    #[must_use]
    pub const fn bias(&self, layer: usize) -> Range<usize> {
        let start = self.weight(layer).end;
        start..start + self.layer_output(layer)
    }

    /// Draws initial parameters: Xavier-uniform weights (Glorot & Bengio 2010) and zero biases, shape `[n_parameters]`.
    #[must_use]
    pub fn initialise(&self, rng: &mut ChaCha8Rng) -> Vec<f32> {
        let mut parameters = vec![0.0; self.n_parameters()];
        for layer in 0..self.n_layers() {
            let bound = (6.0 / (self.layer_input(layer) + self.layer_output(layer)) as f32).sqrt();
            for weight in &mut parameters[self.weight(layer)] {
                *weight = uniform(rng, -bound, bound);
            }
        }
        parameters
    }

    const fn layer_start(&self, layer: usize) -> usize {
        let mut start = 0;
        let mut below = 0;
        while below < layer {
            start += (self.layer_input(below) + 1) * self.layer_output(below);
            below += 1;
        }
        start
    }

    fn weight_matrix<'a>(&self, parameters: &'a [f32], layer: usize) -> Matrix<'a> {
        Matrix::new(
            &parameters[self.weight(layer)],
            self.layer_output(layer),
            self.layer_input(layer),
        )
    }
}

/// Scratch memory for the passes of one network over at most `max_batch` rows.
///
/// A forward pass stores its hidden activations here for the backward passes that follow.
#[derive(Debug, Clone)]
pub struct Workspace {
    activations: Activations,
    parameters: TransposedParameters,
}

impl Workspace {
    /// Allocates memory for `shape` and batches of up to `max_batch` rows.
    #[must_use]
    pub fn new(shape: &MlpShape, max_batch: usize) -> Self {
        let no_parameters = vec![0.0; shape.n_parameters()];
        Self {
            activations: Activations::new(shape, max_batch),
            parameters: TransposedParameters::new(shape, &no_parameters),
        }
    }
}

/// Computes `output`, shape `[batch, n_output]`, from `input`, shape `[batch, n_input]`, and stores the activations in
/// `workspace`. `parameters` has shape `[n_parameters]`.
///
/// # Panics
/// If a size does not match `shape` or the batch exceeds the workspace.
pub fn forward(
    shape: &MlpShape,
    parameters: &[f32],
    input: Matrix<'_>,
    workspace: &mut Workspace,
    output: &mut MatrixMut<'_>,
) {
    let Workspace { activations, parameters: transposed } = workspace;
    transposed.update(shape, parameters);
    let mut rows = activations.block(input.n_rows());
    rows.forward(shape, transposed, input, output);
}

/// Computes the gradient of the loss with respect to the parameters, shape `[n_parameters]`, from its gradient with
/// respect to the output, shape `[batch, n_output]`.
///
/// `workspace` must hold the activations of a [`forward`] pass over the same `input`.
///
/// # Panics
/// If a size does not match `shape` or the batch exceeds the workspace.
pub fn backward_parameters(
    shape: &MlpShape,
    parameters: &[f32],
    input: Matrix<'_>,
    workspace: &mut Workspace,
    output_gradient: &[f32],
    gradient: &mut [f32],
) {
    let activations = &mut workspace.activations;
    activations.block(input.n_rows()).backward(shape, parameters, output_gradient);
    let mut rest = gradient;
    for block in shape.parameter_blocks() {
        let (gradient, others) = rest.split_at_mut(block.len(shape));
        activations.parameter_gradient(shape, &block, input, output_gradient, gradient);
        rest = others;
    }
}

/// Computes the gradient of the loss with respect to the input's `columns`, shape `[batch, columns.len()]`, from its
/// gradient with respect to the output, shape `[batch, n_output]`.
///
/// `workspace` must hold the activations of a [`forward`] pass.
///
/// # Panics
/// If a size does not match `shape` or the batch exceeds the workspace.
pub fn backward_input(
    shape: &MlpShape,
    parameters: &[f32],
    workspace: &mut Workspace,
    output_gradient: &[f32],
    columns: Range<usize>,
    input_gradient: &mut [f32],
) {
    let mut rows = workspace.activations.block(output_gradient.len() / shape.n_output);
    rows.backward(shape, parameters, output_gradient);
    rows.input_gradient(shape, parameters, output_gradient, columns, input_gradient);
}

#[cfg(test)]
mod tests {
    use tandem_core::{Stream, episode_rng};

    use super::*;

    const SHAPE: MlpShape = MlpShape { n_input: 5, n_hidden: 7, n_hidden_layers: 2, n_output: 3 };
    const N_ROWS: usize = 4;

    #[test]
    fn weights_and_biases_cover_the_parameters_once() {
        let parts =
            (0..SHAPE.n_layers()).flat_map(|layer| [SHAPE.weight(layer), SHAPE.bias(layer)]);
        assert_eq!(
            parts.flatten().collect::<Vec<_>>(),
            (0..SHAPE.n_parameters()).collect::<Vec<_>>()
        );
        assert_eq!(SHAPE.n_parameters(), (5 + 1) * 7 + (7 + 1) * 7 + (7 + 1) * 3);
    }

    #[test]
    fn initial_weights_fill_the_xavier_range_and_biases_are_zero() {
        let parameters = SHAPE.initialise(&mut episode_rng(1, 0, Stream::Initialisation));
        let bound = (6.0_f32 / 12.0).sqrt();
        let largest = parameters[SHAPE.weight(0)]
            .iter()
            .fold(0.0_f32, |largest, weight| largest.max(weight.abs()));
        assert!((0.8 * bound..bound).contains(&largest), "largest weight {largest}");
        assert_eq!(parameters[SHAPE.bias(1)], [0.0; 7]);
    }

    /// A slow and simple forward pass in double precision.
    fn reference(parameters: &[f64], input: &[f64]) -> Vec<f64> {
        let mut row = input.to_vec();
        for layer in 0..SHAPE.n_layers() {
            let (weight, bias) = (&parameters[SHAPE.weight(layer)], &parameters[SHAPE.bias(layer)]);
            let next = weight.chunks(row.len()).zip(bias).map(|(weights, bias)| {
                let sum =
                    weights.iter().zip(&row).map(|(weight, x)| weight * x).sum::<f64>() + bias;
                if layer < SHAPE.n_hidden_layers { sum.max(0.0) } else { sum }
            });
            row = next.collect();
        }
        row
    }

    /// A loss that is linear in the output, so its gradient with respect to the output is `slopes`.
    fn loss(parameters: &[f64], input: &[f64], slopes: &[f32]) -> f64 {
        let outputs = input.chunks(SHAPE.n_input).flat_map(|row| reference(parameters, row));
        outputs.zip(slopes).map(|(output, slope)| output * f64::from(*slope)).sum()
    }

    /// The gradient of `loss` at `at`, by central differences.
    fn differences(at: &[f64], loss: impl Fn(&[f64]) -> f64) -> Vec<f64> {
        const STEP: f64 = 1e-6;
        let along = |i: usize, step: f64| {
            let mut moved = at.to_vec();
            moved[i] += step;
            loss(&moved)
        };
        (0..at.len()).map(|i| (along(i, STEP) - along(i, -STEP)) / (2.0 * STEP)).collect()
    }

    fn assert_close(what: &str, got: &[f32], expected: &[f64]) {
        assert_eq!(got.len(), expected.len(), "{what}");
        for (i, (got, expected)) in got.iter().zip(expected).enumerate() {
            assert!(
                (f64::from(*got) - expected).abs() < 2e-5,
                "{what} {i}: {got} against {expected}"
            );
        }
    }

    #[test]
    fn passes_agree_with_double_precision_and_finite_differences() {
        let mut rng = episode_rng(2, 0, Stream::Initialisation);
        let mut parameters = SHAPE.initialise(&mut rng);
        for layer in 0..SHAPE.n_layers() {
            parameters[SHAPE.bias(layer)].fill_with(|| uniform(&mut rng, -0.3, 0.3));
        }
        let mut draw =
            |n: usize| (0..n).map(|_| uniform(&mut rng, -1.0, 1.0)).collect::<Vec<f32>>();
        let (input, slopes) = (draw(N_ROWS * SHAPE.n_input), draw(N_ROWS * SHAPE.n_output));
        let exact = |numbers: &[f32]| numbers.iter().copied().map(f64::from).collect::<Vec<f64>>();
        let (parameters64, input64) = (exact(&parameters), exact(&input));

        let mut workspace = Workspace::new(&SHAPE, N_ROWS + 2);
        let mut output = vec![0.0; N_ROWS * SHAPE.n_output];
        let rows = Matrix::new(&input, N_ROWS, SHAPE.n_input);
        let mut output_rows = MatrixMut::new(&mut output, N_ROWS, SHAPE.n_output);
        forward(&SHAPE, &parameters, rows, &mut workspace, &mut output_rows);
        let outputs: Vec<f64> =
            input64.chunks(SHAPE.n_input).flat_map(|row| reference(&parameters64, row)).collect();
        assert_close("output", &output, &outputs);

        let mut input_gradient = vec![0.0; N_ROWS * 3];
        backward_input(&SHAPE, &parameters, &mut workspace, &slopes, 2..5, &mut input_gradient);
        let slopes_by_input = differences(&input64, |input| loss(&parameters64, input, &slopes));
        let by_columns: Vec<f64> =
            slopes_by_input.chunks(5).flat_map(|row| row[2..].to_vec()).collect();
        assert_close("input gradient", &input_gradient, &by_columns);

        let mut gradient = vec![f32::NAN; SHAPE.n_parameters()];
        backward_parameters(&SHAPE, &parameters, rows, &mut workspace, &slopes, &mut gradient);
        let slopes_by_parameter =
            differences(&parameters64, |parameters| loss(parameters, &input64, &slopes));
        assert_close("gradient", &gradient, &slopes_by_parameter);
    }
}
