//! Constant tensors.

use crate::error::ModelError;
use crate::onnx_proto::{BOOL, EXTERNAL, FLOAT, TensorProto};

/// A constant tensor, possibly transposed. Its numbers are copied when a node uses them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Constant<'a> {
    tensor: &'a TensorProto,
    is_transposed: bool,
}

impl<'a> Constant<'a> {
    pub(super) const fn new(tensor: &'a TensorProto) -> Self {
        Self { tensor, is_transposed: false }
    }

    /// Returns the transpose of a matrix.
    pub(super) const fn transposed(self) -> Self {
        Self { is_transposed: !self.is_transposed, ..self }
    }

    pub(super) fn refused(&self, problem: impl Into<String>) -> ModelError {
        let tensor = tandem_core::text::shortened(&self.tensor.name, 80);
        ModelError::Tensor { tensor, problem: problem.into() }
    }

    /// Returns the number of dimensions.
    pub(super) const fn rank(&self) -> usize {
        self.tensor.dims.len()
    }

    /// Returns the number of numbers, after checking type, shape and location.
    pub(super) fn len(&self) -> Result<usize, ModelError> {
        let tensor = self.tensor;
        if tensor.data_location == EXTERNAL {
            return Err(self.refused(
                "its numbers are in another file (external data): export the model into one file, in PyTorch with \
                 torch.onnx.export(..., external_data=False)",
            ));
        }
        if tensor.data_type != FLOAT {
            let got = tensor.data_type;
            return Err(self.refused(format!("its type is number {got}, expected 1 (float32)")));
        }
        let product = tensor.dims.iter().try_fold(1_usize, |product, dimension| {
            product.checked_mul(usize::try_from(*dimension).ok()?)
        });
        let n_raw = tensor.raw_data.len() / size_of::<f32>();
        let n = if tensor.raw_data.is_empty() { tensor.float_data.len() } else { n_raw };
        let is_whole = tensor.raw_data.len().is_multiple_of(size_of::<f32>());
        if product != Some(n) || n == 0 || !is_whole {
            let dims = &tensor.dims;
            return Err(self.refused(format!("it has {n} numbers, its shape is {dims:?}")));
        }
        Ok(n)
    }

    /// Returns the shape of a matrix, `[rows, columns]`.
    pub(super) fn matrix_shape(&self) -> Result<[usize; 2], ModelError> {
        self.len()?;
        let size = |dimension: i64| usize::try_from(dimension).unwrap_or_default();
        match self.tensor.dims.as_slice() {
            [rows, columns] if self.is_transposed => Ok([size(*columns), size(*rows)]),
            [rows, columns] => Ok([size(*rows), size(*columns)]),
            dims => Err(self.refused(format!("its shape is {dims:?}, expected a matrix"))),
        }
    }

    /// Returns the finite numbers of a matrix, row-major.
    pub(super) fn matrix(&self) -> Result<Vec<f32>, ModelError> {
        let [n_rows, n_columns] = self.matrix_shape()?;
        let stored = self.numbers()?;
        if !self.is_transposed {
            return Ok(stored);
        }
        // Stored as [columns, rows].
        let row = |row| (0..n_columns).map(move |column| column * n_rows + row);
        Ok((0..n_rows).flat_map(row).map(|at| stored[at]).collect())
    }

    /// Returns `width` finite numbers: those of a row, or one number repeated.
    pub(super) fn row(&self, width: usize) -> Result<Vec<f32>, ModelError> {
        let n = self.len()?;
        let mut dims = self.tensor.dims.clone();
        if self.is_transposed {
            dims.reverse();
        }
        let is_row = dims.iter().rev().skip(1).all(|dimension| *dimension == 1);
        if !is_row || dims.len() > 2 || (n != 1 && n != width) {
            return Err(
                self.refused(format!("its shape is {dims:?}, expected one number or [{width}]"))
            );
        }
        let mut row = self.numbers()?;
        row.resize(width, row[0]);
        Ok(row)
    }

    /// Returns the only number, which may be infinite.
    pub(super) fn scalar(&self) -> Result<f32, ModelError> {
        if self.len()? != 1 {
            return Err(
                self.refused(format!("its shape is {:?}, expected one number", self.tensor.dims))
            );
        }
        Ok(self.stored()[0])
    }

    /// Returns the only boolean.
    pub(super) fn flag(&self) -> Result<bool, ModelError> {
        match (self.tensor.data_type, self.tensor.raw_data.as_slice()) {
            (BOOL, [flag]) => Ok(*flag != 0),
            _ => Err(self.refused("expected one boolean, as raw data")),
        }
    }

    fn numbers(&self) -> Result<Vec<f32>, ModelError> {
        let numbers = self.stored();
        if numbers.iter().all(|number| number.is_finite()) {
            Ok(numbers)
        } else {
            Err(self.refused("it holds a number that is not finite"))
        }
    }

    fn stored(&self) -> Vec<f32> {
        if self.tensor.raw_data.is_empty() {
            return self.tensor.float_data.clone();
        }
        let (words, _) = self.tensor.raw_data.as_chunks::<4>();
        words.iter().map(|word| f32::from_le_bytes(*word)).collect()
    }
}
