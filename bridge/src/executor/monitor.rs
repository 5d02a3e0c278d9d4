//! The validation of the states that the arms report.

use tandem_kinematics::joints::MAX_JOINTS;
use tandem_kinematics::{ArmModel, Excess, Joints, WorkCell};

use crate::driver::{ArmReading, PairState};
use crate::executor::errors::ResetError;
use crate::executor::settings::Settings;
use crate::executor::stop::{LocatedCause, StopCause};

/// A moving joint does not report this many bit-identical angles in a row.
const MAX_EQUAL_ANGLES: u32 = 4;
/// The largest drift of the arms' clock behind the local one, seconds per second.
const CLOCK_DRIFT: f64 = 1e-3;

/// Validates states and keeps the newest one whose measurements are valid.
#[derive(Debug, Clone)]
pub(crate) struct Monitor {
    models: Vec<&'static ArmModel>,
    settings: Settings,
    period_s: f64,
    newest: Option<ReceivedState>,
    /// The smallest delay of a state, seconds. It contains the offset between the two clocks.
    usual_delay_s: f64,
    /// The number of consecutive equal angles of each arm and joint.
    n_equal: Vec<[u32; MAX_JOINTS]>,
    n_good: u32,
}

#[derive(Debug, Clone)]
struct ReceivedState {
    state: PairState,
    at_s: f64,
}

/// The commands that a state should reflect.
pub(crate) struct ExpectedState<'a> {
    /// The number of the newest command.
    pub(crate) number: u64,
    /// Velocities that the state should show, arm by arm, radians per second.
    pub(crate) velocities: &'a [Joints],
}

impl Monitor {
    pub(crate) fn new(cell: &WorkCell, settings: &Settings, period_s: f64) -> Self {
        Self {
            models: cell.arms.iter().map(|arm| arm.model).collect(),
            settings: *settings,
            period_s,
            newest: None,
            usual_delay_s: f64::INFINITY,
            n_equal: vec![[0; MAX_JOINTS]; cell.arms.len()],
            n_good: 0,
        }
    }

    /// The newest valid state.
    pub(crate) fn state(&self) -> Option<&PairState> {
        self.newest.as_ref().map(|seen| &seen.state)
    }

    /// The number of consecutive valid states that arrived in time.
    pub(crate) fn n_good(&self) -> u32 {
        self.n_good
    }

    /// Returns why the newest state forbids a reset: an arm reports a fault or a torque beyond the limit.
    pub(crate) fn reported(&self) -> Option<ResetError> {
        let LocatedCause { arm, cause, .. } = self.check_reports(self.state()?).err()?;
        Some(ResetError::Reported { arm: arm?, cause })
    }

    /// Counts good states from 0 again, because an exchange failed.
    pub(crate) fn exchange_failed(&mut self) {
        self.n_good = 0;
    }

    /// The age of the newest state beyond one period, seconds; infinite if there is none.
    pub(crate) fn stale_s(&self, now_s: f64) -> f64 {
        self.newest.as_ref().map_or(f64::INFINITY, |seen| now_s - seen.at_s - self.period_s)
    }

    /// Returns true if every joint was at rest in the newest state.
    pub(crate) fn at_rest(&self) -> bool {
        let rests = |arm: &ArmReading| {
            arm.velocities.iter().all(|rate| rate.abs() <= self.settings.rest_radps)
        };
        self.state().is_some_and(|state| state.arms.iter().all(rests))
    }

    /// Accepts a state received at `now_s` if it is valid.
    pub(crate) fn accept(
        &mut self,
        now_s: f64,
        state: PairState,
        expected: &ExpectedState<'_>,
    ) -> Result<(), LocatedCause> {
        let known = self.newest.as_ref().map(|seen| seen.state.sequence);
        if known == Some(state.sequence) {
            // Arms may report less often than once per period.
            if self.stale_s(now_s) > self.settings.state_hold_s {
                self.n_good = 0;
            }
            return Ok(());
        }
        let ordered = self.check_shape(&state).and_then(|()| self.check_order(now_s, &state));
        let (reported, measured) = match ordered {
            Ok(late_s) => {
                let reported = self.check_reports(&state);
                (reported, self.check_measurements(now_s, &state, expected, late_s))
            }
            Err(cause) => (Ok(()), Err(cause)),
        };
        if measured.is_ok() {
            // Arms that report a fault still report where they are.
            self.n_good = if reported.is_ok() { self.n_good + 1 } else { 0 };
            self.newest = Some(ReceivedState { state, at_s: now_s });
        } else {
            // The cause of this stop is already recorded.
            self.forget();
        }
        reported.and(measured)
    }

