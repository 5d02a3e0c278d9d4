//! `tandem sweep`: many runs, each a `tandem train` of its own, one after another or side by side.
//!
//! All that a sweep knows lies in its runs' directories, so it can be stopped at any point and started again: finished
//! runs are left alone, a run under way goes on from its checkpoint.

mod child;
mod display;
mod file;
mod standing;

use std::collections::VecDeque;
use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, anyhow, bail};
use serde_json::{Value, json};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use crate::cli::SweepArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{output, services, signals};
use child::{Ended, Start};
use display::Display;
use standing::{Standing, State};

/// How often the live lines are brought up to date.
const REFRESH_EVERY: Duration = Duration::from_secs(1);
/// Refused runs that are named before the rest is counted.
const MAX_NAMED: usize = 3;

pub(crate) fn sweep(args: &SweepArgs) -> Result<(), Failed> {
    let out = args.out.clone().unwrap_or_else(|| default_out(&args.file));
    let planned = file::read(&args.file)?;
    let lock = if args.dry_run { None } else { Some(lock(&out).or_cannot_write(String::new)?) };
    let mut standings = Vec::new();
    let mut refused = Vec::new();
    for run in planned {
        match Standing::of(run, &out) {
            Ok(standing) => standings.push(standing),
            Err(error) => refused.push(format!("{error:#}")),
        }
    }
    refuse(&refused, &out)?;
    if args.dry_run {
        return print_plan(&standings, &out, args.json);
    }
    let runtime = services::runtime().or_exit(Exit::TryAgain, String::new)?;
    let is_whole = runtime.block_on(async {
        let interrupted = signals::shutdown_token(false).or_exit(Exit::TryAgain, String::new)?;
        Sweep::new(standings.as_mut_slice(), usize::from(args.jobs)).run(&interrupted).await
    })?;
    drop(lock);
    if !is_whole {
        tell_how_to_go_on(args, &out);
        return Err(Failed::new(Exit::Interrupted, anyhow!("interrupted")));
    }
    print_result(&standings, &out, args.json)
        .map_err(|failed| failed.context(format!("the runs have ended, see {}", out.display())))?;
    failures(&standings)
}

/// `runs/` and the sweep file's name.
fn default_out(file: &Path) -> PathBuf {
    Path::new("runs").join(file.file_stem().unwrap_or(file.as_os_str()))
}

/// Makes `out` and keeps a second sweep out of it for as long as the file lives.
fn lock(out: &Path) -> anyhow::Result<File> {
    std::fs::create_dir_all(out).with_context(|| format!("cannot make {}", out.display()))?;
    let path = out.join("sweep.lock");
    let file = File::create(&path).with_context(|| format!("cannot write {}", path.display()))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => bail!("another sweep works in {}", out.display()),
        Err(TryLockError::Error(error)) => {
            Err(error).with_context(|| format!("cannot lock {}", path.display()))
        }
    }
}

/// Refuses to start when runs were made with other settings than the file's.
fn refuse(refused: &[String], out: &Path) -> Result<(), Failed> {
    if refused.is_empty() {
        return Ok(());
    }
    let named = refused.iter().take(MAX_NAMED).cloned().collect::<Vec<_>>().join("; ");
    let more = match refused.len().saturating_sub(MAX_NAMED) {
        0 => String::new(),
        n => format!("; and {n} more"),
    };
    Err(Failed::usage(format!(
        "{named}{more}: choose another --out than {}, or undo the change",
        out.display()
    )))
}

/// The runs of a sweep under way.
struct Sweep<'a> {
    standings: &'a mut [Standing],
    /// Indices of runs that wait for their turn.
    waiting: VecDeque<usize>,
    n_jobs: usize,
    display: Display,
}

impl<'a> Sweep<'a> {
    fn new(standings: &'a mut [Standing], n_jobs: usize) -> Self {
        let is_open =
            |(_, standing): &(usize, &Standing)| !matches!(standing.state, State::Finished(_));
        let waiting: VecDeque<usize> =
            standings.iter().enumerate().filter(is_open).map(|(idx, _)| idx).collect();
        let n_finished = standings.len() - waiting.len();
        let display = Display::new(standings.len(), n_finished);
        if n_finished > 0 {
            display.say(&format!("{n_finished} of {} runs are finished already", standings.len()));
        }
        for standing in standings.iter() {
            if let Some(why) = &standing.failure {
                display
                    .say(&format!("{} failed before and is tried again: {why}", standing.run.name));
            }
        }
        Self { standings, waiting, n_jobs, display }
    }

    /// Plays every run that is not finished; whether none was left when it ended.
    async fn run(mut self, interrupted: &CancellationToken) -> Result<bool, Failed> {
        let mut running: JoinSet<(usize, Ended)> = JoinSet::new();
        let mut refresh = tokio::time::interval(REFRESH_EVERY);
        loop {
            while running.len() < self.n_jobs && !interrupted.is_cancelled() {
                let Some(idx) = self.waiting.pop_front() else { break };
                self.start(idx, &mut running, interrupted)?;
            }
            if running.is_empty() {
                break;
            }
            tokio::select! {
                Some(ended) = running.join_next() => {
                    let (idx, ended) = ended.or_exit(Exit::Bug, String::new)?;
                    self.end(idx, ended)?;
                }
                _ = refresh.tick() => self.display.refresh(),
                () = interrupted.cancelled() => break,
            }
        }
        self.display.close();
        if interrupted.is_cancelled() {
            return self.save(running).await;
        }
        Ok(true)
    }

