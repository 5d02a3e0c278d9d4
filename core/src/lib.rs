//! The words that the other crates share: tasks and layouts, episodes, the sparse reward, random number streams.
//!
//! Nothing here does input or output, reads a clock or knows a wire format, and a thing lives here only
//! when two crates need it.
#![warn(missing_docs)]

pub mod advice;
pub mod bounds;
pub mod episode;
pub mod evaluation;
pub mod layout;
pub mod reward;
pub mod rng;
pub mod scene;
pub mod settings;
pub mod text;
pub mod work;

pub use advice::{ArmAdvice, StepAdvice, StepQuery};
pub use episode::{Contacts, Episode, EpisodeKind};
pub use evaluation::{EpisodeOutcome, EvaluationSummary, Wilson};
pub use layout::{ArmIndex, Layout, Task};
pub use rng::{Stream, episode_rng};
pub use settings::{Exploration, WorldSettings};
