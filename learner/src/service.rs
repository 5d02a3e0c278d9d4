//! The `Learner` service: gRPC calls on the work queue, next to the learning thread.

mod messages;
mod refusals;

pub use messages::encode_evaluation;

use std::panic::AssertUnwindSafe;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use tandem_core::Episode;
use tandem_core::text::error_chain;
use tandem_net::{ConnectionClosed, EncodedResponse, Incoming, MAX_MESSAGE_BYTES, TextEndpoint};
use tandem_proto::pb;
use tandem_proto::pb::learner_server::{Learner, LearnerServer};
use tandem_proto::{decode_episode, encode_run_terms, encode_slot};
use tandem_telemetry::RunView;
use tandem_telemetry::events::WorkerJoined;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio_stream::wrappers::WatchStream;
use tokio_stream::{Stream, StreamExt as _};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status};

use crate::error::Error;
use crate::metrics;
use crate::progress::RunEnd;
use crate::runtime::on_a_thread;
use crate::shared::{LearnerConfig, Shared, State};
use crate::timings::Timings;
use crate::training_loop::{self, Context, RunOutcome};
use crate::view;
use crate::work_queue::check_count;
use messages::{encode_finished, encode_progress};
pub(crate) use refusals::check_version;
use refusals::{check_name, malformed, refusal};

/// Longest time that a request for work is held before it is answered with `Wait`.
const WORK_POLL: Duration = Duration::from_secs(2);
/// Time for which the service stays after the end of the run, so that clients learn of it.
const LINGER: Duration = Duration::from_millis(1500);
/// Pause between two checks whether all workers know of the end.
const LINGER_TICK: Duration = Duration::from_millis(50);

/// Options of the service.
#[derive(Debug, Default)]
pub struct ServeOptions {
    /// Serves metrics at `/metrics`, without a token.
    pub metrics: Option<TcpListener>,
    /// Receives snapshots of the run about twice a second.
    pub views: Option<watch::Sender<RunView>>,
    /// The stay of the service after a complete run.
    pub linger: LingerPolicy,
}

/// The stay of the service after a complete run. After a run that was interrupted or failed it stays for at most
/// 1.5 s.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LingerPolicy {
    /// For a fixed time, so that clients learn of the end.
    For(Duration),
    /// Until shutdown.
    UntilShutdown,
}

impl Default for LingerPolicy {
    fn default() -> Self {
        Self::For(LINGER)
    }
}

/// Serves a run with default options.
///
/// # Errors
/// See [`serve_with`].
pub async fn serve(
    config: LearnerConfig,
    incoming: impl Into<Incoming>,
    shutdown: CancellationToken,
) -> Result<RunOutcome, Error> {
    serve_with(config, incoming, shutdown, ServeOptions::default()).await
}

/// Serves a run until it ends or `shutdown` is cancelled; saves the state in both cases.
///
/// # Errors
/// When the run cannot start, its state cannot be saved, or learning diverges.
pub async fn serve_with(
    config: LearnerConfig,
    incoming: impl Into<Incoming>,
    shutdown: CancellationToken,
    options: ServeOptions,
) -> Result<RunOutcome, Error> {
    serve_boxed(config, incoming.into(), shutdown, options).await
}

/// Boxes the service, so that it is compiled in this crate only and not in every crate that serves.
fn serve_boxed(
    config: LearnerConfig,
    incoming: Incoming,
    shutdown: CancellationToken,
    options: ServeOptions,
) -> Pin<Box<dyn Future<Output = Result<RunOutcome, Error>> + Send>> {
    Box::pin(async move {
        let timings = Timings::register(config.server_config.metrics());
        let shared = Arc::new(Shared::new(&config, timings));
        metrics::add(config.server_config.metrics(), &shared);
        let learner = LearnerServer::new(LearnerService {
            shared: shared.clone(),
            start: config.first_worker,
        })
        .max_decoding_message_size(MAX_MESSAGE_BYTES);
        let router =
            config.server_config.router(learner, tandem_proto::FILE_DESCRIPTOR_SET).await?;
        let stop_serving = CancellationToken::new();
        let page = config.server_config.metrics().endpoint();
        let serving_metrics = serve_metrics(options.metrics, page);
        let publishing = view::publish(options.views, shared.clone(), config.run.clone());
        let learning = {
            // Also dropped if the thread cannot be started.
            let stop = stop_serving.clone().drop_guard();
            let (pacing, shutdown) = (config.pacing, shutdown.clone());
            on_a_thread("learn", pacing, move |runtime| {
                let _stop = stop;
                let context = Context {
                    config: &config,
                    shared: &shared,
                    runtime: &runtime,
                    shutdown: &shutdown,
                };
                let outcome = learn(context);
                linger(context, &shared, &outcome, options.linger);
                outcome
            })
        };
        let serving = async {
            let served = tokio::select! {
                served = tandem_net::serve(router, incoming, stop_serving) => served,
                () = serving_metrics => Ok(()),
                () = publishing => Ok(()),
            };
            // A server that fails ends the run: no worker can reach it any more.
            shutdown.cancel();
            served
        };
        let (joined, served) = tokio::join!(learning, serving);
        let outcome = joined.map_err(Error::Thread)?;
        served?;
        outcome.unwrap_or(Err(Error::Panicked))
    })
}

