//! Inverse kinematics: which joint angles bring the tool to a place, pointing down.
//!
//! **Four joints.** Joint 4 turns about the gripper's own axis, so joints 1 to 3 alone decide where the tool is: joint 1
//! turns the plane in which the two straight links lie (7 mm beside the base's axis), and in that plane the links of
//! 0.290 m and 0.2831 m meet the target as two circles do. That gives four solutions: the plane in front or behind,
//! the elbow on either side. How the gripper tilts follows from the place, and joint 4 turns the fingers as near to the
//! wanted direction as the tilt permits. The gripper is straight down where the tool is 0.29 m from the point that lies
//! 8 mm below the base's origin; near the table within 15 degrees at 0.21 to 0.36 m from the base.
//!
//! **Six joints.** The wrist's axes do not meet in one point, so there is no such form: damped least squares,
//! from the angles that the arm has and, when these lead nowhere, from a fixed set of postures. With the gripper straight
//! down these arms have singular postures low above the table (the Jaco some 0.3 m from its base): a way through
//! them is refused. The simulated arm's damped iteration glides over them, with angles that miss by a little.
//!
//! What cannot be reached is an error, and so is what can be reached in a singular posture only: there a small move of
//! the tool takes a large one of the joints.

use std::f64::consts::{PI, TAU};

use glam::{DMat3, DVec3};

use crate::forward::ForwardKinematics;
use crate::iterative;
use crate::joints::Joints;
use crate::manipulability::manipulability_m;
use crate::model::{ArmModel, TOOL_ORIGIN_M};
use crate::self_collision::SELF_GAP_M;

/// Postures of an arm with four joints are singular with a smaller gain, metres per radian. It has this where it is bent
/// by 8 degrees, 1.5 mm short of its reach.
pub const MIN_MANIPULABILITY_M: f64 = 0.02;
/// The same with six joints, where turning counts too, weighed with 0.1 m per radian.
pub const LEAST_GAIN_6_M: f64 = 0.002;
/// A solution that differs by no more than this in any joint is where the arm moves on to, radians.
pub(crate) const MOVES_ON_RAD: f64 = 0.35;

/// Where the tool shall be, and how the fingers shall stand. The gripper shall point straight down.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ToolTarget {
    /// Place of the tool's origin in the arm's base frame, metres.
    pub at_m: DVec3,
    /// Direction in which the fingers close, as an angle about the base frame's z axis from its x axis, radians.
    pub yaw_rad: f64,
}

/// Joint angles for a target.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Solution {
    /// The joint angles, radians.
    pub angles: Joints,
    /// Angle between the way the gripper points and straight down, radians. About 0 with six joints.
    pub tilt_rad: f64,
    /// The smallest displacement of the tool per radian of the joints, metres: small near a singular posture.
    pub manipulability_m: f64,
}

/// Why no joint angles can be given for a target.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ReachError {
    /// A number of the target is infinite or not a number.
    #[error("the target is not finite")]
    NotFinite,
    /// The target is farther from the shoulder than the arm is long.
    #[error("the target is {distance_m:.3} m from the shoulder, the arm reaches {reach_m:.3} m")]
    TooFar {
        /// Distance of the target from the shoulder, metres.
        distance_m: f64,
        /// Largest distance, metres.
        reach_m: f64,
    },
    /// The target is nearer than the links permit: to the shoulder, or to the base's vertical axis.
    #[error(
        "the target is {distance_m:.3} m from the shoulder or the base's axis, at least {least_m:.3} m is needed"
    )]
    TooNear {
        /// Distance of the target, metres.
        distance_m: f64,
        /// Smallest distance, metres.
        least_m: f64,
    },
    /// Every solution turns a joint beyond its range; this one by least.
    #[error("joint {} would be at {:.1} degrees, it has {:.0} to {:.0}", .joint + 1,
        .angle_rad.to_degrees(), .range_rad[0].to_degrees(), .range_rad[1].to_degrees())]
    JointRange {
        /// The joint, counted from 0.
        joint: usize,
        /// Its angle, radians.
        angle_rad: f64,
        /// Smallest and largest angle, radians.
        range_rad: [f64; 2],
    },
    /// The only solutions are singular postures.
    #[error(
        "the posture is singular: {manipulability_m:.4} m per radian, at least {MIN_MANIPULABILITY_M} m is needed"
    )]
    Singular {
        /// The smallest displacement of the tool per radian, metres.
        manipulability_m: f64,
        /// What it has to be at least, metres.
        least_m: f64,
    },
    /// No solution was found from any start; the best missed by this much.
    #[error("no joint angles found: the best miss by {miss_m:.3} m and {turn_rad:.3} rad")]
    Unsolved {
        /// Distance, metres.
        miss_m: f64,
        /// Angle, radians.
        turn_rad: f64,
    },
}

