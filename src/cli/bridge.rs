//! The command line of `tandem bridge`.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};

use super::{DialArgs, ListenArgs, SecretArgs, TrialArgs};

/// Where a bridge listens, and where operators look for it.
const ADDRESS: &str = "127.0.0.1:7002";

#[derive(Debug, Args)]
#[command(
    args_conflicts_with_subcommands = true,
    after_help = "\
Examples:
  tandem bridge --driver sim                              serves a simulated pair of arms
  tandem bridge --driver sim --speed 0.1                  the same, no motion faster than a tenth
  tandem bridge status                                    what the arms do, and why they are stopped
  tandem bridge stop                                      stops them; anyone may, at any time
  tandem bridge reset                                     lets stopped arms go
  tandem bridge move deploy/first-motion.json --check-only
  tandem bridge move deploy/first-motion.json --speed 0.1
  tandem bridge trial --policy policies/student-push.safetensors
  tandem bridge --driver quarc --arms-at tcpip://10.0.0.5:18000 --speed 0.1

docs/bridge.md leads from nothing to a first motion."
)]
pub(crate) struct BridgeArgs {
    #[command(subcommand)]
    pub(crate) command: Option<BridgeCommand>,
    #[command(flatten)]
    pub(crate) serve: BridgeServeArgs,
}

#[derive(Debug, Args)]
#[command(mut_arg("listen", |arg| arg.default_value(ADDRESS)))]
pub(crate) struct BridgeServeArgs {
    /// What moves the arms.
    #[arg(long, value_enum, default_value_t = DriverName::Sim)]
    pub(crate) driver: DriverName,
    /// Where the arms' side listens: tcpip://HOST:PORT for quarc, ws://HOST:PORT for kinova-ros.
    #[arg(long, value_name = "ADDR", required_if_eq_any([("driver", "quarc"), ("driver", "kinova-ros")]))]
    pub(crate) arms_at: Option<String>,
    /// No motion is played faster than this share of its own speed, 0.01 to 1.
    #[arg(long, default_value_t = 1.0, value_parser = share)]
    pub(crate) speed: f64,
    /// Seed of the simulated pair's noise and latencies.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) seed: u64,
    #[command(flatten)]
    pub(crate) listen: ListenArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
}

/// What moves the arms.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum DriverName {
    /// A simulated pair of Kinova Micos: nothing real moves.
    Sim,
    /// Arms behind a Simulink model, by way of QUARC [builds with feature quarc].
    Quarc,
    /// Arms behind Kinova's ROS driver, by way of rosbridge [builds with feature kinova-ros].
    KinovaRos,
}

#[derive(Debug, Subcommand)]
pub(crate) enum BridgeCommand {
    /// Shows what the arms do, and why they are stopped.
    Status(OperatorArgs),
    /// Stops the arms. Exit code 0 says that the drives were told.
    Stop(OperatorArgs),
    /// Shows what arms these are and what they may do.
    Describe(OperatorArgs),
    /// Lets stopped arms go: they stay where they are until a motion begins. Look at them first.
    Reset(OperatorArgs),
    /// Moves the arms as a file says. Ctrl-C stops them.
    Move(MoveArgs),
    /// Tries policies on a simulated pair and counts how often they succeed; needs no bridge.
    Trial(TrialArgs),
}

/// How a bridge is reached.
#[derive(Debug, Args)]
pub(crate) struct ConnectArgs {
    /// The bridge's address.
    #[arg(long, value_name = "ADDR", default_value = ADDRESS)]
    pub(crate) connect: String,
    #[command(flatten)]
    pub(crate) dial: DialArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
}

#[derive(Debug, Args)]
pub(crate) struct OperatorArgs {
    #[command(flatten)]
    pub(crate) connect: ConnectArgs,
    /// Prints one JSON object.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Exit codes: 0 the arms are where the motion leads (or it was accepted, with --check-only), 65 the file or the motion is
refused and nothing has moved, 75 the arms were stopped or are not ready, 130 Ctrl-C.")]
pub(crate) struct MoveArgs {
    /// The motion; docs/bridge.md says what the file holds.
    #[arg(value_name = "FILE.json")]
    pub(crate) file: PathBuf,
    /// Only asks whether the motion would be accepted from where the arms are; nothing moves.
    #[arg(long)]
    pub(crate) check_only: bool,
    /// Share of the motion's own speed, 0.01 to 1 [default: the file's].
    #[arg(long, value_parser = share)]
    pub(crate) speed: Option<f64>,
    #[command(flatten)]
    pub(crate) connect: ConnectArgs,
    /// Prints one JSON object on the last line of standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

/// A share from 0.01 to 1.
fn share(text: &str) -> Result<f64, String> {
    let share = text.parse().ok().filter(|share| (0.01..=1.0).contains(share));
    share.ok_or_else(|| "expected a number from 0.01 to 1".to_owned())
}
