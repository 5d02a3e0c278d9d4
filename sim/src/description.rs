//! The world as data: bodies, shapes, contacts and the control law, for simulations in other physics engines.
//!
//! Bodies, shapes and friction are read from the rapier world, and all other numbers from the constants that the
//! simulator computes with. Vectors are in the world frame unless a field names another one: the origin is the centre
//! of the table top, and z points up.

use rapier3d::dynamics::{CoefficientCombineRule, RigidBody, RigidBodyHandle};
use rapier3d::geometry::{Collider, SharedShape};
use rapier3d::math::{Pose, Vector};
use serde::Serialize;
use tandem_core::layout::{EPISODE_STEPS, GOAL_TOLERANCE_M};
use tandem_core::{ArmIndex, Layout};

use crate::arm::{ACTION_M, REACH_ITERATIONS, TRACK_ITERATIONS};
pub use crate::capsule::Capsules;
use crate::capsule::{
    GRIPPER_ENDS, GRIPPER_RADIUS_M, LINK_FRAMES, LINK_RADII_M, describe_mico_capsules,
};
use crate::config::WorldConfig;
use crate::hand::{
    FINGER_HOLD_FORCE_N, FINGER_HOLD_GAIN, FINGERS_MASS_KG, Gripper, OPENING_END_GAIN,
    PALM_MASS_KG, WRIST_ABOVE_M, WRIST_RADIUS_M,
};
pub use crate::kinematics::DhRow;
use crate::kinematics::{DAMPING, DH_TABLE, HOME, MAX_ANGLE_STEP_RAD, SQUARED_ERROR_TOLERANCE};
use crate::link_avoidance as damper;
use crate::mico::Mico;
pub use crate::mico::MicoKinematics;
use crate::parameters::{ArmKind, WorldParameters};
pub use crate::physics::Part;
use crate::physics::{GRAVITY, owner};
use crate::reach::Reach;
use crate::world::PhysicsWorld;

/// A world as data.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WorldDescription {
    /// Name of the task.
    pub task: &'static str,
    /// Duration of a control step, seconds.
    pub control_step_s: f32,
    /// Physics steps per control step.
    pub substeps: u32,
    /// Equal parts of a physics step in which rapier solves contacts and integrates positions. Forces and the set of
    /// contacts are those of the whole step.
    pub solver_iterations: usize,
    /// Control steps per episode.
    pub episode_steps: usize,
    /// Distance between object and goal up to which the goal counts as achieved, metres.
    pub goal_tolerance_m: f32,
    /// Acceleration of gravity, metres per second squared.
    pub gravity_mps2: [f32; 3],
    /// All bodies that move.
    pub bodies: Vec<BodyDescription>,
    /// All shapes. Those without a body are fixed.
    pub shapes: Vec<ShapeDescription>,
    /// All pairs of shapes that collide. Other shapes pass through each other.
    pub contact_pairs: Vec<ContactPairDescription>,
    /// The arms, in order.
    pub arms: Vec<ArmDescription>,
    /// The control law of the hands.
    pub hand: HandControl,
    /// The kinematics of the arms.
    pub kinematics: Kinematics,
    /// The velocity damper that keeps the links of two arms apart.
    pub link_avoidance: LinkAvoidance,
}

/// A rigid body. Its mass is the sum of those of its shapes and of its own.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BodyDescription {
    /// Whether the body can rotate.
    pub rotates: bool,
    /// Factor of gravity: 0 or 1.
    pub gravity_scale: f32,
    /// Mass at the body's origin that belongs to no shape, kilograms.
    pub own_mass_kg: f32,
}

/// A shape with uniform density.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ShapeDescription {
    /// Index of its body, if it is not fixed.
    pub body: Option<usize>,
    /// The part that it belongs to.
    pub part: Part,
    /// Index of the arm that it belongs to.
    pub arm: usize,
    /// Mass, kilograms; 0 for a fixed shape.
    pub mass_kg: f32,
    /// Shape and size.
    #[serde(flatten)]
    pub geometry: Geometry,
    /// Position relative to the body, metres, in the body's frame; for a fixed shape in the world.
    pub position_m: [f32; 3],
}

/// The geometry of a shape.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Geometry {
    /// A box: half the lengths of its edges, metres.
    BoxHalfExtentsM([f32; 3]),
    /// A cylinder along z with hemispherical ends: radius and half the length of its axis, metres.
    CapsuleRadiusAndHalfLengthM([f32; 2]),
}

