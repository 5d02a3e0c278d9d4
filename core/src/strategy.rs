//! The advising strategies, by their names on the command line. The teacher decides by them on which arms it acts; a
//! learner and its workers by some of them when the student asks, and what an intervention costs it.

use std::fmt;
use std::str::FromStr;

/// The threshold of a strategy whose name omits it: the largest of those that the paper compares (0.01, 0.05, 0.1).
pub const DEFAULT_THRESHOLD: f32 = 0.1;
/// The horizon of [`Strategy::JumpStart`] if its name omits it, control steps.
pub const DEFAULT_HORIZON: u32 = 20;
/// The largest horizon, control steps.
pub const MAX_HORIZON: u32 = 100_000;

/// A rule for when the teacher advises: those of the paper (section 3.2) with the names that it gives them in section
/// 4.2, and three of other publications.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Strategy {
    /// Never (NA).
    NoAdvice,
    /// On every step (EA, procedure 1).
    EarlyAdvising,
    /// On every step for the first half of the budget, then as [`Self::MistakeQ`] (EAMC). The paper does not say which
    /// mistake-correcting procedure the second half has.
    EarlyThenMistakeQ {
        /// `t_I` in the second half.
        threshold: f32,
    },
    /// For arms where the teacher values its own action above the student's by more than a threshold (MC-Q, procedure
    /// 2).
    MistakeQ {
        /// `t_I`, a difference of the teacher's values, 0 or more (equation 10).
        threshold: f32,
    },
    /// For arms where the student's action is farther from the teacher's than a threshold (MC-ACT, procedure 3).
    MistakeAction {
        /// `α`, a Euclidean distance between two actions of one arm, 0 or more (equation 11).
        alpha: f32,
    },
    /// As [`Self::MistakeAction`], with a threshold relative to the length of the teacher's action (MC-ACT-ABS).
    MistakeActionAbs {
        /// `α`, a multiple of the length of the teacher's action, 0 or more (equation 11).
        alpha: f32,
    },
    /// On the first steps of an episode, fewer as the student succeeds (JSRL, Uchendu et al. 2023). The learner decides
    /// how many, and its workers do not ask after them.
    JumpStart {
        /// `H`, the largest number of control steps, 1 to [`MAX_HORIZON`].
        horizon: u32,
    },
    /// As [`Self::MistakeQ`] with the default threshold, on the steps whose value the student does not know: where an
    /// ensemble of its critics disagrees (after TS2C, Xue et al. 2023). Workers ask on these steps only.
    CriticDisagreement {
        /// The standard deviation of the critics' values, of the arm where it is largest, above which to ask; 0 or
        /// more.
        threshold: f32,
    },
    /// As [`Self::MistakeQ`], and the student's step before an intervention costs it a reward of 1 (RLIF, Luo et al.
    /// 2023).
    InterventionFeedback {
        /// `t_I`, a difference of the teacher's values, 0 or more.
        threshold: f32,
    },
}

impl Strategy {
    /// The names of the strategies; `T` and `A` are thresholds, `H` is a number of steps.
    pub const NAMES: [&str; 9] = [
        "none",
        "ea",
        "eamc:T",
        "mc-q:T",
        "mc-act:A",
        "mc-act-abs:A",
        "jsrl:H",
        "rlif:T",
        "ts2c:T",
    ];

    /// Returns the names of the strategies that a teacher offers which `has_values` of actions, or has none.
    #[must_use]
    pub fn names(has_values: bool) -> Vec<&'static str> {
        let needs_values = |name: &str| {
            let name = name.split_once(':').map_or(name, |(name, _)| name);
            name.parse().is_ok_and(Self::needs_values)
        };
        Self::NAMES.into_iter().filter(|name| has_values || !needs_values(name)).collect()
    }

    /// Returns true if the strategy compares values of actions.
    #[must_use]
    pub const fn needs_values(self) -> bool {
        match self {
            Self::NoAdvice
            | Self::EarlyAdvising
            | Self::MistakeAction { .. }
            | Self::MistakeActionAbs { .. }
            | Self::JumpStart { .. } => false,
            Self::EarlyThenMistakeQ { .. }
            | Self::MistakeQ { .. }
            | Self::InterventionFeedback { .. }
            | Self::CriticDisagreement { .. } => true,
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
            Self::JumpStart { horizon } => write!(f, "jsrl:{horizon}"),
            Self::InterventionFeedback { threshold } => write!(f, "rlif:{threshold}"),
            Self::CriticDisagreement { threshold } => write!(f, "ts2c:{threshold}"),
        }
    }
}

