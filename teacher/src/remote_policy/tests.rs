use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use tandem_net::ServerConfig;
use tandem_proto::pb::policy_server::{Policy, PolicyServer};
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response};

use super::*;
use crate::advisor::{AdviceRequest, Advisor};
use crate::budget::AccountTerms;
use crate::error::Error;
use crate::fake::{FakePolicy, query};
use crate::ledger::MemoryLedger;
use crate::policy::TeacherPolicy as _;

const TIMEOUTS: PolicyTimeouts = PolicyTimeouts {
    connect: Duration::from_secs(5),
    call: Duration::from_millis(500),
    answer: Duration::from_secs(1),
};

/// Serves [`FakePolicy`], with faults.
#[derive(Clone)]
struct FakeServer {
    digest: Arc<Mutex<String>>,
    has_values: bool,
    /// The first action of every answer, instead of the policy's.
    wrong_action: Arc<Mutex<Option<f32>>>,
    is_away: Arc<AtomicBool>,
    n_calls: Arc<AtomicUsize>,
}

impl FakeServer {
    fn new(has_values: bool) -> Self {
        Self {
            digest: Arc::new(Mutex::new("one".to_owned())),
            has_values,
            wrong_action: Arc::default(),
            is_away: Arc::default(),
            n_calls: Arc::default(),
        }
    }

    /// Serves on a free port, whose address it returns.
    async fn start(&self) -> String {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        let service = PolicyServer::new(self.clone());
        let descriptors = tandem_proto::FILE_DESCRIPTOR_SET;
        let router = ServerConfig::default().router(service, descriptors).await.unwrap();
        tokio::spawn(tandem_net::serve(router, listener, CancellationToken::new()));
        address
    }
}

fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks::<4>().0.iter().map(|word| f32::from_le_bytes(*word)).collect()
}

fn bytes(floats: &[f32]) -> Vec<u8> {
    floats.iter().flat_map(|number| number.to_le_bytes()).collect()
}

#[tonic::async_trait]
impl Policy for FakeServer {
    async fn describe(
        &self,
        _: Request<pb::DescribePolicyRequest>,
    ) -> Result<Response<pb::PolicyDescription>, Status> {
        let task = pb::TaskDescription {
            name: FakePolicy.task().name().to_owned(),
            n_observation: 28,
            n_goal: 3,
            n_action: 3,
            arms: vec![pb::TaskArm::default()],
            ..pb::TaskDescription::default()
        };
        Ok(Response::new(pb::PolicyDescription {
            task: Some(task),
            name: "fake".to_owned(),
            digest: self.digest.lock().unwrap().clone(),
            has_values: self.has_values,
        }))
    }

    async fn evaluate(
        &self,
        request: Request<pb::EvaluatePolicyRequest>,
    ) -> Result<Response<pb::EvaluatePolicyResponse>, Status> {
        self.n_calls.fetch_add(1, Ordering::Relaxed);
        if self.is_away.load(Ordering::Relaxed) {
            return Err(Status::unavailable("restarting"));
        }
        let request = request.into_inner();
        if request.digest != *self.digest.lock().unwrap() {
            return Err(Status::failed_precondition("this server has another policy"));
        }
        let (observations, goals) = (floats(&request.observations), floats(&request.goals));
        let proposed = floats(&request.actions);
        let mut actions = vec![0.0; proposed.len()];
        FakePolicy.act(&observations, &goals, &mut actions);
        let values_of = |actions: &[f32]| {
            let mut q = vec![0.0; actions.len() / 3];
            FakePolicy.q(&observations, &goals, actions, &mut q);
            if self.has_values { bytes(&q) } else { Vec::new() }
        };
        let (values, proposed_values) = (values_of(&actions), values_of(&proposed));
        if let Some(wrong) = *self.wrong_action.lock().unwrap() {
            actions[0] = wrong;
        }
        let actions = bytes(&actions);
        Ok(Response::new(pb::EvaluatePolicyResponse { actions, values, proposed_values }))
    }
}

fn advisor(policy: impl Into<crate::policy::AnyPolicy>, strategy: &str) -> Advisor {
    let mut advisor = Advisor::new(policy, Box::new(MemoryLedger::default())).unwrap();
    let terms = AccountTerms { budget: 1000, strategy: strategy.parse().unwrap() };
    advisor.open_account("run", terms).unwrap();
    advisor
}

async fn connected(server: &FakeServer) -> RemotePolicy {
    let address = server.start().await;
    RemotePolicy::connect(&address, &ClientConfig::default(), TIMEOUTS).await.unwrap()
}

/// Runs `work` on a thread outside of the runtime, as the advisor does.
async fn outside<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    tokio::task::spawn_blocking(work).await.unwrap()
}

/// Returns a request with steps 0 to `n_steps - 1` of one episode.
fn request(n_steps: u16) -> AdviceRequest {
    let queries =
        (0..n_steps).map(|step| query(1, step.into(), f32::from(step % 16) / 32.0, 0.125));
    AdviceRequest { account: "run".to_owned(), queries: queries.collect() }
}

fn refusal(advisor: &mut Advisor) -> Error {
    advisor.advise(&[request(1)]).remove(0).unwrap_err()
}

