//! The command line.

use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Parser, Subcommand, ValueEnum};

mod bridge;
mod relay;
mod scale;
mod trial;

pub(crate) use bridge::{
    BridgeArgs, BridgeCommand, BridgeServeArgs, ConnectArgs, DriverName, MoveArgs, OperatorArgs,
};
pub(crate) use relay::RelayArgs;
pub(crate) use scale::ScaleArgs;
pub(crate) use trial::{ModeName, RecordName, TrialArgs};

/// Trains policies for two robot arms with advice from a one-arm policy.
#[derive(Debug, Parser)]
#[command(
    name = "tandem",
    version = crate::services::VERSION,
    propagate_version = true,
    after_help = "\
Examples:
  tandem train                                  trains two arms to push, with advice
  tandem train --arms 1 --task push             trains a one-arm teacher from scratch
  tandem eval --policy runs/NAME/policy/best.safetensors
  tandem COMMAND --help                         more examples

Exit codes: 0 success, 64 wrong usage or configuration, 65 invalid input data, 70 bug, 74 the
result cannot be written to standard output, 75 temporary failure (try again), 130 interrupted,
141 standard output was closed by its reader."
)]
pub(crate) struct Cli {
    /// Log filter, such as info or tandem_learner=debug; overrides RUST_LOG.
    #[arg(long, global = true, value_name = "FILTER")]
    pub(crate) log: Option<String>,
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
    /// Distributes a learner's parameters to nearby workers, for runs with very many workers.
    Relay(RelayArgs),
    /// Serves a pair of arms, real or simulated, and operates it.
    Bridge(BridgeArgs),
    /// Checks the health of a service.
    Health(HealthArgs),
    /// Shows the progress of a learner's run.
    Status(StatusArgs),
    /// Benchmarks the simulator, networks, updates, replay buffer and a short run on this machine.
    Bench(BenchArgs),
    /// Inspects policy files.
    Policy(PolicyArgs),
    /// Repairs MCAP logs.
    Mcap(McapArgs),
    /// Simulates recorded episodes again and compares them bit for bit.
    Replay(ReplayArgs),
    /// Renders a step of an episode as an SVG picture.
    Picture(PictureArgs),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum TaskName {
    Push,
    PickAndPlace,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum RecipeName {
    /// Tandem's recipe, which needs few environment steps and minutes on two cores.
    Tandem,
    /// The paper's DDPG + HER with the reference implementation's values.
    Paper,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem train                                        two arms, push, strategy mc-q:0.1, shipped teacher
  tandem train --arms 1 --task push --until-success 0.97
  tandem train --strategy ea --budget 50000 --seed 2 --max-minutes 20
  tandem train --set ddpg.discount=0.98 --set rounds.slots=16
  tandem train --run my-run.toml --out runs/mine
  tandem train --resume --out runs/mine               resumes the run
  tandem train --resume --out runs/mine --max-env-steps 600000    resumes it for longer")]
pub(crate) struct TrainArgs {
    /// Task [default: push].
    #[arg(long, value_enum)]
    pub(crate) task: Option<TaskName>,
    /// Number of arms of the trained policy, 1 or 2 [default: 2].
    #[arg(long)]
    pub(crate) arms: Option<usize>,
    /// Advising strategy: none, ea, eamc:T, mc-q:T, mc-act:A or mc-act-abs:A. With init:teacher the student starts as
    /// copies of the teacher and gets no advice
    /// [default: mc-q:0.1 with two arms, none with one].
    #[arg(long, value_name = "NAME[:THRESHOLD]")]
    pub(crate) strategy: Option<String>,
    /// Policy file of the teacher [default: the shipped teacher of the task].
    #[arg(long, value_name = "FILE")]
    pub(crate) teacher: Option<PathBuf>,
    /// Advice budget of the run, in environment steps with advice [default: 500000].
    #[arg(long, value_name = "N")]
    pub(crate) budget: Option<u64>,
    /// Number of worker processes [default: one per core, at most one per slot].
    #[arg(long, value_name = "N")]
    pub(crate) workers: Option<usize>,
    /// Seed of all random numbers [default: 1].
    #[arg(long, value_name = "N")]
    pub(crate) seed: Option<u64>,
    /// Stops when an evaluation reaches this success rate, 0 to 1.
    #[arg(long, value_name = "P")]
    pub(crate) until_success: Option<f64>,
    /// Stops after this many environment steps; 0 for no limit [default: the recipe's].
    #[arg(long, value_name = "N")]
    pub(crate) max_env_steps: Option<u64>,
    /// Stops after this many minutes instead; 0 for no limit.
    #[arg(long, value_name = "N")]
    pub(crate) max_minutes: Option<f64>,
    /// Recipe that gives the defaults of all settings [default: tandem].
    #[arg(long, value_enum)]
    pub(crate) recipe: Option<RecipeName>,
    /// Run file (TOML) with any of the settings; unknown keys are rejected.
    #[arg(long, value_name = "FILE.toml")]
    pub(crate) run: Option<PathBuf>,
    /// Overrides one setting, for example ddpg.discount=0.98; can be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(crate) settings: Vec<String>,
    /// Run directory [default: runs/TASK-ARMS-STRATEGY-seedN].
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    /// Resumes the run in --out from its newest checkpoint. The settings and the teacher remain those of the run; only
    /// its end (--max-env-steps, --max-minutes, --until-success), checkpoint.*, evaluation.recorded_episodes,
    /// evaluation.test_episodes and --workers can change. A rejected --resume changes nothing.
    #[arg(long, requires = "out")]
    pub(crate) resume: bool,
    /// Prints the summary as one JSON object on the last line of standard output.
    #[arg(long)]
    pub(crate) json: bool,
    /// Interrupts the run when standard input closes, which happens when the parent process dies.
    #[arg(long, hide = true)]
    pub(crate) exit_with_stdin: bool,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem sweep deploy/sweep-small.toml --dry-run      lists the runs
  tandem sweep deploy/sweep-small.toml                starts them, or resumes them
  tandem report runs/sweep-small

docs/sweep.md describes the file. The exit code is 75 if runs failed; the next start tries each of
them once more.")]
pub(crate) struct SweepArgs {
    /// Sweep file (TOML): settings of all runs, and lists of values to combine.
    #[arg(value_name = "FILE.toml")]
    pub(crate) file: PathBuf,
    /// Parent of the run directories [default: runs/NAME, after the file].
    #[arg(long, value_name = "DIR", value_parser = utf8_path())]
    pub(crate) out: Option<PathBuf>,
    /// Number of concurrent runs; they share the cores.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    pub(crate) jobs: u16,
    /// Prints one JSON object on the last line of standard output.
    #[arg(long)]
    pub(crate) json: bool,
    /// Lists the runs and the progress of each, and starts none.
    #[arg(long)]
    pub(crate) dry_run: bool,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem report runs/sweep-table2
  tandem report runs/a runs/b --out compared.html --csv compared.csv
  tandem report trials/student-push --all-trials
  tandem report docs/results/students --composed-teachers policies/teacher-push.safetensors")]
pub(crate) struct ReportArgs {
    /// Run directories, directories that contain runs or trials, or single metrics and trials files.
    #[arg(required = true, value_name = "DIR|FILE")]
    pub(crate) paths: Vec<PathBuf>,
    /// HTML page; curves and plots of trials are written next to it as SVG files [default: report.html, in the
    /// directory of the sweep or trials if that is the only one].
    #[arg(long, value_name = "FILE.html")]
    pub(crate) out: Option<PathBuf>,
    /// Also writes a CSV file with one line per run.
    #[arg(long, value_name = "FILE.csv")]
    pub(crate) csv: Option<PathBuf>,
    /// Output of `tandem eval --json`, shown as a row with the file's name; can be repeated.
    #[arg(long = "eval", value_name = "FILE.json")]
    pub(crate) evals: Vec<PathBuf>,
    /// Evaluates a one-arm policy on both arms, the baseline without a student; can be repeated.
    #[arg(long, value_name = "POLICY")]
    pub(crate) composed_teachers: Vec<PathBuf>,
    /// Draws all trials, not only failed ones.
    #[arg(long)]
    pub(crate) all_trials: bool,
    /// Prints one JSON object on the last line of standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
#[command(group = clap::ArgGroup::new("who").required(true), after_help = "\
Examples:
  tandem eval --policy policies/student-push.safetensors
  tandem eval --policy FILE --episodes 400 --seed 7 --json
  tandem eval --composed-teachers policies/teacher-push.safetensors
  tandem eval --policy FILE --episodes 1 --record episode.mcap")]
pub(crate) struct EvalArgs {
    /// Policy to evaluate.
    #[arg(long, value_name = "FILE", group = "who")]
    pub(crate) policy: Option<PathBuf>,
    /// One-arm policy that controls each arm separately: the baseline without a student.
    #[arg(long, value_name = "FILE", group = "who")]
    pub(crate) composed_teachers: Option<PathBuf>,
    /// Fails unless the policy is for this task.
    #[arg(long, value_enum)]
    pub(crate) task: Option<TaskName>,
    /// Number of arms [default: the policy's; 2 for composed teachers].
    #[arg(long)]
    pub(crate) arms: Option<usize>,
    /// Number of episodes, one per goal.
    #[arg(long, default_value_t = 240, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub(crate) episodes: u64,
    /// Seed of the test goals. Runs select their best policy on validation goals of another seed.
    #[arg(long, default_value_t = 777)]
    pub(crate) seed: u64,
    /// Records the first episode to this MCAP file.
    #[arg(long, value_name = "FILE.mcap")]
    pub(crate) record: Option<PathBuf>,
    /// Records all episodes to MCAP files in this directory.
    #[arg(long, value_name = "DIR")]
    pub(crate) record_dir: Option<PathBuf>,
    /// Prints one JSON object on the last line of standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

/// Access token.
#[derive(Debug, Args)]
pub(crate) struct SecretArgs {
    /// File with the access token of the run's services; required to listen on non-loopback addresses.
    #[arg(long, value_name = "FILE", env = "TANDEM_TOKEN_FILE")]
    pub(crate) token_file: Option<PathBuf>,
}

/// Options of a service.
#[derive(Debug, Args)]
pub(crate) struct ListenArgs {
    /// Address to listen on; port 0 selects a free port. The address is printed as `listening on ADDR`.
    #[arg(long, default_value = "127.0.0.1:0", value_name = "ADDR")]
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

/// TLS options of a client.
#[derive(Debug, Args)]
pub(crate) struct DialArgs {
    /// Connects by TLS and trusts certificates signed by this authority (PEM).
    #[arg(long, value_name = "FILE.pem")]
    pub(crate) tls_ca: Option<PathBuf>,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem teacher --policy policies/teacher-push.safetensors --listen 127.0.0.1:7001
  tandem teacher --policy FILE --ledger runs/mine/ledger.sqlite
  tandem teacher --policy FILE --ledger redis://:PASSWORD@redis:6379   several teachers, one budget
  tandem teacher --policy FILE --ledger memory                          lost at exit")]
pub(crate) struct TeacherArgs {
    /// Policy file of the one-arm teacher.
    #[arg(long, value_name = "FILE")]
    pub(crate) policy: PathBuf,
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
    #[command(flatten)]
    pub(crate) listen: ListenArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem learner --run runs/mine/run.toml --listen 0.0.0.0:7000 --teacher 127.0.0.1:7001 --out runs/mine
  tandem learner --run runs/mine/run.toml --out runs/mine --resume --teacher 127.0.0.1:7001
  tandem learner --run run.toml --out runs/mine --start-or-resume --teacher teacher:7001   under a supervisor")]
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
    /// Resumes from the newest checkpoint. Only the settings stop.*, checkpoint.*, evaluation.recorded_episodes and
    /// evaluation.test_episodes can differ from those of the run.
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
    /// Number of threads of the update, 1 or 2. It does not affect the result.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u8).range(1..=2))]
    pub(crate) threads: u8,
    /// Serves Prometheus metrics at http://ADDR/metrics. No token is required: do not expose the address.
    #[arg(long, value_name = "ADDR")]
    pub(crate) metrics_listen: Option<SocketAddr>,
    /// Keeps serving after the run is complete, until the process is asked to exit.
    #[arg(long)]
    pub(crate) stay: bool,
    #[command(flatten)]
    pub(crate) listen: ListenArgs,
    #[command(flatten)]
    pub(crate) dial: DialArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem worker --connect 127.0.0.1:7000 --teacher 127.0.0.1:7001
  tandem worker --connect learner:7000 --teacher teacher:7001 --name bench-3")]
pub(crate) struct WorkerArgs {
    /// Address of the learner or relay.
    #[arg(long, value_name = "ADDR")]
    pub(crate) connect: String,
    /// Address of the teacher, if the run uses advice.
    #[arg(long, value_name = "ADDR")]
    pub(crate) teacher: Option<String>,
    /// Name of the worker in logs and displays.
    #[arg(long, default_value = "worker")]
    pub(crate) name: String,
    /// Directory for recorded episodes.
    #[arg(long, value_name = "DIR")]
    pub(crate) log_dir: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) dial: DialArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
    /// Exits when standard input closes, which happens when the parent process dies.
    #[arg(long, hide = true)]
    pub(crate) exit_with_stdin: bool,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem health 127.0.0.1:7000
  tandem health learner:7000 --service tandem.v1.Learner --tls-ca ca.pem --timeout-s 1
  tandem health learner:7000 --json

Prints `serving` and exits with code 0, or prints the reason and exits with code 75. No token is required.")]
pub(crate) struct HealthArgs {
    /// Address of the service.
    #[arg(value_name = "ADDR")]
    pub(crate) address: String,
    /// Name of one service: tandem.v1.Teacher, tandem.v1.Learner or tandem.v1.Bridge [default: the whole server].
    #[arg(long, default_value = "", hide_default_value = true, value_name = "NAME")]
    pub(crate) service: String,
    /// Timeout in seconds.
    #[arg(long, default_value = "3", value_name = "S", value_parser = seconds)]
    pub(crate) timeout_s: Duration,
    #[command(flatten)]
    pub(crate) dial: DialArgs,
    /// Prints one JSON object: address, service, serving, reason.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem status 127.0.0.1:7000
  tandem status learner:7000 --token-file token --watch
  tandem status learner:7000 --token-file token --json

Exit codes: 0 success (with --watch, the run has ended), 64 wrong token, 75 the learner cannot be
reached.")]
pub(crate) struct StatusArgs {
    /// Address of the learner or relay.
    #[arg(value_name = "ADDR")]
    pub(crate) address: String,
    /// Follows the run until it ends: a line for each evaluation, and one every half minute.
    #[arg(long)]
    pub(crate) watch: bool,
    /// Prints one JSON object; with --watch, one per message.
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) dial: DialArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
}

/// A path that may be part of an address, as a ledger's is.
fn utf8_path() -> impl clap::builder::TypedValueParser<Value = PathBuf> {
    use clap::builder::{OsStringValueParser, TypedValueParser as _};
    OsStringValueParser::new()
        .try_map(|path| path.into_string().map(PathBuf::from).map_err(|_raw| "expected UTF-8"))
}

/// A time span from seconds, more than none.
fn seconds(text: &str) -> Result<Duration, String> {
    let span = text.parse().ok().and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    let span = span.filter(|span| !span.is_zero());
    span.ok_or_else(|| "expected a number of seconds, more than 0".to_owned())
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem bench                   all but scale, about two minutes
  tandem bench sim update --json
  tandem bench scale             number of workers that one learner serves, about two minutes
  tandem bench scale --workers 0 --idle 1000 --join-leave 100")]
pub(crate) struct BenchArgs {
    /// Benchmarks to run [default: all but scale].
    #[arg(value_enum)]
    pub(crate) what: Vec<BenchName>,
    /// Prints one JSON object per line: name, value, unit.
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) scale: ScaleArgs,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum BenchName {
    Sim,
    Inference,
    Update,
    Replay,
    /// The teacher service, compared with an echo service of the same messages.
    Teacher,
    /// A short training run with all its processes.
    EndToEnd,
    /// One learner with increasing numbers of workers, real and idle ones.
    Scale,
}

#[derive(Debug, Args)]
pub(crate) struct PolicyArgs {
    #[command(subcommand)]
    pub(crate) command: PolicyCommand,
}

#[derive(Debug, Subcommand)]
pub(crate) enum PolicyCommand {
    /// Shows sizes, training settings and the digest.
    Show {
        /// The policy file.
        file: PathBuf,
        /// Prints one JSON object.
        #[arg(long)]
        json: bool,
    },
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem replay runs/NAME/mcap/eval-000100-000.mcap     step by step
  tandem replay runs --verify                           all *.mcap files below
  tandem replay FILE.mcap --verify --json

All numbers from the simulator are compared bit for bit with the log. The exit code is 65 if one
differs or a log cannot be read.")]
pub(crate) struct ReplayArgs {
    /// Recorded episodes, or directories to search for *.mcap files.
    #[arg(required = true, value_name = "FILE|DIR")]
    pub(crate) files: Vec<PathBuf>,
    /// Compares only. By default a single log is also printed step by step.
    #[arg(long)]
    pub(crate) verify: bool,
    /// Prints one JSON object on the last line of standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct McapArgs {
    #[command(subcommand)]
    pub(crate) command: McapCommand,
}

#[derive(Debug, Subcommand)]
pub(crate) enum McapCommand {
    /// Recovers the log of a writer that was killed.
    Recover {
        /// Incomplete log.
        file: PathBuf,
        /// Recovered log [default: FILE with `.recovered.mcap` appended].
        #[arg(long, value_name = "FILE")]
        to: Option<PathBuf>,
    },
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem picture --policy policies/student-push.safetensors --out arms.svg
  tandem picture --composed-teachers policies/teacher-push.safetensors --step 20 --out arms.svg")]
pub(crate) struct PictureArgs {
    /// Policy that controls the arms.
    #[arg(long, value_name = "FILE", required_unless_present = "composed_teachers")]
    pub(crate) policy: Option<PathBuf>,
    /// One-arm policy that controls both arms.
    #[arg(long, value_name = "FILE", conflicts_with = "policy")]
    pub(crate) composed_teachers: Option<PathBuf>,
    /// Number of the episode, which determines start and goal.
    #[arg(long, default_value_t = 777)]
    pub(crate) seed: u64,
    /// Control step to draw, 0 to 50.
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u32).range(0..=50))]
    pub(crate) step: u32,
    /// Output file.
    #[arg(long, value_name = "FILE.svg")]
    pub(crate) out: PathBuf,
}
