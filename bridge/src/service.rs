//! The service `tandem.v1.Bridge`: a thin shell round an [`Executor`] on a thread of its own.
//!
//! Nothing that a client does delays a tick: motions are planned and checked on other threads, one at a time, and handed
//! over whole; what calls ask for is done between ticks; progress is published and never waited for. A stop does not
//! queue behind anything.
//!
//! **Every way out stops the drives**: the service's end, a stream that ends or breaks, an owner who is silent, a driver
//! that fails, a panic of the thread that ticks. A killed process is silent, and drives brake on silence.

mod attend;
mod error;
mod execution;
mod messages;
mod motion;
mod thread;
mod time;
mod words;

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use rand_chacha::ChaCha20Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
use tandem_net::{Gate, Incoming, SHUTDOWN_GRACE};
use tandem_proto::pb::bridge_server::{Bridge, BridgeServer};
use tandem_proto::{DecodeError, pb};
use tokio::sync::{Semaphore, watch};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

use crate::executor::{CheckedMotion, Executor, GOOD_STATES, Stop, StopCause, Token};
use error::status;
use messages::{decode_token, token_text};
use motion::Wanted;
use thread::{ArmsHandle, ArmsThread, Snapshot};

pub use error::Error;
pub use motion::Refused;
pub use thread::{AnyDriver, Dial};
pub use time::Time;

/// Bytes that a request may have: joint motions of ten minutes.
const MAX_REQUEST_BYTES: usize = 16 << 20;
/// How long a motion waits until it is its turn to be checked.
const CHECK_QUEUE: Duration = Duration::from_secs(4);

/// What a bridge service needs to know beside its arms.
#[derive(Clone)]
pub struct Config {
    /// What stands behind the executor, for those who ask: "sim".
    pub driver: String,
    /// The program's version.
    pub version: String,
    /// No motion is played faster than this share of its own speed, in (0, 1].
    pub speed: f64,
    /// What the arms are ticked by.
    pub time: Arc<dyn Time>,
    /// Connects again when a reset finds that the driver has failed; `None` for arms that do not lose their connection.
    pub dial: Option<Dial>,
    /// Makes tokens hard to guess: different at every start, and known to nobody.
    pub secret: [u8; 32],
}

/// Serves the arms behind `executor` to those whom `gate` lets in, until `shutdown` is cancelled. The arms are then
/// stopped, before anything else.
///
/// # Errors
/// When the server fails, the thread that moves the arms has panicked, or the driver does not come back.
///
/// # Panics
/// When the speed is not in (0, 1].
pub async fn serve(
    executor: Executor<AnyDriver>,
    config: Config,
    incoming: impl Into<Incoming>,
    gate: &Gate,
    shutdown: CancellationToken,
) -> Result<(), Error> {
    assert!(config.speed > 0.0 && config.speed <= 1.0, "speed {}", config.speed);
    let ends = shutdown.child_token();
    // Whatever becomes of the server: without it nobody can stop the arms.
    let _ends = ends.clone().drop_guard();
    let (thread, arms) = ArmsThread::spawn(executor, Arc::clone(&config.time), ends.clone())
        .map_err(Error::Thread)?;
    tokio::spawn(log_stops(arms.watch()));
    let service = BridgeService::new(arms, config);
    let bridge = BridgeServer::new(service).max_decoding_message_size(MAX_REQUEST_BYTES);
    let router = gate.router(bridge).await?;
    let served = tandem_net::serve(router, incoming, ends.clone()).await;
    ends.cancel();
    thread.join(SHUTDOWN_GRACE).await?;
    Ok(served?)
}

/// Logs why the arms were stopped. The thread that ticks does not: it must not wait for a log.
async fn log_stops(mut snapshots: watch::Receiver<Arc<Snapshot>>) {
    let mut told: Option<Stop> = None;
    while snapshots.changed().await.is_ok() {
        let stopped = snapshots.borrow_and_update().stopped.clone();
        match &stopped {
            Some(stop) if stopped != told => match stop.cause {
                StopCause::NotReset => {}
                StopCause::Requested | StopCause::ShutDown => {
                    tracing::info!(%stop, "the arms were stopped");
                }
                _ => tracing::warn!(%stop, "the arms were stopped"),
            },
            None if told.is_some() => tracing::info!("the arms were let go"),
            _ => {}
        }
        told = stopped;
    }
}

