//! The teacher as a whole: policy, maps, strategy and budget answer a student's queries.

use std::sync::{Mutex, MutexGuard};

use tandem_core::layout::EPISODE_STEPS;
use tandem_core::{ArmAdvice, Layout, StepAdvice, StepQuery};
use tandem_proto::{DecodeError, MAX_ARMS};

use crate::budget::{Balance, Half, Lease, Terms, Verdict, Wish};
use crate::error::Error;
use crate::ledger::{Bill, Charge, Ledger, LedgerError, Receipt};
use crate::maps::Maps;
use crate::policy::TeacherPolicy;
use crate::procedures::judge_arm;
use crate::strategy::Strategy;

/// Answers queries from any number of threads.
pub struct Advisor {
    layout: Layout,
    digest: String,
    maps: Maps,
    judge: Mutex<Judge>,
    ledger: Mutex<Box<dyn Ledger>>,
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
        Ok(Self {
            layout,
            digest: policy.digest().to_owned(),
            maps: Maps::new(Layout::new(layout.task, MAX_ARMS)),
            judge: Mutex::new(Judge::new(policy)),
            ledger: Mutex::new(ledger),
        })
    }

    /// The policy's task, and one arm.
    #[must_use]
    pub const fn layout(&self) -> Layout {
        self.layout
    }

    /// The policy's digest.
    #[must_use]
    pub fn digest(&self) -> &str {
        &self.digest
    }

    /// Where each arm's numbers stand in a student's vectors.
    #[must_use]
    pub const fn maps(&self) -> &Maps {
        &self.maps
    }

    /// Opens account `name`, or finds it open on the same terms.
    ///
    /// # Errors
    /// When it is open on other terms, or the budget is too large.
    pub fn open_account(&self, name: &str, terms: Terms) -> Result<Balance, Error> {
        Ok(self.ledger().open(name, terms)?)
    }

    /// How account `name` stands.
    ///
    /// # Errors
    /// When nobody opened it.
    pub fn balance(&self, name: &str) -> Result<Balance, Error> {
        Ok(self.ledger().balance(name)?)
    }

    /// Sets units of account `name` aside for `episodes`, in their order; see [`Account::open_leases`].
    ///
    /// # Errors
    /// When nobody opened the account.
    ///
    /// [`Account::open_leases`]: crate::budget::Account::open_leases
    pub fn open_leases(
        &self,
        name: &str,
        episodes: &[u64],
        units_per_episode: u32,
    ) -> Result<(Vec<Lease>, Balance), Error> {
        Ok(self.ledger().open_leases(name, episodes, units_per_episode)?)
    }

    /// Returns what `episodes` did not spend to account `name`.
    ///
    /// # Errors
    /// When nobody opened the account.
    pub fn settle_leases(&self, name: &str, episodes: &[u64]) -> Result<Balance, Error> {
        Ok(self.ledger().settle(name, episodes)?)
    }

    /// Answers `queries` on account `name`, in their order, with one forward pass for all of them.
    ///
    /// Either all of them are answered or, on an error, none is and nothing is charged.
    ///
    /// # Errors
    /// When nobody opened the account, or a step lies beyond the end of an episode that has a lease.
    ///
    /// # Panics
    /// When a query's lengths are of no layout of the teacher's task with 1 to [`MAX_ARMS`] arms.
    pub fn advise(&self, name: &str, queries: &[StepQuery]) -> Result<Advice, Error> {
        let strategy = self.ledger().balance(name)?.terms.strategy;
        let judged = self.judge().judge(&self.maps, queries)?;
        let charges = queries.iter().zip(&judged).map(|(query, arms)| Charge {
            episode: query.episode,
            step: query.step,
            wish: Wish {
                first: picks_any(strategy, Half::First, arms),
                second: picks_any(strategy, Half::Second, arms),
            },
        });
        let bill = Bill { account: name.to_owned(), charges: charges.collect() };
        let outcome = self.ledger().charge(&[bill]).pop().unwrap_or_else(|| Ok(Receipt::default()));
        let receipt = outcome.map_err(|error| named(error, queries))?;
        let decided = queries.iter().zip(judged).zip(receipt.verdicts);
        let steps =
            decided.map(|((query, arms), verdict)| self.decide(strategy, query, arms, verdict));
        Ok(Advice { steps: steps.collect(), budget_left: receipt.left })
    }

    /// Overrides those of `arms` that the strategy picks, when there was a unit to pay for it.
    fn decide(
        &self,
        strategy: Strategy,
        query: &StepQuery,
        mut arms: Vec<ArmAdvice>,
        verdict: Verdict,
    ) -> StepAdvice {
        if let Verdict::Charged(half) = verdict {
            for arm in &mut arms {
                arm.overridden = picks(strategy, half, arm);
            }
        }
        let action = self.compose(&query.proposed_action, &arms);
        StepAdvice { action, charged: verdict != Verdict::Uncharged, arms }
    }

    /// The last line of every procedure: `a = f^a(a_1, …, a_n)`.
    fn compose(&self, proposed_action: &[f32], arms: &[ArmAdvice]) -> Vec<f32> {
        let chosen = self.maps.of_student(proposed_action.len()).zip(arms).map(|(map, arm)| {
            if arm.overridden {
                arm.teacher_action.as_slice()
            } else {
                map.arm_action(proposed_action)
            }
        });
        self.maps.joint_action(proposed_action.len(), chosen)
    }

    fn judge(&self) -> MutexGuard<'_, Judge> {
        self.judge.lock().expect("nothing panics while it holds the networks")
    }

    fn ledger(&self) -> MutexGuard<'_, Box<dyn Ledger>> {
        self.ledger.lock().expect("nothing panics while it holds the ledger")
    }
}

