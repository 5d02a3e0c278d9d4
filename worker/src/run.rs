//! The worker's main loop: join the run, then take, play and deliver slots until the run has ended.

use tandem_core::work::SlotOrder;
use tandem_core::{StepQuery, TaskSpec};
use tandem_net::TraceContext;
use tokio::sync::oneshot;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tracing::Instrument as _;

use crate::config::{RecordingConfig, Timeouts, WorkerConfig};
use crate::environment::{EnvironmentClient, Failure};
use crate::error::Error;
use crate::learner::{LearnerClient, Work};
use crate::metrics::WorkerMetrics;
use crate::player::{AdviceReply, PeerChannel, PeerRequest, PlayedSlot, Player};
use crate::recorder::Recorder;
use crate::rollout::RolloutError;
use crate::teacher::TeacherClient;

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
    let rollouts = TaskTracker::new();
    let recorder = match &config.recording {
        Some(recording) => Some(start_recorder(recording.clone(), &rollouts)?),
        None => None,
    };
    let (learner, teacher) =
        (LearnerClient::new(&config, timeouts)?, TeacherClient::new(&config, timeouts)?);
    let pacing = config.pacing;
    let metrics = WorkerMetrics::register(config.client.metrics(), config.liveness.clone());
    let environments = config.environment.clone().map(EnvironmentClient::new);
    let mut worker = Worker {
        config,
        timeouts,
        learner,
        teacher,
        environments,
        metrics,
        recorder,
        difference_logged: false,
        rollouts: rollouts.clone(),
    };
    let drained = async {
        shutdown.cancelled().await;
        tokio::time::sleep(timeouts.drain).await;
    };
    let outcome = tokio::select! {
        outcome = worker.play_slots(&shutdown) => outcome,
        () = drained => Ok(()),
    };
    // The recorder's thread ends with its last sender.
    drop(worker);
    rollouts.close();
    pacing.next(rollouts.wait()).await;
    outcome
}

/// Starts the thread that writes logs.
fn start_recorder(config: RecordingConfig, threads: &TaskTracker) -> Result<Recorder, Error> {
    Recorder::start(config, threads.token()).map_err(Error::Thread)
}

/// A worker and its peers.
struct Worker {
    config: WorkerConfig,
    timeouts: Timeouts,
    learner: LearnerClient,
    teacher: Option<TeacherClient>,
    /// The server of the environments; `None` if they are simulated in this process.
    environments: Option<EnvironmentClient>,
    metrics: WorkerMetrics,
    /// The thread that writes logs, if there are any.
    recorder: Option<Recorder>,
    /// Whether the log has a warning that the environments are not deterministic.
    difference_logged: bool,
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
            let start = self.metrics.now();
            let slot = tokio::select! {
                biased;
                () = shutdown.cancelled() => return Ok(()),
                slot = self.next_slot(membership) => slot?,
            };
            let Some((member, order)) = slot else { return Ok(()) };
            self.metrics.record_wait(start, order.parameter_version);
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

    /// Joins the run and checks that the peers serve it.
    async fn join(&mut self) -> Result<Membership, Error> {
        let (worker_id, terms) = self.learner.join(&self.config.name).await?;
        if let Some(account) = terms.account.as_ref().filter(|_| self.teacher.is_none()) {
            return Err(Error::NoTeacher { account: account.clone() });
        }
        tracing::info!(
            worker_id,
            task = terms.task.name(),
            n_arms = terms.task.n_arms(),
            "run joined"
        );
        let (recorder, metrics) = (self.recorder.clone(), self.metrics.clone());
        let player = match &mut self.environments {
            None => Player::simulating(terms, recorder, metrics)?,
            Some(environments) => {
                environments.check(&terms.task).await?;
                Player::remote(terms, recorder, metrics)
            }
        };
        Ok(Membership { worker_id, player: Box::new(player) })
    }

    /// Plays and delivers a slot. Returns `None` if the learner no longer knows the worker.
    async fn play_and_deliver(
        &mut self,
        mut member: Membership,
        order: SlotOrder,
    ) -> Result<Option<Membership>, Error> {
        let (worker_id, slot) = (member.worker_id, order.slot);
        if !self.fetch_parameters(&mut member.player, &order).await? {
            tracing::warn!(
                slot,
                version = order.parameter_version,
                "parameters no longer available, asking for other work"
            );
            tokio::time::sleep(self.timeouts.backoff.first_pause).await;
            return Ok(Some(member));
        }
        let trace = trace_of(&order);
        let delivered = async {
            let (player, played) = self.play(member.player, order, trace).await?;
            let submission = trace.child("submit", 0);
            let submitted = self.learner.submit(worker_id, slot, &played, submission);
            let submitted = submitted.instrument(submission.span(Some(trace), "submit", "client"));
            Ok::<_, Error>((player, submitted.await?))
        };
        let span = trace.span(None, "slot", "internal");
        let (player, is_known) = delivered.instrument(span).await?;
        if !is_known {
            // Such a learner does not know the slot either and orders its episodes again.
            tracing::warn!(worker_id, slot, "unknown to the learner, joining again");
            return Ok(None);
        }
        Ok(Some(Membership { worker_id, player }))
    }