/// What the generated server calls.
struct BridgeService {
    arms: ArmsHandle,
    config: Config,
    tokens: Mutex<ChaCha20Rng>,
    /// Motions are checked one at a time: the arms' thread needs a processor as well.
    checks: Arc<Semaphore>,
    /// One connection is made at a time.
    dials: Semaphore,
}

impl BridgeService {
    fn new(arms: ArmsHandle, config: Config) -> Self {
        let tokens = Mutex::new(ChaCha20Rng::from_seed(config.secret));
        let (checks, dials) = (Arc::new(Semaphore::new(1)), Semaphore::new(1));
        Self { arms, config, tokens, checks, dials }
    }

    fn new_token(&self) -> Token {
        // A generator is whole at any time.
        let mut tokens = self.tokens.lock().unwrap_or_else(PoisonError::into_inner);
        Token(u128::from(tokens.next_u64()) << 64 | u128::from(tokens.next_u64()))
    }

    async fn acquire_lease(&self, shown: &str) -> Result<Token, Error> {
        if shown.is_empty() {
            let token = self.new_token();
            self.arms.run(move |arms, now_s| arms.executor.acquire(token, now_s)).await?;
            tracing::info!("the arms have an owner");
            return Ok(token);
        }
        let token = decode_token("token", shown)?;
        self.arms.run(move |arms, now_s| arms.executor.renew(token, now_s)).await?;
        Ok(token)
    }

    async fn release_lease(&self, shown: &str) -> Result<(), Error> {
        let token = decode_token("token", shown)?;
        self.arms.run(move |arms, now_s| arms.executor.release(token, now_s)).await
    }

    async fn reset_arms(&self, shown: &str) -> Result<(), Error> {
        let token = decode_token("token", shown)?;
        if let Some(dial) = self.config.dial.as_ref().filter(|_| self.arms.newest().failed) {
            self.connect_again(Arc::clone(dial), token).await?;
        }
        self.arms.run(move |arms, now_s| arms.executor.reset(token, now_s)).await
    }

    /// Gives the arms a new connection in the place of one that has failed, and waits for good states. Nothing moves by it.
    async fn connect_again(&self, dial: Dial, token: Token) -> Result<(), Error> {
        let _turn = self.dials.acquire().await.map_err(|_closed| Error::Ended)?;
        self.arms.run(move |arms, now_s| arms.executor.renew(token, now_s)).await?;
        if !self.arms.newest().failed {
            return Ok(());
        }
        let dialled = tokio::task::spawn_blocking(move || dial()).await;
        let driver = dialled.map_err(|_panic| Error::Panicked)?.map_err(Error::Dial)?;
        self.arms.run(move |arms, now_s| arms.replace_driver(token, driver, now_s)).await?;
        tracing::info!("the arms have a new connection");
        self.arms.until(|newest| newest.failed || newest.n_good >= GOOD_STATES).await;
        Ok(())
    }

    /// What `request` wants, as field `field` of its message.
    fn decode(&self, field: &str, request: Option<pb::MotionRequest>) -> Result<Wanted, Error> {
        let request = request.ok_or_else(|| DecodeError::new(field, "a message", "none"))?;
        let wanted = Wanted::decode(request, self.arms.checker.cell());
        Ok(wanted.map_err(|error| error.within(field))?)
    }

    /// The share of a motion's own speed at which it is played.
    fn bounded(&self, speed: f64) -> f64 {
        speed.min(self.config.speed)
    }

