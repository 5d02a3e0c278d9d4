//! Matrix products whose operands end with their slices. Under a sanitizer or Miri, an access beyond the end fails.

use tandem_policy::{Matrix, MatrixMut, multiply};

/// Sizes below and above those of the kernels' tiles. Miri interprets every access, so it runs fewer.
const SIZES: &[usize] = if cfg!(miri) { &[1, 2, 5] } else { &[1, 2, 3, 7, 8, 9, 16, 17, 31, 33] };

/// Numbers that distinguish neighbouring elements.
fn numbers(n: usize) -> Box<[f32]> {
    // A boxed slice has no spare capacity beyond its end.
    (0..n).map(|i| (i % 13) as f32 - 6.0).collect()
}

/// Returns the length of a row-major matrix whose rows start `row_stride` apart, without padding after the last row.
fn span(n_rows: usize, n_cols: usize, row_stride: usize) -> usize {
    (n_rows - 1) * row_stride + n_cols
}

/// Computes an element of the product by definition.
fn element(lhs: impl Fn(usize) -> f32, rhs: impl Fn(usize) -> f32, n_inner: usize) -> f32 {
    (0..n_inner).map(|inner| lhs(inner) * rhs(inner)).sum()
}

fn check_product([n_rows, n_inner, n_cols]: [usize; 3], gap: usize, transposed: bool) {
    let (lhs_stride, product_stride) = (n_inner + gap, n_cols + gap);
    let lhs = numbers(span(n_rows, n_inner, lhs_stride));
    let (rhs_rows, rhs_cols) = if transposed { (n_cols, n_inner) } else { (n_inner, n_cols) };
    let rhs_stride = rhs_cols + gap;
    let rhs = numbers(span(rhs_rows, rhs_cols, rhs_stride));
    let mut product = vec![f32::NAN; span(n_rows, n_cols, product_stride)].into_boxed_slice();
    let rhs_matrix = Matrix::with_stride(&rhs, rhs_rows, rhs_cols, rhs_stride);
    multiply(
        &mut MatrixMut::with_stride(&mut product, n_rows, n_cols, product_stride),
        Matrix::with_stride(&lhs, n_rows, n_inner, lhs_stride),
        if transposed { rhs_matrix.transposed() } else { rhs_matrix },
    );
    for (at, got) in product.iter().enumerate() {
        let (row, col) = (at / product_stride, at % product_stride);
        if col >= n_cols {
            assert!(got.is_nan(), "a number between the rows was written");
            continue;
        }
        let rhs_at =
            |inner| if transposed { col * rhs_stride + inner } else { inner * rhs_stride + col };
        let expected =
            element(|inner| lhs[row * lhs_stride + inner], |inner| rhs[rhs_at(inner)], n_inner);
        assert_eq!(
            *got, expected,
            "{n_rows} x {n_inner} x {n_cols}, gap {gap}, row {row}, column {col}"
        );
    }
}

#[test]
fn a_product_stays_within_its_slices() {
    for n_rows in SIZES {
        for n_inner in SIZES {
            for n_cols in SIZES {
                for (gap, transposed) in [(0, false), (0, true), (3, false), (3, true)] {
                    check_product([*n_rows, *n_inner, *n_cols], gap, transposed);
                }
            }
        }
    }
}

#[test]
fn slices_that_are_one_number_too_short_are_refused() {
    let refuses = |n_rows: usize, n_cols: usize, row_stride: usize| {
        let mut short = numbers(span(n_rows, n_cols, row_stride) - 1);
        let reads = std::panic::catch_unwind(|| {
            Matrix::with_stride(&numbers(short.len()), n_rows, n_cols, row_stride).n_rows()
        });
        let writes = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            MatrixMut::with_stride(&mut short, n_rows, n_cols, row_stride).rows_mut().count()
        }));
        reads.is_err() && writes.is_err()
    };
    assert!(refuses(1, 2, 2) && refuses(3, 5, 5) && refuses(4, 3, 7));
}
