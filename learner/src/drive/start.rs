//! How a run begins: anew, or from its newest checkpoint.

use std::path::{Path, PathBuf};
use std::time::Duration;

use tandem_core::work::{PublishedActor, RunTerms};
use tandem_proto::pb;
use tandem_system::{DirectoryLock, atomic_file};
use tandem_telemetry::events::RunResumed;
use tokio_util::sync::CancellationToken;

use super::keep::Keeping;
use super::{Drive, UNITS_PER_EPISODE};
use crate::checkpoint::{self, CheckpointError, Restored, Resumption};
use crate::error::Error;
use crate::records::{Judged, Pending, Records};
use crate::runtime::Runtime;
use crate::shared::{LearnerConfig, Shared};
use crate::teacher::{Ledger, Run};
use crate::warnings::Warnings;
use tandem_rl::trainer::Trainer;

/// How long a learner that was there before may take to save and go.
const LOCK_PATIENCE: Duration = Duration::from_secs(30);
/// Pause between two looks whether it has gone.
const LOCK_TICK: Duration = Duration::from_millis(50);

/// What a run begins with.
pub(super) struct Beginning {
    pub(super) trainer: Trainer,
    acting: PublishedActor,
    judged: Judged,
    pending: Vec<Pending>,
    wall_before_s: f64,
    is_resumed: bool,
    lock: RunLock,
}

impl Beginning {
    /// Reads what there is.
    pub(super) fn of(config: &LearnerConfig, shutdown: &CancellationToken) -> Result<Self, Error> {
        let lock = RunLock::take(config, shutdown)?;
        let checkpoints = config.out.join("checkpoint");
        let restored = if config.resume {
            checkpoint::load_newest(&checkpoints, &config.run)?
        } else {
            refuse_former_run(&config.out)?;
            None
        };
        let is_resumed = restored.is_some();
        let (mut trainer, resumption) = match restored {
            Some(Restored { path, trainer, resumption }) => {
                RunResumed { round: trainer.counters().round, path: &path }.emit();
                (trainer, resumption)
            }
            None => {
                if config.resume {
                    tracing::info!(path = ?checkpoints, "no checkpoint yet, the run begins anew");
                }
                let mut trainer = Trainer::new(config.run.clone())?;
                if config.run.advice.starts_from_teacher() {
                    let none = || {
                        Error::StartFrom(
                            "needs the teacher's policy file: give it by --start-from".to_owned(),
                        )
                    };
                    let teacher = config.start_from.as_ref().ok_or_else(none)?;
                    trainer.start_from(teacher).map_err(Error::StartFrom)?;
                }
                let (acting, judged) = (trainer.publish(), Judged::default());
                (trainer, Resumption { acting, judged, pending: Vec::new(), wall_s: 0.0 })
            }
        };
        trainer.set_threads(config.n_threads);
        let Resumption { acting, judged, pending, wall_s } = resumption;
        Ok(Self { trainer, acting, judged, pending, wall_before_s: wall_s, is_resumed, lock })
    }

    /// Opens the run's account when it asks for advice.
    pub(super) fn open_ledger(
        &self,
        config: &LearnerConfig,
        warnings: &Warnings,
        (runtime, shutdown): (&Runtime, &CancellationToken),
    ) -> Result<Option<Ledger>, Error> {
        let advice = &config.run.advice;
        if !advice.asks() {
            return Ok(None);
        }
        let address =
            config.teacher.as_deref().ok_or_else(|| Error::NoTeacher(advice.strategy.clone()))?;
        let terms = pb::OpenAccountRequest {
            name: config.run.name.clone(),
            budget: advice.budget,
            strategy: advice.strategy.clone(),
        };
        let run = if self.is_resumed {
            Run::Resumed { spent: self.trainer.counters().advice_spent }
        } else {
            Run::New
        };
        let whom = (&config.dial, address);
        Ok(Some(Ledger::open(
            whom,
            &terms,
            UNITS_PER_EPISODE,
            (run, warnings),
            (runtime, shutdown),
        )?))
    }
}

