//! Parts of passes that can be computed side by side.
//!
//! A forward pass, and a backward pass through the activations, are independent for each row of a batch: they split into
//! blocks of rows. An element of the gradient with respect to a weight is a sum over the rows, which no split cuts: that
//! gradient splits into blocks of outputs. How a pass splits depends on its sizes only, and every number is computed by
//! one part, so the bits do not depend on who computes the parts, or in which order.

use std::ops::Range;

use super::MlpShape;
use crate::aligned::AlignedVec;
use crate::elementwise::{add_bias, add_bias_relu, column_sums, mask};
use crate::matrix::{Matrix, MatrixMut, max_columns_in_place, multiply, transpose};

/// Rows, or columns, of a register tile of the matrix product. A block of a multiple of it wastes no lanes.
const TILE: usize = 6;
/// Most tiles of a block. Up to `MAX_UNPACKED_TILES`, the matrix product reads its operands in place instead of copying
/// them.
const MAX_TILES: usize = 6;
/// Width from which on a block has at most `MAX_TILES` tiles. In narrower networks, which compute less per row, it has
/// more.
const BROAD_WIDTH: usize = 256;
/// Most tiles of a product that reads its operands in place.
const MAX_UNPACKED_TILES: usize = 8;
/// Numbers of a block of elementwise work.
const ELEMENTWISE_BLOCK: usize = 1 << 15;

/// Returns the most tiles of a block whose rows, or columns, have `width` inputs.
fn max_tiles(width: usize) -> usize {
    (MAX_TILES * BROAD_WIDTH / width.min(BROAD_WIDTH)).min(MAX_UNPACKED_TILES)
}

/// Splits `0..n` into blocks of about equal size, of at most `max_tiles` tiles each, at multiples of a tile.
fn split(n: usize, max_tiles: usize) -> Vec<Range<usize>> {
    let n_tiles = n.div_ceil(TILE);
    split_into(n, n_tiles.div_ceil(max_tiles))
}

/// Splits `0..n` into `n_blocks` blocks of about equal size, at multiples of a tile.
fn split_into(n: usize, n_blocks: usize) -> Vec<Range<usize>> {
    let n_tiles = n.div_ceil(TILE);
    let end_of = |n_before: usize| (n_before * n_tiles / n_blocks * TILE).min(n);
    (0..n_blocks).map(|block| end_of(block)..end_of(block + 1)).collect()
}

/// Splits the elements of a vector of length `n` for elementwise work, and returns the lengths of the parts.
pub fn elementwise_blocks(n: usize) -> impl Iterator<Item = usize> {
    (0..n).step_by(ELEMENTWISE_BLOCK).map(move |start| ELEMENTWISE_BLOCK.min(n - start))
}

impl MlpShape {
    /// Splits the rows of a batch into the blocks of forward and backward passes.
    #[must_use]
    pub fn row_blocks(&self, n_rows: usize) -> Vec<Range<usize>> {
        /// Up to this number of rows, the matrix product has another kernel, with another order of summation, for
        /// single outputs. All blocks of a batch with more rows have more.
        const SINGLE_OUTPUT_ROWS: usize = 256;
        if self.n_output == 1 && n_rows > SINGLE_OUTPUT_ROWS {
            return split_into(n_rows, (n_rows / (SINGLE_OUTPUT_ROWS + 2 * TILE)).max(1));
        }
        split(n_rows, max_tiles(self.n_hidden))
    }

    /// Splits the parameters into consecutive blocks. Together they cover all parameters once, in order.
    #[must_use]
    pub fn parameter_blocks(&self) -> Vec<ParameterBlock> {
        let mut blocks = Vec::new();
        for layer in 0..self.n_layers() {
            let outputs = split(self.layer_output(layer), max_tiles(self.layer_input(layer)));
            blocks.extend(outputs.into_iter().map(|outputs| ParameterBlock { layer, outputs }));
        }
        blocks
    }
}

/// The weights of some outputs of a layer. The last block of a layer includes the bias of the whole layer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ParameterBlock {
    layer: usize,
    outputs: Range<usize>,
}

impl ParameterBlock {
    /// Returns the number of parameters of the block in a network of shape `shape`.
    #[must_use]
    pub const fn len(&self, shape: &MlpShape) -> usize {
        let n_outputs = self.outputs.end - self.outputs.start;
        let n_out = shape.layer_output(self.layer);
        let n_biases = if self.outputs.end == n_out { n_out } else { 0 };
        n_outputs * shape.layer_input(self.layer) + n_biases
    }
}

