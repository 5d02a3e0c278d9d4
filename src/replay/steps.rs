//! The text of an episode's log, one line for each control step.

use std::path::Path;

use tandem_core::text::counted;
use tandem_core::{Contacts, TaskSpec};
use tandem_telemetry::{LoggedTransition, read_episode};

use crate::exit::{Exit, Failed, OrExit as _};
use crate::output;

/// Width of an arm's column: `0.143 m, advised, at goal`.
const ARM_COLUMNS: usize = 26;

/// Prints the steps of the log `file`, and whether the episode succeeded.
pub(super) fn print(file: &Path) -> Result<(), Failed> {
    let log = read_episode(file).or_exit(Exit::Data, String::new)?;
    let task = &log.metadata.task;
    output::print(format_args!("episode {} of {}", log.metadata.episode, file.display()))?;
    output::print(format_args!(
        "task {}, {}, tolerance {}{}",
        task.name(),
        counted(task.n_arms(), "arm"),
        task.tolerance(),
        unit(task)
    ))?;
    output::print(line("step", &column_names(task), "contacts"))?;
    for (step_idx, step) in log.transitions.iter().enumerate() {
        let cells = cells(task, &step.observation, &step.goal, step.advised_arms);
        output::print(line(&format!("{step_idx:>4}"), &cells, contacts_text(step.contacts)))?;
    }
    let last = log.last_observation.as_ref().zip(log.transitions.last()).zip(log.succeeded());
    last.map_or(Ok(()), |((observation, LoggedTransition { goal, .. }), is_success)| {
        output::print(line(" end", &cells(task, observation, goal, 0), ""))?;
        output::print(if is_success { "success" } else { "failure" })
    })
}

fn line(first: &str, cells: &[String], last: &str) -> String {
    let cells: String = cells.iter().map(|cell| format!("{cell:ARM_COLUMNS$}")).collect();
    format!("{first}  {cells}{last}").trim_end().to_owned()
}

/// Returns a name for each of the task's goal distances.
fn column_names(task: &TaskSpec) -> Vec<String> {
    match task.n_arms() {
        1 => vec!["distance from goal".to_owned()],
        _ => {
            let of_arms = task.arms().map(|arm| format!("arm {}, from its goal", arm.0));
            let has_common = !task.common_goal().is_empty();
            of_arms.chain(has_common.then(|| "common goal".to_owned())).collect()
        }
    }
}

/// Returns the distance of each arm from its goal, whether the arm executes the teacher's action, and whether it is at
/// its goal; then the distance of the arms together from the goal common to them, if there is one.
fn cells(task: &TaskSpec, observation: &[f32], goal: &[f32], advised_arms: u8) -> Vec<String> {
    let unit = unit(task);
    let cell = |(idx, distance): (usize, f32)| {
        let is_advised = idx < task.n_arms() && advised_arms >> idx & 1 == 1;
        let advised = if is_advised { ", advised" } else { "" };
        let at_goal = if distance <= task.tolerance() { ", at goal" } else { "" };
        format!("{distance:.3}{unit}{advised}{at_goal}")
    };
    task.goal_distances(observation, goal).into_iter().enumerate().map(cell).collect()
}

/// Returns the unit of distances: metres in the built-in tasks, none in others.
fn unit(task: &TaskSpec) -> &'static str {
    if task.as_built_in().is_some() { " m" } else { "" }
}

const fn contacts_text(contacts: Contacts) -> &'static str {
    match (contacts.contains(Contacts::ARM_ARM), contacts.contains(Contacts::ARM_TABLE)) {
        (true, true) => "arms, table",
        (true, false) => "arms",
        (false, true) => "table",
        (false, false) => "",
    }
}
