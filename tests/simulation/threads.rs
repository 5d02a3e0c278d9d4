//! The threads that rollouts, learners and teachers compute on. Simulated time stands still while one of them does, so
//! that a slow machine makes a simulation slow and not its hosts.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::fs::{self, File};
use std::os::unix::fs::{FileExt as _, MetadataExt as _};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard};
use std::time::Duration;

/// The threads of this process, according to Linux.
const TASKS: &str = "/proc/self/task";
/// Pause between two looks at the threads.
const PAUSE: Duration = Duration::from_micros(50);
/// So many looks later time moves on all the same.
const MAX_LOOKS: u32 = 2000;

/// What the simulations know of each other's threads.
#[derive(Default)]
struct Known {
    /// Those that simulate.
    simulating: BTreeSet<OsString>,
    /// Those that belong to one of them. A new thread belongs to who sees it first, which is almost always the one
    /// whose host has started it.
    computing: BTreeSet<OsString>,
}

static KNOWN: Mutex<Known> =
    Mutex::new(Known { simulating: BTreeSet::new(), computing: BTreeSet::new() });
/// Simulations that have begun.
static N_BEGUN: AtomicU64 = AtomicU64::new(0);

fn known() -> MutexGuard<'static, Known> {
    KNOWN.lock().expect("no panics here")
}

/// The threads of one simulation.
pub(crate) struct Threads {
    /// The thread that simulates.
    own: OsString,
    /// Threads that belong to others.
    others: BTreeSet<OsString>,
    /// What Linux tells of those that belong to this simulation.
    ours: BTreeMap<OsString, File>,
    /// When they were last listed: links to their directory, of which there is one for each of them and two more, and
    /// simulations that had begun.
    listed_at: (u64, u64),
}

impl Threads {
    /// Threads that start from now on, while the calling thread simulates.
    pub(crate) fn of_simulation() -> Self {
        let own = fs::read_link("/proc/thread-self").ok();
        let own = own.as_deref().and_then(Path::file_name).unwrap_or_default().to_owned();
        known().simulating.insert(own.clone());
        N_BEGUN.fetch_add(1, Ordering::Relaxed);
        Self { own, others: names().collect(), ours: BTreeMap::new(), listed_at: (0, 0) }
    }

    /// Returns when all threads of the simulation wait for something.
    pub(crate) fn wait_until_idle(&mut self) {
        for _ in 0..MAX_LOOKS {
            if !self.is_any_busy() {
                return;
            }
            std::thread::sleep(PAUSE);
        }
    }

    fn is_any_busy(&mut self) -> bool {
        // Without Linux's help each step of the simulation takes some time.
        let Ok(tasks) = fs::metadata(TASKS) else { return true };
        let now = (tasks.nlink(), N_BEGUN.load(Ordering::Relaxed));
        if now != self.listed_at {
            self.listed_at = now;
            self.list();
        }
        let mut states = self.ours.values().map(state);
        states.any(|state| match state {
            Some(state) => matches!(state, b'R' | b'D'),
            None => {
                // One has ended, perhaps another begun.
                self.listed_at = (0, 0);
                true
            }
        })
    }

    fn list(&mut self) {
        let now: BTreeSet<OsString> = names().collect();
        let Known { simulating, computing } = &mut *known();
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

/// `R` of a thread that runs or could, `D` of one that waits for a disk; nothing of one that has ended.
fn state(stat: &File) -> Option<u8> {
    let mut text = [0; 64];
    let n_bytes = stat.read_at(&mut text, 0).ok()?;
    // The state follows the name, which stands in brackets.
    text[..n_bytes].rsplit(|byte| *byte == b')').next()?.get(1).copied()
}
