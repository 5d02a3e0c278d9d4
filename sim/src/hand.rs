//! The hand: a palm that a servo moves, and two or three fingers that open and close together.
//!
//! Palm and fingers are rapier bodies that no contact can rotate. One bounded force on the palm models the arm's motors.
//! Forces hold the fingers in their places, and the palm receives the reaction; there are no joints. A locked gripper
//! forms one rigid body with the palm, because compliant fingers would hook over an object's edge and drag it along.
//!
//! In the classic world hands point straight down. In the shared world they tilt as those of a Mico do: the position of
//! the end effector determines the orientation, and bodies rotate at the rate that follows from the palm's velocity.

mod geometry;

use rapier3d::dynamics::{
    CoefficientCombineRule, MassProperties, RigidBodyBuilder, RigidBodyHandle,
};
use rapier3d::geometry::{ColliderBuilder, ColliderHandle};
use rapier3d::math::{Pose, Rotation, Vector};
use tandem_core::ArmIndex;

use self::geometry::{FingerGeometry, PalmGeometry};
pub(crate) use self::geometry::{HandGeometry, MICO_HAND, N_OBSERVED_FINGERS, THREE_FINGERS};
use crate::config::Surfaces;
use crate::frame::ArmFrame;
use crate::mico::Mico;
use crate::physics::{Part, Physics, collides};

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

/// Mass of all fingers of a gripper, kilograms.
pub(crate) const FINGERS_MASS_KG: f32 = 0.4;

/// The connection between fingers and palm.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Gripper {
    /// The fingers are closed and part of the palm's body.
    Locked,
    /// The fingers are separate bodies that open and close.
    Driven,
}

/// The properties of a hand.
#[derive(Debug, Clone, Copy)]
pub(crate) struct HandSettings {
    pub(crate) gripper: Gripper,
    pub(crate) geometry: &'static HandGeometry,
    pub(crate) surfaces: Surfaces,
    pub(crate) grip_force_n: f32,
    pub(crate) palm_force_n: f32,
    /// The arm whose posture tilts the hand; hands without one point straight down.
    pub(crate) mico: Option<Mico>,
}

impl HandSettings {
    /// Returns the mass of the palm's body that belongs to none of its shapes, kilograms. A hand that tilts about its end
    /// effector has its mass there.
    pub(crate) fn mass_at_end_effector_kg(&self) -> f32 {
        match (self.mico, self.gripper) {
            (None, _) => 0.0,
            (Some(_), Gripper::Locked) => PALM_MASS_KG + FINGERS_MASS_KG,
            (Some(_), Gripper::Driven) => PALM_MASS_KG,
        }
    }
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
    /// The lower end of the pad, if it differs from the rest.
    pub(crate) tip: Option<ColliderHandle>,
    pub(crate) mass_kg: f32,
    /// Fraction of the mass of all fingers, and weight in the mean opening.
    pub(crate) mass_fraction: f32,
    /// Position of the closed finger in the palm's frame, metres.
    pub(crate) closed_offset: Vector,
    /// Direction of opening along the palm's y axis: 1 or −1.
    pub(crate) side: f32,
}

/// The state of a finger relative to the palm.
#[derive(Clone, Copy, Default)]
struct FingerState {
    opening_m: f32,
    opening_rate_mps: f32,
    /// Position relative to that of the closed finger, palm's frame, metres.
    offset: Vector,
    /// Velocity relative to the palm, palm's frame, metres per second.
    velocity: Vector,
}

/// The orientation of the palm and its motion, world frame.
#[derive(Clone, Copy)]
struct PalmMotion {
    orientation: Rotation,
    /// Metres per second.
    velocity: Vector,
    /// Radians per second.
    angular_velocity: Vector,
}

