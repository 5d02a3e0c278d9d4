//! The playback of a motion: the reference positions over time and the velocities that follow them.

use std::collections::VecDeque;

use tandem_kinematics::{ArmSample, Excess, Joints, Motion, WorkCell};

use crate::driver::{ArmCommand, PairState};
use crate::executor::envelope::reachable;
use crate::executor::settings::Settings;
use crate::executor::stop::{LocatedCause, StopCause};

/// Openings that are no further apart than this are equal.
const OPENING_TOLERANCE: f64 = 1e-6;

/// A motion and its progress.
#[derive(Debug, Clone)]
pub(crate) struct Playback {
    motion: Motion,
    /// The requested share of the motion's own speed.
    speed: f64,
    /// The present share of the motion's own speed.
    rate: f64,
    /// The part of the motion that has been played, seconds of its own time.
    played_s: f64,
    /// The time since the end of the motion, seconds.
    since_end_s: f64,
    /// The part of that time in which the grippers were not yet commanded to their last openings, seconds.
    opening_s: f64,
    /// The references of the last periods, the newest first.
    references: VecDeque<Vec<Joints>>,
}

/// The inputs of one tick.
pub(crate) struct TickContext<'a> {
    pub(crate) cell: &'a WorkCell,
    pub(crate) settings: &'a Settings,
    pub(crate) period_s: f64,
    /// The newest state; `None` if it is too old for feedback.
    pub(crate) state: Option<&'a PairState>,
    /// The age of the newest state beyond one period, in whole periods.
    pub(crate) stale_periods: usize,
    /// The last command, arm by arm.
    pub(crate) last: &'a [ArmCommand],
}

impl Playback {
    /// Plays `motion` from its beginning at `speed`, in (0, 1].
    pub(crate) fn new(motion: Motion, speed: f64) -> Self {
        let at: Vec<Joints> = motion.at(0.0).into_iter().map(|sample| sample.angles).collect();
        let references = VecDeque::from([at]);
        let (rate, played_s, since_end_s, opening_s) = (speed, 0.0, 0.0, 0.0);
        Self { motion, speed, rate, played_s, since_end_s, opening_s, references }
    }

    pub(crate) fn played_s(&self) -> f64 {
        self.played_s
    }

    pub(crate) fn duration_s(&self) -> f64 {
        self.motion.duration_s()
    }

    /// The time since the end of the motion, seconds; 0 before the end.
    pub(crate) fn since_end_s(&self) -> f64 {
        self.since_end_s
    }

    /// The time since the end of the motion and since the grippers are commanded to their last openings, seconds; 0
    /// before.
    pub(crate) fn settling_s(&self) -> f64 {
        self.since_end_s - self.opening_s
    }

    /// The joint angles that the motion prescribes now, radians.
    pub(crate) fn reference(&self) -> &[Joints] {
        &self.references[0]
    }

    /// Advances the motion by a period, or brings it to rest on its path if `paused`, and returns the next command. The
    /// envelope still has to check it.
    pub(crate) fn next(
        &mut self,
        context: &TickContext<'_>,
        paused: bool,
    ) -> Result<Vec<ArmCommand>, LocatedCause> {
        let errors = match context.state {
            Some(state) => Some(self.errors(context, state)?),
            None => None,
        };
        let opening_step = context.settings.check.limits.gripper_opening_per_s * context.period_s;
        let from = self.references[0].clone();
        self.advance(context, paused);
        let to = self.motion.at(self.played_s);
        let command = |arm: usize| {
            let ahead = Joints::from_fn(from[arm].len(), |joint| {
                let error = errors.as_ref().map_or(0.0, |errors| errors[arm][joint]);
                let ahead = (to[arm].angles[joint] - from[arm][joint]) / context.period_s;
                ahead + context.settings.gain_per_s * error
            });
            let last = context.last[arm].opening;
            let opening = to[arm].gripper_opening.clamp(last - opening_step, last + opening_step);
            ArmCommand { velocities: within_limits(context, arm, &ahead), opening }
        };
        let commands: Vec<ArmCommand> = (0..from.len()).map(command).collect();
        let opens = |(to, command): (&ArmSample, &ArmCommand)| {
            (to.gripper_opening - command.opening).abs() > OPENING_TOLERANCE
        };
        if to.iter().zip(&commands).any(opens) {
            self.opening_s = self.since_end_s;
        }
        self.references.push_front(to.into_iter().map(|sample| sample.angles).collect());
        self.references.truncate(Self::n_references(context));
        Ok(commands)
    }

