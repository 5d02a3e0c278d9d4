//! Combines the states of single arms into states of the pair. Pure.

use crate::driver::{DriverError, PairState};
use crate::kinova_ros::protocol::ArmMessage;

/// The newest states of the arms.
#[derive(Debug, Clone)]
pub(crate) struct StateMerger {
    /// The newest message of each arm.
    newest: Vec<Option<ArmMessage>>,
    /// True for arms that have reported since the last state of the pair, near enough to the other arms.
    new: Vec<bool>,
    /// True for arms whose newest message no state of the pair contains.
    is_unseen: Vec<bool>,
    sequence: u64,
    /// Largest difference between the time stamps of one state, seconds.
    skew_s: f64,
    /// The number of consecutive states with a larger difference.
    n_skewed: u32,
}

/// Consecutive states with too large a difference that indicate different clocks. Fewer may come from delayed messages.
const MAX_SKEWED: u32 = 10;

impl StateMerger {
    pub(crate) fn new(n_arms: usize, skew_s: f64) -> Self {
        Self {
            newest: vec![None; n_arms],
            new: vec![false; n_arms],
            is_unseen: vec![false; n_arms],
            sequence: 0,
            skew_s,
            n_skewed: 0,
        }
    }

    /// Adds the message of an arm. Messages that are not newer than the last one are ignored. The largest torques of
    /// those that no state of the pair contains are kept.
    pub(crate) fn push(&mut self, arm: usize, mut message: ArmMessage) {
        let known = self.newest[arm].as_ref().map_or(f64::NEG_INFINITY, |newest| newest.stamp_s);
        if message.stamp_s > known {
            if let Some(before) = self.newest[arm].as_ref().filter(|_| self.is_unseen[arm]) {
                message.reading.keep_peaks(&before.reading);
            }
            self.newest[arm] = Some(message);
            (self.new[arm], self.is_unseen[arm]) = (true, true);
        }
    }

    /// Returns a state of the pair once every arm has reported. Its time stamp is the oldest one. An arm whose time
    /// stamp is too far behind the others has to report again first.
    pub(crate) fn take(&mut self) -> Result<Option<PairState>, DriverError> {
        if !self.new.iter().all(|new| *new) {
            return Ok(None);
        }
        let messages: Vec<&ArmMessage> = self.newest.iter().flatten().collect();
        let stamps = || messages.iter().map(|message| message.stamp_s);
        let (oldest_s, newest_s) =
            (stamps().fold(f64::INFINITY, f64::min), stamps().fold(f64::NEG_INFINITY, f64::max));
        if newest_s - oldest_s > self.skew_s {
            self.n_skewed += 1;
            if self.n_skewed < MAX_SKEWED {
                for (new, message) in self.new.iter_mut().zip(&messages) {
                    *new = newest_s - message.stamp_s <= self.skew_s;
                }
                return Ok(None);
            }
            let what = format!(
                "the arms' states are {:.3} s apart, at most {:.3}: do their nodes report at the same rate, with the same clock?",
                newest_s - oldest_s,
                self.skew_s
            );
            return Err(DriverError::Malformed { what });
        }
        self.n_skewed = 0;
        self.sequence += 1;
        let arms = messages.iter().map(|message| message.reading.clone()).collect();
        self.new.fill(false);
        self.is_unseen.fill(false);
        let (sequence, stamp_s) = (self.sequence, oldest_s);
        Ok(Some(PairState { sequence, stamp_s, newest_command: None, arms }))
    }
}

#[cfg(test)]
mod tests {
    use tandem_kinematics::Joints;

    use super::*;
    use crate::driver::{ArmReading, Faults};

    fn message(stamp_s: f64) -> ArmMessage {
        let joints = Joints::from_fn(4, |_| stamp_s);
        let faults = Faults::default();
        let reading = ArmReading {
            angles: joints,
            velocities: joints,
            torques_nm: None,
            opening: 1.0,
            faults,
        };
        ArmMessage { stamp_s, reading }
    }

    #[test]
    fn a_state_is_new_when_both_arms_have_reported() {
        let mut merge = StateMerger::new(2, 0.1);
        merge.push(0, message(5.00));
        assert_eq!(merge.take(), Ok(None));
        merge.push(0, message(5.01));
        merge.push(1, message(4.99));
        let state = merge.take().unwrap().unwrap();
        assert_eq!((state.sequence, state.stamp_s), (1, 4.99));
        assert_eq!([state.arms[0].angles[0], state.arms[1].angles[0]], [5.01, 4.99]);
        assert_eq!(merge.take(), Ok(None));
        // Repeated and overtaken messages are ignored.
        merge.push(1, message(4.99));
        merge.push(0, message(5.00));
        assert_eq!(merge.take(), Ok(None));
        merge.push(0, message(5.02));
        merge.push(1, message(5.02));
        let state = merge.take().unwrap().unwrap();
        assert_eq!((state.sequence, state.stamp_s), (2, 5.02));
    }

    #[test]
    fn a_torque_counts_until_a_state_of_the_pair_contains_it() {
        let with_torque = |stamp_s: f64, torque_nm: f64| {
            let mut message = message(stamp_s);
            message.reading.torques_nm = Some(Joints::from_fn(4, |_| torque_nm));
            message
        };
        let mut merge = StateMerger::new(2, 0.1);
        let mut torque_nm = |reports: [(usize, f64, f64); 3]| {
            for (arm, stamp_s, torque_nm) in reports {
                merge.push(arm, with_torque(stamp_s, torque_nm));
            }
            merge.take().unwrap().map(|state| state.arms[0].torques_nm.unwrap()[0])
        };
        assert_eq!(torque_nm([(0, 5.00, -8.0), (0, 5.01, 1.0), (1, 5.01, 0.0)]), Some(-8.0));
        assert_eq!(torque_nm([(0, 5.02, 1.0), (0, 5.03, 2.0), (1, 5.03, 0.0)]), Some(2.0));
        // The first arm's reports are too old for a state of the pair.
        assert_eq!(torque_nm([(0, 5.04, 1.0), (0, 5.05, 9.0), (1, 5.40, 0.0)]), None);
        assert_eq!(torque_nm([(0, 5.41, 1.0), (0, 5.42, 2.0), (1, 5.42, 0.0)]), Some(9.0));
    }

    #[test]
    fn arms_with_other_clocks_are_refused() {
        let mut merge = StateMerger::new(2, 0.1);
        let error = (0..20).find_map(|n| {
            merge.push(0, message(5.0 + 0.01 * f64::from(n)));
            merge.push(1, message(5.2 + 0.01 * f64::from(n)));
            merge.take().map(|state| assert_eq!(state, None)).err()
        });
        let error = error.unwrap().to_string();
        assert!(error.contains("0.200 s apart"), "{error}");
    }

    #[test]
    fn a_delayed_arm_is_waited_for() {
        let mut merge = StateMerger::new(2, 0.1);
        for held_up_s in [5.0, 5.01, 5.02] {
            merge.push(0, message(held_up_s));
            merge.push(1, message(5.5));
            assert_eq!(merge.take(), Ok(None));
        }
        merge.push(0, message(5.49));
        let state = merge.take().unwrap().unwrap();
        assert_eq!((state.sequence, state.stamp_s), (1, 5.49));
        assert_eq!([state.arms[0].angles[0], state.arms[1].angles[0]], [5.49, 5.5]);
    }
}
