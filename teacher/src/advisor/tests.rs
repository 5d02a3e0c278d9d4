use super::*;
use crate::fake::{FakePolicy, query};
use crate::ledger::MemoryLedger;
use crate::policy::TeacherPolicy;

fn advisor(budget: u64, strategy: &str) -> Advisor {
    let mut advisor =
        Advisor::new(Box::new(FakePolicy), Box::new(MemoryLedger::default())).unwrap();
    advisor
        .open_account("run", AccountTerms { budget, strategy: strategy.parse().unwrap() })
        .unwrap();
    advisor
}

fn request(account: &str, queries: &[StepQuery]) -> AdviceRequest {
    AdviceRequest { account: account.to_owned(), queries: queries.to_vec() }
}

/// Answers one request.
fn advise(advisor: &mut Advisor, account: &str, queries: &[StepQuery]) -> Result<Advice, Error> {
    advisor.advise(&[request(account, queries)]).remove(0)
}

fn ask(advisor: &mut Advisor, query: &StepQuery) -> StepAdvice {
    advise(advisor, "run", std::slice::from_ref(query)).unwrap().steps.remove(0)
}

/// Returns a query for which the teacher's actions are (0.5, 0, 0) and (0, 0.25, 0), with importances 0.25 and 0.0625
/// and distances 0.5 and 0.25.
fn two_arms(step: u32) -> StepQuery {
    query(1, step, 0.5, 0.25)
}

