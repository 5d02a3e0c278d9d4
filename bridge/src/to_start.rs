//! Moves arms from any posture to a start posture, slowly and under supervision.
//!
//! Motions of clients keep the grippers within some degrees of the vertical, so that raised or folded arms cannot begin
//! one. Here that limit alone does not hold. Every other one does: joint ranges, reach, speeds, and the gaps to the
//! table, between the arms and within an arm, over the whole motion and for every command. A motion that breaks a limit
//! is not begun: the operator moves the arms by other means then.
//!
//! The joints turn in straight lines. Several orders of joints and arms are tried, and the first one that keeps all
//! limits is played, at a few degrees per second.

use tandem_kinematics::{ArmSample, Joints, Motion, WorkCell};

use crate::driver::{DriverError, PairState};
use crate::ending;
use crate::executor::{
    BadSetting, CheckError, CheckedMotion, Checker, Executor, Phase, Progress, ResetError,
    Settings, StartError, Stop, Token,
};
use crate::service::{BoxDriver, Clock, next_time};

/// Highest speed of a joint, radians per second.
pub const SPEED_RADPS: f64 = 8.0 * std::f64::consts::PI / 180.0;
/// Highest speed of any part of an arm, metres per second.
const PART_MPS: f64 = 0.08;
/// Shortest time of one turn, seconds.
const LEAST_S: f64 = 1.0;
/// Time from one sample to the next, seconds.
const PERIOD_S: f64 = 0.02;
/// Highest speed of a joint that turns along [`smooth`], as a multiple of its mean.
const PEAK: f64 = 1.875;
/// Time in which the states must become good, seconds.
const READY_S: f64 = 5.0;
/// Turns of less than this are left out, radians.
const LEAST_RAD: f64 = 1e-3;
/// The only client of the executor.
const OWNER: Token = Token(1);
/// Orders in which the joints of an arm turn. Joints of one group turn together.
const JOINT_ORDERS: [&[&[usize]]; 7] = [
    &[&[0, 1, 2, 3]],
    &[&[3], &[1, 2], &[0]],
    &[&[1, 2], &[3], &[0]],
    &[&[0, 3], &[2], &[1]],
    &[&[0, 3], &[1], &[2]],
    &[&[2], &[1], &[3], &[0]],
    &[&[1], &[2], &[3], &[0]],
];
/// Orders in which the arms move. Arms of one group move together.
const ARM_ORDERS: [&[&[usize]]; 3] = [&[&[0], &[1]], &[&[1], &[0]], &[&[0, 1]]];

/// The reason why arms were not moved to the start.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ToStartError {
    /// A setting of the cell is out of its range.
    #[error(transparent)]
    Setting(#[from] BadSetting),
    /// The arms cannot be reset.
    #[error("the arms cannot be reset: {0}")]
    Reset(#[source] ResetError),
    /// The driver has failed and did not recover.
    #[error("the driver failed: {0}")]
    Driver(#[source] DriverError),
    /// No order of joints and arms keeps all limits.
    #[error(
        "no checked way leads to the start, move the arms by hand or with Kinova's joystick: {0}"
    )]
    NoWay(#[source] CheckError),
    /// The motion was not started.
    #[error("{0}")]
    Start(#[from] StartError),
    /// The arms were stopped.
    #[error("the arms were stopped: {0}")]
    Stopped(Stop),
    /// The operator interrupted.
    #[error("interrupted")]
    Interrupted,
    /// The arms have not confirmed the order to stop at the end. Holds the error before it, if there was one.
    #[error("{}", ending::unconfirmed(.0.as_deref()))]
    StopUnconfirmed(Option<Box<Self>>),
}

/// The caller's side: its clock, its output and its interruption.
pub struct Operator<'a> {
    /// The clock of the periods.
    pub clock: &'a dyn Clock,
    /// Receives the motion before it begins.
    pub announce: &'a mut dyn FnMut(&Motion),
    /// Receives the progress of the motion, once per period.
    pub report: &'a mut dyn FnMut(Progress),
    /// Returns true if the arms have to stop. Called once per period.
    pub is_interrupted: &'a dyn Fn() -> bool,
}

/// Moves the arms of `cell` behind `driver` to the joint angles `start` (radians, arm by arm), within the limits of
/// `settings` except the tilt. The arms are stopped afterwards.
///
/// # Errors
/// Returns the reason why the arms are not at the start. They are stopped then, unless the error is
/// [`ToStartError::StopUnconfirmed`], which arms at the start may cause too.
pub fn to_start(
    cell: &WorkCell,
    driver: BoxDriver,
    mut settings: Settings,
    start: &[Joints],
    operator: Operator<'_>,
) -> Result<(), ToStartError> {
    settings.check.tilt_rad = std::f64::consts::PI;
    let executor = Executor::new(cell.clone(), driver, settings)?;
    let at_s = operator.clock.now_s();
    let Operator { clock, announce, report, is_interrupted } = operator;
    let mut arms = Arms { executor, clock, is_interrupted, at_s };
    let moved = arms.run(start, announce, report);
    match ending::stop(&mut arms.executor, clock) {
        true => moved,
        false => Err(ToStartError::StopUnconfirmed(moved.err().map(Box::new))),
    }
}

struct Arms<'a> {
    executor: Executor<BoxDriver>,
    clock: &'a dyn Clock,
    is_interrupted: &'a dyn Fn() -> bool,
    /// The time of the last tick.
    at_s: f64,
}

