//! Two scripted arms that take turns in the shared world.

use tandem_core::layout::{OBSERVATION_PER_ARM, WORKSPACE_DISTANCE_M};
use tandem_core::{Contacts, Layout, Stream, WorldSettings, episode_rng};
use tandem_sim::{Env, WorldConfig};

use super::{Controller, Flat, Played, flat_between, length, outcome, towards};

/// Distance between the zones of two arms from which they work at the same time, metres.
const APART_M: f32 = 0.20;
/// Distance between two hands below which the arm that works lets the other one pass, metres.
const PASSING_M: f32 = 0.15;
/// Distance between object and goal at which an arm has finished, metres.
const DONE_M: f32 = 0.025;
/// The same once it has released its object, metres.
const RELEASED_M: f32 = 0.045;
/// Height of a goal above a resting object from which it must be held, metres.
const HOLD_M: f32 = 0.03;
/// Distance of an object from a way that is not in its way, metres.
const CLEARANCE_M: f32 = 0.098;
/// Room that a waiting hand leaves the other arm, metres.
const ROOM_M: f32 = 0.17;
/// Half the edge of a cube, metres.
const HALF_M: f32 = 0.0225;

/// An arm's hand, object and goal, world frame, metres.
#[derive(Clone, Copy)]
struct Seen {
    hand: [f32; 3],
    object: [f32; 3],
    goal: [f32; 3],
}

/// Plays `n_episodes`; returns their outcomes and the number of steps after which all goals were achieved for good.
pub(crate) fn play_in_turn(
    layout: Layout,
    config: &WorldConfig,
    n_episodes: u64,
    n_steps: usize,
) -> Vec<(Played, usize)> {
    let mut env = Env::new(layout, config).expect("a valid world");
    let mut observation = vec![0.0; layout.n_observation()];
    let mut action = vec![0.0; layout.n_action()];
    (0..n_episodes)
        .map(|episode| {
            env.reset(&mut episode_rng(12, episode, Stream::Reset), WorldSettings::default());
            let (mut contacts, mut pair) = (Contacts::NONE, None);
            let mut solved_after = n_steps + 1;
            for step in 0..n_steps {
                env.observe(&mut observation);
                let pair = pair.get_or_insert_with(|| Pair::new(layout, &observation, env.goal()));
                pair.act(&observation, env.goal(), &mut action);
                contacts = contacts | env.step(&action).expect("a finite step");
                env.observe(&mut observation);
                if !outcome(layout, &observation, env.goal(), contacts).success {
                    solved_after = n_steps + 1;
                } else if solved_after > n_steps {
                    solved_after = step + 1;
                }
            }
            (outcome(layout, &observation, env.goal(), contacts), solved_after)
        })
        .collect()
}

struct Pair {
    layout: Layout,
    controllers: [Controller; 2],
    first: usize,
    /// Where each hand waits.
    waiting: [usize; 2],
    /// Steps for which the first arm's gripper has been opening.
    released: u32,
}

impl Pair {
    fn new(layout: Layout, observation: &[f32], goal: &[f32]) -> Self {
        let seen = [0, 1].map(|arm| see(arm, observation, goal));
        let first = usize::from(!may_go_first(layout, &seen, 0));
        let controllers = [0, 1].map(|_| Controller::new(layout.task));
        Self { layout, controllers, first, waiting: [1; 2], released: 0 }
    }

