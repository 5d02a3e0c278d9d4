//! Injected faults of the simulated pair.

use std::collections::VecDeque;

use tandem_bridge::Settings;
use tandem_bridge::driver::{Faults, PairState};
use tandem_bridge::injection::{Fault, FaultKind, Injector};
use tandem_kinematics::Joints;

use crate::simulated::{Disturbance, SimulatedPair};

/// An injected torque, as a share of the largest one that the executor allows.
const TORQUE_SHARE: f64 = 1.5;
/// The tracking error that an injected drift causes against the feedback, as a share of the largest one that the
/// executor allows.
const DRIFT_SHARE: f64 = 2.0;
/// Exchanges by which late states are late.
const N_LATE: usize = 8;

/// Applies the faults of an [`Injector`] to a simulated pair.
#[derive(Debug)]
pub struct Drill {
    injector: Injector,
    n_changes: u64,
    torque_nm: f64,
    drift_radps: f64,
    is_late: bool,
    /// The last state that was returned, followed by those that are still held back.
    held: VecDeque<PairState>,
}

impl Drill {
    /// Applies the faults of `injector` to arms behind an executor with `settings`, whose limits they exceed.
    #[must_use]
    pub fn new(injector: Injector, settings: &Settings) -> Self {
        Self {
            injector,
            n_changes: 0,
            torque_nm: TORQUE_SHARE * settings.torque_nm,
            drift_radps: DRIFT_SHARE * settings.gain_per_s * settings.tracking_rad,
            is_late: false,
            held: VecDeque::new(),
        }
    }

    /// Applies the present faults to `pair`. Call it before each exchange.
    pub fn apply(&mut self, pair: &mut SimulatedPair) {
        let n_changes = self.injector.n_changes();
        if std::mem::replace(&mut self.n_changes, n_changes) == n_changes {
            return;
        }
        let faults = self.injector.faults();
        self.is_late = faults.iter().any(|fault| fault.kind == FaultKind::LateStates);
        pair.disturb(self.disturbance(pair, &faults));
    }

    /// Returns the state that arrives instead of `state`, the newest one.
    pub fn delayed(&mut self, state: PairState) -> PairState {
        self.held.push_back(state.clone());
        let n_kept = if self.is_late { N_LATE + 1 } else { 1 };
        while self.held.len() > n_kept {
            self.held.pop_front();
        }
        self.held.front().cloned().unwrap_or(state)
    }

    fn disturbance(&self, pair: &SimulatedPair, faults: &[Fault]) -> Disturbance {
        let arms = || pair.cell().arms.iter();
        let still = || -> Vec<Joints> {
            arms().map(|arm| Joints::from_fn(arm.model.n_joints(), |_| 0.0)).collect()
        };
        let mut disturbance = Disturbance {
            blocked: Vec::new(),
            drift_radps: still(),
            torque_nm: still(),
            faults: vec![Faults::default(); arms().len()],
        };
        for fault in faults {
            let (arm, joint) = (fault.arm.0, fault.joint);
            let reported = &mut disturbance.faults[arm];
            match fault.kind {
                FaultKind::EmergencyStop => reported.emergency_stop = true,
                FaultKind::DriveFault => reported.drive = true,
                FaultKind::Contact => reported.contact = true,
                FaultKind::BlockedJoint => disturbance.blocked.push((fault.arm, joint)),
                FaultKind::Torque => set(&mut disturbance.torque_nm[arm], joint, self.torque_nm),
                FaultKind::Drift => set(&mut disturbance.drift_radps[arm], joint, self.drift_radps),
                FaultKind::LateStates => {}
            }
        }
        disturbance
    }
}

fn set(joints: &mut Joints, joint: usize, value: f64) {
    if let Some(number) = joints.get_mut(joint) {
        *number = value;
    }
}