fn picks(strategy: Strategy, half: Half, arm: &ArmAdvice) -> bool {
    strategy.procedure(half).is_some_and(|procedure| procedure.overrides(arm))
}

fn picks_any(strategy: Strategy, half: Half, arms: &[ArmAdvice]) -> bool {
    arms.iter().any(|arm| picks(strategy, half, arm))
}

/// A refusal that says which of `queries` it is about.
fn named(error: LedgerError, queries: &[StepQuery]) -> Error {
    let LedgerError::BeyondEnd { charge_idx } = error else { return error.into() };
    let expected = format!("0 to {} in an episode that has a lease", EPISODE_STEPS - 1);
    let step = queries.get(charge_idx).map_or(0, |query| query.step);
    DecodeError::new(format!("steps[{charge_idx}].step"), expected, step).into()
}

/// The teacher's networks with the buffers that they work on. A row is one arm of one step.
struct Judge {
    policy: Box<dyn TeacherPolicy>,
    /// Every state twice, for the two actions: shape `[2 n, n_observation]`.
    observations: Vec<f32>,
    /// Shape `[2 n, n_goal]`.
    goals: Vec<f32>,
    /// The teacher's actions, then the student's: shape `[2 n, n_action]`.
    actions: Vec<f32>,
    /// Shape `[2 n]`.
    q: Vec<f32>,
}

impl Judge {
    const fn new(policy: Box<dyn TeacherPolicy>) -> Self {
        Self {
            policy,
            observations: Vec::new(),
            goals: Vec::new(),
            actions: Vec::new(),
            q: Vec::new(),
        }
    }

    /// What the teacher thinks of every arm of every query, by query.
    fn judge(&mut self, maps: &Maps, queries: &[StepQuery]) -> Result<Vec<Vec<ArmAdvice>>, Error> {
        let n_rows = self.gather(maps, queries);
        self.run(n_rows);
        self.check_finite(maps, queries)?;
        let n_action = self.policy.layout().n_action();
        let (of_teacher, of_student) = self.actions.split_at(n_rows * n_action);
        let (q_teacher, q_student) = self.q.split_at(n_rows);
        let actions = of_teacher.chunks_exact(n_action).zip(of_student.chunks_exact(n_action));
        let mut rows = actions.zip(q_teacher.iter().zip(q_student)).map(
            |((teacher, student), (q_teacher, q_student))| {
                judge_arm(teacher, student, *q_teacher, *q_student)
            },
        );
        let arms_of = |query: &StepQuery| maps.of_student(query.proposed_action.len()).len();
        Ok(queries.iter().map(|query| rows.by_ref().take(arms_of(query)).collect()).collect())
    }

    /// Lays the states out in rows and leaves room for the teacher's actions before the student's.
    fn gather(&mut self, maps: &Maps, queries: &[StepQuery]) -> usize {
        let arms_of = |query: &StepQuery| maps.of_student(query.proposed_action.len()).len();
        let n_rows = queries.iter().map(arms_of).sum();
        self.observations.clear();
        self.goals.clear();
        self.actions.clear();
        self.actions.resize(n_rows * self.policy.layout().n_action(), 0.0);
        for query in queries {
            for map in maps.of_student(query.proposed_action.len()) {
                let (observation, goal) = map.teacher_state(&query.observation, &query.goal);
                self.observations.extend_from_slice(observation);
                self.goals.extend_from_slice(goal);
                self.actions.extend_from_slice(map.arm_action(&query.proposed_action));
            }
        }
        n_rows
    }

    /// One pass of the actor over all states, one of the critic over all states with both actions.
    fn run(&mut self, n_rows: usize) {
        let n_action = self.policy.layout().n_action();
        self.policy.act(&self.observations, &self.goals, &mut self.actions[..n_rows * n_action]);
        self.observations.extend_from_within(..);
        self.goals.extend_from_within(..);
        self.q.clear();
        self.q.resize(2 * n_rows, 0.0);
        self.policy.q(&self.observations, &self.goals, &self.actions, &mut self.q);
    }

    /// Refuses to advise on numbers that no procedure can compare.
    fn check_finite(&self, maps: &Maps, queries: &[StepQuery]) -> Result<(), Error> {
        let (n_rows, n_action) = (self.q.len() / 2, self.policy.layout().n_action());
        let is_finite = |row: usize| {
            let action = &self.actions[row * n_action..(row + 1) * n_action];
            action.iter().chain([&self.q[row], &self.q[n_rows + row]]).all(|x| x.is_finite())
        };
        let mut first_row = 0;
        for query in queries {
            let n_arms = maps.of_student(query.proposed_action.len()).len();
            if !(first_row..first_row + n_arms).all(is_finite) {
                return Err(Error::NotFinite { episode: query.episode, step: query.step });
            }
            first_row += n_arms;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
