//! The service `tandem.v1.Bridge`: a thin shell around an [`Executor`] on its own thread.
//!
//! No client can delay a tick: motions are planned and checked on other threads, one at a time; calls are handled
//! between ticks; progress is published in snapshots, whose lock readers hold only to clone a pointer. A stop waits in
//! no queue.
//!
//! **The drives always stop**: when the service shuts down, a stream ends or breaks, the owner falls silent, a driver
//! fails, or the arms' thread panics. The drives of a killed process brake because they receive no commands.

mod clock;
mod error;
mod execute_stream;
mod execution;
mod messages;
mod metrics;
mod motion;
mod operator;
mod reason_codes;
mod snapshot;
mod thread;

use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use rand_chacha::ChaCha20Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
use tandem_net::{ConnectInfo, Incoming, SHUTDOWN_GRACE, ServerConfig};
use tandem_proto::pb::bridge_server::{Bridge as BridgeRpc, BridgeServer};
use tandem_proto::{DecodeError, pb};
use tokio::sync::{Semaphore, watch};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::{CancellationToken, DropGuard};
use tonic::{Request, Response, Status, Streaming};

use crate::cell_file::{ArmTiming, CellFile};
use crate::executor::{CheckedMotion, Executor, Stop, StopCause, Token};
use crate::injection::Injector;
use messages::{decode_token, token_text};
use metrics::StopCounter;
use motion::MotionSpec;
use thread::{ArmsHandle, ArmsThread, ControlLoop};

pub use clock::Clock;
pub(crate) use clock::next_time;
pub use error::Error;
pub use motion::MotionError;
pub use operator::Operator;
pub use snapshot::{MotionInfo, Observer, Snapshot, Snapshots, observe};
pub use thread::{BoxDriver, Reconnect};

/// The largest request in bytes: a joint motion of ten minutes.
const MAX_REQUEST_BYTES: usize = 16 << 20;
/// The longest time that a motion waits for its check.
const CHECK_TIMEOUT: Duration = Duration::from_secs(4);
/// The longest time that a reset waits for arms that still brake, or for good states: behind kinova-ros, these take a
/// second.
const RESET_TIMEOUT: Duration = Duration::from_secs(2);

/// The configuration of a bridge service.
#[derive(Clone)]
pub struct Config {
    /// The name of the driver for clients, such as "sim".
    pub driver: String,
    /// The program's version.
    pub version: String,
    /// The largest share of a motion's own speed at which it is played, in (0, 1].
    pub speed: f64,
    /// The clock of the ticks.
    pub clock: Arc<dyn Clock>,
    /// Replaces the driver if a reset finds that it has failed; `None` for arms that cannot lose their connection.
    pub reconnect: Option<Reconnect>,
    /// The cell file of the arms.
    pub cell: CellFile,
    /// The times in which each arm reacts: the measured ones, or else those that the driver assumes.
    pub timings: Vec<ArmTiming>,
    /// The name of the cell file; empty for the default cell.
    pub cell_name: String,
    /// Injects faults into simulated arms; `None` for real ones.
    pub injector: Option<Injector>,
    /// Prepares the thread that moves the arms, such as its priority. Called on that thread before the first tick.
    pub prepare_thread: Option<fn()>,
    /// The secret seed of the tokens, which must differ at every start.
    pub secret: [u8; 32],
}

/// Serves the arms of `executor` to the clients that `server_config` admits until `shutdown` is cancelled, and then
/// stops the arms.
///
/// # Errors
/// Returns an error if the server fails, the arms' thread has panicked, the driver hangs, or the arms have not
/// confirmed the stop.
///
/// # Panics
/// Panics if the speed is not in (0, 1].
pub async fn serve(
    executor: Executor<BoxDriver>,
    config: Config,
    incoming: impl Into<Incoming>,
    server_config: &ServerConfig,
    shutdown: CancellationToken,
) -> Result<(), Error> {
    Bridge::start(executor, config, None, &shutdown)?.serve(incoming, server_config).await
}