impl ArmModel {
    /// The solution for `target` whose angles are nearest to `near`, radians. Joints that turn round and round are
    /// taken by the shorter way. Solutions in which the arm is too near to itself come last, unless `near` is so near
    /// that the arm just moves on.
    ///
    /// # Errors
    /// Says why the target cannot be reached.
    ///
    /// # Panics
    /// When `near` is of an arm with another number of joints.
    pub fn nearest(&self, target: &ToolTarget, near: &Joints) -> Result<Solution, ReachError> {
        if !(target.at_m.is_finite() && target.yaw_rad.is_finite() && near.is_finite()) {
            return Err(ReachError::NotFinite);
        }
        if self.n_joints() == 4 {
            let solutions = self.solutions(target, near)?;
            let distance = |solution: &Solution| squared_distance(&solution.angles, near);
            let before = |a: &Solution, b: &Solution| {
                let last = [a, b].map(|solution| !self.takes(&solution.angles, near));
                last[0].cmp(&last[1]).then(distance(a).total_cmp(&distance(b)))
            };
            let nearest = solutions.into_iter().min_by(before).expect("an empty list is an error");
            return Ok(nearest);
        }
        self.nearest_pose(target.at_m, &pointing_down(target.yaw_rad), near)
    }

    /// Every solution for `target` of an arm with four joints, each joint as near to `near` as full turns permit.
    ///
    /// # Errors
    /// Says why the target cannot be reached.
    ///
    /// # Panics
    /// When the arm does not have four joints, or `near` is of another arm.
    pub fn solutions(
        &self,
        target: &ToolTarget,
        near: &Joints,
    ) -> Result<Vec<Solution>, ReachError> {
        assert_eq!((self.n_joints(), near.len()), (4, 4), "the closed form is for four joints");
        let (mut solutions, mut worst) = (Vec::with_capacity(4), None);
        for angles in FourJoints::of(self).branches(target.at_m)? {
            match self.accept(self.facing(angles, target.yaw_rad), near) {
                Ok(solution) => solutions.push(solution),
                Err(error) => worst = Some(nearer_miss(worst, error)),
            }
        }
        match (solutions.is_empty(), worst) {
            (true, Some(error)) => Err(error),
            _ => Ok(solutions),
        }
    }

