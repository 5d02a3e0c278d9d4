//! The hand: a palm that a servo moves, and two or three fingers that open and close together.
//!
//! Palm and fingers are rapier bodies with locked rotations. One bounded force on the palm models the arm's motors.
//! Forces hold the fingers in their places, and the palm receives the reaction; there are no joints. A locked gripper
//! forms one rigid body with the palm, because compliant fingers would hook over an object's edge and drag it along.

use rapier3d::dynamics::{CoefficientCombineRule, RigidBodyBuilder, RigidBodyHandle};
use rapier3d::geometry::{ColliderBuilder, ColliderHandle};
use rapier3d::math::{Pose, Vector};
use tandem_core::ArmIndex;

use crate::frame::ArmFrame;
use crate::physics::{Part, Physics, collides};

/// Half extents of the palm plate, metres.
pub(crate) const PALM_HALF_M: Vector = Vector::new(0.035, 0.06, 0.015);
/// Height of the palm plate's centre above the end effector, metres.
pub(crate) const PALM_ABOVE_M: f32 = 0.065;
/// Heights of the ends of the wrist's capsule above the end effector, metres.
pub(crate) const WRIST_ABOVE_M: [f32; 2] = [0.10, 0.20];
/// Radius of the wrist, metres.
pub(crate) const WRIST_RADIUS_M: f32 = 0.035;

/// Fraction of the distance to an end of the opening's range that one physics step may cover.
pub(crate) const OPENING_END_GAIN: f32 = 0.2;
/// Mass of palm and wrist, kilograms.
pub(crate) const PALM_MASS_KG: f32 = 1.0;
/// Largest force that holds a finger in its place, newtons.
pub(crate) const FINGER_HOLD_FORCE_N: f32 = 200.0;
/// Gain of the force that returns a finger to its place, 1/s.
pub(crate) const FINGER_HOLD_GAIN: f32 = 250.0;

/// Position and mass of a finger.
#[derive(Debug)]
pub(crate) struct FingerGeometry {
    /// Side of the hand, arm frame: 1 or −1 along y.
    side: f32,
    x_m: f32,
    mass_kg: f32,
}

/// The fingers of a gripper and their pads.
#[derive(Debug)]
pub(crate) struct GripperGeometry {
    /// At most [`N_OBSERVED_FINGERS`].
    pub(crate) fingers: &'static [FingerGeometry],
    /// For each observed finger the index of the one that it shows.
    observed: [usize; N_OBSERVED_FINGERS],
    /// Half extents of a finger pad (x, closing direction, z), metres.
    pub(crate) pad_half: Vector,
    /// Largest opening of each side of the gripper, metres.
    pub(crate) max_opening_m: f32,
    /// Speed of each side at full gripper input, metres per second.
    pub(crate) opening_speed_mps: f32,
}

/// The gripper of the classic world. Two fingers oppose one. Their masses balance, so closing the gripper does not move
/// the hand sideways.
pub(crate) static THREE_FINGERS: GripperGeometry = GripperGeometry {
    fingers: &[
        FingerGeometry { side: 1.0, x_m: 0.016, mass_kg: 0.1 },
        FingerGeometry { side: 1.0, x_m: -0.016, mass_kg: 0.1 },
        FingerGeometry { side: -1.0, x_m: 0.0, mass_kg: 0.2 },
    ],
    observed: [0, 1, 2],
    pad_half: Vector::new(0.010, 0.010, 0.020),
    max_opening_m: 0.040,
    opening_speed_mps: 0.25,
};

/// The gripper of the shared world: the two fingers of a Mico, as wide, as far open and as fast as those of the
/// simulated pair of arms in `tandem-trials`. The first of them is observed twice.
pub(crate) static MICO_GRIPPER: GripperGeometry = GripperGeometry {
    fingers: &[
        FingerGeometry { side: 1.0, x_m: 0.0, mass_kg: 0.2 },
        FingerGeometry { side: -1.0, x_m: 0.0, mass_kg: 0.2 },
    ],
    observed: [0, 0, 1],
    pad_half: Vector::new(0.008, 0.005, 0.015),
    max_opening_m: 0.062,
    opening_speed_mps: 0.062,
};

