//! The procedure of a strategy for a step.

use crate::procedures::{ActionFilter, Procedure, jump_start};

pub use tandem_core::strategy::{DEFAULT_THRESHOLD, Strategy, UnknownStrategy};

/// The half of the budget that a unit belongs to. A unit belongs to the first half if more than half of the budget is
/// left before it is assigned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BudgetHalf {
    /// The units that are assigned first.
    First,
    /// The other units.
    Second,
}

/// Returns the procedure of `strategy` for step `step` of an episode, from 0, whose unit would come from `half` of the
/// budget; `None` if the teacher does not act. The half matters to EAMC only (section 4.2 of the paper).
#[must_use]
pub fn procedure(strategy: Strategy, half: BudgetHalf, step: u32) -> Option<Procedure> {
    match (strategy, half) {
        (Strategy::NoAdvice, _) => None,
        (Strategy::EarlyAdvising, _) | (Strategy::EarlyThenMistakeQ { .. }, BudgetHalf::First) => {
            Some(Procedure::EarlyAdvising)
        }
        (Strategy::MistakeQ { threshold } | Strategy::InterventionFeedback { threshold }, _)
        | (Strategy::EarlyThenMistakeQ { threshold }, BudgetHalf::Second) => {
            Some(Procedure::MistakeCorrectingQ { threshold })
        }
        (Strategy::CriticDisagreement { .. }, _) => {
            Some(Procedure::MistakeCorrectingQ { threshold: DEFAULT_THRESHOLD })
        }
        (Strategy::MistakeAction { alpha }, _) => {
            Some(Procedure::MistakeCorrectingAction(ActionFilter::McAct { alpha }))
        }
        (Strategy::MistakeActionAbs { alpha }, _) => {
            Some(Procedure::MistakeCorrectingAction(ActionFilter::McActAbs { alpha }))
        }
        (Strategy::JumpStart { horizon }, _) => {
            jump_start(step, horizon).then_some(Procedure::EarlyAdvising)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eamc_changes_its_procedure_with_the_half_of_the_budget() {
        let eamc = Strategy::EarlyThenMistakeQ { threshold: 0.5 };
        assert_eq!(procedure(eamc, BudgetHalf::First, 0), Some(Procedure::EarlyAdvising));
        assert_eq!(
            procedure(eamc, BudgetHalf::Second, 0),
            Some(Procedure::MistakeCorrectingQ { threshold: 0.5 })
        );
        assert_eq!(procedure(Strategy::NoAdvice, BudgetHalf::First, 0), None);
    }

    #[test]
    fn the_teacher_acts_on_both_halves_of_the_budget_before_the_horizon_and_never_after_it() {
        let jsrl = Strategy::JumpStart { horizon: 3 };
        for half in [BudgetHalf::First, BudgetHalf::Second] {
            let steps = (0..6).map(|step| procedure(jsrl, half, step).is_some());
            assert_eq!(steps.collect::<Vec<_>>(), [true, true, true, false, false, false]);
            assert_eq!(procedure(jsrl, half, 2), Some(Procedure::EarlyAdvising));
        }
    }

    #[test]
    fn rlif_intervenes_as_mc_q_does() {
        for half in [BudgetHalf::First, BudgetHalf::Second] {
            let of = |strategy| procedure(strategy, half, 7);
            let threshold = 0.25;
            assert_eq!(
                of(Strategy::InterventionFeedback { threshold }),
                of(Strategy::MistakeQ { threshold })
            );
        }
    }
}
