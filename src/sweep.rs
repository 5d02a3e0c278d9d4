//! `tandem sweep`: trains a list of runs, each in a `tandem train` process, one after another or concurrently.
//!
//! The state of a sweep is in the directories of its runs, so a sweep can be stopped and restarted at any point.
//! Finished runs are skipped, and unfinished runs are resumed from their checkpoints.

mod board;
mod display;
mod result;
mod run_process;
mod run_status;
mod sweep_file;
mod teachers;

use std::collections::VecDeque;
use std::fs::{File, TryLockError};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::pin::pin;
use std::time::Duration;

use anyhow::{Context as _, anyhow, bail};
use serde_json::{Value, json};
use tandem_core::text::counted;
use tandem_core::{Task, World};
use tandem_dashboard::Site;
use tandem_net::is_exposed;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::cli::{EnvironmentArgs, SweepArgs};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::shell::shell_word;
use crate::{dashboard, output, runtime, signals};
use board::Board;
use display::Display;
use result::{Unfinished, print_result};
use run_process::{RunOutcome, RunProcess};
use run_status::{LENGTH, RunStatus, State};
use sweep_file::{PlannedRun, PlannedSweep};

/// Time between two updates of the live lines and of the dashboard.
const REFRESH_EVERY: Duration = Duration::from_millis(500);
/// Time that pages have to receive the end of the sweep, and then to fetch the documents that changed with it.
const FAREWELL: Duration = Duration::from_secs(2);
/// Maximum number of rejected runs that an error names.
const MAX_NAMED: usize = 3;

pub(crate) fn sweep(args: &SweepArgs) -> Result<(), Failed> {
    let out = args.out.clone().unwrap_or_else(|| default_out(&args.file));
    let PlannedSweep { runs, environment } = sweep_file::read(&args.file)?;
    let runs = match args.only {
        Some(only) => vec![selected(runs, only)?],
        None => runs,
    };
    if out.join("run.toml").exists() {
        return Err(Failed::usage(format!("{} holds a run: choose another --out", out.display())));
    }
    let mut statuses = Vec::new();
    let mut refused = Vec::new();
    for run in runs {
        match RunStatus::of(run, &out) {
            Ok(status) => statuses.push(status),
            Err(error) => refused.push(format!("{error:#}")),
        }
    }
    refuse(&refused, &out)?;
    let checked = teachers::check(&statuses);
    if args.dry_run {
        // The teachers may be trained later.
        if let Err(failed) = checked {
            output::message(failed.line());
        }
        return print_plan((args.only.unwrap_or(0), &statuses), &out, args.json);
    }
    checked?;
    if let Some(note) = classic_note(&statuses) {
        output::message(note);
    }
    let address = dashboard::address(&args.dashboard)?;
    // A refused sweep leaves no files. Each run is checked again when it is started.
    let lock = lock(&out, args.only.is_some()).or_cannot_write(String::new)?;
    let runtime = runtime::new().or_exit(Exit::TryAgain, String::new)?;
    let end = runtime.block_on(async {
        let interrupted = signals::shutdown_token(false)?;
        let n_jobs = usize::from(args.jobs);
        let mut sweep = Sweep::new(statuses.as_mut_slice(), n_jobs, &environment);
        let served = match address {
            Some(address) => sweep.serve(args, &out, address).await?,
            None => None,
        };
        let end = sweep.run(&interrupted).await;
        if served.is_some() {
            tokio::time::sleep(FAREWELL).await;
        }
        end
    })?;
    drop(lock);
    if end != SweepEnd::Complete {
        print_resume_command(args, &out, end);
        return Err(Failed::new(Exit::Interrupted, anyhow!("interrupted")));
    }
    print_result(&statuses, &out, args.json)
        .map_err(|failed| failed.context(format!("the runs have ended, see {}", out.display())))?;
    Unfinished::of(&statuses).check()
}

/// Returns `runs/NAME`, after the sweep file.
fn default_out(file: &Path) -> PathBuf {
    Path::new("runs").join(file.file_stem().unwrap_or(file.as_os_str()))
}

/// Returns run `only` of the list.
fn selected(mut runs: Vec<PlannedRun>, only: usize) -> Result<PlannedRun, Failed> {
    if only >= runs.len() {
        let last = runs.len() - 1;
        return Err(Failed::usage(format!(
            "--only {only}: expected 0 to {last}, the file lists {} runs",
            last + 1
        )));
    }
    Ok(runs.swap_remove(only))
}

