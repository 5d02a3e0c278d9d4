//! The processes of a run: started in order, kept alive, ended together.
//!
//! Each child watches its standard input and ends, saved, when that closes; so they end with this process however it
//! dies. Their log lines go to the run's `tandem.log`.

use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::io::{Read as _, Seek as _, SeekFrom, Write as _};
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow};
use tandem_system::process::ResidentMemory;
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::process::{Child, Command};
use tokio::task::JoinSet;

use super::claim::Claim;
use super::display::Display;
use super::in_use;
use super::plan::Plan;
use super::restarts::{End, Restarts, Role, Verdict};
use crate::clock;
use crate::exit::Exit;

/// How long teacher and workers may take to end once the learner has.
const GRACE: Duration = Duration::from_secs(5);

pub(crate) struct Children {
    program: PathBuf,
    log: File,
    log_path: PathBuf,
    /// Where the services listen; they do so again after a restart.
    teacher_address: Option<String>,
    learner_address: String,
    /// The teacher, if there is one, the learner, the workers.
    processes: Vec<Process>,
    peak: Memory,
}

/// Largest resident size of each kind of process, MiB; 0 where there is none or the system does not tell.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Memory {
    pub(crate) learner_mib: u64,
    pub(crate) teacher_mib: u64,
    pub(crate) worker_mib: u64,
}

/// Why a run cannot go on.
#[derive(Debug)]
pub(crate) struct Broken {
    pub(crate) exit: Exit,
    pub(crate) error: anyhow::Error,
}

impl From<anyhow::Error> for Broken {
    fn from(error: anyhow::Error) -> Self {
        Self { exit: Exit::TryAgain, error }
    }
}

/// What there is to tell about the processes.
#[derive(Debug, Default)]
pub(crate) struct News {
    /// One line an event.
    pub(crate) lines: Vec<String>,
    /// Whether the learner was started again.
    pub(crate) learner_restarted: bool,
    /// Whether somebody asked the learner to end, and it did.
    pub(crate) interrupted: bool,
}

struct Process {
    role: Role,
    name: String,
    state: State,
    restarts: Restarts,
    started_at: Instant,
    /// Where its lines in the log begin.
    log_from: u64,
}

