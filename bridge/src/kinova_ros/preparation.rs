//! The steps before a goal of the fingers, so that it moves nothing but the fingers.
//!
//! A finger goal is a point in the arm's queue, and the rest of the point is a place for the arm: by its control type
//! the joint angles or the Cartesian pose of the arm's own last command. After velocities, either may be outdated. The
//! node offers no way to read the control type. Its action for joint angles sets the angular type, empties the queue
//! and sends the given angles. Before each finger goal, the driver therefore
//!
//! 1. publishes nothing until the arm rests in two further states;
//! 2. compares the arm's own command (`out/joint_command`) with the measured angles, and ends the connection if they
//!    are more than [`MAX_OFF_RAD`] apart;
//! 3. sends that command as a goal of joint angles, which moves nothing, and waits for its success.

use serde_json::Value;
use tandem_kinematics::Joints;

use crate::driver::DriverError;
use crate::kinova_ros::node::ArmNode;
use crate::kinova_ros::{ANGLES_GOAL, COMMAND_TOPIC, KinovaRosDriver, decoder, protocol};

/// Largest distance of the arm's own command from the measured angle of a joint, radians.
const MAX_OFF_RAD: f64 = 1.0 * std::f64::consts::PI / 180.0;
/// Highest measured speed of a joint at rest, radians per second.
const REST_RADPS: f64 = 1.0 * std::f64::consts::PI / 180.0;
/// States after the last velocity that have to show rest.
const N_STATES: u64 = 2;
/// Exchanges within which the arm has to rest, and within which the goal has to succeed.
const MAX_EXCHANGES: u32 = 300;

/// The progress of a preparation.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Preparation {
    /// The arm comes to rest.
    Settling {
        /// The opening of the finger goal, 0 to 1.
        opening: f64,
        /// The number of the newest state at the last velocity.
        sequence: u64,
        /// Exchanges since then.
        n: u32,
    },
    /// The goal of joint angles was sent.
    Angles {
        /// The opening of the finger goal, 0 to 1.
        opening: f64,
        /// The identifier of the goal.
        id: String,
        /// Exchanges since then.
        n: u32,
    },
    /// The finger goal, for this opening, may be sent.
    Ready(f64),
}

impl KinovaRosDriver {
    /// Continues the preparation of a finger goal, or sends it.
    pub(crate) fn prepare_fingers(
        &mut self,
        arm: usize,
        step: Preparation,
    ) -> Result<(), DriverError> {
        let next = match step {
            Preparation::Settling { opening, sequence, n } => {
                self.settle(arm, opening, sequence, n)?
            }
            Preparation::Angles { opening, id, n } => {
                if n >= MAX_EXCHANGES {
                    let what = format!("{} does not end", self.arms[arm].topic(ANGLES_GOAL));
                    return Err(DriverError::Refused { what });
                }
                Preparation::Angles { opening, id, n: n + 1 }
            }
            Preparation::Ready(opening) => {
                let id = self.next_id();
                let turns = decoder(&self.config, arm).turns(opening);
                let topic = self.arms[arm].goal_topic();
                self.socket.send(protocol::finger_goal(&topic, &id, turns))?;
                self.arms[arm].fingers.goal_sent(id);
                return Ok(());
            }
        };
        self.arms[arm].preparation = Some(next);
        Ok(())
    }

    /// Sends the goal of joint angles once the arm rests.
    fn settle(
        &mut self,
        arm: usize,
        opening: f64,
        sequence: u64,
        n: u32,
    ) -> Result<Preparation, DriverError> {
        let reading = &self.newest.arms[arm];
        let rests = reading.velocities.iter().all(|rate| rate.abs() <= REST_RADPS);
        if !rests || self.newest.sequence < sequence + N_STATES {
            if n >= MAX_EXCHANGES {
                let what = format!("{}: the arm does not rest", self.arms[arm].node);
                return Err(DriverError::Refused { what });
            }
            return Ok(Preparation::Settling { opening, sequence, n: n + 1 });
        }
        let commanded = self.arms[arm].holding_command(&reading.angles)?;
        let id = self.next_id();
        let topic = self.arms[arm].topic(ANGLES_GOAL);
        self.socket.send(protocol::angles_goal(&topic, &id, &commanded))?;
        Ok(Preparation::Angles { opening, id, n: 0 })
    }
}

impl ArmNode {
    /// Returns the arm's own command if it holds the arm at `angles`, radians.
    fn holding_command(&self, angles: &Joints) -> Result<Joints, DriverError> {
        let refused = |what: String| Err(DriverError::Refused { what });
        let Some(commanded) = self.commanded else {
            return refused(format!(
                "{} publishes no joint angles, without which fingers cannot be moved safely",
                self.topic(COMMAND_TOPIC)
            ));
        };
        let off = |joint: &usize| (commanded[*joint] - angles[*joint]).abs();
        match (0..angles.len()).find(|joint| off(joint) > MAX_OFF_RAD) {
            None => Ok(commanded),
            Some(joint) => refused(format!(
                "{}: the arm's own command for joint {} is {:.1} degrees from its angle, at most {:.1}: moving the \
                 fingers would move the arm",
                self.node,
                joint + 1,
                off(&joint).to_degrees(),
                MAX_OFF_RAD.to_degrees()
            )),
        }
    }

    /// Handles the result of a goal of joint angles.
    pub(crate) fn handle_angles_result(&mut self, msg: &Value) -> Result<(), DriverError> {
        let Some(Preparation::Angles { opening, id, .. }) = &self.preparation else {
            return Ok(());
        };
        if protocol::ended_goal(msg) != Some(id.as_str()) {
            return Ok(());
        }
        if !protocol::has_succeeded(msg) {
            let what = format!(
                "{} failed: the arm was not switched to angular control",
                self.topic(ANGLES_GOAL)
            );
            return Err(DriverError::Refused { what });
        }
        self.preparation = Some(Preparation::Ready(*opening));
        Ok(())
    }

    /// Handles a message of `rosgraph_msgs/Log`. An error of this node is returned.
    pub(crate) fn handle_log(&self, msg: &Value) -> Result<(), DriverError> {
        match protocol::logged_error(msg) {
            Some((node, text)) if node == self.node => {
                Err(DriverError::Refused { what: format!("{node} logs an error: {text}") })
            }
            _ => Ok(()),
        }
    }
}
