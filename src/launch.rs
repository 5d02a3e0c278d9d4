//! Child processes: starting them, reading the address of a service, and ending them.
//!
//! A child watches its standard input and exits, saved, when that closes, so the children exit with this process,
//! however it ends. Each child has its own process group: Ctrl-C reaches this process only, which then ends its
//! children in order.

mod log;

use std::ffi::OsString;
use std::fmt;
use std::os::unix::process::ExitStatusExt as _;
use std::path::PathBuf;
use std::process::{ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow};
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::process::{Child, ChildStdin, ChildStdout, Command};

use crate::{clock, program};
pub(crate) use log::{ProcessLog, last_line};

/// Starts processes of one program whose standard error goes to one log.
pub(crate) struct Launcher {
    program: PathBuf,
    /// The name under which processes are started.
    name: OsString,
    log: ProcessLog,
}

impl Launcher {
    /// Launches this program.
    pub(crate) fn new(log: ProcessLog) -> anyhow::Result<Self> {
        let program = program::file().context("cannot find this program's own file")?;
        Ok(Self { program, name: program::name(), log })
    }

    /// Launches another build of this program.
    pub(crate) fn with_program(program: PathBuf, log: ProcessLog) -> Self {
        Self { name: program.clone().into(), program, log }
    }

    pub(crate) const fn log(&self) -> &ProcessLog {
        &self.log
    }

    /// Starts a process. Children listen on loopback addresses and are called without a token, so they do not inherit
    /// the variables that name a token or a ledger.
    pub(crate) fn spawn(&self, args: &[OsString], stdout: Stdio) -> anyhow::Result<ChildProcess> {
        let log_offset = self.log.n_bytes();
        let child = Command::new(&self.program)
            .arg0(&self.name)
            .args(args)
            .process_group(0)
            .kill_on_drop(true)
            .env_remove("TANDEM_TOKEN_FILE")
            .env_remove("TANDEM_LEDGER")
            .stdin(Stdio::piped())
            .stdout(stdout)
            .stderr(self.log.try_clone()?)
            .spawn()?;
        Ok(ChildProcess { child, started_at: clock::now(), log_offset })
    }
}

/// A process that exits when its standard input closes, and is killed when this value is dropped.
pub(crate) struct ChildProcess {
    child: Child,
    started_at: Instant,
    log_offset: u64,
}

impl ChildProcess {
    /// Returns the process number, or `None` once the process has been waited for.
    pub(crate) fn pid(&self) -> Option<u32> {
        self.child.id()
    }

    /// Returns the time since the start.
    pub(crate) fn uptime(&self) -> Duration {
        clock::now().saturating_duration_since(self.started_at)
    }

    /// Returns the size that the log had at the start.
    pub(crate) const fn log_offset(&self) -> u64 {
        self.log_offset
    }

    /// Returns how the process ended, or `None` while it runs.
    pub(crate) fn try_wait(&mut self) -> anyhow::Result<Option<ProcessEnd>> {
        let status = self.child.try_wait().context("cannot wait for a process")?;
        Ok(status.map(ProcessEnd::from))
    }

    /// Waits until the process ends. Standard input stays open.
    pub(crate) async fn wait(&mut self) -> anyhow::Result<ExitStatus> {
        self.child.wait().await.context("cannot wait for a process")
    }

    /// Closes the pipe to standard input when the returned value is dropped, which asks the process to exit.
    pub(crate) fn take_input(&mut self) -> Option<ChildStdin> {
        self.child.stdin.take()
    }

    /// Returns the pipe from standard output, which the caller must have requested at the start.
    pub(crate) fn take_output(&mut self) -> anyhow::Result<ChildStdout> {
        self.child.stdout.take().ok_or_else(|| anyhow!("no pipe from standard output"))
    }

    /// Reads the address of a service from the line `listening on ADDR`; `None` if the process does not print it.
    pub(crate) async fn service_address(&mut self) -> anyhow::Result<Option<String>> {
        let [address] = self.lines().await?;
        Ok(address.strip_prefix("listening on ").map(str::to_owned))
    }

    /// Reads the address of a service and, with `has_dashboard`, the line about its dashboard; `None` if the process does
    /// not print its address.
    pub(crate) async fn addresses(
        &mut self,
        has_dashboard: bool,
    ) -> anyhow::Result<Option<ServiceAddresses>> {
        if !has_dashboard {
            let service = self.service_address().await?;
            return Ok(service.map(|service| ServiceAddresses { service, dashboard_line: None }));
        }
        let [address, line] = self.lines().await?;
        let dashboard_line = Some(line).filter(|line| !line.is_empty());
        let service = address.strip_prefix("listening on ").map(str::to_owned);
        Ok(service.map(|service| ServiceAddresses { service, dashboard_line }))
    }

    /// Reads the first lines of standard output; a line that the process does not print is empty.
    async fn lines<const N: usize>(&mut self) -> anyhow::Result<[String; N]> {
        let mut output = BufReader::new(self.take_output()?);
        let mut lines = [const { String::new() }; N];
        for line in &mut lines {
            output.read_line(line).await?;
            line.truncate(line.trim_end().len());
        }
        Ok(lines)
    }

    /// Asks the process to exit and waits for it; kills it after `deadline`. Returns how it ended by itself.
    pub(crate) async fn end(mut self, deadline: Duration) -> Option<ProcessEnd> {
        drop(self.take_input());
        let ended = tokio::time::timeout(deadline, self.child.wait()).await;
        if ended.is_err() {
            drop(self.child.kill().await);
        }
        ended.ok()?.ok().map(ProcessEnd::from)
    }
}

/// The lines that a service prints when it is ready.
#[derive(Debug)]
pub(crate) struct ServiceAddresses {
    /// The address of the service.
    pub(crate) service: String,
    /// The line about its dashboard, which ends with its URL if there is one.
    pub(crate) dashboard_line: Option<String>,
}

/// The end of a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ProcessEnd {
    /// With this exit code.
    Code(i32),
    /// By this signal.
    Signal(i32),
}

impl From<ExitStatus> for ProcessEnd {
    fn from(status: ExitStatus) -> Self {
        let signal = || Self::Signal(status.signal().unwrap_or_default());
        status.code().map_or_else(signal, Self::Code)
    }
}

impl fmt::Display for ProcessEnd {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Code(0) => write!(formatter, "ended before the run"),
            Self::Code(code) => write!(formatter, "ended with exit code {code}"),
            Self::Signal(signal) => write!(formatter, "was killed by signal {signal}"),
        }
    }
}
