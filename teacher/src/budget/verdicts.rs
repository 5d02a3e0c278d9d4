//! The memory of which steps were asked about and what they cost: two bits a step.

use std::collections::BTreeMap;

use super::{Half, Verdict};

/// Steps whose verdicts fit into one word: more than an episode of a run has.
const STEPS_PER_WORD: u32 = 64;

/// Verdicts by episode and step. An episode of up to 64 steps takes one word of 16 bytes.
#[derive(Debug, Clone, Default)]
pub(super) struct Verdicts {
    /// By episode and `step / STEPS_PER_WORD`.
    words: BTreeMap<(u64, u32), u128>,
}

impl Verdicts {
    /// The verdict on a step, when it was asked about before.
    pub(super) fn get(&self, episode: u64, step: u32) -> Option<Verdict> {
        let word = self.words.get(&(episode, step / STEPS_PER_WORD))?;
        match (word >> shift(step)) & 0b11 {
            0b01 => Some(Verdict::Uncharged),
            0b10 => Some(Verdict::Charged(Half::First)),
            0b11 => Some(Verdict::Charged(Half::Second)),
            _ => None,
        }
    }

    /// Remembers the verdict on a step that was not asked about before.
    pub(super) fn insert(&mut self, episode: u64, step: u32, verdict: Verdict) {
        debug_assert_eq!(self.get(episode, step), None, "a verdict stands");
        let bits: u128 = match verdict {
            Verdict::Uncharged => 0b01,
            Verdict::Charged(Half::First) => 0b10,
            Verdict::Charged(Half::Second) => 0b11,
        };
        *self.words.entry((episode, step / STEPS_PER_WORD)).or_default() |= bits << shift(step);
    }
}

/// Where a step's two bits stand in its word.
const fn shift(step: u32) -> u32 {
    2 * (step % STEPS_PER_WORD)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_step_keeps_its_own_verdict() {
        let verdict_of = |step: u32| match step % 3 {
            0 => Verdict::Uncharged,
            1 => Verdict::Charged(Half::First),
            _ => Verdict::Charged(Half::Second),
        };
        let mut verdicts = Verdicts::default();
        for step in (0..200).rev() {
            verdicts.insert(5, step, verdict_of(step));
            assert_eq!(step.checked_sub(1).and_then(|before| verdicts.get(5, before)), None);
        }
        verdicts.insert(u64::MAX, u32::MAX, Verdict::Uncharged);
        assert!((0..200).all(|step| verdicts.get(5, step) == Some(verdict_of(step))));
        assert_eq!(verdicts.get(5, 200), None);
        assert_eq!(verdicts.get(4, 0), None);
        assert_eq!(verdicts.get(u64::MAX, u32::MAX), Some(Verdict::Uncharged));
    }
}
