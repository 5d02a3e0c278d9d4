//! Scripted controllers with the inputs of a policy: one arm's 28 numbers and its goal, in the arm's frame.

use tandem_core::reward::{achieved_goal, distance, is_success};
use tandem_core::{ArmIndex, Contacts, Layout, Stream, Task, World, WorldSettings, episode_rng};
use tandem_sim::{Env, WorldConfig};

/// Displacement for an action of 1, metres.
const ACTION_M: f32 = 0.05;

pub(crate) mod bar;
mod gliding;
pub(crate) mod pair;

/// The outcome of a scripted episode.
pub(crate) struct Played {
    /// Every object is within the tolerance of its goal at the end.
    pub(crate) success: bool,
    /// Largest distance of an object from its goal at the end, metres.
    pub(crate) miss_m: f32,
    /// Contacts during the episode.
    pub(crate) contacts: Contacts,
}

/// Plays `n_episodes` with one controller per arm; controllers do not observe each other.
pub(crate) fn play(layout: Layout, config: &WorldConfig, n_episodes: u64) -> Vec<Played> {
    let mut env = Env::new(layout, config).expect("a valid world");
    let mut observation = vec![0.0; layout.n_observation()];
    let mut action = vec![0.0; layout.n_action()];
    (0..n_episodes)
        .map(|episode| {
            env.reset(&mut episode_rng(11, episode, Stream::Reset), WorldSettings::default());
            let mut controllers = vec![Controller::new(layout.task); layout.n_arms];
            let mut contacts = Contacts::NONE;
            for _ in 0..layout.description().episode_steps {
                env.observe(&mut observation);
                for (arm, controller) in layout.arms().zip(&mut controllers) {
                    let (observation, goal) = (
                        &observation[layout.observation_of(arm)],
                        &env.goal()[layout.goal_of(arm)],
                    );
                    let inputs = controller.act(observation, goal);
                    let part = &mut action[layout.action_of(arm)];
                    part.copy_from_slice(&inputs[..part.len()]);
                }
                contacts = contacts | env.step(&action).expect("a finite step");
            }
            env.observe(&mut observation);
            outcome(layout, &observation, env.goal(), contacts)
        })
        .collect()
}

/// Fraction of successful episodes.
pub(crate) fn success_rate(episodes: &[Played]) -> f64 {
    let n_successes = u32::try_from(episodes.iter().filter(|played| played.success).count())
        .expect("few episodes");
    f64::from(n_successes) / f64::from(u32::try_from(episodes.len()).expect("few episodes"))
}

fn outcome(layout: Layout, observation: &[f32], goal: &[f32], contacts: Contacts) -> Played {
    let achieved: Vec<f32> = achieved_goal(layout, observation).collect();
    let of = |arm: ArmIndex| (&achieved[layout.goal_of(arm)], &goal[layout.goal_of(arm)]);
    Played {
        success: is_success(layout, observation, goal),
        miss_m: layout.arms().map(|arm| distance(of(arm).0, of(arm).1)).fold(0.0, f32::max),
        contacts,
    }
}

/// The phase of a controller.
#[derive(Clone, Copy)]
enum Phase {
    /// Pick: moving above the object. Push: moving behind it.
    Approach,
    /// Pick: moving down to it.
    Descend,
    /// Pick: closing the gripper on it, for this number of steps so far.
    Grasp(u32),
    /// Pick: bringing it to the goal. Push: pushing it there.
    Bring,
    /// Push: moving away from it, to start again or to rest.
    Leave,
}

#[derive(Clone)]
pub(crate) struct Controller {
    task: Task,
    phase: Phase,
    world: WorldNumbers,
}

/// The numbers that suit a world.
#[derive(Clone, Copy)]
struct WorldNumbers {
    /// Height of the hand while it pushes, metres.
    push_z_m: f32,
    /// Lowest height of the hand at which it grasps, metres.
    grasp_z_m: f32,
    /// Height of the hand at which it carries an object over others, metres.
    carry_z_m: f32,
    /// Factor from the distance to a target to the displacement.
    gain: f32,
    /// Distance by which a push is aimed ahead of the hand, metres.
    push_m: f32,
    /// The same as a share of the distance to the goal, where that is less.
    push_share: f32,
    /// Distance behind the object at which the hand comes down, metres.
    behind_m: f32,
    /// Horizontal distance to that point from which it comes down, metres.
    descend_m: f32,
}

impl WorldNumbers {
    fn of(world: World) -> Self {
        match world {
            World::Classic | World::Slow => Self {
                push_z_m: 0.024,
                grasp_z_m: 0.0245,
                carry_z_m: 0.0,
                gain: 1.3,
                push_m: 0.022,
                push_share: 0.5,
                behind_m: 0.07,
                descend_m: 0.03,
            },
            World::Shared => Self {
                push_z_m: 0.033,
                grasp_z_m: 0.033,
                carry_z_m: 0.11,
                gain: 1.0,
                push_m: 0.040,
                push_share: 0.8,
                behind_m: 0.055,
                descend_m: 0.012,
            },
        }
    }
}

/// A point on the table's plane.
type Flat = [f32; 2];

impl Controller {
    pub(crate) fn new(task: Task) -> Self {
        Self { task, phase: Phase::Approach, world: WorldNumbers::of(task.world()) }
    }

    /// Whether the hand is at its object.
    pub(crate) fn is_at_work(&self) -> bool {
        matches!(self.phase, Phase::Grasp(_) | Phase::Bring)
    }

