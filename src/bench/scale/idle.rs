//! Workers that wait instead of simulating: they take slots, fetch parameters and deliver whole episodes as real ones
//! do, each over a connection of its own, and all of them fit into one process.

mod book;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use anyhow::Context as _;
use tandem_core::{Episode, Layout, Task};
use tandem_learner::Clock;
use tandem_net::{Dial, Link};
use tandem_proto::pb::learner_client::LearnerClient;
use tandem_proto::pb::next_work_response::Work;
use tandem_proto::{encode_episode, pb};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tonic::{Code, Status};

pub(super) use book::Book;

/// What workers and learner must have in common; a commit is not part of it.
const VERSION: &str = env!("CARGO_PKG_VERSION");
/// As long as a real worker waits for an answer.
const ANSWER: Duration = Duration::from_secs(20);
/// Pause before a call that failed is made again.
const PAUSE: Duration = Duration::from_millis(100);
/// As much as a real worker takes in.
const MAX_MESSAGE_BYTES: usize = 64 << 20;

/// Many idle workers.
pub(super) struct Crowd {
    common: Arc<Common>,
    members: Vec<Member>,
    n_spawned: usize,
}

struct Common {
    /// A worker calls one of these, in turn.
    addresses: Vec<String>,
    dial: Dial,
    slot_time: Duration,
    episodes_per_round: u64,
    clock: Clock,
    episode: pb::Episode,
    book: Mutex<Book>,
    /// The latest round of which a slot was taken.
    latest: watch::Sender<u64>,
    n_joined: watch::Sender<usize>,
    /// Why the learner takes none of these workers, if it does not.
    refused: watch::Sender<Option<String>>,
}

struct Member {
    task: JoinHandle<()>,
    state: Arc<MemberState>,
}

#[derive(Default)]
struct MemberState {
    is_playing: AtomicBool,
    shall_leave: AtomicBool,
}

impl Crowd {
    pub(super) fn new(
        addresses: Vec<String>,
        slot_time: Duration,
        episodes_per_round: usize,
        clock: Clock,
    ) -> Self {
        let episode = encode_episode(&Episode::zeros(Layout::new(Task::Push, 2), 0));
        let common = Common {
            addresses,
            dial: Dial::default(),
            slot_time,
            episodes_per_round: episodes_per_round as u64,
            clock,
            episode,
            book: Mutex::default(),
            latest: watch::Sender::new(0),
            n_joined: watch::Sender::new(0),
            refused: watch::Sender::new(None),
        };
        Self { common: Arc::new(common), members: Vec::new(), n_spawned: 0 }
    }

    /// Lets `n` more join.
    pub(super) fn join(&mut self, n: usize) -> anyhow::Result<()> {
        for _ in 0..n {
            let address = &self.common.addresses[self.n_spawned % self.common.addresses.len()];
            let link = self.common.dial.link(address).context("cannot call the learner")?;
            let state = Arc::<MemberState>::default();
            let worker = Worker {
                name: format!("idle-{}", self.n_spawned),
                common: self.common.clone(),
                state: state.clone(),
                client: LearnerClient::new(link).max_decoding_message_size(MAX_MESSAGE_BYTES),
                version: None,
            };
            self.members.push(Member { task: tokio::spawn(worker.live()), state });
            self.n_spawned += 1;
        }
        Ok(())
    }

    /// Lets `n` leave: half of them once they have delivered what they have in hand, half of them in the middle of a
    /// slot, without a word.
    pub(super) fn leave(&mut self, n: usize) {
        let (n_silently, mut n_left) = (n / 2, 0);
        self.members.retain(|member| {
            let is_playing = member.state.is_playing.load(Ordering::Relaxed);
            let stays = n_left >= n || !is_playing;
            if !stays && n_left < n_silently {
                member.task.abort();
            } else if !stays {
                member.state.shall_leave.store(true, Ordering::Relaxed);
            }
            n_left += usize::from(!stays);
            stays
        });
    }

    /// Waits until all that were ever let in have joined.
    ///
    /// # Errors
    /// When the learner refuses them.
    pub(super) async fn all_joined(&self) -> anyhow::Result<()> {
        let mut n_joined = self.common.n_joined.subscribe();
        let mut refused = self.common.refused.subscribe();
        tokio::select! {
            joined = n_joined.wait_for(|n| *n >= self.n_spawned) => drop(joined?),
            refused = refused.wait_for(Option::is_some) => {
                anyhow::bail!("the learner refuses workers: {}", refused?.as_deref().unwrap_or_default());
            }
        }
        Ok(())
    }

    /// The latest round of which a slot was taken.
    pub(super) fn round(&self) -> u64 {
        *self.common.latest.borrow()
    }

