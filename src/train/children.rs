//! The processes of a run: started in order, kept alive, ended together.
//!
//! Each child watches its standard input and ends, saved, when that closes; so they end with this process however it
//! dies. Their log lines go to the run's `tandem.log`.

use std::fs::{File, OpenOptions};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context as _, anyhow, bail};
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::process::{Child, Command};

use super::plan::Plan;

/// How long teacher and workers may take to end once the learner has.
const GRACE: Duration = Duration::from_secs(5);
/// Failures of one worker after which the run is given up.
const MAX_WORKER_FAILURES: u32 = 10;

pub(crate) struct Children {
    program: PathBuf,
    log: File,
    log_path: PathBuf,
    teacher: Option<(Child, String)>,
    learner: Option<(Child, String)>,
    workers: Vec<Worker>,
    peak: Memory,
}

/// Largest resident size of each kind of process, MiB; 0 where there is none or the system does not tell.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Memory {
    pub(crate) learner_mib: u64,
    pub(crate) teacher_mib: u64,
    pub(crate) worker_mib: u64,
}

struct Worker {
    child: Child,
    name: String,
    n_failures: u32,
    finished: bool,
}

impl Children {
    pub(crate) fn new(plan: &Plan) -> anyhow::Result<Self> {
        let path = plan.log_path();
        let log = OpenOptions::new().create(true).append(true).open(&path);
        let log = log.with_context(|| format!("cannot write {}", path.display()))?;
        let program = std::env::current_exe().context("cannot find this program's own file")?;
        Ok(Self {
            program,
            log,
            log_path: path,
            teacher: None,
            learner: None,
            workers: Vec::new(),
            peak: Memory::default(),
        })
    }

    /// Starts teacher, learner and workers, in this order.
    pub(crate) async fn start(&mut self, plan: &Plan) -> anyhow::Result<()> {
        if plan.teacher.is_some() {
            let policy = plan.teacher_copy();
            let args = [
                "teacher".into(),
                "--exit-with-stdin".into(),
                "--policy".into(),
                policy.into_os_string(),
            ];
            self.teacher = Some(self.service("teacher", &args).await?);
        }
        let mut args: Vec<std::ffi::OsString> = vec!["learner".into(), "--exit-with-stdin".into()];
        args.extend(["--run".into(), plan.run_file().into_os_string()]);
        args.extend(["--out".into(), plan.out.clone().into_os_string()]);
        if let Some((_, address)) = &self.teacher {
            args.extend(["--teacher".into(), address.into()]);
        }
        if plan.resume {
            args.push("--resume".into());
        }
        self.learner = Some(self.service("learner", &args).await?);
        for number in 1..=plan.n_workers {
            let name = format!("worker-{number}");
            let child = self.worker(plan, &name)?;
            self.workers.push(Worker { child, name, n_failures: 0, finished: false });
        }
        Ok(())
    }

    pub(crate) fn learner_address(&self) -> &str {
        self.learner.as_ref().map_or("", |(_, address)| address)
    }

    /// Looks after the processes: starts dead workers again and says so.
    ///
    /// # Errors
    /// When a process that cannot be replaced has died, or a worker dies again and again.
    pub(crate) fn check(&mut self, plan: &Plan) -> anyhow::Result<Vec<String>> {
        for (role, service) in [("teacher", &mut self.teacher), ("learner", &mut self.learner)] {
            if let Some((child, _)) = service
                && let Some(status) = child.try_wait()?
                && !(role == "learner" && status.success())
            {
                bail!("the {role} died ({status})");
            }
        }
        self.sample_memory();
        let mut said = Vec::new();
        for idx in 0..self.workers.len() {
            let worker = &mut self.workers[idx];
            let Some(status) = worker.child.try_wait()?.filter(|_| !worker.finished) else {
                continue;
            };
            worker.finished = status.success();
            if worker.finished {
                continue;
            }
            worker.n_failures += 1;
            let name = worker.name.clone();
            if worker.n_failures >= MAX_WORKER_FAILURES {
                bail!("{name} died {MAX_WORKER_FAILURES} times, last with {status}");
            }
            said.push(format!("{name} died ({status}) and is started again"));
            self.workers[idx].child = self.worker(plan, &name)?;
        }
        Ok(said)
    }

