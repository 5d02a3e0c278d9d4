//! `tandem scene`: the printed episodes are those that `tandem eval` plays.

use std::fs;
use std::process::{Command, Output};

use serde_json::Value;

const TANDEM: &str = env!("CARGO_BIN_EXE_tandem");
const STUDENT: &str = "policies/student-pick-and-place.safetensors";

fn scene(args: &[&str]) -> Output {
    Command::new(TANDEM)
        .arg("scene")
        .args(args)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .env_remove("RUST_LOG")
        .output()
        .expect("runs")
}

fn printed(args: &[&str]) -> Value {
    let output = scene(args);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("JSON")
}

#[test]
fn the_actions_of_a_policy_give_the_same_episode_again() {
    let played =
        printed(&["--policy", STUDENT, "--episodes", "2", "--seed", "5", "--json"])["episodes"]
            .take();
    let actions: Vec<&Value> =
        played.as_array().expect("episodes").iter().map(|episode| &episode["actions"]).collect();
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("actions.json");
    fs::write(&path, serde_json::to_string(&actions).expect("JSON")).expect("writes");
    let path = path.to_str().expect("UTF-8");
    let repeated =
        printed(&["--task", "pick-and-place", "--actions", path, "--seed", "5"])["episodes"].take();
    assert_eq!(played, repeated);
    assert_eq!(played[1]["observations"].as_array().map(Vec::len), Some(51));
}

#[test]
fn without_actions_only_the_starts_are_printed() {
    let scene = printed(&["--task", "push", "--arms", "1", "--episodes", "3", "--seed", "5"]);
    let episodes = scene["episodes"].as_array().expect("episodes");
    assert_eq!(episodes.len(), 3);
    for episode in episodes {
        assert_eq!(episode["observations"].as_array().map(Vec::len), Some(1));
        assert_eq!(episode["goal"].as_array().map(Vec::len), Some(3));
    }
    assert_ne!(episodes[0]["goal"], episodes[1]["goal"]);
    assert_eq!(scene["world"]["arms"].as_array().map(Vec::len), Some(1));
}

#[test]
fn wrong_actions_are_named() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("actions.json");
    let check = |text: &str, code: i32, word: &str| {
        fs::write(&path, text).expect("writes");
        let output = scene(&["--arms", "1", "--actions", path.to_str().expect("UTF-8")]);
        let line = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{line}");
        assert!(line.contains(word) && line.lines().count() == 1, "{line}");
    };
    check("[[[0, 0]]]", 65, "action has 2 numbers, expected 3");
    check("[[0]]", 65, "expected a sequence");
    let output = scene(&["--policy", STUDENT, "--arms", "1"]);
    assert_eq!(output.status.code(), Some(64));
}
