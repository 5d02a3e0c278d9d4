//! Evaluation of a policy on a fixed set of episodes, without exploration or advice: in this process on any number of
//! threads, or in the environments of a server.

mod served;

use std::num::NonZeroUsize;
use std::ops::Range;

use tandem_core::layout::Layout;
use tandem_core::work::{EpisodeExploration, EpisodeOrder, RunTerms, SlotOrder};
use tandem_core::{AdviceTerms, Episode, EpisodeKind, Exploration, TaskSpec, WorldSettings};
use tandem_sim::{Env, WorldConfig};

use crate::ports::{Act, NoAdvisor, Simulator, VectorEnv};
use crate::rollout::{RolloutError, play_slot};

pub use served::evaluate_served;

/// The composed teachers `f^a(π_tr(ŝ_1), π_tr(ŝ_2))`: a policy for one arm that acts for every arm of a task.
///
/// A row of the task consists of `n_arms` rows of the policy: the parts of its arms, in arm order.
#[derive(Debug, Clone)]
pub struct ComposedTeachers<A> {
    actor: A,
    task: TaskSpec,
}

impl<A: Act> ComposedTeachers<A> {
    /// Composes `actor`, a policy for [one arm](TaskSpec::single_arm) of `task`.
    pub fn new(actor: A, task: impl Into<TaskSpec>) -> Self {
        Self { actor, task: task.into() }
    }
}

impl<A: Act> Act for ComposedTeachers<A> {
    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        let task = &self.task;
        if task.as_built_in().is_some() {
            // The vectors of a built-in task are in arm order.
            return self.actor.act(observations, goals, actions);
        }
        let observations = observations.chunks_exact(task.n_observation());
        let states = observations.zip(goals.chunks_exact(task.n_goal()));
        for ((observation, goal), action) in states.zip(actions.chunks_exact_mut(task.n_action())) {
            let observation = task.observation_in_arm_order(observation);
            let goal = task.goal_in_arm_order(goal);
            let mut in_arm_order = vec![0.0; task.n_action()];
            self.actor.act(&observation, &goal, &mut in_arm_order);
            task.write_action_in_arm_order(&in_arm_order, action);
        }
    }
}

/// An evaluation in simulated worlds of this process.
#[derive(Debug, Clone)]
pub struct Evaluation<'a> {
    /// The task, with one or two arms.
    pub layout: Layout,
    /// The world.
    pub world: &'a WorldConfig,
    /// The seed of the episodes' starts and goals.
    pub seed: u64,
    /// The numbers of the episodes.
    pub numbers: Range<u64>,
    /// The number of threads, each of which has a world of its own. The result does not depend on it.
    pub n_threads: NonZeroUsize,
}

impl Evaluation<'_> {
    /// Plays every episode with an actor of its own, that of its number, and returns the episodes in order.
    ///
    /// # Errors
    /// When the world cannot be built or a step fails.
    pub fn run<A: Act>(
        &self,
        make_actor: impl Fn(u64) -> A + Sync,
    ) -> Result<Vec<Episode>, RolloutError> {
        let env = Env::new(self.layout, self.world).map_err(RolloutError::NoEnvironment)?;
        self.run_in(&Simulator::new(env), make_actor)
    }

    /// Plays the episodes in copies of `env`.
    fn run_in<E: VectorEnv + Clone + Sync, A: Act>(
        &self,
        env: &E,
        make_actor: impl Fn(u64) -> A + Sync,
    ) -> Result<Vec<Episode>, RolloutError> {
        let terms = evaluation_terms(self.layout);
        let numbers: Vec<u64> = self.numbers.clone().collect();
        let n_per_thread = numbers.len().div_ceil(self.n_threads.get()).max(1);
        let play = |numbers: &[u64]| {
            let mut env = env.clone();
            let play_one = |number: &u64| {
                play_alone(&mut env, &mut make_actor(*number), &terms, self.seed, *number)
            };
            numbers.iter().map(play_one).collect::<Result<Vec<Episode>, RolloutError>>()
        };
        let parts: Vec<_> = std::thread::scope(|scope| {
            let threads: Vec<_> =
                numbers.chunks(n_per_thread).map(|part| scope.spawn(|| play(part))).collect();
            threads
                .into_iter()
                .map(|thread| thread.join().expect("a panicking rollout is a bug"))
                .collect()
        });
        let parts = parts.into_iter().collect::<Result<Vec<_>, _>>()?;
        Ok(parts.into_iter().flatten().collect())
    }
}

fn play_alone(
    env: &mut impl VectorEnv,
    actor: &mut impl Act,
    terms: &RunTerms,
    seed: u64,
    number: u64,
) -> Result<Episode, RolloutError> {
    let mut episodes = play_slot(env, &slot_of([number], seed), terms, actor, &mut NoAdvisor)?;
    Ok(episodes.remove(0))
}

/// Returns the order to play evaluation episodes with these numbers.
fn slot_of(numbers: impl IntoIterator<Item = u64>, seed: u64) -> SlotOrder {
    let order = |number| EpisodeOrder {
        number,
        seed,
        advised: false,
        exploration: EpisodeExploration::Noise,
        record: false,
        advised_steps: None,
    };
    SlotOrder {
        slot: 0,
        parameter_version: 0,
        kind: EpisodeKind::Evaluation,
        episodes: numbers.into_iter().map(order).collect(),
    }
}

