//! The `Learner` service: a thin shell round the board and the thread that learns.

mod refusals;

use std::panic::AssertUnwindSafe;
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use tandem_core::Episode;
use tandem_net::Incoming;
use tandem_proto::pb;
use tandem_proto::pb::learner_server::{Learner, LearnerServer};
use tandem_proto::{decode_episode, encode_actor, encode_slot, encode_terms};
use tandem_telemetry::events::WorkerJoined;
use tokio::runtime::Handle;
use tokio_stream::wrappers::WatchStream;
use tokio_stream::{Stream, StreamExt as _};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status};

use crate::board::check_count;
use crate::drive::{self, Ended};
use crate::error::Error;
use crate::shared::{LearnerConfig, Shared, wait_on};
use refusals::{check_name, check_version, malformed, refusal};

/// How long a worker's question for work is held before it is told to wait.
const WORK_POLL: Duration = Duration::from_secs(2);
/// How long the service stays after the run's end, so that all can hear of it.
const LINGER: Duration = Duration::from_millis(1500);
/// How long calls that are open may take to finish once the service shall end.
const SHUTDOWN_GRACE: Duration = Duration::from_secs(5);
/// Largest message taken in; a slot of 64 two-arm episodes has 1 MB.
const MAX_MESSAGE_BYTES: usize = 64 << 20;

/// Serves a run until it ends or `shutdown` is cancelled; the state is saved either way.
///
/// # Errors
/// When the run cannot start, its state cannot be saved, or learning diverges.
pub async fn serve(
    config: LearnerConfig,
    incoming: impl Into<Incoming>,
    shutdown: CancellationToken,
) -> Result<Ended, Error> {
    serve_and_linger(config, incoming, shutdown, LINGER).await
}

/// [`serve`], staying for `linger` after the run's end.
///
/// # Errors
/// When the run cannot start, its state cannot be saved, or learning diverges.
pub async fn serve_and_linger(
    config: LearnerConfig,
    incoming: impl Into<Incoming>,
    shutdown: CancellationToken,
    linger: Duration,
) -> Result<Ended, Error> {
    let shared = Arc::new(Shared::new(config.clock.clone()));
    shared.lock().board.start_workers_at(config.first_worker);
    let learner = LearnerServer::new(LearnerService { shared: shared.clone() })
        .max_decoding_message_size(MAX_MESSAGE_BYTES);
    let router = config.gate.router(learner).await?;
    let stop_serving = CancellationToken::new();
    let learning = {
        let (runtime, stop) = (Handle::current(), stop_serving.clone());
        let shutdown = shutdown.clone();
        let learn = move || {
            let _stop = stop.drop_guard();
            let ended = learn(&config, &shared, &runtime, &shutdown);
            wait_on(&runtime, async move { tokio::time::sleep(linger).await });
            // Watchers' streams close at the first message after the one that says so.
            shared.progress.send_modify(|_| ());
            ended
        };
        std::thread::Builder::new().name("learn".to_owned()).spawn(learn).map_err(|source| {
            Error::RunDirectory {
                action: "start a thread for",
                path: PathBuf::from("learning"),
                source: source.into(),
            }
        })?
    };
    let serving = router
        .serve_with_incoming_shutdown(incoming.into(), stop_serving.clone().cancelled_owned());
    let served = tokio::select! {
        served = serving => served,
        () = grace_after(&stop_serving) => Ok(()),
    };
    // A server that fails takes the run with it: nobody can reach it any more.
    shutdown.cancel();
    let joined = tokio::task::spawn_blocking(move || learning.join()).await;
    let ended =
        joined.map_or(Err(Error::Panicked), |joined| joined.unwrap_or(Err(Error::Panicked)));
    served?;
    ended
}

/// A watcher that reads nothing keeps its call open for ever.
async fn grace_after(stop_serving: &CancellationToken) {
    stop_serving.cancelled().await;
    tokio::time::sleep(SHUTDOWN_GRACE).await;
}

