//! The thread that ticks the executor, and the handle through which calls reach it.
//!
//! The thread does no lengthy work: it receives checked motions, executes at most [`MAX_JOBS`] jobs before a tick, and
//! publishes a snapshot after it, whose lock readers hold only to clone a pointer. Stops bypass the queue of jobs: they
//! increment a counter that the thread reads first.

use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use tandem_kinematics::Joints;
use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::driver::{Driver, DriverError};
use crate::executor::{
    CheckedMotion, Checker, Executor, LeaseError, Phase, ResetError, StartError, Token,
};
use crate::service::clock::{Clock, next_time};
use crate::service::error::Error;
use crate::service::execution::{Execution, Outcome};
use crate::service::snapshot::{Observer, Snapshot};

/// A boxed driver.
pub type BoxDriver = Box<dyn Driver + Send>;

/// Creates a driver with a new connection to the same arms.
pub type Reconnect = Arc<dyn Fn() -> Result<BoxDriver, DriverError> + Send + Sync>;

/// Jobs that may wait for the thread. The callers of further jobs wait.
const CAPACITY: usize = 64;
/// The largest number of jobs before one tick.
const MAX_JOBS: u32 = 8;
/// The longest time that a call waits for the thread.
const CALL_TIMEOUT: Duration = Duration::from_secs(2);
/// The longest time in which the arms confirm a stop.
const CONFIRM_TIMEOUT: Duration = Duration::from_secs(1);
/// The largest number of ticks in which the arms confirm a stop and come to rest when the service shuts down.
const SHUTDOWN_TICKS: u32 = 100;

type Job = Box<dyn FnOnce(&mut ControlLoop, f64) + Send>;

/// The state of the thread.
pub(super) struct ControlLoop {
    pub(super) executor: Executor<BoxDriver>,
    jobs: mpsc::Receiver<Job>,
    snapshots: watch::Sender<Arc<Snapshot>>,
    n_stops_requested: Arc<AtomicU64>,
    n_stops: u64,
    n_motions: u64,
    running: Option<Arc<Execution>>,
    observer: Option<Observer>,
}

/// The running thread.
pub(super) struct ArmsThread {
    thread: JoinHandle<Result<(), Error>>,
    ended: oneshot::Receiver<()>,
}

/// Sends jobs to the thread and reads its snapshots.
#[derive(Clone)]
pub(super) struct ArmsHandle {
    pub(super) checker: Checker,
    pub(super) period_s: f64,
    pub(super) clock: Arc<dyn Clock>,
    jobs: mpsc::Sender<Job>,
    snapshots: watch::Receiver<Arc<Snapshot>>,
    n_stops_requested: Arc<AtomicU64>,
}

/// Reports the end of the thread when it is dropped.
struct EndGuard {
    _ends: DropGuard,
    _ended: oneshot::Sender<()>,
}

impl ArmsThread {
    /// Moves `executor` to a new thread, which ticks it by `clock` until `ends` is cancelled and then stops the arms.
    /// If the thread ends for another reason, it cancels `ends`. The thread calls `prepare` first.
    pub(super) fn spawn(
        executor: Executor<BoxDriver>,
        clock: Arc<dyn Clock>,
        observer: Option<Observer>,
        prepare: Option<fn()>,
        ends: CancellationToken,
    ) -> io::Result<(Self, ArmsHandle)> {
        let (jobs, waiting) = mpsc::channel(CAPACITY);
        let (end_sender, ended) = oneshot::channel();
        let (checker, period_s) = (executor.checker().clone(), executor.period_s());
        let first = snapshot(&executor, clock.now_s());
        let (publisher, snapshots) = watch::channel(Arc::new(first));
        let n_stops_requested = Arc::new(AtomicU64::new(0));
        let mut control = ControlLoop {
            executor,
            jobs: waiting,
            snapshots: publisher,
            n_stops_requested: Arc::clone(&n_stops_requested),
            n_stops: 0,
            n_motions: 0,
            running: None,
            observer,
        };
        let thread_clock = Arc::clone(&clock);
        let guard = EndGuard { _ends: ends.clone().drop_guard(), _ended: end_sender };
        let thread = std::thread::Builder::new().name("arms".to_owned()).spawn(move || {
            let _guard = guard;
            if let Some(prepare) = prepare {
                prepare();
            }
            let ended = catch_unwind(AssertUnwindSafe(|| control.run(&*thread_clock, &ends)));
            // Dropping the executor stops the drives, even after a panic.
            let dropped = catch_unwind(AssertUnwindSafe(move || drop(control)));
            dropped.and(ended).unwrap_or(Err(Error::Panicked))
        })?;
        Ok((
            Self { thread, ended },
            ArmsHandle { checker, period_s, clock, jobs, snapshots, n_stops_requested },
        ))
    }

