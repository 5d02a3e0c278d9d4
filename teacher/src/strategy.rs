//! The advising strategies of the paper, by their names on the command line.

use std::fmt;
use std::str::FromStr;

use crate::procedures::{ActionFilter, Procedure};

/// The threshold of a strategy whose name omits it.
pub const DEFAULT_THRESHOLD: f32 = 0.1;

/// A rule for when the teacher advises.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Strategy {
    /// Never (NA).
    NoAdvice,
    /// On every step (EA).
    EarlyAdvising,
    /// On every step for the first half of the budget, then as [`Self::MistakeQ`] (EAMC).
    EarlyThenMistakeQ {
        /// `t_I` in the second half.
        threshold: f32,
    },
    /// When the teacher's action is worth more than the student's by a threshold (MC-Q).
    MistakeQ {
        /// `t_I`, a difference of values.
        threshold: f32,
    },
    /// When the student's action is far from the teacher's (MC-ACT).
    MistakeAction {
        /// `α`, a Euclidean distance of actions.
        alpha: f32,
    },
    /// As [`Self::MistakeAction`], with the distance relative to the length of the teacher's action (MC-ACT-ABS).
    MistakeActionAbs {
        /// `α`, a multiple of the length of the teacher's action.
        alpha: f32,
    },
}

/// The half of the budget that a unit belongs to. A unit belongs to the first half if more than half of the budget is
/// left before it is assigned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BudgetHalf {
    /// The units that are assigned first.
    First,
    /// The other units.
    Second,
}

impl Strategy {
    /// The names of the strategies; `T` and `A` are thresholds.
    pub const NAMES: [&str; 6] = ["none", "ea", "eamc:T", "mc-q:T", "mc-act:A", "mc-act-abs:A"];

    /// Returns the names of the strategies that a teacher offers which `has_values` of actions, or has none.
    #[must_use]
    pub fn names(has_values: bool) -> Vec<&'static str> {
        let is_offered =
            |name: &&str| has_values || !(name.starts_with("eamc") || name.starts_with("mc-q"));
        Self::NAMES.into_iter().filter(is_offered).collect()
    }

    /// Returns true if the strategy compares values of actions.
    #[must_use]
    pub const fn needs_values(self) -> bool {
        matches!(self, Self::EarlyThenMistakeQ { .. } | Self::MistakeQ { .. })
    }

    /// Returns the procedure for a step whose unit would come from `half` of the budget.
    #[must_use]
    pub const fn procedure(self, half: BudgetHalf) -> Option<Procedure> {
        match (self, half) {
            (Self::NoAdvice, _) => None,
            (Self::EarlyAdvising, _) | (Self::EarlyThenMistakeQ { .. }, BudgetHalf::First) => {
                Some(Procedure::EarlyAdvising)
            }
            (Self::MistakeQ { threshold }, _)
            | (Self::EarlyThenMistakeQ { threshold }, BudgetHalf::Second) => {
                Some(Procedure::MistakeCorrectingQ { threshold })
            }
            (Self::MistakeAction { alpha }, _) => {
                Some(Procedure::MistakeCorrectingAction(ActionFilter::McAct { alpha }))
            }
            (Self::MistakeActionAbs { alpha }, _) => {
                Some(Procedure::MistakeCorrectingAction(ActionFilter::McActAbs { alpha }))
            }
        }
    }
}

impl fmt::Display for Strategy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoAdvice => f.write_str("none"),
            Self::EarlyAdvising => f.write_str("ea"),
            Self::EarlyThenMistakeQ { threshold } => write!(f, "eamc:{threshold}"),
            Self::MistakeQ { threshold } => write!(f, "mc-q:{threshold}"),
            Self::MistakeAction { alpha } => write!(f, "mc-act:{alpha}"),
            Self::MistakeActionAbs { alpha } => write!(f, "mc-act-abs:{alpha}"),
        }
    }
}

/// The number of characters of an invalid text that the error repeats.
const MAX_SHOWN_CHARS: usize = 80;

/// The error for a text that is not the name of a strategy.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("expected {names} (thresholds finite, 0 or more, 0.1 when left out), got {0:?}", names = Strategy::NAMES.join(", "))]
pub struct UnknownStrategy(pub String);

impl FromStr for Strategy {
    type Err = UnknownStrategy;

