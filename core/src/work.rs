//! Work that a learner assigns to its workers.

use crate::episode::EpisodeKind;
use crate::settings::{AdviceTerms, Exploration, WorldSettings};
use crate::task::TaskSpec;

/// Settings that apply to every episode of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct RunTerms {
    /// The run's name; empty outside a run.
    pub run: String,
    /// The task.
    pub task: TaskSpec,
    /// The account at the teacher; `None` if the run takes no advice.
    pub account: Option<String>,
    /// Terms on which the student asks for advice.
    pub advice: AdviceTerms,
    /// Exploration in training episodes.
    pub exploration: Exploration,
    /// Initial states and physics.
    pub world: WorldSettings,
    /// Whether the action in evaluation episodes is the mean, before tanh, of the actor's action and of that for the
    /// scene with the order of its arms reversed.
    pub symmetrized_evaluation: bool,
}

/// Exploration of a training episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EpisodeExploration {
    /// Noise and random actions from the run's settings.
    Noise,
    /// All actions are uniformly random (warm-up).
    Uniform,
    /// None: executes the policy's actions unchanged.
    Greedy,
}

/// An episode to play.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EpisodeOrder {
    /// Number within the run (training) or within the goal set (evaluation).
    pub number: u64,
    /// Seed of its random draws, together with the number.
    pub seed: u64,
    /// Whether to ask the teacher for advice.
    pub advised: bool,
    /// Exploration, if it is played for training.
    pub exploration: EpisodeExploration,
    /// Whether to record the episode in a log.
    pub record: bool,
    /// Number of initial steps on which an advised episode may ask; `None` means all.
    pub advised_steps: Option<u32>,
}

impl EpisodeOrder {
    /// Returns true if the episode may ask on step `step_idx`, from 0.
    #[must_use]
    pub fn asks_on(&self, step_idx: usize) -> bool {
        let is_before_end = |n_steps| u32::try_from(step_idx).is_ok_and(|step| step < n_steps);
        self.advised && self.advised_steps.is_none_or(is_before_end)
    }
}

/// The start of an episode in an environment. Together with the actions it determines the episode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpisodeStart {
    /// Number within the run (training) or within the goal set (evaluation).
    pub number: u64,
    /// Seed of its random draws, together with the number.
    pub seed: u64,
    /// The purpose of the episode.
    pub kind: EpisodeKind,
    /// Initial states and physics of this episode.
    pub world: WorldSettings,
}

/// A slot to play: episodes that one worker steps in lock step.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SlotOrder {
    /// Number of the slot within the run.
    pub slot: u64,
    /// Version of the parameters to act with.
    pub parameter_version: u64,
    /// The purpose of the episodes.
    pub kind: EpisodeKind,
    /// The episodes.
    pub episodes: Vec<EpisodeOrder>,
}

/// An actor's parameters and input normalisation, as the learner publishes them.
#[derive(Debug, Clone, PartialEq)]
pub struct PublishedActor {
    /// Version, incremented by one per round.
    pub version: u64,
    /// Units of each hidden layer.
    pub n_hidden: usize,
    /// Number of hidden layers.
    pub n_hidden_layers: usize,
    /// Weight `[out, in]`, row-major, and bias `[out]` of each layer in turn.
    pub actor: Vec<f32>,
    /// Mean of observations, shape `[n_observation]`.
    pub observation_mean: Vec<f32>,
    /// Standard deviation of observations, above 0, shape `[n_observation]`.
    pub observation_std: Vec<f32>,
    /// Mean of goals, shape `[n_goal]`.
    pub goal_mean: Vec<f32>,
    /// Standard deviation of goals, above 0, shape `[n_goal]`.
    pub goal_std: Vec<f32>,
    /// The condition for asking for advice; `None` means always.
    pub gate: Option<PublishedGate>,
}

/// The critics whose disagreement decides when a student asks for advice. Their inputs are normalised as the actor's.
#[derive(Debug, Clone, PartialEq)]
pub struct PublishedGate {
    /// Number of critics, at least 2.
    pub n_critics: usize,
    /// Units of each hidden layer.
    pub n_hidden: usize,
    /// Number of hidden layers.
    pub n_hidden_layers: usize,
    /// Values per action: 1, or one per arm.
    pub n_heads: usize,
    /// The parameters of each critic in turn, shape `[n_critics, n_parameters]`.
    pub critics: Vec<f32>,
    /// The standard deviation of their values above which to ask, at least 0.
    pub threshold: f32,
}
