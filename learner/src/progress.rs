//! The progress of a run, as the learning thread reports it. The service turns it into messages and metrics.

use tandem_rl::trainer::{Counters, RoundStats};
use tandem_telemetry::{ActedSteps, MetricsRow};

/// A snapshot of the run.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Progress {
    /// Name of the task.
    pub(crate) task: String,
    /// Arms of the learning policy.
    pub(crate) n_arms: usize,
    /// Advising strategy.
    pub(crate) strategy: String,
    /// Rounds, environment steps, episodes, updates and units of advice so far.
    pub(crate) counters: Counters,
    /// The same when this process had loaded its checkpoint; 0 for a new run.
    pub(crate) counters_before: Counters,
    /// Seconds of wall time at the latest change, summed over resumed parts.
    pub(crate) wall_s: f64,
    /// Seconds of wall time of the parts of the run before this process.
    pub(crate) wall_before_s: f64,
    /// Environment steps after which the run ends; 0 for no limit.
    pub(crate) max_env_steps: u64,
    /// Minutes of wall time after which the run ends; 0 for no limit.
    pub(crate) max_minutes: f64,
    /// Recent environment steps per second.
    pub(crate) env_steps_per_s: f64,
    /// Recent updates per second.
    pub(crate) updates_per_s: f64,
    /// Recent units of advice per minute.
    pub(crate) advice_per_min: f64,
    /// Units of advice that the run may still spend.
    pub(crate) budget_left: u64,
    /// The current activity; `None` before the run starts.
    pub(crate) phase: Option<Phase>,
    /// Statistics of the latest round.
    pub(crate) stats: RoundStats,
    /// The arms' training steps by who acted, since the learner started; in arm order.
    pub(crate) acted: Vec<ActedSteps>,
    /// The workers, by number.
    pub(crate) workers: Vec<WorkerProgress>,
    /// The latest evaluation.
    pub(crate) latest: Option<MetricsRow>,
    /// The best evaluation.
    pub(crate) best: Option<MetricsRow>,
    /// The end of the run, once it has ended.
    pub(crate) end: Option<RunEnd>,
    /// Problems that require an operator; empty if there are none.
    pub(crate) warning: String,
    /// The checks of environments on servers, and their failures.
    pub(crate) environment: EnvironmentChecks,
}

/// The training episodes that workers have played twice on servers of environments, and the failures of the servers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct EnvironmentChecks {
    /// Their number since the learner started.
    pub(crate) n_episodes: u64,
    /// True if one of them differed the second time.
    pub(crate) differs: bool,
    /// Failures of servers since the learner started, as workers have reported them.
    pub(crate) n_failures: u64,
}

impl EnvironmentChecks {
    /// Returns the result in words; empty if nothing was checked.
    pub(crate) fn text(self) -> String {
        match (self.n_episodes, self.differs) {
            (0, _) => String::new(),
            (_, true) => "not deterministic".to_owned(),
            (n, false) => format!("deterministic within a process ({n} episodes played twice)"),
        }
    }
}

/// The activity of the learning thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Phase {
    Starting,
    Collecting,
    Updating,
    Evaluating,
    Ended,
}

impl Phase {
    /// Returns the name in messages.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Starting => "starting",
            Self::Collecting => "collecting",
            Self::Updating => "updating",
            Self::Evaluating => "evaluating",
            Self::Ended => "ended",
        }
    }
}

/// The end of a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RunEnd {
    /// The limit that was reached, or the error.
    pub(crate) reason: String,
    /// True if the run was stopped before its end, or failed.
    pub(crate) interrupted: bool,
    /// SHA-256 over the learning state; `None` after an error.
    pub(crate) digest: Option<String>,
}

/// A worker as the progress shows it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct WorkerProgress {
    pub(crate) worker_id: u64,
    pub(crate) name: String,
    pub(crate) n_episodes: u64,
    pub(crate) activity: Activity,
}

/// The activity of a worker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Activity {
    /// Plays the slot of this number.
    Slot(u64),
    /// Waits for a slot.
    Waiting,
    /// Has sent nothing for [`SILENT_AFTER`](crate::work_queue::SILENT_AFTER).
    Silent,
}
