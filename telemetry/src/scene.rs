//! A scene as Foxglove messages: primitives for the 3D panel, transforms and joint states.

use foxglove::messages::{
    Color, CubePrimitive, CylinderPrimitive, FrameTransform, FrameTransforms, JointState,
    JointStates, Pose, Quaternion, SceneEntity, SceneUpdate, SpherePrimitive, TextPrimitive,
    Timestamp, Vector3,
};
use tandem_core::scene::{ArmScene, Capsule, Cuboid, Point, Scene};

pub(crate) use goals::GoalMarkers;
pub(crate) use trail::Trails;

mod goals;
mod trail;

/// Frame of all positions.
const WORLD: &str = "world";
const NO_ROTATION: Quaternion = Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 };
const TABLE_COLOR: Color = rgb(0.82, 0.80, 0.77);
const TEXT_COLOR: Color = rgb(0.15, 0.17, 0.20);
/// Parts of an object that no arm brings to its goal.
const PART_COLOR: Color = rgb(0.59, 0.61, 0.64);
/// Colours of the arms and of their objects and goals; further arms reuse them.
const ARM_COLORS: [Color; 3] =
    [rgb(0.16, 0.44, 0.73), rgb(0.87, 0.46, 0.16), rgb(0.27, 0.60, 0.35)];

/// Returns `scene` and a caption. Each message is complete, so that a viewer can jump to any time.
pub(crate) fn scene_update(scene: &Scene, stamp: Timestamp, caption: &str) -> SceneUpdate {
    let entity = |id: String| world_entity(id, stamp);
    let table =
        SceneEntity { cubes: vec![cube(&scene.table, TABLE_COLOR)], ..entity("table".to_owned()) };
    let caption = SceneEntity {
        texts: vec![caption_above(&scene.table, caption)],
        ..entity("caption".to_owned())
    };
    let arms = scene
        .arms
        .iter()
        .enumerate()
        .map(|(i, arm)| arm_entity(arm, color_of(i), entity(format!("arm{i}"))));
    let object_color = |i| if i < scene.arms.len() { darker(color_of(i)) } else { PART_COLOR };
    let objects = scene.objects.iter().enumerate().map(|(i, object)| SceneEntity {
        cubes: vec![cube(object, object_color(i))],
        ..entity(format!("object{i}"))
    });
    let goals = scene.goals.iter().enumerate().map(|(i, goal)| SceneEntity {
        spheres: vec![sphere(*goal, scene.goal_tolerance_m, Color { a: 0.35, ..color_of(i) })],
        ..entity(format!("goal{i}"))
    });
    SceneUpdate {
        deletions: Vec::new(),
        entities: [table, caption].into_iter().chain(arms).chain(objects).chain(goals).collect(),
    }
}

/// Returns the frames `arm{i}/base` (x towards the origin), `arm{i}/end_effector`, `object{i}` and `goal{i}`.
pub(crate) fn frame_transforms(scene: &Scene, stamp: Timestamp) -> FrameTransforms {
    let frame = |name: String, origin: Point, rotation: Quaternion| FrameTransform {
        rotation: Some(rotation),
        ..tool_frame(name, origin.map(f64::from), stamp)
    };
    let arms = scene.arms.iter().enumerate().flat_map(|(i, arm)| {
        [
            frame(format!("arm{i}/base"), arm.base, toward_origin(arm.base)),
            frame(format!("arm{i}/end_effector"), arm.end_effector, NO_ROTATION),
        ]
    });
    let objects = scene.objects.iter().enumerate();
    let objects = objects.map(|(i, object)| {
        frame(format!("object{i}"), object.centre, quaternion(object.orientation))
    });
    let goals = scene
        .goals
        .iter()
        .enumerate()
        .map(|(i, goal)| frame(format!("goal{i}"), *goal, NO_ROTATION));
    FrameTransforms { transforms: arms.chain(objects).chain(goals).collect() }
}

/// Returns a frame at `origin` (world, metres) with the axes of the world.
pub(crate) fn tool_frame(name: String, origin: [f64; 3], stamp: Timestamp) -> FrameTransform {
    let [x, y, z] = origin;
    FrameTransform {
        timestamp: Some(stamp),
        parent_frame_id: WORLD.to_owned(),
        child_frame_id: name,
        translation: Some(Vector3 { x, y, z }),
        rotation: Some(NO_ROTATION),
    }
}

