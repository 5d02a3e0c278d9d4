//! The description of a task as plain data.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{Manipulation, Reflection};
use crate::text::shortened;

/// Longest text of a value in a message.
const MAX_SHOWN_CHARS: usize = 60;

/// The description of a task: the vectors of its environment, the parts of these vectors that belong to each arm, the
/// sparse reward and the length of an episode. Learner, teacher and workers use no other knowledge of a task.
///
/// It is data from files and messages and may be inconsistent; a [`TaskSpec`](super::TaskSpec) is checked.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct TaskDescription {
    /// Name: 1 to 64 lower-case letters, digits, `-`, `_`, `.` and `/`.
    pub name: String,
    /// Length of an observation, 1 to 4096.
    pub n_observation: usize,
    /// Length of a goal, 1 to 4096.
    pub n_goal: usize,
    /// Length of an action, 1 to 4096; components are in [−1, 1].
    pub n_action: usize,
    /// For each number of the achieved goal its index in the observation, shape `[n_goal]`.
    pub achieved_goal: Vec<usize>,
    /// Control steps per episode, 1 to 10,000.
    pub episode_steps: usize,
    /// Distance up to which a goal counts as achieved, in the unit of the goal, above 0.
    pub tolerance: f32,
    /// Norm of the difference between achieved and desired goal.
    pub norm: Norm,
    /// Whether exchanging the parts of two arms gives another valid transition.
    #[serde(default)]
    pub interchangeable_arms: bool,
    /// Whether steps report contacts between arms and with the table.
    #[serde(default)]
    pub reports_contacts: bool,
    /// Distance between the origins of two arms along the axis of [`ArmDescription::position`], in the unit of these
    /// positions, 0 or more. Each arm's axis points at the other arm.
    #[serde(default)]
    pub origin_distance: f32,
    /// Smallest gap between two arms whose parts come from different steps, 0 or more: along that axis, or in the plane
    /// if [`ArmDescription::lateral`] is given.
    #[serde(default)]
    pub recombination_gap: f32,
    /// Coordinate of each arm's base along that axis, arm frame. Between its base and its first position, an arm
    /// occupies the plane.
    #[serde(default)]
    pub base: f32,
    /// Distances along that axis, across it and up: hands ([`ArmDescription::hand`]) that are nearer to each other
    /// along all three are in contact. Three numbers above 0, or none if that is unknown.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub contact_distances: Vec<f32>,
    /// Largest magnitude of each number of an observation, above 0, shape `[n_observation]`. A learner refuses episodes
    /// with larger ones.
    pub observation_bound: Vec<f32>,
    /// Largest magnitude of each number of a desired goal, above 0, shape `[n_goal]`.
    pub goal_bound: Vec<f32>,
    /// The arms in order, 1 to 8.
    pub arms: Vec<ArmDescription>,
    /// Shared objects, conditions of holding an object, and conditions of success beyond the distance to the goal.
    #[serde(default, skip_serializing_if = "Manipulation::is_default")]
    pub manipulation: Manipulation,
    /// A mirror symmetry of the world, if it has one.
    #[serde(default, skip_serializing_if = "Reflection::is_none")]
    pub reflection: Reflection,
}

/// The indices of one arm in the vectors of its task. The parts of all arms have the same lengths.
///
/// An index belongs to at most one arm, and every index of an action to exactly one. Numbers of observations and goals
/// that belong to no arm are common to all arms.
#[derive(Debug, Clone, PartialEq, Eq, Default, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ArmDescription {
    /// Indices in an observation.
    pub observation: Vec<usize>,
    /// Indices in a goal.
    pub goal: Vec<usize>,
    /// Indices in an action.
    pub action: Vec<usize>,
    /// Indices, in the observation, of the positions along the axis on which the arms face each other. Parts of two
    /// arms from different steps may be recombined where these positions lie far enough apart. Empty: arms are not
    /// recombined.
    #[serde(default)]
    pub position: Vec<usize>,
    /// Indices, in the observation, of the same positions' coordinates along the horizontal axis perpendicular to it.
    /// Empty: only the distance along the first axis counts.
    #[serde(default)]
    pub lateral: Vec<usize>,
    /// Indices, in the observation, of the three coordinates of the hand: along that axis, across it and up. Empty: the
    /// description says nothing about contacts.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub hand: Vec<usize>,
}

