//! The built program as a service, and what operators do with it.

use std::io::{BufRead as _, BufReader};
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use serde_json::Value;
use tempfile::TempDir;

/// The causes of stops that a busy machine may produce.
pub(crate) const BUSY: [&str; 6] =
    ["late", "owner-silent", "state-old", "state-stale", "command-lost", "drive-fault"];
/// The limit of every wait, in pauses, sufficient for busy machines.
pub(crate) const MAX_PAUSES: usize = 1200;
pub(crate) const SERVE: [&str; 6] =
    ["bridge", "--driver", "sim", "--listen", "127.0.0.1:0", "--no-dashboard"];
pub(crate) const PAUSE: Duration = Duration::from_millis(50);

/// A bridge process that is killed on drop.
pub(crate) struct Bridge {
    pub(crate) process: Child,
    pub(crate) address: String,
    pub(crate) directory: TempDir,
}

pub(crate) fn tandem(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(args).current_dir(env!("CARGO_MANIFEST_DIR"));
    command.env_remove("TANDEM_TOKEN_FILE").env_remove("RUST_LOG");
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

impl Bridge {
    pub(crate) fn serve(more: &[&str]) -> Self {
        Self::spawn(tandem(&[&SERVE[..], more].concat()).stderr(Stdio::inherit()))
    }

    pub(crate) fn spawn(command: &mut Command) -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        let mut process = command.spawn().expect("starts");
        let mut line = String::new();
        let mut output = BufReader::new(process.stdout.take().expect("piped"));
        output.read_line(&mut line).expect("a line");
        let address = line.trim().strip_prefix("listening on ").expect("an address").to_owned();
        Self { process, address, directory }
    }

    pub(crate) fn command(&self, what: &[&str]) -> Command {
        let args = [&["bridge"], what, &["--connect", &self.address]].concat();
        tandem(&args)
    }

    pub(crate) fn run(&self, what: &[&str]) -> Output {
        self.command(what).output().expect("runs")
    }

    pub(crate) fn json(&self, what: &[&str]) -> Value {
        let output = self.run(&[what, &["--json"]].concat());
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        serde_json::from_slice(&output.stdout).expect("one JSON object")
    }

    pub(crate) fn status(&self) -> Value {
        self.json(&["status"])
    }

    /// Waits until the status is as wanted. Returns `None` if a busy machine has stopped the arms.
    pub(crate) fn eventually(&self, wanted: impl Fn(&Value) -> bool) -> Option<Value> {
        for _ in 0..MAX_PAUSES {
            let status = self.status();
            if wanted(&status) {
                return Some(status);
            }
            if was_busy(&status) {
                return None;
            }
            std::thread::sleep(PAUSE);
        }
        panic!("{}", self.status())
    }

    /// Resets the arms.
    pub(crate) fn reset(&self) {
        for _ in 0..MAX_PAUSES {
            let output = self.run(&["reset"]);
            if output.status.success() || stderr(&output).contains("not stopped but Idle") {
                return;
            }
            assert_eq!(output.status.code(), Some(75), "{}", stderr(&output));
            std::thread::sleep(PAUSE);
        }
        panic!("{}", self.status())
    }

    /// Runs `work` with arms that are not stopped, and repeats it if a busy machine stops them.
    pub(crate) fn with_arms<T>(&self, work: impl Fn() -> Option<T>) -> T {
        for _ in 0..20 {
            self.reset();
            if let Some(done) = work() {
                return done;
            }
        }
        panic!("{}", self.status())
    }

    /// Starts a slow motion. Returns `None` if a busy machine has stopped it.
    pub(crate) fn moving(&self) -> Option<Child> {
        let slowly = ["move", "deploy/first-motion.json", "--speed", "0.05"];
        let mover = self.command(&slowly).spawn().expect("starts");
        let is_under_way = |status: &Value| status["motion"]["played_s"].as_f64() > Some(0.0);
        match self.eventually(is_under_way) {
            Some(_) => Some(mover),
            None => {
                end(mover);
                None
            }
        }
    }
}

impl Drop for Bridge {
    fn drop(&mut self) {
        drop(self.process.kill());
        drop(self.process.wait());
    }
}

pub(crate) fn was_busy(status: &Value) -> bool {
    status["stopped"]["name"].as_str().is_some_and(|name| BUSY.contains(&name))
}

pub(crate) fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

pub(crate) fn end(mut child: Child) {
    drop(child.kill());
    drop(child.wait());
}

pub(crate) fn signal(child: &Child, signal: &str) {
    let sent = Command::new("kill").args([signal, &child.id().to_string()]).status();
    assert!(sent.expect("kill runs").success());
}

pub(crate) fn fails_with(code: i32, output: &Output, expected: &str) {
    let message = stderr(output);
    assert_eq!(output.status.code(), Some(code), "{message}");
    let line = message.lines().last().unwrap_or_default();
    assert!(line.starts_with("tandem: ") && line.contains(expected), "{message}");
}
