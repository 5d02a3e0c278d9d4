//! The ensemble of critics of strategy `ts2c:T`. Its disagreement marks the steps on which the value of the student's
//! action is uncertain (after TS2C, Xue et al. 2023).
//!
//! The critics are small, differ in their initialisation, and learn the targets of the student's critic on the same
//! batches. Where they have seen data they agree; elsewhere each extrapolates in its own way (Lakshminarayanan et al.
//! 2017). The student itself does not use them.

use tandem_core::work::PublishedGate;
use tandem_core::{Stream, TaskSpec, episode_rng};
use tandem_policy::{
    Adam, Matrix, MatrixMut, MlpShape, Workspace, all_finite, backward_parameters, forward,
};

use crate::ddpg::{CriticBatch, DdpgConfig};

/// Number of critics.
const N_CRITICS: u64 = 3;
/// Units of each hidden layer.
const N_HIDDEN: usize = 64;
/// Number of hidden layers.
const N_HIDDEN_LAYERS: usize = 2;
/// The first number of a critic in the stream of initialisations; actor and critic of the student have 0 and 1.
const FIRST_NUMBER: u64 = 2;

/// Three critics of two hidden layers with 64 units each, and their optimisers.
#[derive(Debug, Clone)]
pub struct CriticEnsemble {
    shape: MlpShape,
    batch_size: usize,
    members: Vec<Member>,
    workspace: Workspace,
    /// Values of a batch, shape `[b, n_heads]`.
    q: Vec<f32>,
    /// Gradient of the loss with respect to `q`.
    q_gradient: Vec<f32>,
    gradient: Vec<f32>,
}

#[derive(Debug, Clone)]
struct Member {
    parameters: Vec<f32>,
    adam: Adam,
}

impl CriticEnsemble {
    /// Creates critics for `task` with `n_heads` values, initialised from `run_seed`.
    #[must_use]
    pub fn new(config: &DdpgConfig, task: &TaskSpec, n_heads: usize, run_seed: u64) -> Self {
        let shape = MlpShape::critic(task, N_HIDDEN, N_HIDDEN_LAYERS, n_heads);
        let b = config.transitions_per_update();
        let n_parameters = shape.n_parameters();
        let member = |idx| {
            let mut rng = episode_rng(run_seed, FIRST_NUMBER + idx, Stream::Initialisation);
            let adam = Adam::new(n_parameters, config.critic_learning_rate);
            Member { parameters: shape.initialise(&mut rng), adam }
        };
        Self {
            members: (0..N_CRITICS).map(member).collect(),
            batch_size: config.batch_size,
            workspace: Workspace::new(&shape, b),
            q: vec![0.0; b * n_heads],
            q_gradient: vec![0.0; b * n_heads],
            gradient: vec![0.0; n_parameters],
            shape,
        }
    }

    /// Makes one gradient step of every critic toward the targets of `batch`. Returns true if all parameters are
    /// finite.
    ///
    /// # Panics
    /// When the batch has another size.
    #[must_use]
    pub fn update(&mut self, batch: CriticBatch<'_>) -> bool {
        let Self { shape, batch_size, members, workspace, q, q_gradient, gradient } = self;
        let n_rows = q.len() / shape.n_output;
        let inputs = Matrix::new(batch.inputs, n_rows, shape.n_input);
        assert_eq!(batch.targets.len(), q.len(), "targets for another number of heads");
        let mut are_finite = true;
        for Member { parameters, adam } in members {
            let mut values = MatrixMut::new(q, n_rows, shape.n_output);
            forward(shape, parameters, inputs, workspace, &mut values);
            for ((slope, value), target) in q_gradient.iter_mut().zip(&*q).zip(batch.targets) {
                *slope = 2.0 * (value - target) / *batch_size as f32;
            }
            backward_parameters(shape, parameters, inputs, workspace, q_gradient, gradient);
            adam.step(parameters, gradient);
            are_finite &= all_finite(parameters);
        }
        are_finite
    }

    /// Returns the critics for the workers, with the threshold of the strategy.
    #[must_use]
    pub fn publish(&self, threshold: f32) -> PublishedGate {
        let parameters = self.members.iter().flat_map(|member| &member.parameters);
        PublishedGate {
            n_critics: self.members.len(),
            n_hidden: self.shape.n_hidden,
            n_hidden_layers: self.shape.n_hidden_layers,
            n_heads: self.shape.n_output,
            critics: parameters.copied().collect(),
            threshold,
        }
    }

    /// Returns every vector that the next update depends on, by name, in a fixed order.
    #[must_use]
    pub fn state(&self) -> Vec<(String, &[f32])> {
        let mut state = Vec::new();
        for (idx, member) in self.members.iter().enumerate() {
            let [first, second] = member.adam.moments();
            let vectors =
                [("parameters", &*member.parameters), ("first", first), ("second", second)];
            state.extend(vectors.map(|(name, values)| (format!("{idx}.{name}"), values)));
        }
        state
    }

