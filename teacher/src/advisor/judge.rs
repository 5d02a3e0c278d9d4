//! What the teacher's networks say of many steps at once.

use tandem_core::{ArmAdvice, StepQuery};

use crate::error::Error;
use crate::maps::Maps;
use crate::policy::TeacherPolicy;
use crate::procedures::judge_arm;

/// The teacher's networks with the buffers that they work on. A row is one arm of one step.
pub(super) struct Judge {
    policy: Box<dyn TeacherPolicy>,
    /// Every state twice, for the two actions: shape `[2 n, n_observation]`.
    observations: Vec<f32>,
    /// Shape `[2 n, n_goal]`.
    goals: Vec<f32>,
    /// Shape `[n, n_action]`.
    student_actions: Vec<f32>,
    /// The teacher's actions, then the student's: shape `[2 n, n_action]`.
    actions: Vec<f32>,
    /// Shape `[2 n]`.
    q: Vec<f32>,
}

/// What a [`Judge`] found, row after row.
pub(super) struct Opinions<'a> {
    judge: &'a Judge,
    n_action: usize,
    next_row: usize,
}

impl Judge {
    pub(super) const fn new(policy: Box<dyn TeacherPolicy>) -> Self {
        Self {
            policy,
            observations: Vec::new(),
            goals: Vec::new(),
            student_actions: Vec::new(),
            actions: Vec::new(),
            q: Vec::new(),
        }
    }

    /// Looks at every arm of every one of `queries`.
    pub(super) fn judge<'a>(
        &mut self,
        maps: &Maps,
        queries: impl Iterator<Item = &'a StepQuery>,
    ) -> Opinions<'_> {
        let n_rows = self.gather(maps, queries);
        let n_action = self.policy.layout().n_action();
        self.run(n_rows, n_action);
        Opinions { judge: self, n_action, next_row: 0 }
    }

    /// Lays the states and the students' actions out in rows; gives their number.
    fn gather<'a>(&mut self, maps: &Maps, queries: impl Iterator<Item = &'a StepQuery>) -> usize {
        self.observations.clear();
        self.goals.clear();
        self.student_actions.clear();
        let mut n_rows = 0;
        for query in queries {
            for map in maps.of_student(query.proposed_action.len()) {
                let (observation, goal) = map.teacher_state(&query.observation, &query.goal);
                self.observations.extend_from_slice(observation);
                self.goals.extend_from_slice(goal);
                self.student_actions.extend_from_slice(map.arm_action(&query.proposed_action));
                n_rows += 1;
            }
        }
        n_rows
    }

    /// One pass of the actor over all states, one of the critic over all states with both actions.
    fn run(&mut self, n_rows: usize, n_action: usize) {
        self.actions.clear();
        self.actions.resize(n_rows * n_action, 0.0);
        self.policy.act(&self.observations, &self.goals, &mut self.actions);
        self.actions.extend_from_slice(&self.student_actions);
        self.observations.extend_from_within(..);
        self.goals.extend_from_within(..);
        self.q.clear();
        self.q.resize(2 * n_rows, 0.0);
        self.policy.q(&self.observations, &self.goals, &self.actions, &mut self.q);
    }
}

impl Opinions<'_> {
    /// What the teacher thinks of every arm of the next query, which is `query`.
    ///
    /// # Errors
    /// When one of its numbers is not finite: no procedure can compare it.
    pub(super) fn next(&mut self, maps: &Maps, query: &StepQuery) -> Result<Vec<ArmAdvice>, Error> {
        let first = self.next_row;
        self.next_row += maps.of_student(query.proposed_action.len()).len();
        let arms: Vec<ArmAdvice> = (first..self.next_row).map(|row| self.arm(row)).collect();
        if arms.iter().all(is_finite) {
            Ok(arms)
        } else {
            Err(Error::NotFinite { episode: query.episode, step: query.step })
        }
    }

    fn arm(&self, row: usize) -> ArmAdvice {
        let (of_teacher, of_student) = self.judge.actions.split_at(self.judge.actions.len() / 2);
        let (q_teacher, q_student) = self.judge.q.split_at(self.judge.q.len() / 2);
        let action = row * self.n_action..(row + 1) * self.n_action;
        judge_arm(&of_teacher[action.clone()], &of_student[action], q_teacher[row], q_student[row])
    }
}

fn is_finite(arm: &ArmAdvice) -> bool {
    let values = [&arm.q_teacher, &arm.q_student, &arm.importance, &arm.distance];
    arm.teacher_action.iter().chain(values).all(|x| x.is_finite())
}
