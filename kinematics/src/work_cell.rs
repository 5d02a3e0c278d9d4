//! The arms on their table, and how the training world's frames map onto it.
//!
//! **World frame**: origin on the table between the arms, z up, x from the first arm to the second. Arms stand upright
//! at table height. The base frame of an arm is Kinova's; its x axis points at the workspace.
//!
//! **The training world** gives every number in an arm's own frame: origin on the table in the centre of its workspace,
//! x away from its base, z up, metres; the second arm's is the first's turned by half a turn. Objects and goals lie
//! within 0.12 m of the centre along x and y and up to 0.27 m high (two arms); the tool moves within 0.20 m, 0.25 m and 0.35 m.
//! The gripper's fingers close along y.
//!
//! **The Mico with four joints** points nearly down in a narrow ring only (see [`inverse`](crate::inverse)), and the
//! training world's base, 0.40 m behind the centre, is outside it. [`TaskFrame`] therefore shrinks own frames about
//! their centre and puts the centre where the ring is. Of points of the tasks' area, drawn evenly, the gripper tilts by
//! at most 15, 20, 25, 30 and 40 degrees for (with example `area`):
//!
//! | scale | base behind centre | lift | heights | 15° | 20° | 25° | 30° | 40° | reached |
//! |---|---|---|---|---|---|---|---|---|---|
//! | 0.5 | 0.27 m | 45 mm | on the table | 99.9 % | 100 % | | | | 100 % |
//! | 0.5 | 0.27 m | 45 mm | up to the highest goal | 95.6 % | 100 % | | | | 100 % |
//! | 1 | 0.27 m | 45 mm | on the table | 64 % | 83 % | 98 % | 100 % | | 100 % |
//! | 1 | 0.27 m | 45 mm | up to the highest goal | 42 % | 57 % | 71 % | 82 % | 95 % | 98 % |
//! | 1 | 0.40 m | 45 mm | on the table | 27 % | 37 % | 48 % | 58 % | 77 % | 100 % |
//!
//! The default is the first: everything within 20 degrees. Its price: what the policy takes for 1 m is 0.5 m, so objects
//! have to be half as large as the training world's, or the policy has to be trained with larger ones. The lift is there because the
//! real fingers reach 44 mm beyond the tool's origin where the training world's reach 20 mm. Centres stay 0.24 m apart
//! although all else is halved, because hands are not halved: what the arms' areas have between them is room for the hands.

use std::f64::consts::{FRAC_PI_2, PI};

use glam::{DMat3, DVec3};
use tandem_core::ArmIndex;
use tandem_core::layout::WORKSPACES_APART_M;

use crate::capsule::PosedLinks;
use crate::forward::ForwardKinematics;
use crate::inverse::{ReachError, ToolTarget};
use crate::joints::Joints;
use crate::model::{ArmModel, MICO_4};

/// An arm and where it stands.
#[derive(Debug, Clone, Copy)]
pub struct PlacedArm {
    /// What arm it is.
    pub model: &'static ArmModel,
    /// Origin of the base frame in the world, metres.
    pub base_in_world_m: DVec3,
    /// Direction of the base frame's x axis, as an angle about the world's z axis from its x axis, radians.
    pub yaw_rad: f64,
}

/// The arms that work together, and their table.
#[derive(Debug, Clone)]
pub struct WorkCell {
    /// The arms, in the order of the layout.
    pub arms: Vec<PlacedArm>,
    /// Height of the table's top in the world, metres.
    pub table_z_m: f64,
    /// How the training world's frames map onto the bases.
    pub task_frame: TaskFrame,
}

/// How far arms are from what they shall not touch, metres; negative when they overlap.
#[derive(Debug, Clone, PartialEq)]
pub struct Gaps {
    /// For each arm the smallest gap between the table and any part but the base.
    pub table_m: Vec<f64>,
    /// The smallest gap between parts of two arms; infinite when there is one arm only.
    pub arms_m: f64,
    /// For each arm the smallest gap between two of its own parts that can meet.
    pub self_m: Vec<f64>,
}

/// How an arm's own frame of the training world lies in the arm's base frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TaskFrame {
    /// Metres here per metre of the training world.
    pub scale: f64,
    /// Distance of the own frame's origin from the base, along the base's x axis, metres.
    pub centre_m: f64,
    /// Height of the own frame's origin above the base, metres.
    pub lift_m: f64,
}

impl TaskFrame {
    /// The frame for the Mico with four joints.
    pub const MICO_4: Self = Self { scale: 0.5, centre_m: 0.27, lift_m: 0.045 };

    /// A point of the own frame (metres of the training world) in the arm's base frame (metres).
    #[must_use]
    pub fn base_from_own(&self, point_in_own: DVec3) -> DVec3 {
        point_in_own * self.scale + DVec3::new(self.centre_m, 0.0, self.lift_m)
    }

    /// A point of the arm's base frame in the own frame.
    #[must_use]
    pub fn own_from_base(&self, point_in_base: DVec3) -> DVec3 {
        (point_in_base - DVec3::new(self.centre_m, 0.0, self.lift_m)) / self.scale
    }
}

impl WorkCell {
    /// Direction in which the fingers close, base frame, radians: along the own frame's y.
    pub const FINGERS_YAW_RAD: f64 = FRAC_PI_2;

