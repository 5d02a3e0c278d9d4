//! Hindsight goals (Andrychowicz et al. 2017, strategy "future"): a goal that the episode achieved later replaces the
//! desired one.

use rand_chacha::ChaCha8Rng;
use tandem_core::rng::{bernoulli, index};
use tandem_core::{Episode, TaskSpec};

use super::ReplayConfig;

/// Samples the later step whose achieved goal replaces the desired goal on step `step_idx` of an episode; `None` keeps
/// the desired goal. `observation` returns the episode's observation before a step, shape `[n_observation]`.
///
/// It always draws two numbers.
pub(super) fn sample_later_step<'a>(
    config: &ReplayConfig,
    task: &TaskSpec,
    observation: impl Fn(usize) -> &'a [f32],
    step_idx: usize,
    rng: &mut ChaCha8Rng,
) -> Option<usize> {
    let has_hindsight = bernoulli(rng, config.her_ratio);
    let later_step = step_idx + 1 + index(rng, task.episode_steps() - step_idx);
    let is_goal =
        !config.displaced_hindsight || task.is_displaced(observation(0), observation(later_step));
    (has_hindsight && is_goal).then_some(later_step)
}

/// Returns the goal of step `step_idx` of an episode, relabelled as in a batch, shape `[n_goal]`.
pub(crate) fn relabelled_goal(
    config: &ReplayConfig,
    task: &TaskSpec,
    episode: &Episode,
    step_idx: usize,
    rng: &mut ChaCha8Rng,
) -> Vec<f32> {
    let mut goal = episode.goal.clone();
    let observation = |step_idx| episode.observation(step_idx);
    let mut sample = || sample_later_step(config, task, observation, step_idx, rng);
    let joint = (config.joint_goal_statistics || task.shares_object()).then(&mut sample);
    for arm in task.arms() {
        let Some(later_step) = joint.unwrap_or_else(&mut sample) else { continue };
        let achieved = episode.observation(later_step);
        task.goal_of(arm).copy_from(&mut goal, task.achieved_goal_of(arm), achieved);
        if arm.0 == 0 {
            task.common_goal().copy_from(&mut goal, task.common_achieved_goal(), achieved);
        }
    }
    goal
}
