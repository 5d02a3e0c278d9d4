//! Tasks on a number of threads of the rayon pool.

use std::sync::{Mutex, PoisonError};

/// Runs `work` within the rayon pool if there is more than one thread, so that [`for_each`] need not enter it each time.
pub(super) fn in_pool<R: Send>(n_threads: usize, work: impl FnOnce() -> R + Send) -> R {
    if n_threads > 1 { rayon::scope(|_| work()) } else { work() }
}

/// Runs `work` on every task, and returns when all are complete. Each of as many threads as there are `states` has one of
/// them, and takes the next task when it has completed one; a smaller pool uses fewer.
pub(super) fn for_each<S: Send, T: Send>(
    states: &mut [S],
    tasks: Vec<T>,
    work: impl Fn(&mut S, T) + Sync,
) {
    let n_threads = states.len().min(tasks.len());
    let Some((own, others)) = states[..n_threads].split_first_mut() else { return };
    if others.is_empty() {
        tasks.into_iter().for_each(|task| work(own, task));
        return;
    }
    let queue = Mutex::new(tasks.into_iter());
    let next = || queue.lock().unwrap_or_else(PoisonError::into_inner).next();
    let take_tasks = |state: &mut S| {
        while let Some(task) = next() {
            work(state, task);
        }
    };
    rayon::scope(|scope| {
        for state in others {
            scope.spawn(|_| take_tasks(state));
        }
        take_tasks(own);
    });
}
