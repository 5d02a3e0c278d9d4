//! Exclusive use of a run directory: one `tandem train` at a time, and no leftover processes of an earlier one.

use std::path::Path;
use std::time::Duration;

use tandem_system::DirectoryLock;
use tandem_teacher::ledger::{OpenError, SqliteLedger};

use super::plan::Plan;
use crate::exit::{Exit, Failed};
use crate::run_directory::lock;
use crate::{clock, output, run_directory, service};

/// Time that a process which was just killed may take to release its lock.
const KILLED_TIMEOUT: Duration = Duration::from_secs(1);
/// Time that the processes of an earlier start may take to save and exit.
const LEFTOVER_TIMEOUT: Duration = Duration::from_secs(30);
/// Pause between two attempts.
const RETRY_EVERY: Duration = Duration::from_millis(50);

/// The lock on a run directory.
#[derive(Debug)]
pub(super) struct RunLock(DirectoryLock);

/// The locks that the learner and the teacher will take. While they are held here, no other learner or teacher uses the
/// directory.
#[derive(Debug)]
pub(super) struct ServiceLocks {
    _checkpoints: Option<DirectoryLock>,
    _ledger: Option<SqliteLedger>,
}

impl RunLock {
    /// Locks the run directory, which is created for a new run.
    pub(super) fn take(plan: &Plan) -> Result<Self, Failed> {
        let out = &plan.out;
        if !plan.resume {
            run_directory::create(out)?;
        }
        match retry_for(KILLED_TIMEOUT, || (), || lock(out))? {
            Some(lock) => Ok(Self(lock)),
            None => Err(try_again(format!(
                "another process uses {}: wait until it exits, or choose another --out",
                out.display()
            ))),
        }
    }

    /// Waits until the leftover processes of an earlier start have saved and exited.
    pub(super) fn wait_for_leftovers(&self, plan: &Plan) -> Result<ServiceLocks, Failed> {
        let checkpoints = plan.checkpoints();
        let learner = format!("the learner of an earlier start still uses {}", plan.out.display());
        let checkpoints = match checkpoints.is_dir() {
            true => Some(wait_for(&learner, || lock(&checkpoints))?),
            false => None,
        };
        let path = plan.ledger();
        let teacher = format!("the teacher of an earlier start still uses {}", path.display());
        let ledger = match plan.config.advice.asks() && path.exists() {
            true => Some(wait_for(&teacher, || open_ledger(&path))?),
            false => None,
        };
        Ok(ServiceLocks { _checkpoints: checkpoints, _ledger: ledger })
    }

    /// Returns true if the path of the run directory still leads to the locked directory.
    pub(super) fn is_in_place(&self) -> bool {
        self.0.is_in_place()
    }
}

/// The locks of a run directory that no process uses.
#[derive(Debug)]
pub(crate) struct UnusedRun {
    _directory: DirectoryLock,
    _checkpoints: Option<DirectoryLock>,
    _ledger: Option<SqliteLedger>,
}

/// Locks a run directory; `None` while `tandem train`, a learner or a teacher uses it.
pub(crate) fn unused(out: &Path) -> Result<Option<UnusedRun>, Failed> {
    let Some(directory) = lock(out)? else { return Ok(None) };
    let (checkpoints, ledger) = (run_directory::checkpoints(out), run_directory::ledger(out));
    let checkpoints = match checkpoints.is_dir() {
        true => match lock(&checkpoints)? {
            Some(lock) => Some(lock),
            None => return Ok(None),
        },
        false => None,
    };
    // The run reports a ledger that cannot be read.
    let ledger = match ledger.exists().then(|| SqliteLedger::open(&ledger)) {
        Some(Err(OpenError::InUse(_))) => return Ok(None),
        Some(Ok(ledger)) => Some(ledger),
        Some(Err(_)) | None => None,
    };
    Ok(Some(UnusedRun { _directory: directory, _checkpoints: checkpoints, _ledger: ledger }))
}

/// Opens the ledger, or returns `None` while another process has it open.
fn open_ledger(path: &Path) -> Result<Option<SqliteLedger>, Failed> {
    match SqliteLedger::open(path) {
        Ok(ledger) => Ok(Some(ledger)),
        Err(OpenError::InUse(_)) => Ok(None),
        Err(error) => Err(service::teacher_failed(tandem_teacher::Error::OpenLedger(error))),
    }
}

/// Repeats `take` until it succeeds; prints what it waits for.
///
/// # Errors
/// When `take` fails or takes too long.
fn wait_for<T>(what: &str, take: impl FnMut() -> Result<Option<T>, Failed>) -> Result<T, Failed> {
    let timeout_s = LEFTOVER_TIMEOUT.as_secs();
    let print =
        || output::message(format_args!("{what}: waiting up to {timeout_s} s until it exits"));
    let taken = retry_for(LEFTOVER_TIMEOUT, print, take)?;
    taken.ok_or_else(|| try_again(format!("{what} after {timeout_s} s: stop it, then try again")))
}

/// Repeats `take` until it returns a value or `timeout` is over; calls `on_wait` before the first pause.
fn retry_for<T>(
    timeout: Duration,
    on_wait: impl FnOnce(),
    mut take: impl FnMut() -> Result<Option<T>, Failed>,
) -> Result<Option<T>, Failed> {
    let until = clock::now() + timeout;
    let mut on_wait = Some(on_wait);
    loop {
        let taken = take()?;
        if taken.is_some() || clock::now() >= until {
            return Ok(taken);
        }
        if let Some(on_wait) = on_wait.take() {
            on_wait();
        }
        std::thread::sleep(RETRY_EVERY);
    }
}

fn try_again(message: String) -> Failed {
    Failed::new(Exit::TryAgain, anyhow::anyhow!(message))
}
