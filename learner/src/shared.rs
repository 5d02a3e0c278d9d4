//! What the service's calls and the thread that learns share, and what both are told at the start.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tandem_core::work::{PublishedActor, RunTerms};
use tandem_net::{ClientConfig, EncodedResponse, Pacing, ServerConfig};
use tandem_policy::Policy;
use tandem_proto::{encode_actor, pb};
use tokio::sync::{Notify, watch};

use crate::board::{Board, Worker};
use crate::service::{Connections, LogQuota};
use crate::warnings::Warnings;
use tandem_rl::config::RunConfig;

/// Parameter versions kept for workers that lag behind.
pub(crate) const KEPT_VERSIONS: usize = 16;

/// The time since some start; passed in so that nothing here reads a clock.
pub type Clock = Arc<dyn Fn() -> Duration + Send + Sync>;

/// What a learner needs to run.
#[derive(Clone)]
pub struct LearnerConfig {
    /// The run.
    pub run: RunConfig,
    /// Who may call.
    pub gate: ServerConfig,
    /// How the teacher is called.
    pub dial: ClientConfig,
    /// The teacher's address, `HOST:PORT` or a URI; needed when the run asks for advice.
    pub teacher: Option<String>,
    /// The one-arm policy whose copies a run of strategy `init:teacher` starts from.
    pub start_from: Option<Policy>,
    /// The run directory.
    pub out: PathBuf,
    /// Whether to go on from the newest checkpoint, or from the beginning where there is none.
    pub resume: bool,
    /// Whether somebody else, such as the parent process, holds the lock of the run directory for this learner.
    pub out_is_locked: bool,
    /// What `run.toml` in the run directory holds from the moment on in which it is certain that the run goes on with
    /// these settings; `None` leaves the file alone.
    pub run_file: Option<String>,
    /// Threads of the update, 1 or 2.
    pub n_threads: usize,
    /// Time since the process started.
    pub clock: Clock,
    /// Version of the program, kept in what it writes.
    pub version: String,
    /// Where workers' numbers start; another one for each start of a learner, so that a worker of the learner before
    /// is not taken for one of this.
    pub first_worker: u64,
    /// How the service and the thread that learns take turns.
    pub pacing: Pacing,
}

/// State shared by the service's calls and the thread that learns.
pub(crate) struct Shared {
    state: Mutex<State>,
    /// Signalled whenever episodes come in.
    pub(crate) arrived: Arc<Notify>,
    /// Signalled whenever there may be work.
    pub(crate) work: Notify,
    pub(crate) progress: watch::Sender<pb::Progress>,
    pub(crate) warnings: Warnings,
    pub(crate) clock: Clock,
}

#[derive(Default)]
pub(crate) struct State {
    pub(crate) board: Board,
    pub(crate) terms: Option<RunTerms>,
    pub(crate) published: BTreeMap<u64, EncodedResponse>,
    /// What workers are told once nothing more is to be done.
    pub(crate) finished: Option<pb::Finished>,
    /// Workers that were playing when the run ended and have not been told yet.
    pub(crate) untold: BTreeSet<u64>,
    /// The connections over which workers have joined.
    pub(crate) connections: Connections,
    /// Log lines about workers that join.
    pub(crate) join_lines: LogQuota,
    /// Episodes in the replay buffer.
    pub(crate) n_replay_episodes: usize,
}

impl State {
    /// Notes how the run ended, and who is to be told.
    pub(crate) fn finish(&mut self, finished: pb::Finished) {
        let is_playing = |worker: &Worker| worker.slot.is_some() && !worker.silent;
        let playing = self.board.workers().filter(|(_, worker)| is_playing(worker));
        self.untold = playing.map(|(worker_id, _)| worker_id).collect();
        self.finished = Some(finished);
    }

    /// Whether a worker that counts as alive does not know yet that the run has ended.
    pub(crate) fn is_awaited(&self, now: Duration) -> bool {
        self.untold.iter().any(|worker_id| !self.board.is_silent(*worker_id, now))
    }
}

impl Shared {
    pub(crate) fn new(clock: Clock) -> Self {
        let (progress, _) = watch::channel(pb::Progress::default());
        Self {
            state: Mutex::default(),
            arrived: Arc::default(),
            work: Notify::new(),
            warnings: Warnings::new(progress.clone()),
            progress,
            clock,
        }
    }

    pub(crate) fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Hands out an actor from now on, and forgets the oldest.
    pub(crate) fn publish(&self, actor: &PublishedActor) {
        let prepared = EncodedResponse::encode(&encode_actor(actor));
        let mut state = self.lock();
        state.published.insert(actor.version, prepared);
        while state.published.len() > KEPT_VERSIONS {
            state.published.pop_first();
        }
    }
}
