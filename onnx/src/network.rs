//! Networks as read from a model: columns of the inputs, elementwise operations and layers.

use tandem_policy::tanh;

/// An elementwise operation with a constant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Op {
    /// `x + c`.
    Add(f32),
    /// `x - c`.
    Sub(f32),
    /// `x * c`.
    Mul(f32),
    /// `x / c`; `c` is not 0.
    Div(f32),
    /// `min(max(x, low), high)`; the bounds are ordered and may be infinite.
    Clip(f32, f32),
    /// `max(x, 0)`.
    Relu,
    /// `tanh(x)`.
    Tanh,
}

impl Op {
    /// Applies the operation.
    #[must_use]
    pub fn apply(self, x: f32) -> f32 {
        match self {
            Self::Add(c) => x + c,
            Self::Sub(c) => x - c,
            Self::Mul(c) => x * c,
            Self::Div(c) => x / c,
            Self::Clip(low, high) => x.clamp(low, high),
            Self::Relu => x.max(0.0),
            Self::Tanh => tanh(x),
        }
    }
}

/// A number that enters the first layer: a number of an input, after elementwise operations.
#[derive(Debug, Clone, PartialEq)]
pub struct Column {
    /// Index of the input.
    pub input: usize,
    /// Index of the number in a row of this input.
    pub index: usize,
    /// Operations, in order.
    pub ops: Vec<Op>,
}

impl Column {
    /// Applies the operations to the column's number.
    #[must_use]
    pub fn apply(&self, x: f32) -> f32 {
        self.ops.iter().fold(x, |x, op| op.apply(x))
    }
}

/// A fully connected layer without activation.
#[derive(Debug, Clone, PartialEq)]
pub struct Layer {
    /// Weight, shape `[n_in, n_out]`: the transpose of a policy file's.
    pub weight: Vec<f32>,
    /// Bias, shape `[n_out]`.
    pub bias: Vec<f32>,
}

impl Layer {
    /// Returns the length of an input row.
    #[must_use]
    pub const fn n_in(&self) -> usize {
        self.weight.len() / self.bias.len()
    }

    /// Computes one row, shape `[n_out]`, from `input`, shape `[n_in]`. The order of summation is fixed.
    fn run(&self, input: &[f32], output: &mut Vec<f32>) {
        output.clear();
        output.extend_from_slice(&self.bias);
        for (x, weights) in input.iter().zip(self.weight.chunks_exact(self.bias.len())) {
            for (sum, weight) in output.iter_mut().zip(weights) {
                *sum += x * weight;
            }
        }
    }
}

/// One step of a network, from a row to a row.
#[derive(Debug, Clone, PartialEq)]
pub enum Step {
    /// A layer.
    Layer(Layer),
    /// One operation for each number of the row.
    Each(Vec<Op>),
}

/// An input of a model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Input {
    /// Name.
    pub name: String,
    /// Length of a row.
    pub width: usize,
}

/// A multilayer perceptron with elementwise operations on its inputs and between its layers.
#[derive(Debug, Clone, PartialEq)]
pub struct Network {
    /// The model's inputs, in its order.
    pub inputs: Vec<Input>,
    /// Name of the output.
    pub output: String,
    /// Length of an output row.
    pub n_output: usize,
    /// The numbers that enter the first step.
    pub columns: Vec<Column>,
    /// Steps, in order. The first one is a layer.
    pub steps: Vec<Step>,
}

impl Network {
    /// Returns the layers, in order.
    pub fn layers(&self) -> impl Iterator<Item = &Layer> {
        self.steps.iter().filter_map(|step| match step {
            Step::Layer(layer) => Some(layer),
            Step::Each(_) => None,
        })
    }

    /// Returns the number of weights and biases.
    #[must_use]
    pub fn n_parameters(&self) -> usize {
        self.layers().map(|layer| layer.weight.len() + layer.bias.len()).sum()
    }

    /// Computes one output row in `row`, which holds the [`columns`](Self::columns) after their operations, shape
    /// `[columns]`. `scratch` is any memory.
    pub(crate) fn run(&self, row: &mut Vec<f32>, scratch: &mut Vec<f32>) {
        for step in &self.steps {
            match step {
                Step::Layer(layer) => {
                    layer.run(row, scratch);
                    std::mem::swap(row, scratch);
                }
                Step::Each(ops) => {
                    for (x, op) in row.iter_mut().zip(ops) {
                        *x = op.apply(*x);
                    }
                }
            }
        }
    }
}
