//! Motion files: JSON, written by hand or by `tandem bridge trial --motions`.

use std::path::Path;

use serde::Deserialize;
use serde_json::{Value, json};
use tandem_kinematics::plan::MAX_WAYPOINTS;
use tandem_kinematics::{ArmWaypoint, Waypoint};
use tandem_proto::pb;
use tandem_system::atomic_file;

use crate::exit::{Exit, Failed, OrExit as _};
use crate::input;

/// Default time between waypoints, as in the training world, seconds.
const STEP_S: f64 = 0.04;

/// The contents of a motion file; unknown keys are rejected.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct MotionFile {
    /// Fraction of the motion's own speed, in (0, 1]; the command line can give it instead.
    speed: Option<f64>,
    /// Positions of the tools; each waypoint has one entry per arm.
    way_points: Option<Vec<Vec<FileWaypoint>>>,
    /// True if the path begins at the current positions of the tools; only with waypoints. The default is true.
    from_here: Option<bool>,
    /// Minimum time per waypoint, seconds; only with waypoints. The default is 0.04.
    step_s: Option<f64>,
    /// Samples of the joints, instead of waypoints.
    joint_motion: Option<FileJointMotion>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileWaypoint {
    /// Position of the tool in the world: x, y, z, metres.
    tool_m: [f64; 3],
    /// Opening of the gripper, 0 to 1.
    opening: f64,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileJointMotion {
    /// Time between two samples, seconds.
    period_s: f64,
    /// Samples of each arm.
    arms: Vec<Vec<FileSample>>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileSample {
    angles_rad: Vec<f64>,
    velocities_radps: Vec<f64>,
    opening: f64,
}

/// Returns why a bridge would refuse a motion of `n_waypoints` that [`write()`] writes, or `None` if it would not.
pub(super) fn refusal(n_waypoints: usize) -> Option<String> {
    // Such a motion begins at the current positions of the tools.
    let n_most = MAX_WAYPOINTS - 1;
    (n_waypoints > n_most)
        .then(|| format!("a motion file has at most {n_most} waypoints, this motion {n_waypoints}"))
}

/// Writes a motion file with `waypoints` and `speed`.
pub(super) fn write(path: &Path, speed: f64, waypoints: &[Waypoint]) -> Result<(), Failed> {
    let arm = |arm: &ArmWaypoint| {
        let round = |number: f64| (number * 1e5).round() * 1e-5;
        let tool_m = <[f64; 3]>::from(arm.tool_in_world_m).map(round);
        json!({ "tool_m": tool_m, "opening": round(arm.gripper_opening) })
    };
    let waypoints: Vec<Vec<Value>> =
        waypoints.iter().map(|arms| arms.iter().map(arm).collect()).collect();
    let text = json!({ "speed": speed, "way_points": waypoints }).to_string();
    let written = atomic_file::replace(path, (text + "\n").as_bytes());
    written.or_cannot_write(|| format!("cannot write {}", path.display()))
}

/// Reads the motion file `path`; `speed` overrides the speed in the file.
pub(super) fn read(path: &Path, speed: Option<f64>) -> Result<pb::MotionRequest, Failed> {
    let cannot_read = || format!("cannot read {path:?}");
    let text = input::text(path).or_exit(Exit::Data, cannot_read)?;
    let not_a_motion = || format!("{path:?} does not hold a motion");
    let file: MotionFile = serde_json::from_str(&text).or_exit(Exit::Data, not_a_motion)?;
    let no_speed = || anyhow::anyhow!("it has no speed: add \"speed\": 1.0, or give --speed");
    let speed = speed.or(file.speed).ok_or_else(no_speed).or_exit(Exit::Data, not_a_motion)?;
    let motion = motion(file).map_err(|what| anyhow::anyhow!(what));
    let motion = motion.or_exit(Exit::Data, not_a_motion)?;
    Ok(pb::MotionRequest { motion: Some(motion), speed })
}

fn motion(file: MotionFile) -> Result<pb::motion_request::Motion, &'static str> {
    use pb::motion_request::Motion as M;
    match (file.way_points, file.joint_motion) {
        (Some(waypoints), None) => {
            let way_points = waypoints.into_iter().map(waypoint).collect();
            let step_s = file.step_s.unwrap_or(STEP_S);
            let from_here = file.from_here.unwrap_or(true);
            Ok(M::WayPoints(pb::WayPoints { way_points, step_s, from_here }))
        }
        (None, Some(_)) if file.from_here.is_some() || file.step_s.is_some() => {
            Err("from_here and step_s belong to way_points only")
        }
        (None, Some(joints)) => {
            let arms = joints.arms.into_iter().map(samples).collect();
            Ok(M::JointMotion(pb::JointMotion { period_s: joints.period_s, arms }))
        }
        _ => Err("it needs either way_points or joint_motion"),
    }
}

fn waypoint(arms: Vec<FileWaypoint>) -> pb::BridgeWayPoint {
    let arm = |arm: FileWaypoint| pb::ArmWayPoint {
        tool_in_world_m: arm.tool_m.to_vec(),
        opening: arm.opening,
    };
    pb::BridgeWayPoint { arms: arms.into_iter().map(arm).collect() }
}

fn samples(samples: Vec<FileSample>) -> pb::ArmMotion {
    let sample = |sample: FileSample| pb::JointSample {
        angles_rad: sample.angles_rad,
        velocities_radps: sample.velocities_radps,
        opening: sample.opening,
    };
    pb::ArmMotion { samples: samples.into_iter().map(sample).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> Result<pb::motion_request::Motion, String> {
        let file = serde_json::from_str(text).map_err(|error| error.to_string())?;
        motion(file).map_err(str::to_owned)
    }

    #[test]
    fn a_motion_has_room_for_the_current_positions() {
        assert_eq!(refusal(999), None);
        let refused = refusal(1000).unwrap();
        assert!(refused.contains("at most 999 waypoints, this motion 1000"), "{refused}");
    }

    #[test]
    fn a_file_contains_either_way_points_or_joint_samples() {
        let places = r#"[[{"tool_m": [0, 0, 0.1], "opening": 1}]]"#;
        let whole = parsed(&format!(r#"{{"speed": 1, "way_points": {places}}}"#)).unwrap();
        let pb::motion_request::Motion::WayPoints(way) = whole else { panic!("{whole:?}") };
        assert!(way.from_here && way.way_points[0].arms[0].tool_in_world_m[2] > 0.09);
        let joints = r#"{"period_s": 0.01, "arms": []}"#;
        assert!(parsed(&format!(r#"{{"speed": 1, "joint_motion": {joints}}}"#)).is_ok());
        for (text, expected) in [
            (r#"{"speed": 1}"#.to_owned(), "either way_points or joint_motion"),
            (
                format!(r#"{{"speed": 1, "way_points": {places}, "joint_motion": {joints}}}"#),
                "either",
            ),
            (
                format!(r#"{{"speed": 1, "way_points": {places}, "sped": 2}}"#),
                "unknown field `sped`",
            ),
            (
                format!(r#"{{"speed": 1, "joint_motion": {joints}, "from_here": true}}"#),
                "belong to way_points",
            ),
        ] {
            let refused = parsed(&text).unwrap_err();
            assert!(refused.contains(expected), "{text}: {refused}");
        }
    }
}
