//! What a learner asks of its workers.

use crate::episode::EpisodeKind;
use crate::layout::Layout;
use crate::settings::{Exploration, WorldSettings};

/// What holds for every episode of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct RunTerms {
    /// Task and arms.
    pub layout: Layout,
    /// The teacher's account; `None` when nobody is to be asked.
    pub account: Option<String>,
    /// How training episodes explore.
    pub exploration: Exploration,
    /// How episodes start and how finely they are simulated.
    pub world: WorldSettings,
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