/// Returns terms for evaluations, which use only the task: the world is built already.
fn evaluation_terms(task: impl Into<TaskSpec>) -> RunTerms {
    RunTerms {
        run: String::new(),
        task: task.into(),
        account: None,
        advice: AdviceTerms::default(),
        exploration: Exploration::NONE,
        world: WorldSettings::default(),
        symmetrized_evaluation: false,
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::TaskDescription;
    use tandem_core::task::ArmDescription;

    use super::*;
    use crate::fakes::{FakeActor, FakeEnvironment, LAYOUT};

    fn evaluate_fake(numbers: Range<u64>, seed: u64, n_threads: usize) -> Vec<Episode> {
        let n_threads = NonZeroUsize::new(n_threads).expect("1 or more");
        let world = &WorldConfig::default();
        let evaluation = Evaluation { layout: LAYOUT, world, seed, numbers, n_threads };
        let played = evaluation.run_in(&FakeEnvironment::new(), |_| FakeActor::Seeker);
        played.expect("no step fails")
    }

    #[test]
    fn the_number_of_threads_changes_nothing() {
        let alone = evaluate_fake(0..7, 5, 1);
        assert_eq!(
            alone.iter().map(|episode| episode.number).collect::<Vec<_>>(),
            [0, 1, 2, 3, 4, 5, 6]
        );
        for n_threads in [2, 3, 7, 16] {
            assert_eq!(evaluate_fake(0..7, 5, n_threads), alone, "{n_threads} threads");
        }
        assert_eq!(
            evaluate_fake(0..3, 5, 2),
            alone[..3],
            "a smaller set is the beginning of a larger one"
        );
        assert_eq!(evaluate_fake(3..7, 5, 3), alone[3..], "a part is that of the whole");
        assert_ne!(
            evaluate_fake(0..7, 6, 1)[0].goal,
            alone[0].goal,
            "another seed has other goals"
        );
        assert!(evaluate_fake(0..0, 5, 2).is_empty());
    }

    #[test]
    fn the_number_of_threads_changes_no_simulation() {
        let evaluate_on = |n_threads| {
            let n_threads = NonZeroUsize::new(n_threads).expect("1 or more");
            let world = &WorldConfig::default();
            let evaluation =
                Evaluation { layout: LAYOUT, world, seed: 5, numbers: 0..3, n_threads };
            evaluation.run(|_| FakeActor::Seeker).expect("no step fails")
        };
        assert_eq!(evaluate_on(1), evaluate_on(2));
    }

    #[test]
    fn composed_teachers_act_for_each_arm_separately() {
        let (mut observations, mut goals) = (vec![0.0; 2 * 56], vec![0.0; 2 * 6]);
        for (row, value) in [0.1, 0.2, 0.3, 0.4].into_iter().enumerate() {
            observations[28 * row] = value;
            goals[3 * row] = 0.5;
        }
        let mut actions = vec![9.0; 2 * 6];
        ComposedTeachers::new(FakeActor::Seeker, LAYOUT).act(&observations, &goals, &mut actions);
        let first_components: Vec<f32> = actions.chunks(3).map(|arm| arm[0]).collect();
        assert_eq!(first_components, [0.5 - 0.1, 0.5 - 0.2, 0.5 - 0.3, 0.5 - 0.4]);
    }

    #[test]
    fn composed_teachers_act_on_the_parts_of_arms_in_any_order() {
        let arm = |arm_idx: usize| ArmDescription {
            observation: vec![arm_idx, arm_idx + 2],
            goal: vec![1 - arm_idx],
            action: vec![1 - arm_idx],
            position: Vec::new(),
            lateral: Vec::new(),
            hand: Vec::new(),
        };
        let task = TaskSpec::new(TaskDescription {
            name: "interleaved".to_owned(),
            n_observation: 4,
            n_goal: 2,
            n_action: 2,
            achieved_goal: vec![1, 0],
            observation_bound: vec![2.0; 4],
            goal_bound: vec![1.0; 2],
            arms: vec![arm(0), arm(1)],
            ..TaskSpec::from(LAYOUT).description().clone()
        })
        .expect("consistent");
        struct Difference;
        impl Act for Difference {
            fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
                let rows = observations.chunks_exact(2).zip(goals);
                for ((row, goal), action) in rows.zip(actions) {
                    *action = goal - row[0] + 0.1 * row[1];
                }
            }
        }
        let observations = [0.1, 0.2, 1.0, 2.0, 0.3, 0.4, -2.0, 0.0];
        let goals = [0.5, 0.25, 0.0, 1.0];
        let mut actions = [9.0; 4];
        ComposedTeachers::new(Difference, task).act(&observations, &goals, &mut actions);
        let expected = [
            0.5 - 0.2 + 0.1 * 2.0, // arm 1
            0.25 - 0.1 + 0.1 * 1.0,
            0.0 - 0.4 + 0.1 * 0.0,
            1.0 - 0.3 + 0.1 * -2.0,
        ];
        assert_eq!(actions, expected);
    }
}
