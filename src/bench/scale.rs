//! `tandem bench scale`: measures how many workers one learner serves. Real workers simulate; idle workers wait as long
//! as an episode would take. The learner, the relays and the real workers are separate processes; the idle workers are
//! tasks of this one.

mod measures;
mod real;
mod row;
mod workspace;

use std::time::Duration;

use anyhow::Context as _;
use tandem_bench::{Clock, IdleWorkers};
use tandem_core::layout::EPISODE_STEPS;
use tandem_core::text::counted;
use tandem_system::fd_limit;

use crate::cli::ScaleArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{clock, output, runtime};
use row::{Reading, Rounds, Row, Scale};
use workspace::{Service, Workspace};

/// Episodes that a worker steps together.
const ROLLOUTS: usize = 2;
/// Timeout of the rounds of one setting.
const TIMEOUT: Duration = Duration::from_secs(600);
/// Open files of this process and of a learner besides the connections of workers.
const OTHER_DESCRIPTORS: u64 = 100;

pub(super) fn scale(args: &ScaleArgs) -> Result<Scale, Failed> {
    if args.idle == 0 && args.workers.iter().all(|n_workers| *n_workers == 0) {
        return Err(Failed::usage("--workers 0 and --idle 0 leave nothing to measure"));
    }
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
    let measured = runtime::new().and_then(|runtime| runtime.block_on(measure(args, n_joining)));
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
    let workspace = Workspace::new(args.program.as_deref())?;
    let mut scale = Scale::default();
    let mut numbers: Vec<usize> = args.workers.iter().copied().map(usize::from).collect();
    numbers.retain(|n| *n > 0);
    numbers.sort_unstable();
    numbers.dedup();
    if let Some(n_slots) = numbers.last() {
        let learner = workspace.learner("real", *n_slots, args.updates_per_env_step).await?;
        for n_workers in &numbers {
            log_progress(&counted(*n_workers, "real worker"));
            let bench = real::RealWorkerBench {
                workspace: &workspace,
                learner: &learner,
                n_slots: *n_slots,
            };
            let row = tokio::time::timeout(TIMEOUT, bench.run(*n_workers, args.rounds, &clock));
            let row = row.await.with_context(|| too_slow(*n_workers, args.rounds))?;
            scale.real.push(row?);
        }
    }
    if args.idle > 0 {
        let (n, rounds) = (usize::from(args.idle), args.rounds);
        let idle = tokio::time::timeout(TIMEOUT, measure_idle(args, n_joining, &workspace, &clock));
        let (joined_s, rows) = idle.await.with_context(|| too_slow(n, rounds))??;
        scale.idle = rows;
        scale.joined_s = Some(joined_s);
    }
    Ok(scale)
}

fn too_slow(n_workers: usize, rounds: u16) -> String {
    format!("{rounds} rounds of {n_workers} workers took more than {} s", TIMEOUT.as_secs())
}

/// Measures rounds of idle workers, first without changes and then while some leave and others join. Returns the
/// seconds until all had joined, and the rows.
async fn measure_idle(
    args: &ScaleArgs,
    n_joining: usize,
    workspace: &Workspace,
    clock: &Clock,
) -> anyhow::Result<(f64, Vec<Row>)> {
    let n_workers = usize::from(args.idle);
    let learner = workspace.learner("idle", n_workers, args.updates_per_env_step).await?;
    let mut relays = Vec::new();
    for _ in 0..args.relays {
        relays.push(workspace.relay(&learner.address).await?);
    }
    let through = if relays.is_empty() { std::slice::from_ref(&learner) } else { &relays };
    let addresses = through.iter().map(|service| service.address.clone()).collect();
    let slot_time = Duration::from_secs_f64(args.slot_s);
    let mut workers = IdleWorkers::new(addresses, slot_time, n_workers * ROLLOUTS, clock.clone());
    log_progress(&format!("{n_workers} idle workers"));
    let before = clock();
    workers.join(n_workers)?;
    workers.all_joined().await?;
    let joined_s = (clock() - before).as_secs_f64();
    let bench = IdleWorkerBench { args, n_workers, learner: &learner, clock };
    let suffix = if relays.is_empty() { String::new() } else { format!("-relays-{}", args.relays) };
    let mut rows = vec![bench.run(&mut workers, format!("idle-{n_workers}{suffix}"), 0).await?];
    if n_joining > 0 {
        log_progress(&format!("{n_joining} idle workers leave and as many join"));
        let name = format!("join-leave-{n_joining}{suffix}");
        rows.push(bench.run(&mut workers, name, n_joining).await?);
    }
    if let Some(error) = workers.timings().first_failure() {
        log_progress(&format!("calls failed and were repeated, the first with: {error}"));
    }
    Ok((joined_s, rows))
}

/// Measures rounds of idle workers.
struct IdleWorkerBench<'a> {
    args: &'a ScaleArgs,
    n_workers: usize,
    learner: &'a Service,
    clock: &'a Clock,
}

impl IdleWorkerBench<'_> {
    /// Measures from the beginning of the next round. `n_leaving` workers leave in the middle of their slots while as
    /// many join.
    async fn run(
        &self,
        workers: &mut IdleWorkers,
        name: String,
        n_leaving: usize,
    ) -> anyhow::Result<Row> {
        let (learner, here) = (self.learner.process.pid, std::process::id());
        // The first two rounds are played with the same parameters.
        let first = (workers.round() + 1).max(2);
        let last = first + u64::from(self.args.rounds);
        workers.wait_for_round(first).await;
        let before = Reading::take((self.clock)(), learner, &[here]);
        let n_failed = workers.timings().n_failed();
        if n_leaving > 0 {
            tokio::time::sleep(Duration::from_secs_f64(self.args.slot_s / 2.0)).await;
            workers.leave(n_leaving);
            workers.join(n_leaving)?;
        }
        workers.wait_for_round(last).await;
        let after = Reading::take((self.clock)(), learner, &[here]);
        let timings = workers.timings();
        let env_steps = self.n_workers * ROLLOUTS * EPISODE_STEPS;
        let rounds = Rounds { env_steps, starts: timings.round_starts(first, last) };
        let mut row = Row::between((&before, &after), (name, self.n_workers), &rounds, learner);
        let mut calls = timings.calls(first, last);
        calls.n_failed -= n_failed;
        row.calls = Some(calls);
        Ok(row)
    }
}

fn log_progress(what: &str) {
    output::message(format_args!("scale: {what}"));
}
