//! Formats the messages of a bridge as text and as JSON.

use serde_json::{Value, json};
use tandem_proto::pb;

/// Returns the name of a phase.
pub(super) fn phase(phase: pb::BridgePhase) -> &'static str {
    match phase {
        pb::BridgePhase::Unspecified => "unknown",
        pb::BridgePhase::Stopped => "stopped",
        pb::BridgePhase::Idle => "idle",
        pb::BridgePhase::Moving => "moving",
        pb::BridgePhase::Holding => "holding",
        pb::BridgePhase::Settling => "settling",
    }
}

pub(super) fn status_lines(status: &pb::BridgeStatusResponse) -> Vec<String> {
    let reason =
        status.stopped.as_ref().map_or_else(String::new, |stop| format!(": {}", stop.sentence));
    let rests = match (status.at_rest, status.arms.is_empty()) {
        (true, _) => "at rest",
        (false, false) => "moving",
        (false, true) => "their motion is unknown",
    };
    let owner = if status.is_owned {
        format!("a client, for another {:.1} s unless it renews its lease", status.lease_left_s)
    } else {
        "none".to_owned()
    };
    let mut lines = vec![
        format!("phase   {}{reason}", phase(status.phase())),
        format!("joints  {rests}"),
        format!("owner   {owner}"),
        format!(
            "clock   {:.2} s, last command {:.0} ms ago",
            status.now_s,
            1e3 * status.since_tick_s
        ),
    ];
    lines.extend(status.arms.iter().enumerate().flat_map(|(idx, arm)| arm_lines(idx, arm)));
    if status.arms.is_empty() {
        lines.push("arms    their position is not known".to_owned());
    }
    lines.extend(status.injected.iter().map(|fault| format!("drill   {}", injected(fault))));
    if let Some(motion) = &status.motion {
        let [played_s, duration_s] =
            clock_times_s([motion.played_s, motion.duration_s], motion.speed);
        let speed = motion.speed;
        lines.push(format!("motion  {played_s:.1} of {duration_s:.1} s, at speed {speed}"));
    }
    lines
}

/// Describes an injected fault, with the joint counted from 1.
pub(super) fn injected(fault: &pb::FaultInjection) -> String {
    use pb::InjectedFault as F;
    let name = fault_name(fault.fault());
    match fault.fault() {
        F::LateStates => name.to_owned(),
        F::BlockedJoint | F::Torque | F::Drift => {
            format!("{name}, arm {}, joint {}", fault.arm, fault.joint + 1)
        }
        F::Unspecified | F::EmergencyStop | F::DriveFault | F::Contact => {
            format!("{name}, arm {}", fault.arm)
        }
    }
}

const fn fault_name(fault: pb::InjectedFault) -> &'static str {
    use pb::InjectedFault as F;
    match fault {
        F::Unspecified => "unknown",
        F::EmergencyStop => "emergency-stop",
        F::DriveFault => "drive-fault",
        F::Contact => "contact",
        F::BlockedJoint => "blocked-joint",
        F::Torque => "torque",
        F::Drift => "drift",
        F::LateStates => "late-states",
    }
}

pub(super) fn injected_json(injected: &[pb::FaultInjection]) -> Value {
    let fault = |fault: &pb::FaultInjection| {
        json!({
            "fault": fault_name(fault.fault()), "arm": fault.arm, "joint": fault.joint,
        })
    };
    Value::Array(injected.iter().map(fault).collect())
}

/// Converts times of a motion at its own speed to seconds on the clock when it is played at `speed`.
pub(super) fn clock_times_s(own_times_s: [f64; 2], speed: f64) -> [f64; 2] {
    own_times_s.map(|time_s| if speed > 0.0 { time_s / speed } else { time_s })
}

fn arm_lines(idx: usize, arm: &pb::ArmState) -> [String; 2] {
    let degrees: Vec<String> =
        arm.angles_rad.iter().map(|angle| format!("{:.1}", angle.to_degrees())).collect();
    let joints = format!("arm {idx}   joints at {} degrees", degrees.join(" "));
    let mut line = format!(
        "        tool at {} m, gripper {:.0} % open",
        position(&arm.tool_in_world_m),
        100.0 * arm.opening
    );
    for (fault, what) in [
        (arm.drive_fault, "DRIVE FAULT"),
        (arm.contact, "CONTACT"),
        (arm.emergency_stop, "EMERGENCY STOP"),
    ] {
        if fault {
            line.push_str(", ");
            line.push_str(what);
        }
    }
    [joints, line]
}