    /// Waits until a slot of `round` is taken.
    pub(super) async fn until(&self, round: u64) -> anyhow::Result<()> {
        self.common.latest.subscribe().wait_for(|latest| *latest >= round).await?;
        Ok(())
    }

    pub(super) fn book(&self) -> MutexGuard<'_, Book> {
        self.common.book()
    }
}

impl Drop for Crowd {
    fn drop(&mut self) {
        self.members.iter().for_each(|member| member.task.abort());
    }
}

impl Common {
    fn book(&self) -> MutexGuard<'_, Book> {
        self.book.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn now(&self) -> Duration {
        (self.clock)()
    }
}

struct Worker {
    name: String,
    common: Arc<Common>,
    state: Arc<MemberState>,
    client: LearnerClient<Link>,
    /// Of the parameters that it has.
    version: Option<u64>,
}

impl Worker {
    /// Works until told to leave. A call that fails is made again, as a real worker does.
    async fn live(mut self) {
        let mut worker_id = None;
        let mut was_in = false;
        while !self.state.shall_leave.load(Ordering::Relaxed) {
            let outcome = match worker_id {
                None => self.join().await.map(Some),
                Some(id) => self.work(id).await.map(|()| Some(id)),
            };
            self.state.is_playing.store(false, Ordering::Relaxed);
            match outcome {
                Ok(id) => worker_id = id,
                Err(status) => {
                    // Before anybody is in, the run is only starting.
                    if *self.common.n_joined.borrow() > 0 {
                        self.common.book().fail(&status);
                    }
                    match status.code() {
                        Code::NotFound => worker_id = None,
                        Code::FailedPrecondition if worker_id.is_none() => {
                            let reason = status.message().to_owned();
                            self.common.refused.send_replace(Some(reason));
                            return;
                        }
                        _ => {}
                    }
                    tokio::time::sleep(PAUSE).await;
                }
            }
            if worker_id.is_some() && !was_in {
                was_in = true;
                self.common.n_joined.send_modify(|n| *n += 1);
            }
        }
    }

    async fn join(&mut self) -> Result<u64, Status> {
        let request = pb::JoinRequest { worker: self.name.clone(), version: VERSION.to_owned() };
        Ok(within(self.client.join(request)).await?.worker_id)
    }

    /// Asks for a slot and plays it, if there is one.
    async fn work(&mut self, worker_id: u64) -> Result<(), Status> {
        let asked = self.common.now();
        let answer = within(self.client.next_work(pb::NextWorkRequest { worker_id })).await?;
        let answered = self.common.now();
        let slot = match answer.work {
            Some(Work::Slot(slot)) => slot,
            Some(Work::Finished(_)) => {
                self.state.shall_leave.store(true, Ordering::Relaxed);
                return Ok(());
            }
            Some(Work::Wait(_)) | None => return Ok(()),
        };
        self.state.is_playing.store(true, Ordering::Relaxed);
        let first = slot.episodes.first().map_or(0, |order| order.number);
        let round = first / self.common.episodes_per_round;
        self.common.book().take(round, slot.slot, (asked, answered));
        self.common.latest.send_if_modified(|latest| {
            let is_new = round > *latest;
            *latest = round.max(*latest);
            is_new
        });
        self.fetch(round, slot.parameter_version).await?;
        tokio::time::sleep(self.common.slot_time).await;
        self.deliver(worker_id, round, &slot).await
    }

    async fn fetch(&mut self, round: u64, version: u64) -> Result<(), Status> {
        if self.version == Some(version) {
            return Ok(());
        }
        let asked = self.common.now();
        within(self.client.get_parameters(pb::GetParametersRequest { version })).await?;
        self.version = Some(version);
        self.common.book().fetched(round, self.common.now().saturating_sub(asked));
        Ok(())
    }

    async fn deliver(&mut self, worker_id: u64, round: u64, slot: &pb::Slot) -> Result<(), Status> {
        let episode = |order: &pb::EpisodeOrder| pb::Episode {
            number: order.number,
            kind: slot.kind,
            parameter_version: slot.parameter_version,
            ..self.common.episode.clone()
        };
        let episodes = slot.episodes.iter().map(episode).collect();
        let request = pb::SubmitEpisodesRequest { worker_id, slot: slot.slot, episodes };
        let sent = self.common.now();
        within(self.client.submit_episodes(request)).await?;
        self.common.book().deliver(round, (sent, self.common.now()));
        Ok(())
    }
}

async fn within<T>(
    call: impl Future<Output = Result<tonic::Response<T>, Status>>,
) -> Result<T, Status> {
    let lapsed = |_elapsed| Status::deadline_exceeded("no answer in time");
    let answer = tokio::time::timeout(ANSWER, call).await.map_err(lapsed)??;
    Ok(answer.into_inner())
}
