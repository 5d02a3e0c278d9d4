//! The thread that owns the networks and the ledger, and its job queue. Under [`Pacing::Lockstep`] it is a task.

use std::io;
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use tandem_net::Pacing;
use tandem_net::metrics::ConstGauge;
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::advisor::{Advice, AdviceRequest, Advisor, TeacherInfo};
use crate::error::Error;
use crate::service::failures::FailureLog;
use crate::service::metrics::TeacherMetrics;

/// The capacity of the job queue. When it is full, calls wait to enqueue their jobs.
const QUEUE_CAPACITY: usize = 256;
/// The number of steps at which a batch takes no further request.
const MAX_BATCH_STEPS: usize = 256;
/// The part of the time limit of a call that a batch is to take at most. Fewer requests are answered together if the
/// policy is slow.
const MAX_BATCH_SHARE: f64 = 0.25;

type Answer<T> = Result<T, Error>;

/// A job for the thread.
enum Job {
    /// Answer a request for advice, which has waited since this time, in a batch with others.
    Advise(AdviceRequest, Duration, oneshot::Sender<Answer<Advice>>),
    /// Run any other operation.
    Run(Box<dyn FnOnce(&mut Advisor) + Send>),
}

/// The running thread or task.
pub(super) struct AdvisorThread {
    handle: JoinHandle,
    ended: oneshot::Receiver<()>,
}

/// The handle of the thread, or of the task under [`Pacing::Lockstep`].
enum JoinHandle {
    Thread(thread::JoinHandle<Result<(), Error>>),
    Task(tokio::task::JoinHandle<Result<(), Error>>),
}

/// Sends jobs to the thread, which ends when all handles are dropped.
#[derive(Clone)]
pub(super) struct AdvisorHandle {
    info: Arc<TeacherInfo>,
    jobs: mpsc::Sender<Job>,
    timeout: Duration,
    metrics: TeacherMetrics,
    failures: Arc<FailureLog>,
}

/// Signals the end of the thread when it is dropped, also after a panic.
struct EndSignal {
    _stop: DropGuard,
    _ended: oneshot::Sender<()>,
}

impl AdvisorThread {
    /// Moves `advisor` to its own thread or task. A call to it fails after `timeout`. When the thread ends, `stop` is
    /// cancelled.
    pub(super) fn spawn(
        advisor: Advisor,
        timeout: Duration,
        stop: CancellationToken,
        pacing: Pacing,
        metrics: TeacherMetrics,
    ) -> io::Result<(Self, AdvisorHandle)> {
        let (jobs, queue) = mpsc::channel(QUEUE_CAPACITY);
        add_queue_depth(&metrics, &jobs);
        let (end_sender, ended) = oneshot::channel();
        let info = Arc::new(advisor.info().clone());
        let batch = Batch::new(metrics.clone(), timeout);
        let job_loop = JobLoop { advisor, jobs: queue, batch, stop: stop.clone() };
        let end_signal = EndSignal { _stop: stop.drop_guard(), _ended: end_sender };
        let handle = match pacing {
            Pacing::Concurrent => JoinHandle::Thread(
                thread::Builder::new().name("advisor".to_owned()).spawn(move || {
                    let _end_signal = end_signal;
                    job_loop.run()
                })?,
            ),
            Pacing::Lockstep => JoinHandle::Task(tokio::spawn(async move {
                let _end_signal = end_signal;
                job_loop.run_as_task().await
            })),
        };
        let failures = Arc::default();
        Ok((Self { handle, ended }, AdvisorHandle { info, jobs, timeout, metrics, failures }))
    }

