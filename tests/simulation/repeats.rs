//! Repeats simulations and compares their traces.

use std::fs::{self, File};
use std::hash::{DefaultHasher, Hasher as _};
use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use tempfile::TempDir;

use crate::process::{self, Simulation};

/// Number of threads that keep the machine busy.
const N_BUSY: usize = 4;

/// Runs each simulation `n_times`, two at a time. Returns a line for each, or the first difference between traces.
pub(crate) fn compare(simulations: &[Simulation], n_times: usize) -> Result<String, String> {
    let lines: Result<Vec<String>, String> =
        simulations.iter().map(|simulation| compare_one(*simulation, n_times)).collect();
    Ok(lines?.join("\n"))
}

fn compare_one(simulation: Simulation, n_times: usize) -> Result<String, String> {
    let disk = TempDir::new().expect("a directory");
    let first = disk.path().join("first");
    let report = process::run(simulation, Some(&first));
    let hash = hash_of(&first);
    let repeat = &|number: usize| {
        let path = disk.path().join(format!("again-{number}"));
        let again = process::run(simulation, Some(&path));
        if hash_of(&path) == hash && again == report {
            fs::remove_file(path).expect("a trace");
            return Ok(());
        }
        let difference = first_difference(&first, &path);
        Err(format!("{simulation} gave a different trace:\n{difference}\n{report:?}\n{again:?}"))
    };
    for numbers in (1..n_times).collect::<Vec<_>>().chunks(2) {
        std::thread::scope(|scope| {
            let start = |number: &usize| {
                let number = *number;
                scope.spawn(move || repeat(number))
            };
            let repeats: Vec<_> = numbers.iter().map(start).collect();
            repeats.into_iter().try_for_each(|repeat| repeat.join().expect("no panic"))
        })?;
    }
    let n_lines = lines(&first).count();
    assert!(n_lines > 1000, "{simulation}: a trace of {n_lines} lines");
    Ok(format!("{simulation}: {n_times} times {hash:016x}, {n_lines} lines"))
}

/// Runs `work` while other threads keep all processors busy.
pub(crate) fn on_a_busy_machine<T>(work: impl FnOnce() -> T) -> T {
    struct Stop<'a>(&'a AtomicBool);
    impl Drop for Stop<'_> {
        fn drop(&mut self) {
            self.0.store(true, Ordering::Relaxed);
        }
    }
    let is_done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let _stop = Stop(&is_done);
        for _ in 0..N_BUSY {
            scope.spawn(|| {
                while !is_done.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            });
        }
        work()
    })
}

fn hash_of(path: &Path) -> u64 {
    let mut hasher = DefaultHasher::new();
    hasher.write(&fs::read(path).expect("a trace"));
    hasher.finish()
}

fn lines(path: &Path) -> impl Iterator<Item = String> {
    BufReader::new(File::open(path).expect("a trace")).lines().map(|line| line.expect("text"))
}

/// Returns the first line in which two traces differ.
fn first_difference(one: &Path, other: &Path) -> String {
    let (mut one, mut other) = (lines(one), lines(other));
    for number in 1.. {
        match (one.next(), other.next()) {
            (None, None) => break,
            (one, other) if one == other => {}
            (one, other) => return format!("line {number}:\n  {one:?}\n  {other:?}"),
        }
    }
    "no line of the trace differs".to_owned()
}
