//! The options that choose a built-in task: its name and its world.

use std::ffi::OsStr;

use clap::builder::{EnumValueParser, PossibleValue, StyledStr, TypedValueParser};
use clap::error::{ContextKind, ContextValue};
use clap::{Arg, Command, ValueEnum};
use tandem_core::text::counted;
use tandem_core::{Layout, Task, World};

use crate::exit::Failed;

/// A task in any world.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum TaskName {
    /// Push an object to its goal.
    Push,
    /// Grasp an object and move it to its goal.
    PickAndPlace,
    /// Carry a bar to its goal with two arms; it has a world of its own.
    CarryBar,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum WorldName {
    /// Fast arms; the areas of two arms lie next to each other.
    Classic,
    /// Arms as slow as real ones; two arms share one area.
    Shared,
}

impl From<WorldName> for World {
    fn from(name: WorldName) -> Self {
        match name {
            WorldName::Classic => Self::Classic,
            WorldName::Shared => Self::Shared,
        }
    }
}

impl TaskName {
    /// Returns a parser that also explains the names which tasks have in files.
    pub(crate) const fn parser() -> TaskNameParser {
        TaskNameParser
    }

    /// Returns the task in a world; the default is [`World::DEFAULT`], or the only world of the task.
    pub(crate) fn in_named_world(self, world: Option<WorldName>) -> Result<Task, Failed> {
        match world {
            Some(world) => in_world(self.in_default_world(), world),
            None => Ok(self.in_default_world()),
        }
    }

    pub(crate) fn in_default_world(self) -> Task {
        let task = match self {
            Self::Push => Task::Push,
            Self::PickAndPlace => Task::PickAndPlace,
            Self::CarryBar => Task::CarryBar,
        };
        task.in_world(World::DEFAULT).unwrap_or(task)
    }
}

fn in_world(task: Task, world: WorldName) -> Result<Task, Failed> {
    task.in_world(world.into()).ok_or_else(|| {
        Failed::usage(format!("{task} exists in a world of its own: leave out --world"))
    })
}

/// Returns the task that the options name, or `None` if they name none. The default task is to push; the default world
/// is [`World::DEFAULT`].
pub(crate) fn chosen_task(
    task: Option<TaskName>,
    world: Option<WorldName>,
) -> Result<Option<Task>, Failed> {
    match (task, world) {
        (None, None) => Ok(None),
        (task, _) => task.unwrap_or(TaskName::Push).in_named_world(world).map(Some),
    }
}

/// Refuses a policy for `of_policy` if the options name another task or another world.
pub(crate) fn check_task(
    of_policy: Task,
    task: Option<TaskName>,
    world: Option<WorldName>,
) -> Result<(), Failed> {
    let named = match (task.map(TaskName::in_default_world), world) {
        (task, Some(world)) => in_world(task.unwrap_or(of_policy), world)?,
        (Some(task), None) => task.in_world(of_policy.world()).unwrap_or(task),
        (None, None) => of_policy,
    };
    if named == of_policy {
        return Ok(());
    }
    Err(Failed::usage(format!("the policy is for {of_policy}, not for {named}")))
}

/// Refuses a policy for `of_policy` if the options name another task, world or number of arms.
pub(crate) fn check_layout(
    of_policy: Layout,
    (task, world): (Option<TaskName>, Option<WorldName>),
    n_arms: Option<usize>,
) -> Result<(), Failed> {
    check_task(of_policy.task, task, world)?;
    n_arms.map_or(Ok(()), |n_arms| check_n_arms(of_policy.n_arms, n_arms))
}

/// Rejects a number of arms other than the policy's.
pub(crate) fn check_n_arms(of_policy: usize, n_arms: usize) -> Result<(), Failed> {
    match of_policy == n_arms {
        true => Ok(()),
        false => Err(Failed::usage(format!(
            "the policy is for {}, not for {}",
            counted(of_policy, "arm"),
            counted(n_arms, "arm")
        ))),
    }
}

/// Returns the options that choose `task`.
pub(crate) fn task_flags(task: Task) -> String {
    match (task.in_world(World::Classic), task.world()) {
        (None, _) => format!("--task {task}"),
        (Some(name), World::DEFAULT) => format!("--task {name}"),
        (Some(name), world) => format!("--task {name} --world {world}"),
    }
}

/// The parser of `--task`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TaskNameParser;

impl TypedValueParser for TaskNameParser {
    type Value = TaskName;

    fn parse_ref(
        &self,
        command: &Command,
        arg: Option<&Arg>,
        value: &OsStr,
    ) -> Result<TaskName, clap::Error> {
        let parsed = EnumValueParser::new().parse_ref(command, arg, value);
        parsed.map_err(|mut error| {
            if let Some(Ok(task)) = value.to_str().map(str::parse::<Task>) {
                let tip = StyledStr::from(format!("use '{}'", task_flags(task)));
                error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![tip]));
            }
            error
        })
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        let values = TaskName::value_variants().iter();
        Some(Box::new(values.filter_map(TaskName::to_possible_value)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_options_name_a_task_in_a_world() {
        let (push, pick) = (Some(TaskName::Push), Some(TaskName::PickAndPlace));
        let (classic, shared) = (Some(WorldName::Classic), Some(WorldName::Shared));
        let bar = Some(TaskName::CarryBar);
        let chosen = |task, world| chosen_task(task, world).expect("a task of this world");
        assert_eq!(chosen(None, None), None);
        assert_eq!(chosen(pick, None), Task::PickAndPlace.in_world(World::DEFAULT));
        assert_eq!(chosen(pick, shared), Some(Task::SharedPickAndPlace));
        assert_eq!(chosen(push, classic), Some(Task::Push));
        assert_eq!(chosen(None, shared), Some(Task::SharedPush));
        assert_eq!(chosen(bar, None), Some(Task::CarryBar));
        assert!(chosen_task(bar, shared).is_err());
    }

    #[test]
    fn a_policy_is_checked_against_what_the_options_name_only() {
        let refused = |task, world| check_task(Task::SharedPush, task, world).is_err();
        assert!(!refused(None, None));
        assert!(!refused(Some(TaskName::Push), None));
        assert!(!refused(None, Some(WorldName::Shared)));
        assert!(refused(Some(TaskName::PickAndPlace), None));
        assert!(refused(Some(TaskName::Push), Some(WorldName::Classic)));
        assert!(refused(Some(TaskName::CarryBar), None));
        assert!(check_task(Task::CarryBar, Some(TaskName::CarryBar), None).is_ok());
        assert!(check_task(Task::CarryBar, Some(TaskName::PickAndPlace), None).is_err());
    }

    #[test]
    fn the_name_of_a_task_in_files_gets_a_tip() {
        use clap::Parser as _;
        let parsed = crate::cli::Cli::try_parse_from(["tandem", "train", "--task", "shared-push"]);
        let message = parsed.expect_err("not a name of a task").to_string();
        assert!(message.contains("use '--task push'"), "{message}");
        assert!(message.contains("push, pick-and-place"), "{message}");
    }

    #[test]
    fn the_flags_of_a_task_name_its_world_unless_it_is_the_default() {
        assert_eq!(task_flags(Task::PickAndPlace), "--task pick-and-place --world classic");
        assert_eq!(task_flags(Task::SharedPush), "--task push");
        assert_eq!(task_flags(Task::CarryBar), "--task carry-bar");
    }
}
