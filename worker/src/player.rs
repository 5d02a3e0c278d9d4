//! The state that a worker keeps between slots: a world, the latest actor and the directory for logs.

use std::path::{Path, PathBuf};

use tandem_core::work::{EpisodeOrder, PublishedActor, RunTerms, SlotOrder};
use tandem_core::{Contacts, Episode, StepAdvice, StepQuery};
use tandem_policy::{Actor, actor_digest};
use tandem_sim::{Env, SimError, WorldConfig};
use tandem_telemetry::events::{EpisodeFinished, EpisodeRecorded};
use tokio::sync::{mpsc, oneshot};

use crate::ports::{Advisor, AdvisorGone};
use crate::record::{log_name, metadata_of, record_episode};
use crate::rollout::{RolloutError, play_slot};

/// Plays slots, on a thread of its own.
pub(crate) struct Player {
    terms: RunTerms,
    world: Env,
    actor: Option<Actor>,
    /// The digest of the actor's parameters; empty without a directory for logs.
    actor_digest: String,
    log_dir: Option<PathBuf>,
}

impl Player {
    pub(crate) fn new(terms: RunTerms, log_dir: Option<PathBuf>) -> Result<Self, SimError> {
        let world = Env::new(terms.layout, &WorldConfig::from(terms.world))?;
        Ok(Self { terms, world, actor: None, actor_digest: String::new(), log_dir })
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
        let layout = self.terms.layout;
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
        mut advisor: AdviceChannel,
    ) -> Result<Vec<Episode>, RolloutError> {
        let actor = self.actor.as_mut().expect("parameters are loaded before a slot is played");
        let episodes = play_slot(&self.world, order, &self.terms, actor, &mut advisor)?;
        for (ordered, episode) in order.episodes.iter().zip(&episodes) {
            finished_event(episode).emit();
            if let Some(log_dir) = self.log_dir.as_deref().filter(|_| ordered.record) {
                self.record(*ordered, episode, log_dir);
            }
        }
        Ok(episodes)
    }

    /// Writes an episode's log. Failures are only logged: the episode itself is delivered.
    fn record(&self, order: EpisodeOrder, episode: &Episode, log_dir: &Path) {
        let path = log_dir.join(log_name(episode));
        let metadata = metadata_of(order, episode, &self.terms, self.actor_digest.clone());
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

/// A request for advice on its way from the rollout's thread to the runtime.
#[derive(Debug)]
pub(crate) struct PendingAdvice {
    pub(crate) queries: Vec<StepQuery>,
    pub(crate) response: oneshot::Sender<Vec<StepAdvice>>,
}

/// The rollout's end of the channel to the teacher.
///
/// One request is pending at a time, so a capacity of one suffices and sending never waits.
#[derive(Debug)]
pub(crate) struct AdviceChannel(mpsc::Sender<PendingAdvice>);

impl AdviceChannel {
    pub(crate) fn new() -> (Self, mpsc::Receiver<PendingAdvice>) {
        let (sender, receiver) = mpsc::channel(1);
        (Self(sender), receiver)
    }
}

impl Advisor for AdviceChannel {
    fn advise(&mut self, queries: Vec<StepQuery>) -> Result<Vec<StepAdvice>, AdvisorGone> {
        let (response, advice) = oneshot::channel();
        self.0.blocking_send(PendingAdvice { queries, response }).map_err(|_unsent| AdvisorGone)?;
        advice.blocking_recv().map_err(|_closed| AdvisorGone)
    }
}
