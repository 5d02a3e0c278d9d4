//! The operations of every ledger.

use tandem_teacher::budget::{AccountTerms, Balance, MAX_BUDGET};
use tandem_teacher::{Strategy, ledger::ChargeRequest, ledger::LedgerError};

use crate::ledger_tests::fixture::{
    BOTH, FIRST, NEITHER, NOTHING, SECOND, TestLedger, charge, inverted, lease, request, terms,
};

pub(crate) fn an_account_is_opened_once_and_keeps_its_terms(mut fixture: TestLedger) {
    let fresh = Balance { terms: terms(10), spent: 0, leased: 0, left: 10 };
    assert_eq!(fixture.open("run", 10), fresh);
    fixture.charge("run", &[charge(1, 0, BOTH)]);
    for _ in 0..2 {
        assert_eq!(fixture.open("run", 10), Balance { spent: 1, left: 9, ..fresh });
        let other = AccountTerms { budget: 11, strategy: Strategy::MistakeQ { threshold: 0.05 } };
        let refused = fixture.ledger().open("run", other).unwrap_err().to_string();
        assert_eq!(
            refused,
            "account \"run\" is open with budget 10 and strategy eamc:0.1, not with budget 11 and strategy mc-q:0.05"
        );
        let too_large = AccountTerms { budget: MAX_BUDGET + 1, ..terms(0) };
        let refused = fixture.ledger().open("run", too_large).unwrap_err().to_string();
        assert_eq!(refused, "budget: expected 0 to 1000000000000, got 1000000000001");
        fixture.close();
    }
}

pub(crate) fn an_account_that_is_not_open_is_refused_by_name(mut fixture: TestLedger) {
    fixture.open("run", 10);
    let mut refusals = vec![
        fixture.ledger().balance("nun").unwrap_err(),
        fixture.ledger().open_leases("nun", &[1], 5).unwrap_err(),
        fixture.ledger().settle("nun", &[1]).unwrap_err(),
    ];
    let requests = [request("nun", &[charge(1, 0, BOTH)]), request("run", &[charge(1, 0, BOTH)])];
    let mut outcomes = fixture.ledger().charge(&requests);
    assert_eq!(outcomes.pop().unwrap().unwrap().verdicts, [FIRST], "the other request is charged");
    refusals.push(outcomes.pop().unwrap().unwrap_err());
    for refused in refusals {
        assert_eq!(refused.to_string(), "unknown account \"nun\": open it first");
    }
}

pub(crate) fn a_request_is_charged_as_a_whole_or_not(mut fixture: TestLedger) {
    fixture.open("run", 100);
    fixture.leases("run", &[1], 50);
    let beyond = [charge(1, 49, BOTH), charge(2, 0, BOTH), charge(1, 50, BOTH), charge(1, 3, BOTH)];
    let requests = [
        request("run", &[charge(1, 7, BOTH)]),
        request("run", &beyond),
        request("run", &beyond[..2]),
    ];
    let outcomes = fixture.ledger().charge(&requests);
    assert_eq!(outcomes[0].as_ref().unwrap().verdicts, [FIRST]);
    let refused = outcomes[1].as_ref().unwrap_err();
    assert!(matches!(refused, LedgerError::BeyondEnd { charge_idx: 2 }), "{refused}");
    assert_eq!(outcomes[2].as_ref().unwrap().left, 49);
    assert_eq!(fixture.state("run"), (3, 48, 49));
    fixture.close();
    // The steps of the refused request have no verdict yet.
    assert_eq!(fixture.charge("run", &[charge(1, 3, NEITHER)]), [NOTHING]);
    assert_eq!(fixture.state("run"), (3, 48, 49));
}

