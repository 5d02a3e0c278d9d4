//! The processes that are measured: a learner, relays, workers. They end with this process.

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context as _, anyhow};
use tandem_core::Task;
use tandem_rl::RunConfig;
use tandem_rl::config::Recipe;
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::process::{Child, Command};

use crate::run_file;

/// How long a process may take to end by itself.
const GRACE: Duration = Duration::from_secs(10);
/// The settings take whole numbers up to here.
const NEVER: u64 = 1 << 53;
/// Updates for each environment step that come to one a round, the least that a learner makes.
const FEW: f64 = 1e-9;

/// Where the processes keep their files; removed at the end.
pub(super) struct Place {
    directory: PathBuf,
    program: PathBuf,
}

impl Place {
    /// Processes of `program`, of this one if none is named.
    pub(super) fn new(program: Option<&Path>) -> anyhow::Result<Self> {
        let program = match program {
            Some(program) => program.to_owned(),
            None => std::env::current_exe().context("cannot find this program's own file")?,
        };
        let name = format!("tandem-bench-scale-{}", std::process::id());
        let path = std::env::temp_dir().join(name);
        fs::create_dir_all(&path).with_context(|| format!("cannot make {}", path.display()))?;
        Ok(Self { directory: path, program })
    }

    fn log(&self) -> anyhow::Result<File> {
        let path = self.directory.join("log");
        let log = OpenOptions::new().create(true).append(true).open(&path);
        log.with_context(|| format!("cannot write {}", path.display()))
    }

    /// The last line that a process left for a person.
    fn last_words(&self) -> String {
        let log = fs::read_to_string(self.directory.join("log")).unwrap_or_default();
        let told = log.lines().rev().find_map(|line| line.strip_prefix("tandem: "));
        told.unwrap_or("it did not say why").to_owned()
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        drop(fs::remove_dir_all(&self.directory));
    }
}

/// A process that ends when its standard input closes, and is killed when this value is dropped.
pub(super) struct Process {
    child: Child,
    pub(super) pid: u32,
}

impl Process {
    fn start(place: &Place, args: &[OsString], stdout: Stdio) -> anyhow::Result<Self> {
        let mut command = Command::new(&place.program);
        command
            .args(args)
            .args(["--exit-with-stdin", "--log", "warn"])
            .process_group(0)
            .kill_on_drop(true)
            .env_remove("TANDEM_TOKEN_FILE")
            .stdin(Stdio::piped())
            .stdout(stdout)
            .stderr(place.log()?);
        let child =
            command.spawn().with_context(|| format!("cannot start {}", place.program.display()))?;
        let pid = child.id().context("a process has ended at once")?;
        Ok(Self { child, pid })
    }

    /// Whether it has not ended.
    pub(super) fn is_alive(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// Lets it end what it is doing.
    pub(super) async fn end(mut self) {
        drop(self.child.stdin.take());
        drop(tokio::time::timeout(GRACE, self.child.wait()).await);
    }
}

/// A process that says where it listens.
pub(super) struct Service {
    pub(super) process: Process,
    pub(super) address: String,
}

impl Service {
    async fn start(place: &Place, args: &[OsString]) -> anyhow::Result<Self> {
        let mut process = Process::start(place, args, Stdio::piped())?;
        let output = process.child.stdout.take().context("a process cannot be heard")?;
        let mut line = String::new();
        BufReader::new(output).read_line(&mut line).await.context("a process cannot be heard")?;
        let address = line.trim().strip_prefix("listening on ").map(str::to_owned);
        let address = address.ok_or_else(|| anyhow!("cannot serve: {}", place.last_words()))?;
        Ok(Self { process, address })
    }

    /// A learner, called `name` in its place, whose rounds have `n_slots` slots, that asks nobody for advice, evaluates nothing and saves nothing.
    pub(super) async fn learner(
        place: &Place,
        name: &str,
        n_slots: usize,
        updates_per_env_step: f64,
    ) -> anyhow::Result<Self> {
        let mut run = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
        run.name = "bench-scale".to_owned();
        run.advice.strategy = "none".to_owned();
        run.rounds.slots = n_slots;
        run.rounds.rollouts = super::ROLLOUTS;
        run.rounds.updates_per_env_step = updates_per_env_step.max(FEW);
        run.rounds.warmup_env_steps = 0;
        run.evaluation.every_env_steps = NEVER;
        run.stop.max_env_steps = 0;
        run.checkpoint.every_rounds = NEVER;
        let run = run.checked().context("cannot make a run")?;
        let out = place.directory.join(name);
        let file = place.directory.join(format!("{name}.toml"));
        fs::write(&file, run_file::to_toml(&run)?).context("cannot write a run file")?;
        let args = ["learner".into(), "--run".into(), file.into(), "--out".into(), out.into()];
        Self::start(place, &args).await.context("the learner did not start")
    }

    /// A relay that passes on what the learner at `learner` says.
    pub(super) async fn relay(place: &Place, learner: &str) -> anyhow::Result<Self> {
        let args = ["relay".into(), "--connect".into(), learner.into()];
        Self::start(place, &args).await.context("a relay did not start")
    }
}

/// A real worker.
pub(super) fn worker(place: &Place, learner: &str, name: &str) -> anyhow::Result<Process> {
    let args = ["worker".into(), "--connect".into(), learner.into(), "--name".into(), name.into()];
    Process::start(place, &args, Stdio::null())
}
