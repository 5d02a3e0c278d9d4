//! The checks of a task's description.

use std::fmt::Display;

use super::{Condition, MAX_ARMS, MAX_EPISODE_STEPS, MAX_NUMBERS, TaskDescription};
use crate::layout::{Layout, Task};
use crate::text::shortened;

/// Longest name of a task, characters.
const MAX_NAME_CHARS: usize = 64;
/// Largest number of conditions of each kind for an arm.
const MAX_CONDITIONS: usize = 16;

/// A description of a task that is inconsistent or exceeds a limit.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: expected {expected}, got {got}")]
pub struct InvalidTask {
    /// The field, such as `arms[1].goal[0]`.
    pub field: String,
    /// Valid values.
    pub expected: String,
    /// Its value.
    pub got: String,
}

impl InvalidTask {
    pub(super) fn unless(
        is_valid: bool,
        field: impl Display,
        expected: impl Display,
        got: impl Display,
    ) -> Result<(), Self> {
        if is_valid {
            return Ok(());
        }
        let got = shortened(&got.to_string(), MAX_NAME_CHARS);
        Err(Self { field: field.to_string(), expected: expected.to_string(), got })
    }
}

/// Checks every field; NaN is in no range.
pub(super) fn check(task: &TaskDescription) -> Result<(), InvalidTask> {
    check_name("name", &task.name)?;
    for (field, n) in [
        ("n_observation", task.n_observation),
        ("n_goal", task.n_goal),
        ("n_action", task.n_action),
    ] {
        within(field, n, 1, MAX_NUMBERS)?;
    }
    within("episode_steps", task.episode_steps, 1, MAX_EPISODE_STEPS)?;
    let is_tolerance = task.tolerance.is_finite() && task.tolerance > 0.0;
    let expected = "a finite number above 0";
    InvalidTask::unless(is_tolerance, "tolerance", expected, task.tolerance)?;
    check_length("achieved_goal", task.achieved_goal.len(), task.n_goal)?;
    check_indices("achieved_goal", &task.achieved_goal, task.n_observation)?;
    check_bounds("observation_bound", &task.observation_bound, task.n_observation)?;
    check_bounds("goal_bound", &task.goal_bound, task.n_goal)?;
    check_arms(task)?;
    check_recombination(task)?;
    check_manipulation(task)?;
    check_reflection(task)?;
    check_reserved_name(task)
}

fn check_name(field: &str, name: &str) -> Result<(), InvalidTask> {
    let is_allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "-_./".contains(c);
    let is_name = (1..=MAX_NAME_CHARS).contains(&name.len()) && name.chars().all(is_allowed);
    let expected =
        format_args!("1 to {MAX_NAME_CHARS} lower-case letters, digits, '-', '_', '.' and '/'")
            .to_string();
    InvalidTask::unless(is_name, field, expected, format_args!("{name:?}"))
}

/// The names of the built-in tasks belong to them.
fn check_reserved_name(task: &TaskDescription) -> Result<(), InvalidTask> {
    let Ok(known) = task.name.parse::<Task>() else { return Ok(()) };
    let built_in = Layout::new(known, task.arms.len()).description();
    let difference = built_in.difference(task);
    let expected = format_args!("a name other than that of the built-in task {known}").to_string();
    let got = || difference.as_ref().map(|difference| format!("{known}, whose {difference}"));
    InvalidTask::unless(difference.is_none(), "name", expected, got().unwrap_or_default())
}

fn check_arms(task: &TaskDescription) -> Result<(), InvalidTask> {
    within("number of arms", task.arms.len(), 1, MAX_ARMS)?;
    let lengths = [task.n_observation, task.n_goal, task.n_action];
    let mut owners = lengths.map(|n| vec![None::<usize>; n]);
    for (arm_idx, arm) in task.arms.iter().enumerate() {
        let first = task.arms[0].fields();
        for (kind, (name, indices)) in arm.fields().into_iter().enumerate() {
            let field = format!("arms[{arm_idx}].{name}");
            check_length(&field, indices.len(), first[kind].1.len())?;
            check_indices(&field, indices, lengths.get(kind).copied().unwrap_or(lengths[0]))?;
            let Some(owners) = owners.get_mut(kind) else { continue };
            for (at, idx) in indices.iter().enumerate() {
                let owner = owners[*idx].replace(arm_idx);
                let expected = "an index that no arm has yet";
                InvalidTask::unless(owner.is_none(), format_args!("{field}[{at}]"), expected, idx)?;
            }
        }
        let (field, n_observation) = (format!("arms[{arm_idx}].position"), arm.observation.len());
        let n_positions = arm.position.len();
        let expected = format_args!("at most {n_observation} numbers").to_string();
        InvalidTask::unless(n_positions <= n_observation, field, expected, n_positions)?;
        let n_action = arm.action.len();
        let field = format_args!("arms[{arm_idx}].action").to_string();
        InvalidTask::unless(n_action > 0, field, "at least one index", "none")?;
    }
    let orphan = owners[2].iter().position(Option::is_none);
    let expected = "every index of an action in the action of an arm";
    let got = orphan.map_or_else(String::new, |idx| format!("none with index {idx}"));
    InvalidTask::unless(orphan.is_none(), "arms", expected, got)
}

