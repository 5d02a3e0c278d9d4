//! Commands and states as vectors of doubles. Pure: bytes in, our types out.
//!
//! A vector is as many IEEE 754 doubles, little-endian, one after the other without anything between or before them. Both
//! are as long as the tables say, always.
//!
//! **Command**, [`COMMAND_LEN`] doubles, to the arms:
//!
//! | index | what | unit |
//! |---|---|---|
//! | 0 | [`COMMAND_MARK`]: tells a command of this layout from everything else | – |
//! | 1 | number of the command | 1, 2, 3, … |
//! | 2 | time of the command: its number times the period | s |
//! | 3 | order: 0 stop, 1 move | – |
//! | 4–7 | velocities of joints 1–4 of arm 0 | rad/s |
//! | 8 | opening of gripper 0: 0 shut, 1 open | – |
//! | 9–12 | velocities of joints 1–4 of arm 1 | rad/s |
//! | 13 | opening of gripper 1 | – |
//!
//! With order 0 the numbers from index 4 are 0 and mean nothing: the drives brake and the grippers stay as they are.
//!
//! **State**, [`STATE_LEN`] doubles, from the arms:
//!
//! | index | what | unit |
//! |---|---|---|
//! | 0 | [`STATE_MARK`]: tells a state of this layout from everything else | – |
//! | 1 | sequence: one more with every vector that is sent | counts |
//! | 2 | stamp: when the state was true, by the arms' clock | s |
//! | 3 | number of the newest command that has taken effect, 0 before the first | – |
//! | 4–7 | angles of joints 1–4 of arm 0, Kinova's convention | rad |
//! | 8–11 | their rates | rad/s |
//! | 12–15 | torques beyond those that carry the arm; 0 where index 17 is 0 | N m |
//! | 16 | opening of gripper 0: 0 shut, 1 open | – |
//! | 17 | whether the torques are told: 0 or 1 | – |
//! | 18 | drive fault: 0 or 1 | – |
//! | 19 | contact: 0 or 1 | – |
//! | 20 | emergency stop: 0 or 1 | – |
//! | 21–37 | the same for arm 1 | |

use tandem_kinematics::Joints;

use crate::driver::{ArmCommand, ArmReading, Command, DriverError, Faults, Order, PairState};

/// Arms of a vector.
pub const N_ARMS: usize = 2;
/// Joints of an arm.
pub const N_JOINTS: usize = 4;
/// Doubles of a command.
pub const COMMAND_LEN: usize = HEAD_LEN + N_ARMS * ARM_COMMAND_LEN;
/// Doubles of a state.
pub const STATE_LEN: usize = HEAD_LEN + N_ARMS * ARM_STATE_LEN;
/// Bytes of a state.
pub const STATE_BYTES: usize = STATE_LEN * size_of::<f64>();
/// First number of a command.
pub const COMMAND_MARK: f64 = 20_001.0;
/// First number of a state.
pub const STATE_MARK: f64 = 20_002.0;

const HEAD_LEN: usize = 4;
const ARM_COMMAND_LEN: usize = N_JOINTS + 1;
const ARM_STATE_LEN: usize = 3 * N_JOINTS + 5;
/// Doubles count exactly up to here.
const LARGEST_COUNT: f64 = 9_007_199_254_740_992.0;

/// The vector of `command`; periods last `period_s` seconds.
///
/// # Errors
/// When the command is not for two arms with four joints, or has a number that no arm may get.
pub fn encode_command(command: &Command, period_s: f64) -> Result<[f64; COMMAND_LEN], DriverError> {
    let mut vector = [0.0; COMMAND_LEN];
    let number = command.number as f64;
    vector[..3].copy_from_slice(&[COMMAND_MARK, number, number * period_s]);
    let Order::Move(arms) = &command.order else { return Ok(vector) };
    same(arms.len(), N_ARMS)?;
    vector[3] = 1.0;
    let (blocks, _) = vector[HEAD_LEN..].as_chunks_mut::<ARM_COMMAND_LEN>();
    for (block, arm) in blocks.iter_mut().zip(arms) {
        same(arm.velocities.len(), N_JOINTS)?;
        if !(arm.velocities.iter().all(|rate| rate.is_finite())
            && (0.0..=1.0).contains(&arm.opening))
        {
            let what = "a velocity is not finite, or an opening not in 0 to 1".into();
            return Err(DriverError::Refused { what });
        }
        for (number, rate) in block.iter_mut().zip(arm.velocities.iter()) {
            *number = *rate;
        }
        block[N_JOINTS] = arm.opening;
    }
    Ok(vector)
}

