//! What happens in a run, one type an event: the message is constant, what varies stands in fields.
//!
//! `debug` for what happens each step, `info` for each episode and connection, `warn` for what was recovered from,
//! `error` for what was given up.

use std::path::Path;

/// The teacher's action took the place of the student's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StepAdvised {
    /// The episode's number.
    pub episode: u64,
    /// The step, from 0.
    pub step: u32,
    /// Bit `a` set when arm `a` was overridden.
    pub overridden_arms: u8,
}

impl StepAdvised {
    /// Logs the event.
    pub fn emit(&self) {
        tracing::debug!(
            episode = self.episode,
            step = self.step,
            overridden_arms = self.overridden_arms,
            "step advised"
        );
    }
}

/// A worker played an episode to its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EpisodeFinished {
    /// The episode's number.
    pub episode: u64,
    /// Version of the parameters that acted.
    pub parameter_version: u64,
    /// Whether every object is at its goal.
    pub success: bool,
    /// Units of advice charged.
    pub advice_charged: u32,
    /// Steps with an arm–arm or arm–table contact.
    pub contact_steps: usize,
}

impl EpisodeFinished {
    /// Logs the event.
    pub fn emit(&self) {
        tracing::info!(
            episode = self.episode,
            parameter_version = self.parameter_version,
            success = self.success,
            advice_charged = self.advice_charged,
            contact_steps = self.contact_steps,
            "episode finished"
        );
    }
}

/// An episode's log is complete.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EpisodeRecorded<'a> {
    /// The episode's number.
    pub episode: u64,
    /// The log.
    pub path: &'a Path,
}

impl EpisodeRecorded<'_> {
    /// Logs the event.
    pub fn emit(&self) {
        tracing::info!(episode = self.episode, path = ?self.path, "episode recorded");
    }
}

/// All episodes of a round are in and learned from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RoundFinished {
    /// The round.
    pub round: u64,
    /// Training steps so far.
    pub env_steps: u64,
    /// Updates so far.
    pub updates: u64,
    /// Share of the round's episodes that succeeded.
    pub training_success: f64,
    /// Share of the round's episodes in which an object was displaced.
    pub training_moved: f64,
    /// Units of advice spent so far.
    pub advice_spent: u64,
}

impl RoundFinished {
    /// Logs the event.
    pub fn emit(&self) {
        tracing::info!(
            round = self.round,
            env_steps = self.env_steps,
            updates = self.updates,
            training_success = self.training_success,
            training_moved = self.training_moved,
            advice_spent = self.advice_spent,
            "round finished"
        );
    }
}

/// A policy was evaluated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EvaluationFinished {
    /// The round after which it was.
    pub round: u64,
    /// Training steps so far.
    pub env_steps: u64,
    /// Share of successful episodes.
    pub success: f64,
    /// Lower end of its 95 % interval.
    pub success_low: f64,
    /// Upper end of its 95 % interval.
    pub success_high: f64,
    /// Share of episodes with an arm–arm or arm–table contact.
    pub collision_rate: f64,
    /// Mean value that the critic gives to the policy's actions.
    pub mean_q: f64,
    /// Whether it is the best so far.
    pub best: bool,
}

impl EvaluationFinished {
    /// Logs the event.
    pub fn emit(&self) {
        tracing::info!(
            round = self.round,
            env_steps = self.env_steps,
            success = self.success,
            success_low = self.success_low,
            success_high = self.success_high,
            collision_rate = self.collision_rate,
            mean_q = self.mean_q,
            best = self.best,
            "evaluation finished"
        );
    }
}

/// A worker joined the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WorkerJoined<'a> {
    /// Its number.
    pub worker_id: u64,
    /// Its label.
    pub name: &'a str,
}

impl WorkerJoined<'_> {
    /// Logs the event.
    pub fn emit(&self) {
        tracing::info!(worker_id = self.worker_id, name = self.name, "worker joined");
    }
}

/// A worker was not heard of for the heartbeat timeout; its slots are assigned again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WorkerSilent<'a> {
    /// Its number.
    pub worker_id: u64,
    /// Its label.
    pub name: &'a str,
    /// Slots that are assigned again.
    pub n_slots: usize,
}

impl WorkerSilent<'_> {
    /// Logs the event.
    pub fn emit(&self) {
        tracing::warn!(
            worker_id = self.worker_id,
            name = self.name,
            n_slots = self.n_slots,
            "worker silent"
        );
    }
}

/// Workers may fetch the parameters of a version.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ParametersPublished {
    /// The version.
    pub version: u64,
}

impl ParametersPublished {
    /// Logs the event.
    pub fn emit(&self) {
        tracing::debug!(version = self.version, "parameters published");
    }
}

/// The state of a run is on the disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CheckpointSaved<'a> {
    /// The round after which it was taken.
    pub round: u64,
    /// Where it is.
    pub path: &'a Path,
    /// SHA-256 over its contents.
    pub digest: &'a str,
}

impl CheckpointSaved<'_> {
    /// Logs the event.
    pub fn emit(&self) {
        tracing::info!(round = self.round, path = ?self.path, digest = self.digest, "checkpoint saved");
    }
}

/// A run goes on from a checkpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RunResumed<'a> {
    /// The checkpoint's round.
    pub round: u64,
    /// Where the checkpoint is.
    pub path: &'a Path,
}

impl RunResumed<'_> {
    /// Logs the event.
    pub fn emit(&self) {
        tracing::info!(round = self.round, path = ?self.path, "run resumed");
    }
}

/// An account of advice was opened, or opened again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AdviceAccountOpened<'a> {
    /// Its name.
    pub account: &'a str,
    /// Units in all.
    pub budget: u64,
    /// Units spent already.
    pub spent: u64,
    /// When the teacher advises.
    pub strategy: &'a str,
}

impl AdviceAccountOpened<'_> {
    /// Logs the event.
    pub fn emit(&self) {
        tracing::info!(
            account = self.account,
            budget = self.budget,
            spent = self.spent,
            strategy = self.strategy,
            "advice account opened"
        );
    }
}

/// The last unit of an account is spent: the student is on its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BudgetExhausted<'a> {
    /// The account's name.
    pub account: &'a str,
    /// Units it had.
    pub budget: u64,
}

impl BudgetExhausted<'_> {
    /// Logs the event.
    pub fn emit(&self) {
        tracing::info!(account = self.account, budget = self.budget, "advice budget exhausted");
    }
}

/// A run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RunFinished<'a> {
    /// Why it ended.
    pub reason: &'a str,
    /// Its last round.
    pub round: u64,
    /// SHA-256 over the learning state.
    pub digest: &'a str,
}

impl RunFinished<'_> {
    /// Logs the event.
    pub fn emit(&self) {
        tracing::info!(
            reason = self.reason,
            round = self.round,
            digest = self.digest,
            "run finished"
        );
    }
}