/// The activations of a batch, and the gradients with respect to them.
#[derive(Debug, Clone)]
pub struct Activations {
    n_hidden: usize,
    /// Outputs of each hidden layer after its ReLU, shape `[max_batch, n_hidden]`.
    hidden: Vec<AlignedVec>,
    /// Gradients with respect to each hidden layer's outputs before its ReLU, shape `[max_batch, n_hidden]`.
    deltas: Vec<AlignedVec>,
}

impl Activations {
    /// Allocates memory for `shape` and batches of up to `max_batch` rows.
    #[must_use]
    pub fn new(shape: &MlpShape, max_batch: usize) -> Self {
        let rows = AlignedVec::zeros(max_batch * shape.n_hidden);
        let layers = vec![rows; shape.n_hidden_layers];
        Self { n_hidden: shape.n_hidden, hidden: layers.clone(), deltas: layers }
    }

    /// Returns the memory of the first `n_rows` rows.
    ///
    /// # Panics
    /// If there are fewer rows.
    pub fn block(&mut self, n_rows: usize) -> RowBlock<'_> {
        let n = n_rows * self.n_hidden;
        RowBlock {
            hidden: self.hidden.iter_mut().map(|rows| &mut rows[..n]).collect(),
            deltas: self.deltas.iter_mut().map(|rows| &mut rows[..n]).collect(),
        }
    }

    /// Returns the memory of consecutive blocks of rows.
    ///
    /// # Panics
    /// If there are fewer rows.
    pub fn blocks(&mut self, blocks: &[Range<usize>]) -> Vec<RowBlock<'_>> {
        let n_layers = self.hidden.len();
        let no_layers = || RowBlock {
            hidden: Vec::with_capacity(n_layers),
            deltas: Vec::with_capacity(n_layers),
        };
        let mut parts: Vec<_> = blocks.iter().map(|_| no_layers()).collect();
        for (hidden, deltas) in self.hidden.iter_mut().zip(&mut self.deltas) {
            let (mut hidden, mut deltas) = (&mut **hidden, &mut **deltas);
            for (part, rows) in parts.iter_mut().zip(blocks) {
                let n = rows.len() * self.n_hidden;
                let (first, rest) = hidden.split_at_mut(n);
                part.hidden.push(first);
                hidden = rest;
                let (first, rest) = deltas.split_at_mut(n);
                part.deltas.push(first);
                deltas = rest;
            }
        }
        parts
    }
}

/// The memory of some consecutive rows of [`Activations`].
#[derive(Debug)]
pub struct RowBlock<'a> {
    hidden: Vec<&'a mut [f32]>,
    deltas: Vec<&'a mut [f32]>,
}

impl RowBlock<'_> {
    /// Computes `output`, shape `[rows, n_output]`, from `input`, shape `[rows, n_input]`, and stores the activations.
    ///
    /// # Panics
    /// If a size does not match `shape` or the block.
    pub fn forward(
        &mut self,
        shape: &MlpShape,
        parameters: &TransposedParameters,
        input: Matrix<'_>,
        output: &mut MatrixMut<'_>,
    ) {
        let n_rows = input.n_rows();
        for layer in 0..shape.n_hidden_layers {
            let (below, above) = self.hidden.split_at_mut(layer);
            let layer_input =
                below.last().map_or(input, |rows| Matrix::new(rows, n_rows, shape.n_hidden));
            let rows = &mut *above[0];
            let mut product = MatrixMut::new(rows, n_rows, shape.n_hidden);
            multiply(&mut product, layer_input, parameters.weight(shape, layer));
            add_bias_relu(rows, parameters.bias(shape, layer));
        }
        let last = shape.n_hidden_layers;
        let layer_input =
            self.hidden.last().map_or(input, |rows| Matrix::new(rows, n_rows, shape.n_hidden));
        multiply(output, layer_input, parameters.weight(shape, last));
        add_bias(output, parameters.bias(shape, last));
    }

    /// Computes and stores the gradient of the loss with respect to the activations, from its gradient with respect to
    /// the output, shape `[rows, n_output]`, after a [`forward`](Self::forward) pass.
    ///
    /// # Panics
    /// If a size does not match `shape` or the block.
    pub fn backward(&mut self, shape: &MlpShape, parameters: &[f32], output_gradient: &[f32]) {
        let n_rows = output_gradient.len() / shape.n_output;
        for layer in (1..shape.n_layers()).rev() {
            let (n_in, n_out) = (shape.layer_input(layer), shape.layer_output(layer));
            let (below, above) = self.deltas.split_at_mut(layer);
            let rows = above.first().map_or(output_gradient, |rows| &**rows);
            let next_rows = &mut *below[layer - 1];
            multiply(
                &mut MatrixMut::new(next_rows, n_rows, n_in),
                Matrix::new(rows, n_rows, n_out),
                shape.weight_matrix(parameters, layer),
            );
            mask(next_rows, self.hidden[layer - 1]);
        }
    }

    /// Computes the gradient of the loss with respect to the input's `columns`, shape `[rows, columns.len()]`, after a
    /// [`backward`](Self::backward) pass for the same `output_gradient`, shape `[rows, n_output]`.
    ///
    /// # Panics
    /// If a size does not match `shape` or the block.
    pub fn input_gradient(
        &self,
        shape: &MlpShape,
        parameters: &[f32],
        output_gradient: &[f32],
        columns: Range<usize>,
        input_gradient: &mut [f32],
    ) {
        let n_rows = output_gradient.len() / shape.n_output;
        let rows = self.deltas.first().map_or(output_gradient, |rows| &**rows);
        let n_out = shape.layer_output(0);
        let weight = &parameters[shape.weight(0)][columns.start..];
        let weight = Matrix::with_stride(weight, n_out, columns.len(), shape.n_input);
        multiply(
            &mut MatrixMut::new(input_gradient, n_rows, columns.len()),
            Matrix::new(rows, n_rows, n_out),
            weight,
        );
    }
}

