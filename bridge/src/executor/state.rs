//! The states of the arms.

use tandem_kinematics::Joints;

use crate::executor::playback::Playback;
use crate::executor::stop::Stop;

/// The phase of the arms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// The drives brake or have braked; nothing moves before a reset.
    Stopped,
    /// The arms hold their position and wait for a motion.
    Idle,
    /// A motion is being played.
    Moving,
    /// A motion pauses because its owner or the states are late.
    Holding,
    /// The motion is over and the arms come to rest at its end.
    Settling,
}

/// The progress of a motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    /// The part that has been played, seconds of the motion's own time.
    pub played_s: f64,
    /// The length of the motion, seconds of its own time.
    pub duration_s: f64,
}

/// The state of the arms and the data that belongs to it.
#[derive(Debug)]
pub(crate) enum ArmsState {
    Stopped(Stop),
    Idle {
        /// The position that the arms hold, radians.
        at: Vec<Joints>,
    },
    Playing {
        playback: Box<Playback>,
        holding: bool,
    },
}

impl ArmsState {
    pub(crate) fn phase(&self) -> Phase {
        match self {
            Self::Stopped(_) => Phase::Stopped,
            Self::Idle { .. } => Phase::Idle,
            Self::Playing { holding: true, .. } => Phase::Holding,
            Self::Playing { playback, .. } if playback.since_end_s() > 0.0 => Phase::Settling,
            Self::Playing { .. } => Phase::Moving,
        }
    }

    pub(crate) fn stop(&self) -> Option<&Stop> {
        match self {
            Self::Stopped(stop) => Some(stop),
            _ => None,
        }
    }

    pub(crate) fn playback(&self) -> Option<&Playback> {
        match self {
            Self::Playing { playback, .. } => Some(playback),
            _ => None,
        }
    }
}
