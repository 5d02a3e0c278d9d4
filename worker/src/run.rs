//! A worker's life: join, take a slot, play it, deliver it, until the run has ended.

use std::path::PathBuf;

use tandem_core::Episode;
use tandem_core::work::SlotOrder;
use tandem_net::{Dial, Pacing};
use tokio::sync::oneshot;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use crate::error::Error;
use crate::grpc::Work;
use crate::peers::Peers;
use crate::player::{Player, Questions};
use crate::retry::Patience;

/// Where a worker works.
#[derive(Debug, Clone)]
pub struct WorkerConfig {
    /// How learner and teacher are called.
    pub dial: Dial,
    /// The learner's address, `HOST:PORT` or a URI.
    pub learner: String,
    /// The teacher's address; needed when the run has one.
    pub teacher: Option<String>,
    /// A label for people; two workers may share one.
    pub name: String,
    /// Where logs of recorded episodes go, made if need be; without it none are written.
    pub log_dir: Option<PathBuf>,
    /// How sockets and rollouts take turns.
    pub pacing: Pacing,
}

/// Plays slots for a learner until the run has ended or `shutdown` is cancelled; a slot in hand is then delivered
/// first, if that takes a few seconds at most.
///
/// A learner or teacher that cannot be reached is waited for, for ever, and so is a learner that was stopped before the
/// run's end. Rollouts run on a thread of their own; a
/// current-thread runtime with time and IO enabled is enough.
///
/// # Errors
/// When something is wrong that waiting does not mend.
pub async fn run(config: WorkerConfig, shutdown: CancellationToken) -> Result<(), Error> {
    run_with(config, Patience::default(), shutdown).await
}

/// [`run`] with other waiting times.
///
/// # Errors
/// When something is wrong that waiting does not mend.
pub async fn run_with(
    config: WorkerConfig,
    patience: Patience,
    shutdown: CancellationToken,
) -> Result<(), Error> {
    if let Some(path) = &config.log_dir {
        std::fs::create_dir_all(path)
            .map_err(|source| Error::LogDir { path: path.clone(), source })?;
    }
    let rollouts = TaskTracker::new();
    let (peers, pacing) = (Peers::new(&config, patience)?, config.pacing);
    let mut worker = Worker { config, patience, peers, rollouts: rollouts.clone() };
    let drained = async {
        shutdown.cancelled().await;
        tokio::time::sleep(patience.drain).await;
    };
    let outcome = tokio::select! {
        outcome = worker.work(&shutdown) => outcome,
        () = drained => Ok(()),
    };
    rollouts.close();
    pacing.next(rollouts.wait()).await;
    outcome
}

/// A worker and its peers.
struct Worker {
    config: WorkerConfig,
    patience: Patience,
    peers: Peers,
    rollouts: TaskTracker,
}

/// What a learner that has been joined gives.
struct Membership {
    worker_id: u64,
    /// Boxed: a world is large to carry through futures.
    player: Box<Player>,
}

impl Worker {
    /// Works until the run has ended; once `shutdown` is cancelled no new slot is begun.
    async fn work(&mut self, shutdown: &CancellationToken) -> Result<(), Error> {
        let mut membership = None;
        loop {
            let slot = tokio::select! {
                biased;
                () = shutdown.cancelled() => return Ok(()),
                slot = self.next_slot(membership) => slot?,
            };
            let Some((member, order)) = slot else { return Ok(()) };
            membership = self.serve(member, order).await?;
        }
    }

