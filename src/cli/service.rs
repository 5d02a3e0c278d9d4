//! The command line of the services.

use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;

use super::monitor::seconds;
use super::{RecordingArgs, TaskName, WorldName};

/// Default address of a service: a free port.
pub(crate) const DEFAULT_LISTEN: &str = "127.0.0.1:0";

/// Access token.
#[derive(Debug, Args)]
pub(crate) struct SecretArgs {
    /// File with the access token of the run's services. A service on a non-loopback address requires one.
    #[arg(long, value_name = "FILE", env = "TANDEM_TOKEN_FILE")]
    pub(crate) token_file: Option<PathBuf>,
}

/// Options of a service.
#[derive(Debug, Args)]
pub(crate) struct ListenArgs {
    /// Address to listen on; port 0 selects a free port. The address is printed as `listening on ADDR`.
    #[arg(long, default_value = DEFAULT_LISTEN, value_name = "ADDR")]
    pub(crate) listen: SocketAddr,
    /// Enables TLS with this certificate chain (PEM).
    #[arg(long, value_name = "FILE.pem", requires = "tls_key")]
    pub(crate) tls_cert: Option<PathBuf>,
    /// Private key of the certificate (PEM).
    #[arg(long, value_name = "FILE.pem", requires = "tls_cert")]
    pub(crate) tls_key: Option<PathBuf>,
    /// Allows calls without a token from anyone who can reach the address.
    #[arg(long)]
    pub(crate) insecure: bool,
    /// Exits when standard input closes, which happens when the parent process dies.
    #[arg(long, hide = true)]
    pub(crate) exit_with_stdin: bool,
}

impl ListenArgs {
    /// Returns the options of a service at `address` without others.
    pub(crate) const fn plain(listen: SocketAddr) -> Self {
        Self { listen, tls_cert: None, tls_key: None, insecure: false, exit_with_stdin: false }
    }
}

/// Metrics of a service.
#[derive(Debug, Args)]
pub(crate) struct MetricsArgs {
    /// Serves Prometheus metrics at http://ADDR/metrics. No token is required: do not expose the address.
    #[arg(long, value_name = "ADDR")]
    pub(crate) metrics_listen: Option<SocketAddr>,
}

/// TLS options of a client.
#[derive(Debug, Args)]
pub(crate) struct ClientArgs {
    /// Connects by TLS and trusts certificates signed by this authority (PEM).
    #[arg(long, value_name = "FILE.pem")]
    pub(crate) tls_ca: Option<PathBuf>,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem teacher --policy policies/teacher-push.safetensors \\
      --listen 127.0.0.1:7001
  tandem teacher --policy FILE --ledger runs/mine/ledger.sqlite
  tandem teacher --policy actor.onnx --critic critic.onnx  # trained elsewhere
  tandem teacher --policy FILE --ledger redis://:PASSWORD@redis:6379
      # several teachers, one budget
  tandem teacher --policy FILE --ledger memory     # lost at exit
  tandem teacher --policy http://127.0.0.1:7005    # a policy in another process

docs/python-services.md shows how to serve a policy from Python.")]
pub(crate) struct TeacherArgs {
    /// Policy of the one-arm teacher: a policy file, a run directory for the best policy of the run, the ONNX model of an
    /// actor (*.onnx), or http://HOST:PORT (https:// with --tls-ca) of a server of tandem.v1.Policy, which is called with
    /// the token of --token-file.
    #[arg(long, value_name = "FILE|DIR|URL")]
    pub(crate) policy: PathBuf,
    /// Fails unless the policy has this digest, as `policy_digest` of `Describe` and `tandem policy show` give it.
    #[arg(long, value_name = "DIGEST")]
    pub(crate) policy_digest: Option<String>,
    /// ONNX model of the actor's critic. Without it, strategies that compare values are not offered.
    #[arg(long, value_name = "FILE.onnx")]
    pub(crate) critic: Option<PathBuf>,
    /// Storage of the accounts: an SQLite file that no other teacher uses, `redis://[USER:PASSWORD@]HOST[:PORT][/DB]`,
    /// or `memory`.
    #[arg(
        long,
        value_name = "WHERE",
        default_value = "ledger.sqlite",
        env = "TANDEM_LEDGER",
        hide_env_values = true
    )]
    pub(crate) ledger: OsString,
    /// Exits when the ledger must be opened again, for a parent process that restarts the teacher.
    #[arg(long, hide = true)]
    pub(crate) exit_for_restart: bool,
    #[command(flatten)]
    pub(crate) listen: ListenArgs,
    #[command(flatten)]
    pub(crate) client_config: ClientArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
    #[command(flatten)]
    pub(crate) metrics: MetricsArgs,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem learner --run runs/mine/run.toml --listen 127.0.0.1:7000 \\
      --teacher 127.0.0.1:7001 --out runs/mine
  tandem learner --run runs/mine/run.toml --out runs/mine --resume \\
      --teacher 127.0.0.1:7001
  tandem learner --run run.toml --out runs/mine --start-or-resume \\
      --teacher teacher:7001
      # under a supervisor
  tandem learner --run run.toml --out runs/mine \\
      --dashboard-listen 127.0.0.1:8600")]
