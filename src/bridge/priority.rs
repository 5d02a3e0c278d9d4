//! The priority of the thread that moves the arms.

use std::io;

use thread_priority::{
    Error, RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

/// Priority among real-time threads, 1 to 99: below those that the kernel uses for interrupts (50).
const PRIORITY: u8 = 5;

/// Gives the calling thread real-time priority (`SCHED_FIFO`), so that other programs cannot delay commands. Warns if
/// the system does not permit that.
pub(super) fn raise() {
    if let Err(why) = try_raise() {
        tracing::warn!(
            why,
            "no real-time priority: other programs may delay commands, which stops the arms (allow it with \
             `ulimit -r 5` or CAP_SYS_NICE)"
        );
    }
}

/// Does the same for simulated arms, where a late command does no harm.
pub(super) fn raise_if_permitted() {
    if let Err(why) = try_raise() {
        tracing::debug!(why, "no real-time priority");
    }
}

fn try_raise() -> Result<(), String> {
    let priority = ThreadPriorityValue::try_from(PRIORITY)?;
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    let priority = ThreadPriority::Crossplatform(priority);
    set_thread_priority_and_policy(thread_native_id(), priority, policy).map_err(
        |error| match error {
            Error::OS(code) => io::Error::from_raw_os_error(code).to_string(),
            error => error.to_string(),
        },
    )
}
