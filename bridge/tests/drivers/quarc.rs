//! The driver for QUARC.

use std::cell::Cell;
use std::io::Write as _;
use std::net::{Shutdown, TcpListener, TcpStream};
use std::rc::Rc;
use std::thread;
use std::time::Duration;

use tandem_bridge::quarc::codec::{encode_state, to_bytes};
use tandem_bridge::quarc::{QuarcConfig, QuarcDriver};
use tandem_bridge::{
    ArmCommand, Command, Driver as _, DriverError, Order, PairState, Phase, ResetError, Settings,
    StartError, StopCause,
};
use tandem_kinematics::{Joints, Motion};

use crate::drivers::quarc_side::{Fault, Side};
use crate::drivers::rig::{
    Listen, OWNER, Patient, Rig, angles, assert_ended, at_rest, eventually, failure, pair_at, sweep,
};

const OPENINGS: [f64; 4] = [0.8, 0.8, 0.4, 0.4];

impl Listen for QuarcDriver {
    fn listen(&mut self, patience: Duration) -> Result<PairState, DriverError> {
        Self::listen(self, patience)
    }
}

struct Test {
    side: Side,
    rig: Rig<Patient<QuarcDriver>>,
    waits: Rc<Cell<bool>>,
    motion: Motion,
}

fn connected(side: &Side) -> QuarcDriver {
    QuarcDriver::connect(QuarcConfig::at(format!("tcpip://{}", side.address))).unwrap()
}

impl Test {
    fn new() -> Self {
        let motion = sweep(OPENINGS);
        let side = Side::new(&pair_at(&motion));
        let driver = connected(&side);
        Self::with(side, driver, motion)
    }

    fn with(side: Side, driver: QuarcDriver, motion: Motion) -> Self {
        let waits = Rc::new(Cell::new(true));
        let rig = Rig::new(Patient::new(driver, &waits, || {}), Settings::default());
        Self { side, rig, waits, motion }
    }

    /// Arms in the middle of the motion.
    fn moving() -> Self {
        let mut test = Self::new();
        test.set_off();
        test
    }

    fn set_off(&mut self) {
        self.rig.reset();
        self.rig.start(&self.motion);
        for _ in 0..60 {
            assert_eq!(self.rig.tick(), Phase::Moving, "{:?}", self.rig.executor.stopped_by());
        }
        assert!(!at_rest(&self.side.pair));
    }

    /// Asserts that the connection ends and the motion stops.
    fn assert_ends(mut self, expected: &str) {
        let cause = self.rig.until_stopped();
        let error = failure(&cause).to_string();
        assert!(error.contains(expected), "{error}");
        eventually("the side sees the end", || self.side.n_ended() == 1);
        assert!(at_rest(&self.side.pair), "{expected}");
        let rested = angles(&self.side.pair);
        for _ in 0..20 {
            assert_eq!(self.rig.tick(), Phase::Stopped);
        }
        // The first stop is kept, and a reset fails: this driver cannot be used again.
        assert_eq!(self.rig.executor.stopped_by().unwrap().cause, cause);
        let reset = self.rig.executor.reset(OWNER, self.rig.now_s);
        assert!(matches!(reset, Err(ResetError::Driver(_))), "{reset:?}");
        assert_eq!(angles(&self.side.pair), rested);
    }
}

#[test]
fn a_motion_is_played_to_its_end() {
    let mut test = Test::new();
    test.rig.reset();
    test.rig.start(&test.motion);
    let n_ticks = test.rig.play();
    assert_ended(&test.side.pair, &test.motion);
    let commands = test.side.commands.lock().unwrap();
    // One command per tick, numbered without gaps, and only stops before the first motion.
    let numbers: Vec<u64> = commands.iter().map(|command| command.number).collect();
    assert!(numbers.iter().zip(1..).all(|(got, expected)| *got == expected), "{numbers:?}");
    assert_eq!(commands.iter().filter(|command| command.order == Order::Stop).count(), 15);
    assert_eq!(commands.len(), 16 + n_ticks);
    let opening = test.rig.executor.state().unwrap().arms[1].opening;
    assert!((opening - 0.4).abs() < 0.02, "{opening}");
}

#[test]
fn vectors_in_pieces_or_two_at_once_are_accepted() {
    let mut test = Test::new();
    test.side.begin(Fault::Split);
    test.rig.reset();
    test.rig.start(&test.motion);
    for _ in 0..60 {
        assert_eq!(test.rig.tick(), Phase::Moving, "{:?}", test.rig.executor.stopped_by());
    }
    test.side.end();
    test.rig.play();
    assert_ended(&test.side.pair, &test.motion);

    test.side.begin(Fault::Twice);
    for _ in 0..5 {
        let before = test.rig.executor.state().unwrap().clone();
        test.rig.tick();
        let state = test.rig.executor.state().unwrap();
        assert_eq!(state.sequence, before.sequence + 1);
        assert!((state.stamp_s - before.stamp_s - 0.02).abs() < 1e-9, "not the newest");
    }
}

