//! Threads that survive a fork of the process.

use pyo3::prelude::*;
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::episode::value_error;

/// A pool of threads. A forked process, which has none of its parent's threads, starts its own at the first use.
pub(crate) struct Threads {
    pool: Option<ThreadPool>,
    /// The process that started the pool.
    process: u32,
    count: usize,
}

impl Threads {
    /// Starts `count` threads.
    ///
    /// # Errors
    /// When the system starts no more threads.
    pub(crate) fn start(count: usize) -> PyResult<Self> {
        let pool = ThreadPoolBuilder::new().num_threads(count).build().map_err(value_error)?;
        Ok(Self { pool: Some(pool), process: std::process::id(), count })
    }

    /// Returns the number of threads.
    pub(crate) const fn count(&self) -> usize {
        self.count
    }

    /// Runs `job`, whose parallel iterators use the threads, on one of them.
    ///
    /// # Errors
    /// When the system starts no more threads in a forked process.
    pub(crate) fn install<T: Send>(&mut self, job: impl FnOnce() -> T + Send) -> PyResult<T> {
        if self.process != std::process::id() {
            let own = Self::start(self.count)?;
            drop(std::mem::replace(self, own));
        }
        let pool = self.pool.as_ref().ok_or_else(|| value_error("the threads have ended"))?;
        Ok(pool.install(job))
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        // In a forked process, a lock of the parent's pool may be held by a thread that does not exist.
        if self.process != std::process::id() {
            std::mem::forget(self.pool.take());
        }
    }
}
