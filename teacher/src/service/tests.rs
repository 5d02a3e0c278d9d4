//! The service over real sockets.

use std::net::SocketAddr;

use tandem_proto::pb::teacher_client::TeacherClient;
use tandem_proto::{decode_advice, encode_query};
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;
use tonic::transport::Channel;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

use super::gated_ledger::{GateControl, GatedLedger, Mode};
use super::*;
use crate::fake::{FakePolicy, query};

async fn serve_open(
    advisor: Advisor,
    listener: TcpListener,
    shutdown: CancellationToken,
) -> Result<(), Error> {
    serve_advisor(advisor, listener, &ServerConfig::default(), shutdown, Pacing::Concurrent).await
}

/// A running service and its client.
struct Fixture {
    client: TeacherClient<Channel>,
    channel: Channel,
    gate: GateControl,
    shutdown: CancellationToken,
    served: JoinHandle<Result<(), Error>>,
}

impl Fixture {
    async fn start() -> Self {
        let listener = TcpListener::bind(SocketAddr::from(([127, 0, 0, 1], 0))).await.unwrap();
        let address = listener.local_addr().unwrap();
        let shutdown = CancellationToken::new();
        let gate = GateControl::new();
        let ledger = Box::new(GatedLedger::new(gate.clone()));
        let advisor = Advisor::new(Box::new(FakePolicy), ledger).unwrap();
        let served = tokio::spawn(serve_open(advisor, listener, shutdown.clone()));
        let channel = Channel::from_shared(format!("http://{address}")).unwrap().connect_lazy();
        Self { client: TeacherClient::new(channel.clone()), channel, gate, shutdown, served }
    }

    async fn open(&mut self, budget: u64, strategy: &str) -> Result<pb::Account, Status> {
        let request = pb::OpenAccountRequest {
            name: "run".to_owned(),
            budget,
            strategy: strategy.to_owned(),
        };
        self.client.open_account(request).await.map(Response::into_inner)
    }

    async fn advise(&mut self, steps: Vec<pb::StepQuery>) -> Result<pb::AdviseResponse, Status> {
        let request = pb::AdviseRequest { account: "run".to_owned(), steps, ..Default::default() };
        self.client.advise(request).await.map(Response::into_inner)
    }

    /// Opens a stream, and returns a sender of requests and the answers.
    async fn stream(&mut self) -> (mpsc::Sender<pb::AdviseRequest>, Streaming<pb::AdviseResponse>) {
        let (sender, receiver) = mpsc::channel(8);
        let answers = self.client.advise_stream(ReceiverStream::new(receiver)).await.unwrap();
        (sender, answers.into_inner())
    }

    async fn stop(self) {
        self.shutdown.cancel();
        drop((self.client, self.channel));
        self.served.await.unwrap().unwrap();
    }
}

fn step(step: u32) -> pb::StepQuery {
    encode_query(&query(1, step, 0.5, 0.25))
}

/// Returns the code and message of a refusal.
fn refusal<T: std::fmt::Debug>(outcome: Result<T, Status>) -> (Code, String) {
    let status = outcome.unwrap_err();
    (status.code(), status.message().to_owned())
}

#[tokio::test]
async fn describe_returns_task_maps_strategies_and_digest() {
    let mut fixture = Fixture::start().await;
    let description = fixture.client.describe(pb::DescribeRequest {}).await.unwrap().into_inner();
    assert_eq!(description.task, "push");
    let sizes = (
        description.n_observation_per_arm,
        description.n_goal_per_arm,
        description.n_action_per_arm,
    );
    assert_eq!(sizes, (28, 3, 3));
    assert_eq!(description.arms.len(), 8);
    let range = |start, end| Some(pb::IndexRange { start, end });
    let second_arm =
        pb::ArmMap { observation: range(28, 56), goal: range(3, 6), action: range(3, 6) };
    assert_eq!(description.arms[1], second_arm);
    assert_eq!(
        description.strategies,
        [
            "none",
            "ea",
            "eamc:T",
            "mc-q:T",
            "mc-act:A",
            "mc-act-abs:A",
            "jsrl:H",
            "rlif:T",
            "ts2c:T"
        ]
    );
    assert_eq!(description.policy_digest, "fa4e");
    fixture.stop().await;
}

#[tokio::test]
async fn the_service_reports_its_health() {
    let fixture = Fixture::start().await;
    let mut health = HealthClient::new(fixture.channel.clone());
    for service in ["", "tandem.v1.Teacher"] {
        let request = tonic_health::pb::HealthCheckRequest { service: service.to_owned() };
        let status = health.check(request).await.unwrap().into_inner().status();
        assert_eq!(status, ServingStatus::Serving, "{service:?}");
    }
    drop(health);
    fixture.stop().await;
}

