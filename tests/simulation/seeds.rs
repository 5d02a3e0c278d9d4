//! Many seeds, some at a time.

use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

/// Simulations at a time.
const N_AT_A_TIME: usize = 2;

/// The seeds that the environment names, `FROM..TO` or one, else the first `n`.
pub(crate) fn seeds_asked_for(n: u64) -> Range<u64> {
    #[expect(clippy::disallowed_methods, reason = "a person picks the seeds of a long test")]
    let Ok(asked) = std::env::var("TANDEM_SIM_SEEDS") else { return 0..n };
    let number = |text: &str| text.trim().parse::<u64>().expect("TANDEM_SIM_SEEDS: FROM..TO or N");
    match asked.split_once("..") {
        Some((from, to)) => number(from)..number(to),
        None => number(&asked)..number(&asked) + 1,
    }
}

/// What `check` gives for each of `seeds`, in no particular order.
///
/// # Panics
/// When something is wrong with one of them; says with which and what.
pub(crate) fn for_seeds<T: Send>(
    seeds: Range<u64>,
    check: impl Fn(u64) -> Result<T, String> + Sync,
) -> Vec<T> {
    let mut outcomes = outcomes(seeds, check);
    let complaints: Vec<String> =
        outcomes.extract_if(.., |outcome| outcome.is_err()).filter_map(Result::err).collect();
    assert!(
        complaints.is_empty(),
        "{} seeds of {}:\n{}",
        complaints.len(),
        complaints.len() + outcomes.len(),
        complaints.join("\n")
    );
    outcomes.into_iter().flatten().collect()
}

/// What is wrong with those of `seeds` with which something is wrong.
pub(crate) fn complaints<T: Send>(
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
    std::thread::scope(|scope| (0..N_AT_A_TIME).for_each(|_| drop(scope.spawn(work))));
    outcomes.into_inner().expect("no panics here")
}