/// Creates `out` and locks it until the returned file is closed: against another sweep or, if `is_shared`, against
/// sweeps of all runs only. Each run locks its own directory.
fn lock(out: &Path, is_shared: bool) -> anyhow::Result<File> {
    std::fs::create_dir_all(out).with_context(|| format!("cannot create {}", out.display()))?;
    let path = out.join("sweep.lock");
    // NFS grants a shared lock only to a file that is open for reading, and an exclusive one only to a file that is open
    // for writing.
    let mut options = File::options();
    let opened = options.read(true).write(true).create(true).truncate(false).open(&path);
    let file = opened.with_context(|| format!("cannot write {}", path.display()))?;
    let locked = if is_shared { file.try_lock_shared() } else { file.try_lock() };
    match locked {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => bail!("another sweep uses {}", out.display()),
        Err(TryLockError::Error(error)) => {
            Err(error).with_context(|| format!("cannot lock {}", path.display()))
        }
    }
}

/// Rejects a sweep whose directory contains runs with other settings.
fn refuse(refused: &[String], out: &Path) -> Result<(), Failed> {
    if refused.is_empty() {
        return Ok(());
    }
    let named = refused.iter().take(MAX_NAMED).cloned().collect::<Vec<_>>().join("; ");
    let more = match refused.len().saturating_sub(MAX_NAMED) {
        0 => String::new(),
        n => format!("; and {n} more"),
    };
    let length = match named.contains(LENGTH) {
        true => format!(" (a larger {LENGTH} extends runs)"),
        false => String::new(),
    };
    Err(Failed::usage(format!(
        "{named}{more}: choose another --out than {}, or undo the change{length}",
        out.display()
    )))
}

/// The end of a sweep.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum SweepEnd {
    /// Every run has ended.
    Complete,
    /// It was interrupted, and the runs have saved and exited.
    Saved,
    /// It was interrupted again while runs were saving.
    Saving,
}

/// A running sweep.
struct Sweep<'a> {
    statuses: &'a mut [RunStatus],
    /// Indices of the runs that are not started yet.
    waiting: VecDeque<usize>,
    n_jobs: usize,
    /// The server of the environments of all runs.
    environment: &'a EnvironmentArgs,
    display: Display,
    /// Lines of runs for the user, at most one of each.
    lines: (mpsc::Sender<String>, mpsc::Receiver<String>),
    /// The content of the dashboard, if there is one.
    board: Option<Board>,
    /// True if each run serves a dashboard of its own, to which that of the sweep links.
    runs_have_dashboards: bool,
}

impl<'a> Sweep<'a> {
    fn new(statuses: &'a mut [RunStatus], n_jobs: usize, environment: &'a EnvironmentArgs) -> Self {
        let is_unfinished =
            |(_, status): &(usize, &RunStatus)| !matches!(status.state, State::Finished(_));
        let waiting: VecDeque<usize> =
            statuses.iter().enumerate().filter(is_unfinished).map(|(idx, _)| idx).collect();
        let n_finished = statuses.len() - waiting.len();
        let display = Display::new(statuses.len(), n_finished);
        if n_finished > 0 {
            display.print(&format!("{n_finished} of {} runs are already finished", statuses.len()));
        }
        for status in statuses.iter() {
            if let Some(why) = &status.failure {
                display.print(&format!("{} failed before and is retried: {why}", status.run.name));
            }
        }
        let n_extended = statuses.iter().filter(|status| status.extends_to.is_some()).count();
        if n_extended > 0 {
            display.print(&format!("{} to a larger {LENGTH}", extends(n_extended)));
        }
        let lines = mpsc::channel(statuses.len().max(1));
        let board = None;
        let runs_have_dashboards = false;
        Self { statuses, waiting, n_jobs, environment, display, lines, board, runs_have_dashboards }
    }

