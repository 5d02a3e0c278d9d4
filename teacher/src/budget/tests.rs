use std::collections::BTreeMap;

use tandem_core::layout::EPISODE_STEPS;
use tandem_core::rng::{Stream, bernoulli, episode_rng, index};

use super::*;
use crate::strategy::Strategy;

/// True if a step is worth a unit of the first, and of the second half of the budget.
type Wanted = [bool; 2];

const ALWAYS: Wanted = [true, true];
const NEVER: Wanted = [false, false];

fn charge(episode: u64, step: u32, wanted: Wanted) -> Charge {
    let [first, second] = wanted;
    Charge { episode, step, wanted_in: BudgetHalves { first, second } }
}

fn account(budget: u64) -> Account {
    Account::new(AccountTerms { budget, strategy: Strategy::EarlyThenMistakeQ { threshold: 0.1 } })
}

fn lease(episode: u64, units: u32, early_units: u32) -> Lease {
    Lease { episode, units, early_units }
}

/// Returns the units spent, leased and left.
fn state(account: &Account) -> (u64, u64, u64) {
    let balance = account.balance();
    (balance.spent, balance.leased, balance.left)
}

#[test]
fn an_empty_budget_pays_for_nothing() {
    let mut account = account(0);
    assert_eq!(account.charge(charge(1, 0, ALWAYS)), None);
    assert_eq!(account.open_leases(&[2], 50), [lease(2, 0, 0)]);
    assert_eq!(account.charge(charge(2, 0, ALWAYS)), None);
    assert_eq!(state(&account), (0, 0, 0));
}

#[test]
fn units_are_early_while_more_than_half_of_the_budget_is_left() {
    let check = |budget: u64, halves: &[BudgetHalf]| {
        let mut account = account(budget);
        let verdicts: Vec<Option<BudgetHalf>> = (0..=u32::try_from(budget).unwrap())
            .map(|s| account.charge(charge(0, s, ALWAYS)))
            .collect();
        let charged = halves.iter().map(|half| Some(*half));
        assert_eq!(verdicts, charged.chain([None]).collect::<Vec<_>>(), "budget {budget}");
    };
    check(1, &[BudgetHalf::First]);
    check(4, &[BudgetHalf::First, BudgetHalf::First, BudgetHalf::Second, BudgetHalf::Second]);
    check(
        5,
        &[
            BudgetHalf::First,
            BudgetHalf::First,
            BudgetHalf::First,
            BudgetHalf::Second,
            BudgetHalf::Second,
        ],
    );
}

#[test]
fn leases_take_what_is_left_in_the_order_of_the_episodes() {
    let mut account = account(120);
    let leases = account.open_leases(&[7, 3, 5, 9], 50);
    assert_eq!(leases, [lease(7, 50, 50), lease(3, 50, 10), lease(5, 20, 0), lease(9, 0, 0)]);
    assert_eq!(state(&account), (0, 120, 0));
}

#[test]
fn a_lease_stays_as_it_was_opened() {
    let mut account = account(120);
    let leases = account.open_leases(&[1, 2, 3], 50);
    account.charge(charge(2, 0, ALWAYS));
    assert_eq!(account.open_leases(&[3, 2, 1], 8), [leases[2], leases[1], leases[0]]);
    account.settle(&[1, 2, 3]);
    assert_eq!(account.open_leases(&[1, 2, 3], 50), leases);
    assert_eq!(state(&account), (1, 0, 119));
}

#[test]
fn an_episode_with_a_lease_spends_nothing_else() {
    let mut account = account(100);
    account.open_leases(&[1], 2);
    let verdicts: Vec<Option<BudgetHalf>> =
        (0..3).map(|step| account.charge(charge(1, step, ALWAYS))).collect();
    let early = Some(BudgetHalf::First);
    assert_eq!(verdicts, [early, early, None]);
    assert_eq!(state(&account), (2, 0, 98));
}

