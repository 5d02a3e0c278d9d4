//! The memory of which steps were asked about and what they cost: three bits a step.

use std::collections::BTreeMap;

use super::{Half, Verdict};

/// Steps whose verdicts fit into one word: more than an episode of a run has.
pub(crate) const STEPS_PER_WORD: u32 = 64;

/// The verdicts on [`STEPS_PER_WORD`] steps that follow one another; the first step is the lowest bit.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Word {
    /// Steps that were asked about.
    pub(crate) asked: u64,
    /// Those of them that cost a unit.
    pub(crate) charged: u64,
    /// Those of them whose unit was of the first half.
    pub(crate) first_half: u64,
}

/// Where a word stands: its episode and `step / STEPS_PER_WORD`.
pub(crate) type WordIndex = (u64, u32);

/// Verdicts by episode and step. An episode of up to 64 steps takes one word of 24 bytes.
#[derive(Debug, Clone, Default)]
pub(super) struct Verdicts {
    words: BTreeMap<WordIndex, Word>,
}

impl Word {
    /// Whether each bit that needs another has it.
    pub(crate) const fn is_sound(self) -> bool {
        self.charged & !self.asked == 0 && self.first_half & !self.charged == 0
    }

    const fn get(self, bit: u64) -> Option<Verdict> {
        if self.asked & bit == 0 {
            None
        } else if self.charged & bit == 0 {
            Some(Verdict::Uncharged)
        } else if self.first_half & bit == 0 {
            Some(Verdict::Charged(Half::Second))
        } else {
            Some(Verdict::Charged(Half::First))
        }
    }
}

impl Verdicts {
    /// The verdict on a step, when it was asked about before.
    pub(super) fn get(&self, episode: u64, step: u32) -> Option<Verdict> {
        self.words.get(&index(episode, step))?.get(bit(step))
    }

    /// Remembers the verdict on a step that was not asked about before.
    pub(super) fn insert(&mut self, episode: u64, step: u32, verdict: Verdict) {
        debug_assert_eq!(self.get(episode, step), None, "a verdict stands");
        let word = self.words.entry(index(episode, step)).or_default();
        word.asked |= bit(step);
        if let Verdict::Charged(half) = verdict {
            word.charged |= bit(step);
            if half == Half::First {
                word.first_half |= bit(step);
            }
        }
    }

    /// The word at `index`, when one of its steps was asked about.
    pub(super) fn word(&self, index: WordIndex) -> Option<Word> {
        self.words.get(&index).copied()
    }

    /// Puts `word`, or none, at `index`.
    pub(super) fn set_word(&mut self, index: WordIndex, word: Option<Word>) {
        match word {
            Some(word) => drop(self.words.insert(index, word)),
            None => drop(self.words.remove(&index)),
        }
    }

    /// How many units `episode` was charged.
    pub(super) fn n_charged(&self, episode: u64) -> u64 {
        let words = self.words.range((episode, 0)..=(episode, u32::MAX));
        words.map(|(_, word)| u64::from(word.charged.count_ones())).sum()
    }
}

/// Where the word of a step stands.
pub(super) const fn index(episode: u64, step: u32) -> WordIndex {
    (episode, step / STEPS_PER_WORD)
}

/// A step's bit in its word.
const fn bit(step: u32) -> u64 {
    1 << (step % STEPS_PER_WORD)
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
        assert_eq!((verdicts.n_charged(5), verdicts.n_charged(u64::MAX)), (133, 0));
    }

    #[test]
    fn a_word_with_a_bit_that_lacks_another_is_not_sound() {
        let word = |asked, charged, first_half| Word { asked, charged, first_half };
        assert!(word(0b1111, 0b0110, 0b0010).is_sound());
        assert!(!word(0b1011, 0b0110, 0b0010).is_sound());
        assert!(!word(0b1111, 0b0110, 0b1000).is_sound());
    }
}