    /// Forgets all states: the next one starts a new sequence.
    pub(crate) fn forget(&mut self) {
        self.n_equal.fill([0; MAX_JOINTS]);
        (self.newest, self.usual_delay_s, self.n_good) = (None, f64::INFINITY, 0);
    }

    /// Checks that the arms report no fault and no torque beyond the limit.
    fn check_reports(&self, state: &PairState) -> Result<(), LocatedCause> {
        for (arm, reading) in state.arms.iter().enumerate() {
            check_faults(arm, reading)?;
            self.check_torques(arm, reading)?;
        }
        Ok(())
    }

    /// Checks that the measurements can be true, and that commands take effect. The state is received at `now_s`,
    /// `late_s` seconds later than usual.
    fn check_measurements(
        &mut self,
        now_s: f64,
        state: &PairState,
        expected: &ExpectedState<'_>,
        late_s: f64,
    ) -> Result<(), LocatedCause> {
        for (arm, reading) in state.arms.iter().enumerate() {
            self.check_motion(arm, now_s, state.stamp_s, reading)?;
            self.check_frozen(arm, reading, &expected.velocities[arm])?;
        }
        self.check_effect(state, expected.number, late_s)
    }

    fn check_shape(&self, state: &PairState) -> Result<(), LocatedCause> {
        let (got, expected) = (state.arms.len(), self.models.len());
        if got != expected {
            return Err(StopCause::Shape { got, expected }.anywhere());
        }
        if !state.stamp_s.is_finite() {
            return Err(StopCause::StateNotFinite.anywhere());
        }
        for (arm, (reading, model)) in state.arms.iter().zip(&self.models).enumerate() {
            let torques = reading.torques_nm.iter();
            for numbers in [&reading.angles, &reading.velocities].into_iter().chain(torques) {
                let (got, expected) = (numbers.len(), model.n_joints());
                if got != expected {
                    return Err(StopCause::Shape { got, expected }.of(arm));
                }
                if let Some(joint) = numbers.iter().position(|number| !number.is_finite()) {
                    return Err(StopCause::StateNotFinite.of_joint(arm, joint));
                }
            }
            if !reading.opening.is_finite() {
                return Err(StopCause::StateNotFinite.of(arm));
            }
        }
        Ok(())
    }

    /// Checks sequence number and time stamp. Returns the delay of the state beyond the usual one, seconds.
    fn check_order(&mut self, now_s: f64, state: &PairState) -> Result<f64, LocatedCause> {
        let delay_s = now_s - state.stamp_s;
        if let Some(seen) = &self.newest {
            let expected = seen.state.sequence.wrapping_add(1);
            if state.sequence != expected {
                let got = state.sequence;
                return Err(StopCause::SequenceJump { got, expected }.anywhere());
            }
            if state.stamp_s <= seen.state.stamp_s {
                return Err(StopCause::StampNotAdvancing { stamp_s: state.stamp_s }.anywhere());
            }
            self.usual_delay_s += CLOCK_DRIFT * (now_s - seen.at_s);
        }
        self.usual_delay_s = self.usual_delay_s.min(delay_s);
        let (got, allowed) = (delay_s - self.usual_delay_s, self.settings.state_stop_s);
        if got > allowed {
            return Err(StopCause::StateDelayed(Excess { got, allowed }).anywhere());
        }
        Ok(got)
    }

    fn check_torques(&self, arm: usize, reading: &ArmReading) -> Result<(), LocatedCause> {
        let allowed = self.settings.torque_nm;
        let torques = reading.torques_nm.iter().flat_map(|torques| torques.iter());
        for (joint, torque) in torques.enumerate() {
            let got = torque.abs();
            if got > allowed {
                return Err(StopCause::Torque(Excess { got, allowed }).of_joint(arm, joint));
            }
        }
        Ok(())
    }

