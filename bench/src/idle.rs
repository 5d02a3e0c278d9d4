//! Workers that wait instead of simulating. They take slots, fetch parameters and deliver whole episodes as real
//! workers do, each over its own connection, and all of them fit into one process.

mod timings;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tandem_core::{Episode, Layout, Task};
use tandem_net::{AuthChannel, ClientConfig, MAX_MESSAGE_BYTES, Retryability, within};
use tandem_proto::pb::learner_client::LearnerClient;
use tandem_proto::pb::next_work_response::Work;
use tandem_proto::{encode_episode, pb};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tonic::Status;

use crate::{Clock, Error};

pub use timings::{Calls, LoadTimings, Percentiles, quantile};

/// The version that workers and learner must share; it does not contain the commit.
const VERSION: &str = env!("CARGO_PKG_VERSION");
/// Timeout of a call, as for a real worker.
const CALL_TIMEOUT: Duration = Duration::from_secs(20);
/// Pause before a failed call is repeated.
const RETRY_PAUSE: Duration = Duration::from_millis(100);

/// Idle workers of one learner. They end when this is dropped.
pub struct IdleWorkers {
    shared: Arc<Shared>,
    workers: Vec<WorkerHandle>,
    n_spawned: usize,
}

struct Shared {
    /// Addresses of the learner or of relays, which workers use in turn.
    addresses: Vec<String>,
    client_config: ClientConfig,
    slot_time: Duration,
    episodes_per_round: u64,
    clock: Clock,
    episode: pb::Episode,
    timings: Mutex<LoadTimings>,
    /// The latest round of which a worker has taken a slot.
    latest_round: watch::Sender<u64>,
    n_joined: watch::Sender<usize>,
    /// The reason if the learner rejects these workers.
    rejection: watch::Sender<Option<String>>,
}

struct WorkerHandle {
    task: JoinHandle<()>,
    state: Arc<WorkerState>,
}

#[derive(Default)]
struct WorkerState {
    is_playing: AtomicBool,
    must_leave: AtomicBool,
}

impl IdleWorkers {
    /// Creates a load without workers.
    ///
    /// The workers call the learner or its relays at `addresses` in turn, and take `slot_time` for a slot. A round has
    /// `episodes_per_round` episodes.
    pub fn new(
        addresses: Vec<String>,
        slot_time: Duration,
        episodes_per_round: usize,
        clock: Clock,
    ) -> Self {
        let episode = encode_episode(&Episode::zeros(Layout::new(Task::Push, 2), 0));
        let shared = Shared {
            addresses,
            client_config: ClientConfig::default(),
            slot_time,
            episodes_per_round: episodes_per_round as u64,
            clock,
            episode,
            timings: Mutex::default(),
            latest_round: watch::Sender::new(0),
            n_joined: watch::Sender::new(0),
            rejection: watch::Sender::new(None),
        };
        Self { shared: Arc::new(shared), workers: Vec::new(), n_spawned: 0 }
    }

    /// Starts `n` more workers. Must be called inside a runtime.
    ///
    /// # Errors
    /// When an address is not one.
    pub fn join(&mut self, n: usize) -> Result<(), Error> {
        for _ in 0..n {
            let address = &self.shared.addresses[self.n_spawned % self.shared.addresses.len()];
            let link = self.shared.client_config.channel(address)?;
            let state = Arc::<WorkerState>::default();
            let worker = Worker {
                name: format!("idle-{}", self.n_spawned),
                shared: self.shared.clone(),
                state: state.clone(),
                client: LearnerClient::new(link).max_decoding_message_size(MAX_MESSAGE_BYTES),
                version: None,
            };
            self.workers.push(WorkerHandle { task: tokio::spawn(worker.run()), state });
            self.n_spawned += 1;
        }
        Ok(())
    }

    /// Removes `n` workers that are playing: one half at once, in the middle of a slot, and the other half after they
    /// have delivered their slots.
    pub fn leave(&mut self, n: usize) {
        let (n_silently, mut n_left) = (n / 2, 0);
        self.workers.retain(|worker| {
            let is_playing = worker.state.is_playing.load(Ordering::Relaxed);
            let stays = n_left >= n || !is_playing;
            if !stays && n_left < n_silently {
                worker.task.abort();
            } else if !stays {
                worker.state.must_leave.store(true, Ordering::Relaxed);
            }
            n_left += usize::from(!stays);
            stays
        });
    }

    /// Waits until all workers that were started have joined.
    ///
    /// # Errors
    /// When the learner rejects them.
    pub async fn all_joined(&self) -> Result<(), Error> {
        let mut n_joined = self.shared.n_joined.subscribe();
        let mut rejection = self.shared.rejection.subscribe();
        tokio::select! {
            _ = n_joined.wait_for(|n| *n >= self.n_spawned) => Ok(()),
            rejection = rejection.wait_for(Option::is_some) => {
                let reason = rejection.ok().and_then(|reason| reason.clone());
                Err(Error::Rejected(reason.unwrap_or_default()))
            }
        }
    }

