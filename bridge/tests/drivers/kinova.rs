//! The driver for kinova-ros.

use std::cell::Cell;
use std::rc::Rc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use tandem_bridge::kinova_ros::{Efforts, KinovaRosConfig, KinovaRosDriver, home, settings};
use tandem_bridge::service::Clock;
use tandem_bridge::{
    ArmCommand, Command, Driver as _, DriverError, Order, PairState, Phase, StopCause,
};
use tandem_kinematics::{Joints, Motion};

use crate::drivers::kinova_side::{Fault, Side};
use crate::drivers::rig::{
    Listen, OWNER, Patient, Rig, SharedPair, angles, assert_ended, at_rest, failure, pair_at, sweep,
};

pub(crate) const STEADY: [f64; 4] = [0.8; 4];

impl Listen for KinovaRosDriver {
    fn listen(&mut self, patience: Duration) -> Result<PairState, DriverError> {
        Self::listen(self, patience)
    }
}

pub(crate) struct Test {
    pub(crate) side: Side,
    pub(crate) rig: Rig<Patient<KinovaRosDriver>>,
    pub(crate) motion: Motion,
}

pub(crate) fn connected(side: &Side) -> KinovaRosDriver {
    let driver = KinovaRosDriver::connect(KinovaRosConfig::at(format!("ws://{}", side.address)));
    quiet(driver.unwrap(), side)
}

/// Takes over the time of the other side.
fn quiet(mut driver: KinovaRosDriver, side: &Side) -> KinovaRosDriver {
    side.take_over();
    // Messages in flight still belong to the time before.
    while driver.listen(Duration::from_millis(20)).unwrap().sequence
        != driver.listen(Duration::from_millis(20)).unwrap().sequence
    {}
    driver
}

/// Lets time advance on the other side with each exchange.
fn patient(side: &Side, driver: KinovaRosDriver) -> Patient<KinovaRosDriver> {
    let waits = Rc::new(Cell::new(false));
    let (passing, due) = (side.clone(), Rc::clone(&waits));
    Patient::new(driver, &waits, move || due.set(passing.pass()))
}

impl Test {
    pub(crate) fn new(openings: [f64; 4]) -> Self {
        let motion = sweep(openings);
        let side = Side::new(&pair_at(&motion));
        let driver = connected(&side);
        Self::with(side, driver, motion)
    }

    pub(crate) fn with(side: Side, driver: KinovaRosDriver, motion: Motion) -> Self {
        Self { rig: Rig::new(patient(&side, driver), settings()), side, motion }
    }

    /// Arms in the middle of the motion.
    pub(crate) fn moving() -> Self {
        let mut test = Self::new(STEADY);
        test.let_go();
        test.set_off();
        test
    }

    /// Resets and waits until both nodes have started.
    pub(crate) fn let_go(&mut self) {
        self.rig.reset();
        for _ in 0..30 {
            assert_eq!(self.rig.tick(), Phase::Idle, "{:?}", self.rig.executor.stopped_by());
        }
        assert!(self.side.ros().nodes.iter().all(|node| !node.stopped));
    }

    fn set_off(&mut self) {
        self.rig.start(&self.motion);
        for _ in 0..60 {
            assert_eq!(self.rig.tick(), Phase::Moving, "{:?}", self.rig.executor.stopped_by());
        }
        assert!(!at_rest(&self.side.ros().pair));
    }

    pub(crate) fn n_velocities(&self) -> [usize; 2] {
        self.side.ros().nodes.each_ref().map(|node| node.n_velocities)
    }

    pub(crate) fn n_calls(&self, service: &str) -> [usize; 2] {
        self.side.ros().nodes.each_ref().map(|node| *node.calls.get(service).unwrap_or(&0))
    }

    /// Asserts that nothing is published and the arms stay at rest.
    pub(crate) fn assert_rests(&mut self) {
        for _ in 0..30 {
            self.rig.tick();
        }
        let pair = std::sync::Arc::clone(&self.side.ros().pair);
        assert!(at_rest(&pair));
        let (rested, n_velocities) = (angles(&pair), self.n_velocities());
        for _ in 0..30 {
            assert_eq!(self.rig.tick(), Phase::Stopped);
        }
        assert_eq!(self.n_velocities(), n_velocities);
        assert_stayed(&pair, &rested);
    }
}

pub(crate) fn assert_stayed(pair: &SharedPair, rested: &[Joints]) {
    for (rested, angles) in rested.iter().zip(angles(pair)) {
        assert!(rested.largest_difference(&angles) < 1e-4);
    }
}

