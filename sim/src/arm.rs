//! An arm: a hand that the physics knows, and the joints that carry it.

use rapier3d::glamx::{DMat3, DVec3};
use rapier3d::math::{Matrix, Vector};
use tandem_core::{ArmIndex, Task};

use crate::config::WorldConfig;
use crate::frame::{ArmFrame, BASE_IN_ARM, WORKSPACE_HIGH, WORKSPACE_LOW};
use crate::hand::{Gripper, Hand};
use crate::kinematics::{ForwardKinematics, HOME, JointAngles, solve_inverse};
use crate::physics::Physics;

/// Displacement that an action of 1 asks for, metres.
const ACTION_M: f32 = 0.05;
/// Share of the way to its target that the palm shall cover per second, 1/s.
const APPROACH_GAIN: f32 = 27.0;
/// Iterations of the inverse kinematics from the posture of one control step to the next's.
const TRACK_ITERATIONS: usize = 3;
/// Iterations of the inverse kinematics from the home posture to anywhere.
const REACH_ITERATIONS: usize = 100;

/// What one arm shall do during a control step.
#[derive(Clone, Copy)]
pub(crate) struct Command {
    /// Where the end effector shall go, world frame, metres.
    pub(crate) target: Vector,
    /// The gripper's input in [−1, 1]: positive opens, −1 closes and holds.
    pub(crate) gripper: f32,
}

/// One arm and its hand.
#[derive(Clone)]
pub(crate) struct Arm {
    pub(crate) frame: ArmFrame,
    pub(crate) hand: Hand,
    /// As of the start of the latest control step.
    angles: JointAngles,
}

impl Arm {
    pub(crate) fn build(
        physics: &mut Physics,
        arm: ArmIndex,
        frame: ArmFrame,
        task: Task,
        config: &WorldConfig,
    ) -> Self {
        let gripper = match task {
            Task::Push => Gripper::Locked,
            Task::PickAndPlace => Gripper::Driven,
        };
        let pads = config.friction(task).pads;
        let hand = Hand::build(physics, arm, frame, gripper, pads, config.grip_force_n);
        Self { frame, hand, angles: HOME }
    }

    /// Puts the arm, at rest, where its end effector is at `end_effector_in_arm` and each side of the gripper is open
    /// by `opening_m`. The joint angles follow from the place alone.
    pub(crate) fn place(
        &mut self,
        physics: &mut Physics,
        end_effector_in_arm: Vector,
        opening_m: f32,
    ) {
        self.hand.place(physics, end_effector_in_arm, opening_m);
        self.angles = solve_inverse(HOME, self.tool_in_base(physics), REACH_ITERATIONS);
    }

    /// Lets the joints follow the hand.
    pub(crate) fn track(&mut self, physics: &Physics) {
        self.angles = self.angles_now(physics, TRACK_ITERATIONS);
    }

    /// The joint angles that go with where the hand is now, radians.
    pub(crate) fn angles_now(&self, physics: &Physics, n_iterations: usize) -> JointAngles {
        solve_inverse(self.angles, self.tool_in_base(physics), n_iterations)
    }

    /// The displacement `action` (own frame, in [−1, 1]) from where the hand is now, kept inside the workspace.
    ///
    /// Counting from the hand and not from the last target, nothing winds up while the hand is blocked.
    pub(crate) fn target(&self, physics: &Physics, action: Vector) -> Vector {
        let at_in_arm = self.frame.arm_from_world(self.hand.end_effector(physics));
        let target_in_arm = (at_in_arm + action * ACTION_M).clamp(WORKSPACE_LOW, WORKSPACE_HIGH);
        self.frame.world_from_arm(target_in_arm)
    }

    /// The palm's velocity on its way to `target`, world frame, metres per second.
    pub(crate) fn velocity_to(&self, physics: &Physics, target: Vector) -> Vector {
        (target - self.hand.end_effector(physics)) * APPROACH_GAIN
    }

    /// Where the origins of the posture's `frames` are and how they move per metre of the palm; world frame, metres.
    pub(crate) fn point_jacobians<const N: usize>(
        &self,
        frames: [usize; N],
    ) -> [(Vector, Matrix); N] {
        let posture = ForwardKinematics::new(&self.angles);
        let motions = posture.point_jacobians(frames);
        std::array::from_fn(|idx| {
            let at = self.world_from_base(posture.point(frames[idx]));
            (at, self.frame.jacobian_in_world(single_precision(motions[idx])))
        })
    }

    /// A point of the arm's base frame in the world, metres.
    pub(crate) fn world_from_base(&self, in_base: DVec3) -> Vector {
        self.frame.world_from_arm(in_base.as_vec3() + BASE_IN_ARM)
    }

    fn tool_in_base(&self, physics: &Physics) -> DVec3 {
        (self.frame.arm_from_world(self.hand.end_effector(physics)) - BASE_IN_ARM).as_dvec3()
    }
}

fn single_precision(matrix: DMat3) -> Matrix {
    Matrix::from_cols(matrix.x_axis.as_vec3(), matrix.y_axis.as_vec3(), matrix.z_axis.as_vec3())
}