impl<'a> Drive<'a> {
    /// Publishes what workers need and orders again the evaluations that were under way.
    pub(super) fn new(
        config: &'a LearnerConfig,
        shared: &'a Shared,
        (runtime, shutdown): (&'a Runtime, &'a CancellationToken),
        beginning: Beginning,
        ledger: Option<Ledger>,
    ) -> Self {
        let Beginning { trainer, acting, judged, pending, wall_before_s, lock, .. } = beginning;
        let terms = RunTerms {
            layout: trainer.layout,
            account: ledger.as_ref().map(|ledger| ledger.account().to_owned()),
            exploration: config.run.exploration,
            world: config.run.world,
        };
        for Pending { counters, policy, .. } in &pending {
            shared.publish(&policy.published(counters.round));
        }
        shared.publish(&acting);
        shared.publish(&trainer.publish());
        let mut drive = Self {
            config,
            shared,
            runtime,
            shutdown,
            trainer,
            acting,
            ledger,
            records: Records::new(&config.out, judged),
            pending: pending.into(),
            keeping: Keeping::default(),
            wall_before_s,
            rates: std::collections::VecDeque::new(),
            lock,
        };
        for Pending { counters, .. } in &drive.pending {
            drive.add(drive.trainer.evaluation_orders(counters.round));
        }
        drive.write_records();
        drive.tell("starting", &drive.trainer.figures());
        drive.tell_evaluation();
        drive.shared.lock().terms = Some(terms);
        drive
    }
}

/// A run that begins anew would overwrite what another has left.
fn refuse_former_run(out: &Path) -> Result<(), CheckpointError> {
    let has_rows = std::fs::metadata(out.join("metrics.jsonl")).is_ok_and(|file| file.len() > 0);
    if has_rows || !checkpoint::list(&out.join("checkpoint")).is_empty() {
        return Err(CheckpointError::RunExists(out.to_owned()));
    }
    Ok(())
}

/// Writes down the settings with which the run goes on.
pub(super) fn keep_run_file(config: &LearnerConfig) -> Result<(), Error> {
    let Some(text) = &config.run_file else { return Ok(()) };
    let path = config.out.join("run.toml");
    if std::fs::read(&path).is_ok_and(|there| there == text.as_bytes()) {
        return Ok(());
    }
    atomic_file::replace(&path, text.as_bytes()).map_err(|error| Error::RunDirectory {
        action: "write",
        path,
        source: error.into(),
    })
}

/// Keeps a second learner out of a run directory.
///
/// Two directories are locked: the run directory by whoever is in charge of the run, which is this learner or the
/// `tandem train` that started it, and the directory of checkpoints by the learner. So a learner that still saves is
/// noticed when its `tandem train` is dead.
#[derive(Debug)]
pub(super) struct RunLock {
    out: Option<DirectoryLock>,
    /// `None` where something is in its way: a checkpoint is then as missing as on a full disk.
    checkpoints: Option<DirectoryLock>,
}

impl RunLock {
    /// Takes the lock, waiting a while for the learner that has it.
    fn take(config: &LearnerConfig, shutdown: &CancellationToken) -> Result<Self, Error> {
        let until = (config.clock)() + LOCK_PATIENCE;
        let is_over = || (config.clock)() >= until || shutdown.is_cancelled();
        let out = match config.out_is_locked {
            true => None,
            false => Some(lock(&config.out, &is_over)?),
        };
        let checkpoints = config.out.join("checkpoint");
        let checkpoints = match checkpoints.exists() && !checkpoints.is_dir() {
            true => None,
            false => Some(lock(&checkpoints, &is_over)?),
        };
        Ok(Self { out, checkpoints })
    }

    /// Whether the paths still lead to the directories that are locked.
    pub(super) fn is_in_place(&self) -> bool {
        self.out.iter().chain(&self.checkpoints).all(DirectoryLock::is_in_place)
    }
}

/// Locks `directory`, which is made when there is none, and tries again until `is_over`.
fn lock(directory: &Path, is_over: &impl Fn() -> bool) -> Result<DirectoryLock, Error> {
    let refused = |source: Box<dyn std::error::Error + Send + Sync>| {
        let path: PathBuf = directory.to_owned();
        Error::RunDirectory { action: "lock", path, source }
    };
    atomic_file::create_directory(directory).map_err(|error| refused(error.into()))?;
    loop {
        match DirectoryLock::try_take(directory) {
            Ok(Some(lock)) => return Ok(lock),
            Ok(None) if is_over() => {
                return Err(refused("another learner is at work in this directory".into()));
            }
            Ok(None) => std::thread::sleep(LOCK_TICK),
            Err(error) => return Err(refused(error.into())),
        }
    }
}
