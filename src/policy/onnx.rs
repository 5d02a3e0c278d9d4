//! `tandem policy export` and `tandem policy import`.

use std::path::{Path, PathBuf};

use serde_json::json;
use tandem_core::rng::uniform;
use tandem_core::task::Norm;
use tandem_core::{Layout, Stream, TaskSpec, episode_rng};
use tandem_onnx::binding::{check_pair, names_task, task_of};
use tandem_onnx::import::check as check_representable;
use tandem_onnx::model::digest;
use tandem_onnx::{
    BoundNetwork, Error, Model, ModelError, Role, export as write, import as convert,
};
use tandem_policy::Policy;
use tandem_system::atomic_file;

use crate::cli::{ExportArgs, ImportArgs};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::output::check_distinct;
use crate::{output, policy_file, served_task};

/// Number of random states on which an imported policy is compared with its models.
const N_COMPARED: usize = 1000;
/// The context of a refusal of a model whose task is not known.
const UNKNOWN_TASK: &str = "the task is unknown, name it with --task, --env or --env-command";
/// Largest accepted difference, relative to values above 1.
const TOLERANCE: f32 = 1e-4;

/// Encodes one of a policy's networks.
type Encode = fn(&Policy) -> Result<Vec<u8>, tandem_policy::Error>;

pub(super) fn export(args: &ExportArgs) -> Result<(), Failed> {
    let file = policy_file::file_of(&args.file)?;
    let policy = policy_file::load(&file)?;
    if args.critic_onnx.is_some() && !policy.has_critic() {
        let shown = args.file.display();
        return Err(Failed::usage(format!("--critic-onnx: {shown} has no critic")));
    }
    let outputs =
        [("--onnx", args.onnx.as_deref()), ("--critic-onnx", args.critic_onnx.as_deref())];
    check_distinct(&[("FILE", Some(&*file)), outputs[0], outputs[1]])?;
    let mut written = Vec::new();
    let networks: [(_, _, Encode); 2] =
        [("actor", &args.onnx, write::actor), ("critic", &args.critic_onnx, write::critic)];
    for (role, path, encode) in networks {
        let Some(path) = path else { continue };
        let file = encode(&policy).or_exit(Exit::Data, String::new)?;
        atomic_file::replace_target(path, &file)
            .or_cannot_write(|| format!("cannot write {}", path.display()))?;
        written.push((role, path, digest(&file)));
    }
    if args.json {
        let file = |(role, path, digest): &(&str, &PathBuf, String)| json!({ "role": role, "file": path.to_string_lossy(), "digest": digest });
        let files: Vec<_> = written.iter().map(file).collect();
        return output::print(json!({ "policy_digest": policy.digest(), "files": files }));
    }
    for (role, path, digest) in &written {
        output::print(format_args!("{role:<13} {}, SHA-256 {digest}", path.display()))?;
    }
    output::print(format_args!("policy digest {}", policy.digest()))
}

