//! Exploration in training episodes: Gaussian noise on every action, and random actions that are held for several
//! steps.
//!
//! A random action of one step hardly moves a hand. Held for several steps, it carries the hand, and objects with it,
//! to new places.

use rand_chacha::ChaCha8Rng;
use tandem_core::rng::{bernoulli, standard_normal, uniform};
use tandem_core::task::Part;
use tandem_core::{ArmIndex, Exploration, TaskSpec};

/// The exploration of one episode.
///
/// Every step draws the same number of random numbers, whether it uses them or not, so neither advice nor a held action
/// changes the draws of later steps.
#[derive(Debug, Clone)]
pub struct Explorer {
    task: TaskSpec,
    noise_std: f32,
    hold_mean_steps: f32,
    start_probability: f32,
    joint_random_actions: bool,
    held: Vec<HeldAction>,
    rng: ChaCha8Rng,
}

/// A random action of one arm, and the number of steps for which it is still held.
#[derive(Debug, Clone)]
struct HeldAction {
    n_steps_left: u32,
    action: Vec<f32>,
}

impl Explorer {
    /// Creates an explorer with these settings that draws from `rng`.
    #[must_use]
    pub fn new(task: impl Into<TaskSpec>, settings: Exploration, rng: ChaCha8Rng) -> Self {
        let task = task.into();
        let n_per_arm = task.action_of(ArmIndex(0)).len();
        let idle = HeldAction { n_steps_left: 0, action: vec![0.0; n_per_arm] };
        Self {
            noise_std: settings.noise_std,
            hold_mean_steps: settings.sticky_random_mean_steps,
            start_probability: start_probability(
                settings.random_action_prob,
                settings.sticky_random_mean_steps,
            ),
            joint_random_actions: settings.joint_random_actions,
            held: vec![idle; task.n_arms()],
            task,
            rng,
        }
    }

    /// Creates an explorer for a warm-up: every arm takes a random action on every step.
    #[must_use]
    pub fn uniform(task: impl Into<TaskSpec>, settings: Exploration, rng: ChaCha8Rng) -> Self {
        Self::new(task, Exploration { random_action_prob: 1.0, ..settings }, rng)
    }

    /// Turns the policy's action for the next step into the action to execute, shape `[n_action]`, in [-1, 1].
    ///
    /// # Panics
    /// If the action is too short.
    pub fn explore(&mut self, action: &mut [f32]) {
        self.explore_holding(action, |_arm| false);
    }

    /// As [`explore`](Self::explore). `holds` returns true for arms that hold an object; a random action never opens
    /// their grippers, because one such step drops an object.
    ///
    /// # Panics
    /// If the action is too short.
    pub fn explore_holding(&mut self, action: &mut [f32], holds: impl Fn(ArmIndex) -> bool) {
        let mut joint = None;
        for arm in self.task.arms() {
            let own = HoldDraw::new(&mut self.rng, self.start_probability, self.hold_mean_steps);
            let draw = *joint.get_or_insert(own);
            let draw = if self.joint_random_actions { draw } else { own };
            self.held[arm.0].advance(draw, &mut self.rng);
            let (part, held) = (self.task.action_of(arm), &self.held[arm.0]);
            explore_arm(part, held, self.noise_std, &mut self.rng, action);
            let gripper = self.task.gripper_of(arm).filter(|_| held.n_steps_left > 0);
            if let Some(gripper) = gripper
                && holds(arm)
            {
                action[gripper] = -action[gripper].abs();
            }
        }
    }
}

/// Adds noise to an arm's part of `action`, or replaces it by a held action.
fn explore_arm(
    part: &Part,
    held: &HeldAction,
    noise_std: f32,
    rng: &mut ChaCha8Rng,
    action: &mut [f32],
) {
    for idx in part.iter() {
        action[idx] = (action[idx] + noise_std * standard_normal(rng)).clamp(-1.0, 1.0);
    }
    if held.n_steps_left > 0 {
        part.write(action, &held.action);
    }
}

/// The draw that decides if a random action starts once the previous one is no longer held, and the number of steps
/// for which it is held.
#[derive(Debug, Clone, Copy)]
struct HoldDraw {
    starts: bool,
    n_steps: u32,
}

impl HoldDraw {
    fn new(rng: &mut ChaCha8Rng, start_probability: f32, hold_mean_steps: f32) -> Self {
        let starts = bernoulli(rng, start_probability);
        Self { starts, n_steps: hold_steps(uniform(rng, 0.0, 1.0), hold_mean_steps) }
    }
}

