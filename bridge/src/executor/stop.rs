//! The causes of stops.

use std::fmt;

use tandem_core::ArmIndex;
use tandem_kinematics::Excess;

use crate::driver::DriverError;

/// The time, place and cause of a stop.
#[derive(Debug, Clone, PartialEq)]
pub struct Stop {
    /// The time of the stop by the clock of the executor's ticks, seconds.
    pub when_s: f64,
    /// The arm, if the cause concerns one.
    pub arm: Option<ArmIndex>,
    /// The joint, counted from 0, if the cause concerns one. Messages count from 1, as Kinova does.
    pub joint: Option<usize>,
    /// The cause.
    pub cause: StopCause,
}

/// The cause of a stop. An [`Excess`] holds the value and the limit, in the unit given with each cause.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum StopCause {
    /// The arms were not reset since the start.
    #[error("the arms were not reset since the start")]
    NotReset,
    /// A client requested the stop.
    #[error("a client stopped the arms")]
    Requested,
    /// The program that moves the arms shuts down.
    #[error("the program that moves the arms is shutting down")]
    ShutDown,
    /// The owner of a motion gave no sign of life; seconds.
    #[error("the owner was silent for {:.3} s, at most {:.3} s", .0.got, .0.allowed)]
    OwnerSilent(Excess),
    /// The owner released the arms during a motion.
    #[error("the owner released the arms during a motion")]
    OwnerReleased,
    /// A tick came too late; seconds.
    #[error("{:.3} s since the last command, at most {:.3} s", .0.got, .0.allowed)]
    TickLate(Excess),
    /// The driver failed.
    #[error("the driver failed")]
    Driver(#[source] DriverError),
    /// No new state has arrived; seconds.
    #[error("no new state for {:.3} s, at most {:.3} s", .0.got, .0.allowed)]
    StateStale(Excess),
    /// States arrive with a growing delay; seconds.
    #[error("the state is delayed by {:.3} s more than earlier states, at most {:.3} s", .0.got, .0.allowed)]
    StateDelayed(Excess),
    /// A state's sequence number does not follow the previous one.
    #[error("state number {got}, expected {expected}")]
    SequenceJump {
        /// The sequence number.
        got: u64,
        /// The sequence number that follows the previous one.
        expected: u64,
    },
    /// A new state has the same time stamp as the previous one, or an earlier one.
    #[error("the state's time did not advance: it is {stamp_s:.3} s")]
    StampNotAdvancing {
        /// The time stamp by the arms' clock, seconds.
        stamp_s: f64,
    },
    /// A joint is commanded to move and keeps reporting the same angle; radians.
    #[error("the angle stays at {:.3} degrees while the joint is commanded to move", .0.to_degrees())]
    Frozen(f64),
    /// The state has a different number of arms or joints.
    #[error("a state of {got} arms or joints, expected {expected}")]
    Shape {
        /// The number in the state.
        got: usize,
        /// The number in the work cell.
        expected: usize,
    },
    /// A number of a state is infinite or not a number.
    #[error("a number of the state is not finite")]
    StateNotFinite,
    /// An angle changed by more than the joint can move; radians.
    #[error("the angle changed by {:.2} degrees from one state to the next, at most {:.2}",
        .0.got.to_degrees(), .0.allowed.to_degrees())]
    AngleJump(Excess),
    /// The arm reports a fault of a drive.
    #[error("a drive reports a fault")]
    DriveFault,
    /// The emergency stop at the arm is pressed.
    #[error("the emergency stop is pressed")]
    EmergencyStop,
    /// A contact with the arm is reported.
    #[error("a contact is reported")]
    ContactReported,
    /// A torque indicates a contact with the arm; newton metres.
    #[error("an unexplained torque of {:.1} N m, at most {:.1}", .0.got, .0.allowed)]
    Torque(Excess),
    /// Commands take no effect; a count of commands.
    #[error("{:.0} commands without effect, at most {:.0}", .0.got, .0.allowed)]
    CommandLost(Excess),
    /// A joint is too far from the motion's reference; radians.
    #[error("{:.2} degrees from the motion's reference, at most {:.2}",
        .0.got.to_degrees(), .0.allowed.to_degrees())]
    Tracking(Excess),
    /// The arms did not settle at the motion's end; radians.
    #[error("{:.2} degrees from the goal after the motion's end, at most {:.2}",
        .0.got.to_degrees(), .0.allowed.to_degrees())]
    NotSettled(Excess),
    /// The measured speed of a joint is too high; radians per second.
    #[error("measured at {:.2} degrees/s, at most {:.2}",
        .0.got.to_degrees(), .0.allowed.to_degrees())]
    Overspeed(Excess),
    /// A number of the command is infinite or not a number, or an opening is outside 0 to 1.
    #[error("a number of the command is out of its range")]
    CommandNotFinite,
    /// The command is too fast for the joint; radians per second.
    #[error("commanded to {:.2} degrees/s, at most {:.2}",
        .0.got.to_degrees(), .0.allowed.to_degrees())]
    JointSpeed(Excess),
    /// The command accelerates the joint too much; radians per second squared.
    #[error("commanded to accelerate by {:.1} degrees/s2, at most {:.1}",
        .0.got.to_degrees(), .0.allowed.to_degrees())]
    JointAcceleration(Excess),
    /// The joint could not stop within its range: the angle at which it would stop, and the end of the range; radians.
    #[error("the joint would stop at {:.2} degrees, its range ends at {:.2}",
        .0.got.to_degrees(), .0.allowed.to_degrees())]
    JointRange(Excess),
    /// The command is too fast for the tool; metres per second.
    #[error("the tool would move at {:.4} m/s, at most {:.4}", .0.got, .0.allowed)]
    ToolSpeed(Excess),
    /// The arm is too near to the table, or would be before it can stop; metres.
    #[error("{:.2} mm above the table before it can stop, at least {:.2}",
        .0.got * 1e3, .0.allowed * 1e3)]
    TableGap(Excess),
    /// The arms are too near to each other, or would be before they can stop; metres.
    #[error("{:.2} mm from the other arm before both can stop, at least {:.2}",
        .0.got * 1e3, .0.allowed * 1e3)]
    ArmsGap(Excess),
    /// Parts of one arm are too near to each other, or would be before it can stop; metres.
    #[error("{:.2} mm between parts of the arm itself before it can stop, at least {:.2}",
        .0.got * 1e3, .0.allowed * 1e3)]
    SelfGap(Excess),
}

