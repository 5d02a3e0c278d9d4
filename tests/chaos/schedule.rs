//! The faults of a run and their times, as a pure function of a seed.

use std::collections::VecDeque;
use std::time::Duration;

/// A process of the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Target {
    Teacher,
    Learner,
    Worker(usize),
}

/// Connections that go through one proxy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Link {
    WorkerToLearner(usize),
    WorkerToTeacher(usize),
    LearnerToTeacher,
}

/// A temporary disturbance of a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Disturbance {
    /// Nothing is forwarded and connections stay open. Bytes sent meanwhile arrive afterwards.
    Blackhole,
    /// Requests arrive, answers do not.
    OneWay,
    /// The far end closes without notice to the near end. Connections are closed afterwards.
    HalfOpen,
    /// Connections are closed and new ones are refused.
    Refuse,
}

/// A fault of the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fault {
    /// Kills and immediately restarts a process.
    Kill(Target),
    /// Stops a process for a duration, then continues it.
    Stop(Target, Duration),
    /// Closes all connections of a link. New ones are accepted.
    Cut(Link),
    Disturb(Link, Disturbance, Duration),
}

impl Fault {
    /// Returns the duration of the fault.
    pub(crate) fn lasts(self) -> Duration {
        match self {
            Self::Kill(_) | Self::Cut(_) => Duration::ZERO,
            Self::Stop(_, lasts) | Self::Disturb(_, _, lasts) => lasts,
        }
    }
}

/// A fault and its time since the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Event {
    pub(crate) at: Duration,
    pub(crate) fault: Fault,
}

/// The faults of a batch. Each batch contains each entry once, in a new random order.
const BATCH: [Kind; 12] = [
    Kind::Kill(Role::Teacher),
    Kind::Kill(Role::Learner),
    Kind::Kill(Role::Worker),
    Kind::Kill(Role::Worker),
    Kind::Stop(Role::Teacher),
    Kind::Stop(Role::Learner),
    Kind::Stop(Role::Worker),
    Kind::Cut,
    Kind::Disturb(Disturbance::Blackhole),
    Kind::Disturb(Disturbance::OneWay),
    Kind::Disturb(Disturbance::HalfOpen),
    Kind::Disturb(Disturbance::Refuse),
];
/// Number of events in a batch, after which every kind of fault has occurred.
pub(crate) const BATCH_EVENTS: usize = BATCH.len();
/// Pause of all faults after a worker is killed, so that its recovery can be measured.
const QUIET_AFTER_WORKER_KILL: Duration = Duration::from_millis(1_500);
/// Shortest and longest duration of a fault.
const LASTS_MILLIS: (u64, u64) = (500, 6_000);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Kill(Role),
    Stop(Role),
    Cut,
    Disturb(Disturbance),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    Teacher,
    Learner,
    Worker,
}

/// An endless schedule.
#[derive(Debug, Clone)]
pub(crate) struct Schedule {
    random: Random,
    n_workers: usize,
    every: Duration,
    batch: VecDeque<Kind>,
    next_at: Duration,
    /// Time at which every fault so far is over.
    over_at: Duration,
}

impl Schedule {
    /// Creates a schedule with a fault every `every` for a run with `n_workers`. Kills of workers are delayed until no
    /// other fault is active.
    pub(crate) fn new(seed: u64, n_workers: usize, every: Duration) -> Self {
        Self {
            random: Random(seed),
            n_workers,
            every,
            batch: VecDeque::new(),
            next_at: every,
            over_at: Duration::ZERO,
        }
    }

    fn fault(&mut self, kind: Kind) -> Fault {
        match kind {
            Kind::Kill(role) => Fault::Kill(self.target(role)),
            Kind::Stop(role) => Fault::Stop(self.target(role), self.lasts()),
            Kind::Cut => Fault::Cut(self.link()),
            Kind::Disturb(how) => Fault::Disturb(self.link(), how, self.lasts()),
        }
    }

    fn target(&mut self, role: Role) -> Target {
        match role {
            Role::Teacher => Target::Teacher,
            Role::Learner => Target::Learner,
            Role::Worker => Target::Worker(self.random.below(self.n_workers)),
        }
    }

    fn link(&mut self) -> Link {
        match self.random.below(3) {
            0 => Link::WorkerToLearner(self.random.below(self.n_workers)),
            1 => Link::WorkerToTeacher(self.random.below(self.n_workers)),
            _ => Link::LearnerToTeacher,
        }
    }