impl Arms<'_> {
    fn run(
        &mut self,
        start: &[Joints],
        announce: &mut dyn FnMut(&Motion),
        report: &mut dyn FnMut(Progress),
    ) -> Result<(), ToStartError> {
        self.good_states()?;
        let state = self.executor.state().ok_or(StartError::NoState)?;
        let checker = self.executor.checker().clone();
        let motion = way(&checker, state, start)?;
        announce(motion.motion());
        self.good_states()?;
        let now_s = self.clock.now_s();
        self.executor.reset(OWNER, now_s).map_err(ToStartError::Reset)?;
        while self.executor.phase() == Phase::Idle && !self.executor.at_rest() {
            self.tick()?;
        }
        self.tick()?;
        self.executor.start_checked(OWNER, motion, 1.0, self.clock.now_s())?;
        loop {
            let phase = self.tick()?;
            if let Some(progress) = self.executor.progress() {
                report(progress);
            }
            if phase == Phase::Idle {
                return Ok(());
            }
        }
    }

    /// Ticks stopped arms until their states are good and they rest.
    fn good_states(&mut self) -> Result<(), ToStartError> {
        let until_s = self.clock.now_s() + READY_S;
        loop {
            self.tick_stopped()?;
            let got = self.executor.n_good();
            let is_good = got >= crate::executor::GOOD_STATES && self.executor.stop_is_confirmed();
            if is_good && self.executor.at_rest() {
                return Ok(());
            }
            if self.clock.now_s() > until_s {
                if let Some(error) = self.executor.exchange_error() {
                    return Err(ToStartError::Driver(error.clone()));
                }
                let error = match self.executor.at_rest() {
                    true => ResetError::States { got, rejected: None },
                    false => ResetError::Moving,
                };
                return Err(ToStartError::Reset(error));
            }
        }
    }

    /// Sends a command and receives a state at the next period. Stopped arms are an error.
    fn tick(&mut self) -> Result<Phase, ToStartError> {
        self.tick_stopped()?;
        match self.executor.stopped_by() {
            Some(stop) => Err(ToStartError::Stopped(stop.clone())),
            None => Ok(self.executor.phase()),
        }
    }

    fn tick_stopped(&mut self) -> Result<(), ToStartError> {
        if (self.is_interrupted)() {
            return Err(ToStartError::Interrupted);
        }
        self.at_s = next_time(self.at_s, self.executor.period_s(), self.clock.now_s());
        self.clock.sleep_until(self.at_s);
        let now_s = self.clock.now_s();
        self.executor.acquire(OWNER, now_s).map_err(StartError::Lease)?;
        self.executor.tick(now_s);
        Ok(())
    }
}

/// Returns the first way to `start` that keeps all limits, or the limit that the simplest way breaks.
fn way(
    checker: &Checker,
    state: &PairState,
    start: &[Joints],
) -> Result<CheckedMotion, ToStartError> {
    let at: Vec<Joints> = state.arms.iter().map(|arm| arm.angles).collect();
    let openings: Vec<f64> = state.arms.iter().map(|arm| arm.opening.clamp(0.0, 1.0)).collect();
    let start: Vec<Joints> =
        (0..at.len()).map(|arm| nearest_turn(checker.cell(), arm, &at[arm], &start[arm])).collect();
    let mut refused = None;
    for arm_order in ARM_ORDERS {
        for joint_order in JOINT_ORDERS {
            let motion = motion(checker.cell(), [&at, &start], &openings, arm_order, joint_order);
            match checker.check(motion, &at) {
                Ok(checked) => return Ok(checked),
                Err(error) => refused = refused.or(Some(error)),
            }
        }
    }
    Err(refused.map_or(ToStartError::Start(StartError::NoState), ToStartError::NoWay))
}

/// Room that a joint should have at the start on both sides, radians, so that motions can begin there.
const ROOM_RAD: f64 = std::f64::consts::FRAC_PI_2;

/// Returns the angles of the same posture as `goal` within the joints' ranges: those with room on both sides if there
/// are any, and of these the nearest to `at`.
fn nearest_turn(cell: &WorkCell, arm: usize, at: &Joints, goal: &Joints) -> Joints {
    let joints = cell.arms[arm].model.joints;
    Joints::from_fn(goal.len(), |joint| {
        let [low, high] = joints[joint].range_rad;
        let turns = [-2.0, -1.0, 0.0, 1.0, 2.0].map(|n| goal[joint] + n * std::f64::consts::TAU);
        let within = turns.into_iter().filter(|angle| (low..=high).contains(angle));
        let lacks_room = |angle: f64| (angle - low).min(high - angle) < ROOM_RAD;
        let best = within.min_by(|a, b| {
            let by_distance = (a - at[joint]).abs().total_cmp(&(b - at[joint]).abs());
            lacks_room(*a).cmp(&lacks_room(*b)).then(by_distance)
        });
        best.unwrap_or(goal[joint])
    })
}

