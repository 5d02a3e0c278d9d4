//! A relay between a learner and its workers: what it passes on, what it keeps, and what it must not keep.

use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tandem_net::{ClientConfig, ServerConfig, Token};
use tandem_proto::pb;
use tandem_proto::pb::learner_client::LearnerClient;
use tandem_proto::pb::learner_server::{Learner, LearnerServer};
use tokio::net::TcpListener;
use tokio::task::JoinSet;
use tokio_stream::Stream;
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;
use tonic::{Code, Request, Response, Status};

use crate::service_tests::run::{
    DEADLINE, Left, Served, Toy, VERSION, calm, client_of, learner_config,
};
use crate::service_tests::toy::config;

async fn bound() -> (TcpListener, SocketAddr) {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("bound");
    (listener, address)
}

/// Starts a relay to `learner`; gives its address and what ends it.
async fn relay(learner: SocketAddr) -> (SocketAddr, tokio_util::sync::DropGuard) {
    relay_with(ClientConfig::default(), learner).await
}

async fn relay_with(
    client_config: ClientConfig,
    learner: SocketAddr,
) -> (SocketAddr, tokio_util::sync::DropGuard) {
    let (listener, address) = bound().await;
    let shutdown = CancellationToken::new();
    let guard = shutdown.clone().drop_guard();
    tokio::spawn(async move {
        let (learner, server_config) = (learner.to_string(), ServerConfig::default());
        let served = tandem_learner::relay::serve(
            &learner,
            &client_config,
            &server_config,
            listener,
            shutdown,
        );
        served.await.expect("relays");
    });
    (address, guard)
}

