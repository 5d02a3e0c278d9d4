//! Policy files: loading them, and the shipped teachers.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use anyhow::anyhow;
use tandem_core::{Task, World};
use tandem_policy::Policy;
use tandem_rl::config::Recipe;
use tandem_teacher::policy::is_onnx;

use crate::cli::task_flags;
use crate::exit::{Exit, Failed, OrExit as _};

/// The best policy of a run, in its directory.
pub(crate) const BEST: &str = "policy/best.safetensors";

/// Returns the policy file that the command line names: `path` itself or, if it is a run directory, the best policy of
/// the run.
pub(crate) fn file_of(path: &Path) -> Result<Cow<'_, Path>, Failed> {
    if !path.is_dir() {
        return Ok(path.into());
    }
    let best = path.join(BEST);
    if best.exists() {
        return Ok(best.into());
    }
    let what = anyhow!(
        "{} is a directory without {BEST}: name a policy file, or the directory of a run that was evaluated",
        path.display()
    );
    Err(Failed::new(Exit::Data, what))
}

/// Loads a policy file, or the best policy of a run directory.
pub(crate) fn load(path: &Path) -> Result<Policy, Failed> {
    let path = &*file_of(path)?;
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
             its directory with --teacher",
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
    fn a_run_directory_stands_for_its_best_policy() {
        let run = tempfile::tempdir().expect("a directory");
        let refused = load(run.path()).expect_err("has no policy");
        assert!(refused.line().contains("without policy/best.safetensors"), "{}", refused.line());
        std::fs::create_dir(run.path().join("policy")).expect("creates");
        let shipped = shipped_teacher("push").expect("ships");
        std::fs::copy(&shipped, run.path().join(BEST)).expect("copies");
        let loaded = load(run.path()).expect("the best policy");
        assert_eq!(loaded.digest(), load(&shipped).expect("a policy").digest());
        assert_eq!(file_of(&shipped).expect("a file"), shipped);
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
