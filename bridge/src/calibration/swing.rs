//! The swings of a joint that is measured.

use tandem_core::ArmIndex;
use tandem_kinematics::{ArmSample, Joints, Motion};

use crate::driver::PairState;

/// Time from one sample to the next, seconds.
const PERIOD_S: f64 = 0.01;

/// The swing of a joint, which accelerates, keeps its speed and brakes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Swing {
    /// The arm.
    pub(super) arm: ArmIndex,
    /// The joint, counted from 0.
    pub(super) joint: usize,
    /// Largest speed, radians per second.
    pub(super) radps: f64,
    /// Acceleration, radians per second squared.
    pub(super) radps2: f64,
}

impl Swing {
    /// Time for which a full swing keeps its speed, seconds.
    pub(super) const CONSTANT_S: f64 = 0.3;

    /// Time in which the joint reaches its speed, seconds.
    pub(super) fn ramp_s(&self) -> f64 {
        self.radps / self.radps2
    }

    /// A full swing, radians.
    pub(super) fn full_rad(&self) -> f64 {
        self.radps * (Self::CONSTANT_S + self.ramp_s())
    }

    /// The smallest swing that is measured, radians.
    pub(super) fn least_rad(&self) -> f64 {
        0.02 * self.full_rad()
    }

    /// Returns the motion from `state` that turns the joint by `by` radians and keeps the others where they are.
    pub(super) fn motion(&self, state: &PairState, by: f64) -> Motion {
        let (side, length) = (by.signum(), by.abs());
        // A short swing does not reach the speed.
        let ramp_s = self.ramp_s().min((length / self.radps2).sqrt());
        let radps = self.radps2 * ramp_s;
        let constant_s = (length / radps - ramp_s).max(0.0);
        let duration_s = 2.0 * ramp_s + constant_s;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a swing takes about a second"
        )]
        let n_intervals = ((duration_s / PERIOD_S).ceil() as usize).max(1);
        // Samples at whole periods end a little later than the swing: slow it down by as much.
        let slower = duration_s / (n_intervals as f64 * PERIOD_S);
        let at = |time_s: f64| {
            let (left_s, peak_s) = (duration_s - time_s, ramp_s + constant_s);
            if time_s < ramp_s {
                (0.5 * self.radps2 * time_s * time_s, self.radps2 * time_s)
            } else if time_s < peak_s {
                (radps * (time_s - 0.5 * ramp_s), radps)
            } else {
                (length - 0.5 * self.radps2 * left_s * left_s, self.radps2 * left_s)
            }
        };
        let sample = |idx: usize, arm_idx: usize| {
            let reading = &state.arms[arm_idx];
            let (turned, radps) =
                if idx == n_intervals { (length, 0.0) } else { at(idx as f64 * PERIOD_S * slower) };
            let moves = |other: usize| arm_idx == self.arm.0 && other == self.joint;
            let n_joints = reading.angles.len();
            ArmSample {
                angles: Joints::from_fn(n_joints, |other| {
                    reading.angles[other] + if moves(other) { side * turned } else { 0.0 }
                }),
                velocities: Joints::from_fn(n_joints, |other| {
                    if moves(other) { side * radps * slower } else { 0.0 }
                }),
                gripper_opening: reading.opening.clamp(0.0, 1.0),
            }
        };
        let samples = |arm_idx| (0..=n_intervals).map(|idx| sample(idx, arm_idx)).collect();
        Motion { period_s: PERIOD_S, arms: (0..state.arms.len()).map(samples).collect() }
    }
}
