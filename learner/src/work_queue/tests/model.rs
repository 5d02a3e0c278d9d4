//! Random lives of a queue against a model.

use std::collections::BTreeMap;
use std::ops::Range;

use proptest::prelude::{Just, Strategy, any, prop_oneof};
use proptest::test_runner::{Config, TestRunner};

use super::*;

/// One thing that happens to a queue. Workers and slots are chosen among those that there are.
#[derive(Debug, Clone)]
enum Happening {
    Order { kind: EpisodeKind, n_slots: u64 },
    Join,
    Ask { worker: usize },
    Deliver { worker: usize, slot: u64 },
    Pass { millis: u64 },
    Reclaim,
    Take,
}

fn happening() -> impl Strategy<Value = Happening> {
    let kind = prop_oneof![Just(EpisodeKind::Training), Just(EpisodeKind::Evaluation)];
    prop_oneof![
        1 => (kind, 1..5_u64).prop_map(|(kind, n_slots)| Happening::Order { kind, n_slots }),
        1 => Just(Happening::Join),
        6 => any::<usize>().prop_map(|worker| Happening::Ask { worker }),
        5 => (any::<usize>(), any::<u64>())
            .prop_map(|(worker, slot)| Happening::Deliver { worker, slot }),
        3 => prop_oneof![4 => 0..4000_u64, 1 => 10_000..20_000_u64, 1 => Just(600_000)]
            .prop_map(|millis| Happening::Pass { millis }),
        2 => Just(Happening::Reclaim),
        1 => Just(Happening::Take),
    ]
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Place {
    Waiting,
    Out { worker: u64, since: Duration },
    In,
    Taken,
}

impl Place {
    fn is_with(self, someone: u64) -> bool {
        matches!(self, Self::Out { worker, .. } if worker == someone)
    }

    const fn is_open(self) -> bool {
        matches!(self, Self::Waiting | Self::Out { .. })
    }
}

struct Slot {
    order: SlotOrder,
    place: Place,
}

struct Member {
    last_seen: Duration,
    silent: bool,
    has_asked: bool,
    given: Option<u64>,
}

/// Every slot there ever was, in the order of their numbers, and every worker that is known.
#[derive(Default)]
struct Model {
    slots: BTreeMap<u64, Slot>,
    members: BTreeMap<u64, Member>,
    joined: Vec<u64>,
    n_episodes: u64,
    now: Duration,
    /// Moving average of the time that a slot takes.
    took: Option<Duration>,
}

impl Model {
    fn next(&mut self, worker: u64) -> Result<Option<u64>, QueueError> {
        let now = self.now;
        let member = self.members.get_mut(&worker).ok_or(QueueError::UnknownWorker(worker))?;
        (member.last_seen, member.silent, member.has_asked) = (now, false, true);
        let is_own = |slot: &u64| self.slots[slot].place.is_with(worker);
        if let Some(own) = member.given.filter(is_own) {
            return Ok(Some(own));
        }
        let waiting = |slot: &&Slot| slot.place == Place::Waiting;
        let training = |slot: &&Slot| slot.order.kind == EpisodeKind::Training;
        let queued = self.slots.values().filter(waiting).find(training);
        let queued = queued.or_else(|| self.slots.values().find(waiting));
        let out = self.slots.values().filter_map(|slot| match slot.place {
            Place::Out { since, .. } => Some((since, slot.order.slot)),
            _ => None,
        });
        let backup_after = (2 * self.took.unwrap_or_default()).clamp(BACKUP_AFTER, SILENT_AFTER);
        let overdue = out.min().filter(|(since, _)| now - *since >= backup_after);
        let chosen = queued.map(|slot| slot.order.slot).or(overdue.map(|(_, slot)| slot));
        member.given = chosen;
        if let Some(slot) = chosen.and_then(|slot| self.slots.get_mut(&slot)) {
            slot.place = Place::Out { worker, since: now };
        }
        Ok(chosen)
    }

    fn submit(&mut self, worker: u64, slot: u64) -> bool {
        // The episodes of a worker that was removed count too.
        if let Some(member) = self.members.get_mut(&worker) {
            (member.last_seen, member.silent, member.has_asked) = (self.now, false, true);
            member.given = member.given.filter(|given| *given != slot);
        }
        let open = self.slots.get_mut(&slot).filter(|slot| slot.place.is_open());
        let Some(slot) = open else { return false };
        if let Place::Out { since, .. } = slot.place {
            let took = self.now - since;
            self.took = Some(self.took.map_or(took, |before| (7 * before + took) / 8));
        }
        slot.place = Place::In;
        true
    }

    fn reclaim(&mut self) -> Vec<(u64, usize)> {
        let mut fell_silent = Vec::new();
        let now = self.now;
        let is_silent = |member: &Member| now - member.last_seen >= SILENT_AFTER;
        self.members.retain(|_, member| member.has_asked || !is_silent(member));
        for (id, member) in &mut self.members {
            if member.silent || self.now - member.last_seen < SILENT_AFTER {
                continue;
            }
            (member.silent, member.given) = (true, None);
            let mut n_slots = 0;
            for slot in self.slots.values_mut() {
                if slot.place.is_with(*id) {
                    slot.place = Place::Waiting;
                    n_slots += 1;
                }
            }
            fell_silent.push((*id, n_slots));
        }
        self.members.retain(|_, member| self.now - member.last_seen < FORGET_AFTER);
        fell_silent
    }
}

struct Both {
    queue: WorkQueue,
    model: Model,
    /// Every round and evaluation ordered: its kind, its version and its slots.
    batches: Vec<(EpisodeKind, u64, Range<u64>)>,
}

impl Both {
    fn order(&mut self, kind: EpisodeKind, n_slots: u64) {
        let version = self.batches.len() as u64;
        let first = self.model.slots.len() as u64;
        for slot in first..first + n_slots {
            let numbers = self.model.n_episodes..self.model.n_episodes + 2;
            self.model.n_episodes += 2;
            let episodes = numbers.flat_map(|number| order(number, kind).episodes).collect();
            let order = SlotOrder { slot, parameter_version: version, kind, episodes };
            self.queue.push(SlotOrder { slot: 0, ..order.clone() });
            self.model.slots.insert(slot, Slot { order, place: Place::Waiting });
        }
        self.batches.push((kind, version, first..first + n_slots));
    }

    fn join(&mut self) -> u64 {
        let id = join(&mut self.queue, self.model.now);
        let last_seen = self.model.now;
        let member = Member { last_seen, silent: false, has_asked: false, given: None };
        self.model.members.insert(id, member);
        self.model.joined.push(id);
        id
    }

    fn ask(&mut self, worker: u64) -> Option<u64> {
        let got = self.queue.next(worker, self.model.now);
        let got = got.map(|order| order.map(|order| order.slot));
        assert_eq!(got, self.model.next(worker));
        got.ok().flatten()
    }

    fn deliver(&mut self, worker: u64, slot: u64) {
        let order = &self.model.slots[&slot].order;
        let episode = |ordered: &EpisodeOrder| Episode {
            kind: order.kind,
            parameter_version: order.parameter_version,
            ..played(ordered.number).remove(0)
        };
        let episodes = order.episodes.iter().map(episode).collect();
        let got = self.queue.submit(worker, slot, episodes, self.model.now);
        assert_eq!(got, Ok(self.model.submit(worker, slot)));
    }

    fn reclaim(&mut self) {
        let got = self.queue.reclaim(self.model.now);
        let got: Vec<_> =
            got.into_iter().map(|silent| (silent.worker_id, silent.n_slots)).collect();
        assert_eq!(got, self.model.reclaim());
    }

    /// Takes every batch that is whole, and sees that its episodes come once, in order.
    fn take(&mut self) {
        for (kind, version, slots) in &self.batches {
            let slots = slots.clone();
            let is_complete =
                !self.model.slots.range(slots.clone()).any(|(_, s)| s.place.is_open());
            assert_eq!(self.queue.is_complete(*kind, *version), is_complete);
            if is_complete {
                let got = self.queue.take(*kind, *version);
                let got: Vec<u64> = got.iter().map(|episode| episode.number).collect();
                let mut ordered = Vec::new();
                for (_, slot) in self.model.slots.range_mut(slots) {
                    if slot.place == Place::In {
                        ordered.extend(slot.order.episodes.iter().map(|order| order.number));
                        slot.place = Place::Taken;
                    }
                }
                assert_eq!(got, ordered);
            }
        }
    }

    /// Nothing is kept but what is under way.
    fn check_size(&self) {
        let count = |place: fn(&Place) -> bool| {
            self.model.slots.values().filter(|slot| place(&slot.place)).count()
        };
        assert_eq!(self.queue.waiting.len(), count(|place| *place == Place::Waiting));
        assert_eq!(self.queue.assigned.len(), count(|place| matches!(place, Place::Out { .. })));
        assert_eq!(self.queue.finished.len(), count(|place| *place == Place::In));
        assert_eq!(self.queue.workers.len(), self.model.members.len());
    }

    fn happens(&mut self, happening: &Happening) {
        let worker_of = |model: &Model, worker: usize| {
            let n = model.joined.len();
            (n > 0).then(|| model.joined[worker % n])
        };
        match *happening {
            Happening::Order { kind, n_slots } => self.order(kind, n_slots),
            Happening::Join => drop(self.join()),
            Happening::Ask { worker } => {
                if let Some(worker) = worker_of(&self.model, worker) {
                    self.ask(worker);
                }
            }
            Happening::Deliver { worker, slot } => {
                let n_slots = self.model.slots.len() as u64;
                if let Some(worker) = worker_of(&self.model, worker).filter(|_| n_slots > 0) {
                    self.deliver(worker, slot % n_slots);
                }
            }
            Happening::Pass { millis } => self.model.now += Duration::from_millis(millis),
            Happening::Reclaim => self.reclaim(),
            Happening::Take => self.take(),
        }
        self.check_size();
    }
}

#[test]
fn every_episode_is_taken_once_and_in_order() {
    let mut runner =
        TestRunner::new(Config { failure_persistence: None, ..Config::with_cases(300) });
    let lives = proptest::collection::vec(happening(), 0..150);
    let outcome = runner.run(&lives, |life| {
        let mut both =
            Both { queue: WorkQueue::default(), model: Model::default(), batches: Vec::new() };
        life.iter().for_each(|happening| both.happens(happening));
        let last = both.join();
        while both.model.slots.values().any(|slot| slot.place.is_open()) {
            both.model.now += BACKUP_AFTER;
            if let Some(slot) = both.ask(last) {
                both.deliver(last, slot);
            }
        }
        both.take();
        assert!(both.model.slots.values().all(|slot| slot.place == Place::Taken));
        both.check_size();
        Ok(())
    });
    if let Err(error) = outcome {
        panic!("{error}");
    }
}
