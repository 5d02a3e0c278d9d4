//! Forward and inverse kinematics agree.

use std::f64::consts::{FRAC_PI_2, TAU};

use nalgebra::{Point3, Vector3};
use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;
use tandem_core::{Stream, episode_rng};
use tandem_kinematics::inverse::MIN_MANIPULABILITY_M;
use tandem_kinematics::{ForwardKinematics, Joints, MICO_4, ReachError, ToolTarget};

const N_CONFIGURATIONS: u32 = 100_000;

/// Angles drawn uniformly from the joints' ranges.
fn random_angles(rng: &mut ChaCha8Rng) -> Joints {
    Joints::from_fn(MICO_4.n_joints(), |joint| {
        let [low, high] = MICO_4.joints[joint].range_rad;
        rng.random_range(low..high)
    })
}

#[test]
fn inverse_kinematics_inverts_forward_kinematics() {
    let mut rng = episode_rng(1, 0, Stream::Reset);
    let (mut singular, mut worst_m, mut worst_rad) = (0, 0.0_f64, 0.0_f64);
    let mut branches = [0; 5];
    for _ in 0..N_CONFIGURATIONS {
        let angles = random_angles(&mut rng);
        let forward = ForwardKinematics::new(&MICO_4, &angles);
        // The horizontal direction across the tool's y axis is the one that joint 4 reaches at its present angle.
        let [x, y] = [Vector3::x(), Vector3::y()].map(|axis| forward.tool().rotation * axis);
        let across = y.cross(&Vector3::z());
        let level = across * across.dot(&x).signum();
        let target = ToolTarget { position_m: forward.tool_m(), yaw_rad: level.y.atan2(level.x) };
        let nearest = match MICO_4.inverse_kinematics(&target, &angles) {
            Ok(nearest) => nearest,
            Err(ReachError::Singular { manipulability_m }) => {
                assert!(manipulability_m < MIN_MANIPULABILITY_M);
                singular += 1;
                continue;
            }
            Err(error) => panic!("{angles:?}: {error}"),
        };
        let solutions = MICO_4.solutions(&target, &angles).unwrap();
        if nearest.angles.largest_difference(&angles) > 1e-6 {
            // Another solution was taken: this configuration is singular, or the direction of its fingers is undefined.
            let listed = solutions.iter().any(|s| s.angles.largest_difference(&angles) < 1e-6);
            let defined = across.norm() >= 1e-6;
            assert!(!listed && (!defined || nearest.manipulability_m >= MIN_MANIPULABILITY_M));
            singular += 1;
        } else {
            worst_rad = worst_rad.max(nearest.angles.largest_difference(&angles));
            assert!((nearest.tilt_rad - forward.tilt_rad()).abs() < 1e-6);
        }
        branches[solutions.len()] += 1;
        for solution in solutions {
            let there = ForwardKinematics::new(&MICO_4, &solution.angles);
            worst_m = worst_m.max((there.tool_m() - target.position_m).norm());
            assert!((there.tilt_rad() - solution.tilt_rad).abs() < 1e-12);
        }
    }
    println!("{singular} singular, off by {worst_m:e} m and {worst_rad:e} rad, {branches:?}");
    assert!(worst_m < 1e-9 && worst_rad < 1e-7 && singular < 10_000);
    assert!(branches[4] > 1000, "all four solutions are within the ranges at times: {branches:?}");
}

#[test]
fn unreachable_targets_are_errors_that_name_the_reason() {
    let check = |at: [f64; 3], expected: fn(&ReachError) -> bool| {
        let target = ToolTarget { position_m: Point3::from(at), yaw_rad: 0.0 };
        let seed = Joints::new(MICO_4.elbow_up_rad);
        let error = MICO_4.inverse_kinematics(&target, &seed).unwrap_err();
        assert!(expected(&error), "{at:?}: {error}");
        assert!(!error.to_string().is_empty());
    };
    check([0.6, 0.0, 0.1], |error| matches!(error, ReachError::TooFar { .. }));
    check([0.003, 0.0, 0.5], |error| matches!(error, ReachError::TooNear { .. }));
    check([0.008, 0.0, 0.2755], |error| matches!(error, ReachError::TooNear { .. }));
    check([0.10, 0.0, 0.2755], |error| matches!(error, ReachError::JointRange { joint: 2, .. }));
    check([0.5725, 0.0, 0.2755], |error| matches!(error, ReachError::Singular { .. }));
    check([0.010, 0.0, 0.6], |error| matches!(error, ReachError::Singular { .. }));
    check([f64::NAN, 0.0, 0.1], |error| matches!(error, ReachError::NotFinite));
    check([1e300, 0.0, 0.1], |error| matches!(error, ReachError::TooFar { .. }));
}

#[test]
fn continuous_joints_take_the_shorter_way_round_within_their_range() {
    let target = ToolTarget { position_m: Point3::new(0.28, 0.05, 0.06), yaw_rad: FRAC_PI_2 };
    let elbow_up = Joints::new(MICO_4.elbow_up_rad);
    let here = MICO_4.inverse_kinematics(&target, &elbow_up).unwrap().angles;
    for turns in [-0.95, -0.6, -0.4, 0.3, 0.7, 0.95] {
        let mut seed = here;
        seed[0] = turns * TAU;
        seed[3] = -turns * TAU;
        let found = MICO_4.inverse_kinematics(&target, &seed).unwrap().angles;
        for joint in [0, 3] {
            let equivalent = [-2.0, -1.0, 0.0, 1.0, 2.0].map(|turn| here[joint] + turn * TAU);
            let nearest = equivalent
                .into_iter()
                .filter(|angle| angle.abs() <= TAU)
                .min_by(|a, b| (a - seed[joint]).abs().total_cmp(&(b - seed[joint]).abs()))
                .unwrap();
            let other_branch = (found[1] - here[1]).abs() > 1e-6;
            let is_nearest = (found[joint] - nearest).abs() < 1e-9;
            assert!(other_branch || is_nearest, "{found:?} from {seed:?}");
        }
        assert!(found.iter().zip(MICO_4.joints).all(|(q, joint)| q.abs() <= joint.range_rad[1]));
    }
}

#[test]
fn the_gripper_points_nearly_down_in_a_ring() {
    let tilt_deg = |radius_m: f64| {
        let position_m = Point3::new(radius_m, 0.0, 0.05);
        let target = ToolTarget { position_m, yaw_rad: FRAC_PI_2 };
        let seed = Joints::new(MICO_4.elbow_up_rad);
        MICO_4.inverse_kinematics(&target, &seed).unwrap().tilt_rad.to_degrees()
    };
    for radius_m in [0.215, 0.25, 0.28, 0.31, 0.355] {
        assert!(tilt_deg(radius_m) < 15.5, "{radius_m}: {}", tilt_deg(radius_m));
    }
    for radius_m in [0.15, 0.19, 0.38, 0.45] {
        assert!(tilt_deg(radius_m) > 15.0, "{radius_m}: {}", tilt_deg(radius_m));
    }
}
