//! The gate on a student's queries: an ensemble of its critics.

use tandem_core::TaskSpec;
use tandem_core::work::{PublishedActor, PublishedGate};

use super::Critic;
use crate::error::Error;
use crate::mlp::MlpShape;
use crate::normalizer::NormalizerSnapshot;
use crate::validation::{check_network_size, check_parameters};

/// An ensemble of critics that decides when a student asks for advice: where they disagree about its action.
///
/// As for [`Critic`], a decision has the same bits in any batch and on every machine with fused multiply-add.
#[derive(Debug, Clone)]
pub struct QueryGate {
    critics: Vec<Critic>,
    threshold: f32,
    /// Values of an action, shape `[n_critics, n_heads]`.
    values: Vec<f32>,
}

impl QueryGate {
    /// Creates the gate that was published beside an actor; `None` if there is none.
    ///
    /// # Errors
    /// Returns an error if a size is out of range, a vector does not have the length that follows from `task` and the
    /// sizes, a number is not finite, or a standard deviation is not above 0.
    pub fn new(task: &TaskSpec, published: &PublishedActor) -> Result<Option<Self>, Error> {
        let Some(gate) = &published.gate else { return Ok(None) };
        let PublishedGate { n_critics, n_hidden, n_hidden_layers, n_heads, threshold, .. } = *gate;
        check_network_size(n_hidden, n_hidden_layers)?;
        let shape = MlpShape::critic(task, n_hidden, n_hidden_layers, n_heads);
        let n_parameters = shape.n_parameters();
        check_parameters("gate", &gate.critics, n_critics * n_parameters)?;
        let snapshot = |mean: &[f32], std: &[f32]| NormalizerSnapshot {
            mean: mean.to_vec(),
            std: std.to_vec(),
        };
        let critic = |parameters: &[f32]| {
            let observation = snapshot(&published.observation_mean, &published.observation_std);
            let goal = snapshot(&published.goal_mean, &published.goal_std);
            Critic::new(task, &shape, parameters, observation, goal)
        };
        let critics: Vec<Critic> =
            gate.critics.chunks_exact(n_parameters).map(critic).collect::<Result<_, _>>()?;
        Ok(Some(Self { values: vec![0.0; critics.len() * n_heads], critics, threshold }))
    }

    /// Returns true if the student is to ask: if, for at least one head, the population standard deviation of the
    /// critics' values of `action`, shape `[n_action]`, exceeds the threshold. Shapes: `observation` `[n_observation]`,
    /// `goal` `[n_goal]`.
    ///
    /// # Panics
    /// If the lengths do not match the task.
    pub fn asks(&mut self, observation: &[f32], goal: &[f32], action: &[f32]) -> bool {
        let Some(n_heads) = self.critics.first().map(Critic::n_heads) else { return true };
        for (critic, values) in self.critics.iter_mut().zip(self.values.chunks_exact_mut(n_heads)) {
            critic.q(observation, goal, action, values);
        }
        let deviations = (0..n_heads).map(|head| {
            let values = self.values.iter().skip(head).step_by(n_heads);
            standard_deviation(values.copied())
        });
        deviations.fold(0.0, f32::max) > self.threshold
    }
}

/// Returns the standard deviation of a population of values.
fn standard_deviation(values: impl ExactSizeIterator<Item = f32> + Clone) -> f32 {
    let n = values.len() as f32;
    let mean = values.clone().sum::<f32>() / n;
    (values.map(|value| (value - mean) * (value - mean)).sum::<f32>() / n).sqrt()
}

#[cfg(test)]
mod tests {
    use tandem_core::{Layout, Task};

    use super::*;
    use crate::policy::Policy;

    const LAYOUT: Layout = Layout::new(Task::Push, 2);

    /// Publishes three critics without weights whose last biases, the values of both arms, are `values`.
    fn published(values: [[f32; 2]; 3], threshold: f32) -> PublishedActor {
        let shape = MlpShape::critic(LAYOUT, 4, 1, 2);
        let critic = |values: [f32; 2]| {
            let mut parameters = vec![0.0; shape.n_parameters()];
            let last = parameters.len() - 2;
            parameters[last..].copy_from_slice(&values);
            parameters
        };
        let gate = PublishedGate {
            n_critics: 3,
            n_hidden: 4,
            n_hidden_layers: 1,
            n_heads: 2,
            critics: values.into_iter().flat_map(critic).collect(),
            threshold,
        };
        PublishedActor { gate: Some(gate), ..Policy::sample(LAYOUT, 2).published(1) }
    }

    fn asks(published: &PublishedActor) -> bool {
        let mut gate = QueryGate::new(&LAYOUT.into(), published).unwrap().expect("a gate");
        gate.asks(&[0.5; 56], &[0.25; 6], &[0.0; 6])
    }

    #[test]
    fn the_arm_with_the_largest_disagreement_decides() {
        let agreed = [[-3.0, -5.0]; 3];
        assert!(!asks(&published(agreed, 0.0)));
        // Deviations: 0 and sqrt(6).
        let second_differs = [[-3.0, -5.0], [-3.0, -8.0], [-3.0, -2.0]];
        assert!(asks(&published(second_differs, 2.4)));
        assert!(!asks(&published(second_differs, 2.5)));
    }

    #[test]
    fn an_actor_without_a_gate_has_none_and_a_gate_that_does_not_fit_is_refused() {
        let task = TaskSpec::from(LAYOUT);
        let without = Policy::sample(LAYOUT, 2).published(1);
        assert!(QueryGate::new(&task, &without).unwrap().is_none());
        let mut published = published([[0.0; 2]; 3], 0.5);
        published.gate.as_mut().expect("a gate").critics.pop();
        let error = QueryGate::new(&task, &published).expect_err("must be refused").to_string();
        assert!(error.starts_with("gate has 857 numbers, expected 858"), "{error}");
    }
}
