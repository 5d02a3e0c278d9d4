//! The advisor, which answers students' queries with the policy, the maps, the strategy and the budget.

mod inference;

use std::collections::{BTreeMap, BTreeSet};

use tandem_core::task::MAX_ARMS;
use tandem_core::{ArmAdvice, StepAdvice, StepQuery, TaskSpec};
use tandem_proto::DecodeError;

use crate::budget::{AccountTerms, Balance, BudgetError, BudgetHalf, BudgetHalves, Charge, Lease};
use crate::error::Error;
use crate::ledger::{ChargeRequest, ChargeResult, Ledger, LedgerError, printable};
use crate::maps::Maps;
use crate::policy::AnyPolicy;
use crate::strategy::{Strategy, procedure};
use inference::TeacherInference;

/// The number of accounts whose strategies are cached. When it is reached, the cache is cleared.
const MAX_CACHED_STRATEGIES: usize = 4096;

/// Answers requests for advice and manages accounts, for one caller at a time.
pub struct Advisor {
    info: TeacherInfo,
    inference: TeacherInference,
    ledger: Box<dyn Ledger>,
    /// A cache by account. The terms of an account never change.
    strategies: BTreeMap<String, Strategy>,
    /// Accounts for which a step was asked about again with other numbers, so that each gets one warning.
    reused: BTreeSet<String>,
    /// The reason why the latest batch could not be evaluated, if it could not.
    policy_failure: Option<String>,
    /// True if the service ends when the ledger must be opened again.
    ends_for_restart: bool,
}

/// A description of the teacher.
#[derive(Debug, Clone, PartialEq)]
pub struct TeacherInfo {
    /// The task of the policy, of one arm.
    pub task: TaskSpec,
    /// The tasks of students with 1, 2, … arms, in arm order; see [`TaskSpec::concatenated`].
    pub students: Vec<TaskSpec>,
    /// The digest of the policy.
    pub digest: String,
    /// True if the policy values actions.
    pub has_values: bool,
    /// The maps from a student's vectors to each arm's.
    pub maps: Maps,
}

/// One request for advice.
#[derive(Debug, Clone, PartialEq)]
pub struct AdviceRequest {
    /// The name of the account that pays.
    pub account: String,
    /// The steps on which the student asks for advice.
    pub queries: Vec<StepQuery>,
}

/// The answer to one [`AdviceRequest`].
#[derive(Debug, Clone, PartialEq)]
pub struct Advice {
    /// One answer for each query, in order.
    pub steps: Vec<StepAdvice>,
    /// Units of the account that are neither spent nor leased.
    pub budget_left: u64,
}

impl Advisor {
    /// Creates an advisor with the accounts of `ledger`.
    ///
    /// # Errors
    /// When the policy is not for one arm, or its task has numbers that belong to no arm.
    pub fn new(policy: impl Into<AnyPolicy>, ledger: Box<dyn Ledger>) -> Result<Self, Error> {
        let policy = policy.into();
        let task = policy.task();
        if task.n_arms() != 1 {
            let (policy, n_arms) = ("this one".to_owned(), task.n_arms());
            return Err(Error::NotOneArm { policy, n_arms });
        }
        task.concatenated(1).map_err(Error::NotAnArm)?;
        let info = TeacherInfo {
            digest: policy.digest().to_owned(),
            has_values: policy.has_values(),
            maps: Maps::new(&task, MAX_ARMS),
            students: (1..=MAX_ARMS).map_while(|n_arms| task.concatenated(n_arms).ok()).collect(),
            task,
        };
        let inference = TeacherInference::new(policy);
        Ok(Self {
            info,
            inference,
            ledger,
            strategies: BTreeMap::new(),
            reused: BTreeSet::new(),
            policy_failure: None,
            ends_for_restart: false,
        })
    }

    /// Makes the service end with [`Error::LedgerNeedsRestart`] when only another process can charge the ledger's
    /// accounts. Otherwise it continues to refuse charges.
    #[must_use]
    pub fn ending_for_restart(self) -> Self {
        Self { ends_for_restart: true, ..self }
    }

    /// Returns true if the service must end, because the ledger must be opened again.
    pub(crate) fn must_end(&self) -> bool {
        self.ends_for_restart && self.ledger.needs_restart()
    }

