//! An arm's node and the faults of its side.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use serde_json::Value;
use tandem_bridge::ArmCommand;
use tandem_kinematics::Joints;

/// A fault of the arms' side.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Fault {
    /// A position is `null`.
    Null,
    /// A position is `NaN`, which is not JSON.
    Nan,
    /// The joints have other names.
    Names,
    /// The connection is closed.
    Close,
    /// This many arms report nothing.
    Silent(usize),
    /// Every state is sent twice, followed by the previous one.
    Again,
    /// The second arm's clock is two seconds ahead.
    Clock,
    /// A service fails.
    Refuses(&'static str),
    /// Services do not respond.
    NoAnswers,
    /// rosbridge reports an error.
    Complains,
    /// rosbridge does not publish velocities.
    Lags,
    /// rosbridge drops some velocities, as a queue of length 1 does.
    Drops,
    /// Another node moves the first arm.
    Stranger,
    /// The second arm's own command is not where the arm is.
    Elsewhere,
    /// Goals of joint angles are aborted.
    Aborts,
    /// Something presses on joint 2 of the first arm with 6 N m.
    Presses,
    /// The second node logs an error.
    Logs,
}

/// An arm's node.
#[derive(Default)]
pub(crate) struct Node {
    pub(crate) stopped: bool,
    /// The velocities of this period, radians per second.
    pub(super) rates: Option<Joints>,
    pub(super) opening: f64,
    /// Whether the arm's control type is angular. `in/start` restarts the interface.
    pub(super) is_angular: bool,
    pub(super) goal: Option<(String, u32)>,
    /// The topics and identifiers of all goals. As actionlib, the node ignores a goal that has a known one.
    pub(super) goal_ids: BTreeSet<(String, String)>,
    pub(super) homing: bool,
    /// The pending call of `in/start` or `in/home_arm` and the periods until its response.
    pub(super) starting: Option<(Value, u32)>,
    /// The velocity that waits for the node's thread.
    pub(super) waiting: Option<Joints>,
    /// The velocities in the arm's own queue.
    pub(super) points: VecDeque<Joints>,
    /// True if the thread handled a status last.
    pub(super) status_last: bool,
    /// When the node's thread is free again, and when its status timer expires; microseconds.
    pub(super) free_us: u64,
    pub(super) status_us: u64,
    /// Velocities that the arm received from the node, and states that the node published.
    pub(crate) n_taken: usize,
    pub(crate) n_states: usize,
    /// Messages with velocities.
    pub(crate) n_velocities: usize,
    /// Velocities that arrived while the fingers moved.
    pub(crate) n_while_busy: usize,
    /// Goals for the fingers, in turns.
    pub(crate) goals: Vec<Value>,
    /// The number of calls of a service.
    pub(crate) calls: BTreeMap<String, usize>,
}

impl Node {
    /// The command of the arm for the coming period: no motion without a velocity.
    pub(super) fn command(&mut self) -> ArmCommand {
        if self.stopped {
            self.waiting = None;
            self.points.clear();
        }
        let rates = self.rates.take().or(self.points.pop_front()).filter(|_| !self.stopped);
        ArmCommand {
            velocities: rates.unwrap_or_else(|| Joints::from_fn(4, |_| 0.0)),
            opening: self.opening.clamp(0.0, 1.0),
        }
    }
}
