//! Real processes: a whole run from the command line, disturbed.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use tempfile::TempDir;

/// A small advised run of 20 rounds.
const SMALL: [&str; 12] = [
    "--max-env-steps",
    "16000",
    "--set",
    "ddpg.n_hidden=32",
    "--set",
    "evaluation.episodes=8",
    "--set",
    "evaluation.every_env_steps=4000",
    "--set",
    "checkpoint.every_rounds=3",
    "--set",
    "advice.budget=3000",
];

fn tandem(args: &[&str], out: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(args).arg("--out").arg(out).current_dir(env!("CARGO_MANIFEST_DIR"));
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn start(workers: &str, out: &Path) -> Child {
    let mut args = vec!["train", "--json", "--workers", workers];
    args.extend(SMALL);
    tandem(&args, out).spawn().expect("starts")
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

/// The process numbers of a run's processes whose command line has `role` as its first argument.
fn pids(parent: u32, role: &str) -> Vec<u32> {
    let children =
        fs::read_to_string(format!("/proc/{parent}/task/{parent}/children")).unwrap_or_default();
    let is_role = |pid: &u32| {
        let line = fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        line.split('\0').nth(1) == Some(role)
    };
    children.split_whitespace().filter_map(|pid| pid.parse().ok()).filter(is_role).collect()
}

/// Waits until the run directory holds a checkpoint: the run is then in full swing.
fn wait_for_checkpoint(out: &Path) {
    let is_saved = || {
        let saved = fs::read_dir(out.join("checkpoint")).into_iter().flatten().flatten();
        saved
            .map(|entry| entry.path())
            .any(|path| path.extension().is_some_and(|e| e == "safetensors"))
    };
    assert!(eventually(is_saved), "no checkpoint within a minute in {}", out.display());
}

/// Looks every 50 ms for a minute whether something has come true.
fn eventually(holds: impl Fn() -> bool) -> bool {
    (0..1200).any(|_| {
        std::thread::sleep(Duration::from_millis(50));
        holds()
    })
}

fn directory() -> (TempDir, PathBuf) {
    let keep = tempfile::tempdir().expect("a directory");
    let out = keep.path().join("run");
    (keep, out)
}

#[test]
fn a_disturbed_run_ends_with_the_bits_of_a_calm_one() {
    let (_keep, out) = directory();
    let calm = digest(&finish(start("2", &out)));

    let (_keep, out) = directory();
    let run = start("3", &out);
    wait_for_checkpoint(&out);
    let workers = pids(run.id(), "worker");
    assert_eq!(workers.len(), 3);
    signal("-KILL", workers[0]);
    signal("-STOP", workers[1]);
    let disturbed = finish(run);
    assert_eq!(digest(&disturbed), calm, "one worker killed and one stopped");

    let (_keep, out) = directory();
    let run = start("1", &out);
    wait_for_checkpoint(&out);
    signal("-INT", run.id());
    let interrupted = finish(run);
    assert_eq!(interrupted.status.code(), Some(130));
    let told = String::from_utf8_lossy(&interrupted.stderr).into_owned();
    assert!(told.contains("tandem train --resume --out"), "{told}");
    let resumed =
        tandem(&["train", "--json", "--resume", "--workers", "2"], &out).output().expect("runs");
    assert_eq!(digest(&resumed), calm, "interrupted and resumed");
}

#[test]
fn children_end_with_their_parent_however_it_dies() {
    let (_keep, out) = directory();
    let mut run = start("1", &out);
    wait_for_checkpoint(&out);
    let learner = pids(run.id(), "learner")[0];
    signal("-KILL", run.id());
    run.wait().expect("is gone");
    let is_gone = || {
        let state = fs::read_to_string(format!("/proc/{learner}/stat")).unwrap_or_default();
        state.is_empty() || state.contains(") Z ")
    };
    assert!(eventually(is_gone), "the learner outlives its parent");
}

#[test]
fn services_say_where_they_listen_and_end_on_sigterm() {
    let policy = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/teacher-push.safetensors");
    let mut teacher = Command::new(env!("CARGO_BIN_EXE_tandem"))
        .args(["teacher", "--policy"])
        .arg(policy)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("starts");
    let mut line = String::new();
    let mut output = std::io::BufReader::new(teacher.stdout.take().expect("piped"));
    std::io::BufRead::read_line(&mut output, &mut line).expect("a line");
    let address = line.trim().strip_prefix("listening on ").expect("the line").to_owned();
    assert!(std::net::TcpStream::connect(&address).is_ok(), "{address}");
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
    assert_eq!(taken.status.code(), Some(64), "a missing run file comes before a taken port");
    signal("-TERM", teacher.id());
    assert!(teacher.wait().expect("ends").success());
}
