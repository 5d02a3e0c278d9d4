//! What a learner asks of its workers.

use crate::episode::EpisodeKind;
use crate::layout::Layout;

/// What holds for every episode of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct RunTerms {
    /// The run's name; empty outside a run.
    pub run: String,
    /// Task and arms.
    pub layout: Layout,
    /// The teacher's account; `None` when nobody is to be asked.
    pub account: Option<String>,
    /// How training episodes explore.
    pub exploration: Exploration,
    /// How episodes start and how finely they are simulated.
    pub world: WorldTerms,
}

/// How training episodes explore.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Exploration {
    /// Standard deviation of the Gaussian added to every action component.
    pub noise_std: f32,
    /// Share of an arm's steps that take random actions.
    pub random_share: f32,
    /// How many steps a random action is kept, on average; 1 draws a new one each step.
    pub random_hold_mean_steps: f32,
}

/// How training episodes start and how finely all are simulated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorldTerms {
    /// Share of training episodes that start with the objects grasped (pick and place).
    pub gripped_start_share: f32,
    /// Share of training episodes that start with the hand anywhere above the table.
    pub wide_start_share: f32,
    /// Physics steps per control step of 0.04 s.
    pub substeps: u32,
}

/// One episode to play.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EpisodeOrder {
    /// Its number.
    pub number: u64,
    /// With the number, the address of its random draws.
    pub seed: u64,
    /// Whether to ask the teacher.
    pub advised: bool,
    /// Whether every action is random (warm-up).
    pub uniform: bool,
    /// Whether to write a log of it.
    pub record: bool,
}

/// Episodes stepped in lock step by one worker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SlotOrder {
    /// The slot's number within the run.
    pub slot: u64,
    /// Version of the parameters that act.
    pub parameter_version: u64,
    /// What the episodes are for.
    pub kind: EpisodeKind,
    /// The episodes.
    pub episodes: Vec<EpisodeOrder>,
}

/// An actor's parameters as published by the learner.
#[derive(Debug, Clone, PartialEq)]
pub struct PublishedActor {
    /// Counts up by one a round.
    pub version: u64,
    /// Units of each hidden layer.
    pub n_hidden: usize,
    /// Hidden layers.
    pub n_hidden_layers: usize,
    /// Weight `[out, in]` and bias of each layer in turn.
    pub actor: Vec<f32>,
    /// Shape `[n_observation]`.
    pub observation_mean: Vec<f32>,
    /// Shape `[n_observation]`.
    pub observation_std: Vec<f32>,
    /// Shape `[n_goal]`.
    pub goal_mean: Vec<f32>,
    /// Shape `[n_goal]`.
    pub goal_std: Vec<f32>,
}
