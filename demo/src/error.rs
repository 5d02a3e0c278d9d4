//! Errors, as the page displays them.

/// An error of the demo.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The policy cannot be used.
    #[error("the policy cannot be used")]
    Policy(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// The policy is of a task that the simulator does not have.
    #[error("the policy is of task {0:?}, which the simulator does not have")]
    NotBuiltIn(String),
    /// The world cannot be built or stepped.
    #[error(transparent)]
    World(#[from] tandem_sim::SimError),
    /// The file is no MCAP file at all.
    #[error("the file is not an MCAP file")]
    NotMcap,
    /// The file ends too early, or a part of it was altered.
    #[error(
        "the file is damaged or incomplete: {0}; `tandem mcap recover` recovers the log of a killed writer"
    )]
    Damaged(String),
    /// The file is the log of a trial, which cannot be simulated again.
    #[error("the file is the log of a trial, not of an episode: a trial cannot be simulated again")]
    TrialLog,
    /// The file is an MCAP file, but not the log of an episode.
    #[error("the file is not the log of an episode: {0}")]
    NotAnEpisode(String),
    /// Only the task's own environments can simulate the log again.
    #[error("the log is of task {0:?}, which only its own environments can simulate again")]
    NoSimulator(String),
    /// No policy or no log was loaded before.
    #[error("nothing is loaded")]
    NothingLoaded,
}
