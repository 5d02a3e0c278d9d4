//! The simulated sensors: encoders with noise and limited resolution, cameras with noise and latency.

use std::collections::VecDeque;

use glam::{DQuat, DVec3};
use rand_chacha::ChaCha8Rng;
use tandem_core::rng::standard_normal;
use tandem_kinematics::Joints;

use crate::simulated::config::{CameraConfig, SimulatedConfig};
use crate::simulated::drives::ArmDrives;
use tandem_bridge::driver::{ArmReading, Faults};

/// The true or observed pose of an object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObjectPose {
    /// The centre, world frame, metres.
    pub at_m: DVec3,
    /// The orientation, world frame.
    pub orientation: DQuat,
    /// The simulated time of the pose, seconds.
    pub time_s: f64,
}

/// Returns the measurements of `arm`.
pub(crate) fn read(
    arm: &ArmDrives,
    opening: f64,
    torques_nm: &Joints,
    faults: Faults,
    config: &SimulatedConfig,
    rng: &mut ChaCha8Rng,
) -> ArmReading {
    let mut noise = |deviation: f64| deviation * f64::from(standard_normal(rng));
    let angles = Joints::from_fn(arm.angles.len(), |joint| {
        let angle = arm.angles[joint] + noise(config.angle_noise_rad);
        (angle / config.angle_step_rad).round() * config.angle_step_rad
    });
    let velocities = Joints::from_fn(arm.angles.len(), |joint| {
        arm.velocities[joint] + noise(config.rate_noise_radps)
    });
    let torques = Joints::from_fn(arm.angles.len(), |joint| {
        torques_nm[joint] + arm.stalled_nm[joint] + noise(config.torque_noise_nm)
    });
    ArmReading {
        angles,
        velocities,
        torques_nm: config.reports_torques.then_some(torques),
        opening,
        faults,
    }
}

/// The cameras.
pub(crate) struct Cameras {
    config: CameraConfig,
    /// The newest available picture, followed by the pictures that are not available yet.
    pictures: VecDeque<Picture>,
    rng: ChaCha8Rng,
}

struct Picture {
    available_period: u64,
    objects: Vec<ObjectPose>,
}

impl Cameras {
    pub(crate) fn new(config: CameraConfig, objects: Vec<ObjectPose>, rng: ChaCha8Rng) -> Self {
        let mut cameras = Self { config, pictures: VecDeque::new(), rng };
        let objects = cameras.with_noise(objects);
        cameras.pictures.push_back(Picture { available_period: 0, objects });
        cameras
    }

    /// Takes a picture of `objects` if one is due.
    pub(crate) fn advance(&mut self, n_periods: u64, objects: impl FnOnce() -> Vec<ObjectPose>) {
        if n_periods.is_multiple_of(self.config.every_periods.max(1)) {
            let available_period = n_periods + self.config.latency_periods;
            let objects = self.with_noise(objects());
            self.pictures.push_back(Picture { available_period, objects });
        }
        while self.pictures.get(1).is_some_and(|next| next.available_period <= n_periods) {
            self.pictures.pop_front();
        }
    }

    /// The objects in the newest available picture.
    pub(crate) fn objects(&self) -> &[ObjectPose] {
        self.pictures.front().map_or(&[], |picture| &picture.objects)
    }

    fn with_noise(&mut self, mut objects: Vec<ObjectPose>) -> Vec<ObjectPose> {
        let CameraConfig { position_noise_m, orientation_noise_rad, .. } = self.config;
        let mut normal = || f64::from(standard_normal(&mut self.rng));
        for object in &mut objects {
            object.at_m += DVec3::new(normal(), normal(), normal()) * position_noise_m;
            let error = DVec3::new(normal(), normal(), normal()) * orientation_noise_rad;
            let error = DQuat::from_scaled_axis(error);
            object.orientation = (error * object.orientation).normalize();
        }
        objects
    }
}
