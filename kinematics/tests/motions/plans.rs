//! Trajectories: limits, path and timing.

use nalgebra::Point3;
use tandem_core::ArmIndex;
use tandem_kinematics::trajectory::DEFAULT_RATE_HZ;
use tandem_kinematics::{
    ArmState, ArmWaypoint, CheckSettings, ForwardKinematics, Joints, Limits, PlanError,
    PlanSettings, Trajectory, Waypoint, WorkCell, check, plan,
};

use crate::walks::{Area, planned, walk};

/// Returns equidistant times of a trajectory, seconds.
fn times_s(trajectory: &Trajectory, n: u32) -> impl Iterator<Item = f64> {
    let duration_s = trajectory.duration_s();
    (0..=n).map(move |idx| duration_s * f64::from(idx) / f64::from(n))
}

/// Returns the largest used share of any limit.
fn used_share(cell: &WorkCell, states: &[ArmState]) -> f64 {
    let limits = Limits::default();
    let mut used = 0.0_f64;
    for (arm, state) in cell.arms.iter().zip(states) {
        let forward = ForwardKinematics::new(arm.model, &state.angles);
        let tool_mps = forward.tool_velocity(&state.velocities).norm();
        used = used.max(tool_mps / limits.tool_speed_mps);
        used = used.max(state.gripper_opening_per_s.abs() / limits.gripper_opening_per_s);
        assert!((0.0..=1.0).contains(&state.gripper_opening));
        for (idx, joint) in arm.model.joints.iter().enumerate() {
            let acceleration = joint.speed_radps / limits.ramp_s;
            used = used.max(state.velocities[idx].abs() / joint.speed_radps);
            used = used.max(state.accelerations[idx].abs() / acceleration);
        }
    }
    used
}

fn tool_in_world(cell: &WorkCell, arm: usize, angles: &Joints) -> Point3<f64> {
    let placed = &cell.arms[arm];
    placed.world_from_base() * ForwardKinematics::new(placed.model, angles).tool_m()
}

#[test]
fn every_limit_holds_at_every_time() {
    let cell = WorkCell::mico_pair();
    let mut fullest = 0.0_f64;
    for seed in 0..20 {
        let trajectory =
            planned(&cell, &walk(&cell, Area::TASKS, seed, 50), &PlanSettings::default());
        let mut busy = 0_u32;
        for time_s in times_s(&trajectory, 20_000) {
            let used = used_share(&cell, &trajectory.at(time_s));
            fullest = fullest.max(used);
            busy += u32::from(used > 0.5);
        }
        assert!(fullest <= 0.98 + 1e-9, "seed {seed}: {fullest} of a limit");
        assert!(busy > 14_000, "seed {seed}: some limit is half used {busy} times only");
    }
    println!("at most {fullest} of a limit");
}

#[test]
fn positions_are_once_differentiable_and_rest_at_both_ends() {
    let cell = WorkCell::mico_pair();
    let trajectory = planned(&cell, &walk(&cell, Area::TASKS, 3, 50), &PlanSettings::default());
    let step_s = 1e-5;
    for time_s in times_s(&trajectory, 30_000).filter(|t| *t > step_s) {
        let [before, here, after] =
            [time_s - step_s, time_s, time_s + step_s].map(|time_s| trajectory.at(time_s));
        if time_s + step_s > trajectory.duration_s() {
            continue;
        }
        for ((before, here), after) in before.iter().zip(&here).zip(&after) {
            for joint in 0..4 {
                let slope = (after.angles[joint] - before.angles[joint]) / (2.0 * step_s);
                assert!((slope - here.velocities[joint]).abs() < 1e-4, "at {time_s} s");
                let change = (after.velocities[joint] - before.velocities[joint]).abs();
                assert!(change < 3.5 * 2.0 * step_s, "a jump of {change} rad/s at {time_s} s");
            }
        }
    }
    for time_s in [-1.0, 0.0, trajectory.duration_s(), trajectory.duration_s() + 1.0] {
        for state in trajectory.at(time_s) {
            assert!(state.velocities.iter().all(|rate| rate.abs() < 1e-9), "{state:?}");
        }
    }
}