    /// Two Micos with four joints that face each other, the centres of their workspaces 0.24 m apart.
    #[must_use]
    pub fn mico_pair() -> Self {
        let centres_apart_m = f64::from(WORKSPACES_APART_M);
        let task_frame = TaskFrame::MICO_4;
        let x_m = 0.5 * centres_apart_m + task_frame.centre_m;
        let arm = |x_m, yaw_rad| PlacedArm {
            model: &MICO_4,
            base_in_world_m: DVec3::new(x_m, 0.0, 0.0),
            yaw_rad,
        };
        Self { arms: vec![arm(-x_m, 0.0), arm(x_m, PI)], table_z_m: 0.0, task_frame }
    }

    /// A point of the own frame of `arm` (metres of the training world) in the world (metres).
    ///
    /// # Panics
    /// When there is no such arm.
    #[must_use]
    pub fn world_from_own(&self, arm: ArmIndex, point_in_own: DVec3) -> DVec3 {
        self.arms[arm.0].world_from_base(self.task_frame.base_from_own(point_in_own))
    }

    /// Joint angles, arm by arm, that put each tool above the centre of its workspace, `height_in_own_m` up in the
    /// own frame, with the elbow above it.
    ///
    /// # Errors
    /// Says why an arm cannot be there.
    pub fn ready(&self, height_in_own_m: f64) -> Result<Vec<Joints>, ReachError> {
        let ready = |(arm, placed): (ArmIndex, &PlacedArm)| {
            let tool_m = self.world_from_own(arm, DVec3::Z * height_in_own_m);
            let near = Joints::new(placed.model.elbow_up_rad);
            Ok(placed.model.nearest(&placed.target(tool_m), &near)?.angles)
        };
        self.indexed().map(ready).collect()
    }

    /// The gaps of the arms at joint angles `at`, radians, arm by arm, with grippers that may be wide open.
    ///
    /// # Panics
    /// When `at` is of other arms.
    #[must_use]
    pub fn gaps(&self, at: &[Joints]) -> Gaps {
        self.gaps_with(at, &vec![1.0; at.len()])
    }

    /// The gaps of the arms at joint angles `at`, radians, arm by arm, with grippers open by `openings` (0 to 1).
    ///
    /// Openings count between parts of one arm only: for all else a gripper takes the room that it has when open.
    ///
    /// # Panics
    /// When `at` or `openings` are of other arms.
    #[must_use]
    pub fn gaps_with(&self, at: &[Joints], openings: &[f64]) -> Gaps {
        let n_arms = self.arms.len();
        assert!(at.len() == n_arms && openings.len() == n_arms, "angles of other arms");
        let pose = |(arm, q): (&PlacedArm, &Joints)| {
            PosedLinks::of(arm, &ForwardKinematics::new(arm.model, q))
        };
        let posed: Vec<PosedLinks> = self.arms.iter().zip(at).map(pose).collect();
        let between = |(idx, links): (usize, &PosedLinks)| {
            posed[..idx].iter().map(|other| links.gap_m(other).0).fold(f64::INFINITY, f64::min)
        };
        Gaps {
            table_m: posed.iter().map(|links| links.table_gap_m(self.table_z_m).0).collect(),
            arms_m: posed.iter().enumerate().map(between).fold(f64::INFINITY, f64::min),
            self_m: (0..n_arms)
                .map(|arm| posed[arm].self_gap_m(self.arms[arm].model, openings[arm]).0)
                .collect(),
        }
    }

    /// The arms with their indices.
    pub(crate) fn indexed(&self) -> impl Iterator<Item = (ArmIndex, &PlacedArm)> {
        self.arms.iter().enumerate().map(|(arm, placed)| (ArmIndex(arm), placed))
    }
}

impl PlacedArm {
    /// A point of the base frame in the world, metres.
    #[must_use]
    pub fn world_from_base(&self, point_in_base: DVec3) -> DVec3 {
        self.base_in_world_m + self.axes() * point_in_base
    }

    /// A point of the world in the base frame, metres.
    #[must_use]
    pub fn base_from_world(&self, point_in_world: DVec3) -> DVec3 {
        self.axes().transpose() * (point_in_world - self.base_in_world_m)
    }

    /// The target that puts the tool at a point of the world (metres) with the fingers across the arm's own frame.
    #[must_use]
    pub fn target(&self, tool_in_world: DVec3) -> ToolTarget {
        let at_m = self.base_from_world(tool_in_world);
        ToolTarget { at_m, yaw_rad: WorkCell::FINGERS_YAW_RAD }
    }

    /// The base frame's axes in the world.
    #[must_use]
    pub fn axes(&self) -> DMat3 {
        let (sin, cos) = libm::sincos(self.yaw_rad);
        let x_axis = DVec3::new(cos, sin, 0.0);
        DMat3::from_cols(x_axis, DVec3::new(-sin, cos, 0.0), DVec3::Z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_arms_face_each_other() {
        let cell = WorkCell::mico_pair();
        let check = |arm, own: [f64; 3], world: [f64; 3]| {
            let got = cell.world_from_own(ArmIndex(arm), DVec3::from(own));
            // The training world's distances are single precision.
            assert!((got - DVec3::from(world)).length() < 1e-8, "{got}");
            let placed = &cell.arms[arm];
            let back = cell.task_frame.own_from_base(placed.base_from_world(got));
            assert!((back - DVec3::from(own)).length() < 1e-12, "{back}");
        };
        check(0, [0.0, 0.0, 0.0], [-0.12, 0.0, 0.045]);
        check(1, [0.0, 0.0, 0.0], [0.12, 0.0, 0.045]);
        check(0, [0.12, 0.1, 0.1], [-0.06, 0.05, 0.095]);
        check(1, [0.12, 0.1, 0.1], [0.06, -0.05, 0.095]);
    }
}
