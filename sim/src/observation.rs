//! The part of an observation that belongs to one arm.

use rapier3d::math::Vector;
use tandem_core::ArmIndex;

use crate::world::PhysicsWorld;

/// Writes `arm`'s part of the observation, shape `[28]`, in the order that `Env::observe` documents. The position of the
/// object is wrong by `error` (arm frame, metres).
pub(crate) fn observe_arm(
    world: &PhysicsWorld,
    arm: ArmIndex,
    error: Vector,
    observation: &mut [f32],
) {
    let (state, object) = (&world.arms[arm.0], world.object_state(arm));
    let frame = state.frame;
    let (hand_position, hand_velocity) =
        (state.hand.end_effector(&world.physics), state.hand.velocity(&world.physics));
    let per_step = |velocity| (frame.rotate(velocity) * world.control_step_s).to_array();
    let fingers = state.hand.openings(&world.physics);

    observation[0..3].copy_from_slice(&frame.arm_from_world(hand_position).to_array());
    observation[3..6].copy_from_slice(&frame.arm_from_world(object.position).to_array());
    observation[6..9].copy_from_slice(&frame.rotate(object.position - hand_position).to_array());
    observation[12..16].copy_from_slice(&frame.orientation_in_arm(object.rotation));
    observation[16..19].copy_from_slice(&per_step(object.velocity - hand_velocity));
    observation[19..22].copy_from_slice(&per_step(object.angular_velocity));
    observation[22..25].copy_from_slice(&per_step(hand_velocity));
    if error != Vector::ZERO {
        for (idx, number) in observation[3..9].iter_mut().enumerate() {
            *number += error[idx % 3];
        }
    }
    for (finger, (opening_m, rate_mps)) in fingers.into_iter().enumerate() {
        observation[9 + finger] = opening_m;
        observation[25 + finger] = rate_mps * world.control_step_s;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rapier3d::math::{Pose, Rotation};
    use tandem_core::layout::OBSERVATION_PER_ARM;
    use tandem_core::{Layout, Task};

    use crate::config::WorldConfig;
    use crate::frame::ArmFrame;

    const ARMS: [ArmIndex; 2] = [ArmIndex(0), ArmIndex(1)];
    const OBJECT: Vector = Vector::new(0.05, -0.08, 0.0225);
    const HAND: Vector = Vector::new(-0.01, 0.02, 0.12);

    /// The observations of both arms after `change` was applied to the world of `HAND` and `OBJECT` at `arm`.
    fn observed_after(
        arm: ArmIndex,
        change: impl Fn(&mut PhysicsWorld, ArmFrame),
    ) -> [[f32; OBSERVATION_PER_ARM]; 2] {
        let mut world =
            PhysicsWorld::build(Layout::new(Task::PickAndPlace, 2), &WorldConfig::default());
        for arm in ARMS {
            world.place_arm(arm, HAND, 0.03);
            world.place_object(arm, OBJECT, 0.0);
        }
        let frame = world.arms[arm.0].frame;
        change(&mut world, frame);
        ARMS.map(|arm| {
            let mut observation = [0.0; OBSERVATION_PER_ARM];
            observe_arm(&world, arm, Vector::ZERO, &mut observation);
            observation
        })
    }

    /// Asserts that `change`, applied at either arm, changes the numbers in `expected` and no others.
    fn check(change: impl Fn(&mut PhysicsWorld, ArmIndex, ArmFrame), expected: &[(usize, f32)]) {
        for arm in ARMS {
            let before = observed_after(arm, |_, _| ());
            let after = observed_after(arm, |world, frame| change(world, arm, frame));
            assert_eq!(before[1 - arm.0], after[1 - arm.0], "the other arm's numbers changed");
            for idx in 0..OBSERVATION_PER_ARM {
                let difference = after[arm.0][idx] - before[arm.0][idx];
                let wanted = expected.iter().find(|(at, _)| *at == idx).map_or(0.0, |(_, by)| *by);
                assert!(
                    (difference - wanted).abs() < 1e-6,
                    "{arm:?}, number {idx}: {difference}, not {wanted}"
                );
            }
        }
    }

    #[test]
    fn at_rest_the_observation_holds_positions_only() {
        for numbers in observed_after(ArmIndex(0), |_, _| ()) {
            let mut expected = [0.0; OBSERVATION_PER_ARM];
            expected[0..3].copy_from_slice(&HAND.to_array());
            expected[3..6].copy_from_slice(&OBJECT.to_array());
            expected[6..9].copy_from_slice(&(OBJECT - HAND).to_array());
            expected[9..12].copy_from_slice(&[0.03; 3]);
            expected[15] = 1.0;
            for (idx, (got, wanted)) in numbers.into_iter().zip(expected).enumerate() {
                assert!((got - wanted).abs() < 1e-6, "number {idx}: {got}, not {wanted}");
            }
        }
    }

    #[test]
    fn positions_and_openings_have_their_indices() {
        let step = Vector::new(0.01, 0.02, 0.03);
        check(
            |world, arm, _| world.place_arm(arm, HAND + step, 0.03),
            &[(0, 0.01), (1, 0.02), (2, 0.03), (6, -0.01), (7, -0.02), (8, -0.03)],
        );
        check(
            |world, arm, _| world.place_object(arm, OBJECT + step, 0.0),
            &[(3, 0.01), (4, 0.02), (5, 0.03), (6, 0.01), (7, 0.02), (8, 0.03)],
        );
        check(
            |world, arm, _| world.place_arm(arm, HAND, 0.01),
            &[(9, -0.02), (10, -0.02), (11, -0.02)],
        );
    }

    #[test]
    fn the_quaternion_has_a_positive_w() {
        let turn = Rotation::from_xyzw(0.6, 0.0, 0.0, -0.8);
        check(
            |world, arm, frame| {
                let pose = Pose::from_parts(
                    frame.world_from_arm(OBJECT),
                    frame.orientation_in_world() * turn,
                );
                world.object_mut(arm).set_position(pose, true);
            },
            &[(12, -0.6), (15, -0.2)],
        );
    }

    #[test]
    fn velocities_are_per_control_step() {
        let velocity = Vector::new(0.1, 0.2, 0.3);
        let per_step = [0.004, 0.008, 0.012];
        let at =
            |first: usize, sign: f32| [0, 1, 2].map(|axis| (first + axis, sign * per_step[axis]));
        check(
            |world, arm, frame| world.object_mut(arm).set_linvel(frame.rotate(velocity), true),
            &at(16, 1.0),
        );
        check(
            |world, arm, frame| world.object_mut(arm).set_angvel(frame.rotate(velocity), true),
            &at(19, 1.0),
        );
        let hand_moves = [at(16, -1.0), at(22, 1.0)].concat();
        check(
            |world, arm, frame| {
                let hand = world.arms[arm.0].hand.clone();
                hand.set_velocities(&mut world.physics, frame.rotate(velocity), &[0.0; 3]);
            },
            &hand_moves,
        );
        check(
            |world, arm, _| {
                let hand = world.arms[arm.0].hand.clone();
                hand.set_velocities(&mut world.physics, Vector::ZERO, &[0.1, 0.2, 0.3]);
            },
            &at(25, 1.0),
        );
    }
}