/// Arms that are ticked, and the service that offers them to clients.
pub struct Bridge {
    thread: ArmsThread,
    arms: ArmsHandle,
    config: Config,
    ends: CancellationToken,
    /// Without the server no client could stop the arms, so the thread ends with it.
    guard: DropGuard,
}

impl Bridge {
    /// Starts to tick the arms of `executor` until `shutdown` is cancelled or the bridge is dropped, which stops them.
    /// `observer` receives every snapshot.
    ///
    /// # Errors
    /// Returns an error if no thread can be started.
    ///
    /// # Panics
    /// Panics if the speed is not in (0, 1].
    pub fn start(
        executor: Executor<BoxDriver>,
        config: Config,
        observer: Option<Observer>,
        shutdown: &CancellationToken,
    ) -> Result<Self, Error> {
        assert!(config.speed > 0.0 && config.speed <= 1.0, "speed {}", config.speed);
        let ends = shutdown.child_token();
        let guard = ends.clone().drop_guard();
        let clock = Arc::clone(&config.clock);
        let started =
            ArmsThread::spawn(executor, clock, observer, config.prepare_thread, ends.clone());
        let (thread, arms) = started.map_err(Error::Thread)?;
        Ok(Self { thread, arms, config, ends, guard })
    }

    /// Returns the handle of an operator in this process.
    #[must_use]
    pub fn operator(&self) -> Operator {
        Operator(self.arms.clone())
    }

    /// Serves the arms to the clients that `server_config` admits, and then stops the arms.
    ///
    /// # Errors
    /// Returns an error if the server fails, the arms' thread has panicked, the driver hangs, or the arms have not
    /// confirmed the stop.
    pub async fn serve(
        self,
        incoming: impl Into<Incoming>,
        server_config: &ServerConfig,
    ) -> Result<(), Error> {
        self.serve_boxed(incoming.into(), server_config).await
    }

    /// Boxes the service, so that it is compiled in this crate only and not in every crate that serves.
    fn serve_boxed(
        self,
        incoming: Incoming,
        server_config: &ServerConfig,
    ) -> Pin<Box<dyn Future<Output = Result<(), Error>> + Send + '_>> {
        Box::pin(async move {
            let Self { thread, arms, config, ends, guard } = self;
            let _ends = guard;
            metrics::add_state(server_config.metrics(), arms.clone());
            let stops = StopCounter::register(server_config.metrics());
            tokio::spawn(log_stops(arms.watch(), stops));
            let service = BridgeService::new(arms, config);
            let bridge = BridgeServer::new(service).max_decoding_message_size(MAX_REQUEST_BYTES);
            let router = server_config.router(bridge, tandem_proto::FILE_DESCRIPTOR_SET).await?;
            let served = tandem_net::serve(router, incoming, ends.clone()).await;
            ends.cancel();
            thread.join(SHUTDOWN_GRACE).await?;
            Ok(served?)
        })
    }
}

/// Logs and counts stops and resets. The arms' thread does not log, because it must not wait.
async fn log_stops(mut snapshots: watch::Receiver<Arc<Snapshot>>, counter: StopCounter) {
    let mut logged: Option<Stop> = None;
    while snapshots.changed().await.is_ok() {
        let newest = Arc::clone(&snapshots.borrow_and_update());
        let stopped = newest.stopped.clone();
        if let Some(stop) = stopped.as_ref().filter(|_| stopped != logged) {
            counter.count(stop);
        }
        match &stopped {
            Some(stop) if stopped != logged => match stop.cause {
                StopCause::NotReset => {}
                StopCause::Requested | StopCause::ShutDown => {
                    tracing::info!(%stop, "the arms were stopped");
                }
                _ => tracing::warn!(%stop, "the arms were stopped"),
            },
            None if logged.is_some() => tracing::info!("the arms were reset"),
            _ => {}
        }
        logged = stopped;
    }
}