    /// Waits up to `grace` for the end of the thread. A thread that is still busy then is detached.
    ///
    /// # Errors
    /// When the thread has panicked, or ended because the ledger must be opened again.
    pub(super) async fn join(self, grace: Duration) -> Result<(), Error> {
        match tokio::time::timeout(grace, self.ended).await {
            Ok(_ended) => match self.handle {
                JoinHandle::Thread(thread) => thread.join().map_err(|_panic| Error::Panicked)?,
                JoinHandle::Task(task) => task.await.map_err(|_panic| Error::Panicked)?,
            },
            Err(_elapsed) => {
                tracing::warn!("the ledger is still in use after the grace period");
                Ok(())
            }
        }
    }
}

impl AdvisorHandle {
    /// Returns the description of the teacher.
    pub(super) fn info(&self) -> &TeacherInfo {
        &self.info
    }

    /// Logs the failure of a request, unless many requests have failed alike.
    pub(super) fn record_failure(&self, error: &Error) {
        self.failures.record(error, self.metrics.now());
    }

    /// Answers a request for advice. If the future is dropped before the thread has taken the request, nothing is
    /// charged.
    pub(super) async fn advise(&self, request: AdviceRequest) -> Answer<Advice> {
        let (reply, answer) = oneshot::channel();
        let start = self.metrics.now();
        let advice = self.send(Job::Advise(request, start, reply), answer).await;
        self.metrics.record_request(start);
        advice
    }

    /// Runs `work` on the thread, after the jobs before it.
    pub(super) async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Advisor) -> Answer<T> + Send + 'static,
    ) -> Answer<T> {
        let (reply, answer) = oneshot::channel();
        let work = move |advisor: &mut Advisor| {
            if !reply.is_closed() {
                drop(reply.send(work(advisor)));
            }
        };
        self.send(Job::Run(Box::new(work)), answer).await
    }

    /// Enqueues `job` and waits for its answer. The thread drops a job unanswered only when it panics.
    async fn send<T>(&self, job: Job, answer: oneshot::Receiver<Answer<T>>) -> Answer<T> {
        let answered = async {
            self.jobs.send(job).await.map_err(|_unsent| Error::Panicked)?;
            answer.await.map_err(|_dropped| Error::Panicked)?
        };
        let timed_out = |_elapsed| Err(Error::Timeout(self.timeout));
        tokio::time::timeout(self.timeout, answered).await.unwrap_or_else(timed_out)
    }
}

/// Adds the number of waiting jobs to the metrics, while there are senders of jobs.
fn add_queue_depth(metrics: &TeacherMetrics, jobs: &mpsc::Sender<Job>) {
    let jobs = jobs.downgrade();
    metrics.registry.add_source(move |registry| {
        let depth = jobs.upgrade().map_or(0, |jobs| jobs.max_capacity() - jobs.capacity());
        let help = "Jobs that wait for the advising thread";
        registry.register("advice_queue_depth", help, ConstGauge::new(depth as f64));
        let help = "Jobs that can wait for the advising thread";
        let capacity = ConstGauge::new(QUEUE_CAPACITY as f64);
        registry.register("advice_queue_capacity", help, capacity);
    });
}

/// Executes jobs in their order. Requests that wait together are answered in one batch.
struct JobLoop {
    advisor: Advisor,
    jobs: mpsc::Receiver<Job>,
    batch: Batch,
    stop: CancellationToken,
}

impl JobLoop {
    /// Runs until there are no senders of jobs, on a thread of its own.
    fn run(mut self) -> Result<(), Error> {
        while let Some(job) = self.jobs.blocking_recv() {
            self.execute(job);
        }
        self.end()
    }

    /// Runs as [`Self::run`] does, on the runtime of the calls: requests of one simulated moment are answered in one
    /// batch.
    async fn run_as_task(mut self) -> Result<(), Error> {
        while let Some(job) = self.jobs.recv().await {
            self.execute(job);
        }
        self.end()
    }

    /// Executes `job` and those that wait behind it.
    fn execute(&mut self, job: Job) {
        self.batch.take_all(job, &mut self.jobs, &mut self.advisor);
        self.batch.answer(&mut self.advisor);
        if self.advisor.must_end() {
            // The service ends; until then, calls are refused.
            self.stop.cancel();
        }
    }

