use std::collections::BTreeMap;
use std::thread;

use tandem_core::Task;

use super::*;
use crate::fake::{FakePolicy, query};
use crate::ledger::MemoryLedger;

fn advisor(budget: u64, strategy: &str) -> Advisor {
    let advisor = Advisor::new(Box::new(FakePolicy), Box::new(MemoryLedger::default())).unwrap();
    advisor.open_account("run", Terms { budget, strategy: strategy.parse().unwrap() }).unwrap();
    advisor
}

fn ask(advisor: &Advisor, query: &StepQuery) -> StepAdvice {
    advisor.advise("run", std::slice::from_ref(query)).unwrap().steps.remove(0)
}

/// The teacher would act (0.5, 0, 0) and (0, 0.25, 0): importances 0.25 and 0.0625, distances 0.5 and 0.25.
fn two_arms(step: u32) -> StepQuery {
    query(1, step, 0.5, 0.25)
}

#[test]
fn each_strategy_overrides_the_arms_that_its_procedure_picks() {
    let check = |strategy: &str, overridden_arms: u8, action: [f32; 6]| {
        let advice = ask(&advisor(10, strategy), &two_arms(0));
        assert_eq!(advice.overridden_arms(), overridden_arms, "{strategy}");
        assert_eq!(advice.action, action, "{strategy}");
        assert_eq!(advice.charged, overridden_arms != 0, "{strategy}");
    };
    let (neither, first, both) =
        ([0.0; 6], [0.5, 0.0, 0.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0, 0.25, 0.0]);
    check("none", 0b00, neither);
    check("ea", 0b11, both);
    check("eamc:100", 0b11, both);
    check("mc-q:0.0624", 0b11, both);
    check("mc-q:0.0625", 0b01, first);
    check("mc-q:0.25", 0b00, neither);
    check("mc-act:0.249", 0b11, both);
    check("mc-act:0.25", 0b01, first);
    check("mc-act:0.5", 0b00, neither);
    check("mc-act-abs:0.999", 0b11, both);
    check("mc-act-abs:1", 0b00, neither);
}

#[test]
fn every_strategy_tells_what_the_teacher_thinks() {
    for strategy in ["none", "ea", "eamc", "mc-q", "mc-act", "mc-act-abs"] {
        for budget in [0, 10] {
            let advice = ask(&advisor(budget, strategy), &two_arms(0));
            let thoughts: Vec<_> = advice
                .arms
                .iter()
                .map(|arm| (arm.q_teacher, arm.q_student, arm.importance, arm.distance))
                .collect();
            assert_eq!(
                thoughts,
                [(0.0, -0.25, 0.25, 0.5), (0.0, -0.0625, 0.0625, 0.25)],
                "{strategy}"
            );
            assert_eq!(advice.arms[1].teacher_action, [0.0, 0.25, 0.0], "{strategy}");
        }
    }
}

#[test]
fn without_budget_the_students_action_comes_back_uncharged() {
    for strategy in ["none", "ea", "eamc", "mc-q", "mc-act", "mc-act-abs"] {
        let advice = ask(&advisor(0, strategy), &two_arms(0));
        assert_eq!((advice.charged, advice.overridden_arms()), (false, 0), "{strategy}");
        assert_eq!(advice.action, [0.0; 6], "{strategy}");
    }
}

#[test]
fn eamc_goes_over_to_mistake_correcting_at_half_of_the_budget() {
    let advisor = advisor(4, "eamc:0.1");
    let overridden: Vec<(u8, bool)> = (0..7)
        .map(|step| {
            ask(&advisor, &if step == 3 { query(1, step, 0.0, 0.0) } else { two_arms(step) })
        })
        .map(|advice| (advice.overridden_arms(), advice.charged))
        .collect();
    let early = (0b11, true);
    let corrected = (0b01, true);
    let left_alone = (0b00, false);
    assert_eq!(
        overridden,
        [early, early, corrected, left_alone, corrected, left_alone, left_alone]
    );
}

#[test]
fn a_repeated_query_gets_the_same_answer_in_any_phase() {
    let advisor = advisor(4, "eamc:0.1");
    let first: Vec<StepAdvice> = (0..6).map(|step| ask(&advisor, &two_arms(step))).collect();
    let spent = advisor.balance("run").unwrap();
    let again: Vec<StepAdvice> = (0..6).map(|step| ask(&advisor, &two_arms(step))).collect();
    assert_eq!(again, first);
    assert_eq!(advisor.balance("run").unwrap(), spent);
}

