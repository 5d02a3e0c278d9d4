//! Refusals of the check.

use tandem_core::ArmIndex;

/// The first limit that a motion violates.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("at {when_s:.3} s arm {}: {reason}", arm.0)]
pub struct Refusal {
    /// Time of the violation, seconds since the start of the motion.
    pub when_s: f64,
    /// The arm; the first one if two arms come too close.
    pub arm: ArmIndex,
    /// The violation.
    pub reason: Reason,
}

/// A value and the limit that it violates, in the unit of the variant that holds it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Excess {
    /// Value of the motion.
    pub got: f64,
    /// Limit.
    pub allowed: f64,
}

/// The violated limit. Joints are counted from 0 here and from 1 in messages, as Kinova does.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Reason {
    /// A setting of the check itself is out of its range: its name and value.
    #[error("the setting {0} is {1}, which is out of its range")]
    Setting(&'static str, f64),
    /// The motion, or the present position, has `got` arms instead of `expected`.
    #[error("the motion has {got} arms, the cell has {expected}")]
    Arms {
        /// Arms of the motion.
        got: usize,
        /// Arms of the cell.
        expected: usize,
    },
    /// A sample, or the present position, has another number of joints than the arm.
    #[error("{got} joints, expected {expected}")]
    Joints {
        /// Joints of the sample.
        got: usize,
        /// Joints of the arm.
        expected: usize,
    },
    /// The arm has another number of samples than the first one, or fewer than two.
    #[error("{got} samples, expected {expected}")]
    Samples {
        /// Samples of this arm.
        got: usize,
        /// Samples of the first arm, or two.
        expected: usize,
    },
    /// The motion takes too long or no time; seconds.
    #[error("the motion takes {} s, expected more than 0 and at most {} s", .0.got, .0.allowed)]
    Duration(Excess),
    /// An angle, a velocity or an opening is infinite or NaN.
    #[error("a number is not finite")]
    NotFinite,
    /// A joint is too far from the first sample; radians.
    #[error("joint {} is {:.2} degrees from the start of the motion, at most {:.2}",
        .0 + 1, .1.got.to_degrees(), .1.allowed.to_degrees())]
    Start(usize, Excess),
    /// A joint moves at the start or at the end; radians per second.
    #[error("joint {} moves at {:.3} degrees/s where the motion must rest", .0 + 1, .1.to_degrees())]
    NotAtRest(usize, f64),
    /// A joint leaves its range: its angle and the range; radians.
    #[error("joint {} is at {:.2} degrees, its range is {:.0} to {:.0}",
        .0 + 1, .1.to_degrees(), .2[0].to_degrees(), .2[1].to_degrees())]
    JointRange(usize, f64, [f64; 2]),
    /// A joint is too fast; radians per second.
    #[error("joint {} moves at {:.2} degrees/s, at most {:.2}",
        .0 + 1, .1.got.to_degrees(), .1.allowed.to_degrees())]
    JointSpeed(usize, Excess),
    /// A joint accelerates too much, or jumps; radians per second squared.
    #[error("joint {} accelerates by {:.1} degrees/s2, at most {:.1}",
        .0 + 1, .1.got.to_degrees(), .1.allowed.to_degrees())]
    JointAcceleration(usize, Excess),
    /// The gripper opening is not between 0 (closed) and 1 (open).
    #[error("the gripper opening is {0}, expected 0 to 1")]
    GripperOpening(f64),
    /// The gripper opening changes too fast; 1/s.
    #[error("the gripper opening changes by {:.3}/s, at most {:.3}/s", .0.got, .0.allowed)]
    GripperSpeed(Excess),
    /// The tool is too fast; metres per second.
    #[error("the tool moves at {:.4} m/s, at most {:.4}", .0.got, .0.allowed)]
    ToolSpeed(Excess),
    /// The tool is too far from the shoulder; metres.
    #[error("the tool is {:.4} m from the shoulder, at most {:.4}", .0.got, .0.allowed)]
    Reach(Excess),
    /// The gripper points too far from straight down; radians.
    #[error("the gripper tilts by {:.2} degrees, at most {:.2}",
        .0.got.to_degrees(), .0.allowed.to_degrees())]
    Tilt(Excess),
    /// A part of the arm, named, is too close to the table; metres.
    #[error("the {} is {:.2} mm above the table, at least {:.2}", .0, .1.got * 1e3, .1.allowed * 1e3)]
    TableGap(&'static str, Excess),
    /// Parts of two arms are too close to each other: the other arm, both parts; metres.
    #[error("the {} is {:.2} mm from the {} of arm {}, at least {:.2}",
        .1[0], .2.got * 1e3, .1[1], .0.0, .2.allowed * 1e3)]
    ArmsGap(ArmIndex, [&'static str; 2], Excess),
    /// Two parts of one arm, named, are too close to each other; metres.
    #[error("the {} is {:.2} mm from the arm's own {}, at least {:.2}",
        .0[1], .1.got * 1e3, .0[0], .1.allowed * 1e3)]
    SelfGap([&'static str; 2], Excess),
}

impl Reason {
    /// Returns the refusal of `arm` at `when_s` for this reason.
    pub(crate) fn at(self, arm: ArmIndex, when_s: f64) -> Refusal {
        Refusal { when_s, arm, reason: self }
    }
}
