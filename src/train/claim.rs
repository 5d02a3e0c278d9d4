//! Who works in a run directory: one `tandem train` at a time, and nobody that an earlier one has left behind.

use std::path::Path;
use std::time::Duration;

use tandem_system::DirectoryLock;
use tandem_teacher::ledger::{OpenError, SqliteLedger};

use super::plan::Plan;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{clock, output, run_directory, services};

/// How long a process that was killed a moment ago may take to be gone.
const GONE_PATIENCE: Duration = Duration::from_secs(1);
/// How long the processes of an earlier start may take to save and end.
const FORMER_PATIENCE: Duration = Duration::from_secs(30);
/// Pause between two looks.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// The lock of a run directory, held as long as this process works there.
#[derive(Debug)]
pub(super) struct Claim(DirectoryLock);

/// The locks of those that will be started: while they are held here, nobody learns or advises in the directory.
#[derive(Debug)]
pub(super) struct Quiet {
    _checkpoints: Option<DirectoryLock>,
    _ledger: Option<SqliteLedger>,
}

impl Claim {
    /// Takes the run directory, which is made for a new run.
    pub(super) fn take(plan: &Plan) -> Result<Self, Failed> {
        let out = &plan.out;
        if !plan.resume {
            run_directory::make(out)?;
        }
        match tried_for(GONE_PATIENCE, || (), || lock(out))? {
            Some(lock) => Ok(Self(lock)),
            None => Err(try_again(format!(
                "another process is at work in {}: wait for its end, or choose another --out",
                out.display()
            ))),
        }
    }

    /// Waits until the processes of an earlier start, whose `tandem train` is dead, have saved and ended.
    pub(super) fn wait_for_former(&self, plan: &Plan) -> Result<Quiet, Failed> {
        let checkpoints = plan.checkpoints();
        let learner =
            format!("the learner of an earlier start still works in {}", plan.out.display());
        let checkpoints = match checkpoints.is_dir() {
            true => Some(awaited(&learner, || lock(&checkpoints))?),
            false => None,
        };
        let path = plan.ledger();
        let teacher = format!("the teacher of an earlier start still uses {}", path.display());
        let ledger = match plan.config.advice.asks() && path.exists() {
            true => Some(awaited(&teacher, || open_ledger(&path))?),
            false => None,
        };
        Ok(Quiet { _checkpoints: checkpoints, _ledger: ledger })
    }

    /// Whether the run directory's path still leads to the directory that was taken.
    pub(super) fn is_in_place(&self) -> bool {
        self.0.is_in_place()
    }
}

fn lock(directory: &Path) -> Result<Option<DirectoryLock>, Failed> {
    let cannot = || format!("cannot lock {}", directory.display());
    DirectoryLock::try_take(directory).or_exit(Exit::TryAgain, cannot)
}

/// The ledger, or `None` while somebody else has it open.
fn open_ledger(path: &Path) -> Result<Option<SqliteLedger>, Failed> {
    match SqliteLedger::open(path) {
        Ok(ledger) => Ok(Some(ledger)),
        Err(OpenError::InUse(_)) => Ok(None),
        Err(error) => Err(services::teacher_failed(tandem_teacher::Error::OpenLedger(error))),
    }
}

/// Tries until it is done; says what is waited for, and gives up when that takes too long.
fn awaited<T>(who: &str, take: impl FnMut() -> Result<Option<T>, Failed>) -> Result<T, Failed> {
    let patience_s = FORMER_PATIENCE.as_secs();
    let say = || output::message(format_args!("{who}: waiting up to {patience_s} s for its end"));
    let taken = tried_for(FORMER_PATIENCE, say, take)?;
    taken.ok_or_else(|| try_again(format!("{who} after {patience_s} s: end it, then try again")))
}

/// Tries until it is done or `patience` is over; calls `waits` before the first pause.
fn tried_for<T>(
    patience: Duration,
    waits: impl FnOnce(),
    mut take: impl FnMut() -> Result<Option<T>, Failed>,
) -> Result<Option<T>, Failed> {
    let until = clock::now() + patience;
    let mut waits = Some(waits);
    loop {
        let taken = take()?;
        if taken.is_some() || clock::now() >= until {
            return Ok(taken);
        }
        if let Some(waits) = waits.take() {
            waits();
        }
        std::thread::sleep(LOOK_EVERY);
    }
}

fn try_again(told: String) -> Failed {
    Failed::new(Exit::TryAgain, anyhow::anyhow!(told))
}
