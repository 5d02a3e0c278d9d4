//! A rapier world that can be cloned, with settings for bodies of centimetres.

use rapier3d::dynamics::{
    CCDSolver, FrictionModel, ImpulseJointSet, IntegrationParameters, IslandManager,
    MultibodyJointSet, RigidBodyHandle, RigidBodySet, SoftBodySet, SpringCoefficients,
};
use rapier3d::geometry::{
    BroadPhaseBvh, Collider, ColliderHandle, ColliderSet, ContactPair, Group, InteractionGroups,
    InteractionTestMode, NarrowPhase,
};
use rapier3d::math::{Pose, Vector};
use rapier3d::parry::query;
use rapier3d::parry::shape::Shape;
use rapier3d::pipeline::PhysicsPipeline;
use serde::Serialize;
use tandem_core::{ArmIndex, Contacts, World};

use crate::config::WorldConfig;

/// Acceleration of gravity, metres per second squared.
pub(crate) const GRAVITY: Vector = Vector::new(0.0, 0.0, -9.81);
/// Collision groups of the tables, one per arm.
const TABLES: [Group; 2] = [Group::GROUP_1, Group::GROUP_2];
/// Collision groups of the objects, in arm order.
const OBJECTS: [Group; 2] = [Group::GROUP_3, Group::GROUP_4];
/// Collision groups of the arms' hands, in arm order.
const HANDS: [Group; 2] = [Group::GROUP_5, Group::GROUP_6];

/// The owner of a collider.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Part {
    /// The table that an arm's object and hand collide with.
    Table,
    /// The arm's object.
    Object,
    /// Palm, wrist and fingers.
    Hand,
}

/// Returns the collision groups of `part` of `arm`. Every part collides with every other one, except that the parts of
/// one hand pass through each other and that each arm has its own table.
pub(crate) fn collides(part: Part, arm: ArmIndex) -> InteractionGroups {
    let movable = OBJECTS[0] | OBJECTS[1] | HANDS[0] | HANDS[1];
    let (group, filter) = match part {
        Part::Table => (TABLES[arm.0], OBJECTS[arm.0] | HANDS[arm.0]),
        Part::Object => (OBJECTS[arm.0], movable | TABLES[arm.0]),
        Part::Hand => (HANDS[arm.0], (movable & !HANDS[arm.0]) | TABLES[arm.0]),
    };
    InteractionGroups::new(group, filter, InteractionTestMode::And)
}

/// Returns the part and the arm to which `collider` belongs.
pub(crate) fn owner(collider: &Collider) -> (Part, ArmIndex) {
    let group = collider.collision_groups().memberships;
    let owners = [(Part::Table, TABLES), (Part::Object, OBJECTS), (Part::Hand, HANDS)];
    owners
        .into_iter()
        .flat_map(|(part, groups)| [(part, ArmIndex(0), groups[0]), (part, ArmIndex(1), groups[1])])
        .find(|(_, _, its)| *its == group)
        .map(|(part, arm, _)| (part, arm))
        .expect("every collider has the groups of one part")
}

/// A rapier world without joints.
///
/// A world that was stepped has filled contact and broad-phase caches, so resetting its bodies does not reproduce the
/// bits of a new world. Clone a world that was never stepped instead.
pub(crate) struct Physics {
    pub(crate) bodies: RigidBodySet,
    pub(crate) colliders: ColliderSet,
    parameters: IntegrationParameters,
    islands: IslandManager,
    broad_phase: BroadPhaseBvh,
    narrow_phase: NarrowPhase,
    impulse_joints: ImpulseJointSet,
    multibody_joints: MultibodyJointSet,
    soft_bodies: SoftBodySet,
    ccd: CCDSolver,
    pipeline: PhysicsPipeline,
}

impl Physics {
    pub(crate) fn new(config: &WorldConfig, world: World) -> Self {
        Self {
            bodies: RigidBodySet::new(),
            colliders: ColliderSet::new(),
            parameters: integration_parameters(config, world),
            islands: IslandManager::new(),
            broad_phase: BroadPhaseBvh::new(),
            narrow_phase: NarrowPhase::new(),
            impulse_joints: ImpulseJointSet::new(),
            multibody_joints: MultibodyJointSet::new(),
            soft_bodies: SoftBodySet::new(),
            ccd: CCDSolver::new(),
            pipeline: pipeline(),
        }
    }

    /// Simulates one physics step.
    pub(crate) fn step(&mut self) {
        self.pipeline.step(
            GRAVITY,
            &self.parameters,
            &mut self.islands,
            &mut self.broad_phase,
            &mut self.narrow_phase,
            &mut self.bodies,
            &mut self.colliders,
            &mut self.impulse_joints,
            &mut self.multibody_joints,
            &mut self.soft_bodies,
            &mut self.ccd,
            &(),
            &(),
        );
    }

    /// Returns the duration of a physics step, seconds.
    pub(crate) fn substep_s(&self) -> f32 {
        self.parameters.dt
    }