fn spent(advisor: &mut Advisor) -> u64 {
    advisor.balance("run").unwrap().spent
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_policy_in_another_process_gives_the_same_advice_as_in_this_one() {
    let server = FakeServer::new(true);
    let remote = connected(&server).await;
    let advice = |mut advisor: Advisor| advisor.advise(&[request(300)]).remove(0).unwrap();
    let remotely = outside(move || advice(advisor(remote, "mc-q:0.02"))).await;
    assert_eq!(remotely, advice(advisor(Box::new(FakePolicy), "mc-q:0.02")));
    assert_eq!(server.n_calls.load(Ordering::Relaxed), 3, "600 arms in calls of 256");
    let charged = remotely.steps.iter().filter(|step| step.charged).count();
    assert!((1..300).contains(&charged), "{charged}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn an_absent_policy_charges_nothing_and_the_repeated_request_is_decided_as_usual() {
    let server = FakeServer::new(true);
    let remote = connected(&server).await;
    server.is_away.store(true, Ordering::Relaxed);
    let (mut advisor, error) = outside(move || {
        let mut advisor = advisor(remote, "ea");
        let error = refusal(&mut advisor);
        (advisor, error)
    })
    .await;
    let Error::RemotePolicy(RemoteError::Unavailable { reason, .. }) = error else {
        panic!("{error}")
    };
    assert_eq!(reason, "restarting");
    assert!(server.n_calls.load(Ordering::Relaxed) > 1, "the call is repeated");
    assert_eq!(spent(&mut advisor), 0);
    let warning = advisor.warning().unwrap();
    assert!(warning.ends_with(" does not answer: restarting"), "{warning}");

    server.is_away.store(false, Ordering::Relaxed);
    let (mut advisor, advice) = outside(move || {
        let advice = advisor.advise(&[request(1)]).remove(0).unwrap();
        (advisor, advice)
    })
    .await;
    assert!(advice.steps[0].charged);
    assert_eq!((spent(&mut advisor), advisor.warning()), (1, None));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn another_policy_at_the_same_address_is_refused_until_the_first_one_is_back() {
    let server = FakeServer::new(true);
    let remote = connected(&server).await;
    "two".clone_into(&mut server.digest.lock().unwrap());
    let digest = Arc::clone(&server.digest);
    outside(move || {
        let mut advisor = advisor(remote, "ea");
        let error = refusal(&mut advisor);
        assert!(matches!(error, Error::RemotePolicy(RemoteError::Changed { .. })), "{error}");
        assert_eq!(spent(&mut advisor), 0);
        "one".clone_into(&mut digest.lock().unwrap());
        assert!(advisor.advise(&[request(1)]).remove(0).is_ok());
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn an_invalid_action_is_refused_with_its_index() {
    let server = FakeServer::new(true);
    let remote = connected(&server).await;
    let wrong_action = Arc::clone(&server.wrong_action);
    outside(move || {
        let mut advisor = advisor(remote, "ea");
        for (wrong, shown) in [(f32::NAN, "got NaN"), (1.5, "got 1.5")] {
            *wrong_action.lock().unwrap() = Some(wrong);
            let error = refusal(&mut advisor).to_string();
            assert!(error.contains("actions[0]: expected a number in [-1, 1]"), "{error}");
            assert!(error.ends_with(shown), "{error}");
        }
        assert_eq!(spent(&mut advisor), 0);
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn without_values_a_strategy_that_compares_them_is_refused() {
    let server = FakeServer::new(false);
    let remote = connected(&server).await;
    outside(move || {
        let mut advisor = advisor(remote, "ea");
        for strategy in ["mc-q:0.1", "eamc:0.1"] {
            let terms = AccountTerms { budget: 1, strategy: strategy.parse().unwrap() };
            let error = advisor.open_account("other", terms).unwrap_err().to_string();
            assert!(error.starts_with(&format!("strategy {strategy} compares values")), "{error}");
        }
        let advice = advisor.advise(&[request(1)]).remove(0).unwrap();
        assert!(advice.steps[0].charged);
        assert_eq!(advice.steps[0].arms[0].q_teacher, 0.0);
    })
    .await;
}

#[tokio::test]
async fn a_server_that_has_gone_is_named_once() {
    let description = connected(&FakeServer::new(true)).await.description;
    let closed = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
    let address = format!("http://{closed}");
    let client = PolicyClient::new(ClientConfig::default().channel(&address).unwrap());
    let connection =
        Connection { client, address: address.clone(), description, timeouts: TIMEOUTS };
    let (reply, _answer) = oneshot::channel();
    let job = Job { n_states: 0, request: pb::EvaluatePolicyRequest::default(), reply };
    let failed = connection.evaluate(&job, &mut Retrier::new(BACKOFF, EVALUATE)).await;
    let message = failed.expect_err("nothing listens").to_string();
    let expected = format!("the policy at {address} does not answer: nothing listens");
    assert!(message.starts_with(&expected), "{message}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_address_where_nothing_answers_is_reported_after_the_time_limit() {
    let timeouts = PolicyTimeouts { connect: Duration::from_millis(200), ..TIMEOUTS };
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    drop(listener);
    let outcome = RemotePolicy::connect(&address, &ClientConfig::default(), timeouts).await;
    assert!(matches!(outcome.err(), Some(RemoteError::Unavailable { .. })));
    let outcome = RemotePolicy::connect("nowhere", &ClientConfig::default(), timeouts).await;
    assert!(matches!(outcome.err(), Some(RemoteError::Address(_))));
}
