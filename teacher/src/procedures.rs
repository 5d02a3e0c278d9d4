//! Procedures 1 to 3 of section 3.2 of the paper, which decide whether the teacher's action replaces the student's on
//! one arm.
//!
//! [`crate::advisor`] has the loop over the arms and `a = f^a(a_1, …, a_n)`; [`crate::budget`] has the test `n_b > 0`
//! and the decrement. The procedures judge the action that the student is about to execute, exploration included, or
//! its policy's action, as the run's `advice.judged_action` says.

use tandem_core::ArmAdvice;
use tandem_core::reward::distance;

/// A rule that selects the arms to override.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Procedure {
    /// Procedure 1: on every step.
    EarlyAdvising,
    /// Procedure 2: where the student's action loses more of the teacher's value than a threshold.
    MistakeCorrectingQ {
        /// `t_I`, a difference of values (equation 10), 0 or more.
        threshold: f32,
    },
    /// Procedure 3: where the student's action is farther from the teacher's than a radius.
    MistakeCorrectingAction(ActionFilter),
}

/// The radius `t_a` of procedure 3, by the formula of equation 11 (the words before it disagree).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ActionFilter {
    /// `t_a = α`.
    McAct {
        /// `α`, a Euclidean distance between two actions of one arm, 0 or more.
        alpha: f32,
    },
    /// `t_a = α · ‖π_tr(ŝ)‖₂`.
    McActAbs {
        /// `α`, a multiple of the length of the teacher's action, 0 or more.
        alpha: f32,
    },
}

impl Procedure {
    /// Returns true if the teacher's action replaces the student's on an arm with these scores.
    #[must_use]
    pub fn overrides(self, arm: &ArmAdvice) -> bool {
        match self {
            Self::EarlyAdvising => early_advising(),
            Self::MistakeCorrectingQ { threshold } => {
                mistake_correcting_q(arm.importance, threshold)
            }
            Self::MistakeCorrectingAction(filter) => {
                mistake_correcting_action(arm.distance, filter.radius(&arm.teacher_action))
            }
        }
    }
}

impl ActionFilter {
    /// Returns `t_a` of equation 11 for `teacher_action`, shape `[action_per_arm]`.
    #[must_use]
    pub fn radius(self, teacher_action: &[f32]) -> f32 {
        match self {
            Self::McAct { alpha } => alpha,
            Self::McActAbs { alpha } => alpha * norm(teacher_action),
        }
    }
}

/// Procedure 1, lines 4 to 9: returns `true`.
#[must_use]
pub const fn early_advising() -> bool {
    true
}

/// Jump-start (Uchendu et al. 2023): returns true if step `step` of an episode, from 0, is before the horizon `H`.
#[must_use]
pub const fn jump_start(step: u32, horizon: u32) -> bool {
    step < horizon
}

/// Procedure 2, line 9: `I_i(s) > t_I`.
#[must_use]
pub fn mistake_correcting_q(importance: f32, threshold: f32) -> bool {
    importance > threshold
}

/// Procedure 3, line 7: `D(a_tr, a_st) > t_a`.
#[must_use]
pub fn mistake_correcting_action(distance: f32, radius: f32) -> bool {
    distance > radius
}

/// Scores the student's action on one arm of one step, with nothing overridden.
///
/// Both actions have shape `[action_per_arm]`; the values are those of the teacher's critic (equation 10).
///
/// # Panics
/// When the actions differ in length.
#[must_use]
pub fn score_arm(
    teacher_action: &[f32],
    student_action: &[f32],
    q_teacher: f32,
    q_student: f32,
) -> ArmAdvice {
    ArmAdvice {
        teacher_action: teacher_action.to_vec(),
        q_teacher,
        q_student,
        importance: q_teacher - q_student,
        distance: distance(teacher_action, student_action),
        overridden: false,
    }
}

fn norm(vector: &[f32]) -> f32 {
    vector.iter().map(|x| x * x).sum::<f32>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A teacher that acts (0.375, 0.5, 0), of length 0.625, for a value of −1.
    fn arm(student_action: [f32; 3], q_student: f32) -> ArmAdvice {
        score_arm(&[0.375, 0.5, 0.0], &student_action, -1.0, q_student)
    }

    #[test]
    fn importance_is_the_value_lost_and_distance_is_euclidean() {
        let scores = arm([0.375, 0.25, 0.0], -1.75);
        assert_eq!((scores.importance, scores.distance, scores.overridden), (0.75, 0.25, false));
        assert_eq!(arm([0.0; 3], -0.5).importance, -0.5);
    }

    #[test]
    fn each_procedure_overrides_by_its_own_rule() {
        let check = |procedure: Procedure, scores: &ArmAdvice, overrides: bool| {
            assert_eq!(procedure.overrides(scores), overrides, "{procedure:?}");
        };
        let same = arm([0.375, 0.5, 0.0], -1.0);
        let worse_by_half = arm([0.0; 3], -1.5);
        let better = arm([0.0; 3], -0.5);

        check(Procedure::EarlyAdvising, &same, true);

        check(Procedure::MistakeCorrectingQ { threshold: 0.0 }, &same, false);
        check(Procedure::MistakeCorrectingQ { threshold: 0.25 }, &worse_by_half, true);
        check(Procedure::MistakeCorrectingQ { threshold: 0.5 }, &worse_by_half, false);
        check(Procedure::MistakeCorrectingQ { threshold: 0.0 }, &better, false);

        let mc_act = |alpha| Procedure::MistakeCorrectingAction(ActionFilter::McAct { alpha });
        check(mc_act(0.0), &same, false);
        check(mc_act(0.5), &better, true);
        check(mc_act(0.625), &better, false);

        let mc_act_abs =
            |alpha| Procedure::MistakeCorrectingAction(ActionFilter::McActAbs { alpha });
        check(mc_act_abs(0.0), &same, false);
        check(mc_act_abs(0.75), &better, true);
        check(mc_act_abs(1.0), &better, false);
    }

    #[test]
    fn equation_11_scales_the_radius_with_the_teachers_action_only_for_mc_act_abs() {
        assert_eq!(ActionFilter::McAct { alpha: 0.5 }.radius(&[0.375, 0.5, 0.0]), 0.5);
        assert_eq!(ActionFilter::McActAbs { alpha: 0.5 }.radius(&[0.375, 0.5, 0.0]), 0.3125);
    }
}
