//! Strategy `init:teacher`: the student starts as two copies of the teacher and is given no advice.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

/// A run too short to learn anything: what it can do it was given.
fn train(more: &[&str], out: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(["train", "--strategy", "init:teacher", "--json", "--workers", "2"]);
    command.args(["--max-env-steps", "1600", "--out"]).arg(out);
    for setting in [
        "rounds.updates_per_env_step=0.002",
        "rounds.warmup_env_steps=0",
        "evaluation.every_env_steps=1600",
        "evaluation.episodes=40",
        "evaluation.test_episodes=8",
        "evaluation.recorded_episodes=0",
    ] {
        command.args(["--set", setting]);
    }
    command.args(more).current_dir(env!("CARGO_MANIFEST_DIR"));
    command.output().expect("runs")
}

fn rows(out: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(out.join("metrics.jsonl")).expect("metrics");
    text.lines().map(|line| serde_json::from_str(line).expect("a row")).collect()
}

#[test]
fn a_student_that_starts_as_its_teachers_copies_succeeds_at_once_and_costs_no_advice() {
    let keep = tempfile::tempdir().expect("a directory");
    let out = keep.path().join("run");
    let ended = train(&[], &out);
    assert!(ended.status.success(), "{}", String::from_utf8_lossy(&ended.stderr));
    let rows = rows(&out);
    let last = rows.last().expect("an evaluation");
    // Composed teachers succeed in some 96 of 100 episodes, fresh networks in none.
    assert!(last["success"].as_f64() > Some(0.75), "{last}");
    assert_eq!(last["advice_spent"], 0);
    let log = std::fs::read_to_string(out.join("tandem.log")).expect("a log");
    assert!(!log.contains("ledger opened"), "no teacher is asked: {log}");
}

#[test]
fn sizes_that_cannot_hold_the_copies_are_refused_with_those_that_can() {
    let keep = tempfile::tempdir().expect("a directory");
    let ended = train(&["--set", "ddpg.n_hidden=256"], &keep.path().join("run"));
    let told = String::from_utf8_lossy(&ended.stderr).into_owned();
    assert_eq!(ended.status.code(), Some(64), "{told}");
    assert!(told.contains("ddpg.n_hidden = 512"), "{told}");
}
