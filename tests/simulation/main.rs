//! Whole runs on a simulated network with delayed, lost and held messages, partitions, crashes and restarts. The result
//! is always that of an undisturbed run.
//!
//! A seed determines all faults, and the same seed always gives the same trace:
//! `TANDEM_SIM_SEEDS=17 cargo test --release --test simulation -- --ignored many_runs` runs seed 17 only, `17..40`
//! a range. Each simulation runs in its own process, which can write a trace with one line for each message, log line
//! and fault, or be followed in a debugger:
//! ```text
//! TANDEM_SIMULATION=run:17 TANDEM_SIM_TRACE=/tmp/trace cargo test --release --test simulation -- \
//!     --ignored --exact one_simulation --nocapture
//! ```
//! Failure messages begin with the simulation, such as `run:17`.

mod cluster;
mod crowd;
mod ledgers;
mod machines;
mod network;
mod process;
mod repeats;
mod schedule;
mod seeds;
mod system;
mod trace;

use std::sync::OnceLock;
use std::time::Duration;

use tandem_core::Task;
use tandem_rl::RunConfig;
use tandem_rl::config::Recipe;
use tandem_teacher::ledger::MemoryLedger;

use cluster::{Outcome, SERVICES, Scenario, Statistics, WORKERS, links, simulate, simulate_with};
use crowd::simulate_crowd;
use ledgers::{ForgetfulLedger, Ledgers};
use process::{Kind, Report, Simulation};
use schedule::Schedule;
use seeds::{failures, for_seeds, seeds_from_env};

/// Strategy, budget, share of advised episodes and lag of the simulated runs. All budgets run out.
const RUNS: [(&str, u64, f64, u32); 3] =
    [("ea", 700, 1.0, 0), ("eamc:0.1", 500, 1.0, 1), ("mc-q:0.1", 150, 0.5, 1)];
/// Rounds of a run.
const N_ROUNDS: u64 = 5;
/// Simulated time within which most faults start: about the duration of an undisturbed run on a fast network.
const SPAN: Duration = Duration::from_secs(4);

fn run_config((strategy, budget, share, lag): (&str, u64, f64, u32)) -> RunConfig {
    let mut run = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    run.name = "simulated".to_owned();
    run.advice.strategy = strategy.to_owned();
    run.advice.budget = budget;
    run.advice.share = share;
    run.rounds.slots = 3;
    run.rounds.lag = lag;
    run.rounds.updates_per_env_step = 0.02;
    run.rounds.warmup_env_steps = 100;
    run.world.substeps = 10;
    run.replay.capacity_transitions = 1000;
    run.ddpg.n_hidden = 16;
    run.ddpg.n_hidden_layers = 2;
    run.ddpg.batch_size = 32;
    run.evaluation.every_env_steps = 2 * run.env_steps_per_round();
    run.evaluation.early_points = 1;
    run.evaluation.episodes = 2;
    run.evaluation.recorded_episodes = 0;
    run.stop.max_env_steps = N_ROUNDS * run.env_steps_per_round();
    run.stop.max_minutes = 0.0;
    run.checkpoint.every_rounds = 1;
    run
}

/// Returns correct ledgers. Every fourth seed keeps them in a file.
fn correct_ledgers(seed: u64) -> Ledgers {
    match seed % 4 {
        0 => Ledgers::in_file(),
        _ => Ledgers::shared(MemoryLedger::default()),
    }
}

fn forgetful_ledgers() -> Ledgers {
    Ledgers::shared(ForgetfulLedger::default())
}

