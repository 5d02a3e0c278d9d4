//! Queries to a teacher and its advice.

/// One step on which a student asks for advice.
///
/// Its vectors are the parts of the arms, concatenated in arm order: see
/// [`TaskSpec::observation_in_arm_order`](crate::TaskSpec::observation_in_arm_order).
#[derive(Debug, Clone, PartialEq)]
pub struct StepQuery {
    /// The episode's number.
    pub episode: u64,
    /// The step, from 0.
    pub step: u32,
    /// The observation before the step, shape `[n_observation]`.
    pub observation: Vec<f32>,
    /// The desired goal, shape `[n_goal]`.
    pub goal: Vec<f32>,
    /// The action that the student is about to execute, exploration included, in [−1, 1], shape `[n_action]`.
    pub proposed_action: Vec<f32>,
    /// The action that the teacher judges, shape `[n_action]`; `None` means the proposed action. Arms that are not
    /// overridden execute the proposed action in either case.
    pub judged_action: Option<Vec<f32>>,
    /// The episode that pays for the step; `None` means the episode itself. The queries of a request that have the same
    /// payer and step share one unit.
    pub payer: Option<u64>,
}

impl StepQuery {
    /// Returns the action that the teacher judges, shape `[n_action]`.
    #[must_use]
    pub fn judged(&self) -> &[f32] {
        self.judged_action.as_deref().unwrap_or(&self.proposed_action)
    }
}

/// The teacher's answer for one arm.
#[derive(Debug, Clone, PartialEq)]
pub struct ArmAdvice {
    /// The teacher's action, in [−1, 1], shape `[action_per_arm]`.
    pub teacher_action: Vec<f32>,
    /// The teacher's value of its own action; 0 if its policy has no critic.
    pub q_teacher: f32,
    /// The teacher's value of the judged action; 0 if its policy has no critic.
    pub q_student: f32,
    /// `q_teacher − q_student` (equation 10).
    pub importance: f32,
    /// The Euclidean distance between the teacher's action and the judged one: `D` of procedure 3.
    pub distance: f32,
    /// Whether the teacher's action replaces the student's.
    pub overridden: bool,
}

/// The teacher's answer for one step.
#[derive(Debug, Clone, PartialEq)]
pub struct StepAdvice {
    /// The action to execute, in arm order, shape `[n_action]`.
    pub action: Vec<f32>,
    /// Whether the step cost a unit of the budget, which other steps of the request may share.
    pub charged: bool,
    /// The advice for each arm, in arm order.
    pub arms: Vec<ArmAdvice>,
    /// Whether the teacher had decided on the step before, on an earlier request with the same numbers or with others.
    pub repeated: bool,
}

impl StepAdvice {
    /// Returns a bit mask with bit `a` set if arm `a` was overridden.
    #[must_use]
    pub fn overridden_arms(&self) -> u8 {
        self.arms.iter().enumerate().map(|(arm, advice)| u8::from(advice.overridden) << arm).sum()
    }
}
