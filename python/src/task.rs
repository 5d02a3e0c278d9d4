//! Descriptions of the built-in tasks.

use pyo3::PyResult;
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use tandem_core::{Layout, Task, TaskDescription, TaskSpec};

use crate::episode::value_error;

/// Returns the description of the built-in task `name` with `n_arms` arms as JSON.
///
/// # Errors
/// Returns a `ValueError` if there is no such task, or not with that number of arms.
#[pyfunction]
pub(crate) fn task_description(name: &str, n_arms: usize) -> PyResult<String> {
    let task: Task = name.parse().map_err(value_error)?;
    if !(task.min_arms()..=2).contains(&n_arms) {
        return Err(value_error(format!(
            "{task} with {n_arms} arms: expected {} to 2",
            task.min_arms()
        )));
    }
    let described = serde_json::to_string(&Layout::new(task, n_arms).description());
    described.map_err(|error| PyRuntimeError::new_err(error.to_string()))
}

/// Checks a description of a task, given as JSON, as every service does that receives one.
///
/// # Errors
/// Returns a `ValueError` that names the first field with an invalid value.
#[pyfunction]
pub(crate) fn check_task(description: &str) -> PyResult<()> {
    let description: TaskDescription = serde_json::from_str(description).map_err(value_error)?;
    TaskSpec::new(description).map(drop).map_err(value_error)
}
