//! Conversions of the parameters that a learner publishes.

use tandem_core::TaskSpec;
use tandem_core::work::{PublishedActor, PublishedGate};

use crate::error::DecodeError;
use crate::numbers::{count_within, finite_from_bytes, one_within, positive, to_bytes};
use crate::pb;

/// Largest number of units per hidden layer.
const MAX_HIDDEN: u32 = 16_384;
/// Largest number of hidden layers.
const MAX_HIDDEN_LAYERS: u32 = 64;
/// Largest number of critics of a gate.
const MAX_CRITICS: u32 = 64;

/// Encodes an actor's parameters.
///
/// # Panics
/// If a size exceeds `u32`.
#[must_use]
pub fn encode_actor(actor: &PublishedActor) -> pb::Parameters {
    pb::Parameters {
        version: actor.version,
        n_hidden: u32::try_from(actor.n_hidden).expect("a layer has fewer than 2^32 units"),
        n_layers: u32::try_from(actor.n_hidden_layers)
            .expect("a network has fewer than 2^32 layers"),
        actor: to_bytes(&actor.actor),
        observation_mean: to_bytes(&actor.observation_mean),
        observation_std: to_bytes(&actor.observation_std),
        goal_mean: to_bytes(&actor.goal_mean),
        goal_std: to_bytes(&actor.goal_std),
        ..actor.gate.as_ref().map(encode_gate).unwrap_or_default()
    }
}

/// Encodes a gate as the fields of a message that has nothing else.
fn encode_gate(gate: &PublishedGate) -> pb::Parameters {
    let count = |n: usize| u32::try_from(n).expect("networks and their layers are few");
    pb::Parameters {
        n_critics: count(gate.n_critics),
        n_critic_hidden: count(gate.n_hidden),
        n_critic_layers: count(gate.n_hidden_layers),
        n_critic_heads: count(gate.n_heads),
        critics: to_bytes(&gate.critics),
        ask_above: gate.threshold,
        ..pb::Parameters::default()
    }
}

/// Decodes the parameters of an actor for `task`.
///
/// # Errors
/// Returns an error if a length does not match the task and the network's size, a number is not finite, a standard
/// deviation is not positive or a message without critics has other fields of a gate.
pub fn decode_actor(
    parameters: &pb::Parameters,
    task: impl Into<TaskSpec>,
) -> Result<PublishedActor, DecodeError> {
    let task = task.into();
    let n_hidden = count_within("n_hidden", parameters.n_hidden, &(1..=MAX_HIDDEN))?;
    let n_layers = count_within("n_layers", parameters.n_layers, &(1..=MAX_HIDDEN_LAYERS))?;
    let (n_hidden, n_hidden_layers) = (to_usize(n_hidden), to_usize(n_layers));
    let (n_observation, n_goal) = (task.n_observation(), task.n_goal());
    let std = |field, bytes, n| positive(field, finite_from_bytes(field, bytes, n)?, n);
    Ok(PublishedActor {
        version: parameters.version,
        n_hidden,
        n_hidden_layers,
        actor: finite_from_bytes(
            "actor",
            &parameters.actor,
            n_parameters(&task, n_hidden, n_hidden_layers),
        )?,
        observation_mean: finite_from_bytes(
            "observation_mean",
            &parameters.observation_mean,
            n_observation,
        )?,
        observation_std: std("observation_std", &parameters.observation_std, n_observation)?,
        goal_mean: finite_from_bytes("goal_mean", &parameters.goal_mean, n_goal)?,
        goal_std: std("goal_std", &parameters.goal_std, n_goal)?,
        gate: decode_gate(parameters, &task)?,
    })
}

/// Decodes the gate of an actor; `None` if it has none.
fn decode_gate(
    parameters: &pb::Parameters,
    task: &TaskSpec,
) -> Result<Option<PublishedGate>, DecodeError> {
    if parameters.n_critics == 0 {
        return without_gate(parameters).map(|()| None);
    }
    let count = |field, count, most| count_within(field, count, &(1..=most)).map(to_usize);
    let n_critics = count_within("n_critics", parameters.n_critics, &(2..=MAX_CRITICS))?;
    let n_hidden = count("n_critic_hidden", parameters.n_critic_hidden, MAX_HIDDEN)?;
    let n_layers = count("n_critic_layers", parameters.n_critic_layers, MAX_HIDDEN_LAYERS)?;
    let n_arms = u32::try_from(task.n_arms()).expect("a task has few arms");
    let n_heads = count("n_critic_heads", parameters.n_critic_heads, n_arms)?;
    let n_input = task.n_observation() + task.n_goal() + task.n_action();
    let n_critics = to_usize(n_critics);
    let n_parameters = n_critics * n_mlp_parameters([n_input, n_heads], n_hidden, n_layers);
    Ok(Some(PublishedGate {
        n_critics,
        n_hidden,
        n_hidden_layers: n_layers,
        n_heads,
        critics: finite_from_bytes("critics", &parameters.critics, n_parameters)?,
        threshold: one_within("ask_above", parameters.ask_above, &(0.0..=f32::MAX))?,
    }))
}

