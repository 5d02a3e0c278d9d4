//! A pair of Kinova Micos with physics of its own, for where there are no arms.
//!
//! It stands for the real world in trials, so it is unlike the training world on purpose: joints instead of a hand that flies,
//! a gripper that tilts as the joints tilt it, two fingers, commands that arrive late, speeds that follow with a lag,
//! encoders with noise, cameras that see late. The arms' shapes are those of `tandem-kinematics`, whose capsules include
//! about a centimetre of margin: two arms touch, and an arm touches the table or itself, when these do. Objects are touched by
//! thinner shells. An arm that touches itself reports a contact.
//!
//! **The gripper** has two pads that slide straight along the closing direction, from 0 to 62 mm each, and reach 36 mm beyond
//! the tool's origin: in every opening they stay within the capsule that kinematics has for the fingers. Kinova's
//! fingers are hinged and reach up to 44 mm when shut.
//!
//! Time passes only in exchanges, [`PERIOD_S`] each. The same seed and commands give the same bits.

use glam::DVec3;
use rand_chacha::ChaCha8Rng;
use tandem_core::scene::Scene;
use tandem_core::{ArmIndex, Contacts, Stream, episode_rng};
use tandem_kinematics::model::Anchor;
use tandem_kinematics::{Cell, Gaps, Joints, Posture};

use crate::simulated::drives::Drives;
use crate::simulated::sensors::Cameras;
use crate::simulated::world::{Carried, World};
use tandem_bridge::driver::{Command, Driver, DriverError, Faults, Order, PairState};

pub use config::{
    Block, CameraConfig, Disturbance, GripperConfig, N_SUBSTEPS, PERIOD_S, SimulatedConfig,
};
pub use realtime::RealTimePair;
pub use sensors::ObjectPose;
pub use world::MAX_OPENING_M;

mod config;
mod drives;
mod realtime;
mod scene;
mod sensors;
mod world;

/// Frames at the ends of the forearm.
const FOREARM_FRAMES: [usize; 2] = [3, 4];

/// What random numbers are for; each has its own stream.
#[derive(Clone, Copy)]
enum Source {
    Latency,
    Joints,
    Cameras,
}

/// Two simulated Micos with four joints, their table and what lies on it.
pub struct SimulatedPair {
    cell: Cell,
    config: SimulatedConfig,
    disturbance: Disturbance,
    drives: Drives,
    world: World,
    cameras: Cameras,
    /// What the arms touched in the last period, as torques of the joints, newton metres.
    torques_nm: Vec<Joints>,
    contacts: Contacts,
    /// For each arm whether two of its own parts touched in the last period.
    self_contacts: Vec<bool>,
    rng: ChaCha8Rng,
}

impl std::fmt::Debug for SimulatedPair {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SimulatedPair").field("time_s", &self.time_s()).finish_non_exhaustive()
    }
}