    fn lasts(&mut self) -> Duration {
        let (shortest, longest) = LASTS_MILLIS;
        Duration::from_millis(shortest + self.random.next() % (longest - shortest + 1))
    }
}

impl Iterator for Schedule {
    type Item = Event;

    fn next(&mut self) -> Option<Event> {
        if self.batch.is_empty() {
            let mut batch = BATCH;
            self.random.shuffle(&mut batch);
            if self.over_at.is_zero() {
                kill_each_first(&mut batch);
            }
            self.batch.extend(batch);
        }
        let fault = self.batch.pop_front().map(|kind| self.fault(kind))?;
        let kills_worker = matches!(fault, Fault::Kill(Target::Worker(_)));
        let at = if kills_worker { self.next_at.max(self.over_at) } else { self.next_at };
        self.over_at = self.over_at.max(at + fault.lasts());
        let pause = if kills_worker { QUIET_AFTER_WORKER_KILL } else { Duration::ZERO };
        self.next_at = at + self.every.max(pause);
        Some(Event { at, fault })
    }
}

/// Puts a kill of each kind of process first: on a fast machine the run is complete before its first batch is.
fn kill_each_first(batch: &mut [Kind]) {
    for (idx, role) in [Role::Teacher, Role::Learner, Role::Worker].into_iter().enumerate() {
        let at = batch.iter().position(|kind| *kind == Kind::Kill(role)).expect("in each batch");
        batch.swap(idx, at);
    }
}

/// SplitMix64.
#[derive(Debug, Clone)]
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut bits = self.0;
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        bits ^ (bits >> 31)
    }

    #[expect(clippy::cast_possible_truncation, reason = "smaller than the bound")]
    fn below(&mut self, bound: usize) -> usize {
        (self.next() % bound as u64) as usize
    }

    fn shuffle<T>(&mut self, items: &mut [T]) {
        for last in (1..items.len()).rev() {
            items.swap(last, self.below(last + 1));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    const EVERY: Duration = Duration::from_secs(2);

    fn events(seed: u64, n: usize) -> Vec<Event> {
        Schedule::new(seed, 4, EVERY).take(n).collect()
    }

    #[test]
    fn a_seed_determines_the_schedule() {
        assert_eq!(events(7, 200), events(7, 200));
        assert_ne!(events(7, 20), events(8, 20));
    }

    #[test]
    fn every_batch_contains_every_kind_of_fault() {
        for batch in events(1, 20 * BATCH_EVENTS).chunks(BATCH_EVENTS) {
            let names: BTreeSet<String> = batch
                .iter()
                .map(|event| match event.fault {
                    Fault::Kill(target) | Fault::Stop(target, _) => {
                        let is_stop = matches!(event.fault, Fault::Stop(..));
                        let worker = matches!(target, Target::Worker(_));
                        let target = if worker { Target::Worker(0) } else { target };
                        format!("{target:?} {is_stop}")
                    }
                    Fault::Cut(_) => "cut".to_owned(),
                    Fault::Disturb(_, how, _) => format!("{how:?}"),
                })
                .collect();
            assert_eq!(
                names.len(),
                BATCH_EVENTS - 1,
                "two faults of a batch kill a worker: {names:?}"
            );
        }
    }

    #[test]
    fn every_worker_and_link_is_disturbed() {
        let mut targets = BTreeSet::new();
        let mut links = BTreeSet::new();
        for event in events(3, 600) {
            match event.fault {
                Fault::Kill(target) | Fault::Stop(target, _) => drop(targets.insert(target)),
                Fault::Cut(link) | Fault::Disturb(link, ..) => drop(links.insert(link)),
            }
        }
        assert_eq!((targets.len(), links.len()), (6, 9));
    }

    #[test]
    fn faults_keep_their_interval_and_spare_the_successor_of_a_killed_worker() {
        let events = events(11, 500);
        let mut over_at = Duration::ZERO;
        for (event, next) in events.iter().zip(&events[1..]) {
            let (from, to) = LASTS_MILLIS;
            let lasts = event.fault.lasts().as_millis();
            assert!(lasts == 0 || (u128::from(from)..=u128::from(to)).contains(&lasts));
            assert!(next.at >= event.at + EVERY);
            if matches!(event.fault, Fault::Kill(Target::Worker(_))) {
                assert!(event.at >= over_at && next.at >= event.at + QUIET_AFTER_WORKER_KILL);
            }
            over_at = over_at.max(event.at + event.fault.lasts());
        }
    }
}
