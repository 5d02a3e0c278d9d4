//! The life of an episode: reset, then act, explore, ask, execute and observe on every step.

use tandem_core::rng::{Stream, episode_rng};
use tandem_core::work::{EpisodeExploration, EpisodeOrder, EpisodeStart, RunTerms, SlotOrder};
use tandem_core::{
    AdviceUnit, Contacts, Episode, EpisodeKind, JudgedAction, StepAdvice, StepQuery, TaskSpec,
    WorldSettings,
};
use tandem_sim::SimError;
use tandem_telemetry::events::StepAdvised;

use crate::explore::Explorer;
use crate::ports::{Act, Advisor, AdvisorGone, EnvironmentError, VectorEnv};
use crate::trace::{Trace, TracedAdvice};

/// An error that ends a slot.
#[derive(Debug, thiserror::Error)]
pub enum RolloutError {
    /// The worker is stopping while a request for advice is pending.
    #[error(transparent)]
    AdvisorGone(#[from] AdvisorGone),
    /// The environments can no longer be used.
    #[error(transparent)]
    Environment(#[from] EnvironmentError),
    /// The environment cannot be built.
    #[error("the environment cannot be built")]
    NoEnvironment(#[source] SimError),
    /// A step of the environment failed.
    #[error("step {step} of episode {episode} failed")]
    Step {
        /// The episode's number.
        episode: u64,
        /// The step, from 0.
        step: usize,
        /// The cause.
        source: SimError,
    },
    /// The teacher's response is about other steps or another task than the request.
    #[error(
        "the teacher's advice on episode {episode}, step {step}, has {got} {field} where {expected} were expected"
    )]
    AdviceShape {
        /// The episode's number.
        episode: u64,
        /// The step, from 0.
        step: usize,
        /// The counted items.
        field: &'static str,
        /// Their number in the response.
        got: usize,
        /// Their expected number.
        expected: usize,
    },
    /// The teacher replaced the student's action without a charge.
    #[error("the teacher overrides arms of episode {episode} on step {step} without a charge")]
    UnchargedAdvice {
        /// The episode's number.
        episode: u64,
        /// The step, from 0.
        step: usize,
    },
}

/// Selects the results of a slot: its episodes alone, or with their traces.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tracing {
    /// The episodes alone.
    Off,
    /// Every episode with its trace.
    On,
}

/// Plays the episodes of `order` in lock step, so that one request for advice serves all of them, and returns them in
/// that order.
///
/// An episode depends only on its own order, the actor, the terms and the teacher's advice on it. The actor sees one
/// observation at a time, so not even the rounding within a batch makes episodes depend on each other.
///
/// # Errors
/// When the advisor is gone or answers in the wrong shape, or a step of the environment fails.
pub fn play_slot(
    env: &mut impl VectorEnv,
    order: &SlotOrder,
    terms: &RunTerms,
    actor: &mut impl Act,
    advisor: &mut impl Advisor,
) -> Result<Vec<Episode>, RolloutError> {
    let played = play_traced_slot(env, order, terms, actor, advisor, Tracing::Off)?;
    Ok(played.into_iter().map(|(episode, _)| episode).collect())
}

/// Plays as [`play_slot`]. Returns each episode with its trace, for its log, if `tracing` is on. The episodes are the
/// same.
///
/// # Errors
/// As [`play_slot`].
pub fn play_traced_slot(
    env: &mut impl VectorEnv,
    order: &SlotOrder,
    terms: &RunTerms,
    actor: &mut impl Act,
    advisor: &mut impl Advisor,
    tracing: Tracing,
) -> Result<Vec<(Episode, Option<Trace>)>, RolloutError> {
    let mut rollouts = start(env, order, terms)?;
    if tracing == Tracing::On {
        rollouts.iter_mut().for_each(|rollout| rollout.trace = Some(Trace::default()));
    }
    let mut batch = StepBatch::new(order.episodes.len(), &terms.task);
    for step_idx in 0..terms.task.episode_steps() {
        trace_scenes(&mut rollouts, env);
        for rollout in &mut rollouts {
            rollout.choose_action(actor, step_idx);
        }
        take_advice(&mut rollouts, step_idx, terms.advice.unit, advisor)?;
        batch.execute(&mut rollouts, step_idx, env)?;
    }
    trace_scenes(&mut rollouts, env);
    for (environment, rollout) in rollouts.iter_mut().enumerate() {
        rollout.episode.avoidance_steps = env.avoidance_steps(environment);
    }
    Ok(rollouts.into_iter().map(|rollout| (rollout.episode, rollout.trace)).collect())
}

