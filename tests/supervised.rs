//! Services under a supervisor that restarts the same command.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::time::Duration;

use serde_json::Value;
use tempfile::TempDir;

/// A small run without advice: 48 rounds of 8 episodes.
const RUN: &str = r#"
    name = "supervised"
    task = "push"
    arms = 2
    advice = { strategy = "none" }
    rounds = { slots = 4, rollouts = 2, updates_per_env_step = 0.1 }
    ddpg = { n_hidden = 32, batch_size = 64 }
    evaluation = { every_env_steps = 3200, episodes = 8, recorded_episodes = 0 }
    checkpoint = { every_rounds = 2 }
    stop = { max_env_steps = 19200 }
"#;

/// A run with a learner and two worker processes, which are killed on drop.
struct Supervised {
    directory: TempDir,
    address: String,
    learner: Child,
    workers: Vec<Child>,
}

impl Supervised {
    fn start() -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        fs::write(directory.path().join("run.toml"), RUN).expect("writable");
        let (learner, address) = learner(directory.path(), "127.0.0.1:0").expect("a port");
        let worker = |number| {
            let mut command = tandem(&["worker", "--connect", &address]);
            log_to(&mut command, &directory.path().join(format!("worker-{number}.log")));
            command.spawn().expect("starts")
        };
        let workers = (0..2).map(worker).collect();
        Self { address, learner, workers, directory }
    }

    fn out(&self) -> PathBuf {
        self.directory.path().join("run")
    }

    /// Restarts the learner as a supervisor does, with the same command and address.
    fn start_learner_again(&mut self) {
        let started = (0..100).find_map(|_| {
            std::thread::sleep(Duration::from_millis(100));
            learner(self.directory.path(), &self.address)
        });
        self.learner = started.expect("its port is free again").0;
    }

    /// Waits for a new checkpoint.
    fn wait_for_checkpoint(&self) {
        let newest = || {
            let saved = fs::read_dir(self.out().join("checkpoint")).into_iter().flatten().flatten();
            saved.map(|entry| entry.file_name()).max()
        };
        let before = newest();
        assert!(eventually(|| newest() > before), "no new checkpoint, {}", self.logs());
    }

    fn status(&self) -> Output {
        tandem(&["status", &self.address, "--json"]).output().expect("runs")
    }

    /// Waits until the learner and the workers end by themselves.
    fn end(&mut self) {
        let ended = end_of(&mut self.learner);
        assert!(ended.is_some_and(|ended| ended.success()), "{ended:?}: {}", self.logs());
        for idx in 0..self.workers.len() {
            let ended = end_of(&mut self.workers[idx]);
            let is_done = ended.is_some_and(|ended| ended.success());
            assert!(is_done, "worker {idx}: {ended:?}: {}", self.logs());
        }
    }

    /// Reads the rows of the run's metrics, without the wall time.
    fn metrics(&self) -> Vec<Value> {
        let text = fs::read_to_string(self.out().join("metrics.jsonl")).expect("metrics");
        let row = |line| {
            let mut row: Value = serde_json::from_str(line).expect("a row");
            row.as_object_mut().expect("an object").remove("wall_s").expect("a time");
            row
        };
        text.lines().map(row).collect()
    }

    /// Returns the contents of the run's files by path.
    fn files(&self) -> BTreeMap<PathBuf, Vec<u8>> {
        let mut files = BTreeMap::new();
        let mut directories = vec![self.out()];
        while let Some(directory) = directories.pop() {
            for entry in fs::read_dir(directory).expect("a directory").flatten() {
                let path = entry.path();
                if path.is_dir() {
                    directories.push(path);
                } else {
                    let content = fs::read(&path).expect("readable");
                    files.insert(path, content);
                }
            }
        }
        files
    }

    /// Starts a learner as for a new run, and returns its exit code and its log.
    fn start_over(&self) -> (Option<i32>, String) {
        let mut command = tandem(&["learner", "--listen", "127.0.0.1:0", "--run"]);
        command.arg(self.directory.path().join("run.toml")).arg("--out").arg(self.out());
        let log = self.directory.path().join("start-over.log");
        log_to(&mut command, &log);
        let mut process = command.spawn().expect("starts");
        let ended = end_of(&mut process);
        drop((process.kill(), process.wait()));
        (ended.and_then(|ended| ended.code()), fs::read_to_string(log).expect("a log"))
    }

    /// Returns the logs of all processes.
    fn logs(&self) -> String {
        let logs = ["learner.log", "worker-0.log", "worker-1.log"];
        let read = |name| fs::read_to_string(self.directory.path().join(name)).unwrap_or_default();
        logs.map(|name| format!("{name}:\n{}", read(name))).join("\n")
    }
}

impl Drop for Supervised {
    fn drop(&mut self) {
        for process in self.workers.iter_mut().chain([&mut self.learner]) {
            drop((process.kill(), process.wait()));
        }
    }
}

fn tandem(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(args).stdin(Stdio::null());
    command
}

fn log_to(command: &mut Command, path: &Path) {
    let log = File::options().create(true).append(true).open(path).expect("a log file");
    command.stderr(log).stdout(Stdio::null());
}

/// Starts the learner of `directory` and returns its address, or `None` if it cannot listen on `listen`.
fn learner(directory: &Path, listen: &str) -> Option<(Child, String)> {
    let mut command = tandem(&["learner", "--start-or-resume", "--listen", listen, "--run"]);
    command.arg(directory.join("run.toml")).arg("--out").arg(directory.join("run"));
    log_to(&mut command, &directory.join("learner.log"));
    let mut process = command.stdout(Stdio::piped()).spawn().expect("starts");
    let mut line = String::new();
    let output = process.stdout.take().expect("piped");
    BufReader::new(output).read_line(&mut line).expect("readable");
    match line.trim().strip_prefix("listening on ") {
        Some(address) => Some((process, address.to_owned())),
        None => {
            assert_eq!(process.wait().expect("ends").code(), Some(75), "printed {line:?}");
            None
        }
    }
}