/// The norm of the difference between an achieved and a desired goal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Norm {
    /// The square root of the sum of squares.
    Euclidean,
    /// The largest magnitude.
    Maximum,
}

impl Norm {
    /// Returns the distance between two points of the same dimension.
    ///
    /// # Panics
    /// If the points differ in dimension.
    #[must_use]
    pub fn distance(self, a: &[f32], b: &[f32]) -> f32 {
        self.of_accumulated(self.accumulate(a, b))
    }

    /// Returns the share of two parts of points in the distance between the points: the sum of squared differences, or
    /// the largest one. [`Norm::combined`] adds shares, [`Norm::of_accumulated`] gives the distance.
    ///
    /// # Panics
    /// If the parts differ in length.
    #[must_use]
    pub fn accumulate(self, a: &[f32], b: &[f32]) -> f32 {
        assert_eq!(a.len(), b.len(), "points of different dimension");
        let differences = a.iter().zip(b).map(|(a, b)| a - b);
        match self {
            Self::Euclidean => differences.map(|difference| difference * difference).sum::<f32>(),
            Self::Maximum => differences.map(f32::abs).fold(0.0, larger),
        }
    }

    /// Returns the share that two accumulated parts have together; NaN if one of them is.
    #[must_use]
    pub const fn combined(self, first: f32, second: f32) -> f32 {
        match self {
            Self::Euclidean => first + second,
            Self::Maximum => larger(first, second),
        }
    }

    /// Returns the distance of which `accumulated` is the share of all parts.
    #[must_use]
    pub fn of_accumulated(self, accumulated: f32) -> f32 {
        match self {
            Self::Euclidean => accumulated.sqrt(),
            Self::Maximum => accumulated,
        }
    }
}

/// Returns the larger number, or NaN if one of them is.
const fn larger(a: f32, b: f32) -> f32 {
    if a.is_nan() || a > b { a } else { b }
}

/// The first field in which two descriptions differ.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TaskDifference {
    /// The field, such as `arms[1].goal`.
    pub field: String,
    /// Its value in the first description.
    pub first: String,
    /// Its value in the second one.
    pub second: String,
}

impl fmt::Display for TaskDifference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} is {} and {}", self.field, self.first, self.second)
    }
}

impl TaskDescription {
    /// Returns the first field in which `self` and `other` differ.
    #[must_use]
    pub fn difference(&self, other: &Self) -> Option<TaskDifference> {
        let differs = |field: &str, first: &dyn fmt::Debug, second: &dyn fmt::Debug| {
            let (first, second) = from_difference(&format!("{first:?}"), &format!("{second:?}"));
            Some(TaskDifference { field: field.to_owned(), first, second })
        };
        macro_rules! compare {
            ($($field:ident),+) => {
                $(if self.$field != other.$field {
                    return differs(stringify!($field), &self.$field, &other.$field);
                })+
            };
        }
        compare!(name, n_observation, n_goal, n_action);
        let n_arms = |description: &Self| description.arms.len();
        if n_arms(self) != n_arms(other) {
            return differs("number of arms", &n_arms(self), &n_arms(other));
        }
        for (arm_idx, (first, second)) in self.arms.iter().zip(&other.arms).enumerate() {
            for ((name, first), (_, second)) in first.fields().into_iter().zip(second.fields()) {
                if first != second {
                    return differs(&format!("arms[{arm_idx}].{name}"), first, second);
                }
            }
        }
        compare!(achieved_goal, episode_steps, tolerance, norm, interchangeable_arms);
        compare!(reports_contacts, origin_distance, recombination_gap, base, contact_distances);
        compare!(observation_bound, goal_bound, manipulation);
        // One arm has no other to mirror.
        let mut reflection = self.reflection.clone();
        if self.arms.len() == 1 {
            reflection.whole_scene = other.reflection.whole_scene;
        }
        match reflection == other.reflection {
            true => None,
            false => differs("reflection", &reflection, &other.reflection),
        }
    }
}

