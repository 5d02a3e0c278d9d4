//! Events of a run. Each event is a type with its fields, a fixed level and a fixed message.
//!
//! Levels: `debug` for steps, `info` for episodes and connections, `warn` for recovered faults, `error` for faults
//! without recovery.

use std::path::Path;

/// Declares an event: a struct, and the `tracing` call with which its method `emit` logs it.
///
/// The call takes the struct's fields by name. A field that it omits is an unused variable, which the compiler reports.
macro_rules! event {
    (
        $(#[$meta:meta])*
        pub struct $name:ident $(<$lifetime:lifetime>)? {
            $($(#[$field_meta:meta])* pub $field:ident: $type:ty,)*
        }
        $level:ident!($($arguments:tt)*)
    ) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq)]
        pub struct $name $(<$lifetime>)? {
            $($(#[$field_meta])* pub $field: $type,)*
        }

        impl $(<$lifetime>)? $name $(<$lifetime>)? {
            #[doc = concat!("Logs the event at level `", stringify!($level), "`.")]
            pub fn emit(&self) {
                let Self { $($field),* } = *self;
                tracing::$level!($($arguments)*);
            }
        }
    };
}

event! {
    /// The teacher's action replaced the student's on at least one arm.
    pub struct StepAdvised {
        /// Number of the episode.
        pub episode: u64,
        /// Step of the episode, from 0.
        pub step: u32,
        /// Bit `a` is set if arm `a` was overridden.
        pub overridden_arms: u8,
    }
    debug!(episode, step, overridden_arms, "step advised")
}

event! {
    /// A worker played an episode to its end.
    pub struct EpisodeFinished {
        /// Number of the episode.
        pub episode: u64,
        /// Version of the parameters that acted.
        pub parameter_version: u64,
        /// `true` if every object is at its goal.
        pub success: bool,
        /// Units of advice charged.
        pub advice_charged: u32,
        /// Number of steps with a contact between the arms, or between an arm and the table.
        pub contact_steps: usize,
    }
    debug!(episode, parameter_version, success, advice_charged, contact_steps, "episode finished")
}

event! {
    /// The log of an episode is complete.
    pub struct EpisodeRecorded<'a> {
        /// Number of the episode.
        pub episode: u64,
        /// Path of the log.
        pub path: &'a Path,
    }
    info!(episode, ?path, "episode recorded")
}

event! {
    /// The learner has filed all episodes of a round and made its updates.
    pub struct RoundFinished {
        /// Number of the round.
        pub round: u64,
        /// Environment steps of training so far.
        pub env_steps: u64,
        /// Updates so far.
        pub updates: u64,
        /// Success rate of the round's episodes, in [0, 1].
        pub training_success: f64,
        /// Share of the round's episodes in which an object was displaced, in [0, 1].
        pub training_moved: f64,
        /// Units of advice spent so far.
        pub advice_spent: u64,
    }
    info!(
        round, env_steps, updates, training_success, training_moved, advice_spent,
        "round finished"
    )
}

event! {
    /// The evaluation of a policy is complete.
    pub struct EvaluationFinished {
        /// Round after which the policy was evaluated.
        pub round: u64,
        /// Environment steps of training so far.
        pub env_steps: u64,
        /// Success rate, in [0, 1].
        pub success: f64,
        /// Lower bound of the 95 % interval of `success`.
        pub success_low: f64,
        /// Upper bound of the 95 % interval of `success`.
        pub success_high: f64,
        /// Share of episodes with a contact between the arms, or between an arm and the table.
        pub collision_rate: f64,
        /// Mean Q-value of the policy's actions.
        pub mean_q: f64,
        /// `true` for the best policy so far.
        pub best: bool,
    }
    info!(
        round, env_steps, success, success_low, success_high, collision_rate, mean_q, best,
        "evaluation finished"
    )
}

event! {
    /// A worker joined the run.
    pub struct WorkerJoined<'a> {
        /// Number of the worker.
        pub worker_id: u64,
        /// Label of the worker.
        pub name: &'a str,
    }
    info!(worker_id, name, "worker joined")
}

event! {
    /// A worker sent nothing for the heartbeat timeout; its slots are reassigned.
    pub struct WorkerSilent<'a> {
        /// Number of the worker.
        pub worker_id: u64,
        /// Label of the worker.
        pub name: &'a str,
        /// Number of slots that are reassigned.
        pub n_slots: usize,
    }
    warn!(worker_id, name, n_slots, "worker silent")
}

event! {
    /// Workers can fetch the parameters of a version.
    pub struct ParametersPublished {
        /// The parameter version.
        pub version: u64,
    }
    debug!(version, "parameters published")
}

event! {
    /// A checkpoint of the run is on disk.
    pub struct CheckpointSaved<'a> {
        /// Round after which the checkpoint was taken.
        pub round: u64,
        /// Path of the checkpoint.
        pub path: &'a Path,
        /// SHA-256 of its contents.
        pub digest: &'a str,
    }
    info!(round, ?path, digest, "checkpoint saved")
}

event! {
    /// A run continues from a checkpoint.
    pub struct RunResumed<'a> {
        /// Round of the checkpoint.
        pub round: u64,
        /// Path of the checkpoint.
        pub path: &'a Path,
    }
    info!(round, ?path, "run resumed")
}

event! {
    /// An account of advice was opened or reopened.
    pub struct AdviceAccountOpened<'a> {
        /// Name of the account.
        pub account: &'a str,
        /// Budget, in units.
        pub budget: u64,
        /// Units spent already.
        pub spent: u64,
        /// Advising strategy.
        pub strategy: &'a str,
    }
    info!(account, budget, spent, strategy, "advice account opened")
}

event! {
    /// A run reached one of its limits.
    pub struct RunFinished<'a> {
        /// Reason of the end.
        pub reason: &'a str,
        /// Number of its last round.
        pub round: u64,
        /// SHA-256 of the learning state.
        pub digest: &'a str,
    }
    info!(reason, round, digest, "run finished")
}

event! {
    /// A run was stopped before its end and can be resumed.
    pub struct RunInterrupted<'a> {
        /// Number of its last round.
        pub round: u64,
        /// SHA-256 of the learning state.
        pub digest: &'a str,
    }
    info!(round, digest, "run interrupted")
}
