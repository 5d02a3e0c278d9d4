//! Snapshots of the world for pictures and logs.

use rapier3d::dynamics::RigidBody;
use rapier3d::math::{Rotation, Vector};
use tandem_core::layout::GOAL_TOLERANCE_M;
use tandem_core::scene::{ArmScene, Capsule, Cuboid, Point, Scene};
use tandem_core::{ArmIndex, Layout};

use crate::arm::Arm;
use crate::bar::{HALF_LENGTH_M, HANDLE_M, PLATE_HALF_M, SECTION_HALF_M, handle};
use crate::capsule::{LINK_FRAMES, LINK_RADII_M};
use crate::frame::MAX_ARMS;
use crate::hand::{PALM_ABOVE_M, PALM_HALF_M, WRIST_ABOVE_M, WRIST_RADIUS_M};
use crate::kinematics::ForwardKinematics;
use crate::world::{TABLE_HALF_M, World};

/// Iterations of the inverse kinematics from the joint angles at the start of a control step to the current hand
/// position.
const ITERATIONS: usize = 20;

/// Returns a snapshot of `world`, `time_s` after the start of the episode. `goal` has shape `[n_goal]`, arm frames; the
/// objects are cubes with half edges `half_m`, or a bar.
pub(crate) fn scene(
    world: &World,
    layout: Layout,
    goal: &[f32],
    half_m: f32,
    time_s: f64,
) -> Scene {
    let goal_in_world = |arm: ArmIndex| {
        let in_arm = Vector::from_slice(&goal[layout.goal_of(arm)]);
        world.arms[arm.0].frame.world_from_arm(in_arm).to_array()
    };
    let cube = |arm: ArmIndex| {
        let body = world.object(arm);
        cuboid(body.translation(), *body.rotation(), Vector::splat(half_m))
    };
    Scene {
        time_s,
        arms: world.arms.iter().map(|arm| arm_scene(world, arm)).collect(),
        objects: if world.has_bar {
            bar_boxes(world.object(ArmIndex(0)))
        } else {
            layout.arms().map(cube).collect()
        },
        goals: layout.arms().map(goal_in_world).collect(),
        goal_tolerance_m: GOAL_TOLERANCE_M,
        table: cuboid(Vector::new(0.0, 0.0, -TABLE_HALF_M.z), Rotation::IDENTITY, TABLE_HALF_M),
    }
}

/// Returns the boxes that show a bar: the handle of each arm, in arm order and centred at the point that the arm brings to
/// its goal, and then the middle.
fn bar_boxes(bar: &RigidBody) -> Vec<Cuboid> {
    let (at, turn): (Vector, Rotation) = (bar.translation(), *bar.rotation());
    let handle_half_m = HALF_LENGTH_M - HANDLE_M;
    let section = |half_length_m| Vector::new(half_length_m, SECTION_HALF_M, SECTION_HALF_M);
    let handles = (0..MAX_ARMS)
        .map(|arm| cuboid(at + turn * handle(ArmIndex(arm)), turn, section(handle_half_m)));
    let middle = section(HANDLE_M - handle_half_m);
    handles.chain([cuboid(at, turn, middle), cuboid(at, turn, PLATE_HALF_M)]).collect()
}

fn arm_scene(world: &World, arm: &Arm) -> ArmScene {
    let joint_angles_rad = arm.angles_now(&world.physics, ITERATIONS);
    let forward = ForwardKinematics::new(&joint_angles_rad);
    let joint_points: Vec<Point> =
        (0..7).map(|idx| arm.world_from_base(forward.point(idx)).to_array()).collect();
    let end_effector = arm.hand.end_effector(&world.physics);
    let mut links: Vec<Capsule> = LINK_FRAMES
        .windows(2)
        .zip(LINK_RADII_M)
        .map(|(ends, radius_m)| Capsule {
            from: joint_points[ends[0]],
            to: joint_points[ends[1]],
            radius_m,
        })
        .collect();
    let [from, to] = WRIST_ABOVE_M.map(|above_m| (end_effector + Vector::Z * above_m).to_array());
    links.push(Capsule { from, to, radius_m: WRIST_RADIUS_M });
    let orientation = arm.frame.orientation_in_world();
    let mut hand = vec![cuboid(end_effector + Vector::Z * PALM_ABOVE_M, orientation, PALM_HALF_M)];
    let pad_half = arm.parameters.gripper.pad_half;
    hand.extend(arm.hand.pads(&world.physics).map(|pad| cuboid(pad, orientation, pad_half)));
    ArmScene {
        base: arm.frame.world_from_arm(arm.parameters.base_in_arm).to_array(),
        joint_angles_rad,
        joint_points,
        links,
        hand,
        end_effector: end_effector.to_array(),
    }
}

fn cuboid(centre: Vector, orientation: Rotation, half_extents_m: Vector) -> Cuboid {
    Cuboid {
        centre: centre.to_array(),
        orientation: orientation.to_array(),
        half_extents_m: half_extents_m.to_array(),
    }
}