fn is_complete(outcome: &Result<RunOutcome, Error>) -> bool {
    outcome.as_ref().is_ok_and(|outcome| !outcome.interrupted)
}

/// Blocks until clients know of the end of the run; after a complete run also until all workers do, and for as long as
/// the policy asks for.
fn linger(
    Context { runtime, shutdown, .. }: Context<'_>,
    shared: &Arc<Shared>,
    outcome: &Result<RunOutcome, Error>,
    policy: LingerPolicy,
) {
    runtime.wait_on(wait_for_pollers(policy));
    if is_complete(outcome) {
        runtime.wait_on(wait_for_workers(shared.clone(), shutdown.clone()));
        runtime.wait_on(wait_for_shutdown(policy, shutdown.clone()));
    }
    // The streams of watchers close at the first message after the one that reports the end.
    shared.progress.send_modify(|_| ());
}

/// Waits until every worker that was playing at the end of the run has asked for work and received the end, or counts
/// as dead. A worker that does not know of the end would wait for the learner forever.
async fn wait_for_workers(shared: Arc<Shared>, shutdown: CancellationToken) {
    while shared.lock().awaits_workers((shared.clock)()) {
        tokio::select! {
            () = tokio::time::sleep(LINGER_TICK) => (),
            () = shutdown.cancelled() => return,
        }
    }
}

/// Serves the metrics while it is polled.
async fn serve_metrics(listener: Option<TcpListener>, page: TextEndpoint) {
    match listener {
        Some(listener) => page.serve(listener).await,
        None => std::future::pending().await,
    }
}

/// Waits until clients that poll have learned of the end.
async fn wait_for_pollers(policy: LingerPolicy) {
    match policy {
        LingerPolicy::For(duration) => tokio::time::sleep(duration).await,
        LingerPolicy::UntilShutdown => tokio::time::sleep(LINGER).await,
    }
}

/// Waits for `shutdown` if the policy asks for it.
async fn wait_for_shutdown(policy: LingerPolicy, shutdown: CancellationToken) {
    if policy == LingerPolicy::UntilShutdown {
        shutdown.cancelled().await;
    }
}

/// Runs the run and reports its end to workers and watchers, after a panic too.
fn learn(context: Context<'_>) -> Result<RunOutcome, Error> {
    let shared = context.shared;
    let run = AssertUnwindSafe(|| training_loop::run(context));
    let outcome = std::panic::catch_unwind(run).unwrap_or(Err(Error::Panicked));
    let end = RunEnd {
        reason: outcome
            .as_ref()
            .map_or_else(|error| error_chain(error), |outcome| outcome.reason.clone()),
        interrupted: !is_complete(&outcome),
        digest: outcome.as_ref().ok().map(|outcome| outcome.digest.clone()),
    };
    shared.lock().finish(end.clone());
    shared.work.notify_waiters();
    shared.progress.send_modify(|progress| progress.end = Some(end));
    outcome
}

/// Waits for the end of a connection and returns the slots of its workers to the queue, so that a round does not wait
/// until they count as slow. A worker that was only disconnected may still submit its episodes.
async fn requeue_when_closed(shared: Arc<Shared>, connection: u64, closed: ConnectionClosed) {
    closed.wait().await;
    let mut state = shared.lock();
    state.connections.remove(connection);
    let requeued = state.queue.remove_connection(connection);
    drop(state);
    for worker_id in &requeued {
        tracing::info!(worker_id, "connection closed, its slot goes to another worker");
    }
    if !requeued.is_empty() {
        shared.work.notify_waiters();
    }
}

struct LearnerService {
    shared: Arc<Shared>,
    /// Identifies this start of the learner.
    start: u64,
}

#[tonic::async_trait]
impl Learner for LearnerService {
    type WatchStream = Pin<Box<dyn Stream<Item = Result<pb::Progress, Status>> + Send>>;

    async fn join(
        &self,
        request: Request<pb::JoinRequest>,
    ) -> Result<Response<pb::JoinResponse>, Status> {
        let closed = ConnectionClosed::from_extensions(request.extensions());
        let pb::JoinRequest { worker: name, version } = request.into_inner();
        check_name(&name)?;
        check_version(&name, &version, "learner")?;
        let now = (self.shared.clock)();
        let mut state = self.shared.lock();
        let terms =
            state.terms.clone().ok_or_else(|| Status::unavailable("the run is starting"))?;
        let connection = closed.map(|closed| self.register(&mut state, closed));
        let worker_id = state
            .queue
            .join(name.clone(), connection, now)
            .map_err(|error| Status::resource_exhausted(error.to_string()))?;
        let decision = state.join_lines.count(now);
        drop(state);
        if let Some(n) = decision.n_skipped {
            tracing::info!(n, "more workers joined");
        }
        if decision.log {
            WorkerJoined { worker_id, name: &name }.emit();
        }
        let terms = Some(encode_run_terms(&terms));
        Ok(Response::new(pb::JoinResponse { worker_id, terms, learner: self.start }))
    }