    fn act(&mut self, observation: &[f32], goal: &[f32], action: &mut [f32]) {
        let (first, second) = (self.first, 1 - self.first);
        let seen = [0, 1].map(|arm| see(arm, observation, goal));
        let grasps = self.layout.task.grasps();
        // An object that is released a little above the table falls, within the tolerance of its goal.
        let done_m = if self.released > 0 { RELEASED_M } else { DONE_M };
        let is_done = distance(seen[first].object, seen[first].goal) < done_m;
        let holds = grasps && seen[first].goal[2] > HALF_M + HOLD_M;
        let apart = zone_distance(&seen[first], &seen[second]) > APART_M;
        let second_may = apart || (is_done && (holds || !grasps || self.released > 2));

        let hands_m = length(flat_between(seen[0].hand, seen[1].hand));
        let inputs_first = if is_done && !holds {
            self.released += 1;
            if grasps && self.released <= 3 {
                [0.0, 0.0, 0.0, 1.0]
            } else {
                retreat(first, &seen, &mut self.waiting[first])
            }
        } else if !second_may
            && hands_m < PASSING_M
            && !self.controllers[first].is_at_work()
            && !is_waiting(second, &seen[second], self.waiting[second])
        {
            [0.0, 0.0, 0.0, if grasps { 1.0 } else { 0.0 }]
        } else {
            self.controllers[first].act(part(observation, first), goal_of(goal, first))
        };
        let inputs_second = if second_may {
            self.controllers[second].act(part(observation, second), goal_of(goal, second))
        } else {
            retreat(second, &seen, &mut self.waiting[second])
        };
        for (arm, inputs) in [(first, inputs_first), (second, inputs_second)] {
            let n = self.layout.task.action_per_arm();
            action[arm * n..(arm + 1) * n].copy_from_slice(&inputs[..n]);
        }
    }
}

pub(super) fn part(observation: &[f32], arm: usize) -> &[f32] {
    &observation[arm * OBSERVATION_PER_ARM..(arm + 1) * OBSERVATION_PER_ARM]
}

fn goal_of(goal: &[f32], arm: usize) -> &[f32] {
    &goal[3 * arm..3 * arm + 3]
}

fn see(arm: usize, observation: &[f32], goal: &[f32]) -> Seen {
    let in_world = |own: &[f32]| in_world(arm, [own[0], own[1], own[2]]);
    let own = part(observation, arm);
    Seen {
        hand: in_world(&own[0..3]),
        object: in_world(&own[3..6]),
        goal: in_world(goal_of(goal, arm)),
    }
}

/// Converts a point from the frame of `arm` to the world frame, metres.
pub(super) fn in_world(arm: usize, [x, y, z]: [f32; 3]) -> [f32; 3] {
    let half_m = 0.5 * WORKSPACE_DISTANCE_M;
    if arm == 0 { [x - half_m, y, z] } else { [half_m - x, -y, z] }
}

/// Converts a point from the world frame to that of `arm`, metres.
pub(super) fn in_own_frame(arm: usize, [x, y, z]: [f32; 3]) -> [f32; 3] {
    let half_m = 0.5 * WORKSPACE_DISTANCE_M;
    if arm == 0 { [x + half_m, y, z] } else { [half_m - x, -y, z] }
}

/// Whether `arm` can serve its object while the other object is at its start.
fn may_go_first(layout: Layout, seen: &[Seen; 2], arm: usize) -> bool {
    let (first, second) = (&seen[arm], &seen[1 - arm]);
    if !layout.task.grasps() {
        return to_segment(second.object, first.object, first.goal) >= CLEARANCE_M
            && to_segment(first.goal, second.object, second.goal) >= CLEARANCE_M;
    }
    let other_holds = second.goal[2] > HALF_M + HOLD_M;
    if first.goal[2] <= HALF_M + HOLD_M {
        return length(flat_between(second.object, first.goal)) >= CLEARANCE_M;
    }
    let sign = if arm == 0 { 1.0 } else { -1.0 };
    let is_beside = |point: [f32; 3]| {
        let [x, y] = flat_between(first.goal, point).map(|offset| sign * offset);
        length([x, y]) >= 0.168 && (x >= -0.001 || y.abs() >= 0.218)
    };
    other_holds && is_beside(second.object) && is_beside(second.goal)
}

/// Where a hand can wait, arm frame, metres.
const WAITING_M: [Flat; 3] = [[-0.04, -0.18], [-0.04, 0.0], [-0.04, 0.18]];

/// Height at which it waits, metres.
const WAITING_Z_M: f32 = 0.24;

