//! Table, objects and hands in rapier.
//!
//! Hands and forearms are kinematic bodies that follow the joints exactly, including their tilt. Each finger is a
//! separate body on a prismatic joint along the closing direction, driven by a spring with limited force. The forces of
//! objects on a hand are converted to torques of the joints.

use glam::{DMat3, DVec3};
use rapier3d::dynamics::{
    CCDSolver, CoefficientCombineRule, FrictionModel, ImpulseJointHandle, ImpulseJointSet,
    IntegrationParameters, IslandManager, MotorModel, MultibodyJointSet, PrismaticJointBuilder,
    RigidBodyBuilder, RigidBodyHandle, RigidBodySet, SoftBodySet, SpringCoefficients,
};
use rapier3d::geometry::{
    BroadPhaseBvh, ColliderBuilder, ColliderHandle, ColliderSet, Group, InteractionGroups,
    InteractionTestMode, NarrowPhase,
};
use rapier3d::math::{Matrix, Pose, Rotation, Vector};
use rapier3d::pipeline::PhysicsPipeline;

use crate::simulated::config::{Block, GripperConfig, SharedObject, SimulatedConfig};
use crate::simulated::single;

/// The largest opening of each finger's pad, metres.
pub const MAX_OPENING_M: f32 = 0.062;
/// Half extents of a pad: along the closing direction, across it, along the hand; metres.
pub(crate) const PAD_HALF_M: DVec3 = DVec3::new(0.005, 0.008, 0.015);
/// The same in the precision of the physics.
#[expect(clippy::cast_possible_truncation, reason = "rounds to single precision")]
const PAD_HALF_SINGLE_M: Vector =
    Vector::new(PAD_HALF_M.x as f32, PAD_HALF_M.y as f32, PAD_HALF_M.z as f32);
/// The distance of the pads' centres ahead of the tool's origin, metres.
pub(crate) const PAD_AHEAD_M: f32 = 0.021;
/// Half extents of the hand's shell, in the tool's axes, metres.
pub(crate) const HAND_HALF_M: Vector = Vector::new(0.035, 0.030, 0.050);
/// The distance of the shell's centre behind the tool's origin, metres. The shell reaches from the last joint to the
/// fingers.
pub(crate) const HAND_BEHIND_M: f32 = 0.110;
/// Half extents of the table, metres.
pub(crate) const TABLE_HALF_M: Vector = Vector::new(0.9, 0.7, 0.05);
/// Radius of the forearm's shell, metres.
const FOREARM_RADIUS_M: f32 = 0.035;

/// The duration of a physics step, seconds, as in the drives.
const SUBSTEP_S: f32 = 0.0025;
/// Stiffness and damping of the spring that drives a finger, newtons per metre and newton seconds per metre.
const FINGER_STIFFNESS: f32 = 4000.0;
const FINGER_DAMPING: f32 = 30.0;
/// Largest force of the spring as a multiple of the grip force. The excess keeps both fingers aligned.
const FINGER_RESERVE: f32 = 3.0;

const TABLE: Group = Group::GROUP_1;
const OBJECTS: Group = Group::GROUP_2;
const ARMS: [Group; 2] = [Group::GROUP_3, Group::GROUP_4];

/// The bodies of the simulation.
pub(crate) struct PhysicsWorld {
    bodies: RigidBodySet,
    colliders: ColliderSet,
    joints: ImpulseJointSet,
    parameters: IntegrationParameters,
    islands: IslandManager,
    broad_phase: BroadPhaseBvh,
    narrow_phase: NarrowPhase,
    multibody_joints: MultibodyJointSet,
    soft_bodies: SoftBodySet,
    ccd: CCDSolver,
    pipeline: PhysicsPipeline,
    hands: Vec<Hand>,
    /// The object of each arm, or the block of each number.
    objects: Vec<Object>,
    /// What scenes show of the objects.
    shown: Vec<ShownBox>,
}

