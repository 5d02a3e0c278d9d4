//! The hand: a palm that flies where its servo pushes it, and three fingers that open and close as one.
//!
//! Palm and fingers are rapier bodies that cannot turn. The arm's motors appear as one bounded force on the palm, the
//! fingers are held in their places by forces whose reaction the palm feels; there are no joints. A locked gripper is
//! one rigid piece with the palm: fingers that could give way would hook over an object's edge and drag it along.

use rapier3d::dynamics::{CoefficientCombineRule, RigidBodyBuilder, RigidBodyHandle};
use rapier3d::geometry::ColliderBuilder;
use rapier3d::math::{Pose, Vector};
use tandem_core::ArmIndex;

use crate::frame::ArmFrame;
use crate::physics::{Part, Physics, collides};

/// How far each side opens, metres.
pub(crate) const MAX_OPENING_M: f32 = 0.040;
/// Half extents of a finger pad: x, closing direction, z; metres.
pub(crate) const PAD_HALF_M: Vector = Vector::new(0.010, 0.010, 0.020);
/// Half extents of the palm plate, metres.
pub(crate) const PALM_HALF_M: Vector = Vector::new(0.035, 0.06, 0.015);
/// The palm plate's centre above the end effector, metres.
pub(crate) const PALM_ABOVE_M: f32 = 0.065;
/// The wrist: a capsule from here to there above the end effector, metres.
pub(crate) const WRIST_ABOVE_M: [f32; 2] = [0.10, 0.20];
/// The wrist's radius, metres.
pub(crate) const WRIST_RADIUS_M: f32 = 0.035;

/// Speed of each side at full gripper input, metres per second.
const OPENING_SPEED_MPS: f32 = 0.25;
/// Share of the way to an end of the opening's range that one physics step may cover.
const OPENING_END_GAIN: f32 = 0.2;
const PALM_MASS_KG: f32 = 1.0;
/// Largest force of the palm's servo on each axis, newtons.
const PALM_FORCE_N: f32 = 40.0;
/// Largest force that holds a finger in its place, newtons.
const FINGER_HOLD_FORCE_N: f32 = 200.0;
/// How fast a finger returns to its place, 1/s.
const FINGER_HOLD_GAIN: f32 = 250.0;

/// Where a finger sits and what it carries.
struct FingerGeometry {
    /// Side of the hand on which it closes, own frame: 1 or −1 along y.
    side: f32,
    x_m: f32,
    mass_kg: f32,
}

/// Two fingers against one. The masses balance, so that closing does not push the hand aside.
const FINGERS: [FingerGeometry; 3] = [
    FingerGeometry { side: 1.0, x_m: 0.016, mass_kg: 0.1 },
    FingerGeometry { side: 1.0, x_m: -0.016, mass_kg: 0.1 },
    FingerGeometry { side: -1.0, x_m: 0.0, mass_kg: 0.2 },
];
/// Mass of all fingers, kilograms.
const FINGERS_MASS_KG: f32 = 0.4;

/// Number of fingers.
pub(crate) const N_FINGERS: usize = FINGERS.len();

/// What the fingers are to the palm.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Gripper {
    /// Shut, and one rigid piece with the palm.
    Locked,
    /// Bodies of their own that open and close.
    Driven,
}

/// The bodies of a hand, all as of one physics step.
#[derive(Clone)]
pub(crate) struct Hand {
    frame: ArmFrame,
    palm: RigidBodyHandle,
    gripper: Gripper,
    fingers: [Finger; N_FINGERS],
    grip_force_n: f32,
}

#[derive(Clone, Copy)]
struct Finger {
    /// The palm's own body when the gripper is locked.
    body: RigidBodyHandle,
    mass_kg: f32,
    /// Share of the mass, and of the common opening's measure.
    mass_fraction: f32,
    /// Where the finger is when shut, relative to the palm, world frame, metres.
    shut_offset: Vector,
    /// The direction of opening along the world's y: 1 or −1.
    outward: f32,
}