/// The implementation of the generated trait.
struct BridgeService {
    arms: ArmsHandle,
    config: Config,
    tokens: Mutex<ChaCha20Rng>,
    /// Motions are checked one at a time, so that the arms' thread keeps a processor.
    checks: Arc<Semaphore>,
    /// One connection is replaced at a time.
    reconnects: Arc<Semaphore>,
}

impl BridgeService {
    fn new(arms: ArmsHandle, config: Config) -> Self {
        let tokens = Mutex::new(ChaCha20Rng::from_seed(config.secret));
        let (checks, reconnects) = (Arc::new(Semaphore::new(1)), Arc::new(Semaphore::new(1)));
        Self { arms, config, tokens, checks, reconnects }
    }

    fn new_token(&self) -> Token {
        // The generator is valid even if a holder of the lock panicked.
        let mut tokens = self.tokens.lock().unwrap_or_else(PoisonError::into_inner);
        Token(u128::from(tokens.next_u64()) << 64 | u128::from(tokens.next_u64()))
    }

    async fn acquire_lease(&self, token: &str) -> Result<Token, Error> {
        if token.is_empty() {
            let token = self.new_token();
            self.arms.run(move |arms, now_s| arms.executor.acquire(token, now_s)).await?;
            tracing::info!("the arms were acquired");
            return Ok(token);
        }
        let token = decode_token("token", token)?;
        self.arms.run(move |arms, now_s| arms.executor.renew(token, now_s)).await?;
        Ok(token)
    }

    async fn release_lease(&self, token: &str) -> Result<(), Error> {
        let token = decode_token("token", token)?;
        self.arms.run(move |arms, now_s| arms.executor.release(token, now_s)).await
    }

    async fn reset_arms(&self, token: &str) -> Result<(), Error> {
        let token = decode_token("token", token)?;
        let newest = self.arms.newest();
        if let Some(reconnect) = &self.config.reconnect
            && newest.exchange_failed
        {
            self.replace_driver(Arc::clone(reconnect), token).await?;
        }
        self.reset_when_ready(token, newest.n_halts).await
    }

    /// Resets the arms as soon as they rest and their states are good, unless there are more than `n_halts` stops and
    /// faults by then.
    async fn reset_when_ready(&self, token: Token, n_halts: u64) -> Result<(), Error> {
        let mut snapshots = self.arms.watch();
        let timeout = tokio::time::sleep(RESET_TIMEOUT);
        tokio::pin!(timeout);
        loop {
            snapshots.mark_unchanged();
            let reset = move |arms: &mut ControlLoop, now_s| {
                arms.executor.reset_unless_halted(token, n_halts, now_s)
            };
            let refused = match self.arms.run(reset).await {
                Err(Error::Reset(refused)) if refused.may_pass() => refused,
                ended => return ended,
            };
            tokio::select! {
                changed = snapshots.changed() => changed.map_err(|_gone| Error::ShuttingDown)?,
                () = &mut timeout => return Err(refused.into()),
            }
        }
    }

    /// Replaces a failed driver. The arms do not move.
    async fn replace_driver(&self, reconnect: Reconnect, token: Token) -> Result<(), Error> {
        let permit = Arc::clone(&self.reconnects).acquire_owned().await;
        let permit = permit.map_err(|_closed| Error::ShuttingDown)?;
        self.arms.run(move |arms, now_s| arms.executor.renew(token, now_s)).await?;
        if !self.arms.newest().exchange_failed {
            return Ok(());
        }
        // The permit ends with the connection, also if the client does not wait for it.
        let connect = move || {
            let _permit = permit;
            reconnect()
        };
        let connected = tokio::task::spawn_blocking(connect).await;
        let driver = connected.map_err(|_panic| Error::Panicked)?.map_err(Error::Reconnect)?;
        let replace = move |arms: &mut ControlLoop, now_s| {
            // Connecting may take longer than a lease. An owner who came meanwhile keeps the arms.
            arms.executor.acquire(token, now_s)?;
            arms.replace_driver(token, driver, now_s)
        };
        self.arms.run(replace).await?;
        tracing::info!("the driver was replaced");
        Ok(())
    }