/// The poses of an arm's bodies; world frame, metres.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ArmPoses {
    pub(crate) tool_m: DVec3,
    pub(crate) tool_axes: DMat3,
    /// The ends of the forearm.
    pub(crate) forearm_m: [DVec3; 2],
}

/// A point of a body that cameras observe.
struct Object {
    body: RigidBodyHandle,
    /// In the body's frame, metres.
    point: Vector,
}

/// A box of a body: its pose in the body's frame and half its edges, metres.
struct ShownBox {
    body: RigidBodyHandle,
    in_body: Pose,
    half_m: Vector,
}

struct Hand {
    body: RigidBodyHandle,
    forearm: RigidBodyHandle,
    fingers: [Finger; 2],
    colliders: Vec<ColliderHandle>,
    /// The target of the fingers, which approaches the commanded opening; metres.
    opening_m: f32,
}

struct Finger {
    body: RigidBodyHandle,
    joint: ImpulseJointHandle,
    /// The opening direction, along x of the tool.
    side: f32,
}

impl PhysicsWorld {
    /// Creates arms at `poses` with their grippers at `opening` (0 to 1), and a table whose top is at `table_z_m`.
    pub(crate) fn new(
        config: &SimulatedConfig,
        poses: &[ArmPoses],
        opening: f32,
        table_z_m: f32,
    ) -> Self {
        let mut pipeline = PhysicsPipeline::new();
        pipeline.counters.disable();
        let mut world = Self {
            bodies: RigidBodySet::new(),
            colliders: ColliderSet::new(),
            joints: ImpulseJointSet::new(),
            parameters: integration_parameters(),
            islands: IslandManager::new(),
            broad_phase: BroadPhaseBvh::new(),
            narrow_phase: NarrowPhase::new(),
            multibody_joints: MultibodyJointSet::new(),
            soft_bodies: SoftBodySet::new(),
            ccd: CCDSolver::new(),
            pipeline,
            hands: Vec::new(),
            objects: Vec::new(),
            shown: Vec::new(),
        };
        let table = ColliderBuilder::cuboid(TABLE_HALF_M.x, TABLE_HALF_M.y, TABLE_HALF_M.z)
            .translation(Vector::new(0.0, 0.0, table_z_m - TABLE_HALF_M.z))
            .friction(config.table_friction)
            .friction_combine_rule(CoefficientCombineRule::Min)
            .collision_groups(groups(TABLE, OBJECTS | ARMS[0] | ARMS[1]));
        world.colliders.insert(table);
        for (arm, poses) in poses.iter().enumerate() {
            world.add_hand(ARMS[arm % ARMS.len()], poses, &config.gripper, opening);
        }
        for block in &config.blocks {
            world.add_block(block, config.table_friction, table_z_m);
        }
        if let Some(shared) = &config.shared {
            world.add_shared(shared, config.table_friction);
        }
        world
    }

    /// Simulates a physics step that moves the arms to `poses` and the grippers towards `openings` (0 to 1).
    pub(crate) fn step(&mut self, poses: &[ArmPoses], openings: &[f64], gripper: &GripperConfig) {
        for (arm, poses) in poses.iter().enumerate() {
            let hand = &self.hands[arm];
            for (body, pose) in [(hand.body, poses.hand()), (hand.forearm, poses.forearm())] {
                let body = &mut self.bodies[body];
                let pose = nearest(&pose, body.position());
                body.set_next_kinematic_position(pose);
            }
            let wanted_m = single(openings[arm]) * MAX_OPENING_M;
            self.drive_fingers(arm, wanted_m, gripper);
        }
        self.pipeline.step(
            Vector::new(0.0, 0.0, -9.81),
            &self.parameters,
            &mut self.islands,
            &mut self.broad_phase,
            &mut self.narrow_phase,
            &mut self.bodies,
            &mut self.colliders,
            &mut self.joints,
            &mut self.multibody_joints,
            &mut self.soft_bodies,
            &mut self.ccd,
            &(),
            &(),
        );
    }

