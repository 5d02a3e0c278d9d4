//! Runs checks for many seeds, several at a time.

use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

/// Number of concurrent simulations.
const N_PARALLEL: usize = 2;

/// Returns the seeds in `TANDEM_SIM_SEEDS`, `FROM..TO` or a single one, or else the first `n`.
pub(crate) fn seeds_from_env(n: u64) -> Range<u64> {
    #[expect(clippy::disallowed_methods, reason = "the user selects the seeds of a long test")]
    let Ok(requested) = std::env::var("TANDEM_SIM_SEEDS") else { return 0..n };
    let number = |text: &str| text.trim().parse::<u64>().expect("TANDEM_SIM_SEEDS: FROM..TO or N");
    match requested.split_once("..") {
        Some((from, to)) => number(from)..number(to),
        None => number(&requested)..number(&requested) + 1,
    }
}

/// Returns the results of `check` for all `seeds`, in no particular order.
///
/// # Panics
/// If the check of any seed fails. The message lists the failures.
pub(crate) fn for_seeds<T: Send>(
    seeds: Range<u64>,
    check: impl Fn(u64) -> Result<T, String> + Sync,
) -> Vec<T> {
    let mut outcomes = outcomes(seeds, check);
    let failures: Vec<String> =
        outcomes.extract_if(.., |outcome| outcome.is_err()).filter_map(Result::err).collect();
    assert!(
        failures.is_empty(),
        "{} seeds of {}:\n{}",
        failures.len(),
        failures.len() + outcomes.len(),
        failures.join("\n")
    );
    outcomes.into_iter().flatten().collect()
}

/// Returns the failures of `check` among `seeds`.
pub(crate) fn failures<T: Send>(
    seeds: Range<u64>,
    check: impl Fn(u64) -> Result<T, String> + Sync,
) -> Vec<String> {
    outcomes(seeds, check).into_iter().filter_map(Result::err).collect()
}

fn outcomes<T: Send>(
    seeds: Range<u64>,
    check: impl Fn(u64) -> Result<T, String> + Sync,
) -> Vec<Result<T, String>> {
    let next = AtomicU64::new(seeds.start);
    let outcomes = Mutex::new(Vec::new());
    let work = || {
        loop {
            let seed = next.fetch_add(1, Ordering::Relaxed);
            if seed >= seeds.end {
                return;
            }
            let outcome = catch_unwind(AssertUnwindSafe(|| check(seed)))
                .unwrap_or_else(|_panic| Err(format!("seed {seed}: a panic, see above")));
            outcomes.lock().expect("no panics here").push(outcome);
        }
    };
    std::thread::scope(|scope| (0..N_PARALLEL).for_each(|_| drop(scope.spawn(work))));
    outcomes.into_inner().expect("no panics here")
}
