//! A server of environments that a worker starts with a command, and the guard that ends it with the worker.
//!
//! The worker starts `tandem env-guard`, which starts the command in a process group of its own. The guard ends this
//! group when its standard input closes, which happens however the worker ends.

use std::ffi::OsString;
use std::os::unix::process::ExitStatusExt as _;
use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process_group};
use tandem_worker::{EnvironmentServer, ServerAddress, ServerNotStarted};
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, BufReader};
use tokio::process::{Child, ChildStdout, Command};
use tokio::sync::Mutex;

use crate::exit::{Exit, Failed, OrExit as _};
use crate::{program, runtime, signals};

/// The variable with the address on which the command listens.
const LISTEN_VARIABLE: &str = "TANDEM_ENV_LISTEN";
/// The beginning of the line with which the command reports its address.
const LISTENING: &str = "listening on ";
/// The longest line of the command's output that is read as one.
const MAX_LINE_BYTES: u64 = 64 << 10;
/// Time that a process group has to end after SIGTERM.
const GRACE: Duration = Duration::from_secs(3);
/// Time that the guard has to end the command.
const END_TIMEOUT: Duration = Duration::from_secs(5);

/// A server that is started with a command of the shell.
#[derive(Debug)]
pub(crate) struct CommandServer {
    command: String,
    start_timeout: Duration,
    process: Mutex<Option<ServerProcess>>,
}

/// The guard of a running server. The guard ends when its standard input is closed.
#[derive(Debug)]
struct ServerProcess {
    guard: Child,
    address: String,
}

impl CommandServer {
    pub(crate) fn new(command: String, start_timeout: Duration) -> Self {
        Self { command, start_timeout, process: Mutex::default() }
    }

    /// Ends the server, if it runs.
    pub(crate) async fn end(&self) {
        if let Some(process) = self.process.lock().await.take() {
            process.end().await;
        }
    }

    /// Starts the command and waits for the line with its address.
    async fn start(&self) -> Result<ServerProcess, ServerNotStarted> {
        let failed = |reason: String| {
            ServerNotStarted(format!("the environment command {:?} {reason}", self.command))
        };
        let spawned = program::file().and_then(|file| {
            Command::new(file)
                .arg0(program::name())
                .arg("env-guard")
                .arg(&self.command)
                .process_group(0)
                .env(LISTEN_VARIABLE, "127.0.0.1:0")
                .env_remove("TANDEM_TOKEN_FILE")
                .env_remove("TANDEM_LEDGER")
                .stdin(Stdio::piped())
                .stdout(Stdio::piped())
                .spawn()
        });
        let mut guard = spawned.map_err(|error| failed(format!("cannot be started: {error}")))?;
        let output = guard.stdout.take();
        let output = output.ok_or_else(|| failed("has no standard output".to_owned()))?;
        let mut output = BufReader::new(output);
        let address = tokio::time::timeout(self.start_timeout, read_address(&mut output)).await;
        let address = match address {
            Ok(Some(address)) => address,
            Ok(None) => {
                let end = tokio::time::timeout(END_TIMEOUT, wait(&mut guard)).await;
                let end = end.unwrap_or_else(|_elapsed| "closed its standard output".to_owned());
                return Err(failed(format!(
                    "{end} before it printed `{LISTENING}http://HOST:PORT`"
                )));
            }
            Err(_elapsed) => {
                ServerProcess { guard, address: String::new() }.end().await;
                let timeout = self.start_timeout;
                let what = "printed no line `listening on http://HOST:PORT`";
                return Err(failed(format!("{what} within {timeout:?} and was killed")));
            }
        };
        tracing::info!(address, "environment command started");
        tokio::spawn(log_lines(output));
        Ok(ServerProcess { guard, address })
    }
}

impl EnvironmentServer for CommandServer {
    fn address(&self) -> ServerAddress<'_> {
        Box::pin(async move {
            let mut process = self.process.lock().await;
            if let Some(running) = &mut *process
                && matches!(running.guard.try_wait(), Ok(None))
            {
                return Ok(running.address.clone());
            }
            let started = self.start().await?;
            Ok(process.insert(started).address.clone())
        })
    }

    fn address_after_failure(&self) -> ServerAddress<'_> {
        Box::pin(async move {
            self.end().await;
            self.address().await
        })
    }
}

