//! The configuration of the driver.

use std::time::Duration;

use crate::kinova_ros::fingers::FingerSettings;

/// The configuration of the driver.
#[derive(Debug, Clone, PartialEq)]
pub struct KinovaRosConfig {
    /// The address of rosbridge: `host:port` or `ws://host:port`. Rosbridge's default port is 9090.
    pub address: String,
    /// The arms, in the order of the work cell.
    pub arms: [KinovaArm; 2],
    /// Time limit of the connection, and then of the first state. Default 3 s each.
    pub connect_timeout: Duration,
    /// Exchanges within which a service has to respond. Default 100.
    pub answer_exchanges: u32,
    /// Largest difference between the time stamps of the two arms' states, seconds. Default 0.1.
    pub skew_s: f64,
    /// The meaning of efforts. Default [`Efforts::Unused`].
    pub efforts: Efforts,
    /// The goals of the grippers.
    pub fingers: FingerSettings,
}

/// The meaning of the efforts that the nodes publish.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Efforts {
    /// Efforts are not used.
    Unused,
    /// Torques without those that carry the arm: the nodes have
    /// `torque_parameters/publish_torque_with_gravity_compensation` set.
    Compensated,
    /// Torques that include the arm's own weight, as the nodes publish them by default. Their difference from a moving
    /// mean is used, which shows a sudden push and not a steady one.
    Changes {
        /// The time constant of the mean, seconds.
        mean_s: f64,
    },
}

/// The names of an arm in ROS.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KinovaArm {
    /// The driver's node, such as `/left/m1n4s200_driver`. Topics and services are below it.
    pub node: String,
    /// The prefix of the joints' names, such as `m1n4s200_`: the node's parameter `robot_name` or else its type, and
    /// `_`.
    pub joint_prefix: String,
}

impl KinovaArm {
    /// Returns the names of an `m1n4s200` whose driver is the node `node`.
    #[must_use]
    pub fn mico(node: impl Into<String>) -> Self {
        Self { node: node.into(), joint_prefix: "m1n4s200_".into() }
    }
}

impl KinovaRosConfig {
    /// Returns the defaults for two `m1n4s200` behind rosbridge at `address`, under `/left/m1n4s200_driver` and
    /// `/right/m1n4s200_driver`.
    #[must_use]
    pub fn at(address: impl Into<String>) -> Self {
        Self {
            address: address.into(),
            arms: ["left", "right"].map(|side| KinovaArm::mico(format!("/{side}/m1n4s200_driver"))),
            connect_timeout: Duration::from_secs(3),
            answer_exchanges: 100,
            skew_s: 0.1,
            efforts: Efforts::Unused,
            fingers: FingerSettings::default(),
        }
    }
}