/// Returns the joints `arm{i}/joint{j}`, with `j` from 1 as Kinova counts, radians.
pub(crate) fn joint_states(scene: &Scene, stamp: Timestamp) -> JointStates {
    let angles_rad: Vec<&[f64]> =
        scene.arms.iter().map(|arm| arm.joint_angles_rad.as_slice()).collect();
    joint_states_of(&angles_rad, &[], stamp)
}

/// Returns joint states of angles in arm order (radians), followed by `arm{i}/gripper`, 0 (closed) to 1 (open).
pub(crate) fn joint_states_of<A: AsRef<[f64]>>(
    angles_rad: &[A],
    openings: &[f64],
    stamp: Timestamp,
) -> JointStates {
    let state = |name: String, position: f64| JointState {
        name,
        position: Some(position),
        ..JointState::default()
    };
    let joints = angles_rad.iter().enumerate().flat_map(|(i, arm)| {
        let angles = arm.as_ref().iter().enumerate();
        angles.map(move |(joint_idx, angle_rad)| {
            state(format!("arm{i}/joint{}", joint_idx + 1), *angle_rad)
        })
    });
    let grippers = openings.iter().enumerate();
    let grippers = grippers.map(|(i, opening)| state(format!("arm{i}/gripper"), *opening));
    JointStates { timestamp: Some(stamp), joints: joints.chain(grippers).collect() }
}

/// Returns an entity in the world frame without primitives.
fn world_entity(id: String, stamp: Timestamp) -> SceneEntity {
    SceneEntity { timestamp: Some(stamp), frame_id: WORLD.to_owned(), id, ..SceneEntity::default() }
}

/// Returns the links of an arm, the post below the first link, and spheres at the ends of links.
fn arm_entity(arm: &ArmScene, color: Color, entity: SceneEntity) -> SceneEntity {
    let post = arm.links.first().map(|link| Capsule {
        from: arm.base,
        to: link.from,
        radius_m: link.radius_m,
    });
    let bars: Vec<Capsule> = post.into_iter().chain(arm.links.iter().copied()).collect();
    let ends =
        arm.links.iter().flat_map(|link| [(link.from, link.radius_m), (link.to, link.radius_m)]);
    SceneEntity {
        cylinders: bars.iter().map(|bar| cylinder(bar, color)).collect(),
        spheres: ends.map(|(end, radius_m)| sphere(end, radius_m, color)).collect(),
        cubes: arm.hand.iter().map(|part| cube(part, darker(color))).collect(),
        ..entity
    }
}

fn caption_above(table: &Cuboid, text: &str) -> TextPrimitive {
    let [x, y, z] = table.centre;
    text_at(vector([x, y, z + table.half_extents_m[2] + 0.85]), text)
}

fn text_at(position: Vector3, text: &str) -> TextPrimitive {
    TextPrimitive {
        pose: Some(pose_at(position)),
        billboard: true,
        font_size: 18.0,
        scale_invariant: true,
        color: Some(TEXT_COLOR),
        text: text.to_owned(),
    }
}

fn cube(cuboid: &Cuboid, color: Color) -> CubePrimitive {
    CubePrimitive {
        pose: Some(Pose {
            position: Some(vector(cuboid.centre)),
            orientation: Some(quaternion(cuboid.orientation)),
        }),
        size: Some(vector(cuboid.half_extents_m.map(|half_m| 2.0 * half_m))),
        color: Some(color),
    }
}

fn sphere(centre: Point, radius_m: f32, color: Color) -> SpherePrimitive {
    SpherePrimitive {
        pose: Some(pose_at(vector(centre))),
        size: Some(vector([2.0 * radius_m; 3])),
        color: Some(color),
    }
}

/// Returns the cylindrical part of a capsule. Cylinders of Foxglove extend along their z axis.
fn cylinder(capsule: &Capsule, color: Color) -> CylinderPrimitive {
    let (from, to) = (capsule.from.map(f64::from), capsule.to.map(f64::from));
    let axis: [f64; 3] = std::array::from_fn(|i| to[i] - from[i]);
    let length_m = axis.iter().map(|x| x * x).sum::<f64>().sqrt();
    let middle: [f64; 3] = std::array::from_fn(|i| 0.5 * (from[i] + to[i]));
    let diameter_m = 2.0 * f64::from(capsule.radius_m);
    CylinderPrimitive {
        pose: Some(Pose {
            position: Some(Vector3 { x: middle[0], y: middle[1], z: middle[2] }),
            orientation: Some(from_z_to(axis.map(|x| x / length_m.max(f64::MIN_POSITIVE)))),
        }),
        size: Some(Vector3 { x: diameter_m, y: diameter_m, z: length_m }),
        bottom_scale: 1.0,
        top_scale: 1.0,
        color: Some(color),
    }
}

