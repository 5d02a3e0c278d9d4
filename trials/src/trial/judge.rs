//! How a trial ended, judged by where the objects are.

use glam::DVec3;
use tandem_core::layout::GOAL_TOLERANCE_M;
use tandem_core::{Contacts, Task};
use tandem_kinematics::{PlanError, Refusal};

use tandem_bridge::executor::{StartError, Stop};

/// Raised by more than this an object was lifted, metres.
const LIFTED_M: f64 = 0.03;
/// Farther than this from the centre of its arm's workspace, along x or y, an object is out of reach, metres.
const REACH_M: f64 = 0.27;

/// Why a trial failed.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Cause {
    /// The motion could not be planned, or the check refused it: nothing moved.
    Refused(RefusedBy),
    /// The envelope stopped the arms.
    Stopped(Stop),
    /// Parts of both arms touched.
    ArmsTouched,
    /// An arm touched the table.
    TableTouched,
    /// The time was over before the policy was done.
    TimedOut,
    /// An object fell from the gripper or out of reach.
    ObjectLost,
    /// An object is too far from its goal.
    NotReached,
}

/// Who refused a motion.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RefusedBy {
    /// No trajectory leads there.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// The check of the whole motion.
    #[error(transparent)]
    Check(#[from] Refusal),
    /// The executor, before it started.
    #[error("{0}")]
    Start(String),
}

impl From<StartError> for RefusedBy {
    fn from(error: StartError) -> Self {
        match error {
            StartError::Refused(refusal) => Self::Check(refusal),
            other => Self::Start(other.to_string()),
        }
    }
}

impl Cause {
    /// The cause's name in tables and files.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Refused(_) => "refused",
            Self::Stopped(_) => "stopped",
            Self::ArmsTouched => "arms-touched",
            Self::TableTouched => "table-touched",
            Self::TimedOut => "timed-out",
            Self::ObjectLost => "object-lost",
            Self::NotReached => "not-reached",
        }
    }

    /// Every name, in the order of the table.
    pub const NAMES: [&'static str; 7] = [
        "not-reached",
        "object-lost",
        "timed-out",
        "arms-touched",
        "table-touched",
        "refused",
        "stopped",
    ];

    /// What there is to say beyond the name.
    #[must_use]
    pub fn detail(&self) -> Option<String> {
        match self {
            Self::Refused(by) => Some(by.to_string()),
            Self::Stopped(stop) => Some(stop.to_string()),
            _ => None,
        }
    }
}

/// What happened to one object; own frame of its arm, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObjectCourse {
    /// Where it lay at first.
    pub start: DVec3,
    /// Where it shall be.
    pub goal: DVec3,
    /// Where it ended.
    pub end: DVec3,
    /// The highest it was.
    pub highest_m: f64,
}

impl ObjectCourse {
    /// How far it ended from its goal, metres.
    #[must_use]
    pub fn goal_distance_m(&self) -> f64 {
        (self.end - self.goal).length()
    }

    fn lost(&self, task: Task) -> bool {
        let fell = self.highest_m - self.start.z > LIFTED_M
            && self.end.z - self.start.z < 0.5 * LIFTED_M
            && task == Task::PickAndPlace;
        let away = self.end.x.abs().max(self.end.y.abs()) > REACH_M;
        fell || away || self.end.z < 0.0
    }
}

/// What arms may not do, however the trial ends.
pub(crate) fn forbidden(touched: Contacts) -> Option<Cause> {
    if touched.contains(Contacts::ARM_ARM) {
        Some(Cause::ArmsTouched)
    } else if touched.contains(Contacts::ARM_TABLE) {
        Some(Cause::TableTouched)
    } else {
        None
    }
}

/// What became of a trial that was carried out to its end or to `time_over`; `None` is success.
pub(crate) fn judge(task: Task, objects: &[ObjectCourse], time_over: bool) -> Option<Cause> {
    let missed = |object: &&ObjectCourse| object.goal_distance_m() > f64::from(GOAL_TOLERANCE_M);
    let mut missed = objects.iter().filter(missed).peekable();
    missed.peek()?;
    if missed.any(|object| object.lost(task)) {
        Some(Cause::ObjectLost)
    } else if time_over {
        Some(Cause::TimedOut)
    } else {
        Some(Cause::NotReached)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_touch_counts_before_the_stop_that_it_leads_to() {
        let both = Contacts::ARM_ARM | Contacts::ARM_TABLE;
        assert_eq!(forbidden(both), Some(Cause::ArmsTouched));
        assert_eq!(forbidden(Contacts::ARM_TABLE), Some(Cause::TableTouched));
        assert_eq!(forbidden(Contacts::NONE), None);
    }

    #[test]
    fn an_object_that_fell_is_lost_and_one_that_lies_elsewhere_was_not_brought() {
        let course = |end: DVec3, highest_m| ObjectCourse {
            start: DVec3::new(0.0, 0.0, 0.0225),
            goal: DVec3::new(0.1, 0.0, 0.2),
            end,
            highest_m,
        };
        let check = |object: ObjectCourse, time_over, expected: Option<Cause>| {
            assert_eq!(judge(Task::PickAndPlace, &[object], time_over), expected);
        };
        check(course(DVec3::new(0.1, 0.03, 0.18), 0.2), false, None);
        check(course(DVec3::new(0.05, 0.0, 0.0225), 0.15), false, Some(Cause::ObjectLost));
        check(course(DVec3::new(0.0, 0.0, 0.0225), 0.0225), false, Some(Cause::NotReached));
        check(course(DVec3::new(0.0, 0.0, 0.0225), 0.0225), true, Some(Cause::TimedOut));
        check(course(DVec3::new(0.4, 0.0, 0.0225), 0.0225), true, Some(Cause::ObjectLost));
    }
}
