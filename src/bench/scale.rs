//! How many workers one learner holds: real ones, which simulate, and idle ones, which wait as long as an episode would
//! take. The learner, the relays and the real workers are processes of their own; the idle workers are in this one.

mod children;
mod idle;
mod measures;
mod real;
mod row;

use std::time::Duration;

use anyhow::Context as _;
use tandem_core::layout::EPISODE_STEPS;
use tandem_learner::Clock;
use tandem_system::fd_limit;

use super::Figure;
use crate::cli::ScaleArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{clock, output, services};
use children::{Place, Service};
use idle::Crowd;
use row::{Reading, Rounds, Row, Scale};

/// Episodes that a worker steps together.
const ROLLOUTS: usize = 2;
/// How long the rounds of one setting may take.
const DEADLINE: Duration = Duration::from_secs(600);
/// Connections and files that this process and a learner have beside those of the workers.
const OTHER_DESCRIPTORS: u64 = 100;

pub(super) fn scale(args: &ScaleArgs) -> Result<Scale, Failed> {
    let n_joining = join_leave(args)?;
    let updates = args.updates_per_env_step;
    if !(0.0..=100.0).contains(&updates) {
        return Err(Failed::usage(format!("--updates-per-env-step {updates}: expected 0 to 100")));
    }
    let n_needed = u64::from(args.idle) + n_joining as u64 + OTHER_DESCRIPTORS;
    if let Some(n_allowed) = fd_limit::raise().filter(|n| *n < n_needed) {
        return Err(Failed::usage(format!(
            "--idle {} needs {n_needed} open files and {n_allowed} are allowed: raise that with `ulimit -n`",
            args.idle
        )));
    }
    let measured =
        services::runtime().and_then(|runtime| runtime.block_on(measure(args, n_joining)));
    measured.or_exit(Exit::TryAgain, || "cannot measure".to_owned())
}

fn join_leave(args: &ScaleArgs) -> Result<usize, Failed> {
    let n = args.join_leave.unwrap_or(args.idle / 10);
    if n > args.idle {
        return Err(Failed::usage(format!(
            "--join-leave {n}: no more than the {} idle workers can leave",
            args.idle
        )));
    }
    Ok(n.into())
}

async fn measure(args: &ScaleArgs, n_joining: usize) -> anyhow::Result<Scale> {
    let clock = clock::since_now();
    let place = Place::new(args.program.as_deref())?;
    let mut scale = Scale::default();
    let mut numbers: Vec<usize> = args.workers.iter().copied().map(usize::from).collect();
    numbers.retain(|n| *n > 0);
    numbers.sort_unstable();
    numbers.dedup();
    if let Some(n_slots) = numbers.last() {
        let learner = Service::learner(&place, "real", *n_slots, args.updates_per_env_step).await?;
        for n_workers in &numbers {
            say(&format!("{n_workers} real workers"));
            let stage = real::Stage { place: &place, learner: &learner, n_slots: *n_slots };
            let row = tokio::time::timeout(DEADLINE, stage.run(*n_workers, args.rounds, &clock));
            let row = row.await.with_context(|| too_slow(*n_workers, args.rounds))?;
            scale.real.push(row?);
        }
    }
    if args.idle > 0 {
        let (n, rounds) = (usize::from(args.idle), args.rounds);
        let idle = tokio::time::timeout(DEADLINE, measure_idle(args, n_joining, &place, &clock));
        let (joined_s, rows) = idle.await.with_context(|| too_slow(n, rounds))??;
        scale.idle = rows;
        scale.joined_s = Some(joined_s);
    }
    Ok(scale)
}

fn too_slow(n_workers: usize, rounds: u16) -> String {
    format!("{rounds} rounds of {n_workers} workers took more than {} s", DEADLINE.as_secs())
}

/// The idle workers' rounds, at first all alike and then with some that leave and others that join. Gives beside them
/// how long it took until all had joined.
async fn measure_idle(
    args: &ScaleArgs,
    n_joining: usize,
    place: &Place,
    clock: &Clock,
) -> anyhow::Result<(f64, Vec<Row>)> {
    let n_workers = usize::from(args.idle);
    let learner = Service::learner(place, "idle", n_workers, args.updates_per_env_step).await?;
    let mut relays = Vec::new();
    for _ in 0..args.relays {
        relays.push(Service::relay(place, &learner.address).await?);
    }
    let through = if relays.is_empty() { std::slice::from_ref(&learner) } else { &relays };
    let addresses = through.iter().map(|service| service.address.clone()).collect();
    let slot_time = Duration::from_secs_f64(args.slot_s);
    let mut crowd = Crowd::new(addresses, slot_time, n_workers * ROLLOUTS, clock.clone());
    say(&format!("{n_workers} idle workers"));
    let before = clock();
    crowd.join(n_workers)?;
    crowd.all_joined().await?;
    let joined_s = (clock() - before).as_secs_f64();
    let stage = IdleStage { args, n_workers, learner: &learner, clock };
    let suffix = if relays.is_empty() { String::new() } else { format!("-relays-{}", args.relays) };
    let mut rows = vec![stage.run(&mut crowd, format!("idle-{n_workers}{suffix}"), 0).await?];
    if n_joining > 0 {
        say(&format!("{n_joining} idle workers leave and as many join"));
        let name = format!("join-leave-{n_joining}{suffix}");
        rows.push(stage.run(&mut crowd, name, n_joining).await?);
    }
    if let Some(told) = crowd.book().first_failure() {
        say(&format!("calls failed and were made again, the first was told: {told}"));
    }
    Ok((joined_s, rows))
}

/// Measures rounds of idle workers.
struct IdleStage<'a> {
    args: &'a ScaleArgs,
    n_workers: usize,
    learner: &'a Service,
    clock: &'a Clock,
}

impl IdleStage<'_> {
    /// Measures from the beginning of the next round on. In the middle of its slots `n_leaving` workers leave and as
    /// many join.
    async fn run(&self, crowd: &mut Crowd, name: String, n_leaving: usize) -> anyhow::Result<Row> {
        let (learner, here) = (self.learner.process.pid, std::process::id());
        // The first two rounds are played with the same parameters.
        let first = (crowd.round() + 1).max(2);
        let last = first + u64::from(self.args.rounds);
        crowd.until(first).await?;
        let before = Reading::take((self.clock)(), learner, &[here]);
        let n_failed = crowd.book().n_failed();
        if n_leaving > 0 {
            tokio::time::sleep(Duration::from_secs_f64(self.args.slot_s / 2.0)).await;
            crowd.leave(n_leaving);
            crowd.join(n_leaving)?;
        }
        crowd.until(last).await?;
        let after = Reading::take((self.clock)(), learner, &[here]);
        let book = crowd.book();
        let env_steps = self.n_workers * ROLLOUTS * EPISODE_STEPS;
        let rounds = Rounds { env_steps, began: book.began(first, last) };
        let mut row = Row::between((&before, &after), (name, self.n_workers), &rounds, learner);
        let mut calls = book.calls(first, last);
        calls.n_failed -= n_failed;
        row.calls = Some(calls);
        Ok(row)
    }
}

fn say(what: &str) {
    output::message(format_args!("scale: {what}"));
}
