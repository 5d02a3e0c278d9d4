//! Matrices as views of flat slices, and their product.

use std::ops::Range;

#[cfg(miri)]
mod interpreted;

#[cfg(not(miri))]
use gemm::gemm;
#[cfg(miri)]
use interpreted::gemm;
use pulp::{Arch, Simd, WithSimd};

/// A read-only view of a slice as a matrix, with any strides.
#[derive(Debug, Clone, Copy)]
pub struct Matrix<'a> {
    data: &'a [f32],
    n_rows: usize,
    n_cols: usize,
    row_stride: usize,
    col_stride: usize,
}

impl<'a> Matrix<'a> {
    /// Creates a contiguous row-major matrix of shape `[n_rows, n_cols]`.
    ///
    /// # Panics
    /// If `data` is too short or a dimension is 0.
    #[must_use]
    pub fn new(data: &'a [f32], n_rows: usize, n_cols: usize) -> Self {
        Self::with_stride(data, n_rows, n_cols, n_cols)
    }

    /// Creates a row-major matrix of shape `[n_rows, n_cols]` whose rows start `row_stride` numbers apart.
    ///
    /// # Panics
    /// If `data` is too short or a dimension is 0.
    #[must_use]
    pub fn with_stride(data: &'a [f32], n_rows: usize, n_cols: usize, row_stride: usize) -> Self {
        assert!(fits(data.len(), n_rows, n_cols, row_stride), "a matrix larger than its data");
        Self { data, n_rows, n_cols, row_stride, col_stride: 1 }
    }

    /// Returns the transpose, a view of the same numbers.
    #[must_use]
    pub const fn transposed(self) -> Self {
        Self {
            data: self.data,
            n_rows: self.n_cols,
            n_cols: self.n_rows,
            row_stride: self.col_stride,
            col_stride: self.row_stride,
        }
    }

    /// Returns the number of rows.
    #[must_use]
    pub const fn n_rows(&self) -> usize {
        self.n_rows
    }

    /// Returns some columns, a view of the same numbers.
    ///
    /// # Panics
    /// If the matrix has fewer columns.
    #[must_use]
    pub fn columns(self, columns: Range<usize>) -> Self {
        assert!(columns.end <= self.n_cols, "columns beyond the matrix");
        Self { data: &self.data[columns.start * self.col_stride..], n_cols: columns.len(), ..self }
    }
}

/// A mutable view of a slice as a row-major matrix.
#[derive(Debug)]
pub struct MatrixMut<'a> {
    data: &'a mut [f32],
    n_rows: usize,
    n_cols: usize,
    row_stride: usize,
}

impl<'a> MatrixMut<'a> {
    /// Creates a contiguous matrix of shape `[n_rows, n_cols]`.
    ///
    /// # Panics
    /// If `data` is too short or a dimension is 0.
    #[must_use]
    pub fn new(data: &'a mut [f32], n_rows: usize, n_cols: usize) -> Self {
        Self::with_stride(data, n_rows, n_cols, n_cols)
    }

    /// Creates a matrix of shape `[n_rows, n_cols]` whose rows start `row_stride` numbers apart.
    ///
    /// # Panics
    /// If `data` is too short, rows overlap or a dimension is 0.
    #[must_use]
    pub fn with_stride(
        data: &'a mut [f32],
        n_rows: usize,
        n_cols: usize,
        row_stride: usize,
    ) -> Self {
        assert!(fits(data.len(), n_rows, n_cols, row_stride), "a matrix larger than its data");
        assert!(n_cols <= row_stride, "rows overlap");
        Self { data, n_rows, n_cols, row_stride }
    }

    /// Returns the rows, in order.
    pub fn rows_mut(&mut self) -> impl Iterator<Item = &mut [f32]> {
        let n_cols = self.n_cols;
        self.data.chunks_mut(self.row_stride).take(self.n_rows).map(move |row| &mut row[..n_cols])
    }
}

/// Returns `true` if the last element of a row-major matrix lies within `len` numbers.
fn fits(len: usize, n_rows: usize, n_cols: usize, row_stride: usize) -> bool {
    n_rows > 0
        && n_cols > 0
        && (n_rows - 1)
            .checked_mul(row_stride)
            .and_then(|start| start.checked_add(n_cols))
            .is_some_and(|end| end <= len)
}

/// Computes `product = lhs · rhs` on the calling thread.
///
/// The kernel is chosen at run time for the processor. On one machine, the result depends on the operands only; a
/// machine with another instruction set may sum in another order.
///
/// # Panics
/// If the shapes do not match.
pub fn multiply(product: &mut MatrixMut<'_>, lhs: Matrix<'_>, rhs: Matrix<'_>) {
    let shapes = (product.n_rows, lhs.n_cols, rhs.n_cols);
    assert_eq!(
        shapes,
        (lhs.n_rows, rhs.n_rows, product.n_cols),
        "shapes of a product do not match"
    );
    let (alpha_of_product, beta_of_operands) = (0.0, 1.0);
    #[expect(unsafe_code, reason = "the matrix product takes pointers")]
    // SAFETY: the constructors checked that the last element of each matrix lies within its slice, the shapes match,
    // and `product` is borrowed mutably, with rows that do not overlap.
    unsafe {
        gemm(
            product.n_rows,
            product.n_cols,
            lhs.n_cols,
            product.data.as_mut_ptr(),
            1,
            stride(product.row_stride),
            false,
            lhs.data.as_ptr(),
            stride(lhs.col_stride),
            stride(lhs.row_stride),
            rhs.data.as_ptr(),
            stride(rhs.col_stride),
            stride(rhs.row_stride),
            alpha_of_product,
            beta_of_operands,
            false,
            false,
            false,
            gemm::Parallelism::None,
        );
    }
}

