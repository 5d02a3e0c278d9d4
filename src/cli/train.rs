//! The command line of `tandem train` and `tandem sweep`.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::number::{seed, whole};
use super::{EnvironmentArgs, LiveArgs, MetricsArgs, RecordingArgs, TaskName, WorldName};
use crate::shell::shell_word;

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum RecipeName {
    /// Tandem's recipe, which needs few environment steps and minutes on two cores.
    Tandem,
    /// The paper's DDPG + HER, with the reference implementation's values where the paper gives none; takes hours.
    Paper,
}

const TASK: &str = "Task";
const ADVICE: &str = "Advice";
const END_OF_THE_RUN: &str = "End of the run";
const SETTINGS: &str = "Settings";
const PROCESSES: &str = "Processes";
const OUTPUT: &str = "Run directory and output";

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem train              # two arms push, advised by the shipped teacher
  tandem train --settings   # every setting, its meaning and its values
  tandem train --arms 1 --task push --until-success 0.97
  tandem train --world classic  # fast arms whose areas lie next to each other
  tandem train --task carry-bar  # two arms carry one bar
  tandem train --strategy ea --budget 50000 --seed 2 --max-minutes 20
  tandem train --strategy jsrl:20 --budget 10000
  tandem train --teacher runs/NAME  # its best policy
  tandem train --teacher actor.onnx --teacher-critic critic.onnx
  tandem train --teacher http://127.0.0.1:7005  # a policy in another process
  tandem train --set ddpg.discount=0.98 --set rounds.slots=16
  tandem train --arms 1 --recipe paper --print-run > my-run.toml
      # every setting of this run
  tandem train --run my-run.toml --out runs/mine --quiet
  tandem train --run deploy/push-paper.toml --teacher runs/teacher-push-paper
  tandem train --env 127.0.0.1:7005  # plays in the environments of a server
  tandem train --env-command 'tandem env'
      # each worker starts a server of its own
  tandem train --record all --log-budget 10GiB
      # records training episodes too
  tandem train --live  # shows recorded episodes in Foxglove
  tandem train --dashboard 0.0.0.0:8600 --dashboard-token-file token
      # to watch it from a phone
  tandem train --resume --out runs/mine  # resumes the run
  tandem train --resume --out runs/mine --max-env-steps 600000
      # resumes it for longer")]