#[test]
fn each_strategy_overrides_the_arms_that_its_procedure_selects() {
    let check = |strategy: &str, overridden_arms: u8, action: [f32; 6]| {
        let advice = ask(&mut advisor(10, strategy), &two_arms(0));
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
    check("rlif:0.0625", 0b01, first);
    check("jsrl:1", 0b11, both);
    check("ts2c:9", 0b01, first);
}

#[test]
fn a_jump_start_ends_at_its_horizon_and_with_the_budget() {
    let mut advisor = advisor(5, "jsrl:3");
    let mut advised = |episode| {
        let steps = (0..5).map(|step| ask(&mut advisor, &query(episode, step, 0.5, 0.25)));
        steps.map(|advice| advice.overridden_arms()).collect::<Vec<_>>()
    };
    assert_eq!(advised(1), [0b11, 0b11, 0b11, 0, 0]);
    assert_eq!(advised(2), [0b11, 0b11, 0, 0, 0], "five units in all");
}

#[test]
fn a_lost_account_is_judged_by_the_strategy_with_which_it_is_opened_anew() {
    let terms = |strategy: &str| AccountTerms { budget: 10, strategy: strategy.parse().unwrap() };
    let mut advisor = advisor(10, "mc-q:0.25");
    assert_eq!(ask(&mut advisor, &two_arms(0)).overridden_arms(), 0b00);
    advisor.ledger = Box::new(MemoryLedger::default());
    advisor.open_account("run", terms("ea")).unwrap();
    assert_eq!(ask(&mut advisor, &two_arms(0)).overridden_arms(), 0b11);

    // Another teacher opens it.
    advisor.ledger = Box::new(MemoryLedger::default());
    advise(&mut advisor, "run", &[two_arms(0)]).unwrap_err();
    advisor.ledger.open("run", terms("mc-q:0.25")).unwrap();
    assert_eq!(ask(&mut advisor, &two_arms(0)).overridden_arms(), 0b00);

    // Another teacher opens it before this one has noticed that it was lost.
    advisor.ledger = Box::new(MemoryLedger::default());
    advisor.ledger.open("run", terms("mc-q:0.0625")).unwrap();
    let refused = advise(&mut advisor, "run", &[two_arms(0)]).unwrap_err().to_string();
    assert_eq!(refused, "account \"run\" now has strategy mc-q:0.0625: ask again");
    assert_eq!(ask(&mut advisor, &two_arms(0)).overridden_arms(), 0b01);
    assert_eq!(advisor.balance("run").unwrap().spent, 1);
}

#[test]
fn advice_on_a_step_that_was_decided_before_is_marked() {
    let advisor = &mut advisor(10, "ea");
    assert!(!ask(advisor, &two_arms(0)).repeated);
    let again = ask(advisor, &query(1, 0, 0.25, 0.25));
    assert!(again.repeated && again.charged, "other numbers for the same step");
    assert!(!ask(advisor, &two_arms(1)).repeated, "another step");
}

#[test]
fn every_strategy_returns_the_scores() {
    for strategy in ["none", "ea", "eamc", "mc-q", "mc-act", "mc-act-abs", "jsrl", "rlif", "ts2c"] {
        for budget in [0, 10] {
            let advice = ask(&mut advisor(budget, strategy), &two_arms(0));
            let scores: Vec<_> = advice
                .arms
                .iter()
                .map(|arm| (arm.q_teacher, arm.q_student, arm.importance, arm.distance))
                .collect();
            assert_eq!(
                scores,
                [(0.0, -0.25, 0.25, 0.5), (0.0, -0.0625, 0.0625, 0.25)],
                "{strategy}"
            );
            assert_eq!(advice.arms[1].teacher_action, [0.0, 0.25, 0.0], "{strategy}");
        }
    }
}

#[test]
fn without_budget_the_students_action_is_returned_uncharged() {
    for strategy in ["none", "ea", "eamc", "mc-q", "mc-act", "mc-act-abs", "jsrl", "rlif", "ts2c"] {
        let advice = ask(&mut advisor(0, strategy), &two_arms(0));
        assert_eq!((advice.charged, advice.overridden_arms()), (false, 0), "{strategy}");
        assert_eq!(advice.action, [0.0; 6], "{strategy}");
    }
}

#[test]
fn eamc_switches_to_mistake_correcting_at_half_of_the_budget() {
    let mut advisor = advisor(4, "eamc:0.1");
    let overridden: Vec<(u8, bool)> = (0..7)
        .map(|step| {
            ask(&mut advisor, &if step == 3 { query(1, step, 0.0, 0.0) } else { two_arms(step) })
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
fn a_step_with_other_numbers_keeps_its_verdict_and_is_noticed() {
    let mut advisor = advisor(10, "mc-q:0.1");
    assert!(ask(&mut advisor, &query(1, 0, 0.5, 0.0)).charged);
    assert!(ask(&mut advisor, &query(1, 0, 0.5, 0.0)).charged, "the same numbers");
    assert!(advisor.reused.is_empty(), "a repetition is expected");
    let changed = ask(&mut advisor, &query(1, 0, 0.0, 0.0));
    assert_eq!((changed.charged, changed.overridden_arms()), (true, 0));
    assert_eq!(advisor.reused.iter().collect::<Vec<_>>(), ["run"]);
}

#[test]
fn a_repeated_query_gets_the_same_answer_in_any_phase() {
    let mut advisor = advisor(4, "eamc:0.1");
    let first: Vec<StepAdvice> = (0..6).map(|step| ask(&mut advisor, &two_arms(step))).collect();
    let spent = advisor.balance("run").unwrap();
    let again: Vec<StepAdvice> = (0..6).map(|step| ask(&mut advisor, &two_arms(step))).collect();
    let marked = |advice: StepAdvice| StepAdvice { repeated: true, ..advice };
    assert_eq!(again, first.into_iter().map(marked).collect::<Vec<_>>());
    assert_eq!(advisor.balance("run").unwrap(), spent);
}

#[test]
fn an_arm_is_advised_from_its_own_numbers_only() {
    let mut advisor = advisor(10, "ea");
    let mut query = query(1, 0, 0.5, 0.25);
    query.observation[28..31].copy_from_slice(&[0.0625, 0.0, -0.125]);
    query.goal[..3].copy_from_slice(&[0.0, 0.0, 0.75]);
    assert_eq!(ask(&mut advisor, &query).action, [0.5, 0.0, 0.75, 0.0625, 0.25, -0.125]);
}

#[test]
fn the_judged_action_decides_and_the_proposed_one_is_executed() {
    let mut advisor = advisor(10, "mc-act:0.1");
    let proposed_action = vec![0.75, 0.75, 0.75, -0.75, -0.75, -0.75];
    let best = vec![0.5, 0.0, 0.0, 0.0, 0.25, 0.0];
    let near = StepQuery {
        proposed_action: proposed_action.clone(),
        judged_action: Some(best.clone()),
        ..two_arms(0)
    };
    let advice = ask(&mut advisor, &near);
    assert_eq!((advice.overridden_arms(), advice.charged), (0b00, false));
    assert_eq!(advice.action, proposed_action, "exploration is not corrected");
    let far = StepQuery { judged_action: Some(vec![0.0; 6]), ..near };
    let far = StepQuery { step: 1, proposed_action: best.clone(), ..far };
    let advice = ask(&mut advisor, &far);
    assert_eq!((advice.overridden_arms(), advice.arms[0].distance), (0b11, 0.5));
    assert_eq!(advice.action, best);
}

#[test]
fn queries_of_one_payer_and_step_share_a_unit() {
    let mut advisor = advisor(2, "mc-act:0.1");
    let far = |episode, step| StepQuery { payer: Some(1), ..query(episode, step, 0.5, 0.25) };
    let near = |episode, step| StepQuery { payer: Some(1), ..query(episode, step, 0.0, 0.0) };
    let shown = |advice: &Advice| -> Vec<(u8, bool)> {
        advice.steps.iter().map(|step| (step.overridden_arms(), step.charged)).collect()
    };
    let none = advise(&mut advisor, "run", &[near(1, 0), near(2, 0)]).unwrap();
    assert_eq!((shown(&none), none.budget_left), (vec![(0, false); 2], 2));
    let second = [near(1, 1), far(2, 1), far(3, 1)];
    let mixed = advise(&mut advisor, "run", &second).unwrap();
    let expected = vec![(0, true), (0b11, true), (0b11, true)];
    assert_eq!((shown(&mixed), mixed.budget_left), (expected.clone(), 1), "one unit for three");
    let again = advise(&mut advisor, "run", &second).unwrap();
    assert_eq!((shown(&again), again.budget_left), (expected, 1), "a repeated request is free");
    let own = |episode| StepQuery { payer: None, ..far(episode, 2) };
    let last = advise(&mut advisor, "run", &[own(2), own(3)]).unwrap();
    assert_eq!((shown(&last), last.budget_left), (vec![(0b11, true), (0, false)], 0));
}

#[test]
fn a_query_without_payer_shares_the_unit_of_queries_that_name_its_episode() {
    let near = query(1, 0, 0.0, 0.0);
    let far = query(1, 0, 0.5, 0.25);
    let paid_by_it = StepQuery { episode: 2, payer: Some(1), ..far.clone() };
    for queries in [[near.clone(), paid_by_it.clone()], [paid_by_it, near.clone()], [near, far]] {
        let advice = advise(&mut advisor(10, "mc-act:0.1"), "run", &queries).unwrap();
        let charged: Vec<bool> = advice.steps.iter().map(|step| step.charged).collect();
        assert_eq!((charged, advice.budget_left), (vec![true; 2], 9), "{queries:?}");
        assert!(advice.steps.iter().all(|step| !step.repeated), "one decision for both");
    }
}

#[test]
fn one_request_may_hold_students_with_different_numbers_of_arms() {
    let mut advisor = advisor(10, "ea");
    let three_arms = StepQuery {
        episode: 2,
        step: 0,
        observation: vec![0.125; 84],
        goal: vec![0.0; 9],
        proposed_action: vec![0.0; 9],
        judged_action: None,
        payer: None,
    };
    let advice = advise(&mut advisor, "run", &[two_arms(0), three_arms, two_arms(1)]).unwrap();
    let actions: Vec<&[f32]> = advice.steps.iter().map(|step| step.action.as_slice()).collect();
    let both = [0.5, 0.0, 0.0, 0.0, 0.25, 0.0];
    assert_eq!(actions, [&both[..], &[0.125; 9], &both]);
    assert_eq!(advice.steps[1].arms.len(), 3);
    assert_eq!(advice.budget_left, 7);
}

#[test]
fn a_refused_request_charges_nothing() {
    let mut advisor = advisor(10, "ea");
    advisor.open_leases("run", &[2], 5).unwrap();
    let before = advisor.balance("run").unwrap();
    let beyond = [two_arms(0), query(2, 50, 0.5, 0.5)];
    let refusal = advise(&mut advisor, "run", &beyond).unwrap_err().to_string();
    assert_eq!(refusal, "steps[1].step: expected 0 to 49 in an episode that has a lease, got 50");
    assert_eq!(advisor.balance("run").unwrap(), before);
    assert!(ask(&mut advisor, &two_arms(50)).charged, "an episode without a lease may be longer");
    let unknown = advise(&mut advisor, "walk", &[]);
    assert!(matches!(unknown, Err(Error::Ledger(LedgerError::Budget(_)))));
}

/// A policy whose values are NaN beyond 0.9 on the first axis.
struct Broken;

impl TeacherPolicy for Broken {
    fn task(&self) -> TaskSpec {
        FakePolicy.task()
    }

    fn digest(&self) -> &str {
        ""
    }

    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        FakePolicy.act(observations, goals, actions);
    }

    fn q(&mut self, observations: &[f32], goals: &[f32], actions: &[f32], q: &mut [f32]) {
        FakePolicy.q(observations, goals, actions, q);
        for (q, observation) in q.iter_mut().zip(observations.chunks_exact(28)) {
            *q = if observation[0] > 0.9 { f32::NAN } else { *q };
        }
    }
}

#[test]
fn a_refused_request_does_not_affect_the_others_of_its_batch() {
    let mut advisor = Advisor::new(Box::new(Broken), Box::new(MemoryLedger::default())).unwrap();
    let terms = AccountTerms { budget: 10, strategy: Strategy::EarlyAdvising };
    advisor.open_account("run", terms).unwrap();
    advisor.open_leases("run", &[2], 5).unwrap();
    let answers = advisor.advise(&[
        request("run", &[two_arms(0), two_arms(1)]),
        request("walk", &[two_arms(2)]),
        request("run", &[two_arms(3), query(1, 4, 0.95, 0.0), two_arms(5)]),
        request("run", &[two_arms(6), query(2, 50, 0.5, 0.5)]),
        request("run", &[]),
        request("run", &[two_arms(0), two_arms(7)]),
    ]);
    let outcomes: Vec<_> = answers
        .iter()
        .map(|answer| match answer {
            Ok(advice) => Ok((advice.steps.len(), advice.budget_left)),
            Err(error) => Err(error.to_string()),
        })
        .collect();
    let refused = |message: &str| Err(message.to_owned());
    let expected = [
        Ok((2, 3)),
        refused("unknown account \"walk\": open it first"),
        refused(
            "the teacher's networks returned a number that is not finite for step 4 of episode 1",
        ),
        refused("steps[1].step: expected 0 to 49 in an episode that has a lease, got 50"),
        Ok((0, 2)),
        Ok((2, 2)),
    ];
    assert_eq!(outcomes, expected);
    assert_eq!(advisor.balance("run").unwrap().spent, 3, "steps 0, 1 and 7");
}

#[test]
fn a_policy_that_fails_is_a_warning_until_it_succeeds() {
    let mut advisor = Advisor::new(Box::new(Broken), Box::new(MemoryLedger::default())).unwrap();
    let terms = AccountTerms { budget: 10, strategy: Strategy::EarlyAdvising };
    advisor.open_account("run", terms).unwrap();
    let failing = query(1, 4, 0.95, 0.0);
    let failure = advise(&mut advisor, "run", &[two_arms(0), failing]).unwrap_err().to_string();
    assert!(failure.contains("not finite for step 4 of episode 1"), "{failure}");
    assert_eq!(advisor.warning(), Some(failure.as_str()));
    advise(&mut advisor, "run", &[]).unwrap();
    assert_eq!(advisor.warning(), Some(failure.as_str()), "nothing was evaluated");
    ask(&mut advisor, &two_arms(1));
    assert_eq!(advisor.warning(), None);
}

/// Returns requests of several accounts and sizes, some of them for the same steps.
fn many_requests() -> Vec<AdviceRequest> {
    let step = |number: u16| {
        let (x, y) = (f32::from(number % 7) / 10.0, f32::from(number % 5) / 10.0);
        query(u64::from(number % 3), u32::from(number / 2), x, y)
    };
    (0..120_u16)
        .map(|number| {
            let account = ["run", "walk", "unknown"][usize::from(number % 17 % 3)];
            let queries: Vec<StepQuery> =
                (0..number % 4).map(|idx| step(3 * number + 5 * idx)).collect();
            request(account, &queries)
        })
        .filter(|request| !request.queries.is_empty())
        .collect()
}

#[test]
fn questions_answered_together_get_what_they_would_get_one_by_one() {
    let fresh = || {
        let mut advisor = advisor(40, "eamc:0.05");
        let terms = AccountTerms { budget: 30, strategy: Strategy::MistakeAction { alpha: 0.3 } };
        advisor.open_account("walk", terms).unwrap();
        advisor.open_leases("run", &[0, 1], 8).unwrap();
        advisor
    };
    let shown = |answers: Vec<Result<Advice, Error>>| -> Vec<Result<Advice, String>> {
        answers.into_iter().map(|answer| answer.map_err(|error| error.to_string())).collect()
    };
    let requests = many_requests();
    let mut alone = fresh();
    let one_by_one: Vec<_> = shown(
        requests.iter().map(|one| alone.advise(std::slice::from_ref(one)).remove(0)).collect(),
    );
    assert!(one_by_one.iter().flatten().any(|advice| advice.steps.iter().any(|s| s.charged)));
    assert!(one_by_one.iter().any(Result::is_err));
    for batch_size in [2, 7, requests.len()] {
        let mut together = fresh();
        let answers =
            requests.chunks(batch_size).flat_map(|batch| together.advise(batch)).collect();
        assert_eq!(shown(answers), one_by_one, "in batches of {batch_size}");
        for account in ["run", "walk"] {
            assert_eq!(together.balance(account).unwrap(), alone.balance(account).unwrap());
        }
    }
}

#[test]
fn the_strategy_of_an_account_is_cached() {
    let mut advisor = advisor(10, "ea");
    ask(&mut advisor, &two_arms(0));
    assert_eq!(advisor.strategies.get("run"), Some(&Strategy::EarlyAdvising));
    for number in 0..MAX_CACHED_STRATEGIES {
        advisor.strategies.insert(number.to_string(), Strategy::NoAdvice);
    }
    let terms = AccountTerms { budget: 10, strategy: Strategy::NoAdvice };
    advisor.open_account("walk", terms).unwrap();
    let advice = advise(&mut advisor, "walk", &[two_arms(0)]).unwrap();
    assert_eq!((advice.steps[0].charged, advisor.strategies.len()), (false, 1));
    assert!(ask(&mut advisor, &two_arms(1)).charged, "looked up again");
}

/// A policy that values nothing: `q` must not be called.
struct Valueless;

impl TeacherPolicy for Valueless {
    fn task(&self) -> TaskSpec {
        FakePolicy.task()
    }

    fn digest(&self) -> &str {
        ""
    }

    fn has_values(&self) -> bool {
        false
    }

    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        FakePolicy.act(observations, goals, actions);
    }

    fn q(&mut self, _observations: &[f32], _goals: &[f32], _actions: &[f32], _q: &mut [f32]) {
        panic!("a policy without values is asked for them");
    }
}

#[test]
fn a_policy_without_values_advises_by_strategies_that_compare_none() {
    let mut ledger = MemoryLedger::default();
    let terms = |strategy: &str| AccountTerms { budget: 10, strategy: strategy.parse().unwrap() };
    ledger.open("from-before", terms("mc-q:0.1")).unwrap();
    let mut advisor = Advisor::new(Box::new(Valueless), Box::new(ledger)).unwrap();
    for strategy in ["mc-q:0.1", "eamc:0.1"] {
        let refusal = advisor.open_account(strategy, terms(strategy)).unwrap_err().to_string();
        let expected = format!(
            "strategy {strategy} compares values of actions, and the teacher's policy has no critic: use none, ea, \
             mc-act:A, mc-act-abs:A, jsrl:H, or a teacher with a critic"
        );
        assert_eq!(refusal, expected);
    }
    let refused = advise(&mut advisor, "from-before", &[two_arms(0)]);
    assert!(matches!(refused, Err(Error::NoValues { .. })), "{refused:?}");
    for strategy in ["ea", "mc-act:0.1", "mc-act-abs:0.1"] {
        advisor.open_account(strategy, terms(strategy)).unwrap();
        let advice = advise(&mut advisor, strategy, &[two_arms(0)]).unwrap();
        assert!(advice.steps[0].charged, "{strategy}");
        let scores = advice.steps[0].arms.iter().map(|arm| (arm.q_teacher, arm.importance));
        assert!(scores.eq([(0.0, 0.0); 2]), "{strategy}");
    }
}
