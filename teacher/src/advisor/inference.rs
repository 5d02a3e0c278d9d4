//! Batched inference with the teacher's networks.

use tandem_core::{ArmAdvice, StepQuery};

use crate::batch::Batch;
use crate::error::Error;
use crate::maps::Maps;
use crate::policy::AnyPolicy;
use crate::procedures::score_arm;

/// The teacher's policy with the buffers of a batch.
pub(super) struct TeacherInference {
    policy: AnyPolicy,
    /// The length of an action of one arm.
    n_action: usize,
    batch: Batch,
}

impl TeacherInference {
    pub(super) fn new(policy: AnyPolicy) -> Self {
        let n_action = policy.task().n_action();
        Self { policy, n_action, batch: Batch::default() }
    }

    /// Scores each arm of each of `queries`, with nothing overridden. Returns one result for each query.
    ///
    /// # Errors
    /// Per query: when the policy cannot be evaluated, or returns a number that is not finite, which no procedure can
    /// compare.
    pub(super) fn score<'a>(
        &mut self,
        maps: &Maps,
        queries: impl Iterator<Item = &'a StepQuery> + Clone,
    ) -> Vec<Result<Vec<ArmAdvice>, Error>> {
        self.gather(maps, queries.clone());
        if let Err(error) = self.policy.evaluate(&mut self.batch) {
            return queries.map(|_| Err(error.clone().into())).collect();
        }
        let mut next_row = 0;
        let score = |query: &StepQuery| {
            let rows = next_row..next_row + maps.of_student(query.proposed_action.len()).len();
            next_row = rows.end;
            let arms: Vec<ArmAdvice> = rows.map(|row| self.score_row(row)).collect();
            if arms.iter().all(is_finite) {
                Ok(arms)
            } else {
                Err(Error::NotFinite { episode: query.episode, step: query.step })
            }
        };
        queries.map(score).collect()
    }

    /// Copies the states and the students' actions into rows.
    fn gather<'a>(&mut self, maps: &Maps, queries: impl Iterator<Item = &'a StepQuery>) {
        let batch = &mut self.batch;
        batch.observations.clear();
        batch.goals.clear();
        batch.student_actions.clear();
        batch.n_rows = 0;
        for query in queries {
            for map in maps.of_student(query.proposed_action.len()) {
                let (observation, goal) = map.teacher_state(&query.observation, &query.goal);
                batch.observations.extend_from_slice(observation);
                batch.goals.extend_from_slice(goal);
                batch.student_actions.extend_from_slice(map.arm_action(query.judged()));
                batch.n_rows += 1;
            }
        }
    }

    fn score_row(&self, row: usize) -> ArmAdvice {
        let (teacher_actions, student_actions) =
            self.batch.actions.split_at(self.batch.actions.len() / 2);
        let (q_teacher, q_student) = self.batch.q.split_at(self.batch.q.len() / 2);
        let action = row * self.n_action..(row + 1) * self.n_action;
        let (teacher, student) = (&teacher_actions[action.clone()], &student_actions[action]);
        score_arm(teacher, student, q_teacher[row], q_student[row])
    }
}

fn is_finite(arm: &ArmAdvice) -> bool {
    let values = [&arm.q_teacher, &arm.q_student, &arm.importance, &arm.distance];
    arm.teacher_action.iter().chain(values).all(|x| x.is_finite())
}
