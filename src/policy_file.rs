//! Policy files: loading them, and the shipped teachers.

use std::path::{Path, PathBuf};

use tandem_core::{Task, World};
use tandem_policy::Policy;
use tandem_rl::config::Recipe;
use tandem_teacher::policy::is_onnx;

use crate::cli::task_flags;
use crate::exit::{Exit, Failed, OrExit as _};

/// Loads a policy file.
pub(crate) fn load(path: &Path) -> Result<Policy, Failed> {
    if is_onnx(path) {
        let shown = path.display();
        return Err(Failed::usage(format!(
            "{shown} is an ONNX model: convert it with `tandem policy import {shown} --out FILE.safetensors`"
        )));
    }
    Policy::load(path).or_exit(Exit::Data, String::new)
}

/// Finds the shipped teacher of a task that was trained with `recipe`, or with the default recipe if there is none.
pub(crate) fn shipped_teacher_of(recipe: Recipe, task: &str) -> Result<PathBuf, Failed> {
    if recipe == Recipe::Paper
        && let Ok(path) = find_teacher(task, "-paper")
    {
        return Ok(path);
    }
    shipped_teacher(task)
}

/// Finds the shipped teacher of a task: in the working directory, next to the program, or in the source tree.
pub(crate) fn shipped_teacher(task: &str) -> Result<PathBuf, Failed> {
    find_teacher(task, "")
}

fn find_teacher(task: &str, suffix: &str) -> Result<PathBuf, Failed> {
    let name = format!("policies/teacher-{}{suffix}.safetensors", shipped_name(task));
    let next_to_program =
        std::env::current_exe().ok().and_then(|exe| Some(exe.parent()?.join(&name)));
    let candidates = [
        Some(PathBuf::from(&name)),
        next_to_program,
        Some(Path::new(env!("CARGO_MANIFEST_DIR")).join(&name)),
    ];
    let found = candidates.into_iter().flatten().find(|path| path.exists());
    found.ok_or_else(|| Failed::usage(no_teacher(&name, task)))
}

/// Describes how to get a teacher for `task`, for which `file` does not ship.
fn no_teacher(file: &str, task: &str) -> String {
    match task.parse() {
        Ok(built_in) => format!(
            "{file}, the shipped teacher of {task}, does not exist: train one with `tandem train --arms 1 {}` and name \
             its policy/best.safetensors with --teacher",
            task_flags(built_in)
        ),
        Err(_) => format!(
            "{task} has no shipped teacher: train one in a one-arm environment of the task (docs/environments.md), then \
             give --teacher FILE, or choose --strategy none"
        ),
    }
}

/// Returns the name under which the policies of a task ship: that of the task, and its world unless that is the default.
fn shipped_name(task: &str) -> String {
    let Ok(built_in) = task.parse::<Task>() else { return task.to_owned() };
    let name = built_in.in_world(World::Classic).unwrap_or(built_in).name();
    match (built_in.in_world(World::DEFAULT), built_in.world()) {
        (None, _) | (_, World::DEFAULT) => name.to_owned(),
        (Some(_), world) => format!("{name}-{world}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn policies_of_other_worlds_than_the_default_one_ship_under_names_with_their_worlds() {
        let is_default = |task: Task| task.world() == World::DEFAULT;
        for task in Task::CLASSIC.into_iter().chain(Task::SHARED) {
            let plain = task.in_world(World::Classic).unwrap_or(task).name();
            let expected = if is_default(task) {
                plain.to_owned()
            } else {
                format!("{plain}-{}", task.world())
            };
            assert_eq!(shipped_name(task.name()), expected);
        }
        assert_eq!(shipped_name("carry-bar"), "carry-bar");
        assert_eq!(shipped_name("FetchPush-v4"), "FetchPush-v4");
    }

    #[test]
    fn only_for_built_in_tasks_a_missing_teacher_is_trained_with_the_name_of_the_task() {
        let built_in = no_teacher("policies/x.safetensors", "shared-push");
        assert!(built_in.contains("`tandem train --arms 1 --task push`"), "{built_in}");
        let served = shipped_teacher("lift-rod").expect_err("does not ship").line();
        assert!(served.starts_with("lift-rod has no shipped teacher: "), "{served}");
        assert!(!served.contains("--task"), "{served}");
        assert!(served.contains("--teacher FILE, or choose --strategy none"), "{served}");
    }
}