impl Activations {
    /// Computes the gradient of the loss with respect to the parameters of `block`, from its gradient with respect to
    /// the output, shape `[batch, n_output]`, after a [`RowBlock::backward`] pass over every row of `input`, shape
    /// `[batch, n_input]`.
    ///
    /// # Panics
    /// If a size does not match `shape` or the batch exceeds the activations.
    pub fn parameter_gradient(
        &self,
        shape: &MlpShape,
        block: &ParameterBlock,
        input: Matrix<'_>,
        output_gradient: &[f32],
        gradient: &mut [f32],
    ) {
        let ParameterBlock { layer, outputs } = block;
        let n_rows = input.n_rows();
        let (n_in, n_out) = (shape.layer_input(*layer), shape.layer_output(*layer));
        let rows = self.deltas.get(*layer).map_or(output_gradient, |rows| &rows[..n_rows * n_out]);
        let layer_input = match layer.checked_sub(1) {
            Some(below) => Matrix::new(&self.hidden[below], n_rows, n_in),
            None => input,
        };
        let (weight, bias) = gradient.split_at_mut(outputs.len() * n_in);
        let of_outputs = Matrix::with_stride(&rows[outputs.start..], n_rows, outputs.len(), n_out);
        let max_cols = max_columns_in_place().min(n_in);
        for start in (0..n_in).step_by(max_cols) {
            let n_cols = max_cols.min(n_in - start);
            multiply(
                &mut MatrixMut::with_stride(&mut weight[start..], outputs.len(), n_cols, n_in),
                of_outputs.transposed(),
                layer_input.columns(start..start + n_cols),
            );
        }
        if !bias.is_empty() {
            column_sums(rows, bias);
        }
    }
}

/// The parameters of all layers, with each weight transposed to shape `[in, out]`. A product with a transposed weight is
/// faster than one with a transposed view.
#[derive(Debug, Clone)]
pub struct TransposedParameters(AlignedVec);

impl TransposedParameters {
    /// Copies `parameters`, shape `[n_parameters]`, and transposes the weights.
    #[must_use]
    pub fn new(shape: &MlpShape, parameters: &[f32]) -> Self {
        let mut transposed = Self(AlignedVec::zeros(shape.n_parameters()));
        transposed.update(shape, parameters);
        transposed
    }

    /// Copies `parameters`, shape `[n_parameters]`, and transposes the weights.
    pub fn update(&mut self, shape: &MlpShape, parameters: &[f32]) {
        self.blocks(shape).into_iter().for_each(|block| block.update(shape, parameters));
    }