/// Returns the shortest rotation from the z axis to `direction`, a unit vector or zero (no rotation).
fn from_z_to(direction: [f64; 3]) -> Quaternion {
    let [x, y, z] = direction;
    let w = 1.0 + z;
    if w < 1e-9 {
        return Quaternion { x: 1.0, y: 0.0, z: 0.0, w: 0.0 };
    }
    let norm = (x * x + y * y + w * w).sqrt();
    Quaternion { x: -y / norm, y: x / norm, z: 0.0, w: w / norm }
}

/// Returns the rotation about z that points the x axis from `base` to the origin of the world.
fn toward_origin(base: Point) -> Quaternion {
    let half_yaw_rad = 0.5 * f64::from(-base[1]).atan2(f64::from(-base[0]));
    Quaternion { x: 0.0, y: 0.0, z: half_yaw_rad.sin(), w: half_yaw_rad.cos() }
}

const fn pose_at(position: Vector3) -> Pose {
    Pose { position: Some(position), orientation: Some(NO_ROTATION) }
}

fn vector(point: [f32; 3]) -> Vector3 {
    let [x, y, z] = point.map(f64::from);
    Vector3 { x, y, z }
}

fn quaternion(xyzw: [f32; 4]) -> Quaternion {
    let [x, y, z, w] = xyzw.map(f64::from);
    Quaternion { x, y, z, w }
}

const fn rgb(r: f64, g: f64, b: f64) -> Color {
    Color { r, g, b, a: 1.0 }
}

const fn color_of(arm: usize) -> Color {
    ARM_COLORS[arm % ARM_COLORS.len()]
}

const fn darker(color: Color) -> Color {
    Color { r: 0.7 * color.r, g: 0.7 * color.g, b: 0.7 * color.b, a: color.a }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Applies a rotation to the z axis.
    fn rotated_z(q: Quaternion) -> [f64; 3] {
        [
            2.0 * (q.x * q.z + q.w * q.y),
            2.0 * (q.y * q.z - q.w * q.x),
            1.0 - 2.0 * (q.x * q.x + q.y * q.y),
        ]
    }

    #[test]
    fn a_cylinder_extends_along_its_capsule() {
        let check = |from: Point, to: Point, direction: [f64; 3]| {
            let drawn = cylinder(&Capsule { from, to, radius_m: 0.04 }, TABLE_COLOR);
            let pose = drawn.pose.unwrap();
            let rotated = rotated_z(pose.orientation.unwrap());
            assert!(
                rotated.iter().zip(direction).all(|(a, b)| (a - b).abs() < 1e-6),
                "{rotated:?} {direction:?}"
            );
            let size = drawn.size.unwrap();
            assert!((size.z - 0.5).abs() < 1e-6 && (size.x - 0.08).abs() < 1e-6);
        };
        check([0.0; 3], [0.0, 0.0, 0.5], [0.0, 0.0, 1.0]);
        check([0.0; 3], [0.0, 0.0, -0.5], [0.0, 0.0, -1.0]);
        check([1.0, 2.0, 3.0], [1.5, 2.0, 3.0], [1.0, 0.0, 0.0]);
        check([0.0; 3], [0.3, -0.4, 0.0], [0.6, -0.8, 0.0]);
    }

    #[test]
    fn a_capsule_of_length_zero_has_a_finite_rotation() {
        let drawn =
            cylinder(&Capsule { from: [1.0; 3], to: [1.0; 3], radius_m: 0.04 }, TABLE_COLOR);
        let q = drawn.pose.unwrap().orientation.unwrap();
        assert!([q.x, q.y, q.z, q.w].iter().all(|x| x.is_finite()));
    }

    #[test]
    fn the_second_arms_base_faces_the_first() {
        let q = toward_origin([0.52, 0.0, 0.0]);
        let x_axis = [1.0 - 2.0 * q.z * q.z, 2.0 * q.w * q.z];
        assert!((x_axis[0] + 1.0).abs() < 1e-9 && x_axis[1].abs() < 1e-9, "{x_axis:?}");
    }
}
