//! Capsules that approximate an arm's shape for link avoidance, and their motion with the palm.

use rapier3d::math::{Matrix, Vector};

use crate::arm::Arm;
use crate::hand::{WRIST_ABOVE_M, WRIST_RADIUS_M};
use crate::physics::Physics;

/// Link frames whose origins are the ends of the links' capsules.
pub(crate) const LINK_FRAMES: [usize; 4] = [1, 2, 4, 5];
/// Radii of the links (upper arm, forearm, wrist bend), metres.
pub(crate) const LINK_RADII_M: [f32; 3] = [0.045, 0.04, 0.035];
/// Number of capsules of an arm: its links, then its wrist, then one around palm plate and fingers.
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

/// The capsules of an arm at the joint angles of the start of a control step.
#[derive(Clone, Copy)]
pub(crate) struct ArmCapsules {
    pub(crate) palm_position: Vector,
    pub(crate) capsules: [ArmCapsule; N_CAPSULES],
}

impl ArmCapsules {
    /// Computes the capsules of `arm` at its current joint angles.
    pub(crate) fn of(arm: &Arm, physics: &Physics) -> Self {
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
