//! Commands about files: policies and logs.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde_json::json;
use tandem_policy::Policy;

use crate::cli::{McapArgs, McapCommand, PolicyArgs, PolicyCommand, ReplayArgs};
use crate::exit::{Exit, Failed, OrExit as _};

/// Loads a policy file, or says in one line why it cannot be used.
pub(crate) fn load_policy(path: &Path) -> Result<Policy, Failed> {
    Policy::load(path).or_exit(Exit::Data, String::new)
}

#[expect(clippy::print_stdout, reason = "what the command is for")]
pub(crate) fn policy(args: &PolicyArgs) -> Result<(), Failed> {
    let PolicyCommand::Show { file, json } = &args.command;
    let policy = load_policy(file)?;
    let metadata: BTreeMap<_, _> = policy.metadata.iter().collect();
    if *json {
        let shown = json!({
            "task": policy.layout.task.name(), "arms": policy.layout.n_arms, "n_hidden": policy.n_hidden,
            "n_hidden_layers": policy.n_hidden_layers, "critic_heads": policy.n_heads, "digest": policy.digest(),
            "metadata": metadata,
        });
        println!("{shown}");
        return Ok(());
    }
    println!("task          {}", policy.layout.task);
    println!("arms          {}", policy.layout.n_arms);
    println!(
        "networks      {} hidden layers of {}, critic heads {}",
        policy.n_hidden_layers, policy.n_hidden, policy.n_heads
    );
    println!("parameters    actor {}, critic {}", policy.actor.len(), policy.critic.len());
    println!("digest        {}", policy.digest());
    for (key, value) in metadata {
        println!("{key:<22} {value}");
    }
    Ok(())
}

#[expect(clippy::print_stdout, reason = "what the command is for")]
pub(crate) fn mcap(args: &McapArgs) -> Result<(), Failed> {
    let McapCommand::Recover { file, to } = &args.command;
    let to =
        to.clone().unwrap_or_else(|| PathBuf::from(format!("{}.recovered.mcap", file.display())));
    if to.exists() {
        return Err(Failed::usage(format!(
            "{} exists: choose another file with --to",
            to.display()
        )));
    }
    let counts = tandem_telemetry::recover(file, &to).or_exit(Exit::Data, String::new)?;
    println!("recovered {} messages of {} into {}", counts.messages, file.display(), to.display());
    Ok(())
}

#[expect(clippy::print_stdout, reason = "what the command is for")]
pub(crate) fn replay(args: &ReplayArgs) -> Result<(), Failed> {
    let log = tandem_telemetry::read_episode(&args.file).or_exit(Exit::Data, String::new)?;
    let mut world =
        tandem_worker::record::world_of(&log.metadata).or_exit(Exit::Data, String::new)?;
    let mut observation = vec![0.0; log.metadata.layout.n_observation()];
    let mut differs_before = None;
    for (step_idx, transition) in log.transitions.iter().enumerate() {
        world.observe(&mut observation);
        if differs_before.is_none() && observation != transition.observation {
            differs_before = Some(step_idx);
        }
        if !args.json && !args.verify {
            println!(
                "step {step_idx:>2}  reward {:>4.1}  action {:?}",
                transition.reward, transition.action
            );
        }
        world.step(&transition.action).or_exit(Exit::Data, || format!("step {step_idx}"))?;
    }
    let n_steps = log.transitions.len();
    if args.json {
        println!(
            "{}",
            json!({"file": args.file, "steps": n_steps, "identical": differs_before.is_none()})
        );
    } else {
        println!("{n_steps} steps of episode {} played again", log.metadata.episode);
    }
    match differs_before {
        Some(step_idx) if args.verify => {
            let file = args.file.display();
            Err(Failed::new(
                Exit::Data,
                anyhow::anyhow!("{file}: the observation before step {step_idx} differs"),
            ))
        }
        _ => Ok(()),
    }
}