/// Recombined arms must not share numbers: their steps differ.
fn check_recombination(task: &TaskDescription) -> Result<(), InvalidTask> {
    for (field, value) in
        [("origin_distance", task.origin_distance), ("recombination_gap", task.recombination_gap)]
    {
        let is_valid = value.is_finite() && value >= 0.0;
        InvalidTask::unless(is_valid, field, "a finite number, 0 or more", value)?;
    }
    InvalidTask::unless(task.base.is_finite(), "base", "a finite number", task.base)?;
    let distances = &task.contact_distances;
    let has_hands = task.arms.iter().all(|arm| arm.hand.len() == 3);
    let is_valid = distances.is_empty()
        || (distances.len() == 3
            && distances.iter().all(|distance| distance.is_finite() && *distance > 0.0)
            && has_hands);
    let expected = "none, or three finite numbers above 0 for arms with hands";
    InvalidTask::unless(is_valid, "contact_distances", expected, format_args!("{distances:?}"))?;
    let has_common = has_common_numbers(task);
    for (arm_idx, arm) in task.arms.iter().enumerate() {
        let achieves_own =
            arm.goal.iter().all(|idx| arm.observation.contains(&task.achieved_goal[*idx]));
        let is_own = arm.position.iter().all(|idx| arm.observation.contains(idx));
        let is_valid = arm.position.is_empty() || (!has_common && achieves_own && is_own);
        let expected = "no index, or observations and goals in which every number, the achieved goal \
                        and these positions belong to the arm";
        let got = format_args!("{} indices", arm.position.len()).to_string();
        InvalidTask::unless(is_valid, format_args!("arms[{arm_idx}].position"), expected, got)?;
        let is_own = arm.hand.iter().all(|idx| arm.observation.contains(idx));
        let is_valid = arm.hand.is_empty() || (arm.hand.len() == 3 && is_own);
        let expected = "no index, or three of the arm's own";
        let got = format_args!("{:?}", arm.hand).to_string();
        InvalidTask::unless(is_valid, format_args!("arms[{arm_idx}].hand"), expected, got)?;
        let is_own = arm.lateral.iter().all(|idx| arm.observation.contains(idx));
        let n_lateral = arm.lateral.len();
        let is_valid = n_lateral == 0 || (n_lateral == arm.position.len() && is_own);
        let expected = "no index, or one of the arm's own for each position";
        let got = format_args!("{n_lateral} indices").to_string();
        InvalidTask::unless(is_valid, format_args!("arms[{arm_idx}].lateral"), expected, got)?;
    }
    Ok(())
}

fn has_common_numbers(task: &TaskDescription) -> bool {
    let of_arms = |n: fn(&super::ArmDescription) -> usize| task.arms.iter().map(n).sum::<usize>();
    of_arms(|arm| arm.observation.len()) < task.n_observation
        || of_arms(|arm| arm.goal.len()) < task.n_goal
}

fn check_manipulation(task: &TaskDescription) -> Result<(), InvalidTask> {
    let manipulation = &task.manipulation;
    let (n_steps, n_arms) = (manipulation.success_steps, manipulation.arms.len());
    within("manipulation.success_steps", n_steps, 1, task.episode_steps)?;
    if !manipulation.one_arm_task.is_empty() {
        check_name("manipulation.one_arm_task", &manipulation.one_arm_task)?;
    }
    let is_valid = task.arms.len() > 1
        || (manipulation.one_arm_task.is_empty() && !manipulation.shared_object);
    let expected = "several arms, or no shared_object and no one_arm_task";
    InvalidTask::unless(is_valid, "manipulation", expected, "one arm")?;
    let is_recombined = task.arms.iter().any(|arm| !arm.position.is_empty());
    let is_valid = !(manipulation.shared_object && is_recombined);
    let expected = "false for arms with positions, which are recombined";
    InvalidTask::unless(is_valid, "manipulation.shared_object", expected, "true")?;
    let expected = format_args!("none or {}", task.arms.len()).to_string();
    let is_valid = n_arms == 0 || n_arms == task.arms.len();
    InvalidTask::unless(is_valid, "manipulation.arms", expected, n_arms)?;
    for (arm_idx, (own, arm)) in manipulation.arms.iter().zip(&task.arms).enumerate() {
        let field = format!("manipulation.arms[{arm_idx}]");
        if let Some(gripper) = own.gripper {
            let (is_own, expected) = (arm.action.contains(&gripper), "an action of the arm");
            InvalidTask::unless(is_own, format_args!("{field}.gripper"), expected, gripper)?;
        }
        within(format_args!("{field}.holding"), own.holding.len(), 0, MAX_CONDITIONS)?;
        within(format_args!("{field}.conditions"), own.conditions.len(), 0, MAX_CONDITIONS)?;
        for condition in own.all_conditions() {
            check_condition(&field, condition, &arm.observation)?;
        }
    }
    Ok(())
}

