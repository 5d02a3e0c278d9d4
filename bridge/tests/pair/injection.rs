//! A driver between the executor and the pair that injects faults.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;

use tandem_bridge::{Command, Driver, DriverError, PairState};
use tandem_core::ArmIndex;
use tandem_kinematics::Joints;
use tandem_trials::SimulatedPair;
use tandem_trials::simulated::Disturbance;

/// The kind of a fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    StateLost,
    StateFrozen,
    StateLate,
    StateNotFinite,
    SequenceJump,
    EncoderJump,
    CommandLost,
    DriverError,
    OwnerGone,
    PersonsStop,
    BlockedJoint,
    TorqueOfContact,
    ReportedContact,
    DriftTogether,
    DriftDown,
    ExecutorDropped,
    ProcessKilled,
}

pub(crate) const KINDS: [Kind; 17] = [
    Kind::StateLost,
    Kind::StateFrozen,
    Kind::StateLate,
    Kind::StateNotFinite,
    Kind::SequenceJump,
    Kind::EncoderJump,
    Kind::CommandLost,
    Kind::DriverError,
    Kind::OwnerGone,
    Kind::PersonsStop,
    Kind::BlockedJoint,
    Kind::TorqueOfContact,
    Kind::ReportedContact,
    Kind::DriftTogether,
    Kind::DriftDown,
    Kind::ExecutorDropped,
    Kind::ProcessKilled,
];

/// The present fault of the connection and the time since when it is detectable.
pub(crate) struct Injection {
    kind: Option<Kind>,
    arm: ArmIndex,
    joint: usize,
    /// States since then.
    n_spoiled: u32,
    /// States that the executor never received and the driver does not count.
    n_lost: u64,
    held: Option<PairState>,
    late: VecDeque<PairState>,
    /// The simulated time at which the fault exceeds the executor's settings, seconds.
    pub(crate) shown_s: Option<f64>,
}

impl Injection {
    pub(crate) fn none() -> Self {
        Self {
            kind: None,
            arm: ArmIndex(0),
            joint: 0,
            n_spoiled: 0,
            n_lost: 0,
            held: None,
            late: VecDeque::new(),
            shown_s: None,
        }
    }

    /// Starts a fault, at this joint if it concerns one.
    pub(crate) fn begin(&mut self, kind: Kind, arm: ArmIndex, joint: usize) {
        (self.kind, self.arm, self.joint) = (Some(kind), arm, joint);
    }

    /// Ends the fault.
    pub(crate) fn end(&mut self) {
        self.kind = None;
    }

    /// Applies the fault to a state at simulated time `time_s`.
    fn spoil(&mut self, mut state: PairState, time_s: f64) -> PairState {
        state.sequence -= self.n_lost;
        let held = self.held.get_or_insert_with(|| state.clone()).clone();
        let Some(kind) = self.kind else {
            self.held = Some(state.clone());
            return state;
        };
        let mut shown_after = u32::MAX;
        match kind {
            Kind::StateLost => {
                state = held;
                self.n_lost += 1;
                // The settings allow states to be late by 15 ms.
                shown_after = 1;
            }
            Kind::StateFrozen => {
                state.arms = held.arms;
                // A moving joint never reports four equal states in a row.
                shown_after = 4;
            }
            Kind::StateLate => {
                self.late.push_back(state);
                // Every other exchange returns the next state, so states age by one period in two.
                let next = if self.n_spoiled % 2 == 1 { self.late.pop_front() } else { None };
                state = next.unwrap_or(held);
                self.held = Some(state.clone());
                // The settings allow an age of 35 ms more.
                shown_after = 7;
            }
            Kind::StateNotFinite => {
                state.arms[self.arm.0].angles[self.joint] = f64::NAN;
                shown_after = 0;
            }
            Kind::SequenceJump => {
                state.sequence += 5;
                shown_after = 0;
            }
            Kind::EncoderJump => {
                state.arms[self.arm.0].angles[self.joint] += 4.0_f64.to_radians();
                shown_after = 0;
            }
            Kind::ReportedContact => {
                state.arms[self.arm.0].faults.contact = true;
                shown_after = 0;
            }
            Kind::TorqueOfContact => shown_after = 0,
            _ => {}
        }
        if self.n_spoiled >= shown_after {
            self.shown_s.get_or_insert(time_s);
        }
        self.n_spoiled += 1;
        state
    }

    /// Returns true if the connection to the arms is cut.
    fn cut(&self) -> bool {
        matches!(self.kind, Some(Kind::CommandLost | Kind::DriverError))
    }
}

/// Forwards commands and states between the executor and the pair.
#[derive(Clone)]
pub(crate) struct Tap {
    pair: Rc<RefCell<SimulatedPair>>,
    injection: Rc<RefCell<Injection>>,
}

impl std::fmt::Debug for Tap {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Tap")
    }
}

impl Tap {
    pub(crate) fn new(pair: Rc<RefCell<SimulatedPair>>, injection: Rc<RefCell<Injection>>) -> Self {
        Self { pair, injection }
    }
}

impl Driver for Tap {
    fn period_s(&self) -> f64 {
        self.pair.borrow().period_s()
    }

    fn exchange(&mut self, command: &Command) -> Result<PairState, DriverError> {
        let (mut pair, mut injection) = (self.pair.borrow_mut(), self.injection.borrow_mut());
        let state = if injection.cut() { pair.skip_period() } else { pair.exchange(command)? };
        let state = injection.spoil(state, pair.time_s());
        if injection.kind == Some(Kind::DriverError) {
            return Err(DriverError::Disconnected { what: "closed by the peer".into() });
        }
        Ok(state)
    }

    fn stop(&mut self) -> Result<(), DriverError> {
        if self.injection.borrow().cut() {
            return Err(DriverError::Disconnected { what: "closed by the peer".into() });
        }
        self.pair.borrow_mut().stop()
    }
}

/// The disturbance of the arms by `kind`; `directions` are those of the drift, arm by arm.
pub(crate) fn disturbance(
    kind: Kind,
    arm: ArmIndex,
    joint: usize,
    directions: &[Joints],
) -> Disturbance {
    match kind {
        Kind::BlockedJoint => Disturbance { blocked: vec![(arm, joint)], ..Disturbance::default() },
        Kind::TorqueOfContact => {
            let leaning = |idx: usize| {
                let nm = |number| if idx == arm.0 && number == joint { 6.0 } else { 0.0 };
                Joints::from_fn(4, nm)
            };
            Disturbance { torque_nm: vec![leaning(0), leaning(1)], ..Disturbance::default() }
        }
        Kind::DriftTogether | Kind::DriftDown => {
            Disturbance { drift_radps: directions.to_vec(), ..Disturbance::default() }
        }
        _ => Disturbance::default(),
    }
}
