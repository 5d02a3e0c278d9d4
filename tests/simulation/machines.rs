//! The machines of a simulation: run them through a schedule.
//!
//! A host's tasks run on the simulation's thread, which waits for what they let other threads compute. A crash ends a
//! host's tasks at once. Its threads end as soon as they want something of the host, or are told to stop, and can reach
//! nothing meanwhile; time moves on when they have ended.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;
use std::sync::{Arc, Weak};
use std::time::Duration;

use tokio_util::sync::CancellationToken;
use turmoil::Sim;

use crate::schedule::{Event, Host, Schedule};
use crate::{system, trace};

/// How much simulated time passes at a time.
const TICK: Duration = Duration::from_millis(5);
/// What takes so much simulated time never ends.
const NEVER: Duration = Duration::from_secs(3600);
/// What is left of a crashed host ends within so many milliseconds of real time.
const LAST_BREATH_MILLIS: u32 = 60_000;

/// What the processes on the hosts and the one who runs the machines share.
#[derive(Default)]
pub(crate) struct House {
    /// What started last on a host, as long as anything of it is left.
    lives: RefCell<BTreeMap<Host, Weak<()>>>,
    /// Tell processes to leave.
    leave: RefCell<BTreeMap<Host, CancellationToken>>,
    /// What must not have happened.
    complaints: RefCell<Vec<String>>,
}

impl House {
    /// Shows that what starts on `host` lives, until every clone is dropped.
    pub(crate) fn life_of(&self, host: Host) -> Arc<()> {
        let life = Arc::new(());
        self.lives.borrow_mut().insert(host, Arc::downgrade(&life));
        life
    }

    /// Cancelled when what starts on `host` is to leave.
    pub(crate) fn leave_of(&self, host: Host) -> CancellationToken {
        let leave = CancellationToken::new();
        self.leave.borrow_mut().insert(host, leave.clone());
        leave
    }

    /// Notes that a process gave up.
    pub(crate) fn complain(&self, complaint: String) {
        self.complaints.borrow_mut().push(complaint);
    }

    /// What was complained of first.
    pub(crate) fn complaint(&self) -> Option<String> {
        self.complaints.borrow().first().cloned()
    }

    /// Waits, in real time, until nothing is left of what started last on `host`.
    fn wait_until_gone(&self, host: Host) {
        let lives = self.lives.borrow();
        let Some(life) = lives.get(host) else { return };
        let mut looks = (0..LAST_BREATH_MILLIS).map(|millis| {
            std::thread::sleep(Duration::from_millis(u64::from(millis.min(1))));
            life.strong_count() == 0
        });
        assert!(looks.any(|is_gone| is_gone), "something of {host}, which crashed, goes on and on");
    }
}

/// Hosts, the network between them, and what goes wrong.
pub(crate) struct Machines<'a> {
    sim: Sim<'a>,
    schedule: &'a Schedule,
    house: Rc<House>,
    links: Vec<(Host, Host)>,
    hosts: Vec<Host>,
    /// Called before a host that runs crashes.
    before_crash: Box<dyn Fn(Host) + 'a>,
    /// Hosts that crashed and are not to start yet.
    down: Vec<Host>,
}

impl<'a> Machines<'a> {
    /// Machines without hosts, of which those will talk to each other that `links` names.
    pub(crate) fn new(
        schedule: &'a Schedule,
        house: &Rc<House>,
        links: Vec<(Host, Host)>,
        before_crash: impl Fn(Host) + 'a,
    ) -> Self {
        let sim = turmoil::Builder::new()
            .rng_seed(schedule.seed)
            .tick_duration(TICK)
            .simulation_duration(NEVER)
            .max_message_latency(schedule.max_latency)
            .fail_rate(schedule.loss)
            .tcp_capacity(1024)
            .enable_random_order()
            .build();
        Self {
            sim,
            schedule,
            house: Rc::clone(house),
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

    /// Simulated time that has passed.
    pub(crate) fn elapsed(&self) -> Duration {
        self.sim.elapsed()
    }

    /// Runs until `ended` gives something.
    pub(crate) fn run_until<T>(&mut self, ended: impl Fn() -> Option<T>) -> Result<T, String> {
        let mut events = self.schedule.events.iter().copied().peekable();
        let mut is_calm = false;
        loop {
            let now = self.sim.elapsed();
            while let Some((_, event)) = events.next_if(|(at, _)| *at <= now) {
                self.apply(event);
            }
            if !is_calm && now >= self.schedule.calm_from {
                is_calm = true;
                self.calm_down();
            }
            self.sim.step().map_err(|error| error.to_string())?;
            system::set_now(self.sim.elapsed());
            if let Some(ended) = ended() {
                return Ok(ended);
            }
            if now >= NEVER {
                return Err(format!("no end after {NEVER:?}"));
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
                if let Some(leave) = self.house.leave.borrow().get(host) {
                    leave.cancel();
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
            self.house.wait_until_gone(host);
        });
        self.down.push(host);
    }

    /// From here on every host is up and every message gets through.
    fn calm_down(&mut self) {
        self.sim.set_fail_rate(0.0);
        for (a, b) in &self.links {
            self.repair(a, b);
        }
        for host in std::mem::take(&mut self.down) {
            self.sim.bounce(host);
        }
    }

    /// Also delivers what was held.
    fn repair(&self, a: Host, b: Host) {
        self.sim.release(a, b);
    }

    /// Ends everything and waits for the threads.
    pub(crate) fn end(self) {
        let Self { sim, house, hosts, .. } = self;
        trace::without(|| {
            drop(sim);
            hosts.iter().for_each(|host| house.wait_until_gone(host));
        });
    }
}

/// What went wrong with whom, and why, on one line.
pub(crate) fn with_causes(who: &str, error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |error| error.source());
    let causes: Vec<String> = causes.map(ToString::to_string).collect();
    format!("{who} gave up: {}", causes.join(": "))
}
