//! Inverse kinematics: joint angles that bring the tool to a position, pointing down as far as possible.
//!
//! The closed form covers arms with four joints. Joint 4 rotates about the gripper's own axis, so joints 1 to 3 alone
//! determine the tool's position. Joint 1 rotates the plane in which the two straight links lie (7 mm beside the base's
//! axis); in that plane the links of 0.290 m and 0.2831 m meet at the target like two circles. There are up to four
//! solutions: the plane in front or behind, the elbow on either side. The position determines the gripper's tilt, and
//! joint 4 rotates the fingers as close to the wanted direction as the tilt permits. The gripper points straight down
//! where the tool is 0.29 m from the point 8 mm below the base's origin; near the table it is within 15 degrees at 0.21
//! to 0.36 m from the base.
//!
//! A target out of reach is an error. So is a target that only singular configurations reach: there, a small motion of
//! the tool needs a large one of the joints.

use std::f64::consts::{PI, TAU};

use nalgebra::{Point3, Vector3};

use crate::forward::ForwardKinematics;
use crate::joints::Joints;
use crate::manipulability::manipulability_m;
use crate::model::ArmModel;
use crate::self_collision::SELF_GAP_M;

/// Configurations with a smaller manipulability are singular, metres per radian. The Mico has this manipulability when
/// its elbow is bent by 8 degrees, 1.5 mm short of its reach.
pub const MIN_MANIPULABILITY_M: f64 = 0.02;
/// The largest difference to the seed, in any joint, of a solution that continues a motion, radians. Larger ones belong
/// to another branch of solutions or pass close to a singular configuration.
pub(crate) const MAX_CONTINUOUS_STEP_RAD: f64 = 0.35;

/// A position of the tool and a direction of the fingers. The gripper is to point straight down.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ToolTarget {
    /// Position of the tool's origin in the arm's base frame, metres.
    pub position_m: Point3<f64>,
    /// Direction in which the fingers close, as an angle about the base frame's z axis from its x axis, radians.
    pub yaw_rad: f64,
}

/// Joint angles for a target.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Solution {
    /// Joint angles, radians.
    pub angles: Joints,
    /// Angle between the gripper's direction and straight down, radians.
    pub tilt_rad: f64,
    /// Smallest singular value of the position Jacobian, metres per radian: small near a singular configuration.
    pub manipulability_m: f64,
}

/// The reason why a target has no solution.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ReachError {
    /// A number of the target or of the present joint angles, from which the search starts, is infinite or NaN.
    #[error("the target or the present joint angles are not finite")]
    NotFinite,
    /// The target is farther from the shoulder than the arm is long.
    #[error("the target is {distance_m:.3} m from the shoulder, the arm reaches {reach_m:.3} m")]
    TooFar {
        /// Distance of the target from the shoulder, metres.
        distance_m: f64,
        /// Largest distance, metres.
        reach_m: f64,
    },
    /// The target is nearer to the shoulder or to the base's vertical axis than the links permit.
    #[error(
        "the target is {distance_m:.3} m from the shoulder or the base's axis, at least {least_m:.3} m is needed"
    )]
    TooNear {
        /// Distance of the target, metres.
        distance_m: f64,
        /// Smallest distance, metres.
        least_m: f64,
    },
    /// Every solution exceeds the range of a joint. The one that exceeds it least is reported.
    #[error("joint {} would be at {:.1} degrees, its range is {:.0} to {:.0}", .joint + 1,
        .angle_rad.to_degrees(), .range_rad[0].to_degrees(), .range_rad[1].to_degrees())]
    JointRange {
        /// The joint, counted from 0.
        joint: usize,
        /// Its angle, radians.
        angle_rad: f64,
        /// Smallest and largest angle, radians.
        range_rad: [f64; 2],
    },
    /// Every solution within the joints' ranges is a singular configuration.
    #[error(
        "the configuration is singular: its manipulability is {manipulability_m:.4} m per radian, \
        at least {MIN_MANIPULABILITY_M} is needed"
    )]
    Singular {
        /// The largest manipulability of these solutions, metres per radian.
        manipulability_m: f64,
    },
}

impl ArmModel {
    /// Returns the solution for `target` nearest to `seed` (joint angles, radians) by squared distance. Continuous
    /// joints take the shorter way round. Solutions in which the arm is too close to itself come last, except within
    /// 0.35 rad of the seed: there the arm continues its motion, another solution would be a jump, and the motion's
    /// check decides about the collision.
    ///
    /// # Errors
    /// Returns the reason why no solution exists.
    ///
    /// # Panics
    /// If the arm or the seed does not have four joints.
    pub fn inverse_kinematics(
        &self,
        target: &ToolTarget,
        seed: &Joints,
    ) -> Result<Solution, ReachError> {
        let last = |solution: &Solution| !self.continues_or_is_clear(&solution.angles, seed);
        let distance = |solution: &Solution| squared_distance(&solution.angles, seed);
        let order = |a: &Solution, b: &Solution| {
            last(a).cmp(&last(b)).then(distance(a).total_cmp(&distance(b)))
        };
        let solutions = self.solutions(target, seed)?;
        Ok(solutions.into_iter().min_by(order).expect("an empty list is an error"))
    }

