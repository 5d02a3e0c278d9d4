//! The loops between matrix products, compiled for each instruction set and chosen at run time.
//!
//! None of them adds up across lanes and none contracts a product and a sum, so every instruction set gives the same
//! bits.

use pulp::Arch;

use crate::matrix::MatrixMut;

/// Hyperbolic tangent, the same bits on every platform.
#[must_use]
pub fn tanh(x: f32) -> f32 {
    libm::tanhf(x)
}

/// Whether no number is infinite or NaN.
#[must_use]
pub fn all_finite(numbers: &[f32]) -> bool {
    const INFINITY_BITS: u32 = f32::INFINITY.to_bits();
    Arch::new().dispatch(|| {
        let magnitude = |number: &f32| number.to_bits() & (u32::MAX >> 1);
        numbers.iter().map(magnitude).fold(0, u32::max) < INFINITY_BITS
    })
}

/// `rows = max(rows + bias, 0)`; `rows` has shape `[n, bias.len()]`.
pub(crate) fn add_bias_relu(rows: &mut [f32], bias: &[f32]) {
    #[inline(always)]
    fn row_kernel(row: &mut [f32], bias: &[f32]) {
        for (x, bias) in row.iter_mut().zip(bias) {
            *x = (*x + *bias).max(0.0);
        }
    }
    Arch::new().dispatch(|| {
        for row in rows.chunks_exact_mut(bias.len()) {
            row_kernel(row, bias);
        }
    });
}

/// Adds `bias` to every row.
pub(crate) fn add_bias(rows: &mut MatrixMut<'_>, bias: &[f32]) {
    for row in rows.rows_mut() {
        for (x, bias) in row.iter_mut().zip(bias) {
            *x += *bias;
        }
    }
}

/// Back through a ReLU: clears `delta` where the unit was off.
pub(crate) fn mask(delta: &mut [f32], activations: &[f32]) {
    Arch::new().dispatch(|| {
        for (delta, activation) in delta.iter_mut().zip(activations) {
            *delta = if *activation > 0.0 { *delta } else { 0.0 };
        }
    });
}

/// As [`mask`], and adds up each column of the result: the bias gradient, shape `[n_units]`.
pub(crate) fn mask_and_sum(delta: &mut [f32], activations: &[f32], sums: &mut [f32]) {
    #[inline(always)]
    fn row_kernel(delta: &mut [f32], activations: &[f32], sums: &mut [f32]) {
        for ((delta, activation), sum) in delta.iter_mut().zip(activations).zip(sums) {
            let kept = if *activation > 0.0 { *delta } else { 0.0 };
            *delta = kept;
            *sum += kept;
        }
    }
    sums.fill(0.0);
    let n_units = sums.len();
    Arch::new().dispatch(|| {
        for (delta, activations) in
            delta.chunks_exact_mut(n_units).zip(activations.chunks_exact(n_units))
        {
            row_kernel(delta, activations, sums);
        }
    });
}

/// The sum of each column of `rows`, shape `[n, sums.len()]`.
pub(crate) fn column_sums(rows: &[f32], sums: &mut [f32]) {
    sums.fill(0.0);
    for row in rows.chunks_exact(sums.len()) {
        for (sum, x) in sums.iter_mut().zip(row) {
            *sum += *x;
        }
    }
}

/// `into = keep * into + (1 - keep) * from`.
pub(crate) fn blend(into: &mut [f32], from: &[f32], keep: f32) {
    Arch::new().dispatch(|| {
        for (into, from) in into.iter_mut().zip(from) {
            *into = keep * *into + (1.0 - keep) * *from;
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn infinities_and_nans_are_found_wherever_they_stand() {
        for position in [0, 37, 99] {
            for bad in [f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                let mut numbers = [f32::MAX; 100];
                assert!(all_finite(&numbers));
                numbers[position] = bad;
                assert!(!all_finite(&numbers), "{bad} at {position}");
            }
        }
    }
}
