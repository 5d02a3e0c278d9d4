//! A learner that serves, workers that play for it, and what a run leaves behind.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use tandem_core::Episode;
use tandem_core::work::SlotOrder;
use tandem_learner::{
    Clock, Error, LearnerConfig, LingerPolicy, RunOutcome, ServeOptions, serve_with,
};
use tandem_net::{ClientConfig, Pacing, ServerConfig};
use tandem_policy::{Actor, Policy};
use tandem_proto::pb::learner_client::LearnerClient;
use tandem_proto::pb::next_work_response::Work;
use tandem_proto::{decode_actor, decode_slot, encode_episode, pb};
use tandem_rl::RunConfig;
use tandem_telemetry::{MetricsLog, MetricsRow};
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::Status;
use tonic::transport::{Channel, Endpoint};

use crate::service_tests::toy::{LAYOUT, play};

/// Within this everything that is to happen has happened, on the slowest machine.
pub(crate) const DEADLINE: Duration = Duration::from_secs(120);
pub(crate) const VERSION: &str = env!("CARGO_PKG_VERSION");

pub(crate) fn real_clock() -> Clock {
    let start = tokio::time::Instant::now();
    Arc::new(move || start.elapsed())
}

pub(crate) fn learner_config(run: RunConfig, out: &Path, resume: bool) -> LearnerConfig {
    LearnerConfig {
        run,
        server_config: ServerConfig::default(),
        client_config: ClientConfig::default(),
        teacher: None,
        start_from: None,
        out: out.to_owned(),
        resume,
        out_is_locked: false,
        run_file: None,
        n_threads: 1,
        clock: real_clock(),
        unix_start: Duration::from_secs(1_000_000_000),
        version: VERSION.to_owned(),
        first_worker: 4096,
        pacing: Pacing::Concurrent,
    }
}

/// A learner that serves.
pub(crate) struct Served {
    pub(crate) address: SocketAddr,
    pub(crate) shutdown: CancellationToken,
    ended: JoinHandle<Result<RunOutcome, Error>>,
}

/// Connects at the first call. To connect here would compile the client again, for this file.
pub(crate) fn client_of(address: SocketAddr) -> LearnerClient<Channel> {
    let endpoint = Endpoint::from_shared(format!("http://{address}")).expect("an address");
    LearnerClient::new(endpoint.connect_lazy())
}

impl Served {
    pub(crate) async fn start(config: LearnerConfig) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("bound");
        let shutdown = CancellationToken::new();
        let linger = LingerPolicy::For(Duration::from_millis(30));
        let options = ServeOptions { linger, ..ServeOptions::default() };
        let serving = serve_with(config, listener, shutdown.clone(), options);
        Self { address, shutdown, ended: tokio::spawn(serving) }
    }

    pub(crate) async fn client(&self) -> LearnerClient<Channel> {
        client_of(self.address)
    }

    pub(crate) async fn join(&self, name: &str) -> Toy {
        Toy::join(self.client().await, name).await.expect("it lives")
    }

    pub(crate) async fn end(self) -> Result<RunOutcome, Error> {
        let ended = tokio::time::timeout(DEADLINE, self.ended).await.expect("the run ends in time");
        ended.expect("serving does not panic")
    }

    /// Lets `n` plain workers play to the end.
    pub(crate) async fn finish(self, n: usize) -> Result<RunOutcome, Error> {
        let mut workers = Vec::new();
        for _ in 0..n {
            let client = self.client().await;
            workers.push(tokio::spawn(async move {
                if let Some(mut toy) = Toy::join(client, "toy").await {
                    while toy.play_one().await {}
                }
            }));
        }
        let ended = self.end().await;
        for worker in workers {
            worker.abort();
        }
        ended
    }
}

/// A worker that has joined.
pub(crate) struct Toy {
    pub(crate) client: LearnerClient<Channel>,
    pub(crate) id: u64,
    actor: Option<(u64, Actor)>,
}

impl Toy {
    /// Joins as `name`, waiting for the run to start; `None` when the learner is gone.
    pub(crate) async fn join(mut client: LearnerClient<Channel>, name: &str) -> Option<Self> {
        loop {
            let request = pb::JoinRequest { worker: name.to_owned(), version: VERSION.to_owned() };
            match client.join(request).await {
                Ok(joined) => {
                    return Some(Self { client, id: joined.into_inner().worker_id, actor: None });
                }
                Err(status) if status.message() == "the run is starting" => {
                    tokio::time::sleep(Duration::from_millis(5)).await;
                }
                Err(_gone) => return None,
            }
        }
    }