enum State {
    Runs(Child),
    Waits { until: Instant, end: End },
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
            teacher_address: None,
            learner_address: String::new(),
            processes: Vec::new(),
            peak: Memory::default(),
        })
    }

    /// Starts teacher, learner and workers, in this order.
    pub(crate) async fn start(&mut self, plan: &Plan, display: &Display) -> Result<(), Broken> {
        if plan.config.advice.asks() {
            let address = self.start_service(Role::Teacher, &teacher_args(plan), display).await?;
            self.teacher_address = Some(address);
        }
        let mut args = self.learner_args(plan, plan.resume);
        args.push("--keep-run-file".into());
        self.learner_address = self.start_service(Role::Learner, &args, display).await?;
        for number in 1..=plan.n_workers {
            let name = format!("worker-{number}");
            let args = self.worker_args(plan, &name);
            self.processes.push(self.spawn(Role::Worker, name, &args, Stdio::null())?);
        }
        Ok(())
    }

    pub(crate) fn learner_address(&self) -> &str {
        &self.learner_address
    }

    /// Looks after the processes: starts again those that have died.
    ///
    /// # Errors
    /// When one has died that is not to be started again.
    pub(crate) fn check(&mut self, plan: &Plan, claim: &Claim) -> Result<News, Broken> {
        let mut news = News::default();
        for idx in 0..self.processes.len() {
            let process = &mut self.processes[idx];
            if let State::Runs(child) = &mut process.state
                && let Some(status) = child.try_wait().context("cannot look after a process")?
            {
                process.has_ended(status, &self.log_path, &mut news)?;
            }
            if let State::Waits { until, end } = process.state
                && until <= clock::now()
            {
                if !claim.is_in_place() {
                    return Err(displaced(plan, &process.name, end));
                }
                news.lines.push(format!("{} {end} and is started again", process.name));
                news.learner_restarted |= process.role == Role::Learner;
                self.start_again(idx, plan)?;
            }
        }
        Ok(news)
    }

    /// The largest sizes seen so far.
    pub(crate) const fn memory(&self) -> Memory {
        self.peak
    }

    /// Looks how large the processes are.
    pub(crate) fn sample_memory(&mut self) {
        for process in &self.processes {
            let State::Runs(child) = &process.state else { continue };
            let peak = match process.role {
                Role::Teacher => &mut self.peak.teacher_mib,
                Role::Learner => &mut self.peak.learner_mib,
                Role::Worker => &mut self.peak.worker_mib,
            };
            let peak_kib = child.id().map_or(0, |pid| ResidentMemory::of(pid).peak_kib);
            *peak = (peak_kib / 1024).max(*peak);
        }
    }

    /// Closes every child's standard input and waits for their end; what then still runs is killed. The learner, which
    /// saves, has until `deadline`; the teacher, whom it settles with, ends after it.
    pub(crate) async fn end(&mut self, deadline: Duration) {
        let mut learner = None;
        let mut teacher = None;
        let mut workers = JoinSet::new();
        for process in self.processes.drain(..) {
            let State::Runs(child) = process.state else { continue };
            match process.role {
                Role::Learner => learner = Some(child),
                Role::Teacher => teacher = Some(child),
                Role::Worker => drop(workers.spawn(end_within(child, GRACE))),
            }
        }
        if let Some(learner) = learner {
            end_within(learner, deadline).await;
        }
        if let Some(teacher) = teacher {
            end_within(teacher, GRACE).await;
        }
        workers.join_all().await;
    }

    /// Starts a service and gives where it listens. One that is killed before it says so is started again.
    async fn start_service(
        &mut self,
        role: Role,
        args: &[OsString],
        display: &Display,
    ) -> Result<String, Broken> {
        let mut restarts = Restarts::new(role);
        loop {
            let started = self.try_start_service(role, args).await?;
            let (process, end) = match started {
                Ok((process, address)) => {
                    self.processes.push(Process { restarts, ..process });
                    return Ok(address);
                }
                Err(ended) => ended,
            };
            let Process { name, started_at, log_from, .. } = process;
            let lived = clock::now().saturating_duration_since(started_at);
            match (end, restarts.ended(end, lived)) {
                (End::Signal(_), Verdict::Again { after }) => {
                    display.say(&format!("{name} {end} and is started again"));
                    tokio::time::sleep(after).await;
                }
                (End::Signal(_), Verdict::GivenUp { n_times }) => {
                    return Err(given_up(&name, n_times, end, &self.log_path, log_from).into());
                }
                _ => {
                    let told = last_words(&self.log_path, log_from);
                    let error = anyhow!("{name} {end}: {told}");
                    return Err(Broken { exit: exit_of(end), error });
                }
            }
        }
    }

    /// Starts a service and waits for the line that says where it listens, or for its end.
    async fn try_start_service(
        &self,
        role: Role,
        args: &[OsString],
    ) -> anyhow::Result<Result<(Process, String), (Process, End)>> {
        let name = format!("the {}", role.name());
        let mut process = self.spawn(role, name, args, Stdio::piped())?;
        let name = &process.name;
        let State::Runs(child) = &mut process.state else {
            return Err(anyhow!("{name} is not running"));
        };
        let output = child.stdout.take().ok_or_else(|| anyhow!("{name} cannot be heard"))?;
        let mut line = String::new();
        let read = BufReader::new(output).read_line(&mut line).await;
        read.with_context(|| format!("{name} cannot be heard"))?;
        match line.trim().strip_prefix("listening on ") {
            Some(address) => Ok(Ok((process, address.to_owned()))),
            None => {
                let status = child.wait().await.context("cannot look after a process")?;
                Ok(Err((process, how_ended(status))))
            }
        }
    }

    /// Starts a process where its predecessor was: others find it there, and nobody has to be told where it listens.
    fn start_again(&mut self, idx: usize, plan: &Plan) -> anyhow::Result<()> {
        let (role, name) = (self.processes[idx].role, self.processes[idx].name.clone());
        let mut args = match role {
            Role::Teacher => teacher_args(plan),
            Role::Learner => self.learner_args(plan, true),
            Role::Worker => self.worker_args(plan, &name),
        };
        let address = match role {
            Role::Teacher => self.teacher_address.as_deref(),
            Role::Learner => Some(self.learner_address.as_str()),
            Role::Worker => None,
        };
        if let Some(address) = address {
            args.extend(["--listen".into(), address.into()]);
        }
        let former = &mut self.processes[idx].restarts;
        let restarts = std::mem::replace(former, Restarts::new(role));
        let process = self.spawn(role, name, &args, Stdio::null())?;
        self.processes[idx] = Process { restarts, ..process };
        Ok(())
    }

    fn learner_args(&self, plan: &Plan, resume: bool) -> Vec<OsString> {
        let mut args: Vec<OsString> =
            vec!["learner".into(), "--exit-with-stdin".into(), "--out-is-locked".into()];
        args.extend(["--run".into(), in_use::settings(&plan.out).into_os_string()]);
        args.extend(["--out".into(), plan.out.clone().into_os_string()]);
        if let Some(address) = &self.teacher_address {
            args.extend(["--teacher".into(), address.into()]);
        }
        if plan.config.advice.starts_from_teacher() {
            args.extend(["--start-from".into(), in_use::teacher(&plan.out).into_os_string()]);
        }
        if resume {
            args.push("--resume".into());
        }
        args
    }

    fn worker_args(&self, plan: &Plan, name: &str) -> Vec<OsString> {
        let mut args: Vec<OsString> =
            vec!["worker".into(), "--exit-with-stdin".into(), "--name".into(), name.into()];
        args.extend(["--connect".into(), self.learner_address.clone().into()]);
        args.extend(["--log-dir".into(), plan.out.join("mcap").into_os_string()]);
        if let Some(address) = &self.teacher_address {
            args.extend(["--teacher".into(), address.into()]);
        }
        args
    }

    fn spawn(
        &self,
        role: Role,
        name: String,
        args: &[OsString],
        stdout: Stdio,
    ) -> anyhow::Result<Process> {
        let log_from = self.log.metadata().map_or(0, |metadata| metadata.len());
        let child = self.command()?.args(args).stdout(stdout).spawn();
        let child = child.with_context(|| format!("cannot start {name}"))?;
        Ok(Process {
            role,
            name,
            state: State::Runs(child),
            restarts: Restarts::new(role),
            started_at: clock::now(),
            log_from,
        })
    }

    fn command(&self) -> anyhow::Result<Command> {
        let mut command = Command::new(&self.program);
        // A process group of their own: Ctrl-C reaches this process alone, which then ends them in order.
        command
            .process_group(0)
            .kill_on_drop(true)
            // They listen on this machine's own addresses only, and this process calls them without a token.
            .env_remove("TANDEM_TOKEN_FILE")
            .env_remove("TANDEM_LEDGER")
            .stdin(Stdio::piped())
            .stderr(self.log.try_clone()?);
        Ok(command)
    }
}

