//! Raised arms are moved to their start posture, or refuse to be.

use std::cell::Cell;
use std::sync::Arc;

use tandem_bridge::service::BoxDriver;
use tandem_bridge::to_start::{Operator, SPEED_RADPS, ToStartError, to_start};
use tandem_bridge::work_cell::mico_cell;
use tandem_bridge::{Command, Driver, DriverError, Executor, Order, PairState, Settings};
use tandem_core::ArmIndex;
use tandem_kinematics::{ArmSample, Joints, Motion};
use tandem_trials::{SimulatedConfig, SimulatedPair};

use crate::drivers::rig::SharedPair;
use crate::pair::calibration::SleepClock;

/// Moves a pair that the test inspects, and keeps the fastest joint's speed.
struct Shared(SharedPair);

impl Driver for Shared {
    fn period_s(&self) -> f64 {
        self.0.lock().unwrap().period_s()
    }

    fn exchange(&mut self, command: &Command) -> Result<PairState, DriverError> {
        if let Order::Move(arms) = &command.order {
            let rates = arms.iter().flat_map(|arm| arm.velocities.iter());
            assert!(rates.clone().all(|rate| rate.abs() < 1.1 * SPEED_RADPS), "{command:?}");
        }
        self.0.lock().unwrap().exchange(command)
    }

    fn stop(&mut self) -> Result<(), DriverError> {
        self.0.lock().unwrap().stop()
    }
}

/// Both arms upright with bent elbows: the grippers do not point down.
fn raised() -> Vec<Joints> {
    let degrees = |joints: [f64; 4]| Joints::new(&joints.map(f64::to_radians));
    vec![degrees([20.0, 180.0, 250.0, 180.0]), degrees([-20.0, 175.0, 260.0, 170.0])]
}

fn pair_at(at: &[Joints]) -> SharedPair {
    let pair = SimulatedPair::new(mico_cell(), at, 0.5, SimulatedConfig::default());
    Arc::new(std::sync::Mutex::new(pair))
}

/// Moves `pair` to `start`, and interrupts after `n_periods`. Returns the duration of the announced motion as well.
fn moved(
    pair: &SharedPair,
    start: &[Joints],
    n_periods: u32,
) -> (Result<(), ToStartError>, Option<f64>) {
    moved_behind(Box::new(Shared(Arc::clone(pair))), start, n_periods)
}

/// As [`moved`], for the arms behind `driver`.
fn moved_behind(
    driver: BoxDriver,
    start: &[Joints],
    n_periods: u32,
) -> (Result<(), ToStartError>, Option<f64>) {
    let (left, mut duration_s) = (Cell::new(n_periods), None);
    let is_interrupted = || {
        left.set(left.get().saturating_sub(1));
        left.get() == 0
    };
    let operator = Operator {
        clock: &SleepClock::default(),
        announce: &mut |motion: &Motion| duration_s = Some(motion.duration_s()),
        report: &mut |_| {},
        is_interrupted: &is_interrupted,
    };
    let result = to_start(&mico_cell(), driver, Settings::default(), start, operator);
    (result, duration_s)
}

fn farthest_rad(pair: &SharedPair, from: &[Joints]) -> f64 {
    let pair = pair.lock().unwrap();
    let far = |(arm, from): (usize, &Joints)| from.largest_difference(pair.angles(ArmIndex(arm)));
    from.iter().enumerate().map(far).fold(0.0, f64::max)
}