#[test]
fn a_malformed_state_ends_the_connection_and_stops_the_arms() {
    let ends = |fault: Fault, expected: &str| {
        let test = Test::moving();
        test.side.begin(fault);
        test.assert_ends(expected);
    };
    ends(Fault::Number(5, f64::NAN), "number 5 of the vector is NaN");
    ends(Fault::Number(3, -7.0), "newest command's number is -7");
    ends(Fault::Number(35, 4.0), "the drive fault is 4, expected 0 or 1");
    ends(Fault::Number(0, 0.0), "a vector begins with 0");
    ends(Fault::Jump, "comes after");
    ends(Fault::Close, "closed the connection");
}

#[test]
fn vectors_of_another_length_end_the_connection_and_stop_the_arms() {
    let ends = |fault: Fault, expected: &str| {
        let side = Side::new(&pair_at(&sweep(OPENINGS)));
        let mut driver = connected(&side);
        driver.exchange(&Command { number: 1, order: Order::Stop }).unwrap();
        let arm = ArmCommand { velocities: Joints::from_fn(4, |_| 0.1), opening: 0.5 };
        let slow = |number| Command { number, order: Order::Move(vec![arm; 2]) };
        for number in 2..12 {
            driver.exchange(&slow(number)).unwrap();
        }
        side.begin(fault);
        let error = (12..5000).find_map(|number| driver.exchange(&slow(number)).err()).unwrap();
        assert!(error.to_string().contains(expected), "{error}");
        eventually("the side sees the end", || side.n_ended() == 1);
        assert!(at_rest(&side.pair), "{expected}");
    };
    ends(Fault::Short, "a vector of 100 bytes instead of 304");
    ends(Fault::Narrow, "the emergency stop is 20002, expected 0 or 1");
}

#[test]
fn arms_that_fall_silent_are_stopped() {
    let mut test = Test::moving();
    test.side.begin(Fault::Mute);
    test.waits.set(false);
    let cause = test.rig.until_stopped();
    assert!(matches!(cause, StopCause::StateStale(_)), "{cause}");
    // The connection still works: the stop command arrives.
    eventually("the arms rest", || {
        test.rig.tick();
        at_rest(&test.side.pair)
    });
    assert_eq!(test.side.n_ended(), 0);
}

#[test]
fn stopped_arms_move_again_over_the_same_connection_after_a_reset() {
    let mut test = Test::moving();
    let n_commands = test.side.commands.lock().unwrap().len();
    test.rig.executor.stop(test.rig.now_s);
    // The stop command was sent between two ticks.
    eventually("the stop arrives", || test.side.commands.lock().unwrap().len() == n_commands + 1);
    for _ in 0..10 {
        assert_eq!(test.rig.tick(), Phase::Stopped);
    }
    assert!(at_rest(&test.side.pair));
    let rested = angles(&test.side.pair);
    test.rig.reset();
    for _ in 0..20 {
        assert_eq!(test.rig.tick(), Phase::Idle);
    }
    for (rested, angles) in rested.iter().zip(angles(&test.side.pair)) {
        assert!(rested.largest_difference(&angles) < 1e-3);
    }
}

#[test]
fn arms_brake_by_themselves_when_the_bridge_is_killed() {
    let motion = sweep(OPENINGS);
    let side = Side::new(&pair_at(&motion));
    let stream = TcpStream::connect(side.address).unwrap();
    let socket = stream.try_clone().unwrap();
    let config = QuarcConfig::at(side.address.to_string());
    let driver = QuarcDriver::over(stream, config).unwrap();
    let mut test = Test::with(side, driver, motion);
    test.set_off();
    // A killed process sends nothing, but its socket is closed.
    std::mem::forget(test.rig);
    socket.shutdown(Shutdown::Both).unwrap();
    eventually("the side sees the end", || test.side.n_ended() == 1);
    assert!(at_rest(&test.side.pair));
    assert!(matches!(
        test.side.commands.lock().unwrap().last(),
        Some(Command { order: Order::Move(_), .. })
    ));
}

#[test]
fn arms_brake_by_themselves_when_the_bridge_hangs() {
    let test = Test::moving();
    for _ in 0..10 {
        test.side.pair.lock().unwrap().skip_period();
    }
    assert!(at_rest(&test.side.pair));
}