impl Process {
    /// Notes that the process has ended, and decides what follows.
    fn has_ended(&mut self, status: ExitStatus, log: &Path, news: &mut News) -> Result<(), Broken> {
        let end = how_ended(status);
        let lived = clock::now().saturating_duration_since(self.started_at);
        let name = &self.name;
        match self.restarts.ended(end, lived) {
            Verdict::Again { after } => {
                self.state = State::Waits { until: clock::now() + after, end };
                Ok(())
            }
            Verdict::Interrupted => {
                news.interrupted = true;
                Ok(())
            }
            Verdict::Final(exit) => {
                let error = anyhow!("{name} {end}: {}", last_words(log, self.log_from));
                Err(Broken { exit, error })
            }
            Verdict::GivenUp { n_times } => {
                Err(given_up(name, n_times, end, log, self.log_from).into())
            }
        }
    }
}

/// Why a process is not started once more.
fn given_up(name: &str, n_times: u32, end: End, log: &Path, log_from: u64) -> anyhow::Error {
    let error = anyhow!("{name} died {n_times} times in a row; the last time it {end}");
    match end {
        End::Code(_) => anyhow!("{error}: {}", last_words(log, log_from)),
        End::Signal(_) => error,
    }
}

/// Why a process cannot be started again: what it would read and write is not this run.
fn displaced(plan: &Plan, name: &str, end: End) -> Broken {
    let out = plan.out.display();
    let error = anyhow!("{name} {end}, and {out} was moved, removed or replaced");
    Broken { exit: Exit::Usage, error }
}

fn teacher_args(plan: &Plan) -> Vec<OsString> {
    let policy = in_use::teacher(&plan.out).into_os_string();
    let ledger = plan.ledger().into_os_string();
    let mut args: Vec<OsString> = vec!["teacher".into(), "--exit-with-stdin".into()];
    args.extend(["--policy".into(), policy, "--ledger".into(), ledger]);
    args
}

fn how_ended(status: ExitStatus) -> End {
    status.code().map_or_else(|| End::Signal(status.signal().unwrap_or_default()), End::Code)
}

/// The exit code that passes on why a process did not start.
const fn exit_of(end: End) -> Exit {
    match end {
        End::Code(64) => Exit::Usage,
        End::Code(65) => Exit::Data,
        End::Code(70) => Exit::Bug,
        _ => Exit::TryAgain,
    }
}

/// Waits for a child whose standard input is closed, and kills it when it takes too long.
async fn end_within(mut child: Child, deadline: Duration) {
    drop(child.stdin.take());
    if tokio::time::timeout(deadline, child.wait()).await.is_err() {
        drop(child.kill().await);
    }
}

/// What a process said as it ended: the last line from `log_from` on that is meant for a person.
fn last_words(log: &Path, log_from: u64) -> String {
    let mut bytes = Vec::new();
    let read = File::open(log).and_then(|mut log| {
        log.seek(SeekFrom::Start(log_from))?;
        log.read_to_end(&mut bytes)
    });
    let text = if read.is_ok() { String::from_utf8_lossy(&bytes) } else { "".into() };
    let told = text.lines().rev().find_map(|line| line.strip_prefix("tandem: "));
    match told.map_or_else(|| note_silence(log).map(|()| "it did not say why"), Ok) {
        Ok(told) => told.to_owned(),
        Err(error) => {
            format!("it could not say why: {} cannot be written: {error}", log.display())
        }
    }
}

/// Writes to the log that a process ended without a word, which shows whether it could have written one.
fn note_silence(log: &Path) -> std::io::Result<()> {
    let mut log = OpenOptions::new().append(true).open(log)?;
    log.write_all(b"a process ended without saying why\n")
}
