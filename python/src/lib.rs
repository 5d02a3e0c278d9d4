//! The compiled part of the Python package `tandem`.

use pyo3::prelude::*;

/// The compiled part of the package.
#[pymodule]
mod _native {}