#[test]
fn a_dropped_executor_leaves_arms_at_rest() {
    let Test { side, rig, .. } = Test::moving();
    drop(rig);
    eventually("the side sees the end", || side.n_ended() == 1);
    assert!(at_rest(&side.pair));
    assert_eq!(side.commands.lock().unwrap().last().unwrap().order, Order::Stop);
}

#[test]
fn nothing_moves_over_a_new_connection_before_a_reset() {
    let mut test = Test::moving();
    test.side.begin(Fault::Close);
    test.rig.until_stopped();
    eventually("the side sees the end", || test.side.n_ended() == 1);
    test.side.end();
    let rested = angles(&test.side.pair);

    let Test { side, motion, .. } = test;
    let driver = connected(&side);
    let mut test = Test::with(side, driver, motion);
    for _ in 0..30 {
        assert_eq!(test.rig.tick(), Phase::Stopped);
        assert!(matches!(test.rig.executor.stopped_by().unwrap().cause, StopCause::NotReset));
        let started = test.rig.executor.start(OWNER, test.motion.clone(), 1.0, test.rig.now_s);
        assert_eq!(started, Err(StartError::NotIdle(Phase::Stopped)));
        assert_eq!(angles(&test.side.pair), rested);
    }
    test.rig.reset();
    assert_eq!(test.rig.tick(), Phase::Idle);
}

#[test]
fn a_connection_has_to_start_with_a_stop() {
    let motion = sweep(OPENINGS);
    let side = Side::new(&pair_at(&motion));
    let mut driver = connected(&side);
    let before = angles(&side.pair);
    let arm = ArmCommand { velocities: Joints::from_fn(4, |_| 0.3), opening: 0.5 };
    let command = Command { number: 1, order: Order::Move(vec![arm; 2]) };
    let refused = driver.exchange(&command).unwrap_err();
    assert!(matches!(refused, DriverError::Refused { .. }), "{refused}");
    eventually("the side sees the end", || side.n_ended() == 1);
    assert_eq!(angles(&side.pair), before);
    assert_eq!(driver.exchange(&command).unwrap_err(), refused);
    assert_eq!(driver.stop().unwrap_err(), refused);
}

#[test]
fn commands_do_not_accumulate_if_the_arms_do_not_read() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let config = QuarcConfig {
        wait: Duration::ZERO,
        ..QuarcConfig::at(listener.local_addr().unwrap().to_string())
    };
    let state = pair_at(&sweep(OPENINGS)).lock().unwrap().skip_period();
    let server = thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        stream.write_all(&to_bytes(&encode_state(&state).unwrap())).unwrap();
        stream
    });
    let mut driver = QuarcDriver::connect(config).unwrap();
    let _unread = server.join().unwrap();
    let stop = |number| Command { number, order: Order::Stop };
    let error = (1..10_000_000).find_map(|number| driver.exchange(&stop(number)).err());
    assert!(error.unwrap().to_string().contains("no longer accept commands"));
    assert!(driver.stop().is_err());
}

#[test]
fn a_connection_without_states_suggests_what_to_check() {
    let check = |sends: Vec<u8>, expected: &str| {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let config = QuarcConfig {
            connect_timeout: Duration::from_millis(300),
            ..QuarcConfig::at(listener.local_addr().unwrap().to_string())
        };
        let server = thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            stream.write_all(&sends).unwrap();
            stream
        });
        let error = QuarcDriver::connect(config).unwrap_err().to_string();
        drop(server.join().unwrap());
        assert!(error.contains(expected), "{error}");
    };
    check(vec![], "sent 0 bytes, a state has 304");
    let state = pair_at(&sweep(OPENINGS)).lock().unwrap().skip_period();
    let vector = encode_state(&state).unwrap();
    check(to_bytes(&vector)[..296].to_vec(), "sent 296 bytes, a state has 304");
    let big_endian = vector.iter().flat_map(|number| number.to_be_bytes()).collect();
    check(big_endian, "set the stream block's byte order to little-endian");
    check(b"HTTP/1.1 400 Bad Request\r\n".repeat(20), "a vector begins with");

    let closed = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let error = QuarcDriver::connect(QuarcConfig::at(closed.to_string())).unwrap_err();
    assert!(error.to_string().contains("is the model running"), "{error}");
    let error = QuarcDriver::connect(QuarcConfig::at("nowhere")).unwrap_err();
    assert!(error.to_string().contains("\"nowhere\""), "{error}");
    let slow = QuarcConfig { wait: Duration::from_millis(10), ..QuarcConfig::at("nowhere:1") };
    assert!(matches!(QuarcDriver::connect(slow), Err(DriverError::Refused { .. })));
}