    /// The largest sizes seen so far.
    pub(crate) const fn memory(&self) -> Memory {
        self.peak
    }

    fn sample_memory(&mut self) {
        let service = |service: &Option<(Child, String)>| {
            service.as_ref().map_or(0, |(child, _)| peak_resident_mib(child))
        };
        let workers = self.workers.iter().map(|worker| peak_resident_mib(&worker.child));
        self.peak = Memory {
            learner_mib: self.peak.learner_mib.max(service(&self.learner)),
            teacher_mib: self.peak.teacher_mib.max(service(&self.teacher)),
            worker_mib: workers.fold(self.peak.worker_mib, u64::max),
        };
    }

    /// Closes every child's standard input and waits for their end; what then still runs is killed. The learner, which
    /// saves, has until `deadline`.
    pub(crate) async fn end(&mut self, deadline: Duration) {
        let mut others: Vec<Child> = self.workers.drain(..).map(|worker| worker.child).collect();
        others.extend(self.teacher.take().map(|(child, _)| child));
        for child in &mut others {
            drop(child.stdin.take());
        }
        if let Some((learner, _)) = self.learner.take() {
            end_within(learner, deadline).await;
        }
        for child in others {
            end_within(child, GRACE).await;
        }
    }

    fn worker(&self, plan: &Plan, name: &str) -> anyhow::Result<Child> {
        let mut command = self.command()?;
        command.args([
            "worker",
            "--exit-with-stdin",
            "--name",
            name,
            "--connect",
            self.learner_address(),
            "--log-dir",
        ]);
        command.arg(plan.out.join("mcap"));
        if let Some((_, address)) = &self.teacher {
            command.args(["--teacher", address]);
        }
        command.stdout(Stdio::null()).spawn().with_context(|| format!("cannot start {name}"))
    }

    /// Starts a service and waits for the line that says where it listens.
    async fn service(
        &self,
        role: &str,
        args: &[std::ffi::OsString],
    ) -> anyhow::Result<(Child, String)> {
        let mut command = self.command()?;
        let mut child = command
            .args(args)
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start the {role}"))?;
        let output =
            child.stdout.take().ok_or_else(|| anyhow!("the {role} has no standard output"))?;
        let mut line = String::new();
        BufReader::new(output).read_line(&mut line).await?;
        match line.trim().strip_prefix("listening on ") {
            Some(address) => Ok((child, address.to_owned())),
            None => {
                let status = child.wait().await?;
                bail!(
                    "the {role} ended ({status}) before it listened: {}",
                    last_words(&self.log_path)
                )
            }
        }
    }

    fn command(&self) -> anyhow::Result<Command> {
        let mut command = Command::new(&self.program);
        // A process group of their own: Ctrl-C reaches this process alone, which then ends them in order.
        command
            .process_group(0)
            .kill_on_drop(true)
            .stdin(Stdio::piped())
            .stderr(self.log.try_clone()?);
        Ok(command)
    }
}

/// Waits for a child whose standard input is closed, and kills it when it takes too long.
async fn end_within(mut child: Child, deadline: Duration) {
    drop(child.stdin.take());
    if tokio::time::timeout(deadline, child.wait()).await.is_err() {
        drop(child.kill().await);
    }
}

/// `VmHWM` of a process, MiB; 0 when it is gone or the system keeps no such account.
fn peak_resident_mib(child: &Child) -> u64 {
    let status =
        child.id().and_then(|pid| std::fs::read_to_string(format!("/proc/{pid}/status")).ok());
    let status = status.unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kib = line.and_then(|line| line.split_whitespace().next()?.parse::<u64>().ok());
    kib.unwrap_or(0) / 1024
}

/// The last line of the log, which is what a dying process says.
fn last_words(log: &Path) -> String {
    let text = std::fs::read_to_string(log).unwrap_or_default();
    text.lines().last().unwrap_or("it said nothing").to_owned()
}