#[test]
fn a_motion_is_played_to_its_end() {
    let mut test = Test::new(STEADY);
    test.let_go();
    let before = test.n_velocities();
    test.rig.start(&test.motion);
    let n_ticks = test.rig.play();
    test.side.pass();
    assert_ended(&test.side.ros().pair, &test.motion);
    // Exactly one message per exchange and arm.
    assert_eq!(test.n_velocities(), before.map(|n| n + n_ticks));
    assert_eq!((test.n_calls("in/stop"), test.n_calls("in/start")), ([1, 1], [1, 1]));
    assert!(test.side.ros().nodes.iter().all(|node| node.goals.is_empty()));
    // The torque that carries the arm's own weight does not count as a contact.
    assert_eq!(test.rig.executor.state().unwrap().arms[0].torques_nm, None);
}

#[test]
fn arms_that_tell_at_50_hz_are_moved_as_well() {
    let mut test = Test::new(STEADY);
    test.side.ros().every = 2;
    test.let_go();
    test.rig.start(&test.motion);
    test.rig.play();
    assert_ended(&test.side.ros().pair, &test.motion);
}

/// Lets arms whose nodes make slow calls move at `speed` for 1.5 s. Returns what is left of the test, and the
/// velocities that the first arm received and the states that its node published, per second.
fn shuttle(call_us: u64, status_us: u64, speed: f64) -> (Test, [f64; 2]) {
    let mut test = Test::new(STEADY);
    test.let_go();
    test.side.slow_calls(call_us, status_us);
    for _ in 0..20 {
        test.rig.tick();
    }
    let counts = |test: &Test| {
        let ros = test.side.ros();
        [ros.nodes[0].n_taken, ros.nodes[0].n_states].map(|n| n as f64)
    };
    let before = counts(&test);
    test.rig.executor.start(OWNER, test.motion.clone(), speed, test.rig.now_s).unwrap();
    let mut n = 0.0;
    while n < 150.0 && test.rig.tick() != Phase::Stopped {
        n += 1.0;
    }
    let after = counts(&test);
    (test, [0, 1].map(|idx| 100.0 * (after[idx] - before[idx]) / n))
}

#[test]
fn a_node_that_only_reads_its_arm_is_told_and_one_at_10_hz_plays_a_motion() {
    // As long as nine calls of 2 ms and one velocity take, the next states are due.
    let (test, [velocities, states]) = shuttle(2000, 10_000, 0.3);
    println!("status every 0.01 s: {velocities:.0} velocities/s, {states:.0} states/s");
    assert!((40.0..60.0).contains(&velocities), "{velocities}");
    let error = failure(&test.rig.executor.stopped_by().unwrap().cause).to_string();
    assert!(error.contains("the node takes too few velocities"), "{error}");

    // The more velocities are lost, the farther fast joints lag behind.
    for (call_us, speed) in [(1000, 0.5), (2000, 0.5), (3000, 0.3)] {
        let (mut test, [velocities, states]) = shuttle(call_us, 100_000, speed);
        println!("calls of {call_us} us, status every 0.1 s: {velocities:.0} velocities/s");
        assert!(velocities >= 78.0 && (9.0..11.0).contains(&states), "{velocities}, {states}");
        test.rig.play();
        assert_ended(&test.side.ros().pair, &test.motion);
    }
}

#[test]
fn grippers_move_while_the_arms_are_stationary() {
    let mut test = Test::new([0.8, 0.8, 0.4, 0.4]);
    test.let_go();
    test.rig.start(&test.motion);
    test.rig.play();
    assert_ended(&test.side.ros().pair, &test.motion);
    let opening = |test: &Test| test.rig.executor.state().unwrap().arms[1].opening;
    for _ in 0..300 {
        assert_eq!(test.rig.tick(), Phase::Idle, "{:?}", test.rig.executor.stopped_by());
    }
    assert!((opening(&test) - 0.4).abs() < 0.02, "{}", opening(&test));
    for node in &test.side.ros().nodes {
        let last = node.goals.last().unwrap();
        assert!((last["finger1"].as_f64().unwrap() - 0.6 * 6400.0).abs() < 64.0, "{last}");
        assert_eq!((&last["finger2"], last["finger3"].as_f64()), (&last["finger1"], Some(0.0)));
        assert!(node.goals.len() <= 3, "{:?}", node.goals);
        assert_eq!(node.n_while_busy, 0);
    }
}

