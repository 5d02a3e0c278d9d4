//! Tasks that follow from a task: that of one of its arms, and that of several copies of its arms.

use super::{
    ArmDescription, InvalidTask, Manipulation, Part, Reflection, TaskDescription, TaskSpec,
};
use crate::layout::{ArmIndex, Layout};

impl TaskSpec {
    /// Returns the one-arm task of which each arm's part is an instance: the task of a teacher.
    ///
    /// Returns `None` if the arms have common numbers, an arm achieves its goal outside its own observation, or the
    /// tasks of two arms differ, for example in bounds or conditions. A task of one arm is its own one-arm task if its
    /// vectors have the order of the arm's parts.
    #[must_use]
    pub fn single_arm(&self) -> Option<Self> {
        if self.n_arms() == 1 && self.is_in_arm_order() {
            return Some(self.clone());
        }
        if let Some(layout) = self.as_built_in() {
            return Some(layout.single_arm().into());
        }
        let mut of_arms = self.arms().map(|arm| self.task_of_arm(arm));
        let first = of_arms.next()??;
        of_arms.all(|other| other.as_ref() == Some(&first)).then_some(first)
    }

    /// Returns the task that remains if all arms but `arm` are removed; `None` if its part is not a task of its own.
    fn task_of_arm(&self, arm_idx: ArmIndex) -> Option<Self> {
        let description = self.description();
        let arm = &description.arms[arm_idx.0];
        let has_common = !self.common_observation().is_empty() || !self.common_goal().is_empty();
        let in_own = |idx: &usize| {
            let achieved = description.achieved_goal[*idx];
            arm.observation.iter().position(|own| *own == achieved)
        };
        let achieved_goal = arm.goal.iter().map(in_own).collect::<Option<Vec<usize>>>()?;
        if has_common || achieved_goal.is_empty() {
            return None;
        }
        let own = |n: usize| (0..n).collect::<Vec<usize>>();
        let bounds = |part: &Part, bounds: &[f32]| part.of(bounds).into_owned();
        let (observation, goal) = (self.observation_of(arm_idx), self.goal_of(arm_idx));
        Self::new(TaskDescription {
            n_observation: arm.observation.len(),
            n_goal: arm.goal.len(),
            n_action: arm.action.len(),
            arms: vec![ArmDescription {
                observation: own(arm.observation.len()),
                goal: own(arm.goal.len()),
                action: own(arm.action.len()),
                position: Vec::new(),
                lateral: Vec::new(),
                hand: Vec::new(),
            }],
            achieved_goal,
            interchangeable_arms: false,
            origin_distance: 0.0,
            recombination_gap: 0.0,
            base: 0.0,
            contact_distances: Vec::new(),
            observation_bound: bounds(observation, &description.observation_bound),
            goal_bound: bounds(goal, &description.goal_bound),
            name: match description.manipulation.one_arm_task.as_str() {
                "" => description.name.clone(),
                other => other.to_owned(),
            },
            manipulation: manipulation_of(description, arm_idx)?,
            reflection: Reflection { whole_scene: false, ..description.reflection.clone() },
            ..description.clone()
        })
        .ok()
    }

    /// Returns true if every number belongs to an arm, and the arms' parts follow each other in the vectors.
    fn is_in_arm_order(&self) -> bool {
        let task = self.description();
        let ascends = |indices: fn(&ArmDescription) -> &Vec<usize>, n: usize| {
            task.arms.iter().flat_map(indices).copied().eq(0..n)
        };
        ascends(|arm| &arm.observation, task.n_observation)
            && ascends(|arm| &arm.goal, task.n_goal)
            && ascends(|arm| &arm.action, task.n_action)
    }

    /// Returns the task of `n_arms` arms whose vectors are the concatenated vectors of this task's arms: the form in
    /// which a student with any number of arms asks a teacher for one arm.
    ///
    /// # Errors
    /// When numbers belong to no arm; otherwise names the limit that the result exceeds.
    pub fn concatenated(&self, n_arms: usize) -> Result<Self, InvalidTask> {
        if let Some(layout) = self.as_built_in() {
            return Self::new(Layout::new(layout.task, n_arms).description());
        }
        let one = self.description();
        let has_common = !self.common_observation().is_empty() || !self.common_goal().is_empty();
        let expected = "arms to which every number of observations and goals belongs";
        InvalidTask::unless(!has_common, "arms", expected, "numbers that belong to no arm")?;
        let shifted = |arm_idx: usize, indices: &[usize], n: usize| {
            indices.iter().map(|idx| arm_idx * n + idx).collect::<Vec<usize>>()
        };
        let arms = (0..n_arms).flat_map(|arm_idx| {
            one.arms.iter().map(move |arm| ArmDescription {
                observation: shifted(arm_idx, &arm.observation, one.n_observation),
                goal: shifted(arm_idx, &arm.goal, one.n_goal),
                action: shifted(arm_idx, &arm.action, one.n_action),
                position: Vec::new(),
                lateral: Vec::new(),
                hand: Vec::new(),
            })
        });
        let achieved_goal =
            (0..n_arms).flat_map(|arm_idx| shifted(arm_idx, &one.achieved_goal, one.n_observation));
        let manipulations = (0..n_arms).flat_map(|arm_idx| {
            let shifted = move |n: usize| move |idx: usize| Some(arm_idx * n + idx);
            one.manipulation.arms.iter().filter_map(move |arm| {
                arm.reindexed(shifted(one.n_observation), shifted(one.n_action))
            })
        });
        Self::new(TaskDescription {
            n_observation: n_arms * one.n_observation,
            n_goal: n_arms * one.n_goal,
            n_action: n_arms * one.n_action,
            arms: arms.collect(),
            achieved_goal: achieved_goal.collect(),
            contact_distances: Vec::new(),
            observation_bound: one.observation_bound.repeat(n_arms),
            goal_bound: one.goal_bound.repeat(n_arms),
            manipulation: Manipulation {
                arms: manipulations.collect(),
                ..one.manipulation.clone()
            },
            ..one.clone()
        })
    }
}

/// Returns an arm's manipulation in vectors of its own; the default if its task is another one.
fn manipulation_of(task: &TaskDescription, arm: ArmIndex) -> Option<Manipulation> {
    if !task.manipulation.one_arm_task.is_empty() {
        return Some(Manipulation::default());
    }
    let own = &task.arms[arm.0];
    let place = |part: &[usize], idx: usize| part.iter().position(|own| *own == idx);
    let reindexed = task.manipulation.arms.get(arm.0).map(|manipulation| {
        manipulation.reindexed(|idx| place(&own.observation, idx), |idx| place(&own.action, idx))
    });
    let arms = match reindexed {
        Some(manipulation) => vec![manipulation?],
        None => Vec::new(),
    };
    let success_steps = task.manipulation.success_steps;
    Some(Manipulation { success_steps, arms, ..Manipulation::default() })
}
