//! The arms: where their joints are, how far and how fast these turn, and how thick the links are.
//!
//! Frames of joints, limits and speeds are those of Kinova's package `kinova_description` (kinova-ros, BSD licence,
//! state of February 2023), files `m1n4s200.xacro`, `m1n6s200.xacro` and `j2n6s300.xacro`. The numbers were read off;
//! nothing of the files is used. Every joint turns about the z axis of its own frame.
//!
//! The base frame stands on the table with z up. By Kinova's convention joints 2 and 3 are stretched at π, so the arm
//! is upright with the tool above the base when both are π.

use std::f64::consts::{PI, TAU};

use glam::{DMat3, DVec3};

use crate::joints::Joints;
use crate::self_collision::{SELF_PAIRS_4, SELF_PAIRS_6, SelfPair};

/// A joint: its frame in the frame of the joint before it, and what it can do.
#[derive(Debug)]
pub struct Joint {
    /// Origin in the frame before, metres.
    pub origin_m: DVec3,
    /// Axes at joint angle 0, in the frame before.
    pub axes: DMat3,
    /// Smallest and largest angle, radians.
    pub range_rad: [f64; 2],
    /// Whether the joint turns round and round, so that angles a full turn apart are one place.
    pub continuous: bool,
    /// Largest speed, radians per second.
    pub speed_radps: f64,
}

/// A point that moves with an arm.
#[derive(Debug)]
pub struct Anchor {
    /// Frame that carries the point: 0 the base, `i` behind joint `i` counted from 1, one more the tool.
    pub frame: usize,
    /// Where it is in that frame, metres.
    pub offset_m: DVec3,
}

/// A part of an arm as a capsule: all points within a radius of a line.
#[derive(Debug)]
pub struct Link {
    /// What the part is called in messages.
    pub name: &'static str,
    /// Where the line ends.
    pub ends: [Anchor; 2],
    /// Radius, metres.
    pub radius_m: f64,
    /// Share of the line that is left, about its middle, when the gripper is shut; 1 for parts that keep their length.
    pub shut_share: f64,
}

/// An arm: its joints from base to wrist, its tool and its shape.
#[derive(Debug)]
pub struct ArmModel {
    /// Kinova's name of the arm.
    pub name: &'static str,
    /// The joints, base to wrist.
    pub joints: &'static [Joint],
    /// The arm's parts, base first. Only the base may touch the table.
    pub links: &'static [Link],
    /// Parts of the arm that can meet other parts of it.
    pub self_pairs: &'static [SelfPair],
    /// Joint angles with the gripper down ahead of the base (along its x axis) and the elbow above it, radians: where
    /// to look for solutions from when the arm is not there yet.
    pub elbow_up_rad: &'static [f64],
}

/// The Mico with four joints and two fingers, `m1n4s200`. Its last joint turns about the gripper's own axis.
pub static MICO_4: ArmModel = ArmModel {
    name: "m1n4s200",
    joints: &MICO_JOINTS_4,
    links: &MICO_LINKS_4,
    self_pairs: &SELF_PAIRS_4,
    elbow_up_rad: &ELBOW_UP_4,
};

/// The Mico with six joints and two fingers, `m1n6s200`.
pub static MICO_6: ArmModel = ArmModel {
    name: "m1n6s200",
    joints: &MICO_JOINTS_6,
    links: &SIX_JOINT_LINKS,
    self_pairs: &SELF_PAIRS_6,
    elbow_up_rad: &ELBOW_UP_6,
};

/// The Jaco with six joints and three fingers, `j2n6s300`.
pub static JACO_6: ArmModel = ArmModel {
    name: "j2n6s300",
    joints: &JACO_JOINTS,
    links: &SIX_JOINT_LINKS,
    self_pairs: &SELF_PAIRS_6,
    elbow_up_rad: &ELBOW_UP_6,
};

/// Where the tool is in the last joint's frame, metres, and which way it looks: x is the direction in which the
/// fingers close, z the way the gripper points. Roll, pitch, yaw of the table: π, 0, π/2.
pub(crate) const TOOL_ORIGIN_M: DVec3 = DVec3::new(0.0, 0.0, -0.16);
pub(crate) const TOOL_AXES: DMat3 = DMat3::from_cols(DVec3::Y, DVec3::X, DVec3::NEG_Z);

/// Roll, pitch, yaw of 0, π, 0.
const TURNED: DMat3 = DMat3::from_cols(DVec3::NEG_X, DVec3::Y, DVec3::NEG_Z);
/// Roll, pitch, yaw of −π/2, 0, π.
const BENT: DMat3 = DMat3::from_cols(DVec3::NEG_X, DVec3::NEG_Z, DVec3::NEG_Y);
/// Roll, pitch, yaw of π/3, 0, π.
const WRIST: DMat3 =
    DMat3::from_cols(DVec3::NEG_X, DVec3::new(0.0, -0.5, SIN_60), DVec3::new(0.0, SIN_60, 0.5));
const SIN_60: f64 = 0.866_025_403_784_438_6;

