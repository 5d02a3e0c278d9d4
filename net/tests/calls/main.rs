//! Services and clients over real sockets: access and error messages.

mod metrics;
mod support;

use std::time::Duration;

use support::{Authority, Identity, OTHER, SECRET, Served, token};
use tandem_net::{
    AuthChannel, ClientConfig, Connection, HealthError, Incoming, ServerConfig, WrongService,
    check_health,
};
use tandem_proto::pb;
use tandem_proto::pb::bridge_client::BridgeClient;
use tandem_proto::pb::learner_client::LearnerClient;
use tandem_proto::pb::teacher_client::TeacherClient;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::server::NamedService;
use tonic::{Code, Status};
use tonic_reflection::pb::{v1, v1alpha};

/// A deadline that no call reaches, even on a busy machine.
const LONG: Duration = Duration::from_secs(60);

/// The configurations of a client and a server that fit each other.
struct Pair {
    client: ClientConfig,
    server: ServerConfig,
}

fn plain() -> Pair {
    Pair { client: ClientConfig::default(), server: ServerConfig::default() }
}

fn trusting(authority: &Authority, identity: &Identity) -> Pair {
    let client =
        ClientConfig::default().with_authority(authority.pem().as_bytes()).expect("a certificate");
    Pair { client, server: identity.add_to(ServerConfig::default()) }
}

fn with_tls() -> Pair {
    let authority = Authority::new("ours");
    let identity = authority.sign("127.0.0.1");
    trusting(&authority, &identity)
}

async fn describe(channel: &AuthChannel) -> Result<(), Status> {
    let call = TeacherClient::new(channel.clone()).describe(pb::DescribeRequest {}).await;
    call.map(drop)
}

/// Makes every call that a service offers, including streams and reflection, and returns the outcomes by name.
async fn call_all(channel: &AuthChannel) -> Vec<(&'static str, Result<(), Status>)> {
    let mut teacher = TeacherClient::new(channel.clone());
    let requests = || tokio_stream::iter([pb::AdviseRequest::default()]);
    let streamed = async {
        let answers = TeacherClient::new(channel.clone()).advise_stream(requests()).await?;
        answers.into_inner().message().await.map(drop)
    };
    vec![
        ("Describe", teacher.describe(pb::DescribeRequest {}).await.map(drop)),
        ("OpenAccount", teacher.open_account(pb::OpenAccountRequest::default()).await.map(drop)),
        ("GetAccount", teacher.get_account(pb::GetAccountRequest::default()).await.map(drop)),
        ("Advise", teacher.advise(pb::AdviseRequest::default()).await.map(drop)),
        ("AdviseStream", streamed.await),
        ("OpenLeases", teacher.open_leases(pb::OpenLeasesRequest::default()).await.map(drop)),
        ("SettleLeases", teacher.settle_leases(pb::SettleLeasesRequest::default()).await.map(drop)),
        ("reflection v1", reflect_v1(channel).await.map(drop)),
        ("reflection v1alpha", reflect_v1alpha(channel).await.map(drop)),
    ]
}

/// Returns the services that a version of reflection lists.
macro_rules! listed_services {
    ($version:ident, $channel:expr) => {{
        use $version::server_reflection_request::MessageRequest::ListServices;
        use $version::server_reflection_response::MessageResponse::ListServicesResponse;
        let request = $version::ServerReflectionRequest {
            host: String::new(),
            message_request: Some(ListServices(String::new())),
        };
        let mut client = $version::server_reflection_client::ServerReflectionClient::new($channel);
        let answers = client.server_reflection_info(tokio_stream::iter([request])).await?;
        let answer = answers.into_inner().message().await?.expect("an answer");
        match answer.message_response {
            Some(ListServicesResponse(listed)) => {
                Ok(listed.service.into_iter().map(|service| service.name).collect())
            }
            other => Err(Status::internal(format!("not a list of services: {other:?}"))),
        }
    }};
}

async fn reflect_v1(channel: &AuthChannel) -> Result<Vec<String>, Status> {
    listed_services!(v1, channel.clone())
}

async fn reflect_v1alpha(channel: &AuthChannel) -> Result<Vec<String>, Status> {
    listed_services!(v1alpha, channel.clone())
}

