//! Manipulation of objects by the arms of a task: shared objects, conditions of holding an object, and conditions of
//! success beyond the distance to the goal.

use serde::{Deserialize, Serialize};

use super::Norm;

/// Manipulation of objects by the arms of a task. The default is that of tasks in which each arm has an object of its
/// own, and in which an episode succeeds if its last step achieves the goal.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct Manipulation {
    /// Whether all arms act on one object. Hindsight goals of all arms then come from one later step, and parts of arms
    /// from different steps are not recombined.
    pub shared_object: bool,
    /// Name of the task that each arm taken by itself performs, which is that of a teacher; empty if it is this task's.
    pub one_arm_task: String,
    /// Number of control steps at the end of an episode after all of which the goal must be achieved, 1 to the steps of
    /// an episode.
    pub success_steps: usize,
    /// The arms in order, or none.
    pub arms: Vec<ArmManipulation>,
}

/// Manipulation of an object by one arm. Indices are those of the task's vectors and belong to the arm.
#[derive(Debug, Clone, PartialEq, Default, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct ArmManipulation {
    /// Index of the action that opens the gripper if it is positive. Exploration opens no gripper that holds an object.
    pub gripper: Option<usize>,
    /// The conditions under which the arm holds its object, at most 16. If there are any, success needs them.
    pub holding: Vec<Condition>,
    /// Further conditions of success, at most 16.
    pub conditions: Vec<Condition>,
}

/// A condition on an observation: some of its numbers lie within a distance of given values.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Condition {
    /// Indices in an observation.
    pub numbers: Vec<usize>,
    /// The values from which the distance is measured, one for each index; empty means zeros.
    #[serde(default)]
    pub target: Vec<f32>,
    /// The largest distance, in the task's norm, 0 or more.
    pub tolerance: f32,
}

impl Default for Manipulation {
    fn default() -> Self {
        Self {
            shared_object: false,
            one_arm_task: String::new(),
            success_steps: 1,
            arms: Vec::new(),
        }
    }
}

impl Manipulation {
    pub(super) fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

impl ArmManipulation {
    /// Returns the conditions of success, in order.
    pub(super) fn all_conditions(&self) -> impl Iterator<Item = &Condition> {
        self.holding.iter().chain(&self.conditions)
    }

    /// Returns the same with other indices; `None` if one of them has no other index.
    pub(super) fn reindexed(
        &self,
        observation: impl Fn(usize) -> Option<usize>,
        action: impl Fn(usize) -> Option<usize>,
    ) -> Option<Self> {
        let condition = |condition: &Condition| {
            let numbers = condition.numbers.iter().map(|idx| observation(*idx));
            Some(Condition { numbers: numbers.collect::<Option<_>>()?, ..condition.clone() })
        };
        Some(Self {
            gripper: match self.gripper {
                Some(idx) => Some(action(idx)?),
                None => None,
            },
            holding: self.holding.iter().map(condition).collect::<Option<_>>()?,
            conditions: self.conditions.iter().map(condition).collect::<Option<_>>()?,
        })
    }
}

impl Condition {
    /// Returns true if `observation` satisfies the condition.
    #[must_use]
    pub(super) fn holds(&self, norm: Norm, observation: &[f32]) -> bool {
        let targets = self.target.iter().copied().chain(std::iter::repeat(0.0));
        let pairs = self.numbers.iter().zip(targets);
        let accumulated = pairs
            .map(|(idx, target)| norm.accumulate(&[observation[*idx]], &[target]))
            .fold(0.0, |first, second| norm.combined(first, second));
        norm.of_accumulated(accumulated) <= self.tolerance
    }
}
