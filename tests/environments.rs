//! Runs whose workers play in the environments of a server, from the command line.

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::LazyLock;
use std::time::Duration;

use serde_json::Value;
use tempfile::TempDir;

/// A small advised run of three rounds.
const SMALL: [&str; 17] = [
    "train",
    "--json",
    "--max-env-steps",
    "2400",
    "--set",
    "rounds.updates_per_env_step=0.05",
    "--set",
    "ddpg.n_hidden=32",
    "--set",
    "evaluation.episodes=4",
    "--set",
    "evaluation.test_episodes=4",
    "--set",
    "evaluation.every_env_steps=1600",
    "--set",
    "world.substeps=10",
    "--workers=2",
];

fn tandem() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.current_dir(env!("CARGO_MANIFEST_DIR")).stdin(Stdio::null());
    command
}

fn train(more: &[&str], out: &Path) -> Output {
    tandem().args(SMALL).args(more).arg("--out").arg(out).output().expect("runs")
}

fn summary(output: &Output) -> Value {
    assert!(output.status.success(), "{:?}: {}", output.status, stderr(output));
    let text = String::from_utf8_lossy(&output.stdout);
    serde_json::from_str(text.lines().last().expect("a line")).expect("an object")
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn run_directory() -> (TempDir, PathBuf) {
    let directory = tempfile::tempdir().expect("a directory");
    let out = directory.path().join("run");
    (directory, out)
}

/// The summary of the run without a server.
static IN_PROCESS: LazyLock<Value> = LazyLock::new(|| {
    let (_keep, out) = run_directory();
    summary(&train(&[], &out))
});

/// `tandem env`, which is killed when this value is dropped.
struct Server {
    child: Child,
    address: String,
}

impl Server {
    fn start(args: &[&str]) -> Self {
        let mut command = tandem();
        command.arg("env").args(args).stdout(Stdio::piped());
        let mut child = command.spawn().expect("starts");
        let mut line = String::new();
        let output = child.stdout.take().expect("a pipe");
        BufReader::new(output).read_line(&mut line).expect("readable");
        let address = line.trim().strip_prefix("listening on ").expect("the contract").to_owned();
        assert!(address.starts_with("http://127.0.0.1:"), "{address}");
        Self { child, address }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.child.kill().ok();
        self.child.wait().ok();
    }
}

/// Writes a script and returns its path.
fn script(directory: &TempDir, name: &str, text: &str) -> String {
    let path = directory.path().join(name);
    fs::write(&path, format!("#!/bin/sh\n{text}\n")).expect("writes");
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).expect("executable");
    path.to_str().expect("UTF-8").to_owned()
}

fn eventually(condition: impl Fn() -> bool) -> bool {
    (0..2400).any(|_| {
        let holds = condition();
        if !holds {
            std::thread::sleep(Duration::from_millis(50));
        }
        holds
    })
}

fn is_running(pid: &str) -> bool {
    // A zombie has no command line.
    fs::read(format!("/proc/{pid}/cmdline")).is_ok_and(|line| !line.is_empty())
}

#[test]
fn a_run_on_a_server_has_the_digest_of_the_same_run_without_it() {
    let server = Server::start(&[]);
    let (_keep, out) = run_directory();
    let result = summary(&train(&["--env", &server.address], &out));
    assert_eq!(result["digest"], IN_PROCESS["digest"]);
    assert_eq!(result["policy_digest"], IN_PROCESS["policy_digest"]);
    assert_eq!(result["environment"], "deterministic within a process (2 episodes played twice)");
    assert_eq!(result["environment_failures"], 0);
    assert_eq!(result["log"].as_str(), out.join("tandem.log").to_str());
    assert!(IN_PROCESS.get("environment").is_none(), "nothing to check in the worker's simulator");
}

#[test]
fn a_run_whose_workers_start_their_servers_has_the_same_digest() {
    let (keep, out) = run_directory();
    let pids = keep.path().join("pids");
    let command =
        format!("echo $$ >> {}; exec '{}' env", pids.display(), env!("CARGO_BIN_EXE_tandem"));
    let result = summary(&train(&["--env-command", &command], &out));
    assert_eq!(result["digest"], IN_PROCESS["digest"]);
    let pids = fs::read_to_string(pids).expect("servers were started");
    assert_eq!(pids.lines().count(), 4, "one to check the task, one per worker, one for the test");
    assert!(eventually(|| !pids.lines().any(is_running)), "servers remain: {pids}");
}

#[test]
fn an_evaluation_on_a_server_gives_the_results_of_one_in_this_process() {
    let server = Server::start(&[]);
    let command = format!("'{}' env", env!("CARGO_BIN_EXE_tandem"));
    let policies = [
        ["--policy", "policies/student-push.safetensors"],
        ["--composed-teachers", "policies/teacher-push.safetensors"],
    ];
    for (policy, environment) in
        policies.into_iter().zip([["--env", &server.address], ["--env-command", &command]])
    {
        let eval = |more: &[&str]| {
            let mut eval = tandem();
            eval.args(["eval", "--json", "--episodes", "20"]).args(policy).args(more);
            let mut result = summary(&eval.output().expect("runs"));
            let values = result.as_object_mut().expect("an object");
            values.remove("steps_per_s");
            let avoidance = values.remove("avoidance_rate");
            assert_eq!(avoidance.is_some(), more.is_empty(), "only the simulator counts it");
            result
        };
        assert_eq!(eval(&environment), eval(&[]), "{policy:?}");
    }
}