/// Adds the scenes of this moment to the traces.
fn trace_scenes(rollouts: &mut [Rollout], env: &impl VectorEnv) {
    for (environment, rollout) in rollouts.iter_mut().enumerate() {
        if let Some(trace) = &mut rollout.trace {
            trace.scenes.extend(env.scene(environment));
        }
    }
}

/// Returns the starts of the episodes of `order`.
#[must_use]
pub fn episode_starts(order: &SlotOrder, terms: &RunTerms) -> Vec<EpisodeStart> {
    let start = |episode: &EpisodeOrder| EpisodeStart {
        number: episode.number,
        seed: episode.seed,
        kind: order.kind,
        world: world_settings(episode, order.kind, terms),
    };
    order.episodes.iter().map(start).collect()
}

/// Returns the settings of an episode's world. They depend on how far the run had come when the episode was ordered.
pub(crate) fn world_settings(
    episode: &EpisodeOrder,
    kind: EpisodeKind,
    terms: &RunTerms,
) -> WorldSettings {
    let n_steps = terms.task.episode_steps() as u64;
    terms.world.at(kind, episode.number.saturating_mul(n_steps))
}

/// Starts the episodes of `order`.
fn start(
    env: &mut impl VectorEnv,
    order: &SlotOrder,
    terms: &RunTerms,
) -> Result<Vec<Rollout>, RolloutError> {
    let (n, task) = (order.episodes.len(), &terms.task);
    let mut observations = vec![0.0; n * task.n_observation()];
    let mut goals = vec![0.0; n * task.n_goal()];
    env.reset(&episode_starts(order, terms), &mut observations, &mut goals)?;
    let observations = observations.chunks_exact(task.n_observation());
    let rows = observations.zip(goals.chunks_exact(task.n_goal()));
    let start = |(episode, row): (&EpisodeOrder, _)| Rollout::start(*episode, order, terms, row);
    Ok(order.episodes.iter().zip(rows).map(start).collect())
}

/// The vectors of one step of all environments, for reuse.
struct StepBatch {
    task: TaskSpec,
    /// Shape `[n, n_action]`.
    actions: Vec<f32>,
    /// Shape `[n, n_observation]`.
    observations: Vec<f32>,
    /// Shape `[n]`.
    contacts: Vec<Contacts>,
}

impl StepBatch {
    fn new(n: usize, task: &TaskSpec) -> Self {
        Self {
            task: task.clone(),
            actions: vec![0.0; n * task.n_action()],
            observations: vec![0.0; n * task.n_observation()],
            contacts: vec![Contacts::NONE; n],
        }
    }

    /// Executes the next action of every rollout.
    fn execute(
        &mut self,
        rollouts: &mut [Rollout],
        step_idx: usize,
        env: &mut impl VectorEnv,
    ) -> Result<(), RolloutError> {
        let Self { task, actions, observations, contacts } = self;
        for (rollout, action) in rollouts.iter().zip(actions.chunks_exact_mut(task.n_action())) {
            action.copy_from_slice(&rollout.action);
        }
        let stepped = env.step(actions, observations, contacts);
        stepped.map_err(|error| failed_step(error, rollouts, step_idx))?;
        let results = observations.chunks_exact(task.n_observation()).zip(contacts);
        for (rollout, (observation, contacts)) in rollouts.iter_mut().zip(results) {
            rollout.record(observation, *contacts);
        }
        Ok(())
    }
}

/// Names the episode of an environment that failed.
fn failed_step(error: EnvironmentError, rollouts: &[Rollout], step: usize) -> RolloutError {
    let number = |environment: usize| rollouts.get(environment).map(|it| it.episode.number);
    match error {
        EnvironmentError::Step { environment, source } => match number(environment) {
            Some(episode) => RolloutError::Step { episode, step, source },
            None => EnvironmentError::Step { environment, source }.into(),
        },
        EnvironmentError::Gone => error.into(),
    }
}