/// Mass of all fingers of a gripper, kilograms.
pub(crate) const FINGERS_MASS_KG: f32 = 0.4;

/// Number of fingers in an observation.
pub(crate) const N_OBSERVED_FINGERS: usize = 3;

/// The connection between fingers and palm.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Gripper {
    /// The fingers are closed and part of the palm's body.
    Locked,
    /// The fingers are separate bodies that open and close.
    Driven,
}

impl GripperGeometry {
    /// Returns the distance along x from the centre of the hand to the outer edge of its pads, metres.
    pub(crate) fn reach_m(&self) -> f32 {
        let outermost_m = self.fingers.iter().map(|finger| finger.x_m.abs()).fold(0.0, f32::max);
        outermost_m + self.pad_half.x
    }
}

/// The properties of a hand.
#[derive(Debug, Clone, Copy)]
pub(crate) struct HandSettings {
    pub(crate) gripper: Gripper,
    pub(crate) geometry: &'static GripperGeometry,
    pub(crate) pad_friction: f32,
    pub(crate) grip_force_n: f32,
    pub(crate) palm_force_n: f32,
}

/// The bodies of a hand.
#[derive(Clone)]
pub(crate) struct Hand {
    frame: ArmFrame,
    pub(crate) palm: RigidBodyHandle,
    pub(crate) fingers: Vec<Finger>,
    pub(crate) settings: HandSettings,
}

/// A finger and its place at the palm.
#[derive(Clone, Copy)]
pub(crate) struct Finger {
    /// The palm's body if the gripper is locked.
    pub(crate) body: RigidBodyHandle,
    pub(crate) pad: ColliderHandle,
    pub(crate) mass_kg: f32,
    /// Fraction of the mass of all fingers, and weight in the mean opening.
    pub(crate) mass_fraction: f32,
    /// Position of the closed finger relative to the palm, world frame, metres.
    pub(crate) closed_offset: Vector,
    /// Direction of opening along the world's y axis: 1 or −1.
    pub(crate) outward: f32,
}

/// The state of a finger relative to the palm.
#[derive(Clone, Copy, Default)]
struct FingerState {
    opening_m: f32,
    opening_rate_mps: f32,
    /// Position relative to that of the closed finger, world frame, metres.
    offset: Vector,
    /// Velocity relative to the palm, world frame, metres per second.
    velocity: Vector,
}

impl Hand {
    /// Adds a hand to `physics`.
    pub(crate) fn build(
        physics: &mut Physics,
        arm: ArmIndex,
        frame: ArmFrame,
        settings: HandSettings,
    ) -> Self {
        let palm = build_palm(physics, arm, frame);
        let mut build = |geometry: &FingerGeometry| {
            let body = match settings.gripper {
                Gripper::Locked => palm,
                Gripper::Driven => physics.bodies.insert(weightless_body(frame)),
            };
            add_finger(physics, arm, frame, body, geometry, &settings)
        };
        let fingers = settings.geometry.fingers.iter().map(&mut build).collect();
        Self { frame, palm, fingers, settings }
    }

    /// Places the hand, at rest, with its end effector at `end_effector_in_arm` (metres) and each side open by
    /// `opening_m`.
    pub(crate) fn place(&self, physics: &mut Physics, end_effector_in_arm: Vector, opening_m: f32) {
        let at = self.frame.world_from_arm(end_effector_in_arm);
        let palm = &mut physics.bodies[self.palm];
        palm.set_translation(at, true);
        palm.set_linvel(Vector::ZERO, true);
        for finger in self.driven_fingers() {
            let body = &mut physics.bodies[finger.body];
            body.set_translation(
                at + finger.closed_offset + Vector::Y * (finger.outward * opening_m),
                true,
            );
            body.set_linvel(Vector::ZERO, true);
        }
    }

