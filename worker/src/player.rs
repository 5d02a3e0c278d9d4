//! What a worker keeps between slots: a world, the latest actor and a place for logs.

use std::path::{Path, PathBuf};

use tandem_core::work::{EpisodeOrder, PublishedActor, RunTerms, SlotOrder};
use tandem_core::{Contacts, Episode, StepAdvice, StepQuery};
use tandem_policy::Actor;
use tandem_sim::{Env, SimError, WorldConfig};
use tandem_telemetry::events::{EpisodeFinished, EpisodeRecorded};
use tokio::sync::{mpsc, oneshot};

use crate::ports::{Advisor, AdvisorGone};
use crate::record::{log_name, metadata_of, record_episode};
use crate::rollout::{RolloutError, play_slot};

/// Plays slots on a thread of its own.
pub(crate) struct Player {
    terms: RunTerms,
    world: Env,
    actor: Option<Actor>,
    log_dir: Option<PathBuf>,
}

impl Player {
    pub(crate) fn new(terms: RunTerms, log_dir: Option<PathBuf>) -> Result<Self, SimError> {
        let world = Env::new(terms.layout, &WorldConfig::from(terms.world))?;
        Ok(Self { terms, world, actor: None, log_dir })
    }

    pub(crate) const fn terms(&self) -> &RunTerms {
        &self.terms
    }

    /// Whether the actor in hand is of `version`.
    pub(crate) fn has_version(&self, version: u64) -> bool {
        self.actor.as_ref().is_some_and(|actor| actor.version() == version)
    }

    /// Acts with `published` from now on.
    pub(crate) fn load(&mut self, published: PublishedActor) -> Result<(), tandem_policy::Error> {
        self.actor = Some(Actor::new(self.terms.layout, published)?);
        Ok(())
    }

    /// Plays `order` with the actor in hand and writes the logs that it asks for.
    ///
    /// # Panics
    /// When no actor was loaded.
    pub(crate) fn play(
        &mut self,
        order: &SlotOrder,
        mut questions: Questions,
    ) -> Result<Vec<Episode>, RolloutError> {
        let actor = self.actor.as_mut().expect("parameters are loaded before a slot is played");
        let episodes = play_slot(&self.world, order, &self.terms, actor, &mut questions)?;
        for (ordered, episode) in order.episodes.iter().zip(&episodes) {
            finished_event(episode).emit();
            if let Some(log_dir) = self.log_dir.as_deref().filter(|_| ordered.record) {
                self.record(*ordered, episode, log_dir);
            }
        }
        Ok(episodes)
    }

    /// Writes an episode's log. A log that cannot be written is no reason to lose the episode.
    fn record(&self, order: EpisodeOrder, episode: &Episode, log_dir: &Path) {
        let path = log_dir.join(log_name(episode));
        match record_episode(&metadata_of(order, episode, &self.terms), episode, &path) {
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

/// A question to the teacher on its way from the rollout's thread to the sockets.
#[derive(Debug)]
pub(crate) struct Question {
    pub(crate) queries: Vec<StepQuery>,
    pub(crate) answer: oneshot::Sender<Vec<StepAdvice>>,
}

/// The rollout's end of the way to the teacher.
///
/// There is one question at a time, so room for one is enough and nobody waits for it.
#[derive(Debug)]
pub(crate) struct Questions(mpsc::Sender<Question>);

impl Questions {
    pub(crate) fn channel() -> (Self, mpsc::Receiver<Question>) {
        let (sender, receiver) = mpsc::channel(1);
        (Self(sender), receiver)
    }
}

impl Advisor for Questions {
    fn advise(&mut self, queries: Vec<StepQuery>) -> Result<Vec<StepAdvice>, AdvisorGone> {
        let (answer, answered) = oneshot::channel();
        self.0.blocking_send(Question { queries, answer }).map_err(|_unsent| AdvisorGone)?;
        answered.blocking_recv().map_err(|_closed| AdvisorGone)
    }
}
