//! The `Learner` service: a thin shell round the board and the thread that learns.

mod connections;
mod refusals;

use std::panic::AssertUnwindSafe;
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use tandem_core::Episode;
use tandem_core::text::error_chain;
use tandem_net::{Hangup, Incoming, Page, Prepared};
use tandem_proto::pb;
use tandem_proto::pb::learner_server::{Learner, LearnerServer};
use tandem_proto::{decode_episode, encode_run_terms, encode_slot};
use tandem_telemetry::events::WorkerJoined;
use tokio::net::TcpListener;
use tokio_stream::wrappers::WatchStream;
use tokio_stream::{Stream, StreamExt as _};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status};

use crate::board::check_count;
use crate::drive::{self, Ended};
use crate::error::Error;
use crate::metrics;
use crate::runtime::{Runtime, on_a_thread};
use crate::shared::{LearnerConfig, Shared};
pub(crate) use connections::{Connections, LogQuota};
pub(crate) use refusals::check_version;
use refusals::{check_name, malformed, refusal};

/// How long a worker's question for work is held before it is told to wait.
const WORK_POLL: Duration = Duration::from_secs(2);
/// How long the service stays after the run's end, so that all can hear of it.
const LINGER: Duration = Duration::from_millis(1500);
/// Pause between two looks whether all workers have heard of it.
const LINGER_TICK: Duration = Duration::from_millis(50);
/// Largest message taken in; a slot of 64 two-arm episodes has 1 MB.
pub(crate) const MAX_MESSAGE_BYTES: usize = 64 << 20;

/// What goes with the service.
#[derive(Debug, Default)]
pub struct Beside {
    /// Where the run's figures stand at `/metrics`, for anybody who can reach it: no token is asked for.
    pub metrics: Option<TcpListener>,
    /// How long the service stays once the run is complete.
    pub after_the_end: AfterTheEnd,
}

/// How long a service stays once its run is complete. It stays for a moment only after one that was interrupted or failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AfterTheEnd {
    /// For a while, so that all can hear of it.
    Linger(Duration),
    /// Until it is told to end.
    Stay,
}

impl Default for AfterTheEnd {
    fn default() -> Self {
        Self::Linger(LINGER)
    }
}

/// Serves a run until it ends or `shutdown` is cancelled; the state is saved either way.
///
/// # Errors
/// When the run cannot start, its state cannot be saved, or learning diverges.
pub async fn serve(
    config: LearnerConfig,
    incoming: impl Into<Incoming>,
    shutdown: CancellationToken,
) -> Result<Ended, Error> {
    serve_beside(config, incoming, shutdown, Beside::default()).await
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
    let beside = Beside { after_the_end: AfterTheEnd::Linger(linger), metrics: None };
    serve_beside(config, incoming, shutdown, beside).await
}

/// [`serve`], with what `beside` asks for.
///
/// # Errors
/// When the run cannot start, its state cannot be saved, or learning diverges.
pub async fn serve_beside(
    config: LearnerConfig,
    incoming: impl Into<Incoming>,
    shutdown: CancellationToken,
    beside: Beside,
) -> Result<Ended, Error> {
    let shared = Arc::new(Shared::new(config.clock.clone()));
    shared.lock().board.start_workers_at(config.first_worker);
    let learner =
        LearnerServer::new(LearnerService { shared: shared.clone(), start: config.first_worker })
            .max_decoding_message_size(MAX_MESSAGE_BYTES);
    let router = config.gate.router(learner).await?;
    let stop_serving = CancellationToken::new();
    let showing = show_figures(beside.metrics, shared.clone());
    let learning = {
        let (pacing, stop) = (config.pacing, stop_serving.clone());
        let shutdown = shutdown.clone();
        on_a_thread("learn", pacing, move |runtime| {
            let _stop = stop.drop_guard();
            let ended = learn(&config, &shared, &runtime, &shutdown);
            runtime.wait_on(linger(beside.after_the_end));
            if is_complete(&ended) {
                runtime.wait_on(until_workers_know(shared.clone(), shutdown.clone()));
                runtime.wait_on(stay(beside.after_the_end, shutdown));
            }
            // Watchers' streams close at the first message after the one that says so.
            shared.progress.send_modify(|_| ());
            ended
        })
    };
    let serving = async {
        let served = tokio::select! {
            served = tandem_net::serve(router, incoming, stop_serving) => served,
            () = showing => Ok(()),
        };
        // A server that fails takes the run with it: nobody can reach it any more.
        shutdown.cancel();
        served
    };
    let (joined, served) = tokio::join!(learning, serving);
    let ended = joined.map_err(|source| Error::RunDirectory {
        action: "start a thread for",
        path: PathBuf::from("learning"),
        source: source.into(),
    })?;
    served?;
    ended.unwrap_or(Err(Error::Panicked))
}

fn is_complete(ended: &Result<Ended, Error>) -> bool {
    ended.as_ref().is_ok_and(|ended| !ended.interrupted)
}

