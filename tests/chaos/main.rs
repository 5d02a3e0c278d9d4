//! A run whose processes are killed and stopped and whose connections are disturbed ends as a calm one: the same bits,
//! the same account, the same metrics.
//!
//! `TANDEM_CHAOS_SEED` chooses another schedule; a failure prints it.

#![expect(
    clippy::panic,
    clippy::print_stdout,
    reason = "a test says what it does and what went wrong"
)]

mod cluster;
mod process;
mod proxy;
mod recovery;
mod schedule;

use std::path::Path;
use std::time::Duration;

use serde_json::Value;

use cluster::{Cluster, NAME, Outcome, ledger_path, run_dir};
use schedule::{HAND_EVENTS, Schedule, Target};

const N_WORKERS: usize = 4;
/// On a fast machine faults come faster, so that every kind of fault has its turn.
const MIN_FAULTS_PER_CALM_RUN: u32 = 20;

/// How large a run, and how often something befalls it.
struct Scale {
    max_env_steps: u64,
    budget: u64,
    /// Longest time from fault to fault.
    every: Duration,
}

#[test]
fn a_run_under_faults_ends_with_the_bits_of_an_undisturbed_run() {
    compare(&Scale { max_env_steps: 48_000, budget: 12_000, every: Duration::from_millis(1_750) });
}

#[test]
#[ignore = "takes a quarter of an hour"]
fn a_long_run_under_faults_ends_with_the_bits_of_an_undisturbed_run() {
    compare(&Scale { max_env_steps: 560_000, budget: 80_000, every: Duration::from_secs(5) });
}

/// The run file: small networks, a budget that runs out on the way, checkpoints every few rounds.
fn run_file(scale: &Scale) -> String {
    let Scale { max_env_steps, budget, .. } = scale;
    format!(
        r#"
        name = "{NAME}"
        task = "push"
        arms = 2
        seed = 3
        advice = {{ strategy = "eamc:0.1", budget = {budget} }}
        rounds = {{ slots = 8, rollouts = 2, lag = 1 }}
        world = {{ substeps = 10 }}
        ddpg = {{ n_hidden = 32 }}
        evaluation = {{ every_env_steps = 4000, episodes = 8, recorded_episodes = 0 }}
        checkpoint = {{ every_rounds = 4, keep = 2 }}
        stop = {{ max_env_steps = {max_env_steps}, max_minutes = 0 }}
        "#
    )
}

/// A calm run and one under faults.
fn compare(scale: &Scale) {
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let runtime = runtime.expect("a runtime");
    let run = |schedule, deadline| {
        let dir = tempfile::tempdir().expect("a directory");
        let outcome = runtime.block_on(async {
            let cluster = Cluster::start(dir.path(), &run_file(scale), N_WORKERS).await;
            cluster.run(schedule, deadline).await
        });
        (dir, outcome)
    };
    let (calm_dir, calm) = run(None, Duration::from_secs(1_800));
    let seed = seed();
    let every = scale.every.min(calm.wall / MIN_FAULTS_PER_CALM_RUN);
    println!("calm run: {:?}; schedule: seed {seed}, a fault every {every:?}", calm.wall);
    let schedule = Schedule::new(seed, N_WORKERS, every);
    let deadline = Duration::from_secs(300) + 10 * calm.wall;
    let (dir, disturbed) = run(Some(schedule), deadline);
    report(&disturbed);
    check_equal((calm_dir.path(), &calm), (dir.path(), &disturbed));
    // On a fast machine the run ends before a whole hand of faults has come.
    let n_faults = disturbed.events.len();
    assert!(n_faults >= HAND_EVENTS / 2, "the run was too short for its faults: {n_faults}");
    check_recoveries(&disturbed);
}

fn check_equal((calm_dir, calm): (&Path, &Outcome), (dir, disturbed): (&Path, &Outcome)) {
    let (expected, got) = (&calm.progress, &disturbed.progress);
    let events = &disturbed.events;
    assert_eq!(got.digest, expected.digest, "other bits after {events:#?}");
    let counted = |progress: &tandem_proto::pb::Progress| {
        (progress.round, progress.env_steps, progress.episodes, progress.updates)
    };
    assert_eq!(counted(got), counted(expected), "counted otherwise after {events:#?}");
    assert_eq!(disturbed.account, calm.account, "another account after {events:#?}");
    assert_eq!(calm.account.left, 0, "the budget is to run out");
    let charged = charges(dir);
    assert_eq!(charged.len() as u64, disturbed.account.spent);
    assert!(charged == charges(calm_dir), "other charges after {events:#?}");
    assert_eq!(metrics(dir), metrics(calm_dir), "other metrics after {events:#?}");
}

/// Every step that was charged, with the half of the budget that paid for it.
fn charges(dir: &Path) -> Vec<(String, u32, String)> {
    let ledger = rusqlite::Connection::open(ledger_path(dir)).expect("a ledger");
    let query = "SELECT CAST(episode AS TEXT), step, CAST(half AS TEXT) FROM charges ORDER BY 1, 2";
    let mut query = ledger.prepare(query).expect("a view of the charges");
    let rows = query.query_map([], |row| Ok((row.get(0)?, row.get(1)?, row.get(2)?)));
    let charges: Vec<_> = rows.expect("rows").map(|row| row.expect("a row")).collect();
    assert!(!charges.is_empty());
    charges
}

/// The rows of the metrics, without the wall time.
fn metrics(dir: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(run_dir(dir).join("metrics.jsonl")).expect("metrics");
    let row = |line| -> Value {
        let mut row: Value = serde_json::from_str(line).expect("a row");
        row.as_object_mut().expect("an object").remove("wall_s").expect("a time");
        row
    };
    text.lines().map(row).collect()
}

fn report(disturbed: &Outcome) {
    println!("run under {} faults: {:?}", disturbed.events.len(), disturbed.wall);
    for recovery in &disturbed.recoveries {
        println!("{:?} was back after {:?}", recovery.who, recovery.took);
    }
}

/// Every kind of process recovered from a kill at least once. How long it took is printed, not tested: it depends on the
/// machine.
fn check_recoveries(disturbed: &Outcome) {
    let kinds: [fn(&Target) -> bool; 3] = [
        |who| *who == Target::Teacher,
        |who| *who == Target::Learner,
        |who| matches!(who, Target::Worker(_)),
    ];
    for is_kind in kinds {
        let recovered = disturbed.recoveries.iter().any(|recovery| is_kind(&recovery.who));
        assert!(recovered, "nothing recovered of one kind: {:?}", disturbed.recoveries);
    }
}

#[expect(clippy::disallowed_methods, reason = "a person chooses the schedule")]
fn seed() -> u64 {
    std::env::var("TANDEM_CHAOS_SEED").map_or(1, |seed| seed.parse().expect("a number"))
}
