//! A ledger in memory.

use std::collections::BTreeMap;

use super::{
    ChargeRequest, ChargeResult, Ledger, LedgerError, charge_all, check_budget, check_terms,
    unknown_account,
};
use crate::budget::{Account, AccountTerms, Balance, Lease};

/// A ledger in memory. Its accounts are lost when the process ends.
#[derive(Debug, Clone, Default)]
pub struct MemoryLedger {
    accounts: BTreeMap<String, Account>,
}

impl MemoryLedger {
    fn account(&mut self, name: &str) -> Result<&mut Account, LedgerError> {
        self.accounts.get_mut(name).ok_or_else(|| unknown_account(name))
    }
}

impl Ledger for MemoryLedger {
    fn open(&mut self, name: &str, terms: AccountTerms) -> Result<Balance, LedgerError> {
        check_budget(terms)?;
        let account = self.accounts.entry(name.to_owned()).or_insert_with(|| Account::new(terms));
        check_terms(name, account.terms(), terms)?;
        Ok(account.balance())
    }

    fn balance(&mut self, name: &str) -> Result<Balance, LedgerError> {
        Ok(self.account(name)?.balance())
    }

    fn open_leases(
        &mut self,
        name: &str,
        episodes: &[u64],
        units_per_episode: u32,
    ) -> Result<(Vec<Lease>, Balance), LedgerError> {
        let account = self.account(name)?;
        Ok((account.open_leases(episodes, units_per_episode), account.balance()))
    }

    fn settle(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, LedgerError> {
        let account = self.account(name)?;
        account.settle(episodes);
        Ok(account.balance())
    }

    fn charge(&mut self, requests: &[ChargeRequest]) -> Vec<Result<ChargeResult, LedgerError>> {
        let charge = |request: &ChargeRequest| {
            let account = self.account(&request.account)?;
            account.update(|transaction| charge_all(transaction, request))
        };
        requests.iter().map(charge).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::budget::{BudgetHalves, Charge, MAX_BUDGET};
    use crate::strategy::Strategy;

    const TERMS: AccountTerms = AccountTerms { budget: 10, strategy: Strategy::EarlyAdvising };

    #[test]
    fn an_account_is_opened_once() {
        let mut ledger = MemoryLedger::default();
        let fresh = Balance { terms: TERMS, spent: 0, leased: 0, left: 10 };
        assert_eq!(ledger.open("run", TERMS).unwrap(), fresh);
        let charge = Charge { episode: 1, step: 0, wanted_in: BudgetHalves::BOTH };
        let request = ChargeRequest {
            account: "run".to_owned(),
            strategy: TERMS.strategy,
            episode_steps: 50,
            charges: vec![charge],
        };
        assert_eq!(ledger.charge(&[request]).remove(0).unwrap().left, 9);
        assert_eq!(ledger.open("run", TERMS).unwrap(), Balance { spent: 1, left: 9, ..fresh });
    }

    #[test]
    fn other_terms_are_refused_with_both_named() {
        let mut ledger = MemoryLedger::default();
        ledger.open("run", TERMS).unwrap();
        let requested =
            AccountTerms { budget: 11, strategy: Strategy::MistakeQ { threshold: 0.05 } };
        let message = ledger.open("run", requested).unwrap_err().to_string();
        let expected = "account \"run\" is open with budget 10 and strategy ea, not with budget 11 and strategy mc-q:0.05";
        assert_eq!(message, expected);
    }

    #[test]
    fn the_largest_budget_is_ten_to_the_twelve() {
        let mut ledger = MemoryLedger::default();
        assert!(ledger.open("run", AccountTerms { budget: MAX_BUDGET, ..TERMS }).is_ok());
        let too_large = AccountTerms { budget: MAX_BUDGET + 1, ..TERMS };
        let refused = ledger.open("more", too_large).unwrap_err().to_string();
        assert_eq!(refused, "budget: expected 0 to 1000000000000, got 1000000000001");
        let unknown = ledger.balance("more").unwrap_err().to_string();
        assert_eq!(unknown, "unknown account \"more\": open it first");
    }
}
