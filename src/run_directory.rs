//! Run directories.

use std::fmt::{self, Display, Formatter};
use std::path::{Path, PathBuf};

use anyhow::anyhow;
use serde_json::Value;
use tandem_report::run_summary::{self, RunLength};
use tandem_rl::RunConfig;
use tandem_system::{DirectoryLock, regular_file};

use crate::exit::{Exit, Failed, OrExit as _};
use crate::run_file;

/// The directory that holds the runs without `--out`.
pub(crate) const RUNS: &str = "runs";

/// Runs that a message names.
const MAX_NAMED_RUNS: usize = 5;

/// Returns the directory of a run's checkpoints.
pub(crate) fn checkpoints(out: &Path) -> PathBuf {
    out.join("checkpoint")
}

/// Returns the file of a run's advice accounts.
pub(crate) fn ledger(out: &Path) -> PathBuf {
    out.join("ledger.sqlite")
}

/// Returns the directory of the files that exist while `tandem train` works on the run.
pub(crate) fn in_use(out: &Path) -> PathBuf {
    out.join("in-use")
}

/// Returns the file with the address of the learner that `tandem train` has started.
pub(crate) fn learner_address(out: &Path) -> PathBuf {
    in_use(out).join("learner")
}

/// Returns the round of the newest checkpoint of the run in `out`, if there is one.
pub(crate) fn saved_round(out: &Path) -> Option<u64> {
    let checkpoints = tandem_learner::checkpoint::list(&checkpoints(out));
    tandem_learner::checkpoint::round_of(checkpoints.last()?)
}

/// The progress of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RunState {
    /// Nothing is saved yet.
    NotSaved,
    /// The newest checkpoint is that of this round.
    Saved(u64),
    /// The run has all its environment steps, but `tandem train` has not tested the result.
    NotTested,
    /// The run has ended, and its result is tested.
    Complete,
}

impl Display for RunState {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotSaved => f.write_str("not saved yet"),
            Self::Saved(round) => write!(f, "saved after round {round}"),
            Self::NotTested => f.write_str("complete, not tested"),
            Self::Complete => f.write_str("complete"),
        }
    }
}

/// Returns the summary that `tandem train` has written for the run in `out`, if there is one.
pub(crate) fn summary(out: &Path) -> Option<Value> {
    let bytes = regular_file::read(&out.join(run_summary::FILE)).ok()?;
    serde_json::from_slice(&bytes).ok().filter(Value::is_object)
}

/// Returns the length of the run in `out` with this configuration, if that is valid.
pub(crate) fn length(out: &Path, run: Option<&RunConfig>) -> RunLength {
    let saved = saved_round(out).zip(run);
    RunLength {
        max_env_steps: run.map(|run| run.stop.max_env_steps),
        env_steps: saved.map(|(round, run)| round * run.env_steps_per_round()),
    }
}

/// Returns the progress of the run in `out`.
pub(crate) fn state(out: &Path) -> RunState {
    let config = run_file::resolve(Some(&out.join("run.toml")), &[]).ok();
    let length = length(out, config.as_ref());
    if summary(out).is_some_and(|summary| run_summary::is_current(&summary, length)) {
        return RunState::Complete;
    }
    let RunLength { max_env_steps, env_steps } = length;
    match saved_round(out) {
        None => RunState::NotSaved,
        Some(_) if max_env_steps > Some(0) && env_steps >= max_env_steps => RunState::NotTested,
        Some(round) => RunState::Saved(round),
    }
}

/// Returns the error about a directory that holds no run to resume, with runs that can be resumed.
pub(crate) fn no_run(problem: &str) -> Failed {
    let runs = runs_in(Path::new(RUNS));
    let named: Vec<String> = runs
        .iter()
        .take(MAX_NAMED_RUNS)
        .map(|run| format!("{} ({})", run.display(), state(run)))
        .collect();
    let more = match runs.len().saturating_sub(MAX_NAMED_RUNS) {
        0 => String::new(),
        n => format!(" and {n} more"),
    };
    Failed::usage(match named.is_empty() {
        true => problem.to_owned(),
        false => format!("{problem}; there are: {}{more}", named.join(", ")),
    })
}

/// Returns the directories in `parent` that hold runs, in the order of their names.
pub(crate) fn runs_in(parent: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(parent).into_iter().flatten();
    let directories = entries.filter_map(|entry| Some(entry.ok()?.path()));
    let mut runs: Vec<PathBuf> =
        directories.filter(|directory| directory.join("run.toml").is_file()).collect();
    runs.sort();
    runs
}

/// Returns the directories in `parent` that hold runs, as that of a sweep does, with the states of these.
pub(crate) fn parents_in(parent: &Path) -> Vec<(PathBuf, Vec<RunState>)> {
    let entries = std::fs::read_dir(parent).into_iter().flatten();
    let directories = entries.filter_map(|entry| Some(entry.ok()?.path()));
    let directories = directories.filter(|directory| !directory.join("run.toml").exists());
    let states = directories.map(|directory| {
        let states = runs_in(&directory).iter().map(|run| state(run)).collect::<Vec<_>>();
        (directory, states)
    });
    let mut parents: Vec<_> = states.filter(|(_, states)| !states.is_empty()).collect();
    parents.sort_by(|(a, _), (b, _)| a.cmp(b));
    parents
}

/// Locks a directory; `None` if another process has locked it.
pub(crate) fn lock(directory: &Path) -> Result<Option<DirectoryLock>, Failed> {
    let cannot = || format!("cannot lock {}", directory.display());
    DirectoryLock::try_take(directory).or_exit(Exit::TryAgain, cannot)
}

/// Locks a directory that `option` names, or refuses it while another process uses it.
pub(crate) fn lock_for(option: &str, directory: &Path) -> Result<DirectoryLock, Failed> {
    lock(directory)?.ok_or_else(|| {
        let directory = directory.display();
        let advice = format!("wait until it exits, or choose another {option}");
        Failed::new(Exit::TryAgain, anyhow!("another process uses {directory}: {advice}"))
    })
}

/// Rejects a path at which no directory can be created: a file, or a path below one.
pub(crate) fn check_path(out: &Path) -> Result<(), Failed> {
    let is_in_the_way = |path: &&Path| path.exists() && !path.is_dir();
    match out.ancestors().find(is_in_the_way) {
        Some(file) if file == out => Err(Failed::usage(format!(
            "--out {}: it is a file, expected a directory for the run",
            out.display()
        ))),
        Some(file) => Err(Failed::usage(format!(
            "--out {}: {} is a file, expected a directory",
            out.display(),
            file.display()
        ))),
        None => Ok(()),
    }
}

/// Creates the directory `out` unless it exists.
pub(crate) fn create(out: &Path) -> Result<(), Failed> {
    check_path(out)?;
    std::fs::create_dir_all(out).or_cannot_write(|| format!("cannot create {}", out.display()))
}
