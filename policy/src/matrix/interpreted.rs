//! The matrix product for Miri, which does not support the SIMD instructions of the `gemm` crate.

use gemm::Parallelism;

/// Performs the accesses of `gemm::gemm` through the same pointers, one number at a time.
///
/// # Safety
/// As for `gemm::gemm`: every element of the factors can be read, and every element of `product` written.
#[expect(unsafe_code, reason = "Miri checks the accesses that the caller guarantees to be valid")]
#[expect(clippy::too_many_arguments, reason = "the arguments of gemm::gemm")]
#[expect(clippy::fn_params_excessive_bools, reason = "the arguments of gemm::gemm")]
pub(super) unsafe fn gemm(
    n_rows: usize,
    n_cols: usize,
    n_inner: usize,
    product: *mut f32,
    product_col_stride: isize,
    product_row_stride: isize,
    _read_product: bool,
    lhs: *const f32,
    lhs_col_stride: isize,
    lhs_row_stride: isize,
    rhs: *const f32,
    rhs_col_stride: isize,
    rhs_row_stride: isize,
    _alpha: f32,
    _beta: f32,
    _conj_product: bool,
    _conj_lhs: bool,
    _conj_rhs: bool,
    _parallelism: Parallelism,
) {
    let at = |row: usize, row_stride: isize, col: usize, col_stride: isize| {
        row.cast_signed() * row_stride + col.cast_signed() * col_stride
    };
    for row in 0..n_rows {
        for col in 0..n_cols {
            let mut sum = 0.0;
            for inner in 0..n_inner {
                // SAFETY: the caller guarantees that every element of both factors is readable.
                sum += unsafe {
                    *lhs.offset(at(row, lhs_row_stride, inner, lhs_col_stride))
                        * *rhs.offset(at(inner, rhs_row_stride, col, rhs_col_stride))
                };
            }
            // SAFETY: the caller guarantees that every element of the product is writable.
            unsafe { *product.offset(at(row, product_row_stride, col, product_col_stride)) = sum };
        }
    }
}
