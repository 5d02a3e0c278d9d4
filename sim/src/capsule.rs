//! Capsules that approximate an arm's shape for link avoidance, and their motion with the palm.

use rapier3d::math::{Matrix, Vector};
use serde::Serialize;
use tandem_core::scene::Capsule;
use tandem_kinematics::model::Anchor;
use tandem_kinematics::{MICO_4, PADS_AHEAD_M};

use crate::arm::Arm;
use crate::hand::{Gripper, HandSettings, WRIST_ABOVE_M, WRIST_RADIUS_M};
use crate::mico::{JointPoints, single};
use crate::physics::Physics;

/// Link frames of a Jaco whose origins are the ends of the links' capsules.
pub(crate) const LINK_FRAMES: [usize; 4] = [1, 2, 4, 5];
/// Radii of the links of a Jaco (upper arm, forearm, wrist bend), metres.
pub(crate) const LINK_RADII_M: [f32; 3] = [0.045, 0.04, 0.035];
/// Number of capsules of an arm: its links, then two around its hand. Those of a Jaco are wrist, and palm plate with
/// fingers; those of a Mico, shell and fingers.
pub(crate) const N_CAPSULES: usize = 5;
/// Number of capsules that are links.
pub(crate) const N_LINKS: usize = LINK_RADII_M.len();
/// Ends of the capsule around palm plate and fingers, relative to the end effector, arm frame, metres.
pub(crate) const GRIPPER_ENDS: [Vector; 2] =
    [Vector::new(0.0, -0.025, 0.03), Vector::new(0.0, 0.025, 0.03)];
/// Radius of this capsule, metres.
pub(crate) const GRIPPER_RADIUS_M: f32 = 0.045;

/// A point of an arm, world frame, metres, and its Jacobian with respect to the palm's position.
#[derive(Clone, Copy)]
pub(crate) struct ArmPoint {
    pub(crate) position: Vector,
    pub(crate) jacobian: Matrix,
}

/// A capsule that is part of an arm.
#[derive(Clone, Copy)]
pub(crate) struct ArmCapsule {
    pub(crate) ends: [ArmPoint; 2],
    pub(crate) radius_m: f32,
}

/// The capsules that approximate an arm.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Capsules {
    /// Those of a Jaco: links, wrist, and palm plate with fingers.
    Jaco {
        /// Frames of the Denavit–Hartenberg table whose origins are the ends of the links' capsules.
        link_frames: [usize; 4],
        /// Radii of the links, metres.
        link_radii_m: [f32; 3],
        /// Heights of the ends of the wrist's capsule above the end effector, metres.
        wrist_above_m: [f32; 2],
        /// Radius of the wrist, metres.
        wrist_radius_m: f32,
        /// Ends of the capsule around palm plate and fingers, relative to the end effector, arm frame, metres.
        gripper_ends_m: [[f32; 3]; 2],
        /// Radius of this capsule, metres.
        gripper_radius_m: f32,
    },
    /// Those of a Mico: base, upper arm and forearm between its joints, shell of the hand, fingers.
    Mico {
        /// Radii, metres.
        radii_m: [f32; N_CAPSULES],
        /// End of the shell near the fingers, in the palm's frame, metres. The other end is the last joint.
        shell_end_m: [f32; 3],
        /// Ends of the capsule around the fingers, in the palm's frame, metres.
        finger_ends_m: [[f32; 3]; 2],
    },
}

/// The capsules of an arm at the joint angles of the start of a control step.
#[derive(Clone, Copy)]
pub(crate) struct ArmCapsules {
    pub(crate) palm_position: Vector,
    pub(crate) capsules: [ArmCapsule; N_CAPSULES],
}

impl ArmCapsules {
    /// Computes the capsules of `arm` at its current joint angles.
    pub(crate) fn of(arm: &Arm, physics: &Physics) -> Self {
        match arm.mico_joints(physics) {
            Some(joints) => Self::of_mico(arm, physics, &joints),
            None => Self::of_jaco(arm, physics),
        }
    }

    /// The links of a Mico are its base, its upper arm and its forearm.
    fn of_mico(arm: &Arm, physics: &Physics, joints: &JointPoints) -> Self {
        let palm_position = arm.hand.end_effector(physics);
        let fixed = |position| ArmPoint {
            position: arm.frame.world_from_arm(position),
            jacobian: Matrix::ZERO,
        };
        let moved = |(position, jacobian)| ArmPoint {
            position: arm.frame.world_from_arm(position),
            jacobian: arm.frame.jacobian_in_world(jacobian),
        };
        let (base, shoulder) = (fixed(arm.parameters.base_in_arm), fixed(joints.shoulder));
        let (elbow, wrist) = (moved(joints.elbow), moved(joints.wrist));
        let turn = arm.hand.orientation(physics);
        let in_hand = |offset: Vector| ArmPoint {
            position: palm_position + turn * offset,
            jacobian: Matrix::IDENTITY,
        };
        let HandCapsules { shell_end_m, fingers_m } = hand_capsules(&arm.hand.settings);
        let fingers = fingers_m.map(in_hand);
        let ends = [
            [base, shoulder],
            [shoulder, elbow],
            [elbow, wrist],
            [wrist, in_hand(shell_end_m)],
            fingers,
        ];
        let radius_m = |idx: usize| single(MICO_4.links[idx].radius_m);
        let capsules =
            std::array::from_fn(|idx| ArmCapsule { ends: ends[idx], radius_m: radius_m(idx) });
        Self { palm_position, capsules }
    }

    /// Returns the links, world frame.
    pub(crate) fn links(&self) -> [Capsule; N_LINKS] {
        std::array::from_fn(|idx| {
            let ArmCapsule { ends: [from, to], radius_m } = self.capsules[idx];
            Capsule { from: from.position.to_array(), to: to.position.to_array(), radius_m }
        })
    }

