//! Measured times are those that the simulated pair was configured with.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use tandem_bridge::calibration::{CalibrationError, JointTiming, Operator, calibrate};
use tandem_bridge::cell_file::ArmTiming;
use tandem_bridge::service::{BoxDriver, Clock};
use tandem_bridge::work_cell::mico_cell;
use tandem_bridge::{Command, Driver, DriverError, Faults, Order, PairState, Settings};
use tandem_trials::simulated::PERIOD_S;
use tandem_trials::{SimulatedConfig, SimulatedPair};

/// A clock that advances when its user sleeps.
#[derive(Debug, Default)]
pub(crate) struct SleepClock(AtomicU64);

impl Clock for SleepClock {
    fn now_s(&self) -> f64 {
        f64::from_bits(self.0.load(Ordering::Relaxed))
    }

    fn sleep_until(&self, when_s: f64) {
        self.0.store(when_s.max(self.now_s()).to_bits(), Ordering::Relaxed);
    }
}

fn pair(config: SimulatedConfig) -> SimulatedPair {
    let cell = mico_cell();
    let at = cell.ready(0.05).unwrap();
    SimulatedPair::new(cell, &at, 0.5, config)
}

/// Measures arms with `config`. Returns the times of each arm and the number of joints that were reported.
fn measured(config: SimulatedConfig, settings: Settings, speed: f64) -> (Vec<ArmTiming>, usize) {
    let mut joints: Vec<JointTiming> = Vec::new();
    let mut report = |joint| joints.push(joint);
    let driver: BoxDriver = Box::new(pair(config));
    let clock = SleepClock::default();
    let operator = Operator { clock: &clock, report: &mut report, is_interrupted: &|| false };
    let timings = calibrate(&mico_cell(), driver, settings, speed, operator);
    (timings.unwrap(), joints.len())
}

#[test]
fn the_simulated_pair_has_the_times_it_was_configured_with() {
    for (latency_periods, lag_s, brake_s, speed) in
        [([1, 2], 0.010, 0.040, 0.3), ([1, 1], 0.020, 0.080, 0.3), ([2, 3], 0.005, 0.030, 0.4)]
    {
        let config =
            SimulatedConfig { latency_periods, lag_s, brake_s, ..SimulatedConfig::default() };
        // What the bridge assumes before the measurement is wrong.
        let settings = Settings {
            lag_s: 0.035,
            reaction_s: 0.060,
            brake_s: 0.1,
            pause_s: 0.2,
            ..Settings::default()
        };
        let (arms, n_joints) = measured(config, settings, speed);
        assert_eq!((arms.len(), n_joints), (2, 8));
        let [low, high] = latency_periods.map(|n| f64::from(n) * PERIOD_S);
        for arm in arms {
            let expected_s = 0.5 * (low + high) + lag_s;
            assert!((arm.lag_s - expected_s).abs() < 0.003, "{arm:?}");
            let longest_s = (high + PERIOD_S).max(expected_s);
            assert!((arm.reaction_s - longest_s).abs() < 0.003, "{arm:?}");
            assert!((arm.brake_s - brake_s).abs() < 0.1 * brake_s + 0.002, "{arm:?}");
        }
    }
}

/// Arms that record their commands and can report faults in a single state.
struct Watched {
    pair: SimulatedPair,
    told: Arc<Mutex<Told>>,
    faults: Option<(After, Faults)>,
}

/// The event after which faults are reported.
#[derive(Debug, Clone)]
enum After {
    /// The first reset, immediately.
    Reset,
    /// The first intended stop, by 100 ms.
    Stop,
    /// The same, and it takes 60 ms by this clock.
    DelayedStop(Arc<SleepClock>),
}

impl After {
    fn is_now(&self, told: &Told) -> bool {
        match self {
            Self::Reset => told.n_moves == 1,
            Self::Stop | Self::DelayedStop(_) => told.n_stops == 10,
        }
    }
}

#[derive(Default)]
struct Told {
    /// The largest number of joints that moved at the same time.
    n_joints: usize,
    /// The highest commanded speed, as a share of the joint's.
    speed: f64,
    newest: Option<Order>,
    n_exchanges: usize,
    n_moves: usize,
    /// Stops since a joint moved.
    n_stops: usize,
    /// Moves since the report of the faults; `None` before.
    n_moves_after: Option<usize>,
}

impl Driver for Watched {
    fn period_s(&self) -> f64 {
        self.pair.period_s()
    }

    fn exchange(&mut self, command: &Command) -> Result<PairState, DriverError> {
        let mut told = self.told.lock().unwrap();
        told.n_exchanges += 1;
        told.newest = Some(command.order.clone());
        if let Order::Move(arms) = &command.order {
            told.n_moves += 1;
            told.n_moves_after = told.n_moves_after.map(|n| n + 1);
            let joints = || {
                self.pair.cell().arms.iter().zip(arms).flat_map(|(placed, arm)| {
                    arm.velocities
                        .iter()
                        .zip(placed.model.joints)
                        .map(|(v, joint)| v.abs() / joint.speed_radps)
                })
            };
            // Feedback moves the other joints a little.
            told.n_joints = told.n_joints.max(joints().filter(|share| *share > 0.05).count());
            told.speed = told.speed.max(joints().fold(0.0, f64::max));
        } else if told.speed > 0.0 {
            told.n_stops += 1;
        }
        let mut state = self.pair.exchange(command)?;
        if let Some((after, faults)) = &self.faults
            && told.n_moves_after.is_none()
            && after.is_now(&told)
        {
            if let After::DelayedStop(clock) = after {
                clock.sleep_until(clock.now_s() + 0.06);
            }
            state.arms[1].faults = *faults;
            told.n_moves_after = Some(0);
        }
        Ok(state)
    }

