//! One run of the sweep: a `tandem train` of its own.
//!
//! The child's standard input stays open as long as the sweep lives. When it closes, because the sweep asks it to end
//! or is dead, the child saves and ends. Its lines go to `sweep.log` in the run directory; whoever has that file open
//! holds a lock on it, so a run that still saves is not started a second time.

use std::fs::{File, OpenOptions, TryLockError};
use std::path::{Path, PathBuf};
use std::pin::pin;
use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use anyhow::{Context as _, anyhow, bail};
use serde_json::Value;
use tokio::io::AsyncReadExt as _;
use tokio::process::Command;
use tokio_util::sync::CancellationToken;

use super::standing::{Standing, State};
use crate::run_file;

/// How long a run may take to save and end once it is asked to.
const END_DEADLINE: Duration = Duration::from_secs(150);
/// How often it is looked whether a run of an earlier sweep has ended.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// What is needed to start a run.
#[derive(Debug)]
pub(super) struct Start {
    pub(super) name: String,
    dir: PathBuf,
    arguments: Vec<std::ffi::OsString>,
}

/// How a run ended.
#[derive(Debug, PartialEq)]
pub(super) enum Ended {
    /// Whole; what it told on its last line.
    Done(Value),
    /// Because it was asked to; it is saved.
    Interrupted,
    /// Otherwise, and why.
    Failed(String),
}

impl Start {
    /// Prepares the directory of a run that is not finished. `n_workers` is `None` where the run shall choose.
    pub(super) fn of(standing: &Standing, n_workers: Option<usize>) -> anyhow::Result<Self> {
        let Standing { run, dir, state, .. } = standing;
        std::fs::create_dir_all(dir).with_context(|| format!("cannot make {}", dir.display()))?;
        let mut arguments: Vec<std::ffi::OsString> = vec![
            "train".into(),
            "--exit-with-stdin".into(),
            "--json".into(),
            "--out".into(),
            dir.into(),
        ];
        if *state == State::Begun {
            arguments.push("--resume".into());
        } else {
            arguments.extend(["--run".into(), write_run_file(standing)?.into()]);
        }
        if let Some(teacher) = run.teacher.as_ref().filter(|_| *state != State::Begun) {
            arguments.extend(["--teacher".into(), teacher.into()]);
        }
        if let Some(n_workers) = n_workers {
            arguments.extend(["--workers".into(), n_workers.to_string().into()]);
        }
        Ok(Self { name: run.name.clone(), dir: dir.clone(), arguments })
    }

    /// Plays the run to its end, or until `stop` asks it to save and end.
    pub(super) async fn play(self, stop: CancellationToken) -> Ended {
        match self.try_play(&stop).await {
            Ok(ended) => ended,
            Err(error) => Ended::Failed(format!("{error:#}")),
        }
    }

    async fn try_play(&self, stop: &CancellationToken) -> anyhow::Result<Ended> {
        let log = locked_log(&self.dir, stop).await?;
        let Some(log) = log else { return Ok(Ended::Interrupted) };
        let said_before = log.metadata().map_or(0, |file| file.len());
        let program = std::env::current_exe().context("cannot find this program's own file")?;
        let mut command = Command::new(program);
        // A process group of its own: Ctrl-C reaches the sweep alone, which then asks its runs to end.
        command.args(&self.arguments).process_group(0).kill_on_drop(true);
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(log);
        let mut child = command.spawn().context("cannot start tandem train")?;
        let stays_open = child.stdin.take();
        let mut output = child.stdout.take().ok_or_else(|| anyhow!("no standard output"))?;
        let mut told = Vec::new();
        let status = {
            let mut ended =
                pin!(async { tokio::join!(child.wait(), output.read_to_end(&mut told)).0 });
            tokio::select! {
                status = &mut ended => status,
                () = stop.cancelled() => {
                    drop(stays_open);
                    let in_time = tokio::time::timeout(END_DEADLINE, ended).await;
                    in_time.unwrap_or_else(|late| Err(late.into()))
                }
            }
        };
        let status = status.context("the run did not end in time and is killed")?;
        Ok(judged(status, &told, || last_words(&self.log_path(), said_before), stop))
    }

    /// Where the run's own lines go.
    pub(super) fn log_path(&self) -> PathBuf {
        log_path(&self.dir)
    }
}

