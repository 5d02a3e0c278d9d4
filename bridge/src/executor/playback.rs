//! A motion being played: where it has the arms at any time, and which velocities bring them there.

use std::collections::VecDeque;

use tandem_kinematics::{Excess, Joints, Motion, WorkCell};

use crate::driver::{ArmCommand, PairState};
use crate::executor::envelope::reachable;
use crate::executor::settings::Settings;
use crate::executor::stop::{Breach, StopCause};

/// A motion and how far it has come.
#[derive(Debug, Clone)]
pub(crate) struct Playback {
    motion: Motion,
    /// Share of the motion's own speed at which it shall be played.
    speed: f64,
    /// Share of the motion's own speed at which it is played now.
    rate: f64,
    /// How much of the motion has been played, seconds of its own time.
    played_s: f64,
    /// How long the motion has been over, seconds.
    over_s: f64,
    /// Where the motion had the arms, the newest first: one entry a period.
    past: VecDeque<Vec<Joints>>,
}

/// What surrounds one tick.
pub(crate) struct Moment<'a> {
    pub(crate) cell: &'a WorkCell,
    pub(crate) settings: &'a Settings,
    pub(crate) period_s: f64,
    /// The newest state; `None` when it is too old to be steered by.
    pub(crate) state: Option<&'a PairState>,
    /// The command before.
    pub(crate) before: &'a [ArmCommand],
}

impl Playback {
    /// Plays `motion` from its beginning at `speed`, in (0, 1].
    pub(crate) fn new(motion: Motion, speed: f64) -> Self {
        let at: Vec<Joints> = motion.at(0.0).into_iter().map(|sample| sample.angles).collect();
        let past = VecDeque::from([at]);
        Self { motion, speed, rate: speed, played_s: 0.0, over_s: 0.0, past }
    }

    pub(crate) fn played_s(&self) -> f64 {
        self.played_s
    }

    pub(crate) fn duration_s(&self) -> f64 {
        self.motion.duration_s()
    }

    /// How long the motion has been over, seconds; 0 while it is being played.
    pub(crate) fn over_s(&self) -> f64 {
        self.over_s
    }

    /// Where the motion has the arms now, radians.
    pub(crate) fn reference(&self) -> &[Joints] {
        &self.past[0]
    }

    /// The next command, before the envelope has looked at it. The motion goes on by a period, or comes to rest on its way
    /// when `paused`.
    pub(crate) fn next(
        &mut self,
        moment: &Moment<'_>,
        paused: bool,
    ) -> Result<Vec<ArmCommand>, Breach> {
        let errors = match moment.state {
            Some(state) => Some(self.errors(moment, state)?),
            None => None,
        };
        let opening_step = moment.settings.check.limits.gripper_opening_per_s * moment.period_s;
        let from = self.past[0].clone();
        self.go_on(moment, paused);
        let to = self.motion.at(self.played_s);
        let command = |arm: usize| {
            let ahead = Joints::from_fn(from[arm].len(), |joint| {
                let error = errors.as_ref().map_or(0.0, |errors| errors[arm][joint]);
                let ahead = (to[arm].angles[joint] - from[arm][joint]) / moment.period_s;
                ahead + moment.settings.gain_per_s * error
            });
            let before = moment.before[arm].opening;
            let opening =
                to[arm].gripper_opening.clamp(before - opening_step, before + opening_step);
            ArmCommand { velocities: within_limits(moment, arm, &ahead), opening }
        };
        let commands = (0..from.len()).map(command).collect();
        self.past.push_front(to.into_iter().map(|sample| sample.angles).collect());
        self.past.truncate(self.n_past(moment));
        Ok(commands)
    }

    /// The largest distance of a joint from the motion's end, radians.
    pub(crate) fn distance_to_end(&self, state: &PairState) -> f64 {
        let ends = self.motion.at(self.duration_s());
        let distances = ends.iter().zip(&state.arms);
        distances.map(|(end, arm)| end.angles.largest_difference(&arm.angles)).fold(0.0, f64::max)
    }

    fn go_on(&mut self, moment: &Moment<'_>, paused: bool) {
        let (wanted, seconds) = if paused {
            (0.0, moment.settings.pause_s)
        } else {
            (self.speed, moment.settings.resume_s)
        };
        let step = moment.period_s / seconds;
        let rate = wanted.clamp(self.rate - step, self.rate + step);
        self.played_s += 0.5 * (self.rate + rate) * moment.period_s;
        self.rate = rate;
        if self.played_s >= self.duration_s() {
            self.played_s = self.duration_s();
            self.over_s += moment.period_s;
        }
    }

    /// How far each joint is from where the motion had it when what is seen now was told, radians.
    fn errors(&self, moment: &Moment<'_>, state: &PairState) -> Result<Vec<Joints>, Breach> {
        let allowed = moment.settings.tracking_rad;
        let mut errors = Vec::with_capacity(state.arms.len());
        for (arm, reading) in state.arms.iter().enumerate() {
            let then = self.reference_ago(moment, arm);
            let error = Joints::from_fn(then.len(), |joint| then[joint] - reading.angles[joint]);
            for (joint, error) in error.iter().enumerate() {
                let got = error.abs();
                if got > allowed {
                    return Err(StopCause::Tracking(Excess { got, allowed }).of_joint(arm, joint));
                }
            }
            errors.push(error);
        }
        Ok(errors)
    }

    /// Where the motion had `arm` one lag ago.
    fn reference_ago(&self, moment: &Moment<'_>, arm: usize) -> Joints {
        let periods = moment.settings.lag_s / moment.period_s;
        let newer = self.n_past(moment) - 2;
        let share = periods - newer as f64;
        let past = |ago: usize| &self.past[ago.min(self.past.len() - 1)][arm];
        let (newer, older) = (past(newer), past(newer + 1));
        Joints::from_fn(newer.len(), |joint| newer[joint] + share * (older[joint] - newer[joint]))
    }

    /// How many references are kept: as far back as one lag.
    fn n_past(&self, moment: &Moment<'_>) -> usize {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a lag is some periods"
        )]
        let periods = (moment.settings.lag_s / moment.period_s) as usize;
        periods + 2
    }
}

/// The velocities nearest to `wanted` that keep the joints' and the tool's limits and can stop within the joints' ranges.
fn within_limits(moment: &Moment<'_>, arm: usize, wanted: &Joints) -> Joints {
    let placed = &moment.cell.arms[arm];
    let (limits, before) = (&moment.settings.check.limits, &moment.before[arm].velocities);
    let ranges: Vec<[f64; 2]> = placed
        .model
        .joints
        .iter()
        .zip(before.iter())
        .map(|(joint, before)| reachable(joint, *before, moment.settings, moment.period_s))
        .collect();
    let mut velocities = Joints::from_fn(wanted.len(), |joint| {
        let fastest = placed.model.joints[joint].speed_radps;
        let [low, high] = ranges[joint];
        wanted[joint].clamp(-fastest, fastest).clamp(low, high)
    });
    let Some(state) = moment.state else { return velocities };
    let posture = tandem_kinematics::ForwardKinematics::new(placed.model, &state.arms[arm].angles);
    let tool_mps = posture.tool_velocity(&velocities).norm();
    if tool_mps > limits.tool_speed_mps {
        let share = limits.tool_speed_mps / tool_mps;
        for (velocity, [low, high]) in velocities.iter_mut().zip(&ranges) {
            *velocity = (*velocity * share).clamp(*low, *high);
        }
    }
    velocities
}