#[tokio::test]
async fn every_call_but_health_requires_the_right_token() {
    for pair in [plain(), with_tls()] {
        let served = Served::start(&pair.server.with_token(token(SECRET))).await;
        let address = served.address.to_string();
        let expected = |shown: Option<&str>| match shown {
            Some(_) => format!("{address} does not accept the token"),
            None => format!("{address} requires a token"),
        };
        for shown in [None, Some(OTHER), Some("the-right-token-01234"), Some("the-right-token-012")]
        {
            let client = match shown {
                Some(text) => pair.client.clone().with_token(&token(text)),
                None => pair.client.clone(),
            };
            let channel = client.channel(&address).expect("an address");
            for (name, outcome) in call_all(&channel).await {
                let status = outcome.expect_err(name);
                assert_eq!(status.code(), Code::Unauthenticated, "{name}: {status}");
                let message = status.message();
                assert!(message.starts_with(&expected(shown)), "{name}: {message}");
                assert!(message.contains("--token-file"), "{name}: {message}");
            }
            check_health(channel, "tandem.v1.Teacher", LONG).await.expect("health needs no token");
        }
        assert_eq!(served.counter.n_calls(), 0);

        let channel = pair.client.with_token(&token(SECRET)).channel(&address).expect("an address");
        for (name, outcome) in call_all(&channel).await {
            assert!(outcome.is_ok(), "{name}: {outcome:?}");
        }
        assert_eq!(served.counter.n_calls(), 7);
    }
}

#[tokio::test]
async fn reflection_lists_the_services_at_the_address_only() {
    let served = Served::start(&ServerConfig::default()).await;
    let channel = ClientConfig::default().channel(&served.address.to_string()).expect("an address");
    for listed in [reflect_v1(&channel).await, reflect_v1alpha(&channel).await] {
        let mut listed = listed.expect("listed");
        listed.sort();
        assert_eq!(listed, ["grpc.health.v1.Health", "tandem.v1.Teacher"]);
    }
}

#[tokio::test]
async fn a_service_without_a_token_accepts_every_call() {
    let served = Served::start(&ServerConfig::default()).await;
    for client in [ClientConfig::default(), ClientConfig::default().with_token(&token(SECRET))] {
        describe(&client.channel(&served.address.to_string()).expect("an address"))
            .await
            .expect("accepted");
    }
    assert_eq!(served.counter.n_calls(), 2);
}

#[tokio::test]
async fn the_token_is_checked_before_the_request_is_decoded() {
    // A number in place of a name, which cannot be decoded.
    type Garbled = tonic_prost::ProstCodec<pb::NextWorkRequest, pb::Account>;
    let served = Served::start(&ServerConfig::default().with_token(token(SECRET))).await;
    let open_garbled = async |text: &str| {
        let client = ClientConfig::default().with_token(&token(text));
        let channel = client.channel(&served.address.to_string()).expect("an address");
        let mut caller = tonic::client::Grpc::new(channel);
        caller.ready().await.expect("ready");
        let path = http::uri::PathAndQuery::from_static("/tandem.v1.Teacher/OpenAccount");
        let request = tonic::Request::new(pb::NextWorkRequest { worker_id: 5 });
        let outcome = caller.unary(request, path, Garbled::default()).await;
        outcome.expect_err("cannot be read").code()
    };
    assert_eq!(open_garbled(SECRET).await, Code::InvalidArgument);
    assert_eq!(open_garbled(OTHER).await, Code::Unauthenticated);
    assert_eq!(served.counter.n_calls(), 0);
}

#[tokio::test]
async fn a_stream_without_a_message_is_rejected_too() {
    let served = Served::start(&ServerConfig::default().with_token(token(SECRET))).await;
    let channel = ClientConfig::default().channel(&served.address.to_string()).expect("an address");
    let (_silent, requests) = mpsc::channel::<pb::AdviseRequest>(1);
    let opening = TeacherClient::new(channel).advise_stream(ReceiverStream::new(requests)).await;
    assert_eq!(opening.expect_err("rejected").code(), Code::Unauthenticated);
    assert_eq!(served.counter.n_calls(), 0);
}

#[tokio::test]
async fn a_certificate_must_be_signed_by_the_authority_for_this_name_and_not_be_expired() {
    let (ours, theirs) = (Authority::new("ours"), Authority::new("theirs"));
    for (identity, reason) in [
        (theirs.sign("127.0.0.1"), "UnknownIssuer"),
        (ours.sign_until("127.0.0.1", 2020), "expired"),
        (ours.sign("learner.example"), "not valid for"),
    ] {
        let pair = trusting(&ours, &identity);
        let served = Served::start(&pair.server).await;
        let address = served.address.to_string();
        let channel = pair.client.with_token(&token(SECRET)).channel(&address).expect("an address");
        let status = describe(&channel).await.expect_err("not trusted");
        assert_eq!(status.code(), Code::Unavailable, "{status}");
        let message = status.message();
        assert!(
            message.starts_with(&format!("{address} is not trusted, see --tls-ca")),
            "{message}"
        );
        assert!(message.contains(reason), "{message} lacks {reason}");
        assert_eq!(served.counter.n_calls(), 0);
    }
}