/// Two shapes that collide.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ContactPairDescription {
    /// Indices of the shapes.
    pub shapes: [usize; 2],
    /// Coefficient of Coulomb friction between them.
    pub friction: f32,
}

/// An arm, its hand and its object.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ArmDescription {
    /// Origin of the arm's frame, metres.
    pub origin_m: [f32; 3],
    /// 1, or −1 if the arm's frame is rotated by 180° about z. The frames of the arm's bodies are rotated alike at the
    /// start of an episode.
    pub sign: f32,
    /// Index of the object's body. Arms that share an object have the same one.
    pub object: usize,
    /// The point of the object that the arm brings to its goal, in the body's frame, metres.
    pub object_point_m: [f32; 3],
    /// Index of the palm's body, whose origin is the end effector.
    pub palm: usize,
    /// The fingers, if they are separate bodies. Otherwise they are shapes of the palm.
    pub fingers: Vec<FingerDescription>,
}

/// A finger that is a separate body.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FingerDescription {
    /// Index of its body.
    pub body: usize,
    /// Mass, kilograms.
    pub mass_kg: f32,
    /// Fraction of the mass of all fingers of the hand.
    pub mass_fraction: f32,
    /// Position of the closed finger relative to the palm, in an upright hand, metres.
    pub closed_offset_m: [f32; 3],
    /// Direction of opening along y, in an upright hand: 1 or −1.
    pub outward: f32,
}

/// The parameters of the control law in `hand.rs` and `arm.rs` of the simulator.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HandControl {
    /// Displacement of the end effector for an action of 1, metres.
    pub action_m: f32,
    /// Lower corner of the end effector's workspace, arm frame, metres.
    pub workspace_low_m: [f32; 3],
    /// Upper corner of this workspace, arm frame, metres.
    pub workspace_high_m: [f32; 3],
    /// The part of this workspace that the arm reaches; all of it if there is none. Targets outside are moved along
    /// their radius.
    pub reach: Option<&'static Reach>,
    /// Gain from the palm's distance to its target to its velocity, 1/s.
    pub approach_gain_per_s: f32,
    /// Largest speed of the palm, metres per second, if it is limited.
    pub max_speed_mps: Option<f32>,
    /// Mass of palm, wrist and fingers, kilograms.
    pub mass_kg: f32,
    /// Mass of the fingers, kilograms.
    pub fingers_mass_kg: f32,
    /// Largest force of the palm's servo along each axis, newtons.
    pub palm_force_n: f32,
    /// Largest force of each side of the gripper, newtons.
    pub grip_force_n: f32,
    /// Largest opening of each side, metres.
    pub max_opening_m: f32,
    /// Speed of each side at full gripper input, metres per second.
    pub opening_speed_mps: f32,
    /// Fraction of the distance to an end of the opening's range that one physics step may cover.
    pub opening_end_gain: f32,
    /// Largest force that holds a finger in its place, newtons.
    pub finger_hold_force_n: f32,
    /// Gain of this force, 1/s.
    pub finger_hold_gain_per_s: f32,
}

/// The kinematics of an arm.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "arm", rename_all = "snake_case")]
pub enum Kinematics {
    /// Six joints, hand straight down, inverse kinematics by iteration.
    Jaco(Box<JacoKinematics>),
    /// Four joints, a hand that tilts, inverse kinematics in closed form.
    Mico(MicoKinematics),
}

/// The parameters of a Jaco's inverse kinematics, by damped least squares.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JacoKinematics {
    /// Position of the arm's base, arm frame, metres.
    pub base_in_arm_m: [f32; 3],
    /// Denavit–Hartenberg table, from base to wrist.
    pub dh_table: [DhRow; 6],
    /// Joint angles from which an episode's first solution is found, radians.
    pub home_rad: [f64; 6],
    /// Damping factor.
    pub damping: f64,
    /// Largest change of an angle per iteration, radians.
    pub max_angle_step_rad: f64,
    /// Sum of squared errors below which the iteration ends.
    pub squared_error_tolerance: f64,
    /// Iterations at the start of an episode.
    pub reach_iterations: usize,
    /// Iterations per control step.
    pub track_iterations: usize,
}