    pub(crate) async fn ask(&mut self) -> Result<Work, Status> {
        let answer = self.client.next_work(pb::NextWorkRequest { worker_id: self.id }).await?;
        Ok(answer.into_inner().work.expect("an answer"))
    }

    /// The next slot and its episodes; `None` when the run is over or the learner gone.
    pub(crate) async fn take(&mut self) -> Option<(SlotOrder, Vec<Episode>)> {
        loop {
            match self.ask().await {
                Ok(Work::Slot(slot)) => {
                    let order = decode_slot(slot).expect("a slot");
                    let episodes = self.play(&order).await?;
                    return Some((order, episodes));
                }
                Ok(Work::Wait(_)) => {}
                Ok(Work::Finished(_)) | Err(_) => return None,
            }
        }
    }

    async fn play(&mut self, order: &SlotOrder) -> Option<Vec<Episode>> {
        let version = order.parameter_version;
        if self.actor.as_ref().is_none_or(|(known, _)| *known != version) {
            let request = pb::GetParametersRequest { version };
            let parameters = self.client.get_parameters(request).await.ok()?.into_inner();
            let published = decode_actor(&parameters, LAYOUT).expect("parameters");
            self.actor = Some((version, Actor::new(LAYOUT, published).expect("an actor")));
        }
        self.actor.as_mut().map(|(_, actor)| play(actor, order))
    }

    pub(crate) async fn deliver(&mut self, slot: u64, episodes: &[Episode]) -> Result<(), Status> {
        deliver_as(&mut self.client, self.id, slot, episodes).await
    }

    /// Plays one slot; false when there is none any more.
    pub(crate) async fn play_one(&mut self) -> bool {
        match self.take().await {
            Some((order, episodes)) => self.deliver(order.slot, &episodes).await.is_ok(),
            None => false,
        }
    }
}

pub(crate) async fn deliver_as(
    client: &mut LearnerClient<Channel>,
    worker_id: u64,
    slot: u64,
    episodes: &[Episode],
) -> Result<(), Status> {
    let episodes = episodes.iter().map(encode_episode).collect();
    let request = pb::SubmitEpisodesRequest { worker_id, slot, episodes, environment_check: None };
    client.submit_episodes(request).await.map(drop)
}

/// The results of a run that do not depend on wall time.
#[derive(Debug, PartialEq)]
pub(crate) struct Left {
    pub(crate) digest: String,
    pub(crate) rows: Vec<MetricsRow>,
    /// Parameters and metadata of the policies, by name.
    policies: BTreeMap<String, (String, BTreeMap<String, String>)>,
}

impl Left {
    pub(crate) fn behind(ended: &RunOutcome, out: &Path) -> Self {
        let mut rows = MetricsLog::read_all(&out.join("metrics.jsonl")).expect("rows");
        rows.iter_mut().for_each(|row| row.wall_s = 0.0);
        let policies = ["best", "last"].map(|name| {
            let path = out.join(format!("policy/{name}.safetensors"));
            let mut policy = Policy::load(&path).expect("a whole policy");
            policy.metadata.remove("wall_s");
            (name.to_owned(), (policy.digest(), policy.metadata))
        });
        Self { digest: ended.digest.clone(), rows, policies: policies.into() }
    }
}

/// A run that nothing happens to, played by one worker.
pub(crate) async fn calm(run: RunConfig) -> Left {
    let directory = tempfile::tempdir().expect("a directory");
    let served = Served::start(learner_config(run, directory.path(), false)).await;
    let ended = served.finish(1).await.expect("a calm run");
    assert!(!ended.interrupted);
    Left::behind(&ended, directory.path())
}

/// Copies a run directory as a crash would leave it.
pub(crate) fn copy_all(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("creates");
    for entry in std::fs::read_dir(from).expect("readable").flatten() {
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy_all(&entry.path(), &target);
        } else if let Err(error) = std::fs::copy(entry.path(), target) {
            // A file that was renamed or removed between being seen and being read.
            assert_eq!(error.kind(), std::io::ErrorKind::NotFound, "{:?}", entry.path());
        }
    }
}