impl SimulatedPair {
    /// Arms of `cell` at rest at joint angles `at` (radians, arm by arm), grippers open by `opening` (0 to 1).
    ///
    /// # Panics
    /// When the cell's arms do not have four joints each, there are more than two, or `at` is of others.
    #[must_use]
    pub fn new(cell: Cell, at: &[Joints], opening: f64, config: SimulatedConfig) -> Self {
        assert!(
            (1..=2).contains(&cell.arms.len()) && cell.arms.len() == at.len(),
            "one or two arms"
        );
        assert!(at.iter().all(|angles| angles.len() == 4), "arms with four joints");
        let rng = |source| episode_rng(config.seed, source as u64, Stream::Reset);
        let carried: Vec<Carried> = carried(&cell, at).collect();
        let opening = opening.clamp(0.0, 1.0);
        let world = World::new(&config, &carried, DVec3::splat(opening).as_vec3().x);
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

    /// Does something to the arms from outside, from now on.
    pub fn disturb(&mut self, disturbance: Disturbance) {
        self.disturbance = disturbance;
    }

    /// Simulated time, seconds.
    #[must_use]
    pub fn time_s(&self) -> f64 {
        self.drives.n_periods() as f64 * PERIOD_S
    }

    /// The true joint angles of an arm, radians.
    ///
    /// # Panics
    /// When there is no such arm.
    #[must_use]
    pub fn angles(&self, arm: ArmIndex) -> &Joints {
        &self.drives.arms[arm.0].angles
    }

    /// The true joint velocities of an arm, radians per second.
    ///
    /// # Panics
    /// When there is no such arm.
    #[must_use]
    pub fn velocities(&self, arm: ArmIndex) -> &Joints {
        &self.drives.arms[arm.0].velocities
    }

    /// The true gaps round the arms, metres.
    #[must_use]
    pub fn gaps(&self) -> &Gaps {
        self.drives.gaps()
    }

    /// What the arms touched in the last period: each other, or the table.
    #[must_use]
    pub fn contacts(&self) -> Contacts {
        self.contacts
    }

    /// Whether two parts of `arm` itself touched in the last period.
    ///
    /// # Panics
    /// When there is no such arm.
    #[must_use]
    pub fn touches_itself(&self, arm: ArmIndex) -> bool {
        self.self_contacts[arm.0]
    }

    /// Where the objects truly are.
    #[must_use]
    pub fn objects(&self) -> Vec<ObjectPose> {
        objects(&self.world, self.time_s())
    }

    /// Where the cameras saw the objects in the newest picture that is known.
    #[must_use]
    pub fn seen(&self) -> &[ObjectPose] {
        self.cameras.seen()
    }

    /// What everything looks like.
    #[must_use]
    pub fn scene(&self) -> Scene {
        let angles: Vec<Joints> = self.drives.arms.iter().map(|arm| arm.angles).collect();
        scene::scene(&self.cell, &angles, &self.world, &self.config.blocks, self.time_s())
    }

    fn simulate_period(&mut self) {
        self.drives.begin_period();
        self.contacts = Contacts::NONE;
        self.self_contacts.fill(false);
        let n_arms = self.cell.arms.len();
        let mut forces_n = vec![DVec3::ZERO; n_arms];
        for _ in 0..N_SUBSTEPS {
            let torques = self.torques_nm.clone();
            let opened: Vec<f64> = (0..n_arms).map(|arm| self.world.opening(arm)).collect();
            self.drives.step(&self.cell, &self.config, &self.disturbance, &opened, &torques);
            let angles: Vec<Joints> = self.drives.arms.iter().map(|arm| arm.angles).collect();
            let carried: Vec<Carried> = carried(&self.cell, &angles).collect();
            let openings: Vec<f64> = self.drives.arms.iter().map(|arm| arm.opening).collect();
            self.world.step(&carried, &openings, &self.config.gripper);
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
        self.cameras.look(self.drives.n_periods(), || objects(&self.world, time_s));
    }

    /// A force on the tool (world frame, newtons) and whoever leans on the arm, as torques of the joints.
    fn torques(&self, arm: usize, force_n: DVec3) -> Joints {
        let placed = &self.cell.arms[arm];
        let posture = Posture::of(placed.model, &self.drives.arms[arm].angles);
        let in_base = placed.axes().transpose() * force_n;
        let leaning = self.disturbance.torque_nm.get(arm);
        Joints::from_fn(placed.model.n_joints(), |joint| {
            posture.tool_motion(joint).0.dot(in_base) + leaning.map_or(0.0, |nm| nm[joint])
        })
    }

    fn read(&mut self) -> PairState {
        let tripped = self.drives.tripped();
        let mut arms = Vec::with_capacity(self.cell.arms.len());
        for (idx, arm) in self.drives.arms.iter().enumerate() {
            let (opening, torques) = (self.world.opening(idx), &self.torques_nm[idx]);
            let contact = self.self_contacts[idx];
            let faults = Faults { drive: tripped, contact, emergency_stop: false };
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
        self.drives.hand_over(command.clone(), self.config.latency_periods);
        self.simulate_period();
        if !self.world.is_finite() {
            return Err(DriverError::Malformed { what: "an object is nowhere".into() });
        }
        Ok(self.read())
    }

    fn stop(&mut self) -> Result<(), DriverError> {
        self.drives.stop(self.config.latency_periods);
        Ok(())
    }
}

/// Where joint angles bring what the physics knows of the arms.
fn carried(cell: &Cell, angles: &[Joints]) -> impl Iterator<Item = Carried> {
    cell.arms.iter().zip(angles).map(|(placed, angles)| {
        let posture = Posture::of(placed.model, angles);
        let tool = posture.tool();
        Carried {
            tool_m: placed.world_from_base(tool.origin_m),
            tool_axes: placed.axes() * tool.axes,
            forearm_m: FOREARM_FRAMES.map(|frame| {
                let anchor = Anchor { frame, offset_m: DVec3::ZERO };
                placed.world_from_base(posture.anchor(&anchor))
            }),
        }
    })
}

fn objects(world: &World, time_s: f64) -> Vec<ObjectPose> {
    let pose = |idx| {
        let body = world.object(idx);
        let at_m = body.translation().as_dvec3();
        ObjectPose { at_m, turn: body.rotation().as_dquat(), time_s }
    };
    (0..world.n_objects()).map(pose).collect()
}
