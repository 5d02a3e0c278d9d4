//! The 28 numbers that an arm's policy sees, in the arm's own frame.

use tandem_core::ArmIndex;

use crate::config::CONTROL_STEP_S;
use crate::world::World;

/// Writes what `arm` sees, shape `[28]`. Velocities are given as metres or radians per control step.
///
/// | numbers | meaning |
/// |---|---|
/// | 0–2 | end effector |
/// | 3–5 | object |
/// | 6–8 | object relative to the end effector |
/// | 9–11 | openings of the fingers |
/// | 12–15 | object's orientation, quaternion (x, y, z, w), w >= 0 |
/// | 16–18 | object's velocity relative to the end effector |
/// | 19–21 | object's angular velocity |
/// | 22–24 | end effector's velocity |
/// | 25–27 | rates of the fingers' openings |
pub(crate) fn observe_arm(world: &World, arm: ArmIndex, observation: &mut [f32]) {
    let (state, object) = (&world.arms[arm.0], world.object(arm));
    let frame = state.frame;
    let (hand_at, hand_velocity) = (state.hand.end_effector(&world.physics), state.hand.velocity(&world.physics));
    let per_step = |velocity| (frame.turned(velocity) * CONTROL_STEP_S).to_array();
    let fingers = state.hand.openings(&world.physics);

    observation[0..3].copy_from_slice(&frame.own_from_world(hand_at).to_array());
    observation[3..6].copy_from_slice(&frame.own_from_world(object.translation()).to_array());
    observation[6..9].copy_from_slice(&frame.turned(object.translation() - hand_at).to_array());
    observation[12..16].copy_from_slice(&frame.orientation_in_own(*object.rotation()));
    observation[16..19].copy_from_slice(&per_step(object.linvel() - hand_velocity));
    observation[19..22].copy_from_slice(&per_step(object.angvel()));
    observation[22..25].copy_from_slice(&per_step(hand_velocity));
    for (finger, (opening_m, rate_mps)) in fingers.into_iter().enumerate() {
        observation[9 + finger] = opening_m;
        observation[25 + finger] = rate_mps * CONTROL_STEP_S;
    }
}