    /// Returns the description of the teacher.
    #[must_use]
    pub const fn info(&self) -> &TeacherInfo {
        &self.info
    }

    /// Opens account `name`, or returns it if it is open with the same terms.
    ///
    /// # Errors
    /// When it is open with other terms, the budget is too large, the strategy needs values that the policy does not
    /// have, or the ledger cannot be used.
    pub fn open_account(&mut self, name: &str, terms: AccountTerms) -> Result<Balance, Error> {
        self.check_offered(terms.strategy)?;
        let balance = self.ledger.open(name, terms)?;
        // Another strategy is remembered if a server has lost the account in the meantime.
        self.remember(name, balance.terms.strategy);
        Ok(balance)
    }

    /// Returns the balance of account `name`.
    ///
    /// # Errors
    /// When the account is not open, or the ledger cannot be used.
    pub fn balance(&mut self, name: &str) -> Result<Balance, Error> {
        Ok(self.ledger.balance(name)?)
    }

    /// Returns the reason why the ledger could not be written, if the last attempt failed, or else the reason why the
    /// policy could not be evaluated, if the last attempt failed.
    #[must_use]
    pub fn warning(&self) -> Option<&str> {
        self.ledger.warning().or(self.policy_failure.as_deref())
    }

    /// Reserves units of account `name` for `episodes`, in their order; see [`Account::open_leases`].
    ///
    /// # Errors
    /// When the account is not open, or the ledger cannot be used.
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

    /// Returns the unspent units of `episodes` to account `name`.
    ///
    /// # Errors
    /// When the account is not open, or the ledger cannot be used.
    pub fn settle_leases(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, Error> {
        Ok(self.ledger.settle(name, episodes)?)
    }

    /// Answers `requests`, in their order, with one batch of inference and one call to the ledger for all of them.
    ///
    /// The answers are the same as if each request came alone, in the same order. A refused request charges nothing and
    /// does not affect the others.
    ///
    /// # Errors
    /// Per request: when its account is not open, a step lies beyond the end of an episode that has a lease, the
    /// policy cannot be evaluated or returns a number that is not finite, or the ledger cannot be used.
    ///
    /// # Panics
    /// When a query's lengths do not fit the teacher's task with any number of arms from 1 to [`MAX_ARMS`], or the ledger
    /// does not answer every charge.
    pub fn advise(&mut self, requests: &[AdviceRequest]) -> Vec<Result<Advice, Error>> {
        let scored = self.score(requests);
        let episode_steps = episode_steps(&self.info.task);
        let charges: Vec<ChargeRequest> = scored
            .iter()
            .flatten()
            .filter_map(|request| request.charge_request(episode_steps))
            .collect();
        let charged = self.charge(&charges);
        self.warn_of_reused_steps(&charges, &charged);
        self.forget_former_strategies(&charges, &charged);
        let mut charged = charged.into_iter();
        let mut answer = |scored: ScoredRequest<'_>| {
            let charged = if scored.arms.is_empty() {
                let balance = self.ledger.balance(&scored.request.account);
                balance.map(|balance| ChargeResult {
                    verdicts: Vec::new(),
                    repeated: Vec::new(),
                    left: balance.left,
                })
            } else {
                charged.next().expect("one result for each request")
            };
            scored.into_advice(&self.info, charged)
        };
        scored.into_iter().map(|scored| answer(scored?)).collect()
    }

