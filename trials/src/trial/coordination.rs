//! Two arms that wait for each other on given paths.
//!
//! A motion that was planned without regard to the arms' links can bring them too close. Each arm then keeps its path,
//! and one waits where the other one passes: the shortest sequence of pairs of waypoints in which the arms stay apart.
//! Path–velocity decomposition after Kant and Zucker (1986), on a grid of waypoints.

use tandem_core::ArmIndex;
use tandem_kinematics::{Joints, Waypoint, WorkCell};

/// Points between two pairs of waypoints at which the gap is computed.
const N_BETWEEN: usize = 3;

/// Returns `waypoints` with waiting arms, so that the arms are at least `gap_m` metres apart, or `None` if there are
/// not two arms, or no such motion. `joint_angles` are near the first waypoint, radians.
pub(crate) fn coordinated(
    cell: &WorkCell,
    waypoints: &[Waypoint],
    joint_angles: &[Joints],
    gap_m: f64,
) -> Option<Vec<Waypoint>> {
    if cell.arms.len() != 2 || waypoints.is_empty() {
        return None;
    }
    let path = |arm| joint_path(cell, waypoints, ArmIndex(arm), joint_angles[arm]);
    let paths = [path(0)?, path(1)?];
    let is_free = |from: [usize; 2], to: [usize; 2]| {
        (1..=N_BETWEEN).all(|part| {
            let share = part as f64 / N_BETWEEN as f64;
            let angles = [0, 1].map(|arm: usize| {
                let (before, after) = (&paths[arm][from[arm]], &paths[arm][to[arm]]);
                Joints::from_fn(before.len(), |joint| {
                    before[joint] + share * (after[joint] - before[joint])
                })
            });
            cell.gaps(&angles).arms_m >= gap_m
        })
    };
    let order = shortest(waypoints.len(), is_free)?;
    let pair = |[first, second]: [usize; 2]| vec![waypoints[first][0], waypoints[second][1]];
    Some(order.into_iter().map(pair).collect())
}

/// Returns the joint angles of an arm at all waypoints, radians, if it reaches them.
fn joint_path(
    cell: &WorkCell,
    waypoints: &[Waypoint],
    arm: ArmIndex,
    mut near: Joints,
) -> Option<Vec<Joints>> {
    let placed = &cell.arms[arm.0];
    let angles = waypoints.iter().map(|waypoint| {
        let target = placed.target(&waypoint[arm.0].tool_in_world_m);
        near = placed.model.inverse_kinematics(&target, &near).ok()?.angles;
        Some(near)
    });
    angles.collect()
}

/// Returns the shortest sequence of pairs of positions from the first pair to the last one, on two paths of `n`
/// positions each. Each pair follows the one before by a step of one arm or of both, from one pair to another, that
/// `is_free` allows.
fn shortest(n: usize, is_free: impl Fn([usize; 2], [usize; 2]) -> bool) -> Option<Vec<[usize; 2]>> {
    // Together first, so that arms wait only where they have to.
    const STEPS: [[usize; 2]; 3] = [[1, 1], [1, 0], [0, 1]];
    let cell = |[first, second]: [usize; 2]| first * n + second;
    let mut steps_to = vec![usize::MAX; n * n];
    let mut came_by = vec![[0, 0]; n * n];
    steps_to[0] = 0;
    for first in 0..n {
        for second in 0..n {
            let from = [first, second];
            let n_steps = steps_to[cell(from)];
            if n_steps == usize::MAX {
                continue;
            }
            for step in STEPS {
                let to = [first + step[0], second + step[1]];
                let is_better = to.iter().all(|position| *position < n)
                    && n_steps + 1 < steps_to[cell(to)]
                    && is_free(from, to);
                if is_better {
                    steps_to[cell(to)] = n_steps + 1;
                    came_by[cell(to)] = step;
                }
            }
        }
    }
    let mut position = [n - 1; 2];
    if steps_to[cell(position)] == usize::MAX {
        return None;
    }
    let mut order = vec![position];
    while position != [0, 0] {
        let step = came_by[cell(position)];
        position = [position[0] - step[0], position[1] - step[1]];
        order.push(position);
    }
    order.reverse();
    Some(order)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arms_that_are_apart_move_together() {
        let order = shortest(4, |_, _| true).unwrap();
        assert_eq!(order, [[0, 0], [1, 1], [2, 2], [3, 3]]);
    }

    #[test]
    fn one_arm_waits_until_the_other_has_passed() {
        // Both paths cross in their middle, and only one arm may be there.
        let is_free = |_: [usize; 2], to: [usize; 2]| to != [2, 2] && to != [2, 3] && to != [3, 2];
        let order = shortest(5, is_free).unwrap();
        assert_eq!((order[0], order[order.len() - 1]), ([0, 0], [4, 4]));
        assert!(order.windows(2).all(|pair| is_free(pair[0], pair[1])));
        assert_eq!(order.len(), 7, "two steps of waiting: {order:?}");
    }

    #[test]
    fn arms_whose_ends_are_too_close_have_no_motion() {
        assert_eq!(shortest(3, |_, to| to != [2, 2]), None);
    }
}