    /// The largest distance of a joint from the motion's end, radians.
    pub(crate) fn distance_to_end(&self, state: &PairState) -> f64 {
        let ends = self.motion.at(self.duration_s());
        let distances = ends.iter().zip(&state.arms);
        distances.map(|(end, arm)| end.angles.largest_difference(&arm.angles)).fold(0.0, f64::max)
    }

    fn advance(&mut self, context: &TickContext<'_>, paused: bool) {
        let (wanted, seconds) = if paused {
            (0.0, context.settings.pause_s)
        } else {
            (self.speed, context.settings.resume_s)
        };
        let step = context.period_s / seconds;
        let rate = wanted.clamp(self.rate - step, self.rate + step);
        self.played_s += 0.5 * (self.rate + rate) * context.period_s;
        self.rate = rate;
        if self.played_s >= self.duration_s() {
            self.played_s = self.duration_s();
            self.since_end_s += context.period_s;
        }
    }

    /// The tracking errors, radians: the references one lag before the newest state minus the measured angles.
    fn errors(
        &self,
        context: &TickContext<'_>,
        state: &PairState,
    ) -> Result<Vec<Joints>, LocatedCause> {
        let allowed = context.settings.tracking_rad;
        let mut errors = Vec::with_capacity(state.arms.len());
        for (arm, reading) in state.arms.iter().enumerate() {
            let then = self.reference_ago(context, arm);
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

    /// The reference of `arm` one lag before the newest state, radians. Arms that report less often than once per
    /// period are compared with the reference of the time of their report.
    fn reference_ago(&self, context: &TickContext<'_>, arm: usize) -> Joints {
        let periods = context.settings.lag_s / context.period_s;
        let newer = lag_periods(context);
        let share = periods - newer as f64;
        let newer = newer + context.stale_periods;
        let reference = |ago: usize| &self.references[ago.min(self.references.len() - 1)][arm];
        let (newer, older) = (reference(newer), reference(newer + 1));
        Joints::from_fn(newer.len(), |joint| newer[joint] + share * (older[joint] - newer[joint]))
    }

    /// The number of references to keep, which covers one lag and the age of states that are good for feedback.
    fn n_references(context: &TickContext<'_>) -> usize {
        lag_periods(context) + whole_periods(context.settings.state_hold_s, context) + 3
    }
}

/// Returns the whole periods of a lag.
fn lag_periods(context: &TickContext<'_>) -> usize {
    whole_periods(context.settings.lag_s, context)
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "settings are a few periods, and positive"
)]
fn whole_periods(time_s: f64, context: &TickContext<'_>) -> usize {
    (time_s / context.period_s) as usize
}

/// Returns the velocities nearest to `wanted` that keep the speed and acceleration limits of joints and tool.
fn within_limits(context: &TickContext<'_>, arm: usize, wanted: &Joints) -> Joints {
    let placed = &context.cell.arms[arm];
    let (limits, last) = (&context.settings.check.limits, &context.last[arm].velocities);
    let ranges: Vec<[f64; 2]> = placed
        .model
        .joints
        .iter()
        .zip(last.iter())
        .map(|(joint, last)| reachable(joint, *last, context.settings, context.period_s))
        .collect();
    let mut velocities = Joints::from_fn(wanted.len(), |joint| {
        let fastest = placed.model.joints[joint].speed_radps;
        let [low, high] = ranges[joint];
        wanted[joint].clamp(-fastest, fastest).clamp(low, high)
    });
    let Some(state) = context.state else { return velocities };
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
