//! The goals of a task without a simulator as Foxglove primitives.

use foxglove::messages::{
    Color, CubePrimitive, SceneEntity, SceneUpdate, TextPrimitive, Timestamp, Vector3,
};
use tandem_core::task::{Norm, Part};
use tandem_core::{ArmIndex, TaskSpec};

use super::{TEXT_COLOR, color_of, darker, pose_at, sphere, text_at, vector, world_entity};

/// Size of an achieved goal relative to the tolerance: its centre shows whether it is within the tolerance.
const ACHIEVED_SIZE: f32 = 0.25;
/// Height of the caption above the highest goal, in tolerances.
const CAPTION_ABOVE: f32 = 6.0;

/// The parts of a task's goal that are points in the plane or in space, in the numbers of the goal.
#[derive(Debug)]
pub(crate) struct GoalMarkers {
    points: Vec<PointPart>,
    tolerance: f32,
    norm: Norm,
}

/// A part of the goal.
#[derive(Debug)]
struct PointPart {
    /// Suffix of the entities: the index of the arm, or `_common`.
    name: String,
    color: Color,
    goal: Part,
    achieved: Part,
}

impl GoalMarkers {
    /// Returns the points of the arms, and of the part common to all arms, with 2 or 3 numbers each; `None` if no part
    /// has so many.
    pub(crate) fn of(task: &TaskSpec) -> Option<Self> {
        let of_arm = |arm: ArmIndex| PointPart {
            name: arm.0.to_string(),
            color: color_of(arm.0),
            goal: task.goal_of(arm).clone(),
            achieved: task.achieved_goal_of(arm).clone(),
        };
        let common = PointPart {
            name: "_common".to_owned(),
            color: TEXT_COLOR,
            goal: task.common_goal().clone(),
            achieved: task.common_achieved_goal().clone(),
        };
        let mut points: Vec<PointPart> = task.arms().map(of_arm).chain([common]).collect();
        points.retain(|part| matches!(part.goal.len(), 2 | 3));
        let (tolerance, norm) = (task.tolerance(), task.norm());
        (!points.is_empty()).then_some(Self { points, tolerance, norm })
    }

    /// Returns the achieved and the desired goals and a caption. Each message is complete, so that a viewer can jump to
    /// any time. Shapes: `observation` `[n_observation]`, `goal` `[n_goal]`.
    pub(crate) fn scene_update(
        &self,
        observation: &[f32],
        goal: &[f32],
        stamp: Timestamp,
        caption: &str,
    ) -> SceneUpdate {
        let mut entities = vec![SceneEntity {
            texts: vec![self.caption(goal, caption)],
            ..world_entity("caption".to_owned(), stamp)
        }];
        for part in &self.points {
            let (achieved, desired) = (part.achieved.of(observation), part.goal.of(goal));
            entities.push(SceneEntity {
                spheres: vec![sphere(
                    point(&achieved),
                    ACHIEVED_SIZE * self.tolerance,
                    darker(part.color),
                )],
                ..world_entity(format!("achieved{}", part.name), stamp)
            });
            entities.push(self.goal_entity(
                point(&desired),
                Color { a: 0.35, ..part.color },
                world_entity(format!("goal{}", part.name), stamp),
            ));
        }
        SceneUpdate { deletions: Vec::new(), entities }
    }

    /// Returns the set of points within the tolerance of a goal: a ball, or a cube by the maximum norm.
    fn goal_entity(&self, centre: [f32; 3], color: Color, entity: SceneEntity) -> SceneEntity {
        match self.norm {
            Norm::Euclidean => {
                SceneEntity { spheres: vec![sphere(centre, self.tolerance, color)], ..entity }
            }
            Norm::Maximum => {
                let size = vector([2.0 * self.tolerance; 3]);
                let cube = CubePrimitive {
                    pose: Some(pose_at(vector(centre))),
                    size: Some(size),
                    color: Some(color),
                };
                SceneEntity { cubes: vec![cube], ..entity }
            }
        }
    }