/// The command of a vector: what the arms' side reads.
///
/// # Errors
/// When the vector is none of a command.
pub fn decode_command(vector: &[f64; COMMAND_LEN]) -> Result<Command, DriverError> {
    all_finite(vector)?;
    marked(vector[0], COMMAND_MARK)?;
    let number = count(vector[1], "the command's number")?;
    if !flag(vector[3], "the order")? {
        return Ok(Command { number, order: Order::Stop });
    }
    let (blocks, _) = vector[HEAD_LEN..].as_chunks::<ARM_COMMAND_LEN>();
    let arm = |block: &[f64; ARM_COMMAND_LEN]| ArmCommand {
        velocities: Joints::new(&block[..N_JOINTS]),
        opening: block[N_JOINTS],
    };
    Ok(Command { number, order: Order::Move(blocks.iter().map(arm).collect()) })
}

/// The vector of `state`: what the arms' side sends.
///
/// # Errors
/// When the state is not of two arms with four joints.
pub fn encode_state(state: &PairState) -> Result<[f64; STATE_LEN], DriverError> {
    same(state.arms.len(), N_ARMS)?;
    let mut vector = [0.0; STATE_LEN];
    let newest = state.newest_command.unwrap_or(0);
    let head = [STATE_MARK, state.sequence as f64, state.stamp_s, newest as f64];
    vector[..HEAD_LEN].copy_from_slice(&head);
    let (blocks, _) = vector[HEAD_LEN..].as_chunks_mut::<ARM_STATE_LEN>();
    for (block, arm) in blocks.iter_mut().zip(&state.arms) {
        same(arm.angles.len(), N_JOINTS)?;
        same(arm.velocities.len(), N_JOINTS)?;
        let told = arm.torques_nm.is_some();
        let torques = arm.torques_nm.unwrap_or_else(|| Joints::from_fn(N_JOINTS, |_| 0.0));
        same(torques.len(), N_JOINTS)?;
        let joints = arm.angles.iter().chain(arm.velocities.iter()).chain(torques.iter());
        let Faults { drive, contact, emergency_stop } = arm.faults;
        let flags = [told, drive, contact, emergency_stop].map(|set| f64::from(u8::from(set)));
        let rest = std::iter::once(arm.opening).chain(flags);
        for (number, value) in block.iter_mut().zip(joints.copied().chain(rest)) {
            *number = value;
        }
    }
    Ok(vector)
}

/// The state of a vector.
///
/// # Errors
/// When the vector is none of a state: says which number is wrong.
pub fn decode_state(vector: &[f64; STATE_LEN]) -> Result<PairState, DriverError> {
    marked(vector[0], STATE_MARK)?;
    all_finite(vector)?;
    let (blocks, _) = vector[HEAD_LEN..].as_chunks::<ARM_STATE_LEN>();
    Ok(PairState {
        sequence: count(vector[1], "the sequence")?,
        stamp_s: vector[2],
        newest_command: Some(count(vector[3], "the newest command's number")?),
        arms: blocks.iter().map(decode_arm).collect::<Result<_, _>>()?,
    })
}