/// Runs the run and tells workers and watchers how it ended, even when that is by a bug.
fn learn(
    config: &LearnerConfig,
    shared: &Shared,
    runtime: &Handle,
    shutdown: &CancellationToken,
) -> Result<Ended, Error> {
    let run = AssertUnwindSafe(|| drive::run(config, shared, runtime, shutdown));
    let ended = std::panic::catch_unwind(run).unwrap_or(Err(Error::Panicked));
    let reason = ended.as_ref().map_or_else(with_causes, |ended| ended.reason.clone());
    shared.lock().finished = Some(reason.clone());
    shared.work.notify_waiters();
    shared.progress.send_modify(|progress| {
        progress.ended = true;
        progress.end_reason = reason;
        progress.digest =
            ended.as_ref().map_or_else(|_| String::new(), |ended| ended.digest.clone());
    });
    ended
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
        let pb::JoinRequest { worker: name, version } = request.into_inner();
        check_name(&name)?;
        check_version(&name, &version)?;
        let now = (self.shared.clock)();
        let mut state = self.shared.lock();
        let terms =
            state.terms.clone().ok_or_else(|| Status::unavailable("the run is starting"))?;
        let worker_id = state
            .board
            .join(name.clone(), now)
            .map_err(|error| Status::resource_exhausted(error.to_string()))?;
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
                let (work, look_again_in) = self.work_for(worker_id)?;
                if let Some(work) = work {
                    return Ok::<_, Status>(work);
                }
                // Either way it is looked again: there is news, or a slot is out for too long.
                drop(tokio::time::timeout(look_again_in, notified).await);
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
        let actor = self.shared.lock().published.get(&version).cloned();
        let actor = actor
            .ok_or_else(|| Status::not_found(format!("parameter version {version} is not kept")))?;
        Ok(Response::new(encode_actor(&actor)))
    }

    async fn submit_episodes(
        &self,
        request: Request<pb::SubmitEpisodesRequest>,
    ) -> Result<Response<pb::SubmitEpisodesResponse>, Status> {
        self.submit(request.into_inner())?;
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
    /// What a worker is to do, and in what time it is worth looking again.
    fn work_for(&self, worker_id: u64) -> Result<(Option<Work>, Duration), Status> {
        let now = (self.shared.clock)();
        let mut state = self.shared.lock();
        if let Some(reason) = &state.finished {
            let finished = pb::Finished { reason: reason.clone() };
            return Ok((Some(Work::Finished(finished)), WORK_POLL));
        }
        let order = state.board.next(worker_id, now).map_err(|error| refusal(&error, None))?;
        let look_again_in = state.board.cover_in(now).unwrap_or(WORK_POLL);
        Ok((order.map(|order| Work::Slot(encode_slot(&order))), look_again_in))
    }

    /// Takes a slot's episodes when every one of them is as ordered; what is in already is not looked at.
    fn submit(&self, request: pb::SubmitEpisodesRequest) -> Result<(), Status> {
        let pb::SubmitEpisodesRequest { worker_id, slot, episodes } = request;
        let now = (self.shared.clock)();
        let mut state = self.shared.lock();
        let layout =
            state.terms.as_ref().ok_or_else(|| Status::unavailable("the run is starting"))?.layout;
        let worker = state.board.worker(worker_id).map(|worker| (worker_id, worker.name.clone()));
        let refused = |error| refusal(&error, worker.as_ref());
        let Some(order) = state.board.ordered(worker_id, slot, now).map_err(refused)? else {
            return Ok(());
        };
        check_count(order, episodes.len()).map_err(refused)?;
        // A slot's episodes take a while to read; other calls are answered meanwhile.
        drop(state);
        let decode = |episode: pb::Episode| {
            let number = episode.number;
            decode_episode(episode, layout)
                .map_err(|error| malformed(&error, number, worker.as_ref()))
        };
        let episodes: Vec<Episode> = episodes.into_iter().map(decode).collect::<Result<_, _>>()?;
        self.shared.lock().board.submit(worker_id, slot, episodes, now).map_err(refused)?;
        self.shared.arrived.notify_all();
        Ok(())
    }
}
