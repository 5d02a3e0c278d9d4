//! A memory layout of a network for inference on a few rows at a time.
//!
//! Every output is a chain of fused multiply-adds over the inputs in order, starting from the bias. The chain does not
//! depend on the number of rows or the width of the vector registers, so a row gives the same bits in any batch and on
//! any machine with a correctly rounded fused multiply-add.

use pulp::{Arch, Simd, WithSimd};

use crate::mlp::MlpShape;

/// Largest number of rows of a pass.
pub(crate) const MAX_ROWS: usize = 32;
/// Number of outputs computed side by side.
const PANEL: usize = 64;

/// The parameters of a layer, with outputs in groups of [`PANEL`]; the last group is padded with zeros.
#[derive(Debug, Clone)]
struct PackedLayer {
    n_input: usize,
    /// Shape `[n_panels, n_input, PANEL]`.
    weights: Vec<[f32; PANEL]>,
    /// Shape `[n_panels, PANEL]`.
    biases: Vec<[f32; PANEL]>,
}

/// The packed parameters of a network, and the memory for a pass.
#[derive(Debug, Clone)]
pub(crate) struct PackedMlp {
    layers: Vec<PackedLayer>,
    n_input: usize,
    n_output: usize,
    /// Distance between rows of `input` and of `output`, in numbers.
    row_stride: usize,
    /// Input rows of a layer, shape `[MAX_ROWS, row_stride]`.
    input: Vec<f32>,
    /// Output rows of a layer, shape `[MAX_ROWS, row_stride]`.
    output: Vec<f32>,
}

impl PackedMlp {
    /// Packs `parameters`, shape `[n_parameters]`.
    pub(crate) fn new(shape: &MlpShape, parameters: &[f32]) -> Self {
        let layers: Vec<_> =
            (0..shape.n_layers()).map(|layer| PackedLayer::new(shape, parameters, layer)).collect();
        let widest = shape.n_input.max(shape.n_hidden).max(shape.n_output);
        let row_stride = widest.next_multiple_of(PANEL);
        Self {
            layers,
            n_input: shape.n_input,
            n_output: shape.n_output,
            row_stride,
            input: vec![0.0; MAX_ROWS * row_stride],
            output: vec![0.0; MAX_ROWS * row_stride],
        }
    }

    /// Returns input row `row_idx`, shape `[n_input]`, to be filled before [`Self::run`].
    pub(crate) fn input_row(&mut self, row_idx: usize) -> &mut [f32] {
        let start = row_idx * self.row_stride;
        &mut self.input[start..start + self.n_input]
    }

    /// Returns output row `row_idx`, shape `[n_output]`, after [`Self::run`].
    pub(crate) fn output_row(&self, row_idx: usize) -> &[f32] {
        let start = row_idx * self.row_stride;
        &self.output[start..start + self.n_output]
    }

    /// Passes the first `n_rows` input rows, at most [`MAX_ROWS`], through the network.
    pub(crate) fn run(&mut self, n_rows: usize) {
        Arch::new().dispatch(Pass { network: self, n_rows });
    }

    #[inline(always)]
    fn pass<S: Simd>(&mut self, simd: S, n_rows: usize) {
        for (layer_idx, layer) in self.layers.iter().enumerate() {
            if layer_idx > 0 {
                std::mem::swap(&mut self.input, &mut self.output);
                relu(&mut self.input[..n_rows * self.row_stride]);
            }
            layer.apply(simd, &self.input, &mut self.output, self.row_stride, n_rows);
        }
    }
}

/// The pass that [`PackedMlp::run`] compiles for each instruction set. A closure of this size would not be inlined.
struct Pass<'a> {
    network: &'a mut PackedMlp,
    n_rows: usize,
}

impl WithSimd for Pass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        self.network.pass(simd, self.n_rows);
    }
}

impl PackedLayer {
    fn new(shape: &MlpShape, parameters: &[f32], layer: usize) -> Self {
        let (n_input, n_output) = (shape.layer_input(layer), shape.layer_output(layer));
        let n_panels = n_output.div_ceil(PANEL);
        let mut weights = vec![[0.0; PANEL]; n_panels * n_input];
        let mut biases = vec![[0.0; PANEL]; n_panels];
        let rows = parameters[shape.weight(layer)].chunks_exact(n_input);
        for (output_idx, (row, bias)) in rows.zip(&parameters[shape.bias(layer)]).enumerate() {
            let (panel, lane) = (output_idx / PANEL, output_idx % PANEL);
            biases[panel][lane] = *bias;
            for (weights, weight) in
                weights[panel * n_input..(panel + 1) * n_input].iter_mut().zip(row)
            {
                weights[lane] = *weight;
            }
        }
        Self { n_input, weights, biases }
    }

    #[inline(always)]
    fn apply<S: Simd>(
        &self,
        simd: S,
        input: &[f32],
        output: &mut [f32],
        row_stride: usize,
        n_rows: usize,
    ) {
        let panels = self.weights.chunks_exact(self.n_input).zip(&self.biases);
        for (panel_idx, (weights, bias)) in panels.enumerate() {
            let column = panel_idx * PANEL;
            let mut row_idx = 0;
            while row_idx < n_rows {
                let input = &input[row_idx * row_stride..];
                let output = &mut output[row_idx * row_stride + column..];
                row_idx += match n_rows - row_idx {
                    1 => tile::<S, 1, 4>(simd, weights, bias, input, output, row_stride),
                    2 | 3 => tile::<S, 2, 4>(simd, weights, bias, input, output, row_stride),
                    _ => tile::<S, 4, 2>(simd, weights, bias, input, output, row_stride),
                };
            }
        }
    }
}