/// Every number belongs to an arm, whose part has the places, and no place is named twice.
fn check_reflection(task: &TaskDescription) -> Result<(), InvalidTask> {
    let reflection = &task.reflection;
    if reflection.is_none() {
        return Ok(());
    }
    let has_common = has_common_numbers(task);
    let expected = "none, or observations and goals in which every number belongs to an arm";
    InvalidTask::unless(!has_common, "reflection", expected, "numbers that belong to no arm")?;
    let arm = &task.arms[0];
    let (to, from): (Vec<usize>, Vec<usize>) =
        reflection.moved.iter().map(|[to, from]| (*to, *from)).unzip();
    check_indices("reflection.moved", &from, arm.observation.len())?;
    let negated = [&reflection.observation[..], &reflection.position].concat();
    let (plane, is_plane) = (reflection.plane, reflection.plane.is_finite());
    InvalidTask::unless(is_plane, "reflection.plane", "a finite number", plane)?;
    for (field, places, n) in [
        ("reflection.observation", &negated, arm.observation.len()),
        ("reflection.goal", &reflection.goal, arm.goal.len()),
        ("reflection.action", &reflection.action, arm.action.len()),
        ("reflection.moved", &to, arm.observation.len()),
    ] {
        check_indices(field, places, n)?;
        let twice = (1..places.len()).find(|at| places[..*at].contains(&places[*at]));
        let got = twice.map_or(0, |at| places[at]);
        InvalidTask::unless(twice.is_none(), field, "each place once", got)?;
    }
    Ok(())
}

fn check_condition(field: &str, condition: &Condition, own: &[usize]) -> Result<(), InvalidTask> {
    let Condition { numbers, target, tolerance } = condition;
    let others = numbers.iter().find(|idx| !own.contains(idx));
    let got = || others.map_or_else(|| "none".to_owned(), ToString::to_string);
    let is_valid = !numbers.is_empty() && numbers.len() <= own.len() && others.is_none();
    let expected = "numbers of the arm's observation in every condition";
    InvalidTask::unless(is_valid, field, expected, got())?;
    if !target.is_empty() {
        check_length(&format!("{field}: target of a condition"), target.len(), numbers.len())?;
    }
    let bad = target.iter().find(|value| !value.is_finite());
    let (expected, got) = ("finite targets of conditions", || bad.map_or(0.0, |value| *value));
    InvalidTask::unless(bad.is_none(), field, expected, got())?;
    let is_tolerance = tolerance.is_finite() && *tolerance >= 0.0;
    let expected = "finite tolerances of conditions, 0 or more";
    InvalidTask::unless(is_tolerance, field, expected, tolerance)
}

fn check_bounds(field: &str, bounds: &[f32], n: usize) -> Result<(), InvalidTask> {
    check_length(field, bounds.len(), n)?;
    let bad = bounds.iter().position(|bound| !(bound.is_finite() && *bound > 0.0));
    match bad {
        None => Ok(()),
        Some(idx) => InvalidTask::unless(
            false,
            format_args!("{field}[{idx}]"),
            "a finite number above 0",
            bounds[idx],
        ),
    }
}

fn check_indices(field: &str, indices: &[usize], n: usize) -> Result<(), InvalidTask> {
    match indices.iter().position(|idx| *idx >= n) {
        None => Ok(()),
        Some(at) => within(format!("{field}[{at}]"), indices[at], 0, n - 1),
    }
}

fn check_length(field: &str, got: usize, expected: usize) -> Result<(), InvalidTask> {
    let numbers = format_args!("{expected} numbers").to_string();
    InvalidTask::unless(got == expected, field, numbers, format_args!("{got}"))
}

fn within(field: impl Display, value: usize, low: usize, high: usize) -> Result<(), InvalidTask> {
    let is_within = (low..=high).contains(&value);
    InvalidTask::unless(is_within, field, format_args!("{low} to {high}"), value)
}
