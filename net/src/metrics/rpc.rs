//! Metrics of calls: how long they take and how they end, at servers and at clients.

use std::collections::BTreeMap;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use http::HeaderMap;
use http::header::AUTHORIZATION;
use hyper::body::{Body as HttpBody, Bytes, Frame, SizeHint};
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::Registry;
use prost::Message as _;
use prost_types::FileDescriptorSet;
use tonic::body::Body;
use tonic::{Code, Status};
use tower::{Layer, Service};
use tracing::{Instrument as _, Span};

use super::{LATENCY_BUCKETS_S, Metrics};
use crate::access::Token;
use crate::trace::TraceContext;

/// The name in labels of a call that the service does not have. Clients may call any path.
const UNKNOWN: &str = "unknown";

type CallLabels = [(&'static str, Arc<str>); 2];
type OutcomeLabels = [(&'static str, Arc<str>); 3];
type Histograms = Family<OutcomeLabels, Histogram, fn() -> Histogram>;

/// The metrics of the calls that a process answers and makes.
pub(crate) struct RpcMetrics {
    server: SideMetrics,
    client: SideMetrics,
    codes: [Arc<str>; 17],
}

/// The metrics of one side.
struct SideMetrics {
    seconds: Histograms,
    in_progress: Family<CallLabels, Gauge>,
}

/// The side on which a call is measured.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Side {
    Server,
    Client,
}

impl RpcMetrics {
    pub(super) fn new(registry: &mut Registry) -> Self {
        let server = SideMetrics::default();
        let help = "Time from a request to the end of its response, at the server";
        registry.register("rpc_server_seconds", help, server.seconds.clone());
        let help = "Calls that are being answered";
        registry.register("rpc_server_in_progress", help, server.in_progress.clone());
        let client = SideMetrics::default();
        let help = "Time from a request to the end of its response, at the client";
        registry.register("rpc_client_seconds", help, client.seconds.clone());
        let help = "Calls that wait for an answer";
        registry.register("rpc_client_in_progress", help, client.in_progress.clone());
        let codes = std::array::from_fn(|code| {
            Arc::from(code_name(Code::from_i32(i32::try_from(code).unwrap_or_default())))
        });
        Self { server, client, codes }
    }

    const fn side(&self, side: Side) -> &SideMetrics {
        match side {
            Side::Server => &self.server,
            Side::Client => &self.client,
        }
    }
}

impl Default for SideMetrics {
    fn default() -> Self {
        let histogram: fn() -> Histogram = || Histogram::new(LATENCY_BUCKETS_S);
        Self { seconds: Family::new_with_constructor(histogram), in_progress: Family::default() }
    }
}

/// The calls that a service has, with their labels by path.
#[derive(Debug, Clone, Default)]
pub(crate) struct Methods {
    by_path: Arc<BTreeMap<String, CallLabels>>,
}

impl Methods {
    /// Returns the calls of all services in these encoded `FileDescriptorSet`s. One that cannot be decoded has none.
    pub(crate) fn of(descriptors: &[&[u8]]) -> Self {
        let mut by_path = BTreeMap::new();
        let sets = descriptors.iter().filter_map(|bytes| FileDescriptorSet::decode(*bytes).ok());
        for file in sets.flat_map(|set| set.file) {
            for service in &file.service {
                let name: Arc<str> = format!("{}.{}", file.package(), service.name()).into();
                for method in &service.method {
                    let path = format!("/{name}/{}", method.name());
                    by_path.insert(path, labels(name.clone(), method.name().into()));
                }
            }
        }
        Self { by_path: Arc::new(by_path) }
    }

    fn labels(&self, path: &str) -> CallLabels {
        let known = self.by_path.get(path).cloned();
        known.unwrap_or_else(|| labels(UNKNOWN.into(), UNKNOWN.into()))
    }
}

/// Returns the labels of a call that this program makes, whose path is one of few.
pub(crate) fn labels_of(path: &str) -> CallLabels {
    let (service, method) = path.trim_start_matches('/').split_once('/').unwrap_or_default();
    labels(service.into(), method.into())
}

const fn labels(service: Arc<str>, method: Arc<str>) -> CallLabels {
    [("service", service), ("method", method)]
}

/// A call that is being measured. It is recorded as `CANCELLED` if it is dropped before its end, which is also the
/// outcome of a call whose client has given up at its deadline.
pub(crate) struct MeasuredCall {
    metrics: Metrics,
    side: Side,
    labels: CallLabels,
    start: Duration,
    is_recorded: bool,
}

impl MeasuredCall {
    pub(crate) fn start(metrics: &Metrics, side: Side, labels: CallLabels) -> Self {
        metrics.rpc().side(side).in_progress.get_or_create(&labels).inc();
        let start = metrics.now();
        Self { metrics: metrics.clone(), side, labels, start, is_recorded: false }
    }

    /// Returns the name of the method.
    fn method(&self) -> &str {
        &self.labels[1].1
    }

    /// Records the end of the call, unless it is recorded already.
    pub(crate) fn end(&mut self, code: Code) {
        if std::mem::replace(&mut self.is_recorded, true) {
            return;
        }
        let rpc = self.metrics.rpc();
        let side = rpc.side(self.side);
        let code = rpc.codes[code as usize].clone();
        let [service, method] = self.labels.clone();
        let seconds = self.metrics.now().saturating_sub(self.start).as_secs_f64();
        side.seconds.get_or_create(&[service, method, ("code", code)]).observe(seconds);
        side.in_progress.get_or_create(&self.labels).dec();
    }

    /// Records the end of the call if `response` has no body, and with the end of the body otherwise.
    pub(crate) fn measure(mut self, response: http::Response<Body>) -> http::Response<Body> {
        if let Some(code) = code_of(response.headers()) {
            self.end(code);
            return response;
        }
        response.map(|body| Body::new(MeasuredBody { body, call: self }))
    }
}

impl Drop for MeasuredCall {
    fn drop(&mut self) {
        self.end(Code::Cancelled);
    }
}

/// The body of a response, whose trailers have the outcome of the call.
struct MeasuredBody {
    body: Body,
    call: MeasuredCall,
}

impl HttpBody for MeasuredBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let frame = ready!(Pin::new(&mut self.body).poll_frame(context));
        match &frame {
            Some(Ok(frame)) => {
                if let Some(trailers) = frame.trailers_ref() {
                    self.call.end(code_of(trailers).unwrap_or(Code::Unknown));
                }
            }
            Some(Err(status)) => self.call.end(status.code()),
            None => self.call.end(Code::Unknown),
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// Returns the code in the headers or trailers of a response.
fn code_of(headers: &HeaderMap) -> Option<Code> {
    headers.get("grpc-status").map(|status| Code::from_bytes(status.as_bytes()))
}

/// Returns the name of a code, as the gRPC specification spells it.
const fn code_name(code: Code) -> &'static str {
    match code {
        Code::Ok => "OK",
        Code::Cancelled => "CANCELLED",
        Code::Unknown => "UNKNOWN",
        Code::InvalidArgument => "INVALID_ARGUMENT",
        Code::DeadlineExceeded => "DEADLINE_EXCEEDED",
        Code::NotFound => "NOT_FOUND",
        Code::AlreadyExists => "ALREADY_EXISTS",
        Code::PermissionDenied => "PERMISSION_DENIED",
        Code::ResourceExhausted => "RESOURCE_EXHAUSTED",
        Code::FailedPrecondition => "FAILED_PRECONDITION",
        Code::Aborted => "ABORTED",
        Code::OutOfRange => "OUT_OF_RANGE",
        Code::Unimplemented => "UNIMPLEMENTED",
        Code::Internal => "INTERNAL",
        Code::Unavailable => "UNAVAILABLE",
        Code::DataLoss => "DATA_LOSS",
        Code::Unauthenticated => "UNAUTHENTICATED",
    }
}

/// A layer that measures the calls of a service, and gives each authenticated call with a trace context a span of its
/// own.
#[derive(Debug, Clone)]
pub struct RpcLayer {
    pub(crate) metrics: Metrics,
    pub(crate) methods: Methods,
    /// The token of the service, if calls require one.
    pub(crate) token: Option<Token>,
}

/// The service that [`RpcLayer`] makes.
#[derive(Debug, Clone)]
pub struct RpcService<S> {
    service: S,
    layer: RpcLayer,
}

impl<S> Layer<S> for RpcLayer {
    type Service = RpcService<S>;

    fn layer(&self, service: S) -> RpcService<S> {
        RpcService { service, layer: self.clone() }
    }
}

impl<S, B> Service<http::Request<B>> for RpcService<S>
where
    S: Service<http::Request<B>, Response = http::Response<Body>>,
    S::Future: Send + 'static,
{
    type Response = S::Response;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<S::Response, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.service.poll_ready(context)
    }

    fn call(&mut self, mut request: http::Request<B>) -> Self::Future {
        let labels = self.layer.methods.labels(request.uri().path());
        let call = MeasuredCall::start(&self.layer.metrics, Side::Server, labels);
        let span = self.layer.server_span(&mut request, call.method());
        let response = self.service.call(request).instrument(span);
        Box::pin(async move { Ok(call.measure(response.await?)) })
    }
}

impl RpcLayer {
    /// Returns the span of a call, and adds its trace context to the extensions of the request. A call without a trace
    /// context or without the service's token has no span.
    fn server_span<B>(&self, request: &mut http::Request<B>, method: &str) -> Span {
        let headers = request.headers();
        let parent = TraceContext::from_headers(headers).filter(|_| self.is_authenticated(headers));
        let Some(parent) = parent else { return Span::none() };
        let trace = parent.child("server", 0);
        request.extensions_mut().insert(trace);
        let span = trace.span(Some(parent), method, "server");
        span.in_scope(|| tracing::debug!("call received"));
        span
    }

    fn is_authenticated(&self, headers: &HeaderMap) -> bool {
        let Some(token) = &self.token else { return true };
        headers.get(AUTHORIZATION).is_some_and(|header| token.matches(header.as_bytes()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clients_cannot_create_series() {
        let methods = Methods::of(&[tonic_health::pb::FILE_DESCRIPTOR_SET, b"not descriptors"]);
        let names = |path: &str| {
            let [(_, service), (_, method)] = methods.labels(path);
            format!("{service} {method}")
        };
        assert_eq!(names("/grpc.health.v1.Health/Check"), "grpc.health.v1.Health Check");
        for path in ["/grpc.health.v1.Health/Check2", "/", "", "/a/b/c", "//"] {
            assert_eq!(names(path), "unknown unknown", "{path:?}");
        }
    }

    #[test]
    fn only_authenticated_calls_have_spans() {
        let token = Token::new("0123456789abcdef").expect("a token");
        let check = |token: Option<&Token>, authorization: Option<&str>, expected| {
            let (metrics, methods) = (Metrics::default(), Methods::default());
            let layer = RpcLayer { metrics, methods, token: token.cloned() };
            let mut request = http::Request::new(());
            TraceContext::of(&[1]).add_to(request.headers_mut());
            if let Some(authorization) = authorization {
                let value = authorization.parse().expect("a header");
                request.headers_mut().insert(AUTHORIZATION, value);
            }
            let span = layer.server_span(&mut request, "Advise");
            let has_trace = request.extensions().get::<TraceContext>().is_some();
            assert_eq!((!span.is_none(), has_trace), (expected, expected), "{authorization:?}");
        };
        check(None, None, true);
        check(Some(&token), None, false);
        check(Some(&token), Some("Bearer 0123456789abcdeF"), false);
        check(Some(&token), Some(&token.header()), true);
    }

    #[test]
    fn a_call_that_is_dropped_is_cancelled_and_no_longer_in_progress() {
        let metrics = Metrics::default();
        let labels = || labels_of("/tandem.v1.Teacher/Advise");
        let open = MeasuredCall::start(&metrics, Side::Client, labels());
        let mut ended = MeasuredCall::start(&metrics, Side::Client, labels());
        ended.end(Code::Ok);
        drop(ended);
        let of = r#"service="tandem.v1.Teacher",method="Advise""#;
        let in_progress = |n: u32| format!("tandem_rpc_client_in_progress{{{of}}} {n}\n");
        assert!(metrics.page().contains(&in_progress(1)), "{}", metrics.page());
        drop(open);
        let page = metrics.page();
        assert!(page.contains(&in_progress(0)), "{page}");
        for code in ["OK", "CANCELLED"] {
            let count = format!("tandem_rpc_client_seconds_count{{{of},code=\"{code}\"}} 1\n");
            assert!(page.contains(&count), "{page}");
        }
    }
}