pub(crate) struct TrainArgs {
    /// Task [default: push].
    #[arg(long, help_heading = TASK, value_parser = TaskName::parser())]
    pub(crate) task: Option<TaskName>,
    /// World of the task: classic (fast arms, adjacent areas) or shared (slow arms, one area) [default: shared].
    #[arg(long, help_heading = TASK, value_enum, hide_possible_values = true)]
    pub(crate) world: Option<WorldName>,
    /// Number of arms of the trained policy, 1 or 2 [default: 2].
    #[arg(long, help_heading = TASK)]
    pub(crate) arms: Option<usize>,
    /// Advising strategy: none, ea, eamc:T, mc-q:T, mc-act:A, mc-act-abs:A, jsrl:H (the teacher acts on at most the
    /// first H steps), rlif:T (as mc-q:T, and interventions lower the reward) or ts2c:T (asks
    /// where critics disagree). With init:teacher the student starts as
    /// copies of the teacher and gets no advice
    /// [default: none with one arm; mc-q:0.4 in pick-and-place of world shared with recipe tandem, else mc-q:0.1].
    #[arg(long, help_heading = ADVICE, value_name = "NAME[:THRESHOLD]")]
    pub(crate) strategy: Option<String>,
    /// Policy file of the teacher, a run directory for the best policy of the run, the ONNX model of an actor (*.onnx),
    /// or http://HOST:PORT of a server of tandem.v1.Policy without a token [default: the shipped teacher of the task].
    /// With --recipe paper it should be a teacher of that recipe; otherwise a message says so.
    #[arg(long, help_heading = ADVICE, value_name = "FILE|DIR|URL")]
    pub(crate) teacher: Option<PathBuf>,
    /// ONNX model of the teacher's critic. Without it, strategies that compare values cannot be used.
    #[arg(long, help_heading = ADVICE, value_name = "FILE.onnx", requires = "teacher")]
    pub(crate) teacher_critic: Option<PathBuf>,
    /// Advice budget, in environment steps with advice; with --recipe paper in lock steps of each slot
    /// (advice.budget_scope, advice.unit) [default: 500000].
    #[arg(long, help_heading = ADVICE, value_name = "N", value_parser = whole)]
    pub(crate) budget: Option<u64>,
    /// Number of worker processes [default: one per core, at most one per slot].
    #[arg(long, help_heading = PROCESSES, value_name = "N")]
    pub(crate) workers: Option<usize>,
    #[command(flatten, next_help_heading = "Environments of another process")]
    pub(crate) environment: EnvironmentArgs,
    /// Seed of all random numbers [default: 1].
    #[arg(long, help_heading = SETTINGS, value_name = "N", value_parser = seed)]
    pub(crate) seed: Option<u64>,
    /// Stops when an evaluation reaches this success rate, 0 to 1; contacts do not count against it.
    #[arg(long, help_heading = END_OF_THE_RUN, value_name = "P")]
    pub(crate) until_success: Option<f64>,
    /// Stops after this many environment steps; 0 for no limit [default: the recipe's, none with --max-minutes].
    #[arg(long, help_heading = END_OF_THE_RUN, value_name = "N", value_parser = whole)]
    pub(crate) max_env_steps: Option<u64>,
    /// Stops after this many minutes, those before --resume included; 0 for no limit. A resumed run keeps its other limit.
    #[arg(long, help_heading = END_OF_THE_RUN, value_name = "N")]
    pub(crate) max_minutes: Option<f64>,
    /// Recipe that gives the defaults of all settings [default: tandem].
    #[arg(long, help_heading = SETTINGS, value_enum)]
    pub(crate) recipe: Option<RecipeName>,
    /// Run file (TOML) with any of the settings; unknown keys are rejected.
    #[arg(long, help_heading = SETTINGS, value_name = "FILE.toml")]
    pub(crate) run: Option<PathBuf>,
    /// Overrides one setting, for example ddpg.discount=0.98; can be repeated.
    #[arg(long = "set", help_heading = SETTINGS, value_name = "KEY=VALUE")]
    pub(crate) settings: Vec<String>,
    /// Prints every setting with its meaning, its range and its values under both recipes, for all tasks and numbers of
    /// arms, and starts nothing. --print-run prints the values of one run.
    #[arg(long = "settings", help_heading = SETTINGS, conflicts_with_all = [
        "task", "world", "arms", "strategy", "teacher", "budget", "env", "env_command", "seed", "until_success",
        "max_env_steps", "max_minutes", "recipe", "run", "settings", "print_run", "out", "resume"])]
    pub(crate) list_settings: bool,
    /// Prints the run file of the other options, with every setting, and starts no run; --run takes it. Teacher, workers
    /// and environments are no settings: name them again. --env and --env-command are asked for their task.
    #[arg(long, help_heading = SETTINGS, conflicts_with_all = ["resume", "json"])]
    pub(crate) print_run: bool,
    /// Run directory [default: runs/TASK-ARMS-STRATEGY-seedN].
    #[arg(long, help_heading = OUTPUT, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    #[command(flatten, next_help_heading = "Logs of episodes")]
    pub(crate) recording: RecordingArgs,
    #[command(flatten, next_help_heading = "Logs of episodes")]
    pub(crate) live: LiveArgs,
    /// Resumes the run in --out from its newest checkpoint. Settings and teacher remain those of the run, and so does the
    /// server of its environments unless --env or --env-command names another one. Only
    /// its end (--max-env-steps, --max-minutes, --until-success), checkpoint.*, evaluation.early_points,
    /// evaluation.recorded_episodes, evaluation.test_episodes and --workers can change. A rejected --resume changes nothing.
    #[arg(long, help_heading = OUTPUT)]
    pub(crate) resume: bool,
    #[command(flatten, next_help_heading = "Monitoring")]
    pub(crate) dashboard: DashboardArgs,
    #[command(flatten, next_help_heading = "Monitoring")]
    pub(crate) metrics: MetricsArgs,
    /// Prints the summary as one JSON object on the last line of standard output.
    #[arg(long, help_heading = OUTPUT)]
    pub(crate) json: bool,
    /// Prints every message about the progress as one JSON object per line of standard output, before the summary.
    #[arg(long, hide = true, requires = "json")]
    pub(crate) progress_json: bool,
    /// Prints no progress: only the summary, warnings and errors.
    #[arg(long, help_heading = OUTPUT, short)]
    pub(crate) quiet: bool,
    /// Interrupts the run when standard input closes, which happens when the parent process dies.
    #[arg(long, hide = true)]
    pub(crate) exit_with_stdin: bool,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem sweep deploy/sweep-small.toml --dry-run  # lists the runs
  tandem sweep deploy/sweep-small.toml            # starts them, or resumes them
  tandem report runs/sweep-small
  tandem sweep deploy/sweep-small.toml --only 3   # trains one of them
  tandem sweep FILE.toml --dashboard 0.0.0.0:8600 --dashboard-token-file token