    /// Returns the position of the end effector, the centre between the pads; world frame, metres.
    pub(crate) fn end_effector(&self, physics: &Physics) -> Vector {
        physics.bodies[self.palm].translation()
    }

    /// Returns the velocity of the palm, world frame, metres per second.
    pub(crate) fn velocity(&self, physics: &Physics) -> Vector {
        physics.bodies[self.palm].linvel()
    }

    /// Returns the opening (metres) and the opening rate (metres per second) of each finger.
    pub(crate) fn openings(&self, physics: &Physics) -> [(f32, f32); N_OBSERVED_FINGERS] {
        if self.settings.gripper == Gripper::Locked {
            return [(0.0, 0.0); N_OBSERVED_FINGERS];
        }
        let states = self.finger_states(physics, self.velocity(physics));
        self.settings
            .geometry
            .observed
            .map(|idx| (states[idx].opening_m, states[idx].opening_rate_mps))
    }

    /// Returns the centres of the pads, world frame, metres.
    pub(crate) fn pads(&self, physics: &Physics) -> impl Iterator<Item = Vector> {
        self.fingers.iter().map(|finger| match self.settings.gripper {
            Gripper::Locked => self.end_effector(physics) + finger.closed_offset,
            Gripper::Driven => physics.bodies[finger.body].translation(),
        })
    }

    /// Returns `true` if all positions and velocities are finite.
    pub(crate) fn is_finite(&self, physics: &Physics) -> bool {
        let fingers = self.fingers.iter().map(|finger| finger.body);
        std::iter::once(self.palm).chain(fingers).all(|body| {
            let body = &physics.bodies[body];
            body.translation().is_finite() && body.linvel().is_finite()
        })
    }

    /// Sets the velocity of the palm (world frame) and the opening rate of each finger, metres per second.
    #[cfg(test)]
    pub(crate) fn set_velocities(&self, physics: &mut Physics, palm: Vector, rates_mps: &[f32]) {
        physics.bodies[self.palm].set_linvel(palm, true);
        for (finger, rate_mps) in self.driven_fingers().iter().zip(rates_mps) {
            physics.bodies[finger.body]
                .set_linvel(palm + Vector::Y * (finger.outward * rate_mps), true);
        }
    }

    /// Sets the forces for the next physics step.
    ///
    /// `velocity` is the desired velocity of the palm (world frame, metres per second), `gripper` the input of the
    /// gripper in [−1, 1]: positive values open it, −1 closes it and holds.
    pub(crate) fn drive(&self, physics: &mut Physics, velocity: Vector, gripper: f32) {
        let substep_s = physics.substep_s();
        let total_mass_kg = PALM_MASS_KG + FINGERS_MASS_KG;
        let palm_velocity = self.velocity(physics);
        let palm_force = bounded(
            (velocity - palm_velocity) * (total_mass_kg / substep_s),
            self.settings.palm_force_n,
        );
        if self.settings.gripper == Gripper::Locked {
            return apply(physics, self.palm, palm_force);
        }
        let palm_velocity_next = palm_velocity + palm_force * (substep_s / total_mass_kg);

        let finger_forces = self.finger_forces(physics, palm_velocity_next, gripper);
        for (finger, force) in self.fingers.iter().zip(finger_forces) {
            apply(physics, finger.body, force);
        }
        let reaction: Vector = finger_forces.into_iter().sum();
        apply(physics, self.palm, palm_force - reaction);
    }

