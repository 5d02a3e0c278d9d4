//! Which processes that have ended are started again, and when. Pure: how long a process lived comes in as an argument.

use std::fmt;
use std::time::Duration;

use crate::exit::Exit;

/// A process that ends sooner after its start has not got going.
const GOT_GOING: Duration = Duration::from_secs(10);
/// A process that has not got going so often in a row is given up.
const MAX_FALSE_STARTS: u32 = 5;
/// Pause before a process that has not got going is started again; doubled from the second time on.
const FIRST_PAUSE: Duration = Duration::from_millis(200);
const LONGEST_PAUSE: Duration = Duration::from_secs(1);
/// A worker that was told of the run's end gets so long before it is missed: the run's end is heard of by then.
const WORKER_DONE_PAUSE: Duration = Duration::from_secs(3);

/// What a process does in a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Role {
    Teacher,
    Learner,
    Worker,
}

impl Role {
    /// The subcommand that does it.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Teacher => "teacher",
            Self::Learner => "learner",
            Self::Worker => "worker",
        }
    }
}

/// How a process ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum End {
    Code(i32),
    Signal(i32),
}

impl fmt::Display for End {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Code(0) => write!(formatter, "ended before the run"),
            Self::Code(code) => write!(formatter, "ended with exit code {code}"),
            Self::Signal(signal) => write!(formatter, "was killed by signal {signal}"),
        }
    }
}

/// What follows from the end of a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    /// It is started again.
    Again { after: Duration },
    /// Somebody asked it to end, and it has saved what it had: so ends the run.
    Interrupted,
    /// Starting it again would not help; the run ends with this exit code.
    Final(Exit),
    /// It does not get going: the run ends.
    GivenUp { n_times: u32 },
}

/// The false starts of one process.
#[derive(Debug)]
pub(super) struct Restarts {
    role: Role,
    n_false_starts: u32,
}

impl Restarts {
    pub(super) const fn new(role: Role) -> Self {
        Self { role, n_false_starts: 0 }
    }

    /// Decides what follows when the process has ended, `lived` after its start.
    pub(super) fn ended(&mut self, end: End, lived: Duration) -> Verdict {
        match (self.role, end) {
            (_, End::Code(64)) => return Verdict::Final(Exit::Usage),
            (_, End::Code(65)) => return Verdict::Final(Exit::Data),
            (Role::Learner, End::Code(70)) => return Verdict::Final(Exit::Bug),
            (Role::Learner, End::Code(130)) => return Verdict::Interrupted,
            // A learner that goes down in good order tells its workers that the run is over.
            (Role::Worker, End::Code(0)) => return Verdict::Again { after: WORKER_DONE_PAUSE },
            _ => (),
        }
        self.n_false_starts = if lived < GOT_GOING { self.n_false_starts + 1 } else { 0 };
        match self.n_false_starts {
            n_times @ MAX_FALSE_STARTS.. => Verdict::GivenUp { n_times },
            0 | 1 => Verdict::Again { after: Duration::ZERO },
            n => Verdict::Again { after: (FIRST_PAUSE * (1 << (n - 2))).min(LONGEST_PAUSE) },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KILLED: End = End::Signal(9);
    const AT_ONCE: Verdict = Verdict::Again { after: Duration::ZERO };

    const fn after_millis(millis: u64) -> Verdict {
        Verdict::Again { after: Duration::from_millis(millis) }
    }

    /// The verdicts on a process that ends so again and again.
    fn verdicts(role: Role, ends: &[(End, u64)]) -> Vec<Verdict> {
        let mut restarts = Restarts::new(role);
        ends.iter().map(|(end, secs)| restarts.ended(*end, Duration::from_secs(*secs))).collect()
    }

    #[test]
    fn who_dies_by_a_signal_or_for_want_of_something_is_started_again() {
        for role in [Role::Teacher, Role::Learner, Role::Worker] {
            for end in [KILLED, End::Signal(6), End::Code(75), End::Code(101)] {
                assert_eq!(verdicts(role, &[(end, 60)]), [AT_ONCE], "{role:?} {end:?}");
            }
        }
        assert_eq!(verdicts(Role::Worker, &[(End::Code(70), 60)]), [AT_ONCE]);
        assert_eq!(verdicts(Role::Teacher, &[(End::Code(0), 60)]), [AT_ONCE]);
        assert_eq!(verdicts(Role::Learner, &[(End::Code(0), 1)]), [AT_ONCE]);
        assert_eq!(verdicts(Role::Worker, &[(End::Code(0), 1)]), [after_millis(3_000)]);
    }

    #[test]
    fn what_starting_again_does_not_mend_ends_the_run() {
        for role in [Role::Teacher, Role::Learner, Role::Worker] {
            assert_eq!(verdicts(role, &[(End::Code(64), 60)]), [Verdict::Final(Exit::Usage)]);
            assert_eq!(verdicts(role, &[(End::Code(65), 60)]), [Verdict::Final(Exit::Data)]);
        }
        assert_eq!(verdicts(Role::Learner, &[(End::Code(70), 1)]), [Verdict::Final(Exit::Bug)]);
        assert_eq!(verdicts(Role::Learner, &[(End::Code(130), 1)]), [Verdict::Interrupted]);
    }

    #[test]
    fn five_false_starts_in_a_row_are_too_many() {
        let pauses = [AT_ONCE, after_millis(200), after_millis(400), after_millis(800)];
        let given_up = Verdict::GivenUp { n_times: 5 };
        assert_eq!(verdicts(Role::Teacher, &[(KILLED, 9); 5])[..4], pauses);
        assert_eq!(verdicts(Role::Teacher, &[(KILLED, 9); 5])[4], given_up);
        let mut ends = vec![(KILLED, 9); 4];
        ends.extend([(KILLED, 10), (KILLED, 1)]);
        assert_eq!(verdicts(Role::Learner, &ends)[4..], [AT_ONCE, AT_ONCE]);
    }
}