docs/sweep.md describes the file. The exit code is 75 if runs failed, or were left out because another \
process uses them; the next start tries each of them once more.")]
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
    /// Trains only run N of the list, from 0; --dry-run prints the numbers. Several such commands may work in one
    /// directory at a time, also on several machines that share it.
    #[arg(long, value_name = "N", conflicts_with = "jobs")]
    pub(crate) only: Option<usize>,
    /// Prints one JSON object on the last line of standard output.
    #[arg(long)]
    pub(crate) json: bool,
    /// Lists the runs with their numbers and their progress, and starts none.
    #[arg(long)]
    pub(crate) dry_run: bool,
    #[command(flatten)]
    pub(crate) dashboard: DashboardArgs,
}

/// Options of the dashboard.
#[derive(Debug, Args)]
pub(crate) struct DashboardArgs {
    /// Address of the dashboard, which a browser shows live. If its port is in use, the next free one is taken.
    /// [default: 127.0.0.1:8600]
    #[arg(long, value_name = "ADDR")]
    pub(crate) dashboard: Option<SocketAddr>,
    /// File with the token that the dashboard asks for if --dashboard is not a loopback address.
    #[arg(long, value_name = "FILE", requires = "dashboard")]
    pub(crate) dashboard_token_file: Option<PathBuf>,
    /// Serves no dashboard.
    #[arg(long, conflicts_with = "dashboard")]
    pub(crate) no_dashboard: bool,
}

impl DashboardArgs {
    /// Returns the options, each after a space, for a command line that is printed.
    pub(crate) fn shell_words(&self) -> String {
        let address = self.dashboard.map(|address| format!(" --dashboard {address}"));
        let token = self.dashboard_token_file.as_deref().map(shell_word);
        let token = token.map(|path| format!(" --dashboard-token-file {path}"));
        let none = if self.no_dashboard { " --no-dashboard" } else { "" };
        format!("{}{}{none}", address.unwrap_or_default(), token.unwrap_or_default())
    }
}

/// Parses a UTF-8 path, which can be part of an address.
fn utf8_path() -> impl clap::builder::TypedValueParser<Value = PathBuf> {
    use clap::builder::{OsStringValueParser, TypedValueParser as _};
    OsStringValueParser::new()
        .try_map(|path| path.into_string().map(PathBuf::from).map_err(|_raw| "expected UTF-8"))
}
