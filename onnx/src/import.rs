//! From models to a policy.
//!
//! A policy file has one form of network (`docs/policy-format.md`): inputs clipped after normalisation, ReLU between
//! layers of equal width, tanh after the actor's last. Other networks are brought to this form where that changes no
//! more than the rounding of their outputs: smaller layers are padded with units of weight 0, missing layers are
//! identities, a constant factor moves into the next layer's weight.

mod columns;
mod layers;

use std::collections::BTreeMap;

use tandem_core::TaskSpec;
use tandem_core::text::counted;
use tandem_policy::policy::{MAX_HIDDEN_LAYERS, NO_CRITIC};
use tandem_policy::{MlpShape, NormalizerSnapshot, Policy};

use crate::binding::{BoundNetwork, Role, Source, policy_columns};
use crate::error::ModelError;
use crate::metadata;
use crate::model::Model;
use columns::{Normalized, normalized};
use layers::{Dense, dense_layers};

/// Largest accepted number of parameters of a network after padding.
const MAX_PARAMETERS: usize = 1 << 24;

/// Creates the policy of an actor and, if there is one, a critic. Without one the policy is marked with [`NO_CRITIC`].
///
/// The metadata that [`export`](crate::export) wrote is restored if the policy is still the exported one.
///
/// # Errors
/// When a model does not fit `task`, or a policy file cannot represent it.
pub fn import(
    actor: &Model,
    critic: Option<&Model>,
    task: impl Into<TaskSpec>,
) -> Result<Policy, ModelError> {
    let task = &task.into();
    let actor_network = Converted::new(&BoundNetwork::new(actor, Role::Actor, task)?, Role::Actor)?;
    let critic_network = critic
        .map(|critic| Converted::new(&BoundNetwork::new(critic, Role::Critic, task)?, Role::Critic))
        .transpose()?;
    let n_heads = critic_network.as_ref().map_or(1, |critic| critic.n_output());
    check_heads(n_heads, task)?;
    let both = || [Some(&actor_network), critic_network.as_ref()].into_iter().flatten();
    let n_hidden = both().map(Converted::widest).max().unwrap_or(1);
    let n_hidden_layers = both().map(|network| network.layers.len() - 1).max().unwrap_or(1);
    let [observation, goal, _] = policy_columns(task);
    let normalizers = shared_normalizers(task, both())?;
    let critic_shape = MlpShape::critic(task, n_hidden, n_hidden_layers, n_heads);
    let actor_shape = MlpShape::actor(task, n_hidden, n_hidden_layers);
    check_size(n_hidden_layers, &[actor_shape, critic_shape])?;
    let mut policy = Policy {
        task: task.clone(),
        n_hidden,
        n_hidden_layers,
        n_heads,
        actor: actor_network.parameters(task, &actor_shape),
        critic: match &critic_network {
            Some(critic) => critic.parameters(task, &critic_shape),
            None => vec![0.0; critic_shape.n_parameters()],
        },
        observation_normalizer: snapshot(&normalizers[observation]),
        goal_normalizer: snapshot(&normalizers[goal]),
        metadata: BTreeMap::new(),
    };
    policy.check()?;
    policy.metadata = metadata_of(&policy, actor, critic);
    Ok(policy)
}

/// Checks that the network of one model fits `task` and that a policy file can represent it, so that an error of
/// [`import`] concerns both models.
///
/// # Errors
/// When the network does not fit, or a policy file cannot represent it.
pub fn check(model: &Model, role: Role, task: &TaskSpec) -> Result<(), ModelError> {
    let network = Converted::new(&BoundNetwork::new(model, role, task)?, role)?;
    match role {
        Role::Actor => Ok(()),
        Role::Critic => check_heads(network.n_output(), task),
    }
}

/// Refuses a critic with neither one value nor one for each arm.
fn check_heads(n_heads: usize, task: &TaskSpec) -> Result<(), ModelError> {
    if [1, task.n_arms()].contains(&n_heads) {
        return Ok(());
    }
    Err(ModelError::NotRepresentable(format!(
        "its critic has {n_heads} values, expected 1, or one for each of {}",
        counted(task.n_arms(), "arm")
    )))
}

/// Refuses networks that padding would make larger than a policy can be.
fn check_size(n_hidden_layers: usize, shapes: &[MlpShape]) -> Result<(), ModelError> {
    if n_hidden_layers > MAX_HIDDEN_LAYERS {
        return Err(ModelError::NotRepresentable(format!(
            "it has {n_hidden_layers} hidden layers, expected at most {MAX_HIDDEN_LAYERS}"
        )));
    }
    match shapes.iter().map(MlpShape::n_parameters).max() {
        Some(n) if n > MAX_PARAMETERS => Err(ModelError::NotRepresentable(format!(
            "with layers of equal width it has {n} parameters, expected at most {MAX_PARAMETERS}"
        ))),
        _ => Ok(()),
    }
}

fn snapshot(columns: &[[f32; 2]]) -> NormalizerSnapshot {
    NormalizerSnapshot {
        mean: columns.iter().map(|[mean, _]| *mean).collect(),
        std: columns.iter().map(|[_, std]| *std).collect(),
    }
}

fn metadata_of(policy: &Policy, actor: &Model, critic: Option<&Model>) -> BTreeMap<String, String> {
    let mut entries = BTreeMap::new();
    if actor.metadata.get(metadata::POLICY_DIGEST) == Some(&policy.digest()) {
        let training = actor.metadata.iter().filter_map(|(key, value)| {
            Some((key.strip_prefix(metadata::TRAINING)?.to_owned(), value.clone()))
        });
        entries.extend(training);
    }
    entries.insert("imported_actor".to_owned(), actor.digest.clone());
    match critic {
        Some(critic) => entries.insert("imported_critic".to_owned(), critic.digest.clone()),
        None => entries.insert(NO_CRITIC.0.to_owned(), NO_CRITIC.1.to_owned()),
    };
    entries
}

