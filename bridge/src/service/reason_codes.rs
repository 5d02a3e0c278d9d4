//! Machine-readable codes and values of stops and refusals. The texts for people are the errors' messages.

use tandem_kinematics::{Excess, PlanError, Reason};

use crate::executor::{CheckError, StopCause};

/// A value, its limit and their unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Values {
    pub(super) got: f64,
    /// `None` if no single limit applies.
    pub(super) allowed: Option<f64>,
    pub(super) unit: &'static str,
}

/// Returns the code of a cause and its values.
pub(super) fn of_cause(cause: &StopCause) -> (&'static str, Option<Values>) {
    use StopCause as C;
    match cause {
        C::NotReset => ("not-reset", None),
        C::Requested => ("requested", None),
        C::ShutDown => ("shut-down", None),
        C::OwnerSilent(e) => ("owner-silent", values(e, "s")),
        C::OwnerReleased => ("owner-left", None),
        C::TickLate(e) => ("late", values(e, "s")),
        C::Driver(_) => ("driver", None),
        C::StateStale(e) => ("state-stale", values(e, "s")),
        C::StateDelayed(e) => ("state-old", values(e, "s")),
        C::SequenceJump { .. } => ("sequence-jump", None),
        C::StampNotAdvancing { stamp_s } => ("time-stands", number(*stamp_s, "s")),
        C::Frozen(angle) => ("frozen", number(*angle, "rad")),
        C::Shape { .. } => ("state-shape", None),
        C::StateNotFinite => ("state-not-finite", None),
        C::AngleJump(e) => ("angle-jump", values(e, "rad")),
        C::DriveFault => ("drive-fault", None),
        C::EmergencyStop => ("emergency-stop", None),
        C::ContactReported => ("contact", None),
        C::Torque(e) => ("torque", values(e, "N m")),
        C::CommandLost(e) => ("command-lost", values(e, "commands")),
        C::Tracking(e) => ("tracking", values(e, "rad")),
        C::NotSettled(e) => ("not-settled", values(e, "rad")),
        C::Overspeed(e) => ("overspeed", values(e, "rad/s")),
        C::CommandNotFinite => ("command-not-finite", None),
        C::JointSpeed(e) => ("joint-speed", values(e, "rad/s")),
        C::JointAcceleration(e) => ("joint-acceleration", values(e, "rad/s2")),
        C::JointRange(e) => ("joint-range", values(e, "rad")),
        C::ToolSpeed(e) => ("tool-speed", values(e, "m/s")),
        C::TableGap(e) => ("table-gap", values(e, "m")),
        C::ArmsGap(e) => ("arms-gap", values(e, "m")),
        C::SelfGap(e) => ("self-gap", values(e, "m")),
    }
}

/// The code of a refusal, its joint if there is one, and its values.
pub(super) struct ReasonCode {
    pub(super) name: &'static str,
    pub(super) joint: Option<usize>,
    pub(super) values: Option<Values>,
}

/// Returns the code of a failed check.
pub(super) fn of_check(error: &CheckError) -> ReasonCode {
    match error {
        CheckError::Refused(refusal) => of_reason(&refusal.reason),
        CheckError::RangeMargin { joint, excess, .. } => {
            code("range-margin", Some(*joint), values(excess, "rad"))
        }
    }
}

fn of_reason(reason: &Reason) -> ReasonCode {
    use Reason as R;
    match reason {
        R::Setting(..) => code("setting", None, None),
        R::Arms { .. } => code("arms", None, None),
        R::Joints { .. } => code("joints", None, None),
        R::Samples { .. } => code("samples", None, None),
        R::Duration(e) => code("duration", None, values(e, "s")),
        R::NotFinite => code("not-finite", None, None),
        R::Start(joint, e) => code("start", Some(*joint), values(e, "rad")),
        R::NotAtRest(joint, rate) => code("not-at-rest", Some(*joint), number(*rate, "rad/s")),
        R::JointRange(joint, angle, [low, high]) => {
            let allowed = if angle < low { *low } else { *high };
            let excess = Excess { got: *angle, allowed };
            code("joint-range", Some(*joint), values(&excess, "rad"))
        }
        R::JointSpeed(joint, e) => code("joint-speed", Some(*joint), values(e, "rad/s")),
        R::JointAcceleration(joint, e) => {
            code("joint-acceleration", Some(*joint), values(e, "rad/s2"))
        }
        R::GripperOpening(opening) => code("opening", None, number(*opening, "")),
        R::GripperSpeed(e) => code("opening-speed", None, values(e, "1/s")),
        R::ToolSpeed(e) => code("tool-speed", None, values(e, "m/s")),
        R::Reach(e) => code("reach", None, values(e, "m")),
        R::Tilt(e) => code("tilt", None, values(e, "rad")),
        R::TableGap(_, e) => code("table-gap", None, values(e, "m")),
        R::ArmsGap(_, _, e) => code("arms-gap", None, values(e, "m")),
        R::SelfGap(_, e) => code("self-gap", None, values(e, "m")),
        _ => code("limit", None, None),
    }
}

/// Returns the code of a failed plan, and its waypoint and arm if there are any.
pub(super) fn of_plan(error: &PlanError) -> (ReasonCode, Option<usize>, Option<usize>) {
    use PlanError as P;
    match error {
        P::Setting { .. } => (code("setting", None, None), None, None),
        P::WaypointCount { .. } => (code("way-points", None, None), None, None),
        P::StartArms { .. } => (code("arms", None, None), None, None),
        P::StartJoints { arm, .. } => (code("joints", None, None), None, Some(arm.0)),
        P::Arms { waypoint, .. } => (code("arms", None, None), Some(*waypoint), None),
        P::GripperOpening { waypoint, arm, gripper_opening: opening } => {
            (code("opening", None, number(*opening, "")), Some(*waypoint), Some(arm.0))
        }
        P::Step { waypoint, arm, step_m } => {
            let excess = Excess { got: *step_m, allowed: tandem_kinematics::plan::MAX_STEP_M };
            (code("step", None, values(&excess, "m")), Some(*waypoint), Some(arm.0))
        }
        P::Unreachable { waypoint, arm, .. } => {
            (code("unreachable", None, None), Some(*waypoint), Some(arm.0))
        }
        P::Jump { waypoint, arm, joint, jump_rad } => {
            let code = code("jump", Some(*joint), number(*jump_rad, "rad"));
            (code, Some(*waypoint), Some(arm.0))
        }
        _ => (code("plan", None, None), None, None),
    }
}

fn code(name: &'static str, joint: Option<usize>, values: Option<Values>) -> ReasonCode {
    ReasonCode { name, joint, values }
}

#[expect(clippy::unnecessary_wraps, reason = "the tables above stay uniform")]
fn values(excess: &Excess, unit: &'static str) -> Option<Values> {
    Some(Values { got: excess.got, allowed: Some(excess.allowed), unit })
}

#[expect(clippy::unnecessary_wraps, reason = "the tables above stay uniform")]
fn number(got: f64, unit: &'static str) -> Option<Values> {
    Some(Values { got, allowed: None, unit })
}
