//! Homing an arm after power-up, over a connection of its own and without an executor.
//!
//! Kinova's node moves the arm to its home position by itself, along an unchecked path, and then opens the gripper
//! completely. The node has one thread and handles no other request until then: it reports no states and **delays
//! `in/stop` until the arm is home**. Only the emergency stop ends the motion earlier.

use std::time::Duration;

use crate::driver::DriverError;
use crate::kinova_ros::node::{Control, Service};
use crate::kinova_ros::{KinovaRosConfig, KinovaRosDriver};
use crate::service::Clock;

/// Time before homing in which no publisher of velocities may appear, seconds. A bridge whose arms are not stopped
/// publishes 100 per second.
const QUIET_S: f64 = 1.0;
/// Time limit of `in/start`, `in/stop` and of the states after homing, seconds.
const SERVICE_S: f64 = 5.0;
/// Time limit of `in/home_arm`, seconds.
const HOMING_S: f64 = 120.0;
/// Highest measured speed of a joint at rest, radians per second.
const REST_RADPS: f64 = 1.0 * std::f64::consts::PI / 180.0;
/// States of the pair that have to show rest.
const N_REST: u64 = 5;
/// Longest wait for a message.
const WAIT: Duration = Duration::from_millis(10);

/// The reason why an arm was not homed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum HomingError {
    /// The connection or a service failed, or another node moves the arms.
    #[error(transparent)]
    Driver(#[from] DriverError),
    /// The operator interrupted.
    #[error(
        "interrupted: the arm is stopped, but if it was homing, its node stops it only once it is home"
    )]
    Interrupted,
    /// Nothing happened in time.
    #[error("{what} took longer than {limit_s} s")]
    Timeout {
        /// The event that took too long.
        what: String,
        /// The limit, seconds.
        limit_s: u32,
    },
}

/// Homes arm `arm` (an index of `config.arms`) and waits until it is stopped and at rest. `is_interrupted` is called
/// about every 10 ms.
///
/// # Errors
/// Returns the reason why the arm was not homed. It is stopped then, as far as the node lets it be.
///
/// # Panics
/// Panics if there is no arm `arm`.
pub fn home(
    config: &KinovaRosConfig,
    arm: usize,
    clock: &dyn Clock,
    is_interrupted: &dyn Fn() -> bool,
) -> Result<(), HomingError> {
    assert!(arm < config.arms.len(), "arm {arm}");
    let mut driver = KinovaRosDriver::connect(config.clone())?;
    driver.is_passive = true;
    let mut homing = Homing { driver, arm, clock, is_interrupted };
    let homed = homing.home();
    if homed.is_err() && !homing.driver.is_passive {
        // The connection may have ended, in which case the driver has stopped the arms.
        homing.driver.stop_arm(arm).ok();
    }
    homed
}

struct Homing<'a> {
    driver: KinovaRosDriver,
    arm: usize,
    clock: &'a dyn Clock,
    is_interrupted: &'a dyn Fn() -> bool,
}

impl Homing<'_> {
    fn home(&mut self) -> Result<(), HomingError> {
        let from_s = self.clock.now_s();
        while self.clock.now_s() < from_s + QUIET_S {
            self.listen()?;
        }
        self.driver.is_passive = false;
        self.call(Service::Start, SERVICE_S)?;
        self.call(Service::Home, HOMING_S)?;
        self.call(Service::Stop, SERVICE_S)?;
        let (mut seen, mut n_rest) = (self.driver.newest.sequence, 0);
        self.until("coming to rest", SERVICE_S, |homing| {
            let newest = &homing.driver.newest;
            if newest.sequence != seen {
                seen = newest.sequence;
                let mut rates = newest.arms[homing.arm].velocities.iter();
                n_rest = if rates.all(|rate| rate.abs() <= REST_RADPS) { n_rest + 1 } else { 0 };
            }
            n_rest >= N_REST
        })
    }

    /// Calls a service and waits for its response.
    fn call(&mut self, service: Service, limit_s: f64) -> Result<(), HomingError> {
        let arm = self.arm;
        self.driver.unless_failed(|driver| driver.call_service(arm, service))?;
        let name = self.driver.arms[arm].topic(service.name());
        self.until(&name, limit_s, |homing| {
            !matches!(homing.driver.arms[homing.arm].control, Control::Pending { .. })
        })
    }

    /// Receives messages until `condition` holds.
    fn until(
        &mut self,
        what: &str,
        limit_s: f64,
        mut condition: impl FnMut(&Self) -> bool,
    ) -> Result<(), HomingError> {
        let from_s = self.clock.now_s();
        while !condition(self) {
            if self.clock.now_s() > from_s + limit_s {
                #[expect(
                    clippy::cast_possible_truncation,
                    clippy::cast_sign_loss,
                    reason = "limits are whole seconds"
                )]
                let limit_s = limit_s as u32;
                return Err(HomingError::Timeout { what: what.to_owned(), limit_s });
            }
            self.listen()?;
        }
        Ok(())
    }

    fn listen(&mut self) -> Result<(), HomingError> {
        if (self.is_interrupted)() {
            return Err(HomingError::Interrupted);
        }
        self.driver.listen(WAIT)?;
        Ok(())
    }
}