    fn of_jaco(arm: &Arm, physics: &Physics) -> Self {
        let palm_position = arm.hand.end_effector(physics);
        let joints = arm
            .point_jacobians(LINK_FRAMES)
            .map(|(position, jacobian)| ArmPoint { position, jacobian });
        let with_palm = |offset: Vector| ArmPoint {
            position: palm_position + offset,
            jacobian: Matrix::IDENTITY,
        };
        let link = |idx: usize| ArmCapsule {
            ends: [joints[idx], joints[idx + 1]],
            radius_m: LINK_RADII_M[idx],
        };
        let wrist_ends = WRIST_ABOVE_M.map(|above_m| with_palm(Vector::Z * above_m));
        let wrist = ArmCapsule { ends: wrist_ends, radius_m: WRIST_RADIUS_M };
        let gripper_ends = GRIPPER_ENDS.map(|end| with_palm(arm.frame.rotate(end)));
        let gripper = ArmCapsule { ends: gripper_ends, radius_m: GRIPPER_RADIUS_M };
        Self { palm_position, capsules: [link(0), link(1), link(2), wrist, gripper] }
    }
}

/// The capsules of a Mico's hand, in the palm's frame, metres.
struct HandCapsules {
    /// The end of the shell near the fingers.
    shell_end_m: Vector,
    /// The ends of the capsule around the fingers.
    fingers_m: [Vector; 2],
}

/// Returns the capsules of a Mico's hand: open as wide as it can be, or shut for good.
fn hand_capsules(settings: &HandSettings) -> HandCapsules {
    let [.., shell, fingers] = MICO_4.links else { unreachable!("a Mico has a hand") };
    let share = match settings.gripper {
        Gripper::Locked => fingers.closed_share,
        Gripper::Driven => 1.0,
    };
    let to_pads_m = MICO_4.plane_lengths_m().hand_m + PADS_AHEAD_M;
    // The tool points along z and closes along x, the palm points along −z and closes along y.
    let finger_end = |end: &Anchor| {
        let [aside_m, ahead_m] = [end.offset_m.x * share, end.offset_m.z];
        Vector::new(0.0, single(aside_m), single(PADS_AHEAD_M - ahead_m))
    };
    HandCapsules {
        shell_end_m: Vector::Z * single(to_pads_m + shell.ends[1].offset_m.z),
        fingers_m: [finger_end(&fingers.ends[0]), finger_end(&fingers.ends[1])],
    }
}

/// Describes the capsules of a Mico whose hand has `settings`.
pub(crate) fn describe_mico_capsules(settings: &HandSettings) -> Capsules {
    let HandCapsules { shell_end_m, fingers_m } = hand_capsules(settings);
    Capsules::Mico {
        radii_m: std::array::from_fn(|idx| single(MICO_4.links[idx].radius_m)),
        shell_end_m: shell_end_m.to_array(),
        finger_ends_m: fingers_m.map(|end| end.to_array()),
    }
}

impl ArmCapsule {
    /// Predicts the capsule after a displacement of the palm, metres.
    pub(crate) fn moved_by(&self, displacement: Vector) -> Self {
        let ends = self
            .ends
            .map(|end| ArmPoint { position: end.position + end.jacobian * displacement, ..end });
        Self { ends, ..*self }
    }

    /// Returns the ends of the axis, world frame, metres.
    pub(crate) fn axis(&self) -> [Vector; 2] {
        self.ends.map(|end| end.position)
    }

    /// Returns the point at `fraction` of the axis, world frame, metres.
    pub(crate) fn point(&self, fraction: f32) -> Vector {
        let [from, to] = self.axis();
        from + (to - from) * fraction
    }

    /// Returns the Jacobian of the point at `fraction` of the axis with respect to the palm's position.
    pub(crate) fn jacobian(&self, fraction: f32) -> Matrix {
        let [from, to] = self.ends.map(|end| end.jacobian);
        from * (1.0 - fraction) + to * fraction
    }
}

/// Returns the positions of the closest points of two segments, as fractions of the segments' lengths.
pub(crate) fn closest_fractions(first: [Vector; 2], second: [Vector; 2]) -> [f32; 2] {
    const TINY: f32 = 1e-9;
    let (along_first, along_second) = (first[1] - first[0], second[1] - second[0]);
    let offset = first[0] - second[0];
    let (a, e) = (along_first.length_squared(), along_second.length_squared());
    let (b, c, f) =
        (along_first.dot(along_second), along_first.dot(offset), along_second.dot(offset));
    let crossing = a * e - b * b;
    let s = if crossing > TINY { ((b * f - c * e) / crossing).clamp(0.0, 1.0) } else { 0.0 };
    let t = (b * s + f) / e.max(TINY);
    if t < 0.0 {
        [(-c / a.max(TINY)).clamp(0.0, 1.0), 0.0]
    } else if t > 1.0 {
        [((b - c) / a.max(TINY)).clamp(0.0, 1.0), 1.0]
    } else {
        [s, t]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn closest_points_of_crossing_and_parallel_segments_are_correct() {
        let check = |first, second, expected: [f32; 2]| {
            assert_eq!(closest_fractions(first, second), expected);
        };
        let along_x = [Vector::ZERO, Vector::X];
        check(along_x, [Vector::new(0.25, -1.0, 0.5), Vector::new(0.25, 1.0, 0.5)], [0.25, 0.5]);
        check(along_x, [Vector::new(2.0, 1.0, 0.0), Vector::new(3.0, 1.0, 0.0)], [1.0, 0.0]);
        check(along_x, [Vector::new(0.0, 1.0, 0.0), Vector::new(1.0, 1.0, 0.0)], [0.0, 0.0]);
    }
}