impl Hand {
    /// Adds a hand to `physics`.
    pub(crate) fn build(
        physics: &mut Physics,
        arm: ArmIndex,
        frame: ArmFrame,
        settings: HandSettings,
    ) -> Self {
        let palm = build_palm(physics, arm, frame, &settings);
        let mut build = |geometry: &FingerGeometry| {
            let body = match settings.gripper {
                Gripper::Locked => palm,
                Gripper::Driven => physics.bodies.insert(weightless_body(frame)),
            };
            add_finger(physics, arm, body, geometry, &settings)
        };
        let fingers = settings.geometry.fingers.iter().map(&mut build).collect();
        Self { frame, palm, fingers, settings }
    }

    /// Places the hand, at rest, with its end effector at `end_effector_in_arm` (metres) and each side open by
    /// `opening_m`.
    pub(crate) fn place(&self, physics: &mut Physics, end_effector_in_arm: Vector, opening_m: f32) {
        let at = self.frame.world_from_arm(end_effector_in_arm);
        let turn = self.orientation_at(at);
        place_body(physics, self.palm, Pose::from_parts(at, turn));
        for finger in self.driven_fingers() {
            let outward = turn * (Vector::Y * (finger.side * opening_m));
            let placed = at + turn * finger.closed_offset + outward;
            place_body(physics, finger.body, Pose::from_parts(placed, turn));
        }
    }

    /// Returns the orientation of the hand, world frame: its fingers close along y, and it points along −z.
    pub(crate) fn orientation(&self, physics: &Physics) -> Rotation {
        self.orientation_at(self.end_effector(physics))
    }

    /// Returns the orientation of the hand with its end effector at `at`, world frame, metres.
    fn orientation_at(&self, at: Vector) -> Rotation {
        let upright = self.frame.orientation_in_world();
        self.settings.mico.map_or(upright, |mico| {
            upright * mico.posture(self.frame.arm_from_world(at)).orientation()
        })
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
        let palm = &physics.bodies[self.palm];
        let motion = PalmMotion {
            orientation: self.orientation(physics),
            velocity: palm.linvel(),
            angular_velocity: palm.angvel(),
        };
        let states = self.finger_states(physics, motion);
        self.settings
            .geometry
            .observed
            .map(|idx| (states[idx].opening_m, states[idx].opening_rate_mps))
    }

    /// Returns the centres of the pads, world frame, metres.
    pub(crate) fn pads(&self, physics: &Physics) -> impl Iterator<Item = Vector> {
        let turn = self.orientation(physics);
        self.fingers.iter().map(move |finger| match self.settings.gripper {
            Gripper::Locked => self.end_effector(physics) + turn * finger.closed_offset,
            Gripper::Driven => physics.bodies[finger.body].translation(),
        })
    }

    /// Returns the bodies of the hand.
    pub(crate) fn bodies(&self) -> impl Iterator<Item = RigidBodyHandle> {
        let fingers = self.driven_fingers().iter().map(|finger| finger.body);
        std::iter::once(self.palm).chain(fingers)
    }

    /// Returns `true` if all positions and velocities are finite.
    pub(crate) fn is_finite(&self, physics: &Physics) -> bool {
        self.bodies().all(|body| {
            let body = &physics.bodies[body];
            body.translation().is_finite() && body.linvel().is_finite()
        })
    }

