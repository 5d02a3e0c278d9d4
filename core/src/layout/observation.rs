//! The quantities of one arm's part of an observation, in its order, which `tandem_sim::Env::observe` writes.
//!
//! Positions and vectors are (x, y, z) in the arm's frame. Velocities and rates are per control step.

use std::ops::Range;

use super::OBSERVATION_PER_ARM;

/// Position of the end effector, metres.
pub const HAND_POSITION: Range<usize> = 0..3;
/// Position of the object, metres.
pub const OBJECT_POSITION: Range<usize> = 3..6;
/// Position of the object relative to the end effector, metres.
pub const HAND_TO_OBJECT: Range<usize> = 6..9;
/// Openings of the fingers, metres.
pub const FINGER_OPENINGS: Range<usize> = 9..12;
/// Orientation of the object, quaternion (x, y, z, w) with w ≥ 0.
pub const OBJECT_ORIENTATION: Range<usize> = 12..16;
/// Velocity of the object relative to the end effector, metres.
pub const OBJECT_VELOCITY: Range<usize> = 16..19;
/// Angular velocity of the object, radians.
pub const OBJECT_ANGULAR_VELOCITY: Range<usize> = 19..22;
/// Velocity of the end effector, metres.
pub const HAND_VELOCITY: Range<usize> = 22..25;
/// Rates of the fingers' openings, metres.
pub const FINGER_RATES: Range<usize> = 25..28;

/// All quantities that are per control step, whose duration depends on the world.
pub const PER_CONTROL_STEP: Range<usize> = OBJECT_VELOCITY.start..OBSERVATION_PER_ARM;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_quantities_follow_each_other_and_fill_an_arms_part() {
        let quantities = [
            HAND_POSITION,
            OBJECT_POSITION,
            HAND_TO_OBJECT,
            FINGER_OPENINGS,
            OBJECT_ORIENTATION,
            OBJECT_VELOCITY,
            OBJECT_ANGULAR_VELOCITY,
            HAND_VELOCITY,
            FINGER_RATES,
        ];
        assert!(quantities.into_iter().flatten().eq(0..OBSERVATION_PER_ARM));
        assert_eq!(PER_CONTROL_STEP, 16..28);
    }
}
