//! The state of the arms of a bridge as messages of its channels, for logs and viewers.

use foxglove::messages::{
    FrameTransform, FrameTransforms, JointState, JointStates, Log, SceneUpdate, Timestamp,
};

use crate::arms_view::{ArmView, ArmsEvents, ArmsView, MotionView};
use crate::log_file::{log_line, timestamp};
use crate::messages::pb;
use crate::scene::{Trails, frame_transforms, tool_frame};

pub(crate) const SCENE: &str = "/scene";
pub(crate) const TF: &str = "/tf";
pub(crate) const MEASURED: &str = "/joint_states";
pub(crate) const PLANNED: &str = "/planned/joint_states";
pub(crate) const ARMS: &str = "/arms";
pub(crate) const LOG: &str = "/log";

/// A message of one of the channels.
#[derive(Debug, Clone)]
pub(crate) enum ArmsMessage {
    Scene(SceneUpdate),
    Tf(FrameTransforms),
    Measured(JointStates),
    Planned(JointStates),
    Arms(pb::ArmsState),
    Log(Log),
}

/// The content of a state's messages: the shapes of the arms take most of the space.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Detail {
    Numbers,
    NumbersAndShapes,
}

/// Turns states into messages. It keeps the paths of the tools since the start of the latest motion.
pub(crate) struct ArmsEncoder {
    events: ArmsEvents,
    trails: Trails,
    n_motions: u64,
    /// The latest motion, for captions.
    motion: Option<MotionView>,
}

impl ArmsEncoder {
    pub(crate) fn new(n_arms: usize) -> Self {
        let trails = Trails::new(n_arms);
        Self { events: ArmsEvents::default(), trails, n_motions: 0, motion: None }
    }

    /// Returns the messages of `view` with the time `time_ns`.
    pub(crate) fn encode(
        &mut self,
        view: &ArmsView,
        time_ns: u64,
        detail: Detail,
    ) -> Vec<ArmsMessage> {
        self.follow(view);
        let stamp = timestamp(time_ns);
        let lines = self.events.update(view).into_iter();
        let lines =
            lines.map(|(level, text)| ArmsMessage::Log(log_line(time_ns, level.into(), &text)));
        let mut messages: Vec<ArmsMessage> = lines.collect();
        messages.push(ArmsMessage::Arms(arms_state(view)));
        if view.arms.is_empty() {
            return messages;
        }
        messages.push(ArmsMessage::Measured(measured(&view.arms, stamp)));
        if view.arms.iter().all(|arm| !arm.planned_rad.is_empty()) {
            messages.push(ArmsMessage::Planned(planned(&view.arms, stamp)));
        }
        if let (Some(scene), Detail::NumbersAndShapes) = (&view.scene, detail) {
            let mut transforms = frame_transforms(scene, stamp).transforms;
            transforms.extend(planned_frames(&view.arms, stamp));
            messages.push(ArmsMessage::Tf(FrameTransforms { transforms }));
            let mut update = crate::scene::scene_update(scene, stamp, &self.caption(view));
            update.entities.extend(self.trails.entities(&planned_tools(view), stamp));
            messages.push(ArmsMessage::Scene(update));
        }
        messages
    }

    /// Extends the paths of the tools, which begin again with each motion.
    fn follow(&mut self, view: &ArmsView) {
        if view.n_motions != self.n_motions {
            self.n_motions = view.n_motions;
            self.trails = Trails::new(view.arms.len());
        }
        if let Some(motion) = &view.motion {
            self.motion = Some(motion.clone());
            let tools: Vec<[f64; 3]> = view.arms.iter().map(|arm| arm.tool_m).collect();
            self.trails.extend(&planned_tools(view), &tools);
        }
    }

    fn caption(&self, view: &ArmsView) -> String {
        let progress = match (&view.motion, &self.motion) {
            (Some(motion), _) => {
                let [played_s, duration_s] = motion.clock_times_s();
                format!(
                    "motion {} {}\n{played_s:.1} of {duration_s:.1} s at speed {}",
                    view.n_motions, motion.name, motion.speed
                )
            }
            (None, Some(motion)) => format!("after motion {} {}", view.n_motions, motion.name),
            (None, None) => "no motion yet".to_owned(),
        };
        let stop = view.stop.as_ref().map_or("", |stop| stop.sentence.as_str());
        format!("{progress}\n{} {stop}", view.phase.name())
    }
}