    /// Returns a text above the middle of all goals, which do not move within an episode.
    fn caption(&self, goal: &[f32], text: &str) -> TextPrimitive {
        let goals: Vec<[f32; 3]> =
            self.points.iter().map(|part| point(&part.goal.of(goal))).collect();
        let mean = |axis: usize| {
            goals.iter().map(|goal| f64::from(goal[axis])).sum::<f64>() / goals.len() as f64
        };
        let highest = goals.iter().map(|goal| goal[2]).fold(f32::MIN, f32::max);
        let above = f64::from(highest + CAPTION_ABOVE * self.tolerance);
        text_at(Vector3 { x: mean(0), y: mean(1), z: above }, text)
    }
}

/// Returns a point with its missing coordinate 0.
fn point(numbers: &[f32]) -> [f32; 3] {
    std::array::from_fn(|axis| numbers.get(axis).copied().unwrap_or(0.0))
}

#[cfg(test)]
mod tests {
    use tandem_core::task::{ArmDescription, TaskDescription};

    use super::*;

    /// Returns a task of two arms with `n` numbers of the goal each, and `n_common` common ones.
    fn task(n: usize, n_common: usize, norm: Norm) -> TaskSpec {
        let n_goal = 2 * n + n_common;
        let arm = |arm_idx: usize| ArmDescription {
            observation: (arm_idx * n..(arm_idx + 1) * n).collect(),
            goal: (arm_idx * n..(arm_idx + 1) * n).collect(),
            action: vec![arm_idx],
            position: Vec::new(),
            lateral: Vec::new(),
            hand: Vec::new(),
        };
        let description = TaskDescription {
            name: "lab/reach".to_owned(),
            n_observation: n_goal,
            n_goal,
            n_action: 2,
            achieved_goal: (0..n_goal).collect(),
            episode_steps: 10,
            tolerance: 0.1,
            norm,
            interchangeable_arms: false,
            reports_contacts: false,
            origin_distance: 0.0,
            base: 0.0,
            contact_distances: Vec::new(),
            recombination_gap: 0.0,
            observation_bound: vec![1.0; n_goal],
            goal_bound: vec![1.0; n_goal],
            arms: vec![arm(0), arm(1)],
            manipulation: tandem_core::task::Manipulation::default(),
            reflection: tandem_core::task::Reflection::default(),
        };
        TaskSpec::new(description).unwrap()
    }

    #[test]
    fn goals_of_two_or_three_numbers_are_points() {
        let names = |n, n_common| -> Vec<String> {
            let markers = GoalMarkers::of(&task(n, n_common, Norm::Euclidean));
            markers
                .map_or_else(Vec::new, |it| it.points.into_iter().map(|part| part.name).collect())
        };
        assert_eq!(names(2, 0), ["0", "1"]);
        assert_eq!(names(3, 3), ["0", "1", "_common"]);
        assert_eq!(names(4, 2), ["_common"]);
        assert_eq!(names(1, 4), [""; 0]);
    }

    #[test]
    fn goals_are_drawn_where_they_are_with_their_tolerance() {
        let draw = |norm| {
            let markers = GoalMarkers::of(&task(2, 0, norm)).unwrap();
            let (observation, goal) = ([0.1, 0.2, 0.3, 0.4], [-0.1, -0.2, -0.3, -0.4]);
            markers.scene_update(&observation, &goal, Timestamp::new(0, 0), "step 0").entities
        };
        let entities = draw(Norm::Euclidean);
        let ids: Vec<&str> = entities.iter().map(|entity| entity.id.as_str()).collect();
        assert_eq!(ids, ["caption", "achieved0", "goal0", "achieved1", "goal1"]);
        let at = |sphere: &foxglove::messages::SpherePrimitive| {
            let position = sphere.pose.as_ref().unwrap().position.as_ref().unwrap();
            [position.x, position.y, position.z].map(|x| (10.0 * x).round())
        };
        assert_eq!(at(&entities[1].spheres[0]), [1.0, 2.0, 0.0]);
        assert_eq!(at(&entities[4].spheres[0]), [-3.0, -4.0, 0.0]);
        assert_eq!(entities[4].spheres[0].size.as_ref().unwrap().x, f64::from(0.2_f32));
        let by_maximum = draw(Norm::Maximum);
        assert_eq!((by_maximum[2].cubes.len(), by_maximum[2].spheres.len()), (1, 0));
    }
}
