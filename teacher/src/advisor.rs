//! The teacher as a whole: policy, maps, strategy and budget answer students' queries.

mod judge;

use std::collections::BTreeMap;

use tandem_core::layout::EPISODE_STEPS;
use tandem_core::{ArmAdvice, Layout, StepAdvice, StepQuery};
use tandem_proto::{DecodeError, MAX_ARMS};

use crate::budget::{Balance, Half, Lease, Terms, Verdict, Wish};
use crate::error::Error;
use crate::ledger::{Bill, Charge, Ledger, LedgerError, Receipt};
use crate::maps::Maps;
use crate::policy::TeacherPolicy;
use crate::strategy::Strategy;
use judge::Judge;

/// Accounts whose strategies are remembered; with one more, all of them are looked up again.
const MAX_REMEMBERED: usize = 4096;

/// Answers queries and keeps accounts, for one caller at a time.
pub struct Advisor {
    profile: Profile,
    judge: Judge,
    ledger: Box<dyn Ledger>,
    /// By account. An account's terms never change.
    strategies: BTreeMap<String, Strategy>,
}

/// What a teacher tells of itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Profile {
    /// The policy's task, and one arm.
    pub layout: Layout,
    /// The policy's digest.
    pub digest: String,
    /// Where each arm's numbers stand in a student's vectors.
    pub maps: Maps,
}

/// One request for advice.
#[derive(Debug, Clone, PartialEq)]
pub struct Question {
    /// The name of the account that pays.
    pub account: String,
    /// The steps asked about.
    pub queries: Vec<StepQuery>,
}

/// The answers to the queries of one request.
#[derive(Debug, Clone, PartialEq)]
pub struct Advice {
    /// One answer per query, in order.
    pub steps: Vec<StepAdvice>,
    /// Units of the account that are neither spent nor set aside.
    pub budget_left: u64,
}

impl Advisor {
    /// An advisor with the accounts of `ledger`.
    ///
    /// # Errors
    /// When the policy is not for one arm.
    pub fn new(policy: Box<dyn TeacherPolicy>, ledger: Box<dyn Ledger>) -> Result<Self, Error> {
        let layout = policy.layout();
        if layout.n_arms != 1 {
            return Err(Error::NotOneArm { n_arms: layout.n_arms, n_values: 1 });
        }
        let profile = Profile {
            layout,
            digest: policy.digest().to_owned(),
            maps: Maps::new(Layout::new(layout.task, MAX_ARMS)),
        };
        Ok(Self { profile, judge: Judge::new(policy), ledger, strategies: BTreeMap::new() })
    }

    /// What the teacher tells of itself.
    #[must_use]
    pub const fn profile(&self) -> &Profile {
        &self.profile
    }

    /// Opens account `name`, or finds it open on the same terms.
    ///
    /// # Errors
    /// When it is open on other terms, the budget is too large, or the ledger cannot be used.
    pub fn open_account(&mut self, name: &str, terms: Terms) -> Result<Balance, Error> {
        Ok(self.ledger.open(name, terms)?)
    }

    /// How account `name` stands.
    ///
    /// # Errors
    /// When nobody opened it, or the ledger cannot be used.
    pub fn balance(&mut self, name: &str) -> Result<Balance, Error> {
        Ok(self.ledger.balance(name)?)
    }

    /// Why the ledger cannot be written, if the last attempt failed.
    #[must_use]
    pub fn warning(&self) -> Option<&str> {
        self.ledger.warning()
    }

    /// Sets units of account `name` aside for `episodes`, in their order; see [`Account::open_leases`].
    ///
    /// # Errors
    /// When nobody opened the account, or the ledger cannot be used.
    ///
    /// [`Account::open_leases`]: crate::budget::Account::open_leases
    pub fn open_leases(
        &mut self,
        name: &str,
        episodes: &[u64],
        units_per_episode: u32,
    ) -> Result<(Vec<Lease>, Balance), Error> {
        Ok(self.ledger.open_leases(name, episodes, units_per_episode)?)
    }

    /// Returns what `episodes` did not spend to account `name`.
    ///
    /// # Errors
    /// When nobody opened the account, or the ledger cannot be used.
    pub fn settle_leases(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, Error> {
        Ok(self.ledger.settle(name, episodes)?)
    }

    /// Answers `questions`, in their order, with one forward pass and one visit to the ledger for all of them.
    ///
    /// The advice is that which each would get alone, in the same order. A question is answered as a whole or, on an
    /// error, not at all and charges nothing; another question's error does not touch it.
    ///
    /// # Errors
    /// Per question: when nobody opened its account, a step lies beyond the end of an episode that has a lease, the
    /// networks give numbers for it that are not finite, or the ledger cannot be used.
    ///
    /// # Panics
    /// When a query's lengths are of no layout of the teacher's task with 1 to [`MAX_ARMS`] arms, or the ledger does
    /// not answer every bill.
    pub fn advise(&mut self, questions: &[Question]) -> Vec<Result<Advice, Error>> {
        let judged = self.judge(questions);
        let bills: Vec<Bill> = judged.iter().flatten().filter_map(Judged::bill).collect();
        let mut receipts = self.charge(&bills).into_iter();
        let mut answer = |judged: Judged<'_>| {
            let receipt = if judged.arms.is_empty() {
                self.ledger.balance(&judged.question.account).map(nothing_charged)
            } else {
                receipts.next().expect("one receipt per bill")
            };
            judged.decide(&self.profile.maps, receipt)
        };
        judged.into_iter().map(|judged| answer(judged?)).collect()
    }

