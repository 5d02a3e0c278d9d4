//! What the policy sees and asks for, and where that is on the real table.
//!
//! **Places.** A metre of the training world is a metre here. What the policy calls the end effector is the point between the
//! pads: the tool's origin stands [`PADS_AHEAD_M`] behind it, along the tilted gripper, and [`HAND_LIFT_M`] higher than the
//! training world has it, because the real fingers are longer than their pads. Objects and goals lie where the
//! policy has them, with the difference that a block that lies on the table is as high as it is: heights are counted from
//! a resting block.
//!
//! **Time.** Arms are slower than the training world's hands, and a step of a policy takes as long as the arms need for it.
//! The policy counts on a hand with inertia, so its hand is played on by the training world's servo ([`Mapping::hand_after`]): the arm is
//! sent to where that hand would be after the step, and the policy is told the velocity that it would have. Objects have
//! the velocity of the hand as far as they moved with it.
//!
//! **Openings.** The policy knows a gripper that opens by [`OPENING_M`] on each side and blocks of one size. Where its
//! pads would touch such a block the real ones touch the real block, where they are shut they are shut, and
//! where they are open they are open; between, openings are in proportion.

use glam::{DQuat, DVec3};
use tandem_core::{ArmIndex, Layout, Task};
use tandem_kinematics::{Cell, Joints, PlacedArm, ReachError, TaskFrame};

use crate::simulated::{Block, MAX_OPENING_M, ObjectPose};

/// Distance from the tool's origin to the point between the pads, metres.
pub const PADS_AHEAD_M: f64 = 0.021;
/// How much higher the point between the pads is than the policy's end effector, metres.
pub const HAND_LIFT_M: f64 = 0.009;
/// Gap between an arm's parts and the table that hands keep, metres: more than the check asks for.
pub const TABLE_GAP_M: f64 = 0.006;
/// How far each side of the training world's gripper opens, metres.
pub const OPENING_M: f64 = 0.040;
/// Half the edge of the training world's blocks, metres.
pub const TRAINED_HALF_M: f64 = 0.0225;
/// Displacement that an action of 1 asks for, metres.
const ACTION_M: f64 = 0.05;
/// The training world's servo: share of the way to its target per second (1/s), largest acceleration along an axis (metres per
/// second squared), time of a physics step (seconds) and steps in a control step.
const APPROACH_GAIN: f64 = 27.0;
const ACCELERATION_MPS2: f64 = 40.0 / 1.4;
const SUBSTEP_S: f64 = 0.002;
const N_SUBSTEPS: u32 = 20;
/// Time of a control step, seconds.
const CONTROL_STEP_S: f64 = 0.04;
/// Velocity at a step's end per way covered in it, for what moves by itself: what is left of the way, times the servo's gain.
const END_VELOCITY_SHARE: f64 = 0.556;
/// How far the training world's gripper moves in a step with an action of 1, metres.
const OPENING_STEP_M: f64 = 0.010;
/// Where the policy's end effectors may be, own frames: low and high corner, metres.
const WORKSPACE_M: [DVec3; 2] = [DVec3::new(-0.20, -0.25, 0.022), DVec3::new(0.20, 0.25, 0.35)];
/// Rounds in which the tool's place is found for a point between the pads.
const TILT_ROUNDS: usize = 4;

/// How a policy's world lies in a cell.
#[derive(Debug, Clone)]
pub struct Mapping {
    cell: Cell,
    /// Each arm alone, for its gap to the table.
    alone: Vec<Cell>,
    layout: Layout,
    block_half_m: f64,
}

/// What one arm and its object are like at one moment, as a policy knows them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmMoment {
    /// End effector, own frame, metres.
    pub hand: DVec3,
    /// Its velocity as the training world has it, metres per second.
    pub hand_velocity: DVec3,
    /// How far each side of the gripper is open, metres.
    pub opening_m: f64,
    /// Object, own frame, metres.
    pub object: DVec3,
    /// How the object is turned in the own frame.
    pub turn: DQuat,
}

impl Mapping {
    /// The mapping of `layout`'s world with blocks like `block` into `cell`.
    #[must_use]
    pub fn new(cell: Cell, layout: Layout, block: &Block) -> Self {
        let task_frame = TaskFrame { scale: 1.0, lift_m: 0.0, ..cell.task_frame };
        let cell = Cell { task_frame, ..cell };
        let alone = |arm: &PlacedArm| Cell { arms: vec![*arm], ..cell.clone() };
        let alone = cell.arms.iter().map(alone).collect();
        Self { cell, alone, layout, block_half_m: f64::from(block.half_m) }
    }

