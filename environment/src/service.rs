//! The gRPC service `tandem.v1.Environment`.

use std::sync::Arc;

use tandem_core::Layout;
use tandem_net::metrics::ConstGauge;
use tandem_net::{Incoming, MAX_MESSAGE_BYTES, ServerConfig};
use tandem_proto::environment::{
    MAX_ENVIRONMENTS, PlayCommand, decode_play_request, encode_environment,
};
use tandem_proto::pb;
use tandem_proto::pb::environment_server::{Environment, EnvironmentServer};
use tandem_sim::SimError;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

use crate::error::Error;
use crate::metrics::{EnvironmentMetrics, OpenStream, Work};
use crate::session::{Prototypes, Session, SessionError};

/// The capacity of a stream's responses. The next request is read once a response is on its way.
const RESPONSE_CAPACITY: usize = 1;

/// The configuration of an environment service.
#[derive(Debug, Clone)]
pub struct Config {
    /// The task and the number of arms.
    pub layout: Layout,
    /// The largest number of environments of all streams together.
    pub max_environments: usize,
    /// Name and version of the program, for logs of clients.
    pub server: String,
}

/// Serves the environments of `config`, with the access control of `server_config`, until `shutdown` is cancelled.
///
/// # Errors
/// When the environments cannot be built or the server fails.
pub async fn serve(
    config: Config,
    incoming: impl Into<Incoming>,
    server_config: &ServerConfig,
    shutdown: CancellationToken,
) -> Result<(), Error> {
    let prototypes = Prototypes::new(config.layout)?;
    let room = Room::new(config.max_environments);
    let metrics = EnvironmentMetrics::register(server_config.metrics());
    room.add_to(server_config);
    let service =
        EnvironmentService { config, prototypes, room, metrics, shutdown: shutdown.clone() };
    let environment = EnvironmentServer::new(service).max_decoding_message_size(MAX_MESSAGE_BYTES);
    let router = server_config.router(environment, tandem_proto::FILE_DESCRIPTOR_SET).await?;
    Ok(tandem_net::serve(router, incoming, shutdown).await?)
}

/// The implementation of the generated server trait.
struct EnvironmentService {
    config: Config,
    prototypes: Prototypes,
    room: Room,
    metrics: EnvironmentMetrics,
    shutdown: CancellationToken,
}

#[tonic::async_trait]
impl Environment for EnvironmentService {
    type PlayStream = ReceiverStream<Result<pb::PlayResponse, Status>>;

    async fn describe(
        &self,
        _: Request<pb::DescribeEnvironmentRequest>,
    ) -> Result<Response<pb::EnvironmentDescription>, Status> {
        let n_per_stream = self.room.n_total.min(MAX_ENVIRONMENTS);
        let (task, server) = (self.prototypes.task(), &self.config.server);
        Ok(Response::new(encode_environment(task, server, n_per_stream)))
    }

    async fn play(
        &self,
        request: Request<Streaming<pb::PlayRequest>>,
    ) -> Result<Response<Self::PlayStream>, Status> {
        let (responses, outgoing) = mpsc::channel(RESPONSE_CAPACITY);
        let stream = PlayStream {
            session: Session::new(self.prototypes.clone()),
            room: self.room.clone(),
            permit: None,
            metrics: self.metrics.clone(),
        };
        let open = OpenStream::new(&self.metrics.streams);
        let (requests, shutdown) = (request.into_inner(), self.shutdown.clone());
        tokio::spawn(async move {
            let _open = open;
            tokio::select! {
                () = stream.serve(requests, &responses) => (),
                () = shutdown.cancelled() => {
                    let stopping = Status::unavailable("the environment server is shutting down");
                    drop(responses.send(Err(stopping)).await);
                }
            }
        });
        Ok(Response::new(ReceiverStream::new(outgoing)))
    }
}

/// The environments that all streams together may have.
#[derive(Clone)]
struct Room {
    n_total: usize,
    free: Arc<Semaphore>,
}