#[tokio::test]
async fn an_account_is_opened_once() {
    let mut fixture = Fixture::start().await;
    let fresh = pb::Account {
        name: "run".to_owned(),
        budget: 10,
        strategy: "mc-q:0.1".to_owned(),
        spent: 0,
        leased: 0,
        left: 10,
        warning: String::new(),
    };
    assert_eq!(fixture.open(10, "mc-q").await.unwrap(), fresh);
    fixture.advise(vec![step(0)]).await.unwrap();
    let spent = pb::Account { spent: 1, left: 9, ..fresh };
    assert_eq!(fixture.open(10, "mc-q:0.1").await.unwrap(), spent);
    let request = pb::GetAccountRequest { name: "run".to_owned() };
    assert_eq!(fixture.client.get_account(request).await.unwrap().into_inner(), spent);

    let (code, message) = refusal(fixture.open(11, "ea").await);
    assert_eq!(code, Code::AlreadyExists);
    assert!(
        message.contains("budget 10 and strategy mc-q:0.1, not with budget 11 and strategy ea"),
        "{message}"
    );
    fixture.stop().await;
}

#[tokio::test]
async fn advice_is_charged_once_and_ends_with_the_budget() {
    let mut fixture = Fixture::start().await;
    fixture.open(2, "ea").await.unwrap();
    for _ in 0..2 {
        let response = fixture.advise(vec![step(0), step(1), step(2)]).await.unwrap();
        assert_eq!(response.budget_left, 0);
        let charged: Vec<bool> = response.steps.iter().map(|step| step.charged).collect();
        assert_eq!(charged, [true, true, false]);
        assert_eq!(response.steps[1].action, [0.5, 0.0, 0.0, 0.0, 0.25, 0.0]);
        assert_eq!(response.steps[2].action, [0.0; 6]);
    }
    fixture.stop().await;
}

#[tokio::test]
async fn a_request_of_many_steps_is_answered_like_many_requests() {
    let mut fixture = Fixture::start().await;
    fixture.open(30, "eamc:0.1").await.unwrap();
    let together = fixture.advise((0..40).map(step).collect()).await.unwrap();
    for (step_idx, first) in (0..40).zip(together.steps) {
        let expected = pb::StepAdvice { repeated: true, ..first };
        assert_eq!(fixture.advise(vec![step(step_idx)]).await.unwrap().steps, [expected]);
    }
    fixture.stop().await;
}

#[tokio::test]
async fn a_stream_is_answered_in_order_until_a_request_is_refused() {
    let mut fixture = Fixture::start().await;
    fixture.open(100, "ea").await.unwrap();
    let (sender, mut answers) = fixture.stream().await;
    let ask = |steps| pb::AdviseRequest { account: "run".to_owned(), steps, ..Default::default() };
    for first in [0_u32, 1, 2] {
        sender.send(ask((0..=first).map(|i| step(10 * first + i)).collect())).await.unwrap();
    }
    sender.send(ask(vec![pb::StepQuery { goal: vec![], ..step(0) }])).await.unwrap();
    for n_steps in [1, 2, 3] {
        assert_eq!(answers.message().await.unwrap().unwrap().steps.len(), n_steps);
    }
    let (code, message) = refusal(answers.message().await);
    assert_eq!(code, Code::InvalidArgument);
    assert_eq!(message, "steps[0].goal: expected 6 numbers, got 0 numbers");
    drop((sender, answers));
    fixture.stop().await;
}

#[tokio::test]
async fn an_open_stream_does_not_keep_the_service_alive() {
    let mut fixture = Fixture::start().await;
    fixture.open(1, "ea").await.unwrap();
    let (sender, mut answers) = fixture.stream().await;
    fixture.shutdown.cancel();
    assert_eq!(refusal(answers.message().await).0, Code::Unavailable);
    fixture.served.await.unwrap().unwrap();
    drop(sender);
}

