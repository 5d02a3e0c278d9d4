//! Many environments that are stepped together.

use numpy::{Element, PyArray1, PyArray2, PyArray3, PyArrayMethods as _, PyReadonlyArray2};
use pyo3::prelude::*;
use rayon::prelude::*;
use tandem_core::{Contacts, WorldSettings};
use tandem_picture::render;
use tandem_sim::SimError;

use crate::episode::{Episode, step_error, value_error};
use crate::simulation::{Course, NewArguments, settings_arguments};
use crate::threads::Threads;

/// When an environment whose episode is over starts the next one; the modes of Gymnasium.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Autoreset {
    NextStep,
    SameStep,
    Disabled,
}

/// An environment of many.
#[derive(Clone)]
struct Slot {
    episode: Episode,
    seed: u64,
    /// Number of the episode within the run of `seed`.
    number: u64,
    n_steps: u32,
    is_started: bool,
    is_over: bool,
    /// The last observation of the episode that ended in this step, if the next one has begun.
    last: Option<Last>,
}

#[derive(Clone)]
struct Last {
    observation: Vec<f32>,
    achieved_goal: Vec<f32>,
    goal: Vec<f32>,
    is_success: bool,
    contacts: Contacts,
}

/// Observations, achieved goals and desired goals, one row per environment.
type Observations<'py> =
    (Bound<'py, PyArray2<f32>>, Bound<'py, PyArray2<f32>>, Bound<'py, PyArray2<f32>>);
/// Success, contacts between arms, and contacts with the table.
type Infos<'py> =
    (Bound<'py, PyArray1<bool>>, Bound<'py, PyArray1<bool>>, Bound<'py, PyArray1<bool>>);
/// Observations, rewards, truncations and infos.
type Steps<'py> =
    (Observations<'py>, Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<bool>>, Infos<'py>);

/// What pickling keeps of an environment of many: its episode, whether it is started and whether it is over.
type SlotState = (Course, bool, bool);

/// Environments that are stepped in parallel. `tandem.TandemVectorEnv` gives them Gymnasium's interface.
///
/// Results do not depend on the number of threads. Pickled environments continue their episodes with the same bits.
#[pyclass(module = "tandem._native")]
pub(crate) struct VectorSimulation {
    slots: Vec<Slot>,
    threads: Threads,
    max_episode_steps: u32,
    autoreset: Autoreset,
}

#[pymethods]
impl VectorSimulation {
    #[new]
    #[pyo3(signature = (task, n_arms, num_envs, *, substeps, grasped_start_prob, randomization, max_episode_steps, autoreset, num_threads))]
    #[expect(clippy::too_many_arguments, reason = "keyword arguments in Python")]
    fn new(
        task: &str,
        n_arms: usize,
        num_envs: usize,
        substeps: u32,
        grasped_start_prob: f32,
        randomization: f32,
        max_episode_steps: u32,
        autoreset: &str,
        num_threads: usize,
    ) -> PyResult<Self> {
        let autoreset = match autoreset {
            "next_step" => Autoreset::NextStep,
            "same_step" => Autoreset::SameStep,
            "disabled" => Autoreset::Disabled,
            other => return Err(value_error(format!("unknown autoreset mode {other:?}"))),
        };
        let settings = WorldSettings {
            grasped_start_prob,
            substeps,
            randomization,
            ..WorldSettings::default()
        };
        let slot = Slot {
            episode: Episode::new(task, n_arms, settings)?,
            seed: 0,
            number: 0,
            n_steps: 0,
            is_started: false,
            is_over: false,
            last: None,
        };
        let threads = Threads::start(num_threads.min(num_envs))?;
        Ok(Self { slots: vec![slot; num_envs], threads, max_episode_steps, autoreset })
    }

    /// Starts the first episodes of the runs of `seeds`, or without a seed the next episode, in the environments of
    /// `mask`. Both have shape `[num_envs]`. An environment outside `mask` that never started keeps its seed for its first
    /// episode. Returns observations and infos of all environments.
    fn reset<'py>(
        &mut self,
        py: Python<'py>,
        seeds: Option<Vec<Option<u64>>>,
        mask: Vec<bool>,
    ) -> PyResult<(Observations<'py>, Infos<'py>)> {
        self.check_length("mask", mask.len())?;
        if let Some(seeds) = &seeds {
            self.check_length("seeds", seeds.len())?;
        }
        let (slots, threads) = (&mut self.slots, &mut self.threads);
        let start = |(idx, slot): (usize, &mut Slot)| {
            slot.last = None;
            let seed = seeds.as_ref().and_then(|seeds| seeds[idx]);
            if mask[idx] {
                slot.start(seed);
            } else if let Some(seed) = seed
                && !slot.is_started
            {
                slot.seed = seed;
            }
        };
        py.detach(|| threads.install(|| slots.par_iter_mut().enumerate().for_each(start)))?;
        Ok((self.observations(py)?, self.infos(py)))
    }

    /// Executes `actions`, shape `[num_envs, n_action]`.
    fn step<'py>(
        &mut self,
        py: Python<'py>,
        actions: PyReadonlyArray2<'py, f32>,
    ) -> PyResult<Steps<'py>> {
        let actions = self.checked_actions(&actions)?;
        let (slots, threads) = (&mut self.slots, &mut self.threads);
        let (limit, autoreset) = (self.max_episode_steps, self.autoreset);
        let n_action = actions.len() / slots.len();
        let step = |(slot, action): (&mut Slot, &[f32])| slot.step(action, limit, autoreset);
        let results: Vec<Result<f32, SimError>> = py.detach(|| {
            threads.install(|| {
                slots.par_iter_mut().zip(actions.par_chunks(n_action)).map(step).collect()
            })
        })?;
        let rewards = results.into_iter().map(|result| result.map(f64::from));
        let rewards: Vec<f64> =
            rewards.collect::<Result<_, _>>().map_err(|error| step_error(&error))?;
        let truncated = self.slots.iter().map(|slot| slot.is_over || slot.last.is_some()).collect();
        Ok((
            self.observations(py)?,
            PyArray1::from_vec(py, rewards),
            PyArray1::from_vec(py, truncated),
            self.infos(py),
        ))
    }

    /// Returns the last observations and infos of the episodes that ended in the last step, if the next ones have
    /// begun: one row for each of them, in order.
    fn last<'py>(&self, py: Python<'py>) -> PyResult<(Observations<'py>, Infos<'py>)> {
        let lasts: Vec<&Last> = self.slots.iter().filter_map(|slot| slot.last.as_ref()).collect();
        let layout = self.slots[0].episode.layout();
        let rows = |field: fn(&Last) -> &[f32], length| {
            rows(py, lasts.iter().map(|last| field(last)), length)
        };
        let observations = (
            rows(|last| &last.observation, layout.n_observation())?,
            rows(|last| &last.achieved_goal, layout.n_goal())?,
            rows(|last| &last.goal, layout.n_goal())?,
        );
        let infos = lasts.iter().map(|last| (last.is_success, last.contacts));
        Ok((observations, infos_of(py, infos)))
    }

    fn __getnewargs_ex__<'py>(&self, py: Python<'py>) -> PyResult<NewArguments<'py>> {
        let episode = &self.slots[0].episode;
        let layout = episode.layout();
        let positional = (layout.task.to_string(), layout.n_arms, self.slots.len());
        let keywords = settings_arguments(py, episode.settings())?;
        keywords.set_item("max_episode_steps", self.max_episode_steps)?;
        keywords.set_item("autoreset", self.autoreset.name())?;
        keywords.set_item("num_threads", self.threads.count())?;
        Ok((positional.into_pyobject(py)?, keywords))
    }

    fn __getstate__(&self) -> Vec<SlotState> {
        self.slots.iter().map(Slot::state).collect()
    }

    fn __setstate__(&mut self, py: Python<'_>, state: Vec<SlotState>) -> PyResult<()> {
        self.check_length("state", state.len())?;
        let (slots, threads) = (&mut self.slots, &mut self.threads);
        let restore = |(slot, state): (&mut Slot, SlotState)| slot.restore(state);
        py.detach(|| threads.install(|| slots.par_iter_mut().zip(state).try_for_each(restore)))?
            .map_err(|error| step_error(&error))
    }

    /// Draws the scene of every environment, shape `[height, width, 3]` each.
    fn render<'py>(
        &mut self,
        py: Python<'py>,
        width: usize,
        height: usize,
    ) -> PyResult<Vec<Bound<'py, PyArray3<u8>>>> {
        let draw = |slot: &Slot| render(&slot.episode.env.scene(), width, height).rgb;
        let (slots, threads) = (&self.slots, &mut self.threads);
        let pictures: Vec<Vec<u8>> =
            py.detach(|| threads.install(|| slots.par_iter().map(draw).collect()))?;
        let pictures = pictures.into_iter();
        pictures.map(|pixels| PyArray1::from_vec(py, pixels).reshape([height, width, 3])).collect()
    }
}

