//! The state that a worker keeps between slots: a world, the latest actor and the directory for logs.

use std::path::{Path, PathBuf};

use tandem_core::work::{EpisodeOrder, EpisodeStart, PublishedActor, RunTerms, SlotOrder};
use tandem_core::{Contacts, Episode, StepAdvice, StepQuery};
use tandem_policy::{Actor, actor_digest};
use tandem_proto::environment::{ResetReply, StepReply};
use tandem_sim::{Env, WorldConfig};
use tandem_telemetry::events::{EpisodeFinished, EpisodeRecorded};
use tokio::sync::{mpsc, oneshot};

use crate::determinism::{self, DeterminismCheck};
use crate::error::Error;
use crate::metrics::{Measured, WorkerMetrics};
use crate::ports::{Advisor, AdvisorGone, Environment, EnvironmentError, Simulator};
use crate::record::{log_name, metadata_of, record_episode};
use crate::rollout::{RolloutError, play_slot};

/// Plays slots, on a thread of its own.
pub(crate) struct Player {
    terms: RunTerms,
    /// The environments in this process; `None` if a server has them.
    simulator: Option<Simulator>,
    actor: Option<Actor>,
    /// The digest of the actor's parameters; empty without a directory for logs.
    actor_digest: String,
    log_dir: Option<PathBuf>,
    metrics: WorkerMetrics,
}

/// A slot that was played.
#[derive(Debug)]
pub(crate) struct PlayedSlot {
    pub(crate) episodes: Vec<Episode>,
    /// The result of playing the slot twice, if it was.
    pub(crate) check: Option<DeterminismCheck>,
}

impl Player {
    /// Creates a player that simulates its environments.
    pub(crate) fn simulating(
        terms: RunTerms,
        log_dir: Option<PathBuf>,
        metrics: WorkerMetrics,
    ) -> Result<Self, Error> {
        let Some(layout) = terms.layout.as_built_in() else {
            return Err(Error::NotBuiltIn { task: terms.layout.name().to_owned() });
        };
        let world = Env::new(layout, &WorldConfig::from(terms.world))?;
        let simulator = Some(Simulator::new(world));
        Ok(Self { simulator, ..Self::remote(terms, log_dir, metrics) })
    }

    /// Creates a player whose environments are on a server.
    pub(crate) const fn remote(
        terms: RunTerms,
        log_dir: Option<PathBuf>,
        metrics: WorkerMetrics,
    ) -> Self {
        Self { terms, simulator: None, actor: None, actor_digest: String::new(), log_dir, metrics }
    }

    pub(crate) const fn terms(&self) -> &RunTerms {
        &self.terms
    }

    /// Returns whether the loaded actor has `version`.
    pub(crate) fn has_version(&self, version: u64) -> bool {
        self.actor.as_ref().is_some_and(|actor| actor.version() == version)
    }

    /// Loads the actor for the following slots.
    pub(crate) fn load(&mut self, published: PublishedActor) -> Result<(), tandem_policy::Error> {
        let layout = &self.terms.layout;
        let for_digest = self.log_dir.is_some().then(|| published.clone());
        self.actor = Some(Actor::new(layout, published)?);
        self.actor_digest =
            for_digest.map_or_else(String::new, |published| actor_digest(layout, &published));
        Ok(())
    }

    /// Plays `order` with the loaded actor and writes the logs that it asks for.
    ///
    /// # Panics
    /// When no actor is loaded.
    pub(crate) fn play(
        &mut self,
        order: &SlotOrder,
        mut peers: PeerChannel,
    ) -> Result<PlayedSlot, RolloutError> {
        let actor = self.actor.as_mut().expect("parameters are loaded before a slot is played");
        let (terms, metrics, start) = (&self.terms, &self.metrics, self.metrics.now());
        let advisor = &mut Measured { port: &mut peers.clone(), metrics };
        let (episodes, check) = match &mut self.simulator {
            Some(port) => {
                let simulator = &mut Measured { port, metrics };
                (play_slot(simulator, order, terms, actor, advisor)?, None)
            }
            None => {
                let served = &mut Measured { port: &mut peers, metrics };
                let episodes = play_slot(served, order, terms, actor, advisor)?;
                let is_checked = determinism::is_checked(order);
                let check =
                    is_checked.then(|| determinism::check(&mut peers, order, terms, &episodes));
                (episodes, check.transpose()?)
            }
        };
        metrics.record_slot(start, &episodes);
        for (ordered, episode) in order.episodes.iter().zip(&episodes) {
            finished_event(episode).emit();
            if let Some(log_dir) = self.log_dir.as_deref().filter(|_| ordered.record) {
                self.record(*ordered, episode, log_dir);
            }
        }
        Ok(PlayedSlot { episodes, check })
    }

    /// Writes an episode's log. Failures are only logged: the episode itself is delivered.
    fn record(&self, order: EpisodeOrder, episode: &Episode, log_dir: &Path) {
        let path = log_dir.join(log_name(episode));
        let digest = self.actor_digest.clone();
        let metadata = metadata_of(order, episode, &self.terms, digest);
        match record_episode(&metadata, episode, &path) {
            Ok(path) => EpisodeRecorded { episode: episode.number, path: &path }.emit(),
            Err(error) => {
                let error: &dyn std::error::Error = &error;
                tracing::warn!(episode = episode.number, ?path, error, "episode not recorded");
            }
        }
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
    Advice(Vec<StepQuery>, oneshot::Sender<Vec<StepAdvice>>),
    /// The start of episodes on the server of the environments.
    Reset(Vec<EpisodeStart>, oneshot::Sender<ResetReply>),
    /// A step of its environments, actions of shape `[n, n_action]`.
    Step(Vec<f32>, oneshot::Sender<StepReply>),
}

/// The rollout's end of the channel to the teacher and to the server of the environments.
///
/// One request is pending at a time, so a capacity of one suffices and sending never waits.
#[derive(Debug, Clone)]
pub(crate) struct PeerChannel(mpsc::Sender<PeerRequest>);

impl PeerChannel {
    pub(crate) fn new() -> (Self, mpsc::Receiver<PeerRequest>) {
        let (sender, receiver) = mpsc::channel(1);
        (Self(sender), receiver)
    }

    /// Sends a request and waits for the response; `None` if the worker is stopping or the peer has failed.
    fn exchange<T>(&self, request: impl FnOnce(oneshot::Sender<T>) -> PeerRequest) -> Option<T> {
        let (sender, response) = oneshot::channel();
        self.0.blocking_send(request(sender)).ok()?;
        response.blocking_recv().ok()
    }
}

impl Advisor for PeerChannel {
    fn advise(&mut self, queries: Vec<StepQuery>) -> Result<Vec<StepAdvice>, AdvisorGone> {
        self.exchange(|response| PeerRequest::Advice(queries, response)).ok_or(AdvisorGone)
    }
}

impl Environment for PeerChannel {
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
}