/// The nodes outlive a bridge, and ignore a goal whose identifier they know.
#[test]
fn a_second_connection_moves_the_grippers_too() {
    let side = Side::new(&pair_at(&sweep(STEADY)));
    let order = |opening| {
        let arm = ArmCommand { velocities: Joints::from_fn(4, |_| 0.0), opening };
        Order::Move(vec![arm; 2])
    };
    for (n_goals, opening) in [(1, 0.5), (2, 0.2)] {
        let mut driver = patient(&side, connected(&side));
        let mut number = 0;
        // The first opening after a stop moves nothing: the driver takes it for that of the gripper.
        for (order, n) in [(Order::Stop, 30), (order(0.8), 60), (order(opening), 400)] {
            for _ in 0..n {
                number += 1;
                driver.exchange(&Command { number, order: order.clone() }).unwrap();
            }
        }
        let n_sent = side.ros().nodes.each_ref().map(|node| node.goals.len());
        assert_eq!(n_sent, [n_goals; 2]);
    }
}

#[test]
fn a_finger_goal_that_could_move_the_arm_is_not_sent() {
    let ends = |fault: Fault, expected: &str| {
        let mut test = Test::new([0.8, 0.8, 0.4, 0.4]);
        test.let_go();
        test.side.begin(fault);
        test.rig.start(&test.motion);
        let error = failure(&test.rig.until_stopped()).to_string();
        assert!(error.contains(expected), "{error}");
        assert!(test.side.ros().nodes[1].goals.is_empty());
    };
    ends(Fault::Elsewhere, "the arm's own command for joint 1 is 3.0 degrees from its angle");
    ends(Fault::Aborts, "joints_action/joint_angles/goal failed");
}

#[test]
fn a_push_stops_arms_whose_efforts_include_their_weight() {
    let motion = sweep(STEADY);
    let side = Side::new(&pair_at(&motion));
    let config = KinovaRosConfig {
        efforts: Efforts::Changes { mean_s: 0.4 },
        ..KinovaRosConfig::at(format!("ws://{}", side.address))
    };
    let driver = quiet(KinovaRosDriver::connect(config).unwrap(), &side);
    let mut test = Test::with(side, driver, motion);
    test.let_go();
    test.set_off();
    test.side.begin(Fault::Presses);
    let cause = test.rig.until_stopped();
    assert!(matches!(&cause, StopCause::Torque(excess) if excess.got > 5.0), "{cause}");
    assert_eq!(test.rig.executor.stopped_by().unwrap().joint, Some(1));
}

#[test]
fn arms_are_homed_alone_and_stopped_afterwards() {
    let side = Side::new(&pair_at(&sweep(STEADY)));
    let config = KinovaRosConfig::at(side.address.to_string());
    let clock = Waits::default();
    home(&config, 1, &clock, &|| false).unwrap();
    let calls = |side: &Side, arm: usize| side.ros().nodes[arm].calls.clone();
    let expected = [("in/home_arm", 1), ("in/start", 1), ("in/stop", 1)];
    assert_eq!(calls(&side, 1), expected.map(|(name, n)| (name.to_owned(), n)).into());
    assert!(calls(&side, 0).is_empty());
    assert!(side.ros().nodes[1].stopped);

    // Somebody moves the arms, the service fails, the operator interrupts.
    let fails = |fault: Option<Fault>, is_interrupted: bool, expected: &str| {
        side.ros().fault = fault;
        let n_homed = calls(&side, 0).get("in/home_arm").copied().unwrap_or(0);
        let error = home(&config, 0, &clock, &|| is_interrupted).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
        calls(&side, 0).get("in/home_arm").copied().unwrap_or(0) - n_homed
    };
    assert_eq!(fails(Some(Fault::Stranger), false, "another node publishes"), 0);
    assert_eq!(fails(None, true, "interrupted"), 0);
    assert!(calls(&side, 0).is_empty(), "whoever moves the arms goes on");
    assert_eq!(fails(Some(Fault::Refuses("home_arm")), false, "in/home_arm"), 1);
}

/// A clock that advances by 2 ms when it is read, so that a test needs no real one.
#[derive(Default)]
struct Waits(AtomicU32);

impl Clock for Waits {
    fn now_s(&self) -> f64 {
        0.002 * f64::from(self.0.fetch_add(1, Ordering::Relaxed))
    }

    fn sleep_until(&self, _at_s: f64) {}
}
