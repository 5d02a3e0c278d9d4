//! The work cell: the arms, their table, and the gaps between them.
//!
//! **World frame**: origin on the table between the arms, z up, x from the first arm to the second. Arms stand upright
//! at table height. The base frame of an arm is Kinova's; its x axis points at the workspace.

use std::f64::consts::{FRAC_PI_2, PI};

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use tandem_core::ArmIndex;
use tandem_core::layout::WORKSPACE_DISTANCE_M;

use crate::capsule::LinkCapsules;
use crate::forward::ForwardKinematics;
use crate::inverse::{ReachError, ToolTarget};
use crate::joints::Joints;
use crate::model::{ArmModel, MICO_4};
use crate::task_frame::TaskFrame;

/// An arm and the pose of its base.
#[derive(Debug, Clone, Copy)]
pub struct PlacedArm {
    /// Geometry of the arm.
    pub model: &'static ArmModel,
    /// Origin of the base frame in the world, metres.
    pub base_in_world_m: Point3<f64>,
    /// Direction of the base frame's x axis, as an angle about the world's z axis from its x axis, radians.
    pub yaw_rad: f64,
}

/// The arms that work together, and their table.
#[derive(Debug, Clone)]
pub struct WorkCell {
    /// Arms, in the order of the layout.
    pub arms: Vec<PlacedArm>,
    /// Height of the table's top in the world, metres.
    pub table_z_m: f64,
    /// Pose and scale of the training world's frames in the bases.
    pub task_frame: TaskFrame,
}

/// Gaps that arms must keep, metres; negative if the parts overlap.
#[derive(Debug, Clone, PartialEq)]
pub struct Gaps {
    /// Smallest gap between the table and any part but the base, per arm.
    pub table_m: Vec<f64>,
    /// Smallest gap between parts of two arms; infinite for a single arm.
    pub arms_m: f64,
    /// Smallest gap between two parts of the same arm that can collide, per arm.
    pub self_m: Vec<f64>,
}

impl WorkCell {
    /// The direction in which the fingers close, base frame, radians: along the arm frame's y.
    pub const FINGERS_YAW_RAD: f64 = FRAC_PI_2;

    /// Returns two Micos with four joints that face each other, the centres of their workspaces 0.24 m apart.
    #[must_use]
    pub fn mico_pair() -> Self {
        Self::mico_pair_with(TaskFrame::MICO_4)
    }

    /// As [`mico_pair`](Self::mico_pair), with the arm frames at `task_frame` in the bases.
    #[must_use]
    pub fn mico_pair_with(task_frame: TaskFrame) -> Self {
        let centres_apart_m = f64::from(WORKSPACE_DISTANCE_M);
        let x_m = 0.5 * centres_apart_m + task_frame.centre_m;
        let arm = |x_m, yaw_rad| PlacedArm {
            model: &MICO_4,
            base_in_world_m: Point3::new(x_m, 0.0, 0.0),
            yaw_rad,
        };
        Self { arms: vec![arm(-x_m, 0.0), arm(x_m, PI)], table_z_m: 0.0, task_frame }
    }

    /// Maps a point of the frame of `arm` (metres of the training world) to the world (metres).
    ///
    /// # Panics
    /// If there is no such arm.
    #[must_use]
    pub fn world_from_arm(&self, arm: ArmIndex, point_in_arm: &Point3<f64>) -> Point3<f64> {
        self.arms[arm.0].world_from_base() * self.task_frame.base_from_arm(point_in_arm)
    }

    /// Returns joint angles, arm by arm, that hold each tool above the centre of its workspace with the elbow up.
    /// `height_in_arm_m` is the height in the arm frame, metres.
    ///
    /// # Errors
    /// Returns the reason why an arm cannot reach that position.
    pub fn ready(&self, height_in_arm_m: f64) -> Result<Vec<Joints>, ReachError> {
        let position_in_arm = Point3::new(0.0, 0.0, height_in_arm_m);
        let ready = |(arm, placed): (ArmIndex, &PlacedArm)| {
            let target = placed.target(&self.world_from_arm(arm, &position_in_arm));
            let seed = Joints::new(placed.model.elbow_up_rad);
            Ok(placed.model.inverse_kinematics(&target, &seed)?.angles)
        };
        self.indexed().map(ready).collect()
    }