/// The capsules and parameters of the velocity damper.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LinkAvoidance {
    /// The capsules of an arm.
    #[serde(flatten)]
    pub capsules: Capsules,
    /// Largest approach speed per metre of gap, 1/s.
    pub approach_gain_per_s: f32,
    /// Largest speed of separation that an overlap demands, metres per second.
    pub separation_mps: f32,
    /// Gap above which a pair imposes no limit, metres.
    pub influence_distance_m: f32,
    /// Gap at the start of a control step above which a pair is ignored during the step, metres.
    pub activation_distance_m: f32,
    /// Distance between two axes below which the direction between them is undefined, metres.
    pub crossing_m: f32,
    /// Lower bound on the norm of a limit's direction.
    pub min_direction_norm: f32,
    /// Largest number of projections of a velocity.
    pub max_projections: usize,
    /// Violation of a limit that counts as none, metres per second.
    pub violation_tolerance_mps: f32,
}

/// Describes `world`, which was built for `layout` from `config`.
pub(crate) fn describe(
    world: &PhysicsWorld,
    layout: Layout,
    config: &WorldConfig,
) -> WorldDescription {
    let kind = layout.task.world();
    WorldDescription {
        task: layout.task.name(),
        control_step_s: kind.control_step_s(),
        substeps: config.substeps_in(kind),
        solver_iterations: config.solver_iterations_in(kind),
        episode_steps: EPISODE_STEPS,
        goal_tolerance_m: GOAL_TOLERANCE_M,
        gravity_mps2: GRAVITY.to_array(),
        bodies: bodies(world),
        shapes: shapes(world),
        contact_pairs: contact_pairs(world),
        arms: layout.arms().map(|arm| arm_description(world, arm)).collect(),
        hand: hand_control(config, world.parameters),
        kinematics: kinematics(world.parameters),
        link_avoidance: link_avoidance(world),
    }
}

fn bodies(world: &PhysicsWorld) -> Vec<BodyDescription> {
    let describe = |(handle, body): (RigidBodyHandle, &RigidBody)| BodyDescription {
        rotates: !body.is_rotation_locked().contains(&true),
        gravity_scale: body.gravity_scale(),
        own_mass_kg: own_mass_kg(world, handle),
    };
    world.physics.bodies.iter().map(describe).collect()
}

/// Returns the mass of a body that belongs to none of its shapes, kilograms.
fn own_mass_kg(world: &PhysicsWorld, body: RigidBodyHandle) -> f32 {
    let hand = world.arms.iter().map(|arm| &arm.hand).find(|hand| hand.palm == body);
    hand.map_or(0.0, |hand| hand.settings.mass_at_end_effector_kg())
}

fn shapes(world: &PhysicsWorld) -> Vec<ShapeDescription> {
    let describe = |collider: &Collider| {
        let (part, arm) = owner(collider);
        let pose: Pose = match collider.position_wrt_parent() {
            Some(in_body) => *in_body,
            None => *collider.position(),
        };
        ShapeDescription {
            body: collider.parent().map(|body| body_index(world, body)),
            part,
            arm: arm.0,
            mass_kg: if collider.parent().is_some() { collider.mass() } else { 0.0 },
            geometry: geometry(collider.shared_shape()),
            position_m: (pose.translation + pose.rotation * centre(collider.shared_shape()))
                .to_array(),
        }
    };
    world.physics.colliders.iter().map(|(_, collider)| describe(collider)).collect()
}

/// Returns the geometry of `shape`. Boxes are symmetric about every plane, so the half turn of an arm's table or body
/// about z does not change them.
fn geometry(shape: &SharedShape) -> Geometry {
    if let Some(capsule) = shape.as_capsule() {
        Geometry::CapsuleRadiusAndHalfLengthM([capsule.radius, capsule.half_height()])
    } else {
        let cuboid = shape.as_cuboid().expect("a world consists of boxes and capsules");
        Geometry::BoxHalfExtentsM(cuboid.half_extents.to_array())
    }
}

/// Returns the centre of `shape` in its own frame, metres.
fn centre(shape: &SharedShape) -> Vector {
    shape.as_capsule().map_or(Vector::ZERO, |capsule| capsule.center())
}

fn contact_pairs(world: &PhysicsWorld) -> Vec<ContactPairDescription> {
    let colliders: Vec<&Collider> =
        world.physics.colliders.iter().map(|(_, collider)| collider).collect();
    let mut pairs = Vec::new();
    for (second, of_second) in colliders.iter().enumerate() {
        for (first, of_first) in colliders[..second].iter().enumerate() {
            // Shapes of one body move together.
            let in_one_body =
                of_first.parent().is_some() && of_first.parent() == of_second.parent();
            if !in_one_body && of_first.collision_groups().test(of_second.collision_groups()) {
                let friction = CoefficientCombineRule::combine(
                    of_first.friction(),
                    of_second.friction(),
                    of_first.friction_combine_rule(),
                    of_second.friction_combine_rule(),
                );
                pairs.push(ContactPairDescription { shapes: [first, second], friction });
            }
        }
    }
    pairs
}

