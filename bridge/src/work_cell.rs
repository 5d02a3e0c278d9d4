//! The placement of the arms and the limits of their motions.
//!
//! Lengths are not scaled: a metre of the training world is a metre here. The bases are 0.27 m behind the centres of
//! their workspaces (0.22 m in the shared world), where the gripper of the Mico with four joints tilts least. Measured
//! for 0.27 m on points drawn uniformly from the tasks' area (example `area` of `tandem-kinematics`):
//!
//! | share of points with a tilt of at most | 15° | 25° | 40° |
//! |---|---|---|---|
//! | low above the table | 64 % | 98 % | 100 % |
//! | up to the highest goal, of which 98 % are reached | 42 % | 71 % | 95 % |
//!
//! Motions may therefore tilt the gripper by up to 45 degrees.

use tandem_core::World;
use tandem_kinematics::{CheckSettings, TaskFrame, WorkCell};

/// Returns the work cell of two Micos with four joints that face each other, with a task frame of scale 1.
#[must_use]
pub fn mico_cell() -> WorkCell {
    mico_cell_of(World::Classic)
}

/// As [`mico_cell`], with the bases as far behind the centres of their workspaces as the tasks of `world` require.
#[must_use]
pub fn mico_cell_of(world: World) -> WorkCell {
    // The distance is a whole number of millimetres, in single precision.
    let centre_m = (f64::from(world.mico_base_distance_m()) * 1e3).round() / 1e3;
    WorkCell::mico_pair_with(TaskFrame { scale: 1.0, centre_m, ..TaskFrame::MICO_4 })
}

/// Returns the limits of the check before a motion: a tilt of at most 45 degrees, 4 mm above the table, 20 mm between
/// arms, 5 mm between parts of one arm.
///
/// The gaps are larger than those of the envelope during the motion (1, 12 and 2 mm), so that the stopping paths of a
/// motion along these limits keep the envelope's limits.
#[must_use]
pub fn check_settings() -> CheckSettings {
    CheckSettings {
        tilt_rad: 45.0_f64.to_radians(),
        table_gap_m: 0.004,
        arms_gap_m: 0.020,
        ..CheckSettings::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bases_are_as_far_behind_the_workspaces_as_the_world_requires() {
        for (world, behind_m) in
            [(World::Classic, 0.27), (World::Slow, 0.27), (World::Shared, 0.22)]
        {
            let cell = mico_cell_of(world);
            assert_eq!(cell.task_frame.centre_m, behind_m, "{world}");
            let centres_apart_m = 0.24;
            let expected_m = -(0.5 * centres_apart_m + behind_m);
            assert!((cell.arms[0].base_in_world_m.x - expected_m).abs() < 1e-6);
            assert_eq!(cell.arms[1].base_in_world_m.x, -cell.arms[0].base_in_world_m.x);
        }
    }
}
