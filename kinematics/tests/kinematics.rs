//! Where the joints bring the tool, and back.

use std::f64::consts::{FRAC_PI_2, TAU};

use glam::DVec3;
use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;
use tandem_core::{Stream, episode_rng};
use tandem_kinematics::inverse::MIN_MANIPULABILITY_M;
use tandem_kinematics::{
    ArmModel, ForwardKinematics, JACO_6, Joints, MICO_4, MICO_6, ReachError, ToolTarget,
};

const N_POSES: u32 = 100_000;

/// Angles anywhere in the joints' ranges.
fn random_angles(model: &ArmModel, rng: &mut ChaCha8Rng) -> Joints {
    Joints::from_fn(model.n_joints(), |joint| {
        let [low, high] = model.joints[joint].range_rad;
        rng.random_range(low..high)
    })
}

#[test]
fn four_joints_are_found_again_from_where_they_bring_the_tool() {
    let mut rng = episode_rng(1, 0, Stream::Reset);
    let (mut singular, mut worst_m, mut worst_rad) = (0, 0.0_f64, 0.0_f64);
    let mut branches = [0; 5];
    for _ in 0..N_POSES {
        let angles = random_angles(&MICO_4, &mut rng);
        let posture = ForwardKinematics::new(&MICO_4, &angles);
        let tool = posture.tool();
        // The level direction that is across the tool's y axis is the one whose nearest turn is this one.
        let across = tool.axes.y_axis.cross(DVec3::Z);
        let level = across * across.dot(tool.axes.x_axis).signum();
        let target = ToolTarget { at_m: tool.origin_m, yaw_rad: level.y.atan2(level.x) };
        let nearest = match MICO_4.nearest(&target, &angles) {
            Ok(nearest) => nearest,
            Err(ReachError::Singular { manipulability_m, .. }) => {
                assert!(manipulability_m < MIN_MANIPULABILITY_M);
                singular += 1;
                continue;
            }
            Err(error) => panic!("{angles:?}: {error}"),
        };
        if nearest.angles.largest_difference(&angles) > 1e-6 {
            // Another solution was taken because this posture is singular, or its fingers point anywhere.
            let level_m = across.length();
            let own = MICO_4.solutions(&target, &angles).unwrap();
            let listed = own.iter().any(|s| s.angles.largest_difference(&angles) < 1e-6);
            assert!(
                !listed && (level_m < 1e-6 || nearest.manipulability_m >= MIN_MANIPULABILITY_M)
            );
            singular += 1;
        } else {
            worst_rad = worst_rad.max(nearest.angles.largest_difference(&angles));
            assert!((nearest.tilt_rad - posture.tilt_rad()).abs() < 1e-6);
        }
        let solutions = MICO_4.solutions(&target, &angles).unwrap();
        branches[solutions.len()] += 1;
        for solution in solutions {
            let there = ForwardKinematics::new(&MICO_4, &solution.angles);
            worst_m = worst_m.max((there.tool().origin_m - target.at_m).length());
            assert!((there.tilt_rad() - solution.tilt_rad).abs() < 1e-12);
        }
    }
    println!(
        "four joints: {singular} singular, off by {worst_m:e} m and {worst_rad:e} rad, {branches:?}"
    );
    assert!(worst_m < 1e-9 && worst_rad < 1e-7 && singular < 10_000);
    assert!(
        branches[4] > 1000,
        "all four solutions are within the ranges now and then: {branches:?}"
    );
}

#[test]
fn six_joints_find_the_way_back_from_nearby() {
    for model in [&MICO_6, &JACO_6] {
        let mut rng = episode_rng(2, 0, Stream::Reset);
        let (mut failed, mut same) = (0, 0);
        for _ in 0..N_POSES {
            let angles = random_angles(model, &mut rng);
            let posture = ForwardKinematics::new(model, &angles);
            let tool = posture.tool();
            let near = Joints::from_fn(6, |joint| angles[joint] + rng.random_range(-0.1..0.1));
            let found = model.nearest_pose(tool.origin_m, &tool.axes, &near);
            let Ok(found) = found else {
                failed += 1;
                continue;
            };
            let there = ForwardKinematics::new(model, &found.angles);
            assert!((there.tool().origin_m - tool.origin_m).length() < 1e-8);
            assert!(there.tool().axes.abs_diff_eq(tool.axes, 1e-8));
            for (angle, joint) in found.angles.iter().zip(model.joints) {
                assert!((joint.range_rad[0]..=joint.range_rad[1]).contains(angle));
            }
            same += u32::from(found.angles.largest_difference(&angles) < 1e-5);
        }
        println!("{}: {failed} not found, {same} the same angles of {N_POSES}", model.name);
        assert!(failed < N_POSES / 50 && same > N_POSES / 10 * 8);
    }
}

