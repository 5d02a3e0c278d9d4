//! The simulated world: table, objects and arms, and the sequence of a control step.

use rapier3d::dynamics::{CoefficientCombineRule, RigidBody, RigidBodyBuilder, RigidBodyHandle};
use rapier3d::geometry::{ColliderBuilder, ColliderHandle, SharedShape};
use rapier3d::math::{Pose, Rotation, Vector};
use tandem_core::{ArmIndex, Contacts, Layout, World};

use crate::arm::{Arm, Command};
use crate::bar;
use crate::config::{SimError, WorldConfig};
use crate::frame::{ArmFrame, MAX_ARMS};
use crate::hand::Finger;
use crate::link_avoidance::VelocityDamper;
use crate::parameters::WorldParameters;
use crate::physics::{Part, Physics, collides, owner};
use crate::randomization::DomainRandomization;

/// Half extents of the table, metres; its top is at z = 0.
pub(crate) const TABLE_HALF_M: Vector = Vector::new(0.8, 0.6, 0.05);
/// Height of the floor, world frame, metres.
const FLOOR_M: f32 = -0.75;
/// Half extents of the floor, metres.
const FLOOR_HALF_M: Vector = Vector::new(8.0, 8.0, 0.5);

/// Force of a pad above which it presses on the bar, newtons.
const GRIPPING_N: f32 = 0.5;

/// The motion of an object, world frame, metres and seconds.
pub(crate) struct ObjectState {
    pub(crate) position: Vector,
    pub(crate) velocity: Vector,
    pub(crate) rotation: Rotation,
    pub(crate) angular_velocity: Vector,
}

/// The state of all bodies. There is one object per arm, in arm order, or one bar.
#[derive(Clone)]
pub(crate) struct PhysicsWorld {
    pub(crate) physics: Physics,
    pub(crate) arms: Vec<Arm>,
    pub(crate) objects: Vec<RigidBodyHandle>,
    /// Whether the object is a bar that both arms share.
    pub(crate) has_bar: bool,
    /// The arms whose pads have pressed on the bar from both sides during the last control step.
    gripping: [bool; MAX_ARMS],
    /// Present if there are two arms.
    damper: Option<VelocityDamper>,
    substeps: u32,
    /// Gap between two arms, hands included, below which they count as touching, metres; 0 if only bodies that press on each
    /// other and links that overlap do.
    contact_margin_m: f32,
    /// Physics steps at the start of a control step in which the previous command is still executed.
    delay_substeps: u32,
    previous: [Command; MAX_ARMS],
    pub(crate) parameters: &'static WorldParameters,
    pub(crate) control_step_s: f32,
}

impl PhysicsWorld {
    /// Creates a world whose bodies have not been placed yet.
    pub(crate) fn build(layout: Layout, config: &WorldConfig) -> Self {
        let friction = config.surfaces(layout.task);
        let kind = layout.task.world();
        let mut physics = Physics::new(config, kind);
        let mut arms = Vec::with_capacity(layout.n_arms);
        let mut objects = Vec::with_capacity(layout.n_arms);
        for arm in layout.arms() {
            let frame = ArmFrame::new(arm, layout.n_arms);
            add_table(&mut physics, arm, frame, config.table_friction);
            arms.push(Arm::build(&mut physics, arm, frame, layout.task, config));
            if !layout.task.shares_object() {
                objects.push(add_object(&mut physics, arm, config, friction.object));
            }
        }
        if layout.task.shares_object() {
            objects.push(bar::build(&mut physics, friction.object));
        }
        if kind == World::Shared {
            for arm in layout.arms() {
                add_floor(&mut physics, arm, config.table_friction);
            }
        }
        Self {
            physics,
            arms,
            objects,
            has_bar: layout.task.shares_object(),
            gripping: [false; MAX_ARMS],
            damper: None,
            substeps: config.substeps_in(kind),
            contact_margin_m: 0.0,
            delay_substeps: 0,
            previous: [Command { target: Vector::ZERO, gripper: 0.0 }; MAX_ARMS],
            parameters: WorldParameters::of(kind),
            control_step_s: kind.control_step_s(),
        }
    }

