//! What is known of one arm's node: its names, whether it lets the arm move, and what it was told. Pure.

use std::collections::VecDeque;

use serde_json::Value;
use tandem_kinematics::Joints;

use crate::driver::DriverError;
use crate::kinova_ros::fingers::{FingerSettings, Fingers};
use crate::kinova_ros::protocol;

/// Velocities that may be under way to ROS at most: a second. An executor stops much earlier.
pub(crate) const MOST_UNDER_WAY: usize = 100;

/// What is known of one arm's node.
#[derive(Debug)]
pub(crate) struct Arm {
    pub(crate) node: String,
    pub(crate) control: Control,
    pub(crate) fingers: Fingers,
    /// Numbers of commands, and their velocities, that were sent and not heard again; oldest first.
    pub(crate) under_way: VecDeque<(u64, Joints)>,
}

/// Whether a node lets its arm move.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Control {
    /// Nobody has asked for anything over this connection.
    Unknown,
    /// A service was called that has not answered for some exchanges.
    Asked { id: String, service: Service, n: u32 },
    /// The arm is stopped.
    Stopped,
    /// The arm follows velocities.
    Started,
}

/// What a node can be asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Service {
    Stop,
    Start,
}

impl Arm {
    /// The arm whose driver is the node `node`.
    pub(crate) fn new(node: &str, fingers: FingerSettings) -> Self {
        Self {
            node: node.trim_end_matches('/').to_owned(),
            control: Control::Unknown,
            fingers: Fingers::new(fingers),
            under_way: VecDeque::new(),
        }
    }

    pub(crate) fn topic(&self, name: &str) -> String {
        format!("{}/{name}", self.node)
    }

    pub(crate) fn velocity_topic(&self) -> String {
        self.topic("in/joint_velocity")
    }

    pub(crate) fn goal_topic(&self) -> String {
        self.topic("fingers_action/finger_positions/goal")
    }

    pub(crate) fn result_topic(&self) -> String {
        self.topic("fingers_action/finger_positions/result")
    }

    pub(crate) fn asked_to_stop(&self) -> bool {
        matches!(self.control, Control::Stopped | Control::Asked { service: Service::Stop, .. })
    }

    /// Notes the answer of a service.
    pub(crate) fn answered(
        &mut self,
        id: &str,
        result: bool,
        values: &str,
    ) -> Result<(), DriverError> {
        let Control::Asked { id: asked, service, .. } = &self.control else { return Ok(()) };
        if asked != id {
            return Ok(());
        }
        if !result {
            let what = format!("{}: {values}", self.topic(service.name()));
            return Err(DriverError::Refused { what });
        }
        self.control = match service {
            Service::Stop => Control::Stopped,
            Service::Start => Control::Started,
        };
        Ok(())
    }

    /// Notes velocities that were published in ROS. They have to be some that were sent; those before them were overtaken and dropped.
    pub(crate) fn published(&mut self, msg: &Value) -> Result<(), DriverError> {
        let is_it = |(number, rates): &(u64, Joints)| protocol::is_of(msg, *number, rates);
        let Some(place) = self.under_way.iter().position(is_it) else {
            let what = format!("another node publishes {}", self.velocity_topic());
            return Err(DriverError::Refused { what });
        };
        self.under_way.drain(..=place);
        Ok(())
    }

    /// Lets an exchange pass. A service has to answer in time.
    pub(crate) fn await_answer(&mut self, most: u32) -> Result<(), DriverError> {
        let node = &self.node;
        if let Control::Asked { service, n, .. } = &mut self.control {
            *n += 1;
            if *n > most {
                let what = format!(
                    "{node}/{} did not answer for {most} exchanges: does the node run?",
                    service.name()
                );
                return Err(DriverError::Refused { what });
            }
        }
        Ok(())
    }
}

impl Service {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Stop => "in/stop",
            Self::Start => "in/start",
        }
    }
}