fn signal(signal: &str, process: &Child) {
    let pid = process.id().to_string();
    assert!(Command::new("kill").args([signal, &pid]).status().expect("kill runs").success());
}

/// Waits up to two minutes for a process to end.
fn end_of(process: &mut Child) -> Option<ExitStatus> {
    (0..2400).find_map(|_| {
        std::thread::sleep(Duration::from_millis(50));
        process.try_wait().expect("a process")
    })
}

/// Polls `holds` every 50 ms for up to two minutes.
fn eventually(holds: impl Fn() -> bool) -> bool {
    (0..2400).any(|_| {
        std::thread::sleep(Duration::from_millis(50));
        holds()
    })
}

/// Interrupts the learner of this command line once it listens, and returns what it has logged.
fn interrupt(command: &str, log: &Path) -> String {
    let program = format!("exec '{}'", env!("CARGO_BIN_EXE_tandem"));
    let mut shell = Command::new("sh");
    shell.args(["-c", &command.replacen("tandem", &program, 1)]).stdin(Stdio::null());
    log_to(&mut shell, log);
    let mut process = shell.stdout(Stdio::piped()).spawn().expect("starts");
    let mut line = String::new();
    let output = process.stdout.take().expect("piped");
    BufReader::new(output).read_line(&mut line).expect("readable");
    let is_listening = line.starts_with("listening on ");
    if is_listening {
        signal("-TERM", &process);
    }
    let ended = end_of(&mut process);
    drop((process.kill(), process.wait()));
    let log = fs::read_to_string(log).expect("a log");
    assert!(is_listening, "{log}");
    assert_eq!(ended.and_then(|ended| ended.code()), Some(130), "{log}");
    log
}

#[test]
fn an_interrupted_learner_prints_the_command_that_resumes_its_run() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = |name: &str| directory.path().join(name);
    fs::write(path("run.toml"), RUN).expect("writable");
    let (run, out) = (path("run.toml"), path("run"));
    let start = format!("tandem learner --run {} --out {}", run.display(), out.display());
    let resume = format!("{start} --resume --threads 1");
    let is_printed = |log: &str| {
        log.contains(&format!("the state after round 0 is saved. Resume with:\n  {resume}\n"))
    };
    let log = interrupt(&format!("{start} --threads 1"), &path("started.log"));
    assert!(log.contains("run interrupted") && !log.contains("run finished"), "{log}");
    assert!(is_printed(&log), "{log}");
    let log = interrupt(&resume, &path("resumed.log"));
    assert!(log.contains("run resumed") && is_printed(&log), "{log}");
}

#[test]
fn the_same_command_starts_and_resumes_a_run() {
    let mut undisturbed = Supervised::start();
    undisturbed.end();
    let mut run = Supervised::start();
    run.wait_for_checkpoint();

    let progress = || -> Value { serde_json::from_slice(&run.status().stdout).expect("JSON") };
    // The first checkpoint may precede the second worker.
    assert!(eventually(|| progress()["workers"].as_array().map(Vec::len) == Some(2)));
    let progress = progress();
    assert_eq!((&progress["task"], &progress["ended"]), (&"push".into(), &false.into()));

    signal("-TERM", &run.learner);
    let interrupted = end_of(&mut run.learner).expect("it ends");
    assert_eq!(interrupted.code(), Some(130), "{}", run.logs());
    let log = fs::read_to_string(run.directory.path().join("learner.log")).expect("a log");
    assert!(log.contains("is saved. The same command resumes the run:\n  tandem learner"), "{log}");
    let away = run.status();
    assert_eq!(away.status.code(), Some(75), "{}", String::from_utf8_lossy(&away.stderr));
    for worker in &mut run.workers {
        assert!(
            worker.try_wait().expect("a process").is_none(),
            "a worker must wait for a learner that was stopped"
        );
    }

    run.start_learner_again();
    run.wait_for_checkpoint();
    signal("-KILL", &run.learner);
    end_of(&mut run.learner).expect("it ends");
    run.start_learner_again();
    run.end();
    assert_eq!(run.metrics(), undisturbed.metrics());

    // A finished run ends again at once without further training.
    run.start_learner_again();
    assert_eq!(end_of(&mut run.learner).expect("it ends").code(), Some(0), "{}", run.logs());
    assert_eq!(run.metrics(), undisturbed.metrics());
    let kept = fs::read_to_string(run.out().join("run.toml")).expect("the settings are kept");
    assert!(kept.contains("name = \"supervised\"") && kept.contains("[replay]"), "{kept}");

    // Without --resume or --start-or-resume, a learner does not overwrite the run.
    let before = run.files();
    let (code, log) = run.start_over();
    assert_eq!(code, Some(64), "{log}");
    assert!(log.contains("holds a run already"), "{log}");
    assert!(run.files() == before, "the files of the run have changed");
}

#[test]
fn resuming_a_run_and_starting_or_resuming_it_exclude_each_other() {
    let both = tandem(&["learner", "--run", "r", "--out", "o", "--resume", "--start-or-resume"]);
    let refused = { both }.output().expect("runs");
    let stderr = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(64), "{stderr}");
    assert!(stderr.contains("cannot be used with"), "{stderr}");
}
