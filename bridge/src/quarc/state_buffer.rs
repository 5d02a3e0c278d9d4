//! Assembles states from bytes received in pieces of any size. Pure.

use crate::driver::{DriverError, PairState};
use crate::quarc::codec::{STATE_BYTES, decode_state, from_bytes};

/// The bytes of an incomplete vector.
#[derive(Debug, Clone, Default)]
pub(crate) struct StateBuffer {
    bytes: Vec<u8>,
    /// The sequence number of the newest complete vector.
    sequence: Option<u64>,
}

impl StateBuffer {
    /// Adds received bytes and returns the newest state that they complete, with the faults and the
    /// largest torques of all of them.
    pub(crate) fn push(&mut self, bytes: &[u8]) -> Result<Option<PairState>, DriverError> {
        self.bytes.extend_from_slice(bytes);
        let (vectors, rest) = self.bytes.as_chunks::<STATE_BYTES>();
        let mut newest = None;
        for vector in vectors {
            let mut state = decode_state(&from_bytes(vector))?;
            if let Some(before) = self.sequence
                && state.sequence != before + 1
            {
                let what = format!("sequence {} comes after {before}", state.sequence);
                return Err(DriverError::Malformed { what });
            }
            self.sequence = Some(state.sequence);
            if let Some(before) = newest.take() {
                keep_peaks(&mut state, &before);
            }
            newest = Some(state);
        }
        self.bytes = rest.to_vec();
        Ok(newest)
    }

    /// The number of bytes of the incomplete vector.
    pub(crate) fn n_partial(&self) -> usize {
        self.bytes.len()
    }
}

/// Adds the faults and the larger torques of `before` to `state`, which replaces it unseen.
pub(crate) fn keep_peaks(state: &mut PairState, before: &PairState) {
    for (arm, before) in state.arms.iter_mut().zip(&before.arms) {
        arm.keep_peaks(before);
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::rng::{index, uniform};
    use tandem_core::{Stream, episode_rng};
    use tandem_kinematics::Joints;

    use super::*;
    use crate::driver::Faults;
    use crate::quarc::codec::tests::state;
    use crate::quarc::codec::{encode_state, to_bytes};

    fn bytes(sequences: impl Iterator<Item = u64>) -> Vec<u8> {
        sequences.flat_map(|nth| to_bytes(&encode_state(&state(nth)).unwrap())).collect()
    }

    #[test]
    fn states_are_complete_for_pieces_of_any_size() {
        let sent = bytes(10..60);
        for seed in 0..50 {
            let mut rng = episode_rng(seed, 0, Stream::Reset);
            let (mut buffer, mut at, mut newest) = (StateBuffer::default(), 0, None);
            while at < sent.len() {
                let n = (1 + index(&mut rng, 2 * STATE_BYTES)).min(sent.len() - at);
                newest = buffer.push(&sent[at..at + n]).unwrap().or(newest);
                at += n;
                let whole = (at / STATE_BYTES) as u64;
                let expected = (whole > 0).then(|| state(9 + whole));
                assert_eq!(newest, expected, "seed {seed} after {at} bytes");
                assert_eq!(buffer.n_partial(), at % STATE_BYTES);
            }
        }
    }

    #[test]
    fn a_fault_of_a_state_that_is_replaced_counts() {
        let mut states: Vec<PairState> = (5..8).map(state).collect();
        for state in &mut states {
            for arm in &mut state.arms {
                arm.faults = Faults::default();
            }
        }
        states[0].arms[1].faults.contact = true;
        let sent: Vec<u8> =
            states.iter().flat_map(|state| to_bytes(&encode_state(state).unwrap())).collect();
        let newest = StateBuffer::default().push(&sent).unwrap().unwrap();
        assert_eq!(newest.sequence, 7);
        let contacts: Vec<bool> = newest.arms.iter().map(|arm| arm.faults.contact).collect();
        assert_eq!(contacts, [false, true]);
    }

    #[test]
    fn a_torque_of_a_state_that_is_replaced_counts() {
        let mut states: Vec<PairState> = (5..8).map(state).collect();
        let torques_nm = [[0.5, -9.0, 1.5, 0.0], [2.0, 3.0, -1.0, 0.0], [-1.0, 4.0, 0.5, 0.0]];
        for (state, torques_nm) in states.iter_mut().zip(torques_nm) {
            state.arms[1].torques_nm = Some(Joints::new(&torques_nm));
        }
        let sent: Vec<u8> =
            states.iter().flat_map(|state| to_bytes(&encode_state(state).unwrap())).collect();
        let newest = StateBuffer::default().push(&sent).unwrap().unwrap();
        assert_eq!(newest.arms[0].torques_nm, None);
        assert_eq!(newest.arms[1].torques_nm, Some(Joints::new(&[2.0, -9.0, 1.5, 0.0])));
        assert_eq!(newest.arms[1].angles, state(7).arms[1].angles);
    }

    #[test]
    fn a_jump_in_the_sequence_is_an_error() {
        let mut buffer = StateBuffer::default();
        assert_eq!(buffer.push(&bytes(5..7)).unwrap().unwrap().sequence, 6);
        for wrong in [6, 8, 0] {
            let error = buffer.clone().push(&bytes(wrong..wrong + 1)).unwrap_err();
            assert!(error.to_string().contains("comes after 6"), "{error}");
        }
    }

    #[test]
    fn random_bytes_neither_panic_nor_give_infinite_states() {
        let good = bytes(10..13);
        let (mut n_refused, mut n_taken) = (0, 0);
        for seed in 0..20_000 {
            let mut rng = episode_rng(seed, 0, Stream::Reset);
            let mut sent = good.clone();
            match index(&mut rng, 3) {
                // Flipped bits.
                0 => {
                    for _ in 0..1 + index(&mut rng, 4) {
                        let at = index(&mut rng, sent.len());
                        sent[at] ^= 1 << index(&mut rng, 8);
                    }
                }
                // Missing bytes.
                1 => {
                    let from = index(&mut rng, sent.len());
                    let n = 1 + index(&mut rng, STATE_BYTES - 1);
                    sent.drain(from..(from + n).min(sent.len()));
                }
                // Noise.
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
            match StateBuffer::default().push(&sent) {
                Ok(Some(state)) => {
                    n_taken += 1;
                    let numbers = state.arms.iter().flat_map(|arm| arm.angles.iter());
                    assert!(numbers.chain([&state.stamp_s]).all(|number| number.is_finite()));
                }
                Ok(None) => panic!("three vectors' bytes and no state"),
                Err(_) => n_refused += 1,
            }
        }
        // Bytes missing from the last vector, and changes from one finite number to another, cannot be detected.
        assert!(n_refused > 10_000 && n_taken > 0, "{n_refused} refused, {n_taken} taken");
    }
}
