//! The mapping between the policy's observations and actions and the real table.
//!
//! **Positions.** Lengths are not scaled. The policy's end effector is the point between the pads. The tool's origin is
//! [`PADS_AHEAD_M`] behind it along the tilted gripper, and higher than in the training world if its hand can be lower
//! than [`PADS_LOWEST_M`], because the real fingers extend beyond their pads. Objects and goals keep their positions.
//! Heights are measured from a block that rests on the table, so blocks of any size start at the height that the policy
//! knows.
//!
//! **Time.** The arms are slower than the training world's hands, and a step takes as long as the arms need. The policy
//! expects a hand with inertia, so the training world's servo continues its hand ([`Mapping::hand_after`]): the arm
//! moves to the position of that hand after the step, and the policy observes its velocity. Objects have the hand's
//! velocity to the extent that they moved with it.
//!
//! **Openings.** The policy knows the training world's gripper and blocks of one size. Three openings correspond:
//! closed, open, and just touching the block. Openings in between are interpolated linearly.

use glam::{DQuat, DVec3};
use tandem_core::{ArmIndex, Layout};
use tandem_kinematics::{Joints, PADS_AHEAD_M, PlacedArm, ReachError, TaskFrame, WorkCell};

use crate::simulated::{Block, MAX_OPENING_M, ObjectPose};
use crate::trial::training_hand::TrainingHand;

/// The smallest height of the point between the pads above the table, metres.
pub const PADS_LOWEST_M: f64 = 0.031;
/// The gap between an arm's parts and the table that hands keep, metres; more than the check requires.
pub const TABLE_GAP_M: f64 = 0.006;
/// Half the edge of the training world's blocks unless their sizes vary, metres.
pub const TRAINED_HALF_M: f64 = 0.0225;
/// Where a hand is out of the way: x (from the middle of the arm's area away from its base, metres) and height above
/// the table, metres.
const WITHDRAWN_POSITION_M: [f64; 2] = [-0.05, 0.20];
/// The number of iterations that determine the tool's position for a point between the pads.
const TILT_ROUNDS: usize = 4;

/// The mapping of a policy's world into a work cell.
///
/// # Panics
/// Methods panic if there is no such arm, or an action is shorter than the task's for one arm.
#[derive(Debug, Clone)]
pub struct Mapping {
    cell: WorkCell,
    /// Work cells with one arm each, for the gaps to the table.
    alone: Vec<WorkCell>,
    layout: Layout,
    hand: TrainingHand,
    /// The height of the point between the pads above the policy's end effector, metres.
    hand_lift_m: f64,
    block_half_m: f64,
    /// Half the edge of the blocks that the policy knows, metres.
    trained_half_m: f64,
}

/// One arm and its object at one time, in the policy's terms.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmObservation {
    /// The end effector, arm frame, metres.
    pub hand: DVec3,
    /// The velocity of the training world's end effector, arm frame, metres per second.
    pub hand_velocity: DVec3,
    /// The opening of each side of the policy's gripper, metres; 0 in tasks without grasping.
    pub opening_m: f64,
    /// The object, arm frame, metres.
    pub object: DVec3,
    /// The orientation of the object, arm frame.
    pub orientation: DQuat,
}

impl Mapping {
    /// Creates the mapping of the world of `layout`, with hands like `hand` and blocks like `block`, into `cell`. A
    /// shared object counts as blocks of its width. The policy knows blocks with half an edge of `trained_half_m`
    /// metres.
    #[must_use]
    pub fn new(
        cell: WorkCell,
        layout: Layout,
        hand: TrainingHand,
        block: &Block,
        trained_half_m: f64,
    ) -> Self {
        let task_frame = TaskFrame { scale: 1.0, lift_m: 0.0, ..cell.task_frame };
        let cell = WorkCell { task_frame, ..cell };
        let alone = |arm: &PlacedArm| WorkCell { arms: vec![*arm], ..cell.clone() };
        let alone = cell.arms.iter().map(alone).collect();
        let hand_lift_m = 1e-6 * ((PADS_LOWEST_M - hand.lowest_m()) * 1e6).round();
        let block_half_m = f64::from(block.half_m);
        Self { cell, alone, layout, hand, hand_lift_m, block_half_m, trained_half_m }
    }

    /// The work cell, with the table as the origin of heights.
    #[must_use]
    pub fn cell(&self) -> &WorkCell {
        &self.cell
    }

    /// Converts the position of an object or goal from the frame of `arm` to the world frame, metres.
    #[must_use]
    pub fn object_in_world(&self, arm: ArmIndex, in_arm: DVec3) -> DVec3 {
        let lifted = in_arm + DVec3::Z * (self.block_half_m - self.trained_half_m);
        self.cell.world_from_arm(arm, &lifted.into()).into()
    }