impl HeldAction {
    /// Advances by one step. A new action may start when the previous one is no longer held.
    fn advance(&mut self, HoldDraw { starts, n_steps }: HoldDraw, rng: &mut ChaCha8Rng) {
        let free = self.n_steps_left <= 1;
        self.n_steps_left = match (free, starts) {
            (true, true) => n_steps,
            (true, false) => 0,
            (false, _) => self.n_steps_left - 1,
        };
        for component in &mut self.action {
            let drawn = uniform(rng, -1.0, 1.0);
            if free && starts {
                *component = drawn;
            }
        }
    }
}

/// Returns the probability that a random action starts on a free step, such that `share` of all steps are random if
/// each action is held for `hold_mean_steps` steps on average.
fn start_probability(share: f32, hold_mean_steps: f32) -> f32 {
    share / (hold_mean_steps * (1.0 - share) + share)
}

/// Maps a draw in [0, 1) to a length of the given mean. With `n` = 2 × mean − 1, the lengths in `1..=n` are equally likely
/// if `n` is whole; else a share of draws, the fraction of `n`, has one more of them.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "rounds a number that is not negative down"
)]
fn hold_steps(draw: f32, mean_steps: f32) -> u32 {
    let n = 2.0 * mean_steps - 1.0;
    let longer_share = n.fract();
    let idx = match draw < longer_share {
        true => draw / longer_share * (n.floor() + 1.0),
        false => (draw - longer_share) / (1.0 - longer_share) * n.floor(),
    };
    (idx as u32).saturating_add(1)
}

#[cfg(test)]
mod tests {
    use tandem_core::layout::{Layout, Task};
    use tandem_core::rng::{Stream, episode_rng};

    use super::*;

    const LAYOUT: Layout = Layout::new(Task::Push, 2);
    const SETTINGS: Exploration =
        Exploration { random_action_prob: 0.3, sticky_random_mean_steps: 4.0, ..Exploration::NONE };
    /// The policy's action, which no random action equals.
    const POLICY_ACTION: [f32; 6] = [0.5; 6];

    fn is_random(action: &[f32; 3]) -> bool {
        action.iter().any(|component| *component != 0.5)
    }

    /// Returns the actions of arm `arm_idx` over one long episode.
    fn arm_actions(mut explorer: Explorer, n_steps: usize, arm_idx: usize) -> Vec<[f32; 3]> {
        let step = |_| {
            let mut action = POLICY_ACTION;
            explorer.explore(&mut action);
            [action[3 * arm_idx], action[3 * arm_idx + 1], action[3 * arm_idx + 2]]
        };
        (0..n_steps).map(step).collect()
    }

    fn rng(number: u64) -> ChaCha8Rng {
        episode_rng(3, number, Stream::Exploration)
    }

    #[test]
    fn random_actions_take_their_share_of_steps_and_are_held_as_long_as_configured() {
        for arm_idx in 0..2 {
            let actions = arm_actions(Explorer::new(LAYOUT, SETTINGS, rng(0)), 40_000, arm_idx);
            let n_random = actions.iter().filter(|action| is_random(action)).count();
            let holds: Vec<usize> = actions
                .chunk_by(|a, b| a == b)
                .filter(|run| is_random(&run[0]))
                .map(<[_]>::len)
                .collect();
            let mean_steps = n_random as f32 / holds.len() as f32;
            let share = n_random as f32 / actions.len() as f32;
            assert!((share - 0.3).abs() < 0.02, "share {share}");
            assert!((mean_steps - 4.0).abs() < 0.1, "mean hold {mean_steps}");
            assert_eq!((holds.iter().min(), holds.iter().max()), (Some(&1), Some(&7)));
        }
    }

    #[test]
    fn lengths_have_the_mean_that_is_set() {
        for mean_steps in [1.0, 1.2, 1.25, 1.5, 2.25, 3.3, 4.0, 49.9] {
            let n_draws = 100_000;
            let lengths = (0..n_draws).map(|i| hold_steps(i as f32 / n_draws as f32, mean_steps));
            let mean = lengths.map(f64::from).sum::<f64>() / f64::from(n_draws);
            let expected = f64::from(mean_steps);
            assert!((mean - expected).abs() < 1e-3 * expected, "{mean_steps}: {mean}");
        }
        let largest = 1.0_f32.next_down();
        assert_eq!([0.0, largest].map(|draw| hold_steps(draw, 4.0)), [1, 7]);
        assert_eq!([0.0, 0.399, 0.401, largest].map(|draw| hold_steps(draw, 1.2)), [1, 2, 1, 1]);
    }

