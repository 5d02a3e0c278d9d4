//! Commands and states as vectors of doubles. Pure.
//!
//! A vector is a sequence of IEEE 754 doubles, little-endian, without header or padding. Both vectors have a fixed
//! length.
//!
//! **Command**, [`COMMAND_LEN`] doubles, to the arms:
//!
//! | index | number | unit |
//! |---|---|---|
//! | 0 | [`COMMAND_MARK`]: identifies a command of this layout | – |
//! | 1 | number of the command | 1, 2, 3, … |
//! | 2 | time of the command: its number times the period | s |
//! | 3 | order: 0 stop, 1 move | – |
//! | 4–7 | velocities of joints 1–4 of arm 0, at most [`MAX_RATE_RADPS`] | rad/s |
//! | 8 | opening of gripper 0: 0 closed, 1 open | – |
//! | 9–12 | velocities of joints 1–4 of arm 1 | rad/s |
//! | 13 | opening of gripper 1 | – |
//!
//! With order 0 the numbers from index 4 are 0 and have no meaning: the drives brake and the grippers do not move.
//!
//! **State**, [`STATE_LEN`] doubles, from the arms:
//!
//! | index | number | unit |
//! |---|---|---|
//! | 0 | [`STATE_MARK`]: identifies a state of this layout | – |
//! | 1 | sequence: the number of vectors that this connection has accepted, with this one | – |
//! | 2 | time stamp of the measurement by the arms' clock | s |
//! | 3 | number of the newest command that has taken effect, 0 before the first | – |
//! | 4–7 | angles of joints 1–4 of arm 0, Kinova's convention | rad |
//! | 8–11 | their rates | rad/s |
//! | 12–15 | torques without the arm's own weight; 0 if index 17 is 0 | N m |
//! | 16 | opening of gripper 0: 0 closed, 1 open | – |
//! | 17 | whether the torques are reported: 0 or 1 | – |
//! | 18 | drive fault: 0 or 1 | – |
//! | 19 | contact: 0 or 1 | – |
//! | 20 | emergency stop: 0 or 1 | – |
//! | 21–37 | the same for arm 1 | |

use tandem_kinematics::Joints;

use crate::driver::{ArmCommand, ArmReading, Command, DriverError, Faults, Order, PairState};

/// The number of arms in a vector.
pub const N_ARMS: usize = 2;
/// The number of joints of an arm.
pub const N_JOINTS: usize = 4;
/// The number of doubles in a command.
pub const COMMAND_LEN: usize = HEAD_LEN + N_ARMS * ARM_COMMAND_LEN;
/// The number of doubles in a state.
pub const STATE_LEN: usize = HEAD_LEN + N_ARMS * ARM_STATE_LEN;
/// The number of bytes in a state.
pub const STATE_BYTES: usize = STATE_LEN * size_of::<f64>();
/// First number of a command.
pub const COMMAND_MARK: f64 = 20_001.0;
/// First number of a state.
pub const STATE_MARK: f64 = 20_002.0;

/// The highest velocity that a command may contain, radians per second. A Mico's fastest joint turns at 0.84.
pub const MAX_RATE_RADPS: f64 = 1.0;

const HEAD_LEN: usize = 4;
const ARM_COMMAND_LEN: usize = N_JOINTS + 1;
const ARM_STATE_LEN: usize = 3 * N_JOINTS + 5;
/// The largest count that doubles represent exactly.
const LARGEST_COUNT: f64 = 9_007_199_254_740_992.0;

/// Encodes `command`; a period takes `period_s` seconds.
///
/// # Errors
/// Returns an error if the command is not for two arms with four joints, or a number is out of its range.
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
        check_ranges(arm).map_err(|what| DriverError::Refused { what })?;
        for (number, rate) in block.iter_mut().zip(arm.velocities.iter()) {
            *number = *rate;
        }
        block[N_JOINTS] = arm.opening;
    }
    Ok(vector)
}

/// Decodes a command, as the arms' side does.
///
/// # Errors
/// Returns an error if the vector is not a command.
pub fn decode_command(vector: &[f64; COMMAND_LEN]) -> Result<Command, DriverError> {
    all_finite(vector)?;
    check_mark(vector[0], COMMAND_MARK)?;
    let number = count(vector[1], "the command's number")?;
    if !flag(vector[3], "the order")? {
        return Ok(Command { number, order: Order::Stop });
    }
    let (blocks, _) = vector[HEAD_LEN..].as_chunks::<ARM_COMMAND_LEN>();
    let arm = |block: &[f64; ARM_COMMAND_LEN]| {
        let velocities = Joints::new(&block[..N_JOINTS]);
        let arm = ArmCommand { velocities, opening: block[N_JOINTS] };
        check_ranges(&arm).map(|()| arm).map_err(malformed)
    };
    Ok(Command { number, order: Order::Move(blocks.iter().map(arm).collect::<Result<_, _>>()?) })
}

