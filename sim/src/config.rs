//! Configuration of the world, initial states of episodes, and errors.

use serde::{Deserialize, Serialize};
use tandem_core::{Task, World, WorldSettings};

/// Physics parameters of a world. The default is the world in which policies are evaluated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorldConfig {
    /// Resolution of the physics, in [10, 80]: physics steps per control step in the classic world, and a quarter of
    /// their number in the other ones. 20 gives steps of 0.002 s, as in the paper, and of 0.003125 s; 10 is twice as
    /// fast.
    pub substeps: u32,
    /// Iterations of the contact solver per physics step, in [1, 16]; twice as many in the slow world.
    pub solver_iterations: usize,
    /// Half the edge length of the cubes, metres, in [0.015, 0.045].
    pub object_half_size_m: f32,
    /// Mass of a cube, kilograms, in [0.02, 1].
    pub object_mass_kg: f32,
    /// Largest force of each side of the gripper, newtons, in [0.1, 60].
    pub grip_force_n: f32,
    /// Coulomb friction coefficient of the table, in [0.01, 2].
    pub table_friction: f32,
    /// Friction in the push task. It is lower than the table's, so a hand pushes objects and cannot drag them from
    /// above.
    pub push: Friction,
    /// Friction in the pick-and-place task.
    pub pick_and_place: Friction,
    /// Friction in the task to carry a bar.
    pub carry_bar: Friction,
    /// Coulomb friction coefficient of the pads in the shared world's push task, in [0, 2]. Their tips have the
    /// coefficient that `push` gives to pads.
    pub rubber_pads: f32,
}

/// Coulomb friction coefficients, each in [0, 2]. A contact has the larger coefficient of its two surfaces, so that of
/// the table is a lower bound for a cube that slides on it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Friction {
    /// Coefficient of the finger pads.
    pub pads: f32,
    /// Coefficient of the cubes.
    pub object: f32,
}

/// The Coulomb friction coefficients of a task's pads and objects.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Surfaces {
    /// Of the pads, above their tips.
    pub(crate) sides: f32,
    /// Of the pads' lower ends, which press on what is below them.
    pub(crate) tips: f32,
    pub(crate) object: f32,
}

impl Default for WorldConfig {
    fn default() -> Self {
        Self {
            substeps: 20,
            solver_iterations: 2,
            object_half_size_m: 0.0225,
            object_mass_kg: 0.1,
            grip_force_n: 15.0,
            table_friction: 0.6,
            push: Friction { pads: 0.3, object: 0.3 },
            pick_and_place: Friction { pads: 0.45, object: 0.45 },
            carry_bar: Friction { pads: 0.8, object: 0.8 },
            rubber_pads: 0.8,
        }
    }
}

impl From<WorldSettings> for WorldConfig {
    fn from(settings: WorldSettings) -> Self {
        Self { substeps: settings.substeps, ..Self::default() }
    }
}

impl WorldConfig {
    /// Returns the configuration if every value is in its range. NaN is in no range.
    ///
    /// # Errors
    /// Returns an error that names the first value out of range.
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
        check("table_friction", self.table_friction.into(), 0.01, 2.0)?;
        check("push.pads", self.push.pads.into(), 0.0, 2.0)?;
        check("push.object", self.push.object.into(), 0.0, 2.0)?;
        check("pick_and_place.pads", self.pick_and_place.pads.into(), 0.0, 2.0)?;
        check("pick_and_place.object", self.pick_and_place.object.into(), 0.0, 2.0)?;
        check("carry_bar.pads", self.carry_bar.pads.into(), 0.0, 2.0)?;
        check("carry_bar.object", self.carry_bar.object.into(), 0.0, 2.0)?;
        check("rubber_pads", self.rubber_pads.into(), 0.0, 2.0)?;
        Ok(self)
    }

    /// Returns the number of physics steps per control step in `world`.
    pub(crate) fn substeps_in(&self, world: World) -> u32 {
        self.substeps * world.substeps_factor()
    }

    /// Returns the duration of a physics step in simulated time in `world`, seconds.
    pub(crate) fn substep_s(&self, world: World) -> f32 {
        #[expect(clippy::cast_precision_loss, reason = "at most 320")]
        let substeps = self.substeps_in(world) as f32;
        world.control_step_s() / substeps
    }

    /// Returns the number of iterations of the contact solver per physics step in `world`.
    pub(crate) fn solver_iterations_in(&self, world: World) -> usize {
        // More contacts share a bar than a cube.
        let factor = match world {
            World::Classic | World::Shared => 1,
            World::Slow => 2,
        };
        self.solver_iterations * factor
    }

    /// Returns the friction coefficients for `task`.
    pub(crate) fn surfaces(&self, task: Task) -> Surfaces {
        let Friction { pads, object } = match task {
            Task::CarryBar => self.carry_bar,
            _ if task.grasps() => self.pick_and_place,
            _ => self.push,
        };
        let is_rubber = task.world() == World::Shared && !task.grasps();
        let sides = if is_rubber { self.rubber_pads } else { pads };
        Surfaces { sides, tips: pads, object }
    }
}

/// Checks that `value` is in `[low, high]`, up to the rounding of a single-precision number.
fn check(key: &'static str, value: f64, low: f64, high: f64) -> Result<(), SimError> {
    let slack = 1e-6 * high;
    if (low - slack..=high + slack).contains(&value) {
        Ok(())
    } else {
        Err(SimError::OutOfRange { key, value, low, high })
    }
}

/// An error of creating or stepping a world.
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
    /// The layout does not have one or two arms.
    #[error("{0} arms, expected 1 or 2")]
    Arms(usize),
    /// The task takes more arms than the layout has.
    #[error("{task} takes {expected} arms, got {got}")]
    TooFewArms {
        /// The task.
        task: Task,
        /// Number of arms given.
        got: usize,
        /// Smallest number of arms.
        expected: usize,
    },
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
        /// Index of the number.
        index: usize,
        /// The number.
        value: f32,
    },
    /// The physics step gave a NaN or infinite position or velocity.
    #[error("the {part} of arm {arm} has no finite position and velocity")]
    StateNotFinite {
        /// Name of the body.
        part: &'static str,
        /// Index of its arm.
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
        assert_eq!(named(WorldConfig { table_friction: 0.0, ..default() }), "table_friction");
        let edge = WorldConfig { object_half_size_m: 0.045, object_mass_kg: 0.02, ..default() };
        assert_eq!(edge.clone().checked(), Ok(edge));
    }
}
