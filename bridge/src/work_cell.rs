//! The placement of the arms and the limits of their motions.
//!
//! Lengths are not scaled: a metre of the training world is a metre here. The bases are 0.27 m behind the centres of
//! their workspaces, where the gripper of the Mico with four joints tilts least. Measured on points drawn uniformly
//! from the tasks' area (example `area` of `tandem-kinematics`):
//!
//! | share of points with a tilt of at most | 15° | 25° | 40° |
//! |---|---|---|---|
//! | low above the table | 64 % | 98 % | 100 % |
//! | up to the highest goal, of which 98 % are reached | 42 % | 71 % | 95 % |
//!
//! Motions may therefore tilt the gripper by up to 45 degrees.

use tandem_kinematics::{CheckSettings, TaskFrame, WorkCell};

/// Returns the work cell of two Micos with four joints that face each other, with a task frame of scale 1.
#[must_use]
pub fn mico_cell() -> WorkCell {
    let half = WorkCell::mico_pair();
    WorkCell { task_frame: TaskFrame { scale: 1.0, ..TaskFrame::MICO_4 }, ..half }
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
