//! Whole runs from the command line, with signals sent to their processes.

use std::collections::BTreeSet;
use std::fs;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::LazyLock;
use std::time::Duration;

use serde_json::Value;
use tempfile::TempDir;

/// A small advised run whose budget runs out on the way.
const SMALL: [&str; 20] = [
    "--set",
    "rounds.rollouts=1",
    "--set",
    "rounds.updates_per_env_step=0.15",
    "--set",
    "ddpg.n_hidden=32",
    "--set",
    "evaluation.episodes=8",
    "--set",
    "evaluation.test_episodes=8",
    "--set",
    "evaluation.every_env_steps=2000",
    "--set",
    "checkpoint.every_rounds=3",
    "--set",
    "advice.budget=300",
    "--set",
    "world.substeps=10",
    "--set",
    "ddpg.batch_size=64",
];

fn tandem(args: &[&str], out: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(args).arg("--out").arg(out).current_dir(env!("CARGO_MANIFEST_DIR"));
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// Environment steps of a run of 12 rounds.
const SHORT: &str = "4800";
/// Environment steps of a run of 48 rounds, for disturbances that take time.
const LONG: &str = "19200";

fn start(workers: &str, out: &Path) -> Child {
    start_with(workers, SHORT, &[], out)
}

fn start_with(workers: &str, env_steps: &str, more: &[&str], out: &Path) -> Child {
    let mut args = vec!["train", "--json", "--workers", workers, "--max-env-steps", env_steps];
    args.extend(SMALL);
    args.extend(more);
    tandem(&args, out).spawn().expect("starts")
}

/// Resumes a run and waits for its end.
fn resume(out: &Path) -> Output {
    tandem(&["train", "--json", "--resume", "--workers", "2"], out).output().expect("runs")
}

/// The digest and metrics of an undisturbed run of 12 rounds.
static UNDISTURBED: LazyLock<(String, Vec<Value>)> = LazyLock::new(|| undisturbed(SHORT));

/// Returns the digest and metrics of an undisturbed run.
fn undisturbed(env_steps: &str) -> (String, Vec<Value>) {
    let (_keep, out) = run_directory();
    let digest = digest(&finish(start_with("2", env_steps, &[], &out)));
    (digest, metrics(&out))
}

/// Reads the rows of a run's metrics, without the wall time.
fn metrics(out: &Path) -> Vec<Value> {
    let text = fs::read_to_string(out.join("metrics.jsonl")).expect("metrics");
    let row = |line| -> Value {
        let mut row: Value = serde_json::from_str(line).expect("a row");
        row.as_object_mut().expect("an object").remove("wall_s").expect("a time");
        row
    };
    text.lines().map(row).collect()
}

fn check_undisturbed_result(ended: &Output, out: &Path) {
    check_result(ended, out, &UNDISTURBED);
}

fn check_result(ended: &Output, out: &Path, undisturbed: &(String, Vec<Value>)) {
    assert_eq!(digest(ended), undisturbed.0);
    assert_eq!(metrics(out), undisturbed.1);
    let summary = fs::read_to_string(out.join("summary.json")).expect("a summary");
    let printed = String::from_utf8_lossy(&ended.stdout);
    assert_eq!(printed.lines().last(), Some(summary.trim_end()));
}

/// Returns the page of metrics at `address`; empty while nothing listens there.
fn page(address: SocketAddr) -> String {
    let mut text = String::new();
    if let Ok(mut stream) = TcpStream::connect(address) {
        drop(stream.write_all(b"GET /metrics HTTP/1.1\r\nhost: a\r\nconnection: close\r\n\r\n"));
        drop(stream.read_to_string(&mut text));
    }
    text
}

/// Returns the standard error of a run.
fn stderr(ended: &Output) -> String {
    String::from_utf8_lossy(&ended.stderr).into_owned()
}

fn finish(child: Child) -> Output {
    child.wait_with_output().expect("ends")
}

fn digest(output: &Output) -> String {
    let text = String::from_utf8_lossy(&output.stdout);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{:?}: {errors}", output.status);
    let summary = text.lines().last().expect("a summary");
    let after = summary.split("\"digest\":\"").nth(1).expect("a digest");
    after.split('"').next().expect("its end").to_owned()
}

fn signal(signal: &str, pid: u32) {
    let sent = Command::new("kill").args([signal, &pid.to_string()]).status().expect("kill runs");
    assert!(sent.success(), "no process {pid}");
}

/// Returns the process ids of a run's children whose first argument is `role`.
fn pids(parent: u32, role: &str) -> Vec<u32> {
    let children =
        fs::read_to_string(format!("/proc/{parent}/task/{parent}/children")).unwrap_or_default();
    let is_role = |pid: &u32| {
        let line = fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        line.split('\0').nth(1) == Some(role)
    };
    children.split_whitespace().filter_map(|pid| pid.parse().ok()).filter(is_role).collect()
}

/// Kills a process of a run and waits until it is restarted.
fn kill_one(run: &Child, role: &str) {
    let former = pids(run.id(), role);
    signal("-KILL", former[0]);
    let is_back = || pids(run.id(), role).iter().any(|pid| !former.contains(pid));
    assert!(eventually(is_back), "the {role} was not restarted");
}

/// Waits until the run has written its first checkpoint.
fn wait_for_checkpoint(out: &Path) {
    let is_saved = || !checkpoints(out).is_empty();
    assert!(eventually(is_saved), "no checkpoint within a minute in {}", out.display());
}

fn checkpoints(out: &Path) -> Vec<PathBuf> {
    let saved = fs::read_dir(out.join("checkpoint")).into_iter().flatten().flatten();
    let is_whole = |path: &PathBuf| path.extension().is_some_and(|e| e == "safetensors");
    saved.map(|entry| entry.path()).filter(is_whole).collect()
}

/// Polls `holds` every 50 ms for up to a minute.
fn eventually(holds: impl Fn() -> bool) -> bool {
    (0..1200).any(|_| {
        std::thread::sleep(Duration::from_millis(50));
        holds()
    })
}

fn run_directory() -> (TempDir, PathBuf) {
    let keep = tempfile::tempdir().expect("a directory");
    let out = keep.path().join("run");
    (keep, out)
}

#[test]
fn an_interrupted_run_resumes_to_the_same_result() {
    let (_keep, out) = run_directory();
    let run = start("1", &out);
    wait_for_checkpoint(&out);
    signal("-INT", run.id());
    let interrupted = finish(run);
    assert_eq!(interrupted.status.code(), Some(130));
    let message = stderr(&interrupted);
    assert!(message.contains("tandem train --resume --out"), "{message}");
    let (code, _, message) = status(&out);
    assert_eq!(code, Some(75), "{message}");
    assert!(message.contains("(saved after round") && message.contains("train --resume --out"));
    check_undisturbed_result(&resume(&out), &out);
    let (code, shown, message) = status(&out);
    assert_eq!((code, message.as_str()), (Some(0), ""), "{shown}");
    assert!(shown.contains("shared-push with 2 arms, strategy") && shown.contains("best success"));
    assert!(shown.ends_with("ended: complete\n"), "{shown}");
    let (code, listed, _) = status(out.parent().expect("a parent"));
    assert_eq!(code, Some(0));
    assert!(listed.contains("run  complete  ") && listed.contains("success"), "{listed}");
    let _lock = tandem_system::DirectoryLock::try_take(&out).expect("a directory").expect("free");
    let (code, shown, message) = status(&out);
    assert_eq!((code, shown.as_str()), (Some(75), ""), "{message}");
    assert!(message.contains("its run is starting or ending: try again"), "{message}");
}

#[test]
fn a_run_that_is_signalled_twice_at_once_is_saved() {
    let (_keep, out) = run_directory();
    let mut run = start_with("1", LONG, &["--set", "checkpoint.every_rounds=1000"], &out);
    let n_evaluations =
        || fs::read_to_string(out.join("metrics.jsonl")).map(|text| text.lines().count());
    assert!(eventually(|| n_evaluations().is_ok_and(|n| n >= 2)));
    assert!(checkpoints(&out).is_empty());
    signal("-INT", run.id());
    let mut messages = BufReader::new(run.stderr.take().expect("piped")).lines();
    let is_interrupted = |line: std::io::Result<String>| {
        line.is_ok_and(|line| line.starts_with("interrupted: saving"))
    };
    assert!(messages.any(is_interrupted));
    signal("-INT", run.id());
    drop(std::thread::spawn(move || messages.for_each(drop)));
    let interrupted = finish(run);
    assert_eq!(interrupted.status.code(), Some(130), "{}", stderr(&interrupted));
    assert_eq!(checkpoints(&out).len(), 1, "{}", stderr(&interrupted));
}

#[test]
fn killed_processes_are_restarted_and_the_run_ends_like_an_undisturbed_one() {
    let (_keep, out) = run_directory();
    let occupied = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = occupied.local_addr().expect("bound");
    let served = ["--metrics-listen", &address.to_string()];
    for option in ["--metrics-listen", "--live"] {
        let refused = finish(start_with("3", LONG, &[option, &address.to_string()], &out));
        assert_eq!(refused.status.code(), Some(75));
        assert!(stderr(&refused).contains(&format!("cannot listen on {address}")));
        assert!(!out.exists(), "a refusal leaves nothing");
    }
    drop(occupied);

    let run = start_with("3", LONG, &served, &out);
    wait_for_checkpoint(&out);
    let workers = pids(run.id(), "worker");
    assert_eq!(workers.len(), 3);
    signal("-STOP", workers[2]);
    for role in ["learner", "teacher", "worker"] {
        kill_one(&run, role);
    }
    let is_served = || page(address).contains("tandem_rounds_total");
    assert!(eventually(is_served), "the new learner serves no metrics");
    let ended = finish(run);
    check_result(&ended, &out, &undisturbed(LONG));
    let messages = stderr(&ended);
    for line in [
        "the learner was killed by signal 9 and is restarted",
        "the learner continues from round",
        "the teacher was killed by signal 9 and is restarted",
        "was killed by signal 9 and is restarted",
    ] {
        assert!(
            messages.lines().any(|message| message.contains(line)),
            "{line:?} is not in {messages}"
        );
    }
    let summary = String::from_utf8_lossy(&ended.stdout);
    assert!(summary.contains("\"env_steps\":19200,"), "{summary}");
}

#[test]
fn a_learner_that_dies_before_its_first_checkpoint_starts_over() {
    let (_keep, out) = run_directory();
    let run = start_with("2", SHORT, &["--set", "checkpoint.every_rounds=1000"], &out);
    // Workers start once the learner listens.
    let is_under_way = || !pids(run.id(), "worker").is_empty();
    assert!(eventually(is_under_way));
    kill_one(&run, "learner");
    let ended = finish(run);
    check_undisturbed_result(&ended, &out);
    assert!(stderr(&ended).contains("the learner continues from round 0"), "{}", stderr(&ended));
}

#[test]
fn briefly_stopped_processes_are_not_restarted() {
    let (_keep, out) = run_directory();
    let run = start("2", &out);
    wait_for_checkpoint(&out);
    for role in ["learner", "teacher", "worker"] {
        let pid = pids(run.id(), role)[0];
        signal("-STOP", pid);
        std::thread::sleep(Duration::from_millis(700));
        signal("-CONT", pid);
    }
    let ended = finish(run);
    check_undisturbed_result(&ended, &out);
    assert!(!stderr(&ended).contains("restarted"), "{}", stderr(&ended));
}

#[test]
fn a_run_gives_up_on_a_process_that_keeps_dying() {
    let (_keep, out) = run_directory();
    let mut run = start("2", &out);
    wait_for_checkpoint(&out);
    let mut killed = BTreeSet::new();
    while run.try_wait().expect("waits").is_none() {
        if let Some(pid) = pids(run.id(), "teacher").first()
            && killed.insert(*pid)
        {
            signal("-KILL", *pid);
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    // The first teacher may have lived so long that its death does not count.
    assert!((5..=6).contains(&killed.len()), "{} teachers were killed", killed.len());
    let given_up = finish(run);
    assert_eq!(given_up.status.code(), Some(75));
    let messages = stderr(&given_up);
    let last = messages.lines().last().expect("a line");
    assert!(last.contains("the teacher died 5 times in a row"), "{messages}");
    assert!(last.contains("tandem train --resume --out"), "{messages}");
    check_undisturbed_result(&resume(&out), &out);
}

#[test]
fn a_run_whose_teacher_does_not_respond_can_be_interrupted() {
    let (_keep, out) = run_directory();
    let run = start("1", &out);
    wait_for_checkpoint(&out);
    signal("-STOP", pids(run.id(), "teacher")[0]);
    std::thread::sleep(Duration::from_millis(500));
    signal("-INT", run.id());
    let interrupted = finish(run);
    assert_eq!(interrupted.status.code(), Some(130), "{}", stderr(&interrupted));
    assert!(
        stderr(&interrupted).contains("tandem train --resume --out"),
        "{}",
        stderr(&interrupted)
    );
    check_undisturbed_result(&resume(&out), &out);
}

#[test]
fn a_learner_that_cannot_continue_ends_the_run_with_its_error_message() {
    let (_keep, out) = run_directory();
    let run = start("1", &out);
    wait_for_checkpoint(&out);
    let learner = pids(run.id(), "learner")[0];
    signal("-STOP", learner);
    for checkpoint in checkpoints(&out) {
        fs::write(checkpoint, "no checkpoint").expect("writable");
    }
    signal("-KILL", learner);
    let ended = finish(run);
    let messages = stderr(&ended);
    assert_eq!(ended.status.code(), Some(65), "{messages}");
    assert_eq!(messages.matches("restarted").count(), 1, "{messages}");
    let last = messages.lines().last().expect("a line");
    assert!(last.contains("the learner ended with exit code 65: checkpoint"), "{messages}");
}

/// Returns exit code, standard output and standard error of `tandem status` of a run directory.
fn status(out: &Path) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    let ended = command.arg("status").arg(out).stdin(Stdio::null()).output().expect("runs");
    (ended.status.code(), String::from_utf8_lossy(&ended.stdout).into_owned(), stderr(&ended))
}

#[test]
fn a_run_directory_leads_to_the_learner_of_its_run_and_to_no_other_program() {
    let (_keep, out) = run_directory();
    let mut run = start_with("1", LONG, &[], &out);
    let is_shown = || {
        let (code, text, _) = status(&out);
        code == Some(0) && text.contains("shared-push with 2 arms")
    };
    assert!(eventually(is_shown), "{:?}", status(&out));
    kill_one(&run, "learner");
    assert!(eventually(is_shown), "the restarted learner: {:?}", status(&out));
    signal("-KILL", run.id());
    run.wait().expect("the run has ended");
    // Another service listens at an address that a killed run has left.
    let other = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = other.local_addr().expect("bound").to_string();
    fs::write(out.join("in-use/learner"), address).expect("the file is there");
    let (code, _, message) = status(&out);
    assert_eq!(code, Some(75), "{message}");
    assert!(message.contains("no learner of a `tandem train` is running in"), "{message}");
}

#[test]
fn a_watcher_follows_a_run_across_restarts_and_reports_its_interruption() {
    let (_keep, out) = run_directory();
    let run = start_with("1", LONG, &[], &out);
    let is_shown = || status(&out).0 == Some(0);
    assert!(eventually(is_shown), "{:?}", status(&out));
    let mut watcher = Command::new(env!("CARGO_BIN_EXE_tandem"));
    watcher.arg("status").arg(&out).arg("--watch").stdin(Stdio::null());
    let mut watcher =
        watcher.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("starts");
    let lines = BufReader::new(watcher.stdout.take().expect("piped")).lines();
    // The reader of the lines runs on, so that the watcher is never blocked.
    let (sender, first) = std::sync::mpsc::channel();
    let lines = lines.map_while(Result::ok);
    let reader = std::thread::spawn(move || lines.for_each(|line| drop(sender.send(line))));
    first.recv().expect("the watcher has reached the learner");
    kill_one(&run, "learner");
    assert!(eventually(is_shown), "the restarted learner: {:?}", status(&out));
    assert!(watcher.try_wait().expect("a child").is_none(), "the watcher waits for the restart");
    let mut further = std::iter::from_fn(|| first.recv_timeout(Duration::from_mins(2)).ok());
    let is_restart = |line: String| line.starts_with("the learner continues from round ");
    assert!(further.any(is_restart), "the restart is printed");
    signal("-INT", run.id());
    assert_eq!(finish(run).status.code(), Some(130));
    let watched = finish(watcher);
    reader.join().expect("reads to the end");
    assert_eq!(watched.status.code(), Some(75), "{}", stderr(&watched));
}

#[test]
fn children_end_when_their_parent_is_killed() {
    let (_keep, out) = run_directory();
    let mut run = start("1", &out);
    wait_for_checkpoint(&out);
    let learner = pids(run.id(), "learner")[0];
    signal("-KILL", run.id());
    run.wait().expect("the run has ended");
    let is_gone = || {
        let state = fs::read_to_string(format!("/proc/{learner}/stat")).unwrap_or_default();
        state.is_empty() || state.contains(") Z ")
    };
    assert!(eventually(is_gone), "the learner outlived its parent");
}

#[test]
fn services_print_their_address_and_end_on_sigterm() {
    let policy = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/teacher-push.safetensors");
    let mut teacher = Command::new(env!("CARGO_BIN_EXE_tandem"))
        .args(["teacher", "--ledger", "memory", "--policy"])
        .arg(policy)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("starts");
    let mut line = String::new();
    let mut output = BufReader::new(teacher.stdout.take().expect("piped"));
    std::io::BufRead::read_line(&mut output, &mut line).expect("a line");
    let address = line.trim().strip_prefix("listening on ").expect("the line").to_owned();
    assert!(TcpStream::connect(&address).is_ok(), "{address}");
    let taken = Command::new(env!("CARGO_BIN_EXE_tandem"))
        .args([
            "learner",
            "--run",
            "no-such-run.toml",
            "--out",
            "/nonexistent",
            "--listen",
            &address,
        ])
        .output()
        .expect("runs");
    assert_eq!(
        taken.status.code(),
        Some(64),
        "a missing run file is reported before a port in use"
    );
    signal("-TERM", teacher.id());
    assert!(teacher.wait().expect("ends").success());
}
