//! The state of one arm's node: its names, whether it lets the arm move, and the commands in flight. Pure.

use std::collections::VecDeque;

use serde_json::Value;
use tandem_kinematics::Joints;

use crate::driver::DriverError;
use crate::kinova_ros::efforts::MeanEfforts;
use crate::kinova_ros::fingers::{FingerSettings, Fingers};
use crate::kinova_ros::following::{Following, LEAST_SHARE, Shortfall};
use crate::kinova_ros::preparation::Preparation;
use crate::kinova_ros::protocol;

/// The largest number of velocities in flight to ROS: those of one second. An executor stops much earlier:
/// at the first state after 60 ms without an effect, or because states are missing.
pub(crate) const MAX_IN_FLIGHT: usize = 100;

/// The state of one arm's node.
#[derive(Debug)]
pub(crate) struct ArmNode {
    pub(crate) node: String,
    pub(crate) control: Control,
    pub(crate) fingers: Fingers,
    /// Numbers and velocities of the commands that were sent and are not published yet; oldest first.
    pub(crate) in_flight: VecDeque<(u64, Joints)>,
    /// The check that the arm follows the velocities.
    pub(crate) following: Following,
    /// The preparation of a finger goal.
    pub(crate) preparation: Option<Preparation>,
    /// The arm's own command, radians.
    pub(crate) commanded: Option<Joints>,
    pub(crate) mean_efforts: MeanEfforts,
}

/// The permission of a node to move its arm.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Control {
    /// No service was called over this connection.
    Unknown,
    /// A service was called and has not responded for `n` exchanges.
    Pending { id: String, service: Service, n: u32 },
    /// The arm is stopped.
    Stopped,
    /// The arm follows velocities.
    Started,
}

/// The services of a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Service {
    Stop,
    Start,
    Home,
}

impl ArmNode {
    /// Creates the state of node `node`.
    pub(crate) fn new(node: &str, fingers: FingerSettings) -> Self {
        Self {
            node: node.trim_end_matches('/').to_owned(),
            control: Control::Unknown,
            fingers: Fingers::new(fingers),
            in_flight: VecDeque::new(),
            following: Following::new(super::PERIOD_S),
            preparation: None,
            commanded: None,
            mean_efforts: MeanEfforts::default(),
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

    pub(crate) fn is_stopping(&self) -> bool {
        matches!(self.control, Control::Stopped | Control::Pending { service: Service::Stop, .. })
    }

    /// Handles a state of the arm. Returns an error if the arm follows too few of its velocities.
    pub(crate) fn handle_state(
        &mut self,
        stamp_s: f64,
        angles: &Joints,
    ) -> Result<(), DriverError> {
        let followed = self.following.push_state(stamp_s, angles);
        followed.map_err(|Shortfall { joint, share, span_s }| {
            let what = format!(
                "{}: joint {} turned by {:.0} % of what the velocities of {span_s:.2} s asked for, at least {:.0} %: \
                 the node takes too few velocities (raise its feedback_publish_rate) or the joint is blocked",
                self.node,
                joint + 1,
                100.0 * share,
                100.0 * LEAST_SHARE
            );
            DriverError::Refused { what }
        })
    }

    /// Handles the response of a service.
    pub(crate) fn handle_response(
        &mut self,
        id: &str,
        result: bool,
        values: &str,
    ) -> Result<(), DriverError> {
        let Control::Pending { id: pending, service, .. } = &self.control else { return Ok(()) };
        if pending != id {
            return Ok(());
        }
        if !result {
            let what = format!("{}: {values}", self.topic(service.name()));
            return Err(DriverError::Refused { what });
        }
        self.control = match service {
            Service::Stop => Control::Stopped,
            Service::Start | Service::Home => Control::Started,
        };
        Ok(())
    }

    /// Handles velocities that were published in ROS. They must be in flight; earlier ones were overtaken and dropped.
    pub(crate) fn handle_velocity(&mut self, msg: &Value) -> Result<(), DriverError> {
        let matches =
            |(number, rates): &(u64, Joints)| protocol::is_velocity_of(msg, *number, rates);
        let Some(idx) = self.in_flight.iter().position(matches) else {
            let what = format!("another node publishes {}", self.velocity_topic());
            return Err(DriverError::Refused { what });
        };
        self.in_flight.drain(..=idx);
        Ok(())
    }

    /// Counts an exchange. Returns an error if a service has not responded within `max_exchanges`.
    pub(crate) fn count_exchange(&mut self, max_exchanges: u32) -> Result<(), DriverError> {
        let node = &self.node;
        if let Control::Pending { service, n, .. } = &mut self.control {
            *n += 1;
            if *n > max_exchanges {
                let what = format!(
                    "{node}/{} did not answer for {max_exchanges} exchanges: does the node run?",
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
            Self::Home => "in/home_arm",
        }
    }
}