/// Returns the most columns of a product for which [`multiply`] reads a first factor in place although it is a transposed
/// view. With more columns it copies that factor first, which takes longer than a second product.
///
/// Only the tiles of AVX-512, 64 columns each, are broad enough for such products.
pub(crate) fn max_columns_in_place() -> usize {
    #[cfg(target_arch = "x86_64")]
    if matches!(Arch::new(), Arch::V4(_)) {
        return 2 * 64;
    }
    usize::MAX
}

/// Writes the transpose of `source`, shape `[n_rows, n_cols]`, to `transposed`, shape `[n_cols, n_rows]`. The rows of
/// `source` start `row_stride` numbers apart.
///
/// # Panics
/// If a slice is too short.
pub(crate) fn transpose(
    source: &[f32],
    row_stride: usize,
    transposed: &mut [f32],
    n_rows: usize,
    n_cols: usize,
) {
    Arch::new().dispatch(Transpose { source, row_stride, transposed, n_rows, n_cols });
}

/// The transposition that [`transpose`] compiles for each instruction set. A closure of this size would not be inlined.
struct Transpose<'a> {
    source: &'a [f32],
    row_stride: usize,
    transposed: &'a mut [f32],
    n_rows: usize,
    n_cols: usize,
}

impl WithSimd for Transpose<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { source, row_stride, transposed, n_rows, n_cols } = self;
        for row in (0..n_rows).step_by(TILE) {
            for col in (0..n_cols).step_by(TILE) {
                if row + TILE <= n_rows && col + TILE <= n_cols {
                    transpose_tile(
                        &source[row * row_stride + col..],
                        row_stride,
                        &mut transposed[col * n_rows + row..],
                        n_rows,
                    );
                    continue;
                }
                for row in row..n_rows.min(row + TILE) {
                    for col in col..n_cols.min(col + TILE) {
                        transposed[col * n_rows + row] = source[row * row_stride + col];
                    }
                }
            }
        }
    }
}

/// Side of a square tile that fits the registers.
const TILE: usize = 16;

/// Transposes one tile. Rows of `source` and of `transposed` start their stride apart.
#[inline(always)]
fn transpose_tile(
    source: &[f32],
    source_stride: usize,
    transposed: &mut [f32],
    transposed_stride: usize,
) {
    let mut rows = [[0.0; TILE]; TILE];
    for (row_idx, row) in rows.iter_mut().enumerate() {
        *row = *tile_row(&source[row_idx * source_stride..]);
    }
    for col in 0..TILE {
        let mut column = [0.0; TILE];
        for (x, row) in column.iter_mut().zip(&rows) {
            *x = row[col];
        }
        transposed[col * transposed_stride..][..TILE].copy_from_slice(&column);
    }
}

#[inline(always)]
fn tile_row(row: &[f32]) -> &[f32; TILE] {
    row.first_chunk().expect("a tile lies within its matrix")
}

fn stride(n: usize) -> isize {
    isize::try_from(n).expect("no slice is longer than isize::MAX")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_product_of_strided_and_transposed_matrices_is_right() {
        let lhs = [1.0, 2.0, 9.0, 3.0, 4.0, 9.0];
        let rhs = [1.0, 10.0, 100.0, 1000.0];
        let mut product = [7.0; 5];
        multiply(
            &mut MatrixMut::with_stride(&mut product, 2, 2, 3),
            Matrix::with_stride(&lhs, 2, 2, 3),
            Matrix::new(&rhs, 2, 2).transposed(),
        );
        assert_eq!(product, [21.0, 2100.0, 7.0, 43.0, 4300.0]);
    }

    #[test]
    fn a_transpose_exchanges_rows_and_columns() {
        for (n_rows, n_cols) in [(1, 3), (16, 16), (33, 50), (256, 62)] {
            let source: Vec<f32> = (0..n_rows * n_cols).map(|i| i as f32).collect();
            let mut transposed = vec![0.0; source.len()];
            transpose(&source, n_cols, &mut transposed, n_rows, n_cols);
            for (i, x) in transposed.iter().enumerate() {
                let (col, row) = (i / n_rows, i % n_rows);
                assert_eq!(
                    *x,
                    source[row * n_cols + col],
                    "row {row}, column {col} of {n_rows} x {n_cols}"
                );
            }
        }
    }

    #[test]
    #[should_panic(expected = "a matrix larger than its data")]
    fn a_matrix_cannot_reach_beyond_its_slice() {
        assert_eq!(Matrix::with_stride(&[0.0; 5], 2, 3, 3).n_rows(), 2);
    }
}