    /// Waits until the runs that are under way have saved. A second interruption ends them at once.
    async fn save(mut self, mut running: JoinSet<(usize, Ended)>) -> Result<bool, Failed> {
        self.display.say("interrupted: saving, a second Ctrl-C ends at once");
        let again = signals::shutdown_token(false).or_exit(Exit::TryAgain, String::new)?;
        loop {
            tokio::select! {
                ended = running.join_next() => match ended {
                    Some(ended) => {
                        let (idx, ended) = ended.or_exit(Exit::Bug, String::new)?;
                        self.end(idx, ended)?;
                    }
                    None => break,
                },
                () = again.cancelled() => break,
            }
        }
        Ok(self.standings.iter().all(|standing| matches!(standing.state, State::Finished(_))))
    }

    fn start(
        &mut self,
        idx: usize,
        running: &mut JoinSet<(usize, Ended)>,
        interrupted: &CancellationToken,
    ) -> Result<(), Failed> {
        let start =
            Start::of(&self.standings[idx], self.workers_per_run()).or_cannot_write(String::new)?;
        self.display.started(&start.name, start.log_path());
        let stop = interrupted.clone();
        running.spawn(async move { (idx, start.play(stop).await) });
        Ok(())
    }

    /// Runs side by side share the cores; a run alone takes what it likes.
    fn workers_per_run(&self) -> Option<usize> {
        let n_cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        (self.n_jobs > 1).then(|| (n_cores / self.n_jobs).max(1))
    }

    fn end(&mut self, idx: usize, ended: Ended) -> Result<(), Failed> {
        let standing = &mut self.standings[idx];
        let name = standing.run.name.clone();
        match ended {
            Ended::Done(summary) => {
                let line = display::reached(&summary);
                standing.finish(summary).or_exit(Exit::TryAgain, String::new)?;
                self.display.ended(&name, &line);
            }
            Ended::Failed(why) => {
                self.display.ended(&name, &format!("failed: {why}"));
                standing.fail(why).or_exit(Exit::TryAgain, String::new)?;
            }
            Ended::Interrupted => self.display.say(&format!("{name}: saved")),
        }
        Ok(())
    }
}

fn print_plan(standings: &[Standing], out: &Path, as_json: bool) -> Result<(), Failed> {
    if as_json {
        let runs: Vec<Value> = standings
            .iter()
            .map(|standing| {
                json!({"name": standing.run.name, "state": standing.todo(), "failure": standing.failure})
            })
            .collect();
        return output::print(json!({"out": out, "runs": runs}));
    }
    for standing in standings {
        let failure = standing.failure.as_ref();
        let failure = failure.map_or_else(String::new, |why| format!(", failed before: {why}"));
        output::print(format_args!("{:<10}{}{failure}", standing.todo(), standing.run.name))?;
    }
    output::print(format_args!("{} runs in {}", standings.len(), out.display()))
}

fn print_result(standings: &[Standing], out: &Path, as_json: bool) -> Result<(), Failed> {
    let n_finished = standings.iter().filter(|one| matches!(one.state, State::Finished(_))).count();
    if as_json {
        let runs: Vec<Value> = standings
            .iter()
            .map(|standing| {
                let summary = match &standing.state {
                    State::Finished(summary) => summary.clone(),
                    State::New | State::Begun => Value::Null,
                };
                json!({"name": standing.run.name, "summary": summary, "failure": standing.failure})
            })
            .collect();
        return output::print(json!({"out": out, "finished": n_finished, "runs": runs}));
    }
    output::print(format_args!(
        "finished      {n_finished} of {} runs in {}",
        standings.len(),
        out.display()
    ))?;
    output::print(format_args!("compare them  tandem report {}", out.display()))
}

/// An error that names the runs that failed, when some did.
fn failures(standings: &[Standing]) -> Result<(), Failed> {
    let failed: Vec<&str> = standings
        .iter()
        .filter(|standing| standing.failure.is_some())
        .map(|standing| standing.run.name.as_str())
        .collect();
    if failed.is_empty() {
        return Ok(());
    }
    let error = anyhow!(
        "{} of {} runs failed and are tried again at the next start: {}; see sweep.log in their directories",
        failed.len(),
        standings.len(),
        failed.join(", ")
    );
    Err(Failed::new(Exit::TryAgain, error))
}

fn tell_how_to_go_on(args: &SweepArgs, out: &Path) {
    let jobs = if args.jobs > 1 { format!(" --jobs {}", args.jobs) } else { String::new() };
    output::message("interrupted; the state is saved. Go on with:");
    output::message(format_args!(
        "  tandem sweep {} --out {}{jobs}",
        args.file.display(),
        out.display()
    ));
}
