//! Snapshots of the world for pictures and logs.

use rapier3d::dynamics::RigidBody;
use rapier3d::math::{Rotation, Vector};
use tandem_core::layout::GOAL_TOLERANCE_M;
use tandem_core::scene::{ArmScene, Capsule, Cuboid, Scene};
use tandem_core::{ArmIndex, Layout};
use tandem_kinematics::{Joints, MICO_4, PADS_AHEAD_M, ToolTarget, WorkCell};

use crate::arm::Arm;
use crate::bar::{HALF_LENGTH_M, HANDLE_M, PLATE_HALF_M, SECTION_HALF_M, handle};
use crate::capsule::{ArmCapsules, LINK_FRAMES, LINK_RADII_M};
use crate::frame::MAX_ARMS;
use crate::hand::{WRIST_ABOVE_M, WRIST_RADIUS_M};
use crate::kinematics::{ForwardKinematics, JointAngles};
use crate::world::{PhysicsWorld, TABLE_HALF_M};

/// Iterations of the inverse kinematics from the joint angles at the start of a control step to the current hand
/// position.
const ITERATIONS: usize = 20;

/// Returns a snapshot of `world`, `time_s` after the start of the episode. `goal` has shape `[n_goal]`, arm frames; the
/// objects are cubes with half edges `half_m`, or a bar.
pub(crate) fn scene(
    world: &PhysicsWorld,
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

/// Returns the boxes that show a bar: the handle of each arm, in arm order and centred at the point that the arm brings
/// to its goal, then what remains of each arm's section beside the plate, and the plate.
fn bar_boxes(bar: &RigidBody) -> Vec<Cuboid> {
    let (at, turn): (Vector, Rotation) = (bar.translation(), *bar.rotation());
    let handle_half_m = HALF_LENGTH_M - HANDLE_M;
    let rest_half_m = 0.5 * (HALF_LENGTH_M - PLATE_HALF_M.x) - handle_half_m;
    let rest_share = (PLATE_HALF_M.x + rest_half_m) / HANDLE_M;
    // Each arm's box whose centre is at this share of the way from the bar's centre to the handle.
    let sections = |half_length_m: f32, share: f32| {
        let half_m = Vector::new(half_length_m, SECTION_HALF_M, SECTION_HALF_M);
        (0..MAX_ARMS)
            .map(move |arm| cuboid(at + turn * (handle(ArmIndex(arm)) * share), turn, half_m))
    };
    sections(handle_half_m, 1.0)
        .chain(sections(rest_half_m, rest_share))
        .chain([cuboid(at, turn, PLATE_HALF_M)])
        .collect()
}

fn arm_scene(world: &PhysicsWorld, arm: &Arm) -> ArmScene {
    let end_effector = arm.hand.end_effector(&world.physics);
    let orientation = arm.hand.orientation(&world.physics);
    let (joint_angles_rad, joint_points, links) = match arm.mico_joints(&world.physics) {
        Some(joints) => {
            let points = [joints.shoulder, joints.elbow.0, joints.wrist.0];
            let [shoulder, elbow, wrist] = points.map(|point| arm.frame.world_from_arm(point));
            let base = arm.frame.world_from_arm(arm.parameters.base_in_arm);
            let links = ArmCapsules::of(arm, &world.physics).links();
            let angles = mico_angles(arm, end_effector, orientation);
            (angles, vec![base, shoulder, elbow, wrist, end_effector], links.to_vec())
        }
        None => jaco_scene(world, arm, end_effector),
    };
    let palm = &arm.parameters.gripper.palm;
    let palm_centre = end_effector + orientation * (Vector::Z * palm.behind_m);
    let mut hand = vec![cuboid(palm_centre, orientation, palm.half)];
    let pad_half = arm.parameters.gripper.pad_half;
    hand.extend(arm.hand.pads(&world.physics).map(|pad| cuboid(pad, orientation, pad_half)));
    ArmScene {
        base: arm.frame.world_from_arm(arm.parameters.base_in_arm).to_array(),
        joint_angles_rad,
        joint_points: joint_points.into_iter().map(|point| point.to_array()).collect(),
        links,
        hand,
        end_effector: end_effector.to_array(),
    }
}

/// Returns the joint angles of a Jaco (radians), the positions of its joints, and its links and wrist, for the current
/// position of its hand; world frame, metres.
fn jaco_scene(
    world: &PhysicsWorld,
    arm: &Arm,
    end_effector: Vector,
) -> (JointAngles, Vec<Vector>, Vec<Capsule>) {
    let angles = arm.angles_now(&world.physics, ITERATIONS);
    let forward = ForwardKinematics::new(&angles);
    let points: Vec<Vector> = (0..7).map(|idx| arm.world_from_base(forward.point(idx))).collect();
    let link = |(ends, radius_m): (&[usize], f32)| Capsule {
        from: points[ends[0]].to_array(),
        to: points[ends[1]].to_array(),
        radius_m,
    };
    let mut links: Vec<Capsule> = LINK_FRAMES.windows(2).zip(LINK_RADII_M).map(link).collect();
    let [from, to] = WRIST_ABOVE_M.map(|above_m| (end_effector + Vector::Z * above_m).to_array());
    links.push(Capsule { from, to, radius_m: WRIST_RADIUS_M });
    (angles, points, links)
}

/// Returns the joint angles of a Mico, radians, and 0 for joints that it does not have. A hand that was pushed out of
/// reach shows the elbow's usual place.
fn mico_angles(arm: &Arm, end_effector: Vector, orientation: Rotation) -> JointAngles {
    let in_base = arm.frame.arm_from_world(end_effector) - arm.parameters.base_in_arm;
    let behind = arm.frame.rotate(orientation * Vector::Z).as_dvec3() * PADS_AHEAD_M;
    let position_m = (in_base.as_dvec3() + behind).to_array().into();
    let target = ToolTarget { position_m, yaw_rad: WorkCell::FINGERS_YAW_RAD };
    let elbow_up = Joints::new(MICO_4.elbow_up_rad);
    let angles = MICO_4.inverse_kinematics(&target, &elbow_up).map_or(elbow_up, |at| at.angles);
    std::array::from_fn(|joint| angles.get(joint).copied().unwrap_or(0.0))
}

fn cuboid(centre: Vector, orientation: Rotation, half_extents_m: Vector) -> Cuboid {
    Cuboid {
        centre: centre.to_array(),
        orientation: orientation.to_array(),
        half_extents_m: half_extents_m.to_array(),
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::{Stream, Task, WorldSettings, episode_rng};

    use super::*;
    use crate::description::Geometry;
    use crate::{Env, WorldConfig};

    #[test]
    fn a_bar_is_drawn_with_the_volume_that_is_simulated() {
        let layout = Layout::new(Task::CarryBar, 2);
        let mut env = Env::new(layout, &WorldConfig::default()).unwrap();
        env.reset(&mut episode_rng(1, 0, Stream::Reset), WorldSettings::default());
        let volume = |half_m: [f32; 3]| 8.0 * half_m.iter().product::<f32>();
        let world = env.description();
        let of_bar = world.shapes.iter().filter(|shape| shape.body == Some(world.arms[0].object));
        let simulated: f32 = of_bar
            .map(|shape| match shape.geometry {
                Geometry::BoxHalfExtentsM(half_m) => volume(half_m),
                Geometry::CapsuleRadiusAndHalfLengthM(_) => panic!("a bar has no capsules"),
            })
            .sum();
        let boxes = env.scene().objects;
        let drawn: f32 = boxes.iter().map(|shown| volume(shown.half_extents_m)).sum();
        assert!((drawn - simulated).abs() < 1e-3 * simulated, "{drawn} m³, not {simulated} m³");
        let handles = [0, 1].map(|arm| Vector::from_array(boxes[arm].centre));
        assert!((handles[0].distance(handles[1]) - 2.0 * HANDLE_M).abs() < 1e-5);
    }
}