fn decode_arm(block: &[f64; ARM_STATE_LEN]) -> Result<ArmReading, DriverError> {
    let joints = |nth: usize| Joints::new(&block[nth * N_JOINTS..(nth + 1) * N_JOINTS]);
    let [opening, told, drive, contact, emergency_stop] =
        std::array::from_fn(|idx| block[3 * N_JOINTS + idx]);
    let told = flag(told, "whether torques are told")?;
    Ok(ArmReading {
        angles: joints(0),
        velocities: joints(1),
        torques_nm: told.then(|| joints(2)),
        opening,
        faults: Faults {
            drive: flag(drive, "the drive fault")?,
            contact: flag(contact, "the contact")?,
            emergency_stop: flag(emergency_stop, "the emergency stop")?,
        },
    })
}

/// The bytes of a vector, `8 * N` of them.
#[must_use]
pub fn to_bytes<const N: usize>(vector: &[f64; N]) -> Vec<u8> {
    vector.iter().flat_map(|number| number.to_le_bytes()).collect()
}

/// The vector of `8 * N` bytes; numbers that are not there are 0.
#[must_use]
pub fn from_bytes<const N: usize>(bytes: &[u8]) -> [f64; N] {
    let (words, _) = bytes.as_chunks::<8>();
    let word = |idx: usize| words.get(idx).map_or(0.0, |word| f64::from_le_bytes(*word));
    std::array::from_fn(word)
}

fn same(got: usize, expected: usize) -> Result<(), DriverError> {
    if got == expected { Ok(()) } else { Err(DriverError::Shape { got, expected }) }
}

fn all_finite(vector: &[f64]) -> Result<(), DriverError> {
    match vector.iter().position(|number| !number.is_finite()) {
        Some(idx) => Err(malformed(format!("number {idx} of the vector is {}", vector[idx]))),
        None => Ok(()),
    }
}

/// Whether a vector begins as it should. What is read at the wrong place or in the wrong byte order does not.
fn marked(got: f64, mark: f64) -> Result<(), DriverError> {
    let mirrored = f64::from_bits(got.to_bits().swap_bytes());
    if got.to_bits() == mark.to_bits() {
        Ok(())
    } else if mirrored.to_bits() == mark.to_bits() {
        let what = "the bytes are big-endian: set the stream block's byte order to little-endian";
        Err(malformed(what.into()))
    } else {
        Err(malformed(format!(
            "a vector begins with {got} instead of {mark}: check the width and the data type of the stream block's signals"
        )))
    }
}

fn count(value: f64, what: &str) -> Result<u64, DriverError> {
    if !((0.0..=LARGEST_COUNT).contains(&value) && value.fract() == 0.0) {
        return Err(malformed(format!("{what} is {value}, which is not a count")));
    }
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "checked above")]
    let count = value as u64;
    Ok(count)
}

fn flag(value: f64, what: &str) -> Result<bool, DriverError> {
    match value {
        0.0 => Ok(false),
        1.0 => Ok(true),
        _ => Err(malformed(format!("{what} is {value}, expected 0 or 1"))),
    }
}

