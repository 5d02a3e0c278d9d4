//! Deadlines and retries of calls.
//!
//! A client waits for a peer that is away and repeats the call, since every call in the workspace may be repeated. An
//! error that repetition cannot cure is returned at once. Time is tokio's, so tests can pause or simulate it.

use std::time::Duration;

use tonic::{Code, Status};

/// Waits for `call` until `deadline`.
///
/// # Errors
/// The error of `call`, or `DEADLINE_EXCEEDED`.
pub async fn within<T>(
    deadline: Duration,
    call: impl Future<Output = Result<T, Status>>,
) -> Result<T, Status> {
    let timed_out = || Status::deadline_exceeded(format!("no answer within {deadline:?}"));
    tokio::time::timeout(deadline, call).await.unwrap_or_else(|_elapsed| Err(timed_out()))
}

/// The effect of repeating a call that failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Retryability {
    /// The call may succeed later: the peer is away, overloaded or restarting.
    Transient,
    /// The peer does not know the subject of the call, as after a restart. The caller must introduce it again first.
    NotFound,
    /// The call cannot succeed.
    Final,
}

impl Retryability {
    /// Returns the retryability of an error with this code.
    #[must_use]
    pub const fn of(code: Code) -> Self {
        match code {
            Code::NotFound => Self::NotFound,
            Code::InvalidArgument
            | Code::FailedPrecondition
            | Code::OutOfRange
            | Code::AlreadyExists
            | Code::PermissionDenied
            | Code::Unauthenticated
            | Code::Unimplemented
            | Code::DataLoss => Self::Final,
            _ => Self::Transient,
        }
    }
}

/// An exponential backoff without jitter, so that the times of retries are reproducible.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Backoff {
    /// The pause after the first failure. It doubles with each further failure.
    pub first_pause: Duration,
    /// The longest pause.
    pub max_pause: Duration,
}

impl Backoff {
    /// Returns the pause after `n_failures` failures in a row, at least 1.
    #[must_use]
    pub fn pause_after(self, n_failures: u32) -> Duration {
        let n_doublings = n_failures.saturating_sub(1).min(31);
        self.first_pause.saturating_mul(1 << n_doublings).min(self.max_pause)
    }
}

/// A call as logs and error messages name it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Operation {
    /// The kind of the called service, such as "learner".
    pub peer: &'static str,
    /// The purpose of the call, as in "cannot {purpose}".
    pub purpose: &'static str,
}

/// The retries of one operation.
///
/// The first failure of an outage is logged as a warning. A later one is a warning only if its message differs from the
/// previous one, and otherwise has level debug. The end of the outage is logged once.
#[derive(Debug)]
pub struct Retrier {
    backoff: Backoff,
    operation: Operation,
    n_failures: u32,
    logged: String,
}

impl Retrier {
    /// Creates a retrier that has seen no failure.
    #[must_use]
    pub const fn new(backoff: Backoff, operation: Operation) -> Self {
        Self { backoff, operation, n_failures: 0, logged: String::new() }
    }

    /// Returns the outcome of a call, or `None` if the call is to be repeated: after an error that is
    /// [`Retryability::Transient`], once the pause is over.
    pub async fn settle<T>(&mut self, outcome: Result<T, Status>) -> Option<Result<T, Status>> {
        match outcome {
            Err(status) if Retryability::of(status.code()) == Retryability::Transient => {
                self.back_off(&status).await;
                None
            }
            outcome => {
                self.end_outage();
                Some(outcome)
            }
        }
    }

    async fn back_off(&mut self, status: &Status) {
        self.n_failures = self.n_failures.saturating_add(1);
        let (peer, message) = (self.operation.peer, status.message());
        let (reason, attempt) =
            (format!("cannot {}: {message}", self.operation.purpose), self.n_failures);
        if attempt == 1 || self.logged != message {
            tracing::warn!(peer, reason, attempt, "call failed, retrying");
            message.clone_into(&mut self.logged);
        } else {
            tracing::debug!(peer, reason, attempt, "call failed again");
        }
        tokio::time::sleep(self.backoff.pause_after(self.n_failures)).await;
    }

    fn end_outage(&mut self) {
        if self.n_failures > 0 {
            let (peer, n_failures) = (self.operation.peer, self.n_failures);
            tracing::info!(peer, n_failures, "peer answers again");
            self.n_failures = 0;
        }
    }
}

