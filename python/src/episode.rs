//! An environment together with its current observation.

use pyo3::PyErr;
use pyo3::exceptions::{PyOSError, PyRuntimeError, PyValueError};
use tandem_core::reward::{achieved_goal, sparse_reward};
use tandem_core::{Contacts, Layout, Stream, Task, TaskSpec, WorldSettings, episode_rng};
use tandem_sim::{Env, SimError, WorldConfig};

/// An environment, its observation and the result of its last step.
#[derive(Clone)]
pub(crate) struct Episode {
    pub(crate) env: Env,
    task: TaskSpec,
    settings: WorldSettings,
    /// Shape `[n_observation]`.
    pub(crate) observation: Vec<f32>,
    /// Shape `[n_goal]`.
    pub(crate) achieved_goal: Vec<f32>,
    pub(crate) reward: f32,
    /// The task's criterion held after each of the last steps that count.
    pub(crate) is_success: bool,
    /// Steps at the end of the episode so far after which the criterion held.
    n_successes: usize,
    pub(crate) contacts: Contacts,
    /// The actions executed so far, shape `[n_steps, n_action]`: with seed and number they determine the episode.
    actions: Vec<f32>,
}

impl Episode {
    /// Creates the environment of `task`, which must be reset before it is stepped.
    ///
    /// # Errors
    /// Returns a `ValueError` if the task is unknown or a setting is out of range.
    pub(crate) fn new(task: &str, n_arms: usize, settings: WorldSettings) -> Result<Self, PyErr> {
        let task: Task = task.parse().map_err(value_error)?;
        settings.check().map_err(value_error)?;
        let layout = Layout::new(task, n_arms);
        let env = Env::new(layout, &WorldConfig::from(settings)).map_err(value_error)?;
        Ok(Self {
            env,
            task: layout.into(),
            settings,
            observation: vec![0.0; layout.n_observation()],
            achieved_goal: vec![0.0; layout.n_goal()],
            reward: 0.0,
            is_success: false,
            n_successes: 0,
            contacts: Contacts::NONE,
            actions: Vec::new(),
        })
    }

    pub(crate) fn layout(&self) -> Layout {
        self.env.layout()
    }

    /// Starts episode `number` of the run with seed `seed`.
    pub(crate) fn start(&mut self, seed: u64, number: u64) {
        self.env.reset(&mut episode_rng(seed, number, Stream::Reset), self.settings);
        self.contacts = Contacts::NONE;
        self.actions.clear();
        self.n_successes = 0;
        self.observe();
        self.reward = 0.0;
    }

    /// Executes `action`, shape `[n_action]`, and observes the result.
    ///
    /// # Errors
    /// As [`Env::step`].
    pub(crate) fn step(&mut self, action: &[f32]) -> Result<(), SimError> {
        self.contacts = self.env.step(action)?;
        self.actions.extend_from_slice(action);
        self.observe();
        Ok(())
    }

    /// Returns the actions executed so far, shape `[n_steps, n_action]`.
    pub(crate) fn actions(&self) -> &[f32] {
        &self.actions
    }

    /// Returns the settings of its starts and its physics.
    pub(crate) const fn settings(&self) -> WorldSettings {
        self.settings
    }

    /// Starts episode `number` of the run with seed `seed` and executes `actions`, shape `[n_steps, n_action]`. The
    /// result has the bits of an episode in which the same actions were executed.
    ///
    /// # Errors
    /// As [`Env::step`].
    pub(crate) fn replay(
        &mut self,
        seed: u64,
        number: u64,
        actions: &[f32],
    ) -> Result<(), SimError> {
        self.start(seed, number);
        actions.chunks(self.layout().n_action()).try_for_each(|action| self.step(action))
    }

    /// Updates observation, achieved goal, reward and success.
    pub(crate) fn observe(&mut self) {
        let layout = self.layout();
        self.env.observe(&mut self.observation);
        for (to, from) in
            self.achieved_goal.iter_mut().zip(achieved_goal(layout, &self.observation))
        {
            *to = from;
        }
        self.reward = sparse_reward(&self.achieved_goal, self.env.goal());
        let holds = self.task.is_success(&self.observation, self.env.goal());
        self.n_successes = if holds { self.n_successes + 1 } else { 0 };
        self.is_success = self.n_successes >= self.task.success_steps();
    }
}

/// Converts an error of a step: a bad action is a `ValueError`, diverging physics a `RuntimeError`.
pub(crate) fn step_error(error: &SimError) -> PyErr {
    match error {
        SimError::ActionLength { .. } | SimError::ActionNotFinite { .. } => value_error(error),
        _ => PyRuntimeError::new_err(error.to_string()),
    }
}

pub(crate) fn value_error(error: impl std::fmt::Display) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// Returns the `OSError` of a file that cannot be read, such as a `FileNotFoundError`.
pub(crate) fn file_error(source: &std::io::Error, text: String) -> PyErr {
    match source.raw_os_error() {
        Some(code) => PyOSError::new_err((code, text)),
        None => PyOSError::new_err(text),
    }
}