#[test]
fn the_tool_follows_the_lines_between_waypoints_to_two_and_a_half_millimetres() {
    let cell = WorkCell::mico_pair();
    let (mut farthest_m, mut from_corner_m) = (0.0_f64, 0.0_f64);
    for seed in 0..20 {
        let waypoints = walk(&cell, Area::TASKS, seed, 50);
        let trajectory = planned(&cell, &waypoints, &PlanSettings::default());
        for (idx, waypoint) in waypoints.iter().enumerate() {
            let states = trajectory.at(trajectory.waypoint_s(idx));
            for (arm, state) in states.iter().enumerate() {
                let tool_m = tool_in_world(&cell, arm, &state.angles);
                let off_m = (tool_m - waypoint[arm].tool_in_world_m).norm();
                from_corner_m = from_corner_m.max(off_m);
                let ends = idx == 0 || idx == 49;
                assert!(!ends || off_m < 1e-9, "the ends are exact: {off_m}");
            }
        }
        for idx in 0..49 {
            let (from_s, to_s) = (trajectory.waypoint_s(idx), trajectory.waypoint_s(idx + 1));
            for share in 0..=40 {
                let time_s = from_s + (to_s - from_s) * f64::from(share) / 40.0;
                for (arm, state) in trajectory.at(time_s).iter().enumerate() {
                    let tool_m = tool_in_world(&cell, arm, &state.angles);
                    let near = idx.saturating_sub(1)..(idx + 2).min(49);
                    let off_m = near
                        .map(|idx| [idx, idx + 1].map(|idx| waypoints[idx][arm].tool_in_world_m))
                        .map(|ends| distance_to_segment_m(tool_m, ends))
                        .fold(f64::INFINITY, f64::min);
                    farthest_m = farthest_m.max(off_m);
                }
            }
        }
    }
    println!("{farthest_m} m from the lines, {from_corner_m} m from a corner");
    assert!(farthest_m < 0.0025 && from_corner_m < 0.0025);
}

fn distance_to_segment_m(point: Point3<f64>, [from, to]: [Point3<f64>; 2]) -> f64 {
    let along = to - from;
    let share = (point - from).dot(&along) / along.norm_squared().max(1e-12);
    (from + along * share.clamp(0.0, 1.0) - point).norm()
}

#[test]
fn a_straight_line_uses_some_limit_almost_fully() {
    let cell = WorkCell::mico_pair();
    let (from, to) = (Point3::new(-0.12, -0.1, 0.02), Point3::new(0.10, 0.1, 0.38));
    let waypoints: Vec<Waypoint> =
        line(&cell, from, to, 9).into_iter().map(|at| with_opening(at, 1.0)).collect();
    let settings = PlanSettings::default();
    let trajectory = planned(&cell, &waypoints, &settings);
    for time_s in times_s(&trajectory, 1000).skip(250).take(500) {
        let used = used_share(&cell, &trajectory.at(time_s));
        assert!(used > 0.85, "{used} of a limit at {time_s} s");
    }
    let slow = planned(&cell, &waypoints, &PlanSettings { speed: 0.25, ..settings });
    assert!((slow.duration_s() - 4.0 * trajectory.duration_s()).abs() < 1e-9);
    for time_s in times_s(&trajectory, 100) {
        let (fast, slow) = (trajectory.at(time_s), slow.at(4.0 * time_s));
        for (fast, slow) in fast.iter().zip(&slow) {
            assert!(fast.angles.largest_difference(&slow.angles) < 1e-9);
            assert!((fast.velocities[1] - 4.0 * slow.velocities[1]).abs() < 1e-9);
        }
    }
}