impl ServerProcess {
    /// Asks the guard to end the server, and waits for both.
    async fn end(mut self) {
        drop(self.guard.stdin.take());
        if tokio::time::timeout(END_TIMEOUT, self.guard.wait()).await.is_err() {
            tracing::warn!("the environment command does not end");
        }
    }
}

/// Waits until the guard ends and describes how the command ended.
async fn wait(guard: &mut Child) -> String {
    // Waiting closes standard input, which would make the guard end the command.
    let _open = guard.stdin.take();
    match guard.wait().await.ok().and_then(|status| status.code()) {
        Some(code @ 129..) => format!("ended with exit code {code} (signal {})", code - 128),
        Some(code) => format!("ended with exit code {code}"),
        None => "was killed".to_owned(),
    }
}

/// Returns the address in the first line of the form `listening on ADDR`; `None` if the output ends without one.
async fn read_address(output: &mut BufReader<ChildStdout>) -> Option<String> {
    while let Some(line) = next_line(output).await {
        match line.trim().strip_prefix(LISTENING) {
            Some(address) => return Some(address.to_owned()),
            None => log_line(&line),
        }
    }
    None
}

/// Logs what the server prints, so that it never waits for a reader.
async fn log_lines(mut output: BufReader<ChildStdout>) {
    while let Some(line) = next_line(&mut output).await {
        log_line(&line);
    }
}

/// Returns the next line, whose bytes need not be UTF-8; `None` if the output has ended. A longer line than
/// [`MAX_LINE_BYTES`] is divided.
async fn next_line(output: &mut BufReader<ChildStdout>) -> Option<String> {
    let mut line = Vec::new();
    match output.take(MAX_LINE_BYTES).read_until(b'\n', &mut line).await {
        Ok(0) | Err(_) => None,
        Ok(_) => Some(String::from_utf8_lossy(&line).trim_end().to_owned()),
    }
}

fn log_line(line: &str) {
    tracing::info!(line, "environment command");
}

/// Runs `command` in a process group of its own and ends the group when standard input closes. Returns the exit code of
/// the command, 128 plus the number of the signal if one has killed it.
pub(crate) fn guard(command: OsString) -> Result<u8, Failed> {
    let runtime = runtime::new().or_exit(Exit::TryAgain, String::new)?;
    runtime.block_on(async {
        let shutdown = signals::shutdown_token(true)?;
        let mut child = Command::new("/bin/sh")
            .arg("-c")
            .arg(command)
            .process_group(0)
            .stdin(Stdio::piped())
            .spawn()
            .or_exit(Exit::TryAgain, || "cannot start /bin/sh".to_owned())?;
        let group = child.id().and_then(|id| Pid::from_raw(i32::try_from(id).ok()?));
        // The kernel closes the pipe when this process ends, even if it is killed.
        let _input = child.stdin.take();
        let status = tokio::select! {
            status = child.wait() => status,
            () = shutdown.cancelled() => {
                signal(group, Signal::TERM);
                match tokio::time::timeout(GRACE, child.wait()).await {
                    Ok(status) => status,
                    Err(_elapsed) => {
                        signal(group, Signal::KILL);
                        child.wait().await
                    }
                }
            }
        };
        signal(group, Signal::KILL);
        Ok(exit_code(status.or_exit(Exit::TryAgain, String::new)?))
    })
}

/// Sends a signal to all processes of a group, of which there may be none left.
fn signal(group: Option<Pid>, signal: Signal) {
    if let Some(group) = group {
        kill_process_group(group, signal).ok();
    }
}

fn exit_code(status: ExitStatus) -> u8 {
    let code = status.code().or_else(|| Some(128 + status.signal()?));
    code.and_then(|code| u8::try_from(code).ok()).unwrap_or(u8::MAX)
}