    /// Serves the dashboard until the returned value is dropped; without a free port, there is none.
    async fn serve(
        &mut self,
        args: &SweepArgs,
        out: &Path,
        address: SocketAddr,
    ) -> Result<Option<DropGuard>, Failed> {
        let token_file = args.dashboard.dashboard_token_file.as_deref();
        let access = dashboard::access("--dashboard", address, token_file, false)?;
        let bound = dashboard::bind_free(address).await;
        let listener = match bound.and_then(|it| Ok((it.local_addr()?, it))) {
            Ok((address, listener)) => {
                self.display.print(&format!("dashboard on {}", dashboard::url(address)));
                listener
            }
            Err(error) => {
                self.display.print(&format!("no dashboard: {error}"));
                return Ok(None);
            }
        };
        // The pages of runs are on this machine, so pages that others see do not link to them.
        self.runs_have_dashboards = !is_exposed(address);
        let name = args.file.file_stem().unwrap_or_default().to_string_lossy();
        let board = Board::new(&name, out, self.n_jobs, self.statuses);
        let stop = CancellationToken::new();
        let site = Site::of_sweep(board.views());
        drop(tokio::spawn(dashboard::serve(site, access, listener, stop.clone())));
        self.board = Some(board);
        Ok(Some(stop.drop_guard()))
    }

    /// Trains every unfinished run, until all of them have ended or `interrupted` is cancelled.
    async fn run(mut self, interrupted: &CancellationToken) -> Result<SweepEnd, Failed> {
        let mut running: JoinSet<(usize, RunOutcome)> = JoinSet::new();
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
                Some(joined) = running.join_next() => {
                    let (idx, outcome) = joined.or_exit(Exit::Bug, String::new)?;
                    self.handle_outcome(idx, outcome)?;
                }
                Some(line) = self.lines.1.recv() => self.display.print(&line),
                _ = refresh.tick() => {
                    self.display.refresh();
                    if let Some(board) = &mut self.board {
                        board.refresh(self.statuses);
                    }
                }
                () = interrupted.cancelled() => break,
            }
        }
        self.display.close();
        if interrupted.is_cancelled() {
            return self.save(running).await;
        }
        let end = Unfinished::of(self.statuses).summary();
        self.end(&end);
        Ok(SweepEnd::Complete)
    }

    /// Shows the end of the sweep on the dashboard.
    fn end(&mut self, how: &str) {
        if let Some(board) = &mut self.board {
            board.end(how);
        }
    }

    /// Waits until the running runs have saved. A second interruption ends them at once.
    async fn save(mut self, mut running: JoinSet<(usize, RunOutcome)>) -> Result<SweepEnd, Failed> {
        self.display.print("interrupted: saving, a second Ctrl-C ends at once");
        let mut interrupted_again = pin!(signals::second_shutdown());
        let end = loop {
            tokio::select! {
                joined = running.join_next() => match joined {
                    Some(joined) => {
                        let (idx, outcome) = joined.or_exit(Exit::Bug, String::new)?;
                        self.handle_outcome(idx, outcome)?;
                    }
                    None => break SweepEnd::Saved,
                },
                again = &mut interrupted_again => break again.map(|()| SweepEnd::Saving)?,
            }
        };
        self.end("interrupted");
        let is_complete =
            self.statuses.iter().all(|status| matches!(status.state, State::Finished(_)));
        Ok(if is_complete { SweepEnd::Complete } else { end })
    }

    fn start(
        &mut self,
        idx: usize,
        running: &mut JoinSet<(usize, RunOutcome)>,
        interrupted: &CancellationToken,
    ) -> Result<(), Failed> {
        let (status, n_workers) = (&self.statuses[idx], self.workers_per_run());
        let has_dashboard = self.runs_have_dashboards;
        let run = match RunProcess::prepare(status, self.environment, n_workers, has_dashboard) {
            Ok(run) => run,
            Err(error) => {
                return self.handle_outcome(idx, RunOutcome::Failed(format!("{error:#}")));
            }
        };
        self.statuses[idx].begin();
        self.display.started(run.name(), run.log_path());
        let (sender, progress) = watch::channel(Value::Null);
        if let Some(board) = &mut self.board {
            board.started(idx, progress);
        }
        let stop = interrupted.clone();
        let lines = self.lines.0.clone();
        running.spawn(async move { (idx, run.run(stop, sender, lines).await) });
        Ok(())
    }

    /// Returns the number of workers of each of several concurrent runs, which share the cores. A single run chooses it
    /// itself.
    fn workers_per_run(&self) -> Option<usize> {
        let n_cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        (self.n_jobs > 1).then(|| (n_cores / self.n_jobs).max(1))
    }

    fn handle_outcome(&mut self, idx: usize, outcome: RunOutcome) -> Result<(), Failed> {
        let status = &mut self.statuses[idx];
        let name = status.run.name.clone();
        match outcome {
            RunOutcome::Complete(summary) => {
                let line = display::summary_line(&summary);
                status.finish(summary);
                self.display.ended(&name, &line);
            }
            RunOutcome::Failed(why) => {
                self.display.ended(&name, &format!("failed: {why}"));
                // A full disk may have ended the run; the other runs continue.
                if let Err(error) = status.fail(why) {
                    self.display.print(&format!("{name}: the cause is not saved: {error:#}"));
                }
            }
            RunOutcome::InUse => {
                let why = format!("another process still uses {}", status.dir.display());
                self.display.ended(&name, &format!("left out: {why}"));
                status.leave_out(why);
            }
            RunOutcome::Interrupted => self.display.print(&format!("{name}: interrupted")),
        }
        if let Some(board) = &mut self.board {
            board.ended(idx, &self.statuses[idx]);
        }
        Ok(())
    }
}