/// Waits until every worker that was playing when the run ended has asked for work and been told, or counts as dead:
/// who is not told waits for the learner for ever.
async fn until_workers_know(shared: Arc<Shared>, shutdown: CancellationToken) {
    while shared.lock().is_awaited((shared.clock)()) {
        tokio::select! {
            () = tokio::time::sleep(LINGER_TICK) => (),
            () = shutdown.cancelled() => return,
        }
    }
}

/// Shows the run's figures for as long as it is polled.
async fn show_figures(listener: Option<TcpListener>, shared: Arc<Shared>) {
    let Some(listener) = listener else { return std::future::pending().await };
    let write = Arc::new(move || metrics::page(&shared));
    let page = Page { path: metrics::PATH, content_type: metrics::CONTENT_TYPE, write };
    page.serve(listener).await;
}

/// Waits until those who ask now and then have heard of the run's end.
async fn linger(after_the_end: AfterTheEnd) {
    match after_the_end {
        AfterTheEnd::Linger(linger) => tokio::time::sleep(linger).await,
        AfterTheEnd::Stay => tokio::time::sleep(LINGER).await,
    }
}

/// Waits for `shutdown` where a service is to stay until then.
async fn stay(after_the_end: AfterTheEnd, shutdown: CancellationToken) {
    if after_the_end == AfterTheEnd::Stay {
        shutdown.cancelled().await;
    }
}

/// Runs the run and tells workers and watchers how it ended, even when that is by a bug.
fn learn(
    config: &LearnerConfig,
    shared: &Shared,
    runtime: &Runtime,
    shutdown: &CancellationToken,
) -> Result<Ended, Error> {
    let run = AssertUnwindSafe(|| drive::run(config, shared, runtime, shutdown));
    let ended = std::panic::catch_unwind(run).unwrap_or(Err(Error::Panicked));
    let reason =
        ended.as_ref().map_or_else(|error| error_chain(error), |ended| ended.reason.clone());
    let interrupted = !is_complete(&ended);
    shared.lock().finish(pb::Finished { reason: reason.clone(), interrupted });
    shared.work.notify_waiters();
    shared.progress.send_modify(|progress| {
        progress.ended = true;
        progress.end_reason = reason;
        progress.digest =
            ended.as_ref().map_or_else(|_| String::new(), |ended| ended.digest.clone());
    });
    ended
}

/// Waits until a connection has ended and hands the slots of its workers to the next that ask: a round need not wait
/// until they count as slow. A worker that was only cut off delivers all the same.
async fn give_to_others(shared: Arc<Shared>, connection: u64, hangup: Hangup) {
    hangup.wait().await;
    let mut state = shared.lock();
    state.connections.ended(connection);
    let gave_back = state.board.connection_ended(connection);
    drop(state);
    for worker_id in &gave_back {
        tracing::info!(worker_id, "connection has ended, its slot goes to another worker");
    }
    if !gave_back.is_empty() {
        shared.work.notify_waiters();
    }
}

struct LearnerService {
    shared: Arc<Shared>,
    /// Which start of a learner this is.
    start: u64,
}

#[tonic::async_trait]
impl Learner for LearnerService {
    type WatchStream = Pin<Box<dyn Stream<Item = Result<pb::Progress, Status>> + Send>>;

    async fn join(
        &self,
        request: Request<pb::JoinRequest>,
    ) -> Result<Response<pb::JoinResponse>, Status> {
        let hangup = Hangup::of(request.extensions());
        let pb::JoinRequest { worker: name, version } = request.into_inner();
        check_name(&name)?;
        check_version(&name, &version, "learner")?;
        let now = (self.shared.clock)();
        let mut state = self.shared.lock();
        let terms =
            state.terms.clone().ok_or_else(|| Status::unavailable("the run is starting"))?;
        let connection = hangup.as_ref().map(|hangup| state.connections.number_of(hangup));
        if let (Some(hangup), Some((number, true))) = (hangup, connection) {
            tokio::spawn(give_to_others(self.shared.clone(), number, hangup));
        }
        let worker_id = state
            .board
            .join(name.clone(), connection.map(|(number, _)| number), now)
            .map_err(|error| Status::resource_exhausted(error.to_string()))?;
        let lines = state.join_lines.count(now);
        drop(state);
        if let Some(n) = lines.left_out {
            tracing::info!(n, "more workers joined");
        }
        if lines.this {
            WorkerJoined { worker_id, name: &name }.emit();
        }
        let terms = Some(encode_run_terms(&terms));
        Ok(Response::new(pb::JoinResponse { worker_id, terms, learner: self.start }))
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
        let prepared = self.shared.lock().published.get(&version).cloned();
        let gone = || Status::not_found(format!("parameter version {version} is not kept"));
        prepared.map(Prepared::answer).ok_or_else(gone)
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
        if let Some(finished) = state.finished.clone() {
            state.untold.remove(&worker_id);
            return Ok((Some(Work::Finished(finished)), WORK_POLL));
        }
        let order = state.board.next(worker_id, now).map_err(|error| refusal(&error, None))?;
        let look_again_in = state.board.cover_in(now).unwrap_or(WORK_POLL);
        drop(state);
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
        self.shared.arrived.notify_one();
        Ok(())
    }
}
