//! The relation between the training world's frames and the arms' base frames.
//!
//! **The classic training world** gives every number in an arm frame: origin on the table in the centre of the
//! arm's workspace, x away from its base, z up, metres. The second arm's frame is the first's rotated by half a turn.
//! Objects and goals lie within 0.12 m of the centre along x and y and up to 0.27 m high (two arms); the tool moves
//! within 0.20 m, 0.25 m and 0.35 m. The gripper's fingers close along y.
//!
//! **The Mico with four joints** points nearly down in a narrow ring only (see [`inverse`](crate::inverse)), and the
//! training world's base, 0.40 m behind the centre, is outside that ring. A [`TaskFrame`] scales arm frames about their
//! centre and moves the centre into the ring. The table gives the share of points, drawn uniformly from the tasks'
//! area, at which the gripper tilts by at most 15, 20, 25, 30 and 40 degrees (measured by example `area`):
//!
//! | scale | base behind centre | lift | heights | 15° | 20° | 25° | 30° | 40° | reached |
//! |---|---|---|---|---|---|---|---|---|---|
//! | 0.5 | 0.27 m | 45 mm | on the table | 99.9 % | 100 % | | | | 100 % |
//! | 0.5 | 0.27 m | 45 mm | up to the highest goal | 95.6 % | 100 % | | | | 100 % |
//! | 1 | 0.27 m | 45 mm | on the table | 64 % | 83 % | 98 % | 100 % | | 100 % |
//! | 1 | 0.27 m | 45 mm | up to the highest goal | 42 % | 57 % | 71 % | 82 % | 95 % | 98 % |
//! | 1 | 0.40 m | 45 mm | on the table | 27 % | 37 % | 48 % | 58 % | 77 % | 100 % |
//!
//! [`TaskFrame::MICO_4`] is the first of these: everything is within 20 degrees. In exchange, 1 m of the policy is 0.5
//! m on the table, so objects must be half as large as in the training world, or the policy must be trained with larger
//! ones. The lift accounts for the real fingers, which extend 44 mm beyond the tool's origin where those of the
//! training world extend 20 mm. The centres stay 0.24 m apart at any scale: that distance is the room for the hands,
//! which are not scaled.

use nalgebra::{Point3, Vector3};

/// The pose and scale of an arm frame of the training world in the arm's base frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TaskFrame {
    /// Metres on the table per metre of the training world.
    pub scale: f64,
    /// Distance of the arm frame's origin from the base, along the base's x axis, metres.
    pub centre_m: f64,
    /// Height of the arm frame's origin above the base, metres.
    pub lift_m: f64,
}

impl TaskFrame {
    /// The frame for the Mico with four joints.
    pub const MICO_4: Self = Self { scale: 0.5, centre_m: 0.27, lift_m: 0.045 };

    /// Maps a point of the arm frame (metres of the training world) to the arm's base frame (metres).
    #[must_use]
    pub fn base_from_arm(&self, point_in_arm: &Point3<f64>) -> Point3<f64> {
        point_in_arm * self.scale + self.origin_in_base()
    }

    /// Maps a point of the arm's base frame (metres) to the arm frame (metres of the training world).
    #[must_use]
    pub fn arm_from_base(&self, point_in_base: &Point3<f64>) -> Point3<f64> {
        (point_in_base - self.origin_in_base()) / self.scale
    }

    fn origin_in_base(&self) -> Vector3<f64> {
        Vector3::new(self.centre_m, 0.0, self.lift_m)
    }
}
