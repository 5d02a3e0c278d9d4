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

/// Teaches robots with two arms by letting a robot with one arm advise them.
#[derive(Debug, Parser)]
#[command(
    name = "tandem",
    version = crate::services::VERSION,
    propagate_version = true,
    after_help = "\
Examples:
  tandem train                                  the main job: two arms learn to push, advised
  tandem train --arms 1 --task push             a one-arm teacher from scratch
  tandem eval --policy runs/NAME/policy/best.safetensors
  tandem COMMAND --help                         more examples

Exit codes: 0 done, 64 bad usage or configuration, 65 bad input data, 70 a bug, 74 the result cannot be
written to standard output, 75 try again, 130 interrupted, 141 standard output has no reader."
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
    /// Trains a policy: starts learner, teacher and workers on this machine.
    Train(Box<TrainArgs>),
    /// Measures a policy on fixed goals: no noise, no advice.
    Eval(EvalArgs),
    /// Trains many runs one after another: strategies, tasks, seeds and whatever else a file lists.
    Sweep(SweepArgs),
    /// Sets runs and trials side by side: the paper's Tables 2 and 4, curves, one HTML page.
    Report(ReportArgs),
    /// Serves a one-arm policy as a teacher.
    Teacher(TeacherArgs),
    /// Serves a run's learner.
    Learner(LearnerArgs),
    /// Plays episodes for a learner.
    Worker(WorkerArgs),
    /// Hands out a learner's parameters near its workers, for runs with very many.
    Relay(RelayArgs),
    /// Serves a pair of arms, real or simulated, and tells them what to do.
    Bridge(BridgeArgs),
    /// Asks a service whether it serves.
    Health(HealthArgs),
    /// Asks a learner how far its run is.
    Status(StatusArgs),
    /// Measures simulation, networks, updates, replay and a short run on this machine.
    Bench(BenchArgs),
    /// Shows what is in a policy file.
    Policy(PolicyArgs),
    /// Mends MCAP logs.
    Mcap(McapArgs),
    /// Plays recorded episodes again in the simulator and compares them bit for bit.
    Replay(ReplayArgs),
    /// Draws the arms at work as an SVG picture.
    Picture(PictureArgs),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum TaskName {
    Push,
    PickAndPlace,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum RecipeName {
    /// What learns fastest on two cores.
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
  tandem train --resume --out runs/mine               goes on where it stopped
  tandem train --resume --out runs/mine --max-env-steps 600000    goes on for longer")]
pub(crate) struct TrainArgs {
    /// What the arms do [default: push].
    #[arg(long, value_enum)]
    pub(crate) task: Option<TaskName>,
    /// Arms of the learning policy, 1 or 2 [default: 2].
    #[arg(long)]
    pub(crate) arms: Option<usize>,
    /// When the teacher takes over: none, ea, eamc:T, mc-q:T, mc-act:A or mc-act-abs:A; init:teacher starts from
    /// copies of the teacher and asks for nothing
    /// [default: mc-q:0.1 with two arms, none with one].
    #[arg(long, value_name = "NAME[:THRESHOLD]")]
    pub(crate) strategy: Option<String>,
    /// The teacher's policy file [default: the one that ships for the task].
    #[arg(long, value_name = "FILE")]
    pub(crate) teacher: Option<PathBuf>,
    /// Pieces of advice for the whole run [default: 500000].
    #[arg(long, value_name = "N")]
    pub(crate) budget: Option<u64>,
    /// Worker processes [default: one a core, at most one a slot].
    #[arg(long, value_name = "N")]
    pub(crate) workers: Option<usize>,
    /// Seed of every random draw [default: 1].
    #[arg(long, value_name = "N")]
    pub(crate) seed: Option<u64>,
    /// Stops once an evaluation succeeds so often, 0 to 1.
    #[arg(long, value_name = "P")]
    pub(crate) until_success: Option<f64>,
    /// Stops after so many environment steps [default: the recipe's; 0 for never].
    #[arg(long, value_name = "N")]
    pub(crate) max_env_steps: Option<u64>,
    /// Stops after so many minutes instead [0: never].
    #[arg(long, value_name = "N")]
    pub(crate) max_minutes: Option<f64>,
    /// Where the settings' defaults come from [default: tandem].
    #[arg(long, value_enum)]
    pub(crate) recipe: Option<RecipeName>,
    /// Run file with any of the settings; unknown keys are refused.
    #[arg(long, value_name = "FILE.toml")]
    pub(crate) run: Option<PathBuf>,
    /// One setting, such as ddpg.discount=0.98; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(crate) settings: Vec<String>,
    /// Run directory [default: runs/TASK-ARMS-STRATEGY-seedN].
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    /// Goes on with the run in --out from its newest checkpoint. Its settings and its teacher stay those that it began
    /// with; only when it stops (--max-env-steps, --max-minutes, --until-success), checkpoint.*,
    /// evaluation.recorded_episodes and --workers may change. A refused --resume changes nothing.
    #[arg(long, requires = "out")]
    pub(crate) resume: bool,
    /// Prints the summary as one JSON object on the last line of standard output.
    #[arg(long)]
    pub(crate) json: bool,
    /// Is interrupted when standard input closes, as it does when the parent process dies.
    #[arg(long, hide = true)]
    pub(crate) exit_with_stdin: bool,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem sweep deploy/sweep-small.toml --dry-run      what it would run
  tandem sweep deploy/sweep-small.toml                goes on where it stopped, when it is started again
  tandem report runs/sweep-small

docs/sweep.md says what the file may hold. Exit code 75 when some runs failed; each is tried once more at the next start.")]
pub(crate) struct SweepArgs {
    /// The sweep file: settings of all runs, and lists to combine.
    #[arg(value_name = "FILE.toml")]
    pub(crate) file: PathBuf,
    /// Where the run directories are made [default: runs/ and the file's name].
    #[arg(long, value_name = "DIR", value_parser = utf8_path())]
    pub(crate) out: Option<PathBuf>,
    /// Runs side by side; they share the cores.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    pub(crate) jobs: u16,
    /// Prints one JSON object on the last line of standard output.
    #[arg(long)]
    pub(crate) json: bool,
    /// Says what would be run, and how far each run is.
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
    /// Run directories, directories with runs or trials below, or metrics and trials files by themselves.
    #[arg(required = true, value_name = "DIR|FILE")]
    pub(crate) paths: Vec<PathBuf>,
    /// The page; curves and pictures of trials are written beside it as SVG files [default: report.html, in the
    /// directory of the sweep or the trials when that is all that is given].
    #[arg(long, value_name = "FILE.html")]
    pub(crate) out: Option<PathBuf>,
    /// Writes one line a run.
    #[arg(long, value_name = "FILE.csv")]
    pub(crate) csv: Option<PathBuf>,
    /// What `tandem eval --json` printed: a row of its own, named after the file; may be repeated.
    #[arg(long = "eval", value_name = "FILE.json")]
    pub(crate) evals: Vec<PathBuf>,
    /// Measures a one-arm policy that drives both arms: the baseline without a student; may be repeated.
    #[arg(long, value_name = "POLICY")]
    pub(crate) composed_teachers: Vec<PathBuf>,
    /// Draws every trial, not only those that failed.
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
    /// The policy to measure.
    #[arg(long, value_name = "FILE", group = "who")]
    pub(crate) policy: Option<PathBuf>,
    /// A one-arm policy that drives every arm by itself: the baseline without a student.
    #[arg(long, value_name = "FILE", group = "who")]
    pub(crate) composed_teachers: Option<PathBuf>,
    /// Must be the policy's task, when given.
    #[arg(long, value_enum)]
    pub(crate) task: Option<TaskName>,
    /// Arms [default: the policy's; 2 for composed teachers].
    #[arg(long)]
    pub(crate) arms: Option<usize>,
    /// Fixed goals to try.
    #[arg(long, default_value_t = 240, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub(crate) episodes: u64,
    /// Which goals; none that a run chooses its best policy by.
    #[arg(long, default_value_t = 777)]
    pub(crate) seed: u64,
    /// Writes the first episode's log there.
    #[arg(long, value_name = "FILE.mcap")]
    pub(crate) record: Option<PathBuf>,
    /// Writes every episode's log into this directory.
    #[arg(long, value_name = "DIR")]
    pub(crate) record_dir: Option<PathBuf>,
    /// Prints one JSON object on the last line of standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

/// The secret that all processes of a run share.
#[derive(Debug, Args)]
pub(crate) struct SecretArgs {
    /// File with the token that callers show and services demand; needed to listen on other than this machine's own
    /// addresses.
    #[arg(long, value_name = "FILE", env = "TANDEM_TOKEN_FILE")]
    pub(crate) token_file: Option<PathBuf>,
}

/// Where a service listens.
#[derive(Debug, Args)]
pub(crate) struct ListenArgs {
    /// Address to listen on; port 0 takes a free one. It is printed as `listening on ADDR`.
    #[arg(long, default_value = "127.0.0.1:0", value_name = "ADDR")]
    pub(crate) listen: SocketAddr,
    /// Speaks TLS with this certificate chain (PEM).
    #[arg(long, value_name = "FILE.pem", requires = "tls_key")]
    pub(crate) tls_cert: Option<PathBuf>,
    /// The certificate's private key (PEM).
    #[arg(long, value_name = "FILE.pem", requires = "tls_cert")]
    pub(crate) tls_key: Option<PathBuf>,
    /// Lets anybody call who can reach the address, without a token.
    #[arg(long)]
    pub(crate) insecure: bool,
    /// Ends when standard input closes, as it does when the parent process dies.
    #[arg(long, hide = true)]
    pub(crate) exit_with_stdin: bool,
}

/// Whom a client trusts.
#[derive(Debug, Args)]
pub(crate) struct DialArgs {
    /// Calls services by TLS and trusts certificates that this authority (PEM) has signed.
    #[arg(long, value_name = "FILE.pem")]
    pub(crate) tls_ca: Option<PathBuf>,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem teacher --policy policies/teacher-push.safetensors --listen 127.0.0.1:7001
  tandem teacher --policy FILE --ledger runs/mine/ledger.sqlite
  tandem teacher --policy FILE --ledger redis://:PASSWORD@redis:6379   several teachers, one budget
  tandem teacher --policy FILE --ledger memory                          forgotten at the end")]
pub(crate) struct TeacherArgs {
    /// The one-arm policy that advises.
    #[arg(long, value_name = "FILE")]
    pub(crate) policy: PathBuf,
    /// Where accounts are kept: an SQLite file that this teacher alone uses, `redis://[USER:PASSWORD@]HOST[:PORT][/DB]`,
    /// or memory.
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
    /// Run file; settings that it leaves out take the recipe's values.
    #[arg(long, value_name = "FILE.toml")]
    pub(crate) run: PathBuf,
    /// The teacher's address, when the run asks for advice.
    #[arg(long, value_name = "ADDR")]
    pub(crate) teacher: Option<String>,
    /// The one-arm policy that a run of strategy init:teacher starts from.
    #[arg(long, value_name = "FILE")]
    pub(crate) start_from: Option<PathBuf>,
    /// Run directory.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Goes on from the newest checkpoint. Of the settings only stop.*, checkpoint.* and evaluation.recorded_episodes
    /// may differ from those that the run began with.
    #[arg(long)]
    pub(crate) resume: bool,
    /// Keeps the resolved settings in the run directory's run.toml.
    #[arg(long, hide = true)]
    pub(crate) keep_run_file: bool,
    /// The parent process holds the lock of the run directory.
    #[arg(long, hide = true)]
    pub(crate) out_is_locked: bool,
    /// Starts the run, or goes on with it where the run directory holds one: for supervisors, which start a process
    /// that has ended by the same command again. Keeps the resolved settings in the run directory's run.toml. A run
    /// that has ended ends again at once, with exit code 0.
    #[arg(long, conflicts_with = "resume")]
    pub(crate) start_or_resume: bool,
    /// Threads of the update, 1 or 2; the result is the same.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u8).range(1..=2))]
    pub(crate) threads: u8,
    /// Shows the run's figures at http://ADDR/metrics, as Prometheus reads them. Whoever reaches the address can read
    /// them, without a token: keep it inside a cluster.
    #[arg(long, value_name = "ADDR")]
    pub(crate) metrics_listen: Option<SocketAddr>,
    /// Goes on serving once the run is complete, until it is asked to end.
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
    /// The learner's address.
    #[arg(long, value_name = "ADDR")]
    pub(crate) connect: String,
    /// The teacher's address, when the run asks for advice.
    #[arg(long, value_name = "ADDR")]
    pub(crate) teacher: Option<String>,
    /// A label for logs.
    #[arg(long, default_value = "worker")]
    pub(crate) name: String,
    /// Where recorded episodes are written.
    #[arg(long, value_name = "DIR")]
    pub(crate) log_dir: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) dial: DialArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
    /// Ends when standard input closes, as it does when the parent process dies.
    #[arg(long, hide = true)]
    pub(crate) exit_with_stdin: bool,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem health 127.0.0.1:7000
  tandem health learner:7000 --service tandem.v1.Learner --tls-ca ca.pem --timeout-s 1
  tandem health learner:7000 --json

Prints `serving` and ends with exit code 0; otherwise says why on one line and ends with 75.
No token is needed: probes have none.")]
pub(crate) struct HealthArgs {
    /// The service's address.
    #[arg(value_name = "ADDR")]
    pub(crate) address: String,
    /// One service, tandem.v1.Teacher, tandem.v1.Learner or tandem.v1.Bridge [default: all that is offered there].
    #[arg(long, default_value = "", hide_default_value = true, value_name = "NAME")]
    pub(crate) service: String,
    /// Seconds to wait for the answer.
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

Exit codes: 0 told (with --watch: until the run had ended), 64 a wrong token, 75 the learner is away or went away.")]
pub(crate) struct StatusArgs {
    /// The learner's address.
    #[arg(value_name = "ADDR")]
    pub(crate) address: String,
    /// Goes on telling until the run has ended: a line for each evaluation, and every half minute.
    #[arg(long)]
    pub(crate) watch: bool,
    /// Prints one JSON object, with --watch one for each message.
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
  tandem bench                   everything but scale, about two minutes
  tandem bench sim update --json
  tandem bench scale             how many workers one learner holds, about two minutes
  tandem bench scale --workers 0 --idle 1000 --join-leave 100")]
pub(crate) struct BenchArgs {
    /// What to measure [default: all but scale].
    #[arg(value_enum)]
    pub(crate) what: Vec<BenchName>,
    /// Prints one JSON object a line: name, value, unit.
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
    /// The teacher as a service, beside an echo of the same messages.
    Teacher,
    /// A short run of the main job, processes and all.
    EndToEnd,
    /// One learner and more and more workers, real ones and ones that only wait.
    Scale,
}

#[derive(Debug, Args)]
pub(crate) struct PolicyArgs {
    #[command(subcommand)]
    pub(crate) command: PolicyCommand,
}

#[derive(Debug, Subcommand)]
pub(crate) enum PolicyCommand {
    /// Shows sizes, how it was trained and its digest.
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
  tandem replay runs --verify                           every *.mcap below
  tandem replay FILE.mcap --verify --json

Every number that the simulator gives is compared bit for bit with the log's; exit code 65 when one differs or a log
cannot be read.")]
pub(crate) struct ReplayArgs {
    /// Recorded episodes, or directories in and below which every *.mcap is one.
    #[arg(required = true, value_name = "FILE|DIR")]
    pub(crate) files: Vec<PathBuf>,
    /// Only compares: without it, one log alone is also shown step by step.
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
    /// Makes a whole file of what a killed writer left.
    Recover {
        /// What was left.
        file: PathBuf,
        /// The whole file [default: FILE with `.recovered.mcap` appended].
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
    /// The policy at work.
    #[arg(long, value_name = "FILE", required_unless_present = "composed_teachers")]
    pub(crate) policy: Option<PathBuf>,
    /// A one-arm policy that drives both arms.
    #[arg(long, value_name = "FILE", conflicts_with = "policy")]
    pub(crate) composed_teachers: Option<PathBuf>,
    /// Which episode's start and goal.
    #[arg(long, default_value_t = 777)]
    pub(crate) seed: u64,
    /// The control step that is drawn, 0 to 50.
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u32).range(0..=50))]
    pub(crate) step: u32,
    /// The picture.
    #[arg(long, value_name = "FILE.svg")]
    pub(crate) out: PathBuf,
}