/// Shortens the texts of two values that differ. Where the start that is shown would be the same, what precedes the
/// difference is left out.
fn from_difference(first: &str, second: &str) -> (String, String) {
    let is_same = |(first, second): &(char, char)| first == second;
    let n_same = first.chars().zip(second.chars()).take_while(is_same).count();
    let n_omitted = match n_same < MAX_SHOWN_CHARS {
        true => 0,
        false => n_same - MAX_SHOWN_CHARS / 2,
    };
    let shown = |text: &str| {
        let rest: String = text.chars().skip(n_omitted).collect();
        format!("{}{}", if n_omitted > 0 { "..." } else { "" }, shortened(&rest, MAX_SHOWN_CHARS))
    };
    (shown(first), shown(second))
}

impl ArmDescription {
    /// Returns the name and the indices of each field.
    pub(super) const fn fields(&self) -> [(&'static str, &Vec<usize>); 6] {
        [
            ("observation", &self.observation),
            ("goal", &self.goal),
            ("action", &self.action),
            ("position", &self.position),
            ("lateral", &self.lateral),
            ("hand", &self.hand),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Layout, Task};

    #[test]
    fn a_norm_of_parts_is_the_norm_of_the_whole() {
        let (a, b) = ([3.0, 0.0, -2.0], [0.0, 4.0, -2.0]);
        for (norm, expected) in [(Norm::Euclidean, 5.0), (Norm::Maximum, 4.0)] {
            assert_eq!(norm.distance(&a, &b), expected);
            let parts = [norm.accumulate(&a[..1], &b[..1]), norm.accumulate(&a[1..], &b[1..])];
            assert_eq!(norm.of_accumulated(norm.combined(parts[0], parts[1])), expected);
            assert!(norm.distance(&[f32::NAN, 4.0], &[0.0; 2]).is_nan());
            let parts = [norm.accumulate(&[f32::NAN], &[0.0]), norm.accumulate(&[4.0], &[0.0])];
            assert!(norm.combined(parts[0], parts[1]).is_nan());
            assert!(norm.combined(parts[1], parts[0]).is_nan());
        }
    }

    #[test]
    fn the_first_differing_field_is_named() {
        let first = Layout::new(Task::Push, 2).description();
        assert_eq!(first.difference(&first), None);
        let check = |change: fn(&mut TaskDescription), message: &str| {
            let mut second = first.clone();
            change(&mut second);
            let difference = first.difference(&second).expect("they differ");
            assert_eq!(difference.to_string(), message);
        };
        check(|task| task.name = "reach".to_owned(), "name is \"push\" and \"reach\"");
        check(|task| task.episode_steps = 60, "episode_steps is 50 and 60");
        check(|task| task.arms[1].goal[2] = 9, "arms[1].goal is [3, 4, 5] and [3, 4, 9]");
        check(|task| task.arms.truncate(1), "number of arms is 2 and 1");
        check(|task| task.goal_bound[5] = 1.0, {
            "goal_bound is [2.0, 2.0, 2.0, 2.0, 2.0, 2.0] and [2.0, 2.0, 2.0, 2.0, 2.0, 1.0]"
        });
        check(|task| task.reflection.plane = 1.0, {
            "reflection is ...action: [], moved: [], plane: 0.0, whole_scene: false } and \
             ...action: [], moved: [], plane: 1.0, whole_scene: false }"
        });
        check(|task| task.reflection.whole_scene = true, {
            "reflection is ... [], plane: 0.0, whole_scene: false } and \
             ... [], plane: 0.0, whole_scene: true }"
        });
        let one_arm = Layout::new(Task::Push, 1).description();
        let mut of_whole_scene = one_arm.clone();
        of_whole_scene.reflection.whole_scene = true;
        assert_eq!(one_arm.difference(&of_whole_scene), None, "one arm is a scene of its own");
    }
}
