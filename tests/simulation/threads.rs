//! The threads that rollouts, learners and teachers compute on. Simulated time stands still while one of them does, so
//! that a slow machine makes a simulation slow and not its hosts.

use std::collections::BTreeSet;
use std::ffi::{OsStr, OsString};
use std::fs::{self, File};
use std::os::unix::fs::{FileExt as _, MetadataExt as _};
use std::path::Path;
use std::sync::Mutex;
use std::time::Duration;

/// The threads of this process, according to Linux.
const TASKS: &str = "/proc/self/task";
/// Pause between two looks at the threads.
const PAUSE: Duration = Duration::from_micros(50);
/// So many looks later time moves on all the same.
const MAX_LOOKS: u32 = 2000;

/// The threads that simulate.
static SIMULATING: Mutex<BTreeSet<OsString>> = Mutex::new(BTreeSet::new());

/// All threads of this process, on behalf of one that simulates.
pub(crate) struct Threads {
    own: OsString,
    /// Links to the directory of the threads when they were last listed, one for each of them and two more.
    n_links: u64,
    /// What Linux tells of those that do not simulate.
    stats: Vec<File>,
}

impl Threads {
    /// The calling thread simulates as long as this lives.
    pub(crate) fn of_simulation() -> Self {
        let own = fs::read_link("/proc/thread-self").ok();
        let own = own.as_deref().and_then(Path::file_name).unwrap_or_default().to_owned();
        SIMULATING.lock().expect("no panics here").insert(own.clone());
        Self { own, n_links: 0, stats: Vec::new() }
    }

    /// Returns when all threads wait for something, but for those that simulate.
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
        if tasks.nlink() != self.n_links {
            self.list(tasks.nlink());
        }
        let mut states = self.stats.iter().map(state);
        states.any(|state| match state {
            Some(state) => matches!(state, b'R' | b'D'),
            None => {
                // One has ended, perhaps another begun.
                self.n_links = 0;
                true
            }
        })
    }

    fn list(&mut self, n_links: u64) {
        let simulating = SIMULATING.lock().expect("no panics here");
        let names =
            fs::read_dir(TASKS).into_iter().flatten().flatten().map(|task| task.file_name());
        let others = names.filter(|name| !simulating.contains(name));
        self.stats = others.filter_map(|name| open(&name)).collect();
        self.n_links = n_links;
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        SIMULATING.lock().expect("no panics here").remove(&self.own);
    }
}

fn open(task: &OsStr) -> Option<File> {
    File::open(Path::new(TASKS).join(task).join("stat")).ok()
}

/// `R` of a thread that runs or could, `D` of one that waits for a disk; nothing of one that has ended.
fn state(stat: &File) -> Option<u8> {
    let mut text = [0; 64];
    let n_bytes = stat.read_at(&mut text, 0).ok()?;
    // The state follows the name, which stands in brackets.
    text[..n_bytes].rsplit(|byte| *byte == b')').next()?.get(1).copied()
}
