//! The state of a run for displays: its counters, workers, teacher and evaluations at one moment.

use std::sync::Arc;

use serde::{Serialize, Serializer};
use tandem_core::Episode;

use crate::metrics::MetricsRow;

/// A snapshot of a run.
///
/// It is serialized to JSON without the evaluations and their episodes. Values that do not exist yet are NaN here and
/// `null` there.
#[derive(Debug, Clone, Default, Serialize)]
pub struct RunView {
    /// Name of the run.
    pub run: String,
    /// Name of the task.
    pub task: String,
    /// Number of arms of the learning policy.
    pub n_arms: usize,
    /// Advising strategy.
    pub strategy: String,
    /// Seed of the run; a text in JSON, because numbers of pages are exact up to 2^53 only.
    #[serde(serialize_with = "as_text")]
    pub seed: u64,
    /// The current activity: "starting", "collecting", "updating", "evaluating" or "ended"; empty until the run is
    /// loaded.
    pub phase: String,
    /// Seconds of wall time, summed over resumed parts.
    pub wall_s: f64,
    /// Rounds learned.
    pub round: u64,
    /// Rounds learned before this learner started; 0 in a new run.
    pub resumed_from_round: u64,
    /// Environment steps of training.
    pub env_steps: u64,
    /// Environment steps that end the run; 0 if they do not.
    pub max_env_steps: u64,
    /// Minutes that end the run; 0 if they do not.
    pub max_minutes: f64,
    /// Training episodes.
    pub episodes: u64,
    /// Updates of the networks.
    pub updates: u64,
    /// Recent environment steps per second.
    pub env_steps_per_s: f64,
    /// Recent updates per second.
    pub updates_per_s: f64,
    /// Units of advice that learned episodes have cost.
    pub advice_spent: u64,
    /// Training steps on which the teacher was asked.
    pub advice_queries: u64,
    /// Units of advice that the run may still spend.
    pub advice_left: u64,
    /// Recent units of advice per minute.
    pub advice_per_min: f64,
    /// Fraction of the latest round's episodes that succeeded.
    pub training_success: f64,
    /// Value of the policy's own actions, mean over the latest round.
    pub mean_q: f64,
    /// The critic's loss, mean over the latest round.
    pub critic_loss: f64,
    /// The actor's loss, mean over the latest round.
    pub actor_loss: f64,
    /// The arms' training steps by who acted, since this learner started; in arm order.
    pub acted: Vec<ActedSteps>,
    /// Slots that wait for a worker.
    pub n_waiting_slots: usize,
    /// Slots that a worker plays.
    pub n_playing_slots: usize,
    /// Episodes in the replay buffer.
    pub n_replay_episodes: usize,
    /// The workers, by number.
    pub workers: Vec<WorkerView>,
    /// The teacher and its ledger.
    pub teacher: TeacherView,
    /// Problems that require an operator; empty if there are none.
    pub warning: String,
    /// The end of the run, once it has ended.
    pub end: Option<EndView>,
    /// All evaluations, oldest first.
    #[serde(skip)]
    pub evaluations: Arc<[MetricsRow]>,
    /// The first episodes of the latest evaluation.
    #[serde(skip)]
    pub evaluated: Arc<[Episode]>,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "required by serde")]
fn as_text<S: Serializer>(number: &u64, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(number)
}

/// Training steps of one arm by who acted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct ActedSteps {
    /// Steps in which the arm executed the teacher's action.
    pub teacher: u64,
    /// Steps in which the arm executed the student's action.
    pub student: u64,
}

/// A worker at one moment.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WorkerView {
    /// Its number.
    pub id: u64,
    /// Its label.
    pub name: String,
    /// Its activity.
    pub state: WorkerState,
    /// The slot that it plays.
    pub slot: Option<u64>,
    /// Episodes that it has delivered.
    pub n_episodes: u64,
    /// Seconds since its latest call.
    pub last_seen_s: f64,
}

/// The activity of a worker.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum WorkerState {
    /// Plays a slot.
    Playing,
    /// Waits for a slot.
    Waiting,
    /// Its connection has closed.
    Disconnected,
    /// Its connection is open, and it has not called for so long that it counts as dead.
    Silent,
}

impl WorkerState {
    /// Returns true if the worker takes part in the run.
    #[must_use]
    pub const fn is_active(self) -> bool {
        matches!(self, Self::Playing | Self::Waiting)
    }
}

/// The teacher and its ledger at one moment.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct TeacherView {
    /// The result of the latest call.
    pub state: TeacherState,
    /// The reason why it does not answer; empty if it does.
    pub error: String,
    /// Name of the run's account.
    pub account: String,
    /// Units of the account.
    pub budget: u64,
    /// Units charged to the account.
    pub spent: u64,
    /// Units reserved for open episodes and not yet spent.
    pub leased: u64,
    /// The reason why the ledger cannot be written or the policy cannot be evaluated; empty if both can.
    pub warning: String,
}

/// The result of the latest call to the teacher.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum TeacherState {
    /// The run has no teacher, or has not called it yet.
    #[default]
    None,
    /// It answered.
    Answering,
    /// It did not answer.
    Unreachable,
    /// It does not know the run's account.
    Lost,
}

/// The end of a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct EndView {
    /// The limit that was reached, or the error.
    pub reason: String,
    /// True if the run was stopped before its end, or failed.
    pub interrupted: bool,
    /// SHA-256 over the learning state; `None` after an error.
    pub digest: Option<String>,
}