/// Whether the hand of `arm` is where it waits.
fn is_waiting(arm: usize, own: &Seen, waiting: usize) -> bool {
    let sign = if arm == 0 { 1.0 } else { -1.0 };
    let [x, y] = WAITING_M[waiting];
    let place = [sign * (x - 0.5 * WORKSPACE_DISTANCE_M), sign * y, 0.0];
    length(flat_between(place, own.hand)) < 0.02
}

/// Moves the hand of `arm` up and back to its base, away from everything that the other arm still has to reach, and
/// updates the place in [`WAITING_M`] where it waits.
fn retreat(arm: usize, seen: &[Seen; 2], waiting: &mut usize) -> [f32; 4] {
    let sign = if arm == 0 { 1.0 } else { -1.0 };
    let (own, other) = (&seen[arm], &seen[1 - arm]);
    let busy = [other.hand, other.object, other.goal, behind(other)];
    let room_m = |idx: usize| {
        let [x, y] = WAITING_M[idx];
        let place = [sign * (x - 0.5 * WORKSPACE_DISTANCE_M), sign * y, 0.0];
        let distances = busy.map(|point| length(flat_between(place, point)));
        distances.into_iter().fold(f32::INFINITY, f32::min)
    };
    let best = (0..WAITING_M.len()).max_by(|&a, &b| room_m(a).total_cmp(&room_m(b)));
    if let Some(best) = best
        && room_m(*waiting) < ROOM_M
        && room_m(best) > room_m(*waiting) + 0.02
    {
        *waiting = best;
    }
    let hand = [sign * own.hand[0] + 0.5 * WORKSPACE_DISTANCE_M, sign * own.hand[1], own.hand[2]];
    // First up, clear of all objects.
    let low = hand[2] < 0.11;
    let [x, y] = WAITING_M[*waiting];
    let target = if low { [hand[0], hand[1], WAITING_Z_M] } else { [x, y, WAITING_Z_M] };
    towards(hand, target, 1.0, 1.0)
}

/// The point behind an object from which a hand pushes it to its goal.
fn behind(seen: &Seen) -> [f32; 3] {
    let [x, y] = flat_between(seen.goal, seen.object);
    let share = 0.055 / length([x, y]).max(1e-6);
    [seen.object[0] + share * x, seen.object[1] + share * y, seen.object[2]]
}

/// The smallest horizontal distance between what one arm still has to pass and what the other one has.
fn zone_distance(one: &Seen, other: &Seen) -> f32 {
    let legs = |seen: &Seen| [(seen.hand, seen.object), (seen.object, seen.goal)];
    let pairs = legs(one).into_iter().flat_map(|one| legs(other).map(|other| (one, other)));
    pairs
        .map(|((a, b), (c, d))| {
            let ends = [
                to_segment(a, c, d),
                to_segment(b, c, d),
                to_segment(c, a, b),
                to_segment(d, a, b),
            ];
            if crosses(a, b, c, d) { 0.0 } else { ends.into_iter().fold(f32::INFINITY, f32::min) }
        })
        .fold(f32::INFINITY, f32::min)
}

fn crosses(a: [f32; 3], b: [f32; 3], c: [f32; 3], d: [f32; 3]) -> bool {
    let side = |from, to, point| {
        let ([x, y], [u, v]) = (flat_between(from, to), flat_between(from, point));
        x * v - y * u
    };
    side(a, b, c) * side(a, b, d) < 0.0 && side(c, d, a) * side(c, d, b) < 0.0
}

/// The horizontal distance of a point from the straight line between two others.
fn to_segment(point: [f32; 3], from: [f32; 3], to: [f32; 3]) -> f32 {
    let (along, offset): (Flat, Flat) = (flat_between(from, to), flat_between(from, point));
    let share = (along[0] * offset[0] + along[1] * offset[1])
        / (along[0] * along[0] + along[1] * along[1]).max(1e-9);
    let share = share.clamp(0.0, 1.0);
    length([offset[0] - along[0] * share, offset[1] - along[1] * share])
}

fn distance(from: [f32; 3], to: [f32; 3]) -> f32 {
    let [x, y] = flat_between(from, to);
    length([length([x, y]), to[2] - from[2]])
}
