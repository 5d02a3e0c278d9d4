//! Two scripted arms that carry a bar, or one of them while the other one waits.

use std::ops::Range;

use tandem_core::layout::{GOAL_TOLERANCE_M, HAND_POSITION, OBJECT_POSITION};
use tandem_core::reward::distance;
use tandem_core::rng::{standard_normal, uniform};
use tandem_core::{ArmIndex, Layout, Stream, Task, TaskSpec, WorldSettings, episode_rng};
use tandem_sim::{Env, WorldConfig};

use super::pair::{in_own_frame, in_world, part};
use super::towards;

const LAYOUT: Layout = Layout::new(Task::CarryBar, 2);
/// Range of the bar's orientation in an arm's observation.
const ORIENTATION: Range<usize> = 12..16;
/// Height above the handles at which the hands wait for each other before they descend, metres.
const ABOVE_M: f32 = 0.05;
/// Height to which the hands lift the bar before they carry it, metres.
const LIFT_M: f32 = 0.03;
/// Largest displacement and rotation of the bar per control step.
const STEP_M: f32 = 0.02;
const STEP_RAD: f32 = 0.0524;
/// Factor from the distance to a target to the displacement.
const GAIN: f32 = 1.3;
/// Where an arm waits that does not take part, arm frame, metres.
const PARKED_M: [f32; 3] = [-0.2, 0.2, 0.34];

/// The arms that take part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Carriers {
    Both,
    FirstOnly,
    SecondOnly,
}

/// The state of the bar after each control step.
#[derive(Clone, Copy)]
pub(crate) struct Moment {
    /// Largest distance of a handle from its goal, metres.
    pub(crate) miss_m: f32,
    /// Angle between the bar and the horizontal, radians.
    pub(crate) tilt_rad: f32,
    /// Both hands have pressed on the bar from both sides.
    pub(crate) is_held: bool,
    /// The task's description counts the state as a success.
    pub(crate) succeeds: bool,
}

impl Moment {
    /// Whether both handles are at their goals and the bar is level, whatever holds it.
    pub(crate) fn is_at_goal(self) -> bool {
        self.miss_m <= GOAL_TOLERANCE_M && self.tilt_rad < 10_f32.to_radians()
    }
}

/// A level pose of the bar, world frame, metres and radians.
#[derive(Clone, Copy)]
struct Pose {
    centre: [f32; 3],
    yaw_rad: f32,
}

#[derive(Clone, Copy)]
enum Phase {
    Above,
    Down,
    Close(u32),
    Carry(Pose),
}

/// How precisely the hands act.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Imprecision {
    /// Standard deviation of Gaussian noise on every action.
    pub(crate) noise_std: f32,
    /// Ranges of the hands' grips along x and z of the arm's frame, relative to the handle, metres.
    pub(crate) grips_m: [[f32; 2]; 2],
}

/// Plays `n_episodes`; returns what happened on every step of each.
pub(crate) fn carry(
    n_episodes: u64,
    carriers: Carriers,
    imprecision: Imprecision,
) -> Vec<Vec<Moment>> {
    let mut env = Env::new(LAYOUT, &WorldConfig::default()).expect("a valid world");
    let play = |episode| {
        env.reset(&mut episode_rng(21, episode, Stream::Reset), WorldSettings::default());
        let mut noise = episode_rng(21, episode, Stream::Exploration);
        let grips = [0, 1].map(|_| {
            let [x, z] = imprecision.grips_m.map(|[low, high]| uniform(&mut noise, low, high));
            [x, 0.0, z]
        });
        let mut observation = vec![0.0; LAYOUT.n_observation()];
        let mut action = vec![0.0; LAYOUT.n_action()];
        let mut phase = Phase::Above;
        env.observe(&mut observation);
        let step = |_| {
            phase = act((phase, grips), &observation, env.goal(), carriers, &mut action);
            let noisy = action
                .iter()
                .map(|input| input + imprecision.noise_std * standard_normal(&mut noise));
            env.step(&noisy.collect::<Vec<f32>>()).expect("a finite step");
            env.observe(&mut observation);
            moment(&env, &observation)
        };
        (0..LAYOUT.description().episode_steps).map(step).collect()
    };
    (0..n_episodes).map(play).collect()
}

/// Describes the state after a control step.
pub(crate) fn moment(env: &Env, observation: &[f32]) -> Moment {
    let goal = env.goal();
    let of = |arm: ArmIndex, range: Range<usize>| part(observation, arm.0)[range].to_vec();
    let miss_m = |arm: ArmIndex| distance(&of(arm, OBJECT_POSITION), &goal[LAYOUT.goal_of(arm)]);
    let orientation = of(ArmIndex(0), ORIENTATION);
    Moment {
        miss_m: LAYOUT.arms().map(miss_m).fold(0.0, f32::max),
        tilt_rad: 2.0 * orientation[0].hypot(orientation[1]).min(1.0).asin(),
        is_held: LAYOUT.arms().all(|arm| env.is_gripping(arm)),
        succeeds: TaskSpec::from(LAYOUT).is_success(observation, goal),
    }
}