    /// Restores the vectors returned by [`state`](Self::state), in its order, after `n_updates` updates.
    ///
    /// # Errors
    /// Describes the mismatch: another number of vectors, or the first one of another length. Nothing changes then.
    pub fn restore(&mut self, stored: &[Vec<f32>], n_updates: u64) -> Result<(), String> {
        let expected = self.shape.n_parameters();
        if stored.len() != 3 * self.members.len() {
            return Err(format!("{} vectors of critics, not 3 for each", stored.len()));
        }
        if let Some(idx) = stored.iter().position(|vector| vector.len() != expected) {
            let got = stored[idx].len();
            return Err(format!("vector {idx} of the critics has {got} numbers, not {expected}"));
        }
        for (member, vectors) in self.members.iter_mut().zip(stored.chunks_exact(3)) {
            member.parameters.copy_from_slice(&vectors[0]);
            member.adam.restore(n_updates, [&vectors[1], &vectors[2]]);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::rng::uniform;
    use tandem_core::{Layout, Task};

    use super::*;

    const B: usize = 32;

    fn ensemble() -> CriticEnsemble {
        let config = DdpgConfig { batch_size: B, ..DdpgConfig::default() };
        CriticEnsemble::new(&config, &Layout::new(Task::Push, 2).into(), 2, 1)
    }

    /// The largest deviation of a critic's values from the ensemble's mean, over a batch.
    fn disagreement(ensemble: &mut CriticEnsemble, inputs: &[f32]) -> f32 {
        let CriticEnsemble { shape, members, workspace, .. } = ensemble;
        let mut values = vec![vec![0.0; 2 * B]; members.len()];
        for (member, values) in members.iter().zip(&mut values) {
            let inputs = Matrix::new(inputs, B, shape.n_input);
            let mut output = MatrixMut::new(values, B, 2);
            forward(shape, &member.parameters, inputs, workspace, &mut output);
        }
        let spread = |idx: usize| {
            let column: Vec<f32> = values.iter().map(|values| values[idx]).collect();
            column.iter().copied().fold(f32::MIN, f32::max)
                - column.iter().copied().fold(f32::MAX, f32::min)
        };
        (0..2 * B).map(spread).fold(0.0, f32::max)
    }

    #[test]
    fn critics_agree_where_they_have_learned_and_differ_elsewhere() {
        let mut ensemble = ensemble();
        let mut rng = episode_rng(3, 0, Stream::Replay);
        let mut draw =
            |n: usize| -> Vec<f32> { (0..n).map(|_| uniform(&mut rng, -1.0, 1.0)).collect() };
        let n_input = ensemble.shape.n_input;
        let (known, unknown, targets) = (draw(B * n_input), draw(B * n_input), draw(2 * B));
        let before = disagreement(&mut ensemble, &known);
        for _ in 0..300 {
            assert!(ensemble.update(CriticBatch { inputs: &known, targets: &targets }));
        }
        let (seen, unseen) =
            (disagreement(&mut ensemble, &known), disagreement(&mut ensemble, &unknown));
        assert!(seen < 0.2 * before && seen < 0.2 * unseen, "{before} {seen} {unseen}");
    }

    #[test]
    fn a_restored_ensemble_continues_with_the_same_bits() {
        let mut ensemble = ensemble();
        let inputs = vec![0.25; B * ensemble.shape.n_input];
        let batch = CriticBatch { inputs: &inputs, targets: &[-1.0; 2 * B] };
        assert!(ensemble.update(batch));
        let stored: Vec<Vec<f32>> =
            ensemble.state().into_iter().map(|(_, vector)| vector.to_vec()).collect();
        let mut restored = self::ensemble();
        restored.restore(&stored, 1).expect("fits");
        assert!(ensemble.update(batch) && restored.update(batch));
        assert_eq!(restored.state(), ensemble.state());
        assert!(restored.restore(&stored[1..], 1).is_err());
        let gate = ensemble.publish(0.5);
        assert_eq!((gate.n_critics, gate.critics.len()), (3, 3 * stored[0].len()));
    }

    #[test]
    fn an_update_says_when_parameters_are_no_longer_finite() {
        let mut ensemble = ensemble();
        let mut inputs = vec![0.25; B * ensemble.shape.n_input];
        assert!(ensemble.update(CriticBatch { inputs: &inputs, targets: &[-1.0; 2 * B] }));
        inputs[3] = f32::NAN;
        assert!(!ensemble.update(CriticBatch { inputs: &inputs, targets: &[-1.0; 2 * B] }));
    }
}
