//! Errors of sensing and acting, with which an evaluation measures how robust a policy is.

use rand_chacha::ChaCha8Rng;
use tandem_core::rng::{standard_normal, uniform};
use tandem_core::{Layout, Stream, episode_rng};

use crate::ports::Act;

/// Errors between a policy and the simulated arms. They change what the policy perceives and when its actions take
/// effect; the episode that is recorded and judged contains the true state and the executed actions.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Perturbation {
    /// Standard deviation of the error of an object's observed position along each axis, drawn at every step, metres, 0
    /// or more.
    pub position_noise_m: f32,
    /// Horizontal distance between an arm's base and the place where it is believed to be, metres; the direction is
    /// drawn for each arm and episode. Positions of objects and goals, which a camera measures in the world frame, are
    /// wrong by this distance in the arm's frame. The hand's own position is not.
    pub base_offset_m: f32,
    /// Control steps by which actions take effect late. Until the first one does, the arms get actions of 0.
    pub delay_steps: usize,
}

/// An actor that perceives and acts with the errors of a [`Perturbation`], for one episode of a built-in task.
#[derive(Debug, Clone)]
pub struct PerturbedActor<A> {
    actor: A,
    layout: Layout,
    perturbation: Perturbation,
    rng: ChaCha8Rng,
    /// Errors of the positions of the arms' objects and goals in the whole episode, shape `[n_goal]`, arm frames, metres.
    offsets: Vec<f32>,
    /// Actions that have not taken effect, the oldest first.
    pending: Vec<Vec<f32>>,
}

impl<A> PerturbedActor<A> {
    /// Creates the actor for episode `number` of an evaluation with `seed`, which determine the errors.
    pub fn new(
        actor: A,
        layout: Layout,
        perturbation: Perturbation,
        seed: u64,
        number: u64,
    ) -> Self {
        // An evaluation does not explore, so this stream is free.
        let mut rng = episode_rng(seed, number, Stream::Exploration);
        let mut offsets = vec![0.0; layout.n_goal()];
        for arm in layout.arms() {
            let angle = uniform(&mut rng, -std::f32::consts::PI, std::f32::consts::PI);
            let offset = &mut offsets[layout.goal_of(arm)];
            let (sin, cos) = libm::sincosf(angle);
            offset[0] = perturbation.base_offset_m * cos;
            offset[1] = perturbation.base_offset_m * sin;
        }
        let pending = vec![vec![0.0; layout.n_action()]; perturbation.delay_steps];
        Self { actor, layout, perturbation, rng, offsets, pending }
    }

    /// Returns the observation and the goal as the policy perceives them.
    fn perceived(&mut self, observation: &[f32], goal: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let (mut observation, mut goal) = (observation.to_vec(), goal.to_vec());
        for (number, offset) in goal.iter_mut().zip(&self.offsets) {
            *number += offset;
        }
        for arm in self.layout.arms() {
            let part = &mut observation[self.layout.observation_of(arm)];
            for (axis, offset) in self.offsets[self.layout.goal_of(arm)].iter().enumerate() {
                let noise = self.perturbation.position_noise_m * standard_normal(&mut self.rng);
                // The object's position, and its position relative to the hand.
                for idx in [3 + axis, 6 + axis] {
                    part[idx] += offset + noise;
                }
            }
        }
        (observation, goal)
    }
}

impl<A: Act> Act for PerturbedActor<A> {
    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        let (n_observation, n_goal) = (self.layout.n_observation(), self.layout.n_goal());
        let rows = observations.chunks_exact(n_observation).zip(goals.chunks_exact(n_goal));
        for ((observation, goal), action) in
            rows.zip(actions.chunks_exact_mut(self.layout.n_action()))
        {
            let (observation, goal) = self.perceived(observation, goal);
            self.actor.act(&observation, &goal, action);
            if self.perturbation.delay_steps > 0 {
                self.pending.push(action.to_vec());
                action.copy_from_slice(&self.pending.remove(0));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::Task;

    use super::*;

    const LAYOUT: Layout = Layout::new(Task::Push, 2);

    /// Returns what it perceives: the object's position of the first arm in the first action, its position relative to
    /// the hand in the second.
    struct Echo;

    impl Act for Echo {
        fn act(&mut self, observations: &[f32], _goals: &[f32], actions: &mut [f32]) {
            actions.copy_from_slice(&observations[3..9]);
        }
    }

    fn acted(perturbation: Perturbation, number: u64, n_steps: usize) -> Vec<[f32; 6]> {
        let mut actor = PerturbedActor::new(Echo, LAYOUT, perturbation, 7, number);
        let step = |step_idx: usize| {
            let (mut observation, mut action) = ([0.0; 56], [0.0; 6]);
            observation[3..9].fill(step_idx as f32);
            actor.act(&observation, &[0.0; 6], &mut action);
            action
        };
        (0..n_steps).map(step).collect()
    }

    #[test]
    fn without_errors_the_actor_is_the_policy() {
        assert_eq!(acted(Perturbation::default(), 0, 3), [[0.0; 6], [1.0; 6], [2.0; 6]]);
    }

    #[test]
    fn late_actions_are_those_of_earlier_steps() {
        let late = Perturbation { delay_steps: 2, ..Perturbation::default() };
        assert_eq!(acted(late, 0, 5), [[0.0; 6], [0.0; 6], [0.0; 6], [1.0; 6], [2.0; 6]]);
    }

    #[test]
    fn noise_changes_with_each_step_and_is_that_of_the_object() {
        let noisy = Perturbation { position_noise_m: 0.01, ..Perturbation::default() };
        let steps = acted(noisy, 0, 2000);
        let errors: Vec<f32> = steps.iter().enumerate().map(|(t, a)| a[0] - t as f32).collect();
        for (step_idx, action) in steps.iter().enumerate().take(20) {
            assert_eq!(action[..3], action[3..], "step {step_idx}");
        }
        let variance = errors.iter().take(50).map(|error| error * error).sum::<f32>() / 50.0;
        assert!((0.006..0.014).contains(&variance.sqrt()), "{}", variance.sqrt());
        assert_ne!(errors[0], errors[1]);
        assert_eq!(acted(noisy, 0, 5), steps[..5], "the same episode has the same errors");
        assert_ne!(acted(noisy, 1, 5), steps[..5], "another episode has others");
    }

    #[test]
    fn a_base_is_wrong_by_the_same_distance_in_a_whole_episode() {
        let moved = Perturbation { base_offset_m: 0.02, ..Perturbation::default() };
        let [first, second] = acted(moved, 0, 2)[..] else { panic!("2 steps") };
        assert!((first[0].hypot(first[1]) - 0.02).abs() < 1e-6);
        assert_eq!(first[2], 0.0, "tables are level");
        assert!((0..6).all(|idx| (second[idx] - first[idx] - 1.0).abs() < 1e-6));
    }

    #[test]
    fn a_goal_moves_with_its_object() {
        let moved = Perturbation { base_offset_m: 0.02, ..Perturbation::default() };
        let mut actor = PerturbedActor::new(Echo, LAYOUT, moved, 7, 0);
        let (observation, goal) = actor.perceived(&[0.0; 56], &[0.0; 6]);
        assert_eq!(observation[3..6], goal[..3]);
        assert_eq!(observation[31..34], goal[3..]);
        assert_ne!(goal[..3], goal[3..], "each arm has an offset of its own");
    }
}