    /// Loads the parameters that play `order` into the player. Returns false if the learner no longer has them.
    async fn fetch_parameters(
        &mut self,
        player: &mut Player,
        order: &SlotOrder,
    ) -> Result<bool, Error> {
        if player.has_actor_of(order) {
            return Ok(true);
        }
        let version = order.parameter_version;
        let Some(published) = self.learner.parameters(version, &player.terms().task).await? else {
            return Ok(false);
        };
        player
            .load(published, order.kind)
            .map_err(|source| Error::Parameters { version, source })?;
        Ok(true)
    }

    /// Plays a slot. If the server of the environments fails, plays it again from the start of its episodes, which
    /// depend only on their seeds and actions.
    async fn play(
        &mut self,
        mut player: Box<Player>,
        order: SlotOrder,
        trace: TraceContext,
    ) -> Result<(Box<Player>, PlayedSlot), Error> {
        loop {
            let (returned, outcome) = self.try_play(player, order.clone(), trace).await?;
            match (outcome, &mut self.environments) {
                (Ok(mut played), environments) => {
                    if let Some(environments) = environments {
                        played.failures = environments.succeed().await;
                    }
                    self.log_difference(&played);
                    return Ok((returned, played));
                }
                (Err(SlotFailure::Environment(failure)), Some(environments)) => {
                    environments.recover(failure).await?;
                }
                (Err(SlotFailure::Environment(_)), None) => return Err(Error::NoServer),
                (Err(SlotFailure::Rollout(source)), _) => {
                    return Err(Error::Rollout { slot: order.slot, source });
                }
            }
            player = returned;
        }
    }

    /// Plays a slot on a thread of its own, and forwards its requests to the teacher and to the server of the
    /// environments.
    async fn try_play(
        &mut self,
        mut player: Box<Player>,
        order: SlotOrder,
        trace: TraceContext,
    ) -> Result<(Box<Player>, Result<PlayedSlot, SlotFailure>), Error> {
        let slot = order.slot;
        let (account, task) = (player.terms().account.clone(), player.terms().task.clone());
        let (peers, mut requests) = PeerChannel::new();
        let (finished, playing) = oneshot::channel();
        let tracked = self.rollouts.token();
        let rollout = std::thread::Builder::new().name("rollout".to_owned());
        rollout
            .spawn(move || {
                let _tracked = tracked;
                let played = player.play(&order, peers);
                // Fails only if the worker has ended meanwhile.
                drop(finished.send((player, played)));
            })
            .map_err(Error::Thread)?;
        let mut failure = None;
        // Ends when the player drops the channel, after the slot or after an error.
        while let Some(request) = self.config.pacing.next(requests.recv()).await {
            let answered = match request {
                PeerRequest::Advice(queries, response) => {
                    let account = account.as_deref().ok_or(Error::NoAccount { slot })?;
                    let advice = self.advise(account, &task, &queries, trace).await?;
                    response.send(advice).is_ok()
                }
                request => match self.forward(request, &task).await {
                    Ok(answered) => answered,
                    Err(error) => {
                        failure = Some(error);
                        false
                    }
                },
            };
            if !answered {
                break;
            }
        }
        // The player's thread ends once its requests are no longer answered.
        drop(requests);
        let (player, played) = self.config.pacing.next(playing).await?;
        let outcome = match failure {
            Some(failure) => Err(SlotFailure::Environment(failure)),
            None => played.map_err(SlotFailure::Rollout),
        };
        Ok((player, outcome))
    }

    async fn advise(
        &mut self,
        account: &str,
        task: &TaskSpec,
        queries: &[StepQuery],
        trace: TraceContext,
    ) -> Result<AdviceReply, Error> {
        let no_teacher = || Error::NoTeacher { account: account.to_owned() };
        let teacher = self.teacher.as_mut().ok_or_else(no_teacher)?;
        let step = queries.first().map_or(0, |query| u64::from(query.step));
        let call = trace.child("advise", step);
        let span = call.span(Some(trace), "advise", "client");
        teacher.advise(account, task, queries, call).instrument(span).await
    }

    /// Forwards a request to the server of the environments. Returns true if the player still waits for the response.
    async fn forward(&mut self, request: PeerRequest, task: &TaskSpec) -> Result<bool, Failure> {
        let no_server = || Failure::Final(Box::new(Error::NoServer));
        self.environments.as_mut().ok_or_else(no_server)?.answer(request, task).await
    }

    /// Warns once of environments that are not deterministic.
    fn log_difference(&mut self, played: &PlayedSlot) {
        let difference = played.check.and_then(|check| check.difference);
        if let Some(difference) = difference.filter(|_| !self.difference_logged) {
            self.difference_logged = true;
            tracing::warn!(%difference, "the environments are not deterministic");
        }
    }
}

/// Returns the first span of the trace of a slot. It depends on the slot's first episode and on the parameters that play
/// it, so a slot that is played again has the same trace.
fn trace_of(order: &SlotOrder) -> TraceContext {
    let (seed, number) = match order.episodes.first() {
        Some(episode) => (episode.seed, episode.number),
        None => (0, order.slot),
    };
    TraceContext::of(&[seed, number, order.kind as u64, order.parameter_version])
}

/// The failure of a slot that was being played.
enum SlotFailure {
    /// The server of the environments has failed.
    Environment(Failure),
    /// The rollout has failed.
    Rollout(RolloutError),
}
