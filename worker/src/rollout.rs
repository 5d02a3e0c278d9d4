//! The life of an episode: reset, then act, explore, ask, execute, observe, fifty times.

use tandem_core::layout::EPISODE_STEPS;
use tandem_core::rng::{Stream, episode_rng};
use tandem_core::work::{EpisodeOrder, RunTerms, SlotOrder};
use tandem_core::{Episode, EpisodeKind, StepAdvice, StepQuery};
use tandem_sim::SimError;
use tandem_telemetry::events::StepAdvised;

use crate::explore::Explorer;
use crate::ports::{Act, Advisor, AdvisorGone, Environment};

/// An error that ends a slot.
#[derive(Debug, thiserror::Error)]
pub enum RolloutError {
    /// The worker is stopping while a request for advice is pending.
    #[error(transparent)]
    AdvisorGone(#[from] AdvisorGone),
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
    /// The teacher's response is about other steps or another layout than the request.
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

/// Plays the episodes of `order` in lock step, so that one request for advice serves all of them, and returns them in
/// that order.
///
/// An episode depends only on its own order, the actor, the terms and the teacher's advice on it. The actor sees one
/// observation at a time, so not even the rounding within a batch makes episodes depend on each other.
///
/// # Errors
/// When the advisor is gone or answers in the wrong shape, or a step of the environment fails.
pub fn play_slot<E: Environment>(
    env: &E,
    order: &SlotOrder,
    terms: &RunTerms,
    actor: &mut impl Act,
    advisor: &mut impl Advisor,
) -> Result<Vec<Episode>, RolloutError> {
    let start = |episode: &EpisodeOrder| Rollout::start(env.clone(), *episode, order, terms);
    let mut rollouts: Vec<Rollout<E>> = order.episodes.iter().map(start).collect();
    for step_idx in 0..EPISODE_STEPS {
        for rollout in &mut rollouts {
            rollout.choose_action(actor);
        }
        take_advice(&mut rollouts, step_idx, advisor)?;
        for rollout in &mut rollouts {
            rollout.execute(step_idx)?;
        }
    }
    Ok(rollouts.into_iter().map(|rollout| rollout.episode).collect())
}

/// Asks the teacher about the next actions of the advised rollouts, and applies its advice.
fn take_advice<E: Environment>(
    rollouts: &mut [Rollout<E>],
    step_idx: usize,
    advisor: &mut impl Advisor,
) -> Result<(), RolloutError> {
    let mut advised: Vec<&mut Rollout<E>> =
        rollouts.iter_mut().filter(|rollout| rollout.advised).collect();
    let Some(first) = advised.first() else {
        return Ok(());
    };
    let first_number = first.episode.number;
    let queries: Vec<StepQuery> = advised.iter().map(|rollout| rollout.query(step_idx)).collect();
    let answers = advisor.advise(queries)?;
    check_count(first_number, step_idx, "steps", answers.len(), advised.len())?;
    for (rollout, advice) in advised.iter_mut().zip(&answers) {
        rollout.apply_advice(advice, step_idx)?;
    }
    Ok(())
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
struct Rollout<E> {
    env: E,
    explorer: Option<Explorer>,
    advised: bool,
    /// The observation before the next step, shape `[n_observation]`.
    observation: Vec<f32>,
    /// The action of the next step, shape `[n_action]`.
    action: Vec<f32>,
    /// The arms whose action of the next step is the teacher's, as a bit mask.
    advised_arms: u8,
    /// The steps played so far.
    episode: Episode,
}

impl<E: Environment> Rollout<E> {
    fn start(mut env: E, order: EpisodeOrder, slot: &SlotOrder, terms: &RunTerms) -> Self {
        let layout = terms.layout;
        env.reset(order, terms.world.for_kind(slot.kind));
        let mut observation = vec![0.0; layout.n_observation()];
        env.observe(&mut observation);
        let mut observations = Vec::with_capacity((EPISODE_STEPS + 1) * layout.n_observation());
        observations.extend_from_slice(&observation);
        let episode = Episode {
            number: order.number,
            kind: slot.kind,
            parameter_version: slot.parameter_version,
            layout,
            observations,
            goal: env.goal().to_vec(),
            actions: Vec::with_capacity(EPISODE_STEPS * layout.n_action()),
            advised_arms: Vec::with_capacity(EPISODE_STEPS),
            contacts: Vec::with_capacity(EPISODE_STEPS),
            advice_charged: 0,
        };
        Self {
            env,
            explorer: explorer(order, slot.kind, terms),
            advised: order.advised && slot.kind == EpisodeKind::Training,
            observation,
            action: vec![0.0; layout.n_action()],
            advised_arms: 0,
            episode,
        }
    }

    /// Chooses the student's next action, including exploration.
    fn choose_action(&mut self, actor: &mut impl Act) {
        actor.act(&self.observation, &self.episode.goal, &mut self.action);
        self.advised_arms = 0;
        if let Some(explorer) = &mut self.explorer {
            explorer.explore(&mut self.action);
        }
    }

    fn query(&self, step_idx: usize) -> StepQuery {
        StepQuery {
            episode: self.episode.number,
            step: u32::try_from(step_idx).expect("an episode's steps are few"),
            observation: self.observation.clone(),
            goal: self.episode.goal.clone(),
            proposed_action: self.action.clone(),
        }
    }

    /// Replaces the proposed action by the teacher's advice.
    fn apply_advice(&mut self, advice: &StepAdvice, step_idx: usize) -> Result<(), RolloutError> {
        let (number, layout) = (self.episode.number, self.episode.layout);
        check_count(number, step_idx, "action components", advice.action.len(), layout.n_action())?;
        check_count(number, step_idx, "arms", advice.arms.len(), layout.n_arms)?;
        self.action.copy_from_slice(&advice.action);
        self.advised_arms = advice.overridden_arms();
        if self.advised_arms != 0 && !advice.charged {
            return Err(RolloutError::UnchargedAdvice { episode: number, step: step_idx });
        }
        if self.advised_arms != 0 {
            let step = u32::try_from(step_idx).expect("an episode's steps are few");
            StepAdvised { episode: number, step, overridden_arms: self.advised_arms }.emit();
        }
        // A step without overridden arms may carry a charge, from a previous worker whose student acted differently. The
        // teacher's account includes that unit, but this episode is not advised on the step.
        self.episode.advice_charged += u32::from(self.advised_arms != 0);
        Ok(())
    }

    fn execute(&mut self, step_idx: usize) -> Result<(), RolloutError> {
        let contacts = self.env.step(&self.action).map_err(|source| RolloutError::Step {
            episode: self.episode.number,
            step: step_idx,
            source,
        })?;
        self.env.observe(&mut self.observation);
        self.episode.observations.extend_from_slice(&self.observation);
        self.episode.actions.extend_from_slice(&self.action);
        self.episode.advised_arms.push(self.advised_arms);
        self.episode.contacts.push(contacts);
        Ok(())
    }
}

fn explorer(order: EpisodeOrder, kind: EpisodeKind, terms: &RunTerms) -> Option<Explorer> {
    if kind == EpisodeKind::Evaluation {
        return None;
    }
    let rng = episode_rng(order.seed, order.number, Stream::Exploration);
    let explorer = if order.uniform { Explorer::uniform } else { Explorer::new };
    Some(explorer(terms.layout, terms.exploration, rng))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fakes::{
        FakeActor, FakeEnvironment, FakeTeacher, LAYOUT, TEACHER_ACTION, slot, terms,
    };
    use crate::ports::NoAdvisor;

    fn play(order: &SlotOrder, actor: FakeActor, advisor: &mut impl Advisor) -> Vec<Episode> {
        play_slot(&FakeEnvironment::new(), order, &terms(), &mut { actor }, advisor)
            .expect("no step fails")
    }

    #[test]
    fn an_episode_is_a_function_of_its_order() {
        let advised = |episode, step, arm| (episode + u64::from(step)) % 3 == arm as u64;
        let play = |numbers: &[u64]| {
            play(&slot(numbers, true), FakeActor::Seeker, &mut FakeTeacher::new(advised))
        };
        let together = play(&[3, 8]);
        assert_eq!(play(&[8]), together[1..]);
        assert_eq!(
            play(&[8, 5, 3]),
            [together[1].clone(), play(&[5]).remove(0), together[0].clone()]
        );
        assert_ne!(together[0].observations, together[1].observations);
        assert_ne!(together[0].actions, together[1].actions);
    }

    #[test]
    fn an_episode_has_every_step_and_follows_the_environment() {
        let episode = play(&slot(&[3], false), FakeActor::Seeker, &mut NoAdvisor).remove(0);
        assert_eq!((episode.number, episode.parameter_version), (3, 4));
        assert_eq!(episode.observations.len(), 51 * LAYOUT.n_observation());
        assert_eq!((episode.actions.len(), episode.contacts.len()), (50 * LAYOUT.n_action(), 50));
        assert_eq!(
            (episode.advised_arms.as_slice(), episode.advice_charged),
            ([0; 50].as_slice(), 0)
        );
        for step_idx in 0..EPISODE_STEPS {
            let expected = episode.observation(step_idx)[0] + 0.05 * episode.action(step_idx)[0];
            assert!(
                (episode.observation(step_idx + 1)[0] - expected).abs() < 1e-6,
                "step {step_idx}"
            );
        }
    }

    #[test]
    fn advice_replaces_exactly_the_overridden_arms_and_is_recorded() {
        let overrides = |_, step: u32, arm: usize| (step as usize % 4) >> arm & 1 == 1;
        let mut teacher = FakeTeacher::new(overrides);
        let episode = play(&slot(&[3], true), FakeActor::Seeker, &mut teacher).remove(0);
        for (step_idx, request) in teacher.requests.iter().enumerate() {
            let expected_arms = [0, 1, 2, 3][step_idx % 4];
            assert_eq!(episode.advised_arms[step_idx], expected_arms);
            for arm in LAYOUT.arms() {
                let executed = &episode.action(step_idx)[LAYOUT.action_of(arm)];
                let proposed = &request[0].proposed_action[LAYOUT.action_of(arm)];
                let overridden = expected_arms >> arm.0 & 1 == 1;
                assert_eq!(executed, if overridden { &TEACHER_ACTION } else { proposed });
            }
        }
        assert_eq!(
            episode.advice_charged, 37,
            "three steps of four, beginning with one that is free"
        );
    }

    #[test]
    fn advice_does_not_shift_the_random_stream() {
        let free = play(&slot(&[3], false), FakeActor::Constant(0.1), &mut NoAdvisor).remove(0);
        let mut teacher = FakeTeacher::new(|_, step, _| step % 2 == 0);
        let advised = play(&slot(&[3], true), FakeActor::Constant(0.1), &mut teacher).remove(0);
        for step_idx in 0..EPISODE_STEPS {
            assert_eq!(teacher.requests[step_idx][0].proposed_action, free.action(step_idx));
            let overridden = step_idx % 2 == 0;
            assert_eq!(
                advised.action(step_idx) == free.action(step_idx),
                !overridden,
                "step {step_idx}"
            );
        }
    }

    #[test]
    fn one_request_covers_every_advised_episode_and_no_other() {
        let mut order = slot(&[3, 8, 9], true);
        order.episodes[1].advised = false;
        let mut teacher = FakeTeacher::new(|_, _, _| true);
        let episodes = play(&order, FakeActor::Seeker, &mut teacher);
        assert_eq!(teacher.requests.len(), EPISODE_STEPS);
        for (step_idx, request) in teacher.requests.iter().enumerate() {
            let asked: Vec<(u64, usize)> =
                request.iter().map(|q| (q.episode, q.step as usize)).collect();
            assert_eq!(asked, [(3, step_idx), (9, step_idx)]);
            assert_eq!(request[1].observation, episodes[2].observation(step_idx));
            assert_eq!(request[1].goal, episodes[2].goal);
        }
        assert_eq!(episodes.iter().map(|e| e.advice_charged).collect::<Vec<_>>(), [50, 0, 50]);
    }

    #[test]
    fn an_evaluation_executes_the_policy_without_exploration_or_advice() {
        let mut order = slot(&[3], true);
        order.kind = EpisodeKind::Evaluation;
        order.episodes[0].uniform = true;
        let episode = play(&order, FakeActor::Constant(0.1), &mut NoAdvisor).remove(0);
        assert!(episode.actions.iter().all(|component| *component == 0.1));
        assert!(
            episode.observation(0)[..3].iter().all(|position| position.abs() <= 0.5),
            "no wide start"
        );
    }

    #[test]
    fn a_warm_up_ignores_the_policy() {
        let mut order = slot(&[3], false);
        order.episodes[0].uniform = true;
        let actions =
            |input| play(&order, FakeActor::Constant(input), &mut NoAdvisor).remove(0).actions;
        assert_eq!(actions(0.1), actions(0.9));
        assert!(actions(0.1).iter().any(|component| component.abs() > 0.9));
    }

    /// An advisor that returns the student's own actions, with fixed flags.
    struct FixedFlags {
        overridden: bool,
        charged: bool,
    }

    impl Advisor for FixedFlags {
        fn advise(&mut self, queries: Vec<StepQuery>) -> Result<Vec<StepAdvice>, AdvisorGone> {
            let mut teacher = FakeTeacher::new(|_, _, _| self.overridden);
            let answers = teacher.advise(queries)?.into_iter();
            Ok(answers.map(|advice| StepAdvice { charged: self.charged, ..advice }).collect())
        }
    }

    #[test]
    fn a_step_that_was_charged_before_but_is_not_overridden_now_is_not_claimed() {
        let mut advisor = FixedFlags { overridden: false, charged: true };
        let episode = play(&slot(&[3], true), FakeActor::Seeker, &mut advisor).remove(0);
        assert_eq!(
            (episode.advised_arms.as_slice(), episode.advice_charged),
            ([0; 50].as_slice(), 0)
        );
    }

    #[test]
    fn an_override_without_a_charge_is_an_error() {
        let mut advisor = FixedFlags { overridden: true, charged: false };
        let played = play_slot(
            &FakeEnvironment::new(),
            &slot(&[3], true),
            &terms(),
            &mut FakeActor::Seeker,
            &mut advisor,
        );
        assert_eq!(
            played.expect_err("no charge").to_string(),
            "the teacher overrides arms of episode 3 on step 0 without a charge"
        );
    }

    #[test]
    fn advice_about_other_steps_is_an_error() {
        struct Silent;
        impl Advisor for Silent {
            fn advise(&mut self, _queries: Vec<StepQuery>) -> Result<Vec<StepAdvice>, AdvisorGone> {
                Ok(Vec::new())
            }
        }
        let played = play_slot(
            &FakeEnvironment::new(),
            &slot(&[3], true),
            &terms(),
            &mut FakeActor::Seeker,
            &mut Silent,
        );
        let error = played.expect_err("one step was asked about");
        assert_eq!(
            error.to_string(),
            "the teacher's advice on episode 3, step 0, has 0 steps where 1 were expected"
        );
    }
}
