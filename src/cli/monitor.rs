//! The command line of `tandem health` and `tandem status`.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;

use super::{ClientArgs, SecretArgs};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem health 127.0.0.1:7000
  tandem health learner:7000 --service tandem.v1.Learner --tls-ca ca.pem \\
      --timeout-s 1
  tandem health learner:7000 --json

Prints `serving` and exits with code 0, or prints the reason and exits with code 75. No token is required.")]
pub(crate) struct HealthArgs {
    /// Address of the service.
    #[arg(value_name = "ADDR")]
    pub(crate) address: String,
    /// Name of one service: tandem.v1.Teacher, tandem.v1.Learner, tandem.v1.Worker, tandem.v1.Environment or
    /// tandem.v1.Bridge [default: the whole server].
    #[arg(long, default_value = "", hide_default_value = true, value_name = "NAME")]
    pub(crate) service: String,
    /// Timeout in seconds.
    #[arg(long, default_value = "3", value_name = "S", value_parser = seconds)]
    pub(crate) timeout_s: Duration,
    #[command(flatten)]
    pub(crate) client_config: ClientArgs,
    /// Prints one JSON object: address, service, serving, reason.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem status runs/mine          # of a running `tandem train`
  tandem status runs/mine --watch
  tandem status runs               # lists the runs in a directory
  tandem status 127.0.0.1:7000
  tandem status learner:7000 --token-file token --watch
  tandem status learner:7000 --token-file token --json

Exit codes: 0 success (with --watch, the run has ended), 64 wrong token, directory or address, 75 the learner cannot be \
reached, or none is running and the run is not complete; with --watch also, the run was interrupted or its learner has \
failed. A run directory is followed across restarts of its learner.")]
pub(crate) struct StatusArgs {
    /// Run directory of a `tandem train` on this machine, directory that holds runs, or address of a learner or relay.
    #[arg(value_name = "DIR|ADDR")]
    pub(crate) run: PathBuf,
    /// Follows the run until it ends, as `tandem train` shows it: with a progress bar on a terminal, elsewhere with a line for
    /// each evaluation and each warning, and one every half minute.
    #[arg(long)]
    pub(crate) watch: bool,
    /// Prints one JSON object; with --watch, one per message, that of a learner's failure included.
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) client_config: ClientArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
}

/// Parses a positive number of seconds.
pub(super) fn seconds(text: &str) -> Result<Duration, String> {
    let span = text.parse().ok().and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    let span = span.filter(|span| !span.is_zero());
    span.ok_or_else(|| "expected a number of seconds, more than 0".to_owned())
}
