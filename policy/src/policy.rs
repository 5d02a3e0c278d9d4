//! A whole policy: both networks, how their inputs are normalised, and how it came to be.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use sha2::{Digest as _, Sha256};
use tandem_core::Layout;
use tandem_core::work::PublishedActor;

use crate::elementwise::all_finite;
use crate::error::Error;
use crate::inference::{Actor, Critic};
use crate::mlp::MlpShape;
use crate::normalizer::NormalizerSnapshot;

/// Most units of a layer that are accepted.
pub const MAX_HIDDEN: usize = 1 << 14;
/// Most hidden layers that are accepted.
pub const MAX_HIDDEN_LAYERS: usize = 64;
/// Most heads of a critic that are accepted.
pub const MAX_HEADS: usize = 64;

/// Everything that chooses and values actions.
#[derive(Debug, Clone, PartialEq)]
pub struct Policy {
    /// Task and arms.
    pub layout: Layout,
    /// Units of each hidden layer, of both networks.
    pub n_hidden: usize,
    /// Hidden layers of both networks.
    pub n_hidden_layers: usize,
    /// Values that the critic gives: 1, or one per arm.
    pub n_heads: usize,
    /// Parameters of the shape [`Policy::actor_shape`].
    pub actor: Vec<f32>,
    /// Parameters of the shape [`Policy::critic_shape`].
    pub critic: Vec<f32>,
    /// How observations are normalised.
    pub observation_normalizer: NormalizerSnapshot,
    /// How goals are normalised.
    pub goal_normalizer: NormalizerSnapshot,
    /// How the policy was trained and how it did. The format's own entries are not among them.
    pub metadata: BTreeMap<String, String>,
}

/// One named array of a policy.
#[derive(Debug, Clone, PartialEq)]
pub struct Tensor<'a> {
    /// Its name in a policy file.
    pub name: String,
    /// Its shape; row-major.
    pub shape: Vec<usize>,
    /// Its numbers.
    pub data: &'a [f32],
}

impl Policy {
    /// The actor's sizes.
    #[must_use]
    pub const fn actor_shape(&self) -> MlpShape {
        MlpShape::actor(self.layout, self.n_hidden, self.n_hidden_layers)
    }

    /// The critic's sizes.
    #[must_use]
    pub const fn critic_shape(&self) -> MlpShape {
        MlpShape::critic(self.layout, self.n_hidden, self.n_hidden_layers, self.n_heads)
    }

    /// What chooses actions.
    ///
    /// # Errors
    /// When a vector has the wrong length or holds a number that cannot be used.
    pub fn actor(&self) -> Result<Actor, Error> {
        Actor::new(self.layout, self.published(0))
    }

    /// What values actions.
    ///
    /// # Errors
    /// When a vector has the wrong length or holds a number that cannot be used.
    pub fn critic(&self) -> Result<Critic, Error> {
        let (observation, goal) =
            (self.observation_normalizer.clone(), self.goal_normalizer.clone());
        Critic::new(self.layout, &self.critic_shape(), &self.critic, observation, goal)
    }

    /// The actor as a learner hands it to its workers, under the number `version`.
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
        }
    }

    /// Checks what the types cannot.
    ///
    /// # Errors
    /// When a vector has the wrong length or holds a number that cannot be used.
    pub fn check(&self) -> Result<(), Error> {
        check_network_size(self.n_hidden, self.n_hidden_layers)?;
        check_size("n_heads", self.n_heads, MAX_HEADS)?;
        check_parameters("actor", &self.actor, self.actor_shape().n_parameters())?;
        check_parameters("critic", &self.critic, self.critic_shape().n_parameters())?;
        let (n_observation, n_goal) = (self.layout.n_observation(), self.layout.n_goal());
        check_normalizer(
            ["observation mean", "observation std"],
            &self.observation_normalizer,
            n_observation,
        )?;
        check_normalizer(["goal mean", "goal std"], &self.goal_normalizer, n_goal)
    }

    /// All tensors in their fixed order: actor, critic, observation and goal normaliser.
    ///
    /// # Panics
    /// When [`Policy::check`] would fail.
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

    /// SHA-256 over all tensors in their fixed order, each as its name and its little-endian numbers; hexadecimal.
    ///
    /// # Panics
    /// When [`Policy::check`] would fail.
    #[must_use]
    pub fn digest(&self) -> String {
        digest_of(&self.tensors())
    }
}

