//! `tandem bridge trial` with the built program.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

const STUDENT: &str = "policies/student-push-classic.safetensors";
const TEACHER: &str = "policies/teacher-push-classic.safetensors";
const GRASPING_TEACHER: &str = "policies/teacher-pick-and-place-classic.safetensors";

fn trial(out: &Path, more: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(["bridge", "trial", "--out"]).arg(out).args(more);
    command.current_dir(env!("CARGO_MANIFEST_DIR")).env_remove("RUST_LOG");
    command.output().expect("runs")
}

fn rows(out: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(out.join("trials.jsonl")).expect("written");
    text.lines().map(|line| serde_json::from_str(line).expect("an object")).collect()
}

#[test]
fn trials_are_evaluated_and_recorded() {
    let dir = tempfile::tempdir().expect("a directory");
    let args = ["--policy", STUDENT, "--composed-teachers", TEACHER, "--trials", "1", "--json"];
    let more = ["--record", "all", "--seed", "2", "--motions", "--rehearsals", "2"];
    let output = trial(dir.path(), &[&args[..], &more].concat());
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let printed: Value = serde_json::from_slice(&output.stdout).expect("one object");
    assert!(printed["trials"].is_object() || printed["trials"].is_array(), "{printed}");
    let rows = rows(dir.path());
    assert_eq!(rows.len(), 2 * 3, "policies, modes");
    for row in &rows {
        let log = dir.path().join(row["log"].as_str().expect("a log"));
        assert!(log.metadata().expect("written").len() > 1000, "{}", log.display());
        let same_start = rows.iter().filter(|other| other["trial"] == row["trial"]);
        assert!(same_start.clone().all(|other| other["goals"] == row["goals"]));
    }
    let is_closed_loop =
        |row: &&Value| row["mode"] == "closed-loop" && row["subject"] == "student-push-classic";
    assert!(rows.iter().filter(is_closed_loop).all(|row| row["success"] == true), "{rows:?}");
    assert!(dir.path().join("report.html").exists());
    let motion = dir.path().join("motions/student-push-classic-twin-0000.json");
    let motion = std::fs::read_to_string(motion).expect("written");
    let motion: Value = serde_json::from_str(&motion).expect("an object");
    assert!(motion["way_points"].as_array().is_some_and(|points| points.len() > 10));
}

#[test]
fn trials_before_a_failure_are_kept() {
    let dir = tempfile::tempdir().expect("a directory");
    std::fs::create_dir_all(dir.path().join("motions/student-push-classic-closed-loop-0003.json"))
        .expect("created");
    let args = ["--policy", STUDENT, "--mode", "closed-loop", "--trials", "8", "--motions"];
    let output = trial(dir.path(), &args);
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(64), "{error}");
    assert!(error.contains("has the first 3 trials") && error.contains("-0003.json"), "{error}");
    let numbers: Vec<_> = rows(dir.path()).iter().map(|row| row["trial"].as_u64()).collect();
    assert_eq!(numbers, [Some(0), Some(1), Some(2)]);
}

#[test]
fn a_directory_belongs_to_one_process_at_a_time() {
    let dir = tempfile::tempdir().expect("a directory");
    let lock = tandem_system::DirectoryLock::try_take(dir.path()).expect("locks").expect("free");
    let args = ["--policy", STUDENT, "--mode", "closed-loop", "--trials", "1"];
    let output = trial(dir.path(), &args);
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(75), "{error}");
    assert!(error.contains("another process uses") && error.lines().count() == 1, "{error}");
    assert!(!dir.path().join("trials.jsonl").exists());

    // Without --out the next directory is taken.
    let first = dir.path().join("runs/trial-push");
    std::fs::create_dir_all(&first).expect("created");
    let first = tandem_system::DirectoryLock::try_take(&first).expect("locks").expect("free");
    let root = env!("CARGO_MANIFEST_DIR");
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(["bridge", "trial", "--policy"]).arg(Path::new(root).join(STUDENT));
    command.args(&args[2..]).current_dir(dir.path()).env_remove("RUST_LOG");
    assert!(command.output().expect("runs").status.success());
    assert_eq!(rows(&dir.path().join("runs/trial-push.2")).len(), 1);
    drop((lock, first));
}

#[test]
fn reports_know_every_cause_of_failure() {
    assert_eq!(tandem_report::trials::CAUSES, tandem_trials::trial::FailureCause::NAMES);
}

#[test]
fn unusable_arguments_are_reported_in_one_line() {
    let dir = tempfile::tempdir().expect("a directory");
    let check = |args: &[&str], code: i32, expected: &str| {
        let output = trial(dir.path(), args);
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{args:?}: {error}");
        assert!(error.contains(expected), "{args:?}: {error}");
        assert!(code == 64 && expected.starts_with("--") || error.lines().count() == 1, "{error}");
    };
    check(&["--policy", TEACHER], 64, "drives 1 arm");
    check(&["--composed-teachers", STUDENT], 64, "a teacher drives one");
    check(&["--policy", STUDENT, "--task", "pick-and-place"], 64, "is for push");
    check(&["--policy", STUDENT, "--block-cm", "20"], 64, "expected 3 to 9");
    check(&["--policy", STUDENT, "--speed", "1e-9"], 64, "expected 0.01 to 1");
    check(&["--policy", STUDENT, "--pad-friction", "nan"], 64, "expected 0 to 2");
    let bar = ["--composed-teachers", GRASPING_TEACHER, "--task", "carry-bar"];
    check(&[&bar[..], &["--block-cm", "5"]].concat(), 64, "keeps its size");
    check(&["--composed-teachers", TEACHER, "--task", "carry-bar"], 64, "not for carry-bar");
    check(&["--policy", "no-such-file"], 65, "no-such-file");
    check(&[], 64, "--policy");
}
