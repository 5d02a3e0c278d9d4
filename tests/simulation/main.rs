//! Whole runs on a simulated network where everything goes wrong that can: messages late, lost and held back, hosts
//! cut off, crashed and started again. What comes out is what a calm run gives.
//!
//! A seed draws what goes wrong. The same seed does not take the same course twice, because threads take part; what is
//! checked holds for every course. `TANDEM_SIM_SEEDS=17 cargo test --release --test simulation -- --ignored` looks at
//! seed 17 alone, `17..40` at several.

mod books;
mod cluster;
mod crowd;
mod machines;
mod network;
mod schedule;
mod seeds;
mod threads;

use std::sync::OnceLock;
use std::time::Duration;

use tandem_core::Task;
use tandem_learner::RunConfig;
use tandem_learner::config::Recipe;
use tandem_teacher::ledger::MemoryLedger;

use books::{ForgetfulLedger, Ledgers};
use cluster::{Course, Outcome, SERVICES, Scenario, WORKERS, links, simulate, simulate_with};
use crowd::simulate_crowd;
use schedule::Schedule;
use seeds::{complaints, for_seeds, seeds_asked_for};

/// Strategy, budget, share of advised episodes and lag of the runs that are simulated. All budgets run out.
const RUNS: [(&str, u64, f64, u32); 3] =
    [("ea", 700, 1.0, 0), ("eamc:0.1", 500, 1.0, 1), ("mc-q:0.1", 150, 0.5, 1)];
/// Rounds of a run.
const N_ROUNDS: u64 = 5;
/// Simulated time within which most of what goes wrong begins: about as long as a calm run takes on a fast network.
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
    run.evaluation.episodes = 2;
    run.evaluation.recorded_episodes = 0;
    run.stop.max_env_steps = N_ROUNDS * run.env_steps_per_round();
    run.stop.max_minutes = 0.0;
    run.checkpoint.every_rounds = 1;
    run
}

/// How a calm run with one worker ends.
fn calm(run_idx: usize) -> &'static Outcome {
    static CALM: [OnceLock<Outcome>; RUNS.len()] = [const { OnceLock::new() }; RUNS.len()];
    CALM[run_idx].get_or_init(|| {
        let scenario = Scenario {
            run: run_config(RUNS[run_idx]),
            workers: &WORKERS[..1],
            ledgers: Ledgers::kept(MemoryLedger::default()),
        };
        simulate(&scenario, &Schedule::calm(0)).expect("nothing goes wrong").0
    })
}

/// Simulates a run that `seed` picks, with what `seed` lets go wrong, and compares its end with a calm one's.
fn check(seed: u64, ledgers: Ledgers) -> Result<Course, String> {
    let run_idx = usize::try_from(seed).expect("a small seed") % RUNS.len();
    let workers = &WORKERS[..2 + usize::try_from(seed / 3 % 4).expect("below 4")];
    let schedule = Schedule::draw(seed, &links(workers), &SERVICES, workers, SPAN);
    let scenario = Scenario { run: run_config(RUNS[run_idx]), workers, ledgers };
    let told = |what: String| {
        format!("{what}\n{} workers, {:?}, {schedule}", workers.len(), RUNS[run_idx])
    };
    let (outcome, course) = simulate(&scenario, &schedule).map_err(told)?;
    let expected = calm(run_idx);
    if outcome == *expected {
        return Ok(course);
    }
    Err(told(format!("expected the end of a calm run, {expected:?}, got {outcome:?}")))
}

/// A ledger that does what it must, every fourth one in a file.
fn proper_ledgers(seed: u64) -> Ledgers {
    match seed % 4 {
        0 => Ledgers::in_file(),
        _ => Ledgers::kept(MemoryLedger::default()),
    }
}

fn check_run(seed: u64) -> Result<Course, String> {
    check(seed, proper_ledgers(seed))
}

#[test]
fn every_calm_run_uses_up_its_budget_and_is_judged_three_times() {
    for (run_idx, (_, budget, ..)) in RUNS.iter().enumerate() {
        let Outcome { balance, counters, metrics, .. } = calm(run_idx);
        assert_eq!((balance.spent, balance.leased, balance.left), (*budget, 0, 0));
        assert_eq!(counters.round, N_ROUNDS);
        let rounds: Vec<u64> = metrics.iter().map(|row| row.round).collect();
        assert_eq!(rounds, [2, 4, 5]);
    }
}

#[test]
fn a_run_in_which_much_goes_wrong_ends_like_a_calm_one() {
    let courses = for_seeds(0..24, check_run);
    let all = courses.iter().fold(Course::default(), Course::plus);
    assert!(all.n_repeats > 100, "the teacher was hardly asked again: {all:?}");
    assert!(all.n_resumed > 0, "few learners resumed: {all:?}");
    assert!(all.n_teachers > 24, "few teachers took over: {all:?}");
    assert!(all.n_workers > 24 * 3, "few workers joined late or again: {all:?}");
}

#[test]
fn a_ledger_that_forgets_its_verdicts_is_found_out() {
    let found = complaints(0..6, |seed| check(seed, Ledgers::kept(ForgetfulLedger::default())));
    assert!(!found.is_empty(), "six seeds found nothing");
}

fn check_crowd(seed: u64) -> Result<u64, String> {
    simulate_crowd(seed, &proper_ledgers(seed))
}

#[test]
fn a_crowd_spends_the_budget_once_and_no_more() {
    let n_repeats: u64 = for_seeds(0..60, check_crowd).into_iter().sum();
    assert!(n_repeats > 0);
}

#[test]
fn a_crowd_finds_out_a_ledger_that_forgets_its_verdicts() {
    let forgetful = |seed| simulate_crowd(seed, &Ledgers::kept(ForgetfulLedger::default()));
    assert!(!complaints(0..3, forgetful).is_empty(), "three seeds found nothing");
}

#[test]
fn a_run_ends_although_somebody_is_connected_who_says_nothing() {
    let scenario = Scenario {
        run: run_config(RUNS[0]),
        workers: &WORKERS[..2],
        ledgers: Ledgers::kept(MemoryLedger::default()),
    };
    let schedule = Schedule::calm(1);
    let (outcome, course) = simulate_with(&scenario, &schedule, |machines| {
        machines.add("silent", network::say_nothing_to_learner);
    })
    .expect("ends");
    assert_eq!(&outcome, calm(0));
    assert!(course.took < Duration::from_secs(60), "{course:?}");
}

#[test]
#[ignore = "takes minutes"]
fn many_runs_in_which_much_goes_wrong_end_like_calm_ones() {
    let courses = for_seeds(seeds_asked_for(500), check_run);
    let all = courses.iter().fold(Course::default(), Course::plus);
    println!("{} runs, together {all:?}", courses.len());
}

#[test]
#[ignore = "takes minutes"]
fn many_crowds_spend_the_budget_once_and_no_more() {
    let repeats = for_seeds(seeds_asked_for(500), check_crowd);
    println!("{} crowds, {} repeats", repeats.len(), repeats.iter().sum::<u64>());
}