    /// The cell, with the table as the origin of heights.
    #[must_use]
    pub fn cell(&self) -> &Cell {
        &self.cell
    }

    /// Where an object or goal at `own` (own frame of `arm`, metres) is in the world.
    #[must_use]
    pub fn object_in_world(&self, arm: ArmIndex, own: DVec3) -> DVec3 {
        self.cell.world_from_own(arm, own + DVec3::Z * (self.block_half_m - TRAINED_HALF_M))
    }

    /// Where the policy has an object that is at `in_world`, metres.
    #[must_use]
    pub fn object_in_own(&self, arm: ArmIndex, in_world: DVec3) -> DVec3 {
        self.own(arm, in_world) - DVec3::Z * (self.block_half_m - TRAINED_HALF_M)
    }

    /// Where the tool's origin has to be in the world, and the angles near `near` with which it is there, so that the point between
    /// the pads is where the policy has its end effector: `own`, metres. Lower than [`TABLE_GAP_M`] allows no hand goes.
    ///
    /// # Errors
    /// Says why the arm cannot be there.
    pub fn tool_in_world(
        &self,
        arm: ArmIndex,
        own: DVec3,
        near: &Joints,
    ) -> Result<(DVec3, Joints), ReachError> {
        self.tool_for_pads(arm, self.pads_in_world(arm, own), near)
    }

    /// Where the point between the pads is in the world for an end effector at `own` (own frame of `arm`), metres.
    #[must_use]
    pub fn pads_in_world(&self, arm: ArmIndex, own: DVec3) -> DVec3 {
        self.cell.world_from_own(arm, own + DVec3::Z * HAND_LIFT_M)
    }

    /// As [`tool_in_world`](Self::tool_in_world), for a point between the pads in the world, metres.
    ///
    /// # Errors
    /// Says why the arm cannot be there.
    pub fn tool_for_pads(
        &self,
        arm: ArmIndex,
        mut pads: DVec3,
        near: &Joints,
    ) -> Result<(DVec3, Joints), ReachError> {
        let placed = &self.cell.arms[arm.0];
        let mut tool = pads + DVec3::Z * PADS_AHEAD_M;
        let mut angles = *near;
        for _ in 0..TILT_ROUNDS {
            angles = placed.model.nearest(&placed.target(tool), near)?.angles;
            let gap_m = self.alone[arm.0].gaps(&[angles]).table_m[0];
            pads.z += (TABLE_GAP_M - gap_m).max(0.0);
            tool = pads - pointing(placed, &angles) * PADS_AHEAD_M;
        }
        Ok((tool, angles))
    }

    /// The policy's end effector when the joints of `arm` are at `angles`, radians; own frame, metres.
    #[must_use]
    pub fn hand_in_own(&self, arm: ArmIndex, angles: &Joints) -> DVec3 {
        let placed = &self.cell.arms[arm.0];
        let posture = tandem_kinematics::Posture::of(placed.model, angles);
        let tool = placed.world_from_base(posture.tool().origin_m);
        let pads = tool + pointing(placed, angles) * PADS_AHEAD_M;
        self.own(arm, pads) - DVec3::Z * HAND_LIFT_M
    }

    /// The real gripper's opening (0 to 1) for one that the policy has at `opening_m` on each side.
    #[must_use]
    pub fn opening(&self, opening_m: f64) -> f64 {
        let touching = self.block_half_m / f64::from(MAX_OPENING_M);
        if opening_m < TRAINED_HALF_M {
            (touching * opening_m / TRAINED_HALF_M).max(0.0)
        } else {
            let beyond = (opening_m - TRAINED_HALF_M) / (OPENING_M - TRAINED_HALF_M);
            (touching + (1.0 - touching) * beyond).min(1.0)
        }
    }

    /// What the policy is told of a real gripper that is open by `opening`, 0 to 1; metres on each side.
    #[must_use]
    pub fn opening_in_own(&self, opening: f64) -> f64 {
        let touching = self.block_half_m / f64::from(MAX_OPENING_M);
        if opening < touching {
            (TRAINED_HALF_M * opening / touching).max(0.0)
        } else {
            let beyond = (opening - touching) / (1.0 - touching);
            (TRAINED_HALF_M + (OPENING_M - TRAINED_HALF_M) * beyond).min(OPENING_M)
        }
    }