impl Room {
    fn new(n_total: usize) -> Self {
        Self { n_total, free: Arc::new(Semaphore::new(n_total)) }
    }

    /// Adds the numbers of environments to the metrics of the service.
    fn add_to(&self, server_config: &ServerConfig) {
        let Self { n_total, free } = self.clone();
        server_config.metrics().add_source(move |registry| {
            let n_used = n_total.saturating_sub(free.available_permits());
            let help = "Environments of all open streams";
            registry.register("environments", help, ConstGauge::new(n_used as f64));
            let help = "Environments that all streams together can have";
            registry.register("environments_capacity", help, ConstGauge::new(n_total as f64));
        });
    }

    /// Reserves room for `n` environments until the permit is dropped.
    fn reserve(&self, n: usize) -> Result<OwnedSemaphorePermit, Status> {
        let permits = u32::try_from(n).unwrap_or(u32::MAX);
        Arc::clone(&self.free).try_acquire_many_owned(permits).map_err(|_full| {
            let (n_total, n_free) = (self.n_total, self.free.available_permits());
            Status::resource_exhausted(format!(
                "no room for {n} environments: {n_free} of {n_total} are free"
            ))
        })
    }
}

/// One stream and its environments.
struct PlayStream {
    session: Session,
    room: Room,
    /// The room of the session, from its first reset on.
    permit: Option<OwnedSemaphorePermit>,
    metrics: EnvironmentMetrics,
}

impl PlayStream {
    /// Answers `requests` one at a time, until the client closes the stream or a request fails.
    async fn serve(
        mut self,
        mut requests: Streaming<pb::PlayRequest>,
        responses: &mpsc::Sender<Result<pb::PlayResponse, Status>>,
    ) {
        while let Ok(Some(request)) = requests.message().await.inspect_err(log_lost) {
            let (stream, response) = self.answer(request).await;
            let is_failed = response.is_err();
            if responses.send(response).await.is_err() || is_failed {
                return;
            }
            let Some(stream) = stream else { return };
            self = stream;
        }
    }

    /// Answers a request. The simulation runs on a thread of its own, so that it delays no socket. Returns no stream if
    /// that thread has panicked.
    async fn answer(
        mut self,
        request: pb::PlayRequest,
    ) -> (Option<Self>, Result<pb::PlayResponse, Status>) {
        let command = match self.decode(request) {
            Ok(command) => command,
            Err(status) => return (Some(self), Err(status)),
        };
        let simulated = tokio::task::spawn_blocking(move || {
            let work = Work::of(&command, self.session.n());
            let start = self.metrics.now();
            let response = self.session.execute(command);
            if response.is_ok() {
                self.metrics.record(work, start);
            }
            (self, response)
        });
        match simulated.await {
            Ok((stream, response)) => (Some(stream), response.map_err(|error| status(&error))),
            Err(_panicked) => (None, Err(Status::internal("the simulator panicked"))),
        }
    }

    fn decode(&mut self, request: pb::PlayRequest) -> Result<PlayCommand, Status> {
        let command = decode_play_request(request, self.session.n(), self.session.task())?;
        if let PlayCommand::Reset(resets) = &command
            && self.permit.is_none()
        {
            self.permit = Some(self.room.reserve(resets.len())?);
        }
        Ok(command)
    }
}

/// Maps an error to the status that the client receives.
fn status(error: &SessionError) -> Status {
    match error {
        SessionError::Reset(_) => Status::invalid_argument(error.to_string()),
        SessionError::Step { source, .. } => {
            tracing::error!(%error, "step failed");
            match source {
                // The same episode would fail again.
                SimError::StateNotFinite { .. } => Status::data_loss(error.to_string()),
                _ => Status::internal(error.to_string()),
            }
        }
    }
}

fn log_lost(status: &Status) {
    tracing::debug!(reason = status.message(), "stream lost");
}