/// Computes one panel of outputs for `ROWS` rows, `VECTORS` registers of each row at a time, and returns `ROWS`.
///
/// The registers are explicit, because the compiler leaves the sums of several rows in scalars.
#[inline(always)]
fn tile<S: Simd, const ROWS: usize, const VECTORS: usize>(
    simd: S,
    weights: &[[f32; PANEL]],
    bias: &[f32; PANEL],
    input: &[f32],
    output: &mut [f32],
    row_stride: usize,
) -> usize {
    let rows: [&[f32]; ROWS] =
        std::array::from_fn(|row| &input[row * row_stride..][..weights.len()]);
    let (bias, _) = S::as_simd_f32s(bias);
    for (group, bias) in bias.as_chunks::<VECTORS>().0.iter().enumerate() {
        let mut sums = [*bias; ROWS];
        for (input_idx, weights) in weights.iter().enumerate() {
            let weights = S::as_simd_f32s(weights).0.as_chunks::<VECTORS>().0[group];
            for (sums, row) in sums.iter_mut().zip(rows) {
                let x = simd.splat_f32s(row[input_idx]);
                for (sum, weight) in sums.iter_mut().zip(weights) {
                    *sum = simd.mul_add_f32s(x, weight, *sum);
                }
            }
        }
        for (row, sums) in sums.iter().enumerate() {
            let (output, _) = S::as_mut_simd_f32s(&mut output[row * row_stride..][..PANEL]);
            output.as_chunks_mut::<VECTORS>().0[group] = *sums;
        }
    }
    ROWS
}

#[inline(always)]
fn relu(rows: &mut [f32]) {
    for x in rows {
        *x = x.max(0.0);
    }
}

#[cfg(test)]
mod tests {
    use pulp::Scalar;
    use tandem_core::rng::uniform;
    use tandem_core::{Stream, episode_rng};

    use super::*;
    use crate::matrix::{Matrix, MatrixMut};
    use crate::mlp::{Workspace, forward};

    const SHAPE: MlpShape = MlpShape { n_input: 31, n_hidden: 70, n_hidden_layers: 3, n_output: 4 };

    /// A network, its parameters and `MAX_ROWS` input rows.
    fn network() -> (PackedMlp, Vec<f32>, Vec<f32>) {
        let mut rng = episode_rng(3, 0, Stream::Initialisation);
        let mut parameters = SHAPE.initialise(&mut rng);
        for layer in 0..SHAPE.n_layers() {
            parameters[SHAPE.bias(layer)].fill_with(|| uniform(&mut rng, -0.5, 0.5));
        }
        let rows = (0..MAX_ROWS * SHAPE.n_input).map(|_| uniform(&mut rng, -2.0, 2.0)).collect();
        (PackedMlp::new(&SHAPE, &parameters), parameters, rows)
    }

    fn outputs(
        network: &mut PackedMlp,
        rows: &[f32],
        pass: impl Fn(&mut PackedMlp, usize),
    ) -> Vec<f32> {
        let n_rows = rows.len() / SHAPE.n_input;
        for (row_idx, row) in rows.chunks_exact(SHAPE.n_input).enumerate() {
            network.input_row(row_idx).copy_from_slice(row);
        }
        pass(network, n_rows);
        (0..n_rows).flat_map(|row_idx| network.output_row(row_idx).to_vec()).collect()
    }

    #[test]
    fn a_row_gives_the_same_bits_in_any_batch() {
        let (mut network, _, rows) = network();
        let all = outputs(&mut network, &rows, PackedMlp::run);
        for n_rows in 1..=9 {
            let some = outputs(&mut network, &rows[..n_rows * SHAPE.n_input], PackedMlp::run);
            assert_eq!(some, all[..n_rows * SHAPE.n_output], "{n_rows} rows");
        }
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        let (mut network, _, rows) = network();
        let dispatched = outputs(&mut network, &rows, PackedMlp::run);
        assert_eq!(
            dispatched,
            outputs(&mut network, &rows, |network, n_rows| network.pass(Scalar::new(), n_rows)),
            "baseline instructions"
        );
    }

    #[test]
    fn packed_inference_agrees_with_the_forward_pass_of_training() {
        let (mut network, parameters, rows) = network();
        let packed = outputs(&mut network, &rows, PackedMlp::run);
        let mut learned = vec![0.0; packed.len()];
        let mut output = MatrixMut::new(&mut learned, MAX_ROWS, SHAPE.n_output);
        let input = Matrix::new(&rows, MAX_ROWS, SHAPE.n_input);
        forward(&SHAPE, &parameters, input, &mut Workspace::new(&SHAPE, MAX_ROWS), &mut output);
        for (packed, learned) in packed.iter().zip(&learned) {
            assert!((packed - learned).abs() < 1e-5, "{packed} against {learned}");
        }
    }
}
