//! Whole runs on a simulated network where everything goes wrong that can: messages late, lost and held back, hosts
//! cut off, crashed and started again. What comes out is what a calm run gives.
//!
//! A seed draws what goes wrong, and the same seed always takes the same course:
//! `TANDEM_SIM_SEEDS=17 cargo test --release --test simulation -- --ignored many_runs` looks at seed 17 alone, `17..40`
//! at several. Each simulation has a process of its own. What that process does can be written down, one line for each
//! message, log line and trouble, or be followed in a debugger:
//! ```text
//! TANDEM_SIMULATION=run:17 TANDEM_SIM_TRACE=/tmp/trace cargo test --release --test simulation -- \
//!     --ignored --exact one_simulation --nocapture
//! ```
//! Complaints begin with the simulation that they are about, such as `run:17`.

mod books;
mod cluster;
mod crowd;
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

use books::{ForgetfulLedger, Ledgers};
use cluster::{Course, Outcome, SERVICES, Scenario, WORKERS, links, simulate, simulate_with};
use crowd::simulate_crowd;
use process::{Kind, Report, Simulation};
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

/// A ledger that does what it must, every fourth one in a file.
fn proper_ledgers(seed: u64) -> Ledgers {
    match seed % 4 {
        0 => Ledgers::in_file(),
        _ => Ledgers::kept(MemoryLedger::default()),
    }
}

fn forgetful_ledgers() -> Ledgers {
    Ledgers::kept(ForgetfulLedger::default())
}

/// Runs a simulation in this process.
fn simulate_here(Simulation(kind, number): Simulation) -> Result<Report, String> {
    let (outcome, course) = match kind {
        Kind::Calm => simulate_calm(run_idx_of(number), &WORKERS[..1], false)?,
        Kind::Silent => simulate_calm(run_idx_of(number), &WORKERS[..2], true)?,
        Kind::Run => simulate_trouble(number, proper_ledgers(number))?,
        Kind::ForgetfulRun => simulate_trouble(number, forgetful_ledgers())?,
        Kind::Crowd | Kind::ForgetfulCrowd => {
            let is_forgetful = kind == Kind::ForgetfulCrowd;
            let ledgers = if is_forgetful { forgetful_ledgers() } else { proper_ledgers(number) };
            let n_repeats = simulate_crowd(number, &ledgers)?;
            return Ok(Report { outcome: None, course: Course { n_repeats, ..Course::default() } });
        }
    };
    Ok(Report { outcome: Some(outcome), course })
}

/// The run that `number` picks.
fn run_idx_of(number: u64) -> usize {
    usize::try_from(number).expect("a small number") % RUNS.len()
}

/// Simulates a run without trouble, if need be with somebody who is connected and says nothing.
fn simulate_calm(
    run_idx: usize,
    workers: &'static [schedule::Host],
    with_silent: bool,
) -> Result<(Outcome, Course), String> {
    let ledgers = Ledgers::kept(MemoryLedger::default());
    let scenario = Scenario { run: run_config(RUNS[run_idx]), workers, ledgers };
    let schedule = Schedule::calm(u64::from(with_silent));
    simulate_with(&scenario, &schedule, |machines| {
        if with_silent {
            machines.add("silent", network::say_nothing_to_learner);
        }
    })
}

/// Simulates the run that `seed` picks, with what `seed` lets go wrong.
fn simulate_trouble(seed: u64, ledgers: Ledgers) -> Result<(Outcome, Course), String> {
    let (scenario, schedule) = trouble(seed, ledgers);
    simulate(&scenario, &schedule).map_err(|what| format!("{what}\n{}", described(seed)))
}

fn trouble(seed: u64, ledgers: Ledgers) -> (Scenario, Schedule) {
    let workers = &WORKERS[..2 + usize::try_from(seed / 3 % 4).expect("below 4")];
    let schedule = Schedule::draw(seed, &links(workers), &SERVICES, workers, SPAN);
    (Scenario { run: run_config(RUNS[run_idx_of(seed)]), workers, ledgers }, schedule)
}

/// What `seed` lets go wrong with which run.
fn described(seed: u64) -> String {
    let (Scenario { workers, .. }, schedule) = trouble(seed, proper_ledgers(1));
    format!("{} workers, {:?}, {schedule}", workers.len(), RUNS[run_idx_of(seed)])
}

/// How a calm run with one worker ends.
fn calm(run_idx: usize) -> &'static Outcome {
    static CALM: [OnceLock<Outcome>; RUNS.len()] = [const { OnceLock::new() }; RUNS.len()];
    CALM[run_idx].get_or_init(|| {
        let report = process::run(Simulation(Kind::Calm, run_idx as u64), None);
        report.expect("nothing goes wrong").outcome.expect("a run ends somehow")
    })
}

