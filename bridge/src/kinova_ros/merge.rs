//! Makes states of the pair of what its arms tell one by one. Pure.

use crate::driver::{DriverError, PairState};
use crate::kinova_ros::protocol::Told;

/// What the arms have told.
#[derive(Debug, Clone)]
pub(crate) struct Merge {
    /// Arm by arm.
    newest: Vec<Option<Told>>,
    /// Whether an arm has told anew since the last state of the pair.
    new: Vec<bool>,
    sequence: u64,
    /// What stamps of one state may be apart, seconds.
    skew_s: f64,
    /// How often in a row they were further apart.
    n_skewed: u32,
}

/// States in a row whose parts are too far apart, until the clocks are to blame. One arm may tell what was held up on its way before it
/// tells anything newer.
const MOST_SKEWED: u32 = 10;

impl Merge {
    pub(crate) fn new(n_arms: usize, skew_s: f64) -> Self {
        let (newest, new) = (vec![None; n_arms], vec![false; n_arms]);
        Self { newest, new, sequence: 0, skew_s, n_skewed: 0 }
    }

    /// Notes what an arm tells. What is not newer than what it told before is late or comes twice, and is nothing new.
    pub(crate) fn note(&mut self, arm: usize, told: Told) {
        let known = self.newest[arm].as_ref().map_or(f64::NEG_INFINITY, |told| told.stamp_s);
        if told.stamp_s > known {
            self.newest[arm] = Some(told);
            self.new[arm] = true;
        }
    }

    /// A state of the pair, when every arm has told anew; it is as old as the oldest part of it. An arm that lags behind the others has to
    /// tell once more first.
    pub(crate) fn take(&mut self) -> Result<Option<PairState>, DriverError> {
        if !self.new.iter().all(|new| *new) {
            return Ok(None);
        }
        let told: Vec<&Told> = self.newest.iter().flatten().collect();
        let stamps = || told.iter().map(|told| told.stamp_s);
        let (oldest_s, newest_s) =
            (stamps().fold(f64::INFINITY, f64::min), stamps().fold(f64::NEG_INFINITY, f64::max));
        if newest_s - oldest_s > self.skew_s {
            self.n_skewed += 1;
            if self.n_skewed < MOST_SKEWED {
                for (new, told) in self.new.iter_mut().zip(&told) {
                    *new = newest_s - told.stamp_s <= self.skew_s;
                }
                return Ok(None);
            }
            let what = format!(
                "the arms' states are {:.3} s apart, at most {:.3}: do their nodes tell equally often, by the same clock?",
                newest_s - oldest_s,
                self.skew_s
            );
            return Err(DriverError::Malformed { what });
        }
        self.n_skewed = 0;
        self.sequence += 1;
        let arms = told.iter().map(|told| told.reading.clone()).collect();
        self.new.fill(false);
        let (sequence, stamp_s) = (self.sequence, oldest_s);
        Ok(Some(PairState { sequence, stamp_s, newest_command: None, arms }))
    }
}

#[cfg(test)]
mod tests {
    use tandem_kinematics::Joints;

    use super::*;
    use crate::driver::{ArmReading, Faults};

    fn told(stamp_s: f64) -> Told {
        let joints = Joints::from_fn(4, |_| stamp_s);
        let faults = Faults::default();
        let reading = ArmReading {
            angles: joints,
            velocities: joints,
            torques_nm: None,
            opening: 1.0,
            faults,
        };
        Told { stamp_s, reading }
    }

    #[test]
    fn a_state_is_new_when_both_arms_have_told() {
        let mut merge = Merge::new(2, 0.1);
        merge.note(0, told(5.00));
        assert_eq!(merge.take(), Ok(None));
        merge.note(0, told(5.01));
        merge.note(1, told(4.99));
        let state = merge.take().unwrap().unwrap();
        assert_eq!((state.sequence, state.stamp_s), (1, 4.99));
        assert_eq!([state.arms[0].angles[0], state.arms[1].angles[0]], [5.01, 4.99]);
        assert_eq!(merge.take(), Ok(None));
        // The same again, or what was overtaken, is nothing new.
        merge.note(1, told(4.99));
        merge.note(0, told(5.00));
        assert_eq!(merge.take(), Ok(None));
        merge.note(0, told(5.02));
        merge.note(1, told(5.02));
        let state = merge.take().unwrap().unwrap();
        assert_eq!((state.sequence, state.stamp_s), (2, 5.02));
    }

    #[test]
    fn arms_with_other_clocks_are_refused() {
        let mut merge = Merge::new(2, 0.1);
        let error = (0..20).find_map(|n| {
            merge.note(0, told(5.0 + 0.01 * f64::from(n)));
            merge.note(1, told(5.2 + 0.01 * f64::from(n)));
            merge.take().map(|state| assert_eq!(state, None)).err()
        });
        let error = error.unwrap().to_string();
        assert!(error.contains("0.200 s apart"), "{error}");
    }

    #[test]
    fn an_arm_that_was_held_up_is_waited_for() {
        let mut merge = Merge::new(2, 0.1);
        for held_up_s in [5.0, 5.01, 5.02] {
            merge.note(0, told(held_up_s));
            merge.note(1, told(5.5));
            assert_eq!(merge.take(), Ok(None));
        }
        merge.note(0, told(5.49));
        let state = merge.take().unwrap().unwrap();
        assert_eq!((state.sequence, state.stamp_s), (1, 5.49));
        assert_eq!([state.arms[0].angles[0], state.arms[1].angles[0]], [5.49, 5.5]);
    }
}