/// One finger's deviation from its place.
#[derive(Clone, Copy, Default)]
struct FingerState {
    opening_m: f32,
    opening_rate_mps: f32,
    /// World frame, metres, relative to where it is when shut.
    offset: Vector,
    /// World frame, metres per second, relative to the palm.
    velocity: Vector,
}

impl Hand {
    /// Adds a hand with pads of friction `pad_friction` to `physics`.
    pub(crate) fn build(
        physics: &mut Physics,
        arm: ArmIndex,
        frame: ArmFrame,
        gripper: Gripper,
        pad_friction: f32,
        grip_force_n: f32,
    ) -> Self {
        let palm = build_palm(physics, arm, frame);
        let fingers = FINGERS.map(|geometry| match gripper {
            Gripper::Locked => attach_finger(physics, arm, frame, palm, &geometry, pad_friction),
            Gripper::Driven => build_finger(physics, arm, frame, &geometry, pad_friction),
        });
        Self { frame, palm, gripper, fingers, grip_force_n }
    }

    /// Puts the hand, at rest, where its end effector is at `end_effector_in_arm` and each side is open by `opening_m`.
    pub(crate) fn place(&self, physics: &mut Physics, end_effector_in_arm: Vector, opening_m: f32) {
        let at = self.frame.world_from_arm(end_effector_in_arm);
        let palm = &mut physics.bodies[self.palm];
        palm.set_translation(at, true);
        palm.set_linvel(Vector::ZERO, true);
        for finger in self.driven_fingers() {
            let body = &mut physics.bodies[finger.body];
            body.set_translation(
                at + finger.shut_offset + Vector::Y * (finger.outward * opening_m),
                true,
            );
            body.set_linvel(Vector::ZERO, true);
        }
    }

    /// Centre between the pads, world frame, metres.
    pub(crate) fn end_effector(&self, physics: &Physics) -> Vector {
        physics.bodies[self.palm].translation()
    }

    /// World frame, metres per second.
    pub(crate) fn velocity(&self, physics: &Physics) -> Vector {
        physics.bodies[self.palm].linvel()
    }

    /// How far each finger is open (metres) and how fast it opens (metres per second).
    pub(crate) fn openings(&self, physics: &Physics) -> [(f32, f32); N_FINGERS] {
        if self.gripper == Gripper::Locked {
            return [(0.0, 0.0); N_FINGERS];
        }
        let velocity = self.velocity(physics);
        self.finger_states(physics, velocity).map(|state| (state.opening_m, state.opening_rate_mps))
    }

    /// The pads' centres, world frame, metres.
    pub(crate) fn pads(&self, physics: &Physics) -> [Vector; N_FINGERS] {
        self.fingers.map(|finger| match self.gripper {
            Gripper::Locked => self.end_effector(physics) + finger.shut_offset,
            Gripper::Driven => physics.bodies[finger.body].translation(),
        })
    }

    /// Whether all positions and velocities are finite.
    pub(crate) fn is_finite(&self, physics: &Physics) -> bool {
        std::iter::once(self.palm).chain(self.fingers.map(|finger| finger.body)).all(|body| {
            let body = &physics.bodies[body];
            body.translation().is_finite() && body.linvel().is_finite()
        })
    }

    /// Lets the palm move with `palm` (world frame) and each finger open with its rate, metres per second.
    #[cfg(test)]
    pub(crate) fn set_velocities(
        &self,
        physics: &mut Physics,
        palm: Vector,
        rates_mps: [f32; N_FINGERS],
    ) {
        physics.bodies[self.palm].set_linvel(palm, true);
        for (finger, rate_mps) in self.driven_fingers().iter().zip(rates_mps) {
            physics.bodies[finger.body]
                .set_linvel(palm + Vector::Y * (finger.outward * rate_mps), true);
        }
    }

