//! Measures how fast arms react: lag, reaction and braking time.
//!
//! **Procedure.** One joint after the other turns by a few degrees out and back at a share of its speed, which gives
//! the lag, and is then stopped several times in the middle of such a swing, which gives the reaction and the braking
//! time. An [`Executor`] plays every swing, so all checks and the envelope apply with the settings that hold until the
//! measurement. Only one joint moves at a time. The arms are reset after intended stops and after delays of the
//! machine; any other stop ends the measurement, also one that would follow while the arms are stopped already.
//!
//! **What is measured.** The *lag* is the delay of measured angles behind the sum of the commanded velocities. The
//! *reaction* is the time from the stamp of the newest state at the time of a stop until the joint begins to brake: the
//! longest one of an arm, plus a period, because commands are not sent at the very moment when a state arrives. The
//! *braking time* is scaled to the joint's highest speed, for drives that brake with a constant deceleration; drives
//! that need the same time at any speed appear slower than they are. The slowest joint determines the reaction and the
//! braking time of an arm; its lag is the mean over its joints.

use std::cell::RefCell;
use std::rc::Rc;

use tandem_core::ArmIndex;
use tandem_kinematics::{Joints, WorkCell};

use crate::cell_file::ArmTiming;
use crate::driver::{Command, Driver, DriverError, Order, PairState, SILENCE_S};
use crate::ending;
use crate::executor::{
    BadSetting, Executor, Phase, ResetError, Settings, StartError, Stop, StopCause, Token,
};
use crate::service::{BoxDriver, Clock, next_time};

use estimate::{StopFit, fit_stop, lag_s};
use swing::Swing;

mod estimate;
mod swing;

/// Smallest and largest share of a joint's speed at which it is measured.
pub const SPEED_SHARES: [f64; 2] = [0.1, 0.5];
/// Stops per joint.
const N_STOPS: usize = 3;
/// Attempts of a swing that a busy machine stops.
const N_ATTEMPTS: usize = 5;
/// Time for which the arms are watched after a stop, seconds.
const WATCH_S: f64 = 0.5;
/// Time after a delay in which drives may report that they have braked because of it, seconds.
const DELAY_EFFECT_S: f64 = 0.2;
/// Time in which the states must become good, seconds.
const READY_S: f64 = 3.0;
/// Share of the constant part of a swing after which it is stopped.
const STOP_SHARE: f64 = 0.85;
/// The only client of the executor.
const OWNER: Token = Token(1);

/// The measurement of a joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointTiming {
    /// The arm.
    pub arm: ArmIndex,
    /// The joint, counted from 0.
    pub joint: usize,
    /// Its lag, longest reaction (without the period that is added per arm) and braking time, seconds.
    pub timing: ArmTiming,
}

