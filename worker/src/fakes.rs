//! An environment, actors and a teacher for tests, simple enough to follow by hand.

use tandem_core::layout::{Layout, OBSERVATION_PER_ARM, Task};
use tandem_core::rng::{Stream, episode_rng, uniform};
use tandem_core::scene::Scene;
use tandem_core::work::{EpisodeExploration, EpisodeOrder, EpisodeStart, RunTerms, SlotOrder};
use tandem_core::{
    AdviceTerms, ArmAdvice, Contacts, EpisodeKind, Exploration, StepAdvice, StepQuery,
    WorldSettings,
};

use crate::ports::{Act, Advisor, AdvisorGone, EnvironmentError, VectorEnv};

pub(crate) const LAYOUT: Layout = Layout::new(Task::Push, 2);

/// Hands that move by the action. Hands at the same place touch.
#[derive(Debug, Clone, Default)]
pub(crate) struct FakeEnvironment {
    /// Shape `[n, n_action]`.
    positions: Vec<f32>,
    /// Added to the first number of every observation after the first reset: an environment with a memory.
    drift: f32,
    n_resets: usize,
}

impl FakeEnvironment {
    pub(crate) fn new() -> Self {
        Self::default()
    }

    /// Creates an environment that adds `drift` from its second reset on.
    pub(crate) fn drifting(drift: f32) -> Self {
        Self { drift, ..Self::default() }
    }

    fn observe(&self, observations: &mut [f32]) {
        observations.fill(0.0);
        let parts = observations.chunks_mut(OBSERVATION_PER_ARM);
        for (part, position) in parts.zip(self.positions.chunks(3)) {
            part[..3].copy_from_slice(position);
            part[0] += if self.n_resets > 1 { self.drift } else { 0.0 };
        }
    }
}

impl VectorEnv for FakeEnvironment {
    fn reset(
        &mut self,
        starts: &[EpisodeStart],
        observations: &mut [f32],
        goals: &mut [f32],
    ) -> Result<(), EnvironmentError> {
        self.n_resets += 1;
        self.positions.clear();
        for (start, goal) in starts.iter().zip(goals.chunks_mut(LAYOUT.n_goal())) {
            let mut rng = episode_rng(start.seed, start.number, Stream::Reset);
            let width = 0.5 + start.world.grasped_start_prob;
            let mut draw = |width: f32| uniform(&mut rng, -width, width);
            self.positions.extend((0..LAYOUT.n_action()).map(|_| draw(width)));
            goal.fill_with(|| draw(0.5));
        }
        self.observe(observations);
        Ok(())
    }

    fn step(
        &mut self,
        actions: &[f32],
        observations: &mut [f32],
        contacts: &mut [Contacts],
    ) -> Result<(), EnvironmentError> {
        for (position, input) in self.positions.iter_mut().zip(actions) {
            *position += 0.05 * input;
        }
        let hands = self.positions.chunks(LAYOUT.n_action());
        for (hands, contacts) in hands.zip(contacts) {
            let meet = (hands[0] - hands[3]).abs() < 0.05;
            *contacts = if meet { Contacts::ARM_ARM } else { Contacts::NONE };
        }
        self.observe(observations);
        Ok(())
    }

    fn scene(&self, _environment: usize) -> Option<Scene> {
        None
    }
}

/// An actor that moves towards the goal, or always takes the same action.
#[derive(Debug, Clone, Copy)]
pub(crate) enum FakeActor {
    Seeker,
    Constant(f32),
}

impl Act for FakeActor {
    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        let arms = observations
            .chunks(OBSERVATION_PER_ARM)
            .zip(goals.chunks(3))
            .zip(actions.chunks_mut(3));
        for ((observation, goal), action) in arms {
            for axis in 0..3 {
                action[axis] = match self {
                    Self::Seeker => (goal[axis] - observation[axis]).clamp(-1.0, 1.0),
                    Self::Constant(input) => *input,
                };
            }
        }
    }
}

/// A teacher that overrides the arms for which `overrides` returns true, given episode, step and arm. Records requests.
pub(crate) struct FakeTeacher<F> {
    pub(crate) overrides: F,
    pub(crate) requests: Vec<Vec<StepQuery>>,
}

/// The teacher's action, which no proposal equals.
pub(crate) const TEACHER_ACTION: [f32; 3] = [0.75, -0.75, 0.25];

impl<F: Fn(u64, u32, usize) -> bool> FakeTeacher<F> {
    pub(crate) const fn new(overrides: F) -> Self {
        Self { overrides, requests: Vec::new() }
    }

    fn verdict(&self, query: &StepQuery) -> StepAdvice {
        let mut action = query.proposed_action.clone();
        let arms: Vec<ArmAdvice> = LAYOUT
            .arms()
            .map(|arm| {
                let overridden = (self.overrides)(query.episode, query.step, arm.0);
                if overridden {
                    action[LAYOUT.action_of(arm)].copy_from_slice(&TEACHER_ACTION);
                }
                ArmAdvice {
                    teacher_action: TEACHER_ACTION.to_vec(),
                    q_teacher: 0.0,
                    q_student: -1.0,
                    importance: 1.0,
                    distance: 1.0,
                    overridden,
                }
            })
            .collect();
        StepAdvice { action, charged: arms.iter().any(|arm| arm.overridden), arms, repeated: false }
    }
}

impl<F: Fn(u64, u32, usize) -> bool> Advisor for FakeTeacher<F> {
    fn advise(&mut self, queries: Vec<StepQuery>) -> Result<Vec<StepAdvice>, AdvisorGone> {
        let advice = queries.iter().map(|query| self.verdict(query)).collect();
        self.requests.push(queries);
        Ok(advice)
    }
}

/// Returns terms with every kind of exploration.
pub(crate) fn terms() -> RunTerms {
    RunTerms {
        run: "run-7".to_owned(),
        task: LAYOUT.into(),
        account: Some("run".to_owned()),
        advice: AdviceTerms::default(),
        exploration: Exploration {
            noise_std: 0.2,
            random_action_prob: 0.3,
            sticky_random_mean_steps: 4.0,
            joint_random_actions: false,
        },
        world: WorldSettings { grasped_start_prob: 0.5, ..WorldSettings::default() },
        symmetrized_evaluation: false,
    }
}

/// Returns a slot of training episodes with these numbers.
pub(crate) fn slot(numbers: &[u64], advised: bool) -> SlotOrder {
    let order = |number: &u64| EpisodeOrder {
        number: *number,
        seed: 11,
        advised,
        exploration: EpisodeExploration::Noise,
        record: false,
        advised_steps: None,
    };
    SlotOrder {
        slot: 0,
        parameter_version: 4,
        kind: EpisodeKind::Training,
        episodes: numbers.iter().map(order).collect(),
    }
}
