//! The command line of `tandem bridge`.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::builder::Resettable;
use clap::{ArgGroup, Args, Id, Subcommand, ValueEnum};
use tandem_bridge::calibration::SPEED_SHARES;

use super::{
    ByteSize, ClientArgs, DashboardArgs, ListenArgs, LiveArgs, MetricsArgs, SecretArgs, TrialArgs,
};

/// Default address of a bridge.
const ADDRESS: &str = "127.0.0.1:7002";
const DASHBOARD_HELP: &str = "Address of the dashboard, which shows the arms in a browser and has a stop button. If its \
    port is in use, the next free one is taken. [default: 127.0.0.1:8600]";
const TOKEN_HELP: &str =
    "File with the token that the dashboard asks for [default: that of --token-file]";
const LIVE_HELP: &str = "Shows the arms in Foxglove, over a websocket at this address [with no address: \
    127.0.0.1:8765]. Anyone who can reach the address can watch";

#[derive(Debug, Args)]
#[command(
    args_conflicts_with_subcommands = true,
    after_help = "\
Examples:
  tandem bridge --driver sim  # serves a simulated pair of arms
  tandem bridge --driver sim --speed 0.1
      # the same, no motion faster than a tenth
  tandem bridge --record runs/arms  # leaves an MCAP log of every motion
  tandem bridge --live              # shows the arms in Foxglove
  tandem bridge status        # state of the arms, and why they are stopped
  tandem bridge stop          # stops them, at any time
  tandem bridge reset         # enables stopped arms
  tandem bridge move deploy/first-motion.json --check-only
  tandem bridge move deploy/first-motion.json --speed 0.1
  tandem bridge trial --policy policies/student-push.safetensors
  tandem bridge cell > cell.toml  # where the arms stand, their limits
  tandem bridge --driver quarc --arms-at tcpip://10.0.0.5:18000 \
      --cell cell.toml --speed 0.1
  tandem bridge inject emergency-stop --arm left  # a drill, simulated arms
  tandem bridge to-start      # moves raised arms slowly to a start posture

docs/bridge.md is a tutorial up to the first motion."
)]
pub(crate) struct BridgeArgs {
    #[command(subcommand)]
    pub(crate) command: Option<BridgeCommand>,
    #[command(flatten)]
    pub(crate) serve: BridgeServeArgs,
}

#[derive(Debug, Args)]
#[command(
    mut_arg("listen", |arg| arg.default_value(ADDRESS)),
    mut_arg("live", |arg| arg.help(LIVE_HELP)),
    mut_arg("dashboard", |arg| arg.help(DASHBOARD_HELP)),
    mut_arg("dashboard_token_file", |arg| {
        // Unlike a run, a bridge may ask for a token at its default address.
        let needs_no_address = arg.requires(Resettable::<Id>::Reset);
        needs_no_address.conflicts_with("no_dashboard").help(TOKEN_HELP)
    })
)]
pub(crate) struct BridgeServeArgs {
    #[command(flatten)]
    pub(crate) arms: ArmsArgs,
    /// Moves real arms although their lag, reaction and braking times are guesses.
    #[arg(long)]
    pub(crate) accept_defaults: bool,
    /// Speed limit for all motions, as a fraction of each motion's own speed, 0.01 to 1.
    #[arg(long, default_value_t = 1.0, value_parser = share)]
    pub(crate) speed: f64,
    /// Writes an MCAP log of every motion, and of every fault that stops the arms, to this directory.
    #[arg(long, value_name = "DIR")]
    pub(crate) record: Option<PathBuf>,
    /// Size that the logs in --record may reach, for example 500MB or 10GiB. Beyond it, the oldest ones are deleted.
    #[arg(long, value_name = "SIZE", requires = "record", default_value_t = ByteSize(2 << 30))]
    pub(crate) log_budget: ByteSize,
    #[command(flatten)]
    pub(crate) live: LiveArgs,
    #[command(flatten)]
    pub(crate) dashboard: DashboardArgs,
    #[command(flatten)]
    pub(crate) listen: ListenArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
    #[command(flatten)]
    pub(crate) metrics: MetricsArgs,
}

