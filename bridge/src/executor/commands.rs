//! The commands that the arms have received.

use std::collections::VecDeque;

use tandem_kinematics::{Joints, WorkCell};

use crate::driver::{ArmCommand, Command, Order, PairState};

/// Entries that are kept beyond the reaction time of the arms.
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
}

impl CommandHistory {
    /// An empty history of the arms of `cell`, which react within `reaction_periods`.
    pub(crate) fn new(cell: &WorkCell, reaction_periods: usize) -> Self {
        let at_rest =
            |n_joints| ArmCommand { velocities: Joints::from_fn(n_joints, |_| 0.0), opening: 0.0 };
        Self {
            number: 0,
            last: cell.arms.iter().map(|arm| at_rest(arm.model.n_joints())).collect(),
            velocities: VelocityHistory::new(),
            reaction_periods,
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
        self.velocities.truncate(self.reaction_periods + EXTRA_ENTRIES);
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

    /// The velocities that a state read now should show.
    ///
    /// # Panics
    /// Panics if no command was pushed yet.
    pub(crate) fn visible_velocities(&self) -> &[Joints] {
        &self.velocities[self.velocities.len().min(self.reaction_periods) - 1]
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

    /// Returns whether no joint was last commanded to move faster than `rest_radps`.
    pub(crate) fn at_rest(&self, rest_radps: f64) -> bool {
        self.last.iter().all(|arm| arm.velocities.iter().all(|rate| rate.abs() <= rest_radps))
    }
}