/// Speed of joints 1 to 3 and of the others, radians per second.
const SPEED_NEAR: f64 = 36.0_f64.to_radians();
const SPEED_FAR: f64 = 48.0_f64.to_radians();

const JOINT_1: Joint = continuous(DVec3::new(0.0, 0.0, 0.15675), TURNED, SPEED_NEAR);
const WRIST_JOINT: Joint = continuous(DVec3::new(0.0, -0.03703, -0.06414), WRIST, SPEED_FAR);

const SHOULDER_M: DVec3 = DVec3::new(0.0, 0.0016, -0.11875);
const MICO_2: Joint = limited(SHOULDER_M, BENT, [50.0, 310.0]);
const MICO_3: Joint = limited(DVec3::new(0.0, -0.290, 0.0), TURNED, [35.0, 325.0]);
const MICO_JOINT_4: Joint = continuous(DVec3::new(0.0, 0.1231, -0.0086), BENT, SPEED_FAR);
const JACO_2: Joint = limited(SHOULDER_M, BENT, [47.0, 313.0]);
const JACO_3: Joint = limited(DVec3::new(0.0, -0.410, 0.0), TURNED, [19.0, 341.0]);
const JACO_4: Joint = continuous(DVec3::new(0.0, 0.2073, -0.0114), BENT, SPEED_FAR);

static MICO_JOINTS_4: [Joint; 4] = [JOINT_1, MICO_2, MICO_3, MICO_JOINT_4];
static MICO_JOINTS_6: [Joint; 6] =
    [JOINT_1, MICO_2, MICO_3, MICO_JOINT_4, WRIST_JOINT, WRIST_JOINT];
static JACO_JOINTS: [Joint; 6] = [JOINT_1, JACO_2, JACO_3, JACO_4, WRIST_JOINT, WRIST_JOINT];

const ELBOW_UP_4: [f64; 4] = [0.0, 0.5 * PI, 1.5 * PI, 0.0];
const ELBOW_UP_6: [f64; 6] = [-0.21, 2.51, 5.08, 2.97, 0.67, -0.38];

/// Radii, metres. Kinova's actuators have diameters of 75 mm (joints 1 to 3) and 58 mm (the others), which their names
/// say; the links are shells no wider than these. About a centimetre is added for the shell, cables and the
/// actuators' ends, which stand across the links.
const BASE_RADIUS_M: f64 = 0.060;
const UPPER_ARM_RADIUS_M: f64 = 0.050;
const FOREARM_RADIUS_M: f64 = 0.045;
const WRIST_RADIUS_M: f64 = 0.040;
const HAND_RADIUS_M: f64 = 0.045;
/// The fingers, wherever they are between open and shut. They are hinged 0.115 m from the last joint and are some
/// 0.089 m long, so they end at most 0.044 m beyond the tool's origin (shut and straight) or, wide open, some 0.0875 m
/// to each side.
const FINGERS_RADIUS_M: f64 = 0.035;
const FINGERS_ASIDE_M: f64 = 0.0525;
const FINGERS_AHEAD_M: f64 = 0.0085;
/// A shut gripper reaches 52.5 mm to each side: the hinges are 31 mm from the middle, the fingers about 10 mm thick, and a
/// centimetre is added. In between the width grows evenly with the opening, and the hinged fingers are never wider.
const FINGERS_SHUT_SHARE: f64 = 1.0 / 3.0;
/// How far the hand's shell reaches from the last joint towards the fingers.
const HAND_LENGTH_M: f64 = 0.10;

const BASE: Link = link("base", anchor(0, DVec3::ZERO), anchor(2, DVec3::ZERO), BASE_RADIUS_M);
const UPPER_ARM: Link =
    link("upper arm", anchor(2, DVec3::ZERO), anchor(3, DVec3::ZERO), UPPER_ARM_RADIUS_M);
const FOREARM: Link =
    link("forearm", anchor(3, DVec3::ZERO), anchor(4, DVec3::ZERO), FOREARM_RADIUS_M);

static MICO_LINKS_4: [Link; 5] = [BASE, UPPER_ARM, FOREARM, hand(4), fingers(5)];
static SIX_JOINT_LINKS: [Link; 7] = [
    BASE,
    UPPER_ARM,
    FOREARM,
    link("wrist", anchor(4, DVec3::ZERO), anchor(5, DVec3::ZERO), WRIST_RADIUS_M),
    link("wrist", anchor(5, DVec3::ZERO), anchor(6, DVec3::ZERO), WRIST_RADIUS_M),
    hand(6),
    fingers(7),
];

impl ArmModel {
    /// How many joints the arm has: 4 or 6.
    #[must_use]
    pub fn n_joints(&self) -> usize {
        self.joints.len()
    }

    /// The shoulder, where the axis of joint 1 meets that of joint 2 but for a millimetre: base frame, metres.
    #[must_use]
    pub fn shoulder_m(&self) -> DVec3 {
        DVec3::Z * (self.joints[0].origin_m.z - self.joints[1].origin_m.z)
    }

