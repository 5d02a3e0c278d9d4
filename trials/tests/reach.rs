//! The closed form of the Mico's reach, which the simulator's shared world uses, agrees with the arm's kinematics.

use glam::DVec3;
use tandem_bridge::work_cell::check_settings;
use tandem_core::World;
use tandem_kinematics::{
    ForwardKinematics, Joints, MICO_4, PADS_AHEAD_M, PlacedArm, TaskFrame, ToolTarget, WorkCell,
};
use tandem_sim::reach::Reach;

/// Iterations that find the tool's position for a point between the pads.
const TILT_ROUNDS: usize = 6;
/// The end effector's range along x and y, arm frame, metres.
const WORKSPACE_M: [[f64; 2]; 2] = [[-0.06, 0.27], [-0.22, 0.22]];
/// The range of its heights above the table, metres.
const HEIGHTS_M: [f64; 2] = [0.031, 0.33];

/// A Mico that is placed as in the work cell of the shared world.
fn cell() -> WorkCell {
    let centre_m = f64::from(World::Shared.mico_base_distance_m());
    let arm =
        PlacedArm { model: &MICO_4, base_in_world_m: [-centre_m, 0.0, 0.0].into(), yaw_rad: 0.0 };
    WorkCell {
        arms: vec![arm],
        table_z_m: 0.0,
        task_frame: TaskFrame { scale: 1.0, centre_m, lift_m: 0.0 },
    }
}

/// The joint angles and the tilt (radians) with the point between the pads at `pads`, arm frame, metres.
fn reached(cell: &WorkCell, pads: DVec3) -> Option<(Joints, f64)> {
    let arm = &cell.arms[0];
    let mut angles = Joints::new(MICO_4.elbow_up_rad);
    let mut tool = pads + DVec3::Z * PADS_AHEAD_M;
    let mut tilt_rad = 0.0;
    for _ in 0..TILT_ROUNDS {
        let ToolTarget { position_m, yaw_rad } = arm.target(&tool.into());
        let target = ToolTarget { position_m, yaw_rad };
        let solution =
            MICO_4.inverse_kinematics(&target, &Joints::new(MICO_4.elbow_up_rad)).ok()?;
        (angles, tilt_rad) = (solution.angles, solution.tilt_rad);
        let pointing = ForwardKinematics::new(&MICO_4, &angles).pointing();
        tool = pads - DVec3::from(arm.world_from_base() * pointing) * PADS_AHEAD_M;
    }
    Some((angles, tilt_rad))
}

/// Calls `look` with a height and an azimuth about the base, on a grid.
fn each_direction(mut look: impl FnMut(f64, f64)) {
    for level in 0..=24 {
        let height_m = HEIGHTS_M[0] + (HEIGHTS_M[1] - HEIGHTS_M[0]) * f64::from(level) / 24.0;
        for azimuth in -5..=5 {
            look(height_m, 0.2 * f64::from(azimuth));
        }
    }
}

/// Returns the least and the largest radius of the closed form at `height_m`, metres.
#[expect(clippy::cast_possible_truncation, reason = "the simulator computes in single precision")]
fn radii_m(height_m: f64) -> [f64; 2] {
    Reach::MICO.radii_m(height_m as f32).map(f64::from)
}

#[test]
fn the_mico_reaches_what_the_closed_form_contains() {
    let (cell, settings) = (cell(), check_settings());
    let base_m = f64::from(World::Shared.mico_base_distance_m());
    let (mut most_rad, mut least_self_m, mut n_points) = (0.0_f64, f64::INFINITY, 0);
    each_direction(|height_m, azimuth| {
        let [near_m, far_m] = radii_m(height_m);
        for step in 0..=30 {
            let radius_m = near_m + (far_m - near_m) * f64::from(step) / 30.0;
            let [x, y] = [radius_m * azimuth.cos() - base_m, radius_m * azimuth.sin()];
            let is_inside = |value: f64, [low, high]: [f64; 2]| (low..=high).contains(&value);
            if !is_inside(x, WORKSPACE_M[0]) || !is_inside(y, WORKSPACE_M[1]) {
                continue;
            }
            let at = DVec3::new(x, y, height_m);
            let (angles, tilt_rad) =
                reached(&cell, at).unwrap_or_else(|| panic!("{at}: out of reach"));
            let gaps = cell.gaps(&[angles]);
            let degrees = tilt_rad.to_degrees();
            assert!(tilt_rad <= settings.tilt_rad, "{at}: tilted by {degrees} degrees");
            assert!(gaps.self_m[0] >= settings.self_gap_m, "{at}: {} m", gaps.self_m[0]);
            most_rad = most_rad.max(tilt_rad);
            least_self_m = least_self_m.min(gaps.self_m[0]);
            n_points += 1;
        }
    });
    println!(
        "{n_points} points, tilt at most {:.1} degrees, gap within the arm at least {least_self_m:.3} m",
        most_rad.to_degrees()
    );
    assert!(n_points > 3000, "{n_points}");
}

#[test]
fn the_closed_form_leaves_out_little_of_the_reach() {
    let (cell, settings) = (cell(), check_settings());
    let base_m = f64::from(World::Shared.mico_base_distance_m());
    each_direction(|height_m, azimuth| {
        let [_, far_m] = radii_m(height_m);
        let radius_m = far_m + 0.05;
        let at = DVec3::new(radius_m * azimuth.cos() - base_m, radius_m * azimuth.sin(), height_m);
        let is_reached = reached(&cell, at).is_some_and(|(_, tilt)| tilt <= settings.tilt_rad);
        assert!(!is_reached, "{at} is in reach, 5 cm beyond the closed form");
    });
}
