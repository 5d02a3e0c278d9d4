//! Forward kinematics: the frames of an arm at given joint angles, and the velocity of its tool.

use nalgebra::{Isometry3, Point3, SMatrix, UnitQuaternion, Vector3};

use crate::joints::{Joints, MAX_JOINTS};
use crate::model::{Anchor, ArmModel};

/// The Jacobian of the tool's position: column `j` is its velocity per rate of joint `j`, metres per radian. Columns
/// beyond the arm's joints are 0.
pub type PositionJacobian = SMatrix<f64, 3, MAX_JOINTS>;

/// The frames of an arm at given joint angles, in the arm's base frame.
#[derive(Debug, Clone)]
pub struct ForwardKinematics {
    /// Base, joints, tool.
    frames: [Isometry3<f64>; MAX_JOINTS + 2],
    n_joints: usize,
}

impl ForwardKinematics {
    /// Computes the frames of `model` at joint angles `angles`, radians.
    ///
    /// # Panics
    /// If `angles` has another number of joints than `model`.
    #[must_use]
    pub fn new(model: &ArmModel, angles: &Joints) -> Self {
        assert_eq!(angles.len(), model.n_joints(), "angles of another arm");
        let n_joints = angles.len();
        let mut frames = [Isometry3::identity(); MAX_JOINTS + 2];
        for (idx, (joint, angle)) in model.joints.iter().zip(angles.iter()).enumerate() {
            let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), *angle);
            frames[idx + 1] = frames[idx] * joint.previous_from_joint * rotation;
        }
        frames[n_joints + 1] = frames[n_joints] * model.last_from_tool;
        Self { frames, n_joints }
    }

    /// Returns the pose of the tool in the base frame, metres. The fingers close along its x axis, and the gripper
    /// points along its z axis.
    #[must_use]
    pub fn tool(&self) -> &Isometry3<f64> {
        &self.frames[self.n_joints + 1]
    }

    /// Returns the position of the tool's origin in the base frame, metres.
    #[must_use]
    pub fn tool_m(&self) -> Point3<f64> {
        self.tool().translation.vector.into()
    }

    /// Returns the direction in which the gripper points, a unit vector of the base frame.
    #[must_use]
    pub fn pointing(&self) -> Vector3<f64> {
        self.tool().rotation * Vector3::z()
    }

    /// Returns the angle between the gripper's direction and straight down, radians in [0, π].
    #[must_use]
    pub fn tilt_rad(&self) -> f64 {
        let pointing = self.pointing();
        libm::atan2(libm::hypot(pointing.x, pointing.y), -pointing.z)
    }

    /// Returns the position of `anchor` in the base frame, metres.
    ///
    /// # Panics
    /// If the anchor's frame is out of range.
    #[must_use]
    pub fn anchor_m(&self, anchor: &Anchor) -> Point3<f64> {
        self.frames[anchor.frame] * anchor.offset_m
    }

    /// Returns the orientation of the frame of `joint` (counted from 0), including the joint's own rotation.
    pub(crate) fn joint_rotation(&self, joint: usize) -> &UnitQuaternion<f64> {
        &self.frames[joint + 1].rotation
    }

    /// Returns the Jacobian of the tool's position, base frame, metres per radian.
    #[must_use]
    pub fn position_jacobian(&self) -> PositionJacobian {
        let tool_m = self.tool().translation.vector;
        let mut jacobian = PositionJacobian::zeros();
        for (joint, frame) in self.frames[1..=self.n_joints].iter().enumerate() {
            let axis = frame.rotation * Vector3::z();
            jacobian.set_column(joint, &axis.cross(&(tool_m - frame.translation.vector)));
        }
        jacobian
    }

    /// Returns the force on the tool's origin that causes external torques `torques_nm`, base frame, newtons: the
    /// least-squares solution. Returns `None` in a posture in which the torques do not determine it.
    #[must_use]
    pub fn tool_force(&self, torques_nm: &Joints) -> Option<Vector3<f64>> {
        let jacobian = self.position_jacobian();
        let terms =
            torques_nm.iter().enumerate().map(|(joint, torque)| jacobian.column(joint) * *torque);
        let inverse = (jacobian * jacobian.transpose()).try_inverse()?;
        Some(inverse * terms.fold(Vector3::zeros(), |sum, term| sum + term))
    }

    /// Returns the velocity of the tool's origin at joint velocities `velocities` (radians per second), base frame,
    /// metres per second.
    #[must_use]
    pub fn tool_velocity(&self, velocities: &Joints) -> Vector3<f64> {
        let jacobian = self.position_jacobian();
        let terms =
            velocities.iter().enumerate().map(|(joint, rate)| jacobian.column(joint) * *rate);
        terms.fold(Vector3::zeros(), |sum, term| sum + term)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::MICO_4;
    use std::f64::consts::PI;

    #[test]
    fn the_stretched_arm_is_upright() {
        let angles = Joints::new(&[0.0, PI, PI, 0.0]);
        let tool_m = ForwardKinematics::new(&MICO_4, &angles).tool_m();
        assert!((tool_m - Point3::new(0.0, -0.007, 0.8486)).norm() < 6e-4, "{tool_m}");
    }

    #[test]
    fn the_jacobian_is_the_derivative_of_the_tools_position() {
        let step = 1e-6;
        let angles = Joints::new(&[0.3, 2.5, 4.0, -1.0]);
        let forward = ForwardKinematics::new(&MICO_4, &angles);
        let jacobian = forward.position_jacobian();
        for joint in 0..MAX_JOINTS {
            let mut turned = angles;
            if let Some(angle) = turned.get_mut(joint) {
                *angle += step;
            }
            let moved = ForwardKinematics::new(&MICO_4, &turned).tool_m() - forward.tool_m();
            assert!((moved / step - jacobian.column(joint)).norm() < 1e-5, "joint {joint}");
        }
    }

    #[test]
    fn torques_of_a_force_on_the_tool_determine_it() {
        let angles = Joints::new(&[0.3, 2.5, 4.0, -1.0]);
        let forward = ForwardKinematics::new(&MICO_4, &angles);
        let force_n = Vector3::new(1.0, -2.0, 5.0);
        let jacobian = forward.position_jacobian();
        let torques_nm = Joints::from_fn(4, |joint| jacobian.column(joint).dot(&force_n));
        let got_n = forward.tool_force(&torques_nm).expect("determined");
        assert!((got_n - force_n).norm() < 1e-9, "{got_n}");
    }
}