    /// Returns the gaps of the arms at joint angles `at` (radians, arm by arm) with all grippers wide open.
    ///
    /// # Panics
    /// If `at` does not match the arms.
    #[must_use]
    pub fn gaps(&self, at: &[Joints]) -> Gaps {
        self.gaps_with(at, &vec![1.0; at.len()])
    }

    /// Returns the gaps of the arms at joint angles `at` (radians, arm by arm) with grippers open by `gripper_openings`
    /// (0 to 1).
    ///
    /// Openings count between parts of the same arm only. All other gaps are those of wide open grippers.
    ///
    /// # Panics
    /// If `at` or `gripper_openings` does not match the arms.
    #[must_use]
    pub fn gaps_with(&self, at: &[Joints], gripper_openings: &[f64]) -> Gaps {
        let n_arms = self.arms.len();
        assert!(at.len() == n_arms && gripper_openings.len() == n_arms, "angles of other arms");
        let capsules =
            |(arm, q): (&PlacedArm, &Joints)| arm.capsules(&ForwardKinematics::new(arm.model, q));
        let capsules: Vec<LinkCapsules> = self.arms.iter().zip(at).map(capsules).collect();
        let between = |(idx, links): (usize, &LinkCapsules)| {
            capsules[..idx].iter().map(|other| links.gap_m(other).0).fold(f64::INFINITY, f64::min)
        };
        Gaps {
            table_m: capsules.iter().map(|links| links.table_gap_m(self.table_z_m).0).collect(),
            arms_m: capsules.iter().enumerate().map(between).fold(f64::INFINITY, f64::min),
            self_m: (0..n_arms)
                .map(|arm| capsules[arm].self_gap_m(self.arms[arm].model, gripper_openings[arm]).0)
                .collect(),
        }
    }

    /// Returns the arms with their indices.
    pub(crate) fn indexed(&self) -> impl Iterator<Item = (ArmIndex, &PlacedArm)> {
        self.arms.iter().enumerate().map(|(arm, placed)| (ArmIndex(arm), placed))
    }
}

impl PlacedArm {
    /// Returns the pose of the base frame in the world, metres.
    #[must_use]
    pub fn world_from_base(&self) -> Isometry3<f64> {
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.yaw_rad);
        Isometry3::from_parts(Translation3::from(self.base_in_world_m), rotation)
    }

    /// Returns the target that brings the tool to `tool_in_world_m` (metres) with the fingers along the arm frame's y.
    #[must_use]
    pub fn target(&self, tool_in_world_m: &Point3<f64>) -> ToolTarget {
        let position_m = self.world_from_base().inverse_transform_point(tool_in_world_m);
        ToolTarget { position_m, yaw_rad: WorkCell::FINGERS_YAW_RAD }
    }

    /// Returns the links in the world.
    pub(crate) fn capsules(&self, forward: &ForwardKinematics) -> LinkCapsules {
        LinkCapsules::new(self.model, forward, &self.world_from_base())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_arms_face_each_other() {
        let cell = WorkCell::mico_pair();
        let check = |arm, in_arm: [f64; 3], world: [f64; 3]| {
            let in_arm = Point3::from(in_arm);
            let got = cell.world_from_arm(ArmIndex(arm), &in_arm);
            // The training world's distances are single precision.
            assert!((got - Point3::from(world)).norm() < 1e-8, "{got}");
            let in_base = cell.arms[arm].world_from_base().inverse_transform_point(&got);
            let back = cell.task_frame.arm_from_base(&in_base);
            assert!((back - in_arm).norm() < 1e-12, "{back}");
        };
        check(0, [0.0, 0.0, 0.0], [-0.12, 0.0, 0.045]);
        check(1, [0.0, 0.0, 0.0], [0.12, 0.0, 0.045]);
        check(0, [0.12, 0.1, 0.1], [-0.06, 0.05, 0.095]);
        check(1, [0.12, 0.1, 0.1], [0.06, -0.05, 0.095]);
    }
}