    /// Returns the forces that open or close the fingers together and hold each in its place, world frame, newtons.
    ///
    /// The term `balancing_n` equalises the openings. Without it, nothing would centre a grasped object between
    /// force-limited fingers.
    fn finger_forces(
        &self,
        physics: &Physics,
        palm_velocity: Vector,
        gripper: f32,
    ) -> [Vector; N_OBSERVED_FINGERS] {
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
        let end_gain = OPENING_END_GAIN / substep_s;
        let HandSettings { geometry, grip_force_n, .. } = self.settings;
        let desired_rate_mps = (gripper * geometry.opening_speed_mps)
            .max(-opening_m * end_gain)
            .min((geometry.max_opening_m - opening_m) * end_gain);
        let side_force_n = (0.5 * FINGERS_MASS_KG * (desired_rate_mps - rate_mps) / substep_s)
            .clamp(-grip_force_n, grip_force_n);
        let mut forces_n = [Vector::ZERO; N_OBSERVED_FINGERS];
        for ((finger, state), force_n) in self.fingers.iter().zip(&states).zip(&mut forces_n) {
            let gain = finger.mass_kg / substep_s;
            let lateral = (state.offset * -FINGER_HOLD_GAIN - state.velocity) * gain;
            let balancing_n = (gain
                * (FINGER_HOLD_GAIN * (opening_m - state.opening_m) + rate_mps
                    - state.opening_rate_mps))
                .clamp(-FINGER_HOLD_FORCE_N, FINGER_HOLD_FORCE_N);
            let closing_n =
                finger.outward * (2.0 * finger.mass_fraction * side_force_n + balancing_n);
            let held = bounded(lateral, FINGER_HOLD_FORCE_N);
            *force_n = Vector::new(held.x, closing_n, held.z);
        }
        forces_n
    }

    /// Returns the fingers that are separate bodies.
    fn driven_fingers(&self) -> &[Finger] {
        match self.settings.gripper {
            Gripper::Locked => &[],
            Gripper::Driven => &self.fingers,
        }
    }

    /// Returns the states of the fingers, in their order; entries beyond them are at rest.
    fn finger_states(
        &self,
        physics: &Physics,
        palm_velocity: Vector,
    ) -> [FingerState; N_OBSERVED_FINGERS] {
        let palm_position = self.end_effector(physics);
        let mut states = [FingerState::default(); N_OBSERVED_FINGERS];
        for (finger, state) in self.fingers.iter().zip(&mut states) {
            let body = &physics.bodies[finger.body];
            let offset = body.translation() - palm_position - finger.closed_offset;
            let velocity = body.linvel() - palm_velocity;
            *state = FingerState {
                opening_m: offset.y * finger.outward,
                opening_rate_mps: velocity.y * finger.outward,
                offset,
                velocity,
            };
        }
        states
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

/// Adds a finger to `body`, which is its own or the palm's. The palm's body is rotated with the arm, so a pad's position
/// in it is in the arm's frame.
fn add_finger(
    physics: &mut Physics,
    arm: ArmIndex,
    frame: ArmFrame,
    body: RigidBodyHandle,
    geometry: &FingerGeometry,
    settings: &HandSettings,
) -> Finger {
    let pad_half = settings.geometry.pad_half;
    let closed_offset = Vector::new(geometry.x_m, geometry.side * pad_half.y, 0.0);
    let pad = ColliderBuilder::cuboid(pad_half.x, pad_half.y, pad_half.z)
        .mass(geometry.mass_kg)
        .friction(settings.pad_friction)
        .friction_combine_rule(CoefficientCombineRule::Max)
        .collision_groups(collides(Part::Hand, arm));
    let pad = match settings.gripper {
        Gripper::Locked => pad.translation(closed_offset),
        Gripper::Driven => pad,
    };
    let pad = physics.colliders.insert_with_parent(pad, body, &mut physics.bodies);
    Finger {
        body,
        pad,
        mass_kg: geometry.mass_kg,
        mass_fraction: geometry.mass_kg / FINGERS_MASS_KG,
        closed_offset: frame.rotate(closed_offset),
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

/// Replaces the forces on a body. rapier keeps those of the previous step otherwise.
fn apply(physics: &mut Physics, body: RigidBodyHandle, force_n: Vector) {
    let body = &mut physics.bodies[body];
    body.reset_forces(false);
    body.add_force(force_n, true);
}

fn bounded(force_n: Vector, limit_n: f32) -> Vector {
    force_n.clamp(Vector::splat(-limit_n), Vector::splat(limit_n))
}
