//! Reflections: mirror symmetries of the world of an arm.

use serde::{Deserialize, Serialize};

use super::{Part, TaskDescription, TaskSpec};
use crate::layout::ArmIndex;

/// A reflection that turns an arm's part of a valid transition into that of another one, such as that of a table about
/// the vertical plane through the arm's base. With several arms it holds while the arm is far enough from the others to
/// be recombined, or always if it is that of the whole scene. The default is no reflection.
///
/// Places are indices within the vector of one arm: 0 is the arm's first number.
#[derive(Debug, Clone, PartialEq, Default, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct Reflection {
    /// Places in an observation whose numbers change their sign: distances and velocities across the plane, rotations
    /// about axes within it.
    pub observation: Vec<usize>,
    /// Places in an observation of coordinates across the plane, which become twice that of the plane minus themselves.
    pub position: Vec<usize>,
    /// Places in a goal of such coordinates.
    pub goal: Vec<usize>,
    /// Places in an action whose numbers change their sign.
    pub action: Vec<usize>,
    /// Pairs of places in an observation: the first gets the number of the second, such as a left finger that of the
    /// right one.
    pub moved: Vec<[usize; 2]>,
    /// Coordinate of the plane.
    pub plane: f32,
    /// Whether the arms and their links mirror each other about one plane, so that all arms of a transition can be
    /// reflected at once, however near they are.
    pub whole_scene: bool,
}

impl Reflection {
    /// Returns true if there is no reflection.
    #[must_use]
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }
}

/// The numbers of a vector of one arm, in order, as functions of the numbers before.
type Places = Vec<Place>;

/// A number that becomes `offset + factor * number`, with the number at place `from`.
#[derive(Debug, Clone, Copy)]
struct Place {
    from: usize,
    factor: f32,
    offset: f32,
}

/// The effect of a reflection on the vectors of an arm.
#[derive(Debug)]
pub(super) struct ReflectionMap {
    observation: Places,
    goal: Places,
    action: Places,
}

impl ReflectionMap {
    /// Creates the map of a checked task; `None` if it has no reflection.
    pub(super) fn new(task: &TaskDescription) -> Option<Self> {
        let (reflection, arm) = (&task.reflection, &task.arms[0]);
        let places = |n: usize, negated: &[usize], positions: &[usize]| -> Places {
            let place = |from| match (negated.contains(&from), positions.contains(&from)) {
                (_, true) => Place { from, factor: -1.0, offset: 2.0 * reflection.plane },
                (true, false) => Place { from, factor: -1.0, offset: 0.0 },
                (false, false) => Place { from, factor: 1.0, offset: 0.0 },
            };
            (0..n).map(place).collect()
        };
        let n_observation = arm.observation.len();
        let mut observation = places(n_observation, &reflection.observation, &reflection.position);
        for [to, from] in &reflection.moved {
            observation[*to].from = *from;
        }
        (!reflection.is_none()).then(|| Self {
            observation,
            goal: places(arm.goal.len(), &[], &reflection.goal),
            action: places(arm.action.len(), &reflection.action, &[]),
        })
    }
}

impl TaskSpec {
    /// Returns true if an arm's part of a transition can be [reflected](Reflection).
    #[must_use]
    pub fn has_reflection(&self) -> bool {
        self.0.reflection.is_some()
    }

    /// Returns true if all arms of a transition can be reflected at once, however near they are.
    #[must_use]
    pub fn has_reflected_scene(&self) -> bool {
        self.has_reflection() && self.description().reflection.whole_scene
    }

    /// Writes the reflection of `from`'s part of the observation `source` as that of `to`; a copy if the task has no
    /// reflection.
    ///
    /// # Panics
    /// If a vector is too short.
    pub fn reflect_observation(
        &self,
        to: ArmIndex,
        from: ArmIndex,
        source: &[f32],
        observation: &mut [f32],
    ) {
        let parts = [self.observation_of(to), self.observation_of(from)];
        self.reflect(parts, |map| &map.observation, source, observation);
    }

    /// As [`Self::reflect_observation`], for a goal.
    ///
    /// # Panics
    /// If a vector is too short.
    pub fn reflect_goal(&self, to: ArmIndex, from: ArmIndex, source: &[f32], goal: &mut [f32]) {
        self.reflect([self.goal_of(to), self.goal_of(from)], |map| &map.goal, source, goal);
    }

    /// As [`Self::reflect_observation`], for an action.
    ///
    /// # Panics
    /// If a vector is too short.
    pub fn reflect_action(&self, to: ArmIndex, from: ArmIndex, source: &[f32], action: &mut [f32]) {
        self.reflect([self.action_of(to), self.action_of(from)], |map| &map.action, source, action);
    }

    fn reflect(
        &self,
        [to, from]: [&Part; 2],
        places: impl Fn(&ReflectionMap) -> &Places,
        source: &[f32],
        target: &mut [f32],
    ) {
        let Some(map) = &self.0.reflection else { return to.copy_from(target, from, source) };
        for (idx, place) in to.iter().zip(places(map)) {
            target[idx] = place.offset + place.factor * source[from.index(place.from)];
        }
    }
}
