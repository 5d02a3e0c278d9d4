//! The `Learner` service: a thin shell round the board and the thread that learns.

use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use tandem_net::Incoming;
use tandem_proto::pb;
use tandem_proto::pb::learner_server::{Learner, LearnerServer};
use tandem_proto::{decode_episode, encode_actor, encode_slot, encode_terms};
use tandem_telemetry::events::WorkerJoined;
use tokio_stream::wrappers::WatchStream;
use tokio_stream::{Stream, StreamExt as _};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status};

use crate::board::SubmitError;
use crate::drive::{self, Ended};
use crate::error::Error;
use crate::shared::{LearnerConfig, Shared, wait_on};

/// How long a worker's question for work is held before it is told to wait.
const WORK_POLL: Duration = Duration::from_secs(2);
/// How long the service stays after the run's end, so that all can hear of it.
const LINGER: Duration = Duration::from_millis(1500);
/// Largest message taken in; a slot of 64 two-arm episodes has 1 MB.
const MAX_MESSAGE_BYTES: usize = 64 << 20;
/// Longest label of a worker.
const MAX_NAME_BYTES: usize = 256;

/// Serves a run until it ends or `shutdown` is cancelled; the state is saved either way.
///
/// # Errors
/// When the run cannot start, its state cannot be saved, or learning diverges.
pub async fn serve(
    config: LearnerConfig,
    incoming: impl Into<Incoming>,
    shutdown: CancellationToken,
) -> Result<Ended, Error> {
    let shared = Arc::new(Shared::new(config.clock.clone()));
    shared.lock().board.start_workers_at(config.first_worker);
    let learner = LearnerServer::new(LearnerService { shared: shared.clone() })
        .max_decoding_message_size(MAX_MESSAGE_BYTES);
    let router = config.gate.router(learner).await?;
    let stop_serving = CancellationToken::new();
    let learning = {
        let (shared, runtime, stop_serving) =
            (shared.clone(), tokio::runtime::Handle::current(), stop_serving.clone());
        std::thread::Builder::new().name("learn".to_owned()).spawn(move || {
            let _stop = stop_serving.drop_guard();
            let ended = drive::run(&config, &shared, &runtime, &shutdown);
            let reason = ended.as_ref().map_or_else(with_causes, |ended| ended.reason.clone());
            shared.lock().finished = Some(reason.clone());
            shared.work.notify_waiters();
            shared.progress.send_modify(|progress| {
                progress.ended = true;
                progress.end_reason = reason;
            });
            wait_on(&runtime, async { tokio::time::sleep(LINGER).await });
            // Watchers' streams close at the first message after the one that says so.
            shared.progress.send_modify(|_| ());
            ended
        })
    };
    router.serve_with_incoming_shutdown(incoming.into(), stop_serving.cancelled()).await?;
    match learning {
        Ok(thread) => tokio::task::spawn_blocking(move || thread.join())
            .await
            .map_or(Err(Error::Panicked), |joined| joined.unwrap_or(Err(Error::Panicked))),
        Err(source) => Err(Error::RunDirectory {
            action: "start a thread for",
            path: PathBuf::from("learning"),
            source: source.into(),
        }),
    }
}

/// An error and what caused it, on one line.
fn with_causes(error: &Error) -> String {
    let mut line = error.to_string();
    let mut cause = std::error::Error::source(error);
    while let Some(inner) = cause {
        let text = inner.to_string();
        if !line.contains(&text) {
            line = format!("{line}: {text}");
        }
        cause = inner.source();
    }
    line
}

struct LearnerService {
    shared: Arc<Shared>,
}

#[tonic::async_trait]
impl Learner for LearnerService {
    type WatchStream = Pin<Box<dyn Stream<Item = Result<pb::Progress, Status>> + Send>>;