#[test]
fn an_arm_is_advised_from_its_own_numbers_only() {
    let advisor = advisor(10, "ea");
    let mut query = query(1, 0, 0.5, 0.25);
    query.observation[28..31].copy_from_slice(&[0.0625, 0.0, -0.125]);
    query.goal[..3].copy_from_slice(&[0.0, 0.0, 0.75]);
    assert_eq!(ask(&advisor, &query).action, [0.5, 0.0, 0.75, 0.0625, 0.25, -0.125]);
}

#[test]
fn one_request_may_hold_students_of_several_layouts() {
    let advisor = advisor(10, "ea");
    let three_arms = StepQuery {
        episode: 2,
        step: 0,
        observation: vec![0.125; 84],
        goal: vec![0.0; 9],
        proposed_action: vec![0.0; 9],
    };
    let advice = advisor.advise("run", &[two_arms(0), three_arms, two_arms(1)]).unwrap();
    let actions: Vec<&[f32]> = advice.steps.iter().map(|step| step.action.as_slice()).collect();
    let both = [0.5, 0.0, 0.0, 0.0, 0.25, 0.0];
    assert_eq!(actions, [&both[..], &[0.125; 9], &both]);
    assert_eq!(advice.steps[1].arms.len(), 3);
    assert_eq!(advice.budget_left, 7);
}

#[test]
fn a_refused_request_charges_nothing() {
    let advisor = advisor(10, "ea");
    advisor.open_leases("run", &[2], 5).unwrap();
    let before = advisor.balance("run").unwrap();
    let refusal =
        advisor.advise("run", &[two_arms(0), query(2, 50, 0.5, 0.5)]).unwrap_err().to_string();
    assert_eq!(refusal, "steps[1].step: expected 0 to 49 in an episode that has a lease, got 50");
    assert_eq!(advisor.balance("run").unwrap(), before);
    assert!(ask(&advisor, &two_arms(50)).charged, "an episode without a lease may be longer");
    assert!(matches!(advisor.advise("walk", &[]), Err(Error::Ledger(LedgerError::Budget(_)))));
}

/// Values everything at NaN.
struct Broken;

impl TeacherPolicy for Broken {
    fn layout(&self) -> Layout {
        Layout::new(Task::Push, 1)
    }

    fn digest(&self) -> &str {
        ""
    }

    fn act(&mut self, _: &[f32], _: &[f32], _: &mut [f32]) {}

    fn q(&mut self, _: &[f32], _: &[f32], _: &[f32], q: &mut [f32]) {
        q.fill(f32::NAN);
    }
}

#[test]
fn advice_that_is_not_finite_is_not_given() {
    let advisor = Advisor::new(Box::new(Broken), Box::new(MemoryLedger::default())).unwrap();
    advisor.open_account("run", Terms { budget: 1, strategy: Strategy::EarlyAdvising }).unwrap();
    let refused = advisor.advise("run", &[two_arms(3)]);
    assert!(matches!(refused, Err(Error::NotFinite { episode: 1, step: 3 })));
    assert_eq!(advisor.balance("run").unwrap().spent, 0);
}

/// 64 threads, every step asked about by two of them: what the budget pays for is charged once, and no more.
#[test]
fn a_budget_is_never_overspent_and_no_step_is_charged_twice() {
    let advisor = advisor(10_000, "ea");
    let charged_steps_of = |thread_idx: u64| -> BTreeMap<(u64, u32), bool> {
        let episode = thread_idx / 2;
        (0..400)
            .map(|step| ((episode, step), ask(&advisor, &query(episode, step, 0.5, 0.5)).charged))
            .collect()
    };
    let by_thread: Vec<BTreeMap<(u64, u32), bool>> = thread::scope(|scope| {
        let threads: Vec<_> =
            (0..64).map(|thread_idx| scope.spawn(move || charged_steps_of(thread_idx))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    });
    for pair in by_thread.chunks_exact(2) {
        assert_eq!(pair[0], pair[1], "the two threads that asked about the same steps");
    }
    let n_charged =
        by_thread.iter().step_by(2).flat_map(BTreeMap::values).filter(|charged| **charged).count();
    assert_eq!(n_charged, 10_000);
    assert_eq!(
        (advisor.balance("run").unwrap().spent, advisor.balance("run").unwrap().left),
        (10_000, 0)
    );
}