    /// Decodes `request`, which is field `field` of its message.
    fn decode(&self, field: &str, request: Option<pb::MotionRequest>) -> Result<MotionSpec, Error> {
        let request = request.ok_or_else(|| DecodeError::new(field, "a message", "none"))?;
        let spec = MotionSpec::decode(request, self.arms.checker.cell());
        Ok(spec.map_err(|error| error.within(field))?)
    }

    /// Returns the share of a motion's own speed at which it is played if a client requests `speed`.
    fn limited_speed(&self, speed: f64) -> f64 {
        speed.min(self.config.speed)
    }

    /// Checks a motion from the position of the arms, and passes it to `then` on the same thread.
    async fn check_motion<T: Send + 'static>(
        &self,
        spec: MotionSpec,
        then: impl FnOnce(CheckedMotion) -> T + Send + 'static,
    ) -> Result<T, Error> {
        let permit = tokio::time::timeout(CHECK_TIMEOUT, Arc::clone(&self.checks).acquire_owned());
        let permit = permit.await.map_err(|_elapsed| Error::Busy)?;
        let permit = permit.map_err(|_closed| Error::ShuttingDown)?;
        // After an invalid state, which stops the arms, there is none until the next one arrives.
        let newest = self.arms.wait_until(|newest| newest.state.is_some()).await;
        let state = newest.state.clone().ok_or(Error::NoState)?;
        let checker = self.arms.checker.clone();
        let checking = tokio::task::spawn_blocking(move || {
            let _permit = permit;
            spec.prepare(&state, newest.openings.as_deref(), &checker).map(then)
        });
        Ok(checking.await.map_err(|_panic| Error::Panicked)??)
    }

    async fn check_request(&self, request: pb::CheckRequest) -> Result<pb::CheckResponse, Error> {
        use pb::check_response::Verdict;
        let spec = self.decode("motion", request.motion)?;
        let (speed, cell) = (self.limited_speed(spec.speed), self.arms.checker.cell().clone());
        let describe = move |motion: CheckedMotion| messages::accepted(&motion, &cell, speed);
        let verdict = match self.check_motion(spec, describe).await {
            Ok(accepted) => Verdict::Accepted(accepted),
            Err(Error::Refused(refused)) => Verdict::Refused(messages::refusal(&refused)),
            Err(error) => return Err(error),
        };
        Ok(pb::CheckResponse { verdict: Some(verdict) })
    }

    fn description(&self) -> pb::DescribeBridgeResponse {
        let (cell, config) = (self.arms.checker.cell(), &self.config);
        pb::DescribeBridgeResponse {
            driver: config.driver.clone(),
            version: config.version.clone(),
            period_s: self.arms.period_s,
            arms: messages::describe_arms(cell, config),
            table_z_m: cell.table_z_m,
            task_frame: Some(messages::task_frame(cell)),
            limits: Some(messages::limits(&self.arms.checker, config.speed)),
            cell_file: config.cell_name.clone(),
        }
    }

    fn current_status(&self) -> pb::BridgeStatusResponse {
        let newest = self.arms.newest();
        let motion = newest.progress.map(|progress| pb::MotionProgress {
            phase: messages::phase(newest.phase).into(),
            played_s: progress.played_s,
            duration_s: progress.duration_s,
            speed: newest.motion.as_ref().map_or(0.0, |motion| motion.speed),
            arms: Vec::new(),
        });
        pb::BridgeStatusResponse {
            phase: messages::phase(newest.phase).into(),
            stopped: newest.stopped.as_ref().map(messages::stop),
            is_owned: newest.lease_left_s.is_some(),
            lease_left_s: newest.lease_left_s.unwrap_or_default(),
            at_rest: newest.at_rest,
            arms: messages::arms(&newest, self.arms.checker.cell()),
            motion,
            now_s: newest.now_s,
            since_tick_s: (self.arms.clock.now_s() - newest.now_s).max(0.0),
            injected: self.injected(),
        }
    }

    /// Injects a fault into simulated arms, or clears all of them. Returns the present ones.
    fn inject_fault(&self, request: pb::InjectRequest) -> Result<Vec<pb::FaultInjection>, Error> {
        use pb::inject_request::Action;
        let action = request.action;
        let action = action.ok_or_else(|| DecodeError::new("action", "fault or clear", "none"))?;
        let Some(injector) = &self.config.injector else {
            return Err(Error::RealArms { driver: self.config.driver.clone() });
        };
        match action {
            Action::Fault(fault) => {
                let fault = messages::decode_fault(fault, self.arms.checker.cell());
                let fault = fault.map_err(|error| error.within("fault"))?;
                tracing::warn!(%fault, "a fault was injected");
                injector.add(fault);
            }
            Action::Clear(pb::ClearFaults {}) => {
                tracing::info!("the injected faults were cleared");
                injector.clear();
            }
        }
        Ok(self.injected())
    }

    fn injected(&self) -> Vec<pb::FaultInjection> {
        let faults = self.config.injector.as_ref().map(Injector::faults).unwrap_or_default();
        faults.into_iter().map(messages::fault).collect()
    }
}

