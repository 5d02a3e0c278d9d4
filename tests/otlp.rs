//! Traces of a run, as a collector receives them: `cargo test --release --features otlp --test otlp`.

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;
use std::sync::{Arc, Mutex};

use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{
    TraceService, TraceServiceServer,
};
use opentelemetry_proto::tonic::collector::trace::v1::{
    ExportTraceServiceRequest, ExportTraceServiceResponse,
};
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::trace::v1::{ResourceSpans, Span};
use tokio::net::TcpListener;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Request, Response, Status};

/// A collector that keeps all spans with the name of their service.
#[derive(Clone, Default)]
struct Collector(Arc<Mutex<Vec<(String, Span)>>>);

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        let mut kept = self.0.lock().expect("no panic");
        for from in request.into_inner().resource_spans {
            let service = service_name(&from);
            let spans = from.scope_spans.into_iter().flat_map(|scope| scope.spans);
            kept.extend(spans.map(|span| (service.clone(), span)));
        }
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

fn service_name(from: &ResourceSpans) -> String {
    let attributes = from.resource.iter().flat_map(|resource| &resource.attributes);
    let mut names = attributes.filter(|attribute| attribute.key == "service.name");
    match names.next().and_then(|name| name.value.clone()).and_then(|value| value.value) {
        Some(Value::StringValue(name)) => name,
        _ => String::new(),
    }
}

/// Trains for two rounds and returns the spans of all services.
async fn spans_of_a_run() -> Vec<(String, Span)> {
    let directory = tempfile::tempdir().expect("a directory");
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let endpoint = format!("http://{}", listener.local_addr().expect("bound"));
    let collector = Collector::default();
    let server = tonic::transport::Server::builder()
        .add_service(TraceServiceServer::new(collector.clone()))
        .serve_with_incoming(TcpListenerStream::new(listener));
    let serving = tokio::spawn(server);
    let out = directory.path().join("run");
    let train = move || {
        Command::new(env!("CARGO_BIN_EXE_tandem"))
            .args(["train", "--max-env-steps", "1600", "--workers", "1", "--out"])
            .arg(out)
            .args(["--set", "ddpg.n_hidden=16", "--set", "evaluation.episodes=4"])
            .args(["--set", "evaluation.test_episodes=4"])
            .env("OTEL_EXPORTER_OTLP_ENDPOINT", endpoint)
            .output()
    };
    let ended = tokio::task::spawn_blocking(train).await.expect("no panic").expect("runs");
    assert!(ended.status.success(), "{}", String::from_utf8_lossy(&ended.stderr));
    serving.abort();
    let mut kept = collector.0.lock().expect("no panic");
    std::mem::take(&mut *kept)
}

#[tokio::test]
async fn the_spans_of_a_slot_have_one_trace_across_worker_teacher_and_learner() {
    let spans = spans_of_a_run().await;
    let mut traces: BTreeMap<&[u8], Vec<&(String, Span)>> = BTreeMap::new();
    for span in &spans {
        assert_eq!((span.1.trace_id.len(), span.1.span_id.len()), (16, 8), "{span:?}");
        assert!(span.1.start_time_unix_nano <= span.1.end_time_unix_nano, "{span:?}");
        traces.entry(&span.1.trace_id).or_default().push(span);
    }
    let is_advised = |trace: &&Vec<&(String, Span)>| {
        trace.iter().any(|(service, _)| service == "tandem-teacher")
    };
    let advised: Vec<_> = traces.values().filter(is_advised).collect();
    assert!(!advised.is_empty(), "{} spans", spans.len());
    for trace in advised {
        let services: BTreeSet<&str> = trace.iter().map(|(service, _)| service.as_str()).collect();
        assert_eq!(
            services.into_iter().collect::<Vec<_>>(),
            ["tandem-learner", "tandem-teacher", "tandem-worker"]
        );
        let of = |service: &str, name: &str| -> Vec<&Span> {
            let named = trace.iter().filter(|(of, span)| of == service && span.name == name);
            named.map(|(_, span)| span).collect()
        };
        let (slots, asked) = (of("tandem-worker", "slot"), of("tandem-worker", "advise"));
        let (answered, submitted) = (of("tandem-teacher", "Advise"), of("tandem-worker", "submit"));
        let received = of("tandem-learner", "SubmitEpisodes");
        assert_eq!((slots.len(), submitted.len(), received.len()), (1, 1, 1));
        // One request for advice for each of an episode's 50 steps.
        assert_eq!((asked.len(), answered.len()), (50, 50));
        assert!(slots[0].parent_span_id.is_empty());
        assert_eq!(submitted[0].parent_span_id, slots[0].span_id);
        assert_eq!(received[0].parent_span_id, submitted[0].span_id);
        let ids: BTreeSet<&[u8]> = asked.iter().map(|span| span.span_id.as_slice()).collect();
        assert_eq!(ids.len(), 50);
        assert!(asked.iter().all(|span| span.parent_span_id == slots[0].span_id));
        assert!(answered.iter().all(|span| ids.contains(span.parent_span_id.as_slice())));
    }
}