/// Options of the arms.
#[derive(Debug, Args)]
pub(crate) struct ArmsArgs {
    /// Driver of the arms.
    #[arg(long, value_enum, default_value_t = DriverName::Sim)]
    pub(crate) driver: DriverName,
    /// Address of the real arms: tcpip://HOST:PORT for quarc, ws://HOST:PORT for kinova-ros.
    #[arg(long, value_name = "ADDR", required_if_eq_any([("driver", "quarc"), ("driver", "kinova-ros")]))]
    pub(crate) arms_at: Option<String>,
    /// Cell file: where the arms stand, their names, limits and reaction times (see docs/cell.md).
    #[arg(long, value_name = "FILE.toml")]
    pub(crate) cell: Option<PathBuf>,
    /// Seed of the simulated pair's noise and latencies.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) seed: u64,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem bridge arms
  tandem bridge --driver quarc --arms-at tcpip://127.0.0.1:18000 \\
      --accept-defaults   # in a separate terminal

Kill the bridge during a motion: the drives brake by themselves, and this process says so. Anyone who \
can reach the address can move the simulated arms.")]
pub(crate) struct ArmsServeArgs {
    /// Address to listen on; port 0 selects a free port.
    #[arg(long, default_value = "127.0.0.1:18000", value_name = "ADDR")]
    pub(crate) listen: SocketAddr,
    /// Cell file of the arms.
    #[arg(long, value_name = "FILE.toml")]
    pub(crate) cell: Option<PathBuf>,
    /// Seed of the pair's noise and latencies.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) seed: u64,
}

/// Driver of the arms.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum DriverName {
    /// A simulated pair of Kinova Micos.
    Sim,
    /// Real arms behind a Simulink model (QUARC).
    Quarc,
    /// Real arms behind Kinova's ROS driver (rosbridge).
    KinovaRos,
}

#[derive(Debug, Subcommand)]
pub(crate) enum BridgeCommand {
    /// Shows the state of the arms, and why they are stopped.
    #[command(after_help = "\
Examples:
  tandem bridge status
  tandem bridge status --connect lab:7002 --token-file token --json")]
    Status(OperatorArgs),
    /// Stops the arms. Exit code 0 means that the arms have confirmed it.
    #[command(after_help = "\
Examples:
  tandem bridge stop
  tandem bridge stop --connect lab:7002 --token-file token")]
    Stop(OperatorArgs),
    /// Shows the model, layout and limits of the arms.
    #[command(after_help = "\
Examples:
  tandem bridge describe
  tandem bridge describe --json")]
    Describe(OperatorArgs),
    /// Enables stopped arms: they hold their position until a motion begins. Inspect them first.
    #[command(after_help = "\
Examples:
  tandem bridge reset
  tandem bridge reset --connect lab:7002 --token-file token")]
    Reset(OperatorArgs),
    /// Executes the motion in a file. Ctrl-C stops the arms.
    Move(MoveArgs),
    /// Prints the default cell file with comments, to start from, or checks a cell file.
    Cell(CellArgs),
    /// Serves the simulated pair as a process of its own, as if it were behind a Simulink model (--driver quarc).
    Arms(ArmsServeArgs),
    /// Homes real arms behind kinova-ros after power-up, one after the other.
    Home(HomeArgs),
    /// Moves raised or folded arms slowly to a start posture, from which motions can begin.
    ToStart(ToStartArgs),
    /// Measures lag, reaction and braking time of the arms, and writes them into their cell file.
    Calibrate(CalibrateArgs),
    /// Injects a fault into simulated arms, to practise a stop. Real arms refuse it.
    Inject(InjectArgs),
    /// Runs trials of policies on a simulated pair and reports success rates; needs no bridge.
    Trial(TrialArgs),
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem bridge cell > cell.toml
  tandem bridge cell cell.toml

docs/cell.md explains every key.")]
pub(crate) struct CellArgs {
    /// Cell file to check [default: prints the default one].
    #[arg(value_name = "FILE.toml")]
    pub(crate) file: Option<PathBuf>,
    /// Prints one JSON object.
    #[arg(long, requires = "file")]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
#[command(
    mut_arg("cell", |arg| arg.required(true)),
    after_help = "\
Examples:
  tandem bridge calibrate --cell cell.toml
  tandem bridge calibrate --driver quarc --arms-at tcpip://10.0.0.5:18000 \\
      --cell cell.toml --speed 0.1

With real arms, the command first asks for confirmation that a person watches them. One joint after \
the other turns by up to 6 degrees and back. The arms need room, and no bridge may be connected to them. Other keys of the file and its comments stay as they are. Ctrl-C stops the arms."
)]
pub(crate) struct CalibrateArgs {
    #[command(flatten)]
    pub(crate) arms: ArmsArgs,
    /// Speed, as a fraction of each joint's highest, 0.1 to 0.5.
    #[arg(long, default_value_t = 0.3, value_parser = calibration_speed)]
    pub(crate) speed: f64,
    #[command(flatten)]
    pub(crate) confirmation: ConfirmationArgs,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem bridge home --driver kinova-ros --arms-at ws://10.0.0.5:9090 \\
      --cell cell.toml
  tandem bridge home --driver kinova-ros --arms-at ws://10.0.0.5:9090 --arm left

Kinova's node moves the arm by itself along an unchecked path, opens its gripper completely, and \
delays every stop until the arm is home: only the emergency stop ends it earlier. Nothing may be in the \
gripper or near the arm. Refused while a bridge moves or holds the arms. docs/drivers.md describes the \
first day with real arms.")]
pub(crate) struct HomeArgs {
    #[command(flatten)]
    pub(crate) arms: ArmsArgs,
    /// Homes only the arm with this name.
    #[arg(long, value_name = "NAME")]
    pub(crate) arm: Option<String>,
    #[command(flatten)]
    pub(crate) confirmation: ConfirmationArgs,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem bridge to-start          # practise with simulated arms, raised
  tandem bridge to-start --driver kinova-ros --arms-at ws://10.0.0.5:9090 \\
      --cell cell.toml

No joint turns faster than 8 degrees per second. All limits except the tilt of the grippers hold, and \
if no path keeps them, nothing moves. Ctrl-C, the end of the terminal and a lost connection stop \
the arms. No bridge may be connected to the arms.")]
pub(crate) struct ToStartArgs {
    #[command(flatten)]
    pub(crate) arms: ArmsArgs,
    #[command(flatten)]
    pub(crate) confirmation: ConfirmationArgs,
}

/// Options of commands that an operator confirms.
#[derive(Debug, Args)]
pub(crate) struct ConfirmationArgs {
    /// Skips the question whether a person watches the arms with a hand on the emergency stop.
    #[arg(long)]
    pub(crate) yes: bool,
    /// Prints one JSON object.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
#[command(
    group(ArgGroup::new("action").required(true).args(["fault", "clear"])),
    after_help = "\
Examples:
  tandem bridge inject emergency-stop --arm left
  tandem bridge inject blocked-joint --arm 1 --joint 2
  tandem bridge inject late-states
  tandem bridge inject --clear

A fault lasts until it is cleared. docs/bridge.md describes the drill."
)]
pub(crate) struct InjectArgs {
    /// Fault to inject.
    #[arg(value_enum)]
    pub(crate) fault: Option<FaultName>,
    /// Clears all injected faults.
    #[arg(long, conflicts_with_all = ["arm", "joint"])]
    pub(crate) clear: bool,
    /// Arm: its number, counted from 0, or its name [default: 0].
    #[arg(long, value_name = "ARM")]
    pub(crate) arm: Option<String>,
    /// Joint of blocked-joint, torque and drift, counted from 1 [default: 1].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) joint: Option<u32>,
    #[command(flatten)]
    pub(crate) connect: ConnectArgs,
    /// Prints one JSON object.
    #[arg(long)]
    pub(crate) json: bool,
}

/// Fault of simulated arms.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum FaultName {
    /// The emergency stop at the arm is pressed.
    EmergencyStop,
    /// A drive of the arm fails.
    DriveFault,
    /// The arm reports a contact.
    Contact,
    /// A joint cannot turn.
    BlockedJoint,
    /// Something presses on a joint.
    Torque,
    /// A joint turns faster than commanded.
    Drift,
    /// States of both arms arrive 80 ms late.
    LateStates,
}