/// The cause of a stop and its place, without the time.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LocatedCause {
    pub(crate) arm: Option<ArmIndex>,
    pub(crate) joint: Option<usize>,
    pub(crate) cause: StopCause,
}

impl StopCause {
    pub(crate) fn anywhere(self) -> LocatedCause {
        LocatedCause { arm: None, joint: None, cause: self }
    }

    pub(crate) fn of(self, arm: usize) -> LocatedCause {
        LocatedCause { arm: Some(ArmIndex(arm)), joint: None, cause: self }
    }

    pub(crate) fn of_joint(self, arm: usize, joint: usize) -> LocatedCause {
        LocatedCause { arm: Some(ArmIndex(arm)), joint: Some(joint), cause: self }
    }
}

impl LocatedCause {
    pub(crate) fn at(self, when_s: f64) -> Stop {
        Stop { when_s, arm: self.arm, joint: self.joint, cause: self.cause }
    }
}

impl fmt::Display for Stop {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "at {:.3} s", self.when_s)?;
        if let Some(arm) = self.arm {
            write!(f, " arm {}", arm.0)?;
        }
        if let Some(joint) = self.joint {
            write!(f, " joint {}", joint + 1)?;
        }
        write!(f, ": {}", self.cause)?;
        if let StopCause::Driver(source) = &self.cause {
            write!(f, ": {source}")?;
        }
        Ok(())
    }
}

impl std::error::Error for Stop {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stop_displays_time_place_and_cause() {
        let excess = Excess { got: 0.05, allowed: 0.035 };
        let check = |stop: Stop, expected: &str| assert_eq!(stop.to_string(), expected);
        check(
            StopCause::Tracking(excess).of_joint(1, 2).at(1.5),
            "at 1.500 s arm 1 joint 3: 2.86 degrees from the motion's reference, at most 2.01",
        );
        check(StopCause::Requested.anywhere().at(0.25), "at 0.250 s: a client stopped the arms");
        check(
            StopCause::Driver(DriverError::Disconnected { what: "closed".into() })
                .anywhere()
                .at(2.0),
            "at 2.000 s: the driver failed: the arms are not connected: closed",
        );
    }
}