    fn stop(&mut self) -> Result<(), DriverError> {
        self.told.lock().unwrap().newest = Some(Order::Stop);
        self.pair.stop()
    }
}

#[test]
fn one_joint_moves_at_a_time_and_an_interrupted_measurement_stops_the_arms() {
    let told = Arc::new(Mutex::new(Told::default()));
    let driver = || -> BoxDriver {
        let pair = pair(SimulatedConfig::default());
        Box::new(Watched { pair, told: Arc::clone(&told), faults: None })
    };
    let clock = SleepClock::default();
    let n_measured = std::cell::Cell::new(0);
    let mut report = |_| n_measured.set(n_measured.get() + 1);
    let is_over = || n_measured.get() == 3 && told.lock().unwrap().n_exchanges.is_multiple_of(50);
    let operator = Operator { clock: &clock, report: &mut report, is_interrupted: &is_over };
    let ended = calibrate(&mico_cell(), driver(), Settings::default(), 0.3, operator);
    assert_eq!(ended.unwrap_err(), CalibrationError::Interrupted);
    let told = told.lock().unwrap();
    assert_eq!(told.newest, Some(Order::Stop), "the last order");
    assert_eq!(told.n_joints, 1);
    assert!(told.speed > 0.25 && told.speed < 0.36, "{}", told.speed);
}

/// Measures arms that report `faults` once. Returns the result and the number of moves after the report.
fn measured_with(
    after: After,
    faults: Faults,
    clock: &SleepClock,
) -> (Result<Vec<ArmTiming>, CalibrationError>, usize) {
    let told = Arc::new(Mutex::new(Told::default()));
    let pair = pair(SimulatedConfig::default());
    let faults = Some((after, faults));
    let driver: BoxDriver = Box::new(Watched { pair, told: Arc::clone(&told), faults });
    let operator = Operator { clock, report: &mut |_| (), is_interrupted: &|| false };
    let ended = calibrate(&mico_cell(), driver, Settings::default(), 0.3, operator);
    let n_moves_after = told.lock().unwrap().n_moves_after;
    (ended, n_moves_after.unwrap())
}

#[test]
fn a_brief_fault_of_arms_at_rest_ends_the_measurement() {
    let contact = Faults { contact: true, ..Faults::default() };
    let emergency_stop = Faults { emergency_stop: true, ..Faults::default() };
    let drive = Faults { drive: true, ..Faults::default() };
    for (faults, what) in [
        (contact, "a contact is reported"),
        (emergency_stop, "the emergency stop is pressed"),
        (drive, "a drive reports a fault"),
    ] {
        for after in [After::Reset, After::Stop] {
            let (ended, n_moves_after) =
                measured_with(after.clone(), faults, &SleepClock::default());
            let error = ended.unwrap_err().to_string();
            let expected = format!("arm 1: {what}");
            assert!(error.starts_with("the arms were stopped: at "), "{after:?}: {error}");
            assert!(error.ends_with(&expected), "{after:?}: {error}");
            assert_eq!(n_moves_after, 0, "{after:?}: {what}");
        }
    }
}

#[test]
fn drives_that_braked_because_of_a_delay_are_reset() {
    let clock = Arc::new(SleepClock::default());
    let drive = Faults { drive: true, ..Faults::default() };
    let (ended, _) = measured_with(After::DelayedStop(Arc::clone(&clock)), drive, &clock);
    assert_eq!(ended.unwrap().len(), 2);
    let emergency_stop = Faults { emergency_stop: true, ..drive };
    let clock = Arc::new(SleepClock::default());
    let after = After::DelayedStop(Arc::clone(&clock));
    let (ended, n_moves_after) = measured_with(after, emergency_stop, &clock);
    assert!(ended.is_err(), "{ended:?}");
    assert_eq!(n_moves_after, 0);
}

#[test]
fn a_joint_without_room_is_an_error_before_it_moves() {
    let cell = mico_cell();
    let mut settings = Settings::default();
    // No gripper is this upright.
    settings.check.tilt_rad = 1e-3;
    let driver: BoxDriver = Box::new(pair(SimulatedConfig::default()));
    let clock = SleepClock::default();
    let operator = Operator { clock: &clock, report: &mut |_| (), is_interrupted: &|| false };
    let ended = calibrate(&cell, driver, settings, 0.3, operator);
    let error = ended.unwrap_err().to_string();
    assert!(error.starts_with("joint 1 of arm 0 cannot turn by"), "{error}");
}
