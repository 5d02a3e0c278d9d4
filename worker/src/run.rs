//! The worker's main loop: join the run, then take, play and deliver slots until the run has ended.

use tandem_core::Episode;
use tandem_core::work::SlotOrder;
use tokio::sync::oneshot;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use crate::config::{Timeouts, WorkerConfig};
use crate::error::Error;
use crate::learner::{Learner, Work};
use crate::player::{AdviceChannel, Player};
use crate::teacher::Teacher;

/// Plays slots for a learner until the run has ended or `shutdown` is cancelled. After a shutdown signal the current
/// slot is delivered first, if that takes a few seconds at most.
///
/// The worker waits indefinitely for a learner or teacher that cannot be reached, and for a learner that was stopped
/// before the end of the run. Rollouts run on a thread of their own; a current-thread runtime with time and IO enabled
/// is sufficient.
///
/// # Errors
/// When waiting cannot cure the error.
pub async fn run(config: WorkerConfig, shutdown: CancellationToken) -> Result<(), Error> {
    run_with(config, Timeouts::default(), shutdown).await
}

/// Runs a worker as [`run`], with other timeouts.
///
/// # Errors
/// When waiting cannot cure the error.
pub async fn run_with(
    config: WorkerConfig,
    timeouts: Timeouts,
    shutdown: CancellationToken,
) -> Result<(), Error> {
    if let Some(path) = &config.log_dir {
        std::fs::create_dir_all(path)
            .map_err(|source| Error::LogDir { path: path.clone(), source })?;
    }
    let rollouts = TaskTracker::new();
    let (learner, teacher) = (Learner::new(&config, timeouts)?, Teacher::new(&config, timeouts)?);
    let pacing = config.pacing;
    let mut worker = Worker { config, timeouts, learner, teacher, rollouts: rollouts.clone() };
    let drained = async {
        shutdown.cancelled().await;
        tokio::time::sleep(timeouts.drain).await;
    };
    let outcome = tokio::select! {
        outcome = worker.play_slots(&shutdown) => outcome,
        () = drained => Ok(()),
    };
    rollouts.close();
    pacing.next(rollouts.wait()).await;
    outcome
}

/// A worker and its peers.
struct Worker {
    config: WorkerConfig,
    timeouts: Timeouts,
    learner: Learner,
    teacher: Option<Teacher>,
    rollouts: TaskTracker,
}

/// The result of joining a run.
struct Membership {
    worker_id: u64,
    /// Boxed to keep futures small: a world is large.
    player: Box<Player>,
}

impl Worker {
    /// Plays slots until the run has ended. Begins no new slot once `shutdown` is cancelled.
    async fn play_slots(&mut self, shutdown: &CancellationToken) -> Result<(), Error> {
        let mut membership = None;
        loop {
            let slot = tokio::select! {
                biased;
                () = shutdown.cancelled() => return Ok(()),
                slot = self.next_slot(membership) => slot?,
            };
            let Some((member, order)) = slot else { return Ok(()) };
            membership = self.play_and_deliver(member, order).await?;
        }
    }

    /// Waits for a slot, joining the run first if necessary. Returns `None` when the run has ended.
    async fn next_slot(
        &mut self,
        mut membership: Option<Membership>,
    ) -> Result<Option<(Membership, SlotOrder)>, Error> {
        loop {
            let member = match membership {
                Some(member) => member,
                None => self.join().await?,
            };
            membership = match self.learner.next_work(member.worker_id).await? {
                Some(Work::Slot(order)) => return Ok(Some((member, order))),
                Some(Work::Finished(reason)) => {
                    tracing::info!(reason, "run ended");
                    return Ok(None);
                }
                Some(Work::Interrupted(reason)) => {
                    tracing::warn!(
                        reason,
                        "learner stopped before the end of the run, waiting for it"
                    );
                    tokio::time::sleep(self.timeouts.backoff.max_pause).await;
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
            tokio::time::sleep(self.timeouts.backoff.first_pause).await;
        }
    }

    async fn join(&mut self) -> Result<Membership, Error> {
        let (worker_id, terms) = self.learner.join(&self.config.name).await?;
        if let Some(account) = terms.account.as_ref().filter(|_| self.teacher.is_none()) {
            return Err(Error::NoTeacher { account: account.clone() });
        }
        tracing::info!(worker_id, task = %terms.layout.task, n_arms = terms.layout.n_arms, "run joined");
        Ok(Membership {
            worker_id,
            player: Box::new(Player::new(terms, self.config.log_dir.clone())?),
        })
    }

    /// Plays and delivers a slot. Returns `None` if the learner no longer knows the worker.
    async fn play_and_deliver(
        &mut self,
        mut member: Membership,
        order: SlotOrder,
    ) -> Result<Option<Membership>, Error> {
        let (worker_id, slot) = (member.worker_id, order.slot);
        if !self.fetch_parameters(&mut member.player, order.parameter_version).await? {
            tracing::warn!(
                slot,
                version = order.parameter_version,
                "parameters no longer available, asking for other work"
            );
            tokio::time::sleep(self.timeouts.backoff.first_pause).await;
            return Ok(Some(member));
        }
        let (player, episodes) = self.play(member.player, order).await?;
        let taken = self.learner.submit(worker_id, slot, &episodes).await?;
        if taken.is_none() {
            // Such a learner does not know the slot either and orders its episodes again.
            tracing::warn!(worker_id, slot, "unknown to the learner, joining again");
        }
        Ok(taken.map(|()| Membership { worker_id, player }))
    }

    /// Loads the parameters of `version` into the player. Returns false if the learner no longer has them.
    async fn fetch_parameters(&mut self, player: &mut Player, version: u64) -> Result<bool, Error> {
        if player.has_version(version) {
            return Ok(true);
        }
        let Some(published) = self.learner.parameters(version, player.terms().layout).await? else {
            return Ok(false);
        };
        player.load(published).map_err(|source| Error::Parameters { version, source })?;
        Ok(true)
    }

    /// Plays a slot on a thread of its own, and forwards its requests for advice to the teacher.
    async fn play(
        &mut self,
        mut player: Box<Player>,
        order: SlotOrder,
    ) -> Result<(Box<Player>, Vec<Episode>), Error> {
        let slot = order.slot;
        let (account, layout) = (player.terms().account.clone(), player.terms().layout);
        let (advisor, mut requests) = AdviceChannel::new();
        let (finished, playing) = oneshot::channel();
        let tracked = self.rollouts.token();
        let rollout = std::thread::Builder::new().name("rollout".to_owned());
        rollout
            .spawn(move || {
                let _tracked = tracked;
                let episodes = player.play(&order, advisor);
                // Fails only if the worker has ended meanwhile.
                drop(finished.send((player, episodes)));
            })
            .map_err(Error::Thread)?;
        // Ends when the player drops the channel, after the slot or after an error.
        while let Some(pending) = self.config.pacing.next(requests.recv()).await {
            let account = account.as_deref().ok_or(Error::NoAccount { slot })?;
            let no_teacher = || Error::NoTeacher { account: account.to_owned() };
            let teacher = self.teacher.as_mut().ok_or_else(no_teacher)?;
            let advice = teacher.advise(account, layout, &pending.queries).await?;
            if pending.response.send(advice).is_err() {
                break;
            }
        }
        let (player, episodes) = self.config.pacing.next(playing).await?;
        Ok((player, episodes.map_err(|source| Error::Rollout { slot, source })?))
    }
}