    async fn next_work(
        &self,
        request: Request<pb::NextWorkRequest>,
    ) -> Result<Response<pb::NextWorkResponse>, Status> {
        let closed = ConnectionClosed::from_extensions(request.extensions());
        let worker_id = request.into_inner().worker_id;
        if let Some(closed) = closed {
            self.attach(worker_id, closed);
        }
        let search = async {
            loop {
                let notified = self.shared.work.notified();
                let (work, retry_in) = self.work_for(worker_id)?;
                if let Some(work) = work {
                    return Ok::<_, Status>(work);
                }
                // Retries in both cases: there may be new slots, or a slot to play a second time.
                drop(tokio::time::timeout(retry_in, notified).await);
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
        prepared.map(EncodedResponse::into_response).ok_or_else(gone)
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
        Ok(Response::new(encode_progress(&self.shared.progress.borrow())))
    }

    async fn watch(
        &self,
        _: Request<pb::WatchRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let mut has_ended = false;
        let progress =
            WatchStream::new(self.shared.progress.subscribe()).take_while(move |progress| {
                let is_open = !has_ended;
                has_ended = progress.end.is_some();
                is_open
            });
        Ok(Response::new(Box::pin(progress.map(|progress| Ok(encode_progress(&progress))))))
    }
}

use pb::next_work_response::Work;

impl LearnerService {
    /// Returns the number of a connection. The slots of its workers return to the queue when it closes.
    fn register(&self, state: &mut State, closed: ConnectionClosed) -> u64 {
        let (number, is_new) = state.connections.register(&closed);
        if is_new {
            tokio::spawn(requeue_when_closed(self.shared.clone(), number, closed));
        }
        number
    }

    /// Attaches a worker that calls over another connection than before to its new connection.
    fn attach(&self, worker_id: u64, closed: ConnectionClosed) {
        let mut state = self.shared.lock();
        let Some(worker) = state.queue.worker(worker_id) else { return };
        let current = worker.connection;
        if current.is_some_and(|current| state.connections.is_same(current, &closed)) {
            return;
        }
        let connection = self.register(&mut state, closed);
        state.queue.attach(worker_id, connection);
    }

    /// Returns the work for a worker, and the time after which to retry if there is none.
    fn work_for(&self, worker_id: u64) -> Result<(Option<Work>, Duration), Status> {
        let now = (self.shared.clock)();
        let mut state = self.shared.lock();
        if let Some(end) = state.end.clone() {
            state.uninformed.remove(&worker_id);
            return Ok((Some(Work::Finished(encode_finished(&end))), WORK_POLL));
        }
        let order = state.queue.next(worker_id, now).map_err(|error| refusal(&error, None))?;
        let retry_in = state.queue.next_backup_in(now).unwrap_or(WORK_POLL);
        drop(state);
        Ok((order.map(|order| Work::Slot(encode_slot(&order))), retry_in))
    }

    /// Accepts a slot's episodes if all of them match the order. Episodes that were submitted before are ignored, the
    /// report on environments that comes with them is not: the worker sends it once.
    fn submit(&self, request: pb::SubmitEpisodesRequest) -> Result<(), Status> {
        let pb::SubmitEpisodesRequest { worker_id, slot, episodes, environment_check } = request;
        let is_new = self.accept(worker_id, slot, episodes)?;
        let is_new_report = self.shared.lock().queue.is_new_report(worker_id, slot);
        if (is_new || is_new_report)
            && let Some(check) = environment_check
        {
            self.shared.record_environment_check(&check);
        }
        self.shared.arrived.notify_one();
        Ok(())
    }

    /// Accepts a slot's episodes; returns false if they were submitted before.
    fn accept(
        &self,
        worker_id: u64,
        slot: u64,
        episodes: Vec<pb::Episode>,
    ) -> Result<bool, Status> {
        let now = (self.shared.clock)();
        let mut state = self.shared.lock();
        let terms =
            state.terms.as_ref().ok_or_else(|| Status::unavailable("the run is starting"))?;
        let task = terms.task.clone();
        let worker = state.queue.worker(worker_id).map(|worker| (worker_id, worker.name.clone()));
        let refused = |error| refusal(&error, worker.as_ref());
        let Some(order) = state.queue.order_of(worker_id, slot, now).map_err(refused)? else {
            return Ok(false);
        };
        check_count(order, episodes.len()).map_err(refused)?;
        // Decoding takes a while, so the lock is released for other calls.
        drop(state);
        let decode = |episode: pb::Episode| {
            let number = episode.number;
            decode_episode(episode, &task)
                .map_err(|error| malformed(&error, number, worker.as_ref()))
        };
        let episodes: Vec<Episode> = episodes.into_iter().map(decode).collect::<Result<_, _>>()?;
        self.shared.lock().queue.submit(worker_id, slot, episodes, now).map_err(refused)
    }
}