/// Returns waypoints of both arms on a line in the arm frames. The grippers are closed from the middle on.
fn line(cell: &WorkCell, from: Point3<f64>, to: Point3<f64>, n: u32) -> Vec<Waypoint> {
    let at = |idx: u32| {
        let share = f64::from(idx) / f64::from(n - 1);
        let waypoint = |arm| ArmWaypoint {
            tool_in_world_m: cell.world_from_arm(ArmIndex(arm), &from.lerp(&to, share)),
            gripper_opening: f64::from(u32::from(2 * idx < n)),
        };
        (0..cell.arms.len()).map(waypoint).collect()
    };
    (0..n).map(at).collect()
}

fn with_opening(mut at: Waypoint, opening: f64) -> Waypoint {
    at.iter_mut().for_each(|arm| arm.gripper_opening = opening);
    at
}

#[test]
fn a_resting_hand_waits_until_its_gripper_has_closed() {
    let cell = WorkCell::mico_pair();
    let at = Point3::new(0.0, 0.0, 0.1);
    let trajectory = planned(&cell, &line(&cell, at, at, 5), &PlanSettings::default());
    // Closing at 0.8/s takes 1.25 s; four steps without any motion take 0.16 s.
    assert!((1.25..1.7).contains(&trajectory.duration_s()), "{}", trajectory.duration_s());
    let open = vec![line(&cell, at, at, 2)[0].clone(); 5];
    let waiting = planned(&cell, &open, &PlanSettings::default());
    assert!((0.16..0.24).contains(&waiting.duration_s()), "{}", waiting.duration_s());
}

#[test]
fn arms_and_grippers_stay_synchronized() {
    let cell = WorkCell::mico_pair();
    let waypoints = walk(&cell, Area::TASKS, 8, 50);
    let trajectory = planned(&cell, &waypoints, &PlanSettings::default());
    for (idx, waypoint) in waypoints.iter().enumerate() {
        let states = trajectory.at(trajectory.waypoint_s(idx));
        assert!((states[0].gripper_opening - states[1].gripper_opening).abs() < 1e-12);
        let settled = waypoints[idx.saturating_sub(1)..(idx + 2).min(50)]
            .iter()
            .all(|near| near[0].gripper_opening == waypoint[0].gripper_opening);
        assert!(!settled || (states[0].gripper_opening - waypoint[0].gripper_opening).abs() < 1e-9);
    }
}

#[test]
fn samples_are_the_trajectory_at_equidistant_times() {
    let cell = WorkCell::mico_pair();
    let trajectory = planned(&cell, &walk(&cell, Area::TASKS, 5, 20), &PlanSettings::default());
    let motion = trajectory.sampled(DEFAULT_RATE_HZ);
    let n_samples = motion.arms[0].len() as f64;
    assert!((n_samples - 1.0) * 0.01 >= trajectory.duration_s());
    assert!((n_samples - 2.0) * 0.01 < trajectory.duration_s());
    let states = trajectory.at(0.37);
    for (samples, state) in motion.arms.iter().zip(states) {
        assert_eq!(samples[37].angles, state.angles);
        assert_eq!(samples[37].velocities, state.velocities);
    }
}

#[test]
fn the_same_waypoints_give_the_same_bits() {
    let cell = WorkCell::mico_pair();
    let motion = |seed| {
        planned(&cell, &walk(&cell, Area::TASKS, seed, 50), &PlanSettings::default()).sampled(100.0)
    };
    assert_eq!(motion(4), motion(4));
    assert_ne!(motion(4), motion(5));
}

