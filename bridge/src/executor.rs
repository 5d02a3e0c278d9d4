//! Plays a checked motion through a driver, period by period, and stops the arms on any fault.
//!
//! **States.** The arms start *stopped*. [`reset`](Executor::reset) makes them *idle* and [`start`](Executor::start)
//! *moving*; at the end of the motion they *settle* and are idle again. While the owner or the states are late, a
//! motion *holds*: it comes to rest on its path and resumes by itself. Every other fault, in any state, and every call
//! of [`stop`](Executor::stop) makes the arms *stopped*: each later command is [`Order::Stop`] until an owner resets
//! them. A [`Stop`] records the time, the place and the cause; later causes do not replace the first one.
//!
//! **Each tick** sends one command and receives one state. `playback.rs` computes the motion's velocities, corrects
//! them by the tracking error and keeps them within the limits; `envelope.rs` then checks the result independently;
//! `monitor.rs` validates the state that comes back.
//!
//! **Ownership.** The client with the token owns the arms as long as it renews its lease
//! ([`acquire`](Executor::acquire)). Only the owner starts motions and resets. Any caller may stop the arms.
//!
//! **The drives always stop.** A dropped executor commands a stop. The drives of a killed process brake because they
//! receive no commands (see [`driver`](crate::driver)).

use tandem_kinematics::{Excess, Joints, Motion, WorkCell};

use crate::driver::{Driver, DriverError, Order, PairState};
use crate::executor::answers::Answers;
use crate::executor::commands::CommandHistory;
use crate::executor::envelope::Envelope;
use crate::executor::lease::Lease;
use crate::executor::monitor::{ExpectedState, Monitor};
use crate::executor::playback::{Playback, TickContext};
use crate::executor::state::ArmsState;
use crate::executor::stop::LocatedCause;

pub use checked::{CheckError, CheckedMotion, Checker};
pub use errors::{ResetError, StartError};
pub use lease::{LeaseError, Token};
pub use settings::{BadSetting, Settings};
pub use state::{Phase, Progress};
pub use stop::{Stop, StopCause};

pub(crate) use errors::GOOD_STATES;

mod accessors;
mod answers;
mod checked;
mod commands;
mod envelope;
mod errors;
mod lease;
mod monitor;
mod playback;
mod settings;
mod state;
mod stop;

/// Time without a new state after which the arms count as disconnected, although commands can be sent, seconds.
const LOST_S: f64 = 1.0;

/// Moves a pair of arms. The executor is the only user of their driver. Times `now_s` are seconds since any start and
/// never decrease.
#[derive(Debug)]
pub struct Executor<D: Driver> {
    cell: WorkCell,
    settings: Settings,
    checker: Checker,
    driver: D,
    period_s: f64,
    lease: Lease,
    monitor: Monitor,
    envelope: Envelope,
    state: ArmsState,
    commands: CommandHistory,
    answers: Answers,
    /// The newest cause of a stop after the one that stopped the arms.
    later_stop: Option<Stop>,
    /// The number of stops and faults so far. A connection that has failed counts once.
    n_halts: u64,
    ticked_s: Option<f64>,
    /// The error of the last attempt to stop the drives, until a command gets through.
    stop_error: Option<DriverError>,
    /// The error of the last exchange.
    exchange_error: Option<DriverError>,
}

impl<D: Driver> Executor<D> {
    /// Takes over the arms of `cell` behind `driver`. They are stopped until an owner resets them.
    ///
    /// # Errors
    /// Returns the first setting that is out of its range.
    pub fn new(cell: WorkCell, driver: D, settings: Settings) -> Result<Self, BadSetting> {
        let period_s = driver.period_s();
        let settings = settings.checked(&cell, period_s)?;
        Ok(Self {
            lease: Lease::default(),
            monitor: Monitor::new(&cell, &settings, period_s),
            envelope: Envelope::new(&cell, &settings, period_s),
            state: ArmsState::Stopped(StopCause::NotReset.anywhere().at(0.0)),
            commands: CommandHistory::new(&cell, &settings, period_s),
            answers: Answers::default(),
            later_stop: None,
            n_halts: 0,
            ticked_s: None,
            stop_error: None,
            exchange_error: None,
            checker: Checker::new(cell.clone(), settings),
            cell,
            settings,
            driver,
            period_s,
        })
    }

    /// Makes the client with `token` the owner if the arms have none, and renews its lease. During a motion this is the
    /// owner's sign of life.
    ///
    /// # Errors
    /// Returns an error if another client owns the arms.
    pub fn acquire(&mut self, token: Token, now_s: f64) -> Result<(), LeaseError> {
        self.lease.acquire(token, now_s, self.settings.lease_s)
    }

