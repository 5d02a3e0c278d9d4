//! The command line of `tandem eval`, `tandem report`, `tandem replay` and the commands for files.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use tandem_core::evaluation::TEST_SEED;

use super::{ClientArgs, EnvironmentArgs, LiveArgs, SecretArgs, TaskName, WorldName};

#[derive(Debug, Args)]
#[command(group = clap::ArgGroup::new("who").required(true), after_help = "\
Examples:
  tandem eval --policy policies/student-push.safetensors
  tandem eval --policy runs/NAME                # the best policy of a run
  tandem eval --policy FILE --episodes 400 --seed 7 --json
  tandem eval --policy policies/student-push.safetensors --baselines
  tandem eval --composed-teachers policies/teacher-push.safetensors
  tandem eval --policy policies/student-push.safetensors --robustness
      # other cubes and friction, noise, delay
  tandem eval --policy FILE --robustness --baselines
  tandem eval --policy FILE --episodes 1 --record episode.mcap
  tandem eval --policy FILE --film arms.gif             # the first episode
  tandem eval --policy FILE --film strip.png --film-outcome failure
  tandem eval --policy FILE --episodes 20 --live
      # then shows the episodes in Foxglove
  tandem eval --policy FILE --env 127.0.0.1:7005
      # in the environments of a server
  tandem eval --policy FILE --env-command 'tandem env'  # starts the server")]
pub(crate) struct EvalArgs {
    /// Policy to evaluate: a file, or a run directory for the best policy of the run.
    #[arg(long, value_name = "FILE|DIR", group = "who")]
    pub(crate) policy: Option<PathBuf>,
    /// One-arm policy that controls each arm separately: the baseline without a student.
    #[arg(long, value_name = "FILE|DIR", group = "who")]
    pub(crate) composed_teachers: Option<PathBuf>,
    /// Also evaluates two baselines on the same goals: composed teachers, and the policy with arms that do not see each
    /// other.
    #[arg(long, requires = "policy")]
    pub(crate) baselines: bool,
    /// Evaluates on the same starts and goals under conditions that differ from the usual ones, one at a time: other
    /// sizes and masses of the cubes, other friction, noise in the positions of the objects, late actions, and bases that
    /// are not where they are believed to be. Starts that have no room for larger cubes are drawn again. --baselines adds
    /// the baselines under the same conditions.
    #[arg(long, conflicts_with_all = ["record", "record_dir", "film", "live", "env", "env_command"])]
    pub(crate) robustness: bool,
    /// One-arm policy of the composed teachers [default: the shipped teacher of the task].
    #[arg(long, value_name = "FILE|DIR", requires = "baselines")]
    pub(crate) teacher: Option<PathBuf>,
    /// Fails unless the policy is for this task, or composed teachers for its arms.
    #[arg(long, value_parser = TaskName::parser())]
    pub(crate) task: Option<TaskName>,
    /// Fails unless the policy is for this world.
    #[arg(long, value_enum)]
    pub(crate) world: Option<WorldName>,
    /// Number of arms [default: the policy's; for composed teachers the server's, or 2].
    #[arg(long)]
    pub(crate) arms: Option<usize>,
    #[command(flatten)]
    pub(crate) environment: EnvironmentArgs,
    /// Number of episodes, one per goal.
    #[arg(long, default_value_t = 240, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub(crate) episodes: u64,
    /// Seed of the test goals. Runs select their best policy on validation goals of another seed.
    #[arg(long, default_value_t = TEST_SEED)]
    pub(crate) seed: u64,
    /// Records the first episode to this MCAP file.
    #[arg(long, value_name = "FILE.mcap")]
    pub(crate) record: Option<PathBuf>,
    /// Records all episodes to MCAP files in this directory.
    #[arg(long, value_name = "DIR")]
    pub(crate) record_dir: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) film: FilmArgs,
    /// Number of episodes in the film, from the first.
    #[arg(long, value_name = "N", default_value_t = 1, requires = "film",
        value_parser = clap::value_parser!(u64).range(1..=100))]
    pub(crate) film_episodes: u64,
    /// Shows only episodes with this outcome.
    #[arg(long, value_enum, requires = "film")]
    pub(crate) film_outcome: Option<OutcomeName>,
    #[command(flatten)]
    pub(crate) live: LiveArgs,
    /// Prints one JSON object on the last line of standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

/// A film of episodes.
#[derive(Debug, Args)]
pub(crate) struct FilmArgs {
    /// Writes a film: an animation (.gif), or a strip of eight pictures per episode (.png).
    #[arg(long, value_name = "FILE.gif|png")]
    pub(crate) film: Option<PathBuf>,
    /// Width and height of a picture, pixels [default: 640x400, in a strip 480x300].
    #[arg(long, value_name = "WxH", requires = "film", value_parser = picture_size)]
    pub(crate) film_size: Option<PictureSize>,
    /// Speed of an animation relative to simulated time.
    #[arg(long, value_name = "FACTOR", default_value_t = 0.5, requires = "film")]
    pub(crate) film_speed: f64,
}

/// Width and height of a picture, pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PictureSize {
    pub(crate) width: usize,
    pub(crate) height: usize,
}

/// Parses a size such as `640x400`.
fn picture_size(text: &str) -> Result<PictureSize, String> {
    let size = text.split_once('x').and_then(|(width, height)| {
        Some(PictureSize { width: width.parse().ok()?, height: height.parse().ok()? })
    });
    size.ok_or_else(|| "expected width and height in pixels, such as 640x400".to_owned())
}

