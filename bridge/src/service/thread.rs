//! The thread that ticks the executor, and how calls reach it.
//!
//! The thread does nothing that takes long: motions come to it checked, a tick does at most [`MAX_JOBS`] of what calls ask
//! for, and nobody waits for it but by what it has published. A stop is a number that it looks at before anything else.

use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use tandem_kinematics::Joints;
use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::driver::{Driver, DriverError, PairState};
use crate::executor::{
    CheckedMotion, Checker, Executor, LeaseError, Phase, Progress, ResetError, StartError, Stop,
    Token,
};
use crate::service::error::Error;
use crate::service::execution::{Execution, Outcome};
use crate::service::time::{Time, next_time};

/// Any driver.
pub type AnyDriver = Box<dyn Driver + Send>;

/// Makes a driver with a new connection to the same arms.
pub type Dial = Arc<dyn Fn() -> Result<AnyDriver, DriverError> + Send + Sync>;

/// Jobs that wait for the thread; further ones wait with their callers.
const CAPACITY: usize = 64;
/// Jobs that are done before one tick.
const MAX_JOBS: u32 = 8;
/// How long a call waits for the thread.
const PATIENCE: Duration = Duration::from_secs(2);
/// How many ticks the arms get to come to rest when the service ends.
const ENDING_TICKS: u32 = 50;

type Job = Box<dyn FnOnce(&mut Arms, f64) + Send>;

/// What the thread tells after each tick.
#[derive(Debug, Clone)]
pub(super) struct Snapshot {
    /// When, seconds by the service's clock.
    pub(super) now_s: f64,
    pub(super) phase: Phase,
    pub(super) stopped: Option<Stop>,
    /// Whether the last exchange with the arms failed.
    pub(super) failed: bool,
    /// How many states in a row were good.
    pub(super) n_good: u32,
    /// Why the drives could not be told to stop.
    pub(super) untold: Option<DriverError>,
    pub(super) lease_left_s: Option<f64>,
    pub(super) at_rest: bool,
    pub(super) state: Option<PairState>,
    /// Where the motion has the joints, radians, arm by arm.
    pub(super) reference: Option<Vec<Joints>>,
    pub(super) progress: Option<Progress>,
    /// Share of the motion's own speed at which it is played.
    pub(super) speed: Option<f64>,
    /// How many stops have been carried out.
    n_stops: u64,
}

/// What the thread owns.
pub(super) struct Arms {
    pub(super) executor: Executor<AnyDriver>,
    jobs: mpsc::Receiver<Job>,
    snapshots: watch::Sender<Arc<Snapshot>>,
    n_stops_wanted: Arc<AtomicU64>,
    n_stops: u64,
    running: Option<Arc<Execution>>,
}

/// A running thread.
pub(super) struct ArmsThread {
    thread: JoinHandle<Result<(), Error>>,
    ended: oneshot::Receiver<()>,
}

/// Reaches the thread.
#[derive(Clone)]
pub(super) struct ArmsHandle {
    pub(super) checker: Checker,
    pub(super) period_s: f64,
    pub(super) time: Arc<dyn Time>,
    jobs: mpsc::Sender<Job>,
    snapshots: watch::Receiver<Arc<Snapshot>>,
    n_stops_wanted: Arc<AtomicU64>,
}

/// Lets others know that the thread has ended, whichever way.
struct Ending {
    _ends: DropGuard,
    _ended: oneshot::Sender<()>,
}

