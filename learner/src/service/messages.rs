//! The progress of a run as Protobuf messages.

use tandem_proto::pb;
use tandem_telemetry::MetricsRow;

use crate::progress::{Activity, Progress, RunEnd, WorkerProgress};

/// Encodes a snapshot of the run.
pub(super) fn encode_progress(progress: &Progress) -> pb::Progress {
    let counters = progress.counters;
    let end = progress.end.as_ref();
    pb::Progress {
        task: progress.task.clone(),
        n_arms: u32::try_from(progress.n_arms).unwrap_or(u32::MAX),
        strategy: progress.strategy.clone(),
        round: counters.round,
        resumed_from_round: progress.counters_before.round,
        env_steps: counters.env_steps,
        episodes: counters.episodes,
        updates: counters.updates,
        wall_s: progress.wall_s,
        env_steps_per_s: progress.env_steps_per_s,
        updates_per_s: progress.updates_per_s,
        advice_spent: counters.advice_spent,
        advice_queries: Some(counters.advice_queries),
        budget_left: progress.budget_left,
        phase: progress.phase.map_or_else(String::new, |phase| phase.name().to_owned()),
        training_success: progress.stats.training_success,
        workers: progress.workers.iter().map(encode_worker).collect(),
        evaluation: progress.latest.as_ref().map(encode_evaluation),
        best: progress.best.as_ref().map(encode_evaluation),
        ended: end.is_some(),
        end_reason: end.map_or_else(String::new, |end| end.reason.clone()),
        digest: end.and_then(|end| end.digest.clone()).unwrap_or_default(),
        warning: progress.warning.clone(),
        environment: progress.environment.text(),
        environment_failures: progress.environment.n_failures,
        max_env_steps: progress.max_env_steps,
        max_minutes: progress.max_minutes,
    }
}

/// Encodes the end of a run for its workers.
pub(super) fn encode_finished(end: &RunEnd) -> pb::Finished {
    pb::Finished { reason: end.reason.clone(), interrupted: end.interrupted }
}

fn encode_worker(worker: &WorkerProgress) -> pb::WorkerProgress {
    let doing = match worker.activity {
        Activity::Slot(slot) => format!("slot {slot}"),
        Activity::Waiting => "waiting".to_owned(),
        Activity::Silent => "silent".to_owned(),
    };
    pb::WorkerProgress {
        worker_id: worker.worker_id,
        name: worker.name.clone(),
        episodes: worker.n_episodes,
        doing,
    }
}

/// Encodes an evaluation.
#[must_use]
pub fn encode_evaluation(row: &MetricsRow) -> pb::Evaluation {
    let contacts = &row.contacts;
    pb::Evaluation {
        round: row.round,
        env_steps: row.env_steps,
        n_episodes: u32::try_from(row.n_episodes).unwrap_or(u32::MAX),
        success: row.success,
        success_low: row.success_low,
        success_high: row.success_high,
        success_joint: row.success_joint,
        success_per_arm: row.success_per_arm.clone(),
        collision_rate: row.collision_rate,
        mean_q: row.mean_q,
        success_without_contact: contacts.success_without_contact,
        success_without_contact_low: contacts.success_without_contact_low,
        success_without_contact_high: contacts.success_without_contact_high,
        arm_contact_rate: contacts.arm_contact_rate,
        table_contact_rate: contacts.table_contact_rate,
        avoidance_rate: contacts.avoidance_rate,
    }
}
