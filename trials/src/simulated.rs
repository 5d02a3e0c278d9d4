//! A simulated pair of Kinova Micos with its own physics.
//!
//! The pair replaces real arms in trials, so it differs from the training world on purpose: it has joints instead of a
//! free hand, a gripper that tilts with the joints, two fingers, delayed commands, speeds that follow with a lag, noisy
//! encoders and delayed cameras. The arms' shapes are those of `tandem-kinematics`, whose capsules include about a
//! centimetre of margin. Contacts between arms, with the table and within one arm are those of the capsules; objects
//! collide with thinner shells. An arm that touches itself reports a contact.
//!
//! **The gripper** has two pads that slide straight along the closing direction, from 0 to 62 mm each, and extend 36 mm
//! beyond the tool's origin. At every opening they stay within the capsule of the fingers in `tandem-kinematics`.
//! Kinova's fingers are hinged and extend up to 44 mm when closed.
//!
//! Time advances only in exchanges, by [`PERIOD_S`] each. The same seed and commands give the same bits.

use glam::{DMat3, DVec3};
use rand_chacha::ChaCha8Rng;
use tandem_core::scene::Scene;
use tandem_core::{ArmIndex, Contacts, Stream, episode_rng};
use tandem_kinematics::model::Anchor;
use tandem_kinematics::{ForwardKinematics, Gaps, Joints, WorkCell};

use crate::simulated::drives::Drives;
use crate::simulated::physics::{ArmPoses, PhysicsWorld};
use crate::simulated::sensors::Cameras;
use tandem_bridge::driver::{Command, Driver, DriverError, Faults, Order, PairState};

pub use config::{
    Block, CameraConfig, Disturbance, GripperConfig, N_SUBSTEPS, ObjectBox, PERIOD_S, SharedObject,
    SimulatedConfig,
};
pub use drill::Drill;
pub use physics::MAX_OPENING_M;
pub(crate) use physics::PAD_HALF_M;
pub use realtime::RealTimePair;
pub use sensors::ObjectPose;

mod config;
mod drill;
mod drives;
mod physics;
mod realtime;
mod scene;
mod sensors;

/// The frames at the ends of the forearm.
const FOREARM_FRAMES: [usize; 2] = [3, 4];

/// The sources of random numbers; each has its own stream.
#[derive(Clone, Copy)]
enum Source {
    Latency,
    Joints,
    Cameras,
}

/// Up to two simulated Micos with four joints, their table and the objects on it.
pub struct SimulatedPair {
    cell: WorkCell,
    config: SimulatedConfig,
    disturbance: Disturbance,
    drives: Drives,
    world: PhysicsWorld,
    cameras: Cameras,
    /// The external torques of the joints in the last period, newton metres.
    torques_nm: Vec<Joints>,
    contacts: Contacts,
    /// Whether parts of each arm touched each other in the last period.
    self_contacts: Vec<bool>,
    rng: ChaCha8Rng,
}

impl std::fmt::Debug for SimulatedPair {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SimulatedPair").field("time_s", &self.time_s()).finish_non_exhaustive()
    }
}

impl SimulatedPair {
    /// Creates the arms of `cell` at rest at joint angles `at` (radians, arm by arm), with the grippers at `opening` (0
    /// to 1).
    ///
    /// # Panics
    /// Panics if there are more than two arms, an arm does not have four joints, or `at` does not match the arms.
    #[must_use]
    pub fn new(cell: WorkCell, at: &[Joints], opening: f64, config: SimulatedConfig) -> Self {
        assert!(
            (1..=2).contains(&cell.arms.len()) && cell.arms.len() == at.len(),
            "one or two arms"
        );
        assert!(at.iter().all(|angles| angles.len() == 4), "arms with four joints");
        let rng = |source| episode_rng(config.seed, source as u64, Stream::Reset);
        let poses: Vec<ArmPoses> = arm_poses(&cell, at.iter()).collect();
        let opening = opening.clamp(0.0, 1.0);
        let world = PhysicsWorld::new(&config, &poses, single(opening), single(cell.table_z_m));
        let objects = objects(&world, 0.0);
        Self {
            drives: Drives::new(&cell, at, opening, rng(Source::Latency)),
            cameras: Cameras::new(config.camera, objects, rng(Source::Cameras)),
            torques_nm: at.iter().map(|at| Joints::from_fn(at.len(), |_| 0.0)).collect(),
            contacts: Contacts::NONE,
            self_contacts: vec![false; at.len()],
            rng: rng(Source::Joints),
            disturbance: Disturbance::default(),
            world,
            cell,
            config,
        }
    }