#[tokio::test]
async fn invalid_requests_are_refused_by_field() {
    let mut fixture = Fixture::start().await;
    fixture.open(10, "ea").await.unwrap();
    let check = |outcome: Result<pb::AdviseResponse, Status>, expected: &str| {
        assert_eq!(refusal(outcome), (Code::InvalidArgument, expected.to_owned()));
    };
    let short = pb::StepQuery { observation: vec![0.0; 55], ..step(0) };
    check(
        fixture.advise(vec![step(0), short]).await,
        "steps[1].observation: expected 28 numbers for each of 1 to 8 arms, got 55 numbers",
    );
    let mut nan = step(0);
    nan.goal[2] = f32::NAN;
    check(fixture.advise(vec![nan]).await, "steps[0].goal[2]: expected a finite number, got NaN");
    let mut large = step(0);
    large.proposed_action[0] = 1.5;
    check(
        fixture.advise(vec![large]).await,
        "steps[0].proposed_action[0]: expected a number in [-1, 1], got 1.5",
    );
    check(fixture.advise(vec![step(0); 1025]).await, "steps: expected at most 1024, got 1025");
    assert_eq!(fixture.open(10, "ea").await.unwrap().spent, 0);

    let strategy = refusal(fixture.open(10, "mc-x:0.1").await);
    assert_eq!(strategy.0, Code::InvalidArgument);
    assert!(strategy.1.starts_with("strategy: expected none, ea,"), "{}", strategy.1);
    let budget = refusal(fixture.open(1_000_000_000_001, "ea").await);
    assert_eq!(
        budget,
        (
            Code::InvalidArgument,
            "budget: expected 0 to 1000000000000, got 1000000000001".to_owned()
        )
    );
    let unnamed = fixture.client.get_account(pb::GetAccountRequest { name: String::new() }).await;
    assert_eq!(
        refusal(unnamed),
        (Code::InvalidArgument, "name: expected 1 to 256 bytes, got 0".to_owned())
    );
    fixture.stop().await;
}

#[tokio::test]
async fn an_unknown_account_is_not_found() {
    let mut fixture = Fixture::start().await;
    let name = || "unknown".to_owned();
    let got = fixture.client.get_account(pb::GetAccountRequest { name: name() }).await;
    assert_eq!(refusal(got).0, Code::NotFound);
    assert_eq!(refusal(fixture.advise(vec![step(0)]).await).0, Code::NotFound);
    let leases = pb::OpenLeasesRequest { account: name(), episodes: vec![1], units_per_episode: 1 };
    assert_eq!(refusal(fixture.client.open_leases(leases).await).0, Code::NotFound);
    let settle = pb::SettleLeasesRequest { account: name(), episodes: vec![1] };
    assert_eq!(refusal(fixture.client.settle_leases(settle).await).0, Code::NotFound);
    fixture.stop().await;
}

#[tokio::test]
async fn a_round_leases_spends_and_settles() {
    let mut fixture = Fixture::start().await;
    fixture.open(60, "eamc:0.1").await.unwrap();
    let request = pb::OpenLeasesRequest {
        account: "run".to_owned(),
        episodes: vec![1, 2],
        units_per_episode: 50,
    };
    for _ in 0..2 {
        let opened = fixture.client.open_leases(request.clone()).await.unwrap().into_inner();
        let lease = |episode, units, early_units| pb::Lease { episode, units, early_units };
        assert_eq!(opened.leases, [lease(1, 50, 30), lease(2, 10, 0)]);
        assert_eq!(opened.account.map(|account| (account.leased, account.left)), Some((60, 0)));
    }
    let advised = fixture.advise(vec![step(0), step(1)]).await.unwrap();
    let layout = tandem_core::Layout::new(tandem_core::Task::Push, 2);
    for advice in advised.steps {
        assert_eq!(decode_advice(advice, layout).unwrap().overridden_arms(), 0b11);
    }
    let request = pb::SettleLeasesRequest { account: "run".to_owned(), episodes: vec![2, 1] };
    for _ in 0..2 {
        let settled = fixture.client.settle_leases(request.clone()).await.unwrap().into_inner();
        assert_eq!((settled.spent, settled.leased, settled.left), (2, 0, 58));
    }
    fixture.stop().await;
}

#[tokio::test]
async fn a_pending_request_is_answered_before_the_service_ends() {
    let ask = || pb::AdviseRequest {
        account: "run".to_owned(),
        steps: vec![step(0)],
        ..Default::default()
    };
    let held_up = async || {
        let mut fixture = Fixture::start().await;
        fixture.open(10, "ea").await.unwrap();
        // The strategy is cached now, so only the charge blocks.
        assert_eq!(fixture.advise(Vec::new()).await.unwrap().budget_left, 10);
        fixture.gate.set(Mode::Block);
        fixture
    };
    let let_end = async |fixture: &Fixture| {
        fixture.gate.charge_called(1).await;
        fixture.shutdown.cancel();
        fixture.gate.set(Mode::Answer);
    };

    let mut fixture = held_up().await;
    let (sender, mut answers) = fixture.stream().await;
    sender.send(ask()).await.unwrap();
    let_end(&fixture).await;
    assert_eq!(answers.message().await.unwrap().unwrap().budget_left, 9);
    assert_eq!(refusal(answers.message().await).0, Code::Unavailable);
    drop((sender, answers));
    fixture.stop().await;

    let fixture = held_up().await;
    let mut client = fixture.client.clone();
    let asked = tokio::spawn(async move { client.advise(ask()).await });
    let_end(&fixture).await;
    assert_eq!(asked.await.unwrap().unwrap().into_inner().budget_left, 9);
    fixture.stop().await;
}

