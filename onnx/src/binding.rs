//! Networks bound to the vectors of a task.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::ops::Range;

use tandem_core::text::counted;
use tandem_core::{Layout, Task, TaskDescription, TaskSpec};

use crate::error::ModelError;
use crate::metadata;
use crate::model::Model;
use crate::network::{Input, Network};

/// Largest number of arms that [`task_of`] considers.
const MAX_ARMS: usize = 8;

/// The function that a network computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// Actions from observations and goals.
    Actor,
    /// Values from observations, goals and actions.
    Critic,
}

/// The origin of a column of a network. The number is an index in that vector.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Source {
    /// A number of the observation.
    Observation(usize),
    /// A number of the goal.
    Goal(usize),
    /// A number of the action.
    Action(usize),
}

/// A network whose inputs are the vectors of a task.
///
/// The result for a row has the same bits in any batch and on every machine.
#[derive(Debug, Clone)]
pub struct BoundNetwork {
    task: TaskSpec,
    network: Network,
    /// Source of each of the network's columns.
    sources: Vec<Source>,
    row: Vec<f32>,
    scratch: Vec<f32>,
}

impl BoundNetwork {
    /// Binds the network of `model` to `task`.
    ///
    /// Inputs are recognised by their names: `observation` (or `obs`, `state`), `goal` (or `desired_goal`),
    /// `achieved_goal`, which is a part of the observation, and `action` (or `actions`). A model with one input, or
    /// whose `observation` is that long, takes observation and goal, and as a critic the action, concatenated in this
    /// order.
    ///
    /// # Errors
    /// When an input has another name or length, or an actor's output is not as long as an action.
    pub fn new(model: &Model, role: Role, task: impl Into<TaskSpec>) -> Result<Self, ModelError> {
        let (network, task) = (&model.network, task.into());
        if role == Role::Actor && network.n_output != task.n_action() {
            return Err(ModelError::Value {
                kind: "output",
                name: network.output.clone(),
                problem: format!(
                    "it has {} numbers, an action of {} with {} has {}",
                    network.n_output,
                    task.name(),
                    counted(task.n_arms(), "arm"),
                    task.n_action()
                ),
            });
        }
        let is_only = network.inputs.len() == 1;
        let inputs = network.inputs.iter().map(|input| sources(input, is_only, role, &task));
        let inputs = inputs.collect::<Result<Vec<_>, _>>()?;
        let sources = network.columns.iter().map(|column| inputs[column.input][column.index]);
        let sources = sources.collect();
        Ok(Self { task, network: network.clone(), sources, row: Vec::new(), scratch: Vec::new() })
    }

    /// Returns the task.
    #[must_use]
    pub const fn task(&self) -> &TaskSpec {
        &self.task
    }

    /// Returns the network.
    #[must_use]
    pub const fn network(&self) -> &Network {
        &self.network
    }

    /// Returns the source of each column of the network.
    #[must_use]
    pub fn sources(&self) -> &[Source] {
        &self.sources
    }

    /// Writes the outputs, shape `[n, n_output]`, for `observations`, shape `[n, n_observation]`, `goals`, shape
    /// `[n, n_goal]`, and `actions`, shape `[n, n_action]`, or empty for an actor.
    ///
    /// # Panics
    /// If the lengths do not match the task or each other.
    pub fn run(
        &mut self,
        observations: &[f32],
        goals: &[f32],
        actions: &[f32],
        outputs: &mut [f32],
    ) {
        let (n_observation, n_goal) = (self.task.n_observation(), self.task.n_goal());
        let (n_action, n_output) = (self.task.n_action(), self.network.n_output);
        let n_rows = observations.len() / n_observation;
        let n_actions = if actions.is_empty() { 0 } else { n_rows * n_action };
        assert_eq!(
            (observations.len(), goals.len(), actions.len(), outputs.len()),
            (n_rows * n_observation, n_rows * n_goal, n_actions, n_rows * n_output),
            "rows of another task"
        );
        for (row, output) in outputs.chunks_exact_mut(n_output).enumerate() {
            let number = |source: &Source| match *source {
                Source::Observation(i) => observations[row * n_observation + i],
                Source::Goal(i) => goals[row * n_goal + i],
                Source::Action(i) => actions[row * n_action + i],
            };
            let columns = self.network.columns.iter().zip(&self.sources);
            self.row.clear();
            self.row.extend(columns.map(|(column, source)| column.apply(number(source))));
            self.network.run(&mut self.row, &mut self.scratch);
            output.copy_from_slice(&self.row);
        }
    }
}

/// Returns the task of `model`: the one in its metadata, or the only one of the classic world whose vectors fit.
///
/// # Errors
/// When no task fits, or several do.
pub fn task_of(model: &Model, role: Role) -> Result<TaskSpec, ModelError> {
    if let Some(task) = task_in_metadata(&model.metadata)? {
        return Ok(task);
    }
    let candidates = Task::CLASSIC
        .into_iter()
        .flat_map(|task| (1..=MAX_ARMS).map(move |n| Layout::new(task, n)));
    let fitting = candidates.filter(|layout| BoundNetwork::new(model, role, *layout).is_ok());
    let fitting: Vec<Layout> = fitting.collect();
    match fitting.as_slice() {
        [layout] => Ok((*layout).into()),
        // The error for one arm names the first input or output that does not fit.
        [] => match BoundNetwork::new(model, role, Layout::new(Task::Push, 1)) {
            Err(error) => Err(error),
            Ok(_) => Err(ModelError::Model("it fits no task".to_owned())),
        },
        _ => Err(ModelError::Model(format!(
            "its inputs and outputs fit several tasks: add the metadata entries {:?} and {:?}",
            metadata::TASK,
            metadata::N_ARMS
        ))),
    }
}

