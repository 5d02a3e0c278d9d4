//! The arms as shapes, for pictures and logs.

use nalgebra::{Isometry3, Point3, Vector3};
use tandem_core::scene::{ArmScene, Capsule, Cuboid, Point, Scene};

use crate::forward::ForwardKinematics;
use crate::joints::Joints;
use crate::model::Anchor;
use crate::work_cell::{PlacedArm, WorkCell};

/// Half extents of the table in pictures, metres; its top is at the work cell's height.
const TABLE_HALF_M: [f32; 3] = [0.9, 0.7, 0.05];
/// Half extents of the hand's shell in the tool's axes, metres, and the distance of its centre behind the tool.
const SHELL_HALF_M: Vector3<f64> = Vector3::new(0.035, 0.030, 0.050);
const SHELL_BEHIND_M: f64 = 0.110;
/// Half extents of a finger in the tool's axes, metres, and the distance of its centre ahead of the tool.
const FINGER_HALF_M: Vector3<f64> = Vector3::new(0.005, 0.008, 0.015);
const FINGER_AHEAD_M: f64 = 0.021;
/// Distance of an open finger from the middle, metres.
const OPEN_DISTANCE_M: f64 = 0.062;

impl WorkCell {
    /// Returns the arms at joint angles `angles` (radians, arm by arm) with grippers open by `openings` (0 to 1, arm by
    /// arm), and the table, world frame. `time_s` becomes the scene's time, seconds. There are no objects and no goals.
    ///
    /// # Panics
    /// If an arm has another number of angles than joints.
    #[must_use]
    pub fn scene(&self, angles: &[Joints], openings: &[f64], time_s: f64) -> Scene {
        let arms = self.arms.iter().zip(angles).zip(openings);
        let top_m = single_number(self.table_z_m);
        Scene {
            time_s,
            arms: arms.map(|((placed, angles), opening)| placed.scene(angles, *opening)).collect(),
            objects: Vec::new(),
            goals: Vec::new(),
            goal_tolerance_m: 0.0,
            table: Cuboid {
                centre: [0.0, 0.0, top_m - TABLE_HALF_M[2]],
                orientation: [0.0, 0.0, 0.0, 1.0],
                half_extents_m: TABLE_HALF_M,
            },
        }
    }
}

impl PlacedArm {
    /// Returns the arm's shapes, world frame, at joint angles `angles` (radians) with its gripper open by `opening` (0
    /// to 1).
    ///
    /// # Panics
    /// If `angles` has another number of joints than the arm.
    #[must_use]
    pub fn scene(&self, angles: &Joints, opening: f64) -> ArmScene {
        let forward = ForwardKinematics::new(self.model, angles);
        let world_from_base = self.world_from_base();
        let point = |anchor: &Anchor| single(&(world_from_base * forward.anchor_m(anchor)));
        let links = self.model.links.iter().filter(|link| is_rigid(link.closed_share));
        let n_joints = angles.len();
        ArmScene {
            base: single(&self.base_in_world_m),
            joint_angles_rad: std::array::from_fn(|joint| {
                angles.get(joint).copied().unwrap_or(0.0)
            }),
            joint_points: (0..=n_joints + 1)
                .map(|frame| point(&Anchor::origin_of(frame)))
                .collect(),
            links: links
                .map(|link| Capsule {
                    from: point(&link.ends[0]),
                    to: point(&link.ends[1]),
                    radius_m: single_number(link.radius_m),
                })
                .collect(),
            hand: hand(&(world_from_base * forward.tool()), opening),
            end_effector: point(&Anchor::origin_of(n_joints + 1)),
        }
    }
}

/// Returns whether a part has the same shape at every opening. The gripper is drawn as fingers instead.
fn is_rigid(closed_share: f64) -> bool {
    closed_share >= 1.0
}

/// Returns the shell of the hand and its two fingers, which move along the tool's x axis.
fn hand(world_from_tool: &Isometry3<f64>, opening: f64) -> Vec<Cuboid> {
    let aside_m = opening.clamp(0.0, 1.0) * OPEN_DISTANCE_M + FINGER_HALF_M.x;
    let parts = [
        (Point3::new(0.0, 0.0, -SHELL_BEHIND_M), SHELL_HALF_M),
        (Point3::new(-aside_m, 0.0, FINGER_AHEAD_M), FINGER_HALF_M),
        (Point3::new(aside_m, 0.0, FINGER_AHEAD_M), FINGER_HALF_M),
    ];
    let rotation = world_from_tool.rotation.coords;
    let cuboid = |(centre, half_m): &(Point3<f64>, Vector3<f64>)| Cuboid {
        centre: single(&(world_from_tool * centre)),
        orientation: [rotation.x, rotation.y, rotation.z, rotation.w].map(single_number),
        half_extents_m: [half_m.x, half_m.y, half_m.z].map(single_number),
    };
    parts.iter().map(cuboid).collect()
}

fn single(point: &Point3<f64>) -> Point {
    [point.x, point.y, point.z].map(single_number)
}

#[expect(clippy::cast_possible_truncation, reason = "pictures have single precision")]
fn single_number(number: f64) -> f32 {
    number as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_join_at_the_joints_and_fingers_are_as_far_apart_as_the_gripper_is_open() {
        let cell = WorkCell::mico_pair();
        let at = cell.ready(0.05).unwrap();
        let scene = cell.scene(&at, &[0.0, 0.5], 1.5);
        for (arm, opening) in scene.arms.iter().zip([0.0, 0.5]) {
            let tool = arm.end_effector;
            assert!(tool[2] > 0.0 && tool[0].abs() < 0.13, "{tool:?}");
            assert!(arm.links.windows(2).all(|pair| pair[0].to == pair[1].from), "{arm:?}");
            let [_, left, right] = &arm.hand[..] else { panic!("{:?}", arm.hand) };
            let apart_m = left.centre.iter().zip(right.centre).map(|(a, b)| (a - b).powi(2));
            let expected_m = 2.0 * (opening * 0.062 + 0.005);
            assert!((apart_m.sum::<f32>().sqrt() - expected_m).abs() < 1e-5, "{arm:?}");
            // The fingers close along the arm frame's y.
            assert!((left.centre[0] - right.centre[0]).abs() < 1e-3, "{arm:?}");
        }
        assert!(scene.arms[0].base[0] < scene.arms[1].base[0]);
        assert_eq!(scene.table.centre[2] + scene.table.half_extents_m[2], 0.0);
    }
}
