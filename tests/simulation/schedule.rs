//! The faults of a simulation, drawn from a seed.

use std::fmt;
use std::time::Duration;

use rand_chacha::ChaCha8Rng;
use tandem_core::rng::{Stream, bernoulli, episode_rng, index, uniform};

/// Name of a simulated host.
pub(crate) type Host = &'static str;

/// Approximate number of sequential network round trips of a run.
const SLOWED_BY: u32 = 60;

/// A fault or its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Event {
    /// The host's processes end immediately.
    Crash(Host),
    /// A host that crashed or left restarts.
    Start(Host),
    /// A worker is asked to stop, delivers its finished work and leaves.
    Leave(Host),
    /// No message passes between the two hosts.
    Partition(Host, Host),
    /// No message passes from the first host to the second.
    PartitionOneWay(Host, Host),
    /// Messages between the two hosts are held and delivered together by the repair.
    Hold(Host, Host),
    /// The two hosts reach each other again.
    Repair(Host, Host),
}

/// A network and its faults.
#[derive(Debug, Clone)]
pub(crate) struct Schedule {
    /// The seed from which everything else is drawn.
    pub(crate) seed: u64,
    /// Maximum latency of a message.
    pub(crate) max_latency: Duration,
    /// Share of lost messages. Each loss also drops everything in flight between its two hosts.
    pub(crate) loss: f64,
    /// Events in order of time.
    pub(crate) events: Vec<(Duration, Event)>,
    /// Time after which there are no more faults.
    pub(crate) quiet_from: Duration,
}

impl Schedule {
    /// Returns a schedule without faults.
    pub(crate) fn undisturbed(seed: u64) -> Self {
        Self {
            seed,
            max_latency: Duration::from_millis(20),
            loss: 0.0,
            events: Vec::new(),
            quiet_from: Duration::ZERO,
        }
    }

    /// Draws faults of `links`, `services` and `workers`. The first worker never leaves for good. Most faults start
    /// within `span`, which is extended on slow networks.
    pub(crate) fn draw(
        seed: u64,
        links: &[(Host, Host)],
        services: &[Host],
        workers: &[Host],
        span: Duration,
    ) -> Self {
        let mut sampler = Sampler::new(seed, span);
        let max_latency = Duration::from_millis([10, 30, 80, 200][sampler.below(4)]);
        sampler.span += SLOWED_BY * max_latency;
        let loss = [0.0, 0.0, 0.000_3, 0.001][sampler.below(4)];
        let mut events = Vec::new();
        for link in links {
            sampler.add_link_faults(*link, &mut events);
        }
        for service in services {
            sampler.add_crashes(service, &mut events);
        }
        for (worker_idx, worker) in workers.iter().enumerate() {
            sampler.add_worker_faults(worker, worker_idx > 0, &mut events);
        }
        events.sort_by_key(|(at, _)| *at);
        let last = events.last().map_or(Duration::ZERO, |(at, _)| *at);
        Self { seed, max_latency, loss, events, quiet_from: last.max(sampler.span) }
    }
}

impl fmt::Display for Schedule {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { seed, max_latency, loss, events, quiet_from } = self;
        writeln!(formatter, "seed {seed}: latency up to {max_latency:?}, loss {loss}")?;
        for (at, event) in events {
            writeln!(formatter, "  {:8.3} s  {event:?}", at.as_secs_f64())?;
        }
        writeln!(formatter, "  {:8.3} s  end of the faults", quiet_from.as_secs_f64())
    }
}

/// Draws times, durations and choices.
struct Sampler {
    rng: ChaCha8Rng,
    span: Duration,
}

impl Sampler {
    fn new(seed: u64, span: Duration) -> Self {
        Self { rng: episode_rng(seed, 0, Stream::Exploration), span }
    }

    fn below(&mut self, n: usize) -> usize {
        index(&mut self.rng, n)
    }

    fn happens(&mut self, probability: f32) -> bool {
        bernoulli(&mut self.rng, probability)
    }

    /// Draws a time within the span.
    fn moment(&mut self) -> Duration {
        self.span.mul_f32(uniform(&mut self.rng, 0.0, 1.0))
    }

    /// Draws a log-uniform duration between 20 ms and 6 s.
    fn duration(&mut self) -> Duration {
        Duration::from_secs_f32(0.02 * 300.0_f32.powf(uniform(&mut self.rng, 0.0, 1.0)))
    }

    fn add_link_faults(&mut self, (a, b): (Host, Host), events: &mut Vec<(Duration, Event)>) {
        if !self.happens(0.5) {
            return;
        }
        let (begin, end) = self.outage();
        let fault = [
            Event::Partition(a, b),
            Event::PartitionOneWay(a, b),
            Event::PartitionOneWay(b, a),
            Event::Hold(a, b),
        ][self.below(4)];
        events.extend([(begin, fault), (end, Event::Repair(a, b))]);
    }

    fn outage(&mut self) -> (Duration, Duration) {
        let begin = self.moment();
        (begin, begin + self.duration())
    }

    /// Adds up to three crashes, one after the other; the later ones often after all other faults.
    fn add_crashes(&mut self, host: Host, events: &mut Vec<(Duration, Event)>) {
        let mut up_at = Duration::ZERO;
        for _ in 0..self.below(4) {
            let down_at = up_at + self.moment();
            up_at = down_at + self.duration();
            events.extend([(down_at, Event::Crash(host)), (up_at, Event::Start(host))]);
        }
    }

    /// Lets a worker join late, leave, crash, or none of these.
    fn add_worker_faults(
        &mut self,
        worker: Host,
        may_leave_for_good: bool,
        events: &mut Vec<(Duration, Event)>,
    ) {
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
                if !may_leave_for_good || self.happens(0.5) {
                    // Crash first, because the worker may not have left yet.
                    events.extend([(end, Event::Crash(worker)), (end, Event::Start(worker))]);
                }
            }
            2 => self.add_crashes(worker, events),
            _ => {}
        }
    }
}