/// Simulates a run in trouble and compares its end with a calm one's.
fn check(kind: Kind, seed: u64) -> Result<Course, String> {
    let simulation = Simulation(kind, seed);
    let Report { outcome, course } = process::run(simulation, None)?;
    let (outcome, expected) = (outcome.expect("a run ends somehow"), calm(run_idx_of(seed)));
    if outcome == *expected {
        return Ok(course);
    }
    let told = described(seed);
    Err(format!(
        "{simulation}: expected the end of a calm run, {expected:?}, got {outcome:?}\n{told}"
    ))
}

fn check_run(seed: u64) -> Result<Course, String> {
    check(Kind::Run, seed)
}

fn check_crowd(seed: u64) -> Result<u64, String> {
    Ok(process::run(Simulation(Kind::Crowd, seed), None)?.course.n_repeats)
}

#[test]
#[ignore = "the others start it, each time in a process of its own"]
fn one_simulation() {
    if let Some(report) = process::run_the_one_asked_for(simulate_here) {
        println!("{report}");
    }
}

#[test]
fn every_undisturbed_run_spends_its_budget_and_is_evaluated_three_times() {
    for (run_idx, (_, budget, ..)) in RUNS.iter().enumerate() {
        let Outcome { units, n_rounds, judged, .. } = calm(run_idx);
        assert_eq!(*units, [*budget, 0, 0]);
        assert_eq!(*n_rounds, N_ROUNDS);
        assert_eq!(*judged, [2, 4, 5]);
    }
}

#[test]
fn a_run_with_many_faults_ends_like_an_undisturbed_one() {
    let courses = for_seeds(0..24, check_run);
    let all = courses.iter().fold(Course::default(), Course::plus);
    assert!(all.n_repeats > 100, "the teacher was hardly asked again: {all:?}");
    assert!(all.n_resumed > 0, "few learners resumed: {all:?}");
    assert!(all.n_teachers > 24, "few teachers took over: {all:?}");
    assert!(all.n_workers > 24 * 3, "few workers joined late or again: {all:?}");
}

#[test]
fn a_ledger_that_forgets_verdicts_is_detected() {
    let found = complaints(0..6, |seed| check(Kind::ForgetfulRun, seed));
    assert!(!found.is_empty(), "six seeds found nothing");
}

#[test]
fn a_crowd_spends_the_budget_exactly_once() {
    let n_repeats: u64 = for_seeds(0..60, check_crowd).into_iter().sum();
    assert!(n_repeats > 0);
}

#[test]
fn a_crowd_detects_a_ledger_that_forgets_verdicts() {
    let forgetful = |seed| process::run(Simulation(Kind::ForgetfulCrowd, seed), None);
    assert!(!complaints(0..3, forgetful).is_empty(), "three seeds found nothing");
}

#[test]
fn a_run_ends_despite_a_silent_open_connection() {
    let Report { outcome, course } = process::run(Simulation(Kind::Silent, 0), None).expect("ends");
    assert_eq!(outcome.as_ref(), Some(calm(0)));
    assert!(course.took < Duration::from_secs(60), "{course:?}");
}

#[test]
fn the_same_seed_gives_the_same_trace() {
    let compared = repeats::compare(&[Simulation(Kind::Run, 8), Simulation(Kind::Crowd, 4)], 3);
    println!("{}", compared.unwrap_or_else(|difference| panic!("{difference}")));
}

#[test]
#[ignore = "takes minutes"]
fn many_seeds_repeat_their_traces_ten_times_on_a_busy_machine() {
    let runs = seeds_asked_for(12).map(|seed| Simulation(Kind::Run, seed));
    let crowds = seeds_asked_for(12).map(|seed| Simulation(Kind::Crowd, seed));
    let simulations: Vec<_> = runs.chain(crowds).collect();
    let compared = repeats::on_a_busy_machine(|| repeats::compare(&simulations, 10));
    println!("{}", compared.unwrap_or_else(|difference| panic!("{difference}")));
}

#[test]
#[ignore = "takes minutes"]
fn many_runs_with_many_faults_end_like_undisturbed_ones() {
    let courses = for_seeds(seeds_asked_for(500), check_run);
    let all = courses.iter().fold(Course::default(), Course::plus);
    println!("{} runs, together {all:?}", courses.len());
}

#[test]
#[ignore = "takes minutes"]
fn many_crowds_spend_the_budget_exactly_once() {
    let repeats = for_seeds(seeds_asked_for(500), check_crowd);
    println!("{} crowds, {} repeats", repeats.len(), repeats.iter().sum::<u64>());
}