fn arm_description(world: &PhysicsWorld, idx: ArmIndex) -> ArmDescription {
    let arm = &world.arms[idx.0];
    let fingers: &[_] = match arm.hand.settings.gripper {
        Gripper::Locked => &[],
        Gripper::Driven => &arm.hand.fingers,
    };
    ArmDescription {
        origin_m: [arm.frame.centre_x_m, 0.0, 0.0],
        sign: arm.frame.sign,
        object: body_index(world, world.object_handle(idx)),
        object_point_m: world.object_point(idx).to_array(),
        palm: body_index(world, arm.hand.palm),
        fingers: fingers
            .iter()
            .map(|finger| FingerDescription {
                body: body_index(world, finger.body),
                mass_kg: finger.mass_kg,
                mass_fraction: finger.mass_fraction,
                closed_offset_m: arm.frame.rotate(finger.closed_offset).to_array(),
                outward: arm.frame.sign * finger.side,
            })
            .collect(),
    }
}

/// Returns the index of `body` in the order of [`bodies`].
fn body_index(world: &PhysicsWorld, body: RigidBodyHandle) -> usize {
    world
        .physics
        .bodies
        .iter()
        .position(|(handle, _)| handle == body)
        .expect("bodies are never removed")
}

fn hand_control(config: &WorldConfig, parameters: &WorldParameters) -> HandControl {
    HandControl {
        action_m: ACTION_M,
        workspace_low_m: parameters.workspace_low.to_array(),
        workspace_high_m: parameters.workspace_high.to_array(),
        reach: parameters.reach,
        approach_gain_per_s: parameters.approach_gain_per_s,
        max_speed_mps: parameters.max_speed_mps,
        mass_kg: PALM_MASS_KG + FINGERS_MASS_KG,
        fingers_mass_kg: FINGERS_MASS_KG,
        palm_force_n: parameters.palm_force_n,
        grip_force_n: config.grip_force_n,
        max_opening_m: parameters.gripper.max_opening_m,
        opening_speed_mps: parameters.gripper.opening_speed_mps,
        opening_end_gain: OPENING_END_GAIN,
        finger_hold_force_n: FINGER_HOLD_FORCE_N,
        finger_hold_gain_per_s: FINGER_HOLD_GAIN,
    }
}

fn kinematics(parameters: &WorldParameters) -> Kinematics {
    if parameters.arms == ArmKind::Mico {
        return Kinematics::Mico(Mico::in_shared_world().describe());
    }
    Kinematics::Jaco(Box::new(JacoKinematics {
        base_in_arm_m: parameters.base_in_arm.to_array(),
        dh_table: DH_TABLE,
        home_rad: HOME,
        damping: DAMPING,
        max_angle_step_rad: MAX_ANGLE_STEP_RAD,
        squared_error_tolerance: SQUARED_ERROR_TOLERANCE,
        reach_iterations: REACH_ITERATIONS,
        track_iterations: TRACK_ITERATIONS,
    }))
}

fn capsules(world: &PhysicsWorld) -> Capsules {
    if world.parameters.arms == ArmKind::Mico {
        return describe_mico_capsules(&world.arms[0].hand.settings);
    }
    Capsules::Jaco {
        link_frames: LINK_FRAMES,
        link_radii_m: LINK_RADII_M,
        wrist_above_m: WRIST_ABOVE_M,
        wrist_radius_m: WRIST_RADIUS_M,
        gripper_ends_m: GRIPPER_ENDS.map(|end| end.to_array()),
        gripper_radius_m: GRIPPER_RADIUS_M,
    }
}

fn link_avoidance(world: &PhysicsWorld) -> LinkAvoidance {
    LinkAvoidance {
        capsules: capsules(world),
        approach_gain_per_s: damper::APPROACH_GAIN,
        separation_mps: damper::SEPARATION_MPS,
        influence_distance_m: damper::INFLUENCE_DISTANCE_M,
        activation_distance_m: damper::ACTIVATION_DISTANCE_M,
        crossing_m: damper::CROSSING_M,
        min_direction_norm: damper::MIN_DIRECTION_NORM,
        max_projections: damper::MAX_PROJECTIONS,
        violation_tolerance_mps: damper::VIOLATION_TOLERANCE_MPS,
    }
}

#[cfg(test)]
mod tests;
