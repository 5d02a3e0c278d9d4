//! What befalls a run, and when: a pure function of a seed.

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
pub(crate) enum Line {
    WorkerToLearner(usize),
    WorkerToTeacher(usize),
    LearnerToTeacher,
}

/// How a line is disturbed for a while.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Disturbance {
    /// Nothing is forwarded, connections stay open; what was sent arrives afterwards.
    Blackhole,
    /// Requests arrive, answers do not.
    OneWay,
    /// The far end is gone and the near end is not told; afterwards connections are closed.
    HalfOpen,
    /// Connections are closed and new ones refused.
    Refuse,
}

/// What befalls the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fault {
    /// Killed, and started again at once.
    Kill(Target),
    /// Stopped for so long, then continued.
    Stop(Target, Duration),
    /// All connections of a line are closed; new ones are taken.
    Cut(Line),
    Disturb(Line, Disturbance, Duration),
}

impl Fault {
    /// How long it lasts.
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

/// Faults of which every hand has each once, in an order drawn anew.
const HAND: [Kind; 12] = [
    Kind::Kill(Who::Teacher),
    Kind::Kill(Who::Learner),
    Kind::Kill(Who::Worker),
    Kind::Kill(Who::Worker),
    Kind::Stop(Who::Teacher),
    Kind::Stop(Who::Learner),
    Kind::Stop(Who::Worker),
    Kind::Cut,
    Kind::Disturb(Disturbance::Blackhole),
    Kind::Disturb(Disturbance::OneWay),
    Kind::Disturb(Disturbance::HalfOpen),
    Kind::Disturb(Disturbance::Refuse),
];
/// Events of a hand: after so many, every kind of fault has come.
pub(crate) const HAND_EVENTS: usize = HAND.len();
/// A killed worker's successor has the run for itself for so long, so that its recovery can be measured.
const QUIET_AFTER_WORKER_KILL: Duration = Duration::from_millis(4_000);
/// Shortest and longest duration of a fault.
const LASTS_MILLIS: (u64, u64) = (500, 6_000);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Kill(Who),
    Stop(Who),
    Cut,
    Disturb(Disturbance),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Who {
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
    hand: VecDeque<Kind>,
    next_at: Duration,
    /// When every fault so far is over.
    over_at: Duration,
}

impl Schedule {
    /// A fault every `every` on a run of `n_workers`; a worker's death is moved to where nothing else is the matter.
    pub(crate) fn new(seed: u64, n_workers: usize, every: Duration) -> Self {
        Self {
            random: Random(seed),
            n_workers,
            every,
            hand: VecDeque::new(),
            next_at: every,
            over_at: Duration::ZERO,
        }
    }

    fn fault(&mut self, kind: Kind) -> Fault {
        match kind {
            Kind::Kill(who) => Fault::Kill(self.target(who)),
            Kind::Stop(who) => Fault::Stop(self.target(who), self.lasts()),
            Kind::Cut => Fault::Cut(self.line()),
            Kind::Disturb(how) => Fault::Disturb(self.line(), how, self.lasts()),
        }
    }

    fn target(&mut self, who: Who) -> Target {
        match who {
            Who::Teacher => Target::Teacher,
            Who::Learner => Target::Learner,
            Who::Worker => Target::Worker(self.random.below(self.n_workers)),
        }
    }

    fn line(&mut self) -> Line {
        match self.random.below(3) {
            0 => Line::WorkerToLearner(self.random.below(self.n_workers)),
            1 => Line::WorkerToTeacher(self.random.below(self.n_workers)),
            _ => Line::LearnerToTeacher,
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
        if self.hand.is_empty() {
            let mut hand = HAND;
            self.random.shuffle(&mut hand);
            self.hand.extend(hand);
        }
        let fault = self.hand.pop_front().map(|kind| self.fault(kind))?;
        let kills_worker = matches!(fault, Fault::Kill(Target::Worker(_)));
        let at = if kills_worker { self.next_at.max(self.over_at) } else { self.next_at };
        self.over_at = self.over_at.max(at + fault.lasts());
        let pause = if kills_worker { QUIET_AFTER_WORKER_KILL } else { Duration::ZERO };
        self.next_at = at + self.every.max(pause);
        Some(Event { at, fault })
    }
}

/// SplitMix64.
#[derive(Debug, Clone)]
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut word = self.0;
        word = (word ^ (word >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        word = (word ^ (word >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        word ^ (word >> 31)
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
    fn every_hand_has_every_kind_of_fault() {
        for hand in events(1, 20 * HAND_EVENTS).chunks(HAND_EVENTS) {
            let names: BTreeSet<String> = hand
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
            assert_eq!(names.len(), HAND_EVENTS - 1, "two of a hand kill a worker: {names:?}");
        }
    }

    #[test]
    fn every_worker_and_line_gets_its_share() {
        let mut targets = BTreeSet::new();
        let mut lines = BTreeSet::new();
        for event in events(3, 600) {
            match event.fault {
                Fault::Kill(target) | Fault::Stop(target, _) => drop(targets.insert(target)),
                Fault::Cut(line) | Fault::Disturb(line, ..) => drop(lines.insert(line)),
            }
        }
        assert_eq!((targets.len(), lines.len()), (6, 9));
    }

    #[test]
    fn faults_come_at_their_pace_and_leave_a_killed_workers_successor_alone() {
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
