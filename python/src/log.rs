//! Episodes from logs.

use std::path::{Path, PathBuf};

use numpy::{Element, PyArray1, PyArrayMethods as _};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyString};
use tandem_core::text::error_chain;
use tandem_core::{ArmAdvice, Contacts, EpisodeKind, TaskSpec, WorldSettings};
use tandem_telemetry::{EpisodeLog, EpisodeMetadata, Error, LoggedTransition};

use crate::episode::{file_error, value_error};
use crate::simulation::settings_arguments;

/// `budget_left` of a step without it.
const NO_BUDGET: i64 = -1;
/// A probability of earlier versions: training episodes that started with the hands anywhere above the table.
const WIDE_START_SHARE: &str = "wide_start_share";

/// Returns the fields of `tandem.Episode` of the log `path`. For a log of another kind, of a trial or of a bridge's
/// motion, returns a message that says so.
///
/// # Errors
/// Returns an `OSError` if the file cannot be read, a `ValueError` if it is incomplete, damaged or no such log.
#[pyfunction]
pub(crate) fn read_episode(py: Python<'_>, path: PathBuf) -> PyResult<Bound<'_, PyAny>> {
    let read = py.detach(|| {
        let log = tandem_telemetry::read_episode(&path)?;
        let columns = Columns::of(&log).map_err(|problem| not_an_episode(&path, problem))?;
        Ok((log, columns))
    });
    match read {
        Ok((log, columns)) => Ok(fields(py, &log, columns)?.into_any()),
        Err(error @ (Error::TrialLog { .. } | Error::MotionLog { .. })) => {
            Ok(PyString::new(py, &error.to_string()).into_any())
        }
        Err(error) => Err(match &error {
            Error::Io { source, .. } => file_error(source, error_chain(&error)),
            _ => value_error(error_chain(&error)),
        }),
    }
}

fn not_an_episode(path: &Path, problem: String) -> Error {
    Error::NotAnEpisode { path: path.to_owned(), problem }
}

/// The steps of an episode whose next observation is known, field by field, row-major. Where the teacher was not asked,
/// its numbers are NaN.
#[derive(Default)]
struct Columns {
    n_steps: usize,
    /// Shape `[n_steps + 1, n_observation]`.
    observation: Vec<f32>,
    /// Shape `[n_steps + 1, n_goal]`.
    achieved_goal: Vec<f32>,
    /// Shape `[n_goal]`.
    desired_goal: Vec<f32>,
    /// Shape `[n_steps, n_action]`.
    action: Vec<f32>,
    /// Shape `[n_steps, n_action]`.
    teacher_action: Vec<f32>,
    /// Shape `[n_steps]`.
    reward: Vec<f32>,
    /// Shape `[n_steps, n_arms]`, as the fields below it.
    reward_per_arm: Vec<f32>,
    overridden: Vec<bool>,
    q_teacher: Vec<f32>,
    q_student: Vec<f32>,
    importance: Vec<f32>,
    distance: Vec<f32>,
    /// Shape `[n_steps]`, as the fields below it.
    asked: Vec<bool>,
    budget_left: Vec<i64>,
    arm_contact: Vec<bool>,
    table_contact: Vec<bool>,
}

impl Columns {
    /// Collects the steps of `log`. The error names what they lack.
    fn of(log: &EpisodeLog) -> Result<Self, String> {
        let task = &log.metadata.task;
        let first = log.transitions.first().ok_or("it has no step")?;
        // The result of the last step of an incomplete log is unknown.
        let n_steps = log.transitions.len() - usize::from(log.last_observation.is_none());
        let mut columns = Self { n_steps, desired_goal: first.goal.clone(), ..Self::default() };
        for (step_idx, step) in log.transitions.iter().enumerate() {
            if step.goal != first.goal {
                return Err(format!("step {step_idx}: the goal is not that of step 0"));
            }
            columns.observe(task, &step.observation);
            if step_idx < n_steps {
                let added = columns.add(task, step);
                added.map_err(|problem| format!("step {step_idx}: {problem}"))?;
            }
        }
        if let Some(observation) = &log.last_observation {
            columns.observe(task, observation);
        }
        Ok(columns)
    }

    fn observe(&mut self, task: &TaskSpec, observation: &[f32]) {
        self.observation.extend_from_slice(observation);
        self.achieved_goal.extend(task.achieved_goal(observation));
    }

    fn add(&mut self, task: &TaskSpec, step: &LoggedTransition) -> Result<(), String> {
        self.action.extend_from_slice(&step.action);
        self.reward.push(step.reward);
        self.reward_per_arm.extend_from_slice(&step.rewards_per_arm);
        self.overridden.extend(task.arms().map(|arm| step.advised_arms >> arm.0 & 1 == 1));
        self.asked.push(!step.advice.is_empty());
        let budget_left = step.budget_left.map(|left| i64::try_from(left).unwrap_or(i64::MAX));
        self.budget_left.push(budget_left.unwrap_or(NO_BUDGET));
        self.arm_contact.push(step.contacts.contains(Contacts::ARM_ARM));
        self.table_contact.push(step.contacts.contains(Contacts::ARM_TABLE));
        self.add_advice(task, &step.advice)
    }

    fn add_advice(&mut self, task: &TaskSpec, advice: &[ArmAdvice]) -> Result<(), String> {
        let n_arms = task.n_arms();
        if !advice.is_empty() && advice.len() != n_arms {
            return Err(format!("advice for {} arms, the task has {n_arms}", advice.len()));
        }
        let mut teacher_action = vec![f32::NAN; task.n_action()];
        for (arm, advice) in task.arms().zip(advice) {
            let (part, got) = (task.action_of(arm), advice.teacher_action.len());
            if got != part.len() {
                return Err(format!("teacher_action has {got} numbers, an arm {}", part.len()));
            }
            part.write(&mut teacher_action, &advice.teacher_action);
        }
        self.teacher_action.append(&mut teacher_action);
        for arm_idx in 0..n_arms {
            let value = |of: fn(&ArmAdvice) -> f32| advice.get(arm_idx).map_or(f32::NAN, of);
            self.q_teacher.push(value(|advice| advice.q_teacher));
            self.q_student.push(value(|advice| advice.q_student));
            self.importance.push(value(|advice| advice.importance));
            self.distance.push(value(|advice| advice.distance));
        }
        Ok(())
    }
}

/// Returns the fields of `tandem.Episode`, except those that Python adds.
fn fields<'py>(
    py: Python<'py>,
    log: &EpisodeLog,
    columns: Columns,
) -> PyResult<Bound<'py, PyDict>> {
    let fields = metadata_fields(py, &log.metadata)?;
    let task = &log.metadata.task;
    let (t, n_arms) = (columns.n_steps, task.n_arms());
    let set = |name, array: PyResult<Bound<'py, PyAny>>| fields.set_item(name, array?);
    set("observation", array(py, columns.observation, &[t + 1, task.n_observation()]))?;
    set("achieved_goal", array(py, columns.achieved_goal, &[t + 1, task.n_goal()]))?;
    set("desired_goal", array(py, columns.desired_goal, &[task.n_goal()]))?;
    set("action", array(py, columns.action, &[t, task.n_action()]))?;
    set("teacher_action", array(py, columns.teacher_action, &[t, task.n_action()]))?;
    set("reward", array(py, columns.reward, &[t]))?;
    set("reward_per_arm", array(py, columns.reward_per_arm, &[t, n_arms]))?;
    set("overridden", array(py, columns.overridden, &[t, n_arms]))?;
    set("q_teacher", array(py, columns.q_teacher, &[t, n_arms]))?;
    set("q_student", array(py, columns.q_student, &[t, n_arms]))?;
    set("importance", array(py, columns.importance, &[t, n_arms]))?;
    set("distance", array(py, columns.distance, &[t, n_arms]))?;
    set("asked", array(py, columns.asked, &[t]))?;
    set("budget_left", array(py, columns.budget_left, &[t]))?;
    set("arm_contact", array(py, columns.arm_contact, &[t]))?;
    set("table_contact", array(py, columns.table_contact, &[t]))?;
    fields.set_item("success", log.succeeded())?;
    let per_arm: Option<Vec<bool>> = task.arms().map(|arm| log.arm_succeeded(arm)).collect();
    let per_arm = per_arm.map(|flags| array(py, flags, &[n_arms])).transpose()?;
    fields.set_item("success_per_arm", per_arm)?;
    Ok(fields)
}

