//! Procedures 1 to 3 of the paper's section 3.2: whether the teacher's action replaces the student's on one arm.
//!
//! The loop over the arms and `a = f^a(a_1, …, a_n)` are [`crate::advisor`]'s, the test `n_b > 0` and the decrement
//! are [`crate::budget`]'s. What is judged is the action that the student is about to execute.

use tandem_core::ArmAdvice;
use tandem_core::reward::distance;

/// A rule that picks the arms to override.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Procedure {
    /// Procedure 1.
    EarlyAdvising,
    /// Procedure 2.
    MistakeCorrectingQ {
        /// `t_I`.
        threshold: f32,
    },
    /// Procedure 3.
    MistakeCorrectingAction(ActionFilter),
}

/// How procedure 3 gets its radius `t_a` (equation 11, whose formula is followed, not the words before it).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ActionFilter {
    /// `t_a = α`.
    McAct {
        /// A distance of actions.
        alpha: f32,
    },
    /// `t_a = α · ‖π_tr(ŝ)‖₂`.
    McActAbs {
        /// A share of the teacher's action's length.
        alpha: f32,
    },
}

impl Procedure {
    /// Whether the teacher's action takes the place of the student's on an arm judged as `arm`.
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
    /// `t_a` of equation 11 where the teacher would act `teacher_action`.
    #[must_use]
    pub fn radius(self, teacher_action: &[f32]) -> f32 {
        match self {
            Self::McAct { alpha } => alpha,
            Self::McActAbs { alpha } => alpha * norm(teacher_action),
        }
    }
}

/// Procedure 1, lines 4 to 9: always.
#[must_use]
pub const fn early_advising() -> bool {
    true
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

/// What the teacher thinks of one arm of one step, nothing overridden yet.
///
/// Both actions have shape `[action_per_arm]`; the values are the teacher's critic's.
#[must_use]
pub fn judge_arm(
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
        judge_arm(&[0.375, 0.5, 0.0], &student_action, -1.0, q_student)
    }

    #[test]
    fn importance_is_the_value_lost_and_distance_is_euclidean() {
        let judged = arm([0.375, 0.25, 0.0], -1.75);
        assert_eq!((judged.importance, judged.distance, judged.overridden), (0.75, 0.25, false));
        assert_eq!(arm([0.0; 3], -0.5).importance, -0.5);
    }

    #[test]
    fn each_procedure_overrides_what_it_says() {
        let check = |procedure: Procedure, judged: &ArmAdvice, overrides: bool| {
            assert_eq!(procedure.overrides(judged), overrides, "{procedure:?}");
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