    #[test]
    fn the_share_holds_within_episodes_of_fifty_steps() {
        let n_random: usize = (0..2_000)
            .flat_map(|number| arm_actions(Explorer::new(LAYOUT, SETTINGS, rng(number)), 50, 1))
            .filter(is_random)
            .count();
        let share = n_random as f32 / 100_000.0;
        assert!((share - 0.3).abs() < 0.02, "share {share}");
    }

    #[test]
    fn the_arms_draw_their_random_actions_independently() {
        let random_steps = |arm_idx| {
            let actions = arm_actions(Explorer::new(LAYOUT, SETTINGS, rng(0)), 2_000, arm_idx);
            actions.iter().map(is_random).collect::<Vec<_>>()
        };
        let both = random_steps(0)
            .iter()
            .zip(random_steps(1))
            .filter(|(first, second)| **first && *second)
            .count();
        assert!((120..240).contains(&both), "{both} of 2,000 steps, 180 expected when independent");
    }

    #[test]
    fn joint_random_actions_replace_all_arms_at_once_with_different_actions() {
        let settings = Exploration { joint_random_actions: true, ..SETTINGS };
        let actions =
            |arm_idx| arm_actions(Explorer::new(LAYOUT, settings, rng(0)), 5_000, arm_idx);
        let (first, second) = (actions(0), actions(1));
        assert!(first.iter().zip(&second).all(|(a, b)| is_random(a) == is_random(b)));
        assert!(first.iter().zip(&second).all(|(a, b)| !is_random(a) || a != b));
        let share = first.iter().filter(|action| is_random(action)).count() as f32 / 5_000.0;
        assert!((share - 0.3).abs() < 0.03, "share {share}");
        let alone = arm_actions(Explorer::new(LAYOUT, SETTINGS, rng(0)), 5_000, 0);
        assert_eq!(first, alone, "the first arm's draws are the same");
    }

    #[test]
    fn a_warm_up_takes_random_actions_only_and_no_share_takes_none() {
        let all_random = arm_actions(Explorer::uniform(LAYOUT, SETTINGS, rng(0)), 500, 0);
        assert!(all_random.iter().all(is_random));
        let none = Exploration { random_action_prob: 0.0, ..SETTINGS };
        let policy_only = arm_actions(Explorer::new(LAYOUT, none, rng(0)), 500, 0);
        assert!(!policy_only.iter().any(is_random));
    }

    #[test]
    fn noise_has_its_deviation_and_stays_within_bounds() {
        let settings = Exploration { noise_std: 0.2, ..Exploration::NONE };
        let actions = arm_actions(Explorer::new(LAYOUT, settings, rng(0)), 20_000, 0);
        let offsets: Vec<f32> = actions.iter().map(|action| action[0] - 0.5).collect();
        let std = (offsets.iter().map(|offset| offset * offset).sum::<f32>() / 20_000.0).sqrt();
        assert!((std - 0.2).abs() < 0.01, "deviation {std}");
        assert!(actions.iter().flatten().all(|component| (-1.0..=1.0).contains(component)));
    }

    #[test]
    fn random_actions_keep_a_gripper_closed_that_holds() {
        let carrying = Layout::new(Task::CarryBar, 2);
        let mut explorer = Explorer::uniform(carrying, SETTINGS, rng(0));
        let mut free = explorer.clone();
        let mut n_open = 0;
        for _ in 0..200 {
            let (mut holding, mut other) = ([0.5; 8], [0.5; 8]);
            explorer.explore_holding(&mut holding, |arm| arm.0 == 1);
            free.explore(&mut other);
            assert_eq!(holding[..7], other[..7], "nothing else differs");
            assert_eq!(holding[7], -other[7].abs());
            n_open += u32::from(other[7] > 0.0);
        }
        assert!(n_open > 50, "{n_open} of 200 random actions open a gripper that holds nothing");
    }

    #[test]
    fn the_executed_action_does_not_change_later_draws() {
        let settings = Exploration { noise_std: 0.2, ..SETTINGS };
        let mut undisturbed = Explorer::new(LAYOUT, settings, rng(0));
        let mut disturbed = undisturbed.clone();
        for _ in 0..30 {
            undisturbed.explore(&mut [0.0; 6]);
            disturbed.explore(&mut [-1.0; 6]);
        }
        let (mut here, mut there) = (POLICY_ACTION, POLICY_ACTION);
        undisturbed.explore(&mut here);
        disturbed.explore(&mut there);
        assert_eq!(here, there);
    }
}
