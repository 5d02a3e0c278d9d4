//! Runs with killed and stopped processes and disturbed connections end like an undisturbed run: with the same bits,
//! account and metrics.
//!
//! `TANDEM_CHAOS_SEED` selects the schedule. The seed is printed.

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
use schedule::{BATCH_EVENTS, Schedule, Target};

const N_WORKERS: usize = 4;
/// Minimum number of faults. Faults come faster on a fast machine, so that every kind of fault occurs.
const MIN_FAULTS_PER_RUN: u32 = 20;

/// The size of a run and the rate of faults.
struct Scale {
    max_env_steps: u64,
    budget: u64,
    /// Maximum time between faults.
    every: Duration,
}

#[test]
fn a_run_under_faults_ends_with_the_bits_of_an_undisturbed_run() {
    compare(&Scale { max_env_steps: 30_000, budget: 6_000, every: Duration::from_millis(1_750) });
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
        rounds = {{ slots = 8, rollouts = 2, lag = 1, updates_per_env_step = 0.2 }}
        world = {{ substeps = 10 }}
        ddpg = {{ n_hidden = 32, batch_size = 64 }}
        evaluation = {{ every_env_steps = 4000, episodes = 8, test_episodes = 8, recorded_episodes = 0 }}
        checkpoint = {{ every_rounds = 4, keep = 2 }}
        stop = {{ max_env_steps = {max_env_steps}, max_minutes = 0 }}
        "#
    )
}

/// Compares an undisturbed run with one under faults.
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
    let (undisturbed_dir, undisturbed) = run(None, Duration::from_secs(1_800));
    let seed = seed();
    let every = scale.every.min(undisturbed.wall / MIN_FAULTS_PER_RUN);
    println!(
        "undisturbed run: {:?}; schedule: seed {seed}, a fault every {every:?}",
        undisturbed.wall
    );
    let schedule = Schedule::new(seed, N_WORKERS, every);
    let deadline = Duration::from_secs(300) + 10 * undisturbed.wall;
    let (dir, disturbed) = run(Some(schedule), deadline);
    report(&disturbed);
    check_equal((undisturbed_dir.path(), &undisturbed), (dir.path(), &disturbed));
    // On a fast machine the run ends before a whole batch of faults.
    let n_faults = disturbed.events.len();
    assert!(n_faults >= BATCH_EVENTS / 2, "the run was too short for its faults: {n_faults}");
    check_recoveries(&disturbed);
}

fn check_equal(
    (undisturbed_dir, undisturbed): (&Path, &Outcome),
    (dir, disturbed): (&Path, &Outcome),
) {
    let (expected, got) = (&undisturbed.progress, &disturbed.progress);
    let events = &disturbed.events;
    assert_eq!(got.digest, expected.digest, "different digest after {events:#?}");
    let counted = |progress: &tandem_proto::pb::Progress| {
        (progress.round, progress.env_steps, progress.episodes, progress.updates)
    };
    assert_eq!(counted(got), counted(expected), "different counters after {events:#?}");
    assert_eq!(disturbed.account, undisturbed.account, "different account after {events:#?}");
    assert_eq!(undisturbed.account.left, 0, "the budget did not run out");
    let charged = charges(dir);
    assert_eq!(charged.len() as u64, disturbed.account.spent);
    assert!(charged == charges(undisturbed_dir), "different charges after {events:#?}");
    assert_eq!(metrics(dir), metrics(undisturbed_dir), "different metrics after {events:#?}");
}

/// Reads every charged step with the half of the budget that paid for it.
fn charges(dir: &Path) -> Vec<(String, u32, String)> {
    let ledger = rusqlite::Connection::open(ledger_path(dir)).expect("a ledger");
    let query = "SELECT CAST(episode AS TEXT), step, CAST(half AS TEXT) FROM charges ORDER BY 1, 2";
    let mut query = ledger.prepare(query).expect("a view of the charges");
    let rows = query.query_map([], |row| Ok((row.get(0)?, row.get(1)?, row.get(2)?)));
    let charges: Vec<_> = rows.expect("rows").map(|row| row.expect("a row")).collect();
    assert!(!charges.is_empty());
    charges
}

/// Reads the rows of the metrics, without the wall time.
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

/// Checks that every kind of process recovered from a kill at least once. The durations are only printed, because they
/// depend on the machine and include other faults.
fn check_recoveries(disturbed: &Outcome) {
    let kinds: [fn(&Target) -> bool; 3] = [
        |who| *who == Target::Teacher,
        |who| *who == Target::Learner,
        |who| matches!(who, Target::Worker(_)),
    ];
    for is_kind in kinds {
        let recovered = disturbed.recoveries.iter().any(|recovery| is_kind(&recovery.who));
        assert!(recovered, "one kind of process never recovered: {:?}", disturbed.recoveries);
    }
}

#[expect(clippy::disallowed_methods, reason = "a person chooses the schedule")]
fn seed() -> u64 {
    std::env::var("TANDEM_CHAOS_SEED").map_or(1, |seed| seed.parse().expect("a number"))
}
