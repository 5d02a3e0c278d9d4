//! The same run file and seed give the same bits for any number of workers, even when the budget runs out.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use serde_json::Value;

/// Strategies, each with a budget that runs out in the middle of the run.
const STRATEGIES: [(&str, u64); 7] = [
    ("ea", 1_300),
    EAMC,
    ("mc-q:0.1", 480),
    ("mc-act:0.1", 1_300),
    JSRL,
    ("rlif:0.1", 480),
    ("ts2c:0.1", 480),
];
const EAMC: (&str, u64) = ("eamc:0.1", 810);
const JSRL: (&str, u64) = ("jsrl:20", 400);
const N_WORKERS: [usize; 4] = [1, 2, 5, 16];
/// Eight rounds of sixteen slots, so that sixteen workers have something to do; the policy is evaluated after each.
const SMALL: [&str; 26] = [
    "--max-env-steps",
    "6400",
    "--set",
    "advice.share=0.3",
    "--set",
    "world.substeps=10",
    "--set",
    "rounds.slots=16",
    "--set",
    "rounds.rollouts=1",
    "--set",
    "rounds.updates_per_env_step=0.05",
    "--set",
    "ddpg.n_hidden=32",
    "--set",
    "ddpg.batch_size=64",
    "--set",
    "evaluation.episodes=2",
    "--set",
    "evaluation.test_episodes=8",
    "--set",
    "evaluation.every_env_steps=800",
    "--set",
    "evaluation.recorded_episodes=0",
    "--set",
    "checkpoint.every_rounds=100",
];

/// The results of a run that must not depend on the number of workers.
#[derive(Debug, PartialEq)]
struct RunResult {
    digest: String,
    best_policy: String,
    /// Rows without the wall time.
    metrics: Vec<Value>,
}

#[test]
fn one_worker_and_five_give_the_same_bits_when_advised_early() {
    check(STRATEGIES[0], 1, &[1, 5]);
}

#[test]
fn one_worker_and_five_give_the_same_bits_when_advised_on_mistakes() {
    check(STRATEGIES[2], 1, &[1, 5]);
}

#[test]
fn one_worker_and_five_give_the_same_bits_when_the_learner_ends_the_advice() {
    check(JSRL, 1, &[1, 5]);
}

#[test]
fn sixteen_workers_give_the_bits_of_fewer_with_either_lag() {
    check(EAMC, 0, &[2, 16]);
    check(EAMC, 1, &[5, 16]);
}

#[test]
fn one_worker_and_five_give_the_same_bits_with_the_papers_ways_of_advice_and_exploration() {
    let settings = [
        "rounds.slots=8",
        "rounds.rollouts=2",
        "advice.share=1",
        "advice.unit=slot-step",
        "advice.judged_action=policy",
        "exploration.joint_random_actions=true",
        "replay.joint_goal_statistics=true",
        "ddpg.batches_per_update=2",
    ];
    check_with(("mc-act:0.1", 900), 0, &[1, 5], &settings);
}

#[test]
fn one_worker_and_five_give_the_same_bits_when_a_unit_pays_for_episodes_that_ask_at_other_steps() {
    let settings =
        ["rounds.slots=8", "rounds.rollouts=2", "advice.share=1", "advice.unit=slot-step"];
    check_with(("ts2c:0.2", 400), 0, &[1, 5], &settings);
}

#[test]
#[ignore = "takes five minutes"]
fn any_number_of_workers_gives_the_same_bits_with_every_strategy_and_either_lag() {
    for advice in STRATEGIES {
        check(advice, 0, &N_WORKERS);
        check(advice, 1, &N_WORKERS);
    }
}

#[test]
fn an_evaluation_does_not_depend_on_the_number_of_threads() {
    let evaluations: Vec<Value> = ["1", "2", "5"].map(evaluate_with_threads).into();
    assert_eq!(evaluations[0], evaluations[1]);
    assert_eq!(evaluations[0], evaluations[2]);
}