#[tonic::async_trait]
impl BridgeRpc for BridgeService {
    type ExecuteStream = ReceiverStream<Result<pb::ExecuteResponse, Status>>;

    async fn describe(
        &self,
        _: Request<pb::DescribeBridgeRequest>,
    ) -> Result<Response<pb::DescribeBridgeResponse>, Status> {
        Ok(Response::new(self.description()))
    }

    async fn acquire(
        &self,
        request: Request<pb::AcquireRequest>,
    ) -> Result<Response<pb::AcquireResponse>, Status> {
        let token = token_text(self.acquire_lease(&request.get_ref().token).await?);
        let lease_s = self.arms.checker.settings().lease_s;
        Ok(Response::new(pb::AcquireResponse { token, lease_s }))
    }

    async fn release(
        &self,
        request: Request<pb::ReleaseRequest>,
    ) -> Result<Response<pb::ReleaseResponse>, Status> {
        self.release_lease(&request.get_ref().token).await?;
        Ok(Response::new(pb::ReleaseResponse {}))
    }

    async fn reset(
        &self,
        request: Request<pb::ResetRequest>,
    ) -> Result<Response<pb::ResetResponse>, Status> {
        self.reset_arms(&request.get_ref().token).await?;
        Ok(Response::new(pb::ResetResponse {}))
    }

    async fn check(
        &self,
        request: Request<pb::CheckRequest>,
    ) -> Result<Response<pb::CheckResponse>, Status> {
        Ok(Response::new(self.check_request(request.into_inner()).await?))
    }

    async fn execute(
        &self,
        request: Request<Streaming<pb::ExecuteRequest>>,
    ) -> Result<Response<Self::ExecuteStream>, Status> {
        let client = ConnectInfo::peer(request.extensions()).map(|peer| peer.to_string());
        let client = client.unwrap_or_default();
        Ok(Response::new(execute_stream::begin(self, request.into_inner(), client).await?))
    }

    async fn stop(
        &self,
        _: Request<pb::StopRequest>,
    ) -> Result<Response<pb::StopResponse>, Status> {
        let newest = self.arms.stop().await?;
        let stopped = newest.stopped.as_ref().map(messages::stop);
        Ok(Response::new(pb::StopResponse { stopped }))
    }

    async fn status(
        &self,
        _: Request<pb::BridgeStatusRequest>,
    ) -> Result<Response<pb::BridgeStatusResponse>, Status> {
        Ok(Response::new(self.current_status()))
    }

    async fn inject(
        &self,
        request: Request<pb::InjectRequest>,
    ) -> Result<Response<pb::InjectResponse>, Status> {
        let injected = self.inject_fault(request.into_inner())?;
        Ok(Response::new(pb::InjectResponse { injected }))
    }
}