    /// Returns the contact force on a hand in the last physics step, world frame, newtons: that of objects and, on the
    /// pads, also of the table and the other arm. Friction, and thus the weight of a held object, is excluded.
    pub(crate) fn force_n(&self, arm: usize) -> DVec3 {
        let mut impulse = Vector::ZERO;
        for collider in &self.hands[arm].colliders {
            for pair in self.narrow_phase.contact_pairs_with(*collider) {
                let towards = if pair.collider1 == *collider { -1.0 } else { 1.0 };
                impulse += pair.total_impulse() * towards;
            }
        }
        (impulse / SUBSTEP_S).as_dvec3()
    }

    /// Returns the opening of a gripper: 0 is closed, 1 is open.
    pub(crate) fn opening(&self, arm: usize) -> f64 {
        let [first, second] = self.openings_m(arm);
        f64::from(0.5 * (first + second) / MAX_OPENING_M).clamp(0.0, 1.0)
    }

    /// The pose of object `idx`, world frame, metres.
    pub(crate) fn object(&self, idx: usize) -> Pose {
        let Object { body, point } = self.objects[idx];
        let at = self.bodies[body].position();
        Pose::from_parts(at.translation + at.rotation * point, at.rotation)
    }

    /// The poses and half extents of the boxes that show the objects, world frame, metres.
    pub(crate) fn shown(&self) -> impl Iterator<Item = (Pose, Vector)> {
        let pose = |shown: &ShownBox| *self.bodies[shown.body].position() * shown.in_body;
        self.shown.iter().map(move |shown| (pose(shown), shown.half_m))
    }

    pub(crate) fn n_objects(&self) -> usize {
        self.objects.len()
    }

    /// The poses and half extents of a hand's shell and its pads.
    pub(crate) fn hand_parts(&self, arm: usize) -> [(Pose, Vector); 3] {
        let hand = &self.hands[arm];
        let at = self.bodies[hand.body].position();
        let shell = *at * Pose::from_parts(Vector::Z * -HAND_BEHIND_M, Rotation::IDENTITY);
        let pad = |finger: &Finger| (*self.bodies[finger.body].position(), PAD_HALF_SINGLE_M);
        [(shell, HAND_HALF_M), pad(&hand.fingers[0]), pad(&hand.fingers[1])]
    }

    /// Returns whether the positions of all bodies are finite.
    pub(crate) fn is_finite(&self) -> bool {
        self.bodies.iter().all(|(_, body)| body.translation().is_finite())
    }

    fn openings_m(&self, arm: usize) -> [f32; 2] {
        let hand = &self.hands[arm];
        let at = self.bodies[hand.body].position();
        [0, 1].map(|idx| {
            let finger = &hand.fingers[idx];
            let offset = at.inv_mul(self.bodies[finger.body].position()).translation;
            offset.x * finger.side - PAD_HALF_SINGLE_M.x
        })
    }

    /// Sets the targets of the fingers' springs. The finger that is ahead is held back, so that a held object stays
    /// centred.
    fn drive_fingers(&mut self, arm: usize, wanted_m: f32, gripper: &GripperConfig) {
        let openings = self.openings_m(arm);
        let mean_m = 0.5 * (openings[0] + openings[1]);
        let step_m = gripper.opening_per_s * MAX_OPENING_M * SUBSTEP_S;
        let hand = &mut self.hands[arm];
        hand.opening_m = wanted_m.clamp(hand.opening_m - step_m, hand.opening_m + step_m);
        let held_m = gripper.grip_n / FINGER_STIFFNESS;
        let target_m = hand.opening_m.clamp(mean_m - held_m, mean_m + held_m);
        for finger in &hand.fingers {
            if let Some(joint) = self.joints.get_mut(finger.joint, true)
                && let Some(slide) = joint.data.as_prismatic_mut()
            {
                slide.set_motor_position(target_m, FINGER_STIFFNESS, FINGER_DAMPING);
            }
        }
    }

