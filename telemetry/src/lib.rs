//! Telemetry of Tandem's services: typed events, metrics of runs, MCAP logs of episodes, trials and the motions of
//! a bridge, and results of trials.
//!
//! Foxglove opens the logs; `tandem replay` simulates recorded episodes again. The crate defines the layout of its
//! files, and does not depend on what writes or reads them. It reads no clock: the times of an episode are simulated,
//! and those of a run are arguments.
//!
//! | kind | written by | read by |
//! |---|---|---|
//! | logs of episodes, `*.mcap` | [`EpisodeRecorder`] | [`read_episode`]; [`recover`] after a crash |
//! | logs of trials and of motions, `*.mcap` | [`TrialRecorder`], [`MotionJournal`] | Foxglove |
//! | metrics of a run, `metrics.jsonl` | [`MetricsLog`] | [`MetricsLog::read_all`] |
//! | results of trials, `trials.jsonl` | [`TrialsLog`] | [`read_trials`] |
//! | events in the program's log | the types in [`events`] | [`logging`] sets it up |
#![warn(missing_docs)]

mod arms_messages;
mod arms_view;
pub mod episode_log;
mod error;
pub mod events;
#[cfg(feature = "live")]
pub mod live;
mod log_budget;
mod log_file;
mod log_name;
pub mod logging;
mod messages;
pub mod metrics;
mod motion_journal;
pub mod motion_log;
pub mod recorder;
mod records;
pub mod recovery;
mod run_view;
mod scene;
pub mod standard_error;
pub mod tensorboard;
pub mod trial_log;
pub mod trials;

pub use arms_view::{ArmView, ArmsEvents, ArmsPhase, ArmsView, MotionView, StopView};
pub use episode_log::{EpisodeLog, LoggedTransition, read_episode};
pub use error::Error;
pub use log_budget::LogBudget;
pub use log_name::LogName;
pub use messages::EpisodeMetadata;
pub use metrics::{ContactMetrics, MetricsLog, MetricsRow};
pub use motion_journal::MotionJournal;
pub use recorder::{EpisodeRecorder, TransitionRecord};
pub use recovery::{RecoveredCounts, recover};
pub use run_view::{
    ActedSteps, EndView, RunView, TeacherState, TeacherView, WorkerState, WorkerView,
};
pub use trial_log::{LogLevel, TrialMetadata, TrialOutcome, TrialRecorder, TrialSnapshot};
pub use trials::{ToolPathPoint, TrialRow, TrialsLog, read_trials};
