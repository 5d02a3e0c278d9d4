//! An arm: a hand, which is a body of the physics simulation, and the joints that follow it.
//!
//! The joints of a Jaco follow by iterated inverse kinematics, those of a Mico have a closed form.

use rapier3d::glamx::{DMat3, DVec3};
use rapier3d::math::{Matrix, Vector};
use tandem_core::{ArmIndex, Task};

use crate::config::WorldConfig;
use crate::frame::ArmFrame;
use crate::hand::{Gripper, Hand, HandSettings};
use crate::kinematics::{ForwardKinematics, HOME, JointAngles, solve_inverse};
use crate::mico::{JointPoints, Mico};
use crate::parameters::{ArmKind, WorldParameters};
use crate::physics::Physics;

/// Displacement of the end effector for an action of 1, metres.
pub(crate) const ACTION_M: f32 = 0.05;
/// Iterations of the inverse kinematics from the joint angles of one control step to those of the next.
pub(crate) const TRACK_ITERATIONS: usize = 3;
/// Iterations of the inverse kinematics from the home posture to any point of the workspace.
pub(crate) const REACH_ITERATIONS: usize = 100;

/// The command to one arm for a control step.
#[derive(Clone, Copy)]
pub(crate) struct Command {
    /// Target of the end effector, world frame, metres.
    pub(crate) target: Vector,
    /// Input of the gripper in [−1, 1]: positive values open it, −1 closes it and holds.
    pub(crate) gripper: f32,
}

/// One arm and its hand.
#[derive(Clone)]
pub(crate) struct Arm {
    pub(crate) frame: ArmFrame,
    pub(crate) hand: Hand,
    pub(crate) parameters: &'static WorldParameters,
    /// Joint angles of a Jaco at the start of the latest control step.
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
        let parameters = WorldParameters::of(task.world());
        let settings = HandSettings {
            gripper: if task.grasps() { Gripper::Driven } else { Gripper::Locked },
            geometry: parameters.gripper,
            surfaces: config.surfaces(task),
            grip_force_n: config.grip_force_n,
            palm_force_n: parameters.palm_force_n,
            mico: match parameters.arms {
                ArmKind::Jaco => None,
                ArmKind::Mico => Some(Mico::in_shared_world()),
            },
        };
        let hand = Hand::build(physics, arm, frame, settings);
        Self { frame, hand, parameters, angles: HOME }
    }

    /// Places the arm, at rest, with its end effector at `end_effector_in_arm` (metres) and each side of the gripper
    /// open by `opening_m`. The joint angles depend on this position only.
    pub(crate) fn place(
        &mut self,
        physics: &mut Physics,
        end_effector_in_arm: Vector,
        opening_m: f32,
    ) {
        self.hand.place(physics, end_effector_in_arm, opening_m);
        if self.parameters.arms == ArmKind::Jaco {
            self.angles = solve_inverse(HOME, self.tool_in_base(physics), REACH_ITERATIONS);
        }
    }

    /// Updates the joint angles to the current position of the hand.
    pub(crate) fn track(&mut self, physics: &Physics) {
        if self.parameters.arms == ArmKind::Jaco {
            self.angles = self.angles_now(physics, TRACK_ITERATIONS);
        }
    }

    /// Returns the joints of a Mico for the current position of the hand, arm frame, metres; nothing for another arm.
    pub(crate) fn mico_joints(&self, physics: &Physics) -> Option<JointPoints> {
        let in_arm = self.frame.arm_from_world(self.hand.end_effector(physics));
        self.hand.settings.mico.map(|mico| mico.posture(in_arm).joints())
    }

    /// Returns the joint angles of a Jaco for the current position of the hand, radians.
    pub(crate) fn angles_now(&self, physics: &Physics, n_iterations: usize) -> JointAngles {
        solve_inverse(self.angles, self.tool_in_base(physics), n_iterations)
    }

    /// Returns the target that `action` (arm frame, in [−1, 1]) commands, clamped to the workspace; world frame,
    /// metres.
    ///
    /// The displacement is relative to the hand, not to the previous target, so a blocked hand causes no wind-up.
    pub(crate) fn target(&self, physics: &Physics, action: Vector) -> Vector {
        let at_in_arm = self.frame.arm_from_world(self.hand.end_effector(physics));
        let target_in_arm = self.parameters.clamp(at_in_arm + action * ACTION_M);
        self.frame.world_from_arm(target_in_arm)
    }

    /// Returns the velocity of the palm towards `target`, world frame, metres per second.
    pub(crate) fn velocity_to(&self, physics: &Physics, target: Vector) -> Vector {
        let velocity =
            (target - self.hand.end_effector(physics)) * self.parameters.approach_gain_per_s;
        self.parameters.limit_speed(velocity)
    }

    /// Returns the origin of each of the link frames `frames` of a Jaco (world frame, metres) and its Jacobian with
    /// respect to the palm's position.
    pub(crate) fn point_jacobians<const N: usize>(
        &self,
        frames: [usize; N],
    ) -> [(Vector, Matrix); N] {
        let forward = ForwardKinematics::new(&self.angles);
        let jacobians = forward.point_jacobians(frames);
        std::array::from_fn(|idx| {
            let position = self.world_from_base(forward.point(frames[idx]));
            (position, self.frame.jacobian_in_world(single_precision(jacobians[idx])))
        })
    }

    /// Transforms a point from the arm's base frame to the world frame, metres.
    pub(crate) fn world_from_base(&self, in_base: DVec3) -> Vector {
        self.frame.world_from_arm(in_base.as_vec3() + self.parameters.base_in_arm)
    }

    fn tool_in_base(&self, physics: &Physics) -> DVec3 {
        let in_arm = self.frame.arm_from_world(self.hand.end_effector(physics));
        (in_arm - self.parameters.base_in_arm).as_dvec3()
    }
}

fn single_precision(matrix: DMat3) -> Matrix {
    Matrix::from_cols(matrix.x_axis.as_vec3(), matrix.y_axis.as_vec3(), matrix.z_axis.as_vec3())
}