    /// No point reached by the tool is farther from the shoulder, metres. The arm with four joints reaches this far.
    #[must_use]
    pub fn reach_m(&self) -> f64 {
        let upper_m = -self.joints[2].origin_m.y;
        let out_of_plane_m = self.joints[1].origin_m.y + self.joints[3].origin_m.z;
        let wrist_m: f64 = self.joints[4..].iter().map(|joint| joint.origin_m.length()).sum();
        let in_plane_m = upper_m + self.joints[3].origin_m.y + wrist_m - TOOL_ORIGIN_M.z;
        libm::hypot(in_plane_m, out_of_plane_m)
    }

    /// For each joint, a distance that no point of `within` (offsets in the last joint's frame, metres) has from the
    /// joint's axis in any posture, metres.
    fn levers_to(&self, within: &[DVec3]) -> Joints {
        let n = self.n_joints();
        let beyond_m = within.iter().map(|point| point.length()).fold(0.0, f64::max);
        Joints::from_fn(n, |joint| {
            let from_axis_m = |point: &DVec3| libm::hypot(point.x, point.y);
            match &self.joints[joint + 1..] {
                [] => within.iter().map(from_axis_m).fold(0.0, f64::max),
                [next, others @ ..] => {
                    let offsets_m = others.iter().map(|other| other.origin_m.length());
                    from_axis_m(&next.origin_m) + offsets_m.sum::<f64>() + beyond_m
                }
            }
        })
    }

    /// For each joint, a distance that the tool's origin never has from the joint's axis, metres.
    pub(crate) fn tool_levers_m(&self) -> Joints {
        self.levers_to(&[TOOL_ORIGIN_M])
    }

    /// For each joint, a distance that no point on the lines of the links has from the joint's axis, metres.
    #[must_use]
    pub fn link_levers_m(&self) -> Joints {
        let n = self.n_joints();
        let in_last_frame = |anchor: &Anchor| match anchor.frame {
            frame if frame == n => Some(anchor.offset_m),
            frame if frame > n => Some(TOOL_ORIGIN_M + TOOL_AXES * anchor.offset_m),
            _ => None,
        };
        let points: Vec<DVec3> =
            self.links.iter().flat_map(|link| &link.ends).filter_map(in_last_frame).collect();
        self.levers_to(&points)
    }
}

const fn continuous(origin_m: DVec3, axes: DMat3, speed_radps: f64) -> Joint {
    Joint { origin_m, axes, range_rad: [-TAU, TAU], continuous: true, speed_radps }
}

const fn limited(origin_m: DVec3, axes: DMat3, range_deg: [f64; 2]) -> Joint {
    let range_rad = [range_deg[0].to_radians(), range_deg[1].to_radians()];
    Joint { origin_m, axes, range_rad, continuous: false, speed_radps: SPEED_NEAR }
}

const fn anchor(frame: usize, offset_m: DVec3) -> Anchor {
    Anchor { frame, offset_m }
}

const fn link(name: &'static str, from: Anchor, to: Anchor, radius_m: f64) -> Link {
    Link { name, ends: [from, to], radius_m, shut_share: 1.0 }
}

const fn hand(frame: usize) -> Link {
    let to = anchor(frame, DVec3::new(0.0, 0.0, -HAND_LENGTH_M));
    link("hand", anchor(frame, DVec3::ZERO), to, HAND_RADIUS_M)
}

const fn fingers(frame: usize) -> Link {
    let from = anchor(frame, DVec3::new(-FINGERS_ASIDE_M, 0.0, FINGERS_AHEAD_M));
    let to = anchor(frame, DVec3::new(FINGERS_ASIDE_M, 0.0, FINGERS_AHEAD_M));
    let open = link("gripper", from, to, FINGERS_RADIUS_M);
    Link { shut_share: FINGERS_SHUT_SHARE, ..open }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::{FRAC_PI_2, FRAC_PI_3};

    /// Turns about the fixed axes x, y, z, one after the other.
    fn from_roll_pitch_yaw(roll: f64, pitch: f64, yaw: f64) -> DMat3 {
        DMat3::from_rotation_z(yaw) * DMat3::from_rotation_y(pitch) * DMat3::from_rotation_x(roll)
    }

    #[test]
    fn the_axes_are_those_of_the_tables_angles() {
        let check = |axes: DMat3, [roll, pitch, yaw]: [f64; 3]| {
            assert!(axes.abs_diff_eq(from_roll_pitch_yaw(roll, pitch, yaw), 1e-12), "{axes}");
        };
        check(TURNED, [0.0, PI, 0.0]);
        check(BENT, [-FRAC_PI_2, 0.0, PI]);
        check(WRIST, [FRAC_PI_3, 0.0, PI]);
        check(TOOL_AXES, [PI, 0.0, FRAC_PI_2]);
    }

    #[test]
    fn the_levers_of_the_four_joint_arm() {
        let levers = MICO_4.tool_levers_m();
        let expected = [0.29 + 0.2831 + 0.0016, 0.29 + 0.2831, 0.2831, 0.0];
        for (lever, expected) in levers.iter().zip(expected) {
            assert!((-1e-12..0.002).contains(&(lever - expected)), "{levers:?}");
        }
        assert!((MICO_4.link_levers_m()[3] - FINGERS_ASIDE_M).abs() < 1e-12);
    }
}
