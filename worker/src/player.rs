//! The state that a worker keeps between slots: a world, the latest actor and the directory for logs.

use tandem_core::scene::Scene;
use tandem_core::work::{EpisodeOrder, EpisodeStart, PublishedActor, RunTerms, SlotOrder};
use tandem_core::{Contacts, Episode, EpisodeKind, StepAdvice, StepQuery};
use tandem_policy::{Actor, actor_digest, symmetrized_actor};
use tandem_proto::environment::{ResetReply, StepReply};
use tandem_sim::{Env, WorldConfig};
use tandem_telemetry::events::EpisodeFinished;
use tokio::sync::{mpsc, oneshot};

use crate::determinism::{self, DeterminismCheck};
use crate::error::Error;
use crate::metrics::{Measured, WorkerMetrics};
use crate::ports::{Advisor, AdvisorGone, EnvironmentError, Simulator, VectorEnv};
use crate::record::metadata_of;
use crate::recorder::{Recorder, Recording};
use crate::rollout::{RolloutError, Tracing, play_traced_slot};
use crate::trace::Trace;

/// Plays slots, on a thread of its own.
pub(crate) struct Player {
    terms: RunTerms,
    /// The environments in this process; `None` if a server has them.
    simulator: Option<Simulator>,
    actor: Option<Actor>,
    /// Whether the actor is the symmetrised one of evaluation episodes.
    is_symmetrized: bool,
    /// The digest of the actor's parameters; empty without a recorder.
    actor_digest: String,
    recorder: Option<Recorder>,
    metrics: WorkerMetrics,
}

/// A slot that was played.
#[derive(Debug)]
pub(crate) struct PlayedSlot {
    pub(crate) episodes: Vec<Episode>,
    /// The result of playing the slot twice, if it was.
    pub(crate) check: Option<DeterminismCheck>,
    /// The failures of the server before the slot was played.
    pub(crate) failures: Failures,
}

/// Failures of a server; attempts that follow a failure before a slot is played belong to it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Failures {
    /// Their number.
    pub(crate) n: u32,
    /// The server and the cause of the latest one, on one line; empty if there is none.
    pub(crate) latest: String,
}

impl Player {
    /// Creates a player that simulates its environments.
    pub(crate) fn simulating(
        terms: RunTerms,
        recorder: Option<Recorder>,
        metrics: WorkerMetrics,
    ) -> Result<Self, Error> {
        let Some(layout) = terms.task.as_built_in() else {
            return Err(Error::NotBuiltIn { task: terms.task.name().to_owned() });
        };
        let world = Env::new(layout, &WorldConfig::from(terms.world))?;
        let simulator = Some(Simulator::new(world));
        Ok(Self { simulator, ..Self::remote(terms, recorder, metrics) })
    }

    /// Creates a player whose environments are on a server.
    pub(crate) const fn remote(
        terms: RunTerms,
        recorder: Option<Recorder>,
        metrics: WorkerMetrics,
    ) -> Self {
        Self {
            terms,
            simulator: None,
            actor: None,
            is_symmetrized: false,
            actor_digest: String::new(),
            recorder,
            metrics,
        }
    }

    pub(crate) const fn terms(&self) -> &RunTerms {
        &self.terms
    }

    /// Returns true if the loaded actor is the one that plays `order`.
    pub(crate) fn has_actor_of(&self, order: &SlotOrder) -> bool {
        let has_version =
            self.actor.as_ref().is_some_and(|actor| actor.version() == order.parameter_version);
        has_version && self.is_symmetrized == self.symmetrizes(order.kind)
    }

    fn symmetrizes(&self, kind: EpisodeKind) -> bool {
        self.terms.symmetrized_evaluation && kind == EpisodeKind::Evaluation
    }

    /// Loads the actor for slots with episodes of `kind`.
    pub(crate) fn load(
        &mut self,
        published: PublishedActor,
        kind: EpisodeKind,
    ) -> Result<(), tandem_policy::Error> {
        let task = &self.terms.task;
        self.is_symmetrized = self.symmetrizes(kind);
        let published =
            if self.is_symmetrized { symmetrized_actor(task, &published) } else { published };
        let for_digest = self.recorder.is_some().then(|| published.clone());
        self.actor = Some(Actor::new(task, published)?);
        self.actor_digest =
            for_digest.map_or_else(String::new, |published| actor_digest(task, &published));
        Ok(())
    }

    /// Plays `order` with the loaded actor and has the logs written that it asks for.
    ///
    /// # Panics
    /// When no actor is loaded.
    pub(crate) fn play(
        &mut self,
        order: &SlotOrder,
        peers: PeerChannel,
    ) -> Result<PlayedSlot, RolloutError> {
        let metrics = self.metrics.clone();
        let peers = peers.with_metrics(metrics.clone());
        metrics.computing(|| self.play_with(order, peers))
    }

    fn play_with(
        &mut self,
        order: &SlotOrder,
        mut peers: PeerChannel,
    ) -> Result<PlayedSlot, RolloutError> {
        let tracing = self.tracing(order.kind);
        let actor = self.actor.as_mut().expect("parameters are loaded before a slot is played");
        let (terms, metrics, start) = (&self.terms, &self.metrics, self.metrics.now());
        let advisor = &mut Measured { port: &mut peers.clone(), metrics };
        let played = match &mut self.simulator {
            Some(port) => {
                let simulator = &mut Measured { port, metrics };
                play_traced_slot(simulator, order, terms, actor, advisor, tracing)?
            }
            None => {
                let served = &mut Measured { port: &mut peers, metrics };
                play_traced_slot(served, order, terms, actor, advisor, tracing)?
            }
        };
        let (episodes, traces): (Vec<Episode>, Vec<Option<Trace>>) = played.into_iter().unzip();
        let check = match self.simulator {
            None if determinism::is_checked(order) => {
                Some(determinism::check(&mut peers, order, terms, &episodes)?)
            }
            _ => None,
        };
        metrics.record_slot(start, &episodes);
        for ((ordered, episode), trace) in order.episodes.iter().zip(&episodes).zip(traces) {
            finished_event(episode).emit();
            self.record(*ordered, episode, trace);
        }
        Ok(PlayedSlot { episodes, check, failures: Failures::default() })
    }

