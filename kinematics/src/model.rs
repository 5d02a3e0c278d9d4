//! The geometry of an arm: joints, tool, links, and bounds derived from them.
//!
//! Every joint rotates about the z axis of its own frame. The base frame lies on the table with z up. By Kinova's
//! convention joints 2 and 3 are stretched at π: the arm is upright, with the tool above the base, when both are π.

mod mico;

use nalgebra::{Isometry3, Point3, Vector3};

pub use self::mico::{MICO_4, PADS_AHEAD_M};
use crate::joints::Joints;

/// A revolute joint: its frame and its limits.
#[derive(Debug)]
pub struct Joint {
    /// Pose of the joint's frame at joint angle 0 in the frame of the previous joint, metres.
    pub previous_from_joint: Isometry3<f64>,
    /// Smallest and largest angle, radians.
    pub range_rad: [f64; 2],
    /// `true` if the joint has no mechanical stop, so that angles a full turn apart are equivalent.
    pub continuous: bool,
    /// Largest speed, radians per second.
    pub speed_radps: f64,
}

/// A point fixed to one of an arm's frames.
#[derive(Debug)]
pub struct Anchor {
    /// Index of the frame: 0 is the base, `i` the frame of joint `i` (counted from 1), `n_joints + 1` the tool.
    pub frame: usize,
    /// Position in that frame, metres.
    pub offset_m: Point3<f64>,
}

/// A part of an arm, modelled as a capsule: all points within a radius of a line segment.
#[derive(Debug)]
pub struct Link {
    /// Name in messages.
    pub name: &'static str,
    /// Ends of the segment.
    pub ends: [Anchor; 2],
    /// Radius, metres.
    pub radius_m: f64,
    /// Share of the segment, about its middle, that remains when the gripper is closed; 1 for parts of fixed length.
    pub closed_share: f64,
}

/// Two parts of one arm that can collide.
#[derive(Debug)]
pub struct SelfPair {
    /// The parts, as indices into [`ArmModel::links`].
    pub links: [usize; 2],
    /// Distance by which the capsules exceed the real parts, added to the gap between them, metres.
    pub allowance_m: f64,
}

/// An arm: joints from base to wrist, tool and shape.
#[derive(Debug)]
pub struct ArmModel {
    /// Kinova's name of the arm.
    pub name: &'static str,
    /// Joints, base to wrist.
    pub joints: &'static [Joint],
    /// Pose of the tool in the frame of the last joint, metres. The fingers close along the tool's x axis, and the
    /// gripper points along its z axis.
    pub last_from_tool: Isometry3<f64>,
    /// Parts, base first. Only the base may touch the table.
    pub links: &'static [Link],
    /// Pairs of parts that are checked for self-collision.
    pub self_pairs: &'static [SelfPair],
    /// Joint angles with the elbow up and the gripper ahead of the base (along its x axis) pointing down, radians: the
    /// seed of the inverse kinematics for an arm whose angles are unknown.
    pub elbow_up_rad: &'static [f64],
}

/// The lengths of an arm with four joints, whose links lie in one vertical plane, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaneLengths {
    /// Height of the shoulder above the base's origin.
    pub shoulder_height_m: f64,
    /// From the shoulder to the elbow.
    pub upper_arm_m: f64,
    /// From the elbow to the last joint.
    pub forearm_m: f64,
    /// From the last joint to the tool's origin.
    pub hand_m: f64,
}

impl Anchor {
    /// Returns the origin of `frame`.
    #[must_use]
    pub const fn origin_of(frame: usize) -> Self {
        Self { frame, offset_m: Point3::new(0.0, 0.0, 0.0) }
    }
}

impl Joint {
    /// Returns the origin of the joint's frame in the previous joint's frame, metres.
    pub(crate) fn origin_m(&self) -> Vector3<f64> {
        self.previous_from_joint.translation.vector
    }
}

impl ArmModel {
    /// Returns the number of joints.
    #[must_use]
    pub fn n_joints(&self) -> usize {
        self.joints.len()
    }

    /// Returns the shoulder in the base frame, metres: the point where the axes of joints 1 and 2 meet. The origin of
    /// joint 2 lies on its axis, 1.6 mm from this point.
    #[must_use]
    pub fn shoulder_m(&self) -> Point3<f64> {
        Point3::new(0.0, 0.0, self.joints[0].origin_m().z - self.joints[1].origin_m().z)
    }

    /// Returns the lengths of the arm's links in their plane, metres.
    ///
    /// # Panics
    /// If the arm does not have four joints.
    #[must_use]
    pub fn plane_lengths_m(&self) -> PlaneLengths {
        assert_eq!(self.n_joints(), 4, "links in one plane");
        let origin_m = |joint: usize| self.joints[joint].origin_m();
        PlaneLengths {
            shoulder_height_m: self.shoulder_m().z,
            upper_arm_m: -origin_m(2).y,
            forearm_m: origin_m(3).y,
            hand_m: -self.last_from_tool.translation.z,
        }
    }

    /// Returns an upper bound on the distance between shoulder and tool, metres. Arms with four joints attain it.
    #[must_use]
    pub fn reach_m(&self) -> f64 {
        let origin_m = |joint: usize| self.joints[joint].origin_m();
        let out_of_plane_m = origin_m(1).y + origin_m(3).z;
        let wrist_m: f64 = self.joints[4..].iter().map(|joint| joint.origin_m().norm()).sum();
        let tool_m = -self.last_from_tool.translation.z;
        let in_plane_m = -origin_m(2).y + origin_m(3).y + wrist_m + tool_m;
        libm::hypot(in_plane_m, out_of_plane_m)
    }

    /// Returns, for each joint, an upper bound on the distance between its axis and the tool's origin, metres.
    pub(crate) fn tool_levers_m(&self) -> Joints {
        self.levers_to(&[self.last_from_tool.translation.vector.into()])
    }

    /// Returns, for each joint, an upper bound on the distance between its axis and any point of the links' segments,
    /// metres. The bound holds at all joint angles.
    #[must_use]
    pub fn link_levers_m(&self) -> Joints {
        let n = self.n_joints();
        let in_last_frame = |anchor: &Anchor| match anchor.frame {
            frame if frame == n => Some(anchor.offset_m),
            frame if frame > n => Some(self.last_from_tool * anchor.offset_m),
            _ => None,
        };
        let points: Vec<Point3<f64>> =
            self.links.iter().flat_map(|link| &link.ends).filter_map(in_last_frame).collect();
        self.levers_to(&points)
    }

    /// Returns, for each joint, an upper bound on the distance between its axis and any of `points`, metres. Points are
    /// given in the frame of the last joint, metres.
    fn levers_to(&self, points: &[Point3<f64>]) -> Joints {
        let n = self.n_joints();
        let beyond_m = points.iter().map(|point| point.coords.norm()).fold(0.0, f64::max);
        let from_axis_m = |point: &Vector3<f64>| libm::hypot(point.x, point.y);
        Joints::from_fn(n, |joint| match &self.joints[joint + 1..] {
            [] => points.iter().map(|point| from_axis_m(&point.coords)).fold(0.0, f64::max),
            [next, others @ ..] => {
                let offsets_m = others.iter().map(|other| other.origin_m().norm());
                from_axis_m(&next.origin_m()) + offsets_m.sum::<f64>() + beyond_m
            }
        })
    }
}
