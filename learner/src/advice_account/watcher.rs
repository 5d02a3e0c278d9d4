//! Watches the run's account at the teacher, beside the learning thread.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tandem_net::{AuthChannel, within};
use tandem_proto::pb;
use tandem_proto::pb::teacher_client::TeacherClient;
use tandem_telemetry::{TeacherState, TeacherView};
use tokio::sync::watch;
use tonic::{Code, Status};

use super::CALL_DEADLINE;
use crate::shared::Clock;
use crate::warnings::{Source, Warnings};

/// Pause between two checks whether the teacher still knows the account. Workers wait for a lost account to be opened
/// again.
const CHECK_PERIOD: Duration = Duration::from_secs(1);
/// Time without an answer after which the run has a warning. A supervisor restarts its teacher within this time.
const WARN_AFTER: Duration = Duration::from_secs(5);
/// Largest number of characters of an error in the warning.
const MAX_ERROR_CHARS: usize = 200;
/// Number of characters of a policy's digest in the warning.
const N_DIGEST_CHARS: usize = 12;

/// Asks for the account about once a second.
pub(super) struct AccountWatcher {
    client: TeacherClient<AuthChannel>,
    /// The digest of the teacher's policy when the run began.
    policy: String,
    /// Set when the teacher reports that it does not know the account.
    lost: Arc<AtomicBool>,
    status: TeacherStatus,
}

impl AccountWatcher {
    pub(super) fn new(
        (client, policy): (TeacherClient<AuthChannel>, String),
        lost: Arc<AtomicBool>,
        (warnings, view): (Warnings, watch::Sender<TeacherView>),
        clock: Clock,
    ) -> Self {
        let answered_at = clock();
        let status = TeacherStatus { warnings, view, clock, answered_at, is_warned: false };
        Self { client, policy, lost, status }
    }

    pub(super) async fn watch(mut self, name: String) {
        loop {
            tokio::time::sleep(CHECK_PERIOD).await;
            let look = self.client.get_account(pb::GetAccountRequest { name: name.clone() });
            let answer = within(CALL_DEADLINE, look).await.map(tonic::Response::into_inner);
            match self.status.record(answer) {
                TeacherState::Lost => self.lost.store(true, Ordering::Relaxed),
                TeacherState::Answering => self.check_policy().await,
                TeacherState::None | TeacherState::Unreachable => {}
            }
        }
    }

    async fn check_policy(&mut self) {
        let look = self.client.describe(pb::DescribeRequest {});
        let Ok(described) = within(CALL_DEADLINE, look).await else { return };
        let now = described.into_inner().policy_digest;
        warn_of_other_policy(&self.status.warnings, &now, &self.policy, false);
    }
}

/// Warns if the teacher was restarted with another policy than the `first` one, perhaps for another task: requests for
/// advice do not name the policy. The warning remains, with another text, once the first policy is back, because the
/// run has learned from the other one's advice. `had_other` is true if an earlier part of the run had this warning.
pub(super) fn warn_of_other_policy(warnings: &Warnings, now: &str, first: &str, had_other: bool) {
    let is_first = now == first;
    if is_first && !had_other && warnings.of(Source::Policy).is_none() {
        return;
    }
    let shown = |digest: &str| digest.chars().take(N_DIGEST_CHARS).collect::<String>();
    let first = shown(first);
    let warning = if is_first {
        format!(
            "the teacher advised by another policy for a while and has its first one, {first}, again: the run has \
             learned from the advice of both"
        )
    } else {
        let now = shown(now);
        format!(
            "the teacher was restarted with another policy, {now} instead of {first}, and advises differently: restart \
             it with the first one"
        )
    };
    warnings.set_latest(Source::Policy, &warning);
}

/// The state of the teacher, as displays and the progress show it.
struct TeacherStatus {
    /// Receives the teacher's warning.
    warnings: Warnings,
    /// Receives the state of the teacher.
    view: watch::Sender<TeacherView>,
    clock: Clock,
    /// Time of the latest answer.
    answered_at: Duration,
    /// True while the warning is about that silence.
    is_warned: bool,
}