#[test]
fn a_settled_lease_flows_back_once_and_pays_no_more() {
    let mut account = account(100);
    account.open_leases(&[1], 50);
    account.charge(charge(1, 0, ALWAYS));
    for _ in 0..2 {
        account.settle(&[1, 1, 77]);
        assert_eq!(state(&account), (1, 0, 99));
        assert!(account.lease(1).is_some(), "units were set aside for it");
        assert!(account.lease(77).is_none(), "a settlement sets none aside");
    }
    assert_eq!(account.charge(charge(1, 1, ALWAYS)), None);
    assert_eq!(account.charge(charge(1, 0, ALWAYS)), Some(BudgetHalf::First));
    assert_eq!(state(&account), (1, 0, 99));
}

#[test]
fn a_repeated_charge_gets_the_same_verdict_whatever_it_wants() {
    let mut account = account(1);
    assert_eq!(account.charge(charge(1, 0, NEVER)), None);
    assert_eq!(account.charge(charge(1, 1, ALWAYS)), Some(BudgetHalf::First));
    assert_eq!(account.charge(charge(1, 0, ALWAYS)), None);
    assert_eq!(account.charge(charge(1, 1, NEVER)), Some(BudgetHalf::First));
    assert_eq!(state(&account), (1, 0, 0));
}

#[test]
fn a_step_without_a_unit_stays_uncharged_when_units_come_back() {
    let mut account = account(10);
    account.open_leases(&[1], 10);
    assert_eq!(account.charge(charge(2, 0, ALWAYS)), None);
    account.settle(&[1]);
    assert_eq!(account.charge(charge(2, 0, ALWAYS)), None);
    assert_eq!(account.charge(charge(2, 1, ALWAYS)), Some(BudgetHalf::First));
}

#[test]
fn a_step_that_does_not_want_the_next_half_is_not_charged() {
    let only_first = [true, false];
    let mut account = account(2);
    assert_eq!(account.charge(charge(1, 0, only_first)), Some(BudgetHalf::First));
    assert_eq!(account.charge(charge(1, 1, only_first)), None);
    assert_eq!(account.charge(charge(1, 2, ALWAYS)), Some(BudgetHalf::Second));
}

/// The order in which the episodes of a round are served must not change any verdict.
#[test]
fn verdicts_of_leased_episodes_do_not_depend_on_the_order_of_arrival() {
    let episodes: Vec<u64> = (0..6).collect();
    let wanted = |episode: u64, step: u32| [true, (episode + u64::from(step)).is_multiple_of(3)];
    let verdicts_in_order = |seed: Option<u64>| {
        let mut account = account(220);
        account.open_leases(&episodes, 50);
        let mut next_step = vec![0_u32; episodes.len()];
        let mut rng = seed.map(|seed| episode_rng(seed, 0, Stream::Replay));
        let mut verdicts = vec![Vec::new(); episodes.len()];
        while let Some(first) = next_step.iter().position(|step| *step < 50) {
            let picked = rng.as_mut().map_or(first, |rng| index(rng, episodes.len()));
            if next_step[picked] < 50 {
                let (episode, step) = (episodes[picked], next_step[picked]);
                verdicts[picked].push(account.charge(charge(episode, step, wanted(episode, step))));
                next_step[picked] += 1;
            }
        }
        account.settle(&episodes);
        (verdicts, state(&account))
    };
    let in_episode_order = verdicts_in_order(None);
    for seed in 0..20 {
        assert_eq!(verdicts_in_order(Some(seed)), in_episode_order);
    }
}

/// A naive account: lists of leases and steps.
#[derive(Default)]
struct Model {
    budget: u64,
    /// Episode, units, early units, settled.
    leases: Vec<(u64, u32, u32, bool)>,
    /// Episode, step, verdict.
    steps: Vec<(u64, u32, Option<BudgetHalf>)>,
}

impl Model {
    fn charged(&self, episode: u64) -> u64 {
        let charged = |(of, _, verdict): &&(u64, u32, Option<BudgetHalf>)| {
            *of == episode && verdict.is_some()
        };
        u64::try_from(self.steps.iter().filter(charged).count()).unwrap()
    }

    fn spent(&self) -> u64 {
        u64::try_from(self.steps.iter().filter(|step| step.2.is_some()).count()).unwrap()
    }