    /// Sets the forces of the next physics step.
    ///
    /// `velocity` is what the palm shall do (world frame, metres per second), `gripper` the gripper's input in
    /// [−1, 1]: positive opens, −1 closes and holds.
    pub(crate) fn drive(&self, physics: &mut Physics, velocity: Vector, gripper: f32) {
        let substep_s = physics.substep_s();
        let moved_mass_kg = PALM_MASS_KG + FINGERS_MASS_KG;
        let palm_velocity = self.velocity(physics);
        let palm_force =
            bounded((velocity - palm_velocity) * (moved_mass_kg / substep_s), PALM_FORCE_N);
        if self.gripper == Gripper::Locked {
            return apply(physics, self.palm, palm_force);
        }
        let palm_velocity_next = palm_velocity + palm_force * (substep_s / moved_mass_kg);

        let finger_forces = self.finger_forces(physics, palm_velocity_next, gripper);
        for (finger, force) in self.fingers.iter().zip(finger_forces) {
            apply(physics, finger.body, force);
        }
        let reaction: Vector = finger_forces.into_iter().sum();
        apply(physics, self.palm, palm_force - reaction);
    }

    /// Forces that open or close the fingers as one and keep each in its place, world frame, newtons.
    ///
    /// Without the term that ties the fingers' openings together, force-limited fingers and what they hold would have
    /// nothing to centre them.
    fn finger_forces(
        &self,
        physics: &Physics,
        palm_velocity: Vector,
        gripper: f32,
    ) -> [Vector; N_FINGERS] {
        let substep_s = physics.substep_s();
        let states = self.finger_states(physics, palm_velocity);
        let mean = |value: fn(&FingerState) -> f32| -> f32 {
            self.fingers
                .iter()
                .zip(&states)
                .map(|(finger, state)| finger.mass_fraction * value(state))
                .sum()
        };
        let opening_m = mean(|state| state.opening_m);
        let rate_mps = mean(|state| state.opening_rate_mps);
        let to_end = OPENING_END_GAIN / substep_s;
        let rate_wanted_mps = (gripper * OPENING_SPEED_MPS)
            .max(-opening_m * to_end)
            .min((MAX_OPENING_M - opening_m) * to_end);
        let side_force_n = (0.5 * FINGERS_MASS_KG * (rate_wanted_mps - rate_mps) / substep_s)
            .clamp(-self.grip_force_n, self.grip_force_n);
        std::array::from_fn(|idx| {
            let (finger, state) = (&self.fingers[idx], &states[idx]);
            let gain = finger.mass_kg / substep_s;
            let lateral = (state.offset * -FINGER_HOLD_GAIN - state.velocity) * gain;
            let balancing_n = (gain
                * (FINGER_HOLD_GAIN * (opening_m - state.opening_m) + rate_mps
                    - state.opening_rate_mps))
                .clamp(-FINGER_HOLD_FORCE_N, FINGER_HOLD_FORCE_N);
            let closing_n =
                finger.outward * (2.0 * finger.mass_fraction * side_force_n + balancing_n);
            let held = bounded(lateral, FINGER_HOLD_FORCE_N);
            Vector::new(held.x, closing_n, held.z)
        })
    }

    /// The fingers that move by themselves.
    fn driven_fingers(&self) -> &[Finger] {
        match self.gripper {
            Gripper::Locked => &[],
            Gripper::Driven => &self.fingers,
        }
    }

    fn finger_states(&self, physics: &Physics, palm_velocity: Vector) -> [FingerState; N_FINGERS] {
        let palm_position = self.end_effector(physics);
        self.fingers.map(|finger| {
            let body = &physics.bodies[finger.body];
            let offset = body.translation() - palm_position - finger.shut_offset;
            let velocity = body.linvel() - palm_velocity;
            FingerState {
                opening_m: offset.y * finger.outward,
                opening_rate_mps: velocity.y * finger.outward,
                offset,
                velocity,
            }
        })
    }
}

