//! Scheduling of tasks and the threads that compute for them.

/// The behaviour of a runtime while a thread computes for one of its tasks.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Pacing {
    /// The runtime runs other tasks, so sockets are served while threads compute.
    #[default]
    Concurrent,
    /// The runtime blocks until the thread is done. Computation then takes no simulated time, which makes simulations
    /// reproducible. Not for production: no socket is served meanwhile.
    Lockstep,
}

impl Pacing {
    /// Waits for `message`, the next message from a thread to the calling task.
    ///
    /// Under [`Self::Lockstep`] this blocks the runtime, so the thread must send without waiting for another task of
    /// the runtime.
    pub async fn next<F: Future>(self, message: F) -> F::Output {
        match self {
            Self::Concurrent => message.await,
            // A task that has exhausted its cooperative budget would never be woken here.
            Self::Lockstep => pollster::block_on(tokio::task::unconstrained(message)),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::sync::{Arc, Barrier};

    use tokio::sync::oneshot;

    use super::*;

    /// Returns whether another task runs while a thread computes.
    async fn runs_others(pacing: Pacing) -> bool {
        let (begin, ran) = (Arc::new(Barrier::new(2)), Arc::new(AtomicBool::new(false)));
        let (sender, answer) = oneshot::channel();
        let (begun, seen) = (Arc::clone(&begin), Arc::clone(&ran));
        let thread = std::thread::spawn(move || {
            if pacing == Pacing::Concurrent {
                begun.wait();
            }
            sender.send(seen.load(Ordering::SeqCst)).unwrap();
        });
        let other = tokio::spawn(async move {
            ran.store(true, Ordering::SeqCst);
            if pacing == Pacing::Concurrent {
                begin.wait();
            }
        });
        let others_ran = pacing.next(answer).await.unwrap();
        thread.join().unwrap();
        other.await.unwrap();
        others_ran
    }

    #[tokio::test]
    async fn other_tasks_wait_for_a_thread_only_in_lockstep() {
        assert!(runs_others(Pacing::Concurrent).await);
        assert!(!runs_others(Pacing::Lockstep).await);
    }

    #[tokio::test]
    async fn a_task_in_lockstep_receives_more_messages_than_its_cooperative_budget() {
        let (sender, mut receiver) = tokio::sync::mpsc::channel(1);
        let thread = std::thread::spawn(move || {
            for message in 0..1000 {
                sender.blocking_send(message).unwrap();
            }
        });
        let mut n_received = 0;
        while Pacing::Lockstep.next(receiver.recv()).await.is_some() {
            n_received += 1;
        }
        assert_eq!(n_received, 1000);
        thread.join().unwrap();
    }
}
