//! How the arms stand, and what their motions have to keep.
//!
//! Objects are not scaled: a metre of the training world is a metre here. The bases stand 0.27 m behind the
//! centres of their workspaces, where the Mico with four joints points down best. Of points of the tasks' area, drawn evenly,
//! its gripper then tilts by at most 15, 25 and 40 degrees: 64, 98 and 100 per cent low above the table, 42, 71 and
//! 95 per cent up to the highest goal, of which 98 per cent are reached (example `area` of `tandem-kinematics`). Motions may
//! therefore tilt the gripper by up to 45 degrees.

use tandem_kinematics::{CheckSettings, TaskFrame, WorkCell};

/// Two Micos with four joints that face each other, for objects of their true size.
#[must_use]
pub fn mico_cell() -> WorkCell {
    let half = WorkCell::mico_pair();
    WorkCell { task_frame: TaskFrame { scale: 1.0, ..TaskFrame::MICO_4 }, ..half }
}

/// What a motion has to keep before it may start: tilt up to 45 degrees, 4 mm above the table, 20 mm between arms, 5 mm
/// between parts of one arm.
///
/// The gaps are larger than those that the envelope keeps while the arms move (1, 12 and 2 mm), so that a motion
/// along the limit is not stopped for what its stopping way would have been.
#[must_use]
pub fn check_settings() -> CheckSettings {
    CheckSettings {
        tilt_rad: 45.0_f64.to_radians(),
        table_gap_m: 0.004,
        arms_gap_m: 0.020,
        ..CheckSettings::default()
    }
}
