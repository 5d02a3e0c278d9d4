//! An arm in one posture: where its frames are, and how the tool moves when the joints turn.

use glam::{DMat3, DVec3};

use crate::joints::{Joints, MAX_JOINTS};
use crate::model::{Anchor, ArmModel, TOOL_AXES, TOOL_ORIGIN_M};

/// A coordinate system in the arm's base frame.
#[derive(Debug, Clone, Copy)]
pub struct Frame {
    /// Origin, metres.
    pub origin_m: DVec3,
    /// Axes as columns.
    pub axes: DMat3,
}

/// An arm in one posture; all in the arm's base frame.
#[derive(Debug, Clone)]
pub struct ForwardKinematics {
    /// Base first, then the joints, then the tool.
    frames: [Frame; MAX_JOINTS + 2],
    n_joints: usize,
}

impl ForwardKinematics {
    /// The posture of `model` with its joints at `angles`, radians.
    ///
    /// # Panics
    /// When `angles` are of an arm with another number of joints.
    #[must_use]
    pub fn new(model: &ArmModel, angles: &Joints) -> Self {
        assert_eq!(angles.len(), model.n_joints(), "angles of another arm");
        let base = Frame { origin_m: DVec3::ZERO, axes: DMat3::IDENTITY };
        let mut frames = [base; MAX_JOINTS + 2];
        for (idx, (joint, angle)) in model.joints.iter().zip(angles.iter()).enumerate() {
            let (sin, cos) = libm::sincos(*angle);
            let at_zero = frames[idx].then(joint.origin_m, joint.axes);
            let DMat3 { x_axis, y_axis, z_axis } = at_zero.axes;
            let axes =
                DMat3::from_cols(x_axis * cos + y_axis * sin, y_axis * cos - x_axis * sin, z_axis);
            frames[idx + 1] = Frame { axes, ..at_zero };
        }
        let n_joints = angles.len();
        frames[n_joints + 1] = frames[n_joints].then(TOOL_ORIGIN_M, TOOL_AXES);
        Self { frames, n_joints }
    }

    /// The tool: x is the direction in which the fingers close, z the way the gripper points.
    #[must_use]
    pub fn tool(&self) -> &Frame {
        &self.frames[self.n_joints + 1]
    }

    /// The angle between the way the gripper points and straight down, radians in [0, π].
    #[must_use]
    pub fn tilt_rad(&self) -> f64 {
        let pointing = self.tool().axes.z_axis;
        libm::atan2(libm::hypot(pointing.x, pointing.y), -pointing.z)
    }

    /// Where `anchor` is, metres.
    ///
    /// # Panics
    /// When the arm has no such frame.
    #[must_use]
    pub fn anchor(&self, anchor: &Anchor) -> DVec3 {
        let frame = &self.frames[anchor.frame];
        frame.origin_m + frame.axes * anchor.offset_m
    }

    /// The axes of joint `joint`'s frame, its own turn included.
    pub(crate) fn joint_axes(&self, joint: usize) -> &DMat3 {
        &self.frames[joint + 1].axes
    }

    /// How the tool moves per radian of joint `joint`: its origin (metres) and its turn (radians).
    #[must_use]
    pub fn tool_motion(&self, joint: usize) -> (DVec3, DVec3) {
        let frame = &self.frames[joint + 1];
        let axis = frame.axes.z_axis;
        (axis.cross(self.tool().origin_m - frame.origin_m), axis)
    }

    /// The velocity of the tool's origin at joint rates `rates`, metres per second when they are radians per second.
    #[must_use]
    pub fn tool_velocity(&self, rates: &Joints) -> DVec3 {
        let moves = rates.iter().enumerate().map(|(joint, rate)| self.tool_motion(joint).0 * *rate);
        moves.fold(DVec3::ZERO, |sum, part| sum + part)
    }
}

impl Frame {
    fn then(&self, origin_m: DVec3, axes: DMat3) -> Self {
        Self { origin_m: self.origin_m + self.axes * origin_m, axes: self.axes * axes }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{JACO_6, MICO_4, MICO_6};
    use std::f64::consts::PI;

    #[test]
    fn stretched_out_the_arms_stand_upright() {
        let check = |model: &ArmModel, tool_m: [f64; 3]| {
            let angles = Joints::from_fn(model.n_joints(), |joint| match joint {
                1 | 2 => PI,
                _ => 0.0,
            });
            let got_m = ForwardKinematics::new(model, &angles).tool().origin_m;
            assert!((got_m - DVec3::from(tool_m)).length() < 6e-4, "{}: {got_m}", model.name);
        };
        check(&MICO_4, [0.0, -0.007, 0.8486]);
        check(&MICO_6, [0.0, 0.067, 0.977]);
        check(&JACO_6, [0.0, 0.064, 1.181]);
    }

    #[test]
    fn the_tools_motion_is_the_derivative_of_its_place() {
        let step = 1e-6;
        for model in [&MICO_4, &MICO_6, &JACO_6] {
            let angles = Joints::new(&[0.3, 2.5, 4.0, -1.0, 0.7, 2.0][..model.n_joints()]);
            let posture = ForwardKinematics::new(model, &angles);
            for joint in 0..model.n_joints() {
                let mut turned = angles;
                turned[joint] += step;
                let after = ForwardKinematics::new(model, &turned);
                let (along, axis) = posture.tool_motion(joint);
                let moved = (after.tool().origin_m - posture.tool().origin_m) / step;
                assert!((moved - along).length() < 1e-5, "{}, joint {joint}", model.name);
                let swung = (after.tool().axes.x_axis - posture.tool().axes.x_axis) / step;
                let expected = axis.cross(posture.tool().axes.x_axis);
                assert!((swung - expected).length() < 1e-5, "{}, joint {joint}", model.name);
            }
        }
    }
}
