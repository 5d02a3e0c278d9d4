//! The command line.

use clap::{Parser, Subcommand};

use crate::version::VERSION;

mod bench;
mod bridge;
mod monitor;
mod number;
mod policy;
mod recording;
mod results;
mod scene;
mod service;
mod task;
mod train;
mod trial;

pub(crate) use bench::{BenchArgs, BenchName, ScaleArgs};
pub(crate) use bridge::{
    ArmsArgs, ArmsServeArgs, BridgeArgs, BridgeCommand, BridgeServeArgs, CalibrateArgs, CellArgs,
    ConnectArgs, DriverName, FaultName, HomeArgs, InjectArgs, MoveArgs, OperatorArgs, ToStartArgs,
};
pub(crate) use monitor::{HealthArgs, StatusArgs};
pub(crate) use policy::{
    ExportArgs, ImportArgs, PolicyArgs, PolicyCommand, ShowArgs, SymmetrizeArgs,
};
pub(crate) use recording::{ByteSize, LiveArgs, RecordedName, RecordingArgs};
pub(crate) use results::{
    EvalArgs, FilmArgs, McapArgs, McapCommand, OutcomeName, PictureArgs, ReplayArgs, ReportArgs,
};
pub(crate) use scene::SceneArgs;
pub(crate) use service::{
    ClientArgs, DEFAULT_LISTEN, EnvArgs, EnvGuardArgs, EnvironmentArgs, LearnerArgs, ListenArgs,
    MetricsArgs, RelayArgs, SecretArgs, TeacherArgs, WorkerArgs,
};
pub(crate) use task::{
    TaskName, WorldName, check_layout, check_n_arms, check_task, chosen_task, task_flags,
};
pub(crate) use train::{DashboardArgs, RecipeName, SweepArgs, TrainArgs};
pub(crate) use trial::{ModeName, RecordName, TrialArgs};

/// Trains policies for two robot arms with advice from a one-arm policy.
#[derive(Debug, Parser)]
#[command(
    name = "tandem",
    version = VERSION,
    propagate_version = true,
    after_help = "\
Examples:
  tandem train                       # trains two arms to push, with advice
  tandem train --arms 1 --task push  # trains a one-arm teacher from scratch
  tandem eval --policy runs/NAME     # evaluates the best policy of a run
  tandem COMMAND --help              # more examples

Exit codes: 0 success, 64 wrong usage or configuration, 65 invalid input data, 70 bug, 74 the \
result cannot be written to standard output, 75 temporary failure (try again), 130 interrupted, \
141 standard output was closed by its reader."
)]
pub(crate) struct Cli {
    /// Log filter, such as info or tandem_learner=debug; overrides RUST_LOG.
    #[arg(long, global = true, value_name = "FILTER")]
    pub(crate) log: Option<String>,
    /// Sends traces to the OpenTelemetry collector at this address (OTLP over gRPC), such as http://127.0.0.1:4317.
    #[cfg(feature = "otlp")]
    #[arg(long, global = true, value_name = "URL", env = "OTEL_EXPORTER_OTLP_ENDPOINT")]
    pub(crate) otlp_endpoint: Option<String>,
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Trains a policy: starts a learner, a teacher and workers on this machine.
    Train(Box<TrainArgs>),
    /// Evaluates a policy on fixed goals, without noise or advice.
    Eval(EvalArgs),
    /// Trains a list of runs: every combination of the strategies, tasks, seeds and settings in a file.
    Sweep(SweepArgs),
    /// Compares runs and trials: the paper's Tables 2 and 4, curves, and an HTML page.
    Report(ReportArgs),
    /// Serves a one-arm policy as a teacher.
    Teacher(TeacherArgs),
    /// Serves the learner of a run.
    Learner(LearnerArgs),
    /// Plays episodes for a learner.
    Worker(WorkerArgs),
    /// Serves the built-in environments to workers and other programs.
    Env(EnvArgs),
    /// Runs an environment command until standard input closes.
    #[command(hide = true)]
    EnvGuard(EnvGuardArgs),
    /// Distributes a learner's parameters to nearby workers, for runs with very many workers.
    Relay(RelayArgs),
    /// Serves a pair of arms, real or simulated, and operates it.
    Bridge(BridgeArgs),
    /// Checks the health of a service.
    Health(HealthArgs),
    /// Shows the progress of a run.
    Status(StatusArgs),
    /// Benchmarks the simulator, networks, updates, replay buffer and a short run on this machine.
    Bench(BenchArgs),
    /// Inspects and symmetrises policies, and converts them from and to ONNX.
    Policy(PolicyArgs),
    /// Repairs MCAP logs.
    Mcap(McapArgs),
    /// Simulates recorded episodes again and compares them bit for bit.
    Replay(ReplayArgs),
    /// Draws a step of an episode as a PNG picture.
    Picture(PictureArgs),
    /// Prints the simulated world, and episodes in it, as JSON for other physics engines.
    Scene(SceneArgs),
    /// Prints the help of every command as a Markdown page.
    #[command(
        hide = true,
        after_help = "\
Examples:
  tandem commands > commands.md"
    )]
    Commands,
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;
    use crate::columns::N_COLUMNS;

    /// Returns the commands without subcommands, by their full names.
    fn leaves(command: &clap::Command, name: &str) -> Vec<(String, clap::Command)> {
        let shown = command.get_subcommands().filter(|command| !command.is_hide_set());
        let below: Vec<_> = shown
            .flat_map(|below| leaves(below, &format!("{name} {}", below.get_name())))
            .collect();
        if below.is_empty() { vec![(name.to_owned(), command.clone())] } else { below }
    }

    #[test]
    fn every_command_has_examples_that_fit_a_narrow_terminal() {
        for (name, command) in leaves(&Cli::command(), "tandem") {
            let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            let examples = help.split("\n\n").find(|part| part.starts_with("Examples:"));
            let examples = examples.unwrap_or_else(|| panic!("{name} has no examples"));
            assert!(examples.contains("  tandem "), "{name}: {examples}");
            let too_long = examples.lines().find(|line| line.chars().count() > N_COLUMNS);
            assert_eq!(too_long, None, "{name}");
        }
    }
}
