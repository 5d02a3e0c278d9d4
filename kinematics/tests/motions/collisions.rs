//! The check on waypoints that lead an arm into an obstacle or too far from upright.

use std::f64::consts::FRAC_PI_2;

use nalgebra::Point3;
use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;
use tandem_core::{ArmIndex, Stream, episode_rng};
use tandem_kinematics::{
    ArmWaypoint, CheckSettings, ForwardKinematics, Joints, MICO_4, PlanSettings, Reason, Waypoint,
    WorkCell, check, plan,
};

use crate::refusals::{N_BROKEN, PERIOD_S};
use crate::walks::{Area, walk};

/// Plans waypoints changed by `change` and compares the time of the refusal with the time at which `margin` is
/// violated.
fn break_waypoints(
    name: &str,
    settings: &CheckSettings,
    change: impl Fn(&WorkCell, &mut Vec<Waypoint>, &mut ChaCha8Rng),
    (expected, tolerance): (fn(&Reason) -> bool, f64),
    margin: impl Fn(&WorkCell, &[Joints]) -> f64,
) {
    let cell = WorkCell::mico_pair();
    let start = cell.ready(0.15).unwrap();
    let mut rng = episode_rng(8, 0, Stream::Exploration);
    for seed in 0..N_BROKEN as u64 {
        let mut waypoints = walk(&cell, Area::FAR, seed % 50, 3);
        change(&cell, &mut waypoints, &mut rng);
        let trajectory = plan(&cell, &waypoints, &start, &PlanSettings::default());
        let trajectory = trajectory.unwrap_or_else(|error| panic!("{name} {seed}: {error}"));
        let motion = trajectory.sampled(1.0 / PERIOD_S);
        let at: Vec<Joints> = motion.arms.iter().map(|samples| samples[0].angles).collect();
        let refusal = check(&cell, &motion, &at, settings).expect_err(name);
        assert!(expected(&refusal.reason), "{name} {seed}: {refusal}");
        // The limit is first exceeded, and then exceeded by more than the tolerance, between these samples.
        let first = |slack: f64| {
            let passes = |idx: &usize| {
                let at: Vec<Joints> = motion.arms.iter().map(|s| s[*idx].angles).collect();
                margin(&cell, &at) < -slack
            };
            (0..motion.arms[0].len()).find(passes).unwrap() as f64 * PERIOD_S
        };
        let (from_s, to_s) = (first(0.0) - PERIOD_S, first(tolerance) + 1e-9);
        let in_time = (from_s..=to_s).contains(&refusal.when_s);
        assert!(in_time, "{name} {seed}: {refusal}, expected from {from_s} to {to_s} s");
    }
}

/// Appends `n` waypoints that lead the given arms from their present positions to points of their base frames.
fn lead(
    cell: &WorkCell,
    waypoints: &mut Vec<Waypoint>,
    goals_in_base: &[(usize, Point3<f64>)],
    n: u32,
) {
    let from = waypoints[waypoints.len() - 1].clone();
    for step in 1..=n {
        let mut next: Waypoint = from.clone();
        for (arm, goal_in_base) in goals_in_base {
            let goal = cell.arms[*arm].world_from_base() * goal_in_base;
            let share = f64::from(step) / f64::from(n);
            let tool_in_world_m = from[*arm].tool_in_world_m.lerp(&goal, share);
            next[*arm] = ArmWaypoint { tool_in_world_m, ..from[*arm] };
        }
        waypoints.push(next);
    }
}

#[test]
fn grippers_that_tilt_too_far_are_refused() {
    let tilt_rad = |at: &[Joints]| {
        at.iter().map(|q| ForwardKinematics::new(&MICO_4, q).tilt_rad()).fold(0.0, f64::max)
    };
    break_waypoints(
        "tilt",
        &CheckSettings::default(),
        |cell, waypoints, rng| {
            let side = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
            let direction = side * rng.random_range(1.0..FRAC_PI_2);
            let radius_m = rng.random_range(0.40..0.50);
            let height_m = rng.random_range(0.10..0.16);
            let goal =
                Point3::new(radius_m * direction.cos(), radius_m * direction.sin(), height_m);
            lead(cell, waypoints, &[(rng.random_range(0..2), goal)], 5);
        },
        (|reason| matches!(reason, Reason::Tilt(_)), 2e-3),
        |_, at| 25.0_f64.to_radians() - tilt_rad(at),
    );
}

#[test]
fn tools_that_are_led_into_the_table_are_refused() {
    break_waypoints(
        "table",
        &CheckSettings::default(),
        |cell, waypoints, rng| {
            let x_m = rng.random_range(0.24..0.32);
            let goal =
                Point3::new(x_m, rng.random_range(-0.06..0.06), rng.random_range(-0.02..0.044));
            lead(cell, waypoints, &[(rng.random_range(0..2), goal)], 4);
        },
        (|reason| matches!(reason, Reason::TableGap(..)), 2e-4),
        |cell, at| cell.gaps(at).table_m.into_iter().fold(f64::INFINITY, f64::min) - 0.002,
    );
}

#[test]
fn arms_that_are_led_into_each_other_are_refused() {
    break_waypoints(
        "arms",
        &CheckSettings::default(),
        |cell, waypoints, rng| {
            let (y_m, z_m) = (rng.random_range(-0.06..0.06), rng.random_range(0.06..0.14));
            let goal = |y_m: f64| Point3::new(0.345, y_m, z_m);
            let off_m = rng.random_range(-0.02..0.02);
            lead(cell, waypoints, &[(0, goal(y_m)), (1, goal(off_m - y_m))], 5);
        },
        (|reason| matches!(reason, Reason::ArmsGap(ArmIndex(1), ..)), 2e-4),
        |cell, at| cell.gaps(at).arms_m - 0.02,
    );
}

#[test]
fn tools_that_are_led_through_the_arms_own_base_are_refused() {
    // Grippers tilt near the base; a tight limit on the tilt would refuse the motion earlier.
    let settings = CheckSettings { tilt_rad: 1.5, ..CheckSettings::default() };
    break_waypoints(
        "own base",
        &settings,
        |cell, waypoints, rng| {
            let (x_m, y_m) = (rng.random_range(0.05..0.08), rng.random_range(-0.02..0.02));
            let goal = Point3::new(x_m, y_m, rng.random_range(0.07..0.09));
            lead(cell, waypoints, &[(rng.random_range(0..2), goal)], 5);
        },
        (|reason| matches!(reason, Reason::SelfGap(["base", _], _)), 2e-4),
        |cell, at| cell.gaps(at).self_m.into_iter().fold(f64::INFINITY, f64::min) - 0.005,
    );
}
