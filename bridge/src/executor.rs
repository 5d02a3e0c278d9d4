//! Plays a checked motion through a driver, period by period, and stops whenever anything is not as it should be.
//!
//! **States.** The arms begin *stopped*. [`reset`](Executor::reset) makes them *idle*, [`start`](Executor::start) *moving*, and
//! at the motion's end they *settle* and are idle again. A moving pair *holds* (comes to rest on its
//! path, and goes on by itself) while its owner or its states are late. Everything else that goes wrong, in any state, and
//! [`stop`](Executor::stop) by anyone, makes them *stopped*: every later command is [`Order::Stop`] until an owner resets
//! them. A stop says when, where and why ([`Stop`]), and the first one stands.
//!
//! **Each tick** sends one command and takes one state. The motion's own velocities, corrected by how far the arms are from
//! where it has them, are kept within the limits (`playback.rs`); the envelope then looks at what came of it as if
//! it did not know where it came from (`envelope.rs`); the state that comes back is judged (`monitor.rs`).
//!
//! **Ownership.** Whoever has the token owns the arms, as long as they are heard ([`acquire`](Executor::acquire) again). Only the
//! owner starts and resets. Stopping is free for all.
//!
//! **Every way out stops the drives**: when the executor is dropped it tells them, and when its process is killed they
//! fall silent (see [`driver`](crate::driver)).

use tandem_kinematics::{Excess, Joints, Motion, WorkCell};

use crate::driver::{ArmCommand, Command, Driver, DriverError, Order, PairState};
use crate::executor::envelope::{Envelope, History};
use crate::executor::lease::Lease;
use crate::executor::monitor::{Monitor, Told};
use crate::executor::playback::{Moment, Playback};
use crate::executor::stop::Breach;

pub use checked::{CheckError, CheckedMotion, Checker};
pub use lease::{LeaseError, Token};
pub use refused::{ResetError, StartError};
pub use settings::{BadSetting, Settings};
pub use stop::{Stop, StopCause};

pub(crate) use refused::GOOD_STATES;

mod checked;
mod envelope;
mod lease;
mod monitor;
mod playback;
mod refused;
mod settings;
mod stop;

/// Commands that are remembered beyond a reaction.
const REMEMBERED_BEYOND: usize = 8;

/// What the arms are doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// The drives brake or have braked; nothing moves before a reset.
    Stopped,
    /// The arms stay where they are and wait for a motion.
    Idle,
    /// A motion is being played.
    Moving,
    /// A motion pauses because its owner or the states are late.
    Holding,
    /// The motion is over and the arms come to rest at its end.
    Settling,
}

/// How far a motion has come.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    /// What has been played of it, seconds of the motion's own time.
    pub played_s: f64,
    /// How long it is, seconds of its own time.
    pub duration_s: f64,
}

/// Moves a pair of arms; nothing else may talk to their driver.
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
    state: State,
    number: u64,
    history: History,
    before: Vec<ArmCommand>,
    ticked_s: Option<f64>,
    /// Why the drives could not be told to stop, until they were.
    untold: Option<DriverError>,
    /// Why the last exchange failed, if it did.
    failed: Option<DriverError>,
}

/// What the arms are doing, and what goes with it.
#[derive(Debug)]
enum State {
    Stopped(Stop),
    Idle {
        /// Where the arms shall stay, radians.
        at: Vec<Joints>,
    },
    Playing {
        playback: Box<Playback>,
        holding: bool,
    },
}

impl<D: Driver> Executor<D> {
    /// Takes over the arms of `cell` behind `driver`. They are stopped until somebody resets them.
    ///
    /// # Errors
    /// Names a setting that makes no sense.
    pub fn new(cell: WorkCell, driver: D, settings: Settings) -> Result<Self, BadSetting> {
        let period_s = driver.period_s();
        let settings = settings.checked(&cell, period_s)?;
        let still =
            |n_joints| ArmCommand { velocities: Joints::from_fn(n_joints, |_| 0.0), opening: 0.0 };
        let before: Vec<ArmCommand> =
            cell.arms.iter().map(|arm| still(arm.model.n_joints())).collect();
        Ok(Self {
            lease: Lease::default(),
            monitor: Monitor::new(&cell, &settings, period_s),
            envelope: Envelope::new(&cell, &settings, period_s),
            state: State::Stopped(StopCause::NotReset.anywhere().at(0.0)),
            number: 0,
            history: History::new(),
            before,
            ticked_s: None,
            untold: None,
            failed: None,
            checker: Checker::new(cell.clone(), settings),
            cell,
            settings,
            driver,
            period_s,
        })
    }