    /// Sets the velocity of the palm (world frame) and the opening rate of each finger, metres per second.
    #[cfg(test)]
    pub(crate) fn set_velocities(&self, physics: &mut Physics, palm: Vector, rates_mps: &[f32]) {
        physics.bodies[self.palm].set_linvel(palm, true);
        let closing = self.orientation(physics) * Vector::Y;
        for (finger, rate_mps) in self.driven_fingers().iter().zip(rates_mps) {
            physics.bodies[finger.body].set_linvel(palm + closing * (finger.side * rate_mps), true);
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
        let motion = self.turn(physics, palm_velocity);
        let palm_force = bounded(
            (velocity - palm_velocity) * (total_mass_kg / substep_s),
            self.settings.palm_force_n,
        );
        if self.settings.gripper == Gripper::Locked {
            return apply(physics, self.palm, palm_force);
        }
        let palm_velocity_next = palm_velocity + palm_force * (substep_s / total_mass_kg);

        let motion = PalmMotion { velocity: palm_velocity_next, ..motion };
        let finger_forces = self.finger_forces(physics, motion, gripper);
        for (finger, force) in self.fingers.iter().zip(finger_forces) {
            apply(physics, finger.body, force);
        }
        let reaction: Vector = finger_forces.into_iter().sum();
        apply(physics, self.palm, palm_force - reaction);
    }

    /// Rotates the bodies to the posture of the arm at the palm's position, and makes them follow it during the next
    /// physics step, in which the palm has about `velocity` (world frame, metres per second). Hands that point down stay.
    fn turn(&self, physics: &mut Physics, velocity: Vector) -> PalmMotion {
        let upright = self.frame.orientation_in_world();
        let Some(mico) = self.settings.mico else {
            return PalmMotion { orientation: upright, velocity, angular_velocity: Vector::ZERO };
        };
        let posture = mico.posture(self.frame.arm_from_world(self.end_effector(physics)));
        let orientation = upright * posture.orientation();
        let in_arm = posture.angular_velocity(self.frame.rotate(velocity));
        let angular_velocity = self.frame.rotate(in_arm);
        for handle in self.bodies() {
            let body = &mut physics.bodies[handle];
            body.set_rotation(orientation, true);
            body.set_angvel(angular_velocity, true);
        }
        PalmMotion { orientation, velocity, angular_velocity }
    }

    /// Returns the forces that open or close the fingers together and hold each in its place, world frame, newtons.
    ///
    /// The term `balancing_n` equalises the openings. Without it, nothing would centre a grasped object between
    /// force-limited fingers.
    fn finger_forces(
        &self,
        physics: &Physics,
        palm: PalmMotion,
        gripper: f32,
    ) -> [Vector; N_OBSERVED_FINGERS] {
        let substep_s = physics.substep_s();
        let states = self.finger_states(physics, palm);
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
            let closing_n = finger.side * (2.0 * finger.mass_fraction * side_force_n + balancing_n);
            let held = bounded(lateral, FINGER_HOLD_FORCE_N);
            *force_n = self.world_from_palm(palm, Vector::new(held.x, closing_n, held.z));
        }
        forces_n
    }

    /// Rotates a direction from the world frame to the palm's. Signs alone change for upright hands, also those of zeros.
    fn palm_from_world(&self, palm: PalmMotion, direction: Vector) -> Vector {
        match self.settings.mico {
            None => self.frame.rotate(direction),
            Some(_) => palm.orientation.inverse() * direction,
        }
    }

    /// Rotates a direction from the palm's frame to the world frame.
    fn world_from_palm(&self, palm: PalmMotion, direction: Vector) -> Vector {
        match self.settings.mico {
            None => self.frame.rotate(direction),
            Some(_) => palm.orientation * direction,
        }
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
        palm: PalmMotion,
    ) -> [FingerState; N_OBSERVED_FINGERS] {
        let palm_position = self.end_effector(physics);
        let mut states = [FingerState::default(); N_OBSERVED_FINGERS];
        for (finger, state) in self.fingers.iter().zip(&mut states) {
            let body = &physics.bodies[finger.body];
            let lever = body.translation() - palm_position;
            let carried = palm.velocity + palm.angular_velocity.cross(lever);
            let offset = self.palm_from_world(palm, lever) - finger.closed_offset;
            let velocity = self.palm_from_world(palm, body.linvel() - carried);
            *state = FingerState {
                opening_m: offset.y * finger.side,
                opening_rate_mps: velocity.y * finger.side,
                offset,
                velocity,
            };
        }
        states
    }
}