    fn from_str(text: &str) -> Result<Self, UnknownStrategy> {
        let unknown = || UnknownStrategy(text.chars().take(MAX_SHOWN_CHARS).collect());
        let (name, threshold_text) = match text.split_once(':') {
            Some((name, threshold)) => (name, Some(threshold)),
            None => (text, None),
        };
        let threshold =
            threshold_text.map_or(Some(DEFAULT_THRESHOLD), parse_threshold).ok_or_else(unknown)?;
        match name {
            "none" if threshold_text.is_none() => Ok(Self::NoAdvice),
            "ea" if threshold_text.is_none() => Ok(Self::EarlyAdvising),
            "eamc" => Ok(Self::EarlyThenMistakeQ { threshold }),
            "mc-q" => Ok(Self::MistakeQ { threshold }),
            "mc-act" => Ok(Self::MistakeAction { alpha: threshold }),
            "mc-act-abs" => Ok(Self::MistakeActionAbs { alpha: threshold }),
            _ => Err(unknown()),
        }
    }
}

/// Parses a finite number, at least 0. −0 becomes 0.
fn parse_threshold(text: &str) -> Option<f32> {
    text.parse()
        .ok()
        .filter(|threshold: &f32| threshold.is_finite() && *threshold >= 0.0)
        .map(f32::abs)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_strategy_is_parsed_from_its_name() {
        let check = |text: &str, strategy: Strategy| {
            assert_eq!(text.parse(), Ok(strategy), "{text}");
            assert_eq!(strategy.to_string().parse(), Ok(strategy), "{strategy}");
        };
        check("none", Strategy::NoAdvice);
        check("ea", Strategy::EarlyAdvising);
        check("eamc:0.25", Strategy::EarlyThenMistakeQ { threshold: 0.25 });
        check("mc-q:0", Strategy::MistakeQ { threshold: 0.0 });
        check("mc-act:1e-2", Strategy::MistakeAction { alpha: 0.01 });
        check("mc-act-abs:0.05", Strategy::MistakeActionAbs { alpha: 0.05 });
        check("eamc", Strategy::EarlyThenMistakeQ { threshold: 0.1 });
        check("mc-q", Strategy::MistakeQ { threshold: 0.1 });
        check("mc-act", Strategy::MistakeAction { alpha: 0.1 });
        check("mc-act-abs", Strategy::MistakeActionAbs { alpha: 0.1 });
        assert_eq!("mc-q:-0".parse::<Strategy>().unwrap().to_string(), "mc-q:0");
        assert_eq!("mc-q:0.10".parse::<Strategy>().unwrap().to_string(), "mc-q:0.1");
    }

    #[test]
    fn an_unknown_strategy_is_refused_with_the_list_of_names() {
        for text in [
            "",
            "MC-Q",
            "mc",
            "mc-q:",
            "mc-q:NaN",
            "mc-q:inf",
            "mc-q:-0.1",
            "mc-q:1:2",
            "ea:0.1",
            "none:0",
        ] {
            let message = text.parse::<Strategy>().unwrap_err().to_string();
            assert!(
                message.starts_with("expected none, ea, eamc:T, mc-q:T, mc-act:A, mc-act-abs:A"),
                "{message}"
            );
            assert!(message.ends_with(&format!("got {text:?}")), "{message}");
        }
    }

    #[test]
    fn a_teacher_without_values_offers_exactly_the_strategies_that_need_none() {
        assert_eq!(Strategy::names(true), Strategy::NAMES);
        for name in Strategy::NAMES {
            let strategy: Strategy = name.split(':').next().unwrap().parse().unwrap();
            assert_eq!(Strategy::names(false).contains(&name), !strategy.needs_values(), "{name}");
        }
    }

    #[test]
    fn eamc_changes_its_procedure_with_the_half_of_the_budget() {
        let eamc = Strategy::EarlyThenMistakeQ { threshold: 0.5 };
        assert_eq!(eamc.procedure(BudgetHalf::First), Some(Procedure::EarlyAdvising));
        assert_eq!(
            eamc.procedure(BudgetHalf::Second),
            Some(Procedure::MistakeCorrectingQ { threshold: 0.5 })
        );
        assert_eq!(Strategy::NoAdvice.procedure(BudgetHalf::First), None);
    }
}