pub(crate) fn a_request_that_another_strategy_decided_charges_nothing(mut fixture: TestLedger) {
    fixture.open("run", 10);
    let strategy = Strategy::MistakeQ { threshold: 0.05 };
    let of_another = ChargeRequest {
        strategy,
        ..request("run", &[charge(1, 0, NEITHER), charge(1, 1, BOTH), charge(1, 50, BOTH)])
    };
    let requests = [of_another, request("run", &[charge(1, 1, BOTH)])];
    let outcomes = fixture.ledger().charge(&requests);
    let refused = outcomes[0].as_ref().unwrap_err();
    assert_eq!(refused.to_string(), "account \"run\" now has strategy eamc:0.1: ask again");
    assert!(matches!(refused, LedgerError::OtherStrategy { .. }), "{refused:?}");
    let charged = outcomes[1].as_ref().unwrap();
    assert_eq!(
        (charged.verdicts.as_slice(), charged.repeated.as_slice()),
        ([FIRST].as_slice(), [false].as_slice())
    );
    assert_eq!(fixture.state("run"), (1, 0, 9));
    fixture.close();
    assert_eq!(fixture.charge("run", &[charge(1, 0, BOTH)]), [FIRST], "it has no verdict yet");
}

pub(crate) fn an_episode_without_a_lease_has_no_end(mut fixture: TestLedger) {
    fixture.open("run", 10);
    let far = [charge(1, 50, BOTH), charge(1, 64, BOTH), charge(1, u32::MAX, BOTH)];
    assert_eq!(fixture.charge("run", &far), [FIRST; 3]);
    fixture.close();
    assert_eq!(fixture.charge("run", &far), [FIRST; 3]);
    assert_eq!(fixture.state("run"), (3, 0, 7));
    fixture.leases("run", &[1], 2);
    let refused = fixture.pay("run", &far[1..]).unwrap_err();
    assert!(matches!(refused, LedgerError::BeyondEnd { charge_idx: 0 }), "{refused}");
}

pub(crate) fn a_repeated_operation_changes_nothing(mut fixture: TestLedger) {
    fixture.open("run", 10);
    let leases = fixture.leases("run", &[3, 4], 3);
    let charges = [
        charge(3, 0, BOTH),
        charge(3, 1, NEITHER),
        charge(4, 0, BOTH),
        charge(9, 63, BOTH),
        charge(9, 64, NEITHER),
        charge(3, 0, BOTH),
    ];
    let verdicts = fixture.charge("run", &charges);
    assert_eq!(verdicts, [FIRST, NOTHING, FIRST, SECOND, NOTHING, FIRST]);
    let settled = fixture.settle("run", &[4]);
    assert_eq!(settled, (3, 2, 5));
    let other_halves = charges.map(|charge| inverted(&charge));
    for _ in 0..2 {
        assert_eq!(fixture.leases("run", &[4, 3], 8), [leases[1], leases[0]]);
        assert_eq!(fixture.charge("run", &other_halves), verdicts);
        assert_eq!(fixture.settle("run", &[4]), settled);
        assert_eq!(fixture.state("run"), settled);
        fixture.close();
    }
}

pub(crate) fn leases_take_what_is_left_in_the_order_of_the_episodes(mut fixture: TestLedger) {
    fixture.open("run", 120);
    let leases = fixture.leases("run", &[7, 3, 5, 9, 7], 50);
    let expected = [lease(7, 50, 50), lease(3, 50, 10), lease(5, 20, 0), lease(9, 0, 0)];
    assert_eq!(leases[..4], expected);
    assert_eq!(leases[4], leases[0], "named twice, leased once");
    assert_eq!(fixture.state("run"), (0, 120, 0));
    fixture.close();
    assert_eq!(fixture.leases("run", &[7, 3, 5, 9], 1), expected);
    let charges = [charge(9, 0, BOTH), charge(1, 0, BOTH), charge(5, 0, BOTH)];
    assert_eq!(fixture.charge("run", &charges), [NOTHING, NOTHING, SECOND]);
    assert_eq!(fixture.state("run"), (1, 119, 0));
}

pub(crate) fn a_settled_lease_flows_back_once_and_pays_no_more(mut fixture: TestLedger) {
    fixture.open("run", 100);
    fixture.leases("run", &[1, 2], 30);
    fixture.charge("run", &[charge(1, 0, BOTH)]);
    for _ in 0..2 {
        assert_eq!(fixture.settle("run", &[1, 1, 77]), (1, 30, 69));
        fixture.close();
    }
    let again = [charge(1, 1, BOTH), charge(1, 0, BOTH), charge(2, 0, BOTH)];
    assert_eq!(fixture.charge("run", &again), [NOTHING, FIRST, FIRST]);
    assert_eq!(fixture.state("run"), (2, 29, 69));
    assert_eq!(fixture.leases("run", &[1], 30), [lease(1, 30, 30)], "it stays settled");
    assert_eq!(fixture.state("run"), (2, 29, 69));
}

