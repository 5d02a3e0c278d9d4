//! The configuration of a learner, and the state that the service shares with the learning thread.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tandem_core::Episode;
use tandem_core::work::{PublishedActor, RunTerms};
use tandem_net::{ClientConfig, EncodedResponse, Pacing, ServerConfig};
use tandem_policy::Policy;
use tandem_proto::{encode_actor, pb};
use tandem_rl::config::RunConfig;
use tandem_telemetry::{MetricsRow, TeacherView};
use tokio::sync::{Notify, watch};

use crate::connections::{Connections, LogQuota};
use crate::progress::{Progress, RunEnd};
use crate::timings::Timings;
use crate::warnings::{Source, Warnings};
use crate::work_queue::{WorkQueue, Worker};

/// Parameter versions that are kept for workers that lag behind.
pub(crate) const KEPT_VERSIONS: usize = 16;

/// Largest number of characters of a worker's text in a warning: a difference between two plays of an episode, or the
/// cause of a failure.
const MAX_REPORT_CHARS: usize = 300;

/// Failures of environments from which on there is a warning. Fewer follow from a server that is restarted.
const MIN_FAILURES_OF_WARNING: u64 = 3;

/// Returns the time since a fixed start. Passed in, so that nothing in this crate reads a clock.
pub type Clock = Arc<dyn Fn() -> Duration + Send + Sync>;

/// The configuration of a learner.
#[derive(Clone)]
pub struct LearnerConfig {
    /// The run.
    pub run: RunConfig,
    /// Access control and TLS of the service.
    pub server_config: ServerConfig,
    /// Token and TLS of calls to the teacher.
    pub client_config: ClientConfig,
    /// The teacher's address, `HOST:PORT` or a URI; required if the run asks for advice.
    pub teacher: Option<String>,
    /// The one-arm policy whose copies a run with strategy `init:teacher` starts from.
    pub start_from: Option<Policy>,
    /// The run directory.
    pub out: PathBuf,
    /// Resumes from the newest checkpoint, or starts anew if there is none.
    pub resume: bool,
    /// True if another process, such as the parent, holds the lock of the run directory for this learner.
    pub out_is_locked: bool,
    /// Text of `run.toml`, which is written once it is certain that the run continues with these settings; `None`
    /// leaves the file unchanged.
    pub run_file: Option<String>,
    /// Threads of the update, 1 or more.
    pub n_threads: usize,
    /// Time since the process started.
    pub clock: Clock,
    /// Start of the process, since 1970; for the times of events in TensorBoard.
    pub unix_start: Duration,
    /// Version of the program, stored in policy files.
    pub version: String,
    /// First number of a worker. It differs for each start of a learner, so that a worker of the previous learner is
    /// not mistaken for one of this.
    pub first_worker: u64,
    /// Scheduling of the service and the learning thread.
    pub pacing: Pacing,
}

/// State shared by the service's calls and the learning thread.
pub(crate) struct Shared {
    state: Mutex<State>,
    /// Signalled when episodes arrive.
    pub(crate) arrived: Arc<Notify>,
    /// Signalled when there may be work.
    pub(crate) work: Notify,
    pub(crate) progress: watch::Sender<Progress>,
    pub(crate) warnings: Warnings,
    /// The teacher and its ledger.
    pub(crate) teacher: watch::Sender<TeacherView>,
    pub(crate) clock: Clock,
    pub(crate) timings: Timings,
}

/// The part of the shared state behind the lock.
#[derive(Default)]
pub(crate) struct State {
    pub(crate) queue: WorkQueue,
    /// The run's terms; `None` before the run starts.
    pub(crate) terms: Option<RunTerms>,
    /// Published parameters by version, encoded.
    pub(crate) published: BTreeMap<u64, EncodedResponse>,
    /// The end of the run, once there is no more work.
    pub(crate) end: Option<RunEnd>,
    /// Workers that were playing at the end of the run and have not received it yet.
    pub(crate) uninformed: BTreeSet<u64>,
    /// The connections over which workers have joined.
    pub(crate) connections: Connections,
    /// Limits the log lines about workers that join.
    pub(crate) join_lines: LogQuota,
    /// All evaluations, oldest first.
    pub(crate) evaluations: Arc<[MetricsRow]>,
    /// The first episodes of the latest evaluation.
    pub(crate) evaluated: Arc<[Episode]>,
    /// Episodes in the replay buffer.
    pub(crate) n_replay_episodes: usize,
}

impl State {
    /// Records the end of the run and the workers that have to receive it: those that may be playing, also if their
    /// connections have ended. The others call within the time for which the service stays anyway.
    pub(crate) fn finish(&mut self, end: RunEnd) {
        let is_playing = |worker: &Worker| worker.slot.is_some() && !worker.reported_silent;
        let playing = self.queue.workers().filter(|(_, worker)| is_playing(worker));
        self.uninformed = playing.map(|(worker_id, _)| worker_id).collect();
        self.end = Some(end);
    }

    /// Returns true if a worker that counts as alive has not received the end of the run yet.
    pub(crate) fn awaits_workers(&self, now: Duration) -> bool {
        self.uninformed.iter().any(|worker_id| !self.queue.is_silent(*worker_id, now))
    }
}

impl Shared {
    /// Creates the state of a run that has not started.
    pub(crate) fn new(config: &LearnerConfig, timings: Timings) -> Self {
        let (progress, _) = watch::channel(Progress::default());
        let queue = WorkQueue::new(config.run.advice.unit, config.first_worker);
        Self {
            state: Mutex::new(State { queue, ..State::default() }),
            arrived: Arc::default(),
            work: Notify::new(),
            warnings: Warnings::new(progress.clone()),
            teacher: watch::Sender::default(),
            progress,
            clock: config.clock.clone(),
            timings,
        }
    }

    pub(crate) fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds the result of playing episodes twice and the failures of a server to the progress, with a warning about the
    /// first difference, and one once failures are frequent.
    pub(crate) fn record_environment_check(&self, check: &pb::EnvironmentCheck) {
        self.progress.send_modify(|progress| {
            progress.environment.n_episodes += u64::from(check.n_episodes);
            progress.environment.differs |= !check.difference.is_empty();
            progress.environment.n_failures += u64::from(check.failures);
        });
        let shown = |text: &str| text.chars().take(MAX_REPORT_CHARS).collect::<String>();
        if !check.difference.is_empty() {
            let warning =
                format!("the environments are not deterministic: {}", shown(&check.difference));
            self.warnings.set_first(Source::Environment, &warning);
        }
        let n_failures = self.progress.borrow().environment.n_failures;
        if check.failures > 0 && n_failures >= MIN_FAILURES_OF_WARNING {
            let warning = format!(
                "the environments fail repeatedly, their episodes are played again: one failure, of the server {}",
                shown(&check.failure)
            );
            self.warnings.set_first(Source::Failures, &warning);
        }
    }

    /// Publishes an actor, and drops the oldest beyond [`KEPT_VERSIONS`].
    pub(crate) fn publish(&self, actor: &PublishedActor) {
        let prepared = EncodedResponse::encode(&encode_actor(actor));
        let mut state = self.lock();
        state.published.insert(actor.version, prepared);
        while state.published.len() > KEPT_VERSIONS {
            state.published.pop_first();
        }
    }
}