    /// Returns every solution for `target`, each continuous joint at the full turn nearest to `seed` (radians).
    ///
    /// # Errors
    /// Returns the reason why no solution exists.
    ///
    /// # Panics
    /// If the arm or the seed does not have four joints.
    pub fn solutions(
        &self,
        target: &ToolTarget,
        seed: &Joints,
    ) -> Result<Vec<Solution>, ReachError> {
        assert_eq!((self.n_joints(), seed.len()), (4, 4), "the closed form is for four joints");
        let position = target.position_m.iter();
        if !(position.chain([&target.yaw_rad]).all(|n| n.is_finite()) && seed.is_finite()) {
            return Err(ReachError::NotFinite);
        }
        let (mut solutions, mut error) = (Vec::with_capacity(4), None);
        for angles in TwoLinks::of(self).branches(&target.position_m)? {
            match self.accept(self.facing(angles, target.yaw_rad), seed) {
                Ok(solution) => solutions.push(solution),
                Err(new) => error = Some(closer_error(error, new)),
            }
        }
        match (solutions.is_empty(), error) {
            (true, Some(error)) => Err(error),
            _ => Ok(solutions),
        }
    }

    fn continues_or_is_clear(&self, angles: &Joints, seed: &Joints) -> bool {
        angles.largest_difference(seed) <= MAX_CONTINUOUS_STEP_RAD
            || self.self_gap_m(angles, 1.0) >= SELF_GAP_M
    }

    /// Shifts `angles` by full turns as close to `seed` as the ranges permit, and accepts them if they are within the
    /// ranges and not singular.
    fn accept(&self, mut angles: Joints, seed: &Joints) -> Result<Solution, ReachError> {
        for (joint, angle) in angles.iter_mut().enumerate() {
            let [low, high] = self.joints[joint].range_rad;
            *angle = if self.joints[joint].continuous {
                let seed = seed[joint].clamp(low, high);
                let turned = *angle + TAU * libm::round((seed - *angle) / TAU);
                turned - TAU * f64::from(turned > high) + TAU * f64::from(turned < low)
            } else {
                angle.rem_euclid(TAU)
            };
            if !(low..=high).contains(angle) {
                let range_rad = [low, high];
                return Err(ReachError::JointRange { joint, angle_rad: *angle, range_rad });
            }
        }
        let forward = ForwardKinematics::new(self, &angles);
        let manipulability_m = manipulability_m(&forward.position_jacobian());
        if manipulability_m < MIN_MANIPULABILITY_M {
            return Err(ReachError::Singular { manipulability_m });
        }
        Ok(Solution { angles, tilt_rad: forward.tilt_rad(), manipulability_m })
    }

    /// Completes joints 1 to 3 with the angle of joint 4 that rotates the fingers as close to `yaw_rad` as possible.
    fn facing(&self, [q1, q2, q3]: [f64; 3], yaw_rad: f64) -> Joints {
        let forward = ForwardKinematics::new(self, &Joints::new(&[q1, q2, q3, 0.0]));
        let (sin, cos) = libm::sincos(yaw_rad);
        let wanted = forward.joint_rotation(3).inverse() * Vector3::new(cos, sin, 0.0);
        // The fingers close along the joint's y axis, which joint 4 rotates towards its negative x axis.
        Joints::new(&[q1, q2, q3, libm::atan2(-wanted.x, wanted.y)])
    }
}

/// An arm with four joints as two links in a vertical plane.
struct TwoLinks {
    shoulder_z_m: f64,
    /// Distance of the plane from the base's axis.
    aside_m: f64,
    upper_m: f64,
    fore_m: f64,
}

impl TwoLinks {
    fn of(model: &ArmModel) -> Self {
        let origin_m = |joint: usize| model.joints[joint].origin_m();
        let lengths = model.plane_lengths_m();
        Self {
            shoulder_z_m: lengths.shoulder_height_m,
            aside_m: origin_m(1).y + origin_m(3).z,
            upper_m: lengths.upper_arm_m,
            fore_m: lengths.forearm_m + lengths.hand_m,
        }
    }

    /// Returns joints 1 to 3 of every solution, radians, regardless of their ranges.
    fn branches(&self, target_m: &Point3<f64>) -> Result<Vec<[f64; 3]>, ReachError> {
        let from_axis_m = libm::hypot(target_m.x, target_m.y);
        let squared = from_axis_m * from_axis_m - self.aside_m * self.aside_m;
        if squared <= 0.0 {
            let least_m = self.aside_m.abs();
            return Err(ReachError::TooNear { distance_m: from_axis_m, least_m });
        }
        let (ahead_m, up_m) = (squared.sqrt(), target_m.z - self.shoulder_z_m);
        let bend_rad = self.bend_rad(libm::hypot(ahead_m, up_m))?;
        let mut branches = Vec::with_capacity(4);
        for ahead_m in [ahead_m, -ahead_m] {
            let q1 = libm::atan2(
                self.aside_m * target_m.x + ahead_m * target_m.y,
                self.aside_m * target_m.y - ahead_m * target_m.x,
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

    /// Returns the angle between the links for a tool at `distance_m` from the shoulder, in the plane (law of cosines).
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

fn squared_distance(angles: &Joints, other: &Joints) -> f64 {
    angles.iter().zip(other.iter()).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// Returns the more informative error of two: the least singular configuration, then the smallest excess of a range.
fn closer_error(known: Option<ReachError>, new: ReachError) -> ReachError {
    let rank = |error: &ReachError| match error {
        ReachError::Singular { manipulability_m } => (0, -manipulability_m),
        ReachError::JointRange { angle_rad, range_rad: [low, high], .. } => {
            (1, (low - angle_rad).max(angle_rad - high))
        }
        _ => (2, 0.0),
    };
    match known {
        Some(known) => {
            let ((kind, by), (new_kind, new_by)) = (rank(&known), rank(&new));
            if kind.cmp(&new_kind).then(by.total_cmp(&new_by)).is_le() { known } else { new }
        }
        None => new,
    }
}
