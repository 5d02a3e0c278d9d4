//! Planned motions of all arms, evaluated at any time or sampled.

use tandem_core::ArmIndex;

use crate::joints::Joints;
use crate::motion::{ArmSample, Motion};
use crate::spline::Spline;
use crate::work_cell::WorkCell;

/// The default number of samples per second.
pub const DEFAULT_RATE_HZ: f64 = 100.0;

/// The layout of a path's channels: for each arm its joints, then its gripper's opening.
#[derive(Debug, Clone)]
pub(crate) struct Channels {
    /// First channel of each arm, then the number of channels.
    firsts: Vec<usize>,
}

/// The motion of all arms from rest to rest. Times are seconds since its start.
#[derive(Debug, Clone)]
pub struct Trajectory {
    channels: Channels,
    path: Spline,
    /// Rate of the path at the ends of the spans, spans per second.
    rates: Vec<f64>,
    /// Times of these ends, seconds.
    times_s: Vec<f64>,
    n_pieces: u32,
}

/// The state of one arm at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmState {
    /// Joint angles, radians.
    pub angles: Joints,
    /// Joint velocities, radians per second.
    pub velocities: Joints,
    /// Joint accelerations, radians per second squared.
    pub accelerations: Joints,
    /// Opening of the gripper: 0 is closed, 1 open.
    pub gripper_opening: f64,
    /// Rate of change of the opening, 1/s.
    pub gripper_opening_per_s: f64,
}

/// A point of the path and the rate and acceleration of the path parameter there.
struct PathPoint {
    span: usize,
    share: f64,
    rate: f64,
    acceleration: f64,
}

impl Trajectory {
    pub(crate) fn new(channels: Channels, path: Spline, rates: Vec<f64>, n_pieces: u32) -> Self {
        let mut times_s = vec![0.0];
        let mut now_s = 0.0;
        for ends in rates.windows(2) {
            now_s += 2.0 / (ends[0] + ends[1]);
            times_s.push(now_s);
        }
        Self { channels, path, rates, times_s, n_pieces }
    }

    /// Returns the duration, seconds.
    #[must_use]
    pub fn duration_s(&self) -> f64 {
        self.times_s[self.times_s.len() - 1]
    }

    /// Returns the time at which the tools are at waypoint `idx` (counted from 0), or closest to it in a corner,
    /// seconds.
    ///
    /// # Panics
    /// If there is no such waypoint.
    #[must_use]
    pub fn waypoint_s(&self, idx: usize) -> f64 {
        self.times_s[idx * self.n_pieces as usize]
    }

    /// Returns the state of every arm at `time_s` (seconds). The arms rest before the start and after the end.
    #[must_use]
    pub fn at(&self, time_s: f64) -> Vec<ArmState> {
        let point = self.path_point(time_s);
        (0..self.channels.n_arms()).map(|arm| self.state(&point, ArmIndex(arm))).collect()
    }

    /// Samples the motion `rate_hz` times a second. The last sample is at or just after the end.
    ///
    /// # Panics
    /// If `rate_hz` is not positive and finite.
    #[must_use]
    pub fn sampled(&self, rate_hz: f64) -> Motion {
        assert!(rate_hz > 0.0 && rate_hz.is_finite(), "{rate_hz} samples a second");
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a finite number of samples that must fit in memory anyway"
        )]
        let n_periods = (self.duration_s() * rate_hz).ceil() as u32;
        let mut arms = vec![Vec::new(); self.channels.n_arms()];
        for sample in 0..=n_periods {
            for (arm, state) in arms.iter_mut().zip(self.at(f64::from(sample) / rate_hz)) {
                let ArmState { angles, velocities, gripper_opening, .. } = state;
                arm.push(ArmSample { angles, velocities, gripper_opening });
            }
        }
        Motion { period_s: 1.0 / rate_hz, arms }
    }

    fn path_point(&self, time_s: f64) -> PathPoint {
        let n_spans = self.path.n_spans();
        let time_s = time_s.clamp(0.0, self.duration_s());
        let span = self.times_s.partition_point(|start_s| *start_s <= time_s);
        let span = span.saturating_sub(1).min(n_spans - 1);
        let (from, to) = (self.rates[span], self.rates[span + 1]);
        let acceleration = 0.5 * (to * to - from * from);
        let since_s = time_s - self.times_s[span];
        let share = (from + 0.5 * acceleration * since_s) * since_s;
        let rate = from + acceleration * since_s;
        PathPoint { span, share: share.clamp(0.0, 1.0), rate: rate.max(0.0), acceleration }
    }

    fn state(&self, point: &PathPoint, arm: ArmIndex) -> ArmState {
        let jet = |channel| self.path.at(point.span, point.share, channel);
        let n_joints = self.channels.n_joints(arm);
        let of_joints = |value: &dyn Fn(usize) -> f64| {
            Joints::from_fn(n_joints, |joint| value(self.channels.joint(arm, joint)))
        };
        let opening = jet(self.channels.gripper(arm));
        ArmState {
            angles: of_joints(&|channel| jet(channel).value),
            velocities: of_joints(&|channel| jet(channel).first * point.rate),
            accelerations: of_joints(&|channel| {
                let jet = jet(channel);
                jet.second * point.rate * point.rate + jet.first * point.acceleration
            }),
            gripper_opening: opening.value.clamp(0.0, 1.0),
            gripper_opening_per_s: opening.first * point.rate,
        }
    }
}

impl Channels {
    pub(crate) fn of(cell: &WorkCell) -> Self {
        let mut firsts = vec![0];
        let mut next = 0;
        for arm in &cell.arms {
            next += arm.model.n_joints() + 1;
            firsts.push(next);
        }
        Self { firsts }
    }

    pub(crate) fn n_channels(&self) -> usize {
        self.firsts[self.firsts.len() - 1]
    }

    pub(crate) fn joint(&self, arm: ArmIndex, joint: usize) -> usize {
        self.firsts[arm.0] + joint
    }

    pub(crate) fn gripper(&self, arm: ArmIndex) -> usize {
        self.firsts[arm.0 + 1] - 1
    }

    fn n_joints(&self, arm: ArmIndex) -> usize {
        self.gripper(arm) - self.firsts[arm.0]
    }

    fn n_arms(&self) -> usize {
        self.firsts.len() - 1
    }
}
