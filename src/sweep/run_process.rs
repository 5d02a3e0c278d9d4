//! One run of the sweep: a `tandem train` process.
//!
//! The run saves and exits when the sweep closes its standard input or dies. Its lines go to `sweep.log` in the run
//! directory, which stays locked as long as a process has it open. A run is started again once this log and the locks of
//! `tandem train`, the learner and the teacher are free.

use std::ffi::OsString;
use std::fs::TryLockError;
use std::path::PathBuf;
use std::pin::pin;
use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use anyhow::Context as _;
use serde_json::Value;
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::process::ChildStdout;
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;

use super::run_status::{self, RunStatus, State};
use super::sweep_file::PlannedRun;
use crate::cli::EnvironmentArgs;
use crate::exit::Failed;
use crate::launch::{Launcher, ProcessLog, last_line};
use crate::train::run_lock;
use crate::{environment_server, run_directory, run_file};

/// Time that a run has to save and exit.
const END_TIMEOUT: Duration = Duration::from_mins(11);
/// Time between two attempts to lock the log.
const RETRY_EVERY: Duration = Duration::from_millis(100);

/// A run that can be started.
#[derive(Debug)]
pub(super) struct RunProcess {
    run: PlannedRun,
    dir: PathBuf,
    /// Arguments that do not depend on how far the run is.
    args: Vec<OsString>,
}

/// The end of a run.
#[derive(Debug, PartialEq)]
pub(super) enum RunOutcome {
    /// The run is complete, with this summary on the last line of its output.
    Complete(Value),
    /// The run was asked to exit and is saved.
    Interrupted,
    /// The run was not started: another process still uses its directory.
    InUse,
    /// The run failed for this reason.
    Failed(String),
}

impl RunProcess {
    /// Prepares the directory of an unfinished run. With `n_workers` of `None`, `tandem train` chooses the number. With
    /// `has_dashboard`, the run serves a page of its own.
    pub(super) fn prepare(
        status: &RunStatus,
        environment: &EnvironmentArgs,
        n_workers: Option<usize>,
        has_dashboard: bool,
    ) -> anyhow::Result<Self> {
        let RunStatus { run, dir, .. } = status;
        std::fs::create_dir_all(dir).with_context(|| format!("cannot create {}", dir.display()))?;
        let mut args: Vec<OsString> = vec![
            "train".into(),
            "--exit-with-stdin".into(),
            "--json".into(),
            "--progress-json".into(),
            "--out".into(),
            dir.into(),
        ];
        if !has_dashboard {
            args.push("--no-dashboard".into());
        }
        if let Some(n_workers) = n_workers {
            args.extend(["--workers".into(), n_workers.to_string().into()]);
        }
        args.extend(environment_server::arguments(environment));
        Ok(Self { run: run.clone(), dir: dir.clone(), args })
    }

    /// Returns the name of the run.
    pub(super) fn name(&self) -> &str {
        &self.run.name
    }

    /// Runs to the end, or until `stop` asks the run to save and exit. Messages about the progress go to `progress`, lines
    /// for the user to `lines`.
    pub(super) async fn run(
        self,
        stop: CancellationToken,
        progress: watch::Sender<Value>,
        lines: mpsc::Sender<String>,
    ) -> RunOutcome {
        match self.try_run(&stop, &progress, &lines).await {
            Ok(outcome) => outcome,
            Err(error) => RunOutcome::Failed(format!("{error:#}")),
        }
    }

