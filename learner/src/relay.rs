//! A relay: a proxy between a learner and many workers.
//!
//! A relay fetches each version of the parameters once and forwards all other calls. A learner with a thousand workers
//! behind ten relays sends ten copies of a version instead of a thousand. A relay has no state that a run needs: it can
//! be restarted at any time, and its workers retry meanwhile.

use std::collections::BTreeMap;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tandem_net::metrics::Counter;
use tandem_net::{
    AuthChannel, ClientConfig, EncodedResponse, Incoming, MAX_MESSAGE_BYTES, Metrics, ServerConfig,
    TraceContext, within,
};
use tandem_proto::pb;
use tandem_proto::pb::learner_client::LearnerClient;
use tandem_proto::pb::learner_server::{Learner, LearnerServer};
use tokio::sync::OnceCell;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Request, Response, Status, Streaming};

use crate::error::Error;
use crate::service::check_version;
use crate::shared::KEPT_VERSIONS;

/// Deadline of a call to the learner, which holds a request for work for up to 2 s.
const CALL_DEADLINE: Duration = Duration::from_secs(20);

/// Serves workers at `incoming` on behalf of the learner at `learner` until `shutdown` is cancelled.
///
/// # Errors
/// When `learner` is not an address, or the server fails.
pub async fn serve(
    learner: &str,
    client_config: &ClientConfig,
    server_config: &ServerConfig,
    incoming: impl Into<Incoming>,
    shutdown: CancellationToken,
) -> Result<(), Error> {
    let link = client_config.channel(learner).map_err(Error::Address)?;
    let client = LearnerClient::new(link)
        .max_decoding_message_size(MAX_MESSAGE_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES);
    let metrics = RelayMetrics::register(server_config.metrics());
    let relay =
        Relay { client, cache: Mutex::default(), metrics, is_rejected: AtomicBool::default() };
    serve_boxed(relay, server_config, incoming.into(), shutdown).await
}

/// Boxes the service, so that it is compiled in this crate only and not in every crate that serves.
fn serve_boxed(
    relay: Relay,
    server_config: &ServerConfig,
    incoming: Incoming,
    shutdown: CancellationToken,
) -> Pin<Box<dyn Future<Output = Result<(), Error>> + Send + '_>> {
    Box::pin(async move {
        let server = LearnerServer::new(relay).max_decoding_message_size(MAX_MESSAGE_BYTES);
        let router = server_config.router(server, tandem_proto::FILE_DESCRIPTOR_SET).await?;
        Ok(tandem_net::serve(router, incoming, shutdown).await?)
    })
}

struct Relay {
    client: LearnerClient<AuthChannel>,
    cache: Mutex<Cache>,
    metrics: RelayMetrics,
    /// Set while the learner rejects the relay's token, which is logged once.
    is_rejected: AtomicBool,
}

/// The metrics of distributed parameters.
#[derive(Debug)]
struct RelayMetrics {
    requests: Counter,
    fetches: Counter,
}

impl RelayMetrics {
    fn register(metrics: &Metrics) -> Self {
        let requests = "Requests of workers for parameters";
        let fetches = "Requests to the learner for parameters that the relay did not have";
        Self {
            requests: metrics.counter("relay_parameter_requests", requests),
            fetches: metrics.counter("relay_parameter_fetches", fetches),
        }
    }
}

/// The parameters published by one start of a learner.
#[derive(Debug, Default)]
struct Cache {
    /// Identifies the start: version 3 of another one has other parameters.
    learner: u64,
    versions: BTreeMap<u64, Arc<OnceCell<EncodedResponse>>>,
}

impl Cache {
    /// Clears the cache if `learner` is another start.
    fn switch_to(&mut self, learner: u64) {
        if self.learner != learner {
            *self = Self { learner, versions: BTreeMap::new() };
        }
    }

    /// Returns the cell of a version: one caller fetches it, the others wait.
    fn cell(&mut self, version: u64) -> Arc<OnceCell<EncodedResponse>> {
        let cell = self.versions.entry(version).or_default().clone();
        while self.versions.len() > KEPT_VERSIONS {
            self.versions.pop_first();
        }
        cell
    }

