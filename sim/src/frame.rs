//! The frame of each arm and its pose in the world.

use rapier3d::math::{Matrix, Rotation, Vector};
use tandem_core::ArmIndex;
use tandem_core::layout::WORKSPACE_DISTANCE_M;

/// Largest number of arms in a world.
pub(crate) const MAX_ARMS: usize = 2;

/// Distance of the origin of each arm's frame from the world's origin if there are two arms, metres.
const CENTRE_X_M: f32 = WORKSPACE_DISTANCE_M / 2.0;

/// The frame of an arm: origin on the table, x away from the arm's base, z up. In the classic world it is the centre of the
/// arm's workspace.
///
/// The second of two arms is the first one rotated by 180° about z, so coordinates in arm frames do not distinguish
/// them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ArmFrame {
    pub(crate) centre_x_m: f32,
    /// 1, or −1 if rotated by 180°.
    pub(crate) sign: f32,
}

impl ArmFrame {
    pub(crate) fn new(arm: ArmIndex, n_arms: usize) -> Self {
        match (n_arms, arm) {
            (1, _) => Self { centre_x_m: 0.0, sign: 1.0 },
            (_, ArmIndex(0)) => Self { centre_x_m: -CENTRE_X_M, sign: 1.0 },
            _ => Self { centre_x_m: CENTRE_X_M, sign: -1.0 },
        }
    }

    pub(crate) fn world_from_arm(self, point_in_arm: Vector) -> Vector {
        self.rotate(point_in_arm) + Vector::new(self.centre_x_m, 0.0, 0.0)
    }

    pub(crate) fn arm_from_world(self, point_in_world: Vector) -> Vector {
        self.rotate(point_in_world - Vector::new(self.centre_x_m, 0.0, 0.0))
    }

    /// Rotates a direction from this frame to the world frame, or back: a rotation by 180° is its own inverse.
    pub(crate) fn rotate(self, direction: Vector) -> Vector {
        Vector::new(self.sign * direction.x, self.sign * direction.y, direction.z)
    }

    /// Expresses a linear map between directions of this frame in the world frame.
    pub(crate) fn jacobian_in_world(self, jacobian_in_arm: Matrix) -> Matrix {
        let turn = Matrix::from_diagonal(Vector::new(self.sign, self.sign, 1.0));
        turn * jacobian_in_arm * turn
    }

    /// Returns the orientation of this frame in the world.
    pub(crate) fn orientation_in_world(self) -> Rotation {
        if self.sign > 0.0 { Rotation::IDENTITY } else { Rotation::from_xyzw(0.0, 0.0, 1.0, 0.0) }
    }

    /// Expresses a body's orientation in this frame, as a quaternion (x, y, z, w) with w >= 0.
    pub(crate) fn orientation_in_arm(self, in_world: Rotation) -> [f32; 4] {
        let Rotation { x, y, z, w } = in_world;
        let in_arm = if self.sign > 0.0 { [x, y, z, w] } else { [-y, x, w, -z] };
        if in_arm[3] < 0.0 { in_arm.map(|component| -component) } else { in_arm }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parameters::WorldParameters;
    use tandem_core::World;

    #[test]
    fn the_second_arm_faces_the_first() {
        let first = ArmFrame::new(ArmIndex(0), 2);
        let second = ArmFrame::new(ArmIndex(1), 2);
        let base_in_arm = WorldParameters::of(World::Classic).base_in_arm;
        let base = |frame: ArmFrame| frame.world_from_arm(base_in_arm).to_array();
        assert_eq!(base(first), [-0.52, 0.0, 0.0]);
        assert_eq!(base(second), [0.52, 0.0, 0.0]);
        let ahead = Vector::new(0.12, 0.05, 0.1);
        assert_eq!(first.world_from_arm(ahead).to_array(), [0.0, 0.05, 0.1]);
        assert_eq!(second.world_from_arm(ahead).to_array(), [0.0, -0.05, 0.1]);
        assert_eq!(second.arm_from_world(second.world_from_arm(ahead)), ahead);
    }

    #[test]
    fn orientations_that_rotate_with_the_arm_are_equal_in_both_arm_frames() {
        let tilted = Rotation::from_xyzw(0.1, 0.2, -0.3, 0.927_361_8);
        for arm in [ArmIndex(0), ArmIndex(1)] {
            let frame = ArmFrame::new(arm, 2);
            let read = frame.orientation_in_arm(frame.orientation_in_world() * tilted);
            for (got, expected) in read.into_iter().zip(tilted.to_array()) {
                assert!((got - expected).abs() < 1e-6, "{read:?}");
            }
        }
    }
}