/// Checks that the metadata of the models does not contradict that they belong together.
///
/// # Errors
/// When they are for different tasks, or parts of different policies.
pub fn check_pair(actor: &Model, critic: &Model) -> Result<(), ModelError> {
    let task = |model: &Model| task_in_metadata(&model.metadata).ok().flatten();
    if let (Some(of_actor), Some(of_critic)) = (task(actor), task(critic))
        && of_actor != of_critic
    {
        let text =
            |task: &TaskSpec| format!("{} with {}", task.name(), counted(task.n_arms(), "arm"));
        let (actor, critic) = (text(&of_actor), text(&of_critic));
        let problem = match actor == critic {
            false => format!("its metadata says {critic}, the actor's says {actor}"),
            true => format!("its metadata describes {critic} otherwise than the actor's"),
        };
        return Err(ModelError::Model(problem));
    }
    let policy = |model: &Model| model.metadata.get(metadata::POLICY_DIGEST).cloned();
    match (policy(actor), policy(critic)) {
        (Some(of_actor), Some(of_critic)) if of_actor != of_critic => {
            Err(ModelError::Model(format!(
                "it belongs to another policy than the actor: the metadata {:?} differs",
                metadata::POLICY_DIGEST
            )))
        }
        _ => Ok(()),
    }
}

/// Returns true if the metadata of `model` names its task, rightly or wrongly.
#[must_use]
pub fn names_task(model: &Model) -> bool {
    [metadata::TASK_DESCRIPTION, metadata::TASK, metadata::N_ARMS]
        .iter()
        .any(|key| model.metadata.contains_key(*key))
}

fn task_in_metadata(entries: &BTreeMap<String, String>) -> Result<Option<TaskSpec>, ModelError> {
    let refused = |key: &str, value: &str, expected: String| {
        let value = tandem_core::text::shortened(value, 80);
        ModelError::Model(format!("metadata {key:?} is {value:?}, expected {expected}"))
    };
    if let Some(text) = entries.get(metadata::TASK_DESCRIPTION) {
        let problem = |problem: &dyn Display| {
            let expected = format!("the description of a task: {problem}");
            refused(metadata::TASK_DESCRIPTION, text, expected)
        };
        let description: TaskDescription =
            serde_json::from_str(text).map_err(|error| problem(&error))?;
        return TaskSpec::new(description).map(Some).map_err(|error| problem(&error));
    }
    let missing = |key: &str, other: &str| {
        ModelError::Model(format!("metadata {other:?} is present, {key:?} is missing"))
    };
    let (task, n_arms) = match (entries.get(metadata::TASK), entries.get(metadata::N_ARMS)) {
        (Some(task), Some(n_arms)) => (task, n_arms),
        (None, None) => return Ok(None),
        (Some(_), None) => return Err(missing(metadata::N_ARMS, metadata::TASK)),
        (None, Some(_)) => return Err(missing(metadata::TASK, metadata::N_ARMS)),
    };
    let task = task.parse::<Task>().map_err(|_unknown| {
        refused(metadata::TASK, task, format!("one of {}", Task::ALL.map(Task::name).join(", ")))
    })?;
    match n_arms.parse::<usize>() {
        Ok(n @ 1..=MAX_ARMS) => Ok(Some(Layout::new(task, n).into())),
        _ => Err(refused(metadata::N_ARMS, n_arms, format!("1 to {MAX_ARMS}"))),
    }
}

/// Returns the sources of the numbers of an input.
fn sources(
    input: &Input,
    is_only: bool,
    role: Role,
    task: &TaskSpec,
) -> Result<Vec<Source>, ModelError> {
    let observation = || (0..task.n_observation()).map(Source::Observation);
    let goal = || (0..task.n_goal()).map(Source::Goal);
    let action = || (0..task.n_action()).map(Source::Action);
    let achieved = || task.description().achieved_goal.iter().copied();
    let has_action = role == Role::Critic;
    let mut candidates: Vec<Vec<Source>> = Vec::new();
    let name = input.name.to_ascii_lowercase();
    match name.as_str() {
        "observation" | "observations" | "obs" | "state" => {
            candidates.extend([observation().collect(), observation().chain(goal()).collect()]);
        }
        "goal" | "goals" | "desired_goal" => candidates.push(goal().collect()),
        "achieved_goal" => candidates.push(achieved().map(Source::Observation).collect()),
        "action" | "actions" if has_action => candidates.push(action().collect()),
        _ => {}
    }
    if is_only {
        let actions = action().take(if has_action { usize::MAX } else { 0 });
        candidates.push(observation().chain(goal()).chain(actions).collect());
    }
    let refused = |problem| ModelError::Value { kind: "input", name: input.name.clone(), problem };
    if candidates.is_empty() {
        let names = match role {
            Role::Actor => "observation, goal (desired_goal) or achieved_goal",
            Role::Critic => "observation, goal (desired_goal), achieved_goal or action",
        };
        return Err(refused(format!("the name is unknown, expected {names}, or a single input")));
    }
    let lengths: Vec<String> = candidates.iter().map(|sources| sources.len().to_string()).collect();
    let fitting = candidates.into_iter().find(|sources| sources.len() == input.width);
    fitting.ok_or_else(|| {
        refused(format!(
            "it has {} numbers, {} with {} has {}",
            input.width,
            task.name(),
            counted(task.n_arms(), "arm"),
            lengths.join(" or ")
        ))
    })
}

/// Returns the range of the observation, then of the goal and of the action, in an input row of a policy's network.
pub(crate) fn policy_columns(task: &TaskSpec) -> [Range<usize>; 3] {
    let n_state = task.n_observation() + task.n_goal();
    [0..task.n_observation(), task.n_observation()..n_state, n_state..n_state + task.n_action()]
}
