//! Tests of rollouts with fake environments, actors and teachers.

use super::*;
use crate::fakes::{FakeActor, FakeEnvironment, FakeTeacher, LAYOUT, TEACHER_ACTION, slot, terms};
use crate::ports::NoAdvisor;

fn play(order: &SlotOrder, actor: FakeActor, advisor: &mut impl Advisor) -> Vec<Episode> {
    play_slot(&mut FakeEnvironment::new(), order, &terms(), &mut { actor }, advisor)
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
    assert_eq!(play(&[8, 5, 3]), [together[1].clone(), play(&[5]).remove(0), together[0].clone()]);
    assert_ne!(together[0].observations, together[1].observations);
    assert_ne!(together[0].actions, together[1].actions);
}

#[test]
fn an_episode_has_every_step_and_follows_the_environment() {
    let episode = play(&slot(&[3], false), FakeActor::Seeker, &mut NoAdvisor).remove(0);
    assert_eq!((episode.number, episode.parameter_version), (3, 4));
    assert_eq!(episode.observations.len(), 51 * LAYOUT.n_observation());
    assert_eq!((episode.actions.len(), episode.contacts.len()), (50 * LAYOUT.n_action(), 50));
    assert_eq!((episode.advised_arms.as_slice(), episode.advice_charged), ([0; 50].as_slice(), 0));
    for step_idx in 0..50 {
        let expected = episode.observation(step_idx)[0] + 0.05 * episode.action(step_idx)[0];
        assert!((episode.observation(step_idx + 1)[0] - expected).abs() < 1e-6, "step {step_idx}");
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
    assert_eq!(episode.advice_charged, 37, "three steps of four, beginning with one that is free");
}

#[test]
fn advice_does_not_shift_the_random_stream() {
    let free = play(&slot(&[3], false), FakeActor::Constant(0.1), &mut NoAdvisor).remove(0);
    let mut teacher = FakeTeacher::new(|_, step, _| step % 2 == 0);
    let advised = play(&slot(&[3], true), FakeActor::Constant(0.1), &mut teacher).remove(0);
    for step_idx in 0..50 {
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
    assert_eq!(teacher.requests.len(), 50);
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
    order.episodes[0].exploration = EpisodeExploration::Uniform;
    let episode = play(&order, FakeActor::Constant(0.1), &mut NoAdvisor).remove(0);
    assert!(episode.actions.iter().all(|component| *component == 0.1));
    assert!(
        episode.observation(0)[..3].iter().all(|position| position.abs() <= 0.5),
        "no wide start"
    );
}

#[test]
fn a_greedy_episode_executes_the_policy_and_is_advised_as_any_other() {
    let mut order = slot(&[3, 4], true);
    order.episodes[0].exploration = EpisodeExploration::Greedy;
    let mut teacher = FakeTeacher::new(|episode, step, _| episode == 3 && step == 7);
    let episodes = play(&order, FakeActor::Constant(0.1), &mut teacher);
    for step_idx in 0..50 {
        let expected = if step_idx == 7 { TEACHER_ACTION } else { [0.1; 3] };
        for arm in LAYOUT.arms() {
            assert_eq!(episodes[0].action(step_idx)[LAYOUT.action_of(arm)], expected);
        }
    }
    assert!(episodes[1].actions.iter().any(|component| *component != 0.1), "the other explores");
}

#[test]
fn a_warm_up_ignores_the_policy() {
    let mut order = slot(&[3], false);
    order.episodes[0].exploration = EpisodeExploration::Uniform;
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
    assert_eq!((episode.advised_arms.as_slice(), episode.advice_charged), ([0; 50].as_slice(), 0));
}

#[test]
fn an_override_without_a_charge_is_an_error() {
    let mut advisor = FixedFlags { overridden: true, charged: false };
    let played = play_slot(
        &mut FakeEnvironment::new(),
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
        &mut FakeEnvironment::new(),
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

#[test]
fn an_order_ends_the_queries_and_every_query_is_counted() {
    let mut order = slot(&[3, 8, 9], true);
    order.episodes[0].advised_steps = Some(4);
    order.episodes[1].advised_steps = Some(0);
    let mut teacher = FakeTeacher::new(|_, _, _| true);
    let episodes = play(&order, FakeActor::Seeker, &mut teacher);
    let queried: Vec<_> = episodes.iter().map(|episode| episode.queried_steps).collect();
    assert_eq!(queried, [Some(4), Some(0), Some(50)]);
    let asked: Vec<usize> = teacher.requests.iter().map(Vec::len).collect();
    assert_eq!(asked[..6], [2, 2, 2, 2, 1, 1]);
    assert_eq!(episodes[0].advised_arms[..5], [0b11, 0b11, 0b11, 0b11, 0]);
    assert_eq!(episodes.iter().map(|e| e.advice_charged).collect::<Vec<_>>(), [4, 0, 50]);
}

#[test]
fn a_student_that_knows_its_values_does_not_ask() {
    struct Gated(FakeActor);

    impl Act for Gated {
        fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
            self.0.act(observations, goals, actions);
        }

        fn asks(&mut self, _observation: &[f32], _goal: &[f32], action: &[f32]) -> bool {
            assert_eq!(action, [0.1; 6], "the action without exploration");
            false
        }
    }

    let mut teacher = FakeTeacher::new(|_, _, _| true);
    let (env, order) = (&mut FakeEnvironment::new(), slot(&[3], true));
    let actor = &mut Gated(FakeActor::Constant(0.1));
    let gated = play_slot(env, &order, &terms(), actor, &mut teacher).expect("no step fails");
    assert_eq!((gated[0].queried_steps, teacher.requests.len()), (Some(0), 0));
    let free = play(&slot(&[3], false), FakeActor::Constant(0.1), &mut NoAdvisor);
    assert_eq!(gated, free, "as without advice");
}