/// Options of a client of a bridge.
#[derive(Debug, Args)]
pub(crate) struct ConnectArgs {
    /// Address of the bridge.
    #[arg(long, value_name = "ADDR", default_value = ADDRESS)]
    pub(crate) connect: String,
    #[command(flatten)]
    pub(crate) client_config: ClientArgs,
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
Examples:
  tandem bridge move deploy/first-motion.json --check-only
  tandem bridge move deploy/first-motion.json --speed 0.1

Exit codes: 0 the motion is complete (with --check-only, it would be accepted), 65 the file or the \
motion is rejected and nothing has moved, 75 the arms were stopped or are not ready, 130 interrupted \
with Ctrl-C.")]
pub(crate) struct MoveArgs {
    /// Motion file, described in docs/bridge.md.
    #[arg(value_name = "FILE.json")]
    pub(crate) file: PathBuf,
    /// Checks the motion from the present posture, and moves nothing.
    #[arg(long)]
    pub(crate) check_only: bool,
    /// Fraction of the motion's own speed, 0.01 to 1 [default: the file's].
    #[arg(long, value_parser = share)]
    pub(crate) speed: Option<f64>,
    #[command(flatten)]
    pub(crate) connect: ConnectArgs,
    /// Prints one JSON object on the last line of standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

/// Parses the speed of a calibration.
fn calibration_speed(text: &str) -> Result<f64, String> {
    let [low, high] = SPEED_SHARES;
    let speed = text.parse().ok().filter(|speed| (low..=high).contains(speed));
    speed.ok_or_else(|| format!("expected a number from {low} to {high}"))
}

/// Parses a fraction from 0.01 to 1.
fn share(text: &str) -> Result<f64, String> {
    let share = text.parse().ok().filter(|share| (0.01..=1.0).contains(share));
    share.ok_or_else(|| "expected a number from 0.01 to 1".to_owned())
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use crate::cli::Cli;

    #[test]
    fn the_page_at_the_default_address_may_have_a_token_of_its_own() {
        let accepts =
            |args: &[&str]| Cli::try_parse_from(["tandem", "bridge"].iter().chain(args)).is_ok();
        let token = ["--dashboard-token-file", "token"];
        assert!(accepts(&token));
        assert!(accepts(&[&["--dashboard", "127.0.0.1:8600"], &token[..]].concat()));
        assert!(!accepts(&[&["--no-dashboard"], &token[..]].concat()));
    }
}
