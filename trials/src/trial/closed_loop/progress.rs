//! The progress of a trial: which hands are blocked by objects, and how long the objects have not moved.

use glam::DVec3;

/// An object that is displaced by less rests, metres.
const REST_TOLERANCE_M: f64 = 0.015;
/// The arms are idle when all misplaced objects have rested for this many steps.
const MAX_IDLE: usize = 20;

/// How many steps the hands have been held up and the objects have rested.
pub(super) struct Progress {
    /// Whether a block kept each hand from where it was to be after the last step.
    held_up: Vec<bool>,
    /// The number of consecutive steps, up to the last one, after which that was so.
    n_held_up: Vec<usize>,
    /// Where the objects were when a misplaced one was last displaced, arm frames, metres.
    rested: Vec<DVec3>,
    /// The number of observations since.
    n_idle: usize,
}

impl Progress {
    pub(super) fn new(n_arms: usize) -> Self {
        let (held_up, n_held_up) = (vec![false; n_arms], vec![0; n_arms]);
        Self { held_up, n_held_up, rested: Vec::new(), n_idle: 0 }
    }

    /// Records which hands a motion left held up.
    pub(super) fn hold_up(&mut self, held_up: Vec<bool>) {
        self.held_up = held_up;
    }

    /// Returns whether a hand was held up in the last motion.
    pub(super) fn is_held_up(&self) -> bool {
        self.held_up.contains(&true)
    }

    /// Counts a step that starts with the objects at `objects`, arm frames, metres. `misplaced` says which of them are
    /// away from their goals.
    pub(super) fn see(&mut self, objects: &[DVec3], misplaced: &[bool]) {
        for (n_held_up, is_held_up) in self.n_held_up.iter_mut().zip(&self.held_up) {
            *n_held_up = if *is_held_up { *n_held_up + 1 } else { 0 };
        }
        let mut each = objects.iter().zip(misplaced).zip(&self.rested);
        let rests = each.all(|((object, misplaced), rested)| {
            !misplaced || (object - rested).length() < REST_TOLERANCE_M
        });
        if rests && self.rested.len() == objects.len() {
            self.n_idle += 1;
        } else {
            (self.rested, self.n_idle) = (objects.to_vec(), 0);
        }
    }

    /// The number of consecutive steps after which the hand of `arm` was held up.
    pub(super) fn n_held_up(&self, arm: usize) -> usize {
        self.n_held_up[arm]
    }

    /// Returns whether no misplaced object has moved for [`MAX_IDLE`] steps.
    pub(super) fn is_idle(&self) -> bool {
        self.n_idle >= MAX_IDLE
    }

    /// Resets the count of steps without a displacement.
    pub(super) fn start_again(&mut self) {
        self.n_idle = 0;
    }

    /// Resets the count of steps in which the hand of `arm` was held up.
    pub(super) fn release(&mut self, arm: usize) {
        self.n_held_up[arm] = 0;
        self.held_up[arm] = false;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hands_that_are_held_up_step_after_step_are_counted() {
        let mut progress = Progress::new(2);
        for n_held_up in 1..=3 {
            progress.hold_up(vec![false, true]);
            assert!(progress.is_held_up());
            progress.see(&[DVec3::ZERO; 2], &[true; 2]);
            assert_eq!([0, 1].map(|arm| progress.n_held_up(arm)), [0, n_held_up]);
        }
        progress.hold_up(vec![false, false]);
        progress.see(&[DVec3::ZERO; 2], &[true; 2]);
        assert!(!progress.is_held_up());
        assert_eq!(progress.n_held_up(1), 0);
    }

    #[test]
    fn arms_are_idle_until_a_misplaced_object_is_displaced() {
        let mut progress = Progress::new(2);
        let mut see = |x_m: f64, n: usize| {
            for step in 0..n {
                let placed = DVec3::Y * step as f64;
                progress.see(&[DVec3::X * x_m, placed], &[true, false]);
            }
            progress.is_idle()
        };
        assert!(!see(0.0, MAX_IDLE));
        assert!(see(0.01, 1), "neither noise nor what happens to placed objects counts");
        assert!(!see(0.02, MAX_IDLE));
        assert!(see(0.02, 1));
    }
}