fn judged(
    status: ExitStatus,
    told: &[u8],
    last_words: impl FnOnce() -> String,
    stop: &CancellationToken,
) -> Ended {
    let summary = || -> Option<Value> {
        let text = std::str::from_utf8(told).ok()?;
        let summary: Value = serde_json::from_str(text.lines().last()?).ok()?;
        summary.get("digest").is_some().then_some(summary)
    };
    match (status.success().then(summary).flatten(), status.code()) {
        (Some(summary), _) => Ended::Done(summary),
        (None, Some(130)) if stop.is_cancelled() => Ended::Interrupted,
        (None, _) => Ended::Failed(format!("{status}: {}", last_words())),
    }
}

/// Writes the whole configuration of a new run beside where `tandem train` will keep its own.
fn write_run_file(standing: &Standing) -> anyhow::Result<PathBuf> {
    let path = standing.dir.join("sweep.toml");
    let left = standing.dir.join("run.toml");
    if left.exists() {
        // Nothing was learned with it: see `State::New`.
        std::fs::remove_file(&left).with_context(|| format!("cannot remove {}", left.display()))?;
    }
    let text = run_file::to_toml(&standing.run.config)?;
    std::fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(path)
}

fn log_path(dir: &Path) -> PathBuf {
    dir.join("sweep.log")
}

/// The run's log, open and locked: the lock lives as long as this process or the run itself has the file open. `None`
/// when `stop` came first.
async fn locked_log(dir: &Path, stop: &CancellationToken) -> anyhow::Result<Option<File>> {
    let path = log_path(dir);
    let log = OpenOptions::new().create(true).append(true).open(&path);
    let log = log.with_context(|| format!("cannot write {}", path.display()))?;
    let n_looks = END_DEADLINE.as_millis() / LOOK_EVERY.as_millis();
    for _ in 0..n_looks {
        match log.try_lock() {
            Ok(()) => return Ok(Some(log)),
            Err(TryLockError::WouldBlock) => {}
            Err(TryLockError::Error(error)) => {
                return Err(error).with_context(|| format!("cannot lock {}", path.display()));
            }
        }
        tokio::select! {
            () = tokio::time::sleep(LOOK_EVERY) => {}
            () = stop.cancelled() => return Ok(None),
        }
    }
    bail!("a run of an earlier sweep still works in {}", dir.display())
}

/// The last line that a run said since its log had `from` bytes.
fn last_words(log: &Path, from: u64) -> String {
    let bytes = std::fs::read(log).unwrap_or_default();
    let new = usize::try_from(from).ok().and_then(|from| bytes.get(from..)).unwrap_or_default();
    last_line(new).unwrap_or_else(|| "it said nothing".to_owned())
}

/// The last line that says anything.
pub(super) fn last_line(bytes: &[u8]) -> Option<String> {
    let text = String::from_utf8_lossy(bytes);
    text.lines().rfind(|line| !line.trim().is_empty()).map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use std::os::unix::process::ExitStatusExt as _;

    use super::*;

    #[test]
    fn the_end_of_a_run_is_told_by_its_code_and_its_last_line() {
        let stopped = CancellationToken::new();
        stopped.cancel();
        let goes_on = CancellationToken::new();
        let said = || "tandem: no".to_owned();
        let check = |code: i32, told: &str, stop: &CancellationToken, expected: &Ended| {
            let status = ExitStatus::from_raw(code << 8);
            assert_eq!(judged(status, told.as_bytes(), said, stop), *expected, "{code} {told:?}");
        };
        let done = Ended::Done(serde_json::json!({"digest": "d"}));
        check(0, "chatter\n{\"digest\":\"d\"}\n", &goes_on, &done);
        check(0, "{\"digest\":\"d\"}\n", &stopped, &done);
        check(130, "", &stopped, &Ended::Interrupted);
        let failed = |code: i32| Ended::Failed(format!("exit status: {code}: tandem: no"));
        check(130, "", &goes_on, &failed(130));
        check(75, "", &stopped, &failed(75));
        check(0, "no summary", &goes_on, &failed(0));
        check(70, "{\"digest\":\"d\"}", &goes_on, &failed(70));
    }

    #[test]
    fn the_last_words_are_those_of_this_start() {
        let dir = tempfile::tempdir().expect("a directory");
        let log = dir.path().join("sweep.log");
        std::fs::write(&log, "tandem: before\n").expect("writes");
        assert_eq!(last_words(&log, 15), "it said nothing");
        std::fs::write(&log, "tandem: before\n00:01 round 1\ntandem: now\n\n").expect("writes");
        assert_eq!(last_words(&log, 15), "tandem: now");
    }
}
