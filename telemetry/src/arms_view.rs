//! The state of the arms of a bridge for logs and displays, and the events in it.

use serde::Serialize;
use tandem_core::scene::Scene;

use crate::trial_log::LogLevel;

/// The state of the arms after a tick of their bridge. Positions are in the world frame, metres; lists are in arm
/// order.
///
/// It is serialized to JSON without the scene.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct ArmsView {
    /// Time of the tick since the start of the bridge, seconds.
    pub time_s: f64,
    /// Time of the tick, milliseconds since 1970.
    pub unix_ms: u64,
    /// Phase of the arms.
    pub phase: ArmsPhase,
    /// The motion in progress.
    pub motion: Option<MotionView>,
    /// Number of motions started since the start of the bridge.
    pub n_motions: u64,
    /// The stop that the arms are in, while they are stopped.
    pub stop: Option<StopView>,
    /// The problem of the last attempt to command a stop, until a command gets through.
    pub stop_error: Option<String>,
    /// The faults that an operator has injected into simulated arms, as text; oldest first.
    pub injected: Vec<String>,
    /// True if the driver exchanges commands and states with the arms.
    pub is_connected: bool,
    /// Time until the owner's lease ends unless it is renewed, seconds; `None` if the arms have no owner.
    pub lease_left_s: Option<f64>,
    /// True if all joints are at rest.
    pub at_rest: bool,
    /// The arms; empty without a valid state.
    pub arms: Vec<ArmView>,
    /// Smallest gap between parts of two arms, metres; `None` without a valid state or with one arm.
    pub arms_gap_m: Option<f64>,
    /// Shapes of the arms as measured; `None` without a valid state.
    #[serde(skip)]
    pub scene: Option<Scene>,
}

/// The state of one arm.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct ArmView {
    /// Measured joint angles, radians, base to wrist.
    pub angles_rad: Vec<f64>,
    /// Measured velocities of the joints, radians per second.
    pub velocities_radps: Vec<f64>,
    /// Measured torques of the joints, newton metres; empty if the arm does not report them.
    pub torques_nm: Vec<f64>,
    /// Joint angles that the motion prescribes, radians; empty without a motion.
    pub planned_rad: Vec<f64>,
    /// Measured position of the tool.
    pub tool_m: [f64; 3],
    /// Position of the tool that the motion prescribes.
    pub planned_tool_m: Option<[f64; 3]>,
    /// Opening of the gripper, 0 (closed) to 1 (open).
    pub opening: f64,
    /// Smallest gap between the table and any part but the base, metres.
    pub table_gap_m: f64,
    /// Smallest gap between two parts of the arm that can collide, metres.
    pub self_gap_m: f64,
    /// A drive reports a fault.
    pub drive_fault: bool,
    /// A contact is reported.
    pub contact: bool,
    /// The emergency stop at the arm is pressed.
    pub emergency_stop: bool,
}

/// A motion in progress.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct MotionView {
    /// Name that its client gave it; may be empty.
    pub name: String,
    /// Address of the client; empty if it is not known.
    pub client: String,
    /// Share of the motion's own speed at which it is played, in (0, 1].
    pub speed: f64,
    /// Part that has been played, seconds of the motion's own time.
    pub played_s: f64,
    /// Duration at its own speed, seconds.
    pub duration_s: f64,
}

impl MotionView {
    /// Returns the played part and the duration on the clock, seconds: at speed 0.1, ten times the motion's own times.
    #[must_use]
    pub fn clock_times_s(&self) -> [f64; 2] {
        let on_clock = |own_s: f64| if self.speed > 0.0 { own_s / self.speed } else { own_s };
        [self.played_s, self.duration_s].map(on_clock)
    }
}

/// The time and cause of a stop.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct StopView {
    /// Name of the cause, such as `requested`.
    pub name: String,
    /// Description of the stop.
    pub sentence: String,
    /// Time since the start of the bridge, seconds.
    pub time_s: f64,
}

/// Phase of the arms.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ArmsPhase {
    /// Nothing moves before a reset.
    #[default]
    Stopped,
    /// The arms wait for a motion.
    Idle,
    /// A motion is played.
    Moving,
    /// A motion pauses.
    Holding,
    /// A motion has ended and the arms come to rest.
    Settling,
}

impl ArmsPhase {
    /// Returns the name in logs.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Stopped => "stopped",
            Self::Idle => "idle",
            Self::Moving => "moving",
            Self::Holding => "holding",
            Self::Settling => "settling",
        }
    }
}

impl StopView {
    /// Returns true if an operator or a program asked for the stop, as opposed to a fault.
    #[must_use]
    pub fn is_expected(&self) -> bool {
        matches!(self.name.as_str(), "requested" | "shut-down" | "not-reset")
    }
}

/// Finds the events between consecutive states.
#[derive(Debug, Clone, Default)]
pub struct ArmsEvents {
    former: Option<Former>,
}

/// The parts of the latest state that events depend on.
#[derive(Debug, Clone, PartialEq)]
struct Former {
    phase: ArmsPhase,
    stop: Option<StopView>,
    is_connected: bool,
    is_owned: bool,
    n_motions: u64,
}

