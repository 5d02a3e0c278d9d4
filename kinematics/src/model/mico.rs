//! Kinova's Mico with four joints.
//!
//! Frames of joints, limits and speeds are those of Kinova's package `kinova_description` (kinova-ros, BSD licence,
//! state of February 2023), file `m1n4s200.xacro`. The numbers were read off; nothing of the file is used.

use std::f64::consts::{FRAC_1_SQRT_2, PI, TAU};

use nalgebra::{Isometry3, Point3, Quaternion, Translation3, Unit, UnitQuaternion};

use super::{Anchor, ArmModel, Joint, Link, SelfPair};

/// The Mico with four joints and two fingers, `m1n4s200`. Its last joint rotates about the gripper's own axis.
pub static MICO_4: ArmModel = ArmModel {
    name: "m1n4s200",
    joints: &JOINTS,
    last_from_tool: Isometry3::from_parts(Translation3::new(0.0, 0.0, TOOL_Z_M), TOOL_AXES),
    links: &LINKS,
    self_pairs: &SELF_PAIRS,
    elbow_up_rad: &[0.0, 0.5 * PI, 1.5 * PI, 0.0],
};

/// Rotations of the description's roll, pitch and yaw; each is half a turn about one axis.
/// Roll, pitch, yaw of 0, π, 0.
const TURNED: UnitQuaternion<f64> = half_turn(0.0, 1.0, 0.0);
/// Roll, pitch, yaw of −π/2, 0, π.
const BENT: UnitQuaternion<f64> = half_turn(0.0, -FRAC_1_SQRT_2, FRAC_1_SQRT_2);
/// Roll, pitch, yaw of π, 0, π/2.
const TOOL_AXES: UnitQuaternion<f64> = half_turn(FRAC_1_SQRT_2, FRAC_1_SQRT_2, 0.0);

const TOOL_Z_M: f64 = -0.16;

/// The distance of the point between the finger pads ahead of the tool's origin, metres.
pub const PADS_AHEAD_M: f64 = 0.021;

/// Speed of joints 1 to 3 and of joint 4, radians per second.
const SPEED_NEAR: f64 = 36.0_f64.to_radians();
const SPEED_FAR: f64 = 48.0_f64.to_radians();

static JOINTS: [Joint; 4] = [
    continuous([0.0, 0.0, 0.15675], TURNED, SPEED_NEAR),
    limited([0.0, 0.0016, -0.11875], BENT, [50.0, 310.0]),
    limited([0.0, -0.290, 0.0], TURNED, [35.0, 325.0]),
    continuous([0.0, 0.1231, -0.0086], BENT, SPEED_FAR),
];

/// Radii, metres. Kinova's actuators have diameters of 75 mm (joints 1 to 3) and 58 mm (joint 4), according to their
/// names; the links are shells no wider than these. About a centimetre is added for the shell, cables and the ends of
/// the actuators, which lie across the links.
const BASE_RADIUS_M: f64 = 0.060;
const UPPER_ARM_RADIUS_M: f64 = 0.050;
const FOREARM_RADIUS_M: f64 = 0.045;
const HAND_RADIUS_M: f64 = 0.045;
/// The length of the hand's shell from the last joint towards the fingers, metres.
const HAND_LENGTH_M: f64 = 0.10;
/// The fingers at any opening. Their hinges are 0.115 m from the last joint and the fingers are about 0.089 m long, so
/// they end at most 0.044 m beyond the tool's origin (closed and straight) or, wide open, about 0.0875 m to each side.
const FINGERS_RADIUS_M: f64 = 0.035;
const FINGERS_ASIDE_M: f64 = 0.0525;
const FINGERS_AHEAD_M: f64 = 0.0085;
/// A closed gripper extends 52.5 mm to each side: the hinges are 31 mm from the middle, the fingers about 10 mm thick,
/// and a centimetre is added. The modelled width is linear in the opening, and the hinged fingers are never wider.
const FINGERS_CLOSED_SHARE: f64 = 1.0 / 3.0;

