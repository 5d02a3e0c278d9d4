//! The run's processes: started, killed, stopped, started again where they were.

use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::io::{BufRead as _, BufReader};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};

/// A process that can be started again; it is killed when dropped.
#[derive(Debug)]
pub(crate) struct Process {
    args: Vec<OsString>,
    log: PathBuf,
    child: Child,
    /// How often it was started again, or stopped.
    pub(crate) n_upsets: u32,
}

impl Process {
    /// Starts a process that nobody calls.
    pub(crate) fn start(args: Vec<OsString>, log: &Path) -> Self {
        let child = spawn(&args, log, Stdio::null());
        Self { args, log: log.to_owned(), child, n_upsets: 0 }
    }

    /// Starts a service and waits for the line that says where it listens. It will listen there again.
    pub(crate) fn serve(args: Vec<OsString>, log: &Path) -> (Self, SocketAddr) {
        let mut child = spawn(&args, log, Stdio::piped());
        let output = child.stdout.take().expect("piped");
        let mut line = String::new();
        BufReader::new(output).read_line(&mut line).expect("readable");
        let address = line.trim().strip_prefix("listening on ").map(str::parse);
        let Some(Ok(address)) = address else { panic!("no address in {line:?}") };
        let mut process = Self { args, log: log.to_owned(), child, n_upsets: 0 };
        process.add_args(["--listen".to_owned(), format!("{address}")]);
        (process, address)
    }

    /// Appends to the arguments with which it is started again.
    pub(crate) fn add_args(&mut self, args: impl IntoIterator<Item = String>) {
        self.args.extend(args.into_iter().map(OsString::from));
    }

    /// Replaces the value of an argument for the next start.
    pub(crate) fn set_arg(&mut self, name: &str, value: &str) {
        let place = self.args.iter().position(|arg| arg == name).expect("an argument");
        self.args[place + 1] = value.into();
    }

    /// Kills it at once.
    pub(crate) fn kill(&mut self) {
        self.child.kill().expect("a process");
        self.child.wait().expect("ends");
    }

    /// Starts it again after it has ended.
    pub(crate) fn start_again(&mut self) {
        self.n_upsets += 1;
        self.child = spawn(&self.args, &self.log, Stdio::null());
    }

    /// Sends a signal, unless it has ended.
    pub(crate) fn signal(&mut self, signal: &str) {
        if self.ended().is_some() {
            return;
        }
        let pid = self.child.id().to_string();
        let sent = Command::new("kill").args([signal, &pid]).status().expect("kill runs");
        assert!(sent.success(), "no process {pid}");
    }

    /// How it ended, if it has.
    pub(crate) fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().expect("a process")
    }

    /// Asks it to end and waits for that.
    pub(crate) fn end(&mut self) -> ExitStatus {
        self.signal("-TERM");
        self.child.wait().expect("ends")
    }

    /// The last lines of its log.
    pub(crate) fn last_words(&self) -> String {
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
    let log: File =
        OpenOptions::new().create(true).append(true).open(log).expect("a place for logs");
    // It ends with this process even when that is killed: its standard input then closes.
    Command::new(env!("CARGO_BIN_EXE_tandem"))
        .args(args)
        .arg("--exit-with-stdin")
        .stdin(Stdio::piped())
        .stdout(stdout)
        .stderr(log)
        .spawn()
        .expect("starts")
}