pub(crate) fn the_first_half_is_handed_out_first(mut fixture: TestLedger) {
    let only_first = [true, false];
    let only_second = [false, true];
    fixture.open("run", 5);
    let steps =
        |steps: std::ops::Range<u32>, wanted| steps.map(move |step| charge(1, step, wanted));
    let charges: Vec<_> = steps(0..2, BOTH).chain(steps(2..3, only_second)).collect();
    assert_eq!(fixture.charge("run", &charges), [FIRST, FIRST, NOTHING]);
    let charges: Vec<_> = steps(3..5, only_first).chain(steps(5..8, BOTH)).collect();
    assert_eq!(fixture.charge("run", &charges), [FIRST, NOTHING, SECOND, SECOND, NOTHING]);
    assert_eq!(fixture.state("run"), (5, 0, 0));
}

pub(crate) fn a_lease_says_how_many_of_its_units_are_early(mut fixture: TestLedger) {
    let only_first = [true, false];
    fixture.open("run", 9);
    fixture.charge("run", &[charge(100, 0, BOTH)]);
    assert_eq!(fixture.leases("run", &[1, 2], 3), [lease(1, 3, 3), lease(2, 3, 1)]);
    fixture.close();
    // Serving the second episode first changes nothing.
    let second: Vec<_> = (0..3).map(|step| charge(2, step, only_first)).collect();
    assert_eq!(fixture.charge("run", &second), [FIRST, NOTHING, NOTHING]);
    let first: Vec<_> = (0..4).map(|step| charge(1, step, BOTH)).collect();
    assert_eq!(fixture.charge("run", &first), [FIRST, FIRST, FIRST, NOTHING]);
    assert_eq!(fixture.charge("run", &[charge(2, 3, BOTH)]), [SECOND]);
    assert_eq!(fixture.state("run"), (6, 1, 2));
}

pub(crate) fn a_step_without_a_unit_stays_uncharged(mut fixture: TestLedger) {
    fixture.open("run", 10);
    fixture.leases("run", &[1], 10);
    assert_eq!(fixture.charge("run", &[charge(2, 0, BOTH)]), [NOTHING]);
    assert_eq!(fixture.settle("run", &[1]), (0, 0, 10));
    fixture.close();
    assert_eq!(fixture.charge("run", &[charge(2, 0, BOTH), charge(2, 1, BOTH)]), [NOTHING, FIRST]);
}

pub(crate) fn charges_before_a_lease_do_not_count_against_it(mut fixture: TestLedger) {
    fixture.open("run", 20);
    let before: Vec<_> = (0..4).map(|step| charge(1, step, BOTH)).collect();
    assert_eq!(fixture.charge("run", &before), [FIRST; 4]);
    assert_eq!(fixture.leases("run", &[1], 3), [lease(1, 3, 3)]);
    fixture.charge("run", &[charge(1, 10, BOTH)]);
    fixture.close();
    assert_eq!(fixture.state("run"), (5, 2, 13));
    let after: Vec<_> = (11..15).map(|step| charge(1, step, BOTH)).collect();
    assert_eq!(fixture.charge("run", &after), [FIRST, FIRST, NOTHING, NOTHING]);
    fixture.close();
    assert_eq!(fixture.settle("run", &[1]), (7, 0, 13));
}