    /// Waits for the thread's end, at most for `grace`.
    ///
    /// # Errors
    /// Returns an error if the thread has panicked, its driver hangs, or the arms have not confirmed the stop at its
    /// end.
    pub(super) async fn join(self, grace: Duration) -> Result<(), Error> {
        match tokio::time::timeout(grace, self.ended).await {
            Ok(_ended) => self.thread.join().unwrap_or(Err(Error::Panicked)),
            Err(_elapsed) => Err(Error::DriverHung),
        }
    }
}

impl ControlLoop {
    /// Ticks until `ends` is cancelled, and then until the arms have confirmed a stop and are at rest.
    ///
    /// # Errors
    /// Returns an error if they do not confirm it or do not come to rest in time.
    fn run(&mut self, clock: &dyn Clock, ends: &CancellationToken) -> Result<(), Error> {
        let (mut at_s, mut n_shutdown) = (clock.now_s(), 0);
        loop {
            at_s = next_time(at_s, self.executor.period_s(), clock.now_s());
            clock.sleep_until(at_s);
            let now_s = clock.now_s();
            if ends.is_cancelled() {
                if n_shutdown == 0 {
                    self.executor.shut_down(now_s);
                    self.jobs.close();
                    while self.jobs.try_recv().is_ok() {}
                } else if self.executor.at_rest() && self.executor.stop_is_confirmed() {
                    return Ok(());
                } else if n_shutdown == SHUTDOWN_TICKS {
                    return Err(self.not_stopped());
                }
                n_shutdown += 1;
            }
            self.handle_requests(now_s);
            self.executor.tick(now_s);
            self.finish_motion();
            self.publish(now_s);
        }
    }

    /// Returns the error of a shutdown after which the arms have not confirmed the stop or are not known to rest.
    fn not_stopped(&self) -> Error {
        if let Some(error) = self.executor.stop_error() {
            return Error::StopFailed(error.clone());
        }
        let waited_s = f64::from(SHUTDOWN_TICKS) * self.executor.period_s();
        let waited = Duration::from_secs_f64(waited_s);
        match self.executor.stop_is_confirmed() {
            true => Error::NotAtRest(waited),
            false => Error::StopUnconfirmed(waited),
        }
    }

    fn publish(&self, now_s: f64) {
        let newest = Arc::new(Snapshot {
            motion: self.running.as_ref().map(|execution| Arc::clone(&execution.motion)),
            n_motions: self.n_motions,
            n_stops: self.n_stops,
            ..snapshot(&self.executor, now_s)
        });
        if let Some(observer) = &self.observer {
            observer.publish(&newest);
        }
        self.snapshots.send_replace(newest);
    }

    /// Handles the requests since the last tick, stops first.
    fn handle_requests(&mut self, now_s: f64) {
        let n_stops = self.n_stops_requested.load(Ordering::Acquire);
        if n_stops != self.n_stops {
            self.executor.stop(now_s);
            self.n_stops = n_stops;
        }
        if let Some(execution) = &self.running {
            if execution.is_abandoned() {
                // Stop the arms even if the lease has ended meanwhile.
                if self.executor.release(execution.token, now_s).is_err() {
                    self.executor.stop(now_s);
                }
            } else if execution.take_alive() {
                // Without a lease this is not a sign of life, and the owner counts as silent.
                self.executor.renew(execution.token, now_s).ok();
            }
        }
        // A motion that was stopped is over before a job can reset the arms or start another one.
        self.finish_motion();
        for _ in 0..MAX_JOBS {
            let Ok(job) = self.jobs.try_recv() else { return };
            job(self, now_s);
            self.finish_motion();
        }
    }

    /// Starts the motion of `execution`, unless its client has abandoned it.
    pub(super) fn start(
        &mut self,
        execution: &Arc<Execution>,
        motion: CheckedMotion,
        now_s: f64,
    ) -> Result<(), StartError> {
        if execution.is_abandoned() {
            return Err(LeaseError::NotOwned.into());
        }
        self.executor.start_checked(execution.token, motion, execution.motion.speed, now_s)?;
        self.n_motions += 1;
        self.running = Some(Arc::clone(execution));
        Ok(())
    }

    /// Replaces the executor's failed driver, and publishes the new state at once.
    pub(super) fn replace_driver(
        &mut self,
        token: Token,
        driver: BoxDriver,
        now_s: f64,
    ) -> Result<(), ResetError> {
        self.executor.replace_driver(token, driver, now_s)?;
        self.publish(now_s);
        Ok(())
    }

    /// Records the outcome of a motion that has ended.
    fn finish_motion(&mut self) {
        let outcome = match self.executor.phase() {
            Phase::Idle => Outcome::Done,
            Phase::Stopped => match self.executor.stopped_by() {
                Some(stop) => Outcome::Stopped(stop.clone()),
                None => return,
            },
            Phase::Moving | Phase::Holding | Phase::Settling => return,
        };
        if let Some(execution) = self.running.take() {
            execution.finish(outcome);
        }
    }
}

