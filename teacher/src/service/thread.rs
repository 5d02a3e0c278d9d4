//! The thread that owns the networks and the ledger, and how calls reach it. Under [`Pacing::Lockstep`] it is a task.

use std::io;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use tandem_net::Pacing;
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::advisor::{Advice, Advisor, Profile, Question};
use crate::error::Error;

/// Jobs that wait for the thread; further ones wait with their callers, one for each open call.
const CAPACITY: usize = 256;
/// Once it has so many steps to answer, the thread takes no further question before it answers.
const MAX_BATCH_STEPS: usize = 256;

type Answer<T> = Result<T, Error>;

/// What the thread is asked to do.
enum Job {
    /// Answer a question, together with others.
    Advise(Question, oneshot::Sender<Answer<Advice>>),
    /// Anything else, by itself.
    Run(Box<dyn FnOnce(&mut Advisor) + Send>),
}

/// A running thread.
pub(super) struct AdvisorThread {
    place: Place,
    ended: oneshot::Receiver<()>,
}

/// Where the advisor's jobs are done.
enum Place {
    Thread(JoinHandle<()>),
    Task(tokio::task::JoinHandle<()>),
}

/// Reaches the thread. It ends once nobody holds one of these any more.
#[derive(Clone)]
pub(super) struct AdvisorHandle {
    profile: Arc<Profile>,
    jobs: mpsc::Sender<Job>,
    patience: Duration,
}

/// Lets others know that the thread has ended, whichever way.
struct Ending {
    _stop: DropGuard,
    _ended: oneshot::Sender<()>,
}

impl AdvisorThread {
    /// Moves `advisor` to a thread of its own. Calls wait for it no longer than `patience`; when it ends, `stop` is
    /// cancelled.
    pub(super) fn spawn(
        advisor: Advisor,
        patience: Duration,
        stop: CancellationToken,
        pacing: Pacing,
    ) -> io::Result<(Self, AdvisorHandle)> {
        let (jobs, waiting) = mpsc::channel(CAPACITY);
        let (ending, ended) = oneshot::channel();
        let profile = Arc::new(advisor.profile().clone());
        let ending = Ending { _stop: stop.drop_guard(), _ended: ending };
        let place = match pacing {
            Pacing::Concurrent => Place::Thread(
                std::thread::Builder::new().name("advisor".to_owned()).spawn(move || {
                    let _ending = ending;
                    work(advisor, waiting);
                })?,
            ),
            Pacing::Lockstep => Place::Task(tokio::spawn(async move {
                let _ending = ending;
                work_as_a_task(advisor, waiting).await;
            })),
        };
        Ok((Self { place, ended }, AdvisorHandle { profile, jobs, patience }))
    }

    /// Waits for the thread's end, no longer than `grace`; a thread that is still asked or stuck is left to itself.
    ///
    /// # Errors
    /// When it has panicked.
    pub(super) async fn join(self, grace: Duration) -> Result<(), Error> {
        match tokio::time::timeout(grace, self.ended).await {
            Ok(_ended) => match self.place {
                Place::Thread(thread) => thread.join().map_err(|_panic| Error::Panicked),
                Place::Task(task) => task.await.map_err(|_panic| Error::Panicked),
            },
            Err(_elapsed) => {
                tracing::warn!("the ledger is still in use after the grace period");
                Ok(())
            }
        }
    }
}

impl AdvisorHandle {
    /// What the teacher tells of itself.
    pub(super) fn profile(&self) -> &Profile {
        &self.profile
    }

    /// The answer to `question`. Whoever drops the future before the thread has come to it charges nothing.
    pub(super) async fn advise(&self, question: Question) -> Answer<Advice> {
        let (reply, answer) = oneshot::channel();
        self.ask(Job::Advise(question, reply), answer).await
    }

    /// What `work` gives, done in its turn.
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
        self.ask(Job::Run(Box::new(work)), answer).await
    }

    /// Hands in `job` and waits for its answer. The thread drops a job unanswered only when it panics.
    async fn ask<T>(&self, job: Job, answer: oneshot::Receiver<Answer<T>>) -> Answer<T> {
        let asked = async {
            self.jobs.send(job).await.map_err(|_unsent| Error::Panicked)?;
            answer.await.map_err(|_dropped| Error::Panicked)?
        };
        let overdue = |_elapsed| Err(Error::Overdue(self.patience));
        tokio::time::timeout(self.patience, asked).await.unwrap_or_else(overdue)
    }
}

/// Does the jobs in their order: questions that wait together are answered together.
fn work(mut advisor: Advisor, mut jobs: mpsc::Receiver<Job>) {
    let mut batch = Batch::default();
    while let Some(job) = jobs.blocking_recv() {
        batch.take_all(job, &mut jobs, &mut advisor);
        batch.answer(&mut advisor);
    }
}

/// [`work`] on the runtime of the calls: questions that arrive at one simulated moment are answered together.
async fn work_as_a_task(mut advisor: Advisor, mut jobs: mpsc::Receiver<Job>) {
    let mut batch = Batch::default();
    while let Some(job) = jobs.recv().await {
        batch.take_all(job, &mut jobs, &mut advisor);
        batch.answer(&mut advisor);
    }
}

/// Questions that are answered together.
#[derive(Default)]
struct Batch {
    questions: Vec<Question>,
    replies: Vec<oneshot::Sender<Answer<Advice>>>,
    n_steps: usize,
}

impl Batch {
    /// Takes `job` and those that wait behind it, as many as are answered together.
    fn take_all(&mut self, job: Job, jobs: &mut mpsc::Receiver<Job>, advisor: &mut Advisor) {
        self.take(job, advisor);
        while self.n_steps < MAX_BATCH_STEPS
            && let Ok(job) = jobs.try_recv()
        {
            self.take(job, advisor);
        }
    }

    /// Adds a question, unless nobody waits for its answer any more. Anything else is done after the questions that
    /// came before it.
    fn take(&mut self, job: Job, advisor: &mut Advisor) {
        match job {
            Job::Advise(_, reply) if reply.is_closed() => {}
            Job::Advise(question, reply) => {
                self.n_steps += question.queries.len();
                self.questions.push(question);
                self.replies.push(reply);
            }
            Job::Run(work) => {
                self.answer(advisor);
                work(advisor);
            }
        }
    }

    fn answer(&mut self, advisor: &mut Advisor) {
        if self.questions.is_empty() {
            return;
        }
        let answers = advisor.advise(&self.questions);
        self.questions.clear();
        self.n_steps = 0;
        for (reply, answer) in self.replies.drain(..).zip(answers) {
            // Whoever has gone asks again and gets the same verdicts.
            drop(reply.send(answer));
        }
    }
}

#[cfg(test)]
mod tests;
