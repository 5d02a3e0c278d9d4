//! The progress of a run as JSON: the same for `tandem status --json` and for a sweep, which follows its runs.

use serde_json::{Value, json};
use tandem_proto::pb;

use crate::progress_text::remaining_s;

/// Returns a message as an object.
pub(crate) fn progress_json(progress: &pb::Progress) -> Value {
    let worker = |worker: &pb::WorkerProgress| {
        json!({
            "worker_id": worker.worker_id, "name": worker.name, "episodes": worker.episodes,
            "doing": worker.doing,
        })
    };
    json!({
        "task": progress.task, "arms": progress.n_arms, "strategy": progress.strategy,
        "phase": progress.phase, "round": progress.round, "env_steps": progress.env_steps,
        "episodes": progress.episodes, "updates": progress.updates, "wall_s": progress.wall_s,
        "env_steps_per_s": progress.env_steps_per_s, "updates_per_s": progress.updates_per_s,
        "advice_spent": progress.advice_spent, "budget_left": progress.budget_left,
        "advice_queries": progress.advice_queries,
        "training_success": progress.training_success,
        "evaluation": progress.evaluation.as_ref().map(evaluation_json),
        "best": progress.best.as_ref().map(evaluation_json),
        "workers": progress.workers.iter().map(worker).collect::<Vec<_>>(),
        "ended": progress.ended, "end_reason": progress.end_reason, "digest": progress.digest,
        "warning": progress.warning, "environment": progress.environment,
        "environment_failures": progress.environment_failures,
        "max_env_steps": progress.max_env_steps, "max_minutes": progress.max_minutes,
        "remaining_s": remaining_s(progress),
    })
}

fn evaluation_json(evaluation: &pb::Evaluation) -> Value {
    json!({
        "round": evaluation.round, "env_steps": evaluation.env_steps,
        "episodes": evaluation.n_episodes, "success": evaluation.success,
        "success_low": evaluation.success_low, "success_high": evaluation.success_high,
        "success_joint": evaluation.success_joint, "success_per_arm": evaluation.success_per_arm,
        "success_without_contact": evaluation.success_without_contact,
        "success_without_contact_low": evaluation.success_without_contact_low,
        "success_without_contact_high": evaluation.success_without_contact_high,
        "arm_contact_rate": evaluation.arm_contact_rate,
        "table_contact_rate": evaluation.table_contact_rate,
        "avoidance_rate": evaluation.avoidance_rate,
        "collision_rate": evaluation.collision_rate, "mean_q": evaluation.mean_q,
    })
}
