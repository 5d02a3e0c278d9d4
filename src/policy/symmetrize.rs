//! `tandem policy symmetrize`.

use serde_json::json;
use tandem_system::atomic_file;

use crate::cli::SymmetrizeArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::output::check_distinct;
use crate::{output, policy_file};

pub(super) fn symmetrize(args: &SymmetrizeArgs) -> Result<(), Failed> {
    let file = policy_file::file_of(&args.file)?;
    let policy = policy_file::load(&file)?;
    let refusal = if policy.is_symmetrized() {
        Some("the policy is symmetrised already".to_owned())
    } else if !policy.task.has_interchangeable_arms() {
        let (task, n_arms) = (policy.task.name(), policy.task.n_arms());
        Some(format!("the arms of {task}, arms {n_arms}, are not interchangeable"))
    } else {
        None
    };
    if let Some(refusal) = refusal {
        return Err(Failed::usage(format!("{}: {refusal}", args.file.display())));
    }
    check_distinct(&[("FILE", Some(&*file)), ("--out", Some(args.out.as_path()))])?;
    let mut policy = policy.symmetrized();
    // The evaluation was that of the policy before. Its seed remains: the goals chose this policy too.
    policy
        .metadata
        .retain(|key, _| !key.starts_with("evaluation_success") && key != "evaluation_episodes");
    let bytes = policy.to_bytes().or_exit(Exit::Data, String::new)?;
    atomic_file::replace_target(&args.out, &bytes)
        .or_cannot_write(|| format!("cannot write {}", args.out.display()))?;
    let (n_layers, n_hidden) = (policy.n_hidden_layers, policy.n_hidden);
    if args.json {
        return output::print(json!({
            "file": args.out.to_string_lossy(), "digest": policy.digest(), "n_hidden": n_hidden, "n_hidden_layers": n_layers,
        }));
    }
    output::print(format_args!("policy        {}", args.out.display()))?;
    output::print(format_args!("networks      {n_layers} hidden layers of {n_hidden}"))?;
    output::print(format_args!("digest        {}", policy.digest()))
}