impl TeacherStatus {
    /// Records the answer to a call and returns the state that it shows.
    fn record(&mut self, answer: Result<pb::Account, Status>) -> TeacherState {
        let (state, error) = match &answer {
            Ok(account) => {
                self.end_silence(&account.warning);
                (TeacherState::Answering, String::new())
            }
            Err(status) if status.code() == Code::NotFound => {
                self.end_silence("");
                (TeacherState::Lost, status.message().to_owned())
            }
            Err(status) => {
                self.warn_of_silence(status.message());
                (TeacherState::Unreachable, status.message().to_owned())
            }
        };
        self.view.send_modify(|view| {
            (view.state, view.error) = (state, error);
            if let Ok(pb::Account { name, budget, spent, leased, warning, .. }) = answer {
                (view.account, view.warning) = (name, warning);
                (view.budget, view.spent, view.leased) = (budget, spent, leased);
            }
        });
        state
    }

    /// Warns once of a teacher that has not answered for [`WARN_AFTER`]; later errors may differ from the first.
    fn warn_of_silence(&mut self, error: &str) {
        let now = (self.clock)();
        if now.saturating_sub(self.answered_at) < WARN_AFTER || self.is_warned {
            return;
        }
        self.is_warned = true;
        let error: String = error.chars().take(MAX_ERROR_CHARS).collect();
        let warning = format!("the teacher does not answer, the run waits for it: {error}");
        self.warnings.set(Source::Teacher, &warning);
    }

    /// Replaces the warning by that of a teacher that answers.
    fn end_silence(&mut self, warning: &str) {
        (self.answered_at, self.is_warned) = ((self.clock)(), false);
        self.warnings.set(Source::Teacher, warning);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicU64;

    use super::*;
    use crate::progress::Progress;

    #[test]
    fn the_warning_about_another_policy_names_the_latest_one_and_remains() {
        let (progress, shown) = watch::channel(Progress::default());
        let warnings = Warnings::new(progress);
        let other = |now: &str| {
            format!(
                "the teacher was restarted with another policy, {now} instead of a1, and advises differently: restart \
                 it with the first one"
            )
        };
        let both = "the teacher advised by another policy for a while and has its first one, a1, again: the run has \
                    learned from the advice of both";
        for (now, expected) in [
            ("a1", String::new()),
            ("b2", other("b2")),
            ("c3", other("c3")),
            ("a1", both.to_owned()),
            ("a1", both.to_owned()),
            ("b2", other("b2")),
        ] {
            warn_of_other_policy(&warnings, now, "a1", false);
            assert_eq!(shown.borrow().warning, expected);
        }
    }

    #[test]
    fn a_silent_teacher_is_warned_of_once_and_until_it_answers() {
        let (progress, shown) = watch::channel(Progress::default());
        let (view, _) = watch::channel(TeacherView::default());
        let now_s = Arc::new(AtomicU64::new(0));
        let time = now_s.clone();
        let clock: Clock = Arc::new(move || Duration::from_secs(time.load(Ordering::Relaxed)));
        let mut status = TeacherStatus {
            warnings: Warnings::new(progress),
            view,
            clock,
            answered_at: Duration::ZERO,
            is_warned: false,
        };
        let mut check = |at_s, answer: Result<&str, &str>, expected: &str| {
            now_s.store(at_s, Ordering::Relaxed);
            status.record(match answer {
                Ok(warning) => {
                    Ok(pb::Account { warning: warning.to_owned(), ..Default::default() })
                }
                Err(error) => Err(Status::unavailable(error)),
            });
            assert_eq!(shown.borrow().warning, expected, "at {at_s} s");
        };
        let silent = "the teacher does not answer, the run waits for it: refused";
        check(100, Ok(""), "");
        check(101, Err("timeout"), "");
        check(104, Err("timeout"), "");
        check(105, Err("refused"), silent);
        check(107, Err("timeout"), silent);
        check(108, Ok(""), "");
        check(112, Err("refused"), "");
        check(113, Err("refused"), silent);
        check(119, Ok("the disk is full"), "the disk is full");
    }
}