/// Writes the action of this step and returns the next phase.
fn act(
    (phase, grips): (Phase, [[f32; 3]; 2]),
    observation: &[f32],
    goal: &[f32],
    carriers: Carriers,
    action: &mut [f32],
) -> Phase {
    let active = |arm: usize| match carriers {
        Carriers::Both => true,
        Carriers::FirstOnly => arm == 0,
        Carriers::SecondOnly => arm == 1,
    };
    let hands = [0, 1].map(|arm| point(&part(observation, arm)[HAND_POSITION]));
    let handles = [0, 1].map(|arm| point(&part(observation, arm)[OBJECT_POSITION]));
    let grip = |arm: usize| [0, 1, 2].map(|axis| handles[arm][axis] + grips[arm][axis]);
    let is_ready = |above_m: f32, within_m: f32| {
        (0..2).filter(|arm| active(*arm)).all(|arm| {
            let [x, y, z] = grip(arm);
            distance(&hands[arm], &[x, y, z.max(0.0225) + above_m]) < within_m
        })
    };
    let mut target = |arm: usize, at: [f32; 3], gripper: f32| {
        let inputs = if active(arm) {
            towards(hands[arm], at, GAIN, gripper)
        } else {
            towards(hands[arm], PARKED_M, GAIN, 1.0)
        };
        action[4 * arm..4 * arm + 4].copy_from_slice(&inputs);
    };
    let above = |arm: usize, above_m: f32| {
        let [x, y, z] = grip(arm);
        [x, y, z + above_m]
    };
    match phase {
        Phase::Above => {
            [0, 1].into_iter().for_each(|arm| target(arm, above(arm, ABOVE_M), 1.0));
            if is_ready(ABOVE_M, 0.008) { Phase::Down } else { phase }
        }
        Phase::Down => {
            [0, 1].into_iter().for_each(|arm| target(arm, above(arm, 0.0), 1.0));
            if is_ready(0.0, 0.006) { Phase::Close(0) } else { phase }
        }
        Phase::Close(n_steps) => {
            [0, 1].into_iter().for_each(|arm| target(arm, hands[arm], -1.0));
            let pose = Pose::between(handles);
            let [x, y, z] = pose.centre;
            let lifted = Pose { centre: [x, y, z + LIFT_M], ..pose };
            if n_steps < 1 { Phase::Close(n_steps + 1) } else { Phase::Carry(lifted) }
        }
        Phase::Carry(pose) => {
            for arm in [0, 1] {
                let handle = pose.handle(arm);
                let at = [0, 1, 2].map(|axis| hands[arm][axis] + handle[axis] - handles[arm][axis]);
                target(arm, at, -1.0);
            }
            Phase::Carry(pose.advanced(Pose::between([0, 1].map(|arm| point(&goal[3 * arm..])))))
        }
    }
}

fn point(numbers: &[f32]) -> [f32; 3] {
    [numbers[0], numbers[1], numbers[2]]
}

impl Pose {
    /// The pose of the bar with these handles, arm frames.
    fn between(handles: [[f32; 3]; 2]) -> Self {
        let [first, second] = [0, 1].map(|arm| in_world(arm, handles[arm]));
        let centre = [0, 1, 2].map(|axis| 0.5 * (first[axis] + second[axis]));
        Self { centre, yaw_rad: (second[1] - first[1]).atan2(second[0] - first[0]) }
    }

    /// The handle of `arm`, arm frame.
    fn handle(self, arm: usize) -> [f32; 3] {
        let side = if arm == 0 { -0.16 } else { 0.16 };
        let [x, y, z] = self.centre;
        in_own_frame(arm, [x + side * self.yaw_rad.cos(), y + side * self.yaw_rad.sin(), z])
    }

    /// The pose one step closer to `goal`.
    fn advanced(self, goal: Self) -> Self {
        let share = (STEP_M / distance(&self.centre, &goal.centre).max(1e-6)).min(1.0);
        let at = |axis: usize| self.centre[axis] + share * (goal.centre[axis] - self.centre[axis]);
        let turn_rad = (goal.yaw_rad - self.yaw_rad).clamp(-STEP_RAD, STEP_RAD);
        Self { centre: [at(0), at(1), at(2)], yaw_rad: self.yaw_rad + turn_rad }
    }
}
