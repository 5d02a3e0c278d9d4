//! One environment, and the reward.

use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods as _, PyReadonlyArray2};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use tandem_core::reward::sparse_reward;
use tandem_core::{Contacts, WorldSettings};
use tandem_picture::render;
use tandem_sim::SimError;

use crate::episode::{Episode, step_error, value_error};

/// Observation, reward, terminated, truncated and info, as `gymnasium.Env.step` returns them.
type Step<'py> = (Bound<'py, PyDict>, f32, bool, bool, Bound<'py, PyDict>);

/// The arguments of a constructor, for pickling: positional ones and keyword arguments.
pub(crate) type NewArguments<'py> = (Bound<'py, PyTuple>, Bound<'py, PyDict>);
/// Seed, number of the episode, and the actions executed so far, shape `[n_steps, n_action]`.
pub(crate) type Course = (u64, u64, Vec<f32>);

/// One environment. `tandem.TandemEnv` gives it Gymnasium's interface.
///
/// A copy and a pickled simulation continue the current episode with the same bits: its seed, number and actions
/// determine it.
#[pyclass(module = "tandem._native")]
#[derive(Clone)]
pub(crate) struct Simulation {
    episode: Episode,
    /// Seed and number of the current episode; `None` before the first reset.
    started: Option<(u64, u64)>,
}

#[pymethods]
impl Simulation {
    #[new]
    #[pyo3(signature = (task, n_arms, *, substeps, grasped_start_prob, randomization))]
    fn new(
        task: &str,
        n_arms: usize,
        substeps: u32,
        grasped_start_prob: f32,
        randomization: f32,
    ) -> PyResult<Self> {
        let settings = WorldSettings {
            grasped_start_prob,
            substeps,
            randomization,
            ..WorldSettings::default()
        };
        Ok(Self { episode: Episode::new(task, n_arms, settings)?, started: None })
    }

    /// Length of an action.
    #[getter]
    fn n_action(&self) -> usize {
        self.episode.layout().n_action()
    }