#[test]
fn a_server_that_dies_during_a_run_changes_nothing() {
    let (keep, out) = run_directory();
    let (pids, program) = (keep.path().join("pids"), env!("CARGO_BIN_EXE_tandem"));
    let command = format!("echo $$ >> {}; exec '{program}' env", pids.display());
    let mut run = tandem();
    run.args(SMALL).args(["--env-command", &command]).arg("--out").arg(&out);
    let run = run.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("starts");
    let log = || fs::read_to_string(out.join("tandem.log")).unwrap_or_default();
    let kill = |n_before: usize| {
        let started = || fs::read_to_string(&pids).unwrap_or_default();
        let n_connected = || log().matches("environment server connected").count();
        assert!(eventually(|| n_connected() >= n_before), "{}", log());
        let pid = started().lines().last().expect("a server").to_owned();
        Command::new("kill").args(["-KILL", &pid]).status().expect("kill runs");
    };
    kill(2);
    let result = summary(&run.wait_with_output().expect("ends"));
    assert_eq!(result["digest"], IN_PROCESS["digest"]);
    assert!(result["environment_failures"].as_u64() > Some(0), "{result}");
}

#[test]
fn an_address_in_use_is_reported_with_what_to_do() {
    let server = Server::start(&[]);
    let address = server.address.strip_prefix("http://").expect("the contract");
    let refused = tandem().args(["env", "--listen", address]).output().expect("runs");
    assert_eq!(refused.status.code(), Some(75), "{}", stderr(&refused));
    let line = stderr(&refused);
    assert!(line.starts_with(&format!("tandem: cannot listen on {address}: stop the program")));
    assert!(line.contains("choose another --listen") && line.lines().count() == 1, "{line}");
}

#[test]
fn another_task_is_refused_before_anything_is_written() {
    let server = Server::start(&["--arms", "1"]);
    let (_keep, out) = run_directory();
    let refused = train(&["--env", &server.address], &out);
    assert_eq!(refused.status.code(), Some(64), "{}", stderr(&refused));
    let line = stderr(&refused);
    let expected =
        "serves another task than the run's: n_observation is 56 in the run and 28 at the server";
    assert!(line.contains(expected) && line.lines().count() == 1, "{line}");
    assert!(!out.exists());
}

#[test]
fn a_server_with_too_few_environments_is_refused_before_anything_is_written() {
    let server = Server::start(&["--max-environments", "4"]);
    let (_keep, out) = run_directory();
    let refused = train(&["--env", &server.address, "--set", "evaluation.episodes=240"], &out);
    assert_eq!(refused.status.code(), Some(64), "{}", stderr(&refused));
    let line = stderr(&refused);
    let expected =
        "serves 4 environments per stream, a slot has 8 episodes: serve at least 8 (`n` of";
    assert!(line.contains(expected) && line.lines().count() == 1, "{line}");
    assert!(!out.exists());
}

#[test]
fn a_command_that_does_not_serve_is_reported_in_one_line_with_its_status() {
    let directory = tempfile::tempdir().expect("a directory");
    let check = |text: &str, timeout: &str, expected: &str| {
        let (_keep, out) = run_directory();
        let command = script(&directory, "server", text);
        let refused = train(&["--env-command", &command, "--env-timeout-s", timeout], &out);
        assert_eq!(refused.status.code(), Some(64), "{}", stderr(&refused));
        let line = stderr(&refused);
        let last = line.lines().last().unwrap_or_default();
        assert!(last.ends_with(expected) && last.contains(&command), "{line}");
        assert!(!out.exists());
    };
    check(
        "exit 3",
        "60",
        "ended with exit code 3 before it printed `listening on http://HOST:PORT`",
    );
    check(
        "kill -SEGV $$",
        "60",
        "ended with exit code 139 (signal 11) before it printed `listening on http://HOST:PORT`",
    );
    let pid = directory.path().join("pid");
    check(
        &format!("echo $$ > {}; echo warming up; sleep 600", pid.display()),
        "3",
        "printed no line `listening on http://HOST:PORT` within 3s and was killed",
    );
    let pid = fs::read_to_string(pid).expect("it was started");
    assert!(eventually(|| !is_running(pid.trim())), "the silent command remains");
}

#[test]
fn a_killed_worker_leaves_no_server() {
    let directory = tempfile::tempdir().expect("a directory");
    let pids = directory.path().join("pids");
    // The shell and the program behind it are one process group.
    let text = format!(
        "sleep 600 & echo $! >> {0}; echo $$ >> {0}; '{1}' env",
        pids.display(),
        env!("CARGO_BIN_EXE_tandem")
    );
    let command = script(&directory, "server", &text);
    let (_keep, out) = run_directory();
    let mut run = tandem();
    run.args(SMALL).args(["--env-command", &command]).arg("--out").arg(&out);
    let mut run = run.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("starts");
    let started = || fs::read_to_string(&pids).unwrap_or_default();
    // Two processes for the check of the task, and two for each worker.
    assert!(eventually(|| started().lines().count() == 6), "{}", started());
    for pid in children(run.id()) {
        Command::new("kill").args(["-KILL", &pid]).status().expect("kill runs");
    }
    run.kill().expect("killed");
    run.wait().expect("ends");
    assert!(eventually(|| !started().lines().any(is_running)), "processes remain: {}", started());
}

/// Returns the process ids of the children of a process.
fn children(parent: u32) -> Vec<String> {
    let path = format!("/proc/{parent}/task/{parent}/children");
    let children = fs::read_to_string(path).unwrap_or_default();
    children.split_whitespace().map(str::to_owned).collect()
}