impl ArmsThread {
    /// Moves `executor` to a thread of its own, which ticks it by `time` until `ends` is cancelled. The arms are then
    /// stopped. When the thread ends for another reason, `ends` is cancelled.
    pub(super) fn spawn(
        executor: Executor<AnyDriver>,
        time: Arc<dyn Time>,
        ends: CancellationToken,
    ) -> io::Result<(Self, ArmsHandle)> {
        let (jobs, waiting) = mpsc::channel(CAPACITY);
        let (ending, ended) = oneshot::channel();
        let (checker, period_s) = (executor.checker().clone(), executor.period_s());
        let first = snapshot(&executor, time.now_s(), None, 0);
        let (publisher, snapshots) = watch::channel(Arc::new(first));
        let n_stops_wanted = Arc::new(AtomicU64::new(0));
        let mut arms = Arms {
            executor,
            jobs: waiting,
            snapshots: publisher,
            n_stops_wanted: Arc::clone(&n_stops_wanted),
            n_stops: 0,
            running: None,
        };
        let clock = Arc::clone(&time);
        let ending = Ending { _ends: ends.clone().drop_guard(), _ended: ending };
        let thread = std::thread::Builder::new().name("arms".to_owned()).spawn(move || {
            let _ending = ending;
            let ticked = catch_unwind(AssertUnwindSafe(|| arms.tick_on(&*clock, &ends)));
            // Dropping the executor stops the drives, whatever has happened before.
            let dropped = catch_unwind(AssertUnwindSafe(move || drop(arms)));
            ticked.and(dropped).map_err(|_panic| Error::Panicked)
        })?;
        Ok((
            Self { thread, ended },
            ArmsHandle { checker, period_s, time, jobs, snapshots, n_stops_wanted },
        ))
    }

    /// Waits for the thread's end, no longer than `grace`.
    ///
    /// # Errors
    /// When it has panicked, or its driver does not come back.
    pub(super) async fn join(self, grace: Duration) -> Result<(), Error> {
        match tokio::time::timeout(grace, self.ended).await {
            Ok(_ended) => self.thread.join().unwrap_or(Err(Error::Panicked)),
            Err(_elapsed) => Err(Error::Stuck),
        }
    }
}

impl Arms {
    /// Ticks until `ends` is cancelled and the arms rest.
    fn tick_on(&mut self, time: &dyn Time, ends: &CancellationToken) {
        let (mut at_s, mut n_ending) = (time.now_s(), 0);
        while n_ending < ENDING_TICKS {
            at_s = next_time(at_s, self.executor.period_s(), time.now_s());
            time.sleep_until(at_s);
            let now_s = time.now_s();
            if ends.is_cancelled() {
                if n_ending == 0 {
                    self.executor.shut_down(now_s);
                    self.jobs.close();
                    while self.jobs.try_recv().is_ok() {}
                } else if self.executor.at_rest() {
                    return;
                }
                n_ending += 1;
            }
            self.obey(now_s);
            self.executor.tick(now_s);
            self.conclude();
            self.publish(now_s);
        }
    }

    fn publish(&self, now_s: f64) {
        let speed = self.running.as_ref().map(|execution| execution.speed);
        let newest = snapshot(&self.executor, now_s, speed, self.n_stops);
        self.snapshots.send_replace(Arc::new(newest));
    }

    /// Does what was asked for since the tick before: stops first.
    fn obey(&mut self, now_s: f64) {
        let n_stops = self.n_stops_wanted.load(Ordering::Acquire);
        if n_stops != self.n_stops {
            self.executor.stop(now_s);
            self.n_stops = n_stops;
        }
        if let Some(execution) = &self.running {
            if execution.is_left() {
                // A lease that has ended meanwhile does not keep the arms moving.
                if self.executor.release(execution.token, now_s).is_err() {
                    self.executor.stop(now_s);
                }
            } else if execution.was_heard() {
                // Without the lease this is no sign of life, and the executor counts on.
                self.executor.renew(execution.token, now_s).ok();
            }
        }
        for _ in 0..MAX_JOBS {
            let Ok(job) = self.jobs.try_recv() else { return };
            job(self, now_s);
        }
    }

    /// Starts the motion of `execution`, unless its client has gone meanwhile.
    pub(super) fn start(
        &mut self,
        execution: &Arc<Execution>,
        motion: CheckedMotion,
        now_s: f64,
    ) -> Result<(), StartError> {
        if execution.is_left() {
            return Err(LeaseError::Nobody.into());
        }
        self.executor.start_checked(execution.token, motion, execution.speed, now_s)?;
        self.running = Some(Arc::clone(execution));
        Ok(())
    }