async fn client(address: SocketAddr) -> LearnerClient<Channel> {
    client_of(address)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_whose_workers_call_relays_is_the_same() {
    let expected = calm(config(1)).await;
    let directory = tempfile::tempdir().expect("a directory");
    let served = Served::start(learner_config(config(1), directory.path(), false)).await;
    let (first, _first) = relay(served.address).await;
    let (second, _second) = relay(served.address).await;
    for address in [first, second, second, served.address] {
        let mut toy = Toy::join(client(address).await, "toy").await.expect("joins");
        tokio::spawn(async move { while toy.play_one().await {} });
    }
    let mut progress = client(first).await;
    let status = progress.status(pb::StatusRequest {}).await.expect("is forwarded").into_inner();
    assert_eq!(status.task, "push");
    let mut watched = progress.watch(pb::WatchRequest {}).await.expect("a stream").into_inner();
    let ended = served.end().await.expect("a run");
    assert_eq!(Left::behind(&ended, directory.path()), expected);
    let last = async {
        let mut last = pb::Progress::default();
        while let Ok(Some(progress)) = watched.message().await {
            last = progress;
        }
        last
    };
    let last = tokio::time::timeout(DEADLINE, last).await.expect("the stream ends");
    assert_eq!((last.ended, last.digest), (true, ended.digest));
}

/// A learner that says what it is asked about parameters, and counts.
#[derive(Clone, Default)]
struct Fake {
    /// Which start of a learner it claims to be.
    start: Arc<AtomicU64>,
    /// Versions below this are known.
    n_versions: Arc<AtomicU64>,
    n_fetched: Arc<AtomicU64>,
}

#[tonic::async_trait]
impl Learner for Fake {
    type WatchStream = Pin<Box<dyn Stream<Item = Result<pb::Progress, Status>> + Send>>;

    async fn join(
        &self,
        _: Request<pb::JoinRequest>,
    ) -> Result<Response<pb::JoinResponse>, Status> {
        let learner = self.start.load(Ordering::SeqCst);
        Ok(Response::new(pb::JoinResponse { worker_id: 1, terms: None, learner }))
    }

    async fn next_work(
        &self,
        request: Request<pb::NextWorkRequest>,
    ) -> Result<Response<pb::NextWorkResponse>, Status> {
        Err(Status::not_found(format!("worker {} is unknown", request.into_inner().worker_id)))
    }

    async fn get_parameters(
        &self,
        request: Request<pb::GetParametersRequest>,
    ) -> Result<Response<pb::Parameters>, Status> {
        let version = request.into_inner().version;
        self.n_fetched.fetch_add(1, Ordering::SeqCst);
        // All who ask at the same time have asked before this is answered.
        tokio::time::sleep(std::time::Duration::from_millis(200)).await;
        if version >= self.n_versions.load(Ordering::SeqCst) {
            return Err(Status::not_found(format!("version {version} is not kept")));
        }
        // Longer than what fits into a window of flow control.
        let actor = vec![self.start.load(Ordering::SeqCst).to_le_bytes()[0]; 3 << 20];
        Ok(Response::new(pb::Parameters { version, actor, ..Default::default() }))
    }

    async fn submit_episodes(
        &self,
        request: Request<pb::SubmitEpisodesRequest>,
    ) -> Result<Response<pb::SubmitEpisodesResponse>, Status> {
        let n = request.into_inner().episodes.len();
        Err(Status::invalid_argument(format!("{n} episodes")))
    }

    async fn status(
        &self,
        _: Request<pb::StatusRequest>,
    ) -> Result<Response<pb::Progress>, Status> {
        Err(Status::unimplemented("a fake"))
    }

    async fn watch(
        &self,
        _: Request<pb::WatchRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        Err(Status::unimplemented("a fake"))
    }
}

impl Fake {
    async fn serve(&self) -> SocketAddr {
        self.serve_with(ServerConfig::default()).await
    }

    async fn serve_with(&self, config: ServerConfig) -> SocketAddr {
        let (listener, address) = bound().await;
        let router = config
            .router(LearnerServer::new(self.clone()), tandem_proto::FILE_DESCRIPTOR_SET)
            .await
            .expect("serves");
        tokio::spawn(tandem_net::serve(router, listener, CancellationToken::new()));
        address
    }

    fn n_fetched(&self) -> u64 {
        self.n_fetched.load(Ordering::SeqCst)
    }
}

async fn parameters(
    client: &LearnerClient<Channel>,
    version: u64,
) -> Result<pb::Parameters, Status> {
    let mut client = client.clone().max_decoding_message_size(64 << 20);
    Ok(client.get_parameters(pb::GetParametersRequest { version }).await?.into_inner())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_version_is_fetched_once_for_all_workers() {
    let fake = Fake::default();
    fake.n_versions.store(5, Ordering::SeqCst);
    let (address, _relay) = relay(fake.serve().await).await;
    let mut asking = JoinSet::new();
    for _ in 0..16 {
        let client = client(address).await;
        asking.spawn(async move { parameters(&client, 3).await });
    }
    while let Some(answer) = asking.join_next().await {
        let answer = answer.expect("answers").expect("parameters");
        assert_eq!((answer.version, answer.actor.len()), (3, 3 << 20));
    }
    assert_eq!(fake.n_fetched(), 1);
    parameters(&client(address).await, 4).await.expect("another version");
    assert_eq!(fake.n_fetched(), 2);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_failed_fetch_is_repeated() {
    let fake = Fake::default();
    let (address, _relay) = relay(fake.serve().await).await;
    let client = client(address).await;
    let status = parameters(&client, 0).await.expect_err("there is none");
    assert_eq!((status.code(), status.message()), (Code::NotFound, "version 0 is not kept"));
    fake.n_versions.store(1, Ordering::SeqCst);
    assert_eq!(parameters(&client, 0).await.expect("now there is").version, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_oldest_of_more_than_sixteen_versions_is_dropped() {
    let fake = Fake::default();
    fake.n_versions.store(100, Ordering::SeqCst);
    let (address, _relay) = relay(fake.serve().await).await;
    let client = client(address).await;
    let in_order = (0..17).map(|version| (version, version + 1));
    for (version, n_fetched) in in_order.chain([(16, 17), (1, 17), (0, 18)]) {
        parameters(&client, version).await.expect("parameters");
        assert_eq!(fake.n_fetched(), n_fetched, "version {version}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_learner_keeps_the_last_sixteen_versions() {
    let directory = tempfile::tempdir().expect("a directory");
    let mut run = config(0);
    run.stop.max_env_steps = 20 * 400;
    let served = Served::start(learner_config(run, directory.path(), false)).await;
    let mut toy = served.join("toy").await;
    let mut client = served.client().await;
    let round = loop {
        assert!(toy.play_one().await, "twenty rounds");
        let progress = client.status(pb::StatusRequest {}).await.expect("answers").into_inner();
        if progress.round > 16 {
            break progress.round;
        }
    };
    parameters(&client, round).await.expect("the newest");
    let status = parameters(&client, 0).await.expect_err("no longer kept");
    assert_eq!(status.code(), Code::NotFound, "{status:?}");
    served.finish(1).await.expect("a run");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn parameters_of_a_former_learner_are_dropped() {
    let fake = Fake::default();
    fake.n_versions.store(1, Ordering::SeqCst);
    let (address, _relay) = relay(fake.serve().await).await;
    let client = client(address).await;
    for start in [1, 2] {
        fake.start.store(start, Ordering::SeqCst);
        let request = pb::JoinRequest { worker: String::new(), version: VERSION.to_owned() };
        let joined = client.clone().join(request).await.expect("joins").into_inner();
        assert_eq!(joined.learner, start);
        let actor = parameters(&client, 0).await.expect("parameters").actor;
        assert_eq!(u64::from(actor[0]), start, "another learner's version 0");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn refusals_are_forwarded_and_another_version_is_refused() {
    let fake = Fake::default();
    let (address, _relay) = relay(fake.serve().await).await;
    let mut client = client(address).await;
    let status = client.next_work(pb::NextWorkRequest { worker_id: 7 }).await.expect_err("refused");
    assert_eq!((status.code(), status.message()), (Code::NotFound, "worker 7 is unknown"));
    let episodes = vec![pb::Episode::default(); 3];
    let request =
        pb::SubmitEpisodesRequest { worker_id: 1, slot: 2, episodes, environment_check: None };
    let status = client.submit_episodes(request).await.expect_err("refused");
    assert_eq!((status.code(), status.message()), (Code::InvalidArgument, "3 episodes"));
    let request = pb::JoinRequest { worker: "old".to_owned(), version: "0.0.9".to_owned() };
    let status = client.join(request).await.expect_err("refused");
    assert_eq!(status.code(), Code::FailedPrecondition);
    assert!(status.message().contains("this relay of version"), "{}", status.message());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_absent_learner_is_reported() {
    let (listener, absent) = bound().await;
    drop(listener);
    let (address, _relay) = relay(absent).await;
    let status = parameters(&client(address).await, 0).await.expect_err("no learner listens");
    assert_eq!(status.code(), Code::Unavailable);
    assert!(status.message().contains(&absent.to_string()), "{}", status.message());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_relay_with_another_token_than_the_learner_does_not_end_its_workers() {
    let token = |text| Token::new(text).expect("a token");
    let required = ServerConfig::default().with_token(token("the-right-token-0123"));
    let learner = Fake::default().serve_with(required).await;
    let rejected = ClientConfig::default().with_token(&token("another-token-456789"));
    let (address, _relay) = relay_with(rejected, learner).await;
    let worker = ClientConfig::default().channel(&address.to_string()).expect("an address");
    let mut worker = LearnerClient::new(worker);
    let of_work = worker.next_work(pb::NextWorkRequest { worker_id: 7 }).await.map(drop);
    let of_parameters =
        worker.get_parameters(pb::GetParametersRequest { version: 0 }).await.map(drop);
    for status in [of_work, of_parameters].map(|answer| answer.expect_err("rejected")) {
        assert_eq!(status.code(), Code::Unavailable);
        let expected = format!("the relay cannot call the learner: {learner} does not accept");
        assert!(status.message().starts_with(&expected), "{}", status.message());
    }
}
