//! From snapshots of a bridge to the views that logs and displays use.

use tandem_bridge::injection::Injector;
use tandem_bridge::service::{MotionInfo, Snapshot};
use tandem_bridge::{ArmReading, Phase, Progress};
use tandem_kinematics::{Gaps, Joints, WorkCell};
use tandem_telemetry::{ArmView, ArmsPhase, ArmsView, MotionView, StopView};

use crate::clock;

/// Returns the view of `snapshot` in `cell` with the present faults of `injector`.
pub(super) fn of(snapshot: &Snapshot, cell: &WorkCell, injector: Option<&Injector>) -> ArmsView {
    let injected = injector.map(Injector::faults).unwrap_or_default();
    let gaps = snapshot.gaps(cell);
    let motion = snapshot.motion.as_deref().zip(snapshot.progress);
    let stop = snapshot.stopped.as_ref().map(|stop| StopView {
        name: snapshot.stop_name().unwrap_or_default().to_owned(),
        sentence: stop.to_string(),
        time_s: stop.when_s,
    });
    ArmsView {
        time_s: snapshot.now_s,
        unix_ms: clock::unix_millis(),
        phase: phase(snapshot.phase),
        motion: motion.map(|(motion, progress)| motion_view(motion, progress)),
        n_motions: snapshot.n_motions,
        stop,
        stop_error: snapshot.stop_error.as_ref().map(ToString::to_string),
        injected: injected.iter().map(ToString::to_string).collect(),
        is_connected: !snapshot.exchange_failed,
        lease_left_s: snapshot.lease_left_s,
        at_rest: snapshot.at_rest,
        arms: gaps.as_ref().map(|gaps| arms(snapshot, cell, gaps)).unwrap_or_default(),
        arms_gap_m: gaps.map(|gaps| gaps.arms_m).filter(|gap_m| gap_m.is_finite()),
        scene: snapshot.scene(cell),
    }
}

fn motion_view(motion: &MotionInfo, progress: Progress) -> MotionView {
    MotionView {
        name: motion.name.clone(),
        client: motion.client.clone(),
        speed: motion.speed,
        played_s: progress.played_s,
        duration_s: motion.duration_s,
    }
}

/// Returns the arms; none without a valid state.
fn arms(snapshot: &Snapshot, cell: &WorkCell, gaps: &Gaps) -> Vec<ArmView> {
    let Some(state) = &snapshot.state else { return Vec::new() };
    let (tools, planned_tools) = (snapshot.tools(cell), snapshot.planned_tools(cell));
    let planned = |arm: usize| snapshot.reference.as_ref().and_then(|all| all.get(arm));
    let arm = |(idx, reading): (usize, &ArmReading)| ArmView {
        angles_rad: reading.angles.to_vec(),
        velocities_radps: reading.velocities.to_vec(),
        torques_nm: joints(reading.torques_nm.as_ref()),
        planned_rad: joints(planned(idx)),
        tool_m: tools.get(idx).copied().unwrap_or_default(),
        planned_tool_m: planned_tools.get(idx).copied(),
        opening: reading.opening,
        table_gap_m: gaps.table_m.get(idx).copied().unwrap_or(f64::NAN),
        self_gap_m: gaps.self_m.get(idx).copied().unwrap_or(f64::NAN),
        drive_fault: reading.faults.drive,
        contact: reading.faults.contact,
        emergency_stop: reading.faults.emergency_stop,
    };
    state.arms.iter().enumerate().map(arm).collect()
}

fn joints(values: Option<&Joints>) -> Vec<f64> {
    values.map_or_else(Vec::new, |values| values.to_vec())
}

const fn phase(phase: Phase) -> ArmsPhase {
    match phase {
        Phase::Stopped => ArmsPhase::Stopped,
        Phase::Idle => ArmsPhase::Idle,
        Phase::Moving => ArmsPhase::Moving,
        Phase::Holding => ArmsPhase::Holding,
        Phase::Settling => ArmsPhase::Settling,
    }
}