    fn end(self) -> Result<(), Error> {
        if self.advisor.must_end() { Err(Error::LedgerNeedsRestart) } else { Ok(()) }
    }
}

/// Requests that are answered together.
struct Batch {
    requests: Vec<AdviceRequest>,
    replies: Vec<oneshot::Sender<Answer<Advice>>>,
    n_steps: usize,
    pace: Pace,
    /// The time limit of a call.
    timeout: Duration,
    metrics: TeacherMetrics,
}

/// The size and the time of the next batch, by the measure of the latest one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Pace {
    /// The number of steps at which a batch takes no further request.
    max_steps: usize,
    /// The time that a batch takes.
    batch_time: Duration,
}

impl Pace {
    /// The pace before the first batch.
    const FAST: Self = Self { max_steps: MAX_BATCH_STEPS, batch_time: Duration::ZERO };

    /// Returns the pace after a batch of `n_steps` steps, at least 1, has taken `time`; a call may take `timeout`.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "clamped to a small positive range"
    )]
    fn after(n_steps: usize, time: Duration, timeout: Duration) -> Self {
        let max_time_s = MAX_BATCH_SHARE * timeout.as_secs_f64();
        let affordable = n_steps as f64 * max_time_s / time.as_secs_f64();
        let max_steps = affordable.clamp(1.0, MAX_BATCH_STEPS as f64) as usize;
        Self { max_steps, batch_time: time }
    }

    /// Returns true if a request that has waited for `waited` is not worth an answer: its caller would be gone before
    /// the batch ends. Some requests are always worth one, so that the pace is measured again.
    fn is_too_late(self, waited: Duration, timeout: Duration) -> bool {
        waited + self.batch_time.min(timeout / 2) > timeout
    }
}

impl Batch {
    const fn new(metrics: TeacherMetrics, timeout: Duration) -> Self {
        Self {
            requests: Vec::new(),
            replies: Vec::new(),
            n_steps: 0,
            pace: Pace::FAST,
            timeout,
            metrics,
        }
    }

    /// Takes `job` and the jobs behind it until the batch is full or the queue is empty.
    fn take_all(&mut self, job: Job, jobs: &mut mpsc::Receiver<Job>, advisor: &mut Advisor) {
        self.take(job, advisor);
        while self.n_steps < self.pace.max_steps
            && let Ok(job) = jobs.try_recv()
        {
            self.take(job, advisor);
        }
    }

    /// Adds a request, unless its caller has gone or will be gone. Any other job runs after the requests before it are
    /// answered.
    fn take(&mut self, job: Job, advisor: &mut Advisor) {
        match job {
            Job::Advise(_, _, reply) if reply.is_closed() => {}
            Job::Advise(request, since, reply) => {
                let waited = self.metrics.now().saturating_sub(since);
                if self.pace.is_too_late(waited, self.timeout) {
                    // A caller that has gone repeats its request anyway.
                    drop(reply.send(Err(Error::Timeout(self.timeout))));
                    return;
                }
                self.n_steps += request.queries.len();
                self.requests.push(request);
                self.replies.push(reply);
            }
            Job::Run(work) => {
                self.answer(advisor);
                work(advisor);
            }
        }
    }

    fn answer(&mut self, advisor: &mut Advisor) {
        if self.requests.is_empty() {
            return;
        }
        let start = self.metrics.now();
        let answers = advisor.advise(&self.requests);
        if self.n_steps > 0 {
            let time = self.metrics.now().saturating_sub(start);
            self.pace = Pace::after(self.n_steps, time, self.timeout);
        }
        self.metrics.record_batch(start, self.n_steps, &answers);
        self.requests.clear();
        self.n_steps = 0;
        for (reply, answer) in self.replies.drain(..).zip(answers) {
            // A caller that has gone repeats its request and gets the same verdicts.
            drop(reply.send(answer));
        }
    }
}

#[cfg(test)]
mod tests;