/// Repeats `call` until it succeeds or fails for good. Each attempt has the same deadline.
///
/// # Errors
/// The first error that is not [`Retryability::Transient`].
pub async fn retry<T, F>(
    backoff: Backoff,
    deadline: Duration,
    operation: Operation,
    mut call: impl FnMut() -> F,
) -> Result<T, Status>
where
    F: Future<Output = Result<T, Status>>,
{
    let mut retrier = Retrier::new(backoff, operation);
    loop {
        let outcome = within(deadline, call()).await;
        if let Some(outcome) = retrier.settle(outcome).await {
            return outcome;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use tokio::time::Instant;

    use super::*;

    const BACKOFF: Backoff =
        Backoff { first_pause: Duration::from_millis(50), max_pause: Duration::from_secs(1) };
    const DEADLINE: Duration = Duration::from_secs(5);
    const ASK: Operation = Operation { peer: "learner", purpose: "ask for work" };

    /// Returns the outcome of a call with these results, the time it took, and the log lines written.
    async fn retried(results: Vec<Result<u32, Status>>) -> (Result<u32, Code>, Duration, String) {
        let log = Arc::new(Mutex::new(Vec::new()));
        let to = Arc::clone(&log);
        let subscriber = tracing_subscriber::fmt()
            .without_time()
            .with_ansi(false)
            .with_writer(move || LogWriter(Arc::clone(&to)))
            .finish();
        let logged = tracing::subscriber::set_default(subscriber);
        let (started, mut results) = (Instant::now(), results.into_iter());
        let outcome = retry(BACKOFF, DEADLINE, ASK, || {
            let result = results.next();
            async {
                match result {
                    Some(result) => result,
                    None => std::future::pending().await,
                }
            }
        });
        let outcome = tokio::time::timeout(Duration::from_secs(60), outcome).await;
        drop(logged);
        let log = String::from_utf8(log.lock().unwrap().clone()).unwrap();
        let outcome = outcome.unwrap_or_else(|_elapsed| Err(Status::cancelled("")));
        (outcome.map_err(|status| status.code()), started.elapsed(), log)
    }

    struct LogWriter(Arc<Mutex<Vec<u8>>>);

    impl std::io::Write for LogWriter {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().unwrap().extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    fn away(message: &str) -> Result<u32, Status> {
        Err(Status::unavailable(message))
    }

    #[test]
    fn pauses_double_up_to_the_maximum() {
        let pauses = [1, 2, 3, 5, 6, 1_000, u32::MAX].map(|n| BACKOFF.pause_after(n).as_millis());
        assert_eq!(pauses, [50, 100, 200, 800, 1_000, 1_000, 1_000]);
    }

    #[tokio::test(start_paused = true)]
    async fn an_outage_is_logged_once_and_its_end_once() {
        let (outcome, elapsed, log) =
            retried(vec![away("refused"), away("refused"), away("refused"), Ok(7)]).await;
        assert_eq!((outcome, elapsed), (Ok(7), Duration::from_millis(50 + 100 + 200)));
        let lines: Vec<&str> = log.lines().collect();
        assert_eq!(lines.len(), 2, "{log}");
        assert!(lines[0].contains("WARN") && lines[0].contains("cannot ask for work: refused"));
        assert!(lines[1].contains("INFO") && lines[1].contains("n_failures=3"), "{log}");
    }

    #[tokio::test(start_paused = true)]
    async fn another_reason_is_logged_again() {
        let (_, _, log) = retried(vec![away("refused"), away("speaks TLS"), Ok(7)]).await;
        assert_eq!(log.lines().count(), 3, "{log}");
        assert!(log.contains("speaks TLS"), "{log}");
    }

    #[tokio::test(start_paused = true)]
    async fn a_call_that_succeeds_at_once_is_not_logged() {
        assert_eq!(retried(vec![Ok(7)]).await, (Ok(7), Duration::ZERO, String::new()));
    }

    #[tokio::test(start_paused = true)]
    async fn an_error_that_repetition_cannot_cure_is_returned_at_once() {
        for (error, code) in [
            (Status::failed_precondition("another version"), Code::FailedPrecondition),
            (Status::unauthenticated("wrong token"), Code::Unauthenticated),
            (Status::not_found("no such worker"), Code::NotFound),
        ] {
            let (outcome, elapsed, _) = retried(vec![Err(error)]).await;
            assert_eq!((outcome, elapsed), (Err(code), Duration::ZERO));
        }
    }

    #[tokio::test(start_paused = true)]
    async fn an_attempt_without_an_answer_ends_at_its_deadline() {
        let (outcome, _, log) = retried(Vec::new()).await;
        assert_eq!(outcome, Err(Code::Cancelled), "it is repeated until the test ends it");
        assert!(log.contains("no answer within 5s"), "{log}");
        assert_eq!(log.lines().count(), 1, "{log}");
    }
}