    /// Makes whoever has `token` the owner when nobody else is, and notes that they were heard: the sign of life of a motion.
    ///
    /// # Errors
    /// When somebody else owns the arms.
    pub fn acquire(&mut self, token: Token, now_s: f64) -> Result<(), LeaseError> {
        self.lease.acquire(token, now_s, self.settings.lease_s)
    }

    /// Notes that the owner was heard.
    ///
    /// # Errors
    /// When whoever has `token` does not own the arms, or does no longer.
    pub fn renew(&mut self, token: Token, now_s: f64) -> Result<(), LeaseError> {
        self.lease.renew(token, now_s, self.settings.lease_s)
    }

    /// Gives the arms up. A motion is stopped.
    ///
    /// # Errors
    /// When whoever asks does not own them.
    pub fn release(&mut self, token: Token, now_s: f64) -> Result<(), LeaseError> {
        self.lease.renew(token, now_s, self.settings.lease_s)?;
        if matches!(self.state, State::Playing { .. }) {
            self.halt(StopCause::OwnerLeft.anywhere(), now_s);
        }
        self.lease.release();
        Ok(())
    }

    /// Time from one tick to the next, seconds.
    #[must_use]
    pub fn period_s(&self) -> f64 {
        self.period_s
    }

    /// What checks motions for this executor.
    #[must_use]
    pub fn checker(&self) -> &Checker {
        &self.checker
    }

    /// Checks `motion` and starts it from where the arms are, at `speed` (in (0, 1], a share of the motion's own). The
    /// check of a long motion takes longer than a period: see [`start_checked`](Self::start_checked).
    ///
    /// # Errors
    /// Says what is wrong with the motion, or why this is not the time. Nothing moves then.
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

    /// Starts a motion that the [`checker`](Self::checker) has passed, if the arms are still where it begins.
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

    /// Where the arms are, joint angles in radians, when a motion may start now.
    fn startable(
        &mut self,
        token: Token,
        speed: f64,
        now_s: f64,
    ) -> Result<Vec<Joints>, StartError> {
        self.lease.renew(token, now_s, self.settings.lease_s)?;
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
        self.state = State::Playing { playback, holding: false };
    }

    /// Stops the arms. Anyone may at any time.
    pub fn stop(&mut self, now_s: f64) {
        self.halt(StopCause::Requested.anywhere(), now_s);
    }

    /// Stops the arms because whoever ticks the executor is about to end.
    pub fn shut_down(&mut self, now_s: f64) {
        self.halt(StopCause::ShutDown.anywhere(), now_s);
    }

    /// Lets stopped arms go: they stay where they are until a motion is started.
    ///
    /// # Errors
    /// When whoever asks does not own the arms, or the arms are not well.
    pub fn reset(&mut self, token: Token, now_s: f64) -> Result<(), ResetError> {
        self.lease.renew(token, now_s, self.settings.lease_s)?;
        if self.phase() != Phase::Stopped {
            return Err(ResetError::NotStopped(self.phase()));
        }
        let got = self.monitor.n_good();
        let stale = self.monitor.stale_s(now_s) > self.settings.state_hold_s;
        let state = self.monitor.state().filter(|_| got >= GOOD_STATES && !stale);
        let Some(state) = state else { return Err(ResetError::States { got }) };
        if !self.monitor.at_rest() {
            return Err(ResetError::Moving);
        }
        for (before, arm) in self.before.iter_mut().zip(&state.arms) {
            before.opening = arm.opening.clamp(0.0, 1.0);
        }
        self.state = State::Idle { at: state.arms.iter().map(|arm| arm.angles).collect() };
        Ok(())
    }