/// Runs a simulation in this process.
fn simulate_here(Simulation(kind, number): Simulation) -> Result<Report, String> {
    let (outcome, statistics) = match kind {
        Kind::Undisturbed => simulate_undisturbed(run_idx_of(number), &WORKERS[..1], false)?,
        Kind::Silent => simulate_undisturbed(run_idx_of(number), &WORKERS[..2], true)?,
        Kind::Run => simulate_faults(number, correct_ledgers(number))?,
        Kind::ForgetfulRun => simulate_faults(number, forgetful_ledgers())?,
        Kind::Crowd | Kind::ForgetfulCrowd => {
            let is_forgetful = kind == Kind::ForgetfulCrowd;
            let ledgers = if is_forgetful { forgetful_ledgers() } else { correct_ledgers(number) };
            let n_repeats = simulate_crowd(number, &ledgers)?;
            return Ok(Report {
                outcome: None,
                statistics: Statistics { n_repeats, ..Statistics::default() },
            });
        }
    };
    Ok(Report { outcome: Some(outcome), statistics })
}

/// Returns the index of the run that `number` selects.
fn run_idx_of(number: u64) -> usize {
    usize::try_from(number).expect("a small number") % RUNS.len()
}

/// Simulates a run without faults, optionally with an idle client.
fn simulate_undisturbed(
    run_idx: usize,
    workers: &'static [schedule::Host],
    with_idle_client: bool,
) -> Result<(Outcome, Statistics), String> {
    let ledgers = Ledgers::shared(MemoryLedger::default());
    let scenario = Scenario { run: run_config(RUNS[run_idx]), workers, ledgers };
    let schedule = Schedule::undisturbed(u64::from(with_idle_client));
    simulate_with(&scenario, &schedule, |machines| {
        if with_idle_client {
            machines.add("silent", network::idle_client);
        }
    })
}

/// Simulates the run that `seed` selects, with the faults that `seed` draws.
fn simulate_faults(seed: u64, ledgers: Ledgers) -> Result<(Outcome, Statistics), String> {
    let (scenario, schedule) = faulty_scenario(seed, ledgers);
    simulate(&scenario, &schedule).map_err(|what| format!("{what}\n{}", describe(seed)))
}

fn faulty_scenario(seed: u64, ledgers: Ledgers) -> (Scenario, Schedule) {
    let workers = &WORKERS[..2 + usize::try_from(seed / 3 % 4).expect("below 4")];
    let schedule = Schedule::draw(seed, &links(workers), &SERVICES, workers, SPAN);
    (Scenario { run: run_config(RUNS[run_idx_of(seed)]), workers, ledgers }, schedule)
}

/// Describes the run and the faults of `seed`.
fn describe(seed: u64) -> String {
    let (Scenario { workers, .. }, schedule) = faulty_scenario(seed, correct_ledgers(1));
    format!("{} workers, {:?}, {schedule}", workers.len(), RUNS[run_idx_of(seed)])
}

/// Returns the outcome of an undisturbed run with one worker.
fn undisturbed(run_idx: usize) -> &'static Outcome {
    static UNDISTURBED: [OnceLock<Outcome>; RUNS.len()] = [const { OnceLock::new() }; RUNS.len()];
    UNDISTURBED[run_idx].get_or_init(|| {
        let report = process::run(Simulation(Kind::Undisturbed, run_idx as u64), None);
        report.expect("no fault").outcome.expect("an outcome")
    })
}

/// Simulates a run under faults and compares its outcome with the undisturbed run.
fn check(kind: Kind, seed: u64) -> Result<Statistics, String> {
    let simulation = Simulation(kind, seed);
    let Report { outcome, statistics } = process::run(simulation, None)?;
    let (outcome, expected) = (outcome.expect("an outcome"), undisturbed(run_idx_of(seed)));
    if outcome == *expected {
        return Ok(statistics);
    }
    let description = describe(seed);
    Err(format!(
        "{simulation}: expected the outcome of an undisturbed run, {expected:?}, got {outcome:?}\n{description}"
    ))
}

fn check_run(seed: u64) -> Result<Statistics, String> {
    check(Kind::Run, seed)
}