#[test]
fn raised_arms_reach_their_start_and_are_stopped_there() {
    let start = mico_cell().ready(0.05).unwrap();
    let pair = pair_at(&raised());
    // A client's motion is refused, because the grippers do not point down.
    let mut executor =
        Executor::new(mico_cell(), Shared(Arc::clone(&pair)), Settings::default()).unwrap();
    let rests = |angles: &Joints| ArmSample {
        angles: *angles,
        velocities: Joints::new(&[0.0; 4]),
        gripper_opening: 0.5,
    };
    let arms = raised().iter().map(|angles| vec![rests(angles); 2]).collect();
    let here = Motion { period_s: 0.01, arms };
    let refused = executor.checker().check(here, &raised());
    assert!(format!("{refused:?}").contains("Tilt"), "{refused:?}");
    executor.stop(0.0);
    drop(executor);

    let (result, duration_s) = moved(&pair, &start, 20_000);
    assert_eq!(result, Ok(()));
    assert!((10.0..180.0).contains(&duration_s.unwrap()), "{duration_s:?}");
    assert!(farthest_rad(&pair, &start) < 0.3_f64.to_radians());
}

#[test]
fn an_interruption_stops_the_arms_on_their_way() {
    let start = mico_cell().ready(0.05).unwrap();
    let pair = pair_at(&raised());
    assert_eq!(moved(&pair, &start, 2000).0, Err(ToStartError::Interrupted));
    let mut inspected = pair.lock().unwrap();
    (0..20).for_each(|_| drop(inspected.skip_period()));
    let rates = [0, 1].map(|arm| *inspected.velocities(ArmIndex(arm)));
    assert!(rates.iter().all(|rates| rates.iter().all(|rate| rate.abs() < 1e-3)), "{rates:?}");
    drop(inspected);
    assert!(farthest_rad(&pair, &raised()) > 0.1 && farthest_rad(&pair, &start) > 0.1);
}

#[test]
fn a_start_without_a_checked_way_is_refused() {
    // Both hands at the same place.
    let cell = mico_cell();
    let middle = cell.world_from_arm(ArmIndex(0), &[0.12, 0.0, 0.05].into());
    let start: Vec<Joints> = [0, 1]
        .map(|arm| {
            let model = cell.arms[arm].model;
            let target = cell.arms[arm].target(&middle);
            let seed = Joints::new(model.elbow_up_rad);
            model.inverse_kinematics(&target, &seed).unwrap().angles
        })
        .to_vec();
    let pair = pair_at(&raised());
    let (result, announced) = moved(&pair, &start, 20_000);
    assert!(
        matches!(&result, Err(ToStartError::NoWay(error)) if error.to_string().contains("arm")),
        "{result:?}"
    );
    assert!(announced.is_none() && farthest_rad(&pair, &raised()) < 1e-3);
}

/// Arms that do not answer the orders to stop after a motion.
struct Deaf {
    pair: SharedPair,
    newest: Option<PairState>,
    has_moved: bool,
}

impl Driver for Deaf {
    fn period_s(&self) -> f64 {
        self.pair.lock().unwrap().period_s()
    }

    fn exchange(&mut self, command: &Command) -> Result<PairState, DriverError> {
        self.has_moved |= matches!(command.order, Order::Move(_));
        let state = self.pair.lock().unwrap().exchange(command)?;
        match &self.newest {
            Some(newest) if self.has_moved && command.order == Order::Stop => Ok(newest.clone()),
            _ => Ok(self.newest.insert(state).clone()),
        }
    }

    fn stop(&mut self) -> Result<(), DriverError> {
        self.pair.lock().unwrap().stop()
    }
}

#[test]
fn a_stop_at_the_end_that_the_arms_do_not_confirm_is_reported() {
    let start = mico_cell().ready(0.05).unwrap();
    let moved_deaf = |n_periods| {
        let pair = pair_at(&raised());
        let driver: BoxDriver = Box::new(Deaf { pair, newest: None, has_moved: false });
        moved_behind(driver, &start, n_periods).0
    };
    assert_eq!(moved_deaf(20_000), Err(ToStartError::StopUnconfirmed(None)));
    let interrupted = moved_deaf(2000).unwrap_err();
    let first = Some(Box::new(ToStartError::Interrupted));
    assert_eq!(interrupted, ToStartError::StopUnconfirmed(first));
    assert_eq!(
        interrupted.to_string(),
        "interrupted; the arms have not confirmed the order to stop within 1 s: use the emergency stop"
    );
}
