//! The arms' side of the connection: whether the drives follow commands or brake, and which states are sent. Pure.
//!
//! Simulated arms and tests use it. `bridge/quarc` contains the same state machine in C for real arms; both are tested
//! against `bridge/quarc/vectors.txt`. The rules are those of `docs/drivers.md`, section QUARC.

use std::io::{self, ErrorKind, Write};

use crate::driver::{Command, DriverError, Order, PairState, SILENCE_S};
use crate::quarc::codec::{COMMAND_LEN, STATE_LEN, decode_command, encode_state};

/// The state machine of the arms' side. It passes one sample after the other; commands arrive between two samples.
#[derive(Debug, Clone)]
pub struct ArmSide {
    /// Samples without a new command after which the drives brake.
    silent_limit: u32,
    is_connected: bool,
    /// True if the drives have braked by themselves and wait for a stop command (rules 1 and 2).
    is_tripped: bool,
    /// Samples since the number of the command changed.
    n_silent: u32,
    /// The newest command that the drives follow (rule 5).
    newest: Command,
    /// The number of states that were sent over this connection (rule 4).
    n_sent: u64,
}

impl ArmSide {
    /// Creates the arms' side for samples of `period_s` seconds. The drives brake until a bridge has sent a stop
    /// command.
    #[must_use]
    pub fn new(period_s: f64) -> Self {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "saturates; a limit of 0 brakes for ever"
        )]
        let silent_limit = (SILENCE_S / period_s + 0.5) as u32;
        Self::braking(silent_limit)
    }

    const fn braking(silent_limit: u32) -> Self {
        Self {
            silent_limit,
            is_connected: false,
            is_tripped: true,
            n_silent: 0,
            newest: Command { number: 0, order: Order::Stop },
            n_sent: 0,
        }
    }

    /// Reports whether a bridge is connected. The drives brake when a connection ends or begins, and sequence and
    /// newest command start again. Report the end of a connection before the next one.
    pub fn set_connected(&mut self, is_connected: bool) {
        if is_connected != self.is_connected {
            *self = Self { is_connected, ..Self::braking(self.silent_limit) };
        }
    }

    /// Takes a command that has arrived.
    ///
    /// # Errors
    /// Returns an error if the vector is not a command. The drives then brake and report a fault (rule 2).
    pub fn receive(&mut self, vector: &[f64; COMMAND_LEN]) -> Result<(), DriverError> {
        let command = decode_command(vector).inspect_err(|_error| self.is_tripped = true)?;
        match command.order {
            // Rule 3: a stop counts under any number.
            Order::Stop => self.is_tripped = false,
            // Rule 1: tripped drives wait for a stop, and a repeated number is no new command.
            Order::Move(_) if self.is_tripped || command.number == self.newest.number => {
                return Ok(());
            }
            Order::Move(_) => {}
        }
        self.newest = command;
        self.n_silent = 0;
        Ok(())
    }

    /// Passes a sample and returns what the drives do until the next one, under the number of the newest command.
    /// `is_measured` is whether the arms could be measured in this sample.
    pub fn sample(&mut self, is_measured: bool) -> Command {
        if self.is_connected && is_measured && self.n_silent < self.silent_limit {
            self.n_silent += 1;
        } else {
            self.is_tripped = true;
        }
        let number = self.newest.number;
        if self.is_tripped { Command { number, order: Order::Stop } } else { self.newest.clone() }
    }

    /// Returns true if the drives have braked by themselves and wait for a stop command.
    #[must_use]
    pub const fn is_tripped(&self) -> bool {
        self.is_tripped
    }

    /// Encodes the state of this sample under the next number of the sequence. `measured` may report a newest command
    /// that has taken effect later than the drives were told.
    ///
    /// # Errors
    /// Returns an error if the state is not of two arms with four joints.
    pub fn encode(&self, measured: PairState) -> Result<[f64; STATE_LEN], DriverError> {
        let newest_command = measured.newest_command.or(Some(self.newest.number));
        let mut state = PairState { sequence: self.n_sent + 1, newest_command, ..measured };
        for arm in &mut state.arms {
            arm.faults.drive |= self.is_tripped;
        }
        encode_state(&state)
    }

    /// Reports that the connection has accepted the encoded state whole (rule 4).
    pub fn sent(&mut self) {
        self.n_sent += 1;
    }
}

/// Sends vectors over a non-blocking connection, each whole or not at all (rule 4).
#[derive(Debug, Clone, Default)]
pub struct VectorSender {
    /// The part of the last vector that the connection has not taken yet.
    rest: Vec<u8>,
}

impl VectorSender {
    /// Sends a vector after the rest of the previous one. Returns false if that rest still waits; the vector is then
    /// dropped.
    ///
    /// # Errors
    /// Returns the error of the connection.
    pub fn send(&mut self, stream: &mut impl Write, vector: &[u8]) -> io::Result<bool> {
        if !self.flush(stream)? {
            return Ok(false);
        }
        self.rest.extend_from_slice(vector);
        self.flush(stream)?;
        Ok(true)
    }

    /// Sends the rest. Returns true if nothing is left.
    fn flush(&mut self, stream: &mut impl Write) -> io::Result<bool> {
        while !self.rest.is_empty() {
            match stream.write(&self.rest) {
                Ok(0) => return Err(ErrorKind::WriteZero.into()),
                Ok(n) => drop(self.rest.drain(..n)),
                Err(error) if error.kind() == ErrorKind::WouldBlock => return Ok(false),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(true)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A connection that takes `room` bytes before it would block.
    struct Pipe {
        room: usize,
        taken: Vec<u8>,
    }

    impl Write for Pipe {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let n = bytes.len().min(self.room);
            if n == 0 {
                return Err(ErrorKind::WouldBlock.into());
            }
            self.room -= n;
            self.taken.extend_from_slice(&bytes[..n]);
            Ok(n)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_vector_is_sent_whole_or_not_at_all() {
        let (mut sender, mut pipe) = (VectorSender::default(), Pipe { room: 5, taken: Vec::new() });
        assert!(sender.send(&mut pipe, b"abc").unwrap());
        // Two bytes leave at once, the third follows before the next vector that is accepted.
        assert!(sender.send(&mut pipe, b"def").unwrap());
        assert!(!sender.send(&mut pipe, b"ghi").unwrap());
        pipe.room = 10;
        assert!(sender.send(&mut pipe, b"jkl").unwrap());
        assert_eq!(pipe.taken, b"abcdefjkl");
    }
}
