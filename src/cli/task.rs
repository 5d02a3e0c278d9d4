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
    Push,
    PickAndPlace,
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

    /// Returns the task in a world; the default is [`World::DEFAULT`].
    pub(crate) fn in_named_world(self, world: Option<WorldName>) -> Task {
        self.in_world(world.map_or(World::DEFAULT, World::from))
    }

    const fn in_world(self, world: World) -> Task {
        match self {
            Self::Push => Task::Push.in_world(world),
            Self::PickAndPlace => Task::PickAndPlace.in_world(world),
        }
    }
}

/// Returns the task that the options name, or `None` if they name none. The default task is to push; the default world
/// is [`World::DEFAULT`].
pub(crate) fn chosen_task(task: Option<TaskName>, world: Option<WorldName>) -> Option<Task> {
    match (task, world) {
        (None, None) => None,
        (task, _) => Some(task.unwrap_or(TaskName::Push).in_named_world(world)),
    }
}

/// Refuses a policy for `of_policy` if the options name another task or another world.
pub(crate) fn check_task(
    of_policy: Task,
    task: Option<TaskName>,
    world: Option<WorldName>,
) -> Result<(), Failed> {
    let world = world.map_or(of_policy.world(), World::from);
    let named = task.map_or(of_policy.in_world(world), |task| task.in_world(world));
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
    match n_arms {
        Some(n_arms) if n_arms != of_policy.n_arms => Err(Failed::usage(format!(
            "the policy is for {}, not for {}",
            counted(of_policy.n_arms, "arm"),
            counted(n_arms, "arm")
        ))),
        _ => Ok(()),
    }
}

/// Returns the options that choose `task`.
pub(crate) fn task_flags(task: Task) -> String {
    let name = task.in_world(World::Classic);
    match task.world() {
        World::DEFAULT => format!("--task {name}"),
        world => format!("--task {name} --world {world}"),
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
        assert_eq!(chosen_task(None, None), None);
        assert_eq!(chosen_task(pick, None), Some(Task::PickAndPlace.in_world(World::DEFAULT)));
        assert_eq!(chosen_task(pick, shared), Some(Task::SharedPickAndPlace));
        assert_eq!(chosen_task(push, classic), Some(Task::Push));
        assert_eq!(chosen_task(None, shared), Some(Task::SharedPush));
    }

    #[test]
    fn a_policy_is_checked_against_what_the_options_name_only() {
        let refused = |task, world| check_task(Task::SharedPush, task, world).is_err();
        assert!(!refused(None, None));
        assert!(!refused(Some(TaskName::Push), None));
        assert!(!refused(None, Some(WorldName::Shared)));
        assert!(refused(Some(TaskName::PickAndPlace), None));
        assert!(refused(Some(TaskName::Push), Some(WorldName::Classic)));
    }

    #[test]
    fn the_name_of_a_task_in_files_gets_a_tip() {
        use clap::Parser as _;
        let parsed = crate::cli::Cli::try_parse_from(["tandem", "train", "--task", "shared-push"]);
        let message = parsed.expect_err("not a name of a task").to_string();
        assert!(message.contains("use '--task push --world shared'"), "{message}");
        assert!(message.contains("push, pick-and-place"), "{message}");
    }

    #[test]
    fn the_flags_of_a_task_name_its_world_unless_it_is_the_default() {
        assert_eq!(task_flags(Task::PickAndPlace), "--task pick-and-place");
        assert_eq!(task_flags(Task::SharedPush), "--task push --world shared");
    }
}
