//! The command line of `tandem scene`.

use std::path::PathBuf;

use clap::Args;
use tandem_core::evaluation::TEST_SEED;

use super::{TaskName, WorldName};

#[derive(Debug, Args)]
#[command(group = clap::ArgGroup::new("actor"), after_help = "\
Examples:
  tandem scene --task push --arms 2 --json
  tandem scene --task push --arms 1 --episodes 240 --seed 780 --json
  tandem scene --task pick-and-place --actions actions.json --seed 780 --json
  tandem scene --policy policies/student-push.safetensors --episodes 240 \\
      --seed 780 --json

docs/transfer.md describes the output.")]
pub(crate) struct SceneArgs {
    /// Task [default: the policy's, or push].
    #[arg(long, value_parser = TaskName::parser())]
    pub(crate) task: Option<TaskName>,
    /// World of the task [default: the policy's, or shared].
    #[arg(long, value_enum)]
    pub(crate) world: Option<WorldName>,
    /// Number of arms [default: the policy's; 2 otherwise].
    #[arg(long)]
    pub(crate) arms: Option<usize>,
    /// Number of evaluation episodes to print. Without actions, only their initial states and goals are printed.
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(0..=10_000), conflicts_with = "actions")]
    pub(crate) episodes: u64,
    /// Seed of the initial states and goals; `tandem eval` plays the same ones.
    #[arg(long, default_value_t = TEST_SEED)]
    pub(crate) seed: u64,
    /// Simulates these actions: JSON of shape `[episodes][steps][n_action]`.
    #[arg(long, value_name = "FILE.json", group = "actor")]
    pub(crate) actions: Option<PathBuf>,
    /// Simulates the actions of this policy.
    #[arg(long, value_name = "FILE|DIR", group = "actor")]
    pub(crate) policy: Option<PathBuf>,
    /// Simulates the actions of this one-arm policy, which controls each arm separately.
    #[arg(long, value_name = "FILE|DIR", group = "actor")]
    pub(crate) composed_teachers: Option<PathBuf>,
    /// Prints one JSON object on one line [default: indented].
    #[arg(long)]
    pub(crate) json: bool,
}