/// Formats a position in metres, rounded to millimetres, without negative zeros.
fn position(metres: &[f64]) -> String {
    let rounded = metres.iter().map(|metres| (metres * 1e3).round() / 1e3 + 0.0);
    let numbers: Vec<String> = rounded.map(|metres| format!("{metres:.3}")).collect();
    numbers.join(" ")
}

pub(super) fn description_lines(description: &pb::DescribeBridgeResponse) -> Vec<String> {
    let mut lines = vec![format!(
        "driver  {}, version {}, a command every {:.0} ms",
        description.driver,
        description.version,
        1e3 * description.period_s
    )];
    for (idx, arm) in description.arms.iter().enumerate() {
        lines.push(format!(
            "arm {idx}   {}, {}, base at {} m, turned by {:.0} degrees",
            arm.name,
            arm.model,
            position(&arm.base_in_world_m),
            arm.yaw_rad.to_degrees()
        ));
        lines.extend(arm.joints.iter().enumerate().map(|(joint, limits)| {
            format!(
                "        joint {}: {:.0} to {:.0} degrees, {:.0} degrees/s",
                joint + 1,
                limits.low_rad.to_degrees(),
                limits.high_rad.to_degrees(),
                limits.speed_radps.to_degrees()
            )
        }));
    }
    for arm in &description.arms {
        lines.push(format!(
            "times   {}: lag {:.0} ms, reaction {:.0} ms, brake {:.0} ms{}",
            arm.name,
            1e3 * arm.lag_s,
            1e3 * arm.reaction_s,
            1e3 * arm.brake_s,
            if arm.is_measured { "" } else { " (not measured)" }
        ));
    }
    lines.push(format!("table   at a height of {:.3} m", description.table_z_m));
    if let Some(limits) = &description.limits {
        lines.extend(limit_lines(limits));
    }
    if !description.cell_file.is_empty() {
        lines.push(format!("cell    {}", description.cell_file));
    }
    lines
}

fn limit_lines(limits: &pb::BridgeLimits) -> Vec<String> {
    vec![
        format!(
            "speed   at most {} of a motion's own, tools at most {} m/s",
            limits.speed, limits.tool_speed_mps
        ),
        format!(
            "tilt    at most {:.0} degrees, reach at most {:.0} % of the arm's",
            limits.tilt_rad.to_degrees(),
            100.0 * limits.reach_share
        ),
        format!(
            "gaps    to the table, between the arms and within an arm, at least\n        \
             {:.0}, {:.0} and {:.0} mm (motions), {:.0}, {:.0} and {:.0} mm (envelope)",
            1e3 * limits.check_table_gap_m,
            1e3 * limits.check_arms_gap_m,
            1e3 * limits.check_self_gap_m,
            1e3 * limits.table_gap_m,
            1e3 * limits.arms_gap_m,
            1e3 * limits.self_gap_m
        ),
        format!(
            "owner   a motion pauses after {} s of silence and is stopped after {} s",
            limits.owner_hold_s, limits.owner_stop_s
        ),
    ]
}

pub(super) fn stop_json(stop: &pb::BridgeStop) -> Value {
    json!({
        "name": stop.name, "sentence": stop.sentence, "when_s": stop.when_s, "arm": stop.arm,
        "joint": stop.joint, "got": stop.got, "allowed": stop.allowed, "unit": stop.unit,
    })
}

pub(super) fn refusal_json(refusal: &pb::MotionRefusal) -> Value {
    json!({
        "name": refusal.name, "sentence": refusal.sentence, "when_s": refusal.when_s,
        "arm": refusal.arm, "joint": refusal.joint, "way_point": refusal.way_point,
        "got": refusal.got, "allowed": refusal.allowed, "unit": refusal.unit,
    })
}

