//! Observations and goals stay within the bounds that the learner accepts, for any behaviour of the arms.

use std::ops::Range;

use rand_chacha::ChaCha8Rng;
use tandem_core::layout::{EPISODE_STEPS, OBSERVATION_PER_ARM};
use tandem_core::rng::{bernoulli, index, uniform};
use tandem_core::{Layout, Stream, Task, WorldSettings, episode_rng};
use tandem_sim::{Env, WorldConfig};

/// Smallest ratio of a bound to the largest observed magnitude.
const MARGIN: f32 = 4.0;
/// Range of the object's orientation in an arm's observation.
const ORIENTATION: Range<usize> = 12..16;

/// Extreme behaviours.
#[derive(Clone, Copy)]
enum Behaviour {
    /// Full speed in a random direction that changes now and then.
    Flail,
    /// Full speed at the arm's own object, opening and closing the gripper.
    Smash,
    /// Full speed towards the other arm's object.
    Raid,
    /// Presses on the object and moves sideways.
    Squeeze,
    /// Grasps the object, swings it and lets go.
    Throw,
}

const BEHAVIOURS: [Behaviour; 5] =
    [Behaviour::Flail, Behaviour::Smash, Behaviour::Raid, Behaviour::Squeeze, Behaviour::Throw];

struct RoughArm {
    behaviour: Behaviour,
    push: [f32; 4],
    release_at: usize,
}

impl RoughArm {
    fn new(rng: &mut ChaCha8Rng) -> Self {
        let behaviour = BEHAVIOURS[index(rng, BEHAVIOURS.len())];
        Self { behaviour, push: corner(rng), release_at: 5 + index(rng, EPISODE_STEPS - 5) }
    }

    /// The next action for the arm's observation.
    fn act(&mut self, rng: &mut ChaCha8Rng, step_idx: usize, observed: &[f32]) -> [f32; 4] {
        if bernoulli(rng, 0.2) {
            self.push = corner(rng);
        }
        let to_object = [observed[6], observed[7], observed[8]]
            .map(|offset_m| (40.0 * offset_m).clamp(-1.0, 1.0));
        let [x, y, z, grip] = self.push;
        match self.behaviour {
            Behaviour::Flail => self.push,
            Behaviour::Smash => [to_object[0], to_object[1], to_object[2], grip],
            Behaviour::Raid => [1.0, y, -1.0, grip],
            Behaviour::Squeeze if to_object[0].abs() + to_object[1].abs() > 0.5 => {
                [to_object[0], to_object[1], 1.0, -1.0]
            }
            Behaviour::Squeeze => [0.3 * x, 0.3 * y, -1.0, -1.0],
            Behaviour::Throw if step_idx < self.release_at => [x, y, z, -1.0],
            Behaviour::Throw => [x, y, z, 1.0],
        }
    }
}

/// A random corner of the action space.
fn corner(rng: &mut ChaCha8Rng) -> [f32; 4] {
    [0; 4].map(|_| if uniform(rng, -1.0, 1.0) < 0.0 { -1.0 } else { 1.0 })
}

/// The largest magnitude of each number of an arm's observation, and of a goal.
struct Largest {
    observation: [f32; OBSERVATION_PER_ARM],
    goal: f32,
}

fn update(largest: &mut Largest, observation: &[f32], goal: &[f32]) {
    for arm in observation.chunks(OBSERVATION_PER_ARM) {
        for (most, value) in largest.observation.iter_mut().zip(arm) {
            *most = most.max(value.abs());
        }
    }
    largest.goal = goal.iter().fold(largest.goal, |most, value| most.max(value.abs()));
}

fn play(layout: Layout, substeps: u32, n_episodes: u64) -> Largest {
    let config = WorldConfig { substeps, ..WorldConfig::default() };
    let mut env = Env::new(layout, &config).expect("a valid world");
    let mut largest = Largest { observation: [0.0; OBSERVATION_PER_ARM], goal: 0.0 };
    let mut observation = vec![0.0; layout.n_observation()];
    let mut action = vec![0.0; layout.n_action()];
    for episode in 0..n_episodes {
        let mut rng = episode_rng(5, episode, Stream::Exploration);
        let settings = WorldSettings {
            grasped_start_prob: 0.5,
            substeps,
            randomization: 1.0,
            ..WorldSettings::default()
        };
        env.reset(&mut episode_rng(5, episode, Stream::Reset), settings);
        let mut arms: Vec<RoughArm> = layout.arms().map(|_| RoughArm::new(&mut rng)).collect();
        for step_idx in 0..=EPISODE_STEPS {
            env.observe(&mut observation);
            update(&mut largest, &observation, env.goal());
            for (arm, arm_controller) in layout.arms().zip(&mut arms) {
                let inputs = arm_controller.act(
                    &mut rng,
                    step_idx,
                    &observation[layout.observation_of(arm)],
                );
                let part = &mut action[layout.action_of(arm)];
                part.copy_from_slice(&inputs[..part.len()]);
            }
            env.step(&action).expect("a finite step");
        }
    }
    largest
}

#[test]
fn no_behaviour_brings_a_number_near_its_bound() {
    check_bounds(6);
}

#[test]
#[ignore = "half a minute"]
fn no_behaviour_brings_a_number_near_its_bound_in_a_hundred_episodes() {
    check_bounds(100);
}

#[expect(clippy::print_stdout, reason = "shown with --nocapture")]
fn check_bounds(n_episodes: u64) {
    for task in Task::ALL {
        let layouts = [(1, 20), (2, 20), (2, 10)];
        for (n_arms, substeps) in layouts.into_iter().filter(|(n, _)| *n >= task.min_arms()) {
            let layout = Layout::new(task, n_arms);
            // A step of a bar takes as long as ten of other tasks.
            let n_episodes = if task.shares_object() { n_episodes.div_ceil(8) } else { n_episodes };
            let largest = play(layout, substeps, n_episodes);
            for (idx, most) in largest.observation.into_iter().enumerate() {
                // The components of a unit quaternion reach their bound of 1, up to rounding.
                let margin = if ORIENTATION.contains(&idx) { 1.0 } else { MARGIN };
                let bound = layout.observation_bound(idx);
                println!("{task}, arms {n_arms}, number {idx}: {most} of {bound}");
                assert!(margin * most <= bound, "number {idx}: {most}, bound {bound}");
            }
            assert!(MARGIN * largest.goal <= layout.goal_bound(), "goal: {}", largest.goal);
        }
    }
}
