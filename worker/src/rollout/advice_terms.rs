//! Tests of the settings that say how workers ask for advice.

use tandem_core::AdviceTerms;

use super::*;
use crate::fakes::{FakeActor, FakeEnvironment, FakeTeacher, slot, terms};

fn play(
    advice: AdviceTerms,
    order: &SlotOrder,
    teacher: &mut FakeTeacher<impl Fn(u64, u32, usize) -> bool>,
) -> Vec<Episode> {
    let (mut env, mut actor) = (FakeEnvironment::new(), FakeActor::Constant(0.1));
    let terms = RunTerms { advice, ..terms() };
    play_slot(&mut env, order, &terms, &mut actor, teacher).expect("no step fails")
}

#[test]
fn the_judged_action_is_the_policys_without_exploration() {
    let advice = AdviceTerms { judged_action: JudgedAction::Policy, ..AdviceTerms::default() };
    let order = slot(&[3], true);
    let mut teacher = FakeTeacher::new(|_, _, _| false);
    let judged = play(advice, &order, &mut teacher);
    let queries: Vec<&StepQuery> = teacher.requests.iter().flatten().collect();
    assert!(queries.iter().all(|query| query.judged() == [0.1; 6]));
    assert!(queries.iter().any(|query| query.proposed_action != [0.1; 6]), "it explores");
    let mut teacher = FakeTeacher::new(|_, _, _| false);
    assert_eq!(play(AdviceTerms::default(), &order, &mut teacher), judged, "without advice");
    assert!(teacher.requests.iter().flatten().all(|query| query.judged_action.is_none()));
}

#[test]
fn the_first_advised_episode_of_a_slot_claims_the_units_of_lock_steps() {
    let advice = AdviceTerms { unit: AdviceUnit::SlotStep, ..AdviceTerms::default() };
    let mut order = slot(&[3, 8, 9], true);
    order.episodes[0].advised = false;
    // Episode 8 is overridden on steps 0 to 9, episode 9 on steps 5 to 24.
    let overrides = |episode, step, arm| {
        arm == 0 && if episode == 8 { step < 10 } else { (5..25).contains(&step) }
    };
    let mut teacher = FakeTeacher::new(overrides);
    let episodes = play(advice, &order, &mut teacher);
    let charged: Vec<u32> = episodes.iter().map(|episode| episode.advice_charged).collect();
    assert_eq!(charged, [0, 25, 0]);
    let n_advised = |episode: &Episode| episode.advised_arms.iter().filter(|a| **a != 0).count();
    assert_eq!(episodes.iter().map(n_advised).collect::<Vec<_>>(), [0, 10, 20]);
    assert!(teacher.requests.iter().flatten().all(|query| query.payer == Some(8)));
}