    fn add_hand(&mut self, group: Group, poses: &ArmPoses, gripper: &GripperConfig, opening: f32) {
        let others = (OBJECTS | TABLE | ARMS[0] | ARMS[1]) & !group;
        let kinematic = |pose| RigidBodyBuilder::kinematic_position_based().pose(pose);
        let body = self.bodies.insert(kinematic(poses.hand()));
        let forearm = self.bodies.insert(kinematic(poses.forearm()));
        let shell = ColliderBuilder::cuboid(HAND_HALF_M.x, HAND_HALF_M.y, HAND_HALF_M.z)
            .translation(Vector::Z * -HAND_BEHIND_M)
            .friction(0.3)
            .collision_groups(groups(group, others));
        let half_m = single(0.5 * (poses.forearm_m[1] - poses.forearm_m[0]).length());
        let bar = ColliderBuilder::capsule_z(half_m, FOREARM_RADIUS_M)
            .friction(0.3)
            .collision_groups(groups(group, others));
        let mut colliders = vec![
            self.colliders.insert_with_parent(shell, body, &mut self.bodies),
            self.colliders.insert_with_parent(bar, forearm, &mut self.bodies),
        ];
        let opening_m = opening * MAX_OPENING_M;
        let fingers = [1.0, -1.0].map(|side| {
            let closed = Vector::new(side * PAD_HALF_SINGLE_M.x, 0.0, PAD_AHEAD_M);
            let offset = closed + Vector::X * (side * opening_m);
            let pose = poses.hand() * Pose::from_parts(offset, Rotation::IDENTITY);
            let finger = self
                .bodies
                .insert(RigidBodyBuilder::dynamic().pose(pose).gravity_scale(0.0).can_sleep(false));
            let half = PAD_HALF_SINGLE_M;
            let pad = ColliderBuilder::cuboid(half.x, half.y, half.z)
                .mass(gripper.finger_kg)
                .friction(gripper.pad_friction)
                .friction_combine_rule(CoefficientCombineRule::Max)
                .collision_groups(groups(group, others));
            colliders.push(self.colliders.insert_with_parent(pad, finger, &mut self.bodies));
            let slide = PrismaticJointBuilder::new(Vector::X * side)
                .local_anchor1(closed)
                .local_anchor2(Vector::ZERO)
                .contacts_enabled(false)
                .limits([0.0, MAX_OPENING_M])
                .motor_model(MotorModel::ForceBased)
                .motor_position(opening_m, FINGER_STIFFNESS, FINGER_DAMPING)
                .motor_max_force(FINGER_RESERVE * gripper.grip_n)
                .build();
            Finger { body: finger, joint: self.joints.insert(body, finger, slide, true), side }
        });
        self.hands.push(Hand { body, forearm, fingers, colliders, opening_m });
    }

    fn add_block(&mut self, block: &Block, friction: f32, table_z_m: f32) {
        let at = Vector::new(block.at_m[0], block.at_m[1], table_z_m + block.half_m);
        let pose = Pose::from_parts(at, Rotation::from_rotation_z(block.yaw_rad));
        let body = self.bodies.insert(RigidBodyBuilder::dynamic().pose(pose).can_sleep(false));
        let half_m = Vector::splat(block.half_m);
        let cube = object_box(half_m, block.mass_kg, friction);
        self.colliders.insert_with_parent(cube, body, &mut self.bodies);
        self.objects.push(Object { body, point: Vector::ZERO });
        self.shown.push(ShownBox { body, in_body: Pose::IDENTITY, half_m });
    }

    fn add_shared(&mut self, object: &SharedObject, friction: f32) {
        let rotation = Rotation::from_rotation_z(object.yaw_rad);
        let pose = Pose::from_parts(Vector::from_array(object.at_m), rotation);
        let body = self.bodies.insert(RigidBodyBuilder::dynamic().pose(pose).can_sleep(false));
        for part in &object.boxes {
            let part = object_box(Vector::from_array(part.half_m), part.mass_kg, friction)
                .translation(Vector::from_array(part.centre_m));
            self.colliders.insert_with_parent(part, body, &mut self.bodies);
        }
        let points = object.points_m.iter().map(|point| Vector::from_array(*point));
        self.objects.extend(points.map(|point| Object { body, point }));
        self.shown.extend(object.shown.iter().map(|shown| ShownBox {
            body,
            in_body: Pose::from_parts(
                Vector::from_array(shown.centre),
                Rotation::from_array(shown.orientation),
            ),
            half_m: Vector::from_array(shown.half_extents_m),
        }));
    }
}

