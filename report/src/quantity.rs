//! The metrics of an evaluation that reports show and compare.

use tandem_core::Wilson;
use tandem_telemetry::MetricsRow;

/// The metric that a curve shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quantity {
    /// Evaluation success, with its 95 % interval.
    Success,
    /// Evaluation success without contact between the arms, with its 95 % interval.
    SuccessWithoutContact,
    /// Evaluation success by the joint norm.
    SuccessJoint,
    /// Success of the training episodes.
    TrainingSuccess,
    /// Share of evaluation episodes in which an object was displaced.
    Moved,
    /// Share of evaluation episodes with a contact.
    CollisionRate,
    /// Share of evaluation episodes with a contact before all objects were at their goals.
    CollisionRateBeforeSuccess,
    /// Mean Q-value of the policy's actions.
    MeanQ,
    /// Units of advice spent.
    AdviceSpent,
}

impl Quantity {
    /// Returns the label of the vertical axis.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Success | Self::SuccessJoint | Self::TrainingSuccess => "success rate",
            Self::SuccessWithoutContact => "success without contact",
            Self::Moved | Self::CollisionRate | Self::CollisionRateBeforeSuccess => {
                "share of episodes"
            }
            Self::MeanQ => "mean Q-value",
            Self::AdviceSpent => "units of advice",
        }
    }

    /// Returns true if the values are shares, in [0, 1].
    #[must_use]
    pub const fn is_share(self) -> bool {
        !matches!(self, Self::MeanQ | Self::AdviceSpent)
    }

    /// Returns the value of this metric in `row`, NaN if the row does not have it.
    pub(crate) fn of(self, row: &MetricsRow) -> f64 {
        match self {
            Self::Success => row.success,
            Self::SuccessWithoutContact => row.contacts.success_without_contact.unwrap_or(f64::NAN),
            Self::SuccessJoint => row.success_joint,
            Self::TrainingSuccess => row.training_success,
            Self::Moved => row.moved,
            Self::CollisionRate => row.collision_rate,
            Self::CollisionRateBeforeSuccess => row.collision_rate_before_success,
            // The critic of the initial policy has learned nothing, and its rows have a zero.
            Self::MeanQ if row.updates == 0 => f64::NAN,
            Self::MeanQ => row.mean_q,
            Self::AdviceSpent => row.advice_spent as f64,
        }
    }

    /// Returns the 95 % interval of this metric in `row`, if it has one.
    pub(crate) fn interval(self, row: &MetricsRow) -> Option<(f64, f64)> {
        match self {
            Self::Success => Some((row.success_low, row.success_high)),
            Self::SuccessWithoutContact => {
                row.contacts.success().map(|(_, Wilson { low, high })| (low, high))
            }
            _ => None,
        }
    }
}
