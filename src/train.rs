//! `tandem train`: one command that starts learner, teacher and workers as processes, watches them and reports.

mod children;
mod claim;
mod display;
mod in_use;
mod plan;
mod restarts;
mod summary;
mod watch;

use std::time::{Duration, Instant};

use anyhow::anyhow;
use tandem_proto::pb;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use crate::cli::TrainArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{clock, services, signals};
use children::{Broken, Children, Memory};
use claim::Claim;
use display::Display;
pub(crate) use display::{counts_line, evaluation_line, grouped};
use in_use::InUse;
use plan::Plan;
pub(crate) use plan::shipped_teacher;
use watch::Heard;

/// How long a process may take to say where it listens.
const START_DEADLINE: Duration = Duration::from_secs(60);
/// How long processes may take to save and end.
const END_DEADLINE: Duration = Duration::from_secs(60);
/// How often it is looked whether all processes live.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// How often it is looked how large they are.
const MEASURE_EVERY: Duration = Duration::from_millis(500);

pub(crate) fn train(args: &TrainArgs) -> Result<(), Failed> {
    let plan = Plan::of(args)?;
    let claim = Claim::take(&plan)?;
    let quiet = claim.wait_for_former(&plan)?;
    plan.prepare()?;
    let in_use = InUse::write(&plan)?;
    drop(quiet);
    let runtime = services::runtime().or_exit(Exit::TryAgain, String::new)?;
    let (last, memory) = runtime.block_on(async {
        let interrupted =
            signals::shutdown_token(args.exit_with_stdin).or_exit(Exit::TryAgain, String::new)?;
        run((&plan, &claim), &interrupted).await
    })?;
    drop(in_use);
    if last.end_reason == INTERRUPTED {
        summary::interrupted(&plan);
        return Err(Failed::new(Exit::Interrupted, anyhow!(INTERRUPTED)));
    }
    summary::print(&plan, &last, memory, args.json)
}

/// Why a run ends that somebody stopped.
const INTERRUPTED: &str = "interrupted";

/// Starts every process, watches until the run has ended, and ends every process.
async fn run(
    (plan, claim): (&Plan, &Claim),
    interrupted: &CancellationToken,
) -> Result<(pb::Progress, Memory), Failed> {
    let mut display = Display::new(plan);
    let mut children = Children::new(plan).or_cannot_write(String::new)?;
    let last = tokio::select! {
        started = start(plan, &mut children, &display) => started,
        () = interrupted.cancelled() => Ok(()),
    };
    let last = match last {
        Ok(()) => Watch::new((plan, claim), &mut children, &mut display).follow(interrupted).await,
        Err(broken) => Err(broken),
    };
    display.close();
    if interrupted.is_cancelled() {
        display.say("interrupted: saving, a second Ctrl-C ends at once");
    }
    let again = signals::shutdown_token(false).or_exit(Exit::TryAgain, String::new)?;
    tokio::select! {
        () = children.end(END_DEADLINE) => (),
        () = again.cancelled() => (),
    }
    let last = match last {
        Ok(last) => last,
        Err(Broken { exit, error }) => {
            return Err(Failed::new(exit, error.context(broke_off(plan, exit))));
        }
    };
    if last.ended && !interrupted.is_cancelled() {
        return Ok((last, children.memory()));
    }
    Ok((pb::Progress { end_reason: INTERRUPTED.to_owned(), ..last }, children.memory()))
}

/// Starts every process in time.
async fn start(plan: &Plan, children: &mut Children, display: &Display) -> Result<(), Broken> {
    let started = tokio::time::timeout(START_DEADLINE, children.start(plan, display)).await;
    started.unwrap_or_else(|_elapsed| {
        Err(anyhow!("a process did not say in time where it listens").into())
    })
}

/// Says how to go on, where that can help, and where to look.
fn broke_off(plan: &Plan, exit: Exit) -> String {
    let (log, out) = (plan.log_path(), plan.out.display());
    let log = log.display();
    match exit {
        Exit::TryAgain => {
            format!(
                "the run was interrupted, resume it with `tandem train --resume --out {out}`; see {log}"
            )
        }
        _ => format!("the run cannot continue; see {log}"),
    }
}

/// What is known of a run that goes on.
struct Watch<'a> {
    plan: &'a Plan,
    claim: &'a Claim,
    children: &'a mut Children,
    display: &'a mut Display,
    last: pb::Progress,
    /// How many streams of progress had been opened before the latest message's.
    n_streams: u32,
    /// Whether the learner was started again and has not been heard of since.
    awaits_learner: bool,
    started_at: Instant,
    /// Seconds that the run had taken before this start; known once the learner has told.
    wall_before_s: Option<f64>,
}

impl<'a> Watch<'a> {
    fn new(
        (plan, claim): (&'a Plan, &'a Claim),
        children: &'a mut Children,
        display: &'a mut Display,
    ) -> Self {
        Self {
            plan,
            claim,
            children,
            display,
            last: pb::Progress::default(),
            n_streams: 0,
            awaits_learner: false,
            started_at: clock::now(),
            wall_before_s: None,
        }
    }

    /// Follows the learner's progress to its end, and keeps the processes alive.
    async fn follow(mut self, interrupted: &CancellationToken) -> Result<pb::Progress, Broken> {
        if interrupted.is_cancelled() {
            return Ok(self.last);
        }
        let mut heard: mpsc::Receiver<Heard> = watch::follow(self.children.learner_address())?;
        let mut look = tokio::time::interval(LOOK_EVERY);
        let mut measure = tokio::time::interval(MEASURE_EVERY);
        loop {
            tokio::select! {
                Some(heard) = heard.recv() => {
                    self.hear(heard);
                    if self.last.ended {
                        return Ok(self.last);
                    }
                }
                _ = look.tick() => {
                    if self.look_after_processes()? {
                        return Ok(self.last);
                    }
                }
                _ = measure.tick() => self.children.sample_memory(),
                () = interrupted.cancelled() => return Ok(self.last),
            }
        }
    }

    /// Takes in a message. A learner that starts, or that tells of an error as it ends, has nothing to add: what
    /// follows from its end is decided when it has ended.
    fn hear(&mut self, Heard { n_streams_before, progress }: Heard) {
        let is_new = n_streams_before != self.n_streams;
        if progress.task.is_empty() || (progress.ended && progress.digest.is_empty()) {
            return;
        }
        self.n_streams = n_streams_before;
        if self.last.task.is_empty()
            && let Err(failed) = self.plan.keep_teacher()
        {
            self.display.say(&format!("{:#}", failed.into_error()));
        }
        if self.awaits_learner && is_new {
            self.awaits_learner = false;
            self.display.say(&format!("the learner continues from round {}", progress.round));
        }
        // A learner that was started again has forgotten the time since its last checkpoint and that of its absence.
        let elapsed_s = self.started_at.elapsed().as_secs_f64();
        let before_s = *self.wall_before_s.get_or_insert((progress.wall_s - elapsed_s).max(0.0));
        self.last = pb::Progress { wall_s: before_s + elapsed_s, ..progress };
        self.display.show(&self.last);
    }

    /// Starts dead processes again. Gives whether the learner was interrupted.
    fn look_after_processes(&mut self) -> Result<bool, Broken> {
        let news = self.children.check(self.plan, self.claim)?;
        news.lines.iter().for_each(|line| self.display.say(line));
        self.awaits_learner |= news.learner_restarted;
        Ok(news.interrupted)
    }
}
