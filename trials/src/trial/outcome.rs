//! The outcome of a trial, determined from the final positions of the objects.

use glam::DVec3;
use tandem_core::{Contacts, Task};
use tandem_kinematics::{PlanError, Refusal};

use tandem_bridge::executor::{StartError, Stop};

/// An object that rises by more than this was lifted, metres.
const LIFT_THRESHOLD_M: f64 = 0.03;
/// An object farther than this from the origin of its arm's frame, along x or y, is out of reach, metres. In the shared
/// world the origin is not the workspace's centre, and an object between workspace and base counts as within reach.
const REACH_M: f64 = 0.27;

/// The cause of a failed trial.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum FailureCause {
    /// The motion could not be planned, or the check refused it. Nothing moved.
    Refused(MotionRefusal),
    /// The rehearsal on a copy of the pair ended with this cause, so the pair has no motion. Nothing moved.
    NotRehearsed(Box<Self>),
    /// The executor stopped the arms, for example because a command did not pass the envelope.
    Stopped(Stop),
    /// Parts of both arms touched.
    ArmsTouched,
    /// An arm touched the table.
    TableTouched,
    /// The time limit passed before the policy was done.
    TimedOut,
    /// An object fell from the gripper or out of reach.
    ObjectLost,
    /// An object is too far from its goal.
    NotReached,
    /// The objects are at their goals, but another condition of the task does not hold or did not hold for long enough.
    ConditionUnmet,
}

/// The reason why a motion was refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MotionRefusal {
    /// No trajectory leads through the waypoints.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// The check refused the motion.
    #[error(transparent)]
    Check(#[from] Refusal),
    /// The executor refused to start the motion.
    #[error("{0}")]
    Start(String),
}

impl From<StartError> for MotionRefusal {
    fn from(error: StartError) -> Self {
        match error {
            StartError::Refused(refusal) => Self::Check(refusal),
            other => Self::Start(other.to_string()),
        }
    }
}

impl FailureCause {
    /// Returns the cause's name in tables and files.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Refused(_) => "refused",
            Self::NotRehearsed(_) => "not-rehearsed",
            Self::Stopped(_) => "stopped",
            Self::ArmsTouched => "arms-touched",
            Self::TableTouched => "table-touched",
            Self::TimedOut => "timed-out",
            Self::ObjectLost => "object-lost",
            Self::NotReached => "not-reached",
            Self::ConditionUnmet => "condition-unmet",
        }
    }

    /// All names, in the order of the table.
    pub const NAMES: [&'static str; 9] = [
        "not-reached",
        "condition-unmet",
        "object-lost",
        "timed-out",
        "arms-touched",
        "table-touched",
        "refused",
        "not-rehearsed",
        "stopped",
    ];

    /// Returns the details beyond the name, if there are any.
    #[must_use]
    pub fn detail(&self) -> Option<String> {
        match self {
            Self::Refused(by) => Some(by.to_string()),
            Self::NotRehearsed(cause) => Some(cause.detail().map_or_else(
                || cause.name().to_owned(),
                |detail| format!("{} in the rehearsal: {detail}", cause.name()),
            )),
            Self::Stopped(stop) => Some(stop.to_string()),
            _ => None,
        }
    }
}

/// The result of one object; frame of its arm, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObjectResult {
    /// The initial position.
    pub start: DVec3,
    /// The goal.
    pub goal: DVec3,
    /// The final position.
    pub end: DVec3,
    /// The largest height.
    pub highest_m: f64,
}

impl ObjectResult {
    /// The final distance from the goal, metres.
    #[must_use]
    pub fn goal_distance_m(&self) -> f64 {
        (self.end - self.goal).length()
    }

    fn lost(&self, task: Task) -> bool {
        let fell = self.highest_m - self.start.z > LIFT_THRESHOLD_M
            && self.end.z - self.start.z < 0.5 * LIFT_THRESHOLD_M
            && task.grasps();
        let away = self.end.x.abs().max(self.end.y.abs()) > REACH_M;
        fell || away || self.end.z < 0.0
    }
}

/// Returns the failure that a contact of the arms causes, regardless of how the trial ends.
pub(crate) fn contact_failure(touched: Contacts) -> Option<FailureCause> {
    if touched.contains(Contacts::ARM_ARM) {
        Some(FailureCause::ArmsTouched)
    } else if touched.contains(Contacts::ARM_TABLE) {
        Some(FailureCause::TableTouched)
    } else {
        None
    }
}

/// Returns the failure of a trial that was carried out to its end or timed out; `None` is success. An object has
/// reached its goal up to a distance of `tolerance_m`.
pub(crate) fn object_failure(
    task: Task,
    objects: &[ObjectResult],
    tolerance_m: f64,
    timed_out: bool,
) -> Option<FailureCause> {
    let missed = |object: &&ObjectResult| object.goal_distance_m() > tolerance_m;
    let mut missed = objects.iter().filter(missed).peekable();
    missed.peek()?;
    if missed.any(|object| object.lost(task)) {
        Some(FailureCause::ObjectLost)
    } else if timed_out {
        Some(FailureCause::TimedOut)
    } else {
        Some(FailureCause::NotReached)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_contact_takes_precedence_over_the_stop_that_it_causes() {
        let both = Contacts::ARM_ARM | Contacts::ARM_TABLE;
        assert_eq!(contact_failure(both), Some(FailureCause::ArmsTouched));
        assert_eq!(contact_failure(Contacts::ARM_TABLE), Some(FailureCause::TableTouched));
        assert_eq!(contact_failure(Contacts::NONE), None);
    }

    #[test]
    fn an_object_that_fell_is_lost_and_one_elsewhere_has_not_reached_its_goal() {
        let object = |end: DVec3, highest_m| ObjectResult {
            start: DVec3::new(0.0, 0.0, 0.0225),
            goal: DVec3::new(0.1, 0.0, 0.2),
            end,
            highest_m,
        };
        let check = |object: ObjectResult, timed_out, expected: Option<FailureCause>| {
            assert_eq!(object_failure(Task::PickAndPlace, &[object], 0.05, timed_out), expected);
        };
        check(object(DVec3::new(0.1, 0.03, 0.18), 0.2), false, None);
        check(object(DVec3::new(0.05, 0.0, 0.0225), 0.15), false, Some(FailureCause::ObjectLost));
        check(object(DVec3::new(0.0, 0.0, 0.0225), 0.0225), false, Some(FailureCause::NotReached));
        check(object(DVec3::new(0.0, 0.0, 0.0225), 0.0225), true, Some(FailureCause::TimedOut));
        check(object(DVec3::new(0.4, 0.0, 0.0225), 0.0225), true, Some(FailureCause::ObjectLost));
    }
}
