//! How long a worker waits for its peers.

use std::time::Duration;

use tandem_telemetry::events::{Reconnected, Reconnecting};

use crate::grpc::CallError;

/// How long a worker waits before it asks again, and for an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Patience {
    /// Pause after a first failure; doubled after each further one.
    pub first_pause: Duration,
    /// The pause does not grow beyond this.
    pub longest_pause: Duration,
    /// For the learner's answer to a call; one that takes longer counts as failed.
    pub answer: Duration,
    /// For the answer to a request for work, which the learner holds back for some seconds when it has none.
    pub work: Duration,
    /// For the teacher's advice, which takes milliseconds: an episode stands still meanwhile.
    pub advice: Duration,
    /// For the slot in hand to be played and delivered once the worker has been told to stop.
    pub drain: Duration,
}

impl Default for Patience {
    fn default() -> Self {
        Self {
            first_pause: Duration::from_millis(50),
            longest_pause: Duration::from_secs(1),
            answer: Duration::from_secs(20),
            work: Duration::from_secs(20),
            advice: Duration::from_secs(5),
            drain: Duration::from_secs(5),
        }
    }
}

impl Patience {
    /// The pause after `n_failures` failures in a row, 1 or more.
    #[must_use]
    pub fn pause_after(self, n_failures: u32) -> Duration {
        let n_doublings = n_failures.saturating_sub(1).min(31);
        self.first_pause.saturating_mul(1 << n_doublings).min(self.longest_pause)
    }
}

/// What is attempted with which peer, as errors and logs put it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Attempt {
    pub(crate) peer: &'static str,
    pub(crate) what: &'static str,
}

/// The failures in a row of one attempt.
#[derive(Debug)]
pub(crate) struct Outage {
    patience: Patience,
    attempt: Attempt,
    n_failures: u32,
}

impl Outage {
    /// No failure so far.
    pub(crate) const fn none(patience: Patience, attempt: Attempt) -> Self {
        Self { patience, attempt, n_failures: 0 }
    }

    /// The answer, unless the peer is away: then waits until it is time to try again.
    pub(crate) async fn settle<T>(
        &mut self,
        answer: Result<T, CallError>,
    ) -> Option<Result<T, CallError>> {
        if let Err(CallError::Away(status)) = answer {
            self.wait(&status).await;
            return None;
        }
        if self.n_failures > 0 {
            Reconnected { peer: self.attempt.peer, attempts: self.n_failures }.emit();
        }
        Some(answer)
    }

    async fn wait(&mut self, status: &tonic::Status) {
        self.n_failures = self.n_failures.saturating_add(1);
        let pause = self.patience.pause_after(self.n_failures);
        Reconnecting {
            peer: self.attempt.peer,
            attempt: self.n_failures,
            wait_millis: u64::try_from(pause.as_millis()).unwrap_or(u64::MAX),
            reason: &format!("cannot {}: {}", self.attempt.what, status.message()),
        }
        .emit();
        tokio::time::sleep(pause).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_up_to_a_bound() {
        let patience = Patience {
            first_pause: Duration::from_millis(50),
            longest_pause: Duration::from_secs(1),
            ..Patience::default()
        };
        let pauses = [1, 2, 3, 5, 6, 1_000, u32::MAX].map(|n| patience.pause_after(n).as_millis());
        assert_eq!(pauses, [50, 100, 200, 800, 1_000, 1_000, 1_000]);
    }
}