#[tokio::test]
async fn a_tls_mismatch_is_reported_and_ends_once_the_service_has_changed() {
    let tls = with_tls();
    let plain_link = |address: &str| ClientConfig::default().channel(address).expect("an address");
    let tls_link = |address: &str| tls.client.channel(address).expect("an address");
    let rejection = async |channel: &AuthChannel| {
        let status = describe(channel).await.expect_err("TLS mismatch");
        assert_eq!(status.code(), Code::Unavailable, "{status}");
        status.message().to_owned()
    };

    let served = Served::start(&tls.server).await;
    let (address, channel) = (served.address.to_string(), plain_link(&served.address.to_string()));
    for _ in 0..5 {
        let message = rejection(&channel).await;
        assert!(message.starts_with(&format!("{address} speaks TLS")), "{message}");
        assert!(message.contains("--tls-ca"), "{message}");
    }
    assert_eq!(served.counter.n_calls(), 0);
    let restarted = Served::start_on(served.stop().await, &ServerConfig::default()).await;
    call_until_success(&channel).await;

    let channel = tls_link(&address);
    for _ in 0..5 {
        let message = rejection(&channel).await;
        assert!(message.starts_with(&format!("{address} does not speak TLS")), "{message}");
        assert!(message.contains("--tls-cert"), "{message}");
    }
    assert_eq!(restarted.counter.n_calls(), 1);
    let _restarted = Served::start_on(restarted.stop().await, &tls.server).await;
    call_until_success(&channel).await;
}