    /// No episode of the test is charged both before and after it gets a lease.
    fn leased(&self) -> u64 {
        let open = self.leases.iter().filter(|lease| !lease.3);
        open.map(|(episode, units, _, _)| u64::from(*units) - self.charged(*episode)).sum()
    }

    fn left(&self) -> u64 {
        self.budget - self.spent() - self.leased()
    }

    fn open_lease(&mut self, episode: u64, max_units: u32) -> Lease {
        if let Some((_, units, early, _)) = self.leases.iter().find(|lease| lease.0 == episode) {
            return lease(episode, *units, *early);
        }
        let mut left = self.left();
        let (mut units, mut early_units) = (0, 0);
        while units < max_units && left > 0 {
            early_units += u32::from(2 * left > self.budget);
            (units, left) = (units + 1, left - 1);
        }
        self.leases.push((episode, units, early_units, false));
        lease(episode, units, early_units)
    }

    fn charge(&mut self, episode: u64, step: u32, wanted: Wanted) -> Option<BudgetHalf> {
        if let Some((_, _, verdict)) =
            self.steps.iter().find(|known| (known.0, known.1) == (episode, step))
        {
            return *verdict;
        }
        let (available, early) = match self.leases.iter().find(|lease| lease.0 == episode) {
            Some((_, units, early, settled)) => {
                let charged = self.charged(episode);
                (!settled && charged < u64::from(*units), charged < u64::from(*early))
            }
            None => (self.left() > 0, 2 * self.left() > self.budget),
        };
        let half = if early { BudgetHalf::First } else { BudgetHalf::Second };
        let is_worth_it = wanted[usize::from(!early)];
        let verdict = (available && is_worth_it).then_some(half);
        self.steps.push((episode, step, verdict));
        verdict
    }
}

/// Random operations on episodes 0 to 19, which get leases, and 100 to 104, which do not.
#[test]
fn an_account_agrees_with_a_naive_model() {
    for seed in 0..40 {
        let mut rng = episode_rng(seed, 0, Stream::Replay);
        let budget = u64::try_from(index(&mut rng, 400)).unwrap();
        let (mut account, mut model) = (account(budget), Model { budget, ..Model::default() });
        for _ in 0..600 {
            let n_opened = model.leases.len();
            let any_leased = u64::try_from(index(&mut rng, n_opened.max(1))).unwrap();
            match index(&mut rng, 12) {
                0 if n_opened < 20 => {
                    let next = u64::try_from(n_opened).unwrap();
                    let units = u32::try_from(index(&mut rng, 51)).unwrap();
                    let episodes = [next, any_leased.min(next)];
                    let expected: Vec<Lease> =
                        episodes.iter().map(|e| model.open_lease(*e, units)).collect();
                    assert_eq!(account.open_leases(&episodes, units), expected);
                }
                1 => {
                    account.settle(&[any_leased]);
                    model
                        .leases
                        .iter_mut()
                        .filter(|lease| lease.0 == any_leased)
                        .for_each(|lease| lease.3 = true);
                }
                kind => {
                    let unleased = kind == 2 || n_opened == 0;
                    let episode = if unleased { 100 + any_leased % 5 } else { any_leased };
                    let step = u32::try_from(index(&mut rng, EPISODE_STEPS)).unwrap();
                    let wanted = [bernoulli(&mut rng, 0.9), bernoulli(&mut rng, 0.6)];
                    assert_eq!(
                        account.charge(charge(episode, step, wanted)),
                        model.charge(episode, step, wanted)
                    );
                }
            }
            assert_eq!(
                state(&account),
                (model.spent(), model.leased(), model.left()),
                "seed {seed}"
            );
        }
    }
}

mod transactions {
    use super::*;

    /// The records that a ledger has stored.
    #[derive(Default)]
    struct Stored {
        leases: BTreeMap<u64, LeaseRecord>,
        verdicts: BTreeMap<VerdictIndex, VerdictBits>,
    }

    impl Stored {
        fn write(&mut self, changes: &Changes) {
            self.leases.extend(&changes.leases);
            self.verdicts.extend(&changes.verdicts);
        }