    /// Angles of an arm with six joints that bring the tool to `at_m` (base frame, metres) with the axes `axes`, near to
    /// `near` where that leads there. The solution's tilt is that of `axes`.
    ///
    /// # Errors
    /// Says why the pose cannot be reached, or that it was not.
    ///
    /// # Panics
    /// When the arm does not have six joints, or `near` is of another arm.
    pub fn nearest_pose(
        &self,
        at_m: DVec3,
        axes: &DMat3,
        near: &Joints,
    ) -> Result<Solution, ReachError> {
        assert_eq!((self.n_joints(), near.len()), (6, 6), "the iteration is for six joints");
        let (distance_m, reach_m) = ((at_m - self.shoulder_m()).length(), self.reach_m());
        if !at_m.is_finite() || !axes.is_finite() {
            return Err(ReachError::NotFinite);
        }
        if distance_m > reach_m {
            return Err(ReachError::TooFar { distance_m, reach_m });
        }
        let from = |start: &Joints| {
            iterative::solve(self, at_m, axes, start).and_then(|angles| self.accept(angles, near))
        };
        let mut touching = None;
        let mut worst = None;
        match from(near) {
            Ok(found) if self.takes(&found.angles, near) => return Ok(found),
            Ok(found) => touching = Some(found),
            Err(error) => worst = Some(error),
        }
        let mut best: Option<Solution> = None;
        for start in iterative::starts(self) {
            match from(&start) {
                Ok(found) => {
                    let place =
                        if self.takes(&found.angles, near) { &mut best } else { &mut touching };
                    let nearer = place.is_none_or(|known| {
                        squared_distance(&found.angles, near)
                            < squared_distance(&known.angles, near)
                    });
                    *place = if nearer { Some(found) } else { *place };
                }
                Err(error) => worst = Some(nearer_miss(worst, error)),
            }
        }
        best.or(touching).ok_or_else(|| worst.expect("every start has failed"))
    }

    /// Whether a solution need not come last: the arm keeps clear of itself, or moves on from `near`. Where an arm that
    /// moves on meets itself is for the check to say; another solution would be a jump.
    fn takes(&self, angles: &Joints, near: &Joints) -> bool {
        angles.largest_difference(near) <= MOVES_ON_RAD
            || self.self_gap_m(angles, 1.0) >= SELF_GAP_M
    }

    /// `angles` by full turns as near to `near` as the ranges permit, when they are within them and not singular.
    fn accept(&self, mut angles: Joints, near: &Joints) -> Result<Solution, ReachError> {
        for (joint, angle) in angles.iter_mut().enumerate() {
            let [low, high] = self.joints[joint].range_rad;
            *angle = if self.joints[joint].continuous {
                let near = near[joint].clamp(low, high);
                let turned = *angle + TAU * libm::round((near - *angle) / TAU);
                turned - TAU * f64::from(turned > high) + TAU * f64::from(turned < low)
            } else {
                angle.rem_euclid(TAU)
            };
            if !(low..=high).contains(angle) {
                let range_rad = [low, high];
                return Err(ReachError::JointRange { joint, angle_rad: *angle, range_rad });
            }
        }
        let posture = ForwardKinematics::new(self, &angles);
        let manipulability_m = manipulability_m(&posture, angles.len());
        let least_m = if angles.len() < 6 { MIN_MANIPULABILITY_M } else { LEAST_GAIN_6_M };
        if manipulability_m < least_m {
            return Err(ReachError::Singular { manipulability_m, least_m });
        }
        Ok(Solution { angles, tilt_rad: posture.tilt_rad(), manipulability_m })
    }

    /// Joints 1 to 3 with a joint 4 that turns the fingers as near to `yaw_rad` as it can.
    fn facing(&self, [q1, q2, q3]: [f64; 3], yaw_rad: f64) -> Joints {
        let posture = ForwardKinematics::new(self, &Joints::new(&[q1, q2, q3, 0.0]));
        let (sin, cos) = libm::sincos(yaw_rad);
        let wanted = DVec3::new(cos, sin, 0.0);
        let axes = posture.joint_axes(3);
        // The fingers close along the joint's y axis, which joint 4 turns towards its negative x axis.
        let turn_rad = libm::atan2(-wanted.dot(axes.x_axis), wanted.dot(axes.y_axis));
        Joints::new(&[q1, q2, q3, turn_rad])
    }
}

/// The four-joint arm as two links in a plane.
struct FourJoints {
    shoulder_z_m: f64,
    /// How far the plane is beside the base's axis.
    aside_m: f64,
    upper_m: f64,
    fore_m: f64,
}