/// Calls until a call succeeds: the client may take a moment to notice that the previous connection is closed.
async fn call_until_success(channel: &AuthChannel) {
    let calling = async {
        while describe(channel).await.is_err() {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(LONG, calling).await.expect("gets through");
}

#[tokio::test]
async fn a_failed_connection_is_reported_with_the_address() {
    let served = Served::start(&ServerConfig::default()).await;
    let address = served.address.to_string();
    drop(served.stop().await);
    let status = describe(&ClientConfig::default().channel(&address).expect("an address"))
        .await
        .expect_err("no server");
    assert_eq!(status.code(), Code::Unavailable, "{status}");
    assert!(status.message().starts_with(&format!("{address} does not answer: ")), "{status}");
}

#[tokio::test]
async fn the_error_of_a_call_to_another_kind_of_service_names_that_service() {
    let served = Served::start(&ServerConfig::default().with_token(token(SECRET))).await;
    let address = served.address.to_string();
    let channel =
        ClientConfig::default().with_token(&token(SECRET)).channel(&address).expect("an address");
    let join = LearnerClient::new(channel.clone()).join(pb::JoinRequest::default()).await;
    let execute = BridgeClient::new(channel.clone()).execute(tokio_stream::empty()).await;
    let mut caller = tonic::client::Grpc::new(channel);
    caller.ready().await.expect("ready");
    let path = http::uri::PathAndQuery::from_static("/tandem.v1.Teacher/Guess");
    let codec = tonic_prost::ProstCodec::<(), ()>::default();
    let unknown = caller.unary(tonic::Request::new(()), path, codec).await;
    for (outcome, expected) in [
        (join.map(drop), "is a teacher, not a learner: check the address"),
        (execute.map(drop), "is a teacher, not a bridge: check the address"),
        (unknown.map(drop), "does not know /tandem.v1.Teacher/Guess: it is of another version"),
    ] {
        let status = outcome.expect_err(expected);
        assert_eq!(status.code(), Code::Unimplemented, "{status}");
        let message = status.message();
        assert!(message.contains(&address) && message.ends_with(expected), "{message}");
    }
}

#[tokio::test]
async fn tokens_and_tls_work_over_any_network() {
    let pair = with_tls();
    let (connections, accepted) = mpsc::channel(4);
    let incoming = Incoming::new(ReceiverStream::new(accepted));
    let (counter, serving) = support::serve(incoming, &pair.server.with_token(token(SECRET))).await;
    let connect = move |_| {
        let connections = connections.clone();
        async move {
            let (near, far) = tokio::io::duplex(1 << 16);
            connections.send(Ok(Connection::new(far))).await.expect("the service is there");
            Ok(Connection::new(near))
        }
    };
    let client = pair.client.with_connector(connect);
    let right =
        client.clone().with_token(&token(SECRET)).channel("127.0.0.1:1").expect("an address");
    describe(&right).await.expect("gets in");
    let wrong = client.with_token(&token(OTHER)).channel("127.0.0.1:1").expect("an address");
    let status = describe(&wrong).await.expect_err("rejected");
    assert_eq!(status.code(), Code::Unauthenticated, "{status}");
    assert_eq!(counter.n_calls(), 1);
    serving.abort();
}

#[tokio::test(start_paused = true)]
async fn a_connection_without_a_request_is_closed_and_one_that_made_a_request_is_kept() {
    let (connections, accepted) = mpsc::channel(4);
    let incoming = Incoming::new(ReceiverStream::new(accepted));
    let (_, serving) =
        support::serve(incoming, &ServerConfig::default().with_token(token(SECRET))).await;
    let connect = async || {
        let (near, far) = tokio::io::duplex(1 << 16);
        connections.send(Ok(Connection::new(far))).await.expect("the service is there");
        near
    };
    let mut silent = connect().await;
    silent.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0").await.expect("sent");
    let started = tokio::time::Instant::now();
    silent.read_to_end(&mut Vec::new()).await.expect("closed");
    assert_eq!(started.elapsed().as_secs(), 10);

    let only = std::sync::Mutex::new(Some(connect().await));
    let client = ClientConfig::default().with_connector(move |_| {
        let stream = only.lock().expect("no panic").take();
        async move { stream.map(Connection::new).ok_or(std::io::ErrorKind::NotConnected.into()) }
    });
    let channel = client.channel("127.0.0.1:1").expect("an address");
    check_health(channel.clone(), "", LONG).await.expect("serves");
    tokio::time::sleep(Duration::from_secs(600)).await;
    check_health(channel, "", LONG).await.expect("over the same connection");
    serving.abort();
}

#[tokio::test]
async fn a_health_check_distinguishes_the_ways_of_not_serving() {
    for pair in [plain(), with_tls()] {
        let served = Served::start(&pair.server).await;
        let channel = pair.client.channel(&served.address.to_string()).expect("an address");
        for service in ["", "tandem.v1.Teacher"] {
            check_health(channel.clone(), service, LONG).await.expect("serves");
        }
        let error = check_health(channel, "tandem.v1.Learner", LONG).await.expect_err("not there");
        assert!(matches!(error, HealthError::UnknownService(_)), "{error}");
    }
    // A socket without an accepting process: connections are established, answers never arrive.
    let silent = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = silent.local_addr().expect("bound").to_string();
    let channel = ClientConfig::default().channel(&address).expect("an address");
    let error = check_health(channel, "", Duration::from_millis(200)).await.expect_err("silent");
    assert!(matches!(error, HealthError::Timeout(_)), "{error}");
    drop(silent);
    let channel = ClientConfig::default().channel(&address).expect("an address");
    let error = check_health(channel, "", LONG).await.expect_err("no server");
    assert!(matches!(error, HealthError::Unreachable(_)), "{error}");
}

/// A process that only calls other services.
struct Caller;

impl NamedService for Caller {
    const NAME: &'static str = "tandem.v1.Caller";
}

#[tokio::test]
async fn a_process_without_services_reports_its_own_health_without_a_token() {
    let config = ServerConfig::default().with_token(token(SECRET));
    let (router, reporter) = config.health_router::<Caller>().await.expect("valid");
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("bound").to_string();
    let serving = tokio::spawn(tandem_net::serve(router, listener, CancellationToken::new()));

    let open = ClientConfig::default().channel(&address).expect("an address");
    for is_serving in [true, false, true] {
        reporter.set_serving(is_serving).await;
        for service in ["", Caller::NAME] {
            let health = check_health(open.clone(), service, LONG).await;
            match is_serving {
                true => health.expect("serving"),
                false => assert!(matches!(health, Err(HealthError::NotServing)), "{health:?}"),
            }
        }
    }
    assert_eq!(reflect_v1(&open).await.expect_err("no token").code(), Code::Unauthenticated);
    let client = ClientConfig::default().with_token(&token(SECRET));
    let authenticated = client.channel(&address).expect("an address");
    assert_eq!(reflect_v1(&authenticated).await.expect("listed"), ["grpc.health.v1.Health"]);
    let status = describe(&authenticated).await.expect_err("no teacher");
    let expected = WrongService { name: "caller".to_owned(), address };
    assert_eq!(WrongService::of(&status), Some(expected), "{status}");
    serving.abort();
}