fn check_crowd(seed: u64) -> Result<u64, String> {
    Ok(process::run(Simulation(Kind::Crowd, seed), None)?.statistics.n_repeats)
}

#[test]
#[ignore = "started by the other tests in a separate process"]
fn one_simulation() {
    if let Some(report) = process::run_requested(simulate_here) {
        println!("{report}");
    }
}

#[test]
fn every_undisturbed_run_spends_its_budget_and_is_evaluated_four_times() {
    for (run_idx, (_, budget, ..)) in RUNS.iter().enumerate() {
        let Outcome { units, n_rounds, evaluated, .. } = undisturbed(run_idx);
        assert_eq!(*units, [*budget, 0, 0]);
        assert_eq!(*n_rounds, N_ROUNDS);
        assert_eq!(*evaluated, [0, 2, 4, 5]);
    }
}

#[test]
fn a_run_with_many_faults_ends_like_an_undisturbed_one() {
    let runs = for_seeds(0..7, check_run);
    let all = runs.iter().fold(Statistics::default(), Statistics::plus);
    assert!(all.n_repeats > 28, "few repeated requests: {all:?}");
    assert!(all.n_resumed > 0, "few learners resumed: {all:?}");
    assert!(all.n_teachers > 7, "few teacher restarts: {all:?}");
    assert!(all.n_workers > 7 * 3, "few late or repeated joins: {all:?}");
}

#[test]
fn a_ledger_that_forgets_verdicts_is_detected() {
    let found = failures(0..6, |seed| check(Kind::ForgetfulRun, seed));
    assert!(!found.is_empty(), "not detected by six seeds");
}

#[test]
fn a_crowd_spends_the_budget_exactly_once() {
    let n_repeats: u64 = for_seeds(0..25, check_crowd).into_iter().sum();
    assert!(n_repeats > 0);
}

#[test]
fn a_crowd_detects_a_ledger_that_forgets_verdicts() {
    let forgetful = |seed| process::run(Simulation(Kind::ForgetfulCrowd, seed), None);
    assert!(!failures(0..3, forgetful).is_empty(), "not detected by three seeds");
}

#[test]
fn a_run_ends_despite_a_silent_open_connection() {
    let Report { outcome, statistics } =
        process::run(Simulation(Kind::Silent, 0), None).expect("ends");
    assert_eq!(outcome.as_ref(), Some(undisturbed(0)));
    assert!(statistics.took < Duration::from_secs(60), "{statistics:?}");
}

#[test]
fn the_same_seed_gives_the_same_trace() {
    let compared = repeats::compare(&[Simulation(Kind::Run, 8), Simulation(Kind::Crowd, 4)], 2);
    println!("{}", compared.unwrap_or_else(|difference| panic!("{difference}")));
}

#[test]
#[ignore = "takes minutes"]
fn many_seeds_repeat_their_traces_ten_times_on_a_busy_machine() {
    let runs = seeds_from_env(12).map(|seed| Simulation(Kind::Run, seed));
    let crowds = seeds_from_env(12).map(|seed| Simulation(Kind::Crowd, seed));
    let simulations: Vec<_> = runs.chain(crowds).collect();
    let compared = repeats::on_a_busy_machine(|| repeats::compare(&simulations, 10));
    println!("{}", compared.unwrap_or_else(|difference| panic!("{difference}")));
}

#[test]
#[ignore = "takes minutes"]
fn many_runs_with_many_faults_end_like_undisturbed_ones() {
    let runs = for_seeds(seeds_from_env(500), check_run);
    let all = runs.iter().fold(Statistics::default(), Statistics::plus);
    println!("{} runs, in total {all:?}", runs.len());
}

#[test]
#[ignore = "takes minutes"]
fn many_crowds_spend_the_budget_exactly_once() {
    let repeats = for_seeds(seeds_from_env(500), check_crowd);
    println!("{} crowds, {} repeats", repeats.len(), repeats.iter().sum::<u64>());
}