/// The outcome of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum OutcomeName {
    Success,
    Failure,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem report runs/sweep-table2
  tandem report runs/a runs/b --out compared.html --csv compared.csv
  tandem report trials/student-push --all-trials
  tandem report docs/results/students \\
      --composed-teachers policies/teacher-push.safetensors
  tandem report runs/NAME --film-strips runs/NAME")]
pub(crate) struct ReportArgs {
    /// Run directories, directories that contain runs or trials, or single metrics and trials files.
    #[arg(required = true, value_name = "DIR|FILE")]
    pub(crate) paths: Vec<PathBuf>,
    /// HTML page; its figures are also written to a directory beside it, report-figures for report.html [default:
    /// report.html in the directory of the sweep or trials, or comparison.html in that of a run, if it is the only one,
    /// else report.html in the working directory].
    #[arg(long, value_name = "FILE.html")]
    pub(crate) out: Option<PathBuf>,
    /// Also writes a CSV file with one line per run.
    #[arg(long, value_name = "FILE.csv")]
    pub(crate) csv: Option<PathBuf>,
    /// Also writes the tables of all values, with ranges and intervals, as Markdown.
    #[arg(long, value_name = "FILE.md")]
    pub(crate) markdown: Option<PathBuf>,
    /// Output of `tandem eval --json`, shown as a row with the file's name; can be repeated.
    #[arg(long = "eval", value_name = "FILE.json")]
    pub(crate) evals: Vec<PathBuf>,
    /// Evaluates a one-arm policy on both arms, the baseline without a student; can be repeated.
    #[arg(long, value_name = "FILE|DIR")]
    pub(crate) composed_teachers: Vec<PathBuf>,
    /// Plays the test goals with this policy, a file or a run directory, and shows a success and a failure as film strips;
    /// can be repeated.
    #[arg(long, value_name = "FILE|DIR")]
    pub(crate) film_strips: Vec<PathBuf>,
    /// Draws all trials, not only failed ones.
    #[arg(long)]
    pub(crate) all_trials: bool,
    /// Prints one JSON object on the last line of standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem replay runs/NAME/mcap/eval-000100-000.mcap  # step by step
  tandem replay runs --verify                        # all *.mcap files below
  tandem replay FILE.mcap --verify --json
  tandem replay FILE.mcap --film episode.gif
  tandem replay runs/NAME/mcap --verify --env-command 'python3 server.py'
  tandem replay runs/NAME/mcap --live  # in Foxglove: play, pause, seek

All numbers from the simulator are compared bit for bit with the log. An episode of a task that is \
not built-in is simulated again in the environments of --env or --env-command. Logs of trials are \
left out. The exit code is 65 if \
a number differs or a log cannot be read, and else 64 if a log needs environments that are not given; \
a single log is then printed without --verify, and not compared.")]
pub(crate) struct ReplayArgs {
    /// Recorded episodes, or directories to search for *.mcap files.
    #[arg(required = true, value_name = "FILE|DIR")]
    pub(crate) files: Vec<PathBuf>,
    /// Compares only. By default a single log is also printed step by step.
    #[arg(long, conflicts_with = "live")]
    pub(crate) verify: bool,
    #[command(flatten)]
    pub(crate) live: LiveArgs,
    /// Prints one JSON object on the last line of standard output.
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) film: FilmArgs,
    #[command(flatten)]
    pub(crate) environment: EnvironmentArgs,
    #[command(flatten)]
    pub(crate) client_config: ClientArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem mcap recover runs/NAME/mcap/eval-000100-000.mcap.part
  tandem mcap recover FILE.mcap.part --to recovered.mcap")]
pub(crate) struct McapArgs {
    #[command(subcommand)]
    pub(crate) command: McapCommand,
}

#[derive(Debug, Subcommand)]
pub(crate) enum McapCommand {
    /// Recovers the log of a writer that was killed.
    #[command(after_help = "\
Examples:
  tandem mcap recover runs/NAME/mcap/eval-000100-000.mcap.part
  tandem replay runs/NAME/mcap/eval-000100-000.mcap.part.recovered.mcap")]
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
  tandem picture --policy policies/student-push.safetensors --out arms.png
  tandem picture --composed-teachers policies/teacher-push.safetensors \\
      --step 20 --out arms.png")]
pub(crate) struct PictureArgs {
    /// Policy that controls the arms: a file or a run directory.
    #[arg(long, value_name = "FILE|DIR", required_unless_present = "composed_teachers")]
    pub(crate) policy: Option<PathBuf>,
    /// One-arm policy that controls both arms.
    #[arg(long, value_name = "FILE|DIR", conflicts_with = "policy")]
    pub(crate) composed_teachers: Option<PathBuf>,
    /// Seed of start and goal: those of the first episode of an evaluation with this seed.
    #[arg(long, default_value_t = TEST_SEED)]
    pub(crate) seed: u64,
    /// Control step to draw, 0 to 50.
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u32).range(0..=50))]
    pub(crate) step: u32,
    /// Width and height, pixels.
    #[arg(long, value_name = "WxH", default_value = "960x600", value_parser = picture_size)]
    pub(crate) size: PictureSize,
    /// Output file.
    #[arg(long, value_name = "FILE.png")]
    pub(crate) out: PathBuf,
}