/// The reason why arms could not be measured.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CalibrationError {
    /// A setting of the cell is out of its range.
    #[error(transparent)]
    Setting(#[from] BadSetting),
    /// The arms cannot be reset.
    #[error("the arms cannot be reset: {0}")]
    Reset(#[source] ResetError),
    /// The driver has failed and did not recover.
    #[error("the driver failed: {0}")]
    Driver(#[source] DriverError),
    /// A joint cannot turn in either direction from where it is.
    #[error("joint {} of arm {} cannot turn by {degrees:.1} degrees from here, move the arm to where it has room: {refusal}", .joint + 1, .arm.0)]
    NoRoom {
        /// The arm.
        arm: ArmIndex,
        /// The joint, counted from 0.
        joint: usize,
        /// The swing, degrees.
        degrees: f64,
        /// The refused limit.
        refusal: String,
    },
    /// A motion was not started.
    #[error("{0}")]
    Start(#[source] StartError),
    /// The arms were stopped.
    #[error("the arms were stopped: {0}")]
    Stopped(Stop),
    /// The operator interrupted the measurement.
    #[error("interrupted")]
    Interrupted,
    /// The arms have not confirmed the order to stop at the end. Holds the error before it, if there was one.
    #[error("{}", ending::unconfirmed(.0.as_deref()))]
    StopUnconfirmed(Option<Box<Self>>),
    /// The joint did not move as commanded, so nothing can be measured.
    #[error("joint {} of arm {} did not move as commanded", .joint + 1, .arm.0)]
    NotMoving {
        /// The arm.
        arm: ArmIndex,
        /// The joint, counted from 0.
        joint: usize,
    },
}

/// A state and the commanded velocities of the period before it, radians per second; `None` for a stop.
#[derive(Debug, Clone)]
struct Exchange {
    state: PairState,
    commanded: Option<Vec<Joints>>,
}

/// Records all exchanges of a driver.
struct Recorder {
    driver: BoxDriver,
    exchanges: Rc<RefCell<Vec<Exchange>>>,
}

impl Driver for Recorder {
    fn period_s(&self) -> f64 {
        self.driver.period_s()
    }

    fn exchange(&mut self, command: &Command) -> Result<PairState, DriverError> {
        let state = self.driver.exchange(command)?;
        let commanded = match &command.order {
            Order::Move(arms) => Some(arms.iter().map(|arm| arm.velocities).collect()),
            Order::Stop => None,
        };
        self.exchanges.borrow_mut().push(Exchange { state: state.clone(), commanded });
        Ok(state)
    }

    fn stop(&mut self) -> Result<(), DriverError> {
        self.driver.stop()
    }

    fn disconnect(&mut self, reason: &DriverError) {
        self.driver.disconnect(reason);
    }

    fn confirms_stop(&self) -> bool {
        self.driver.confirms_stop()
    }
}

/// The caller's side of a measurement: its clock, its output and its interruption.
pub struct Operator<'a> {
    /// The clock of the periods.
    pub clock: &'a dyn Clock,
    /// Receives the times of each joint.
    pub report: &'a mut dyn FnMut(JointTiming),
    /// Returns true if the measurement has to end. Called once per period.
    pub is_interrupted: &'a dyn Fn() -> bool,
}

/// Measures the arms of `cell` behind `driver`, one joint after the other at `speed` (a share of the joint's highest
/// speed, see [`SPEED_SHARES`]), within the limits of `settings`. Returns the times of each arm.
///
/// # Errors
/// Returns the reason why the arms could not be measured. They are stopped then, unless the error is
/// [`CalibrationError::StopUnconfirmed`], which replaces the times of measured arms too.
///
/// # Panics
/// Panics if `speed` is not within [`SPEED_SHARES`].
pub fn calibrate(
    cell: &WorkCell,
    driver: BoxDriver,
    settings: Settings,
    speed: f64,
    operator: Operator<'_>,
) -> Result<Vec<ArmTiming>, CalibrationError> {
    assert!((SPEED_SHARES[0]..=SPEED_SHARES[1]).contains(&speed), "speed {speed}");
    let Operator { clock, report, is_interrupted } = operator;
    let exchanges = Rc::new(RefCell::new(Vec::new()));
    let recorder = Recorder { driver, exchanges: Rc::clone(&exchanges) };
    let executor = Executor::new(cell.clone(), recorder, settings)?;
    let at_s = clock.now_s();
    let mut bench = Bench {
        cell,
        executor,
        exchanges,
        clock,
        is_interrupted,
        ramp_s: settings.check.limits.ramp_s,
        at_s,
        ticked_s: at_s,
        delayed_s: f64::NEG_INFINITY,
    };
    let measured = bench.measure_arms(speed, report);
    match ending::stop(&mut bench.executor, clock) {
        true => measured,
        false => Err(CalibrationError::StopUnconfirmed(measured.err().map(Box::new))),
    }
}

/// Returns the times of an arm with these joints.
fn of_arm(joints: &[ArmTiming], period_s: f64) -> ArmTiming {
    let slowest = |time: fn(&ArmTiming) -> f64| joints.iter().map(time).fold(0.0, f64::max);
    let lag_s = joints.iter().map(|joint| joint.lag_s).sum::<f64>() / joints.len().max(1) as f64;
    let lag_s = lag_s.max(0.0);
    let reaction_s = (slowest(|joint| joint.reaction_s) + period_s).max(lag_s);
    ArmTiming { lag_s, reaction_s, brake_s: slowest(|joint| joint.brake_s) }
}

/// Returns true if the cause is that commands, states or their effects were late.
fn is_delay(cause: &StopCause) -> bool {
    use StopCause as C;
    matches!(cause, C::TickLate(_) | C::StateStale(_) | C::StateDelayed(_) | C::CommandLost(_))
}

/// The arms while they are measured.
struct Bench<'a> {
    cell: &'a WorkCell,
    executor: Executor<Recorder>,
    exchanges: Rc<RefCell<Vec<Exchange>>>,
    clock: &'a dyn Clock,
    is_interrupted: &'a dyn Fn() -> bool,
    ramp_s: f64,
    /// The time for which the last tick was due.
    at_s: f64,
    /// The time at which it began.
    ticked_s: f64,
    /// The end of the last delay that may have made the drives brake by themselves.
    delayed_s: f64,
}

impl Bench<'_> {
    /// Measures all arms, and reports the times of each joint.
    fn measure_arms(
        &mut self,
        speed: f64,
        report: &mut dyn FnMut(JointTiming),
    ) -> Result<Vec<ArmTiming>, CalibrationError> {
        let mut timings = Vec::with_capacity(self.cell.arms.len());
        for (arm, placed) in self.cell.arms.iter().enumerate() {
            let mut joints = Vec::with_capacity(placed.model.n_joints());
            for joint in 0..placed.model.n_joints() {
                let timing = self.measure(ArmIndex(arm), joint, speed)?;
                report(JointTiming { arm: ArmIndex(arm), joint, timing });
                joints.push(timing);
            }
            timings.push(of_arm(&joints, self.executor.period_s()));
        }
        Ok(timings)
    }

    /// Measures a joint.
    fn measure(
        &mut self,
        arm: ArmIndex,
        joint: usize,
        speed: f64,
    ) -> Result<ArmTiming, CalibrationError> {
        let fastest = self.cell.arms[arm.0].model.joints[joint].speed_radps;
        let (radps, radps2) = (speed * fastest, 0.5 * fastest / self.ramp_s);
        let swing = Swing { arm, joint, radps, radps2 };
        self.ready()?;
        let home = self.angle(&swing);
        let side = self.side(&swing)?;
        let n_before = self.exchanges.borrow().len();
        self.attempt(|bench| {
            bench.go_to(home, &swing)?;
            bench.swing_by(side * swing.full_rad(), &swing, None)?;
            bench.go_to(home, &swing)
        })?;
        let lag_s =
            lag_s(&self.exchanges.borrow()[n_before..], arm.0, joint, self.executor.period_s());
        let mut fits = Vec::with_capacity(N_STOPS);
        for _ in 0..N_STOPS {
            fits.push(self.attempt(|bench| {
                bench.go_to(home, &swing)?;
                bench.stop_in_swing(side, &swing)
            })?);
        }
        self.attempt(|bench| bench.go_to(home, &swing))?;
        let not_moving = CalibrationError::NotMoving { arm, joint };
        let lag_s = lag_s.ok_or(not_moving)?;
        let reaction_s = fits.iter().map(|fit| fit.begins_s).fold(0.0, f64::max);
        fits.sort_by(|a, b| a.takes_s.total_cmp(&b.takes_s));
        let brake_s = fits[N_STOPS / 2].takes_s / speed;
        // The measurement does not resolve times below a millisecond.
        Ok(ArmTiming { lag_s, reaction_s, brake_s: brake_s.max(0.001) })
    }

    /// Repeats `work` while a busy machine stops it.
    fn attempt<T>(
        &mut self,
        mut work: impl FnMut(&mut Self) -> Result<T, CalibrationError>,
    ) -> Result<T, CalibrationError> {
        let mut n = 0;
        loop {
            n += 1;
            match work(self) {
                Err(CalibrationError::Stopped(stop)) if n < N_ATTEMPTS && self.was_late(&stop) => {
                    self.ready()?;
                }
                done => return done,
            }
        }
    }

    /// Sends a command and receives a state at the next period.
    fn tick(&mut self) -> Result<Phase, CalibrationError> {
        if (self.is_interrupted)() {
            return Err(CalibrationError::Interrupted);
        }
        self.at_s = next_time(self.at_s, self.executor.period_s(), self.clock.now_s());
        self.clock.sleep_until(self.at_s);
        let now_s = self.clock.now_s();
        self.executor
            .acquire(OWNER, now_s)
            .map_err(|error| CalibrationError::Start(error.into()))?;
        let since_s = now_s - std::mem::replace(&mut self.ticked_s, now_s);
        let phase = self.executor.tick(now_s);
        let end_s = self.clock.now_s();
        let newest = self.executor.newest_stop().filter(|stop| stop.when_s >= now_s);
        if since_s.max(end_s - now_s) >= SILENCE_S - self.executor.period_s()
            || newest.is_some_and(|stop| is_delay(&stop.cause))
        {
            self.delayed_s = end_s;
        }
        Ok(phase)
    }

    /// Returns true if a machine that is too slow explains the stop. Drives that wait too long for a command report a
    /// fault, too; any other fault needs a person.
    fn was_late(&self, stop: &Stop) -> bool {
        let explains_fault = stop.when_s - self.delayed_s <= DELAY_EFFECT_S;
        is_delay(&stop.cause) || stop.cause == StopCause::DriveFault && explains_fault
    }

    /// Returns the first or the newest cause of the present stop if it needs a person before the arms are reset.
    /// Intended stops and delays do not, nor do drives that become ready only when commands arrive.
    fn needs_person(&self) -> Option<&Stop> {
        use StopCause as C;
        let first = self.executor.stopped_by()?;
        let is_new = first.cause == C::NotReset;
        let needs = |stop: &&Stop| match stop.cause {
            C::NotReset | C::Requested => false,
            C::EmergencyStop | C::ContactReported | C::Torque(_) => true,
            C::DriveFault if is_delay(&first.cause) => false,
            _ => !is_new && !self.was_late(stop),
        };
        [Some(first), self.executor.newest_stop()].into_iter().flatten().find(needs)
    }

    /// Resets the arms if they are stopped and no person is needed, and waits until they are at rest.
    fn ready(&mut self) -> Result<(), CalibrationError> {
        let until_s = self.clock.now_s() + READY_S;
        loop {
            let phase = self.tick()?;
            let now_s = self.clock.now_s();
            if phase == Phase::Idle && (self.executor.at_rest() || now_s > until_s) {
                return Ok(());
            }
            if phase != Phase::Stopped {
                continue;
            }
            if let Some(stop) = self.needs_person() {
                return Err(CalibrationError::Stopped(stop.clone()));
            }
            match self.executor.reset(OWNER, now_s) {
                Err(error) if now_s > until_s => {
                    return Err(match self.executor.exchange_error() {
                        Some(error) => CalibrationError::Driver(error.clone()),
                        None => CalibrationError::Reset(error),
                    });
                }
                Ok(()) | Err(_) => {}
            }
        }
    }

    /// Returns the measured angle of the joint, radians; 0 if there is no state.
    fn angle(&self, swing: &Swing) -> f64 {
        self.executor.state().map_or(0.0, |state| state.arms[swing.arm.0].angles[swing.joint])
    }

    /// Returns the direction, 1 or -1, in which the joint has room for a full swing.
    fn side(&self, swing: &Swing) -> Result<f64, CalibrationError> {
        let no_room = |refusal: String| CalibrationError::NoRoom {
            arm: swing.arm,
            joint: swing.joint,
            degrees: swing.full_rad().to_degrees(),
            refusal,
        };
        let Some(state) = self.executor.state() else {
            return Err(no_room("the position of the arms is not known".to_owned()));
        };
        let at: Vec<Joints> = state.arms.iter().map(|arm| arm.angles).collect();
        let check = |side: f64| {
            let motion = swing.motion(state, side * swing.full_rad());
            self.executor.checker().check(motion, &at).map(|_| side)
        };
        check(1.0).or_else(|refused| check(-1.0).map_err(|_also| no_room(refused.to_string())))
    }

    /// Turns the joint to `angle`, radians, if it is not there.
    fn go_to(&mut self, angle: f64, swing: &Swing) -> Result<(), CalibrationError> {
        let by = angle - self.angle(swing);
        if by.abs() < swing.least_rad() {
            return Ok(());
        }
        self.swing_by(by, swing, None)
    }

    /// Turns the joint by `by` radians. Returns after `stop_s` seconds of the swing if they are given.
    fn swing_by(
        &mut self,
        by: f64,
        swing: &Swing,
        stop_s: Option<f64>,
    ) -> Result<(), CalibrationError> {
        self.ready()?;
        let state = self.executor.state().ok_or(CalibrationError::Start(StartError::NoState))?;
        let motion = swing.motion(state, by);
        let started = self.executor.start(OWNER, motion, 1.0, self.clock.now_s());
        started.map_err(CalibrationError::Start)?;
        loop {
            match self.tick()? {
                Phase::Idle => return Ok(()),
                Phase::Stopped => return Err(self.stopped()),
                _ => {}
            }
            let played_s = self.executor.progress().map_or(0.0, |progress| progress.played_s);
            if stop_s.is_some_and(|stop_s| played_s >= stop_s) {
                return Ok(());
            }
        }
    }

    /// Stops the joint in the middle of a swing, and returns how it came to rest.
    fn stop_in_swing(&mut self, side: f64, swing: &Swing) -> Result<StopFit, CalibrationError> {
        let stop_s = swing.ramp_s() + STOP_SHARE * Swing::CONSTANT_S;
        self.swing_by(side * swing.full_rad(), swing, Some(stop_s))?;
        let n_before = self.exchanges.borrow().len();
        self.executor.stop(self.clock.now_s());
        let until_s = self.clock.now_s() + WATCH_S;
        while self.clock.now_s() < until_s {
            self.tick()?;
            if let Some(stop) = self.executor.newest_stop()
                && stop.cause != StopCause::Requested
            {
                return Err(CalibrationError::Stopped(stop.clone()));
            }
        }
        let fit = {
            let exchanges = self.exchanges.borrow();
            fit_stop(&exchanges, n_before, swing.arm.0, swing.joint, side)
        };
        fit.ok_or(CalibrationError::NotMoving { arm: swing.arm, joint: swing.joint })
    }

    fn stopped(&self) -> CalibrationError {
        match self.needs_person().or(self.executor.stopped_by()) {
            Some(stop) => CalibrationError::Stopped(stop.clone()),
            None => CalibrationError::Start(StartError::NoState),
        }
    }
}