    /// Converts the position of an object or goal from the world frame to the frame of `arm`, metres.
    #[must_use]
    pub fn object_in_arm(&self, arm: ArmIndex, in_world: DVec3) -> DVec3 {
        self.in_arm(arm, in_world) - DVec3::Z * (self.block_half_m - self.trained_half_m)
    }

    /// Returns the tool's origin (world frame, metres) for the policy's end effector at `in_arm` (arm frame, metres),
    /// and the joint angles near `near` that reach it, radians. Hands that would come nearer to the table than
    /// [`TABLE_GAP_M`] are raised.
    ///
    /// # Errors
    /// Returns an error if the arm cannot reach the position.
    pub fn tool_in_world(
        &self,
        arm: ArmIndex,
        in_arm: DVec3,
        near: &Joints,
    ) -> Result<(DVec3, Joints), ReachError> {
        self.tool_for_pads(arm, self.pads_in_world(arm, in_arm), near)
    }

    /// Converts a point between the pads from the world frame to the policy's end effector in the frame of `arm`,
    /// metres: the inverse of [`pads_in_world`](Self::pads_in_world).
    #[must_use]
    pub fn hand_of_pads(&self, arm: ArmIndex, in_world: DVec3) -> DVec3 {
        self.in_arm(arm, in_world) - DVec3::Z * self.hand_lift_m
    }

    /// Converts an end effector at `in_arm` (frame of `arm`) to the point between the pads, world frame, metres.
    #[must_use]
    pub fn pads_in_world(&self, arm: ArmIndex, in_arm: DVec3) -> DVec3 {
        self.cell.world_from_arm(arm, &(in_arm + DVec3::Z * self.hand_lift_m).into()).into()
    }

    /// As [`tool_in_world`](Self::tool_in_world), for a point between the pads in the world frame, metres.
    ///
    /// # Errors
    /// Returns an error if the arm cannot reach the position.
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
            angles = placed.model.inverse_kinematics(&placed.target(&tool.into()), near)?.angles;
            let gap_m = self.alone[arm.0].gaps(&[angles]).table_m[0];
            pads.z += (TABLE_GAP_M - gap_m).max(0.0);
            tool = pads - pointing(placed, &angles) * PADS_AHEAD_M;
        }
        Ok((tool, angles))
    }

    /// Returns the policy's end effector for joint angles `angles` (radians) of `arm`, arm frame, metres.
    #[must_use]
    pub fn hand_in_arm(&self, arm: ArmIndex, angles: &Joints) -> DVec3 {
        let placed = &self.cell.arms[arm.0];
        let posture = tandem_kinematics::ForwardKinematics::new(placed.model, angles);
        let tool = DVec3::from(placed.world_from_base() * posture.tool_m());
        let pads = tool + pointing(placed, angles) * PADS_AHEAD_M;
        self.hand_of_pads(arm, pads)
    }

    /// Returns the real gripper's opening (0 to 1) for the policy's opening of `opening_m` on each side.
    #[must_use]
    pub fn opening(&self, opening_m: f64) -> f64 {
        let touching = self.block_half_m / f64::from(MAX_OPENING_M);
        if opening_m < self.trained_half_m {
            (touching * opening_m / self.trained_half_m).max(0.0)
        } else {
            let most_m = self.hand.max_opening_m();
            let beyond = (opening_m - self.trained_half_m) / (most_m - self.trained_half_m);
            (touching + (1.0 - touching) * beyond).min(1.0)
        }
    }

    /// Returns the policy's opening (metres on each side) for the real gripper's `opening`, 0 to 1.
    #[must_use]
    pub fn policy_opening_m(&self, opening: f64) -> f64 {
        let touching = self.block_half_m / f64::from(MAX_OPENING_M);
        if opening < touching {
            (self.trained_half_m * opening / touching).max(0.0)
        } else {
            let beyond = (opening - touching) / (1.0 - touching);
            let most_m = self.hand.max_opening_m();
            (self.trained_half_m + (most_m - self.trained_half_m) * beyond).min(most_m)
        }
    }

    /// Converts measurements of `arm` and its object to the policy's terms: joint angles `angles` (radians), the real
    /// gripper's `opening` (0 to 1), the velocity of the training world's hand (arm frame, metres per second) and the
    /// object as seen (world frame).
    #[must_use]
    pub fn observe(
        &self,
        arm: ArmIndex,
        angles: &Joints,
        opening: f64,
        hand_velocity: DVec3,
        seen: &ObjectPose,
    ) -> ArmObservation {
        let upright = DQuat::from_rotation_z(-self.cell.arms[arm.0].yaw_rad);
        let opening_m =
            if self.layout.task.grasps() { self.policy_opening_m(opening) } else { 0.0 };
        ArmObservation {
            hand: self.hand_in_arm(arm, angles),
            hand_velocity,
            opening_m,
            object: self.object_in_arm(arm, seen.at_m),
            orientation: upright * seen.orientation * upright.inverse(),
        }
    }

    /// Returns the nearest position to `hand` that the training world's hand may have; arm frame, metres.
    #[must_use]
    pub fn reachable_hand(&self, hand: DVec3) -> DVec3 {
        self.hand.reachable(hand)
    }

    /// The largest opening of each side of the policy's gripper, metres.
    #[must_use]
    pub fn max_opening_m(&self) -> f64 {
        self.hand.max_opening_m()
    }

    /// Returns the position to which a hand at `hand` withdraws to make room for other arms: near its base and above
    /// the objects on the table; arm frame, metres.
    #[must_use]
    pub fn withdrawn_hand(&self, hand: DVec3) -> DVec3 {
        self.hand.reachable(DVec3::new(
            WITHDRAWN_POSITION_M[0],
            0.5 * hand.y,
            WITHDRAWN_POSITION_M[1],
        ))
    }

    /// Returns the position and velocity of the training world's hand after a step with `action` (one arm's, shape
    /// `[action_per_arm]`, in [−1, 1]) from `hand` with `velocity`; arm frame, metres and metres per second.
    #[must_use]
    pub fn hand_after(&self, hand: DVec3, velocity: DVec3, action: &[f32]) -> (DVec3, DVec3) {
        self.hand.after(hand, velocity, action)
    }

    /// Returns the opening of each side of the policy's gripper to command after a step with `action` (one arm's, of a
    /// task of grasping), metres. `commanded_m` was commanded before and `actual_m` reached, metres. A gripper that
    /// closes is commanded beyond an object between its pads, which presses on it; one that opens starts from the
    /// object's size, as in the training world.
    #[must_use]
    pub fn opening_after(&self, commanded_m: f64, actual_m: f64, action: &[f32]) -> f64 {
        if !self.layout.task.grasps() {
            return 0.0;
        }
        let input = f64::from(action[3].clamp(-1.0, 1.0));
        let from_m = if input > 0.0 { commanded_m.max(actual_m) } else { commanded_m };
        (from_m + input * self.hand.opening_step_m()).clamp(0.0, self.hand.max_opening_m())
    }

    /// Writes the policy's observation of one arm, shape `[28]`, in the training world's format. Velocities follow from
    /// the difference between `now` and one step `before`.
    pub fn write_observation(
        &self,
        now: &ArmObservation,
        before: &ArmObservation,
        observation: &mut [f32],
    ) {
        write_observation(&self.hand, now, before, observation);
    }

    fn in_arm(&self, arm: ArmIndex, in_world: DVec3) -> DVec3 {
        let in_base =
            self.cell.arms[arm.0].world_from_base().inverse_transform_point(&in_world.into());
        self.cell.task_frame.arm_from_base(&in_base).into()
    }
}

