//! The scene of the simulated pair for pictures and logs.

use glam::DVec3;
use rapier3d::math::{Pose, Rotation, Vector};
use tandem_core::scene::{ArmScene, Capsule, Cuboid, Point, Scene};
use tandem_kinematics::model::Anchor;
use tandem_kinematics::{ForwardKinematics, Joints, PlacedArm, WorkCell};

use crate::simulated::physics::{PhysicsWorld, TABLE_HALF_M};
use crate::simulated::single;

/// Returns the scene with the arms at joint angles `angles` (radians) at `time_s`, without goals.
pub(crate) fn scene(
    cell: &WorkCell,
    angles: &[Joints],
    world: &PhysicsWorld,
    time_s: f64,
) -> Scene {
    let arm = |idx: usize| arm_scene(&cell.arms[idx], &angles[idx], world.hand_parts(idx));
    let table_z_m = DVec3::splat(cell.table_z_m).as_vec3().z;
    let centre = Vector::new(0.0, 0.0, table_z_m - TABLE_HALF_M.z);
    let under = Pose::from_parts(centre, Rotation::IDENTITY);
    Scene {
        time_s,
        arms: (0..angles.len()).map(arm).collect(),
        objects: world.shown().map(|(pose, half_m)| cuboid(&pose, half_m)).collect(),
        goals: Vec::new(),
        goal_tolerance_m: 0.0,
        table: cuboid(&under, TABLE_HALF_M),
    }
}

fn arm_scene(placed: &PlacedArm, angles: &Joints, hand: [(Pose, Vector); 3]) -> ArmScene {
    let posture = ForwardKinematics::new(placed.model, angles);
    let point = |anchor: &Anchor| {
        single_point((placed.world_from_base() * posture.anchor_m(anchor)).into())
    };
    let origin = |frame| point(&Anchor::origin_of(frame));
    let links = placed.model.links.iter().map(|link| Capsule {
        from: point(&link.ends[0]),
        to: point(&link.ends[1]),
        radius_m: single(link.radius_m),
    });
    let n_joints = angles.len();
    ArmScene {
        base: single_point(placed.base_in_world_m.into()),
        joint_angles_rad: std::array::from_fn(|joint| angles.get(joint).copied().unwrap_or(0.0)),
        joint_points: (0..=n_joints + 1).map(origin).collect(),
        links: links.collect(),
        hand: hand.iter().map(|(pose, half_m)| cuboid(pose, *half_m)).collect(),
        end_effector: origin(n_joints + 1),
    }
}

fn single_point(point: DVec3) -> Point {
    point.as_vec3().to_array()
}

fn cuboid(pose: &Pose, half_m: Vector) -> Cuboid {
    Cuboid {
        centre: pose.translation.to_array(),
        orientation: pose.rotation.to_array(),
        half_extents_m: half_m.to_array(),
    }
}