    /// Waits for a slot, joining first where that is needed; `None` when the run has ended.
    async fn next_slot(
        &mut self,
        mut membership: Option<Membership>,
    ) -> Result<Option<(Membership, SlotOrder)>, Error> {
        loop {
            let member = match membership {
                Some(member) => member,
                None => self.join().await?,
            };
            membership = match self.peers.next_work(member.worker_id).await? {
                Some(Work::Slot(order)) => return Ok(Some((member, order))),
                Some(Work::Finished(reason)) => {
                    tracing::info!(reason, "run ended");
                    return Ok(None);
                }
                Some(Work::Interrupted(reason)) => {
                    tracing::warn!(reason, "learner stopped before the run's end, waiting for it");
                    tokio::time::sleep(self.patience.longest_pause).await;
                    None
                }
                Some(Work::Wait) => Some(member),
                None => {
                    tracing::warn!(
                        worker_id = member.worker_id,
                        "unknown to the learner, joining again"
                    );
                    None
                }
            };
            tokio::time::sleep(self.patience.first_pause).await;
        }
    }

    async fn join(&mut self) -> Result<Membership, Error> {
        let (worker_id, terms) = self.peers.join(&self.config.name).await?;
        if let Some(account) = terms.account.as_ref().filter(|_| !self.peers.has_teacher()) {
            return Err(Error::NoTeacher { account: account.clone() });
        }
        tracing::info!(worker_id, task = %terms.layout.task, n_arms = terms.layout.n_arms, "run joined");
        Ok(Membership {
            worker_id,
            player: Box::new(Player::new(terms, self.config.log_dir.clone())?),
        })
    }

    /// Plays a slot and delivers it. The membership is gone when the learner no longer knows the worker.
    async fn serve(
        &mut self,
        mut member: Membership,
        order: SlotOrder,
    ) -> Result<Option<Membership>, Error> {
        let (worker_id, slot) = (member.worker_id, order.slot);
        if !self.fetch_parameters(&mut member.player, order.parameter_version).await? {
            tracing::warn!(
                slot,
                version = order.parameter_version,
                "parameters gone, asking for other work"
            );
            tokio::time::sleep(self.patience.first_pause).await;
            return Ok(Some(member));
        }
        let (player, episodes) = self.play(member.player, order).await?;
        let taken = self.peers.submit(worker_id, slot, &episodes).await?;
        if taken.is_none() {
            // A learner that has forgotten the worker has forgotten what it plays: these episodes are ordered again.
            tracing::warn!(worker_id, slot, "unknown to the learner, joining again");
        }
        Ok(taken.map(|()| Membership { worker_id, player }))
    }

    /// Sees to it that the player acts with `version`; gives false when the learner no longer has it.
    async fn fetch_parameters(&mut self, player: &mut Player, version: u64) -> Result<bool, Error> {
        if player.has_version(version) {
            return Ok(true);
        }
        let Some(published) = self.peers.parameters(version, player.terms().layout).await? else {
            return Ok(false);
        };
        player.load(published).map_err(|source| Error::Parameters { version, source })?;
        Ok(true)
    }

    /// Plays a slot on a thread of its own, passing its questions on to the teacher.
    async fn play(
        &mut self,
        mut player: Box<Player>,
        order: SlotOrder,
    ) -> Result<(Box<Player>, Vec<Episode>), Error> {
        let slot = order.slot;
        let (account, layout) = (player.terms().account.clone(), player.terms().layout);
        let (questions, mut asked) = Questions::channel();
        let (finished, playing) = oneshot::channel();
        let counted = self.rollouts.token();
        let rollout = std::thread::Builder::new().name("rollout".to_owned());
        rollout
            .spawn(move || {
                let _counted = counted;
                let episodes = player.play(&order, questions);
                // Nobody waits for the episodes any more when the worker has ended meanwhile.
                drop(finished.send((player, episodes)));
            })
            .map_err(Error::Thread)?;
        // Ends when the player has dropped its end, played to the end or not.
        while let Some(question) = self.config.pacing.next(asked.recv()).await {
            let account = account.as_deref().ok_or(Error::NoAccount { slot })?;
            let advice = self.peers.advise(account, layout, &question.queries).await?;
            if question.answer.send(advice).is_err() {
                break;
            }
        }
        let (player, episodes) = self.config.pacing.next(playing).await?;
        Ok((player, episodes.map_err(|source| Error::Rollout { slot, source })?))
    }
}
