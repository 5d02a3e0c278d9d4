//! The verdicts on steps, three bits for each step.

use std::collections::BTreeMap;

use super::BudgetHalf;

/// Steps whose verdicts share one [`VerdictBits`]: more than an episode of a built-in task has.
const STEPS_PER_WORD: u32 = 64;

/// The verdicts on 64 consecutive steps. The first step is the lowest bit.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct VerdictBits {
    /// Steps that were asked about.
    pub(crate) asked: u64,
    /// Of those, steps that cost a unit.
    pub(crate) charged: u64,
    /// Of those, steps whose unit belongs to the first half of the budget.
    pub(crate) first_half: u64,
}

/// The key of a [`VerdictBits`]: its episode and `step / 64`.
pub(crate) type VerdictIndex = (u64, u32);

/// Returns the key of the verdict on a step.
pub(super) const fn verdict_index(episode: u64, step: u32) -> VerdictIndex {
    (episode, step / STEPS_PER_WORD)
}

/// Returns the units charged to `episode`, by key.
pub(super) fn charged_units(
    verdicts: &BTreeMap<VerdictIndex, VerdictBits>,
    episode: u64,
) -> impl Iterator<Item = (&VerdictIndex, u64)> {
    let of_episode = verdicts.range((episode, 0)..=(episode, u32::MAX));
    of_episode.map(|(index, bits)| (index, bits.n_charged()))
}

impl VerdictBits {
    /// Returns true if each charged step was asked about, and each step of the first half was charged.
    pub(crate) const fn is_consistent(self) -> bool {
        self.charged & !self.asked == 0 && self.first_half & !self.charged == 0
    }

    /// Returns the number of charged steps.
    pub(super) fn n_charged(self) -> u64 {
        u64::from(self.charged.count_ones())
    }

    /// Returns the verdict on `step`, or `None` if the step was not asked about.
    pub(super) const fn get(self, step: u32) -> Option<Option<BudgetHalf>> {
        let bit = bit(step);
        if self.asked & bit == 0 {
            None
        } else if self.charged & bit == 0 {
            Some(None)
        } else if self.first_half & bit == 0 {
            Some(Some(BudgetHalf::Second))
        } else {
            Some(Some(BudgetHalf::First))
        }
    }

    /// Adds the verdict on `step`, which was not asked about before.
    pub(super) fn insert(&mut self, step: u32, verdict: Option<BudgetHalf>) {
        let bit = bit(step);
        self.asked |= bit;
        if verdict.is_some() {
            self.charged |= bit;
        }
        if verdict == Some(BudgetHalf::First) {
            self.first_half |= bit;
        }
    }
}

const fn bit(step: u32) -> u64 {
    1 << (step % STEPS_PER_WORD)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_step_keeps_its_own_verdict() {
        let verdict_of = |step: u32| match step % 3 {
            0 => None,
            1 => Some(BudgetHalf::First),
            _ => Some(BudgetHalf::Second),
        };
        let mut bits = VerdictBits::default();
        for step in (0..STEPS_PER_WORD).rev() {
            bits.insert(step, verdict_of(step));
            assert_eq!(step.checked_sub(1).and_then(|before| bits.get(before)), None);
        }
        assert!((0..STEPS_PER_WORD).all(|step| bits.get(step) == Some(verdict_of(step))));
        assert!(bits.is_consistent());
        assert_eq!(bits.n_charged(), 42);
    }

    #[test]
    fn a_step_beyond_64_has_another_index() {
        assert_eq!([0, 63, 64, 129].map(|step| verdict_index(5, step).1), [0, 0, 1, 2]);
        assert_eq!(verdict_index(u64::MAX, u32::MAX), (u64::MAX, u32::MAX / 64));
    }

    #[test]
    fn the_charged_units_of_an_episode_are_summed_over_all_of_its_steps() {
        let bits = |charged| VerdictBits { asked: charged, charged, first_half: 0 };
        let verdicts = [((4, 0), 1), ((5, 0), 0b111), ((5, 9), 0b1), ((6, 0), 1)];
        let verdicts = verdicts.map(|(index, charged)| (index, bits(charged))).into();
        assert_eq!(charged_units(&verdicts, 5).map(|(_, units)| units).sum::<u64>(), 4);
    }

    #[test]
    fn bits_that_contradict_one_another_are_inconsistent() {
        let bits = |asked, charged, first_half| VerdictBits { asked, charged, first_half };
        assert!(bits(0b1111, 0b0110, 0b0010).is_consistent());
        assert!(!bits(0b1011, 0b0110, 0b0010).is_consistent());
        assert!(!bits(0b1111, 0b0110, 0b1000).is_consistent());
    }
}