impl ArmsEvents {
    /// Returns the events since the previous state, as lines of text, oldest first.
    pub fn update(&mut self, view: &ArmsView) -> Vec<(LogLevel, String)> {
        let now = Former {
            phase: view.phase,
            stop: view.stop.clone(),
            is_connected: view.is_connected,
            is_owned: view.lease_left_s.is_some(),
            n_motions: view.n_motions,
        };
        let Some(former) = self.former.replace(now.clone()) else { return first(view) };
        if former == now {
            return Vec::new();
        }
        let mut lines = Vec::new();
        if now.is_owned && !former.is_owned {
            lines.push((LogLevel::Info, "a client owns the arms".to_owned()));
        }
        if !now.is_connected && former.is_connected {
            lines.push((LogLevel::Error, "the driver has lost the arms".to_owned()));
        } else if now.is_connected && !former.is_connected {
            lines.push((LogLevel::Info, "the driver exchanges states with the arms".to_owned()));
        }
        if former.stop.is_some() && now.stop.is_none() {
            lines.push((LogLevel::Info, "the arms were reset".to_owned()));
        }
        if now.n_motions != former.n_motions {
            lines.push((LogLevel::Info, started(view)));
        }
        match (former.phase, now.phase) {
            (ArmsPhase::Moving | ArmsPhase::Settling, ArmsPhase::Holding) => {
                lines.push((LogLevel::Warning, "the motion pauses".to_owned()));
            }
            (ArmsPhase::Holding, ArmsPhase::Moving) => {
                lines.push((LogLevel::Info, "the motion continues".to_owned()));
            }
            (ArmsPhase::Moving | ArmsPhase::Settling | ArmsPhase::Holding, ArmsPhase::Idle) => {
                lines.push((LogLevel::Info, "the motion is done".to_owned()));
            }
            _ => {}
        }
        if let Some(stop) = now.stop.filter(|stop| Some(stop) != former.stop.as_ref()) {
            lines.push((level(&stop), format!("stopped: {}", stop.sentence)));
        }
        if !now.is_owned && former.is_owned {
            lines.push((LogLevel::Info, "the arms have no owner".to_owned()));
        }
        lines
    }
}

/// Returns the line of the first state of a display or a log.
fn first(view: &ArmsView) -> Vec<(LogLevel, String)> {
    match (&view.stop, &view.motion) {
        (Some(stop), _) => vec![(level(stop), format!("stopped: {}", stop.sentence))],
        (None, Some(_)) => vec![(LogLevel::Info, started(view))],
        (None, None) => Vec::new(),
    }
}

fn level(stop: &StopView) -> LogLevel {
    if stop.is_expected() { LogLevel::Warning } else { LogLevel::Error }
}

fn started(view: &ArmsView) -> String {
    let mut line = format!("motion {}", view.n_motions);
    if let Some(motion) = &view.motion {
        if !motion.name.is_empty() {
            line.push_str(&format!(" ({})", motion.name));
        }
        let [_, duration_s] = motion.clock_times_s();
        line.push_str(&format!(" started: {duration_s:.1} s at speed {}", motion.speed));
        if !motion.client.is_empty() {
            line.push_str(&format!(", client {}", motion.client));
        }
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_are_the_differences_between_states() {
        let mut events = ArmsEvents::default();
        let mut view = ArmsView { is_connected: true, ..ArmsView::default() };
        let mut texts = |view: &ArmsView| -> Vec<String> {
            events.update(view).into_iter().map(|(_, text)| text).collect()
        };
        let stop = |name: &str| {
            let sentence = format!("at 0.000 s: {name}");
            Some(StopView { name: name.to_owned(), sentence, time_s: 0.0 })
        };
        view.stop = stop("not-reset");
        assert_eq!(texts(&view), ["stopped: at 0.000 s: not-reset"]);
        view.time_s = 1.0;
        assert!(texts(&view).is_empty());
        (view.stop, view.phase, view.lease_left_s) = (None, ArmsPhase::Idle, Some(5.0));
        assert_eq!(texts(&view), ["a client owns the arms", "the arms were reset"]);
        (view.phase, view.n_motions) = (ArmsPhase::Moving, 1);
        view.motion = Some(MotionView {
            name: "lift".to_owned(),
            client: "10.0.0.7".to_owned(),
            speed: 0.5,
            duration_s: 2.0,
            ..MotionView::default()
        });
        assert_eq!(texts(&view), ["motion 1 (lift) started: 4.0 s at speed 0.5, client 10.0.0.7"]);
        view.phase = ArmsPhase::Holding;
        assert_eq!(texts(&view), ["the motion pauses"]);
        (view.phase, view.motion, view.stop) = (ArmsPhase::Stopped, None, stop("late"));
        assert_eq!(texts(&view), ["stopped: at 0.000 s: late"]);
        view.is_connected = false;
        assert_eq!(texts(&view), ["the driver has lost the arms"]);
    }
}