    /// Places `arm`'s object at `at_in_arm` (metres), at rest and rotated from the arm's frame by `yaw_rad` about the
    /// vertical axis.
    pub(crate) fn place_object(&mut self, arm: ArmIndex, at_in_arm: Vector, yaw_rad: f32) {
        let frame = self.arms[arm.0].frame;
        let (sin, cos) = libm::sincosf(0.5 * yaw_rad);
        let turned = frame.orientation_in_world() * Rotation::from_xyzw(0.0, 0.0, sin, cos);
        let pose = Pose::from_parts(frame.world_from_arm(at_in_arm), turned);
        self.place_body(self.objects[arm.0], pose);
    }

    /// Places the bar, at rest and level, between its handles: those of both arms, arm frames, metres. The bar is rotated
    /// by `yaw_rad` from the line through the arms' bases.
    pub(crate) fn place_bar(&mut self, handles_in_arm: [Vector; MAX_ARMS], yaw_rad: f32) {
        let handle = |arm: usize| self.arms[arm].frame.world_from_arm(handles_in_arm[arm]);
        let centre = (handle(0) + handle(1)) * 0.5;
        let (sin, cos) = libm::sincosf(0.5 * yaw_rad);
        let turned = Rotation::from_xyzw(0.0, 0.0, sin, cos);
        self.place_body(self.objects[0], Pose::from_parts(centre, turned));
        self.gripping = [false; MAX_ARMS];
    }

    fn place_body(&mut self, body: RigidBodyHandle, pose: Pose) {
        let body = &mut self.physics.bodies[body];
        body.set_position(pose, true);
        body.set_linvel(Vector::ZERO, true);
        body.set_angvel(Vector::ZERO, true);
    }

    /// Places `arm`, at rest, with its end effector at `end_effector_in_arm` (metres).
    pub(crate) fn place_arm(&mut self, arm: ArmIndex, end_effector_in_arm: Vector, opening_m: f32) {
        self.arms[arm.0].place(&mut self.physics, end_effector_in_arm, opening_m);
    }