    /// Checks that no joint is faster than it can be, by its rate and by the change of its angle. The time stamp of a
    /// state is that of its oldest measurement. Arms that were measured later may have turned for longer than from
    /// stamp to stamp, but hardly for longer than from receipt to receipt.
    fn check_motion(
        &self,
        arm: usize,
        now_s: f64,
        stamp_s: f64,
        reading: &ArmReading,
    ) -> Result<(), LocatedCause> {
        for (joint, limits) in self.models[arm].joints.iter().enumerate() {
            let allowed = self.settings.overspeed_share * limits.speed_radps;
            let got = reading.velocities[joint].abs();
            if got > allowed {
                return Err(StopCause::Overspeed(Excess { got, allowed }).of_joint(arm, joint));
            }
            if let Some(seen) = &self.newest {
                let before = seen.state.arms[arm].angles[joint];
                let since_s = (stamp_s - seen.state.stamp_s).max(now_s - seen.at_s);
                let allowed = allowed * since_s + self.settings.jump_rad;
                let got = (reading.angles[joint] - before).abs();
                if got > allowed {
                    return Err(StopCause::AngleJump(Excess { got, allowed }).of_joint(arm, joint));
                }
            }
        }
        Ok(())
    }

    fn check_frozen(
        &mut self,
        arm: usize,
        reading: &ArmReading,
        commanded: &Joints,
    ) -> Result<(), LocatedCause> {
        let before = self.newest.as_ref().map(|seen| seen.state.arms[arm].angles);
        for (joint, commanded_radps) in commanded.iter().enumerate() {
            let angle = reading.angles[joint];
            let same = before.is_some_and(|before| before[joint].to_bits() == angle.to_bits());
            let count = &mut self.n_equal[arm][joint];
            *count = if same && commanded_radps.abs() > self.settings.frozen_radps {
                *count + 1
            } else {
                0
            };
            if *count >= MAX_EQUAL_ANGLES {
                return Err(StopCause::Frozen(angle).of_joint(arm, joint));
            }
        }
        Ok(())
    }

    /// Checks that commands take effect in time, if the arms report that. A delayed state cannot reflect the newest
    /// commands.
    fn check_effect(
        &self,
        state: &PairState,
        number: u64,
        late_s: f64,
    ) -> Result<(), LocatedCause> {
        let Some(newest) = state.newest_command else { return Ok(()) };
        // A larger number belongs to the command of another client.
        let newest = if newest > number { 0 } else { newest };
        let unknown = (late_s / self.period_s).round();
        let got = (number - newest) as f64 - unknown;
        let allowed = (self.settings.command_s / self.period_s).floor();
        if got > allowed {
            return Err(StopCause::CommandLost(Excess { got, allowed }).anywhere());
        }
        Ok(())
    }
}

fn check_faults(arm: usize, reading: &ArmReading) -> Result<(), LocatedCause> {
    let faults = reading.faults;
    if faults.emergency_stop {
        Err(StopCause::EmergencyStop.of(arm))
    } else if faults.drive {
        Err(StopCause::DriveFault.of(arm))
    } else if faults.contact {
        Err(StopCause::ContactReported.of(arm))
    } else {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::driver::Faults;
    use crate::work_cell::mico_cell;

    /// Arms whose first joints turned by these angles, radians.
    fn state(sequence: u64, stamp_s: f64, turned: [f64; 2]) -> PairState {
        let reading = |turned: f64| ArmReading {
            angles: Joints::from_fn(4, |joint| if joint == 0 { turned } else { 0.0 }),
            velocities: Joints::from_fn(4, |_| 0.0),
            torques_nm: None,
            opening: 1.0,
            faults: Faults::default(),
        };
        let arms = turned.map(reading).to_vec();
        PairState { sequence, stamp_s, newest_command: None, arms }
    }

    #[test]
    fn an_arm_that_was_measured_after_the_stamp_may_have_turned_for_longer() {
        let cell = mico_cell();
        let settings = Settings { state_hold_s: 0.13, state_stop_s: 0.25, ..Settings::default() };
        let velocities = vec![Joints::from_fn(4, |_| 0.0); 2];
        let expected = ExpectedState { number: 0, velocities: &velocities };
        let fastest = cell.arms[1].model.joints[0].speed_radps;
        let second = |turned: f64| {
            let mut monitor = Monitor::new(&cell, &settings, 0.01);
            // The first arm reports at 0.24 s, 40 ms late, and at 0.30 s; the second one at 0.25 s and 0.35 s.
            monitor.accept(100.25, state(1, 0.24, [0.0; 2]), &expected).unwrap();
            monitor.accept(100.35, state(2, 0.30, [0.06 * fastest, turned]), &expected)
        };
        assert_eq!(second(0.10 * fastest), Ok(()));
        let jump = second(0.14 * fastest + settings.jump_rad).unwrap_err();
        assert!(matches!(jump.cause, StopCause::AngleJump(_)), "{jump:?}");
    }
}
