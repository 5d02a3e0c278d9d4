//! The comparison of the advice that episodes claim with what the teacher's account was charged.
//!
//! Workers report what their episodes were charged; the teacher's ledger knows. In most rounds both are equal. Three
//! things make an account run ahead of the episodes that have been learned, and none of them is a false report:
//!
//! - A learner that died had workers charge episodes after its newest checkpoint. The resumed learner orders these
//!   episodes again, and the ledger charges nothing for them a second time.
//! - Workers that have not noticed yet that the learner died go on with such an episode under its lease.
//! - A lost account is opened anew with a smaller budget, because nobody knows what was charged last.
//!
//! Pure: it sees the account's statements in the order in which the teacher made them.

/// How an account stands by an answer of the teacher.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Statement {
    /// Units charged.
    pub(super) spent: u64,
    /// Units set aside for open episodes and not spent.
    pub(super) leased: u64,
}

/// What the account's statements allow the next round's episodes to claim.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Audit {
    /// The latest statement that was made while no episode of this learner was under way.
    latest: Statement,
    /// Units charged that no learned episode accounts for, most probably by episodes that will be ordered again.
    ahead: u64,
    /// Units charged that are known to belong to no episode any more, and are not counted yet.
    unclaimed: u64,
    /// Whether the account has been charged for everything since the run's beginning, or since a name of its own.
    is_whole: bool,
}

/// What a round's episodes cost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Cost {
    /// Units that count as spent.
    pub(super) units: u64,
    /// What the account was charged instead of the claim, when the claim cannot be true.
    pub(super) instead: Option<u64>,
}

impl Audit {
    /// Begins with an account that was charged `ahead` units more than the learned episodes account for.
    pub(super) const fn new(latest: Statement, ahead: u64, is_whole: bool) -> Self {
        Self { latest, ahead, unclaimed: 0, is_whole }
    }

    /// Whether the account was charged for everything: only then a lease bounds what its episode can claim.
    pub(super) const fn is_whole(&self) -> bool {
        self.is_whole
    }

    /// Takes note of a round's leases, which have `units` in all.
    ///
    /// When all of them are new, no earlier learner had ordered this round. So nothing that was charged before is for
    /// an episode yet to come: what is unaccounted for then has no episode.
    pub(super) const fn leases_opened(&mut self, units: u64, now: Statement) {
        let handed_out_before = self.latest.spent + self.latest.leased;
        let are_new = units > 0 && now.spent + now.leased == handed_out_before + units;
        if self.is_whole && are_new {
            self.unclaimed += self.ahead;
            self.ahead = 0;
        }
    }

    /// Compares what a round's episodes claim with the account once they are settled and none is under way.
    pub(super) fn settled(&mut self, claimed: u64, now: Statement) -> Cost {
        let before = std::mem::replace(&mut self.latest, now);
        let unclaimed = std::mem::take(&mut self.unclaimed);
        let Some(charged) = now.spent.checked_sub(before.spent) else {
            // A ledger that was put back to an earlier state proves nothing.
            self.is_whole = false;
            return Cost { units: claimed + unclaimed, instead: None };
        };
        // Units set aside for episodes of an earlier learner may have been spent on these.
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
    fn true_claims_are_counted_as_they_are() {
        let mut audit = NEW;
        for units in [37, 0, 400, 1] {
            assert_eq!(round(&mut audit, 400, units, units), true_cost(units));
        }
        assert_eq!(round(&mut audit, 0, 0, 0), true_cost(0), "the budget is spent");
    }

    #[test]
    fn what_was_charged_counts_whatever_workers_claim() {
        let mut audit = NEW;
        assert_eq!(round(&mut audit, 400, 0, 400), Cost { units: 0, instead: Some(0) });
        assert_eq!(round(&mut audit, 400, 90, 0), Cost { units: 90, instead: Some(90) });
        assert_eq!(round(&mut audit, 400, 90, 91), Cost { units: 90, instead: Some(90) });
        assert_eq!(round(&mut audit, 400, 90, 90), true_cost(90), "and it goes on from there");
    }

    #[test]
    fn rounds_that_are_played_again_are_charged_already() {
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
    fn a_resumed_run_that_plays_otherwise_counts_what_it_was_charged_before() {
        let mut audit = Audit::new(stand(130, 0), 30, true);
        assert_eq!(audit.settled(12, stand(130, 0)), true_cost(12));
        assert_eq!(round(&mut audit, 400, 50, 50), true_cost(68), "with 18 units of no episode");
        assert_eq!(round(&mut audit, 400, 50, 50), true_cost(50));
    }

    #[test]
    fn claims_beyond_a_replay_are_noticed() {
        let mut audit = Audit::new(stand(130, 0), 30, true);
        assert_eq!(audit.settled(31, stand(130, 0)), Cost { units: 30, instead: Some(30) });
    }

    #[test]
    fn an_account_that_was_opened_anew_proves_too_many_claims_only() {
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
    fn a_ledger_that_was_put_back_proves_nothing() {
        let mut audit = Audit::new(stand(500, 0), 0, true);
        assert_eq!(audit.settled(40, stand(300, 0)), true_cost(40));
        assert!(!audit.is_whole());
    }
}
