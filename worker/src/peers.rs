//! The learner and the teacher as a worker lives with them: whoever is away is waited for, for ever.

use tandem_core::work::{PublishedActor, RunTerms};
use tandem_core::{Episode, Layout, StepAdvice, StepQuery};

use crate::error::Error;
use crate::grpc::{CallError, Learner, Teacher, Work};
use crate::retry::{Attempt, Outage, Patience};
use crate::run::WorkerConfig;

const JOIN: Attempt = Attempt { peer: "learner", what: "join the run" };
const ASK: Attempt = Attempt { peer: "learner", what: "ask for work" };
const FETCH: Attempt = Attempt { peer: "learner", what: "fetch parameters" };
const DELIVER: Attempt = Attempt { peer: "learner", what: "deliver episodes" };
const ADVISE: Attempt = Attempt { peer: "teacher", what: "ask the teacher" };

/// A worker's learner and teacher. What is `None` is not known to the learner, as after a restart.
pub(crate) struct Peers {
    patience: Patience,
    learner: Learner,
    teacher: Option<Teacher>,
}

impl Peers {
    /// Peers at the addresses of `config`, which are connected to when first needed.
    pub(crate) fn new(config: &WorkerConfig, patience: Patience) -> Result<Self, Error> {
        let link = |role, address: &str| {
            config.dial.link(address).map_err(|source| Error::Address { role, source })
        };
        let learner = Learner::new(link("learner", &config.learner)?, patience);
        let teacher = match &config.teacher {
            Some(address) => Some(Teacher::new(link("teacher", address)?, patience)),
            None => None,
        };
        Ok(Self { patience, learner, teacher })
    }

    /// Announces the worker called `name`; gives its number and the run's terms.
    pub(crate) async fn join(&mut self, name: &str) -> Result<(u64, RunTerms), Error> {
        let mut outage = Outage::none(self.patience, JOIN);
        loop {
            let answer = self.learner.join(name).await;
            if let Some(joined) = outage.settle(answer).await {
                return joined.map_err(|error| protocol(JOIN, error));
            }
        }
    }

    /// What is to be done next, unless the worker is unknown.
    pub(crate) async fn next_work(&mut self, worker_id: u64) -> Result<Option<Work>, Error> {
        let mut outage = Outage::none(self.patience, ASK);
        loop {
            let answer = self.learner.next_work(worker_id).await;
            if let Some(work) = outage.settle(answer).await {
                return if_known(ASK, work);
            }
        }
    }

    /// The actor of `version`, unless the learner has it no longer.
    pub(crate) async fn parameters(
        &mut self,
        version: u64,
        layout: Layout,
    ) -> Result<Option<PublishedActor>, Error> {
        let mut outage = Outage::none(self.patience, FETCH);
        loop {
            let answer = self.learner.parameters(version, layout).await;
            if let Some(published) = outage.settle(answer).await {
                return if_known(FETCH, published);
            }
        }
    }

    /// Delivers a slot's episodes, unless the worker is unknown.
    pub(crate) async fn submit(
        &mut self,
        worker_id: u64,
        slot: u64,
        episodes: &[Episode],
    ) -> Result<Option<()>, Error> {
        let mut outage = Outage::none(self.patience, DELIVER);
        loop {
            let answer = self.learner.submit(worker_id, slot, episodes).await;
            if let Some(taken) = outage.settle(answer).await {
                return if_known(DELIVER, taken);
            }
        }
    }

    /// Whether there is a teacher to ask.
    pub(crate) const fn has_teacher(&self) -> bool {
        self.teacher.is_some()
    }

    /// The teacher's verdicts on `queries`, charged to `account`.
    pub(crate) async fn advise(
        &mut self,
        account: &str,
        layout: Layout,
        queries: &[StepQuery],
    ) -> Result<Vec<StepAdvice>, Error> {
        let no_teacher = || Error::NoTeacher { account: account.to_owned() };
        let teacher = self.teacher.as_mut().ok_or_else(no_teacher)?;
        let mut outage = Outage::none(self.patience, ADVISE);
        loop {
            let answer = match teacher.advise(account, layout, queries).await {
                // A teacher that has lost the account is away until the learner has opened it again.
                Err(CallError::Unknown(status)) => Err(CallError::Away(status)),
                answer => answer,
            };
            if let Some(advice) = outage.settle(answer).await {
                return advice.map_err(|error| protocol(ADVISE, error));
            }
        }
    }
}

fn if_known<T>(attempt: Attempt, answer: Result<T, CallError>) -> Result<Option<T>, Error> {
    match answer {
        Ok(answer) => Ok(Some(answer)),
        Err(CallError::Unknown(_)) => Ok(None),
        Err(error) => Err(protocol(attempt, error)),
    }
}

fn protocol(attempt: Attempt, error: CallError) -> Error {
    Error::Protocol { attempted: attempt.what, source: Box::new(error) }
}
