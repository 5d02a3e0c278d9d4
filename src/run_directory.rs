//! Run directories.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use tandem_system::DirectoryLock;

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

/// Returns how far the run in `out` is: `complete`, `saved after round 6`, or `not saved yet`.
pub(crate) fn state(out: &Path) -> String {
    let Some(round) = saved_round(out) else { return "not saved yet".to_owned() };
    let is_complete = run_file::resolve(Some(&out.join("run.toml")), &[]).is_ok_and(|run| {
        let limit = run.stop.max_env_steps;
        limit > 0 && round * run.env_steps_per_round() >= limit
    });
    if is_complete { "complete".to_owned() } else { format!("saved after round {round}") }
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
