//! The rows that a policy evaluates together.

/// States, the student's actions in them, and the teacher's answers. A row is one arm of one step.
#[derive(Debug, Default)]
pub(crate) struct Batch {
    /// The number `n` of rows.
    pub(crate) n_rows: usize,
    /// Shape `[n, n_observation]`; after an evaluation in this process every state twice, for the two actions.
    pub(crate) observations: Vec<f32>,
    /// Shape `[n, n_goal]`; after an evaluation in this process every goal twice.
    pub(crate) goals: Vec<f32>,
    /// Shape `[n, n_action]`.
    pub(crate) student_actions: Vec<f32>,
    /// The teacher's actions, then the student's, shape `[2 n, n_action]`.
    pub(crate) actions: Vec<f32>,
    /// The values of these actions, shape `[2 n]`.
    pub(crate) q: Vec<f32>,
}