impl Autoreset {
    const fn name(self) -> &'static str {
        match self {
            Self::NextStep => "next_step",
            Self::SameStep => "same_step",
            Self::Disabled => "disabled",
        }
    }
}

impl Slot {
    fn state(&self) -> SlotState {
        let course = (self.seed, self.number, self.episode.actions().to_vec());
        (course, self.is_started, self.is_over)
    }

    fn restore(&mut self, state: SlotState) -> Result<(), SimError> {
        let (seed, number, actions);
        ((seed, number, actions), self.is_started, self.is_over) = state;
        (self.seed, self.number, self.n_steps, self.last) = (seed, number, 0, None);
        if !self.is_started {
            return Ok(());
        }
        self.episode.replay(seed, number, &actions)?;
        let n_steps = actions.len() / self.episode.layout().n_action();
        self.n_steps = u32::try_from(n_steps).unwrap_or(u32::MAX);
        Ok(())
    }

    /// Starts the first episode of the run of `seed`, or without a seed the next one of the current run.
    fn start(&mut self, seed: Option<u64>) {
        (self.seed, self.number) = match seed {
            Some(seed) => (seed, 0),
            None if self.is_started => (self.seed, self.number + 1),
            None => (self.seed, 0),
        };
        self.episode.start(self.seed, self.number);
        (self.n_steps, self.is_started, self.is_over) = (0, true, false);
    }