pub(super) fn import(args: &ImportArgs) -> Result<(), Failed> {
    for (name, input) in
        [("ACTOR", Some(args.actor.as_path())), ("--critic", args.critic.as_deref())]
    {
        check_distinct(&[(name, input), ("--out", Some(args.out.as_path()))])?;
    }
    let actor = Model::load(&args.actor).or_exit(Exit::Data, String::new)?;
    let critic = args.critic.as_deref().map(Model::load).transpose();
    let critic = critic.or_exit(Exit::Data, String::new)?;
    let refused = |source| refused(&args.actor, source);
    let task = task_of_import(args, &actor)?;
    // The critic alone is checked first, so that an error names its file.
    if let Some((critic, path)) = critic.as_ref().zip(args.critic.as_ref()) {
        let checked = check_pair(&actor, critic);
        let checked = checked.and_then(|()| check_representable(critic, Role::Critic, &task));
        checked.map_err(|source| self::refused(path, source))?;
    }
    let policy = convert(&actor, critic.as_ref(), &task).map_err(refused)?;
    let differences = compare(&policy, &actor, critic.as_ref()).map_err(refused)?;
    if differences.iter().any(|difference| difference.is_nan() || *difference > TOLERANCE) {
        return Err(Failed::new(
            Exit::Data,
            anyhow::anyhow!(
                "{}: the policy differs from the model by {:.1e}, because its numbers are too large for float32",
                args.actor.display(),
                Norm::Maximum.combined(differences[0], differences[1])
            ),
        ));
    }
    let file = policy.to_bytes().or_exit(Exit::Data, String::new)?;
    atomic_file::replace_target(&args.out, &file)
        .or_cannot_write(|| format!("cannot write {}", args.out.display()))?;
    if args.json {
        return output::print(json!({
            "file": args.out.to_string_lossy(), "task": task.name(), "arms": task.n_arms(), "digest": policy.digest(),
            "has_critic": policy.has_critic(), "action_difference": differences[0], "value_difference": differences[1],
        }));
    }
    output::print(format_args!("policy        {}", args.out.display()))?;
    output::print(format_args!("task          {}, arms {}", task.name(), task.n_arms()))?;
    output::print(format_args!("digest        {}", policy.digest()))?;
    let values = match policy.has_critic() {
        true => format!(", values by {:.1e}", differences[1]),
        false => "; it has no critic, so a teacher of it offers no strategy that compares values"
            .to_owned(),
    };
    output::print(format_args!(
        "compared      {N_COMPARED} random states: actions differ by {:.1e}{values}",
        differences[0]
    ))
}

/// Returns the task that the arguments name, or else the one that the model names or fits.
fn task_of_import(args: &ImportArgs, actor: &Model) -> Result<TaskSpec, Failed> {
    if let (Some(task), Some(n_arms)) = (args.task, args.arms) {
        let task = task.in_named_world(args.world)?;
        if usize::from(n_arms) < task.min_arms() {
            return Err(Failed::usage(format!("--arms {n_arms}: {task} takes two arms")));
        }
        return Ok(Layout::new(task, usize::from(n_arms)).into());
    }
    if let Some(served) = served_task::of_server(&args.environment)? {
        return Ok(served.task);
    }
    task_of(actor, Role::Actor).map_err(|source| {
        let failed = refused(&args.actor, source);
        if names_task(actor) { failed } else { failed.context(UNKNOWN_TASK.to_owned()) }
    })
}

fn refused(path: &Path, source: ModelError) -> Failed {
    let error = Error::Refused { path: path.to_owned(), source: Box::new(source) };
    Failed::new(Exit::Data, error)
}

/// Returns the largest differences of actions and of values between a policy and its models in random states.
fn compare(policy: &Policy, actor: &Model, critic: Option<&Model>) -> Result<[f32; 2], ModelError> {
    let task = &policy.task;
    let mut rng = episode_rng(0, 0, Stream::Reset);
    let mut draw = |n: usize, most: f32| -> Vec<f32> {
        (0..N_COMPARED * n).map(|_| uniform(&mut rng, -most, most)).collect()
    };
    let (observations, goals) = (draw(task.n_observation(), 0.5), draw(task.n_goal(), 0.5));
    let proposed = draw(task.n_action(), 1.0);
    let mut expected = vec![0.0; proposed.len()];
    let mut got = expected.clone();
    BoundNetwork::new(actor, Role::Actor, task)?.run(&observations, &goals, &[], &mut expected);
    policy.actor()?.act(&observations, &goals, &mut got);
    let action_difference = largest_difference(&got, &expected);
    let Some(critic) = critic else { return Ok([action_difference, 0.0]) };
    let mut expected = vec![0.0; N_COMPARED * policy.n_heads];
    let mut got = expected.clone();
    let mut bound = BoundNetwork::new(critic, Role::Critic, task)?;
    bound.run(&observations, &goals, &proposed, &mut expected);
    policy.critic()?.q(&observations, &goals, &proposed, &mut got);
    Ok([action_difference, largest_difference(&got, &expected)])
}

fn largest_difference(got: &[f32], expected: &[f32]) -> f32 {
    let differences = got.iter().zip(expected);
    let relative =
        differences.map(|(got, expected)| (got - expected).abs() / expected.abs().max(1.0));
    relative.fold(0.0, |largest, next| Norm::Maximum.combined(largest, next))
}