fn planned_tools(view: &ArmsView) -> Vec<[f64; 3]> {
    view.arms.iter().filter_map(|arm| arm.planned_tool_m).collect()
}

/// Returns the frames `arm{i}/planned_tool`.
fn planned_frames(arms: &[ArmView], stamp: Timestamp) -> impl Iterator<Item = FrameTransform> {
    let planned = arms.iter().enumerate();
    planned.filter_map(move |(arm, view)| {
        Some(tool_frame(format!("arm{arm}/planned_tool"), view.planned_tool_m?, stamp))
    })
}

/// Returns joint states with velocities and, where arms report them, torques, followed by the grippers.
fn measured(arms: &[ArmView], stamp: Timestamp) -> JointStates {
    let joints = arms.iter().enumerate().flat_map(|(arm, view)| {
        let angles = view.angles_rad.iter().enumerate();
        angles.map(move |(joint, angle_rad)| JointState {
            name: format!("arm{arm}/joint{}", joint + 1),
            position: Some(*angle_rad),
            velocity: view.velocities_radps.get(joint).copied(),
            effort: view.torques_nm.get(joint).copied(),
            ..JointState::default()
        })
    });
    let grippers = arms.iter().enumerate().map(|(arm, view)| JointState {
        name: format!("arm{arm}/gripper"),
        position: Some(view.opening),
        ..JointState::default()
    });
    JointStates { timestamp: Some(stamp), joints: joints.chain(grippers).collect() }
}

fn planned(arms: &[ArmView], stamp: Timestamp) -> JointStates {
    let angles: Vec<&[f64]> = arms.iter().map(|arm| arm.planned_rad.as_slice()).collect();
    crate::scene::joint_states_of(&angles, &[], stamp)
}

fn arms_state(view: &ArmsView) -> pb::ArmsState {
    let motion = view.motion.as_ref();
    pb::ArmsState {
        bridge_time_s: view.time_s,
        phase: view.phase.name().to_owned(),
        stop: view.stop.as_ref().map(|stop| stop.name.clone()).unwrap_or_default(),
        played_s: motion.map(|motion| motion.played_s),
        duration_s: motion.map(|motion| motion.duration_s),
        speed: motion.map(|motion| motion.speed),
        at_rest: view.at_rest,
        is_owned: view.lease_left_s.is_some(),
        arms_gap_m: view.arms_gap_m,
        arms: view.arms.iter().map(arm_state).collect(),
    }
}

fn arm_state(arm: &ArmView) -> pb::ArmState {
    let errors = arm.planned_rad.iter().zip(&arm.angles_rad).map(|(a, b)| (a - b).abs());
    pb::ArmState {
        tool_m: arm.tool_m.to_vec(),
        planned_tool_m: arm.planned_tool_m.map(|tool| tool.to_vec()).unwrap_or_default(),
        opening: arm.opening,
        table_gap_m: arm.table_gap_m,
        self_gap_m: arm.self_gap_m,
        largest_error_rad: (!arm.planned_rad.is_empty()).then(|| errors.fold(0.0, f64::max)),
        drive_fault: arm.drive_fault,
        contact: arm.contact,
        emergency_stop: arm.emergency_stop,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_caption_has_the_seconds_that_pass_at_the_speed_of_the_motion() {
        let mut view = ArmsView { n_motions: 3, ..ArmsView::default() };
        view.motion = Some(MotionView {
            name: "lift".to_owned(),
            speed: 0.1,
            played_s: 0.25,
            duration_s: 2.0,
            ..MotionView::default()
        });
        let mut encoder = ArmsEncoder::new(2);
        encoder.follow(&view);
        let caption = encoder.caption(&view);
        assert!(caption.starts_with("motion 3 lift\n2.5 of 20.0 s at speed 0.1\n"), "{caption}");
        view.motion = None;
        assert!(encoder.caption(&view).starts_with("after motion 3 lift\n"));
    }
}