/// Returns the motion from the first to the second joint angles in the given orders.
fn motion(
    cell: &WorkCell,
    [from, to]: [&[Joints]; 2],
    openings: &[f64],
    arm_order: &[&[usize]],
    joint_order: &[&[usize]],
) -> Motion {
    let mut at = from.to_vec();
    let rests = |at: &[Joints], arm: usize| ArmSample {
        angles: at[arm],
        velocities: Joints::from_fn(at[arm].len(), |_| 0.0),
        gripper_opening: openings[arm],
    };
    let mut arms: Vec<Vec<ArmSample>> = (0..at.len()).map(|arm| vec![rests(&at, arm)]).collect();
    for (moving, joints) in
        arm_order.iter().flat_map(|arms| joint_order.iter().map(move |joints| (*arms, *joints)))
    {
        let mut next = at.clone();
        for arm in moving {
            let (next, to) = (&mut next[*arm], &to[*arm]);
            for joint in joints.iter().filter(|joint| **joint < to.len()) {
                next[*joint] = to[*joint];
            }
        }
        let n = n_intervals(cell, &at, &next);
        if n == 0 {
            continue;
        }
        for step in 1..=n {
            for (arm, samples) in arms.iter_mut().enumerate() {
                let [share, rate] = smooth(step as f64 / n as f64);
                let by = |joint: usize| next[arm][joint] - at[arm][joint];
                let seconds = n as f64 * PERIOD_S;
                samples.push(ArmSample {
                    angles: Joints::from_fn(at[arm].len(), |joint| {
                        at[arm][joint] + share * by(joint)
                    }),
                    velocities: Joints::from_fn(at[arm].len(), |joint| rate * by(joint) / seconds),
                    gripper_opening: openings[arm],
                });
            }
        }
        at = next;
    }
    if arms[0].len() == 1 {
        // The arms are at the start.
        arms.iter_mut().for_each(|samples| samples.push(samples[0]));
    }
    Motion { period_s: PERIOD_S, arms }
}

/// Returns the number of samples of a turn that is slow enough; 0 if nothing turns.
fn n_intervals(cell: &WorkCell, from: &[Joints], to: &[Joints]) -> usize {
    let mut least_s = 0.0_f64;
    for (arm, placed) in cell.arms.iter().enumerate() {
        let levers_m = placed.model.link_levers_m();
        let turn = |joint: usize| (to[arm][joint] - from[arm][joint]).abs();
        let moved_m: f64 = (0..from[arm].len()).map(|joint| levers_m[joint] * turn(joint)).sum();
        let largest = from[arm].largest_difference(&to[arm]);
        if largest > LEAST_RAD {
            let seconds = PEAK * (largest / SPEED_RADPS).max(moved_m / PART_MPS);
            least_s = least_s.max(seconds).max(LEAST_S);
        }
    }
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a turn takes a minute or two at most"
    )]
    let n = (least_s / PERIOD_S).ceil() as usize;
    n
}

/// Returns the share of a turn after a share of its time, and its derivative. Rates and accelerations are 0 at both
/// ends.
fn smooth(t: f64) -> [f64; 2] {
    [t * t * t * (10.0 - 15.0 * t + 6.0 * t * t), 30.0 * t * t * (1.0 - 2.0 * t + t * t)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::work_cell::mico_cell;

    fn degrees(joints: [f64; 4]) -> Joints {
        Joints::new(&joints.map(f64::to_radians))
    }

    #[test]
    fn a_joint_keeps_room_at_the_start_even_if_it_turns_farther() {
        let cell = mico_cell();
        let goal = degrees([-1.5, 180.0, 250.0, 180.0]);
        let from = degrees([275.0, 180.0, 250.0, 180.0]);
        let to = nearest_turn(&cell, 0, &from, &goal);
        assert!((to[0] - goal[0]).abs() < 1e-9, "{to:?}");
        let near = degrees([-100.0, 180.0, 250.0, 180.0]);
        assert!((nearest_turn(&cell, 0, &near, &goal)[0] - goal[0]).abs() < 1e-9);
    }

    #[test]
    fn a_turn_that_is_left_out_moves_no_joint_at_once() {
        let cell = mico_cell();
        let from = vec![degrees([0.0, 180.0, 250.0, 180.0]); 2];
        let to = vec![degrees([10.0, 180.0, 250.0, 180.04]); 2];
        let motion = motion(&cell, [&from, &to], &[0.5; 2], &[&[0, 1]], &[&[3], &[1, 2], &[0]]);
        let largest = motion.arms[0]
            .windows(2)
            .map(|pair| pair[0].angles.largest_difference(&pair[1].angles))
            .fold(0.0, f64::max);
        assert!(largest < SPEED_RADPS * PERIOD_S, "{largest}");
        let turned = motion.arms[0][motion.arms[0].len() - 1].angles[0];
        assert!((turned - 10_f64.to_radians()).abs() < 1e-9);
    }
}