/// Asks the teacher about the next actions of the rollouts that ask, and applies its advice. If a unit pays for the lock
/// step, the slot's first advised episode claims it, whether or not it asks on this step: it has the slot's lease.
fn take_advice(
    rollouts: &mut [Rollout],
    step_idx: usize,
    unit: AdviceUnit,
    advisor: &mut impl Advisor,
) -> Result<(), RolloutError> {
    let payer_idx = match unit {
        AdviceUnit::EnvStep => None,
        AdviceUnit::SlotStep => rollouts.iter().position(|rollout| rollout.order.advised),
    };
    let payer = payer_idx.map(|idx| rollouts[idx].episode.number);
    let (mut asking, others): (Vec<&mut Rollout>, Vec<&mut Rollout>) =
        rollouts.iter_mut().partition(|rollout| rollout.asks);
    for trace in others.into_iter().filter_map(|rollout| rollout.trace.as_mut()) {
        trace.advice.push(TracedAdvice::default());
    }
    let Some(first) = asking.first() else {
        return Ok(());
    };
    let first_number = first.episode.number;
    let answers = ask(&mut asking, step_idx, payer, advisor)?;
    check_count(first_number, step_idx, "steps", answers.len(), asking.len())?;
    let budget_left = advisor.budget_left();
    for (rollout, advice) in asking.into_iter().zip(answers) {
        rollout.apply_advice(&advice, step_idx)?;
        if let Some(trace) = &mut rollout.trace {
            trace.advice.push(TracedAdvice { arms: advice.arms, budget_left });
        }
    }
    claim_units(rollouts, payer_idx);
    Ok(())
}

/// Returns the teacher's advice on the next actions of the rollouts, which count the query. The episode `payer` pays
/// for all of them if there is one.
fn ask(
    rollouts: &mut [&mut Rollout],
    step_idx: usize,
    payer: Option<u64>,
    advisor: &mut impl Advisor,
) -> Result<Vec<StepAdvice>, RolloutError> {
    let query = |rollout: &&mut Rollout| StepQuery { payer, ..rollout.query(step_idx) };
    let queries: Vec<StepQuery> = rollouts.iter().map(query).collect();
    let answers = advisor.advise(queries)?;
    for rollout in rollouts {
        *rollout.episode.queried_steps.get_or_insert(0) += 1;
    }
    Ok(answers)
}

/// Adds the units for the advice on this step to the episodes: one for each episode with overridden arms, or one for
/// all of them to the payer's.
///
/// A step without overridden arms may carry a charge, from a previous worker whose student acted differently. The
/// teacher's account includes that unit, but no episode claims it.
fn claim_units(rollouts: &mut [Rollout], payer_idx: Option<usize>) {
    match payer_idx {
        None => {
            for rollout in rollouts {
                rollout.episode.advice_charged += u32::from(rollout.advised_arms != 0);
            }
        }
        Some(idx) => {
            let any = rollouts.iter().any(|rollout| rollout.advised_arms != 0);
            rollouts[idx].episode.advice_charged += u32::from(any);
        }
    }
}

fn check_count(
    episode: u64,
    step: usize,
    field: &'static str,
    got: usize,
    expected: usize,
) -> Result<(), RolloutError> {
    if got == expected {
        Ok(())
    } else {
        Err(RolloutError::AdviceShape { episode, step, field, got, expected })
    }
}

/// An episode being played.
struct Rollout {
    explorer: Option<Explorer>,
    /// The order of the episode, which says on which steps to ask at most.
    order: EpisodeOrder,
    /// Whether the teacher is asked about the next step.
    asks: bool,
    /// The observation before the next step, shape `[n_observation]`.
    observation: Vec<f32>,
    /// The action of the next step, shape `[n_action]`.
    action: Vec<f32>,
    /// The policy's action of the next step, without exploration, if the teacher judges it, shape `[n_action]`.
    policy_action: Option<Vec<f32>>,
    /// The arms whose action of the next step is the teacher's, as a bit mask.
    advised_arms: u8,
    /// The steps played so far.
    episode: Episode,
    /// Their trace, if the episode is traced.
    trace: Option<Trace>,
}

