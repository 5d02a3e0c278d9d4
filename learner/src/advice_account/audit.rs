//! Compares the units of advice that episodes claim with the charges of the teacher's account.
//!
//! Workers report the charges of their episodes; the teacher's ledger is authoritative. Both agree in most rounds. The
//! account can be ahead of the learned episodes for three reasons, none of which is a false report:
//!
//! - Workers of a dead learner charged episodes after its newest checkpoint. The resumed learner orders these episodes
//!   again, and the ledger does not charge them twice.
//! - Workers that have not noticed the death of the learner continue such an episode under its lease.
//! - A lost account is opened again with a smaller budget, because the last charges are unknown.
//!
//! Pure: statements of the account are arguments, in the order in which the teacher made them.

/// The state of the account in a response of the teacher.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Statement {
    /// Units charged.
    pub(super) spent: u64,
    /// Units reserved for open episodes and not spent.
    pub(super) leased: u64,
}

/// Derives from the account's statements what the next round's episodes can claim.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Audit {
    /// The latest statement made while no episode of this learner was open.
    latest: Statement,
    /// Charged units that no learned episode accounts for; most likely they belong to episodes that will be ordered
    /// again.
    ahead: u64,
    /// Charged units that certainly belong to no future episode and are not counted yet.
    unclaimed: u64,
    /// True if the account has all charges since the start of the run or since it got its own name.
    is_whole: bool,
}

/// The cost of a round's episodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Cost {
    /// Units that count as spent.
    pub(super) units: u64,
    /// The charges of the account, if the claim cannot be true.
    pub(super) instead: Option<u64>,
}

impl Audit {
    /// Starts with an account that was charged `ahead` units more than the learned episodes account for.
    pub(super) const fn new(latest: Statement, ahead: u64, is_whole: bool) -> Self {
        Self { latest, ahead, unclaimed: 0, is_whole }
    }

    /// Returns true if the account has all charges. Only then does a lease limit the claim of its episode.
    pub(super) const fn is_whole(&self) -> bool {
        self.is_whole
    }

    /// Records a round's leases of `units` in total.
    ///
    /// If all of them are new, no earlier learner has ordered this round. Then no earlier charge is for a future
    /// episode, so charges without an episode never get one.
    pub(super) const fn leases_opened(&mut self, units: u64, now: Statement) {
        let handed_out_before = self.latest.spent + self.latest.leased;
        let are_new = units > 0 && now.spent + now.leased == handed_out_before + units;
        if self.is_whole && are_new {
            self.unclaimed += self.ahead;
            self.ahead = 0;
        }
    }

