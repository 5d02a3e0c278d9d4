//! What every ledger answers.

use tandem_teacher::budget::{Balance, MAX_BUDGET, Terms, Wish};
use tandem_teacher::{Strategy, ledger::LedgerError};

use crate::place::{BOTH, FIRST, NEITHER, NOTHING, Place, SECOND, bill, charge, lease, terms};

pub(crate) fn an_account_is_opened_once_and_keeps_its_terms(mut place: Place) {
    let fresh = Balance { terms: terms(10), spent: 0, leased: 0, left: 10 };
    assert_eq!(place.open("run", 10), fresh);
    place.charge("run", &[charge(1, 0, BOTH)]);
    for _ in 0..2 {
        assert_eq!(place.open("run", 10), Balance { spent: 1, left: 9, ..fresh });
        let asked = Terms { budget: 11, strategy: Strategy::MistakeQ { threshold: 0.05 } };
        let refused = place.ledger().open("run", asked).unwrap_err().to_string();
        assert_eq!(
            refused,
            "account \"run\" is open with budget 10 and strategy eamc:0.1, not with budget 11 and strategy mc-q:0.05"
        );
        let too_large = Terms { budget: MAX_BUDGET + 1, ..terms(0) };
        let refused = place.ledger().open("run", too_large).unwrap_err().to_string();
        assert_eq!(refused, "budget: expected 0 to 1000000000000, got 1000000000001");
        place.close();
    }
}

pub(crate) fn an_account_that_nobody_opened_is_refused_by_name(mut place: Place) {
    place.open("run", 10);
    let mut refusals = vec![
        place.ledger().balance("nun").unwrap_err(),
        place.ledger().open_leases("nun", &[1], 5).unwrap_err(),
        place.ledger().settle("nun", &[1]).unwrap_err(),
    ];
    let bills = [bill("nun", &[charge(1, 0, BOTH)]), bill("run", &[charge(1, 0, BOTH)])];
    let mut outcomes = place.ledger().charge(&bills);
    assert_eq!(outcomes.pop().unwrap().unwrap().verdicts, [FIRST], "the other bill is paid");
    refusals.push(outcomes.pop().unwrap().unwrap_err());
    for refused in refusals {
        assert_eq!(refused.to_string(), "unknown account \"nun\": open it first");
    }
}

pub(crate) fn a_bill_is_made_as_a_whole_or_not(mut place: Place) {
    place.open("run", 100);
    place.leases("run", &[1], 50);
    let beyond = [charge(1, 49, BOTH), charge(2, 0, BOTH), charge(1, 50, BOTH), charge(1, 3, BOTH)];
    let bills =
        [bill("run", &[charge(1, 7, BOTH)]), bill("run", &beyond), bill("run", &beyond[..2])];
    let outcomes = place.ledger().charge(&bills);
    assert_eq!(outcomes[0].as_ref().unwrap().verdicts, [FIRST]);
    let refused = outcomes[1].as_ref().unwrap_err();
    assert!(matches!(refused, LedgerError::BeyondEnd { charge_idx: 2 }), "{refused}");
    assert_eq!(outcomes[2].as_ref().unwrap().left, 49);
    assert_eq!(place.state("run"), (3, 48, 49));
    place.close();
    // Steps of the refused bill that no other bill had were not asked about.
    assert_eq!(place.charge("run", &[charge(1, 3, NEITHER)]), [NOTHING]);
    assert_eq!(place.state("run"), (3, 48, 49));
}

pub(crate) fn an_episode_without_a_lease_has_no_end(mut place: Place) {
    place.open("run", 10);
    let far = [charge(1, 50, BOTH), charge(1, 64, BOTH), charge(1, u32::MAX, BOTH)];
    assert_eq!(place.charge("run", &far), [FIRST; 3]);
    place.close();
    assert_eq!(place.charge("run", &far), [FIRST; 3]);
    assert_eq!(place.state("run"), (3, 0, 7));
    place.leases("run", &[1], 2);
    let refused = place.pay("run", &far[1..]).unwrap_err();
    assert!(matches!(refused, LedgerError::BeyondEnd { charge_idx: 0 }), "{refused}");
}

pub(crate) fn asking_again_changes_nothing(mut place: Place) {
    place.open("run", 10);
    let leases = place.leases("run", &[3, 4], 3);
    let asked = [
        charge(3, 0, BOTH),
        charge(3, 1, NEITHER),
        charge(4, 0, BOTH),
        charge(9, 63, BOTH),
        charge(9, 64, NEITHER),
        charge(3, 0, BOTH),
    ];
    let verdicts = place.charge("run", &asked);
    assert_eq!(verdicts, [FIRST, NOTHING, FIRST, SECOND, NOTHING, FIRST]);
    let settled = place.settle("run", &[4]);
    assert_eq!(settled, (3, 2, 5));
    let other_wish = asked.map(|asked| charge(asked.episode, asked.step, swapped(asked.wish)));
    for _ in 0..2 {
        assert_eq!(place.leases("run", &[4, 3], 8), [leases[1], leases[0]]);
        assert_eq!(place.charge("run", &other_wish), verdicts);
        assert_eq!(place.settle("run", &[4]), settled);
        assert_eq!(place.state("run"), settled);
        place.close();
    }
}