/// Trains once for each number of workers and compares the results.
fn check(advice: (&str, u64), lag: u32, n_workers: &[usize]) {
    check_with(advice, lag, n_workers, &[]);
}

/// As [`check`], with further settings.
fn check_with(advice: (&str, u64), lag: u32, n_workers: &[usize], settings: &[&str]) {
    let (first, others) = n_workers.split_first().expect("numbers of workers");
    let expected = train(advice, lag, *first, settings);
    for n_workers in others {
        let got = train(advice, lag, *n_workers, settings);
        assert_eq!(got, expected, "{advice:?}, lag {lag}: {n_workers} workers against {first}");
    }
}

fn train(
    (strategy, budget): (&str, u64),
    lag: u32,
    n_workers: usize,
    settings: &[&str],
) -> RunResult {
    let directory = tempfile::tempdir().expect("a directory");
    let out = directory.path().join("run");
    let mut args = vec!["train".to_owned(), "--json".into(), "--workers".into()];
    args.extend([n_workers.to_string(), "--strategy".into(), strategy.into()]);
    args.extend(["--budget".into(), budget.to_string()]);
    args.extend(["--set".into(), format!("rounds.lag={lag}")]);
    args.extend(SMALL.map(str::to_owned));
    args.extend(settings.iter().flat_map(|setting| ["--set".to_owned(), (*setting).to_owned()]));
    let summary = last_line(tandem(&args).arg("--out").arg(&out));
    assert_eq!(summary["budget_left"], 0, "{strategy}: the budget did not run out");
    assert_eq!(summary["advice_spent"], budget, "{strategy}");
    let metrics = metrics(&out);
    check_runs_out_on_the_way(budget, &metrics);
    let text = |key: &str| summary[key].as_str().expect("a text").to_owned();
    RunResult { digest: text("digest"), best_policy: text("policy_digest"), metrics }
}

/// Checks that the first half of the budget lasts for at least one evaluation and that all is spent before the end.
fn check_runs_out_on_the_way(budget: u64, metrics: &[Value]) {
    let spent: Vec<u64> =
        metrics.iter().map(|row| row["advice_spent"].as_u64().expect("a number")).collect();
    let n_before_half = spent.iter().filter(|spent| **spent < budget / 2).count();
    let n_after = spent.iter().filter(|spent| **spent == budget).count();
    assert!(n_before_half >= 1 && n_after >= 2, "of {budget}: {spent:?}");
}

fn metrics(out: &Path) -> Vec<Value> {
    let text = fs::read_to_string(out.join("metrics.jsonl")).expect("metrics");
    let row = |line| -> Value {
        let mut row: Value = serde_json::from_str(line).expect("a row");
        row.as_object_mut().expect("an object").remove("wall_s").expect("a time");
        row
    };
    text.lines().map(row).collect()
}

fn evaluate_with_threads(n_threads: &str) -> Value {
    let mut args: Vec<String> = vec!["eval".into(), "--json".into(), "--policy".into()];
    args.push("policies/student-push.safetensors".into());
    args.extend(["--episodes".into(), "40".into(), "--seed".into(), "5".into()]);
    let mut evaluation = last_line(tandem(&args).env("RAYON_NUM_THREADS", n_threads));
    evaluation.as_object_mut().expect("an object").remove("steps_per_s").expect("a speed");
    evaluation
}

fn tandem(args: &[String]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(args).current_dir(env!("CARGO_MANIFEST_DIR")).stdin(Stdio::null());
    command
}

/// Runs a command and returns the JSON object on the last line of its output.
fn last_line(command: &mut Command) -> Value {
    let output = command.output().expect("runs");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{:?}: {errors}", output.status);
    let text = String::from_utf8_lossy(&output.stdout);
    serde_json::from_str(text.lines().last().expect("a line")).expect("an object")
}