    async fn join(
        &self,
        request: Request<pb::JoinRequest>,
    ) -> Result<Response<pb::JoinResponse>, Status> {
        let name = request.into_inner().worker;
        if name.len() > MAX_NAME_BYTES {
            let message =
                format!("worker: expected at most {MAX_NAME_BYTES} bytes, got {}", name.len());
            return Err(Status::invalid_argument(message));
        }
        let now = (self.shared.clock)();
        let mut state = self.shared.lock();
        let terms =
            state.terms.clone().ok_or_else(|| Status::unavailable("the run is starting"))?;
        let worker_id = state.board.join(name.clone(), now);
        drop(state);
        WorkerJoined { worker_id, name: &name }.emit();
        Ok(Response::new(pb::JoinResponse { worker_id, terms: Some(encode_terms(&terms)) }))
    }

    async fn next_work(
        &self,
        request: Request<pb::NextWorkRequest>,
    ) -> Result<Response<pb::NextWorkResponse>, Status> {
        let worker_id = request.into_inner().worker_id;
        let search = async {
            loop {
                let notified = self.shared.work.notified();
                if let Some(work) = self.work_for(worker_id)? {
                    return Ok::<_, Status>(work);
                }
                notified.await;
            }
        };
        let work =
            tokio::time::timeout(WORK_POLL, search).await.unwrap_or(Ok(Work::Wait(pb::Wait {})))?;
        Ok(Response::new(pb::NextWorkResponse { work: Some(work) }))
    }

    async fn get_parameters(
        &self,
        request: Request<pb::GetParametersRequest>,
    ) -> Result<Response<pb::Parameters>, Status> {
        let version = request.into_inner().version;
        let state = self.shared.lock();
        let actor = state.published.get(&version);
        let actor = actor
            .ok_or_else(|| Status::not_found(format!("parameter version {version} is not kept")))?;
        Ok(Response::new(encode_actor(actor)))
    }

    async fn submit_episodes(
        &self,
        request: Request<pb::SubmitEpisodesRequest>,
    ) -> Result<Response<pb::SubmitEpisodesResponse>, Status> {
        let request = request.into_inner();
        let now = (self.shared.clock)();
        let mut state = self.shared.lock();
        let layout =
            state.terms.as_ref().ok_or_else(|| Status::unavailable("the run is starting"))?.layout;
        let episodes: Result<Vec<_>, _> =
            request.episodes.into_iter().map(|episode| decode_episode(episode, layout)).collect();
        state.board.submit(request.worker_id, request.slot, episodes?, now).map_err(refusal)?;
        drop(state);
        self.shared.arrived.notify_all();
        Ok(Response::new(pb::SubmitEpisodesResponse {}))
    }

    async fn status(
        &self,
        _: Request<pb::StatusRequest>,
    ) -> Result<Response<pb::Progress>, Status> {
        Ok(Response::new(self.shared.progress.borrow().clone()))
    }

    async fn watch(
        &self,
        _: Request<pb::WatchRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let mut told_the_end = false;
        let progress =
            WatchStream::new(self.shared.progress.subscribe()).take_while(move |progress| {
                let goes_on = !told_the_end;
                told_the_end = progress.ended;
                goes_on
            });
        Ok(Response::new(Box::pin(progress.map(Ok))))
    }
}

use pb::next_work_response::Work;

impl LearnerService {
    fn work_for(&self, worker_id: u64) -> Result<Option<Work>, Status> {
        let now = (self.shared.clock)();
        let mut state = self.shared.lock();
        if let Some(reason) = &state.finished {
            return Ok(Some(Work::Finished(pb::Finished { reason: reason.clone() })));
        }
        let order = state.board.next(worker_id, now).map_err(refusal)?;
        Ok(order.map(|order| Work::Slot(encode_slot(&order))))
    }
}

#[expect(clippy::needless_pass_by_value, reason = "used as a function value in map_err")]
fn refusal(error: SubmitError) -> Status {
    match error {
        SubmitError::UnknownWorker(_) => Status::not_found(error.to_string()),
        SubmitError::WrongEpisodes { .. } => Status::invalid_argument(error.to_string()),
    }
}