fn build_palm(physics: &mut Physics, arm: ArmIndex, frame: ArmFrame) -> RigidBodyHandle {
    let palm = physics.bodies.insert(weightless_body(frame));
    let part = |shape: ColliderBuilder, mass_kg: f32, above_m: f32| {
        shape
            .translation(Vector::new(0.0, 0.0, above_m))
            .mass(mass_kg)
            .friction(0.4)
            .collision_groups(collides(Part::Hand, arm))
    };
    let plate = ColliderBuilder::cuboid(PALM_HALF_M.x, PALM_HALF_M.y, PALM_HALF_M.z);
    let [low_m, high_m] = WRIST_ABOVE_M;
    let wrist = ColliderBuilder::capsule_z(0.5 * (high_m - low_m), WRIST_RADIUS_M);
    physics.colliders.insert_with_parent(
        part(plate, 0.7 * PALM_MASS_KG, PALM_ABOVE_M),
        palm,
        &mut physics.bodies,
    );
    physics.colliders.insert_with_parent(
        part(wrist, 0.3 * PALM_MASS_KG, 0.5 * (low_m + high_m)),
        palm,
        &mut physics.bodies,
    );
    palm
}

fn build_finger(
    physics: &mut Physics,
    arm: ArmIndex,
    frame: ArmFrame,
    geometry: &FingerGeometry,
    friction: f32,
) -> Finger {
    let body = physics.bodies.insert(weightless_body(frame));
    let pad = pad(arm, geometry, friction);
    physics.colliders.insert_with_parent(pad, body, &mut physics.bodies);
    finger(body, frame, geometry)
}

/// A finger that is part of the palm. The palm's body is turned with the arm, so the pad's place is the arm's own.
fn attach_finger(
    physics: &mut Physics,
    arm: ArmIndex,
    frame: ArmFrame,
    palm: RigidBodyHandle,
    geometry: &FingerGeometry,
    friction: f32,
) -> Finger {
    let pad = pad(arm, geometry, friction).translation(shut_offset_in_arm(geometry));
    physics.colliders.insert_with_parent(pad, palm, &mut physics.bodies);
    finger(palm, frame, geometry)
}

fn pad(arm: ArmIndex, geometry: &FingerGeometry, friction: f32) -> ColliderBuilder {
    ColliderBuilder::cuboid(PAD_HALF_M.x, PAD_HALF_M.y, PAD_HALF_M.z)
        .mass(geometry.mass_kg)
        .friction(friction)
        .friction_combine_rule(CoefficientCombineRule::Max)
        .collision_groups(collides(Part::Hand, arm))
}

fn shut_offset_in_arm(geometry: &FingerGeometry) -> Vector {
    Vector::new(geometry.x_m, geometry.side * PAD_HALF_M.y, 0.0)
}

fn finger(body: RigidBodyHandle, frame: ArmFrame, geometry: &FingerGeometry) -> Finger {
    Finger {
        body,
        mass_kg: geometry.mass_kg,
        mass_fraction: geometry.mass_kg / FINGERS_MASS_KG,
        shut_offset: frame.rotate(shut_offset_in_arm(geometry)),
        outward: frame.rotate(Vector::Y * geometry.side).y,
    }
}

fn weightless_body(frame: ArmFrame) -> RigidBodyBuilder {
    RigidBodyBuilder::dynamic()
        .pose(Pose::from_parts(Vector::ZERO, frame.orientation_in_world()))
        .lock_rotations()
        .gravity_scale(0.0)
        .can_sleep(false)
}

/// Replaces the body's forces: rapier keeps those of the step before.
fn apply(physics: &mut Physics, body: RigidBodyHandle, force_n: Vector) {
    let body = &mut physics.bodies[body];
    body.reset_forces(false);
    body.add_force(force_n, true);
}

fn bounded(force_n: Vector, limit_n: f32) -> Vector {
    force_n.clamp(Vector::splat(-limit_n), Vector::splat(limit_n))
}
