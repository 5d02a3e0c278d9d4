//! The processes that are measured: a learner, relays and workers. They end with this process.

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context as _, anyhow};
use tandem_core::Task;
use tandem_rl::RunConfig;
use tandem_rl::config::Recipe;

use crate::launch::{ChildProcess, Launcher, ProcessLog};
use crate::run_file;

/// Time that a process has to exit.
const GRACE: Duration = Duration::from_secs(10);
/// Largest whole number that a setting accepts.
const NEVER: u64 = 1 << 53;
/// Updates per environment step that amount to one per round, the minimum of a learner.
const FEW: f64 = 1e-9;

/// A temporary directory for the processes, and the program that they run.
pub(super) struct Workspace {
    directory: PathBuf,
    launcher: Launcher,
}

impl Workspace {
    /// Creates the directory. Without `program`, the processes run this program.
    pub(super) fn new(program: Option<&Path>) -> anyhow::Result<Self> {
        let name = format!("tandem-bench-scale-{}", std::process::id());
        let directory = std::env::temp_dir().join(name);
        fs::create_dir_all(&directory)
            .with_context(|| format!("cannot create {}", directory.display()))?;
        let log = ProcessLog::open(&directory.join("log"))?;
        let launcher = match program {
            Some(program) => Launcher::with_program(program.to_owned(), log),
            None => Launcher::new(log)?,
        };
        Ok(Self { directory, launcher })
    }

    /// Starts a learner without advice, evaluations and checkpoints, whose rounds have `n_slots` slots. `name` is unique
    /// in this workspace.
    pub(super) async fn learner(
        &self,
        name: &str,
        n_slots: usize,
        updates_per_env_step: f64,
    ) -> anyhow::Result<Service> {
        let mut run = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
        run.name = "bench-scale".to_owned();
        run.advice.strategy = "none".to_owned();
        run.rounds.slots = n_slots;
        run.rounds.rollouts = super::ROLLOUTS;
        run.rounds.updates_per_env_step = updates_per_env_step.max(FEW);
        run.rounds.warmup_env_steps = 0;
        run.evaluation.every_env_steps = NEVER;
        run.evaluation.early_points = 0;
        run.stop.max_env_steps = 0;
        run.checkpoint.every_rounds = NEVER;
        let run = run.checked().context("invalid settings")?;
        let out = self.directory.join(name);
        let file = self.directory.join(format!("{name}.toml"));
        fs::write(&file, run_file::to_toml(&run)?).context("cannot write a run file")?;
        let args = ["learner".into(), "--run".into(), file.into(), "--out".into(), out.into()];
        self.start_service(&args).await.context("the learner did not start")
    }

    /// Starts a relay of the learner at `learner`.
    pub(super) async fn relay(&self, learner: &str) -> anyhow::Result<Service> {
        let args = ["relay".into(), "--connect".into(), learner.into()];
        self.start_service(&args).await.context("a relay did not start")
    }

    /// Starts a worker that simulates.
    pub(super) fn worker(&self, learner: &str, name: &str) -> anyhow::Result<Process> {
        let args =
            ["worker".into(), "--connect".into(), learner.into(), "--name".into(), name.into()];
        self.start(&args, Stdio::null())
    }

    async fn start_service(&self, args: &[OsString]) -> anyhow::Result<Service> {
        let mut process = self.start(args, Stdio::piped())?;
        let address = process.child.service_address().await.context("cannot read the address")?;
        let reason = || self.launcher.log().last_error_since(process.child.log_offset());
        let address = address.ok_or_else(|| anyhow!("no address: {}", reason()))?;
        Ok(Service { process, address })
    }

    fn start(&self, args: &[OsString], stdout: Stdio) -> anyhow::Result<Process> {
        let mut args = args.to_vec();
        args.extend(["--exit-with-stdin", "--log", "warn"].map(OsString::from));
        let child = self.launcher.spawn(&args, stdout).context("cannot start a process")?;
        let pid = child.pid().context("a process has ended at once")?;
        Ok(Process { child, pid })
    }
}

impl Drop for Workspace {
    fn drop(&mut self) {
        drop(fs::remove_dir_all(&self.directory));
    }
}

/// A process of a workspace.
pub(super) struct Process {
    child: ChildProcess,
    pub(super) pid: u32,
}

impl Process {
    /// Returns true if the process runs.
    pub(super) fn is_alive(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// Asks the process to exit and waits for it.
    pub(super) async fn end(self) {
        self.child.end(GRACE).await;
    }
}

/// A process that serves at an address.
pub(super) struct Service {
    pub(super) process: Process,
    pub(super) address: String,
}
