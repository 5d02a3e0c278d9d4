//! Checks that environments are deterministic: some episodes are played twice.

use std::fmt;

use tandem_core::work::{RunTerms, SlotOrder};
use tandem_core::{Contacts, Episode, EpisodeKind, TaskSpec};

use crate::ports::{EnvironmentError, VectorEnv};
use crate::rollout::episode_starts;

/// One in this many training episodes is played twice.
pub const CHECKED_ONE_IN: u64 = 100;

/// The result of playing a slot twice.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DeterminismCheck {
    /// The number of episodes that were played twice.
    pub n_episodes: u32,
    /// The first difference, if there is one.
    pub difference: Option<Difference>,
}

/// The first number of an episode that differs when the episode is played again.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Difference {
    /// The episode's number.
    pub episode: u64,
    /// The number of steps before the number was observed; 0 is the start.
    pub step: usize,
    /// The vector that differs.
    pub field: &'static str,
    /// The index within the vector.
    pub component: usize,
    /// The value at first.
    pub first: f32,
    /// The value when the episode was played again.
    pub second: f32,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { episode, step, field, component, first, second } = self;
        let size = (first - second).abs();
        write!(
            f,
            "episode {episode}, played twice with the same seed and actions, differs after step {step}: \
             {field}[{component}] is {first:e}, then {second:e}, a difference of {size:e}"
        )
    }
}

/// Returns true if the episodes of a slot are played twice.
///
/// The choice depends on the numbers of the episodes, so it does not depend on the worker.
#[must_use]
pub fn is_checked(order: &SlotOrder) -> bool {
    let period = CHECKED_ONE_IN * order.episodes.len() as u64;
    order.kind == EpisodeKind::Training
        && order.episodes.iter().any(|episode| episode.number.is_multiple_of(period))
}

/// Plays `episodes`, those of `order`, again with the same seeds and actions and compares every number, bit for bit.
///
/// # Errors
/// When the environments can no longer be used.
pub fn check(
    env: &mut impl VectorEnv,
    order: &SlotOrder,
    terms: &RunTerms,
    episodes: &[Episode],
) -> Result<DeterminismCheck, EnvironmentError> {
    let n_episodes = u32::try_from(episodes.len()).unwrap_or(u32::MAX);
    let difference = replay(env, order, terms, episodes)?;
    Ok(DeterminismCheck { n_episodes, difference })
}

fn replay(
    env: &mut impl VectorEnv,
    order: &SlotOrder,
    terms: &RunTerms,
    episodes: &[Episode],
) -> Result<Option<Difference>, EnvironmentError> {
    let task = &terms.task;
    let mut observations = vec![0.0; episodes.len() * task.n_observation()];
    let mut goals = vec![0.0; episodes.len() * task.n_goal()];
    env.reset(&episode_starts(order, terms), &mut observations, &mut goals)?;
    for (episode, goal) in episodes.iter().zip(goals.chunks_exact(task.n_goal())) {
        let difference = first_difference((episode, 0, "goal"), &episode.goal, goal);
        if difference.is_some() {
            return Ok(difference);
        }
    }
    let mut contacts = vec![Contacts::NONE; episodes.len()];
    let n_steps = episodes.iter().map(|episode| episode.contacts.len()).min().unwrap_or_default();
    for step in 0..=n_steps {
        let difference = observed_difference(task, episodes, step, &observations);
        if difference.is_some() || step == n_steps {
            return Ok(difference);
        }
        let actions: Vec<f32> =
            episodes.iter().flat_map(|episode| episode.action(step)).copied().collect();
        env.step(&actions, &mut observations, &mut contacts)?;
        for (episode, contacts) in episodes.iter().zip(&contacts) {
            let [first, second] = [episode.contacts[step], *contacts].map(|it| [it.bits().into()]);
            let difference = first_difference((episode, step + 1, "contacts"), &first, &second);
            if difference.is_some() {
                return Ok(difference);
            }
        }
    }
    Ok(None)
}

/// Compares the observations of all episodes after `step` steps, shape `[n, n_observation]`.
fn observed_difference(
    task: &TaskSpec,
    episodes: &[Episode],
    step: usize,
    observations: &[f32],
) -> Option<Difference> {
    let rows = episodes.iter().zip(observations.chunks_exact(task.n_observation()));
    rows.filter_map(|(episode, second)| {
        first_difference((episode, step, "observation"), episode.observation(step), second)
    })
    .next()
}

fn first_difference(
    (episode, step, field): (&Episode, usize, &'static str),
    first: &[f32],
    second: &[f32],
) -> Option<Difference> {
    let mut pairs = first.iter().zip(second).enumerate();
    let (component, (first, second)) =
        pairs.find(|(_, (first, second))| first.to_bits() != second.to_bits())?;
    let episode = episode.number;
    Some(Difference { episode, step, field, component, first: *first, second: *second })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fakes::{FakeActor, FakeEnvironment, slot, terms};
    use crate::ports::NoAdvisor;
    use crate::rollout::play_slot;

    fn checked(drift: f32) -> DeterminismCheck {
        let mut env = FakeEnvironment::drifting(drift);
        let (order, terms) = (slot(&[3, 8], false), terms());
        let actor = &mut FakeActor::Seeker;
        let episodes =
            play_slot(&mut env, &order, &terms, actor, &mut NoAdvisor).expect("no step fails");
        check(&mut env, &order, &terms, &episodes).expect("no step fails")
    }

    #[test]
    fn an_environment_that_repeats_its_episodes_passes() {
        assert_eq!(checked(0.0), DeterminismCheck { n_episodes: 2, difference: None });
    }

    #[test]
    fn the_first_difference_is_named_with_its_size() {
        let difference = checked(0.5).difference.expect("the second time drifts");
        let Difference { episode, step, field, component, first, second } = difference;
        assert_eq!((episode, step, field, component), (3, 0, "observation", 0));
        assert_eq!(second, first + 0.5);
        assert!(difference.to_string().ends_with("a difference of 5e-1"), "{difference}");
    }

    #[test]
    fn one_training_episode_of_a_hundred_is_checked() {
        for n_together in [1, 2, 8] {
            let slots = (0..800 / n_together).map(|idx| {
                let numbers: Vec<u64> = (idx * n_together..(idx + 1) * n_together).collect();
                slot(&numbers, false)
            });
            let n_checked: usize = slots.filter(is_checked).map(|it| it.episodes.len()).sum();
            assert_eq!(n_checked, 8, "{n_together} episodes per slot");
        }
        let evaluation = SlotOrder { kind: EpisodeKind::Evaluation, ..slot(&[0], false) };
        assert!(!is_checked(&evaluation));
    }
}
