//! The answers of the arms: new states arrive, and one of them confirms an order to stop.

use crate::driver::PairState;

/// The newest answer of the arms, and the one that is awaited.
#[derive(Debug, Default)]
pub(crate) struct Answers {
    /// The sequence number of the newest state.
    sequence: Option<u64>,
    /// The time of the newest answer, or of the first exchange, seconds.
    newest_s: Option<f64>,
    /// The number of the order to stop that a state has to confirm.
    awaited: Option<u64>,
}

impl Answers {
    /// Forgets all answers: the arms have a new connection, whose first command repeats an order to stop.
    pub(crate) fn restart(&mut self) {
        let awaited = self.awaited.map(|_| 1);
        *self = Self { awaited, ..Self::default() };
    }

    /// Awaits a state that confirms the order to stop with this number, unless an earlier one is not confirmed yet: all
    /// orders after that one are orders to stop too.
    pub(crate) fn await_stop(&mut self, number: u64) {
        self.awaited.get_or_insert(number);
    }

    /// Returns true if no order to stop awaits its confirmation.
    pub(crate) fn stop_is_confirmed(&self) -> bool {
        self.awaited.is_none()
    }

    /// Notes the state that the exchange of command `number` has returned at `now_s`. Returns the time since the newest
    /// answer, seconds.
    pub(crate) fn note(&mut self, state: &PairState, number: u64, now_s: f64) -> f64 {
        if self.sequence.replace(state.sequence) != Some(state.sequence) {
            self.newest_s = Some(now_s);
            let confirms = |awaited| match state.newest_command {
                Some(newest) => (awaited..=number).contains(&newest),
                // Arms that do not report it have at least sent this state after the order.
                None => number > awaited,
            };
            self.awaited = self.awaited.filter(|awaited| !confirms(*awaited));
        }
        now_s - *self.newest_s.get_or_insert(now_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(sequence: u64, newest_command: Option<u64>) -> PairState {
        PairState { sequence, stamp_s: 0.0, newest_command, arms: Vec::new() }
    }

    #[test]
    fn silence_is_the_time_without_a_new_state() {
        let mut answers = Answers::default();
        assert_eq!(answers.note(&state(7, None), 1, 10.0), 0.0);
        assert_eq!(answers.note(&state(7, None), 2, 10.5), 0.5);
        assert_eq!(answers.note(&state(8, None), 3, 11.0), 0.0);
        answers.restart();
        assert_eq!(answers.note(&state(8, None), 1, 12.0), 0.0);
    }

    #[test]
    fn a_stop_is_confirmed_by_a_state_that_reflects_it() {
        let mut answers = Answers::default();
        answers.note(&state(1, Some(0)), 1, 0.0);
        answers.await_stop(2);
        for (sequence, newest_command, is_confirmed) in [
            (1, Some(2), false), // The same state again.
            (2, Some(1), false),
            (3, Some(9), false), // The command of another client.
            (4, Some(2), true),
        ] {
            answers.note(&state(sequence, newest_command), 3, 0.0);
            assert_eq!(answers.stop_is_confirmed(), is_confirmed, "{sequence}");
        }
    }

    #[test]
    fn arms_without_echo_confirm_a_stop_by_a_state_after_it() {
        let mut answers = Answers::default();
        answers.await_stop(2);
        answers.note(&state(1, None), 2, 0.0);
        assert!(!answers.stop_is_confirmed(), "this state was sent before the order");
        answers.await_stop(3);
        answers.note(&state(2, None), 3, 0.0);
        assert!(answers.stop_is_confirmed());
    }
}