    async fn try_run(
        &self,
        stop: &CancellationToken,
        progress: &watch::Sender<Value>,
        lines: &mpsc::Sender<String>,
    ) -> anyhow::Result<RunOutcome> {
        let log = ProcessLog::open(&self.log_path())?;
        let wait = || {
            let (name, dir) = (self.name(), self.dir.display());
            // A full queue has older lines for the user.
            drop(lines.try_send(format!("{name}: waits for another process that uses {dir}")));
        };
        let mut is_log_locked = false;
        let taken = retry(stop, wait, || {
            is_log_locked = is_log_locked || lock(&log)?.is_some();
            match is_log_locked {
                true => run_lock::unused(&self.dir).map_err(Failed::into_error),
                false => Ok(None),
            }
        });
        let unused = match taken.await? {
            Taken::Yes(unused) => unused,
            Taken::Stopped => return Ok(RunOutcome::Interrupted),
            Taken::TooLate => return Ok(RunOutcome::InUse),
        };
        // The processes of another sweep may have changed the run while this one waited for them.
        let mut args = self.args.clone();
        match run_status::state(&self.run, &self.dir)? {
            (State::Finished(summary), _) => return Ok(RunOutcome::Complete(summary)),
            (State::Started, extends_to) => {
                args.extend(resume_arguments(extends_to));
                if !run_status::has_teacher_copy(&self.run, &self.dir) {
                    args.extend(self.teacher_arguments());
                }
            }
            (State::New, _) => args.extend(self.start_arguments()?),
        }
        drop(unused);
        let launcher = Launcher::new(log)?;
        let mut child =
            launcher.spawn(&args, Stdio::piped()).context("cannot start tandem train")?;
        let log_offset = child.log_offset();
        let stdin = child.take_input();
        let stdout = child.take_output()?;
        let mut last_line = String::new();
        let status = {
            let read = async {
                let (status, last) = tokio::join!(child.wait(), follow(stdout, progress));
                last_line = last;
                status
            };
            let mut ended = pin!(read);
            tokio::select! {
                status = &mut ended => status,
                () = stop.cancelled() => {
                    drop(stdin);
                    let in_time = tokio::time::timeout(END_TIMEOUT, ended).await;
                    in_time.unwrap_or_else(|late| Err(late.into()))
                }
            }
        };
        let status = status.context("the run did not exit in time and is killed")?;
        let log = launcher.log();
        Ok(outcome(status, &last_line, || last_log_line(log, log_offset), stop))
    }

    /// Writes the run file of a new run, and returns the arguments that start it.
    fn start_arguments(&self) -> anyhow::Result<Vec<OsString>> {
        let mut args = vec!["--run".into(), self.write_run_file()?.into()];
        args.extend(self.teacher_arguments());
        Ok(args)
    }

    fn teacher_arguments(&self) -> impl Iterator<Item = OsString> {
        self.run.teacher.iter().flat_map(|path| ["--teacher".into(), path.into()])
    }

    /// Writes the resolved settings of a new run next to the run file of `tandem train`.
    fn write_run_file(&self) -> anyhow::Result<PathBuf> {
        let path = self.dir.join("sweep.toml");
        let leftover = self.dir.join("run.toml");
        if leftover.exists() {
            // A run of `State::New` has learned nothing, so its run file can be replaced.
            std::fs::remove_file(&leftover)
                .with_context(|| format!("cannot remove {}", leftover.display()))?;
            // The verdicts of its teacher are those of other settings.
            let ledger = run_directory::ledger(&self.dir);
            for suffix in ["", "-wal", "-shm"] {
                let mut path = ledger.clone().into_os_string();
                path.push(suffix);
                drop(std::fs::remove_file(path));
            }
        }
        let text = run_file::to_toml(&self.run.config)?;
        std::fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))?;
        Ok(path)
    }

    /// Returns the path of the run's log.
    pub(super) fn log_path(&self) -> PathBuf {
        self.dir.join("sweep.log")
    }
}

/// Sends every message of a run to `progress`, and returns the last line of its output.
async fn follow(output: ChildStdout, progress: &watch::Sender<Value>) -> String {
    let mut lines = BufReader::new(output).lines();
    let mut last = String::new();
    while let Ok(Some(line)) = lines.next_line().await {
        if let Ok(message) = serde_json::from_str::<Value>(&line)
            && !is_summary(&message)
        {
            progress.send_replace(message);
        }
        last = line;
    }
    last
}

/// Returns true if a line of output is the summary of a run, and not a message about its progress.
fn is_summary(object: &Value) -> bool {
    object.get("digest").is_some() && object.get("phase").is_none()
}

fn outcome(
    status: ExitStatus,
    last_output_line: &str,
    last_log_line: impl FnOnce() -> String,
    stop: &CancellationToken,
) -> RunOutcome {
    let summary = || -> Option<Value> {
        let summary: Value = serde_json::from_str(last_output_line).ok()?;
        is_summary(&summary).then_some(summary)
    };
    match (status.success().then(summary).flatten(), status.code()) {
        (Some(summary), _) => RunOutcome::Complete(summary),
        (None, Some(130)) if stop.is_cancelled() => RunOutcome::Interrupted,
        (None, _) => RunOutcome::Failed(format!("{status}: {}", last_log_line())),
    }
}

/// Returns the arguments that continue a run, to the length `extends_to` if it is longer than before.
fn resume_arguments(extends_to: Option<u64>) -> Vec<OsString> {
    let mut args = vec!["--resume".into()];
    let length = |env_steps: u64| ["--max-env-steps".into(), env_steps.to_string().into()];
    args.extend(extends_to.into_iter().flat_map(length));
    args
}