    /// Compares the claims of a round's episodes with the account after they are settled, when no lease is open.
    pub(super) fn settled(&mut self, claimed: u64, now: Statement) -> Cost {
        let before = std::mem::replace(&mut self.latest, now);
        let unclaimed = std::mem::take(&mut self.unclaimed);
        let Some(charged) = now.spent.checked_sub(before.spent) else {
            // A ledger that was restored to an earlier state proves nothing.
            self.is_whole = false;
            return Cost { units: claimed + unclaimed, instead: None };
        };
        // These may be charges to leases of an earlier learner.
        let elsewhere = if self.is_whole { before.leased.min(charged) } else { charged };
        let counted = claimed.clamp(charged - elsewhere, charged + self.ahead);
        self.ahead = self.ahead + charged - counted;
        let instead = (counted != claimed).then_some(counted);
        Cost { units: counted + unclaimed, instead }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn stand(spent: u64, leased: u64) -> Statement {
        Statement { spent, leased }
    }

    /// An account of a new run.
    const NEW: Audit = Audit::new(stand(0, 0), 0, true);

    const fn true_cost(units: u64) -> Cost {
        Cost { units, instead: None }
    }

    /// A round with leases of `leased` units of which the account is charged `charged` and the workers claim `claimed`.
    fn round(audit: &mut Audit, leased: u64, charged: u64, claimed: u64) -> Cost {
        let before = audit.latest;
        audit.leases_opened(leased, stand(before.spent, before.leased + leased));
        audit.settled(claimed, stand(before.spent + charged, before.leased))
    }

    #[test]
    fn true_claims_count_unchanged() {
        let mut audit = NEW;
        for units in [37, 0, 400, 1] {
            assert_eq!(round(&mut audit, 400, units, units), true_cost(units));
        }
        assert_eq!(round(&mut audit, 0, 0, 0), true_cost(0), "the budget is spent");
    }

    #[test]
    fn charges_count_regardless_of_claims() {
        let mut audit = NEW;
        assert_eq!(round(&mut audit, 400, 0, 400), Cost { units: 0, instead: Some(0) });
        assert_eq!(round(&mut audit, 400, 90, 0), Cost { units: 90, instead: Some(90) });
        assert_eq!(round(&mut audit, 400, 90, 91), Cost { units: 90, instead: Some(90) });
        assert_eq!(round(&mut audit, 400, 90, 90), true_cost(90), "and continues from there");
    }

    #[test]
    fn repeated_rounds_are_charged_already() {
        // The checkpoint had 100 units; rounds of 30, 40 and an unfinished one of 25 followed.
        let mut audit = Audit::new(stand(195, 175), 95, true);
        assert_eq!(audit.settled(30, stand(195, 175)), true_cost(30));
        assert_eq!(audit.settled(40, stand(195, 175)), true_cost(40));
        assert_eq!(audit.settled(60, stand(230, 0)), true_cost(60), "35 of them anew");
        assert_eq!(audit.ahead, 0);
        assert_eq!(round(&mut audit, 200, 80, 79), Cost { units: 80, instead: Some(80) });
    }

    #[test]
    fn a_worker_that_still_plays_for_a_dead_learner_raises_no_alarm() {
        let mut audit = Audit::new(stand(130, 50), 30, true);
        // Ten units of the unfinished round are spent while the first one is played again.
        assert_eq!(audit.settled(20, stand(140, 40)), true_cost(20));
        assert_eq!(audit.settled(25, stand(145, 0)), true_cost(25));
        assert_eq!(audit.ahead, 0);
    }

    #[test]
    fn a_resumed_run_that_differs_counts_its_earlier_charges() {
        let mut audit = Audit::new(stand(130, 0), 30, true);
        assert_eq!(audit.settled(12, stand(130, 0)), true_cost(12));
        assert_eq!(round(&mut audit, 400, 50, 50), true_cost(68), "with 18 units of no episode");
        assert_eq!(round(&mut audit, 400, 50, 50), true_cost(50));
    }

    #[test]
    fn claims_beyond_repeated_rounds_are_detected() {
        let mut audit = Audit::new(stand(130, 0), 30, true);
        assert_eq!(audit.settled(31, stand(130, 0)), Cost { units: 30, instead: Some(30) });
    }

    #[test]
    fn a_reopened_account_disproves_excessive_claims_only() {
        // Two episodes were under way, and 100 units are written off for them.
        let mut audit = Audit::new(stand(0, 0), 100, false);
        assert_eq!(audit.settled(70, stand(40, 0)), true_cost(70), "30 in the lost account");
        let charged_by_stragglers = 11;
        let spent = 40 + 50 + charged_by_stragglers;
        assert_eq!(audit.settled(50, stand(spent, 0)), true_cost(50));
        let most = 100 - 30 + charged_by_stragglers;
        assert_eq!(audit.settled(200, stand(spent, 0)), Cost { units: most, instead: Some(most) });
    }

    #[test]
    fn a_restored_ledger_proves_nothing() {
        let mut audit = Audit::new(stand(500, 0), 0, true);
        assert_eq!(audit.settled(40, stand(300, 0)), true_cost(40));
        assert!(!audit.is_whole());
    }
}