pub(crate) fn the_largest_numbers_are_kept_to_the_last_digit(mut fixture: TestLedger) {
    let episodes = [u64::MAX, u64::MAX - 1, 1 << 63, (1 << 63) - 1, (1 << 53) + 1, 1 << 53, 0];
    fixture.open("run", MAX_BUDGET);
    let leases = fixture.leases("run", &episodes[..6], u32::MAX);
    assert!(leases.iter().zip(episodes).all(|(lease, episode)| lease.episode == episode));
    assert!(leases.iter().all(|lease| (lease.units, lease.early_units) == (u32::MAX, u32::MAX)));
    let leased = 6 * u64::from(u32::MAX);
    assert_eq!(fixture.state("run"), (0, leased, MAX_BUDGET - leased));
    // Alternating verdicts: if two of the numbers collided, a verdict would be repeated.
    for (idx, episode) in episodes.into_iter().enumerate() {
        let wanted = if idx % 2 == 0 { BOTH } else { NEITHER };
        let expected = if idx % 2 == 0 { FIRST } else { NOTHING };
        assert_eq!(fixture.charge("run", &[charge(episode, 49, wanted)]), [expected], "{episode}");
    }
    fixture.close();
    let again = episodes.map(|episode| charge(episode, 49, NEITHER));
    let [yes, no] = [FIRST, NOTHING];
    assert_eq!(fixture.charge("run", &again), [yes, no, yes, no, yes, no, yes]);
    assert_eq!(fixture.state("run"), (4, leased - 3, MAX_BUDGET - leased - 1));
    assert_eq!(fixture.settle("run", &episodes), (4, 0, MAX_BUDGET - 4));
}

pub(crate) fn any_name_of_up_to_256_bytes_is_an_account_of_its_own(mut fixture: TestLedger) {
    let names = [
        "ж".repeat(128),
        "腕".repeat(85) + "!",
        "腕".repeat(85) + "?",
        "x".repeat(256),
        "run".to_owned(),
        "Run".to_owned(),
        "run ".to_owned(),
        "run\0".to_owned(),
        "}".to_owned(),
        "{run}".to_owned(),
        "run}:leases".to_owned(),
        "'; DROP TABLE accounts; --".to_owned(),
        "a\r\nb".to_owned(),
        "%s\\\"".to_owned(),
    ];
    for (budget, name) in (10..).zip(&names) {
        fixture.open(name, budget);
        fixture.leases(name, &[1], 1);
        fixture.charge(name, &[charge(1, 0, BOTH), charge(2, 0, BOTH)]);
    }
    fixture.close();
    for (budget, name) in (10..).zip(&names) {
        assert_eq!(fixture.state(name), (2, 0, budget - 2), "{name:?}");
        assert_eq!(fixture.charge(name, &[charge(1, 0, NEITHER)]), [FIRST], "{name:?}");
    }
}

pub(crate) fn requests_of_one_call_are_charged_in_their_order(mut fixture: TestLedger) {
    fixture.open("few", 3);
    fixture.open("many", 100);
    let two =
        |account, episode| request(account, &[charge(episode, 0, BOTH), charge(episode, 1, BOTH)]);
    let requests = [two("few", 1), two("many", 1), two("few", 2), two("few", 1), two("few", 3)];
    let outcomes = fixture.ledger().charge(&requests);
    let outcomes: Vec<_> = outcomes.into_iter().map(|outcome| outcome.unwrap()).collect();
    let verdicts: Vec<_> = outcomes.iter().map(|result| result.verdicts.as_slice()).collect();
    assert_eq!(verdicts[0], [FIRST, FIRST]);
    assert_eq!(verdicts[1], [FIRST, FIRST]);
    assert_eq!(verdicts[2], [SECOND, NOTHING]);
    assert_eq!(verdicts[3], [FIRST, FIRST], "repeated");
    assert_eq!(verdicts[4], [NOTHING, NOTHING]);
    let left: Vec<u64> = outcomes.iter().map(|result| result.left).collect();
    assert_eq!(left, [1, 98, 0, 0, 0]);
    fixture.close();
    assert_eq!((fixture.state("few"), fixture.state("many")), ((3, 0, 0), (2, 0, 98)));
}

pub(crate) fn an_empty_request_or_call_changes_nothing(mut fixture: TestLedger) {
    fixture.open("run", 3);
    assert!(fixture.ledger().charge(&[]).is_empty());
    assert_eq!(fixture.charge("run", &[]), []);
    assert_eq!(fixture.leases("run", &[], 5), []);
    assert_eq!(fixture.settle("run", &[]), (0, 0, 3));
}