    /// Renews the owner's lease.
    ///
    /// # Errors
    /// Returns an error if the client with `token` does not own the arms, or its lease has ended.
    pub fn renew(&mut self, token: Token, now_s: f64) -> Result<(), LeaseError> {
        self.lease.renew(token, now_s, self.settings.lease_s)
    }

    /// Releases the arms. A motion is stopped.
    ///
    /// # Errors
    /// Returns an error if the client with `token` does not own the arms.
    pub fn release(&mut self, token: Token, now_s: f64) -> Result<(), LeaseError> {
        self.renew(token, now_s)?;
        if matches!(self.state, ArmsState::Playing { .. }) {
            self.halt(StopCause::OwnerReleased.anywhere(), now_s);
        }
        self.lease.release();
        Ok(())
    }

    /// Time from one tick to the next, seconds.
    #[must_use]
    pub fn period_s(&self) -> f64 {
        self.period_s
    }

    /// The checker whose motions this executor accepts.
    #[must_use]
    pub fn checker(&self) -> &Checker {
        &self.checker
    }

    /// Checks `motion` and starts it from the position of the arms, at `speed` (in (0, 1], a share of the motion's
    /// own). The check of a long motion takes longer than a period: see [`start_checked`](Self::start_checked).
    ///
    /// # Errors
    /// Returns the fault of the motion, or the reason why no motion can start now. Nothing moves then.
    pub fn start(
        &mut self,
        token: Token,
        motion: Motion,
        speed: f64,
        now_s: f64,
    ) -> Result<(), StartError> {
        let at = self.startable(token, speed, now_s)?;
        let motion = self.checker.check(motion, &at)?;
        self.play(motion, speed);
        Ok(())
    }

    /// Starts a motion that the [`checker`](Self::checker) has passed, if the arms are still at its beginning.
    ///
    /// # Errors
    /// As [`start`](Self::start).
    pub fn start_checked(
        &mut self,
        token: Token,
        motion: CheckedMotion,
        speed: f64,
        now_s: f64,
    ) -> Result<(), StartError> {
        let at = self.startable(token, speed, now_s)?;
        if !motion.passed(&self.checker) {
            return Err(StartError::OtherChecker);
        }
        motion.begins_at(&at)?;
        self.play(motion, speed);
        Ok(())
    }

    /// Returns the joint angles of the arms, radians, if a motion may start now.
    fn startable(
        &mut self,
        token: Token,
        speed: f64,
        now_s: f64,
    ) -> Result<Vec<Joints>, StartError> {
        self.renew(token, now_s)?;
        if self.phase() != Phase::Idle {
            return Err(StartError::NotIdle(self.phase()));
        }
        if !(speed > 0.0 && speed <= 1.0) {
            return Err(StartError::Speed(speed));
        }
        let stale_s = self.monitor.stale_s(now_s);
        let state = self.monitor.state().filter(|_| stale_s <= self.settings.state_hold_s);
        let state = state.ok_or(StartError::NoState)?;
        if !self.monitor.at_rest() {
            return Err(StartError::Moving);
        }
        Ok(state.arms.iter().map(|arm| arm.angles).collect())
    }

    fn play(&mut self, motion: CheckedMotion, speed: f64) {
        let playback = Box::new(Playback::new(motion.into_motion(), speed));
        self.state = ArmsState::Playing { playback, holding: false };
    }

    /// Stops the arms on request. No ownership is needed. [`stop_is_confirmed`](Self::stop_is_confirmed) returns
    /// whether the arms have answered.
    pub fn stop(&mut self, now_s: f64) {
        self.order_stop(StopCause::Requested, now_s);
    }

    /// As [`stop`](Self::stop), because the program that ticks the executor is about to end.
    pub fn shut_down(&mut self, now_s: f64) {
        self.order_stop(StopCause::ShutDown, now_s);
    }

    /// Stops the arms, which have to confirm it.
    fn order_stop(&mut self, cause: StopCause, now_s: f64) {
        self.halt(cause.anywhere(), now_s);
        // The next command repeats the order, under a number of its own.
        self.answers.await_stop(self.commands.number() + 1);
    }

    /// Makes stopped arms idle. They hold their position until a motion is started. Idle arms stay as they are.
    ///
    /// # Errors
    /// Returns an error if the client with `token` does not own the arms, a motion is in progress, their states are not
    /// good, or they are beyond a limit at which they would be stopped again.
    pub fn reset(&mut self, token: Token, now_s: f64) -> Result<(), ResetError> {
        self.reset_unless_halted(token, self.n_halts, now_s)
    }

