//! Policy files: loading them, the shipped teachers, and `tandem policy`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde_json::json;
use tandem_policy::Policy;

use crate::cli::{PolicyArgs, PolicyCommand};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::output;

/// Loads a policy file.
pub(crate) fn load(path: &Path) -> Result<Policy, Failed> {
    Policy::load(path).or_exit(Exit::Data, String::new)
}

/// Finds the shipped teacher of a task: in the working directory, next to the program, or in the source tree.
pub(crate) fn shipped_teacher(task: &str) -> Result<PathBuf, Failed> {
    let name = format!("policies/teacher-{task}.safetensors");
    let next_to_program =
        std::env::current_exe().ok().and_then(|exe| Some(exe.parent()?.join(&name)));
    let candidates = [
        Some(PathBuf::from(&name)),
        next_to_program,
        Some(Path::new(env!("CARGO_MANIFEST_DIR")).join(&name)),
    ];
    candidates.into_iter().flatten().find(|path| path.exists()).ok_or_else(|| {
        Failed::usage(format!(
            "{name}, the shipped teacher of {task}, does not exist: train one with `tandem train --arms 1 --task {task}` \
             and name its policy/best.safetensors with --teacher"
        ))
    })
}

/// `tandem policy show`.
pub(crate) fn policy(args: &PolicyArgs) -> Result<(), Failed> {
    let PolicyCommand::Show { file, json } = &args.command;
    let policy = load(file)?;
    let metadata: BTreeMap<_, _> = policy.metadata.iter().collect();
    if *json {
        return output::print(json!({
            "task": policy.layout.name(), "arms": policy.layout.n_arms(), "n_hidden": policy.n_hidden,
            "n_hidden_layers": policy.n_hidden_layers, "critic_heads": policy.n_heads, "digest": policy.digest(),
            "metadata": metadata,
        }));
    }
    output::print(format_args!("task          {}", policy.layout.name()))?;
    output::print(format_args!("arms          {}", policy.layout.n_arms()))?;
    output::print(format_args!(
        "networks      {} hidden layers of {}, critic heads {}",
        policy.n_hidden_layers, policy.n_hidden, policy.n_heads
    ))?;
    output::print(format_args!(
        "parameters    actor {}, critic {}",
        policy.actor.len(),
        policy.critic.len()
    ))?;
    output::print(format_args!("digest        {}", policy.digest()))?;
    for (key, value) in metadata {
        let [key, value] = [key, value].map(|text| output::escaped(text).replace('\n', "\\n"));
        output::print(format_args!("{key:<22} {value}"))?;
    }
    Ok(())
}