/// The number of characters of an invalid text that the error repeats.
const MAX_SHOWN_CHARS: usize = 80;

/// The error for a text that is not the name of a strategy.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "expected {names} (thresholds finite, 0 or more, 0.1 when left out; H 1 to {MAX_HORIZON} steps, {DEFAULT_HORIZON} \
     when left out), got {0:?}",
    names = Strategy::NAMES.join(", ")
)]
pub struct UnknownStrategy(pub String);

impl FromStr for Strategy {
    type Err = UnknownStrategy;

    fn from_str(text: &str) -> Result<Self, UnknownStrategy> {
        let unknown = || UnknownStrategy(text.chars().take(MAX_SHOWN_CHARS).collect());
        let (name, number) = match text.split_once(':') {
            Some((name, number)) => (name, Some(number)),
            None => (text, None),
        };
        let threshold = || number.map_or(Some(DEFAULT_THRESHOLD), parse_threshold);
        let horizon = || number.map_or(Some(DEFAULT_HORIZON), parse_horizon);
        let strategy = match name {
            "none" if number.is_none() => Some(Self::NoAdvice),
            "ea" if number.is_none() => Some(Self::EarlyAdvising),
            "eamc" => threshold().map(|threshold| Self::EarlyThenMistakeQ { threshold }),
            "mc-q" => threshold().map(|threshold| Self::MistakeQ { threshold }),
            "mc-act" => threshold().map(|alpha| Self::MistakeAction { alpha }),
            "mc-act-abs" => threshold().map(|alpha| Self::MistakeActionAbs { alpha }),
            "jsrl" => horizon().map(|horizon| Self::JumpStart { horizon }),
            "rlif" => threshold().map(|threshold| Self::InterventionFeedback { threshold }),
            "ts2c" => threshold().map(|threshold| Self::CriticDisagreement { threshold }),
            _ => None,
        };
        strategy.ok_or_else(unknown)
    }
}

/// Parses a finite number, at least 0. −0 becomes 0.
fn parse_threshold(text: &str) -> Option<f32> {
    text.parse()
        .ok()
        .filter(|threshold: &f32| threshold.is_finite() && *threshold >= 0.0)
        .map(f32::abs)
}

/// Parses a number of steps, 1 to [`MAX_HORIZON`].
fn parse_horizon(text: &str) -> Option<u32> {
    text.parse().ok().filter(|horizon| (1..=MAX_HORIZON).contains(horizon))
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
        check("ts2c:0.75", Strategy::CriticDisagreement { threshold: 0.75 });
        check("eamc:0.25", Strategy::EarlyThenMistakeQ { threshold: 0.25 });
        check("mc-q:0", Strategy::MistakeQ { threshold: 0.0 });
        check("mc-act:1e-2", Strategy::MistakeAction { alpha: 0.01 });
        check("mc-act-abs:0.05", Strategy::MistakeActionAbs { alpha: 0.05 });
        check("jsrl:50", Strategy::JumpStart { horizon: 50 });
        check("rlif:0.5", Strategy::InterventionFeedback { threshold: 0.5 });
        check("eamc", Strategy::EarlyThenMistakeQ { threshold: 0.1 });
        check("mc-q", Strategy::MistakeQ { threshold: 0.1 });
        check("mc-act", Strategy::MistakeAction { alpha: 0.1 });
        check("mc-act-abs", Strategy::MistakeActionAbs { alpha: 0.1 });
        check("jsrl", Strategy::JumpStart { horizon: 20 });
        check("rlif", Strategy::InterventionFeedback { threshold: 0.1 });
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
            "jsrl:0",
            "jsrl:2.5",
            "jsrl:100001",
            "rlif:-1",
        ] {
            let message = text.parse::<Strategy>().unwrap_err().to_string();
            let names = "expected none, ea, eamc:T, mc-q:T, mc-act:A, mc-act-abs:A, jsrl:H, rlif:T, \
                         ts2c:T";
            assert!(message.starts_with(names), "{message}");
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
        assert_eq!(Strategy::names(false), ["none", "ea", "mc-act:A", "mc-act-abs:A", "jsrl:H"]);
    }
}
