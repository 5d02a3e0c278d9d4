//! The driver for kinova-ros when the arms' side, the connection or the bridge fails.

use std::io::{Read as _, Write as _};
use std::net::TcpListener;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use tandem_bridge::kinova_ros::{KinovaRosConfig, KinovaRosDriver};
use tandem_bridge::{
    ArmCommand, Command, Driver as _, DriverError, Order, Phase, ResetError, StartError, StopCause,
};
use tandem_kinematics::Joints;

use crate::drivers::kinova::{STEADY, Test, assert_stayed, connected};
use crate::drivers::kinova_side::{Fault, Side};
use crate::drivers::rig::{
    OWNER, angles, assert_ended, at_rest, eventually, failure, pair_at, sweep,
};

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
        assert!(matches!(reset, Err(ResetError::Driver(_))), "{reset:?}");
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

/// Rosbridge discards what it has not processed when a connection closes.
#[test]
fn a_connection_closes_after_the_nodes_have_answered_the_stop() {
    let side = Side::new(&pair_at(&sweep(STEADY)));
    let mut driver = connected(&side);
    side.begin(Fault::Complains);
    let is_over = AtomicBool::new(false);
    let stopped = thread::scope(|scope| {
        scope.spawn(|| {
            while !is_over.load(Ordering::SeqCst) {
                thread::sleep(Duration::from_millis(5));
                side.pass();
            }
        });
        eventually("the driver fails", || driver.listen(Duration::from_millis(20)).is_err());
        let stopped = side.ros().nodes.each_ref().map(|node| node.stopped);
        is_over.store(true, Ordering::SeqCst);
        stopped
    });
    assert_eq!(stopped, [true; 2]);
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
        for _ in 0..110 {
            test.rig.tick();
        }
        assert!(test.rig.executor.exchange_error().is_some());
        eventually("the connection ends, so that another one can take its place", || {
            test.side.pass();
            !test.side.ros().connected()
        });
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
        // Only the first stop is reported. Resets show that the connection has ended.
        eventually("the connection has ended", || {
            test.rig.tick();
            let reset = test.rig.executor.reset(OWNER, test.rig.now_s);
            matches!(reset, Err(ResetError::Driver(_)))
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