pub(crate) struct LearnerArgs {
    /// Run file (TOML); settings that it omits take the recipe's values.
    #[arg(long, value_name = "FILE.toml")]
    pub(crate) run: PathBuf,
    /// Address of the teacher, if the run uses advice.
    #[arg(long, value_name = "ADDR")]
    pub(crate) teacher: Option<String>,
    /// One-arm policy from which a run of strategy init:teacher starts.
    #[arg(long, value_name = "FILE")]
    pub(crate) start_from: Option<PathBuf>,
    /// Run directory.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Resumes from the newest checkpoint. Only the settings stop.*, checkpoint.*, evaluation.early_points,
    /// evaluation.recorded_episodes and evaluation.test_episodes can differ from those of the run.
    #[arg(long)]
    pub(crate) resume: bool,
    /// Writes the resolved settings to run.toml in the run directory.
    #[arg(long, hide = true)]
    pub(crate) keep_run_file: bool,
    /// The parent process holds the lock on the run directory.
    #[arg(long, hide = true)]
    pub(crate) out_is_locked: bool,
    /// Starts the run, or resumes the one in the run directory: for supervisors that repeat the same command. Writes
    /// the resolved settings to run.toml in the run directory. If the run is complete, exits at once with code 0.
    #[arg(long, conflicts_with = "resume")]
    pub(crate) start_or_resume: bool,
    /// Number of threads of the update, 1 to 64 [default: the number of cores, at most 16]. It does not affect the
    /// result.
    #[arg(long, value_parser = clap::value_parser!(u8).range(1..=64))]
    pub(crate) threads: Option<u8>,
    /// Serves the run's dashboard at http://ADDR/ [default: none]. An address that other machines can reach requires a
    /// token, which the page asks for.
    #[arg(long, value_name = "ADDR")]
    pub(crate) dashboard_listen: Option<SocketAddr>,
    /// File with the token of the dashboard [default: --token-file].
    #[arg(long, value_name = "FILE", requires = "dashboard_listen")]
    pub(crate) dashboard_token_file: Option<PathBuf>,
    /// Takes the next free port if that of the dashboard is in use, runs without a dashboard if there is none, and
    /// prints the outcome as a second line.
    #[arg(long, hide = true, requires = "dashboard_listen")]
    pub(crate) dashboard_is_optional: bool,
    /// Keeps serving after the run is complete, until the process is asked to exit.
    #[arg(long)]
    pub(crate) stay: bool,
    #[command(flatten)]
    pub(crate) listen: ListenArgs,
    #[command(flatten)]
    pub(crate) client_config: ClientArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
    #[command(flatten)]
    pub(crate) metrics: MetricsArgs,
}

