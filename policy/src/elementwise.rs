//! Elementwise loops, compiled for several instruction sets of which one is chosen at run time.
//!
//! No loop sums across lanes or fuses a product with a sum, so all instruction sets give the same bits.

use pulp::Arch;

use crate::matrix::MatrixMut;

/// Computes the hyperbolic tangent, with the same bits on every platform.
#[must_use]
pub fn tanh(x: f32) -> f32 {
    libm::tanhf(x)
}

/// Returns `true` if no number is infinite or NaN.
#[must_use]
pub fn all_finite(numbers: &[f32]) -> bool {
    const INFINITY_BITS: u32 = f32::INFINITY.to_bits();
    Arch::new().dispatch(|| {
        let magnitude = |number: &f32| number.to_bits() & (u32::MAX >> 1);
        numbers.iter().map(magnitude).fold(0, u32::max) < INFINITY_BITS
    })
}

/// Computes `rows = max(rows + bias, 0)`. `rows` has shape `[n, bias.len()]`.
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

/// Propagates a gradient through a ReLU: sets `delta` to 0 where the activation is not positive.
pub(crate) fn mask(delta: &mut [f32], activations: &[f32]) {
    Arch::new().dispatch(|| {
        for (delta, activation) in delta.iter_mut().zip(activations) {
            *delta = if *activation > 0.0 { *delta } else { 0.0 };
        }
    });
}

/// Writes the sum of each column of `rows`, shape `[n, sums.len()]`, to `sums`.
pub(crate) fn column_sums(rows: &[f32], sums: &mut [f32]) {
    #[inline(always)]
    fn row_kernel(row: &[f32], sums: &mut [f32]) {
        for (sum, x) in sums.iter_mut().zip(row) {
            *sum += *x;
        }
    }
    sums.fill(0.0);
    Arch::new().dispatch(|| {
        for row in rows.chunks_exact(sums.len()) {
            row_kernel(row, sums);
        }
    });
}

/// Computes `target = keep * target + (1 - keep) * source`.
pub(crate) fn blend(target: &mut [f32], source: &[f32], keep: f32) {
    Arch::new().dispatch(|| {
        for (target, source) in target.iter_mut().zip(source) {
            *target = keep * *target + (1.0 - keep) * *source;
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn infinities_and_nans_are_found_at_any_position() {
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