    /// Removes the cell of a version that could not be fetched, because clients may ask for any number.
    fn remove_empty(&mut self, version: u64) {
        if self.versions.get(&version).is_some_and(|cell| !cell.initialized()) {
            self.versions.remove(&version);
        }
    }
}

impl Relay {
    fn cache(&self) -> MutexGuard<'_, Cache> {
        self.cache.lock().unwrap_or_else(PoisonError::into_inner)
    }

    async fn fetch(&self, version: u64) -> Result<EncodedResponse, Status> {
        self.metrics.fetches.inc();
        let mut client = self.client.clone();
        let request = pb::GetParametersRequest { version };
        let parameters = self.forward(client.get_parameters(request)).await?;
        Ok(EncodedResponse::encode(parameters.get_ref()))
    }

    /// Applies the deadline to a call of the learner.
    ///
    /// If the learner rejects the relay's token, the call fails with `UNAVAILABLE`: the caller's own token is right,
    /// and the call can be repeated until the relay has the learner's token.
    async fn forward<T>(
        &self,
        call: impl Future<Output = Result<Response<T>, Status>>,
    ) -> Result<Response<T>, Status> {
        match within(CALL_DEADLINE, call).await {
            Ok(response) => {
                if self.is_rejected.swap(false, Ordering::Relaxed) {
                    tracing::info!("the learner accepts the relay's token again");
                }
                // The headers of the learner's response, such as its date, do not apply to this one.
                Ok(Response::new(response.into_inner()))
            }
            Err(status) if status.code() == Code::Unauthenticated => {
                let reason = status.message();
                if !self.is_rejected.swap(true, Ordering::Relaxed) {
                    tracing::warn!(reason, "the learner rejects the relay's token, workers wait");
                }
                Err(Status::unavailable(format!("the relay cannot call the learner: {reason}")))
            }
            Err(status) => Err(status),
        }
    }
}

#[tonic::async_trait]
impl Learner for Relay {
    type WatchStream = Streaming<pb::Progress>;

    async fn join(
        &self,
        request: Request<pb::JoinRequest>,
    ) -> Result<Response<pb::JoinResponse>, Status> {
        let request = request.into_inner();
        // A relay would drop the fields that another version has added.
        check_version(&request.worker, &request.version, "relay")?;
        let answer = self.forward(self.client.clone().join(request)).await?;
        self.cache().switch_to(answer.get_ref().learner);
        Ok(answer)
    }

    async fn next_work(
        &self,
        request: Request<pb::NextWorkRequest>,
    ) -> Result<Response<pb::NextWorkResponse>, Status> {
        self.forward(self.client.clone().next_work(request.into_inner())).await
    }

    async fn get_parameters(
        &self,
        request: Request<pb::GetParametersRequest>,
    ) -> Result<Response<pb::Parameters>, Status> {
        self.metrics.requests.inc();
        let version = request.into_inner().version;
        let cell = self.cache().cell(version);
        match cell.get_or_try_init(|| self.fetch(version)).await {
            Ok(prepared) => Ok(prepared.clone().into_response()),
            Err(status) => {
                self.cache().remove_empty(version);
                Err(status)
            }
        }
    }

    async fn submit_episodes(
        &self,
        request: Request<pb::SubmitEpisodesRequest>,
    ) -> Result<Response<pb::SubmitEpisodesResponse>, Status> {
        self.forward(self.client.clone().submit_episodes(with_trace(request))).await
    }

    async fn status(
        &self,
        request: Request<pb::StatusRequest>,
    ) -> Result<Response<pb::Progress>, Status> {
        self.forward(self.client.clone().status(request.into_inner())).await
    }

    async fn watch(
        &self,
        request: Request<pb::WatchRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        self.forward(self.client.clone().watch(request.into_inner())).await
    }
}

/// Returns a request with the message and the trace context of `request`, without its other headers.
fn with_trace<T>(request: Request<T>) -> Request<T> {
    let trace = request.extensions().get::<TraceContext>().copied();
    let mut forwarded = Request::new(request.into_inner());
    if let Some(trace) = trace {
        forwarded.extensions_mut().insert(trace);
    }
    forwarded
}
