//! Layers with the activations of a policy's networks.

use crate::binding::Role;
use crate::network::{Layer, Network, Op, Step};

/// A layer with its activation folded away: every hidden layer is followed by ReLU, an actor's last one by tanh.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Dense {
    /// Weight, shape `[n_in, n_out]`.
    weight: Vec<f32>,
    /// Bias, shape `[n_out]`.
    pub(super) bias: Vec<f32>,
}

impl Dense {
    /// Returns the weights of each unit, shape `[n_in]`.
    pub(super) fn rows(&self) -> impl Iterator<Item = Vec<f32>> {
        let n_out = self.bias.len();
        (0..n_out).map(move |unit| self.weight.iter().skip(unit).step_by(n_out).copied().collect())
    }

    /// Applies `ops`, one per unit, to the output. Returns false if they are not affine.
    fn fold(&mut self, ops: &[Op]) -> bool {
        let n_out = self.bias.len();
        for (unit, op) in ops.iter().enumerate() {
            let bias = &mut self.bias[unit];
            match *op {
                Op::Add(c) => *bias += c,
                Op::Sub(c) => *bias -= c,
                Op::Mul(_) | Op::Div(_) => {
                    *bias = op.apply(*bias);
                    let weights = self.weight.iter_mut().skip(unit).step_by(n_out);
                    weights.for_each(|weight| *weight = op.apply(*weight));
                }
                Op::Clip(..) | Op::Relu | Op::Tanh => return false,
            }
        }
        true
    }
}

/// The activation after the last layer so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Activation {
    None,
    Relu,
    Tanh,
}

/// Returns the layers of `network`: at least one hidden layer, and the output layer.
pub(super) fn dense_layers(network: &Network, role: Role) -> Result<Vec<Dense>, String> {
    let mut layers: Vec<Dense> = Vec::new();
    let mut activation = Activation::Relu;
    for step in &network.steps {
        match (step, layers.last_mut()) {
            (Step::Layer(layer), _) => {
                check_hidden(activation, layers.len())?;
                let Layer { weight, bias } = layer.clone();
                layers.push(Dense { weight, bias });
                activation = Activation::None;
            }
            (Step::Each(ops), Some(layer)) => activation = apply(activation, ops, layer)?,
            (Step::Each(_), None) => return Err("its first step is no layer".to_owned()),
        }
    }
    match (role, activation) {
        (Role::Actor, Activation::Tanh) | (Role::Critic, Activation::None) => {}
        (Role::Actor, _) => return Err("the actor does not end with Tanh".to_owned()),
        (Role::Critic, _) => return Err("the critic has an activation at its end".to_owned()),
    }
    if layers.len() < 2 { Err("it has no hidden layer".to_owned()) } else { Ok(layers) }
}

fn check_hidden(activation: Activation, n_layers: usize) -> Result<(), String> {
    match activation {
        Activation::Relu => Ok(()),
        Activation::Tanh => Err(format!(
            "Tanh follows hidden layer {n_layers}, expected Relu (`tandem teacher` can serve the model itself)"
        )),
        Activation::None => Err(format!("no activation follows layer {n_layers}, expected Relu")),
    }
}

/// Returns the activation after `ops`, which follow `layer` and `activation`.
#[expect(clippy::float_cmp, reason = "factors of exactly 1 and offsets of exactly 0")]
fn apply(activation: Activation, ops: &[Op], layer: &mut Dense) -> Result<Activation, String> {
    let all = |test: fn(&Op) -> bool| ops.iter().all(test);
    let is_idle = match activation {
        Activation::None => false,
        Activation::Relu => all(|op| matches!(op, Op::Relu)),
        Activation::Tanh => {
            all(|op| matches!(op, Op::Clip(low, high) if *low <= -1.0 && *high >= 1.0))
        }
    };
    let changes_nothing = all(|op| match op {
        Op::Add(c) | Op::Sub(c) => *c == 0.0,
        Op::Mul(c) | Op::Div(c) => *c == 1.0,
        _ => false,
    });
    if is_idle || changes_nothing {
        return Ok(activation);
    }
    match (activation, ops.first()) {
        (Activation::None, Some(Op::Relu)) => Ok(Activation::Relu),
        (Activation::None, Some(Op::Tanh)) => Ok(Activation::Tanh),
        (Activation::None, _) if layer.fold(ops) => Ok(Activation::None),
        (_, op) => Err(format!("{} follows {activation:?}", op.map_or("nothing", name))),
    }
}

const fn name(op: &Op) -> &'static str {
    match op {
        Op::Add(_) => "Add",
        Op::Sub(_) => "Sub",
        Op::Mul(_) => "Mul",
        Op::Div(_) => "Div",
        Op::Clip(..) => "Clip",
        Op::Relu => "Relu",
        Op::Tanh => "Tanh",
    }
}