    /// Returns the contacts between hands, and between hands and the table, in the last physics step.
    pub(crate) fn hand_contacts(&self) -> Contacts {
        self.narrow_phase
            .contact_pairs()
            .map(|pair| {
                let kind = self.kind_of(pair);
                if kind.any() && pair.total_impulse_magnitude() > 0.0 {
                    kind
                } else {
                    Contacts::NONE
                }
            })
            .fold(Contacts::NONE, |all, one| all | one)
    }

    /// Returns true if the colliders `a` and `b` pressed on each other with at least `force_n` newtons in the last
    /// physics step.
    pub(crate) fn presses(&self, a: ColliderHandle, b: ColliderHandle, force_n: f32) -> bool {
        let impulse = |pair: &ContactPair| pair.total_impulse_magnitude();
        let pair = self.narrow_phase.contact_pair(a, b);
        pair.map_or(0.0, impulse) > force_n * self.substep_s()
    }

    /// Returns the forces with which the hands of both arms pressed objects down in the last physics step, newtons. Friction
    /// is excluded.
    pub(crate) fn downward_forces_n(&self) -> [f32; 2] {
        let group =
            |collider: ColliderHandle| self.colliders[collider].collision_groups().memberships;
        let is_object = |collider| OBJECTS.contains(&group(collider));
        let mut impulses = [0.0; 2];
        for pair in self.narrow_phase.contact_pairs() {
            for (arm, impulse) in impulses.iter_mut().enumerate() {
                // The impulse acts on the second collider.
                if group(pair.collider1) == HANDS[arm] && is_object(pair.collider2) {
                    *impulse -= pair.total_impulse().z;
                } else if group(pair.collider2) == HANDS[arm] && is_object(pair.collider1) {
                    *impulse += pair.total_impulse().z;
                }
            }
        }
        impulses.map(|impulse| impulse / self.substep_s())
    }

    /// Returns the smallest distance between the shapes of two bodies at their present positions, metres; 0 if they
    /// touch.
    pub(crate) fn gap_m(&self, first: RigidBodyHandle, second: RigidBodyHandle) -> f32 {
        let mut min_m = f32::INFINITY;
        for (pose, shape) in self.shapes(first) {
            for (other_pose, other_shape) in self.shapes(second) {
                let gap = query::distance(&pose, shape, &other_pose, other_shape)
                    .expect("parry knows the distances between boxes and capsules");
                min_m = min_m.min(gap.distance);
            }
        }
        min_m
    }

    /// Returns the shapes of a body, world frame. rapier moves colliders to their bodies only in a step.
    fn shapes(&self, body: RigidBodyHandle) -> impl Iterator<Item = (Pose, &dyn Shape)> {
        let body = &self.bodies[body];
        body.colliders().iter().map(|handle| {
            let collider = &self.colliders[*handle];
            let in_body = collider.position_wrt_parent().copied().unwrap_or(Pose::IDENTITY);
            (*body.position() * in_body, collider.shape())
        })
    }

    /// Classifies a contact of this pair.
    fn kind_of(&self, pair: &ContactPair) -> Contacts {
        let group =
            |collider: ColliderHandle| self.colliders[collider].collision_groups().memberships;
        let both = group(pair.collider1) | group(pair.collider2);
        if both == HANDS[0] | HANDS[1] {
            Contacts::ARM_ARM
        } else {
            let touches_table = |arm: usize| both == TABLES[arm] | HANDS[arm];
            let arm = (0..HANDS.len()).find(|arm| touches_table(*arm));
            arm.map_or(Contacts::NONE, |arm| Contacts::TABLE_OF[arm])
        }
    }
}

impl Clone for Physics {
    /// Clones the world. The pipeline is scratch memory without state, so the clone gets a new one.
    fn clone(&self) -> Self {
        Self {
            bodies: self.bodies.clone(),
            colliders: self.colliders.clone(),
            parameters: self.parameters,
            islands: self.islands.clone(),
            broad_phase: self.broad_phase.clone(),
            narrow_phase: self.narrow_phase.clone(),
            impulse_joints: self.impulse_joints.clone(),
            multibody_joints: self.multibody_joints.clone(),
            soft_bodies: self.soft_bodies.clone(),
            ccd: self.ccd.clone(),
            pipeline: pipeline(),
        }
    }
}

fn pipeline() -> PhysicsPipeline {
    let mut pipeline = PhysicsPipeline::new();
    pipeline.counters.disable();
    pipeline
}

/// Returns parameters for bodies of centimetres. With rapier's defaults, which are for bodies of metres, a cube sinks
/// into the table by a third of its size.
fn integration_parameters(config: &WorldConfig, world: World) -> IntegrationParameters {
    let softness = SpringCoefficients::new(200.0, 5.0);
    IntegrationParameters {
        dt: config.substep_s(world),
        num_solver_iterations: config.solver_iterations_in(world),
        num_internal_pgs_iterations: 1,
        num_internal_stabilization_iterations: 1,
        normalized_prediction_distance: 0.002,
        normalized_allowed_linear_error: 0.0005,
        normalized_max_corrective_velocity: 1.0,
        contact_softness: softness,
        static_contact_softness: softness,
        contact_recycling: false,
        contact_clustering: true,
        max_ccd_substeps: 0,
        friction_model: FrictionModel::Coulomb,
        friction_in_bias_pass: false,
        ..IntegrationParameters::default()
    }
}