    /// Largest magnitude of each number of an observation, shape `[n_observation]`.
    #[getter]
    fn observation_bounds<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        let layout = self.episode.layout();
        let bounds = (0..layout.n_observation()).map(|idx| layout.observation_bound(idx));
        PyArray1::from_iter(py, bounds)
    }

    /// Largest magnitude of each number of an achieved goal, shape `[n_goal]`.
    #[getter]
    fn goal_bounds<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        let layout = self.episode.layout();
        let indices = layout.arms().flat_map(|arm| layout.achieved_goal_of(arm));
        PyArray1::from_iter(py, indices.map(|idx| layout.observation_bound(idx)))
    }

    /// Starts episode `number` of the run with seed `seed` and returns observation and info.
    fn reset<'py>(
        &mut self,
        py: Python<'py>,
        seed: u64,
        number: u64,
    ) -> PyResult<(Bound<'py, PyDict>, Bound<'py, PyDict>)> {
        py.detach(|| self.episode.start(seed, number));
        self.started = Some((seed, number));
        Ok((self.observation(py)?, self.info(py)?))
    }

    /// Executes `action`, shape `[n_action]`, clamped to [−1, 1]. Returns observation, reward, terminated, truncated and
    /// info; an episode never ends by itself, so the two flags are false.
    fn step<'py>(&mut self, py: Python<'py>, action: &Bound<'py, PyAny>) -> PyResult<Step<'py>> {
        self.step_by(py, action, Episode::step)
    }

    /// Does what `step` does, except for the physics: benchmarks measure the cost of the interface with it.
    fn step_without_physics<'py>(
        &mut self,
        py: Python<'py>,
        action: &Bound<'py, PyAny>,
    ) -> PyResult<Step<'py>> {
        self.step_by(py, action, |episode, _| {
            episode.observe();
            Ok(())
        })
    }

    /// Executes `actions`, shape `[n, n_action]`, and returns the observations after each, shape `[n, n_observation]`.
    /// If the shape is another one, no action is executed.
    fn play<'py>(
        &mut self,
        py: Python<'py>,
        actions: PyReadonlyArray2<'py, f32>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        self.check_started()?;
        let (actions, n_action) = (actions.as_array(), self.n_action());
        if actions.ncols() != n_action {
            let got = actions.dim();
            return Err(value_error(format!(
                "actions have shape {got:?}, expected (n, {n_action})"
            )));
        }
        let actions: Vec<f32> = actions.iter().copied().collect();
        let mut observations = Vec::new();
        let episode = &mut self.episode;
        let mut play = || {
            for action in actions.chunks(n_action) {
                episode.step(action)?;
                observations.extend_from_slice(&episode.observation);
            }
            Ok(())
        };
        py.detach(&mut play).map_err(|error: SimError| step_error(&error))?;
        let n_observation = self.episode.observation.len();
        let n_steps = observations.len() / n_observation;
        PyArray1::from_vec(py, observations).reshape([n_steps, n_observation])
    }

    fn __copy__(&self) -> Self {
        self.clone()
    }

    fn __deepcopy__(&self, _memo: &Bound<'_, PyAny>) -> Self {
        self.clone()
    }

    fn __getnewargs_ex__<'py>(&self, py: Python<'py>) -> PyResult<NewArguments<'py>> {
        let layout = self.episode.layout();
        let positional = (layout.task.to_string(), layout.n_arms).into_pyobject(py)?;
        Ok((positional, settings_arguments(py, self.episode.settings())?))
    }

    fn __getstate__(&self) -> Option<Course> {
        self.started.map(|(seed, number)| (seed, number, self.episode.actions().to_vec()))
    }

    fn __setstate__(&mut self, py: Python<'_>, state: Option<Course>) -> PyResult<()> {
        let Some((seed, number, actions)) = state else { return Ok(()) };
        self.started = Some((seed, number));
        let episode = &mut self.episode;
        py.detach(|| episode.replay(seed, number, &actions)).map_err(|error| step_error(&error))
    }

    /// Draws the scene, `width` times `height` pixels: red, green and blue, shape `[height, width, 3]`.
    fn render<'py>(
        &self,
        py: Python<'py>,
        width: usize,
        height: usize,
    ) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let pixels = py.detach(|| render(&self.episode.env.scene(), width, height).rgb);
        PyArray1::from_vec(py, pixels).reshape([height, width, 3])
    }
}

impl Simulation {
    fn step_by<'py>(
        &mut self,
        py: Python<'py>,
        action: &Bound<'py, PyAny>,
        step: fn(&mut Episode, &[f32]) -> Result<(), SimError>,
    ) -> PyResult<Step<'py>> {
        self.check_started()?;
        let action = action_of(action, self.n_action())?;
        let episode = &mut self.episode;
        py.detach(|| step(episode, &action)).map_err(|error| step_error(&error))?;
        Ok((self.observation(py)?, self.episode.reward, false, false, self.info(py)?))
    }

    fn check_started(&self) -> PyResult<()> {
        if self.started.is_some() {
            return Ok(());
        }
        Err(PyRuntimeError::new_err("the environment has no episode yet: call reset first"))
    }

    fn observation<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let Episode { env, observation, achieved_goal, .. } = &self.episode;
        let dict = PyDict::new(py);
        dict.set_item(intern!(py, "observation"), PyArray1::from_slice(py, observation))?;
        dict.set_item(intern!(py, "achieved_goal"), PyArray1::from_slice(py, achieved_goal))?;
        dict.set_item(intern!(py, "desired_goal"), PyArray1::from_slice(py, env.goal()))?;
        Ok(dict)
    }

    fn info<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let Episode { is_success, contacts, .. } = &self.episode;
        let dict = PyDict::new(py);
        dict.set_item(intern!(py, "is_success"), is_success)?;
        dict.set_item(intern!(py, "arm_contact"), contacts.contains(Contacts::ARM_ARM))?;
        dict.set_item(intern!(py, "table_contact"), contacts.contains(Contacts::ARM_TABLE))?;
        Ok(dict)
    }
}