    /// Gives objects, pads and table the properties that were drawn for an episode, and delays its actions. A bar keeps
    /// its size and mass. To be called before the first step and before the arms are placed.
    pub(crate) fn vary(&mut self, drawn: &DomainRandomization) {
        let half_m = drawn.object_half_m;
        for object in &self.objects {
            for collider in self.physics.bodies[*object].colliders() {
                let part = &mut self.physics.colliders[*collider];
                if !self.has_bar {
                    part.set_shape(SharedShape::cuboid(half_m, half_m, half_m));
                    part.set_mass(drawn.object_mass_kg);
                }
                part.set_friction(drawn.surfaces.object);
            }
        }
        for finger in self.arms.iter().flat_map(|arm| &arm.hand.fingers) {
            self.physics.colliders[finger.pad].set_friction(drawn.surfaces.sides);
            if let Some(tip) = finger.tip {
                self.physics.colliders[tip].set_friction(drawn.surfaces.tips);
            }
        }
        let tables: Vec<ColliderHandle> = self
            .physics
            .colliders
            .iter()
            .filter(|(_, collider)| owner(collider).0 == Part::Table)
            .map(|(handle, _)| handle)
            .collect();
        for table in tables {
            self.physics.colliders[table].set_friction(drawn.table_friction);
        }
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a few steps, at least 0"
        )]
        let delay_substeps = (drawn.delay_s / self.physics.substep_s()) as u32;
        self.delay_substeps = delay_substeps;
        self.contact_margin_m = drawn.contact_margin_m;
    }

    /// Makes the arms stay where they are, with grippers as they are, until the first action takes effect.
    ///
    /// A gripper counts as open if its opening, computed from the fingers' rounded positions, is not below the largest. At
    /// some places in the shared world it is below by a rounding error; such a gripper closes by up to 2.3 mm during the
    /// delay. A margin would change the bits of recorded episodes and runs.
    pub(crate) fn hold(&mut self) {
        for (arm, previous) in self.arms.iter().zip(&mut self.previous) {
            let (opening_m, _) = arm.hand.openings(&self.physics)[0];
            let is_open = opening_m >= arm.parameters.gripper.max_opening_m;
            let target = arm.hand.end_effector(&self.physics);
            *previous = Command { target, gripper: if is_open { 1.0 } else { -1.0 } };
        }
    }

    /// Starts link avoidance anew. To be called once all arms are in place.
    pub(crate) fn reset_link_avoidance(&mut self) {
        self.damper = match self.arms.as_slice() {
            [first, second] => {
                let watches_hands = self.contact_margin_m > 0.0;
                Some(VelocityDamper::new([first, second], &self.physics, watches_hands))
            }
            _ => None,
        };
    }

    /// Returns the smallest gap between the links of two arms during the last control step, metres; infinite for one
    /// arm.
    pub(crate) fn link_gap_m(&self) -> f32 {
        self.damper.as_ref().map_or(f32::INFINITY, VelocityDamper::min_gap_m)
    }

    /// Returns the smallest distance between the hand of `arm` and the object of `owner`, metres; 0 if they touch.
    pub(crate) fn hand_to_object_m(&self, arm: ArmIndex, owner: ArmIndex) -> f32 {
        let object = self.object_handle(owner);
        let gaps_m = self.arms[arm.0].hand.bodies().map(|body| self.physics.gap_m(body, object));
        gaps_m.fold(f32::INFINITY, f32::min)
    }

    /// Returns the number of physics steps of the last control step in which link avoidance changed the velocity of an
    /// arm.
    pub(crate) fn n_avoiding_substeps(&self) -> u32 {
        self.damper.as_ref().map_or(0, VelocityDamper::n_interventions)
    }

    /// Returns the body of `arm`'s object: the bar if the arms share one.
    pub(crate) fn object(&self, arm: ArmIndex) -> &RigidBody {
        &self.physics.bodies[self.object_handle(arm)]
    }

    /// Returns the handle of the body of `arm`'s object.
    pub(crate) fn object_handle(&self, arm: ArmIndex) -> RigidBodyHandle {
        self.objects[if self.has_bar { 0 } else { arm.0 }]
    }

    /// Returns the point of the object's body that `arm` brings to its goal: the centre, or its handle of the bar; body
    /// frame, metres.
    pub(crate) fn object_point(&self, arm: ArmIndex) -> Vector {
        if self.has_bar { bar::handle(arm) } else { Vector::ZERO }
    }

    /// Returns the motion of `arm`'s object, or of its handle of the bar.
    pub(crate) fn object_state(&self, arm: ArmIndex) -> ObjectState {
        let body = self.object(arm);
        let (position, velocity) = (body.translation(), body.linvel());
        let (rotation, angular_velocity) = (*body.rotation(), body.angvel());
        if !self.has_bar {
            return ObjectState { position, velocity, rotation, angular_velocity };
        }
        let lever = rotation * self.object_point(arm);
        ObjectState {
            position: position + lever,
            velocity: velocity + angular_velocity.cross(lever),
            // A bar along x looks the same to both arms.
            rotation: rotation * self.arms[arm.0].frame.orientation_in_world(),
            angular_velocity,
        }
    }

    /// Returns true if the pads of `arm` have pressed on the bar from both sides in a physics step of the last control
    /// step.
    pub(crate) fn is_gripping(&self, arm: ArmIndex) -> bool {
        self.gripping[arm.0]
    }

    #[cfg(test)]
    pub(crate) fn object_mut(&mut self, arm: ArmIndex) -> &mut RigidBody {
        &mut self.physics.bodies[self.objects[arm.0]]
    }

    /// Simulates one control step. `commands` has one entry per arm; further entries are ignored.
    pub(crate) fn step(&mut self, commands: &[Command; MAX_ARMS]) -> Result<Contacts, SimError> {
        for arm in &mut self.arms {
            arm.track(&self.physics);
        }
        if let (Some(damper), [first, second]) = (&mut self.damper, self.arms.as_slice()) {
            damper.update_posture([first, second], &self.physics);
        }
        let mut contacts = Contacts::NONE;
        self.gripping = [false; MAX_ARMS];
        let previous = std::mem::replace(&mut self.previous, *commands);
        for substep in 0..self.substeps {
            self.drive(if substep < self.delay_substeps { &previous } else { commands });
            self.physics.step();
            contacts = contacts | self.physics.hand_contacts();
            if let Some(limit_n) = self.parameters.press_limit_n {
                for (arm, force_n) in self.physics.downward_forces_n().into_iter().enumerate() {
                    if force_n > limit_n {
                        contacts = contacts | Contacts::TABLE_OF[arm];
                    }
                }
            }
            if self.has_bar {
                self.update_gripping();
            }
        }
        self.check_finite()?;
        let hand_gap_m = self.damper.as_ref().map_or(f32::INFINITY, VelocityDamper::min_hand_gap_m);
        if self.link_gap_m().min(hand_gap_m) < self.contact_margin_m {
            contacts = contacts | Contacts::ARM_ARM;
        }
        Ok(if self.parameters.attributes_contacts { contacts } else { contacts.of_any_arm() })
    }

    /// Sets the forces on the hands for the next physics step.
    fn drive(&mut self, commands: &[Command; MAX_ARMS]) {
        let mut velocities = [Vector::ZERO; MAX_ARMS];
        for ((arm, command), velocity) in self.arms.iter().zip(commands).zip(&mut velocities) {
            *velocity = arm.velocity_to(&self.physics, command.target);
        }
        if let (Some(damper), [first, second]) = (&mut self.damper, self.arms.as_slice()) {
            let palms = [first, second].map(|arm| arm.hand.end_effector(&self.physics));
            velocities = damper.limit(palms, velocities);
            velocities = velocities.map(|velocity| self.parameters.limit_speed(velocity));
        }
        for ((arm, command), velocity) in self.arms.iter().zip(commands).zip(velocities) {
            arm.hand.drive(&mut self.physics, velocity, command.gripper);
        }
    }

    fn update_gripping(&mut self) {
        let bar = self.physics.bodies[self.objects[0]].colliders();
        for (arm, gripping) in self.arms.iter().zip(&mut self.gripping) {
            let presses = |side: f32| {
                let mut pads = arm.hand.fingers.iter().filter(|finger| finger.side == side);
                pads.any(|Finger { pad, .. }| {
                    bar.iter().any(|part| self.physics.presses(*pad, *part, GRIPPING_N))
                })
            };
            *gripping = *gripping || (presses(1.0) && presses(-1.0));
        }
    }

    fn check_finite(&self) -> Result<(), SimError> {
        for (arm, state) in self.arms.iter().enumerate() {
            if !state.hand.is_finite(&self.physics) {
                return Err(SimError::StateNotFinite { part: "hand", arm });
            }
            let object = self.object(ArmIndex(arm));
            let parts = [object.translation(), object.linvel(), object.angvel()];
            if !parts.iter().all(|part| part.is_finite()) || !object.rotation().is_finite() {
                return Err(SimError::StateNotFinite { part: "object", arm });
            }
        }
        Ok(())
    }
}