    /// Scores the steps of all requests whose accounts are open.
    fn score<'a>(
        &mut self,
        requests: &'a [AdviceRequest],
    ) -> Vec<Result<ScoredRequest<'a>, Error>> {
        let strategies: Vec<Result<Strategy, Error>> =
            requests.iter().map(|request| self.strategy(&request.account)).collect();
        let open = requests.iter().zip(&strategies).filter(|(_, strategy)| strategy.is_ok());
        let queries = open.flat_map(|(request, _)| &request.queries);
        let scores = self.inference.score(&self.info.maps, queries);
        self.note_failure(&scores);
        let mut arms = scores.into_iter();
        let mut score = |request: &'a AdviceRequest, strategy| {
            let arms: Vec<_> = arms.by_ref().take(request.queries.len()).collect();
            let arms = arms.into_iter().collect::<Result<_, _>>()?;
            Ok(ScoredRequest { request, strategy, arms })
        };
        requests
            .iter()
            .zip(strategies)
            .map(|(request, strategy)| score(request, strategy?))
            .collect()
    }

    /// Stores the first failure among the scores of a batch. A batch without one ends the former failure.
    fn note_failure(&mut self, scores: &[Result<Vec<ArmAdvice>, Error>]) {
        if scores.is_empty() {
            return;
        }
        let failure = scores.iter().find_map(|score| score.as_ref().err());
        self.policy_failure = failure.map(|error| printable(&error.to_string()));
    }

    fn strategy(&mut self, account: &str) -> Result<Strategy, Error> {
        if let Some(strategy) = self.strategies.get(account) {
            return Ok(*strategy);
        }
        let strategy = self.ledger.balance(account)?.terms.strategy;
        self.check_offered(strategy)?;
        self.remember(account, strategy);
        Ok(strategy)
    }

    fn remember(&mut self, account: &str, strategy: Strategy) {
        if self.strategies.len() >= MAX_CACHED_STRATEGIES {
            self.strategies.clear();
        }
        self.strategies.insert(account.to_owned(), strategy);
    }

    /// Refuses a strategy that needs values if the policy has none.
    const fn check_offered(&self, strategy: Strategy) -> Result<(), Error> {
        if strategy.needs_values() && !self.info.has_values {
            return Err(Error::NoValues { strategy });
        }
        Ok(())
    }

    fn charge(&mut self, requests: &[ChargeRequest]) -> Vec<Result<ChargeResult, LedgerError>> {
        if requests.is_empty() {
            return Vec::new();
        }
        let results = self.ledger.charge(requests);
        assert_eq!(results.len(), requests.len(), "a ledger answers every request");
        results
    }

    /// Forgets the strategies of accounts that a server has lost: other teachers may open them anew with others, or
    /// have done so. A repeated request is answered by the account's strategy.
    fn forget_former_strategies(
        &mut self,
        requests: &[ChargeRequest],
        results: &[Result<ChargeResult, LedgerError>],
    ) {
        for (request, result) in requests.iter().zip(results) {
            if let Err(
                LedgerError::Budget(BudgetError::UnknownAccount(_))
                | LedgerError::OtherStrategy { .. },
            ) = result
            {
                self.strategies.remove(&request.account);
            }
        }
    }

    /// Warns, once for each account, if a step was charged that the strategy would not charge now: the account remembers
    /// the verdict on an earlier request for the same step of the same episode, which had other numbers.
    fn warn_of_reused_steps(
        &mut self,
        requests: &[ChargeRequest],
        results: &[Result<ChargeResult, LedgerError>],
    ) {
        for (request, result) in requests.iter().zip(results) {
            let Ok(result) = result else { continue };
            let mut decided = request.charges.iter().zip(&result.verdicts);
            let is_contradicted = |(charge, verdict): &(&Charge, &Option<BudgetHalf>)| {
                verdict.is_some_and(|half| !charge.wanted_in.contains(half))
            };
            let Some((charge, _)) = decided.find(is_contradicted) else { continue };
            if self.reused.len() < MAX_CACHED_STRATEGIES
                && self.reused.insert(request.account.clone())
            {
                tracing::warn!(
                    account = request.account,
                    episode = charge.episode,
                    step = charge.step,
                    "other numbers for a step that was decided before, its verdict stays: use another account or episode"
                );
            }
        }
    }
}

/// A request with the teacher's scores of its steps.
struct ScoredRequest<'a> {
    request: &'a AdviceRequest,
    strategy: Strategy,
    /// By query, then by arm. Nothing is overridden yet.
    arms: Vec<Vec<ArmAdvice>>,
}