    /// Puts a driver with a new connection to the same arms in the place of one that has failed. The arms stay stopped, its
    /// first commands are stops, commands are counted from 1, and nothing is believed of what the driver before has told.
    ///
    /// # Errors
    /// When whoever asks does not own the arms, they are not stopped, or the driver has not failed.
    pub fn replace_driver(
        &mut self,
        token: Token,
        driver: D,
        now_s: f64,
    ) -> Result<(), ResetError> {
        self.lease.renew(token, now_s, self.settings.lease_s)?;
        if self.phase() != Phase::Stopped || self.failed.is_none() {
            return Err(ResetError::Connected);
        }
        self.driver = driver;
        self.monitor = Monitor::new(&self.cell, &self.settings, self.period_s);
        self.history = History::new();
        self.number = 0;
        (self.untold, self.failed) = (None, None);
        Ok(())
    }

    /// Lets one period begin at `now_s`: sends a command and takes a state. To be called once a period.
    pub fn tick(&mut self, now_s: f64) -> Phase {
        let order = self.next_order(now_s).unwrap_or_else(|breach| {
            self.halt(breach, now_s);
            Order::Stop
        });
        self.number += 1;
        self.remember(&order);
        match self.driver.exchange(&Command { number: self.number, order }) {
            Ok(state) => {
                (self.untold, self.failed) = (None, None);
                let ago = self.history.len().min(self.lag_periods()) - 1;
                let told = Told { number: self.number, velocities: &self.history[ago] };
                if let Err(breach) = self.monitor.take(now_s, state, &told) {
                    self.halt(breach, now_s);
                }
            }
            Err(error) => {
                self.monitor.miss();
                self.failed = Some(error.clone());
                self.halt(StopCause::Driver(error).anywhere(), now_s);
            }
        }
        self.phase()
    }

    /// What the arms are doing.
    #[must_use]
    pub fn phase(&self) -> Phase {
        match &self.state {
            State::Stopped(_) => Phase::Stopped,
            State::Idle { .. } => Phase::Idle,
            State::Playing { holding: true, .. } => Phase::Holding,
            State::Playing { playback, .. } if playback.over_s() > 0.0 => Phase::Settling,
            State::Playing { .. } => Phase::Moving,
        }
    }

    /// Why the arms are stopped, while they are.
    #[must_use]
    pub fn stopped_by(&self) -> Option<&Stop> {
        match &self.state {
            State::Stopped(stop) => Some(stop),
            _ => None,
        }
    }

    /// Why the drives could not be told to stop, as long as they were not.
    #[must_use]
    pub fn untold(&self) -> Option<&DriverError> {
        self.untold.as_ref()
    }

    /// Why the last exchange failed, if it did. A driver that has failed may never work again.
    #[must_use]
    pub fn failed(&self) -> Option<&DriverError> {
        self.failed.as_ref()
    }

    /// How many states in a row were good.
    #[must_use]
    pub fn n_good(&self) -> u32 {
        self.monitor.n_good()
    }

    /// How long the present owner's lease holds unless it is renewed, seconds; `None` when nobody owns the arms.
    #[must_use]
    pub fn lease_left_s(&self, now_s: f64) -> Option<f64> {
        let left_s = self.settings.lease_s - self.lease.silent_s(now_s);
        (left_s > 0.0).then_some(left_s)
    }

    /// How far the present motion has come.
    #[must_use]
    pub fn progress(&self) -> Option<Progress> {
        match &self.state {
            State::Playing { playback, .. } => {
                let (played_s, duration_s) = (playback.played_s(), playback.duration_s());
                Some(Progress { played_s, duration_s })
            }
            _ => None,
        }
    }

    /// Where the present motion has the arms, radians, arm by arm.
    #[must_use]
    pub fn reference(&self) -> Option<&[Joints]> {
        match &self.state {
            State::Playing { playback, .. } => Some(playback.reference()),
            _ => None,
        }
    }

    /// What stands behind, to look at.
    #[must_use]
    pub fn driver(&self) -> &D {
        &self.driver
    }

    /// The newest state of the arms that was believed.
    #[must_use]
    pub fn state(&self) -> Option<&PairState> {
        self.monitor.state()
    }

    /// Whether the arms were last seen at rest.
    #[must_use]
    pub fn at_rest(&self) -> bool {
        self.monitor.at_rest()
    }