pub(super) fn accepted_json(accepted: &pb::AcceptedMotion) -> Value {
    json!({
        "duration_s": accepted.duration_s, "speed": accepted.speed,
        "table_gap_m": accepted.table_gap_m, "arms_gap_m": accepted.arms_gap_m,
        "self_gap_m": accepted.self_gap_m,
    })
}

fn arm_json(arm: &pb::ArmState) -> Value {
    json!({
        "angles_rad": arm.angles_rad, "velocities_radps": arm.velocities_radps,
        "tool_in_world_m": arm.tool_in_world_m, "opening": arm.opening,
        "drive_fault": arm.drive_fault, "contact": arm.contact,
        "emergency_stop": arm.emergency_stop,
    })
}

pub(super) fn progress_json(progress: &pb::MotionProgress) -> Value {
    json!({
        "phase": phase(progress.phase()), "played_s": progress.played_s,
        "duration_s": progress.duration_s, "speed": progress.speed,
        "arms": progress.arms.iter().map(arm_json).collect::<Vec<_>>(),
    })
}

pub(super) fn status_json(status: &pb::BridgeStatusResponse) -> Value {
    let motion = status.motion.as_ref().map(|motion| {
        json!({
            "played_s": motion.played_s, "duration_s": motion.duration_s, "speed": motion.speed,
        })
    });
    json!({
        "phase": phase(status.phase()),
        "stopped": status.stopped.as_ref().map(stop_json),
        "is_owned": status.is_owned, "lease_left_s": status.lease_left_s,
        "at_rest": status.at_rest,
        "arms": status.arms.iter().map(arm_json).collect::<Vec<_>>(),
        "motion": motion, "now_s": status.now_s, "since_tick_s": status.since_tick_s,
        "injected": injected_json(&status.injected),
    })
}

pub(super) fn description_json(description: &pb::DescribeBridgeResponse) -> Value {
    let joint = |joint: &pb::JointDescription| {
        json!({
            "low_rad": joint.low_rad, "high_rad": joint.high_rad,
            "speed_radps": joint.speed_radps, "continuous": joint.continuous,
        })
    };
    let arm = |arm: &pb::ArmDescription| {
        json!({
            "name": arm.name, "model": arm.model, "base_in_world_m": arm.base_in_world_m,
            "yaw_rad": arm.yaw_rad, "lag_s": arm.lag_s, "reaction_s": arm.reaction_s,
            "brake_s": arm.brake_s, "is_measured": arm.is_measured,
            "joints": arm.joints.iter().map(joint).collect::<Vec<_>>(),
        })
    };
    let frame = description.task_frame.as_ref().map(
        |frame| json!({"scale": frame.scale, "centre_m": frame.centre_m, "lift_m": frame.lift_m}),
    );
    json!({
        "driver": description.driver, "version": description.version, "period_s": description.period_s,
        "arms": description.arms.iter().map(arm).collect::<Vec<_>>(), "table_z_m": description.table_z_m,
        "cell_file": description.cell_file, "task_frame": frame, "limits": description.limits.as_ref().map(limits_json),
    })
}

fn limits_json(limits: &pb::BridgeLimits) -> Value {
    json!({
        "speed": limits.speed, "tool_speed_mps": limits.tool_speed_mps, "ramp_s": limits.ramp_s,
        "opening_per_s": limits.opening_per_s, "tilt_rad": limits.tilt_rad,
        "reach_share": limits.reach_share, "check_table_gap_m": limits.check_table_gap_m,
        "check_arms_gap_m": limits.check_arms_gap_m, "table_gap_m": limits.table_gap_m,
        "arms_gap_m": limits.arms_gap_m, "range_margin_rad": limits.range_margin_rad,
        "start_rad": limits.start_rad, "duration_s": limits.duration_s,
        "tracking_rad": limits.tracking_rad, "torque_nm": limits.torque_nm,
        "owner_hold_s": limits.owner_hold_s, "owner_stop_s": limits.owner_stop_s,
        "lease_s": limits.lease_s, "max_way_points": limits.max_way_points,
        "max_step_m": limits.max_step_m,
        "check_self_gap_m": limits.check_self_gap_m, "self_gap_m": limits.self_gap_m,
        "lag_s": limits.lag_s, "reaction_s": limits.reaction_s, "brake_s": limits.brake_s,
    })
}
