//! What goes wrong in a simulation and when, drawn from a seed.

use std::fmt;
use std::time::Duration;

use rand_chacha::ChaCha8Rng;
use tandem_core::rng::{Stream, bernoulli, episode_rng, index, uniform};

/// A machine of the simulation.
pub(crate) type Host = &'static str;

/// Longest ways over the network that a run takes one after the other, more or less.
const SLOWED_BY: u32 = 60;

/// What happens at some moment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Event {
    /// The host's processes are gone at once.
    Crash(Host),
    /// A host that crashed or left starts again.
    Start(Host),
    /// A worker is told to stop, delivers what it has in hand and goes.
    Leave(Host),
    /// Nothing gets through between the two.
    Partition(Host, Host),
    /// Nothing gets through from the first to the second.
    PartitionOneWay(Host, Host),
    /// What is sent between the two waits, and is delivered in one go by the repair.
    Hold(Host, Host),
    /// The two reach each other again.
    Repair(Host, Host),
}

/// A network and what goes wrong on it.
#[derive(Debug, Clone)]
pub(crate) struct Schedule {
    /// Everything else is drawn from it.
    pub(crate) seed: u64,
    /// Messages take no longer.
    pub(crate) max_latency: Duration,
    /// Share of the messages that are lost, and with each all that is under way between its two hosts.
    pub(crate) loss: f64,
    /// By time.
    pub(crate) events: Vec<(Duration, Event)>,
    /// From here on nothing goes wrong any more.
    pub(crate) calm_from: Duration,
}

impl Schedule {
    /// Nothing goes wrong.
    pub(crate) fn calm(seed: u64) -> Self {
        Self {
            seed,
            max_latency: Duration::from_millis(20),
            loss: 0.0,
            events: Vec::new(),
            calm_from: Duration::ZERO,
        }
    }

    /// Much goes wrong: between the hosts of `links`, with `services`, and with `workers`, of which the first does not
    /// leave for good. Most of it begins within `span`, or what takes as long on a slow network.
    pub(crate) fn draw(
        seed: u64,
        links: &[(Host, Host)],
        services: &[Host],
        workers: &[Host],
        span: Duration,
    ) -> Self {
        let mut dice = Dice::new(seed, span);
        let max_latency = Duration::from_millis([10, 30, 80, 200][dice.below(4)]);
        dice.span += SLOWED_BY * max_latency;
        let loss = [0.0, 0.0, 0.000_3, 0.001][dice.below(4)];
        let mut events = Vec::new();
        for link in links {
            dice.trouble_on(*link, &mut events);
        }
        for service in services {
            dice.crashes_of(service, &mut events);
        }
        for (worker_idx, worker) in workers.iter().enumerate() {
            dice.life_of(worker, worker_idx > 0, &mut events);
        }
        events.sort_by_key(|(at, _)| *at);
        let last = events.last().map_or(Duration::ZERO, |(at, _)| *at);
        Self { seed, max_latency, loss, events, calm_from: last.max(dice.span) }
    }
}

impl fmt::Display for Schedule {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { seed, max_latency, loss, events, calm_from } = self;
        writeln!(formatter, "seed {seed}: latency up to {max_latency:?}, loss {loss}")?;
        for (at, event) in events {
            writeln!(formatter, "  {:8.3} s  {event:?}", at.as_secs_f64())?;
        }
        writeln!(formatter, "  {:8.3} s  calm", calm_from.as_secs_f64())
    }
}

/// Draws moments, spans and choices.
struct Dice {
    rng: ChaCha8Rng,
    span: Duration,
}

impl Dice {
    fn new(seed: u64, span: Duration) -> Self {
        Self { rng: episode_rng(seed, 0, Stream::Exploration), span }
    }

    fn below(&mut self, n: usize) -> usize {
        index(&mut self.rng, n)
    }

    fn happens(&mut self, probability: f32) -> bool {
        bernoulli(&mut self.rng, probability)
    }

    /// A moment within the span.
    fn moment(&mut self) -> Duration {
        self.span.mul_f32(uniform(&mut self.rng, 0.0, 1.0))
    }

    /// Some time between 20 ms and 6 s, short ones as likely as long ones.
    fn while_(&mut self) -> Duration {
        Duration::from_secs_f32(0.02 * 300.0_f32.powf(uniform(&mut self.rng, 0.0, 1.0)))
    }

    fn trouble_on(&mut self, (a, b): (Host, Host), events: &mut Vec<(Duration, Event)>) {
        if !self.happens(0.5) {
            return;
        }
        let (begin, end) = self.outage();
        let trouble = [
            Event::Partition(a, b),
            Event::PartitionOneWay(a, b),
            Event::PartitionOneWay(b, a),
            Event::Hold(a, b),
        ][self.below(4)];
        events.extend([(begin, trouble), (end, Event::Repair(a, b))]);
    }

    fn outage(&mut self) -> (Duration, Duration) {
        let begin = self.moment();
        (begin, begin + self.while_())
    }

    /// Up to three crashes, one after the other; the later ones often come when everything else is calm.
    fn crashes_of(&mut self, host: Host, events: &mut Vec<(Duration, Event)>) {
        let mut up_at = Duration::ZERO;
        for _ in 0..self.below(4) {
            let down_at = up_at + self.moment();
            up_at = down_at + self.while_();
            events.extend([(down_at, Event::Crash(host)), (up_at, Event::Start(host))]);
        }
    }

    /// A worker that joins late, leaves, crashes, or does none of it.
    fn life_of(&mut self, worker: Host, may_stay_away: bool, events: &mut Vec<(Duration, Event)>) {
        match self.below(4) {
            0 => {
                events.extend([
                    (Duration::ZERO, Event::Crash(worker)),
                    (self.moment(), Event::Start(worker)),
                ]);
            }
            1 => {
                let (begin, end) = self.outage();
                events.push((begin, Event::Leave(worker)));
                if !may_stay_away || self.happens(0.5) {
                    // Crashed first: it may not have gone yet.
                    events.extend([(end, Event::Crash(worker)), (end, Event::Start(worker))]);
                }
            }
            2 => self.crashes_of(worker, events),
            _ => {}
        }
    }
}