    /// As [`reset`](Self::reset), unless there have been more than `n_halts` stops and faults: an operator has to inspect
    /// the arms again after those.
    pub(crate) fn reset_unless_halted(
        &mut self,
        token: Token,
        n_halts: u64,
        now_s: f64,
    ) -> Result<(), ResetError> {
        let idle = self.idle_after_reset(token, now_s);
        let is_final = idle.as_ref().is_err_and(|refused| !refused.may_pass());
        let was_halted = self.n_halts != n_halts && !is_final;
        if let Some(stop) = self.newest_stop().filter(|_| was_halted) {
            return Err(ResetError::StoppedMeanwhile { cause: stop.cause.clone() });
        }
        if let Some(idle) = idle? {
            self.state = idle;
        }
        Ok(())
    }

    /// Returns the state of stopped arms after a reset, or `None` for arms that are idle.
    fn idle_after_reset(
        &mut self,
        token: Token,
        now_s: f64,
    ) -> Result<Option<ArmsState>, ResetError> {
        self.renew(token, now_s)?;
        match self.phase() {
            Phase::Stopped => {}
            Phase::Idle => return Ok(None),
            moving => return Err(ResetError::NotStopped(moving)),
        }
        if let Some(error) = &self.exchange_error {
            return Err(ResetError::Driver(error.clone()));
        }
        if !self.stop_is_confirmed() {
            return Err(ResetError::Unconfirmed);
        }
        let got = self.monitor.n_good();
        let stale_s = self.monitor.stale_s(now_s);
        let stale = stale_s > self.settings.state_hold_s;
        let state = self.monitor.state().filter(|_| got >= GOOD_STATES && !stale);
        let Some(state) = state else {
            let reported = self.monitor.reported().filter(|_| !stale);
            return Err(reported.unwrap_or_else(|| self.too_few_states(got, now_s)));
        };
        if !self.monitor.at_rest() {
            return Err(ResetError::Moving);
        }
        self.commands.keep_openings(state);
        let commands = self.commands.stationary();
        let checked = self.envelope.check(&commands, self.commands.velocities(), state, stale_s);
        if let Err(LocatedCause { arm, cause, .. }) = checked {
            return Err(ResetError::Limit { arm, cause });
        }
        let at = state.arms.iter().map(|arm| arm.angles).collect();
        Ok(Some(ArmsState::Idle { at }))
    }

    fn too_few_states(&self, got: u32, now_s: f64) -> ResetError {
        let is_new = |stop: &&Stop| {
            let is_requested = matches!(stop.cause, StopCause::Requested | StopCause::ShutDown);
            got == 0 && !is_requested && now_s - stop.when_s <= self.settings.state_stop_s
        };
        let rejected = self.later_stop.as_ref().filter(is_new).map(|stop| stop.cause.clone());
        ResetError::States { got, rejected }
    }

    /// Replaces a driver that has failed by one with a new connection to the same arms. The arms stay stopped, the
    /// first commands of the new driver are stops, commands are counted from 1, and earlier states are discarded.
    ///
    /// # Errors
    /// Returns an error if the client with `token` does not own the arms, they are not stopped, or the driver has not
    /// failed.
    pub fn replace_driver(
        &mut self,
        token: Token,
        driver: D,
        now_s: f64,
    ) -> Result<(), ResetError> {
        self.renew(token, now_s)?;
        if self.phase() != Phase::Stopped || self.exchange_error.is_none() {
            return Err(ResetError::Connected);
        }
        self.driver = driver;
        self.monitor = Monitor::new(&self.cell, &self.settings, self.period_s);
        self.commands.restart();
        self.answers.restart();
        (self.stop_error, self.exchange_error) = (None, None);
        Ok(())
    }

    /// Starts a period at `now_s`, seconds: sends a command, receives a state and returns the phase after that. Must be
    /// called once per period.
    pub fn tick(&mut self, now_s: f64) -> Phase {
        let order = self.next_order(now_s).unwrap_or_else(|cause| {
            self.halt(cause, now_s);
            Order::Stop
        });
        let command = self.commands.push(order);
        match self.driver.exchange(&command) {
            Ok(state) if self.answers.note(&state, command.number, now_s) > LOST_S => {
                self.lose(now_s);
            }
            Ok(state) => {
                (self.stop_error, self.exchange_error) = (None, None);
                let velocities = self.commands.visible_velocities();
                let number = self.commands.number();
                let expected = ExpectedState { number, velocities: &velocities };
                if let Err(cause) = self.monitor.accept(now_s, state, &expected) {
                    self.halt(cause, now_s);
                }
            }
            Err(error) => {
                self.monitor.exchange_failed();
                self.halt(StopCause::Driver(error.clone()).anywhere(), now_s);
                self.exchange_error = Some(error);
            }
        }
        self.phase()
    }

