//! How tasks and the threads that compute for them take turns.

/// What a runtime does while a thread computes for one of its tasks.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Pacing {
    /// Runs other tasks: sockets are served while threads compute.
    #[default]
    Concurrent,
    /// Waits for the thread. Computing then takes no simulated time, so that a simulation always takes the same course.
    /// Of no use outside simulations: nothing is served meanwhile.
    Lockstep,
}

impl Pacing {
    /// The output of `message`, the next one that a thread sends to the calling task.
    ///
    /// Under [`Self::Lockstep`] the runtime is blocked until then. The thread must not wait for any other task of that
    /// runtime before it sends.
    pub async fn next<F: Future>(self, message: F) -> F::Output {
        match self {
            Self::Concurrent => message.await,
            // A task that has used up its share of the runtime would never be woken here.
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

    /// Whether another task runs while a thread computes.
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
    async fn only_in_lockstep_other_tasks_wait_for_a_thread() {
        assert!(runs_others(Pacing::Concurrent).await);
        assert!(!runs_others(Pacing::Lockstep).await);
    }

    #[tokio::test]
    async fn a_task_in_lockstep_hears_more_messages_than_it_may_take_in_one_go() {
        let (sender, mut receiver) = tokio::sync::mpsc::channel(1);
        let thread = std::thread::spawn(move || {
            for message in 0..1000 {
                sender.blocking_send(message).unwrap();
            }
        });
        let mut n_heard = 0;
        while Pacing::Lockstep.next(receiver.recv()).await.is_some() {
            n_heard += 1;
        }
        assert_eq!(n_heard, 1000);
        thread.join().unwrap();
    }
}
