//! The contract between the executor and a pair of arms, simulated or real.
//!
//! **One exchange a period.** The executor calls [`Driver::exchange`] once every [`Driver::period_s`]: a command goes out,
//! the newest state comes back. The call does not wait longer than a period; when nothing new has come it
//! returns the state before once more, and its sequence number tells. Angles, their rates and torques are those of the joints, base to
//! wrist, by Kinova's convention (see [`tandem_kinematics::model`]); radians, radians per second, newton metres.
//!
//! **Whoever falls silent stops the arms.** A command holds for one period. Every driver has to see to it that the arms
//! brake by themselves when no command has come for [`SILENCE_S`], also when its own process is killed:
//!
//! - The simulated pair (crate `tandem-trials`) counts simulated time since the last command and brakes.
//! - **QUARC** (one vector of doubles per sample over TCP): the receiving model holds its last input, which would go on moving for ever. The
//!   vector therefore carries the command's number, and the model on that side has to set the velocities to zero when the
//!   number has not changed for [`SILENCE_S`] or its stream server reports a lost peer. The driver closes the socket when a vector is short, is
//!   not finite or jumps in its number.
//! - **kinova-ros**: the arm follows joint velocities only while they are published at 100 Hz and stops when that ends.
//!   The driver publishes once per exchange and nothing in between, so that a killed process is silent at once. On
//!   [`Order::Stop`] it publishes nothing and calls the driver's `in/stop`. A queue that lies
//!   between (rosbridge) has to be of length 1: a deep one would be played to its end.

use tandem_kinematics::Joints;

/// Time without a command after which the drives brake by themselves, seconds.
pub const SILENCE_S: f64 = 0.050;

/// A pair of arms, or any number of arms that share a table.
pub trait Driver {
    /// Time from one exchange to the next, seconds.
    fn period_s(&self) -> f64;

    /// Hands over the command of the coming period and returns the newest state.
    ///
    /// # Errors
    /// Says what happened to the connection. The arms may be moving then: call [`stop`](Self::stop).
    fn exchange(&mut self, command: &Command) -> Result<PairState, DriverError>;

    /// Lets the drives brake, by every means there is and without waiting for the next exchange. May be called at any time and
    /// any number of times.
    ///
    /// # Errors
    /// When the drives could not be told. What is left then is that they fall silent.
    fn stop(&mut self) -> Result<(), DriverError>;
}

impl<D: Driver + ?Sized> Driver for Box<D> {
    fn period_s(&self) -> f64 {
        (**self).period_s()
    }

    fn exchange(&mut self, command: &Command) -> Result<PairState, DriverError> {
        (**self).exchange(command)
    }

    fn stop(&mut self) -> Result<(), DriverError> {
        (**self).stop()
    }
}

/// What the arms shall do in the coming period.
#[derive(Debug, Clone, PartialEq)]
pub struct Command {
    /// Counts the commands of one executor, from 1.
    pub number: u64,
    /// What to do.
    pub order: Order,
}

/// What the arms are told.
#[derive(Debug, Clone, PartialEq)]
pub enum Order {
    /// The drives brake as fast as they may and stay where they are; grippers keep what they hold.
    Stop,
    /// One entry an arm, in the order of the cell.
    Move(Vec<ArmCommand>),
}

/// What one arm shall do in the coming period.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmCommand {
    /// Joint velocities, radians per second.
    pub velocities: Joints,
    /// How far the gripper shall be open: 0 is shut, 1 open.
    pub opening: f64,
}

/// The arms at one time, as far as they have told.
#[derive(Debug, Clone, PartialEq)]
pub struct PairState {
    /// Counts the states. The same number again means that nothing new has come; any other step than 1 means that some
    /// were lost or that the arms have started anew.
    pub sequence: u64,
    /// When the state was true, seconds by a clock of the arms' own.
    pub stamp_s: f64,
    /// The newest command that had taken effect by then; `None` where the arms do not tell.
    pub newest_command: Option<u64>,
    /// One entry an arm, in the order of the cell.
    pub arms: Vec<ArmReading>,
}

/// What one arm says of itself.
#[derive(Debug, Clone, PartialEq)]
pub struct ArmReading {
    /// Joint angles, radians.
    pub angles: Joints,
    /// Their rates, radians per second.
    pub velocities: Joints,
    /// Torques beyond those that carry the arm itself, newton metres; `None` where the arm does not tell.
    pub torques_nm: Option<Joints>,
    /// How far the gripper is open: 0 is shut, 1 open.
    pub opening: f64,
    /// What the arm complains about.
    pub faults: Faults,
}

/// What an arm complains about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Faults {
    /// A drive has failed, was switched off or has braked by itself.
    pub drive: bool,
    /// Something touches the arm where nothing should, as a sensor or a person says.
    pub contact: bool,
    /// The emergency stop at the arm is pressed.
    pub emergency_stop: bool,
}

/// Why an exchange failed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DriverError {
    /// There is no connection, or it has ended.
    #[error("the arms are not connected: {what}")]
    Disconnected {
        /// What happened, in the words of what lies below.
        what: String,
    },
    /// The arms said what cannot be understood.
    #[error("the arms sent what is not a state: {what}")]
    Malformed {
        /// What is wrong with it.
        what: String,
    },
    /// The arms, or the way to them, do not take the command.
    #[error("the arms do not take this: {what}")]
    Refused {
        /// What is wrong, and what to do.
        what: String,
    },
    /// The command does not fit the arms.
    #[error("a command for {got} arms or joints, expected {expected}")]
    Shape {
        /// What the command is for.
        got: usize,
        /// What there is.
        expected: usize,
    },
}
