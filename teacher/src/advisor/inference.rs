//! Batched inference with the teacher's networks.

use tandem_core::{ArmAdvice, StepQuery};

use crate::error::Error;
use crate::maps::Maps;
use crate::policy::TeacherPolicy;
use crate::procedures::score_arm;

/// The teacher's networks with the buffers of a batch. A row is one arm of one step.
pub(super) struct TeacherInference {
    policy: Box<dyn TeacherPolicy>,
    /// Length of an arm's action.
    n_action: usize,
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

impl TeacherInference {
    pub(super) fn new(policy: Box<dyn TeacherPolicy>) -> Self {
        Self {
            n_action: policy.layout().n_action(),
            policy,
            observations: Vec::new(),
            goals: Vec::new(),
            student_actions: Vec::new(),
            actions: Vec::new(),
            q: Vec::new(),
        }
    }

    /// Scores each arm of each of `queries`, with nothing overridden. Returns one result for each query.
    ///
    /// # Errors
    /// Per query: when the networks return a number that is not finite, which no procedure can compare.
    pub(super) fn score<'a>(
        &mut self,
        maps: &Maps,
        queries: impl Iterator<Item = &'a StepQuery> + Clone,
    ) -> Vec<Result<Vec<ArmAdvice>, Error>> {
        let n_rows = self.gather(maps, queries.clone());
        self.run(n_rows);
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

    /// Copies the states and the students' actions into rows, and returns their number.
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

    /// Runs the actor once on all states, and the critic once on all states with both actions.
    fn run(&mut self, n_rows: usize) {
        self.actions.clear();
        self.actions.resize(self.student_actions.len(), 0.0);
        self.policy.act(&self.observations, &self.goals, &mut self.actions);
        self.actions.extend_from_slice(&self.student_actions);
        self.observations.extend_from_within(..);
        self.goals.extend_from_within(..);
        self.q.clear();
        self.q.resize(2 * n_rows, 0.0);
        self.policy.q(&self.observations, &self.goals, &self.actions, &mut self.q);
    }

    fn score_row(&self, row: usize) -> ArmAdvice {
        let n_action = self.n_action;
        let (teacher_actions, student_actions) = self.actions.split_at(self.actions.len() / 2);
        let (q_teacher, q_student) = self.q.split_at(self.q.len() / 2);
        let action = row * n_action..(row + 1) * n_action;
        let (teacher, student) = (&teacher_actions[action.clone()], &student_actions[action]);
        score_arm(teacher, student, q_teacher[row], q_student[row])
    }
}

fn is_finite(arm: &ArmAdvice) -> bool {
    let values = [&arm.q_teacher, &arm.q_student, &arm.importance, &arm.distance];
    arm.teacher_action.iter().chain(values).all(|x| x.is_finite())
}