    /// Executes `action`, or starts the next episode if this is the mode's time to do so, and returns the reward.
    fn step(&mut self, action: &[f32], limit: u32, autoreset: Autoreset) -> Result<f32, SimError> {
        self.last = None;
        if self.is_over {
            self.start(None);
            return Ok(0.0);
        }
        self.episode.step(action)?;
        self.n_steps += 1;
        self.is_over = self.n_steps >= limit;
        let reward = self.episode.reward;
        if self.is_over && autoreset == Autoreset::SameStep {
            self.last = Some(Last {
                observation: self.episode.observation.clone(),
                achieved_goal: self.episode.achieved_goal.clone(),
                goal: self.episode.env.goal().to_vec(),
                is_success: self.episode.is_success,
                contacts: self.episode.contacts,
            });
            self.start(None);
        }
        Ok(reward)
    }
}

impl VectorSimulation {
    fn check_length(&self, name: &str, length: usize) -> PyResult<()> {
        if length == self.slots.len() {
            return Ok(());
        }
        let expected = self.slots.len();
        Err(value_error(format!("{name} has length {length}, expected {expected}")))
    }

    /// Returns the numbers of `actions` if every environment can execute its own. Otherwise none is stepped.
    fn checked_actions(&self, actions: &PyReadonlyArray2<'_, f32>) -> PyResult<Vec<f32>> {
        let actions = actions.as_array();
        let expected = (self.slots.len(), self.slots[0].episode.layout().n_action());
        if actions.dim() != expected {
            let got = actions.dim();
            return Err(value_error(format!("actions have shape {got:?}, expected {expected:?}")));
        }
        if let Some(((env, index), value)) =
            actions.indexed_iter().find(|(_, value)| !value.is_finite())
        {
            let place = format!("number {index} of the action of environment {env}");
            return Err(value_error(format!("{place} is {value}, expected a finite number")));
        }
        let is_waiting = |slot: &Slot| {
            !slot.is_started || (slot.is_over && self.autoreset == Autoreset::Disabled)
        };
        if let Some(env) = self.slots.iter().position(is_waiting) {
            return Err(value_error(format!("environment {env} has no episode: call reset first")));
        }
        Ok(actions.iter().copied().collect())
    }

    fn observations<'py>(&self, py: Python<'py>) -> PyResult<Observations<'py>> {
        let layout = self.slots[0].episode.layout();
        let rows = |field: fn(&Episode) -> &[f32], length| {
            rows(py, self.slots.iter().map(|slot| field(&slot.episode)), length)
        };
        Ok((
            rows(|episode| &episode.observation, layout.n_observation())?,
            rows(|episode| &episode.achieved_goal, layout.n_goal())?,
            rows(|episode| episode.env.goal(), layout.n_goal())?,
        ))
    }

    fn infos<'py>(&self, py: Python<'py>) -> Infos<'py> {
        let episodes = self.slots.iter().map(|slot| &slot.episode);
        infos_of(py, episodes.map(|episode| (episode.is_success, episode.contacts)))
    }
}

/// Concatenates rows of `length` numbers, shape `[n, length]`.
fn rows<'a, 'py, T: Element + Copy + 'a>(
    py: Python<'py>,
    rows: impl ExactSizeIterator<Item = &'a [T]>,
    length: usize,
) -> PyResult<Bound<'py, PyArray2<T>>> {
    let n_rows = rows.len();
    let mut numbers = Vec::with_capacity(n_rows * length);
    rows.for_each(|row| numbers.extend_from_slice(row));
    PyArray1::from_vec(py, numbers).reshape([n_rows, length])
}

fn infos_of(py: Python<'_>, infos: impl Iterator<Item = (bool, Contacts)> + Clone) -> Infos<'_> {
    let contact =
        |kind| PyArray1::from_iter(py, infos.clone().map(|(_, contacts)| contacts.contains(kind)));
    (
        PyArray1::from_iter(py, infos.clone().map(|(is_success, _)| is_success)),
        contact(Contacts::ARM_ARM),
        contact(Contacts::ARM_TABLE),
    )
}