    /// What `arm` and its object are like to the policy.
    #[must_use]
    pub fn moment(
        &self,
        arm: ArmIndex,
        angles: &Joints,
        opening: f64,
        hand_velocity: DVec3,
        seen: &ObjectPose,
    ) -> ArmMoment {
        let upright = DQuat::from_rotation_z(-self.cell.arms[arm.0].yaw_rad);
        let opening_m = match self.layout.task {
            Task::Push => 0.0,
            Task::PickAndPlace => self.opening_in_own(opening),
        };
        ArmMoment {
            hand: self.hand_in_own(arm, angles),
            hand_velocity,
            opening_m,
            object: self.object_in_own(arm, seen.at_m),
            turn: upright * seen.turn * upright.inverse(),
        }
    }

    /// Where the training world's hand would be after a step with `action` (one arm's, in [−1, 1]) from `hand` with `velocity`,
    /// and its velocity then; own frame, metres and metres per second.
    #[must_use]
    pub fn hand_after(&self, hand: DVec3, velocity: DVec3, action: &[f32]) -> (DVec3, DVec3) {
        let asked = DVec3::from_array([0, 1, 2].map(|axis| f64::from(action[axis])));
        let displacement = asked.clamp(DVec3::NEG_ONE, DVec3::ONE) * ACTION_M;
        let target = (hand + displacement).clamp(WORKSPACE_M[0], WORKSPACE_M[1]);
        let most = DVec3::splat(ACCELERATION_MPS2 * SUBSTEP_S);
        let (mut at, mut velocity) = (hand, velocity);
        for _ in 0..N_SUBSTEPS {
            velocity += ((target - at) * APPROACH_GAIN - velocity).clamp(-most, most);
            at += velocity * SUBSTEP_S;
        }
        let inside = at.clamp(WORKSPACE_M[0], WORKSPACE_M[1]);
        (inside, velocity)
    }

    /// How far each side of the gripper shall be open after a step with `action` from `opening_m`, metres. What is in the way does
    /// not count: a gripper that holds something is told to shut.
    #[must_use]
    pub fn opening_after(&self, opening_m: f64, action: &[f32]) -> f64 {
        match self.layout.task {
            Task::Push => 0.0,
            Task::PickAndPlace => {
                let step_m = f64::from(action[3].clamp(-1.0, 1.0)) * OPENING_STEP_M;
                (opening_m + step_m).clamp(0.0, OPENING_M)
            }
        }
    }

    fn own(&self, arm: ArmIndex, in_world: DVec3) -> DVec3 {
        let in_base = self.cell.arms[arm.0].base_from_world(in_world);
        self.cell.task_frame.own_from_base(in_base)
    }
}

/// Writes what the policy sees of one arm, shape `[28]`, as the training world does: `now`, and how it came there from one
/// step `before`.
pub fn observe_arm(now: &ArmMoment, before: &ArmMoment, observation: &mut [f32]) {
    let hand_velocity = now.hand_velocity * CONTROL_STEP_S;
    let (hand_way, object_way) = (now.hand - before.hand, now.object - before.object);
    let together = object_way.dot(hand_way) / hand_way.length_squared().max(1e-6);
    let together = together.clamp(0.0, 1.0);
    let object_velocity =
        hand_velocity * together + (object_way - hand_way * together) * END_VELOCITY_SHARE;
    let turn = (now.turn * before.turn.inverse()).normalize();
    let turn = if turn.w < 0.0 { -turn } else { turn };
    let turn_velocity = turn.to_scaled_axis() * END_VELOCITY_SHARE;
    let opening_rate_m = now.opening_m - before.opening_m;
    let facing = if now.turn.w < 0.0 { -now.turn } else { now.turn };
    let parts = [
        now.hand,
        now.object,
        now.object - now.hand,
        DVec3::splat(now.opening_m),
        DVec3::new(facing.x, facing.y, facing.z),
    ];
    let rates = [
        object_velocity - hand_velocity,
        turn_velocity,
        hand_velocity,
        DVec3::splat(opening_rate_m),
    ];
    for (idx, part) in parts.iter().enumerate() {
        observation[3 * idx..3 * idx + 3].copy_from_slice(&part.as_vec3().to_array());
    }
    observation[15] = facing.as_quat().w;
    for (idx, part) in rates.iter().enumerate() {
        observation[16 + 3 * idx..19 + 3 * idx].copy_from_slice(&part.as_vec3().to_array());
    }
}

/// The way a gripper points, world frame.
fn pointing(placed: &PlacedArm, angles: &Joints) -> DVec3 {
    placed.axes() * tandem_kinematics::Posture::of(placed.model, angles).tool().axes.z_axis
}
