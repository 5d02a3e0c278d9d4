//! A policy: actor and critic, the normalisation of their inputs, and metadata.

use std::collections::BTreeMap;

use sha2::{Digest as _, Sha256};
use tandem_core::TaskSpec;
use tandem_core::text::hex;
use tandem_core::work::PublishedActor;

use crate::error::Error;
use crate::inference::{Actor, Critic};
use crate::mlp::MlpShape;
use crate::normalizer::NormalizerSnapshot;
use crate::validation::{
    check_heads, check_network_size, check_normalizer, check_parameters, check_size,
};

pub use crate::validation::{MAX_HEADS, MAX_HIDDEN, MAX_HIDDEN_LAYERS};

/// A trained policy: the networks that choose and value actions, with everything needed to evaluate them.
#[derive(Debug, Clone, PartialEq)]
pub struct Policy {
    /// The task.
    pub task: TaskSpec,
    /// Units of each hidden layer of both networks.
    pub n_hidden: usize,
    /// Number of hidden layers of both networks.
    pub n_hidden_layers: usize,
    /// Number of values that the critic returns: 1, of the joint reward, or one per arm.
    pub n_heads: usize,
    /// Parameters of the actor, shape `[n_parameters]` of [`Policy::actor_shape`].
    pub actor: Vec<f32>,
    /// Parameters of the critic, shape `[n_parameters]` of [`Policy::critic_shape`].
    pub critic: Vec<f32>,
    /// Normalisation of observations, shape `[n_observation]`.
    pub observation_normalizer: NormalizerSnapshot,
    /// Normalisation of goals, shape `[n_goal]`.
    pub goal_normalizer: NormalizerSnapshot,
    /// Free-form entries about training and success rates. The entries that the file format defines are not included.
    pub metadata: BTreeMap<String, String>,
}

/// The metadata entry of a policy without a critic, whose values are all 0, such as an actor from another program.
pub const NO_CRITIC: (&str, &str) = ("critic", "none");

/// The metadata entry of a policy whose training episodes differed in their worlds: how much, in (0, 1].
pub const RANDOMIZATION_KEY: &str = "randomization";

/// One named array of a policy.
#[derive(Debug, Clone, PartialEq)]
pub struct Tensor<'a> {
    /// Name in a policy file.
    pub name: String,
    /// Shape, row-major.
    pub shape: Vec<usize>,
    /// Numbers, in row-major order.
    pub data: &'a [f32],
}

impl Policy {
    /// Returns the sizes of the actor.
    #[must_use]
    pub fn actor_shape(&self) -> MlpShape {
        MlpShape::actor(&self.task, self.n_hidden, self.n_hidden_layers)
    }

    /// Returns the sizes of the critic.
    #[must_use]
    pub fn critic_shape(&self) -> MlpShape {
        MlpShape::critic(&self.task, self.n_hidden, self.n_hidden_layers, self.n_heads)
    }

    /// Creates the actor, which chooses actions.
    ///
    /// # Errors
    /// Returns an error if a size is out of range, or a vector has the wrong length or contains an invalid number.
    pub fn actor(&self) -> Result<Actor, Error> {
        Actor::new(&self.task, self.published(0))
    }

    /// Creates the critic, which values actions.
    ///
    /// # Errors
    /// Returns an error if a size is out of range, or a vector has the wrong length or contains an invalid number.
    pub fn critic(&self) -> Result<Critic, Error> {
        let (observation, goal) =
            (self.observation_normalizer.clone(), self.goal_normalizer.clone());
        Critic::new(&self.task, &self.critic_shape(), &self.critic, observation, goal)
    }

    /// Returns true unless the metadata says that the policy has no critic; see [`NO_CRITIC`].
    #[must_use]
    pub fn has_critic(&self) -> bool {
        let (key, value) = NO_CRITIC;
        self.metadata.get(key).is_none_or(|critic| critic != value)
    }

    /// Returns the actor in the form that a learner publishes to workers, as version `version`.
    #[must_use]
    pub fn published(&self, version: u64) -> PublishedActor {
        PublishedActor {
            version,
            n_hidden: self.n_hidden,
            n_hidden_layers: self.n_hidden_layers,
            actor: self.actor.clone(),
            observation_mean: self.observation_normalizer.mean.clone(),
            observation_std: self.observation_normalizer.std.clone(),
            goal_mean: self.goal_normalizer.mean.clone(),
            goal_std: self.goal_normalizer.std.clone(),
            gate: None,
        }
    }

    /// Validates sizes, lengths and numbers.
    ///
    /// # Errors
    /// Returns an error if a size is out of range, the critic has neither one value nor one for each arm, a vector has
    /// the wrong length, a number is not finite, or a standard deviation is not positive.
    pub fn check(&self) -> Result<(), Error> {
        check_network_size(self.n_hidden, self.n_hidden_layers)?;
        check_size("n_heads", self.n_heads, MAX_HEADS)?;
        check_heads(self.n_heads, self.task.n_arms())?;
        check_parameters("actor", &self.actor, self.actor_shape().n_parameters())?;
        check_parameters("critic", &self.critic, self.critic_shape().n_parameters())?;
        let (n_observation, n_goal) = (self.task.n_observation(), self.task.n_goal());
        check_normalizer(
            ["observation mean", "observation std"],
            &self.observation_normalizer,
            n_observation,
        )?;
        check_normalizer(["goal mean", "goal std"], &self.goal_normalizer, n_goal)
    }

