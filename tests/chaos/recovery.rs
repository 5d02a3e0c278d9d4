//! Recovery times of killed processes.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use tandem_proto::pb;
use tandem_proto::pb::learner_client::LearnerClient;
use tandem_proto::pb::teacher_client::TeacherClient;
use tokio::task::AbortHandle;
use tonic::transport::Channel;

use crate::cluster::now;
use crate::schedule::{Fault, Target};

const ASK_EVERY: Duration = Duration::from_millis(20);

/// One recovery.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Recovery {
    pub(crate) who: Target,
    /// Time from the restart to the first answer, or to a worker's first delivery.
    pub(crate) took: Duration,
}

/// The completed and active measurements of a run.
#[derive(Debug, Default)]
pub(crate) struct Recoveries {
    done: Arc<Mutex<Vec<Recovery>>>,
    under_way: BTreeMap<Target, AbortHandle>,
}

impl Recoveries {
    /// Discards the measurement of the process that a fault hits.
    pub(crate) fn disturbed_by(&mut self, fault: Fault) {
        self.under_way.retain(|who, measurement| {
            let is_target = matches!(fault, Fault::Kill(hit) | Fault::Stop(hit, _) if hit == *who);
            if is_target {
                measurement.abort();
            }
            !is_target
        });
    }

    /// Measures until the teacher answers.
    pub(crate) fn teacher(&mut self, teacher: TeacherClient<Channel>) {
        self.measure(Target::Teacher, move || {
            let mut teacher = teacher.clone();
            async move { teacher.describe(pb::DescribeRequest {}).await.is_ok() }
        });
    }

    /// Measures until the learner answers.
    pub(crate) fn learner(&mut self, learner: LearnerClient<Channel>) {
        self.measure(Target::Learner, move || {
            let mut learner = learner.clone();
            async move { learner.status(pb::StatusRequest {}).await.is_ok() }
        });
    }

    /// Measures until the worker called `name` has delivered episodes.
    pub(crate) fn worker(&mut self, idx: usize, name: String, learner: LearnerClient<Channel>) {
        self.measure(Target::Worker(idx), move || {
            let (mut learner, name) = (learner.clone(), name.clone());
            async move {
                let Ok(progress) = learner.status(pb::StatusRequest {}).await else { return false };
                let workers = progress.into_inner().workers;
                workers.iter().any(|worker| worker.name == name && worker.episodes > 0)
            }
        });
    }

    /// Returns the measurements.
    pub(crate) fn take(self) -> Vec<Recovery> {
        self.under_way.into_values().for_each(|measurement| measurement.abort());
        std::mem::take(&mut *self.done.lock().expect("not poisoned"))
    }

    fn measure<F>(&mut self, who: Target, is_back: impl Fn() -> F + Send + 'static)
    where
        F: Future<Output = bool> + Send,
    {
        let (done, started): (_, Instant) = (self.done.clone(), now());
        let measurement = tokio::spawn(async move {
            while !is_back().await {
                tokio::time::sleep(ASK_EVERY).await;
            }
            let recovery = Recovery { who, took: started.elapsed() };
            done.lock().expect("not poisoned").push(recovery);
        });
        self.under_way.insert(who, measurement.abort_handle());
    }
}