/// Refuses fields of a gate in a message without critics.
fn without_gate(parameters: &pb::Parameters) -> Result<(), DecodeError> {
    let fields = [
        ("n_critic_hidden", parameters.n_critic_hidden != 0),
        ("n_critic_layers", parameters.n_critic_layers != 0),
        ("n_critic_heads", parameters.n_critic_heads != 0),
        ("critics", !parameters.critics.is_empty()),
        ("ask_above", parameters.ask_above.to_bits() != 0),
    ];
    match fields.iter().find(|(_, is_set)| *is_set) {
        Some((field, _)) => Err(DecodeError::new(*field, "no value without critics", "one")),
        None => Ok(()),
    }
}

/// Returns the number of parameters of an actor for `task` with `n_hidden_layers >= 1` hidden layers of `n_hidden`
/// units.
fn n_parameters(task: &TaskSpec, n_hidden: usize, n_hidden_layers: usize) -> usize {
    let ends = [task.n_observation() + task.n_goal(), task.n_action()];
    n_mlp_parameters(ends, n_hidden, n_hidden_layers)
}

/// Returns the number of parameters of a network with this many inputs and outputs.
const fn n_mlp_parameters(
    [n_input, n_output]: [usize; 2],
    n_hidden: usize,
    n_hidden_layers: usize,
) -> usize {
    let first = (n_input + 1) * n_hidden;
    let inner = (n_hidden + 1) * n_hidden * (n_hidden_layers - 1);
    first + inner + (n_hidden + 1) * n_output
}

/// Converts a count that is known to be small.
fn to_usize(count: u32) -> usize {
    usize::try_from(count).expect("indices have 32 bits or more")
}

#[cfg(test)]
mod tests {
    use prost::Message as _;
    use tandem_core::{Layout, Task};

    use super::*;

    const LAYOUT: Layout = Layout::new(Task::Push, 2);

    fn actor() -> PublishedActor {
        let ramp = |n: u16| (0..n).map(|i| f32::from(i) / 64.0 - 1.0).collect();
        PublishedActor {
            version: 12,
            n_hidden: 5,
            n_hidden_layers: 3,
            actor: ramp(63 * 5 + 2 * 6 * 5 + 6 * 6),
            observation_mean: ramp(56),
            observation_std: vec![0.01; 56],
            goal_mean: ramp(6),
            goal_std: vec![2.0; 6],
            gate: None,
        }
    }

    #[test]
    fn a_gate_round_trips_and_one_of_another_size_is_refused() {
        let ramp = |n: u16| (0..n).map(|i| f32::from(i) / 64.0 - 1.0).collect();
        let gate = PublishedGate {
            n_critics: 3,
            n_hidden: 4,
            n_hidden_layers: 2,
            n_heads: 2,
            critics: ramp(3 * (69 * 4 + 5 * 4 + 5 * 2)),
            threshold: 0.5,
        };
        let gated = PublishedActor { gate: Some(gate), ..actor() };
        let message = encode_actor(&gated);
        assert_eq!(decode_actor(&message, LAYOUT), Ok(gated));
        let check = |spoil: fn(&mut pb::Parameters), expected: &str| {
            let mut spoilt = message.clone();
            spoil(&mut spoilt);
            assert_eq!(decode_actor(&spoilt, LAYOUT).unwrap_err().to_string(), expected);
        };
        check(|m| m.n_critics = 65, "n_critics: expected 2 to 64, got 65");
        check(|m| m.n_critics = 1, "n_critics: expected 2 to 64, got 1");
        check(|m| m.n_critic_heads = 3, "n_critic_heads: expected 1 to 2, got 3");
        check(|m| m.n_critics = 0, "n_critic_hidden: expected no value without critics, got one");
        let rest = |m: &mut pb::Parameters| {
            *m = pb::Parameters { ask_above: 0.5, ..encode_actor(&actor()) }
        };
        check(rest, "ask_above: expected no value without critics, got one");
        check(|m| m.n_critics = 2, "critics: expected 612 numbers, got 918 numbers");
        check(|m| m.critics[..4].fill(0xff), "critics[0]: expected a finite number, got NaN");
    }

    #[test]
    fn an_actor_round_trips() {
        let bytes = encode_actor(&actor()).encode_to_vec();
        let message = pb::Parameters::decode(bytes.as_slice()).unwrap();
        assert_eq!(decode_actor(&message, LAYOUT), Ok(actor()));
    }

    #[test]
    fn a_malformed_actor_is_refused_by_name() {
        let check = |corrupt: fn(&mut pb::Parameters), message: &str| {
            let mut malformed = encode_actor(&actor());
            corrupt(&mut malformed);
            assert_eq!(decode_actor(&malformed, LAYOUT).unwrap_err().to_string(), message);
        };
        check(|p| p.n_hidden = 6, "actor: expected 504 numbers, got 411 numbers");
        check(|p| p.n_hidden = u32::MAX, "n_hidden: expected 1 to 16384, got 4294967295");
        check(|p| p.n_layers = 0, "n_layers: expected 1 to 64, got 0");
        check(
            |p| p.actor.truncate(1643),
            "actor: expected 1644 bytes, 4 per number, got 1643 bytes",
        );
        check(|p| p.goal_std[4..8].fill(0), "goal_std[1]: expected a finite number above 0, got 0");
        check(|p| p.goal_mean[8..12].fill(0xff), "goal_mean[2]: expected a finite number, got NaN");
        check(
            |p| p.observation_mean.clear(),
            "observation_mean: expected 56 numbers, got 0 numbers",
        );
    }
}
