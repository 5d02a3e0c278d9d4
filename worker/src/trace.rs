//! The part of a log that an episode itself does not contain.

use tandem_core::ArmAdvice;
use tandem_core::scene::Scene;

/// The scenes of an episode and the teacher's advice on it, as a worker sees them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Trace {
    /// The scene before each step and after the last one; empty if the bodies are unknown.
    pub scenes: Vec<Scene>,
    /// The advice on each step; without arms on steps on which the teacher was not asked.
    pub advice: Vec<TracedAdvice>,
}

/// The teacher's advice on one step.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TracedAdvice {
    /// The advice for each arm, in arm order; empty if the teacher was not asked.
    pub arms: Vec<ArmAdvice>,
    /// The units of the budget that were left when the teacher answered, if that is known.
    pub budget_left: Option<u64>,
}