impl FourJoints {
    fn of(model: &ArmModel) -> Self {
        Self {
            shoulder_z_m: model.shoulder_m().z,
            aside_m: model.joints[1].origin_m.y + model.joints[3].origin_m.z,
            upper_m: -model.joints[2].origin_m.y,
            fore_m: model.joints[3].origin_m.y - TOOL_ORIGIN_M.z,
        }
    }

    /// Joints 1 to 3 of every solution, radians, without regard to their ranges.
    fn branches(&self, at_m: DVec3) -> Result<Vec<[f64; 3]>, ReachError> {
        let from_axis_m = libm::hypot(at_m.x, at_m.y);
        let squared = from_axis_m * from_axis_m - self.aside_m * self.aside_m;
        if squared <= 0.0 {
            let least_m = self.aside_m.abs();
            return Err(ReachError::TooNear { distance_m: from_axis_m, least_m });
        }
        let (ahead_m, up_m) = (squared.sqrt(), at_m.z - self.shoulder_z_m);
        let bend_rad = self.bend_rad(libm::hypot(ahead_m, up_m))?;
        let mut branches = Vec::with_capacity(4);
        for ahead_m in [ahead_m, -ahead_m] {
            let q1 = libm::atan2(
                self.aside_m * at_m.x + ahead_m * at_m.y,
                self.aside_m * at_m.y - ahead_m * at_m.x,
            );
            for bend_rad in [bend_rad, -bend_rad] {
                let (sin, cos) = libm::sincos(bend_rad);
                let lean_rad = libm::atan2(ahead_m, up_m)
                    - libm::atan2(self.fore_m * sin, self.upper_m + self.fore_m * cos);
                branches.push([q1, PI + lean_rad, PI - bend_rad]);
            }
        }
        Ok(branches)
    }

    /// The angle between the links when the tool is `distance_m` from the shoulder, in the plane.
    fn bend_rad(&self, distance_m: f64) -> Result<f64, ReachError> {
        let (sum_m, difference_m) =
            (self.upper_m + self.fore_m, (self.upper_m - self.fore_m).abs());
        if distance_m > sum_m {
            let reach_m = libm::hypot(sum_m, self.aside_m);
            let distance_m = libm::hypot(distance_m, self.aside_m);
            return Err(ReachError::TooFar { distance_m, reach_m });
        }
        if distance_m < difference_m {
            return Err(ReachError::TooNear { distance_m, least_m: difference_m });
        }
        let squares = self.upper_m * self.upper_m + self.fore_m * self.fore_m;
        let cos = (distance_m * distance_m - squares) / (2.0 * self.upper_m * self.fore_m);
        Ok(libm::acos(cos.clamp(-1.0, 1.0)))
    }
}

/// The axes of a tool that points straight down with the fingers closing along `yaw_rad`.
fn pointing_down(yaw_rad: f64) -> DMat3 {
    let (sin, cos) = libm::sincos(yaw_rad);
    DMat3::from_cols(DVec3::new(cos, sin, 0.0), DVec3::new(sin, -cos, 0.0), DVec3::NEG_Z)
}

fn squared_distance(angles: &Joints, other: &Joints) -> f64 {
    angles.iter().zip(other.iter()).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// Of two reasons the one that tells more: a singular posture, then a joint least beyond its range, then a miss.
fn nearer_miss(known: Option<ReachError>, new: ReachError) -> ReachError {
    let rank = |error: &ReachError| match error {
        ReachError::JointRange { angle_rad, range_rad: [low, high], .. } => {
            (1, (low - angle_rad).max(angle_rad - high))
        }
        ReachError::Singular { manipulability_m, .. } => (0, -manipulability_m),
        ReachError::Unsolved { miss_m, turn_rad } => (2, miss_m + turn_rad),
        _ => (3, 0.0),
    };
    match known {
        Some(known) => {
            let ((kind, by), (new_kind, new_by)) = (rank(&known), rank(&new));
            if kind.cmp(&new_kind).then(by.total_cmp(&new_by)).is_le() { known } else { new }
        }
        None => new,
    }
}