impl ArmsHandle {
    /// Returns the newest snapshot.
    pub(super) fn newest(&self) -> Arc<Snapshot> {
        Arc::clone(&self.snapshots.borrow())
    }

    /// Returns the number of jobs that wait for the thread.
    pub(super) fn n_waiting(&self) -> usize {
        self.jobs.max_capacity() - self.jobs.capacity()
    }

    /// Returns a receiver of snapshots. A slow receiver sees only the newest one.
    pub(super) fn watch(&self) -> watch::Receiver<Arc<Snapshot>> {
        self.snapshots.clone()
    }

    /// Stops the arms before all waiting jobs, and waits until they confirm it. Returns the snapshot after that.
    ///
    /// # Errors
    /// Returns an error if the drives could not be commanded to stop or do not confirm it, or the thread does not
    /// respond.
    pub(super) async fn stop(&self) -> Result<Arc<Snapshot>, Error> {
        let number = self.n_stops_requested.fetch_add(1, Ordering::AcqRel) + 1;
        let mut snapshots = self.snapshots.clone();
        let stopped = async {
            let newest = snapshots.wait_for(|newest| newest.n_stops >= number).await;
            newest.map(|newest| Arc::clone(&newest)).map_err(|_gone| {
                match self.newest().stop_error.clone() {
                    Some(error) => Error::StopFailed(error),
                    None => Error::ShuttingDown,
                }
            })
        };
        let timed_out = |_elapsed| Err(Error::Timeout(CALL_TIMEOUT));
        let newest = tokio::time::timeout(CALL_TIMEOUT, stopped).await.unwrap_or_else(timed_out)?;
        let is_answered =
            |newest: &Arc<Snapshot>| newest.stop_error.is_some() || newest.stop_is_confirmed;
        let newest = match is_answered(&newest) {
            true => newest,
            false => self.wait_for(CONFIRM_TIMEOUT, is_answered).await,
        };
        match &newest.stop_error {
            Some(error) => Err(Error::StopFailed(error.clone())),
            None if !newest.stop_is_confirmed => Err(Error::StopUnconfirmed(CONFIRM_TIMEOUT)),
            None => Ok(newest),
        }
    }

    /// Waits until a snapshot meets `condition`, at most as long as a call. Returns that snapshot, or else the newest one.
    pub(super) async fn wait_until(
        &self,
        condition: impl FnMut(&Arc<Snapshot>) -> bool,
    ) -> Arc<Snapshot> {
        self.wait_for(CALL_TIMEOUT, condition).await
    }

    async fn wait_for(
        &self,
        timeout: Duration,
        condition: impl FnMut(&Arc<Snapshot>) -> bool,
    ) -> Arc<Snapshot> {
        let mut snapshots = self.snapshots.clone();
        match tokio::time::timeout(timeout, snapshots.wait_for(condition)).await {
            Ok(Ok(met)) => Arc::clone(&met),
            Ok(Err(_)) | Err(_) => self.newest(),
        }
    }

    /// Runs `work` on the thread before a tick and returns its result. Dropping the future before that cancels the
    /// work.
    pub(super) async fn run<T: Send + 'static, E: Into<Error> + Send + 'static>(
        &self,
        work: impl FnOnce(&mut ControlLoop, f64) -> Result<T, E> + Send + 'static,
    ) -> Result<T, Error> {
        let (reply, answer) = oneshot::channel();
        let job: Job = Box::new(move |control, now_s| {
            if !reply.is_closed() {
                drop(reply.send(work(control, now_s)));
            }
        });
        let response = async {
            self.jobs.send(job).await.map_err(|_unsent| Error::ShuttingDown)?;
            answer.await.map_err(|_dropped| Error::ShuttingDown)?.map_err(Into::into)
        };
        let timed_out = |_elapsed| Err(Error::Timeout(CALL_TIMEOUT));
        tokio::time::timeout(CALL_TIMEOUT, response).await.unwrap_or_else(timed_out)
    }
}

/// Returns the state of `executor`, without the motion and the counters of the thread.
fn snapshot(executor: &Executor<BoxDriver>, now_s: f64) -> Snapshot {
    Snapshot {
        now_s,
        phase: executor.phase(),
        stopped: executor.stopped_by().cloned(),
        exchange_failed: executor.exchange_error().is_some(),
        stop_error: executor.stop_error().cloned(),
        stop_is_confirmed: executor.stop_is_confirmed(),
        lease_left_s: executor.lease_left_s(now_s),
        at_rest: executor.at_rest(),
        state: executor.state().cloned(),
        openings: executor.openings(),
        reference: executor.reference().map(<[Joints]>::to_vec),
        motion: None,
        progress: executor.progress(),
        n_motions: 0,
        n_halts: executor.n_halts(),
        n_stops: 0,
    }
}
