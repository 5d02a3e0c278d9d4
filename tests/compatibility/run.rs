//! An unfinished run of an earlier version.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use tandem_core::Task;
use tandem_learner::checkpoint::load_newest;
use tandem_rl::RunConfig;
use tandem_rl::config::{Recipe, former_keys};
use tandem_rl::trainer::Counters;
use toml::Table;

/// Merges the run file's settings over the recipe's, so that settings of later versions have a value. The program
/// treats former keys in the same way, see `a_run_resumes_and_ends_with_the_same_counts`.
fn configuration(run: &Path) -> RunConfig {
    let mut text = fs::read_to_string(run.join("run.toml")).expect("readable");
    let name = |key: &'static str| key.split_once('.').expect("a section").1;
    for (former, current) in former_keys::RENAMED {
        text = text.replace(&format!("\n{} =", name(former)), &format!("\n{} =", name(current)));
    }
    let is_kept = |line: &&str| !former_keys::REMOVED.iter().any(|key| line.starts_with(name(key)));
    let text: Vec<&str> = text.lines().filter(is_kept).collect();
    let settings: Table = text.join("\n").parse().expect("TOML");
    let defaults = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    let mut resolved = Table::try_from(defaults).expect("a table");
    for (key, value) in settings {
        match (resolved.get_mut(&key).and_then(|default| default.as_table_mut()), value) {
            (Some(section), toml::Value::Table(changes)) => section.extend(changes),
            (_, value) => drop(resolved.insert(key, value)),
        }
    }
    resolved.try_into().expect("a configuration")
}

/// Returns the digest of the learning state in the checkpoint's header.
fn digest_in(checkpoint: &Path) -> String {
    let bytes = fs::read(checkpoint).expect("readable");
    let text = String::from_utf8_lossy(&bytes);
    let (_, after) = text.split_once(r#""digest":""#).expect("a digest");
    after.chars().take(64).collect()
}

fn copy_directory(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("made");
    for entry in fs::read_dir(from).expect("readable") {
        let from = entry.expect("readable").path();
        let to = to.join(from.file_name().expect("a name"));
        if from.is_dir() {
            copy_directory(&from, &to);
        } else {
            fs::copy(&from, &to).expect("copied");
        }
    }
}

#[test]
fn a_checkpoint_brings_back_the_state_that_was_saved() {
    for version in super::versions() {
        let run = version.join("run");
        let restored = load_newest(&run.join("checkpoint"), &configuration(&run));
        let restored = restored.expect("readable").expect("a checkpoint");
        let expected = &super::expected(&version)["run"];
        let count = |key: &str| expected[key].as_u64().expect("a count");
        let expected = Counters {
            round: count("round"),
            env_steps: count("env_steps"),
            episodes: count("episodes"),
            updates: count("updates"),
            advice_spent: restored.trainer.counters().advice_spent,
            advice_queries: restored.trainer.counters().advice_queries,
        };
        assert_eq!(restored.trainer.counters(), expected);
        assert!((1..=350).contains(&expected.advice_spent));
        assert_eq!(restored.trainer.digest(), digest_in(&restored.path));
        assert_eq!(restored.resumption.acting.n_hidden, 8);
    }
}

/// Compares counts only, because the learned numbers depend on the processor's matrix kernels.
#[test]
fn a_run_resumes_and_ends_with_the_same_counts() {
    for version in super::versions() {
        let directory = tempfile::tempdir().expect("a directory");
        let run: PathBuf = directory.path().join("run");
        copy_directory(&version.join("run"), &run);
        let output = Command::new(env!("CARGO_BIN_EXE_tandem"))
            .args(["train", "--resume", "--json", "--workers", "1"])
            .args(["--set", "evaluation.test_episodes=8", "--out"])
            .arg(&run)
            .output()
            .expect("runs");
        let (stdout, stderr) =
            (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
        assert!(output.status.success(), "{stderr}");
        let last = stdout.lines().last().expect("a summary");
        let summary: Value = serde_json::from_str(last).expect("JSON");
        let expected = super::read_json(&version.join("run-at-end.json"));
        for key in ["task", "arms", "env_steps", "updates", "advice_spent", "budget_left"] {
            assert_eq!(summary[key], expected[key], "{key}");
        }
        let metrics = fs::read_to_string(run.join("metrics.jsonl")).expect("readable");
        let evaluations = &super::expected(&version)["run"]["evaluated_env_steps"];
        assert_eq!(metrics.lines().count(), evaluations.as_array().expect("a list").len());
    }
}