/// Returns the digest of a published actor: [`Policy::digest`] over the tensors of the actor and the normalisers alone.
///
/// # Panics
/// When [`Actor::new`] would fail.
#[must_use]
pub fn actor_digest(layout: Layout, published: &PublishedActor) -> String {
    let shape = MlpShape::actor(layout, published.n_hidden, published.n_hidden_layers);
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
    hasher.finalize().iter().fold(String::new(), |mut text, byte| {
        write!(text, "{byte:02x}").expect("a string takes any text");
        text
    })
}

/// Returns the tensors of the normalisers, given mean and standard deviation of observations, then of goals.
fn normalizer_tensors(normalizers: [[&[f32]; 2]; 2]) -> impl Iterator<Item = Tensor<'_>> {
    ["observation", "goal"].into_iter().zip(normalizers).flat_map(|(name, parts)| {
        ["mean", "std"].into_iter().zip(parts).map(move |(part, data)| Tensor {
            name: format!("normalizer.{name}.{part}"),
            shape: vec![data.len()],
            data,
        })
    })
}

/// The tensors that a network's flat parameters consist of, in their order.
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

/// The bytes of `numbers` as files and digests have them.
pub(crate) fn little_endian(numbers: &[f32]) -> Vec<u8> {
    numbers.iter().flat_map(|number| number.to_le_bytes()).collect()
}

pub(crate) fn check_network_size(n_hidden: usize, n_hidden_layers: usize) -> Result<(), Error> {
    check_size("n_hidden", n_hidden, MAX_HIDDEN)?;
    check_size("n_hidden_layers", n_hidden_layers, MAX_HIDDEN_LAYERS)
}

const fn check_size(name: &'static str, got: usize, most: usize) -> Result<(), Error> {
    if got == 0 || got > most { Err(Error::Size { name, got, most }) } else { Ok(()) }
}

pub(crate) fn check_parameters(
    name: &'static str,
    parameters: &[f32],
    expected: usize,
) -> Result<(), Error> {
    if parameters.len() != expected {
        return Err(Error::WrongLength { name, got: parameters.len(), expected });
    }
    if all_finite(parameters) { Ok(()) } else { Err(Error::NotFinite { name }) }
}

pub(crate) fn check_normalizer(
    [mean, std]: [&'static str; 2],
    normalizer: &NormalizerSnapshot,
    size: usize,
) -> Result<(), Error> {
    check_parameters(mean, &normalizer.mean, size)?;
    check_parameters(std, &normalizer.std, size)?;
    if normalizer.std.iter().all(|std| *std > 0.0) {
        Ok(())
    } else {
        Err(Error::NotPositive { name: std })
    }
}

#[cfg(test)]
impl Policy {
    /// A small policy with arbitrary numbers, two hidden layers of 32 units.
    pub(crate) fn sample(layout: Layout, n_heads: usize) -> Self {
        use tandem_core::rng::uniform;
        use tandem_core::{Stream, episode_rng};

        let mut rng = episode_rng(11, 0, Stream::Initialisation);
        let (actor, critic) =
            (MlpShape::actor(layout, 32, 2), MlpShape::critic(layout, 32, 2, n_heads));
        let (actor, critic) = (actor.initialise(&mut rng), critic.initialise(&mut rng));
        let mut normalizer = |size: usize| NormalizerSnapshot {
            mean: (0..size).map(|_| uniform(&mut rng, -0.2, 0.2)).collect(),
            std: (0..size).map(|_| uniform(&mut rng, 0.01, 0.6)).collect(),
        };
        let (observation_normalizer, goal_normalizer) =
            (normalizer(layout.n_observation()), normalizer(layout.n_goal()));
        let metadata =
            BTreeMap::from([("trained".to_owned(), "for a test, \"quoted\"".to_owned())]);
        Self {
            layout,
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
