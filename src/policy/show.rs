//! `tandem policy show`.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::path::Path;

use serde_json::json;
use tandem_onnx::binding::task_of;
use tandem_onnx::network::{Op, Step};
use tandem_onnx::{BoundNetwork, Model, Network, Role};
use tandem_teacher::policy::is_onnx;

use crate::cli::ShowArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{output, policy_file};

pub(super) fn show(args: &ShowArgs) -> Result<(), Failed> {
    if is_onnx(&args.file) { show_model(&args.file, args.json) } else { show_policy(args) }
}

fn show_policy(args: &ShowArgs) -> Result<(), Failed> {
    let policy = policy_file::load(&args.file)?;
    let described = policy.task.as_built_in().is_none();
    let description = described.then(|| json!(policy.task.description()));
    if args.json {
        let mut shown = json!({
            "task": policy.task.name(), "arms": policy.task.n_arms(), "n_hidden": policy.n_hidden,
            "n_hidden_layers": policy.n_hidden_layers, "critic_heads": policy.n_heads, "digest": policy.digest(),
            "metadata": policy.metadata,
        });
        if let Some(description) = description {
            shown["description"] = description;
        }
        return output::print(shown);
    }
    line("task", policy.task.name())?;
    line("arms", policy.task.n_arms())?;
    let (n_layers, n_hidden, n_heads) = (policy.n_hidden_layers, policy.n_hidden, policy.n_heads);
    let critic = match policy.has_critic() {
        true => format!("critic heads {n_heads}"),
        false => "no critic".to_owned(),
    };
    line("networks", format_args!("{n_layers} hidden layers of {n_hidden}, {critic}"))?;
    let (n_actor, n_critic) = (policy.actor.len(), policy.critic.len());
    line("parameters", format_args!("actor {n_actor}, critic {n_critic}"))?;
    line("digest", policy.digest())?;
    let description = description.map(|text| ("description".to_owned(), text.to_string()));
    show_metadata(&policy.metadata.into_iter().chain(description).collect())
}

fn show_model(file: &Path, as_json: bool) -> Result<(), Failed> {
    let model = Model::load(file).or_exit(Exit::Data, String::new)?;
    let network = &model.network;
    let inputs = network.inputs.iter();
    let fit =
        [(Role::Actor, "actor"), (Role::Critic, "critic")].into_iter().find_map(|(role, name)| {
            let task = task_of(&model, role).ok()?;
            BoundNetwork::new(&model, role, &task).is_ok().then_some((name, task))
        });
    if as_json {
        let inputs: Vec<_> =
            inputs.map(|input| json!({ "name": input.name, "width": input.width })).collect();
        return output::print(json!({
            "role": fit.as_ref().map(|(name, _)| name),
            "task": fit.as_ref().map(|(_, task)| task.name()),
            "arms": fit.as_ref().map(|(_, task)| task.n_arms()),
            "inputs": inputs,
            "output": { "name": network.output, "width": network.n_output },
            "layers": layers(network),
            "n_parameters": network.n_parameters(),
            "producer": model.producer, "ir_version": model.ir_version, "opset": model.opset,
            "digest": model.digest, "metadata": model.metadata,
        }));
    }
    match fit {
        Some((name, task)) => {
            line("fits", format_args!("{name} for {}, arms {}", task.name(), task.n_arms()))?;
        }
        None => line("fits", "no task")?,
    }
    let inputs: Vec<String> =
        inputs.map(|input| format!("{} [batch, {}]", input.name, input.width)).collect();
    line("inputs", output::escaped(&inputs.join(", ")))?;
    line("output", format_args!("{} [batch, {}]", network.output, network.n_output))?;
    line("layers", layers(network).join(", "))?;
    line("parameters", network.n_parameters())?;
    let (ir, opset) = (model.ir_version, model.opset);
    line("format", format_args!("IR version {ir}, opset {opset}, written by {}", model.producer))?;
    line("digest", &model.digest)?;
    show_metadata(&model.metadata)
}

/// Describes each layer by its number of units and the operations after it.
fn layers(network: &Network) -> Vec<String> {
    let mut layers: Vec<String> = Vec::new();
    for step in &network.steps {
        match (step, layers.last_mut()) {
            (Step::Layer(layer), _) => layers.push(layer.bias.len().to_string()),
            (Step::Each(ops), Some(last)) => {
                let name = match ops.first() {
                    Some(Op::Relu) => "relu",
                    Some(Op::Tanh) => "tanh",
                    Some(Op::Clip(..)) => "clip",
                    _ => "affine",
                };
                last.push(' ');
                last.push_str(name);
            }
            (Step::Each(_), None) => {}
        }
    }
    layers
}

fn show_metadata(metadata: &BTreeMap<String, String>) -> Result<(), Failed> {
    for (key, value) in metadata {
        let [key, value] = [key, value].map(|text| output::escaped(text).replace('\n', "\\n"));
        output::print(format_args!("{key:<22} {value}"))?;
    }
    Ok(())
}

fn line(label: &str, value: impl Display) -> Result<(), Failed> {
    output::print(format_args!("{label:<13} {}", value.to_string().replace('\n', "\\n")))
}