    /// Three displacements and the gripper's input.
    pub(crate) fn act(&mut self, observation: &[f32], goal: &[f32]) -> [f32; 4] {
        let hand = [observation[0], observation[1], observation[2]];
        let object = [observation[3], observation[4], observation[5]];
        if self.task.grasps() {
            self.pick_and_place(hand, object, goal)
        } else {
            self.push(hand, object, goal)
        }
    }

    fn pick_and_place(&mut self, hand: [f32; 3], object: [f32; 3], goal: &[f32]) -> [f32; 4] {
        let WorldNumbers { grasp_z_m, carry_z_m, gain, .. } = self.world;
        let grasp_z = object[2].max(grasp_z_m);
        let off = length(flat_between(hand, object));
        match self.phase {
            Phase::Approach => {
                if off < 0.008 {
                    self.phase = Phase::Descend;
                }
                let above = if off < 0.03 { 0.04 } else { 0.08 };
                towards(hand, [object[0], object[1], grasp_z + above], gain, 1.0)
            }
            Phase::Descend => {
                if (hand[2] - grasp_z).abs() < 0.006 {
                    self.phase = Phase::Grasp(0);
                }
                towards(hand, [object[0], object[1], grasp_z], gain, 1.0)
            }
            Phase::Grasp(n_steps) => {
                self.phase = if n_steps < 4 { Phase::Grasp(n_steps + 1) } else { Phase::Bring };
                [0.0, 0.0, 0.0, -1.0]
            }
            Phase::Bring | Phase::Leave => {
                if off > 0.05 || hand[2] > object[2] + 0.06 {
                    self.phase = Phase::Approach;
                }
                let mut target = std::array::from_fn(|axis| hand[axis] + goal[axis] - object[axis]);
                if length([goal[0] - object[0], goal[1] - object[1]]) > 0.05 {
                    target[2] = target[2].max(carry_z_m);
                }
                towards(hand, target, gain, -1.0)
            }
        }
    }

    fn push(&mut self, hand: [f32; 3], object: [f32; 3], goal: &[f32]) -> [f32; 4] {
        let to_goal = [goal[0] - object[0], goal[1] - object[1]];
        let distance_m = length(to_goal);
        let along = to_goal.map(|d| d / distance_m.max(1e-6));
        let behind = flat_between(object, hand);
        let advance_m = behind[0] * along[0] + behind[1] * along[1];
        let lateral = [behind[0] - along[0] * advance_m, behind[1] - along[1] * advance_m];
        if distance_m < 0.012 {
            self.phase = Phase::Leave;
        }
        match self.phase {
            Phase::Bring => {
                if advance_m > -0.012 || length(lateral) > 0.022 {
                    self.phase = Phase::Leave;
                }
                let WorldNumbers { push_z_m, gain, push_m, push_share, .. } = self.world;
                let ahead_m = (distance_m * push_share).clamp(0.005, push_m)
                    * (1.0 - length(lateral) / 0.03).max(0.25);
                let target = |axis: usize| hand[axis] + along[axis] * ahead_m - lateral[axis] * 0.4;
                towards(hand, [target(0), target(1), push_z_m], gain, 0.0)
            }
            Phase::Leave => self.leave(behind, distance_m),
            _ => self.move_behind(hand, object, along, behind),
        }
    }

    fn leave(&mut self, behind: Flat, distance_m: f32) -> [f32; 4] {
        let away_m = length(behind);
        if away_m > self.world.behind_m - 0.005 {
            if distance_m > 0.02 {
                self.phase = Phase::Approach;
            }
            return [0.0; 4];
        }
        [0.5 * behind[0] / away_m.max(1e-6), 0.5 * behind[1] / away_m.max(1e-6), 0.0, 0.0]
    }

    /// Moves over the object, never through it, to 7 cm behind it as seen from the goal.
    fn move_behind(
        &mut self,
        hand: [f32; 3],
        object: [f32; 3],
        along: Flat,
        behind: Flat,
    ) -> [f32; 4] {
        let WorldNumbers { push_z_m, gain, behind_m, descend_m, .. } = self.world;
        let target = [object[0] - along[0] * behind_m, object[1] - along[1] * behind_m];
        let off = length([target[0] - hand[0], target[1] - hand[1]]);
        if off < 0.012 && hand[2] < push_z_m + 0.012 {
            self.phase = Phase::Bring;
        }
        if off < descend_m {
            return towards(hand, [target[0], target[1], push_z_m], gain, 0.0);
        }
        if hand[2] >= 0.055 {
            return towards(hand, [target[0], target[1], 0.075], 1.15 * gain, 0.0);
        }
        let mut rise = towards(hand, [hand[0], hand[1], 0.075], 1.15 * gain, 0.0);
        let away_m = length(behind);
        if away_m < self.world.behind_m {
            rise[0] = 0.3 * behind[0] / away_m.max(1e-6);
            rise[1] = 0.3 * behind[1] / away_m.max(1e-6);
        }
        rise
    }
}

fn towards(hand: [f32; 3], target: [f32; 3], gain: f32, gripper: f32) -> [f32; 4] {
    let input = |axis: usize| ((target[axis] - hand[axis]) / ACTION_M * gain).clamp(-1.0, 1.0);
    [input(0), input(1), input(2), gripper]
}

fn flat_between(from: [f32; 3], to: [f32; 3]) -> Flat {
    [to[0] - from[0], to[1] - from[1]]
}

fn length(flat: Flat) -> f32 {
    flat[0].hypot(flat[1])
}
