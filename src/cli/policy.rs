//! The command line of `tandem policy`.

use std::path::PathBuf;

use clap::{Args, Subcommand};

use super::{EnvironmentArgs, TaskName, WorldName};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem policy show policies/student-push.safetensors
  tandem policy export policies/student-push.safetensors --onnx actor.onnx
  tandem policy symmetrize policies/student-push.safetensors --out s.safetensors
  tandem policy import actor.onnx --critic critic.onnx --out FILE.safetensors")]
pub(crate) struct PolicyArgs {
    #[command(subcommand)]
    pub(crate) command: PolicyCommand,
}

#[derive(Debug, Subcommand)]
pub(crate) enum PolicyCommand {
    /// Shows what a policy file or an ONNX model contains.
    Show(ShowArgs),
    /// Exports a policy to ONNX models.
    Export(ExportArgs),
    /// Converts ONNX models to a policy file.
    Import(ImportArgs),
    /// Makes a policy treat interchangeable arms alike.
    Symmetrize(SymmetrizeArgs),
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem policy show policies/student-push.safetensors
  tandem policy show actor.onnx --json")]
pub(crate) struct ShowArgs {
    /// Policy file, run directory, or ONNX model (*.onnx).
    pub(crate) file: PathBuf,
    /// Prints one JSON object.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
#[command(group = clap::ArgGroup::new("to").required(true).multiple(true), after_help = "\
Examples:
  tandem policy export policies/student-push.safetensors --onnx actor.onnx
  tandem policy export FILE --onnx actor.onnx --critic-onnx critic.onnx

The models normalise their inputs themselves. Actor: inputs observation and goal, output action. \
Critic: inputs observation, goal and action, output value. docs/onnx.md describes the vectors.")]
pub(crate) struct ExportArgs {
    /// Policy file, or a run directory.
    pub(crate) file: PathBuf,
    /// Output file of the actor.
    #[arg(long, value_name = "FILE.onnx", group = "to")]
    pub(crate) onnx: Option<PathBuf>,
    /// Output file of the critic.
    #[arg(long, value_name = "FILE.onnx", group = "to")]
    pub(crate) critic_onnx: Option<PathBuf>,
    /// Prints one JSON object.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem policy import actor.onnx --critic critic.onnx --out FILE.safetensors
  tandem policy import actor.onnx --task push --arms 1 --out FILE.safetensors
  tandem policy import actor.onnx --env-command 'python3 server.py' \\
      --out FILE.safetensors
  tandem eval --composed-teachers FILE.safetensors

A policy file has ReLU between the layers and tanh after the actor's last. `tandem teacher --policy \
actor.onnx` serves other networks without a conversion.")]
pub(crate) struct ImportArgs {
    /// ONNX model of the actor.
    pub(crate) actor: PathBuf,
    /// ONNX model of the critic. Without it, the policy has no values.
    #[arg(long, value_name = "FILE.onnx")]
    pub(crate) critic: Option<PathBuf>,
    /// Task [default: the one in the model's metadata, or the one of the classic world that the model fits].
    #[arg(long, value_parser = TaskName::parser(), requires = "arms", conflicts_with_all = ["env", "env_command"])]
    pub(crate) task: Option<TaskName>,
    /// World of the task [default: shared].
    #[arg(long, value_enum, requires = "task")]
    pub(crate) world: Option<WorldName>,
    /// Number of arms [default: as for --task].
    #[arg(long, value_name = "N", requires = "task", value_parser = clap::value_parser!(u8).range(1..=8))]
    pub(crate) arms: Option<u8>,
    #[command(flatten)]
    pub(crate) environment: EnvironmentArgs,
    /// Output file.
    #[arg(long, value_name = "FILE.safetensors")]
    pub(crate) out: PathBuf,
    /// Prints one JSON object.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem policy symmetrize policies/student-push.safetensors --out s.safetensors
  tandem eval --policy s.safetensors

Where arms are interchangeable, the best action of a scene does not depend on their order. The new \
policy computes the mean for both orders, in networks twice as wide. Runs save such policies unless \
evaluation.symmetrized is false.")]
pub(crate) struct SymmetrizeArgs {
    /// Policy file, or a run directory.
    pub(crate) file: PathBuf,
    /// Output file.
    #[arg(long, value_name = "FILE.safetensors")]
    pub(crate) out: PathBuf,
    /// Prints one JSON object.
    #[arg(long)]
    pub(crate) json: bool,
}
