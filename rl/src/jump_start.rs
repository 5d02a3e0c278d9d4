//! The horizon of strategy `jsrl:H` (Jump-Start RL, Uchendu et al. 2023): the number of steps, at the start of an
//! advised episode, on which the teacher acts.
//!
//! It falls from H to 0 as the student's own success rises: `h = ⌈H · (1 − s / 0.7)⌉` for the success rate s of a
//! window of training episodes without advice, and never rises again. (Uchendu et al. lower it by a fixed step whenever
//! the success of teacher and student together is within a tolerance of the best; a student that does not improve then
//! costs the full horizon for good.) These episodes explore and so succeed less often than evaluations: the horizon is
//! 0 at a rate of 0.7 already. Late in a run, some of them may be played without exploration
//! (`rounds.final_greedy_share`); they count like the others. If all episodes are advised, all of them count.
//!
//! Pure: the horizon of a round depends on the episodes of the rounds up to the one before the previous round. So it is
//! known when the round is ordered, with `rounds.lag` 0 and 1, and again when a run resumes.

/// Episodes of a window, rounded up to whole rounds.
pub const WINDOW_EPISODES: u32 = 32;
/// The success rate of these episodes from which on the teacher does not act.
pub const TARGET_SUCCESS: f64 = 0.7;

/// The horizons of the present and the next round, and the window that decides the one after them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct JumpStart {
    /// `H`, control steps.
    max_horizon: u32,
    /// The horizon of the round to be learned next, control steps.
    present: u32,
    /// The horizon of the round after it.
    next: u32,
    /// Episodes of the window so far.
    n_episodes: u32,
    /// Those that succeeded.
    n_succeeded: u32,
}

impl JumpStart {
    /// Creates the state before the first round, with horizon `max_horizon`, control steps.
    #[must_use]
    pub const fn new(max_horizon: u32) -> Self {
        Self { max_horizon, present: max_horizon, next: max_horizon, n_episodes: 0, n_succeeded: 0 }
    }

    /// Returns the horizon of a round, control steps: the one to be learned next (0), or the one after it (1). Later
    /// rounds are not decided yet, and have that of round 1.
    #[must_use]
    pub const fn horizon(&self, n_rounds_ahead: u64) -> u32 {
        if n_rounds_ahead == 0 { self.present } else { self.next }
    }

    /// Learns the outcome of a round: `n_succeeded` of its `n_episodes` episodes that count succeeded.
    pub fn finish_round(&mut self, n_episodes: u32, n_succeeded: u32) {
        self.n_episodes += n_episodes;
        self.n_succeeded += n_succeeded;
        self.present = self.next;
        if self.n_episodes >= WINDOW_EPISODES {
            let success = f64::from(self.n_succeeded) / f64::from(self.n_episodes);
            self.next = self.next.min(horizon_at(self.max_horizon, success));
            (self.n_episodes, self.n_succeeded) = (0, 0);
        }
    }

    /// Returns the state without `H`, as a checkpoint stores it: the horizons of the present and the next round, and
    /// the episodes of the window and those of them that succeeded.
    #[must_use]
    pub const fn state(&self) -> [u32; 4] {
        [self.present, self.next, self.n_episodes, self.n_succeeded]
    }

    /// Restores the state of a run with horizon `max_horizon`; returns `None` if no run has it.
    #[must_use]
    pub fn from_state(max_horizon: u32, state: [u32; 4]) -> Option<Self> {
        let [present, next, n_episodes, n_succeeded] = state;
        let is_valid = next <= present
            && present <= max_horizon
            && n_episodes < WINDOW_EPISODES
            && n_succeeded <= n_episodes;
        is_valid.then_some(Self { max_horizon, present, next, n_episodes, n_succeeded })
    }
}

/// Returns the horizon at success rate `success`, in [0, 1].
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a whole number from 0 to max_horizon"
)]
fn horizon_at(max_horizon: u32, success: f64) -> u32 {
    let missing = (1.0 - success / TARGET_SUCCESS).max(0.0);
    (f64::from(max_horizon) * missing).ceil() as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_horizon_falls_with_success_to_zero() {
        let check = |success, horizon| assert_eq!(horizon_at(20, success), horizon, "{success}");
        check(0.0, 20);
        check(0.1, 18);
        check(0.35, 10);
        check(0.69, 1);
        check(0.7, 0);
        check(1.0, 0);
    }

    #[test]
    fn a_window_takes_effect_after_the_round_that_may_be_played_already() {
        let mut jump_start = JumpStart::new(20);
        jump_start.finish_round(16, 8);
        assert_eq!([0, 1, 2].map(|ahead| jump_start.horizon(ahead)), [20, 20, 20], "half a window");
        jump_start.finish_round(16, 8);
        assert_eq!([0, 1, 2].map(|ahead| jump_start.horizon(ahead)), [20, 6, 6]);
        jump_start.finish_round(16, 0);
        assert_eq!([0, 1].map(|ahead| jump_start.horizon(ahead)), [6, 6]);
        jump_start.finish_round(16, 0);
        assert_eq!([0, 1].map(|ahead| jump_start.horizon(ahead)), [6, 6], "it never rises");
        jump_start.finish_round(32, 32);
        assert_eq!([0, 1].map(|ahead| jump_start.horizon(ahead)), [6, 0]);
    }

    #[test]
    fn a_state_is_restored_unless_no_run_has_it() {
        let mut jump_start = JumpStart::new(20);
        jump_start.finish_round(32, 8);
        jump_start.finish_round(5, 3);
        assert_eq!(JumpStart::from_state(20, jump_start.state()), Some(jump_start));
        for state in [[21, 20, 0, 0], [9, 10, 0, 0], [20, 20, 32, 0], [20, 20, 4, 5]] {
            assert_eq!(JumpStart::from_state(20, state), None, "{state:?}");
        }
    }
}