    /// What to tell the arms, when nothing speaks against it.
    fn next_order(&mut self, now_s: f64) -> Result<Order, Breach> {
        let since_s = self.ticked_s.replace(now_s).map_or(self.period_s, |before| now_s - before);
        if matches!(self.state, State::Stopped(_)) {
            return Ok(Order::Stop);
        }
        let allowed = self.settings.tick_s;
        if !(since_s > 0.0 && since_s <= allowed) {
            return Err(StopCause::Late(Excess { got: since_s, allowed }).anywhere());
        }
        let stale_s = self.monitor.stale_s(now_s);
        let allowed = self.settings.state_stop_s;
        let state = match self.monitor.state() {
            Some(state) if stale_s <= allowed => state,
            _ => return Err(StopCause::StateStale(Excess { got: stale_s, allowed }).anywhere()),
        };
        let fresh = stale_s <= self.settings.state_hold_s;
        let commands = match &mut self.state {
            State::Stopped(_) => return Ok(Order::Stop),
            State::Idle { at } => {
                stays(at, state, self.settings.tracking_rad)?;
                self.before.iter().map(still).collect()
            }
            State::Playing { playback, holding } => {
                let silent_s = self.lease.silent_s(now_s);
                let allowed = self.settings.owner_stop_s;
                if silent_s > allowed {
                    let excess = Excess { got: silent_s, allowed };
                    return Err(StopCause::OwnerSilent(excess).anywhere());
                }
                *holding = !fresh || silent_s > self.settings.owner_hold_s;
                let moment = Moment {
                    cell: &self.cell,
                    settings: &self.settings,
                    period_s: self.period_s,
                    state: fresh.then_some(state),
                    before: &self.before,
                };
                playback.next(&moment, *holding)?
            }
        };
        self.envelope.check(&commands, &self.history, state, stale_s)?;
        self.settle()?;
        Ok(Order::Move(commands))
    }

    /// Ends a motion whose arms rest at its end.
    fn settle(&mut self) -> Result<(), Breach> {
        let (State::Playing { playback, holding: false }, Some(state)) =
            (&self.state, self.monitor.state())
        else {
            return Ok(());
        };
        if playback.over_s() <= 0.0 {
            return Ok(());
        }
        let (got, allowed) = (playback.distance_to_end(state), self.settings.settled_rad);
        let resting = self
            .before
            .iter()
            .all(|arm| arm.velocities.iter().all(|rate| rate.abs() <= self.settings.rest_radps));
        if got <= allowed && resting && self.monitor.at_rest() {
            self.state = State::Idle { at: playback.reference().to_vec() };
        } else if playback.over_s() > self.settings.settle_s {
            return Err(StopCause::NotSettled(Excess { got, allowed }).anywhere());
        }
        Ok(())
    }

    /// Notes what the arms are told.
    fn remember(&mut self, order: &Order) {
        let commands = match order {
            Order::Move(commands) => commands.clone(),
            Order::Stop => self.before.iter().map(still).collect(),
        };
        self.history.push_front(commands.iter().map(|arm| arm.velocities).collect());
        self.history.truncate(self.lag_periods() + REMEMBERED_BEYOND);
        self.before = commands;
    }

    /// Stops the arms, by the fastest way there is. The first stop stands.
    fn halt(&mut self, breach: Breach, now_s: f64) {
        if !matches!(self.state, State::Stopped(_)) {
            self.state = State::Stopped(breach.at(now_s));
        }
        // When this fails, the next command says it again, and without one the drives brake by themselves.
        self.untold = self.driver.stop().err();
    }

    /// A reaction in periods.
    fn lag_periods(&self) -> usize {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a reaction is some periods"
        )]
        let periods = (self.settings.reaction_s / self.period_s).ceil() as usize;
        periods.max(1)
    }
}

impl<D: Driver> Drop for Executor<D> {
    /// The arms brake.
    fn drop(&mut self) {
        self.driver.stop().ok();
    }
}

/// The command to stay, with the gripper as it is.
fn still(before: &ArmCommand) -> ArmCommand {
    ArmCommand { velocities: Joints::from_fn(before.velocities.len(), |_| 0.0), ..*before }
}

/// Idle arms are where they shall stay.
fn stays(at: &[Joints], state: &PairState, allowed: f64) -> Result<(), Breach> {
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
