//! Services and clients over real sockets: who gets in, who is told what.

mod support;

use std::time::Duration;

use support::{Authority, Identity, OTHER, SECRET, Served, token};
use tandem_net::{Connection, Dial, Gate, Incoming, Link, Unwell, check_health};
use tandem_proto::pb;
use tandem_proto::pb::bridge_client::BridgeClient;
use tandem_proto::pb::learner_client::LearnerClient;
use tandem_proto::pb::teacher_client::TeacherClient;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status};
use tonic_reflection::pb::{v1, v1alpha};

/// Longer than anything takes, even on a machine that is busy with other things.
const LONG: Duration = Duration::from_secs(60);

/// How calls cross the network: plain, or by TLS with a service of this authority.
struct Net {
    dial: Dial,
    gate: Gate,
}

fn plain() -> Net {
    Net { dial: Dial::default(), gate: Gate::default() }
}

fn trusting(authority: &Authority, identity: &Identity) -> Net {
    let dial = Dial::default().with_authority(authority.pem().as_bytes()).expect("a certificate");
    Net { dial, gate: identity.gate(Gate::default()) }
}

fn by_tls() -> Net {
    let authority = Authority::new("ours");
    let identity = authority.sign("127.0.0.1");
    trusting(&authority, &identity)
}

async fn describe(link: &Link) -> Result<(), Status> {
    let call = TeacherClient::new(link.clone()).describe(pb::DescribeRequest {}).await;
    call.map(drop)
}

/// Every way to call that a service offers, by name: one call each, streams and reflection included.
async fn call_all(link: &Link) -> Vec<(&'static str, Result<(), Status>)> {
    let mut teacher = TeacherClient::new(link.clone());
    let requests = || tokio_stream::iter([pb::AdviseRequest::default()]);
    let streamed = async {
        let answers = TeacherClient::new(link.clone()).advise_stream(requests()).await?;
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
        ("reflection v1", reflect_v1(link).await),
        ("reflection v1alpha", reflect_v1alpha(link).await),
    ]
}

async fn reflect_v1(link: &Link) -> Result<(), Status> {
    use v1::server_reflection_request::MessageRequest::ListServices;
    let request = v1::ServerReflectionRequest {
        host: String::new(),
        message_request: Some(ListServices(String::new())),
    };
    v1::server_reflection_client::ServerReflectionClient::new(link.clone())
        .server_reflection_info(tokio_stream::iter([request]))
        .await
        .map(drop)
}

async fn reflect_v1alpha(link: &Link) -> Result<(), Status> {
    use v1alpha::server_reflection_request::MessageRequest::ListServices;
    let request = v1alpha::ServerReflectionRequest {
        host: String::new(),
        message_request: Some(ListServices(String::new())),
    };
    v1alpha::server_reflection_client::ServerReflectionClient::new(link.clone())
        .server_reflection_info(tokio_stream::iter([request]))
        .await
        .map(drop)
}

#[tokio::test]
async fn only_the_right_token_opens_anything_but_health() {
    for net in [plain(), by_tls()] {
        let served = Served::start(&net.gate.with_token(token(SECRET))).await;
        let address = served.address.to_string();
        let told = |shown: Option<&str>| match shown {
            Some(_) => format!("{address} does not accept the token"),
            None => format!("{address} wants a token"),
        };
        for shown in [None, Some(OTHER), Some("the-right-token-01234"), Some("the-right-token-012")]
        {
            let dial = match shown {
                Some(text) => net.dial.clone().with_token(&token(text)),
                None => net.dial.clone(),
            };
            let link = dial.link(&address).expect("an address");
            for (name, outcome) in call_all(&link).await {
                let status = outcome.expect_err(name);
                assert_eq!(status.code(), Code::Unauthenticated, "{name}: {status}");
                let message = status.message();
                assert!(message.starts_with(&told(shown)), "{name}: {message}");
                assert!(message.contains("--token-file"), "{name}: {message}");
            }
            check_health(link, "tandem.v1.Teacher", LONG).await.expect("health needs no token");
        }
        assert_eq!(served.counter.n_calls(), 0);

        let link = net.dial.with_token(&token(SECRET)).link(&address).expect("an address");
        for (name, outcome) in call_all(&link).await {
            assert!(outcome.is_ok(), "{name}: {outcome:?}");
        }
        assert_eq!(served.counter.n_calls(), 7);
    }
}