impl ScoredRequest<'_> {
    /// Returns the charges that the request may cause, unless it has no steps. Queries with the same payer and step
    /// share one, which is wanted if any of them wants it.
    fn charge_request(&self, episode_steps: u32) -> Option<ChargeRequest> {
        let mut charges: Vec<Charge> = Vec::new();
        for ((query, arms), charge_idx) in
            self.request.queries.iter().zip(&self.arms).zip(charge_indices(&self.request.queries))
        {
            let wanted = |half| {
                procedure(self.strategy, half, query.step)
                    .is_some_and(|procedure| arms.iter().any(|arm| procedure.overrides(arm)))
            };
            let wanted_in = BudgetHalves {
                first: wanted(BudgetHalf::First),
                second: wanted(BudgetHalf::Second),
            };
            match charges.get_mut(charge_idx) {
                Some(charge) => charge.wanted_in = charge.wanted_in.union(wanted_in),
                None => charges.push(Charge { episode: payer(query), step: query.step, wanted_in }),
            }
        }
        let (account, strategy) = (|| self.request.account.clone(), self.strategy);
        (!charges.is_empty()).then(|| ChargeRequest {
            account: account(),
            strategy,
            episode_steps,
            charges,
        })
    }

    /// Returns the answer, given the verdicts on the charges.
    fn into_advice(
        self,
        info: &TeacherInfo,
        charged: Result<ChargeResult, LedgerError>,
    ) -> Result<Advice, Error> {
        let (queries, maps) = (&self.request.queries, &info.maps);
        let n_steps = episode_steps(&info.task);
        let indices = charge_indices(queries);
        let charged = charged.map_err(|error| with_step(error, queries, &indices, n_steps))?;
        let n_charges = indices.iter().max().map_or(0, |last| last + 1);
        assert_eq!(charged.verdicts.len(), n_charges, "a ledger decides on every charge");
        let decided = queries.iter().zip(self.arms).zip(indices);
        let steps = decided.map(|((query, arms), charge_idx)| StepAdvice {
            repeated: charged.repeated[charge_idx],
            ..step_advice(self.strategy, maps, query, arms, charged.verdicts[charge_idx])
        });
        Ok(Advice { steps: steps.collect(), budget_left: charged.left })
    }
}

/// Returns the index of each query's charge. Charges are in the order of their first query.
fn charge_indices(queries: &[StepQuery]) -> Vec<usize> {
    let mut by_step: BTreeMap<(u64, u32), usize> = BTreeMap::new();
    queries
        .iter()
        .map(|query| {
            let next = by_step.len();
            *by_step.entry((payer(query), query.step)).or_insert(next)
        })
        .collect()
}

/// Returns the number of the episode that pays for the step.
fn payer(query: &StepQuery) -> u64 {
    query.payer.unwrap_or(query.episode)
}

/// Overrides the arms that the strategy selects, if a unit was charged for the step.
fn step_advice(
    strategy: Strategy,
    maps: &Maps,
    query: &StepQuery,
    mut arms: Vec<ArmAdvice>,
    verdict: Option<BudgetHalf>,
) -> StepAdvice {
    if let Some(half) = verdict
        && let Some(procedure) = procedure(strategy, half, query.step)
    {
        for arm in &mut arms {
            arm.overridden = procedure.overrides(arm);
        }
    }
    let action = compose(maps, &query.proposed_action, &arms);
    StepAdvice { action, charged: verdict.is_some(), arms, repeated: false }
}

/// Composes the joint action, as in the last line of every procedure: `a = f^a(a_1, …, a_n)`.
fn compose(maps: &Maps, proposed_action: &[f32], arms: &[ArmAdvice]) -> Vec<f32> {
    let chosen = maps.of_student(proposed_action.len()).zip(arms).map(|(map, arm)| {
        if arm.overridden { arm.teacher_action.as_slice() } else { map.arm_action(proposed_action) }
    });
    maps.joint_action(proposed_action.len(), chosen)
}

fn episode_steps(task: &TaskSpec) -> u32 {
    u32::try_from(task.episode_steps()).expect("an episode has few steps")
}

/// Adds the step of a refused charge to the error.
fn with_step(
    error: LedgerError,
    queries: &[StepQuery],
    charge_indices: &[usize],
    n_steps: u32,
) -> Error {
    let LedgerError::BeyondEnd { charge_idx } = error else { return error.into() };
    let expected = format!("0 to {} in an episode that has a lease", n_steps - 1);
    let query_idx = charge_indices.iter().position(|idx| *idx == charge_idx).unwrap_or(charge_idx);
    let step = queries.get(query_idx).map_or(0, |query| query.step);
    DecodeError::new(format!("steps[{query_idx}].step"), expected, step).into()
}

#[cfg(test)]
mod tests;
