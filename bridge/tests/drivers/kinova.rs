//! The driver for kinova-ros.

use std::cell::Cell;
use std::io::{Read as _, Write as _};
use std::net::TcpListener;
use std::rc::Rc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::Duration;

use tandem_bridge::kinova_ros::{Efforts, KinovaRosConfig, KinovaRosDriver, home, settings};
use tandem_bridge::service::Clock;
use tandem_bridge::{
    ArmCommand, Command, Driver as _, DriverError, Order, PairState, Phase, ResetError, StartError,
    StopCause,
};
use tandem_kinematics::{Joints, Motion};

use crate::drivers::kinova_side::{Fault, Side};
use crate::drivers::rig::{
    Listen, OWNER, Patient, Rig, SharedPair, angles, assert_ended, at_rest, eventually, failure,
    pair_at, sweep,
};

const STEADY: [f64; 4] = [0.8; 4];

impl Listen for KinovaRosDriver {
    fn listen(&mut self, patience: Duration) -> Result<PairState, DriverError> {
        Self::listen(self, patience)
    }
}

struct Test {
    side: Side,
    rig: Rig<Patient<KinovaRosDriver>>,
    motion: Motion,
}

fn connected(side: &Side) -> KinovaRosDriver {
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

impl Test {
    fn new(openings: [f64; 4]) -> Self {
        let motion = sweep(openings);
        let side = Side::new(&pair_at(&motion));
        let driver = connected(&side);
        Self::with(side, driver, motion)
    }

    fn with(side: Side, driver: KinovaRosDriver, motion: Motion) -> Self {
        let waits = Rc::new(Cell::new(false));
        let (passing, due) = (side.clone(), Rc::clone(&waits));
        let driver = Patient::new(driver, &waits, move || due.set(passing.pass()));
        Self { rig: Rig::new(driver, settings()), side, motion }
    }

    /// Arms in the middle of the motion.
    fn moving() -> Self {
        let mut test = Self::new(STEADY);
        test.let_go();
        test.set_off();
        test
    }

    /// Resets and waits until both nodes have started.
    fn let_go(&mut self) {
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

    fn n_velocities(&self) -> [usize; 2] {
        self.side.ros().nodes.each_ref().map(|node| node.n_velocities)
    }

    fn n_calls(&self, service: &str) -> [usize; 2] {
        self.side.ros().nodes.each_ref().map(|node| *node.calls.get(service).unwrap_or(&0))
    }

    /// Asserts that nothing is published and the arms stay at rest.
    fn assert_rests(&mut self) {
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

fn assert_stayed(pair: &SharedPair, rested: &[Joints]) {
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

#[test]
fn repeated_and_late_states_are_not_new() {
    let mut test = Test::moving();
    test.side.begin(Fault::Again);
    test.rig.play();
    assert_ended(&test.side.ros().pair, &test.motion);
}

#[test]
fn a_malformed_state_ends_the_connection_and_stops_the_arms() {
    let ends = |fault: Fault, expected: &str| {
        let mut test = Test::moving();
        test.side.begin(fault);
        let cause = test.rig.until_stopped();
        let error = failure(&cause).to_string();
        assert!(error.contains(expected), "{error}");
        test.assert_rests();
        // The driver stops the arms before it closes the socket.
        if fault != Fault::Close {
            eventually("the stops arrive", || {
                test.side.pass();
                !test.side.ros().connected()
            });
            assert_eq!(test.n_calls("in/stop"), [2, 2]);
        }
        assert_eq!(test.rig.executor.stopped_by().unwrap().cause, cause);
        let reset = test.rig.executor.reset(OWNER, test.rig.now_s);
        assert!(matches!(reset, Err(ResetError::States { .. })), "{reset:?}");
    };
    ends(Fault::Null, "/left/m1n4s200_driver: position of m1n4s200_joint_2 is null");
    ends(Fault::Nan, "not JSON");
    ends(Fault::Names, "no joint \"m1n4s200_joint_1\"");
    ends(Fault::Clock, "s apart");
    ends(Fault::Complains, "rosbridge: no such type");
    ends(Fault::Stranger, "another node publishes /left/m1n4s200_driver/in/joint_velocity");
    ends(Fault::Logs, "/right/m1n4s200_driver logs an error: Could not get the angles");
    ends(Fault::Close, "not connected");
}

#[test]
fn silent_arms_are_stopped() {
    for n_silent in [1, 2] {
        let mut test = Test::moving();
        test.side.begin(Fault::Silent(n_silent));
        let cause = test.rig.until_stopped();
        assert!(matches!(cause, StopCause::StateStale(_)), "{cause}");
        test.assert_rests();
        assert_eq!(test.n_calls("in/stop"), [2, 2]);
        assert!(test.side.ros().nodes.iter().all(|node| node.stopped));
    }
}

#[test]
fn undelivered_velocities_stop_the_arms_and_prevent_a_reset() {
    let mut test = Test::moving();
    test.side.begin(Fault::Lags);
    let cause = test.rig.until_stopped();
    assert!(matches!(cause, StopCause::CommandLost(_)), "{cause}");
    test.assert_rests();
    assert_eq!(test.n_calls("in/stop"), [2, 2]);
    let reset = test.rig.executor.reset(OWNER, test.rig.now_s);
    assert!(matches!(reset, Err(ResetError::States { .. })), "{reset:?}");
}

#[test]
fn dropped_velocities_do_not_accumulate() {
    let mut test = Test::moving();
    test.side.begin(Fault::Drops);
    test.rig.play();
    for _ in 0..200 {
        assert_eq!(test.rig.tick(), Phase::Idle, "{:?}", test.rig.executor.stopped_by());
    }
    assert_ended(&test.side.ros().pair, &test.motion);
}

#[test]
fn stopped_arms_move_again_only_after_a_reset() {
    let mut test = Test::moving();
    test.rig.executor.stop(test.rig.now_s);
    test.assert_rests();
    assert_eq!((test.n_calls("in/stop"), test.n_calls("in/start")), ([2, 2], [1, 1]));
    test.let_go();
    assert_eq!(test.n_calls("in/start"), [2, 2]);
}

#[test]
fn a_service_that_fails_or_does_not_respond_ends_the_connection() {
    let ends = |fault: Fault, expected: &str| {
        let mut test = Test::moving();
        test.side.begin(fault);
        test.rig.executor.stop(test.rig.now_s);
        test.assert_rests();
        // Only the first stop is reported. The states show that the connection has ended.
        eventually("states are missing", || {
            test.rig.tick();
            let reset = test.rig.executor.reset(OWNER, test.rig.now_s);
            matches!(reset, Err(ResetError::States { .. }))
        });
        let Test { side, .. } = test;
        let mut driver = connected(&side);
        let stop = |number| Command { number, order: Order::Stop };
        let error = (1..400).find_map(|number| {
            let error = driver.exchange(&stop(number)).err();
            thread::sleep(Duration::from_millis(1));
            side.pass();
            error
        });
        let error = error.unwrap().to_string();
        assert!(error.contains(expected), "{error}");
    };
    ends(Fault::Refuses("stop"), "in/stop: \"Could not stop the control API\"");
    ends(Fault::NoAnswers, "in/stop did not answer for 100 exchanges");

    let mut test = Test::new(STEADY);
    test.side.begin(Fault::Refuses("start"));
    test.rig.try_reset();
    let error = failure(&test.rig.until_stopped()).to_string();
    assert!(error.contains("in/start: \"Could not"), "{error}");
    assert_eq!(test.n_velocities(), [0, 0]);
}

#[test]
fn arms_stop_when_the_bridge_hangs_or_is_killed() {
    let test = Test::moving();
    let n_velocities = test.n_velocities();
    for _ in 0..30 {
        test.side.pass();
    }
    assert!(at_rest(&test.side.ros().pair));
    assert!(test.n_velocities()[0] <= n_velocities[0] + 1);
}

#[test]
fn a_dropped_executor_leaves_stopped_arms() {
    let Test { side, rig, .. } = Test::moving();
    drop(rig);
    eventually("the stops arrive", || {
        side.pass();
        side.ros().nodes.iter().all(|node| node.stopped)
    });
    for _ in 0..30 {
        side.pass();
    }
    assert!(at_rest(&side.ros().pair));
}

#[test]
fn nothing_moves_over_a_new_connection_before_a_reset() {
    let mut test = Test::moving();
    test.side.begin(Fault::Close);
    test.rig.until_stopped();
    test.assert_rests();
    test.side.ros().fault = None;
    let Test { side, motion, .. } = test;
    let pair = std::sync::Arc::clone(&side.ros().pair);
    let rested = angles(&pair);

    let driver = connected(&side);
    let mut test = Test::with(side, driver, motion);
    let n_velocities = test.n_velocities();
    for _ in 0..30 {
        assert_eq!(test.rig.tick(), Phase::Stopped);
        assert!(matches!(test.rig.executor.stopped_by().unwrap().cause, StopCause::NotReset));
        let started = test.rig.executor.start(OWNER, test.motion.clone(), 1.0, test.rig.now_s);
        assert_eq!(started, Err(StartError::NotIdle(Phase::Stopped)));
    }
    assert_stayed(&pair, &rested);
    assert_eq!(test.n_velocities(), n_velocities);
    test.let_go();
}

#[test]
fn a_connection_has_to_start_with_a_stop() {
    let side = Side::new(&pair_at(&sweep(STEADY)));
    let mut driver = connected(&side);
    let arm = ArmCommand { velocities: Joints::from_fn(4, |_| 0.3), opening: 0.5 };
    let command = Command { number: 1, order: Order::Move(vec![arm; 2]) };
    let refused = driver.exchange(&command).unwrap_err();
    assert!(matches!(refused, DriverError::Refused { .. }), "{refused}");
    assert_eq!(driver.stop().unwrap_err(), refused);
    eventually("the stops arrive", || {
        side.pass();
        side.ros().nodes.iter().all(|node| node.stopped && node.n_velocities == 0)
    });
}

#[test]
fn commands_do_not_accumulate_if_rosbridge_does_not_read() {
    let side = Side::new(&pair_at(&sweep(STEADY)));
    let mut driver = connected(&side);
    let arm = ArmCommand { velocities: Joints::from_fn(4, |_| 0.0), opening: 0.8 };
    let moves = |number| Command { number, order: Order::Move(vec![arm; 2]) };
    driver.exchange(&Command { number: 1, order: Order::Stop }).unwrap();
    let mut number = 1;
    eventually("both nodes follow", || {
        side.pass();
        number += 1;
        driver.exchange(&moves(number)).unwrap();
        side.ros().nodes.iter().all(|node| node.n_velocities > 0)
    });
    // The peer does not read from here on.
    let error = (number..10_000_000).find_map(|number| driver.exchange(&moves(number)).err());
    assert!(error.unwrap().to_string().contains("rosbridge holds 100 velocities"));
}

#[test]
fn a_connection_without_states_suggests_what_to_check() {
    let config = |address: String| KinovaRosConfig {
        connect_timeout: Duration::from_millis(300),
        ..KinovaRosConfig::at(address)
    };
    let check = |config: KinovaRosConfig, expected: &str| {
        let error = KinovaRosDriver::connect(config).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    };
    let side = Side::new(&pair_at(&sweep(STEADY)));
    side.begin(Fault::Silent(1));
    check(config(side.address.to_string()), "no out/joint_state of both /left/m1n4s200_driver and");

    let closed = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    check(config(closed.to_string()), "does rosbridge_websocket run");
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let server = thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let mut asked = [0; 16];
        stream.read_exact(&mut asked).unwrap();
        stream.write_all(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n").unwrap();
        stream
    });
    check(config(address), "no websocket: ");
    drop(server.join().unwrap());
}