#[tokio::test]
async fn a_service_without_a_token_lets_everybody_in() {
    let served = Served::start(&Gate::default()).await;
    for dial in [Dial::default(), Dial::default().with_token(&token(SECRET))] {
        describe(&dial.link(&served.address.to_string()).expect("an address")).await.expect("in");
    }
    assert_eq!(served.counter.n_calls(), 2);
}

#[tokio::test]
async fn nothing_of_a_call_is_read_before_its_token_is_right() {
    // A number where a name is expected: whoever decodes it fails.
    type Garbled = tonic_prost::ProstCodec<pb::NextWorkRequest, pb::Account>;
    let served = Served::start(&Gate::default().with_token(token(SECRET))).await;
    let open_garbled = async |text: &str| {
        let dial = Dial::default().with_token(&token(text));
        let link = dial.link(&served.address.to_string()).expect("an address");
        let mut caller = tonic::client::Grpc::new(link);
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
async fn a_stream_that_never_says_anything_is_sent_away_too() {
    let served = Served::start(&Gate::default().with_token(token(SECRET))).await;
    let link = Dial::default().link(&served.address.to_string()).expect("an address");
    let (_silent, requests) = mpsc::channel::<pb::AdviseRequest>(1);
    let opening = TeacherClient::new(link).advise_stream(ReceiverStream::new(requests)).await;
    assert_eq!(opening.expect_err("sent away").code(), Code::Unauthenticated);
    assert_eq!(served.counter.n_calls(), 0);
}

#[tokio::test]
async fn a_certificate_counts_when_the_authority_signed_it_for_this_name_and_it_is_not_expired() {
    let (ours, theirs) = (Authority::new("ours"), Authority::new("theirs"));
    for (identity, reason) in [
        (theirs.sign("127.0.0.1"), "UnknownIssuer"),
        (ours.sign_until("127.0.0.1", 2020), "expired"),
        (ours.sign("learner.example"), "not valid for"),
    ] {
        let net = trusting(&ours, &identity);
        let served = Served::start(&net.gate).await;
        let address = served.address.to_string();
        let link = net.dial.with_token(&token(SECRET)).link(&address).expect("an address");
        let status = describe(&link).await.expect_err("not trusted");
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
async fn who_speaks_otherwise_is_told_so_and_gets_through_once_the_service_has_changed() {
    let tls = by_tls();
    let plain_link = |address: &str| Dial::default().link(address).expect("an address");
    let tls_link = |address: &str| tls.dial.link(address).expect("an address");
    let told = async |link: &Link| {
        let status = describe(link).await.expect_err("another language");
        assert_eq!(status.code(), Code::Unavailable, "{status}");
        status.message().to_owned()
    };

    let served = Served::start(&tls.gate).await;
    let (address, link) = (served.address.to_string(), plain_link(&served.address.to_string()));
    for _ in 0..5 {
        let message = told(&link).await;
        assert!(message.starts_with(&format!("{address} speaks TLS")), "{message}");
        assert!(message.contains("--tls-ca"), "{message}");
    }
    assert_eq!(served.counter.n_calls(), 0);
    let restarted = Served::start_on(served.stop().await, &Gate::default()).await;
    through(&link).await;

    let link = tls_link(&address);
    for _ in 0..5 {
        let message = told(&link).await;
        assert!(message.starts_with(&format!("{address} does not speak TLS")), "{message}");
        assert!(message.contains("--tls-cert"), "{message}");
    }
    assert_eq!(restarted.counter.n_calls(), 1);
    let _restarted = Served::start_on(restarted.stop().await, &tls.gate).await;
    through(&link).await;
}

/// Calls until a call gets through: connections of a service that has ended may take a moment to be noticed.
async fn through(link: &Link) {
    let calling = async {
        while describe(link).await.is_err() {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(LONG, calling).await.expect("gets through");
}

#[tokio::test]
async fn nobody_there_is_told_with_the_address() {
    let served = Served::start(&Gate::default()).await;
    let address = served.address.to_string();
    drop(served.stop().await);
    let status =
        describe(&Dial::default().link(&address).expect("an address")).await.expect_err("nobody");
    assert_eq!(status.code(), Code::Unavailable, "{status}");
    assert!(status.message().starts_with(&format!("{address} does not answer: ")), "{status}");
}

#[tokio::test]
async fn a_call_to_another_kind_of_service_is_told_which_one_it_is() {
    let served = Served::start(&Gate::default().with_token(token(SECRET))).await;
    let address = served.address.to_string();
    let link = Dial::default().with_token(&token(SECRET)).link(&address).expect("an address");
    let join = LearnerClient::new(link.clone()).join(pb::JoinRequest::default()).await;
    let execute = BridgeClient::new(link.clone()).execute(tokio_stream::empty()).await;
    let mut caller = tonic::client::Grpc::new(link);
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
    let net = by_tls();
    let (connections, accepted) = mpsc::channel(4);
    let incoming = Incoming::new(ReceiverStream::new(accepted));
    let (counter, serving) = support::serve(incoming, &net.gate.with_token(token(SECRET))).await;
    let connect = move |_| {
        let connections = connections.clone();
        async move {
            let (near, far) = tokio::io::duplex(1 << 16);
            connections.send(Ok(Connection::new(far))).await.expect("the service is there");
            Ok(Connection::new(near))
        }
    };
    let dial = net.dial.through(connect);
    let right = dial.clone().with_token(&token(SECRET)).link("127.0.0.1:1").expect("an address");
    describe(&right).await.expect("gets in");
    let wrong = dial.with_token(&token(OTHER)).link("127.0.0.1:1").expect("an address");
    let status = describe(&wrong).await.expect_err("sent away");
    assert_eq!(status.code(), Code::Unauthenticated, "{status}");
    assert_eq!(counter.n_calls(), 1);
    serving.abort();
}

#[tokio::test(start_paused = true)]
async fn a_connection_without_a_request_is_closed_and_one_that_made_a_request_is_kept() {
    let (connections, accepted) = mpsc::channel(4);
    let incoming = Incoming::new(ReceiverStream::new(accepted));
    let (_, serving) = support::serve(incoming, &Gate::default().with_token(token(SECRET))).await;
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
    let dial = Dial::default().through(move |_| {
        let stream = only.lock().expect("nobody panics").take();
        async move { stream.map(Connection::new).ok_or(std::io::ErrorKind::NotConnected.into()) }
    });
    let link = dial.link("127.0.0.1:1").expect("an address");
    check_health(link.clone(), "", LONG).await.expect("serves");
    tokio::time::sleep(Duration::from_secs(600)).await;
    check_health(link, "", LONG).await.expect("over the same connection");
    serving.abort();
}

#[tokio::test]
async fn health_tells_serving_from_every_way_of_not_serving() {
    for net in [plain(), by_tls()] {
        let served = Served::start(&net.gate).await;
        let link = net.dial.link(&served.address.to_string()).expect("an address");
        for service in ["", "tandem.v1.Teacher"] {
            check_health(link.clone(), service, LONG).await.expect("serves");
        }
        let unwell = check_health(link, "tandem.v1.Learner", LONG).await.expect_err("not there");
        assert!(matches!(unwell, Unwell::NoSuchService(_)), "{unwell}");
    }
    // A socket that nobody accepts from: connections stand, answers never come.
    let silent = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = silent.local_addr().expect("bound").to_string();
    let link = Dial::default().link(&address).expect("an address");
    let unwell = check_health(link, "", Duration::from_millis(200)).await.expect_err("silent");
    assert!(matches!(unwell, Unwell::Silent(_)), "{unwell}");
    drop(silent);
    let link = Dial::default().link(&address).expect("an address");
    let unwell = check_health(link, "", LONG).await.expect_err("nobody there");
    assert!(matches!(unwell, Unwell::Unreachable(_)), "{unwell}");
}