    /// Returns the tracing of episodes of `kind`: on for training episodes that are recorded. Evaluation episodes are
    /// simulated again instead.
    fn tracing(&self, kind: EpisodeKind) -> Tracing {
        let records_training = self.recorder.as_ref().is_some_and(Recorder::records_training);
        match kind {
            EpisodeKind::Training if records_training => Tracing::On,
            _ => Tracing::Off,
        }
    }

    /// Passes an episode to the recorder, if its order asks for a log or it has a trace.
    fn record(&self, order: EpisodeOrder, episode: &Episode, trace: Option<Trace>) {
        let Some(recorder) = &self.recorder else { return };
        if !order.record && trace.is_none() {
            return;
        }
        let metadata = metadata_of(order, episode, &self.terms, self.actor_digest.clone());
        let is_training = trace.is_some();
        let recording = Recording { metadata, episode: episode.clone(), trace };
        if is_training { recorder.try_record(recording) } else { recorder.record(recording) }
    }
}

fn finished_event(episode: &Episode) -> EpisodeFinished {
    EpisodeFinished {
        episode: episode.number,
        parameter_version: episode.parameter_version,
        success: episode.succeeded(),
        advice_charged: episode.advice_charged,
        contact_steps: episode
            .contacts
            .iter()
            .copied()
            .filter(|contacts: &Contacts| contacts.any())
            .count(),
    }
}

/// A request on its way from the rollout's thread to the runtime.
#[derive(Debug)]
pub(crate) enum PeerRequest {
    /// A request for advice.
    Advice(Vec<StepQuery>, oneshot::Sender<AdviceReply>),
    /// The start of episodes on the server of the environments.
    Reset(Vec<EpisodeStart>, oneshot::Sender<ResetReply>),
    /// A step of its environments, actions of shape `[n, n_action]`.
    Step(Vec<f32>, oneshot::Sender<StepReply>),
}

/// The teacher's response to a request for advice.
#[derive(Debug)]
pub(crate) struct AdviceReply {
    pub(crate) steps: Vec<StepAdvice>,
    /// Units of the budget that are left.
    pub(crate) budget_left: u64,
}

/// The rollout's end of the channel to the teacher and to the server of the environments.
///
/// One request is pending at a time, so a capacity of one suffices and sending never waits.
#[derive(Debug, Clone)]
pub(crate) struct PeerChannel {
    requests: mpsc::Sender<PeerRequest>,
    /// Units of the budget that were left after the latest advice.
    budget_left: Option<u64>,
    /// The metrics that the waiting for responses is reported to, if any.
    metrics: Option<WorkerMetrics>,
}

impl PeerChannel {
    pub(crate) fn new() -> (Self, mpsc::Receiver<PeerRequest>) {
        let (sender, receiver) = mpsc::channel(1);
        (Self { requests: sender, budget_left: None, metrics: None }, receiver)
    }

    /// Reports the waiting for responses to `metrics`.
    pub(crate) fn with_metrics(mut self, metrics: WorkerMetrics) -> Self {
        self.metrics = Some(metrics);
        self
    }

    /// Sends a request and waits for the response; `None` if the worker is stopping or the peer has failed.
    fn exchange<T>(&self, request: impl FnOnce(oneshot::Sender<T>) -> PeerRequest) -> Option<T> {
        let (sender, response) = oneshot::channel();
        let exchange = || {
            self.requests.blocking_send(request(sender)).ok()?;
            response.blocking_recv().ok()
        };
        match &self.metrics {
            Some(metrics) => metrics.waiting(exchange),
            None => exchange(),
        }
    }
}

impl Advisor for PeerChannel {
    fn advise(&mut self, queries: Vec<StepQuery>) -> Result<Vec<StepAdvice>, AdvisorGone> {
        let reply = self.exchange(|response| PeerRequest::Advice(queries, response));
        let reply = reply.ok_or(AdvisorGone)?;
        self.budget_left = Some(reply.budget_left);
        Ok(reply.steps)
    }

    fn budget_left(&self) -> Option<u64> {
        self.budget_left
    }
}

impl VectorEnv for PeerChannel {
    fn reset(
        &mut self,
        starts: &[EpisodeStart],
        observations: &mut [f32],
        goals: &mut [f32],
    ) -> Result<(), EnvironmentError> {
        let reply = self.exchange(|response| PeerRequest::Reset(starts.to_vec(), response));
        let reply = reply.ok_or(EnvironmentError::Gone)?;
        observations.copy_from_slice(&reply.observations);
        goals.copy_from_slice(&reply.goals);
        Ok(())
    }

    fn step(
        &mut self,
        actions: &[f32],
        observations: &mut [f32],
        contacts: &mut [Contacts],
    ) -> Result<(), EnvironmentError> {
        let reply = self.exchange(|response| PeerRequest::Step(actions.to_vec(), response));
        let reply = reply.ok_or(EnvironmentError::Gone)?;
        observations.copy_from_slice(&reply.observations);
        contacts.copy_from_slice(&reply.contacts);
        Ok(())
    }

    fn scene(&self, _environment: usize) -> Option<Scene> {
        None
    }
}