static LINKS: [Link; 5] = [
    link("base", Anchor::origin_of(0), Anchor::origin_of(2), BASE_RADIUS_M),
    link("upper arm", Anchor::origin_of(2), Anchor::origin_of(3), UPPER_ARM_RADIUS_M),
    link("forearm", Anchor::origin_of(3), Anchor::origin_of(4), FOREARM_RADIUS_M),
    link("hand", Anchor::origin_of(4), anchor(4, [0.0, 0.0, -HAND_LENGTH_M]), HAND_RADIUS_M),
    Link {
        closed_share: FINGERS_CLOSED_SHARE,
        ..link(
            "gripper",
            anchor(5, [-FINGERS_ASIDE_M, 0.0, FINGERS_AHEAD_M]),
            anchor(5, [FINGERS_ASIDE_M, 0.0, FINGERS_AHEAD_M]),
            FINGERS_RADIUS_M,
        )
    },
];

/// The extra width of the hand's and the upper arm's capsules over Kinova's actuators of 75 and 58 mm in diameter,
/// metres.
const FOLDED_ALLOWANCE_M: f64 = (0.050 - 0.0375) + (0.045 - 0.029);

/// All pairs of parts that do not share a joint, except forearm and gripper: joint 4 rotates the gripper about the
/// forearm's own line, so their distance is fixed.
static SELF_PAIRS: [SelfPair; 5] = [
    pair([0, 2], 0.0),
    pair([0, 3], 0.0),
    pair([0, 4], 0.0),
    pair([1, 3], FOLDED_ALLOWANCE_M),
    pair([1, 4], 0.0),
];

const fn half_turn(x: f64, y: f64, z: f64) -> UnitQuaternion<f64> {
    Unit::new_unchecked(Quaternion::new(0.0, x, y, z))
}

const fn pose([x, y, z]: [f64; 3], axes: UnitQuaternion<f64>) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::new(x, y, z), axes)
}

const fn continuous(origin_m: [f64; 3], axes: UnitQuaternion<f64>, speed_radps: f64) -> Joint {
    let previous_from_joint = pose(origin_m, axes);
    Joint { previous_from_joint, range_rad: [-TAU, TAU], continuous: true, speed_radps }
}

const fn limited(origin_m: [f64; 3], axes: UnitQuaternion<f64>, range_deg: [f64; 2]) -> Joint {
    let range_rad = [range_deg[0].to_radians(), range_deg[1].to_radians()];
    let previous_from_joint = pose(origin_m, axes);
    Joint { previous_from_joint, range_rad, continuous: false, speed_radps: SPEED_NEAR }
}

const fn anchor(frame: usize, [x, y, z]: [f64; 3]) -> Anchor {
    Anchor { frame, offset_m: Point3::new(x, y, z) }
}

const fn link(name: &'static str, from: Anchor, to: Anchor, radius_m: f64) -> Link {
    Link { name, ends: [from, to], radius_m, closed_share: 1.0 }
}

const fn pair(links: [usize; 2], allowance_m: f64) -> SelfPair {
    SelfPair { links, allowance_m }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_PI_2;

    #[test]
    fn the_axes_match_the_roll_pitch_and_yaw_of_the_description() {
        let check = |axes: UnitQuaternion<f64>, [roll, pitch, yaw]: [f64; 3]| {
            let expected = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
            assert!(axes.angle_to(&expected) < 1e-12, "{axes}");
        };
        check(TURNED, [0.0, PI, 0.0]);
        check(BENT, [-FRAC_PI_2, 0.0, PI]);
        check(TOOL_AXES, [PI, 0.0, FRAC_PI_2]);
    }

    #[test]
    fn levers_match_the_lengths_of_the_links() {
        let levers = MICO_4.tool_levers_m();
        let expected = [0.29 + 0.2831 + 0.0016, 0.29 + 0.2831, 0.2831, 0.0];
        for (lever, expected) in levers.iter().zip(expected) {
            assert!((-1e-12..0.002).contains(&(lever - expected)), "{levers:?}");
        }
        assert!((MICO_4.link_levers_m()[3] - FINGERS_ASIDE_M).abs() < 1e-12);
    }
}