    /// Returns the order of the coming period, or the cause of a stop.
    fn next_order(&mut self, now_s: f64) -> Result<Order, LocatedCause> {
        let since_s = self.ticked_s.replace(now_s).map_or(self.period_s, |before| now_s - before);
        if matches!(self.state, ArmsState::Stopped(_)) {
            return Ok(Order::Stop);
        }
        let allowed = self.settings.tick_s;
        if !(since_s > 0.0 && since_s <= allowed) {
            return Err(StopCause::TickLate(Excess { got: since_s, allowed }).anywhere());
        }
        let stale_s = self.monitor.stale_s(now_s);
        let allowed = self.settings.state_stop_s;
        let state = match self.monitor.state() {
            Some(state) if stale_s <= allowed => state,
            _ => return Err(StopCause::StateStale(Excess { got: stale_s, allowed }).anywhere()),
        };
        let fresh = stale_s <= self.settings.state_hold_s;
        let commands = match &mut self.state {
            ArmsState::Stopped(_) => return Ok(Order::Stop),
            ArmsState::Idle { at } => {
                check_in_place(at, state, self.settings.tracking_rad)?;
                self.commands.stationary()
            }
            ArmsState::Playing { playback, holding } => {
                let silent_s = self.lease.silent_s(now_s);
                let allowed = self.settings.owner_stop_s;
                if silent_s > allowed {
                    let excess = Excess { got: silent_s, allowed };
                    return Err(StopCause::OwnerSilent(excess).anywhere());
                }
                *holding = !fresh || silent_s > self.settings.owner_hold_s;
                let context = TickContext {
                    cell: &self.cell,
                    settings: &self.settings,
                    period_s: self.period_s,
                    state: fresh.then_some(state),
                    stale_periods: stale_periods(stale_s, self.period_s),
                    last: self.commands.last(),
                };
                playback.next(&context, *holding)?
            }
        };
        self.envelope.check(&commands, self.commands.velocities(), state, stale_s)?;
        self.settle()?;
        Ok(Order::Move(commands))
    }

    /// Ends a motion whose arms rest at its end and whose grippers have received its last openings.
    fn settle(&mut self) -> Result<(), LocatedCause> {
        let (ArmsState::Playing { playback, holding: false }, Some(state)) =
            (&self.state, self.monitor.state())
        else {
            return Ok(());
        };
        if playback.settling_s() <= 0.0 {
            return Ok(());
        }
        let (got, allowed) = (playback.distance_to_end(state), self.settings.settled_rad);
        let at_rest = self.commands.at_rest(self.settings.rest_radps) && self.monitor.at_rest();
        if got <= allowed && at_rest {
            self.state = ArmsState::Idle { at: playback.reference().to_vec() };
        } else if playback.settling_s() > self.settings.settle_s {
            return Err(StopCause::NotSettled(Excess { got, allowed }).anywhere());
        }
        Ok(())
    }

    /// Counts silent arms as disconnected until a new state arrives, and forgets where they were. The connection to real
    /// arms ends, which brakes them too, so that a reset can connect again.
    fn lose(&mut self, now_s: f64) {
        self.monitor.forget();
        if self.exchange_error.is_some() {
            return;
        }
        let error = DriverError::Disconnected { what: format!("no new state for {LOST_S} s") };
        self.halt(StopCause::Driver(error.clone()).anywhere(), now_s);
        self.driver.disconnect(&error);
        self.exchange_error = Some(error);
    }

    /// Stops the arms in the fastest way. Keeps the first cause and the newest one.
    fn halt(&mut self, cause: LocatedCause, now_s: f64) {
        let is_counted =
            self.exchange_error.is_some() && matches!(cause.cause, StopCause::Driver(_));
        self.n_halts += u64::from(!is_counted);
        let stop = cause.at(now_s);
        if matches!(self.state, ArmsState::Stopped(_)) {
            self.later_stop = Some(stop);
        } else {
            self.state = ArmsState::Stopped(stop);
            self.later_stop = None;
        }
        // If this fails, the next command repeats the stop, and without commands the drives brake by themselves.
        self.stop_error = self.driver.stop().err();
    }
}

impl<D: Driver> Drop for Executor<D> {
    /// Stops the drives.
    fn drop(&mut self) {
        self.driver.stop().ok();
    }
}

/// Returns the age of a state beyond one period in whole periods. Ages of less than half a period are jitter.
fn stale_periods(stale_s: f64, period_s: f64) -> usize {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a state that is used is a few periods old"
    )]
    let periods = (stale_s / period_s).round().max(0.0) as usize;
    periods
}

/// Checks that idle arms are at most `allowed` radians from the position that they hold.
fn check_in_place(at: &[Joints], state: &PairState, allowed: f64) -> Result<(), LocatedCause> {
    for (arm, (at, reading)) in at.iter().zip(&state.arms).enumerate() {
        for (joint, (at, angle)) in at.iter().zip(reading.angles.iter()).enumerate() {
            let got = (at - angle).abs();
            if got > allowed {
                return Err(StopCause::Tracking(Excess { got, allowed }).of_joint(arm, joint));
            }
        }
    }
    Ok(())
}
