//! The descriptions of the built-in tasks, which the simulator implements.

use std::ops::Range;

use super::{
    ArmDescription, ArmManipulation, Condition, Manipulation, Norm, Reflection, TaskDescription,
};
use crate::bounds::GOAL_BOUND_M;
use crate::layout::observation::{
    FINGER_OPENINGS, FINGER_RATES, HAND_POSITION, HAND_TO_OBJECT, HAND_VELOCITY,
    OBJECT_ANGULAR_VELOCITY, OBJECT_ORIENTATION, OBJECT_POSITION, OBJECT_VELOCITY,
};
use crate::layout::{
    ArmIndex, EPISODE_STEPS, GOAL_TOLERANCE_M, Layout, WORKSPACE_DISTANCE_M, World,
};

/// Smallest gap along x, metres, between the hands and objects of two arms whose transitions come from different steps:
/// they cannot touch. Hands move by at most 5 cm in a step of any world, and reach 3.5 cm ahead of their position.
const RECOMBINATION_GAP_M: f32 = 0.10;
/// The same in the plane, in the shared world: a closed hand is at most 0.12 m wide and moves up to 0.05 m per step. An
/// open hand is 0.144 m wide, so two that are open and side by side can come closer than their widths; that is rare.
const SHARED_RECOMBINATION_GAP_M: f32 = 0.16;

/// Number of steps for which a bar must be held at its goal.
const CARRIED_STEPS: usize = 5;
/// Offsets of the components of a vector or a quaternion.
const X: usize = 0;
const Y: usize = 1;
const Z: usize = 2;
/// Horizontal and vertical components of [`HAND_TO_OBJECT`].
const HAND_TO_OBJECT_ACROSS: Range<usize> = HAND_TO_OBJECT.start..HAND_TO_OBJECT.start + Z;
const HAND_TO_OBJECT_UP: Range<usize> = HAND_TO_OBJECT.start + Z..HAND_TO_OBJECT.end;
/// The components x and y of an object's quaternion, which are the sine of half the tilt.
const OBJECT_TILT: Range<usize> = OBJECT_ORIENTATION.start..OBJECT_ORIENTATION.start + Z;
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
        let fingers = [FINGER_OPENINGS.start, FINGER_RATES.start].into_iter();
        Reflection {
            observation: vec![
                HAND_TO_OBJECT.start + Y,
                OBJECT_ORIENTATION.start + X,
                OBJECT_ORIENTATION.start + Z,
                OBJECT_VELOCITY.start + Y,
                OBJECT_ANGULAR_VELOCITY.start + X,
                OBJECT_ANGULAR_VELOCITY.start + Z,
                HAND_VELOCITY.start + Y,
            ],
            position: vec![HAND_POSITION.start + Y, OBJECT_POSITION.start + Y],
            goal: vec![Y],
            action: vec![Y],
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

    /// Returns the conditions under which `arm` holds its handle and the bar is level.
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