/// The server of environments.
#[derive(Debug, Clone, Default, PartialEq, Args)]
pub(crate) struct EnvironmentArgs {
    /// The environments are those of the server at this address [default: the built-in ones].
    #[arg(long, value_name = "ADDR")]
    pub(crate) env: Option<String>,
    /// The environments are those of a server that this shell command starts, one server per worker. The command reads
    /// the address from TANDEM_ENV_LISTEN and prints `listening on http://HOST:PORT`.
    #[arg(long, value_name = "CMD", conflicts_with = "env")]
    pub(crate) env_command: Option<String>,
    /// Deadline of the start of the environment command and of each reply of the server, seconds [default: 60].
    #[arg(long, value_name = "S", value_parser = seconds)]
    pub(crate) env_timeout_s: Option<Duration>,
    /// File with the access token of the server at --env
    /// [default: --token-file, if there is one and --env-tls-ca is not given].
    #[arg(long, value_name = "FILE", requires = "env")]
    pub(crate) env_token_file: Option<PathBuf>,
    /// Connects to the server at --env by TLS and trusts certificates signed by this authority (PEM)
    /// [default: --tls-ca, if there is one and --env-token-file is not given].
    #[arg(long, value_name = "FILE.pem", requires = "env")]
    pub(crate) env_tls_ca: Option<PathBuf>,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem worker --connect 127.0.0.1:7000 --teacher 127.0.0.1:7001
  tandem worker --connect learner:7000 --teacher teacher:7001 --name bench-3
  tandem worker --connect learner:7000 --teacher teacher:7001 \\
      --env simulator:7005
  tandem worker --connect learner:7000 --env-command 'python3 server.py'
      # a server of its own
  tandem worker --connect learner:7000 --listen 127.0.0.1:7003
      # for `tandem health 127.0.0.1:7003`")]
pub(crate) struct WorkerArgs {
    /// Address of the learner or relay.
    #[arg(long, value_name = "ADDR")]
    pub(crate) connect: String,
    /// Address of the teacher, if the run uses advice.
    #[arg(long, value_name = "ADDR")]
    pub(crate) teacher: Option<String>,
    /// Address for health checks; port 0 selects a free port. The address is printed as `listening on ADDR`. The worker
    /// stops serving when one step of its rollout takes longer than a minute [default: none].
    #[arg(long, value_name = "ADDR")]
    pub(crate) listen: Option<SocketAddr>,
    /// Name of the worker in logs and displays.
    #[arg(long, default_value = "worker")]
    pub(crate) name: String,
    /// Directory for recorded episodes.
    #[arg(long, value_name = "DIR")]
    pub(crate) log_dir: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) recording: RecordingArgs,
    #[command(flatten)]
    pub(crate) environment: EnvironmentArgs,
    #[command(flatten)]
    pub(crate) client_config: ClientArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
    #[command(flatten)]
    pub(crate) metrics: MetricsArgs,
    /// Exits when standard input closes, which happens when the parent process dies.
    #[arg(long, hide = true)]
    pub(crate) exit_with_stdin: bool,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem relay --connect learner:7000 --listen 0.0.0.0:7000 --token-file token
  tandem worker --connect relay:7000 --teacher teacher:7001 --token-file token

Workers connect to a relay as they would to the learner. docs/scale.md shows when relays help.")]
pub(crate) struct RelayArgs {
    /// Address of the learner.
    #[arg(long, value_name = "ADDR")]
    pub(crate) connect: String,
    #[command(flatten)]
    pub(crate) listen: ListenArgs,
    #[command(flatten)]
    pub(crate) client_config: ClientArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
    #[command(flatten)]
    pub(crate) metrics: MetricsArgs,
}

/// The guard of an environment command.
#[derive(Debug, Args)]
pub(crate) struct EnvGuardArgs {
    /// Command for the shell.
    pub(crate) command: OsString,
}

#[derive(Debug, Args)]
#[command(
    mut_arg("listen", |listen| listen.env("TANDEM_ENV_LISTEN")),
    after_help = "\
Examples:
  tandem env                               # two arms, push, on a free port
  tandem env --task pick-and-place --arms 1 --listen 127.0.0.1:7005
  tandem train --env 127.0.0.1:7005 --task pick-and-place --arms 1
  tandem train --env-command 'tandem env'  # one server per worker
  tandem env --task carry-bar --describe | jq .manipulation

docs/environments.md describes the protocol, and how to write a server in another language."
)]
pub(crate) struct EnvArgs {
    /// Task.
    #[arg(long, value_parser = TaskName::parser(), default_value = "push")]
    pub(crate) task: TaskName,
    /// World of the task: classic (fast arms, adjacent areas) or shared (slow arms, one area) [default: shared].
    #[arg(long, value_enum, hide_possible_values = true)]
    pub(crate) world: Option<WorldName>,
    /// Number of arms.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u8).range(1..=2))]
    pub(crate) arms: u8,
    /// Prints the description of the task as JSON and exits.
    #[arg(long)]
    pub(crate) describe: bool,
    /// Largest number of environments of all streams together. A stream has 1024 at most.
    #[arg(long, value_name = "N", default_value_t = 4096, value_parser = clap::value_parser!(u16).range(1..))]
    pub(crate) max_environments: u16,
    #[command(flatten)]
    pub(crate) listen: ListenArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
    #[command(flatten)]
    pub(crate) metrics: MetricsArgs,
}
