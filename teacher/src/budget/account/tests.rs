use tandem_core::layout::EPISODE_STEPS;
use tandem_core::rng::{Stream, bernoulli, episode_rng, index};

use super::*;
use crate::strategy::Strategy;

const ALWAYS: Wish = Wish { first: true, second: true };
const NEVER: Wish = Wish { first: false, second: false };

fn account(budget: u64) -> Account {
    Account::new(Terms { budget, strategy: Strategy::EarlyThenMistakeQ { threshold: 0.1 } })
}

fn lease(episode: u64, units: u32, early_units: u32) -> Lease {
    Lease { episode, units, early_units }
}

/// What is spent, leased and left.
fn state(account: &Account) -> (u64, u64, u64) {
    let balance = account.balance();
    (balance.spent, balance.leased, balance.left)
}

#[test]
fn an_empty_budget_pays_for_nothing() {
    let mut account = account(0);
    assert_eq!(account.charge(1, 0, ALWAYS), Verdict::Uncharged);
    assert_eq!(account.open_leases(&[2], 50), [lease(2, 0, 0)]);
    assert_eq!(account.charge(2, 0, ALWAYS), Verdict::Uncharged);
    assert_eq!(state(&account), (0, 0, 0));
}

#[test]
fn units_are_early_while_more_than_half_of_the_budget_is_left() {
    let check = |budget: u64, halves: &[Half]| {
        let mut account = account(budget);
        let verdicts: Vec<Verdict> =
            (0..=u32::try_from(budget).unwrap()).map(|s| account.charge(0, s, ALWAYS)).collect();
        let charged = halves.iter().map(|half| Verdict::Charged(*half));
        assert_eq!(
            verdicts,
            charged.chain([Verdict::Uncharged]).collect::<Vec<_>>(),
            "budget {budget}"
        );
    };
    check(1, &[Half::First]);
    check(4, &[Half::First, Half::First, Half::Second, Half::Second]);
    check(5, &[Half::First, Half::First, Half::First, Half::Second, Half::Second]);
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
    account.charge(2, 0, ALWAYS);
    assert_eq!(account.open_leases(&[3, 2, 1], 8), [leases[2], leases[1], leases[0]]);
    account.settle(&[1, 2, 3]);
    assert_eq!(account.open_leases(&[1, 2, 3], 50), leases);
    assert_eq!(state(&account), (1, 0, 119));
}

#[test]
fn an_episode_with_a_lease_spends_nothing_else() {
    let mut account = account(100);
    account.open_leases(&[1], 2);
    let verdicts: Vec<Verdict> = (0..3).map(|step| account.charge(1, step, ALWAYS)).collect();
    let early = Verdict::Charged(Half::First);
    assert_eq!(verdicts, [early, early, Verdict::Uncharged]);
    assert_eq!(state(&account), (2, 0, 98));
}

#[test]
fn a_settled_lease_flows_back_once_and_pays_no_more() {
    let mut account = account(100);
    account.open_leases(&[1], 50);
    account.charge(1, 0, ALWAYS);
    for _ in 0..2 {
        account.settle(&[1, 1, 77]);
        assert_eq!(state(&account), (1, 0, 99));
        assert!(account.has_lease(1), "units were set aside for it");
        assert!(!account.has_lease(77), "a settlement sets none aside");
    }
    assert_eq!(account.charge(1, 1, ALWAYS), Verdict::Uncharged);
    assert_eq!(account.charge(1, 0, ALWAYS), Verdict::Charged(Half::First));
    assert_eq!(state(&account), (1, 0, 99));
}

#[test]
fn asking_again_gives_the_same_verdict_whatever_is_wished() {
    let mut account = account(1);
    assert_eq!(account.charge(1, 0, NEVER), Verdict::Uncharged);
    assert_eq!(account.charge(1, 1, ALWAYS), Verdict::Charged(Half::First));
    assert_eq!(account.charge(1, 0, ALWAYS), Verdict::Uncharged);
    assert_eq!(account.charge(1, 1, NEVER), Verdict::Charged(Half::First));
    assert_eq!(state(&account), (1, 0, 0));
}

#[test]
fn a_step_refused_for_want_of_units_stays_refused_when_units_come_back() {
    let mut account = account(10);
    account.open_leases(&[1], 10);
    assert_eq!(account.charge(2, 0, ALWAYS), Verdict::Uncharged);
    account.settle(&[1]);
    assert_eq!(account.charge(2, 0, ALWAYS), Verdict::Uncharged);
    assert_eq!(account.charge(2, 1, ALWAYS), Verdict::Charged(Half::First));
}

#[test]
fn a_unit_of_the_wrong_half_is_not_wished_for() {
    let only_first = Wish { first: true, second: false };
    let mut account = account(2);
    assert_eq!(account.charge(1, 0, only_first), Verdict::Charged(Half::First));
    assert_eq!(account.charge(1, 1, only_first), Verdict::Uncharged);
    assert_eq!(account.charge(1, 2, ALWAYS), Verdict::Charged(Half::Second));
}

/// The order in which episodes of a round are served must not change any verdict.
#[test]
fn verdicts_of_leased_episodes_do_not_depend_on_the_order_of_arrival() {
    let episodes: Vec<u64> = (0..6).collect();
    let wish = |episode: u64, step: u32| Wish {
        first: true,
        second: (episode + u64::from(step)).is_multiple_of(3),
    };
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
                verdicts[picked].push(account.charge(episode, step, wish(episode, step)));
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

/// The account as one would write it down: every unit a line.
#[derive(Default)]
struct Model {
    budget: u64,
    /// Episode, units, early units, settled.
    leases: Vec<(u64, u32, u32, bool)>,
    /// Episode, step, verdict.
    steps: Vec<(u64, u32, Verdict)>,
}

impl Model {
    fn charged(&self, episode: u64) -> u64 {
        let charged = |(of, _, verdict): &&(u64, u32, Verdict)| {
            *of == episode && *verdict != Verdict::Uncharged
        };
        u64::try_from(self.steps.iter().filter(charged).count()).unwrap()
    }

    fn spent(&self) -> u64 {
        u64::try_from(self.steps.iter().filter(|step| step.2 != Verdict::Uncharged).count())
            .unwrap()
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

    fn charge(&mut self, episode: u64, step: u32, wish: Wish) -> Verdict {
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
        let half = if early { Half::First } else { Half::Second };
        let worth_it = if early { wish.first } else { wish.second };
        let verdict =
            if available && worth_it { Verdict::Charged(half) } else { Verdict::Uncharged };
        self.steps.push((episode, step, verdict));
        verdict
    }
}

/// Random operations on episodes 0 to 19, which get leases, and 100 to 104, which do not.
#[test]
fn an_account_does_what_the_written_down_model_does() {
    for seed in 0..40 {
        let mut rng = episode_rng(seed, 0, Stream::Replay);
        let budget = u64::try_from(index(&mut rng, 400)).unwrap();
        let (mut account, mut model) = (account(budget), Model { budget, ..Model::default() });
        for _ in 0..600 {
            let n_opened = account.leases.len();
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
                    let wish =
                        Wish { first: bernoulli(&mut rng, 0.9), second: bernoulli(&mut rng, 0.6) };
                    assert_eq!(
                        account.charge(episode, step, wish),
                        model.charge(episode, step, wish)
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
