//! The threads that rollouts, learners and teachers compute on. Simulated time stands still while one of them does, so
//! that a slow machine makes a simulation slow and not its hosts.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::fs::{self, File};
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// The threads of this process, according to Linux.
const TASKS: &str = "/proc/self/task";
/// Pause between two looks at the threads.
const PAUSE: Duration = Duration::from_micros(50);
/// So many looks later time moves on all the same.
const MAX_LOOKS: u32 = 2000;

/// What the simulations know of each other's threads. Who holds it makes a step; a thread that is new then belongs to
/// that simulation.
#[derive(Default)]
struct Known {
    /// Threads that simulate.
    simulating: BTreeSet<OsString>,
    /// Threads that belong to one of them.
    computing: BTreeSet<OsString>,
}

static KNOWN: Mutex<Known> =
    Mutex::new(Known { simulating: BTreeSet::new(), computing: BTreeSet::new() });

fn known() -> MutexGuard<'static, Known> {
    KNOWN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The threads of one simulation.
pub(crate) struct Threads {
    /// The thread that simulates.
    own: OsString,
    /// Threads that belong to others.
    others: BTreeSet<OsString>,
    /// What Linux tells of those that belong to this simulation.
    ours: BTreeMap<OsString, File>,
}

impl Threads {
    /// Threads that start from now on, while the calling thread simulates.
    pub(crate) fn of_simulation() -> Self {
        let own = fs::read_link("/proc/thread-self").ok();
        let own = own.as_deref().and_then(Path::file_name).unwrap_or_default().to_owned();
        known().simulating.insert(own.clone());
        Self { own, others: names().collect(), ours: BTreeMap::new() }
    }

    /// Makes a step, and returns when all threads of the simulation wait for something.
    pub(crate) fn during<T>(&mut self, step: impl FnOnce() -> T) -> T {
        let mut known = known();
        let outcome = step();
        self.list(&mut known);
        drop(known);
        let is_any_busy = || self.ours.values().any(is_busy);
        let mut looks = (0..MAX_LOOKS).map(|look| {
            if look > 0 {
                std::thread::sleep(PAUSE);
            }
            is_any_busy()
        });
        looks.find(|is_any_busy| !is_any_busy);
        outcome
    }

    fn list(&mut self, Known { simulating, computing }: &mut Known) {
        let now: BTreeSet<OsString> = names().collect();
        let is_ours = |task: &OsString| now.contains(task) && !simulating.contains(task);
        self.ours.retain(|task, _| is_ours(task) || !computing.remove(task));
        for task in &now {
            if self.ours.contains_key(task) || self.others.contains(task) {
                continue;
            }
            let stat = File::open(Path::new(TASKS).join(task).join("stat"));
            match stat {
                Ok(stat) if is_ours(task) && computing.insert(task.clone()) => {
                    self.ours.insert(task.clone(), stat);
                }
                _ => {
                    self.others.insert(task.clone());
                }
            }
        }
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        let mut known = known();
        known.simulating.remove(&self.own);
        for task in self.ours.keys() {
            known.computing.remove(task);
        }
    }
}

/// The threads of this process by their numbers.
fn names() -> impl Iterator<Item = OsString> {
    fs::read_dir(TASKS).into_iter().flatten().flatten().map(|task| task.file_name())
}

/// Whether a thread runs, could run, or waits for a disk.
fn is_busy(stat: &File) -> bool {
    let mut text = [0; 64];
    // Of a thread that has ended nothing can be read.
    let n_bytes = stat.read_at(&mut text, 0).unwrap_or(0);
    // The state follows the name, which stands in brackets.
    let state = text[..n_bytes].rsplit(|byte| *byte == b')').next().and_then(|rest| rest.get(1));
    matches!(state, Some(b'R' | b'D'))
}