    /// Gives the executor a new driver in the place of one that has failed, and tells so at once.
    pub(super) fn replace_driver(
        &mut self,
        token: Token,
        driver: AnyDriver,
        now_s: f64,
    ) -> Result<(), ResetError> {
        self.executor.replace_driver(token, driver, now_s)?;
        self.publish(now_s);
        Ok(())
    }

    /// Notes how a motion has ended, once it has.
    fn conclude(&mut self) {
        let outcome = match self.executor.phase() {
            Phase::Idle => Outcome::Done,
            Phase::Stopped => match self.executor.stopped_by() {
                Some(stop) => Outcome::Stopped(stop.clone()),
                None => return,
            },
            Phase::Moving | Phase::Holding | Phase::Settling => return,
        };
        if let Some(execution) = self.running.take() {
            execution.end(outcome);
        }
    }
}

impl ArmsHandle {
    /// What the thread has told last.
    pub(super) fn newest(&self) -> Arc<Snapshot> {
        Arc::clone(&self.snapshots.borrow())
    }

    /// What the thread tells from now on: the newest only, whoever is slow misses some.
    pub(super) fn watch(&self) -> watch::Receiver<Arc<Snapshot>> {
        self.snapshots.clone()
    }

    /// Stops the arms, past everything that waits; gives what the thread tells once the drives were told.
    ///
    /// # Errors
    /// When the drives could not be told, or the thread does not answer.
    pub(super) async fn stop(&self) -> Result<Arc<Snapshot>, Error> {
        let number = self.n_stops_wanted.fetch_add(1, Ordering::AcqRel) + 1;
        let mut snapshots = self.snapshots.clone();
        let told = async {
            let told = snapshots.wait_for(|newest| newest.n_stops >= number).await;
            told.map(|newest| Arc::clone(&newest)).map_err(|_gone| Error::Ended)
        };
        let overdue = |_elapsed| Err(Error::Overdue(PATIENCE));
        let newest = tokio::time::timeout(PATIENCE, told).await.unwrap_or_else(overdue)?;
        match &newest.untold {
            Some(error) => Err(Error::Untold(error.clone())),
            None => Ok(newest),
        }
    }

    /// Waits until the thread tells what is `wanted`, no longer than for a call.
    pub(super) async fn until(&self, wanted: impl FnMut(&Arc<Snapshot>) -> bool) {
        let mut snapshots = self.snapshots.clone();
        tokio::time::timeout(PATIENCE, snapshots.wait_for(wanted)).await.ok();
    }

    /// What `work` gives, done in its turn before a tick. Whoever drops the future before that leaves it undone.
    pub(super) async fn run<T: Send + 'static, E: Into<Error> + Send + 'static>(
        &self,
        work: impl FnOnce(&mut Arms, f64) -> Result<T, E> + Send + 'static,
    ) -> Result<T, Error> {
        let (reply, answer) = oneshot::channel();
        let job: Job = Box::new(move |arms, now_s| {
            if !reply.is_closed() {
                drop(reply.send(work(arms, now_s)));
            }
        });
        let asked = async {
            self.jobs.send(job).await.map_err(|_unsent| Error::Ended)?;
            answer.await.map_err(|_dropped| Error::Ended)?.map_err(Into::into)
        };
        let overdue = |_elapsed| Err(Error::Overdue(PATIENCE));
        tokio::time::timeout(PATIENCE, asked).await.unwrap_or_else(overdue)
    }
}

fn snapshot(
    executor: &Executor<AnyDriver>,
    now_s: f64,
    speed: Option<f64>,
    n_stops: u64,
) -> Snapshot {
    Snapshot {
        now_s,
        phase: executor.phase(),
        stopped: executor.stopped_by().cloned(),
        failed: executor.failed().is_some(),
        n_good: executor.n_good(),
        untold: executor.untold().cloned(),
        lease_left_s: executor.lease_left_s(now_s),
        at_rest: executor.at_rest(),
        state: executor.state().cloned(),
        reference: executor.reference().map(<[Joints]>::to_vec),
        progress: executor.progress(),
        speed,
        n_stops,
    }
}