/// Adds the palm's body. That of a Mico has its mass at the end effector, about which the hand tilts.
fn build_palm(
    physics: &mut Physics,
    arm: ArmIndex,
    frame: ArmFrame,
    settings: &HandSettings,
) -> RigidBodyHandle {
    let at_end_effector_kg = settings.mass_at_end_effector_kg();
    let tilts = settings.mico.is_some();
    let body = if tilts {
        let mass = MassProperties::new(Vector::ZERO, at_end_effector_kg, Vector::ZERO);
        weightless_body(frame).additional_mass_properties(mass)
    } else {
        weightless_body(frame)
    };
    let palm = physics.bodies.insert(body);
    let part = |shape: ColliderBuilder, mass_kg: f32, above_m: f32| {
        shape
            .translation(Vector::new(0.0, 0.0, above_m))
            .mass(if tilts { 0.0 } else { mass_kg })
            .friction(0.4)
            .collision_groups(collides(Part::Hand, arm))
    };
    let PalmGeometry { half, behind_m, has_wrist } = &settings.geometry.palm;
    let plate = ColliderBuilder::cuboid(half.x, half.y, half.z);
    let mut parts = vec![part(plate, 0.7 * PALM_MASS_KG, *behind_m)];
    if *has_wrist {
        let [low_m, high_m] = WRIST_ABOVE_M;
        let wrist = ColliderBuilder::capsule_z(0.5 * (high_m - low_m), WRIST_RADIUS_M);
        parts.push(part(wrist, 0.3 * PALM_MASS_KG, 0.5 * (low_m + high_m)));
    }
    for part in parts {
        physics.colliders.insert_with_parent(part, palm, &mut physics.bodies);
    }
    palm
}

/// Adds a finger to `body`, which is its own or the palm's. The palm's body is rotated with the arm, so a pad's position
/// in it is in the arm's frame.
fn add_finger(
    physics: &mut Physics,
    arm: ArmIndex,
    body: RigidBodyHandle,
    geometry: &FingerGeometry,
    settings: &HandSettings,
) -> Finger {
    let pad_half = settings.geometry.pad_half;
    let closed_offset = Vector::new(geometry.x_m, geometry.side * pad_half.y, 0.0);
    let is_weightless = settings.mico.is_some() && settings.gripper == Gripper::Locked;
    let centre = match settings.gripper {
        Gripper::Locked => closed_offset,
        Gripper::Driven => Vector::ZERO,
    };
    let mass_kg = if is_weightless { 0.0 } else { geometry.mass_kg };
    let mut add = |[low_m, high_m]: [f32; 2], friction: f32| {
        let part = ColliderBuilder::cuboid(pad_half.x, pad_half.y, 0.5 * (high_m - low_m))
            .translation(centre + Vector::Z * (0.5 * (low_m + high_m)))
            .mass(mass_kg * ((high_m - low_m) / (2.0 * pad_half.z)))
            .friction(friction)
            .friction_combine_rule(CoefficientCombineRule::Max)
            .collision_groups(collides(Part::Hand, arm));
        physics.colliders.insert_with_parent(part, body, &mut physics.bodies)
    };
    let [low_m, high_m] = [-pad_half.z, pad_half.z];
    let border_m = match settings.gripper {
        Gripper::Locked => low_m + settings.geometry.tip_height_m,
        Gripper::Driven => low_m,
    };
    let pad = add([border_m, high_m], settings.surfaces.sides);
    let tip = (border_m > low_m).then(|| add([low_m, border_m], settings.surfaces.tips));
    Finger {
        body,
        pad,
        tip,
        mass_kg: geometry.mass_kg,
        mass_fraction: geometry.mass_kg / FINGERS_MASS_KG,
        closed_offset,
        side: geometry.side,
    }
}

/// Moves a body, at rest.
fn place_body(physics: &mut Physics, body: RigidBodyHandle, pose: Pose) {
    let body = &mut physics.bodies[body];
    body.set_position(pose, true);
    body.set_linvel(Vector::ZERO, true);
    body.set_angvel(Vector::ZERO, true);
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