fn malformed(what: String) -> DriverError {
    DriverError::Malformed { what }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn state(sequence: u64) -> PairState {
        let arm = |arm: f64| ArmReading {
            angles: Joints::from_fn(4, |joint| arm + joint as f64),
            velocities: Joints::from_fn(4, |joint| 0.1 * joint as f64 - arm),
            torques_nm: (arm > 0.0).then(|| Joints::from_fn(4, |joint| joint as f64 - 1.5)),
            opening: 0.25 + 0.5 * arm,
            faults: Faults { drive: arm > 0.0, contact: false, emergency_stop: arm > 0.0 },
        };
        let stamp_s = 0.01 * sequence as f64;
        PairState { sequence, stamp_s, newest_command: Some(7), arms: vec![arm(0.0), arm(1.0)] }
    }

    fn command() -> Command {
        let arm = |arm: f64| ArmCommand {
            velocities: Joints::from_fn(4, |joint| arm + 0.25 * joint as f64),
            opening: 0.5,
        };
        Command { number: 41, order: Order::Move(vec![arm(-1.0), arm(0.5)]) }
    }

    #[test]
    fn what_is_written_is_read_again() {
        for sequence in [0, 1, 1 << 40] {
            let vector = encode_state(&state(sequence)).unwrap();
            assert_eq!(from_bytes(&to_bytes(&vector)), vector);
            assert_eq!(decode_state(&vector).unwrap(), state(sequence));
        }
        let vector = encode_command(&command(), 0.01).unwrap();
        assert_eq!(decode_command(&vector).unwrap(), command());
        let stop = Command { number: 42, order: Order::Stop };
        let vector = encode_command(&stop, 0.01).unwrap();
        assert_eq!(decode_command(&vector).unwrap(), stop);
    }

    #[test]
    fn numbers_stand_where_the_tables_say() {
        let vector = encode_command(&command(), 0.5).unwrap();
        let expected =
            [20_001.0, 41.0, 20.5, 1.0, -1.0, -0.75, -0.5, -0.25, 0.5, 0.5, 0.75, 1.0, 1.25, 0.5];
        assert_eq!(vector, expected);
        let vector = encode_state(&state(3)).unwrap();
        assert_eq!(vector[..8], [20_002.0, 3.0, 0.03, 7.0, 0.0, 1.0, 2.0, 3.0]);
        assert_eq!(vector[16..22], [0.25, 0.0, 0.0, 0.0, 0.0, 1.0]);
        assert_eq!(vector[29..], [-1.5, -0.5, 0.5, 1.5, 0.75, 1.0, 1.0, 0.0, 1.0]);
        // The first number in memory, least significant byte first.
        assert_eq!(to_bytes(&vector)[..8], [0, 0, 0, 0, 0x80, 0x88, 0xd3, 0x40]);
    }

    #[test]
    fn a_command_that_no_arm_may_get_is_not_written() {
        let spoil = |change: fn(&mut Vec<ArmCommand>)| {
            let mut command = command();
            if let Order::Move(arms) = &mut command.order {
                change(arms);
            }
            encode_command(&command, 0.01)
        };
        let refused = |result| matches!(result, Err(DriverError::Refused { .. }));
        assert!(refused(spoil(|arms| arms[1].velocities[2] = f64::NAN)));
        assert!(refused(spoil(|arms| arms[0].velocities[0] = f64::INFINITY)));
        assert!(refused(spoil(|arms| arms[0].opening = 1.01)));
        assert!(refused(spoil(|arms| arms[0].opening = f64::NAN)));
        let shape = |result| matches!(result, Err(DriverError::Shape { .. }));
        assert!(shape(spoil(|arms| arms.truncate(1))));
        assert!(shape(spoil(|arms| arms[1].velocities = Joints::from_fn(6, |_| 0.0))));
    }

    #[test]
    fn a_vector_that_is_none_says_why() {
        let good = encode_state(&state(3)).unwrap();
        let check = |idx: usize, value: f64, expected: &str| {
            let mut vector = good;
            vector[idx] = value;
            let error = decode_state(&vector).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        };
        check(0, 0.03, "a vector begins with 0.03 instead of 20002");
        check(0, f64::from_bits(STATE_MARK.to_bits().swap_bytes()), "big-endian");
        check(0, f64::NAN, "begins with NaN");
        check(1, 2.5, "the sequence is 2.5");
        check(1, -1.0, "the sequence is -1");
        check(1, 1e300, "not a count");
        check(3, 0.5, "newest command");
        check(6, f64::NAN, "number 6 of the vector is NaN");
        check(37, f64::NEG_INFINITY, "number 37 of the vector is -inf");
        check(17, 2.0, "whether torques are told is 2, expected 0 or 1");
        check(20, 0.5, "the emergency stop is 0.5");
        let mut garbled = encode_command(&command(), 0.01).unwrap();
        garbled[3] = 2.0;
        let error = decode_command(&garbled).unwrap_err().to_string();
        assert!(error.contains("the order is 2, expected 0 or 1"), "{error}");
    }
}