fn array<'py, T: Element>(
    py: Python<'py>,
    numbers: Vec<T>,
    shape: &[usize],
) -> PyResult<Bound<'py, PyAny>> {
    Ok(PyArray1::from_vec(py, numbers).reshape(shape)?.into_any())
}

fn metadata_fields<'py>(
    py: Python<'py>,
    metadata: &EpisodeMetadata,
) -> PyResult<Bound<'py, PyDict>> {
    let (fields, task) = (PyDict::new(py), &metadata.task);
    let kind = match metadata.kind {
        EpisodeKind::Training => "training",
        EpisodeKind::Evaluation => "evaluation",
    };
    let description = serde_json::to_string(task.description())
        .map_err(|error| PyRuntimeError::new_err(error.to_string()))?;
    fields.set_item("run", &metadata.run)?;
    fields.set_item("number", metadata.episode)?;
    fields.set_item("seed", metadata.seed)?;
    fields.set_item("kind", kind)?;
    fields.set_item("parameter_version", metadata.parameter_version)?;
    fields.set_item("policy_digest", &metadata.policy_digest)?;
    fields.set_item("task", task.name())?;
    fields.set_item("n_arms", task.n_arms())?;
    fields.set_item("description", description)?;
    fields.set_item("world", metadata.world.clone())?;
    fields.set_item("step_s", step_s(task))?;
    let settings = simulated_settings(metadata);
    let arguments = settings.map(|settings| settings_arguments(py, settings)).transpose()?;
    fields.set_item("env_kwargs", arguments)?;
    Ok(fields)
}

/// Returns the duration of a control step of a built-in task, seconds.
fn step_s(task: &TaskSpec) -> Option<f64> {
    let layout = task.as_built_in()?;
    // 0.04 s, not the nearest float32.
    Some((f64::from(layout.task.world().control_step_s()) * 1e3).round() / 1e3)
}

/// Returns the settings of a built-in world that this package simulates.
fn simulated_settings(metadata: &EpisodeMetadata) -> Option<WorldSettings> {
    metadata.task.as_built_in()?;
    let entry = |key: &str| metadata.world.get(key).map(String::as_str);
    let settings = WorldSettings::from_log_entries(entry).ok()?.for_kind(metadata.kind);
    let is_training = metadata.kind == EpisodeKind::Training;
    let is_removed = is_training && entry(WIDE_START_SHARE).is_some_and(|share| share != "0");
    (settings.check().is_ok() && !is_removed).then_some(settings)
}
