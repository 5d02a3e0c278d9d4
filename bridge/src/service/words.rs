//! Names and numbers of what stops or refuses a motion, for programs; people read the sentences.

use tandem_kinematics::{Excess, PlanError, Reason};

use crate::executor::{CheckError, StopCause};

/// What was, what is allowed, and in which unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Numbers {
    pub(super) got: f64,
    /// `None` where there is no one number to compare with.
    pub(super) allowed: Option<f64>,
    pub(super) unit: &'static str,
}

/// The name of a cause, and its numbers.
pub(super) fn of_cause(cause: &StopCause) -> (&'static str, Option<Numbers>) {
    use StopCause as C;
    match cause {
        C::NotReset => ("not-reset", None),
        C::Requested => ("requested", None),
        C::ShutDown => ("shut-down", None),
        C::OwnerSilent(e) => ("owner-silent", numbers(e, "s")),
        C::OwnerLeft => ("owner-left", None),
        C::Late(e) => ("late", numbers(e, "s")),
        C::Driver(_) => ("driver", None),
        C::StateStale(e) => ("state-stale", numbers(e, "s")),
        C::StateOld(e) => ("state-old", numbers(e, "s")),
        C::SequenceJump { .. } => ("sequence-jump", None),
        C::TimeStands { stamp_s } => ("time-stands", number(*stamp_s, "s")),
        C::Frozen(angle) => ("frozen", number(*angle, "rad")),
        C::Shape { .. } => ("state-shape", None),
        C::StateNotFinite => ("state-not-finite", None),
        C::AngleJump(e) => ("angle-jump", numbers(e, "rad")),
        C::DriveFault => ("drive-fault", None),
        C::EmergencyStop => ("emergency-stop", None),
        C::ContactReported => ("contact", None),
        C::Torque(e) => ("torque", numbers(e, "N m")),
        C::CommandLost(e) => ("command-lost", numbers(e, "commands")),
        C::Tracking(e) => ("tracking", numbers(e, "rad")),
        C::NotSettled(e) => ("not-settled", numbers(e, "rad")),
        C::Overspeed(e) => ("overspeed", numbers(e, "rad/s")),
        C::CommandNotFinite => ("command-not-finite", None),
        C::JointSpeed(e) => ("joint-speed", numbers(e, "rad/s")),
        C::JointAcceleration(e) => ("joint-acceleration", numbers(e, "rad/s2")),
        C::JointRange(e) => ("joint-range", numbers(e, "rad")),
        C::ToolSpeed(e) => ("tool-speed", numbers(e, "m/s")),
        C::TableGap(e) => ("table-gap", numbers(e, "m")),
        C::ArmsGap(e) => ("arms-gap", numbers(e, "m")),
        C::SelfGap(e) => ("self-gap", numbers(e, "m")),
    }
}

/// What a check says: its name, the joint if there is one, and its numbers.
pub(super) struct Word {
    pub(super) name: &'static str,
    pub(super) joint: Option<usize>,
    pub(super) numbers: Option<Numbers>,
}

/// What the check has against a motion.
pub(super) fn of_check(error: &CheckError) -> Word {
    match error {
        CheckError::Refused(refusal) => of_reason(&refusal.reason),
        CheckError::RangeMargin { joint, excess, .. } => {
            word("range-margin", Some(*joint), numbers(excess, "rad"))
        }
    }
}

fn of_reason(reason: &Reason) -> Word {
    use Reason as R;
    match reason {
        R::Setting(..) => word("setting", None, None),
        R::Arms { .. } => word("arms", None, None),
        R::Joints { .. } => word("joints", None, None),
        R::Samples { .. } => word("samples", None, None),
        R::Duration(e) => word("duration", None, numbers(e, "s")),
        R::NotFinite => word("not-finite", None, None),
        R::Start(joint, e) => word("start", Some(*joint), numbers(e, "rad")),
        R::NotAtRest(joint, rate) => word("not-at-rest", Some(*joint), number(*rate, "rad/s")),
        R::JointRange(joint, angle, [low, high]) => {
            let allowed = if angle < low { *low } else { *high };
            let excess = Excess { got: *angle, allowed };
            word("joint-range", Some(*joint), numbers(&excess, "rad"))
        }
        R::JointSpeed(joint, e) => word("joint-speed", Some(*joint), numbers(e, "rad/s")),
        R::JointAcceleration(joint, e) => {
            word("joint-acceleration", Some(*joint), numbers(e, "rad/s2"))
        }
        R::GripperOpening(opening) => word("opening", None, number(*opening, "")),
        R::GripperSpeed(e) => word("opening-speed", None, numbers(e, "1/s")),
        R::ToolSpeed(e) => word("tool-speed", None, numbers(e, "m/s")),
        R::Reach(e) => word("reach", None, numbers(e, "m")),
        R::Tilt(e) => word("tilt", None, numbers(e, "rad")),
        R::TableGap(_, e) => word("table-gap", None, numbers(e, "m")),
        R::ArmsGap(_, _, e) => word("arms-gap", None, numbers(e, "m")),
        R::SelfGap(_, e) => word("self-gap", None, numbers(e, "m")),
        _ => word("limit", None, None),
    }
}

/// What speaks against a plan, and the way point and arm where there is one.
pub(super) fn of_plan(error: &PlanError) -> (Word, Option<usize>, Option<usize>) {
    use PlanError as P;
    match error {
        P::Setting { .. } => (word("setting", None, None), None, None),
        P::WaypointCount { .. } => (word("way-points", None, None), None, None),
        P::Arms { waypoint, .. } => (word("arms", None, None), Some(*waypoint), None),
        P::GripperOpening { waypoint, arm, gripper_opening: opening } => {
            (word("opening", None, number(*opening, "")), Some(*waypoint), Some(arm.0))
        }
        P::Step { waypoint, arm, step_m } => {
            let excess = Excess { got: *step_m, allowed: tandem_kinematics::plan::MAX_STEP_M };
            (word("step", None, numbers(&excess, "m")), Some(*waypoint), Some(arm.0))
        }
        P::Unreachable { waypoint, arm, .. } => {
            (word("unreachable", None, None), Some(*waypoint), Some(arm.0))
        }
        P::Jump { waypoint, arm, joint, jump_rad } => {
            let word = word("jump", Some(*joint), number(*jump_rad, "rad"));
            (word, Some(*waypoint), Some(arm.0))
        }
        _ => (word("plan", None, None), None, None),
    }
}

fn word(name: &'static str, joint: Option<usize>, numbers: Option<Numbers>) -> Word {
    Word { name, joint, numbers }
}

/// A wrapped value needs no bound to be told.
#[expect(clippy::unnecessary_wraps, reason = "so that the tables above read evenly")]
fn numbers(excess: &Excess, unit: &'static str) -> Option<Numbers> {
    Some(Numbers { got: excess.got, allowed: Some(excess.allowed), unit })
}

#[expect(clippy::unnecessary_wraps, reason = "so that the tables above read evenly")]
fn number(got: f64, unit: &'static str) -> Option<Numbers> {
    Some(Numbers { got, allowed: None, unit })
}