fn swapped(wish: Wish) -> Wish {
    Wish { first: !wish.first, second: !wish.second }
}

pub(crate) fn leases_take_what_is_left_in_the_order_of_the_episodes(mut place: Place) {
    place.open("run", 120);
    let leases = place.leases("run", &[7, 3, 5, 9, 7], 50);
    let expected = [lease(7, 50, 50), lease(3, 50, 10), lease(5, 20, 0), lease(9, 0, 0)];
    assert_eq!(leases[..4], expected);
    assert_eq!(leases[4], leases[0], "named twice, leased once");
    assert_eq!(place.state("run"), (0, 120, 0));
    place.close();
    assert_eq!(place.leases("run", &[7, 3, 5, 9], 1), expected);
    let asked = [charge(9, 0, BOTH), charge(1, 0, BOTH), charge(5, 0, BOTH)];
    assert_eq!(place.charge("run", &asked), [NOTHING, NOTHING, SECOND]);
    assert_eq!(place.state("run"), (1, 119, 0));
}

pub(crate) fn a_settled_lease_flows_back_once_and_pays_no_more(mut place: Place) {
    place.open("run", 100);
    place.leases("run", &[1, 2], 30);
    place.charge("run", &[charge(1, 0, BOTH)]);
    for _ in 0..2 {
        assert_eq!(place.settle("run", &[1, 1, 77]), (1, 30, 69));
        place.close();
    }
    let again = [charge(1, 1, BOTH), charge(1, 0, BOTH), charge(2, 0, BOTH)];
    assert_eq!(place.charge("run", &again), [NOTHING, FIRST, FIRST]);
    assert_eq!(place.state("run"), (2, 29, 69));
    assert_eq!(place.leases("run", &[1], 30), [lease(1, 30, 30)], "it stays settled");
    assert_eq!(place.state("run"), (2, 29, 69));
}

pub(crate) fn the_first_half_is_handed_out_first(mut place: Place) {
    let only_first = Wish { first: true, second: false };
    let only_second = Wish { first: false, second: true };
    place.open("run", 5);
    let steps = |steps: std::ops::Range<u32>, wish| steps.map(move |step| charge(1, step, wish));
    let asked: Vec<_> = steps(0..2, BOTH).chain(steps(2..3, only_second)).collect();
    assert_eq!(place.charge("run", &asked), [FIRST, FIRST, NOTHING]);
    let asked: Vec<_> = steps(3..5, only_first).chain(steps(5..8, BOTH)).collect();
    assert_eq!(place.charge("run", &asked), [FIRST, NOTHING, SECOND, SECOND, NOTHING]);
    assert_eq!(place.state("run"), (5, 0, 0));
}

pub(crate) fn a_lease_says_how_many_of_its_units_are_early(mut place: Place) {
    let only_first = Wish { first: true, second: false };
    place.open("run", 9);
    place.charge("run", &[charge(100, 0, BOTH)]);
    assert_eq!(place.leases("run", &[1, 2], 3), [lease(1, 3, 3), lease(2, 3, 1)]);
    place.close();
    // The second episode is served first; that changes nothing.
    let second: Vec<_> = (0..3).map(|step| charge(2, step, only_first)).collect();
    assert_eq!(place.charge("run", &second), [FIRST, NOTHING, NOTHING]);
    let first: Vec<_> = (0..4).map(|step| charge(1, step, BOTH)).collect();
    assert_eq!(place.charge("run", &first), [FIRST, FIRST, FIRST, NOTHING]);
    assert_eq!(place.charge("run", &[charge(2, 3, BOTH)]), [SECOND]);
    assert_eq!(place.state("run"), (6, 1, 2));
}

pub(crate) fn a_step_refused_for_want_of_units_stays_refused(mut place: Place) {
    place.open("run", 10);
    place.leases("run", &[1], 10);
    assert_eq!(place.charge("run", &[charge(2, 0, BOTH)]), [NOTHING]);
    assert_eq!(place.settle("run", &[1]), (0, 0, 10));
    place.close();
    assert_eq!(place.charge("run", &[charge(2, 0, BOTH), charge(2, 1, BOTH)]), [NOTHING, FIRST]);
}