    /// Simulates a period without a command and returns the state.
    pub fn skip_period(&mut self) -> PairState {
        self.simulate_period();
        self.read()
    }

    /// Applies a disturbance to the arms from now on.
    pub fn disturb(&mut self, disturbance: Disturbance) {
        self.disturbance = disturbance;
    }

    /// The simulated time, seconds.
    #[must_use]
    pub fn time_s(&self) -> f64 {
        self.drives.n_periods() as f64 * PERIOD_S
    }

    /// The true joint angles of an arm, radians.
    ///
    /// # Panics
    /// Panics if there is no such arm.
    #[must_use]
    pub fn angles(&self, arm: ArmIndex) -> &Joints {
        &self.drives.arms[arm.0].angles
    }

    /// The true joint velocities of an arm, radians per second.
    ///
    /// # Panics
    /// Panics if there is no such arm.
    #[must_use]
    pub fn velocities(&self, arm: ArmIndex) -> &Joints {
        &self.drives.arms[arm.0].velocities
    }

    /// The work cell of the arms.
    #[must_use]
    pub fn cell(&self) -> &WorkCell {
        &self.cell
    }

    /// The true gaps around the arms, metres.
    #[must_use]
    pub fn gaps(&self) -> &Gaps {
        self.drives.gaps()
    }

    /// The contacts of the arms with each other and with the table in the last period.
    #[must_use]
    pub fn contacts(&self) -> Contacts {
        self.contacts
    }

    /// The true opening of an arm's gripper: 0 is closed, 1 is open.
    ///
    /// # Panics
    /// Panics if there is no such arm.
    #[must_use]
    pub fn opening(&self, arm: ArmIndex) -> f64 {
        self.world.opening(arm.0)
    }

    /// Returns whether parts of `arm` touched each other in the last period.
    ///
    /// # Panics
    /// Panics if there is no such arm.
    #[must_use]
    pub fn touches_itself(&self, arm: ArmIndex) -> bool {
        self.self_contacts[arm.0]
    }

    /// The true poses of the objects; of a shared object, those of the arms' points.
    #[must_use]
    pub fn objects(&self) -> Vec<ObjectPose> {
        objects(&self.world, self.time_s())
    }

    /// The poses of the objects in the newest camera picture that is available.
    #[must_use]
    pub fn observed_objects(&self) -> &[ObjectPose] {
        self.cameras.objects()
    }

    /// The scene for pictures and logs.
    #[must_use]
    pub fn scene(&self) -> Scene {
        let angles: Vec<Joints> = self.drives.arms.iter().map(|arm| arm.angles).collect();
        scene::scene(&self.cell, &angles, &self.world, self.time_s())
    }

    fn simulate_period(&mut self) {
        self.drives.begin_period();
        self.contacts = Contacts::NONE;
        self.self_contacts.fill(false);
        let n_arms = self.cell.arms.len();
        let mut forces_n = vec![DVec3::ZERO; n_arms];
        let (mut openings, mut commanded) = (vec![0.0; n_arms], vec![0.0; n_arms]);
        let mut poses = Vec::with_capacity(n_arms);
        for _ in 0..N_SUBSTEPS {
            for (arm, opening) in openings.iter_mut().enumerate() {
                *opening = self.world.opening(arm);
            }
            let (cell, torques) = (&self.cell, &self.torques_nm);
            self.drives.step(cell, &self.config, &self.disturbance, &openings, torques);
            poses.clear();
            poses.extend(arm_poses(cell, self.drives.arms.iter().map(|arm| &arm.angles)));
            for (opening, arm) in commanded.iter_mut().zip(&self.drives.arms) {
                *opening = arm.opening;
            }
            self.world.step(&poses, &commanded, &self.config.gripper);
            for (arm, force_n) in forces_n.iter_mut().enumerate() {
                *force_n += self.world.force_n(arm) / f64::from(N_SUBSTEPS);
            }
            self.contacts = self.contacts | self.drives.contacts();
            for (any, now) in self.self_contacts.iter_mut().zip(self.drives.self_contacts()) {
                *any |= *now;
            }
        }
        for (arm, force_n) in forces_n.into_iter().enumerate() {
            self.torques_nm[arm] = self.torques(arm, force_n);
        }
        let time_s = self.time_s();
        self.cameras.advance(self.drives.n_periods(), || objects(&self.world, time_s));
    }

