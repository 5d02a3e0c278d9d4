//! Command lines of the processes of a run.

use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::Path;

use super::inputs;
use super::plan::Plan;
use crate::environment_server;

/// The option of the learner that names the address of the dashboard.
pub(super) const DASHBOARD: &str = "--dashboard-listen";

/// The option with which the learner writes the run file of a run that it continues.
pub(super) const KEEP_RUN_FILE: &str = "--keep-run-file";

/// Returns the arguments of the teacher.
pub(super) fn teacher(plan: &Plan) -> Vec<OsString> {
    let mut args = command("teacher");
    if let Some(teacher) = &plan.teacher {
        if let Some(server) = teacher.server() {
            push_address(&mut args, "--policy", Some(&server.address));
            push_address(&mut args, "--policy-digest", Some(&server.digest));
        } else {
            push_path(&mut args, "--policy", &inputs::teacher(&plan.out, teacher));
        }
        if let Some(critic) = inputs::teacher_critic(&plan.out, teacher) {
            push_path(&mut args, "--critic", &critic);
        }
    }
    push_path(&mut args, "--ledger", &plan.ledger());
    args.push("--exit-for-restart".into());
    args
}

/// Returns the arguments of the learner. `resume` is set if the run directory contains a run.
pub(super) fn learner(plan: &Plan, teacher_address: Option<&str>, resume: bool) -> Vec<OsString> {
    let mut args = command("learner");
    args.push("--out-is-locked".into());
    push_path(&mut args, "--run", &inputs::settings(&plan.out));
    push_path(&mut args, "--out", &plan.out);
    push_address(&mut args, "--teacher", teacher_address);
    if let Some(address) = plan.metrics {
        push_address(&mut args, "--metrics-listen", Some(&address.to_string()));
    }
    if let Some(teacher) =
        plan.teacher.as_ref().filter(|_| plan.config.advice.starts_from_teacher())
    {
        push_path(&mut args, "--start-from", &inputs::teacher(&plan.out, teacher));
    }
    if resume {
        args.push("--resume".into());
    }
    args
}

/// Adds the address of the dashboard, if there is one.
pub(super) fn push_dashboard(args: &mut Vec<OsString>, plan: &Plan, dashboard: Option<SocketAddr>) {
    let Some(address) = dashboard else { return };
    args.extend([DASHBOARD.into(), address.to_string().into(), "--dashboard-is-optional".into()]);
    if let Some(token) = &plan.dashboard_token_file {
        push_path(args, "--dashboard-token-file", token);
    }
}

/// Returns the arguments of the worker `name`.
pub(super) fn worker(
    plan: &Plan,
    name: &str,
    learner_address: &str,
    teacher_address: Option<&str>,
) -> Vec<OsString> {
    let mut args = command("worker");
    args.extend(["--name".into(), name.into()]);
    push_address(&mut args, "--connect", Some(learner_address));
    push_path(&mut args, "--log-dir", &plan.logs());
    args.extend(plan.recording.arguments());
    push_address(&mut args, "--teacher", teacher_address);
    args.extend(environment_server::arguments(&plan.environment));
    args
}

/// Adds the option `name` with an address, if there is one.
pub(super) fn push_address(args: &mut Vec<OsString>, name: &str, address: Option<&str>) {
    if let Some(address) = address {
        args.extend([name.into(), address.into()]);
    }
}

fn push_path(args: &mut Vec<OsString>, name: &str, path: &Path) {
    args.extend([name.into(), path.into()]);
}

fn command(name: &str) -> Vec<OsString> {
    vec![name.into(), "--exit-with-stdin".into()]
}
