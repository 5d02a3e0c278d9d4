//! A learner with a few slots, which fails at configured calls.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Mutex, MutexGuard};

use tandem_core::work::{RunTerms, SlotOrder};
use tandem_core::{Episode, EpisodeKind};
use tandem_proto::pb;
use tokio::sync::mpsc;
use tonic::{Request, Response, Status};

use super::{actor, terms};

/// The calls that can fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Call {
    Join,
    NextWork,
    GetParameters,
    Submit,
}

/// The failure of a call.
#[derive(Debug, Clone)]
pub(crate) enum Fault {
    /// The call has no effect and returns this status.
    Answer(Status),
    /// The call takes effect, but its response is lost.
    AnswerLost,
    /// The learner forgets its workers and their slots.
    WorkersForgotten,
    /// The learner is stopped before the end of the run, and another one continues the run.
    Stopped,
    /// The call never returns.
    Hang(mpsc::Sender<()>),
}

pub(crate) struct FakeLearner {
    terms: RunTerms,
    state: Mutex<State>,
    fault: Option<(Call, usize, Fault)>,
}

struct State {
    waiting: VecDeque<SlotOrder>,
    out: BTreeMap<u64, SlotOrder>,
    workers: BTreeSet<u64>,
    n_joined: u64,
    is_stopping: bool,
    n_calls: BTreeMap<Call, usize>,
    episodes: BTreeMap<(bool, u64), Episode>,
    checks: Vec<(u32, String)>,
    failures: Vec<(u32, String)>,
}

impl State {
    fn forget_workers(&mut self) {
        self.workers.clear();
        let out = std::mem::take(&mut self.out);
        self.waiting.extend(out.into_values());
    }

    fn check_known(&self, worker_id: u64) -> Result<(), Status> {
        let known = self.workers.contains(&worker_id);
        if known { Ok(()) } else { Err(Status::not_found(format!("no worker {worker_id}"))) }
    }
}

impl FakeLearner {
    pub(crate) fn new(orders: Vec<SlotOrder>) -> Self {
        let state = State {
            waiting: orders.into(),
            out: BTreeMap::new(),
            workers: BTreeSet::new(),
            n_joined: 0,
            is_stopping: false,
            n_calls: BTreeMap::new(),
            episodes: BTreeMap::new(),
            checks: Vec::new(),
            failures: Vec::new(),
        };
        Self { terms: terms(), state: Mutex::new(state), fault: None }
    }

    pub(crate) fn with_terms(self, terms: RunTerms) -> Self {
        Self { terms, ..self }
    }

    /// Adds a fault to the `nth` call of a kind, counted from 0.
    pub(crate) fn with_fault(self, call: Call, nth: usize, fault: Fault) -> Self {
        Self { fault: Some((call, nth, fault)), ..self }
    }

    /// Leaves one call without a response. The receiver gets a message when the call arrives.
    pub(crate) fn hanging_at(self, call: Call, nth: usize) -> (Self, mpsc::Receiver<()>) {
        let (reached, at_fault) = mpsc::channel(1);
        (self.with_fault(call, nth, Fault::Hang(reached)), at_fault)
    }

    pub(crate) fn forget_workers(&self) {
        self.state().forget_workers();
    }

    pub(crate) fn n_calls(&self, call: Call) -> usize {
        self.state().n_calls.get(&call).copied().unwrap_or(0)
    }

    /// Returns the delivered episodes, by whether they are evaluations and by number.
    pub(crate) fn episodes(&self) -> BTreeMap<(bool, u64), Episode> {
        self.state().episodes.clone()
    }

    /// Returns the delivered checks of environments: the number of episodes and the difference.
    pub(crate) fn checks(&self) -> Vec<(u32, String)> {
        self.state().checks.clone()
    }

    /// Returns the delivered failures of environments: their number and the latest one.
    pub(crate) fn failures(&self) -> Vec<(u32, String)> {
        self.state().failures.clone()
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("no handler panics")
    }