    /// Returns the latest round of which a worker has taken a slot.
    pub fn round(&self) -> u64 {
        *self.shared.latest_round.borrow()
    }

    /// Waits until a worker has taken a slot of `round`.
    pub async fn wait_for_round(&self, round: u64) {
        // Fails only without a sender, and `shared` has it.
        drop(self.shared.latest_round.subscribe().wait_for(|latest| *latest >= round).await);
    }

    /// Locks the timings of all calls so far.
    pub fn timings(&self) -> MutexGuard<'_, LoadTimings> {
        self.shared.timings()
    }
}

impl Drop for IdleWorkers {
    fn drop(&mut self) {
        self.workers.iter().for_each(|worker| worker.task.abort());
    }
}

impl Shared {
    fn timings(&self) -> MutexGuard<'_, LoadTimings> {
        self.timings.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn now(&self) -> Duration {
        (self.clock)()
    }
}

struct Worker {
    name: String,
    shared: Arc<Shared>,
    state: Arc<WorkerState>,
    client: LearnerClient<AuthChannel>,
    /// Version of the worker's parameters.
    version: Option<u64>,
}

impl Worker {
    /// Works until it must leave. Failed calls are repeated, as by a real worker.
    async fn run(mut self) {
        let mut worker_id = None;
        let mut has_joined = false;
        while !self.state.must_leave.load(Ordering::Relaxed) {
            let outcome = match worker_id {
                None => self.join().await.map(Some),
                Some(id) => self.work(id).await.map(|()| Some(id)),
            };
            self.state.is_playing.store(false, Ordering::Relaxed);
            match outcome {
                Ok(id) => worker_id = id,
                Err(status) => {
                    // Until a worker has joined, the run is still starting.
                    if *self.shared.n_joined.borrow() > 0 {
                        self.shared.timings().record_failure(&status);
                    }
                    match Retryability::of(status.code()) {
                        Retryability::NotFound => worker_id = None,
                        Retryability::Final if worker_id.is_none() => {
                            let reason = status.message().to_owned();
                            self.shared.rejection.send_replace(Some(reason));
                            return;
                        }
                        _ => {}
                    }
                    tokio::time::sleep(RETRY_PAUSE).await;
                }
            }
            if worker_id.is_some() && !has_joined {
                has_joined = true;
                self.shared.n_joined.send_modify(|n| *n += 1);
            }
        }
    }

    async fn join(&mut self) -> Result<u64, Status> {
        let request = pb::JoinRequest { worker: self.name.clone(), version: VERSION.to_owned() };
        Ok(within(CALL_TIMEOUT, self.client.join(request)).await?.into_inner().worker_id)
    }

    /// Requests a slot and plays it, if there is one.
    async fn work(&mut self, worker_id: u64) -> Result<(), Status> {
        let requested = self.shared.now();
        let answer = within(CALL_TIMEOUT, self.client.next_work(pb::NextWorkRequest { worker_id }))
            .await?
            .into_inner();
        let answered = self.shared.now();
        let slot = match answer.work {
            Some(Work::Slot(slot)) => slot,
            Some(Work::Finished(_)) => {
                self.state.must_leave.store(true, Ordering::Relaxed);
                return Ok(());
            }
            Some(Work::Wait(_)) | None => return Ok(()),
        };
        self.state.is_playing.store(true, Ordering::Relaxed);
        let first = slot.episodes.first().map_or(0, |order| order.number);
        let round = first / self.shared.episodes_per_round;
        self.shared.timings().record_assignment(round, slot.slot, (requested, answered));
        self.shared.latest_round.send_if_modified(|latest| {
            let is_new = round > *latest;
            *latest = round.max(*latest);
            is_new
        });
        self.fetch(round, slot.parameter_version).await?;
        tokio::time::sleep(self.shared.slot_time).await;
        self.deliver(worker_id, round, &slot).await
    }

    async fn fetch(&mut self, round: u64, version: u64) -> Result<(), Status> {
        if self.version == Some(version) {
            return Ok(());
        }
        let requested = self.shared.now();
        within(CALL_TIMEOUT, self.client.get_parameters(pb::GetParametersRequest { version }))
            .await?;
        self.version = Some(version);
        self.shared.timings().record_fetch(round, self.shared.now().saturating_sub(requested));
        Ok(())
    }

    async fn deliver(&mut self, worker_id: u64, round: u64, slot: &pb::Slot) -> Result<(), Status> {
        let episode = |order: &pb::EpisodeOrder| pb::Episode {
            number: order.number,
            kind: slot.kind,
            parameter_version: slot.parameter_version,
            ..self.shared.episode.clone()
        };
        let episodes = slot.episodes.iter().map(episode).collect();
        let request = pb::SubmitEpisodesRequest {
            worker_id,
            slot: slot.slot,
            episodes,
            environment_check: None,
        };
        let sent = self.shared.now();
        within(CALL_TIMEOUT, self.client.submit_episodes(request)).await?.into_inner();
        self.shared.timings().record_delivery(round, (sent, self.shared.now()));
        Ok(())
    }
}
