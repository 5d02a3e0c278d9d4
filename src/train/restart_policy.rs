//! Decides which processes are restarted after they have ended, and when. Pure: the uptime is an argument.

use std::time::Duration;

use crate::exit::Exit;
use crate::launch::ProcessEnd;

/// A process that ends sooner counts as a failed start.
const MIN_UPTIME: Duration = Duration::from_secs(10);
/// Number of failed starts in a row after which a process is given up.
const MAX_FAILED_STARTS: u32 = 5;
/// Pause before the second failed start in a row is repeated; doubled each time.
const FIRST_PAUSE: Duration = Duration::from_millis(200);
const MAX_PAUSE: Duration = Duration::from_secs(1);
/// Pause before a worker that exited with 0 is restarted. A worker exits so at the end of the run, which is known here
/// by then.
const FINISHED_WORKER_PAUSE: Duration = Duration::from_secs(3);

/// The role of a process in a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Role {
    Teacher,
    Learner,
    Worker,
}

impl Role {
    /// Returns the name of the subcommand.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Teacher => "teacher",
            Self::Learner => "learner",
            Self::Worker => "worker",
        }
    }
}

/// The consequence of the end of a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Decision {
    /// The process is restarted.
    Restart { after: Duration },
    /// The process was interrupted by a signal and has saved its state: the run is interrupted.
    Interrupted,
    /// A restart would not help: the run ends with this exit code.
    Fail(Exit),
    /// The process has failed to start too often: the run ends.
    GiveUp { n_times: u32 },
}

/// Counts the failed starts of one process.
#[derive(Debug)]
pub(super) struct RestartPolicy {
    role: Role,
    n_failed_starts: u32,
}

impl RestartPolicy {
    pub(super) const fn new(role: Role) -> Self {
        Self { role, n_failed_starts: 0 }
    }

    /// Decides what follows from the end of the process after `uptime`.
    pub(super) fn decide(&mut self, end: ProcessEnd, uptime: Duration) -> Decision {
        match (self.role, end) {
            (_, ProcessEnd::Code(64)) => return Decision::Fail(Exit::Usage),
            (_, ProcessEnd::Code(65)) => return Decision::Fail(Exit::Data),
            (Role::Learner, ProcessEnd::Code(70)) => return Decision::Fail(Exit::Bug),
            (Role::Learner, ProcessEnd::Code(130)) => return Decision::Interrupted,
            // A learner that shuts down reports to its workers that the run is over.
            (Role::Worker, ProcessEnd::Code(0)) => {
                return Decision::Restart { after: FINISHED_WORKER_PAUSE };
            }
            _ => (),
        }
        // A learner ends with 75 if its last state cannot be written: to learn it again does not help.
        let is_futile = (self.role, end) == (Role::Learner, ProcessEnd::Code(75));
        self.n_failed_starts =
            if uptime < MIN_UPTIME || is_futile { self.n_failed_starts + 1 } else { 0 };
        match self.n_failed_starts {
            n_times @ MAX_FAILED_STARTS.. => Decision::GiveUp { n_times },
            0 | 1 => Decision::Restart { after: Duration::ZERO },
            n => Decision::Restart { after: (FIRST_PAUSE * (1 << (n - 2))).min(MAX_PAUSE) },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KILLED: ProcessEnd = ProcessEnd::Signal(9);
    const AT_ONCE: Decision = Decision::Restart { after: Duration::ZERO };

    const fn after_millis(millis: u64) -> Decision {
        Decision::Restart { after: Duration::from_millis(millis) }
    }

    /// Returns the decisions about a process that ends several times.
    fn decisions(role: Role, ends: &[(ProcessEnd, u64)]) -> Vec<Decision> {
        let mut policy = RestartPolicy::new(role);
        ends.iter().map(|(end, secs)| policy.decide(*end, Duration::from_secs(*secs))).collect()
    }

    #[test]
    fn processes_killed_by_a_signal_or_missing_a_resource_are_restarted() {
        for role in [Role::Teacher, Role::Learner, Role::Worker] {
            for end in [KILLED, ProcessEnd::Signal(6), ProcessEnd::Code(75), ProcessEnd::Code(101)]
            {
                assert_eq!(decisions(role, &[(end, 60)]), [AT_ONCE], "{role:?} {end:?}");
            }
        }
        assert_eq!(decisions(Role::Worker, &[(ProcessEnd::Code(70), 60)]), [AT_ONCE]);
        assert_eq!(decisions(Role::Teacher, &[(ProcessEnd::Code(0), 60)]), [AT_ONCE]);
        assert_eq!(decisions(Role::Learner, &[(ProcessEnd::Code(0), 1)]), [AT_ONCE]);
        assert_eq!(decisions(Role::Worker, &[(ProcessEnd::Code(0), 1)]), [after_millis(3_000)]);
    }

    #[test]
    fn errors_that_a_restart_cannot_fix_end_the_run() {
        for role in [Role::Teacher, Role::Learner, Role::Worker] {
            assert_eq!(
                decisions(role, &[(ProcessEnd::Code(64), 60)]),
                [Decision::Fail(Exit::Usage)]
            );
            assert_eq!(
                decisions(role, &[(ProcessEnd::Code(65), 60)]),
                [Decision::Fail(Exit::Data)]
            );
        }
        assert_eq!(
            decisions(Role::Learner, &[(ProcessEnd::Code(70), 1)]),
            [Decision::Fail(Exit::Bug)]
        );
        assert_eq!(
            decisions(Role::Learner, &[(ProcessEnd::Code(130), 1)]),
            [Decision::Interrupted]
        );
    }

    #[test]
    fn a_process_is_given_up_after_five_failed_starts_in_a_row() {
        let pauses = [AT_ONCE, after_millis(200), after_millis(400), after_millis(800)];
        let given_up = Decision::GiveUp { n_times: 5 };
        assert_eq!(decisions(Role::Teacher, &[(KILLED, 9); 5])[..4], pauses);
        assert_eq!(decisions(Role::Teacher, &[(KILLED, 9); 5])[4], given_up);
        let mut ends = vec![(KILLED, 9); 4];
        ends.extend([(KILLED, 10), (KILLED, 1)]);
        assert_eq!(decisions(Role::Learner, &ends)[4..], [AT_ONCE, AT_ONCE]);
        let full_disk = [(ProcessEnd::Code(75), 3600); 5];
        assert_eq!(decisions(Role::Learner, &full_disk)[4], given_up);
    }
}