    /// What the teacher thinks of each of `questions`.
    fn judge<'a>(&mut self, questions: &'a [Question]) -> Vec<Result<Judged<'a>, Error>> {
        let strategies: Vec<Result<Strategy, Error>> =
            questions.iter().map(|question| self.strategy(&question.account)).collect();
        let known = questions.iter().zip(&strategies).filter(|(_, strategy)| strategy.is_ok());
        let maps = &self.profile.maps;
        let mut opinions =
            self.judge.judge(maps, known.flat_map(|(question, _)| &question.queries));
        let mut judge = |question: &'a Question, strategy| {
            let opinions: Vec<Result<Vec<ArmAdvice>, Error>> =
                question.queries.iter().map(|query| opinions.next(maps, query)).collect();
            let arms = opinions.into_iter().collect::<Result<_, _>>()?;
            Ok(Judged { question, strategy, arms })
        };
        questions
            .iter()
            .zip(strategies)
            .map(|(question, strategy)| judge(question, strategy?))
            .collect()
    }

    fn strategy(&mut self, account: &str) -> Result<Strategy, Error> {
        if let Some(strategy) = self.strategies.get(account) {
            return Ok(*strategy);
        }
        let strategy = self.ledger.balance(account)?.terms.strategy;
        if self.strategies.len() >= MAX_REMEMBERED {
            self.strategies.clear();
        }
        self.strategies.insert(account.to_owned(), strategy);
        Ok(strategy)
    }

    fn charge(&mut self, bills: &[Bill]) -> Vec<Result<Receipt, LedgerError>> {
        if bills.is_empty() {
            return Vec::new();
        }
        let receipts = self.ledger.charge(bills);
        assert_eq!(receipts.len(), bills.len(), "a ledger answers every bill");
        receipts
    }
}

/// A question, and what the teacher thinks of it.
struct Judged<'a> {
    question: &'a Question,
    strategy: Strategy,
    /// By query, then by arm; nothing overridden yet.
    arms: Vec<Vec<ArmAdvice>>,
}

impl Judged<'_> {
    /// What the question may cost, unless it asks about no step.
    fn bill(&self) -> Option<Bill> {
        let charges = self.question.queries.iter().zip(&self.arms).map(|(query, arms)| Charge {
            episode: query.episode,
            step: query.step,
            wish: Wish {
                first: picks_any(self.strategy, Half::First, arms),
                second: picks_any(self.strategy, Half::Second, arms),
            },
        });
        let charges: Vec<Charge> = charges.collect();
        (!charges.is_empty()).then(|| Bill { account: self.question.account.clone(), charges })
    }

    /// The answer, now that it is known what was paid for.
    fn decide(self, maps: &Maps, receipt: Result<Receipt, LedgerError>) -> Result<Advice, Error> {
        let queries = &self.question.queries;
        let receipt = receipt.map_err(|error| named(error, queries))?;
        assert_eq!(receipt.verdicts.len(), queries.len(), "a ledger decides on every charge");
        let decided = queries.iter().zip(self.arms).zip(receipt.verdicts);
        let steps = decided
            .map(|((query, arms), verdict)| decide(self.strategy, maps, query, arms, verdict));
        Ok(Advice { steps: steps.collect(), budget_left: receipt.left })
    }
}

/// Overrides those of `arms` that the strategy picks, when there was a unit to pay for it.
fn decide(
    strategy: Strategy,
    maps: &Maps,
    query: &StepQuery,
    mut arms: Vec<ArmAdvice>,
    verdict: Verdict,
) -> StepAdvice {
    if let Verdict::Charged(half) = verdict {
        for arm in &mut arms {
            arm.overridden = picks(strategy, half, arm);
        }
    }
    let action = compose(maps, &query.proposed_action, &arms);
    StepAdvice { action, charged: verdict != Verdict::Uncharged, arms }
}

/// The last line of every procedure: `a = f^a(a_1, …, a_n)`.
fn compose(maps: &Maps, proposed_action: &[f32], arms: &[ArmAdvice]) -> Vec<f32> {
    let chosen = maps.of_student(proposed_action.len()).zip(arms).map(|(map, arm)| {
        if arm.overridden { arm.teacher_action.as_slice() } else { map.arm_action(proposed_action) }
    });
    maps.joint_action(proposed_action.len(), chosen)
}

fn picks(strategy: Strategy, half: Half, arm: &ArmAdvice) -> bool {
    strategy.procedure(half).is_some_and(|procedure| procedure.overrides(arm))
}

fn picks_any(strategy: Strategy, half: Half, arms: &[ArmAdvice]) -> bool {
    arms.iter().any(|arm| picks(strategy, half, arm))
}

fn nothing_charged(balance: Balance) -> Receipt {
    Receipt { verdicts: Vec::new(), left: balance.left }
}

/// A refusal that says which of `queries` it is about.
fn named(error: LedgerError, queries: &[StepQuery]) -> Error {
    let LedgerError::BeyondEnd { charge_idx } = error else { return error.into() };
    let expected = format!("0 to {} in an episode that has a lease", EPISODE_STEPS - 1);
    let step = queries.get(charge_idx).map_or(0, |query| query.step);
    DecodeError::new(format!("steps[{charge_idx}].step"), expected, step).into()
}

#[cfg(test)]
mod tests;