/// Returns the keyword arguments that give an environment its settings.
pub(crate) fn settings_arguments(
    py: Python<'_>,
    settings: WorldSettings,
) -> PyResult<Bound<'_, PyDict>> {
    let arguments = PyDict::new(py);
    arguments.set_item("substeps", settings.substeps)?;
    arguments.set_item("grasped_start_prob", settings.grasped_start_prob)?;
    arguments.set_item("randomization", settings.randomization)?;
    Ok(arguments)
}

/// Returns the numbers of an action: a float32 array, or any sequence of numbers.
fn action_of(action: &Bound<'_, PyAny>, n_action: usize) -> PyResult<Vec<f32>> {
    if let Ok(array) = action.cast::<PyArray1<f32>>() {
        return Ok(array.readonly().as_array().iter().copied().collect());
    }
    let py = action.py();
    let n_dimensions = action.getattr(intern!(py, "ndim")).and_then(|number| number.extract());
    match n_dimensions {
        // Arrays of other types, such as tensors of PyTorch, need not be sequences.
        Ok(1) => {
            let array = py.import("numpy")?.call_method1("asarray", (action, "float32"))?;
            return Ok(array.cast::<PyArray1<f32>>()?.readonly().as_array().to_vec());
        }
        Ok(_) => {
            let shape = action.getattr(intern!(py, "shape"))?;
            let problem = format!("the action has shape {shape}, expected ({n_action},)");
            return Err(value_error(problem));
        }
        Err(_) => {}
    }
    action.extract().map_err(|error| shape_error(action, n_action).unwrap_or(error))
}

/// Returns the error of an action that is a number or a nested sequence, `None` for one that fails otherwise.
fn shape_error(action: &Bound<'_, PyAny>, n_action: usize) -> Option<PyErr> {
    let py = action.py();
    let shape = match py.import("numpy").and_then(|numpy| numpy.call_method1("shape", (action,))) {
        Ok(shape) => shape,
        Err(error) if error.is_instance_of::<PyValueError>(py) => {
            let problem = "the action has rows of different lengths";
            return Some(value_error(format!("{problem}, expected shape ({n_action},)")));
        }
        Err(_) => return None,
    };
    // NumPy gives objects that are not numbers, such as None, the shape () as well.
    let has_shape = match shape.len().ok()? {
        0 => action.extract::<f32>().is_ok(),
        n_dimensions => n_dimensions > 1,
    };
    has_shape.then(|| value_error(format!("the action has shape {shape}, expected ({n_action},)")))
}

/// Returns the sparse rewards, −1 or 0, shape `[n]`, of `achieved` and `desired` goals, metres, both of shape
/// `[n, n_goal]`.
#[pyfunction]
pub(crate) fn compute_reward<'py>(
    py: Python<'py>,
    achieved: PyReadonlyArray2<'py, f32>,
    desired: PyReadonlyArray2<'py, f32>,
) -> PyResult<Bound<'py, PyArray1<f32>>> {
    let (achieved, desired) = (achieved.as_array(), desired.as_array());
    if achieved.dim() != desired.dim() {
        let shapes = (achieved.dim(), desired.dim());
        return Err(value_error(format!(
            "goals of different shapes: {:?} and {:?}",
            shapes.0, shapes.1
        )));
    }
    let (achieved, desired) = (achieved.as_standard_layout(), desired.as_standard_layout());
    let rewards = achieved
        .rows()
        .into_iter()
        .zip(desired.rows())
        .map(|(achieved, desired)| sparse_reward(&achieved.to_vec(), &desired.to_vec()));
    Ok(PyArray1::from_vec(py, rewards.collect()))
}
