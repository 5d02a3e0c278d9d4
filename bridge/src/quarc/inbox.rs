//! Makes states of the bytes that come, however they are cut. Pure.

use crate::driver::{DriverError, PairState};
use crate::quarc::codec::{STATE_BYTES, decode_state, from_bytes};

/// What has come and is not a whole vector yet.
#[derive(Debug, Clone, Default)]
pub(crate) struct Inbox {
    bytes: Vec<u8>,
    /// The sequence of the newest whole vector.
    sequence: Option<u64>,
}

impl Inbox {
    /// Takes the bytes that have come and returns the newest whole state among them, if one is complete now.
    pub(crate) fn take(&mut self, bytes: &[u8]) -> Result<Option<PairState>, DriverError> {
        self.bytes.extend_from_slice(bytes);
        let (vectors, rest) = self.bytes.as_chunks::<STATE_BYTES>();
        let mut newest = None;
        for vector in vectors {
            let state = decode_state(&from_bytes(vector))?;
            if let Some(before) = self.sequence
                && state.sequence != before + 1
            {
                let what = format!("sequence {} comes after {before}", state.sequence);
                return Err(DriverError::Malformed { what });
            }
            self.sequence = Some(state.sequence);
            newest = Some(state);
        }
        self.bytes = rest.to_vec();
        Ok(newest)
    }

    /// Bytes of a vector that is not whole yet.
    pub(crate) fn n_short(&self) -> usize {
        self.bytes.len()
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::rng::{index, uniform};
    use tandem_core::{Stream, episode_rng};

    use super::*;
    use crate::quarc::codec::tests::state;
    use crate::quarc::codec::{encode_state, to_bytes};

    fn bytes(sequences: impl Iterator<Item = u64>) -> Vec<u8> {
        sequences.flat_map(|nth| to_bytes(&encode_state(&state(nth)).unwrap())).collect()
    }

    #[test]
    fn states_come_whole_however_they_are_cut() {
        let sent = bytes(10..60);
        for seed in 0..50 {
            let mut rng = episode_rng(seed, 0, Stream::Reset);
            let (mut inbox, mut at, mut newest) = (Inbox::default(), 0, None);
            while at < sent.len() {
                let n = (1 + index(&mut rng, 2 * STATE_BYTES)).min(sent.len() - at);
                newest = inbox.take(&sent[at..at + n]).unwrap().or(newest);
                at += n;
                let whole = (at / STATE_BYTES) as u64;
                let expected = (whole > 0).then(|| state(9 + whole));
                assert_eq!(newest, expected, "seed {seed} after {at} bytes");
                assert_eq!(inbox.n_short(), at % STATE_BYTES);
            }
        }
    }

    #[test]
    fn a_jump_in_the_sequence_is_an_error() {
        let mut inbox = Inbox::default();
        assert_eq!(inbox.take(&bytes(5..7)).unwrap().unwrap().sequence, 6);
        for wrong in [6, 8, 0] {
            let error = inbox.clone().take(&bytes(wrong..wrong + 1)).unwrap_err();
            assert!(error.to_string().contains("comes after 6"), "{error}");
        }
    }

    #[test]
    fn no_bytes_are_taken_for_a_state_or_make_it_panic() {
        let good = bytes(10..13);
        let (mut n_refused, mut n_taken) = (0, 0);
        for seed in 0..20_000 {
            let mut rng = episode_rng(seed, 0, Stream::Reset);
            let mut sent = good.clone();
            match index(&mut rng, 3) {
                // Some bytes are others.
                0 => {
                    for _ in 0..1 + index(&mut rng, 4) {
                        let at = index(&mut rng, sent.len());
                        sent[at] ^= 1 << index(&mut rng, 8);
                    }
                }
                // Some bytes are missing.
                1 => {
                    let from = index(&mut rng, sent.len());
                    let n = 1 + index(&mut rng, STATE_BYTES - 1);
                    sent.drain(from..(from + n).min(sent.len()));
                }
                // All bytes are noise.
                _ => sent.fill_with(|| {
                    #[expect(
                        clippy::cast_possible_truncation,
                        clippy::cast_sign_loss,
                        reason = "noise"
                    )]
                    let byte = uniform(&mut rng, 0.0, 256.0) as u8;
                    byte
                }),
            }
            match Inbox::default().take(&sent) {
                Ok(Some(state)) => {
                    n_taken += 1;
                    let numbers = state.arms.iter().flat_map(|arm| arm.angles.iter());
                    assert!(numbers.chain([&state.stamp_s]).all(|number| number.is_finite()));
                }
                Ok(None) => panic!("three vectors' bytes and no state"),
                Err(_) => n_refused += 1,
            }
        }
        // What is left out in the last vector alone, or turns one finite number into another, cannot be seen.
        assert!(n_refused > 10_000 && n_taken > 0, "{n_refused} refused, {n_taken} taken");
    }
}