#[test]
fn six_joints_point_down_where_the_training_worlds_arm_works() {
    let mut rng = episode_rng(3, 0, Stream::Reset);
    let near = Joints::new(JACO_6.elbow_up_rad);
    let mut singular = 0;
    for _ in 0..2000 {
        let mut within = |low: f64, high: f64| rng.random_range(low..high);
        let at_m = DVec3::new(within(0.2, 0.6), within(-0.25, 0.25), within(0.022, 0.35));
        let target = ToolTarget { at_m, yaw_rad: FRAC_PI_2 };
        let solution = match JACO_6.nearest(&target, &near) {
            Ok(solution) => solution,
            Err(ReachError::Singular { .. }) => {
                singular += 1;
                continue;
            }
            Err(error) => panic!("{at_m}: {error}"),
        };
        assert!(solution.tilt_rad < 1e-8);
        let tool = *ForwardKinematics::new(&JACO_6, &solution.angles).tool();
        assert!((tool.origin_m - at_m).length() < 1e-9);
        assert!((tool.axes.x_axis - DVec3::Y).length() < 1e-8);
    }
    println!("{singular} of 2000 singular");
    assert!(singular < 60, "a thin surface only: {singular}");
}

#[test]
fn the_simulated_arms_home_posture_is_the_same_by_this_table() {
    let home =
        [-0.208_556_86, 2.506_949_69, 5.075_284_33, 2.970_589_41, 0.665_106_14, -0.379_560_43];
    let posture = ForwardKinematics::new(&JACO_6, &Joints::new(&home));
    let off_m = (posture.tool().origin_m - DVec3::new(0.40, 0.0, 0.15)).length();
    assert!(off_m < 1e-3 && posture.tilt_rad() < 2e-3, "{off_m} m, {} rad", posture.tilt_rad());
}

#[test]
fn what_cannot_be_reached_is_told() {
    let check = |at: [f64; 3], expected: fn(&ReachError) -> bool| {
        let target = ToolTarget { at_m: DVec3::from(at), yaw_rad: 0.0 };
        let near = Joints::new(MICO_4.elbow_up_rad);
        let error = MICO_4.nearest(&target, &near).unwrap_err();
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
    let far = ToolTarget { at_m: DVec3::new(0.0, 1.0, 0.2), yaw_rad: 0.0 };
    let error = JACO_6.nearest(&far, &Joints::new(JACO_6.elbow_up_rad)).unwrap_err();
    assert!(matches!(error, ReachError::TooFar { .. }), "{error}");
    let below = ToolTarget { at_m: DVec3::new(0.65, 0.0, -0.3), yaw_rad: 0.0 };
    let error = MICO_6.nearest(&below, &Joints::new(MICO_6.elbow_up_rad)).unwrap_err();
    assert!(matches!(error, ReachError::TooFar { .. } | ReachError::Unsolved { .. }), "{error}");
}

#[test]
fn joints_take_the_shorter_way_round_within_their_soft_range() {
    let target = ToolTarget { at_m: DVec3::new(0.28, 0.05, 0.06), yaw_rad: FRAC_PI_2 };
    let here = MICO_4.nearest(&target, &Joints::new(MICO_4.elbow_up_rad)).unwrap().angles;
    for turns in [-0.95, -0.6, -0.4, 0.3, 0.7, 0.95] {
        let mut near = here;
        near[0] = turns * TAU;
        near[3] = -turns * TAU;
        let found = MICO_4.nearest(&target, &near).unwrap().angles;
        for joint in [0, 3] {
            let places = [-2.0, -1.0, 0.0, 1.0, 2.0].map(|turn| here[joint] + turn * TAU);
            let nearest = places
                .into_iter()
                .filter(|place| place.abs() <= TAU)
                .min_by(|a, b| (a - near[joint]).abs().total_cmp(&(b - near[joint]).abs()))
                .unwrap();
            let other = (found[1] - here[1]).abs() > 1e-6;
            assert!(other || (found[joint] - nearest).abs() < 1e-9, "{found:?} from {near:?}");
        }
        assert!(found.iter().zip(MICO_4.joints).all(|(q, joint)| q.abs() <= joint.range_rad[1]));
    }
}

#[test]
fn the_four_joint_arm_points_nearly_down_in_a_ring() {
    let tilt_deg = |radius_m: f64| {
        let target = ToolTarget { at_m: DVec3::new(radius_m, 0.0, 0.05), yaw_rad: FRAC_PI_2 };
        let near = Joints::new(MICO_4.elbow_up_rad);
        MICO_4.nearest(&target, &near).unwrap().tilt_rad.to_degrees()
    };
    for radius_m in [0.215, 0.25, 0.28, 0.31, 0.355] {
        assert!(tilt_deg(radius_m) < 15.5, "{radius_m}: {}", tilt_deg(radius_m));
    }
    for radius_m in [0.15, 0.19, 0.38, 0.45] {
        assert!(tilt_deg(radius_m) > 15.0, "{radius_m}: {}", tilt_deg(radius_m));
    }
}
