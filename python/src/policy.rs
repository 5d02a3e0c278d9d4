//! Policies from files.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

use numpy::{PyArray1, PyArray2, PyArrayDyn, PyArrayMethods as _, PyReadonlyArray2};
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use tandem_policy::{Actor, Critic, Error};

use crate::episode::{file_error, value_error};

/// A policy and its networks. `tandem.Policy` gives it an interface for arrays of any shape.
#[pyclass(module = "tandem._native", frozen)]
pub(crate) struct Policy {
    policy: tandem_policy::Policy,
    networks: Mutex<Networks>,
}

/// The networks with their scratch memory.
struct Networks {
    actor: Actor,
    critic: Critic,
}

#[pymethods]
impl Policy {
    /// Loads and validates a policy file.
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        py.detach(|| Self::of(tandem_policy::Policy::load(&path).map_err(load_error)?))
    }

    /// Reads a policy from the bytes of a file, and validates it.
    #[staticmethod]
    fn from_bytes(py: Python<'_>, bytes: &[u8]) -> PyResult<Self> {
        py.detach(|| Self::of(tandem_policy::Policy::from_bytes(bytes).map_err(value_error)?))
    }

    /// Returns the bytes of a file with the policy.
    fn to_bytes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        let bytes = py.detach(|| self.policy.to_bytes()).map_err(value_error)?;
        Ok(PyBytes::new(py, &bytes))
    }

    /// Name of the task.
    #[getter]
    fn task(&self) -> &str {
        self.policy.task.name()
    }

    /// Number of arms.
    #[getter]
    fn n_arms(&self) -> usize {
        self.policy.task.n_arms()
    }

    /// Length of an observation.
    #[getter]
    fn n_observation(&self) -> usize {
        self.policy.task.n_observation()
    }

    /// Length of a goal.
    #[getter]
    fn n_goal(&self) -> usize {
        self.policy.task.n_goal()
    }

    /// Length of an action.
    #[getter]
    fn n_action(&self) -> usize {
        self.policy.task.n_action()
    }

    /// Number of values that the critic returns.
    #[getter]
    fn n_heads(&self) -> usize {
        self.policy.n_heads
    }

    /// False for a policy whose critic is unknown, such as an actor from another program.
    #[getter]
    fn has_critic(&self) -> bool {
        self.policy.has_critic()
    }

    /// The file's entries about training and success rates.
    #[getter]
    fn metadata(&self) -> BTreeMap<String, String> {
        self.policy.metadata.clone()
    }

    /// SHA-256 of the tensors, hexadecimal.
    #[getter]
    fn digest(&self) -> String {
        self.policy.digest()
    }

    /// Copies of all tensors by their names in the file.
    fn tensors<'py>(
        &self,
        py: Python<'py>,
    ) -> PyResult<BTreeMap<String, Bound<'py, PyArrayDyn<f32>>>> {
        let tensor = |tensor: tandem_policy::policy::Tensor<'_>| {
            let array = PyArray1::from_slice(py, tensor.data).reshape(tensor.shape)?;
            Ok((tensor.name, array))
        };
        self.policy.tensors().into_iter().map(tensor).collect()
    }

    /// Returns the actions, shape `[n, n_action]`, for `observations`, shape `[n, n_observation]`, and `goals`, shape
    /// `[n, n_goal]`.
    fn act<'py>(
        &self,
        py: Python<'py>,
        observations: PyReadonlyArray2<'py, f32>,
        goals: PyReadonlyArray2<'py, f32>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let task = &self.policy.task;
        let n_rows = observations.as_array().nrows();
        let observations = checked(&observations, n_rows, task.n_observation(), "observations")?;
        let goals = checked(&goals, n_rows, task.n_goal(), "goals")?;
        let mut actions = vec![0.0; n_rows * task.n_action()];
        py.detach(|| self.networks().actor.act(&observations, &goals, &mut actions));
        PyArray1::from_vec(py, actions).reshape([n_rows, task.n_action()])
    }

    /// Returns the values, shape `[n, n_heads]`, of `actions`, shape `[n, n_action]`, for `observations` and `goals`.
    fn q<'py>(
        &self,
        py: Python<'py>,
        observations: PyReadonlyArray2<'py, f32>,
        goals: PyReadonlyArray2<'py, f32>,
        actions: PyReadonlyArray2<'py, f32>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        if !self.policy.has_critic() {
            return Err(value_error("the policy has no critic, and so no values"));
        }
        let task = &self.policy.task;
        let n_rows = observations.as_array().nrows();
        let observations = checked(&observations, n_rows, task.n_observation(), "observations")?;
        let goals = checked(&goals, n_rows, task.n_goal(), "goals")?;
        let actions = checked(&actions, n_rows, task.n_action(), "actions")?;
        let mut values = vec![0.0; n_rows * self.policy.n_heads];
        py.detach(|| self.networks().critic.q(&observations, &goals, &actions, &mut values));
        PyArray1::from_vec(py, values).reshape([n_rows, self.policy.n_heads])
    }
}

impl Policy {
    fn of(policy: tandem_policy::Policy) -> PyResult<Self> {
        let (actor, critic) =
            (policy.actor().map_err(value_error)?, policy.critic().map_err(value_error)?);
        Ok(Self { policy, networks: Mutex::new(Networks { actor, critic }) })
    }

    /// Returns the networks; another thread's panic leaves nothing in them that the next call does not overwrite.
    fn networks(&self) -> MutexGuard<'_, Networks> {
        self.networks.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Returns the numbers of `array` if it has shape `[n_rows, length]` and all of them are finite.
fn checked(
    array: &PyReadonlyArray2<'_, f32>,
    n_rows: usize,
    length: usize,
    name: &str,
) -> PyResult<Vec<f32>> {
    let array = array.as_array();
    let (got, expected) = (array.dim(), (n_rows, length));
    if got != expected {
        return Err(value_error(format!("{name} have shape {got:?}, expected {expected:?}")));
    }
    let numbers: Vec<f32> = array.iter().copied().collect();
    if !tandem_policy::all_finite(&numbers) {
        return Err(value_error(format!("{name} contain a number that is not finite")));
    }
    Ok(numbers)
}

/// Converts an error with its causes: an unreadable file is an `OSError`, any other a `ValueError`.
fn load_error(error: Error) -> PyErr {
    let text = tandem_core::text::error_chain(&error);
    match error {
        Error::Read { source, .. } => file_error(&source, text),
        _ => value_error(text),
    }
}