    /// Splits the memory into blocks that can be updated side by side.
    #[must_use]
    pub fn blocks(&mut self, shape: &MlpShape) -> Vec<TransposedBlock<'_>> {
        let mut blocks = Vec::new();
        let mut rest = &mut *self.0;
        for layer in 0..shape.n_layers() {
            let n_out = shape.layer_output(layer);
            let max_tiles = (ELEMENTWISE_BLOCK / (n_out * TILE)).max(1);
            let n_in = shape.layer_input(layer);
            for inputs in split(n_in, max_tiles) {
                let (weight, others) = rest.split_at_mut(inputs.len() * n_out);
                let n_biases = if inputs.end == n_in { n_out } else { 0 };
                let (bias, others) = others.split_at_mut(n_biases);
                blocks.push(TransposedBlock { layer, inputs, weight, bias });
                rest = others;
            }
        }
        blocks
    }

    /// Returns the parameters as they were before the transposition, shape `[n_parameters]`.
    #[must_use]
    pub fn transposed_back(&self, shape: &MlpShape) -> Vec<f32> {
        let mut parameters = vec![0.0; shape.n_parameters()];
        for layer in 0..shape.n_layers() {
            let (n_in, n_out) = (shape.layer_input(layer), shape.layer_output(layer));
            let weight = &mut parameters[shape.weight(layer)];
            transpose(&self.0[shape.weight(layer)], n_out, weight, n_in, n_out);
            parameters[shape.bias(layer)].copy_from_slice(self.bias(shape, layer));
        }
        parameters
    }

    /// Returns the transposed weight and the bias of each layer, one layer after the other, for elementwise work.
    pub fn as_mut_slice(&mut self) -> &mut [f32] {
        &mut self.0
    }

    /// Returns the transposed weight and the bias of each layer, one layer after the other.
    #[must_use]
    pub fn as_slice(&self) -> &[f32] {
        &self.0
    }

    fn weight(&self, shape: &MlpShape, layer: usize) -> Matrix<'_> {
        let weight = &self.0[shape.weight(layer)];
        Matrix::new(weight, shape.layer_input(layer), shape.layer_output(layer))
    }

    fn bias(&self, shape: &MlpShape, layer: usize) -> &[f32] {
        &self.0[shape.bias(layer)]
    }
}

/// The transposed weights of some inputs of a layer. The last block of a layer includes its bias.
#[derive(Debug)]
pub struct TransposedBlock<'a> {
    layer: usize,
    inputs: Range<usize>,
    /// Shape `[inputs.len(), out]`.
    weight: &'a mut [f32],
    /// Shape `[out]`, or empty.
    bias: &'a mut [f32],
}

impl TransposedBlock<'_> {
    /// Copies the block from `parameters`, shape `[n_parameters]`, and transposes its weights.
    pub fn update(self, shape: &MlpShape, parameters: &[f32]) {
        let Self { layer, inputs, weight, bias } = self;
        let (n_in, n_out) = (shape.layer_input(layer), shape.layer_output(layer));
        let source = &parameters[shape.weight(layer)][inputs.start..];
        transpose(source, n_in, weight, n_out, inputs.len());
        if !bias.is_empty() {
            bias.copy_from_slice(&parameters[shape.bias(layer)]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Asserts that `blocks` cover `0..n` once, in order.
    fn assert_covers(blocks: &[Range<usize>], n: usize) {
        let ends = blocks.iter().map(|block| block.end);
        let starts = std::iter::once(0).chain(ends);
        assert!(blocks.iter().zip(starts).all(|(block, start)| block.start == start), "{blocks:?}");
        assert_eq!(blocks.last().map(|block| block.end), Some(n));
    }

    #[test]
    fn blocks_cover_all_rows_and_none_is_much_smaller() {
        for n_hidden in [6, 64, 256, 300] {
            for n_output in [1, 2, 8] {
                let shape = MlpShape { n_input: 62, n_hidden, n_hidden_layers: 2, n_output };
                for n_rows in (1..=600).chain([4096, 65_536]) {
                    let blocks = shape.row_blocks(n_rows);
                    assert_covers(&blocks, n_rows);
                    let smallest = blocks.iter().map(Range::len).min().unwrap();
                    let is_single = n_output == 1 && n_rows > 256;
                    let least = if is_single { 257 } else { n_rows.min(2 * TILE + 1) };
                    assert!(smallest >= least, "{smallest} of {n_rows} rows");
                }
            }
        }
    }

    #[test]
    fn transposing_twice_restores_the_parameters() {
        for (n_hidden, n_output) in [(6, 1), (37, 2), (256, 8)] {
            let shape = MlpShape { n_input: 62, n_hidden, n_hidden_layers: 3, n_output };
            let parameters: Vec<f32> = (0..shape.n_parameters()).map(|idx| idx as f32).collect();
            let transposed = TransposedParameters::new(&shape, &parameters);
            assert_ne!(transposed.as_slice(), parameters);
            assert_eq!(transposed.transposed_back(&shape), parameters);
        }
    }

    #[test]
    fn blocks_of_parameters_cover_all_parameters_once() {
        for (n_hidden, n_output) in [(6, 1), (37, 2), (64, 3), (256, 8), (300, 8)] {
            let shape = MlpShape { n_input: 62, n_hidden, n_hidden_layers: 3, n_output };
            let blocks = shape.parameter_blocks();
            let n_parameters: usize = blocks.iter().map(|block| block.len(&shape)).sum();
            assert_eq!(n_parameters, shape.n_parameters());
            for layer in 0..shape.n_layers() {
                let of_layer = blocks.iter().filter(|block| block.layer == layer);
                let outputs: Vec<_> = of_layer.map(|block| block.outputs.clone()).collect();
                assert_covers(&outputs, shape.layer_output(layer));
            }
        }
    }
}
