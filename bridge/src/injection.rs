//! Faults that operators inject into simulated arms, to practise each stop.

use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use tandem_core::ArmIndex;

/// The kind of an injected fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FaultKind {
    /// The emergency stop at the arm is pressed, and its drives brake.
    EmergencyStop,
    /// A drive of the arm fails, and its drives brake.
    DriveFault,
    /// The arm reports a contact.
    Contact,
    /// A joint cannot turn.
    BlockedJoint,
    /// Something presses on a joint.
    Torque,
    /// A joint turns faster than commanded.
    Drift,
    /// States of both arms arrive late.
    LateStates,
}

/// A fault and the place where it occurs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fault {
    /// The kind.
    pub kind: FaultKind,
    /// The arm.
    pub arm: ArmIndex,
    /// The joint of a blocked joint, a torque or a drift, counted from 0.
    pub joint: usize,
}

impl fmt::Display for Fault {
    /// Writes the name, and the place with the joint counted from 1.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (arm, joint) = (self.arm.0, self.joint + 1);
        match self.kind {
            FaultKind::EmergencyStop => write!(f, "emergency-stop, arm {arm}"),
            FaultKind::DriveFault => write!(f, "drive-fault, arm {arm}"),
            FaultKind::Contact => write!(f, "contact, arm {arm}"),
            FaultKind::BlockedJoint => write!(f, "blocked-joint, arm {arm}, joint {joint}"),
            FaultKind::Torque => write!(f, "torque, arm {arm}, joint {joint}"),
            FaultKind::Drift => write!(f, "drift, arm {arm}, joint {joint}"),
            FaultKind::LateStates => f.write_str("late-states"),
        }
    }
}

/// The present faults, shared by the service and the driver of simulated arms.
#[derive(Debug, Clone, Default)]
pub struct Injector(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    faults: Mutex<Vec<Fault>>,
    /// Counts the changes of `faults`.
    n_changes: AtomicU64,
}

impl Injector {
    /// Adds a fault to those that are present. It lasts until [`clear`](Self::clear).
    pub fn add(&self, fault: Fault) {
        self.change(|faults| {
            if !faults.contains(&fault) {
                faults.push(fault);
            }
        });
    }

    /// Removes all faults.
    pub fn clear(&self) {
        self.change(Vec::clear);
    }

    /// Returns the present faults, oldest first.
    #[must_use]
    pub fn faults(&self) -> Vec<Fault> {
        self.0.faults.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Returns how often the faults were changed, without taking a lock.
    #[must_use]
    pub fn n_changes(&self) -> u64 {
        self.0.n_changes.load(Ordering::Acquire)
    }

    fn change(&self, change: impl FnOnce(&mut Vec<Fault>)) {
        change(&mut self.0.faults.lock().unwrap_or_else(PoisonError::into_inner));
        self.0.n_changes.fetch_add(1, Ordering::Release);
    }
}