    /// Returns all tensors in the order of the file format: actor, critic, observation and goal normalisation.
    ///
    /// # Panics
    /// If a parameter vector is too short for its network; see [`Policy::check`].
    #[must_use]
    pub fn tensors(&self) -> Vec<Tensor<'_>> {
        let mut tensors = network_tensors("actor", &self.actor_shape(), &self.actor);
        tensors.extend(network_tensors("critic.0", &self.critic_shape(), &self.critic));
        let (observation, goal) = (&self.observation_normalizer, &self.goal_normalizer);
        tensors.extend(normalizer_tensors([
            [&observation.mean, &observation.std],
            [&goal.mean, &goal.std],
        ]));
        tensors
    }

    /// Computes the SHA-256 digest over the names and little-endian numbers of all [`tensors`](Self::tensors), in
    /// hexadecimal.
    ///
    /// # Panics
    /// If a parameter vector is too short for its network; see [`Policy::check`].
    #[must_use]
    pub fn digest(&self) -> String {
        digest_of(&self.tensors())
    }
}

/// Returns the digest of a published actor: [`Policy::digest`] over the tensors of the actor and of the normalisation
/// alone.
///
/// # Panics
/// If the parameter vector is too short for the network; see [`Actor::new`].
#[must_use]
pub fn actor_digest(task: &TaskSpec, published: &PublishedActor) -> String {
    let shape = MlpShape::actor(task, published.n_hidden, published.n_hidden_layers);
    let mut tensors = network_tensors("actor", &shape, &published.actor);
    tensors.extend(normalizer_tensors([
        [&published.observation_mean, &published.observation_std],
        [&published.goal_mean, &published.goal_std],
    ]));
    digest_of(&tensors)
}

fn digest_of(tensors: &[Tensor<'_>]) -> String {
    let mut hasher = Sha256::new();
    for tensor in tensors {
        hasher.update(tensor.name.as_bytes());
        hasher.update(little_endian(tensor.data));
    }
    hex(&hasher.finalize())
}

/// Returns the tensors of the normalisation, given mean and standard deviation of observations, then of goals.
fn normalizer_tensors(normalizers: [[&[f32]; 2]; 2]) -> impl Iterator<Item = Tensor<'_>> {
    ["observation", "goal"].into_iter().zip(normalizers).flat_map(|(name, parts)| {
        ["mean", "std"].into_iter().zip(parts).map(move |(part, data)| Tensor {
            name: format!("normalizer.{name}.{part}"),
            shape: vec![data.len()],
            data,
        })
    })
}

/// Splits a network's flat parameters into the tensors of its layers.
fn network_tensors<'a>(prefix: &str, shape: &MlpShape, parameters: &'a [f32]) -> Vec<Tensor<'a>> {
    let layer_tensors = |layer| {
        let (n_out, n_in) = (shape.layer_output(layer), shape.layer_input(layer));
        let tensor = |part: &str, shape, data| Tensor {
            name: format!("{prefix}.layers.{layer}.{part}"),
            shape,
            data,
        };
        [
            tensor("weight", vec![n_out, n_in], &parameters[shape.weight(layer)]),
            tensor("bias", vec![n_out], &parameters[shape.bias(layer)]),
        ]
    };
    (0..shape.n_layers()).flat_map(layer_tensors).collect()
}

/// Encodes `numbers` as little-endian bytes, as in files and digests.
pub(crate) fn little_endian(numbers: &[f32]) -> Vec<u8> {
    numbers.iter().flat_map(|number| number.to_le_bytes()).collect()
}

#[cfg(test)]
impl Policy {
    /// Creates a small policy with arbitrary numbers and two hidden layers of 32 units.
    pub(crate) fn sample(task: impl Into<TaskSpec>, n_heads: usize) -> Self {
        let task = task.into();
        use tandem_core::rng::uniform;
        use tandem_core::{Stream, episode_rng};

        let mut rng = episode_rng(11, 0, Stream::Initialisation);
        let (actor, critic) =
            (MlpShape::actor(&task, 32, 2), MlpShape::critic(&task, 32, 2, n_heads));
        let (actor, critic) = (actor.initialise(&mut rng), critic.initialise(&mut rng));
        let mut normalizer = |size: usize| NormalizerSnapshot {
            mean: (0..size).map(|_| uniform(&mut rng, -0.2, 0.2)).collect(),
            std: (0..size).map(|_| uniform(&mut rng, 0.01, 0.6)).collect(),
        };
        let (observation_normalizer, goal_normalizer) =
            (normalizer(task.n_observation()), normalizer(task.n_goal()));
        let metadata =
            BTreeMap::from([("trained".to_owned(), "for a test, \"quoted\"".to_owned())]);
        Self {
            task,
            n_hidden: 32,
            n_hidden_layers: 2,
            n_heads,
            actor,
            critic,
            observation_normalizer,
            goal_normalizer,
            metadata,
        }
    }
}