    /// Checks a motion from where the arms are, and looks at it with `look` on the same thread.
    async fn check_motion<T: Send + 'static>(
        &self,
        wanted: Wanted,
        look: impl FnOnce(CheckedMotion) -> T + Send + 'static,
    ) -> Result<T, Error> {
        // After a state that was not believed there is none until the next one has come.
        self.arms.until(|newest| newest.state.is_some()).await;
        let turn = tokio::time::timeout(CHECK_QUEUE, Arc::clone(&self.checks).acquire_owned());
        let turn = turn.await.map_err(|_elapsed| Error::Busy)?.map_err(|_closed| Error::Ended)?;
        let newest = self.arms.newest();
        let state = newest.state.clone().ok_or(Error::NoState)?;
        let checker = self.arms.checker.clone();
        let checking = tokio::task::spawn_blocking(move || {
            let _turn = turn;
            wanted.prepare(&state, &checker).map(look)
        });
        Ok(checking.await.map_err(|_panic| Error::Panicked)??)
    }

    async fn judge(&self, request: pb::CheckRequest) -> Result<pb::CheckResponse, Error> {
        use pb::check_response::Verdict;
        let wanted = self.decode("motion", request.motion)?;
        let (speed, cell) = (self.bounded(wanted.speed), self.arms.checker.cell().clone());
        let look = move |motion: CheckedMotion| messages::accepted(&motion, &cell, speed);
        let verdict = match self.check_motion(wanted, look).await {
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
            arms: cell.arms.iter().map(messages::describe_arm).collect(),
            table_z_m: cell.table_z_m,
            task_frame: Some(messages::task_frame(cell)),
            limits: Some(messages::limits(&self.arms.checker, config.speed)),
        }
    }

    fn present(&self) -> pb::BridgeStatusResponse {
        let newest = self.arms.newest();
        let motion = newest.progress.map(|progress| pb::MotionProgress {
            phase: messages::phase(newest.phase).into(),
            played_s: progress.played_s,
            duration_s: progress.duration_s,
            speed: newest.speed.unwrap_or_default(),
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
            since_tick_s: (self.arms.time.now_s() - newest.now_s).max(0.0),
        }
    }
}

#[tonic::async_trait]
impl Bridge for BridgeService {
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
        let acquired = self.acquire_lease(&request.get_ref().token).await;
        let token = token_text(acquired.map_err(|error| status(&error))?);
        let lease_s = self.arms.checker.settings().lease_s;
        Ok(Response::new(pb::AcquireResponse { token, lease_s }))
    }

    async fn release(
        &self,
        request: Request<pb::ReleaseRequest>,
    ) -> Result<Response<pb::ReleaseResponse>, Status> {
        let released = self.release_lease(&request.get_ref().token).await;
        released.map_err(|error| status(&error))?;
        Ok(Response::new(pb::ReleaseResponse {}))
    }

    async fn reset(
        &self,
        request: Request<pb::ResetRequest>,
    ) -> Result<Response<pb::ResetResponse>, Status> {
        let reset = self.reset_arms(&request.get_ref().token).await;
        reset.map_err(|error| status(&error))?;
        Ok(Response::new(pb::ResetResponse {}))
    }

    async fn check(
        &self,
        request: Request<pb::CheckRequest>,
    ) -> Result<Response<pb::CheckResponse>, Status> {
        let verdict = self.judge(request.into_inner()).await;
        verdict.map(Response::new).map_err(|error| status(&error))
    }

    async fn execute(
        &self,
        request: Request<Streaming<pb::ExecuteRequest>>,
    ) -> Result<Response<Self::ExecuteStream>, Status> {
        let told = attend::begin(self, request.into_inner()).await;
        told.map(Response::new).map_err(|error| status(&error))
    }

    async fn stop(
        &self,
        _: Request<pb::StopRequest>,
    ) -> Result<Response<pb::StopResponse>, Status> {
        let newest = self.arms.stop().await.map_err(|error| status(&error))?;
        let stopped = newest.stopped.as_ref().map(messages::stop);
        Ok(Response::new(pb::StopResponse { stopped }))
    }

    async fn status(
        &self,
        _: Request<pb::BridgeStatusRequest>,
    ) -> Result<Response<pb::BridgeStatusResponse>, Status> {
        Ok(Response::new(self.present()))
    }
}