#[test]
fn invalid_waypoints_and_settings_are_refused() {
    let cell = WorkCell::mico_pair();
    let start = cell.ready(0.15).unwrap();
    let good = walk(&cell, Area::TASKS, 1, 10);
    let check = |change: &dyn Fn(&mut Vec<Waypoint>), expected: fn(&PlanError) -> bool| {
        let mut waypoints = good.clone();
        change(&mut waypoints);
        let error = plan(&cell, &waypoints, &start, &PlanSettings::default()).unwrap_err();
        assert!(expected(&error), "{error}");
    };
    let refusal = |start: &[Joints]| {
        plan(&cell, &good, start, &PlanSettings::default()).unwrap_err().to_string()
    };
    assert_eq!(refusal(&start[..1]), "the start has 1 arms, the cell has 2");
    let short = [start[0], Joints::new(&start[1][..3])];
    assert_eq!(refusal(&short), "the start of arm 1 has 3 joints, the arm has 4");
    check(&|points| points.truncate(1), |e| matches!(e, PlanError::WaypointCount { got: 1 }));
    check(&|points| points[4].truncate(1), |e| {
        matches!(e, PlanError::Arms { waypoint: 4, got: 1, expected: 2 })
    });
    check(&|points| points[4][1].gripper_opening = 1.01, |e| {
        matches!(e, PlanError::GripperOpening { waypoint: 4, arm: ArmIndex(1), .. })
    });
    check(&|points| points[4][1].gripper_opening = f64::NAN, |e| {
        matches!(e, PlanError::GripperOpening { .. })
    });
    check(&|points| points[4][0].tool_in_world_m.y = f64::NAN, |e| {
        matches!(e, PlanError::Step { waypoint: 4, arm: ArmIndex(0), .. })
    });
    check(&|points| points[0][0].tool_in_world_m.y = f64::NAN, |e| {
        matches!(e, PlanError::Step { waypoint: 0, .. })
    });
    check(&|points| points[4][0].tool_in_world_m.x += 0.5, |e| {
        matches!(e, PlanError::Step { waypoint: 4, .. })
    });
    let out = |points: &mut Vec<Waypoint>| {
        for (idx, point) in points.iter_mut().enumerate() {
            point[1].tool_in_world_m = Point3::new(0.12, 0.1 * idx as f64, 0.1);
        }
    };
    check(&out, |e| matches!(e, PlanError::Unreachable { waypoint: 6 | 5, arm: ArmIndex(1), .. }));
    for settings in [
        PlanSettings { speed: 0.0, ..PlanSettings::default() },
        PlanSettings { speed: 1.1, ..PlanSettings::default() },
        PlanSettings { piece_m: f64::NAN, ..PlanSettings::default() },
        PlanSettings { step_s: -0.04, ..PlanSettings::default() },
        PlanSettings {
            limits: Limits { ramp_s: 0.0, ..Limits::default() },
            ..PlanSettings::default()
        },
    ] {
        let error = plan(&cell, &good, &start, &settings).unwrap_err();
        assert!(matches!(error, PlanError::Setting { .. }), "{error}");
    }
}

#[test]
fn a_line_over_the_base_is_refused() {
    let cell = WorkCell::mico_pair();
    let placed = &cell.arms[0];
    // A line through the vertical axis of the base, where joint 1 would have to jump.
    let at = |x_m: f64| {
        let tool_in_world_m = placed.world_from_base() * Point3::new(x_m, 0.0, 0.75);
        vec![ArmWaypoint { tool_in_world_m, gripper_opening: 1.0 }]
    };
    let alone = WorkCell { arms: vec![*placed], ..cell.clone() };
    let waypoints: Vec<Waypoint> = [0.2, 0.1, 0.0, -0.1].map(at).to_vec();
    let seed = Joints::new(placed.model.elbow_up_rad);
    let target = placed.target(&waypoints[0][0].tool_in_world_m);
    let start = placed.model.inverse_kinematics(&target, &seed).unwrap().angles;
    let error = plan(&alone, &waypoints, &[start], &PlanSettings::default()).unwrap_err();
    assert!(matches!(error, PlanError::Unreachable { .. } | PlanError::Jump { .. }), "{error}");
}

#[test]
fn a_plan_passes_the_check_at_other_rates_too() {
    let cell = WorkCell::mico_pair();
    for seed in 0..10 {
        let trajectory =
            planned(&cell, &walk(&cell, Area::TASKS, seed, 50), &PlanSettings::default());
        let at: Vec<Joints> = trajectory.at(0.0).iter().map(|state| state.angles).collect();
        for rate_hz in [50.0, 90.0, 500.0] {
            let passed = check(&cell, &trajectory.sampled(rate_hz), &at, &CheckSettings::default());
            assert_eq!(passed, Ok(()), "walk {seed} at {rate_hz} Hz");
        }
    }
}
