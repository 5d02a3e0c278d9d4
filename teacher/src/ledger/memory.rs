//! Accounts that live as long as the process.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use tandem_core::layout::EPISODE_STEPS;

use super::{Bill, Charge, Ledger, LedgerError, Receipt};
use crate::budget::{Account, Balance, BudgetError, Lease, MAX_BUDGET, Terms};

/// Accounts in memory: forgotten when the process ends.
#[derive(Debug, Clone, Default)]
pub struct MemoryLedger {
    accounts: BTreeMap<String, Account>,
}

impl MemoryLedger {
    fn account(&self, name: &str) -> Result<&Account, BudgetError> {
        self.accounts.get(name).ok_or_else(|| BudgetError::UnknownAccount(name.to_owned()))
    }

    fn account_mut(&mut self, name: &str) -> Result<&mut Account, BudgetError> {
        self.accounts.get_mut(name).ok_or_else(|| BudgetError::UnknownAccount(name.to_owned()))
    }

    fn charge_bill(&mut self, bill: &Bill) -> Result<Receipt, LedgerError> {
        let account = self.account_mut(&bill.account)?;
        if let Some(charge_idx) = bill.charges.iter().position(|charge| is_beyond(account, charge))
        {
            return Err(LedgerError::BeyondEnd { charge_idx });
        }
        let charge = |charge: &Charge| account.charge(charge.episode, charge.step, charge.wish);
        let verdicts = bill.charges.iter().map(charge).collect();
        Ok(Receipt { verdicts, left: account.left() })
    }
}

/// Episodes of a run, which have leases, have [`EPISODE_STEPS`] steps; how long others are is their owner's matter.
fn is_beyond(account: &Account, charge: &Charge) -> bool {
    usize::try_from(charge.step).map_or(true, |step| step >= EPISODE_STEPS)
        && account.has_lease(charge.episode)
}

impl Ledger for MemoryLedger {
    fn open(&mut self, name: &str, terms: Terms) -> Result<Balance, LedgerError> {
        if terms.budget > MAX_BUDGET {
            return Err(BudgetError::BudgetTooLarge(terms.budget).into());
        }
        match self.accounts.entry(name.to_owned()) {
            Entry::Vacant(vacant) => Ok(vacant.insert(Account::new(terms)).balance()),
            Entry::Occupied(account) if account.get().terms() == terms => {
                Ok(account.get().balance())
            }
            Entry::Occupied(account) => Err(LedgerError::Budget(BudgetError::OtherTerms {
                name: name.to_owned(),
                open: account.get().terms(),
                asked: terms,
            })),
        }
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
        let account = self.account_mut(name)?;
        Ok((account.open_leases(episodes, units_per_episode), account.balance()))
    }

    fn settle(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, LedgerError> {
        let account = self.account_mut(name)?;
        account.settle(episodes);
        Ok(account.balance())
    }

    fn charge(&mut self, bills: &[Bill]) -> Vec<Result<Receipt, LedgerError>> {
        bills.iter().map(|bill| self.charge_bill(bill)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::budget::Wish;
    use crate::strategy::Strategy;

    const TERMS: Terms = Terms { budget: 10, strategy: Strategy::EarlyAdvising };

    #[test]
    fn an_account_is_opened_once() {
        let mut ledger = MemoryLedger::default();
        let fresh = Balance { terms: TERMS, spent: 0, leased: 0, left: 10 };
        assert_eq!(ledger.open("run", TERMS).unwrap(), fresh);
        let charge = Charge { episode: 1, step: 0, wish: Wish { first: true, second: true } };
        let bill = Bill { account: "run".to_owned(), charges: vec![charge] };
        assert_eq!(ledger.charge(&[bill]).remove(0).unwrap().left, 9);
        assert_eq!(ledger.open("run", TERMS).unwrap(), Balance { spent: 1, left: 9, ..fresh });
    }

    #[test]
    fn other_terms_are_refused_with_both_named() {
        let mut ledger = MemoryLedger::default();
        ledger.open("run", TERMS).unwrap();
        let asked = Terms { budget: 11, strategy: Strategy::MistakeQ { threshold: 0.05 } };
        let message = ledger.open("run", asked).unwrap_err().to_string();
        let expected = "account \"run\" is open with budget 10 and strategy ea, not with budget 11 and strategy mc-q:0.05";
        assert_eq!(message, expected);
    }

    #[test]
    fn the_largest_budget_is_ten_to_the_twelve() {
        let mut ledger = MemoryLedger::default();
        assert!(ledger.open("run", Terms { budget: MAX_BUDGET, ..TERMS }).is_ok());
        let too_large = Terms { budget: MAX_BUDGET + 1, ..TERMS };
        let refused = ledger.open("more", too_large).unwrap_err().to_string();
        assert_eq!(refused, "budget: expected 0 to 1000000000000, got 1000000000001");
        let unknown = ledger.balance("more").unwrap_err().to_string();
        assert_eq!(unknown, "unknown account \"more\": open it first");
    }
}