impl Rollout {
    /// Starts an episode with its first observation and its goal.
    fn start(
        order: EpisodeOrder,
        slot: &SlotOrder,
        terms: &RunTerms,
        (observation, goal): (&[f32], &[f32]),
    ) -> Self {
        let (task, n_steps) = (&terms.task, terms.task.episode_steps());
        let mut observations = Vec::with_capacity((n_steps + 1) * task.n_observation());
        observations.extend_from_slice(observation);
        let episode = Episode {
            number: order.number,
            kind: slot.kind,
            parameter_version: slot.parameter_version,
            task: task.clone(),
            observations,
            goal: goal.to_vec(),
            actions: Vec::with_capacity(n_steps * task.n_action()),
            advised_arms: Vec::with_capacity(n_steps),
            contacts: Vec::with_capacity(n_steps),
            advice_charged: 0,
            avoidance_steps: None,
            queried_steps: Some(0),
        };
        Self {
            explorer: explorer(order, slot.kind, terms),
            order,
            asks: false,
            observation: observation.to_vec(),
            action: vec![0.0; task.n_action()],
            policy_action: match terms.advice.judged_action {
                JudgedAction::Executed => None,
                JudgedAction::Policy => Some(vec![0.0; task.n_action()]),
            },
            advised_arms: 0,
            episode,
            trace: None,
        }
    }

    /// Chooses the student's next action, including exploration, and whether to ask about it: on the ordered steps
    /// where the student asks, which depends on its action without exploration.
    fn choose_action(&mut self, actor: &mut impl Act, step_idx: usize) {
        actor.act(&self.observation, &self.episode.goal, &mut self.action);
        let may_ask = self.episode.kind == EpisodeKind::Training && self.order.asks_on(step_idx);
        self.asks = may_ask && actor.asks(&self.observation, &self.episode.goal, &self.action);
        self.advised_arms = 0;
        if let Some(policy_action) = &mut self.policy_action {
            policy_action.copy_from_slice(&self.action);
        }
        if let Some(explorer) = &mut self.explorer {
            let (task, observation) = (&self.episode.task, &self.observation);
            explorer.explore_holding(&mut self.action, |arm| task.arm_holds(arm, observation));
        }
    }

    /// Returns the query on the next step, in arm order.
    fn query(&self, step_idx: usize) -> StepQuery {
        let task = &self.episode.task;
        StepQuery {
            episode: self.episode.number,
            step: u32::try_from(step_idx).expect("an episode's steps are few"),
            observation: task.observation_in_arm_order(&self.observation),
            goal: task.goal_in_arm_order(&self.episode.goal),
            proposed_action: task.action_in_arm_order(&self.action),
            judged_action: self
                .policy_action
                .as_ref()
                .map(|action| task.action_in_arm_order(action)),
            payer: None,
        }
    }

    /// Replaces the proposed action by the teacher's advice.
    fn apply_advice(&mut self, advice: &StepAdvice, step_idx: usize) -> Result<(), RolloutError> {
        let (number, task) = (self.episode.number, &self.episode.task);
        check_count(number, step_idx, "action components", advice.action.len(), task.n_action())?;
        check_count(number, step_idx, "arms", advice.arms.len(), task.n_arms())?;
        task.write_action_in_arm_order(&advice.action, &mut self.action);
        self.advised_arms = advice.overridden_arms();
        if self.advised_arms != 0 && !advice.charged {
            return Err(RolloutError::UnchargedAdvice { episode: number, step: step_idx });
        }
        if self.advised_arms != 0 {
            let step = u32::try_from(step_idx).expect("an episode's steps are few");
            StepAdvised { episode: number, step, overridden_arms: self.advised_arms }.emit();
        }
        Ok(())
    }

    /// Records the executed step and what followed from it.
    fn record(&mut self, observation: &[f32], contacts: Contacts) {
        self.observation.copy_from_slice(observation);
        self.episode.observations.extend_from_slice(observation);
        self.episode.actions.extend_from_slice(&self.action);
        self.episode.advised_arms.push(self.advised_arms);
        self.episode.contacts.push(contacts);
    }
}

fn explorer(order: EpisodeOrder, kind: EpisodeKind, terms: &RunTerms) -> Option<Explorer> {
    if kind == EpisodeKind::Evaluation {
        return None;
    }
    let rng = episode_rng(order.seed, order.number, Stream::Exploration);
    let explorer = match order.exploration {
        EpisodeExploration::Noise => Explorer::new,
        EpisodeExploration::Uniform => Explorer::uniform,
        EpisodeExploration::Greedy => return None,
    };
    Some(explorer(&terms.task, terms.exploration, rng))
}

#[cfg(test)]
mod advice_terms;
#[cfg(test)]
mod arm_order;
#[cfg(test)]
mod tests;
