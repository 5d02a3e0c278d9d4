//! What the joints report and what the cameras see: the truth with noise, in steps, and late.

use std::collections::VecDeque;

use glam::{DQuat, DVec3};
use rand_chacha::ChaCha8Rng;
use tandem_core::rng::standard_normal;
use tandem_kinematics::Joints;

use crate::simulated::config::{CameraConfig, SimulatedConfig};
use crate::simulated::drives::ArmDrives;
use tandem_bridge::driver::{ArmReading, Faults};

/// An object as it is or was seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObjectPose {
    /// Its centre in the world, metres.
    pub at_m: DVec3,
    /// How it is turned in the world.
    pub turn: DQuat,
    /// When, seconds of simulated time.
    pub time_s: f64,
}

/// What `arm` reports of itself.
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
        torques_nm: config.tells_torques.then_some(torques),
        opening,
        faults,
    }
}

/// The cameras.
pub(crate) struct Cameras {
    config: CameraConfig,
    /// Pictures that are not known yet, and then the newest known one; oldest first.
    pictures: VecDeque<Picture>,
    rng: ChaCha8Rng,
}

struct Picture {
    known_period: u64,
    objects: Vec<ObjectPose>,
}

impl Cameras {
    pub(crate) fn new(config: CameraConfig, objects: Vec<ObjectPose>, rng: ChaCha8Rng) -> Self {
        let mut cameras = Self { config, pictures: VecDeque::new(), rng };
        let objects = cameras.blurred(objects);
        cameras.pictures.push_back(Picture { known_period: 0, objects });
        cameras
    }

    /// Takes a picture of `objects` when it is time.
    pub(crate) fn look(&mut self, n_periods: u64, objects: impl FnOnce() -> Vec<ObjectPose>) {
        if n_periods.is_multiple_of(self.config.every_periods.max(1)) {
            let known_period = n_periods + self.config.latency_periods;
            let objects = self.blurred(objects());
            self.pictures.push_back(Picture { known_period, objects });
        }
        while self.pictures.get(1).is_some_and(|next| next.known_period <= n_periods) {
            self.pictures.pop_front();
        }
    }

    /// The objects of the newest picture that is known.
    pub(crate) fn seen(&self) -> &[ObjectPose] {
        self.pictures.front().map_or(&[], |picture| &picture.objects)
    }

    fn blurred(&mut self, mut objects: Vec<ObjectPose>) -> Vec<ObjectPose> {
        let CameraConfig { place_noise_m, turn_noise_rad, .. } = self.config;
        let mut normal = || f64::from(standard_normal(&mut self.rng));
        for object in &mut objects {
            object.at_m += DVec3::new(normal(), normal(), normal()) * place_noise_m;
            let turn = DVec3::new(normal(), normal(), normal()) * turn_noise_rad;
            object.turn = (DQuat::from_scaled_axis(turn) * object.turn).normalize();
        }
        objects
    }
}
