//! No number of an observation or a goal leaves the bounds that the learner accepts, whatever the arms do.

use std::ops::Range;

use rand_chacha::ChaCha8Rng;
use tandem_core::layout::{EPISODE_STEPS, OBSERVATION_PER_ARM};
use tandem_core::rng::{coin, index, uniform};
use tandem_core::{Layout, Stream, Task, WorldSettings, episode_rng};
use tandem_sim::{Env, WorldConfig};

/// Episodes of each layout.
const N_EPISODES: u64 = 100;

/// How many times larger than anything seen a bound must be.
const MARGIN: f32 = 4.0;
/// Where an object's orientation stands in an arm's observation.
const ORIENTATION: Range<usize> = 12..16;

/// Ways to be rough.
#[derive(Clone, Copy)]
enum Plan {
    /// Full speed in a random direction, another one now and then.
    Flail,
    /// Full speed at the arm's own object, jaws snapping.
    Smash,
    /// Full speed at the other arm's object, or where it would be.
    Raid,
    /// Down on the object and to the side.
    Squeeze,
    /// Hold on to the object and swing it, then let go.
    Throw,
}

const PLANS: [Plan; 5] = [Plan::Flail, Plan::Smash, Plan::Raid, Plan::Squeeze, Plan::Throw];

struct Rowdy {
    plan: Plan,
    push: [f32; 4],
    release_at: usize,
}

impl Rowdy {
    fn new(rng: &mut ChaCha8Rng) -> Self {
        let plan = PLANS[index(rng, PLANS.len())];
        Self { plan, push: corner(rng), release_at: 5 + index(rng, EPISODE_STEPS - 5) }
    }

    /// The next action, from what the arm sees.
    fn act(&mut self, rng: &mut ChaCha8Rng, step_idx: usize, seen: &[f32]) -> [f32; 4] {
        if coin(rng, 0.2) {
            self.push = corner(rng);
        }
        let to_object =
            [seen[6], seen[7], seen[8]].map(|offset_m| (40.0 * offset_m).clamp(-1.0, 1.0));
        let [x, y, z, grip] = self.push;
        match self.plan {
            Plan::Flail => self.push,
            Plan::Smash => [to_object[0], to_object[1], to_object[2], grip],
            Plan::Raid => [1.0, y, -1.0, grip],
            Plan::Squeeze if to_object[0].abs() + to_object[1].abs() > 0.5 => {
                [to_object[0], to_object[1], 1.0, -1.0]
            }
            Plan::Squeeze => [0.3 * x, 0.3 * y, -1.0, -1.0],
            Plan::Throw if step_idx < self.release_at => [x, y, z, -1.0],
            Plan::Throw => [x, y, z, 1.0],
        }
    }
}

/// A random corner of the actions' range.
fn corner(rng: &mut ChaCha8Rng) -> [f32; 4] {
    [0; 4].map(|_| if uniform(rng, -1.0, 1.0) < 0.0 { -1.0 } else { 1.0 })
}

/// The largest magnitude of each number of an arm's observation, and of a goal.
struct Largest {
    observation: [f32; OBSERVATION_PER_ARM],
    goal: f32,
}

fn note(largest: &mut Largest, observation: &[f32], goal: &[f32]) {
    for arm in observation.chunks(OBSERVATION_PER_ARM) {
        for (most, value) in largest.observation.iter_mut().zip(arm) {
            *most = most.max(value.abs());
        }
    }
    largest.goal = goal.iter().fold(largest.goal, |most, value| most.max(value.abs()));
}

fn play(layout: Layout, substeps: u32) -> Largest {
    let config = WorldConfig { substeps, ..WorldConfig::default() };
    let mut env = Env::new(layout, &config).expect("a valid world");
    let mut largest = Largest { observation: [0.0; OBSERVATION_PER_ARM], goal: 0.0 };
    let mut observation = vec![0.0; layout.n_observation()];
    let mut action = vec![0.0; layout.n_action()];
    for episode in 0..N_EPISODES {
        let mut rng = episode_rng(5, episode, Stream::Exploration);
        let settings = WorldSettings { grasped_start_prob: 0.5, substeps };
        env.reset(&mut episode_rng(5, episode, Stream::Reset), settings);
        let mut arms: Vec<Rowdy> = layout.arms().map(|_| Rowdy::new(&mut rng)).collect();
        for step_idx in 0..=EPISODE_STEPS {
            env.observe(&mut observation);
            note(&mut largest, &observation, env.goal());
            for (arm, rowdy) in layout.arms().zip(&mut arms) {
                let inputs =
                    rowdy.act(&mut rng, step_idx, &observation[layout.observation_of(arm)]);
                let part = &mut action[layout.action_of(arm)];
                part.copy_from_slice(&inputs[..part.len()]);
            }
            env.step(&action).expect("a finite step");
        }
    }
    largest
}

#[test]
fn whatever_the_arms_do_no_number_comes_near_its_bound() {
    for task in Task::ALL {
        for (n_arms, substeps) in [(1, 20), (2, 20), (2, 10)] {
            let layout = Layout::new(task, n_arms);
            let largest = play(layout, substeps);
            for (idx, most) in largest.observation.into_iter().enumerate() {
                // A unit quaternion has no room to spare: its numbers are 1 at most, but for rounding.
                let margin = if ORIENTATION.contains(&idx) { 1.0 } else { MARGIN };
                let bound = layout.largest_observation(idx);
                println!("{task}, {n_arms} arm(s), number {idx}: {most} of {bound}");
                assert!(margin * most <= bound, "number {idx}: {most}, bound {bound}");
            }
            assert!(MARGIN * largest.goal <= layout.largest_goal(), "goal: {}", largest.goal);
        }
    }
}
