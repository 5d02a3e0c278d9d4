//! The commands that the arms have received.

use std::collections::VecDeque;

use tandem_kinematics::{Joints, WorkCell};

use crate::driver::{ArmCommand, Command, Order, PairState};
use crate::executor::settings::Settings;

/// Least number of entries that are kept beyond the reaction time of the arms.
const EXTRA_ENTRIES: usize = 8;

/// Commanded velocities, the newest first: one entry per period, arm by arm, radians per second.
pub(crate) type VelocityHistory = VecDeque<Vec<Joints>>;

/// The newest commands of an executor.
#[derive(Debug)]
pub(crate) struct CommandHistory {
    /// Number of the last command.
    number: u64,
    /// The last command, arm by arm.
    last: Vec<ArmCommand>,
    velocities: VelocityHistory,
    reaction_periods: usize,
    /// Entries to keep: every command that may have no effect yet in the oldest state that is used.
    n_kept: usize,
}

impl CommandHistory {
    /// An empty history of the arms of `cell`.
    pub(crate) fn new(cell: &WorkCell, settings: &Settings, period_s: f64) -> Self {
        let reaction_periods = periods(settings.reaction_s, period_s).max(1);
        let n_kept = reaction_periods + periods(settings.state_stop_s, period_s).max(EXTRA_ENTRIES);
        let at_rest =
            |n_joints| ArmCommand { velocities: Joints::from_fn(n_joints, |_| 0.0), opening: 0.0 };
        Self {
            number: 0,
            last: cell.arms.iter().map(|arm| at_rest(arm.model.n_joints())).collect(),
            velocities: VelocityHistory::new(),
            reaction_periods,
            n_kept,
        }
    }

    /// Numbers `order` and adds it to the history.
    pub(crate) fn push(&mut self, order: Order) -> Command {
        self.number += 1;
        self.last = match &order {
            Order::Move(commands) => commands.clone(),
            Order::Stop => self.stationary(),
        };
        self.velocities.push_front(self.last.iter().map(|arm| arm.velocities).collect());
        self.velocities.truncate(self.n_kept);
        Command { number: self.number, order }
    }

    /// Forgets all velocities and counts commands from 1 again.
    pub(crate) fn restart(&mut self) {
        self.velocities.clear();
        self.number = 0;
    }

    pub(crate) fn number(&self) -> u64 {
        self.number
    }

    pub(crate) fn last(&self) -> &[ArmCommand] {
        &self.last
    }

    pub(crate) fn velocities(&self) -> &VelocityHistory {
        &self.velocities
    }

    /// The velocities that a state read now shows at least: for each joint, the slowest one within the reaction time,
    /// since a joint may follow the newest command or the oldest.
    ///
    /// # Panics
    /// Panics if no command was pushed yet.
    pub(crate) fn visible_velocities(&self) -> Vec<Joints> {
        let recent = || self.velocities.iter().take(self.reaction_periods);
        let slowest = |arm: usize, joint: usize| {
            let rates = recent().map(|velocities| velocities[arm][joint]);
            rates.min_by(|a, b| a.abs().total_cmp(&b.abs())).unwrap_or(0.0)
        };
        let arms = self.velocities[0].iter().enumerate();
        arms.map(|(arm, joints)| Joints::from_fn(joints.len(), |joint| slowest(arm, joint)))
            .collect()
    }

    /// The command to stay in place with the grippers as they are.
    pub(crate) fn stationary(&self) -> Vec<ArmCommand> {
        let stay = |arm: &ArmCommand| ArmCommand {
            velocities: Joints::from_fn(arm.velocities.len(), |_| 0.0),
            ..*arm
        };
        self.last.iter().map(stay).collect()
    }

    /// Takes over the gripper openings of `state`, so that grippers keep their position after a reset.
    pub(crate) fn keep_openings(&mut self, state: &PairState) {
        for (last, arm) in self.last.iter_mut().zip(&state.arms) {
            last.opening = arm.opening.clamp(0.0, 1.0);
        }
    }

    /// Returns true if no joint was last commanded to move faster than `rest_radps`.
    pub(crate) fn at_rest(&self, rest_radps: f64) -> bool {
        self.last.iter().all(|arm| arm.velocities.iter().all(|rate| rate.abs() <= rest_radps))
    }
}

/// Returns a time in periods, rounded up.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "settings are a few periods, and positive"
)]
fn periods(time_s: f64, period_s: f64) -> usize {
    (time_s / period_s).ceil() as usize
}