pub(crate) fn what_was_charged_before_the_lease_is_not_the_leases(mut place: Place) {
    place.open("run", 20);
    let before: Vec<_> = (0..4).map(|step| charge(1, step, BOTH)).collect();
    assert_eq!(place.charge("run", &before), [FIRST; 4]);
    assert_eq!(place.leases("run", &[1], 3), [lease(1, 3, 3)]);
    place.charge("run", &[charge(1, 10, BOTH)]);
    place.close();
    assert_eq!(place.state("run"), (5, 2, 13));
    let after: Vec<_> = (11..15).map(|step| charge(1, step, BOTH)).collect();
    assert_eq!(place.charge("run", &after), [FIRST, FIRST, NOTHING, NOTHING]);
    place.close();
    assert_eq!(place.settle("run", &[1]), (7, 0, 13));
}

pub(crate) fn the_largest_numbers_are_kept_to_the_last_digit(mut place: Place) {
    let episodes = [u64::MAX, u64::MAX - 1, 1 << 63, (1 << 63) - 1, (1 << 53) + 1, 1 << 53, 0];
    place.open("run", MAX_BUDGET);
    let leases = place.leases("run", &episodes[..6], u32::MAX);
    assert!(leases.iter().zip(episodes).all(|(lease, episode)| lease.episode == episode));
    assert!(leases.iter().all(|lease| (lease.units, lease.early_units) == (u32::MAX, u32::MAX)));
    let leased = 6 * u64::from(u32::MAX);
    assert_eq!(place.state("run"), (0, leased, MAX_BUDGET - leased));
    // An odd number of steps of every other episode: were two numbers one, a verdict would be repeated.
    for (idx, episode) in episodes.into_iter().enumerate() {
        let wish = if idx % 2 == 0 { BOTH } else { NEITHER };
        let expected = if idx % 2 == 0 { FIRST } else { NOTHING };
        assert_eq!(place.charge("run", &[charge(episode, 49, wish)]), [expected], "{episode}");
    }
    place.close();
    let again = episodes.map(|episode| charge(episode, 49, NEITHER));
    let [yes, no] = [FIRST, NOTHING];
    assert_eq!(place.charge("run", &again), [yes, no, yes, no, yes, no, yes]);
    assert_eq!(place.state("run"), (4, leased - 3, MAX_BUDGET - leased - 1));
    assert_eq!(place.settle("run", &episodes), (4, 0, MAX_BUDGET - 4));
}

pub(crate) fn any_name_of_up_to_256_bytes_is_an_account_of_its_own(mut place: Place) {
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
        place.open(name, budget);
        place.leases(name, &[1], 1);
        place.charge(name, &[charge(1, 0, BOTH), charge(2, 0, BOTH)]);
    }
    place.close();
    for (budget, name) in (10..).zip(&names) {
        assert_eq!(place.state(name), (2, 0, budget - 2), "{name:?}");
        assert_eq!(place.charge(name, &[charge(1, 0, NEITHER)]), [FIRST], "{name:?}");
    }
}

pub(crate) fn bills_of_one_call_are_made_in_their_order(mut place: Place) {
    place.open("few", 3);
    place.open("many", 100);
    let two =
        |account, episode| bill(account, &[charge(episode, 0, BOTH), charge(episode, 1, BOTH)]);
    let bills = [two("few", 1), two("many", 1), two("few", 2), two("few", 1), two("few", 3)];
    let outcomes = place.ledger().charge(&bills);
    let outcomes: Vec<_> = outcomes.into_iter().map(|outcome| outcome.unwrap()).collect();
    let verdicts: Vec<_> = outcomes.iter().map(|receipt| receipt.verdicts.as_slice()).collect();
    assert_eq!(verdicts[0], [FIRST, FIRST]);
    assert_eq!(verdicts[1], [FIRST, FIRST]);
    assert_eq!(verdicts[2], [SECOND, NOTHING]);
    assert_eq!(verdicts[3], [FIRST, FIRST], "asked again");
    assert_eq!(verdicts[4], [NOTHING, NOTHING]);
    let left: Vec<u64> = outcomes.iter().map(|receipt| receipt.left).collect();
    assert_eq!(left, [1, 98, 0, 0, 0]);
    place.close();
    assert_eq!((place.state("few"), place.state("many")), ((3, 0, 0), (2, 0, 98)));
}

pub(crate) fn an_empty_bill_or_call_is_nothing(mut place: Place) {
    place.open("run", 3);
    assert!(place.ledger().charge(&[]).is_empty());
    assert_eq!(place.charge("run", &[]), []);
    assert_eq!(place.leases("run", &[], 5), []);
    assert_eq!(place.settle("run", &[]), (0, 0, 3));
}
