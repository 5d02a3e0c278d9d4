//! The public state of the executor.

use tandem_kinematics::Joints;

use super::Executor;
use crate::driver::{Driver, DriverError, PairState};
use crate::executor::playback::Playback;
use crate::executor::state::{Phase, Progress};
use crate::executor::stop::Stop;

impl<D: Driver> Executor<D> {
    /// The phase of the arms.
    #[must_use]
    pub fn phase(&self) -> Phase {
        self.state.phase()
    }

    /// The stop that the arms are in, while they are stopped.
    #[must_use]
    pub fn stopped_by(&self) -> Option<&Stop> {
        self.state.stop()
    }

    /// The newest cause of a stop while the arms are stopped: the one that stopped them, or a later one that would
    /// have.
    #[must_use]
    pub fn newest_stop(&self) -> Option<&Stop> {
        self.stopped_by().map(|first| self.later_stop.as_ref().unwrap_or(first))
    }

    /// The number of stops and faults so far. A connection that has failed counts once.
    #[must_use]
    pub(crate) fn n_halts(&self) -> u64 {
        self.n_halts
    }

    /// Returns true if the arms have confirmed the last order to stop with a new state.
    #[must_use]
    pub fn stop_is_confirmed(&self) -> bool {
        self.answers.stop_is_confirmed() && self.driver.confirms_stop()
    }

    /// The error of the last attempt to stop the drives, until a command gets through.
    #[must_use]
    pub fn stop_error(&self) -> Option<&DriverError> {
        self.stop_error.as_ref()
    }

    /// The error of the last exchange, if it failed. A driver that has failed may never work again.
    #[must_use]
    pub fn exchange_error(&self) -> Option<&DriverError> {
        self.exchange_error.as_ref()
    }

    /// The number of consecutive good states.
    #[must_use]
    pub fn n_good(&self) -> u32 {
        self.monitor.n_good()
    }

    /// The time until the present lease ends unless it is renewed, seconds; `None` if the arms have no owner.
    #[must_use]
    pub fn lease_left_s(&self, now_s: f64) -> Option<f64> {
        let left_s = self.settings.lease_s - self.lease.silent_s(now_s);
        (left_s > 0.0).then_some(left_s)
    }

    /// The progress of the present motion.
    #[must_use]
    pub fn progress(&self) -> Option<Progress> {
        let playback = self.state.playback()?;
        let (played_s, duration_s) = (playback.played_s(), playback.duration_s());
        Some(Progress { played_s, duration_s })
    }

    /// The joint angles that the present motion prescribes now, radians, arm by arm.
    #[must_use]
    pub fn reference(&self) -> Option<&[Joints]> {
        self.state.playback().map(Playback::reference)
    }

    /// The commanded openings of the grippers, arm by arm; `None` while the arms are stopped. A gripper that holds an
    /// object is open wider than commanded.
    #[must_use]
    pub fn openings(&self) -> Option<Vec<f64>> {
        let is_stopped = self.phase() == Phase::Stopped;
        (!is_stopped).then(|| self.commands.last().iter().map(|arm| arm.opening).collect())
    }

    /// The driver, for inspection.
    #[must_use]
    pub fn driver(&self) -> &D {
        &self.driver
    }

    /// The newest valid state of the arms.
    #[must_use]
    pub fn state(&self) -> Option<&PairState> {
        self.monitor.state()
    }

    /// Returns true if all joints were at rest in the newest state.
    #[must_use]
    pub fn at_rest(&self) -> bool {
        self.monitor.at_rest()
    }
}