/// Returns the code and message with which each kind of call is refused.
async fn refusals(fixture: &mut Fixture) -> Vec<(Code, String)> {
    let (sender, mut answers) = fixture.stream().await;
    let ask =
        pb::AdviseRequest { account: "run".to_owned(), steps: vec![step(0)], ..Default::default() };
    sender.send(ask.clone()).await.unwrap();
    let name = || "run".to_owned();
    let leases = pb::OpenLeasesRequest { account: name(), episodes: vec![1], units_per_episode: 1 };
    let settle = pb::SettleLeasesRequest { account: name(), episodes: vec![1] };
    let [mut first, mut second, mut third, mut fourth] = [(); 4].map(|()| fixture.client.clone());
    let get = pb::GetAccountRequest { name: name() };
    let (advise, streamed, get, leases, settle) = tokio::join!(
        first.advise(ask),
        answers.message(),
        second.get_account(get),
        third.open_leases(leases),
        fourth.settle_leases(settle),
    );
    vec![refusal(advise), refusal(streamed), refusal(get), refusal(leases), refusal(settle)]
}

#[tokio::test]
async fn every_call_is_unavailable_while_the_ledger_is() {
    let mut fixture = Fixture::start().await;
    fixture.open(10, "ea").await.unwrap();
    for (mode, message) in [
        (Mode::Refuse, "the ledger cannot be used now: the disk is full"),
        (Mode::Block, "no answer within 4s: ask again"),
    ] {
        fixture.gate.set(mode);
        let expected = (Code::Unavailable, message.to_owned());
        assert_eq!(refusals(&mut fixture).await, vec![expected; 5]);
        fixture.client.describe(pb::DescribeRequest {}).await.unwrap();
        fixture.gate.set(Mode::Answer);
        assert!(fixture.advise(vec![step(0)]).await.unwrap().steps[0].charged);
    }
    assert_eq!(fixture.open(10, "ea").await.unwrap().spent, 1);
    fixture.stop().await;
}

#[tokio::test]
async fn a_panic_is_an_internal_error_and_ends_the_service() {
    let mut fixture = Fixture::start().await;
    fixture.open(10, "ea").await.unwrap();
    let (sender, mut answers) = fixture.stream().await;
    fixture.gate.set(Mode::Panic);
    let ask =
        pb::AdviseRequest { account: "run".to_owned(), steps: vec![step(0)], ..Default::default() };
    sender.send(ask).await.unwrap();
    let (code, message) = refusal(answers.message().await);
    assert_eq!(
        (code, message.as_str()),
        (Code::Internal, "the teacher has a bug and ends: see its log")
    );
    let Fixture { client, channel, served, .. } = fixture;
    drop((client, channel, sender, answers));
    assert!(matches!(served.await.unwrap(), Err(Error::Panicked)));
}

/// A writer into memory that tests read as the log.
#[derive(Clone, Default)]
struct Log(std::sync::Arc<std::sync::Mutex<Vec<u8>>>);

impl std::io::Write for Log {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap().extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[tokio::test]
async fn many_failures_for_one_reason_are_one_line_of_the_log() {
    let log = Log::default();
    let to = log.clone();
    let subscriber =
        tracing_subscriber::fmt().with_ansi(false).with_writer(move || to.clone()).finish();
    let logged = tracing::subscriber::set_default(subscriber);
    let mut fixture = Fixture::start().await;
    fixture.open(10, "ea").await.unwrap();
    fixture.gate.set(Mode::Refuse);
    for _ in 0..20 {
        assert_eq!(refusal(fixture.advise(vec![step(0)]).await).0, Code::Unavailable);
    }
    fixture.stop().await;
    drop(logged);
    let text = String::from_utf8(log.0.lock().unwrap().clone()).unwrap();
    let lines: Vec<&str> = text.lines().filter(|line| line.contains("request failed")).collect();
    assert!(lines.len() == 1 && lines[0].contains("the disk is full"), "{text}");
}
