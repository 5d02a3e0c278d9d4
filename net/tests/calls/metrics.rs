//! Metrics and trace contexts of calls, at the server and at the client.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tandem_net::{ClientConfig, Metrics, ServerConfig, TraceContext};
use tandem_proto::pb;
use tandem_proto::pb::bridge_client::BridgeClient;
use tandem_proto::pb::teacher_client::TeacherClient;
use tonic::Request;

use crate::calls::support::{OTHER, SECRET, Served, token};

/// Metrics by a clock that advances by 1 ms at each reading.
fn metrics() -> Metrics {
    let n_readings = AtomicU64::new(0);
    Metrics::new(Arc::new(move || Duration::from_millis(n_readings.fetch_add(1, Ordering::SeqCst))))
}

fn count(side: &str, service: &str, method: &str, code: &str, n: u32) -> String {
    format!(
        "tandem_rpc_{side}_seconds_count{{service=\"{service}\",method=\"{method}\",code=\"{code}\"}} {n}\n"
    )
}

#[tokio::test]
async fn calls_are_counted_with_their_outcomes_on_both_sides() {
    let (at_server, at_client) = (metrics(), metrics());
    let server = ServerConfig::default().with_token(token(SECRET)).with_metrics(at_server.clone());
    let served = Served::start(&server).await;
    let address = served.address.to_string();
    let with = |secret: &str| {
        let config = ClientConfig::default().with_token(&token(secret));
        config.with_metrics(at_client.clone()).channel(&address).expect("an address")
    };
    let mut teacher = TeacherClient::new(with(SECRET));
    for _ in 0..2 {
        teacher.describe(pb::DescribeRequest {}).await.expect("answers");
    }
    let requests = tokio_stream::iter([pb::AdviseRequest::default()]);
    let mut answers = teacher.advise_stream(requests).await.expect("answers").into_inner();
    while answers.message().await.expect("no error").is_some() {}
    let denied = TeacherClient::new(with(OTHER)).describe(pb::DescribeRequest {}).await;
    denied.expect_err("another token");
    let mut bridge = BridgeClient::new(with(SECRET));
    let unknown = bridge.status(pb::BridgeStatusRequest::default()).await;
    unknown.expect_err("another service");
    let pages = [("server", at_server.page()), ("client", at_client.page())];
    for (side, page) in pages {
        for expected in [
            count(side, "tandem.v1.Teacher", "Describe", "OK", 2),
            count(side, "tandem.v1.Teacher", "AdviseStream", "OK", 1),
            count(side, "tandem.v1.Teacher", "Describe", "UNAUTHENTICATED", 1),
            count(side, "tandem.v1.Bridge", "Status", "UNIMPLEMENTED", 1),
        ] {
            assert!(page.contains(&expected), "{expected} in {page}");
        }
        let sums = page.lines().filter(|line| line.contains("_seconds_sum{"));
        assert!(sums.clone().count() >= 4, "{page}");
        assert!(sums.clone().all(|line| !line.ends_with(" 0.0")), "{page}");
        let open = page.lines().filter(|line| line.contains("_in_progress{"));
        assert!(open.clone().all(|line| line.ends_with(" 0")), "{page}");
    }
}

#[tokio::test]
async fn a_call_carries_the_trace_context_of_its_request() {
    let served = Served::start(&ServerConfig::default()).await;
    let address = served.address.to_string();
    let channel = ClientConfig::default().channel(&address).expect("an address");
    let trace = TraceContext::of(&[7, 3]).child("submit", 0);
    let mut request = Request::new(pb::DescribeRequest {});
    request.extensions_mut().insert(trace);
    TeacherClient::new(channel.clone()).describe(request).await.expect("answers");
    TeacherClient::new(channel).describe(pb::DescribeRequest {}).await.expect("answers");
    assert_eq!(served.counter.traces(), [Some(trace.child("server", 0)), None]);
}
