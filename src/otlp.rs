//! Export of traces to an OpenTelemetry collector: OTLP over gRPC.
//!
//! A layer turns the spans of [`tandem_net::TraceContext`] into messages, and a thread sends them in batches. Nothing
//! waits for the collector: spans are dropped while it is away.

mod layer;

use std::sync::mpsc as sync;
use std::time::Duration;

use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
use opentelemetry_proto::tonic::collector::trace::v1::trace_service_client::TraceServiceClient;
use opentelemetry_proto::tonic::common::v1::{InstrumentationScope, KeyValue};
use opentelemetry_proto::tonic::resource::v1::Resource;
use opentelemetry_proto::tonic::trace::v1::{ResourceSpans, ScopeSpans, Span};
use tandem_net::{AuthChannel, ClientConfig, within};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use crate::exit::{Exit, Failed, OrExit as _};
use crate::runtime;
use crate::version::VERSION;
use layer::text;

pub(crate) use layer::SpanLayer;

/// The capacity of the queue to the exporting thread. Further spans are dropped.
const QUEUE_CAPACITY: usize = 8192;
/// The largest number of spans in a request.
const MAX_BATCH: usize = 512;
/// The pause between two requests.
const PERIOD: Duration = Duration::from_millis(500);
/// The deadline of a request.
const DEADLINE: Duration = Duration::from_secs(5);
/// The longest time that the process waits at its end for the last spans.
const FLUSH: Duration = Duration::from_secs(2);

/// The exporting thread. Dropping it sends the last spans.
pub(crate) struct Exporter {
    stop: CancellationToken,
    ended: sync::Receiver<()>,
}

/// Starts to export spans to the collector at `endpoint`, as those of service `tandem-{component}`.
pub(crate) fn start(endpoint: &str, component: &str) -> Result<(SpanLayer, Exporter), Failed> {
    let invalid = || "--otlp-endpoint cannot be used".to_owned();
    let runtime = runtime::new().or_exit(Exit::TryAgain, String::new)?;
    // A channel needs a runtime to be created in.
    let address = endpoint.trim_end_matches('/').to_owned();
    let channel = runtime.block_on(async { ClientConfig::default().channel(&address) });
    let client = TraceServiceClient::new(channel.or_exit(Exit::Usage, invalid)?);
    let (sender, spans) = mpsc::channel(QUEUE_CAPACITY);
    let (end_sender, ended) = sync::channel();
    let stop = CancellationToken::new();
    let collector = Collector { client, resource: resource(component), is_away: false };
    let stopped = stop.clone();
    std::thread::Builder::new()
        .name("otlp".to_owned())
        .spawn(move || {
            runtime.block_on(collector.export(spans, stopped));
            // Fails only if the process waits no longer.
            end_sender.send(()).ok();
        })
        .or_exit(Exit::TryAgain, String::new)?;
    Ok((SpanLayer::new(sender), Exporter { stop, ended }))
}

impl Drop for Exporter {
    fn drop(&mut self) {
        self.stop.cancel();
        self.ended.recv_timeout(FLUSH).ok();
    }
}

/// Returns the description of this process.
fn resource(component: &str) -> Resource {
    let name = text(format!("tandem-{component}"));
    let attributes = [("service.name", name), ("service.version", text(VERSION.to_owned()))];
    let attributes = attributes.map(|(key, value)| KeyValue {
        key: key.to_owned(),
        value: Some(value),
        ..KeyValue::default()
    });
    Resource { attributes: attributes.into(), ..Resource::default() }
}

struct Collector {
    client: TraceServiceClient<AuthChannel>,
    resource: Resource,
    /// True if the log has a warning that the collector does not answer.
    is_away: bool,
}

impl Collector {
    /// Sends the spans in batches until `stop` is cancelled and the queue is empty.
    async fn export(mut self, mut spans: mpsc::Receiver<Span>, stop: CancellationToken) {
        loop {
            let is_last = stop.is_cancelled();
            let mut batch = Vec::new();
            while let Ok(span) = spans.try_recv() {
                batch.push(span);
                if batch.len() == MAX_BATCH {
                    self.send(std::mem::take(&mut batch)).await;
                }
            }
            if !batch.is_empty() {
                self.send(batch).await;
            }
            if is_last {
                return;
            }
            tokio::select! {
                () = tokio::time::sleep(PERIOD) => (),
                () = stop.cancelled() => (),
            }
        }
    }

    /// Sends a batch, which is dropped if the collector does not accept it.
    async fn send(&mut self, spans: Vec<Span>) {
        let n_spans = spans.len();
        let scope = InstrumentationScope { name: "tandem".to_owned(), ..Default::default() };
        let scope_spans = ScopeSpans { scope: Some(scope), spans, schema_url: String::new() };
        let resource_spans = ResourceSpans {
            resource: Some(self.resource.clone()),
            scope_spans: vec![scope_spans],
            schema_url: String::new(),
        };
        let request = ExportTraceServiceRequest { resource_spans: vec![resource_spans] };
        match within(DEADLINE, self.client.export(request)).await {
            Ok(_) => self.is_away = false,
            Err(status) if !std::mem::replace(&mut self.is_away, true) => {
                let reason = status.message();
                tracing::warn!(reason, n_spans, "the collector does not accept spans");
            }
            Err(_) => {}
        }
    }
}