/// A network in the form of a policy file, except for padding.
struct Converted {
    /// By the network's column: its source and normalisation.
    columns: Vec<(Source, Normalized)>,
    /// Hidden layers, then the output layer.
    layers: Vec<Dense>,
}

impl Converted {
    fn new(network: &BoundNetwork, role: Role) -> Result<Self, ModelError> {
        let sources = network.sources().iter().copied();
        let columns = sources.zip(&network.network().columns).map(|(source, column)| {
            let bound = match source {
                Source::Observation(i) => network.task().observation_bound(i),
                Source::Goal(i) => network.task().goal_bound(i),
                Source::Action(_) => 1.0,
            };
            Ok((source, normalized(source, column, bound).map_err(ModelError::NotRepresentable)?))
        });
        let layers = dense_layers(network.network(), role).map_err(ModelError::NotRepresentable)?;
        Ok(Self { columns: columns.collect::<Result<_, ModelError>>()?, layers })
    }

    fn n_output(&self) -> usize {
        self.layers.last().map_or(0, |layer| layer.bias.len())
    }

    /// Returns the number of units of the widest hidden layer.
    fn widest(&self) -> usize {
        let hidden = self.layers.iter().rev().skip(1);
        hidden.map(|layer| layer.bias.len()).max().unwrap_or(1)
    }

    /// Returns the parameters of the same network with shape `shape`.
    fn parameters(&self, task: &TaskSpec, shape: &MlpShape) -> Vec<f32> {
        let mut parameters = vec![0.0; shape.n_parameters()];
        let n_missing = shape.n_layers() - self.layers.len();
        for layer in 0..shape.n_layers() {
            let (weight, bias) = (shape.weight(layer), shape.bias(layer));
            let n_in = shape.layer_input(layer);
            let is_output = layer == shape.n_hidden_layers;
            if !is_output && layer + 1 >= self.layers.len() {
                // Hidden units are not negative, so the ReLU of an identity changes nothing.
                for unit in 0..shape.n_hidden {
                    parameters[weight.start + unit * n_in + unit] = 1.0;
                }
                continue;
            }
            let source = &self.layers[if is_output { layer - n_missing } else { layer }];
            let matrix = &mut parameters[weight];
            if layer == 0 {
                self.write_first(source, task, matrix, n_in);
            } else {
                for (unit, weights) in source.rows().enumerate() {
                    matrix[unit * n_in..][..weights.len()].copy_from_slice(&weights);
                }
            }
            let offsets = match layer {
                0 => self.first_bias(source),
                _ => source.bias.clone(),
            };
            parameters[bias][..offsets.len()].copy_from_slice(&offsets);
        }
        parameters
    }

    /// Writes the first layer's weights to the columns of a policy's network. Columns of the same source add up.
    #[expect(clippy::cast_possible_truncation, reason = "weights are stored as f32")]
    fn write_first(&self, layer: &Dense, task: &TaskSpec, matrix: &mut [f32], n_in: usize) {
        let [observation, goal, action] = policy_columns(task);
        let position = |source| match source {
            Source::Observation(i) => observation.start + i,
            Source::Goal(i) => goal.start + i,
            Source::Action(i) => action.start + i,
        };
        for (unit, weights) in layer.rows().enumerate() {
            let mut row = vec![0.0_f64; n_in];
            for ((source, column), weight) in self.columns.iter().zip(weights) {
                row[position(*source)] += f64::from(weight) * column.factor;
            }
            let row = row.into_iter().map(|weight| weight as f32);
            matrix[unit * n_in..][..n_in].iter_mut().zip(row).for_each(|(to, weight)| *to = weight);
        }
    }

    /// Returns the first layer's bias with the columns' constant parts.
    #[expect(clippy::cast_possible_truncation, reason = "biases are stored as f32")]
    fn first_bias(&self, layer: &Dense) -> Vec<f32> {
        let constant_part = |weights: Vec<f32>| -> f64 {
            let columns = self.columns.iter().zip(weights);
            columns.map(|((_, column), weight)| f64::from(weight) * column.offset).sum()
        };
        let rows = layer.rows().zip(&layer.bias);
        rows.map(|(weights, bias)| (f64::from(*bias) + constant_part(weights)) as f32).collect()
    }
}

/// Returns mean and standard deviation of each number of observation and goal, on which all networks must agree. Numbers
/// that no network uses are not normalised.
fn shared_normalizers<'a>(
    task: &TaskSpec,
    networks: impl Iterator<Item = &'a Converted>,
) -> Result<Vec<[f32; 2]>, ModelError> {
    let [observation, goal, _] = policy_columns(task);
    let mut normalizers = vec![None; goal.end];
    for (source, column) in networks.flat_map(|network| &network.columns) {
        let (at, name) = match source {
            Source::Observation(i) => (observation.start + i, format!("observation {i}")),
            Source::Goal(i) => (goal.start + i, format!("goal {i}")),
            Source::Action(_) => continue,
        };
        let normalizer = [column.mean, column.std];
        if *normalizers[at].get_or_insert(normalizer) != normalizer {
            return Err(ModelError::NotRepresentable(format!(
                "{name} is normalised in two ways, a policy has one for actor and critic"
            )));
        }
    }
    Ok(normalizers.into_iter().map(|normalizer| normalizer.unwrap_or([0.0, 1.0])).collect())
}

#[cfg(test)]
mod tests;