/// Locks a log; `None` while another process has locked it.
fn lock(log: &ProcessLog) -> anyhow::Result<Option<()>> {
    match log.file().try_lock() {
        Ok(()) => Ok(Some(())),
        Err(TryLockError::WouldBlock) => Ok(None),
        Err(TryLockError::Error(error)) => {
            Err(error).with_context(|| format!("cannot lock {}", log.path().display()))
        }
    }
}

/// The result of waiting for the other processes of a run.
#[derive(Debug, PartialEq, Eq)]
enum Taken<T> {
    Yes(T),
    /// The run was asked to exit first.
    Stopped,
    /// A process still uses the run after the time that it may take to save and exit.
    TooLate,
}

/// Repeats `take` until it returns a value, `stop` is cancelled, or a process that uses the run should have saved and
/// exited. Calls `on_wait` before the first pause.
async fn retry<T>(
    stop: &CancellationToken,
    on_wait: impl FnOnce(),
    mut take: impl FnMut() -> anyhow::Result<Option<T>>,
) -> anyhow::Result<Taken<T>> {
    let n_attempts = END_TIMEOUT.as_millis() / RETRY_EVERY.as_millis();
    let mut on_wait = Some(on_wait);
    for _ in 0..n_attempts {
        if let Some(taken) = take()? {
            return Ok(Taken::Yes(taken));
        }
        if let Some(on_wait) = on_wait.take() {
            on_wait();
        }
        tokio::select! {
            () = tokio::time::sleep(RETRY_EVERY) => {}
            () = stop.cancelled() => return Ok(Taken::Stopped),
        }
    }
    Ok(Taken::TooLate)
}

/// Returns the last line of the log since it had `offset` bytes.
fn last_log_line(log: &ProcessLog, offset: u64) -> String {
    last_line(&log.text_since(offset)).unwrap_or("it logged nothing").to_owned()
}

#[cfg(test)]
mod tests {
    use std::os::unix::process::ExitStatusExt as _;

    use super::*;

    #[test]
    fn the_outcome_follows_from_the_exit_code_and_the_last_line() {
        let stopped = CancellationToken::new();
        stopped.cancel();
        let running = CancellationToken::new();
        let last_log_line = || "tandem: no".to_owned();
        let check = |code: i32, output: &str, stop: &CancellationToken, expected: &RunOutcome| {
            let status = ExitStatus::from_raw(code << 8);
            assert_eq!(
                outcome(status, output, last_log_line, stop),
                *expected,
                "{code} {output:?}"
            );
        };
        let done = RunOutcome::Complete(serde_json::json!({"digest": "d"}));
        check(0, "{\"digest\":\"d\"}", &running, &done);
        check(0, "{\"digest\":\"d\"}", &stopped, &done);
        check(130, "", &stopped, &RunOutcome::Interrupted);
        let failed = |code: i32| RunOutcome::Failed(format!("exit status: {code}: tandem: no"));
        check(130, "", &running, &failed(130));
        check(75, "", &stopped, &failed(75));
        check(0, "no summary", &running, &failed(0));
        check(0, "{\"digest\":\"d\",\"phase\":\"ended\"}", &running, &failed(0));
        check(70, "{\"digest\":\"d\"}", &running, &failed(70));
    }

    #[tokio::test(start_paused = true)]
    async fn a_run_in_use_is_waited_for_and_no_failure() {
        let running = CancellationToken::new();
        let mut n_waits = 0;
        let taken = retry(&running, || n_waits += 1, || Ok(None::<()>)).await.expect("no error");
        assert_eq!((taken, n_waits), (Taken::TooLate, 1));
        let mut n_attempts = 0;
        let third = || {
            n_attempts += 1;
            Ok((n_attempts == 3).then_some(()))
        };
        assert_eq!(retry(&running, || (), third).await.expect("no error"), Taken::Yes(()));
        running.cancel();
        let stopped = retry(&running, || (), || Ok(None::<()>)).await.expect("no error");
        assert_eq!(stopped, Taken::Stopped);
    }

    #[test]
    fn the_last_line_is_one_of_this_start() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = dir.path().join("sweep.log");
        std::fs::write(&path, "tandem: before\n").expect("writes");
        let log = ProcessLog::open(&path).expect("opens");
        assert_eq!(last_log_line(&log, 15), "it logged nothing");
        std::fs::write(&path, "tandem: before\n00:01 round 1\ntandem: now\n\n").expect("writes");
        assert_eq!(last_log_line(&log, 15), "tandem: now");
    }
}
