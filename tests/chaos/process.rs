//! The processes of a run: started, killed, stopped and restarted at the same address.

use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::io::{BufRead as _, BufReader};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};

/// A restartable process that is killed on drop.
#[derive(Debug)]
pub(crate) struct Process {
    args: Vec<OsString>,
    log: PathBuf,
    child: Child,
    /// Number of restarts and stops.
    pub(crate) n_interruptions: u32,
}

impl Process {
    /// Starts a process that is not a service.
    pub(crate) fn start(args: Vec<OsString>, log: &Path) -> Self {
        let child = spawn(&args, log, Stdio::null());
        Self { args, log: log.to_owned(), child, n_interruptions: 0 }
    }

    /// Starts a service and waits for its address, which it keeps across restarts.
    pub(crate) fn serve(args: Vec<OsString>, log: &Path) -> (Self, SocketAddr) {
        let mut child = spawn(&args, log, Stdio::piped());
        let output = child.stdout.take().expect("piped");
        let mut line = String::new();
        BufReader::new(output).read_line(&mut line).expect("readable");
        let address = line.trim().strip_prefix("listening on ").map(str::parse);
        let Some(Ok(address)) = address else { panic!("no address in {line:?}") };
        let mut process = Self { args, log: log.to_owned(), child, n_interruptions: 0 };
        process.add_args(["--listen".to_owned(), format!("{address}")]);
        (process, address)
    }

    /// Appends arguments for the next start.
    pub(crate) fn add_args(&mut self, args: impl IntoIterator<Item = String>) {
        self.args.extend(args.into_iter().map(OsString::from));
    }

    /// Replaces the value of an argument for the next start.
    pub(crate) fn set_arg(&mut self, name: &str, value: &str) {
        let position = self.args.iter().position(|arg| arg == name).expect("an argument");
        self.args[position + 1] = value.into();
    }

    /// Kills the process.
    pub(crate) fn kill(&mut self) {
        self.child.kill().expect("a process");
        self.child.wait().expect("ends");
    }

    /// Restarts the process after its end.
    pub(crate) fn restart(&mut self) {
        self.n_interruptions += 1;
        self.child = spawn(&self.args, &self.log, Stdio::null());
    }

    /// Sends a signal, unless the process has ended.
    pub(crate) fn signal(&mut self, signal: &str) {
        if self.ended().is_some() {
            return;
        }
        let pid = self.child.id().to_string();
        let sent = Command::new("kill").args([signal, &pid]).status().expect("kill runs");
        assert!(sent.success(), "no process {pid}");
    }

    /// Returns the exit status if the process has ended.
    pub(crate) fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().expect("a process")
    }

    /// Sends SIGTERM and waits for the end.
    pub(crate) fn end(&mut self) -> ExitStatus {
        self.signal("-TERM");
        self.child.wait().expect("ends")
    }

    /// Returns the last lines of the log.
    pub(crate) fn log_tail(&self) -> String {
        let bytes = std::fs::read(&self.log).unwrap_or_default();
        let text = String::from_utf8_lossy(&bytes);
        let lines: Vec<&str> = text.lines().rev().take(8).collect();
        lines.into_iter().rev().collect::<Vec<_>>().join("\n")
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        drop((self.child.kill(), self.child.wait()));
    }
}

fn spawn(args: &[OsString], log: &Path, stdout: Stdio) -> Child {
    let log: File = OpenOptions::new().create(true).append(true).open(log).expect("a log file");
    // The closed standard input ends the child even if this process is killed.
    Command::new(env!("CARGO_BIN_EXE_tandem"))
        .args(args)
        .arg("--exit-with-stdin")
        .stdin(Stdio::piped())
        .stdout(stdout)
        .stderr(log)
        .spawn()
        .expect("starts")
}
