//! The hosts of a simulation and the execution of its schedule.
//!
//! A host's tasks run on the simulation's thread, which waits for computations on other threads. A crash ends the tasks
//! immediately. Threads of the crashed host end when they next use the host or are cancelled. Until then they cannot
//! reach anything, and simulated time does not advance.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;
use std::sync::{Arc, Weak};
use std::time::Duration;

use tokio_util::sync::CancellationToken;
use turmoil::Sim;

use crate::schedule::{Event, Host, Schedule};
use crate::{system, trace};

/// Simulated time per step.
const TICK: Duration = Duration::from_millis(5);
/// Simulated time after which a run counts as hanging.
const TIME_LIMIT: Duration = Duration::from_secs(3600);
/// Real time within which the threads of a crashed host must end, in milliseconds.
const CRASH_TIMEOUT_MILLIS: u32 = 60_000;

/// State shared between the processes on the hosts and the simulation.
#[derive(Default)]
pub(crate) struct ProcessTracker {
    /// Lifetime of the latest process of each host, until its last thread has ended.
    lifetimes: RefCell<BTreeMap<Host, Weak<()>>>,
    /// Tokens that ask processes to leave.
    shutdowns: RefCell<BTreeMap<Host, CancellationToken>>,
    /// Violations so far.
    violations: RefCell<Vec<String>>,
}

impl ProcessTracker {
    /// Returns a token that marks the new process on `host` as alive until every clone is dropped.
    pub(crate) fn lifetime_token(&self, host: Host) -> Arc<()> {
        let lifetime = Arc::new(());
        self.lifetimes.borrow_mut().insert(host, Arc::downgrade(&lifetime));
        lifetime
    }

    /// Returns the token that is cancelled when the new process on `host` is asked to leave.
    pub(crate) fn shutdown_token(&self, host: Host) -> CancellationToken {
        let shutdown = CancellationToken::new();
        self.shutdowns.borrow_mut().insert(host, shutdown.clone());
        shutdown
    }

    /// Records a violation, such as a process that gave up.
    pub(crate) fn report_violation(&self, violation: String) {
        self.violations.borrow_mut().push(violation);
    }

    /// Returns the first violation.
    pub(crate) fn first_violation(&self) -> Option<String> {
        self.violations.borrow().first().cloned()
    }

    /// Waits, in real time, until the latest process on `host` has ended completely.
    fn wait_until_gone(&self, host: Host) {
        let lifetimes = self.lifetimes.borrow();
        let Some(lifetime) = lifetimes.get(host) else { return };
        let mut polls = (0..CRASH_TIMEOUT_MILLIS).map(|millis| {
            std::thread::sleep(Duration::from_millis(u64::from(millis.min(1))));
            lifetime.strong_count() == 0
        });
        assert!(polls.any(|is_gone| is_gone), "a thread of the crashed {host} did not end");
    }
}

/// The hosts, the network between them and the schedule of faults.
pub(crate) struct Machines<'a> {
    sim: Sim<'a>,
    schedule: &'a Schedule,
    tracker: Rc<ProcessTracker>,
    links: Vec<(Host, Host)>,
    hosts: Vec<Host>,
    /// Called before a running host crashes.
    before_crash: Box<dyn Fn(Host) + 'a>,
    /// Crashed hosts that have not been restarted.
    down: Vec<Host>,
}

impl<'a> Machines<'a> {
    /// Creates a simulation without hosts. `links` names the pairs of hosts that will communicate.
    pub(crate) fn new(
        schedule: &'a Schedule,
        tracker: &Rc<ProcessTracker>,
        links: Vec<(Host, Host)>,
        before_crash: impl Fn(Host) + 'a,
    ) -> Self {
        let sim = turmoil::Builder::new()
            .rng_seed(schedule.seed)
            .tick_duration(TICK)
            .simulation_duration(TIME_LIMIT)
            .max_message_latency(schedule.max_latency)
            .fail_rate(schedule.loss)
            .tcp_capacity(1024)
            .enable_random_order()
            .build();
        Self {
            sim,
            schedule,
            tracker: Rc::clone(tracker),
            links,
            hosts: Vec::new(),
            before_crash: Box::new(before_crash),
            down: Vec::new(),
        }
    }

    /// Adds a host that runs `software` whenever it starts.
    pub(crate) fn add<F>(&mut self, host: Host, software: impl Fn() -> F + 'a)
    where
        F: Future<Output = turmoil::Result> + 'static,
    {
        self.sim.host(host, software);
        self.hosts.push(host);
    }

    /// Returns the elapsed simulated time.
    pub(crate) fn elapsed(&self) -> Duration {
        self.sim.elapsed()
    }

    /// Runs until `ended` returns a value.
    pub(crate) fn run_until<T>(&mut self, ended: impl Fn() -> Option<T>) -> Result<T, String> {
        let mut events = self.schedule.events.iter().copied().peekable();
        let mut is_quiet = false;
        loop {
            let now = self.sim.elapsed();
            while let Some((_, event)) = events.next_if(|(at, _)| *at <= now) {
                self.apply(event);
            }
            if !is_quiet && now >= self.schedule.quiet_from {
                is_quiet = true;
                self.end_faults();
            }
            self.sim.step().map_err(|error| error.to_string())?;
            system::set_now(self.sim.elapsed());
            if let Some(ended) = ended() {
                return Ok(ended);
            }
            if now >= TIME_LIMIT {
                return Err(format!("no end after {TIME_LIMIT:?}"));
            }
        }
    }

    fn apply(&mut self, event: Event) {
        tracing::info!(?event, "schedule");
        match event {
            Event::Crash(host) => self.crash(host),
            Event::Start(host) => {
                self.down.retain(|down| *down != host);
                self.sim.bounce(host);
            }
            Event::Leave(host) => {
                if let Some(shutdown) = self.tracker.shutdowns.borrow().get(host) {
                    shutdown.cancel();
                }
            }
            Event::Partition(a, b) => self.sim.partition(a, b),
            Event::PartitionOneWay(from, to) => self.sim.partition_oneway(from, to),
            Event::Hold(a, b) => self.sim.hold(a, b),
            Event::Repair(a, b) => self.repair(a, b),
        }
    }

    fn crash(&mut self, host: Host) {
        if self.sim.is_host_running(host) {
            (self.before_crash)(host);
        }
        trace::without(|| {
            self.sim.crash(host);
            self.tracker.wait_until_gone(host);
        });
        self.down.push(host);
    }

    /// Ends all faults: starts every host and lets every message through.
    fn end_faults(&mut self) {
        self.sim.set_fail_rate(0.0);
        for (a, b) in &self.links {
            self.repair(a, b);
        }
        for host in std::mem::take(&mut self.down) {
            self.sim.bounce(host);
        }
    }

    /// Restores a link and delivers the messages that were held.
    fn repair(&self, a: Host, b: Host) {
        self.sim.release(a, b);
    }

    /// Ends the simulation and waits for its threads.
    pub(crate) fn end(self) {
        let Self { sim, tracker, hosts, .. } = self;
        trace::without(|| {
            drop(sim);
            hosts.iter().for_each(|host| tracker.wait_until_gone(host));
        });
    }
}

/// Formats an error with its causes on one line.
pub(crate) fn with_causes(who: &str, error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |error| error.source());
    let causes: Vec<String> = causes.map(ToString::to_string).collect();
    format!("{who} gave up: {}", causes.join(": "))
}