impl ArmPoses {
    fn hand(&self) -> Pose {
        let [x, y, z] = [self.tool_axes.x_axis, self.tool_axes.y_axis, self.tool_axes.z_axis];
        let axes = Matrix::from_cols(x.as_vec3(), y.as_vec3(), z.as_vec3());
        Pose::from_parts(self.tool_m.as_vec3(), Rotation::from_mat3(&axes))
    }

    fn forearm(&self) -> Pose {
        let [from, to] = self.forearm_m;
        let along = (to - from).normalize().as_vec3();
        let rotation = Rotation::from_rotation_arc(Vector::Z, along);
        Pose::from_parts((0.5 * (from + to)).as_vec3(), rotation)
    }
}

/// Returns a box of an object with half the edges `half_m`, metres.
fn object_box(half_m: Vector, mass_kg: f32, friction: f32) -> ColliderBuilder {
    ColliderBuilder::cuboid(half_m.x, half_m.y, half_m.z)
        .mass(mass_kg)
        .friction(friction)
        .friction_combine_rule(CoefficientCombineRule::Max)
        .collision_groups(groups(OBJECTS, OBJECTS | TABLE | ARMS[0] | ARMS[1]))
}

/// Returns `pose` with the quaternion of its rotation that is nearer to `from`. Rapier would interpret the other one as
/// a full turn.
fn nearest(pose: &Pose, from: &Pose) -> Pose {
    let rotation =
        if pose.rotation.dot(from.rotation) < 0.0 { -pose.rotation } else { pose.rotation };
    Pose::from_parts(pose.translation, rotation)
}

fn groups(member: Group, of: Group) -> InteractionGroups {
    InteractionGroups::new(member, of, InteractionTestMode::And)
}

/// Returns integration parameters with a longer step, more iterations and softer contacts than the training world.
fn integration_parameters() -> IntegrationParameters {
    let softness = SpringCoefficients::new(120.0, 4.0);
    IntegrationParameters {
        dt: SUBSTEP_S,
        num_solver_iterations: 6,
        normalized_prediction_distance: 0.002,
        normalized_allowed_linear_error: 0.0005,
        normalized_max_corrective_velocity: 1.0,
        contact_softness: softness,
        static_contact_softness: softness,
        contact_recycling: false,
        max_ccd_substeps: 0,
        friction_model: FrictionModel::Coulomb,
        ..IntegrationParameters::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_kinematics::MICO_4;

    #[test]
    fn the_pads_stay_within_the_capsule_of_the_fingers() {
        let fingers = &MICO_4.links[MICO_4.links.len() - 1];
        let [from, to] = [0, 1].map(|end| DVec3::from(fingers.ends[end].offset_m));
        let middle = 0.5 * (from + to);
        for opening in [0.0_f32, 0.25, 0.5, 0.75, 1.0] {
            let share = fingers.closed_share + f64::from(opening) * (1.0 - fingers.closed_share);
            let [from, to] = [from, to].map(|end| middle + share * (end - middle));
            for corner in 0..8_u32 {
                let side = |bit: u32| if corner >> bit & 1 == 1 { 1.0 } else { -1.0 };
                let centre =
                    Vector::new(PAD_HALF_SINGLE_M.x + opening * MAX_OPENING_M, 0.0, PAD_AHEAD_M);
                let corner = centre + PAD_HALF_SINGLE_M * Vector::new(side(0), side(1), side(2));
                let corner = corner.as_dvec3();
                let on_line = corner.clamp(from.min(to), from.max(to));
                let distance_m = (corner - on_line).length();
                assert!(distance_m < fingers.radius_m, "{opening}: {corner} {distance_m}");
            }
        }
    }
}