/// As [`Mapping::write_observation`], for a training world with `hand`.
fn write_observation(
    hand: &TrainingHand,
    now: &ArmObservation,
    before: &ArmObservation,
    observation: &mut [f32],
) {
    let hand_velocity = now.hand_velocity * hand.control_step_s();
    let end_velocity_share = hand.end_velocity_share();
    let (hand_displacement, object_displacement) =
        (now.hand - before.hand, now.object - before.object);
    let together =
        object_displacement.dot(hand_displacement) / hand_displacement.length_squared().max(1e-6);
    let together = together.clamp(0.0, 1.0);
    let object_velocity = hand_velocity * together
        + (object_displacement - hand_displacement * together) * end_velocity_share;
    let rotation = (now.orientation * before.orientation.inverse()).normalize();
    let rotation = if rotation.w < 0.0 { -rotation } else { rotation };
    let angular_velocity = rotation.to_scaled_axis() * end_velocity_share;
    let opening_rate_m = now.opening_m - before.opening_m;
    let orientation = if now.orientation.w < 0.0 { -now.orientation } else { now.orientation };
    let parts = [
        now.hand,
        now.object,
        now.object - now.hand,
        DVec3::splat(now.opening_m),
        DVec3::new(orientation.x, orientation.y, orientation.z),
    ];
    let rates = [
        object_velocity - hand_velocity,
        angular_velocity,
        hand_velocity,
        DVec3::splat(opening_rate_m),
    ];
    for (idx, part) in parts.iter().enumerate() {
        observation[3 * idx..3 * idx + 3].copy_from_slice(&part.as_vec3().to_array());
    }
    observation[15] = orientation.as_quat().w;
    for (idx, part) in rates.iter().enumerate() {
        observation[16 + 3 * idx..19 + 3 * idx].copy_from_slice(&part.as_vec3().to_array());
    }
}

/// The direction of a gripper, world frame.
fn pointing(placed: &PlacedArm, angles: &Joints) -> DVec3 {
    let posture = tandem_kinematics::ForwardKinematics::new(placed.model, angles);
    (placed.world_from_base() * posture.pointing()).into()
}
