//! What the services tell about themselves: typed events, the metrics of a run, and a log of every recorded episode
//! that Foxglove opens and `tandem replay` plays again, and the records of trials on arms.
//!
//! Knows the layout of its files and nothing of who writes or reads them. No clock is read here: an episode's times
//! are simulated, and a run's are handed in.
#![warn(missing_docs)]

pub mod episode_log;
mod error;
pub mod events;
mod log_file;
pub mod logging;
mod messages;
pub mod metrics;
pub mod recorder;
mod records;
pub mod recovery;
mod scene;
pub mod standard_error;
pub mod trial_log;
pub mod trials;

pub use episode_log::{EpisodeLog, LoggedTransition, read_episode};
pub use error::Error;
pub use messages::EpisodeMetadata;
pub use metrics::{MetricsLog, MetricsRow};
pub use recorder::{EpisodeRecorder, TransitionRecord};
pub use recovery::{RecoveredCounts, recover};
pub use trial_log::{LogLevel, TrialLook, TrialMetadata, TrialOutcome, TrialRecorder};
pub use trials::{ToolsAt, TrialRow, TrialsLog, read_trials};