fn check_ranges(arm: &ArmCommand) -> Result<(), String> {
    // False for what is not a number.
    let is_allowed = |rate: &f64| rate.abs() <= MAX_RATE_RADPS;
    if arm.velocities.iter().all(is_allowed) && (0.0..=1.0).contains(&arm.opening) {
        return Ok(());
    }
    Err(format!(
        "a velocity is not in -{MAX_RATE_RADPS} to {MAX_RATE_RADPS} rad/s, or an opening not in 0 to 1"
    ))
}

/// Encodes `state`, as the arms' side does.
///
/// # Errors
/// Returns an error if the state is not of two arms with four joints.
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
        let reports_torques = arm.torques_nm.is_some();
        let torques = arm.torques_nm.unwrap_or_else(|| Joints::from_fn(N_JOINTS, |_| 0.0));
        same(torques.len(), N_JOINTS)?;
        let joints = arm.angles.iter().chain(arm.velocities.iter()).chain(torques.iter());
        let Faults { drive, contact, emergency_stop } = arm.faults;
        let flags =
            [reports_torques, drive, contact, emergency_stop].map(|set| f64::from(u8::from(set)));
        let rest = std::iter::once(arm.opening).chain(flags);
        for (number, value) in block.iter_mut().zip(joints.copied().chain(rest)) {
            *number = value;
        }
    }
    Ok(vector)
}

/// Decodes a state.
///
/// # Errors
/// Returns an error that names the malformed number if the vector is not a state.
pub fn decode_state(vector: &[f64; STATE_LEN]) -> Result<PairState, DriverError> {
    check_mark(vector[0], STATE_MARK)?;
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
    let [opening, reports_torques, drive, contact, emergency_stop] =
        std::array::from_fn(|idx| block[3 * N_JOINTS + idx]);
    let reports_torques = flag(reports_torques, "whether torques are reported")?;
    Ok(ArmReading {
        angles: joints(0),
        velocities: joints(1),
        torques_nm: reports_torques.then(|| joints(2)),
        opening,
        faults: Faults {
            drive: flag(drive, "the drive fault")?,
            contact: flag(contact, "the contact")?,
            emergency_stop: flag(emergency_stop, "the emergency stop")?,
        },
    })
}

/// Converts a vector to `8 * N` bytes.
#[must_use]
pub fn to_bytes<const N: usize>(vector: &[f64; N]) -> Vec<u8> {
    vector.iter().flat_map(|number| number.to_le_bytes()).collect()
}

/// Converts `8 * N` bytes to a vector. Missing numbers are 0.
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

/// Checks the mark of a vector. A wrong offset or byte order gives another number.
fn check_mark(got: f64, mark: f64) -> Result<(), DriverError> {
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
        Command { number: 41, order: Order::Move(vec![arm(-1.0), arm(0.25)]) }
    }

    #[test]
    fn vectors_round_trip() {
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
    fn numbers_are_at_the_documented_indices() {
        let vector = encode_command(&command(), 0.5).unwrap();
        let expected =
            [20_001.0, 41.0, 20.5, 1.0, -1.0, -0.75, -0.5, -0.25, 0.5, 0.25, 0.5, 0.75, 1.0, 0.5];
        assert_eq!(vector, expected);
        let vector = encode_state(&state(3)).unwrap();
        assert_eq!(vector[..8], [20_002.0, 3.0, 0.03, 7.0, 0.0, 1.0, 2.0, 3.0]);
        assert_eq!(vector[16..22], [0.25, 0.0, 0.0, 0.0, 0.0, 1.0]);
        assert_eq!(vector[29..], [-1.5, -0.5, 0.5, 1.5, 0.75, 1.0, 1.0, 0.0, 1.0]);
        // The first number in memory, least significant byte first.
        assert_eq!(to_bytes(&vector)[..8], [0, 0, 0, 0, 0x80, 0x88, 0xd3, 0x40]);
    }

    #[test]
    fn a_command_out_of_range_is_not_encoded() {
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
        assert!(refused(spoil(|arms| arms[0].velocities = Joints::from_fn(4, |_| -1.01))));
        assert!(refused(spoil(|arms| arms[0].opening = 1.01)));
        assert!(refused(spoil(|arms| arms[0].opening = f64::NAN)));
        let shape = |result| matches!(result, Err(DriverError::Shape { .. }));
        assert!(shape(spoil(|arms| arms.truncate(1))));
        assert!(shape(spoil(|arms| arms[1].velocities = Joints::from_fn(6, |_| 0.0))));
    }

    #[test]
    fn a_malformed_vector_is_refused_with_its_fault() {
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
        check(17, 2.0, "whether torques are reported is 2, expected 0 or 1");
        check(20, 0.5, "the emergency stop is 0.5");
        let mut garbled = encode_command(&command(), 0.01).unwrap();
        garbled[3] = 2.0;
        let error = decode_command(&garbled).unwrap_err().to_string();
        assert!(error.contains("the order is 2, expected 0 or 1"), "{error}");
    }
}
