//! The descriptions of the built-in tasks, which the simulator implements.

use std::ops::Range;

use super::{
    ArmDescription, ArmManipulation, Condition, Manipulation, Norm, Reflection, TaskDescription,
};
use crate::bounds::GOAL_BOUND_M;
use crate::layout::{
    ArmIndex, EPISODE_STEPS, GOAL_TOLERANCE_M, HAND_POSITION, Layout, OBJECT_POSITION,
    WORKSPACE_DISTANCE_M, World,
};

/// Smallest gap along x, metres, between the hands and objects of two arms whose transitions come from different steps:
/// they cannot touch. Hands move by at most 5 cm in a step of any world, and reach 3.5 cm ahead of their position.
const RECOMBINATION_GAP_M: f32 = 0.10;
/// The same in the plane, in the shared world: a closed hand is at most 0.12 m wide and moves up to 0.05 m per step. An
/// open hand is 0.144 m wide, so two that are open and side by side can come closer than their widths; that is rare.
const SHARED_RECOMBINATION_GAP_M: f32 = 0.16;

/// Number of steps for which a bar must be held at its goal.
const CARRIED_STEPS: usize = 5;
/// Within an arm's observation, its object relative to its hand, the openings of its fingers, and the components of its
/// object's quaternion that are the sine of half the tilt.
const HAND_TO_OBJECT_ACROSS: Range<usize> = 6..8;
const HAND_TO_OBJECT_UP: Range<usize> = 8..9;
const FINGER_OPENINGS: Range<usize> = 9..12;
const OBJECT_TILT: Range<usize> = 12..14;
/// Horizontal and vertical distance from its handle within which a hand holds it, metres: its pads reach the end of the
/// bar from 5 cm beyond the handle, and its section from 4 cm above it.
const HOLDING_DISTANCES_M: [f32; 2] = [0.06, 0.045];
/// Openings of a gripper that is closed on a handle, metres: from a little less than half its width to that of the largest
/// angle at which the pads fit around it.
const HOLDING_OPENING_M: [f32; 2] = [0.018, 0.038];
/// Sine of half the largest tilt of a bar at its goal, 10°.
const HALF_TILT_SINE: f32 = 0.087_155_74;

impl Layout {
    /// Returns the description of the built-in task with this number of arms.
    #[must_use]
    pub fn description(self) -> TaskDescription {
        let has_several_arms = self.n_arms > 1;
        let is_recombined = has_several_arms && !self.task.shares_object();
        let is_shared = self.task.world() == World::Shared;
        let arm = |arm| {
            let observation = self.observation_of(arm);
            let x_of = |position: Range<usize>| observation.start + position.start;
            let position = vec![x_of(HAND_POSITION), x_of(OBJECT_POSITION)];
            let lateral = position.iter().map(|x| x + 1).collect();
            ArmDescription {
                observation: observation.clone().collect(),
                goal: self.goal_of(arm).collect(),
                action: self.action_of(arm).collect(),
                position: if is_recombined { position } else { Vec::new() },
                lateral: if is_recombined && is_shared { lateral } else { Vec::new() },
                hand: if is_recombined && is_shared {
                    HAND_POSITION.map(|idx| observation.start + idx).collect()
                } else {
                    Vec::new()
                },
            }
        };
        let if_several = |value| if is_recombined { value } else { 0.0 };
        TaskDescription {
            name: self.task.name().to_owned(),
            n_observation: self.n_observation(),
            n_goal: self.n_goal(),
            n_action: self.n_action(),
            arms: self.arms().map(arm).collect(),
            achieved_goal: self.arms().flat_map(|arm| self.achieved_goal_of(arm)).collect(),
            episode_steps: EPISODE_STEPS,
            tolerance: GOAL_TOLERANCE_M,
            norm: Norm::Euclidean,
            interchangeable_arms: has_several_arms,
            reports_contacts: true,
            origin_distance: if_several(WORKSPACE_DISTANCE_M),
            recombination_gap: if_several(if is_shared {
                SHARED_RECOMBINATION_GAP_M
            } else {
                RECOMBINATION_GAP_M
            }),
            base: if is_shared { if_several(-World::Shared.mico_base_distance_m()) } else { 0.0 },
            contact_distances: Vec::new(),
            observation_bound: (0..self.n_observation())
                .map(|idx| self.observation_bound(idx))
                .collect(),
            goal_bound: vec![GOAL_BOUND_M; self.n_goal()],
            manipulation: self.manipulation(),
            reflection: self.reflection(),
        }
    }

    /// The reflection about the vertical plane through the arm's base, y to -y, in the shared world. The gripper of the
    /// other worlds has two fingers on one side and one on the other.
    fn reflection(self) -> Reflection {
        if self.task.world() != World::Shared {
            return Reflection::default();
        }
        // Of each finger, opening and rate. The first two places show the same finger.
        let fingers = [9, 25].into_iter();
        Reflection {
            // The distance between hand and object; the object's quaternion; velocities.
            observation: vec![7, 12, 14, 17, 19, 21, 23],
            position: vec![HAND_POSITION.start + 1, OBJECT_POSITION.start + 1],
            goal: vec![1],
            action: vec![1],
            moved: fingers.flat_map(|at| [[at, at + 2], [at + 1, at + 2], [at + 2, at]]).collect(),
            plane: 0.0,
            // Both bases lie in the plane, and a Mico's links have mirror images.
            whole_scene: self.n_arms > 1,
        }
    }

    fn manipulation(self) -> Manipulation {
        if !self.task.shares_object() || self.n_arms < 2 {
            return Manipulation::default();
        }
        let own = self.task.of_one_arm();
        Manipulation {
            shared_object: true,
            one_arm_task: if own == self.task { String::new() } else { own.name().to_owned() },
            success_steps: CARRIED_STEPS,
            arms: self.arms().map(|arm| self.carries(arm)).collect(),
        }
    }

    /// When `arm` holds its handle, and when the bar is level.
    fn carries(self, arm: ArmIndex) -> ArmManipulation {
        let first = self.observation_of(arm).start;
        let numbers = |range: Range<usize>| range.map(|idx| first + idx).collect::<Vec<usize>>();
        let offsets = [HAND_TO_OBJECT_ACROSS, HAND_TO_OBJECT_UP].into_iter();
        let near = offsets.zip(HOLDING_DISTANCES_M).map(|(offset, tolerance)| Condition {
            numbers: numbers(offset),
            target: Vec::new(),
            tolerance,
        });
        let [low_m, high_m] = HOLDING_OPENING_M;
        let closed = FINGER_OPENINGS.map(|idx| Condition {
            numbers: vec![first + idx],
            target: vec![0.5 * (low_m + high_m)],
            tolerance: 0.5 * (high_m - low_m),
        });
        ArmManipulation {
            gripper: self.action_of(arm).last(),
            holding: near.chain(closed).collect(),
            conditions: vec![Condition {
                numbers: numbers(OBJECT_TILT),
                target: Vec::new(),
                tolerance: HALF_TILT_SINE,
            }],
        }
    }
}
