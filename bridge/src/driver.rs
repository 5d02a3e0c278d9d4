//! The contract between the executor and a pair of arms, simulated or real.
//!
//! **One exchange per period.** The executor calls [`Driver::exchange`] once every [`Driver::period_s`]: the driver
//! sends a command and returns the newest state. The call waits at most one period. If no new state has arrived, it
//! returns the previous one again, with the same sequence number. Angles, rates and torques are those of the joints,
//! from base to wrist, by Kinova's convention (see [`tandem_kinematics::model`]), in radians, radians per second and
//! newton metres.
//!
//! **Silence stops the arms.** A command holds for one period. Every driver must ensure that the arms brake by
//! themselves if no command arrives for [`SILENCE_S`], including when its own process is killed:
//!
//! - The simulated pair (crate `tandem-trials`) counts simulated time since the last command and brakes.
//! - **QUARC** (one vector of doubles per sample over TCP): the receiving model holds its last input and would continue
//!   to move. The vector therefore contains the command's number, and the model must set the velocities to zero if the
//!   number has not changed for [`SILENCE_S`] or its stream server reports a lost peer. The driver closes the socket if
//!   a vector is incomplete, not finite or out of sequence.
//! - **kinova-ros**: the arm follows joint velocities only while they are published at 100 Hz, and stops otherwise. The
//!   driver publishes once per exchange and at no other time, so a killed process is silent at once. On [`Order::Stop`]
//!   it publishes nothing and calls the node's `in/stop`. Queues in between (rosbridge) must have length 1, because the
//!   arm would execute all commands of a longer queue.

use tandem_kinematics::Joints;

/// Time without a command after which the drives brake by themselves, seconds.
pub const SILENCE_S: f64 = 0.050;

/// A connection to a pair of arms, or to any number of arms in one work cell.
pub trait Driver {
    /// Time from one exchange to the next, seconds.
    fn period_s(&self) -> f64;

    /// Sends the command of the coming period and returns the newest state.
    ///
    /// # Errors
    /// Returns an error if the connection fails. The arms may still be moving: call [`stop`](Self::stop).
    fn exchange(&mut self, command: &Command) -> Result<PairState, DriverError>;

    /// Stops the drives by all available means, without waiting for the next exchange. May be called at any time and
    /// any number of times.
    ///
    /// # Errors
    /// Returns an error if the command could not be sent. The drives then brake after [`SILENCE_S`] without commands.
    fn stop(&mut self) -> Result<(), DriverError>;

    /// Ends the connection to arms that have fallen silent, for this reason, so that another one can take its place.
    fn disconnect(&mut self, _reason: &DriverError) {}

    /// Returns true if the arms have answered the last order to stop. Drivers whose arms do not answer orders return
    /// true: the executor waits for a state.
    fn confirms_stop(&self) -> bool {
        true
    }
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

    fn disconnect(&mut self, reason: &DriverError) {
        (**self).disconnect(reason);
    }

    fn confirms_stop(&self) -> bool {
        (**self).confirms_stop()
    }
}

/// A command for the coming period.
#[derive(Debug, Clone, PartialEq)]
pub struct Command {
    /// The number of the command, counted from 1 by each executor.
    pub number: u64,
    /// The order.
    pub order: Order,
}

/// The order of a command.
#[derive(Debug, Clone, PartialEq)]
pub enum Order {
    /// The drives brake as fast as possible and hold their position; grippers do not move.
    Stop,
    /// The arms move. One entry per arm, in the order of the work cell.
    Move(Vec<ArmCommand>),
}

/// The command of one arm for the coming period.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmCommand {
    /// Joint velocities, radians per second.
    pub velocities: Joints,
    /// The desired opening of the gripper: 0 is closed, 1 is open.
    pub opening: f64,
}

/// The state of the arms at one time.
#[derive(Debug, Clone, PartialEq)]
pub struct PairState {
    /// The sequence number of the state. A repeated number means that no new state has arrived; a step other than 1
    /// means that states were lost or the arms have restarted.
    pub sequence: u64,
    /// The time of the measurement by the arms' own clock, seconds.
    pub stamp_s: f64,
    /// The number of the newest command that had taken effect; `None` if the arms do not report it.
    pub newest_command: Option<u64>,
    /// One entry per arm, in the order of the work cell.
    pub arms: Vec<ArmReading>,
}

/// The measurements of one arm.
#[derive(Debug, Clone, PartialEq)]
pub struct ArmReading {
    /// Joint angles, radians.
    pub angles: Joints,
    /// Their rates, radians per second.
    pub velocities: Joints,
    /// Torques without those that carry the arm's own weight, newton metres; `None` if the arm does not report them.
    pub torques_nm: Option<Joints>,
    /// The opening of the gripper: 0 is closed, 1 is open.
    pub opening: f64,
    /// The reported faults.
    pub faults: Faults,
}

impl ArmReading {
    /// Adds what a single reading may show from `before`, which this one replaces unseen: its faults, and the torque of
    /// each joint whose magnitude was larger.
    pub(crate) fn keep_peaks(&mut self, before: &Self) {
        self.faults.drive |= before.faults.drive;
        self.faults.contact |= before.faults.contact;
        self.faults.emergency_stop |= before.faults.emergency_stop;
        if let (Some(torques_nm), Some(before_nm)) = (&mut self.torques_nm, &before.torques_nm) {
            for (torque_nm, before_nm) in torques_nm.iter_mut().zip(before_nm.iter()) {
                if before_nm.abs() > torque_nm.abs() {
                    *torque_nm = *before_nm;
                }
            }
        }
    }
}

/// The faults that an arm reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Faults {
    /// A drive has failed, was switched off or has braked by itself.
    pub drive: bool,
    /// An unintended contact with the arm, reported by a sensor or an operator.
    pub contact: bool,
    /// The emergency stop at the arm is pressed.
    pub emergency_stop: bool,
}

/// The reason why an exchange failed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DriverError {
    /// There is no connection, or it has ended.
    #[error("the arms are not connected: {what}")]
    Disconnected {
        /// The description of the failure by the lower layer.
        what: String,
    },
    /// The arms sent a malformed state.
    #[error("the arms sent a malformed state: {what}")]
    Malformed {
        /// The fault of the state.
        what: String,
    },
    /// The arms, or a program between, refuse the command.
    #[error("the arms refuse the command: {what}")]
    Refused {
        /// The problem, and its remedy if known.
        what: String,
    },
    /// The command is for a different number of arms or joints.
    #[error("a command for {got} arms or joints, expected {expected}")]
    Shape {
        /// The number in the command.
        got: usize,
        /// The number that exists.
        expected: usize,
    },
}
