//! The simulated pair by itself.
#![expect(clippy::unwrap_used, reason = "a test panics where it fails")]

use tandem_bridge::work_cell::mico_cell;
use tandem_bridge::{ArmCommand, Command, Driver as _, DriverError, Order, PairState};
use tandem_core::{ArmIndex, Contacts};
use tandem_kinematics::Joints;
use tandem_trials::simulated::{Block, CameraConfig, PERIOD_S};
use tandem_trials::{SimulatedConfig, SimulatedPair};

const ARMS: [ArmIndex; 2] = [ArmIndex(0), ArmIndex(1)];

fn pair(config: SimulatedConfig) -> SimulatedPair {
    let cell = mico_cell();
    let at = cell.ready(0.06).unwrap();
    SimulatedPair::new(cell, &at, 1.0, config)
}

/// A command with the same joint velocities for both arms and closed grippers.
fn moving(number: u64, velocities: [f64; 4]) -> Command {
    let arm = ArmCommand { velocities: Joints::new(&velocities), opening: 0.0 };
    Command { number, order: Order::Move(vec![arm, arm]) }
}

fn quiet() -> SimulatedConfig {
    SimulatedConfig {
        angle_noise_rad: 0.0,
        rate_noise_radps: 0.0,
        torque_noise_nm: 0.0,
        ..SimulatedConfig::default()
    }
}

fn at_rest(pair: &SimulatedPair) -> bool {
    ARMS.iter().all(|arm| pair.velocities(*arm).iter().all(|rate| *rate == 0.0))
}

#[test]
fn the_same_seed_and_commands_give_the_same_bits() {
    let run = |seed| {
        let blocks = vec![Block::small([-0.12, 0.0])];
        let mut pair = pair(SimulatedConfig { seed, blocks, ..SimulatedConfig::default() });
        let exchange = |number| pair.exchange(&moving(number, [0.1, 0.05, -0.1, 0.2])).unwrap();
        let states: Vec<PairState> = (1..60).map(exchange).collect();
        (states, pair.objects(), pair.observed_objects().to_vec(), pair.scene())
    };
    assert_eq!(run(3), run(3));
    assert_ne!(run(3).0, run(4).0);
}

#[test]
fn drives_without_commands_brake_and_wait_for_a_stop() {
    let mut pair = pair(SimulatedConfig::default());
    for number in 1..=20 {
        pair.exchange(&moving(number, [0.3, 0.0, 0.0, 0.0])).unwrap();
    }
    let mut silent_s = PERIOD_S;
    while !at_rest(&pair) {
        assert!(silent_s < 0.1, "still moving");
        pair.skip_period();
        silent_s += PERIOD_S;
    }
    assert!(silent_s > 0.05, "they wait for 50 ms: {silent_s}");
    for number in 21..=30 {
        let state = pair.exchange(&moving(number, [0.3, 0.0, 0.0, 0.0])).unwrap();
        assert!(at_rest(&pair) && state.arms[0].faults.drive);
    }
    pair.exchange(&Command { number: 31, order: Order::Stop }).unwrap();
    for number in 32..=40 {
        pair.exchange(&moving(number, [0.3, 0.0, 0.0, 0.0])).unwrap();
    }
    assert!(!at_rest(&pair));
}

#[test]
fn commands_take_effect_late_and_speeds_follow_with_a_lag() {
    let mut pair = pair(quiet());
    let mut numbers = Vec::new();
    for number in 1..=30 {
        let state = pair.exchange(&moving(number, [0.3, 0.0, 0.0, 0.0])).unwrap();
        numbers.push(number - state.newest_command.unwrap());
        if number == 1 {
            assert!(at_rest(&pair), "no command takes effect at once");
        }
        if number == 3 {
            let rate = pair.velocities(ARMS[0])[0];
            assert!((0.05..0.29).contains(&rate), "{rate}");
        }
    }
    assert!(numbers.iter().all(|late| (1..=2).contains(late)), "{numbers:?}");
    assert!(numbers.contains(&1) && numbers.contains(&2));
    assert!((pair.velocities(ARMS[0])[0] - 0.3).abs() < 1e-3);
}

#[test]
fn an_arm_driven_into_the_table_stalls() {
    let mut pair = pair(quiet());
    let mut stalled_nm = 0.0_f64;
    // Joint 2 leans the arms towards the table.
    let before_m = pair.gaps().table_m[0];
    for number in 1..=200 {
        let state = pair.exchange(&moving(number, [0.0, -0.2, 0.0, 0.0])).unwrap();
        let torques = state.arms[0].torques_nm.unwrap();
        stalled_nm = torques.iter().fold(stalled_nm, |most, torque| most.max(torque.abs()));
    }
    assert!(pair.gaps().table_m[0] < before_m);
    assert!(pair.contacts().contains(Contacts::ARM_TABLE), "{:?}", pair.gaps());
    assert!(pair.gaps().table_m.iter().all(|gap_m| *gap_m > -0.002), "{:?}", pair.gaps());
    assert!(stalled_nm > 6.0, "{stalled_nm}");
}

#[test]
fn the_gripper_moves_at_its_own_speed() {
    let mut pair = pair(quiet());
    let mut openings = Vec::new();
    for number in 1..=140 {
        let state = pair.exchange(&moving(number, [0.0; 4])).unwrap();
        openings.push(state.arms[1].opening);
    }
    assert!(openings[0] > 0.97 && openings[139] < 0.03, "{openings:?}");
    assert!((0.4..0.6).contains(&openings[51]), "{}", openings[51]);
    assert!(openings.windows(2).all(|pair| pair[1] <= pair[0] + 0.01));
}

#[test]
fn cameras_have_latency_and_noise() {
    let camera = CameraConfig { latency_periods: 5, ..CameraConfig::default() };
    let blocks = vec![Block::small([-0.12, 0.1]), Block::large([0.12, 0.2])];
    let mut pair = pair(SimulatedConfig { blocks, camera, ..SimulatedConfig::default() });
    let (mut off_m, mut n) = (0.0, 0);
    for number in 1..=300 {
        pair.exchange(&moving(number, [0.0; 4])).unwrap();
        let late_s = pair.time_s() - pair.observed_objects()[0].time_s;
        if number > 10 {
            assert!((0.049..0.081).contains(&late_s), "{late_s}");
            let is = pair.objects();
            off_m += pair.observed_objects()[1].at_m.distance_squared(is[1].at_m);
            n += 1;
        }
    }
    let deviation_m = (off_m / f64::from(n) / 3.0).sqrt();
    assert!((0.0008..0.0012).contains(&deviation_m), "{deviation_m}");
}

#[test]
fn commands_for_other_arms_are_refused() {
    let mut pair = pair(quiet());
    let mut command = moving(1, [0.0; 4]);
    let Order::Move(arms) = &mut command.order else { unreachable!("a move") };
    arms.pop();
    assert_eq!(pair.exchange(&command), Err(DriverError::Shape { got: 1, expected: 2 }));
}
