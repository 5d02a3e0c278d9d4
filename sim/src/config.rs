//! What a world is made of, how its episodes start, and what can go wrong with it.

use serde::{Deserialize, Serialize};
use tandem_core::{Task, WorldSettings};

/// Simulated time of a control step, seconds.
pub const CONTROL_STEP_S: f32 = 0.04;
/// Control steps per second of simulated time.
pub(crate) const CONTROL_STEPS_PER_S: f64 = 25.0;

/// How finely a world is simulated and what its objects are made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorldConfig {
    /// Physics steps per control step of 0.04 s, in [10, 80]. The paper's 0.002 s are 20; 10 doubles the speed.
    pub substeps: u32,
    /// Iterations of the contact solver per physics step, in [1, 16].
    pub solver_iterations: usize,
    /// Half the edge of the cubes, metres, in [0.015, 0.045].
    pub object_half_size_m: f32,
    /// Mass of a cube, kilograms, in [0.02, 1].
    pub object_mass_kg: f32,
    /// Largest force with which each side of the gripper presses, newtons, in [0.1, 60].
    pub grip_force_n: f32,
    /// Surfaces of the push task: smoother than the table, so that objects are pushed and not dragged from above.
    pub push: Friction,
    /// Surfaces of the pick-and-place task.
    pub pick_and_place: Friction,
}

/// Coulomb friction coefficients, each in [0, 2]. Of two touching surfaces the larger coefficient counts; the
/// table's is 0.6, so a cube never slides on it with less.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Friction {
    /// Of the finger pads.
    pub pads: f32,
    /// Of the cubes.
    pub object: f32,
}

impl Default for WorldConfig {
    fn default() -> Self {
        Self {
            substeps: 20,
            solver_iterations: 2,
            object_half_size_m: 0.0225,
            object_mass_kg: 0.1,
            grip_force_n: 15.0,
            push: Friction { pads: 0.3, object: 0.3 },
            pick_and_place: Friction { pads: 0.45, object: 0.45 },
        }
    }
}

impl From<WorldSettings> for WorldConfig {
    fn from(settings: WorldSettings) -> Self {
        Self { substeps: settings.substeps, ..Self::default() }
    }
}

impl WorldConfig {
    /// The configuration, when every value is in its range; NaN is in none.
    ///
    /// # Errors
    /// Names the first value out of range.
    pub fn checked(self) -> Result<Self, SimError> {
        check("substeps", f64::from(self.substeps), 10.0, 80.0)?;
        #[expect(
            clippy::cast_precision_loss,
            reason = "counts above 2^52 are out of range all the same"
        )]
        check("solver_iterations", self.solver_iterations as f64, 1.0, 16.0)?;
        check("object_half_size_m", self.object_half_size_m.into(), 0.015, 0.045)?;
        check("object_mass_kg", self.object_mass_kg.into(), 0.02, 1.0)?;
        check("grip_force_n", self.grip_force_n.into(), 0.1, 60.0)?;
        check("push.pads", self.push.pads.into(), 0.0, 2.0)?;
        check("push.object", self.push.object.into(), 0.0, 2.0)?;
        check("pick_and_place.pads", self.pick_and_place.pads.into(), 0.0, 2.0)?;
        check("pick_and_place.object", self.pick_and_place.object.into(), 0.0, 2.0)?;
        Ok(self)
    }

    /// Simulated time of a physics step, seconds.
    pub(crate) fn substep_s(&self) -> f32 {
        #[expect(clippy::cast_precision_loss, reason = "at most 80")]
        let substeps = self.substeps as f32;
        CONTROL_STEP_S / substeps
    }

    /// The surfaces that `task` is done with.
    pub(crate) fn friction(&self, task: Task) -> Friction {
        match task {
            Task::Push => self.push,
            Task::PickAndPlace => self.pick_and_place,
        }
    }
}

/// Passes `value` when it lies in `[low, high]`, with the slack of a number given in single precision.
fn check(key: &'static str, value: f64, low: f64, high: f64) -> Result<(), SimError> {
    let slack = 1e-6 * high;
    if (low - slack..=high + slack).contains(&value) {
        Ok(())
    } else {
        Err(SimError::OutOfRange { key, value, low, high })
    }
}

/// Why a world cannot be built or stepped.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SimError {
    /// A configured value is out of its range.
    #[error("world.{key} is {value}, expected a number from {low} to {high}")]
    OutOfRange {
        /// Name of the value.
        key: &'static str,
        /// The value.
        value: f64,
        /// Smallest value allowed.
        low: f64,
        /// Largest value allowed.
        high: f64,
    },
    /// Worlds have one arm or two.
    #[error("{0} arms, expected 1 or 2")]
    Arms(usize),
    /// The action has the wrong length.
    #[error("action has {got} numbers, expected {expected}")]
    ActionLength {
        /// Numbers given.
        got: usize,
        /// Numbers needed.
        expected: usize,
    },
    /// A number of the action is NaN or infinite.
    #[error("action[{index}] is {value}")]
    ActionNotFinite {
        /// Where the number stands.
        index: usize,
        /// The number.
        value: f32,
    },
    /// The physics step gave a NaN or infinite position or velocity.
    #[error("the {part} of arm {arm} has no finite position and velocity")]
    StateNotFinite {
        /// Which body.
        part: &'static str,
        /// The arm it belongs to.
        arm: usize,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_out_of_range_are_named() {
        let named = |config: WorldConfig| match config.checked() {
            Err(SimError::OutOfRange { key, .. }) => key,
            other => panic!("{other:?}"),
        };
        let default = WorldConfig::default;
        assert_eq!(named(WorldConfig { substeps: 5, ..default() }), "substeps");
        assert_eq!(
            named(WorldConfig { object_half_size_m: f32::NAN, ..default() }),
            "object_half_size_m"
        );
        assert_eq!(
            named(WorldConfig { push: Friction { pads: -0.1, object: 0.3 }, ..default() }),
            "push.pads"
        );
        let edge = WorldConfig { object_half_size_m: 0.045, object_mass_kg: 0.02, ..default() };
        assert_eq!(edge.clone().checked(), Ok(edge));
    }
}