    /// Counts a call and applies its fault; returns whether the response is to be lost.
    async fn arrive(&self, call: Call) -> Result<bool, Status> {
        let nth = {
            let mut state = self.state();
            let n_calls = state.n_calls.entry(call).or_default();
            *n_calls += 1;
            *n_calls - 1
        };
        let fault = self.fault.as_ref().filter(|(at, at_nth, _)| (*at, *at_nth) == (call, nth));
        match fault.map(|(_, _, fault)| fault) {
            None => Ok(false),
            Some(Fault::Answer(status)) => Err(status.clone()),
            Some(Fault::AnswerLost) => Ok(true),
            Some(Fault::WorkersForgotten) => {
                self.forget_workers();
                Ok(false)
            }
            Some(Fault::Stopped) => {
                self.forget_workers();
                self.state().is_stopping = true;
                Ok(false)
            }
            Some(Fault::Hang(reached)) => {
                reached.send(()).await.expect("the test waits for it");
                std::future::pending().await
            }
        }
    }
}

#[tonic::async_trait]
impl pb::learner_server::Learner for FakeLearner {
    async fn join(
        &self,
        _request: Request<pb::JoinRequest>,
    ) -> Result<Response<pb::JoinResponse>, Status> {
        self.arrive(Call::Join).await?;
        let mut state = self.state();
        state.n_joined += 1;
        let worker_id = state.n_joined;
        state.workers.insert(worker_id);
        Ok(Response::new(pb::JoinResponse {
            worker_id,
            terms: Some(tandem_proto::encode_run_terms(&self.terms)),
            learner: 1,
        }))
    }

    async fn next_work(
        &self,
        request: Request<pb::NextWorkRequest>,
    ) -> Result<Response<pb::NextWorkResponse>, Status> {
        use pb::next_work_response::Work;
        self.arrive(Call::NextWork).await?;
        let mut state = self.state();
        if std::mem::take(&mut state.is_stopping) {
            let finished = pb::Finished { reason: "interrupted".to_owned(), interrupted: true };
            return Ok(Response::new(pb::NextWorkResponse {
                work: Some(Work::Finished(finished)),
            }));
        }
        state.check_known(request.into_inner().worker_id)?;
        let work = match state.waiting.pop_front().or_else(|| state.out.values().next().cloned()) {
            Some(order) => {
                state.out.insert(order.slot, order.clone());
                Work::Slot(tandem_proto::encode_slot(&order))
            }
            None => {
                let reason = "all slots are in".to_owned();
                Work::Finished(pb::Finished { reason, interrupted: false })
            }
        };
        Ok(Response::new(pb::NextWorkResponse { work: Some(work) }))
    }

    async fn get_parameters(
        &self,
        request: Request<pb::GetParametersRequest>,
    ) -> Result<Response<pb::Parameters>, Status> {
        self.arrive(Call::GetParameters).await?;
        Ok(Response::new(tandem_proto::encode_actor(&actor(request.into_inner().version))))
    }

    async fn submit_episodes(
        &self,
        request: Request<pb::SubmitEpisodesRequest>,
    ) -> Result<Response<pb::SubmitEpisodesResponse>, Status> {
        let answer_lost = self.arrive(Call::Submit).await?;
        let request = request.into_inner();
        let mut state = self.state();
        state.check_known(request.worker_id)?;
        if state.out.remove(&request.slot).is_some() {
            if let Some(check) = request.environment_check {
                if check.n_episodes > 0 {
                    state.checks.push((check.n_episodes, check.difference));
                }
                if check.failures > 0 {
                    state.failures.push((check.failures, check.failure));
                }
            }
            for message in request.episodes {
                let episode = tandem_proto::decode_episode(message, &self.terms.task)?;
                let key = (episode.kind == EpisodeKind::Evaluation, episode.number);
                assert!(state.episodes.insert(key, episode).is_none(), "delivered twice: {key:?}");
            }
        }
        if answer_lost {
            Err(Status::unavailable("lost"))
        } else {
            Ok(Response::new(pb::SubmitEpisodesResponse {}))
        }
    }

    async fn status(
        &self,
        _request: Request<pb::StatusRequest>,
    ) -> Result<Response<pb::Progress>, Status> {
        Err(Status::unimplemented("not needed here"))
    }

    type WatchStream = tokio_stream::Empty<Result<pb::Progress, Status>>;

    async fn watch(
        &self,
        _request: Request<pb::WatchRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        Err(Status::unimplemented("not needed here"))
    }
}
