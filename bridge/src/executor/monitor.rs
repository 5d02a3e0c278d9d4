//! What states of the arms have to be like to be believed.

use tandem_kinematics::joints::MAX_JOINTS;
use tandem_kinematics::{ArmModel, Excess, Joints, WorkCell};

use crate::driver::{ArmReading, PairState};
use crate::executor::settings::Settings;
use crate::executor::stop::{Breach, StopCause};

/// As many equal angles in a row, bit for bit, are not a moving joint's.
const MOST_EQUAL: u32 = 4;
/// How far the arms' clock may run behind ours, seconds per second.
const CLOCK_DRIFT: f64 = 1e-3;

/// What was seen of the arms, and how good it was.
#[derive(Debug, Clone)]
pub(crate) struct Monitor {
    models: Vec<&'static ArmModel>,
    settings: Settings,
    period_s: f64,
    newest: Option<Seen>,
    /// Smallest time that states took to come, by clocks that do not agree: seconds.
    usual_delay_s: f64,
    /// For each arm and joint how often the angle was the same in a row.
    equal: Vec<[u32; MAX_JOINTS]>,
    n_good: u32,
}

#[derive(Debug, Clone)]
struct Seen {
    state: PairState,
    at_s: f64,
}

/// What the arms were told, as far as a state can be judged by it.
pub(crate) struct Told<'a> {
    /// Number of the newest command.
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
            equal: vec![[0; MAX_JOINTS]; cell.arms.len()],
            n_good: 0,
        }
    }

    /// The newest state that was believed.
    pub(crate) fn state(&self) -> Option<&PairState> {
        self.newest.as_ref().map(|seen| &seen.state)
    }

    /// How many states in a row were good and came in time.
    pub(crate) fn n_good(&self) -> u32 {
        self.n_good
    }

    /// Notes that no state has come because the driver failed: good ones have to come anew.
    pub(crate) fn miss(&mut self) {
        self.n_good = 0;
    }

    /// By how much more than a period the newest state is past, seconds; infinite when there is none.
    pub(crate) fn stale_s(&self, now_s: f64) -> f64 {
        self.newest.as_ref().map_or(f64::INFINITY, |seen| now_s - seen.at_s - self.period_s)
    }

    /// Whether every joint was last seen at rest.
    pub(crate) fn at_rest(&self) -> bool {
        let rests = |arm: &ArmReading| {
            arm.velocities.iter().all(|rate| rate.abs() <= self.settings.rest_radps)
        };
        self.state().is_some_and(|state| state.arms.iter().all(rests))
    }

    /// Takes a state that has come at `now_s`.
    pub(crate) fn take(
        &mut self,
        now_s: f64,
        state: PairState,
        told: &Told<'_>,
    ) -> Result<(), Breach> {
        let known = self.newest.as_ref().map(|seen| seen.state.sequence);
        if known == Some(state.sequence) {
            // Arms may tell less often than once a period.
            if self.stale_s(now_s) > self.settings.state_hold_s {
                self.n_good = 0;
            }
            return Ok(());
        }
        let judged = self.judge(now_s, &state, told);
        if judged.is_ok() {
            self.n_good += 1;
            self.newest = Some(Seen { state, at_s: now_s });
        } else {
            // What comes next is a new beginning: the reason for this stop stands already.
            let settings = self.settings;
            let models = std::mem::take(&mut self.models);
            let equal = vec![[0; MAX_JOINTS]; models.len()];
            let (newest, usual_delay_s) = (None, f64::INFINITY);
            *self = Self { models, settings, newest, usual_delay_s, equal, n_good: 0, ..*self };
        }
        judged
    }

    fn judge(&mut self, now_s: f64, state: &PairState, told: &Told<'_>) -> Result<(), Breach> {
        self.judge_shape(state)?;
        let late_s = self.judge_order(now_s, state)?;
        for (arm, reading) in state.arms.iter().enumerate() {
            judge_faults(arm, reading)?;
            self.judge_torques(arm, reading)?;
            self.judge_motion(arm, state.stamp_s, reading)?;
            self.judge_frozen(arm, reading, &told.velocities[arm])?;
        }
        self.judge_answer(state, told.number, late_s)
    }

    fn judge_shape(&self, state: &PairState) -> Result<(), Breach> {
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

    /// Numbers and times go on as they should. How much later than usual the state is, seconds.
    fn judge_order(&mut self, now_s: f64, state: &PairState) -> Result<f64, Breach> {
        let delay_s = now_s - state.stamp_s;
        if let Some(seen) = &self.newest {
            let expected = seen.state.sequence.wrapping_add(1);
            if state.sequence != expected {
                let got = state.sequence;
                return Err(StopCause::SequenceJump { got, expected }.anywhere());
            }
            if state.stamp_s <= seen.state.stamp_s {
                return Err(StopCause::TimeStands { stamp_s: state.stamp_s }.anywhere());
            }
            self.usual_delay_s += CLOCK_DRIFT * (now_s - seen.at_s);
        }
        self.usual_delay_s = self.usual_delay_s.min(delay_s);
        let (got, allowed) = (delay_s - self.usual_delay_s, self.settings.state_stop_s);
        if got > allowed {
            return Err(StopCause::StateOld(Excess { got, allowed }).anywhere());
        }
        Ok(got)
    }

    fn judge_torques(&self, arm: usize, reading: &ArmReading) -> Result<(), Breach> {
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

    /// Joints are not faster than they can be, by their rates and by their angles.
    fn judge_motion(&self, arm: usize, stamp_s: f64, reading: &ArmReading) -> Result<(), Breach> {
        for (joint, limits) in self.models[arm].joints.iter().enumerate() {
            let allowed = self.settings.overspeed_share * limits.speed_radps;
            let got = reading.velocities[joint].abs();
            if got > allowed {
                return Err(StopCause::Overspeed(Excess { got, allowed }).of_joint(arm, joint));
            }
            if let Some(seen) = &self.newest {
                let before = seen.state.arms[arm].angles[joint];
                let since_s = stamp_s - seen.state.stamp_s;
                let allowed = allowed * since_s + self.settings.jump_rad;
                let got = (reading.angles[joint] - before).abs();
                if got > allowed {
                    return Err(StopCause::AngleJump(Excess { got, allowed }).of_joint(arm, joint));
                }
            }
        }
        Ok(())
    }

    fn judge_frozen(
        &mut self,
        arm: usize,
        reading: &ArmReading,
        told: &Joints,
    ) -> Result<(), Breach> {
        let before = self.newest.as_ref().map(|seen| seen.state.arms[arm].angles);
        for (joint, told_radps) in told.iter().enumerate() {
            let angle = reading.angles[joint];
            let same = before.is_some_and(|before| before[joint].to_bits() == angle.to_bits());
            let count = &mut self.equal[arm][joint];
            *count =
                if same && told_radps.abs() > self.settings.frozen_radps { *count + 1 } else { 0 };
            if *count >= MOST_EQUAL {
                return Err(StopCause::Frozen(angle).of_joint(arm, joint));
            }
        }
        Ok(())
    }

    /// Commands take effect in time, where the arms tell. A late state cannot know the newest ones.
    fn judge_answer(&self, state: &PairState, number: u64, late_s: f64) -> Result<(), Breach> {
        let Some(newest) = state.newest_command else { return Ok(()) };
        // A larger number is of somebody else's command.
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

fn judge_faults(arm: usize, reading: &ArmReading) -> Result<(), Breach> {
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