    /// Converts a force on the tool (world frame, newtons) and the external torques of the disturbance to joint
    /// torques.
    fn torques(&self, arm: usize, force_n: DVec3) -> Joints {
        let placed = &self.cell.arms[arm];
        let posture = ForwardKinematics::new(placed.model, &self.drives.arms[arm].angles);
        let in_base = placed.world_from_base().inverse_transform_vector(&force_n.into());
        let jacobian = posture.position_jacobian();
        let external = self.disturbance.torque_nm.get(arm);
        Joints::from_fn(placed.model.n_joints(), |joint| {
            jacobian.column(joint).dot(&in_base) + external.map_or(0.0, |nm| nm[joint])
        })
    }

    fn read(&mut self) -> PairState {
        let tripped = self.drives.tripped();
        let mut arms = Vec::with_capacity(self.cell.arms.len());
        for (idx, arm) in self.drives.arms.iter().enumerate() {
            let (opening, torques) = (self.world.opening(idx), &self.torques_nm[idx]);
            let contact = self.self_contacts[idx];
            let injected = self.disturbance.faults.get(idx).copied().unwrap_or_default();
            let faults = Faults {
                drive: tripped || injected.drive,
                contact: contact || injected.contact,
                emergency_stop: injected.emergency_stop,
            };
            arms.push(sensors::read(arm, opening, torques, faults, &self.config, &mut self.rng));
        }
        PairState {
            sequence: self.drives.n_periods(),
            stamp_s: self.time_s(),
            newest_command: Some(self.drives.newest()),
            arms,
        }
    }

    fn check_shape(&self, command: &Command) -> Result<(), DriverError> {
        let Order::Move(arms) = &command.order else { return Ok(()) };
        let differs = |(got, expected): &(usize, usize)| got != expected;
        let joints = arms.iter().zip(&self.cell.arms);
        let joints = joints.map(|(arm, placed)| (arm.velocities.len(), placed.model.n_joints()));
        let counts = std::iter::once((arms.len(), self.cell.arms.len())).chain(joints);
        match counts.into_iter().find(differs) {
            Some((got, expected)) => Err(DriverError::Shape { got, expected }),
            None => Ok(()),
        }
    }
}

impl Driver for SimulatedPair {
    fn period_s(&self) -> f64 {
        PERIOD_S
    }

    fn exchange(&mut self, command: &Command) -> Result<PairState, DriverError> {
        self.check_shape(command)?;
        self.drives.send(command.clone(), self.config.latency_periods);
        self.simulate_period();
        if !self.world.is_finite() {
            return Err(DriverError::Malformed {
                what: "the position of an object is not finite".into(),
            });
        }
        Ok(self.read())
    }

    fn stop(&mut self) -> Result<(), DriverError> {
        self.drives.stop(self.config.latency_periods);
        Ok(())
    }
}

/// Rounds to single precision.
pub(crate) fn single(number: f64) -> f32 {
    DVec3::splat(number).as_vec3().x
}

/// Returns the poses of the arms' bodies for joint angles `angles`, radians.
fn arm_poses<'a>(
    cell: &'a WorkCell,
    angles: impl Iterator<Item = &'a Joints>,
) -> impl Iterator<Item = ArmPoses> {
    cell.arms.iter().zip(angles).map(|(placed, angles)| {
        let posture = ForwardKinematics::new(placed.model, angles);
        let world_from_base = placed.world_from_base();
        let world_from_tool = world_from_base * posture.tool();
        ArmPoses {
            tool_m: world_from_tool.translation.vector.into(),
            tool_axes: DMat3::from_quat(world_from_tool.rotation.into()),
            forearm_m: FOREARM_FRAMES.map(|frame| {
                (world_from_base * posture.anchor_m(&Anchor::origin_of(frame))).into()
            }),
        }
    })
}

fn objects(world: &PhysicsWorld, time_s: f64) -> Vec<ObjectPose> {
    let pose = |idx| {
        let pose = world.object(idx);
        let at_m = pose.translation.as_dvec3();
        ObjectPose { at_m, orientation: pose.rotation.as_dquat(), time_s }
    };
    (0..world.n_objects()).map(pose).collect()
}