/// Returns `1 run is extended` or `N runs are extended`.
fn extends(n_runs: usize) -> String {
    let verb = if n_runs == 1 { "is" } else { "are" };
    format!("{} {verb} extended", counted(n_runs, "run"))
}

/// Prints the runs with the numbers that `--only` takes; that of the first is `first`.
fn print_plan(
    (first, statuses): (usize, &[RunStatus]),
    out: &Path,
    as_json: bool,
) -> Result<(), Failed> {
    let numbered = statuses.iter().zip(first..);
    if as_json {
        let run = |(status, number): (&RunStatus, usize)| {
            let (name, state) = (&status.run.name, status.state_name());
            json!({"index": number, "name": name, "state": state, "failure": status.failure})
        };
        let runs: Vec<Value> = numbered.map(run).collect();
        return output::print(json!({"out": out.to_string_lossy(), "runs": runs}));
    }
    for (status, number) in numbered {
        let failure = status.failure.as_ref();
        let failure = failure.map_or_else(String::new, |why| format!(", failed before: {why}"));
        let (state, name) = (status.state_name(), &status.run.name);
        output::print(format_args!("{number:>3}  {state:<10}{name}{failure}"))?;
    }
    output::print(format_args!("{} in {}", counted(statuses.len(), "run"), out.display()))?;
    classic_note(statuses).map_or(Ok(()), output::print)
}

/// Returns a note if runs are of the classic world, whose tasks have the names that `tandem train --task` has for those of
/// its default world.
fn classic_note(statuses: &[RunStatus]) -> Option<&'static str> {
    let mut tasks =
        statuses.iter().filter_map(|status| status.run.config.task.parse::<Task>().ok());
    tasks.any(|task| task.world() == World::Classic).then_some(
        "push and pick-and-place are in the classic world here; shared-push and\n  \
         shared-pick-and-place are the tasks of `tandem train`'s default world",
    )
}

fn print_resume_command(args: &SweepArgs, out: &Path, end: SweepEnd) {
    let options = match args.only {
        Some(only) => format!(" --only {only}"),
        None if args.jobs > 1 => format!(" --jobs {}", args.jobs),
        None => String::new(),
    };
    let options = format!("{options}{}", args.dashboard.shell_words());
    output::message(match end {
        SweepEnd::Saving => {
            "interrupted; runs may still be saving, which the next start waits for. Resume with:"
        }
        SweepEnd::Complete | SweepEnd::Saved => "interrupted; the state is saved. Resume with:",
    });
    output::message(format_args!(
        "  tandem sweep {} --out {}{options}",
        shell_word(&args.file),
        shell_word(out)
    ));
}

#[cfg(test)]
mod tests {
    use std::io::{Read as _, Write as _};

    use super::*;

    #[test]
    fn only_a_run_of_another_length_is_refused_with_what_extends_it() {
        let refused = |difference: &str| {
            let run = format!("a was made with other settings: {difference}");
            refuse(&[run], Path::new("runs/s")).expect_err("another run").line()
        };
        let shorter = refused("stop.max_env_steps is 800 there, 400 now");
        assert!(shorter.ends_with("undo the change (a larger stop.max_env_steps extends runs)"));
        let other_teacher = refused("its teacher is another one");
        assert!(other_teacher.ends_with("than runs/s, or undo the change"), "{other_teacher}");
    }

    #[test]
    fn the_lock_file_is_open_for_reading_and_for_writing() {
        let keep = tempfile::tempdir().expect("a directory");
        for is_shared in [false, true] {
            let mut file = lock(keep.path(), is_shared).expect("free");
            assert_eq!(file.read(&mut [0]).expect("readable"), 0);
            assert_eq!(file.write(&[]).expect("writable"), 0);
        }
    }
}
