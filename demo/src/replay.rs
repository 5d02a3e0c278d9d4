//! A recorded episode, simulated again and compared with its log bit for bit.

use tandem_core::layout::GOAL_TOLERANCE_M;
use tandem_core::reward::{
    REWARD_ACHIEVED, REWARD_PENDING, achieved_goal, distance, sparse_reward,
};
use tandem_core::scene::Scene;
use tandem_core::{ArmIndex, Layout, Stream, episode_rng};
use tandem_sim::{Env, WorldConfig};

use crate::error::Error;
use crate::log::{EpisodeLog, Transition};

/// A log and its simulation.
pub struct Replay {
    /// The log.
    pub log: EpisodeLog,
    /// The state before every step and after the last one, as simulated.
    pub frames: Vec<Frame>,
    /// The first value that differs from the log.
    pub difference: Option<Difference>,
}

/// A moment of an episode.
pub struct Frame {
    /// All bodies.
    pub scene: Scene,
    /// Distances of the objects from their goals, metres, in arm order.
    pub distances_m: Vec<f32>,
}

/// A value of a log that the simulation gives otherwise.
#[derive(Debug, Clone, PartialEq)]
pub struct Difference {
    /// The step, from 0; the number of steps means the observation after the last one.
    pub step: usize,
    /// The vector that differs.
    pub field: &'static str,
    /// The index within the vector.
    pub component: usize,
    /// The value in the log.
    pub logged: f32,
    /// The simulated value.
    pub played: f32,
}

impl Replay {
    /// Simulates `log` again. Observations, goals, contacts and rewards are compared, as by `tandem replay --verify`.
    ///
    /// # Errors
    /// If the world cannot be built, or if an action is not finite.
    pub fn of(log: EpisodeLog) -> Result<Self, Error> {
        let layout = log.layout;
        let mut env = Env::new(layout, &WorldConfig::from(log.world))?;
        env.reset(&mut episode_rng(log.seed, log.episode, Stream::Reset), log.world);
        let mut observation = vec![0.0; layout.n_observation()];
        env.observe(&mut observation);
        let mut frames = vec![Frame::of(&env, &observation)];
        let mut difference = None;
        for (step_idx, logged) in log.transitions.iter().enumerate() {
            let before = Comparison(step_idx)
                .check("observation", &logged.observation, &observation)
                .or_else(|| Comparison(step_idx).check("goal", &logged.goal, env.goal()));
            let contacts = env.step(&logged.action)?;
            env.observe(&mut observation);
            difference = difference.or(before).or_else(|| {
                Comparison(step_idx).check_after(layout, logged, &observation, contacts.bits())
            });
            frames.push(Frame::of(&env, &observation));
        }
        if let Some(last) = &log.last_observation {
            let end = Comparison(log.transitions.len());
            difference = difference.or_else(|| end.check("observation", last, &observation));
        }
        Ok(Self { log, frames, difference })
    }

    /// Returns the number of steps, from the first one, that are equal bit for bit.
    #[must_use]
    pub fn n_equal_steps(&self) -> usize {
        let n_steps = self.log.transitions.len();
        self.difference.as_ref().map_or(n_steps, |difference| difference.step.min(n_steps))
    }
}

impl Frame {
    fn of(env: &Env, observation: &[f32]) -> Self {
        let layout = env.layout();
        let distance_m = |arm: ArmIndex| {
            distance(&observation[layout.achieved_goal_of(arm)], &env.goal()[layout.goal_of(arm)])
        };
        Self { scene: env.scene(), distances_m: layout.arms().map(distance_m).collect() }
    }
}

/// The comparison of the step with this index.
#[derive(Clone, Copy)]
struct Comparison(usize);

impl Comparison {
    fn check(self, field: &'static str, logged: &[f32], played: &[f32]) -> Option<Difference> {
        let mut pairs = logged.iter().zip(played).enumerate();
        let (component, (logged, played)) =
            pairs.find(|(_, (logged, played))| logged.to_bits() != played.to_bits())?;
        Some(Difference { step: self.0, field, component, logged: *logged, played: *played })
    }

    /// Compares contacts and rewards of a step before `observation`.
    fn check_after(
        self,
        layout: Layout,
        logged: &Transition,
        observation: &[f32],
        contacts: u8,
    ) -> Option<Difference> {
        let achieved: Vec<f32> = achieved_goal(layout, observation).collect();
        let per_arm = |arm: ArmIndex| {
            let object = &observation[layout.achieved_goal_of(arm)];
            let is_achieved =
                distance(object, &logged.goal[layout.goal_of(arm)]) <= GOAL_TOLERANCE_M;
            if is_achieved { REWARD_ACHIEVED } else { REWARD_PENDING }
        };
        let per_arm: Vec<f32> = layout.arms().map(per_arm).collect();
        #[expect(clippy::cast_precision_loss, reason = "a few bits")]
        let logged_contacts = logged.contacts as f32;
        self.check("contacts", &[logged_contacts], &[f32::from(contacts)])
            .or_else(|| {
                self.check("reward", &[logged.reward], &[sparse_reward(&achieved, &logged.goal)])
            })
            .or_else(|| self.check("rewards_per_arm", &logged.rewards_per_arm, &per_arm))
    }
}