        fn restore(&self, terms: AccountTerms) -> Account {
            let leases: Vec<_> =
                self.leases.iter().map(|(episode, lease)| (*episode, *lease)).collect();
            let verdicts: Vec<_> =
                self.verdicts.iter().map(|(index, bits)| (*index, *bits)).collect();
            Account::restore(terms, &leases, &verdicts).expect("consistent")
        }
    }

    /// Runs one to five random operations on episodes 0 to 9.
    fn disturb(transaction: &mut Transaction<'_>, below: &mut impl FnMut(u32) -> u32) {
        for _ in 0..=below(5) {
            let (episode, step) = (u64::from(below(10)), below(100));
            match below(10) {
                0 => drop(transaction.open_leases(&[episode, (episode + 3) % 10], step % 20)),
                1 => transaction.settle(&[episode]),
                _ => drop(transaction.charge(charge(episode, step, [true, below(2) == 0]))),
            }
        }
    }

    #[test]
    fn a_dropped_transaction_changes_nothing_and_an_applied_one_can_be_restored() {
        for seed in 0..50 {
            let mut rng = episode_rng(seed, 0, Stream::Replay);
            let mut below =
                |n: u32| u32::try_from(index(&mut rng, usize::try_from(n).unwrap())).unwrap();
            let (mut account, mut stored) = (account(120), Stored::default());
            for _ in 0..60 {
                let before = account.clone();
                let mut transaction = account.begin();
                disturb(&mut transaction, &mut below);
                let changes = transaction.into_changes();
                assert_eq!(account, before, "seed {seed}");
                if below(2) == 0 {
                    stored.write(&changes);
                    let is_empty = changes.is_empty();
                    account.apply(changes);
                    assert_eq!(is_empty, account == before, "seed {seed}");
                }
                assert_eq!(stored.restore(account.terms()), account, "seed {seed}");
            }
        }
    }

    #[test]
    fn operations_of_one_transaction_see_one_another() {
        for seed in 0..50 {
            let mut rng = episode_rng(seed, 0, Stream::Replay);
            let mut below =
                |n: u32| u32::try_from(index(&mut rng, usize::try_from(n).unwrap())).unwrap();
            let (mut together, mut one_by_one) = (account(120), account(120));
            let charges: Vec<Charge> = (0..200)
                .map(|_| charge(u64::from(below(10)), below(100), [true, below(2) == 0]))
                .collect();
            together.update(|transaction| transaction.open_leases(&[1, 2, 3], 20));
            one_by_one.open_leases(&[1, 2, 3], 20);
            let verdicts: Vec<_> = together
                .update(|transaction| charges.iter().map(|c| transaction.charge(*c)).collect());
            let expected: Vec<_> = charges.iter().map(|c| one_by_one.charge(*c)).collect();
            assert_eq!(verdicts, expected, "seed {seed}");
            assert_eq!(together, one_by_one, "seed {seed}");
        }
    }

    #[test]
    fn records_that_contradict_one_another_are_refused() {
        let lease = |units, early_units| LeaseRecord {
            units,
            early_units,
            charged_before: 0,
            settled: false,
        };
        let bits = |asked, charged| VerdictBits { asked, charged, first_half: 0 };
        let check = |lease: LeaseRecord, bits: VerdictBits, expected: Option<&str>| {
            let terms = account(120).terms();
            let error = Account::restore(terms, &[(7, lease)], &[((7, 0), bits)]).err();
            assert_eq!(error.map(|error| error.to_string()).as_deref(), expected);
        };
        let does_not_fit = Some("the lease of episode 7 does not fit its verdicts");
        check(lease(2, 1), bits(0b111, 0b11), None);
        check(lease(1, 1), bits(0b111, 0b11), does_not_fit);
        check(lease(2, 3), bits(0b111, 0b11), does_not_fit);
        let contradict = Some("the verdicts on episode 7 contradict one another");
        check(lease(2, 1), bits(0b001, 0b11), contradict);
        check(lease(121, 1), bits(0b111, 0b11), Some("more than the budget is handed out"));
        let charged_before = LeaseRecord { charged_before: 3, ..lease(2, 1) };
        check(charged_before, bits(0b111, 0b11), does_not_fit);
    }
}