/// Adds the table that `arm`'s hand and object collide with. Each arm has one, at the same place but rotated with the
/// arm.
///
/// rapier solves the contacts of a cube's four corners in an order that depends on the table's axes, which displaces a
/// resting cube by a micrometre. With a table per arm, the cubes of the two arms are displaced in opposite directions,
/// which preserves the symmetry of the arms.
fn add_table(physics: &mut Physics, arm: ArmIndex, frame: ArmFrame, friction: f32) {
    let top_at_zero = Vector::new(0.0, 0.0, -TABLE_HALF_M.z);
    let table = ColliderBuilder::cuboid(TABLE_HALF_M.x, TABLE_HALF_M.y, TABLE_HALF_M.z)
        .position(Pose::from_parts(top_at_zero, frame.orientation_in_world()))
        .friction(friction)
        .friction_combine_rule(CoefficientCombineRule::Min)
        .collision_groups(collides(Part::Table, arm));
    physics.colliders.insert(table);
}

/// Adds the floor below the table, for `arm`'s object: an episode of the shared world is long enough for a fall of 760 m.
fn add_floor(physics: &mut Physics, arm: ArmIndex, friction: f32) {
    let floor = ColliderBuilder::cuboid(FLOOR_HALF_M.x, FLOOR_HALF_M.y, FLOOR_HALF_M.z)
        .translation(Vector::Z * (FLOOR_M - FLOOR_HALF_M.z))
        .friction(friction)
        .friction_combine_rule(CoefficientCombineRule::Min)
        .collision_groups(collides(Part::Table, arm));
    physics.colliders.insert(floor);
}

fn add_object(
    physics: &mut Physics,
    arm: ArmIndex,
    config: &WorldConfig,
    friction: f32,
) -> RigidBodyHandle {
    let half_m = config.object_half_size_m;
    let body = physics.bodies.insert(RigidBodyBuilder::dynamic().can_sleep(false));
    let cube = ColliderBuilder::cuboid(half_m, half_m, half_m)
        .mass(config.object_mass_kg)
        .friction(friction)
        .friction_combine_rule(CoefficientCombineRule::Max)
        .collision_groups(collides(Part::Object, arm));
    physics.colliders.insert_with_parent(cube, body, &mut physics.bodies);
    body
}
